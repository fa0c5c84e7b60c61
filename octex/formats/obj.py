"""Writes Wavefront OBJ: a surface with images as .obj, with .mtl and image files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from octex.channels import CHANNELS, linear_to_srgb
from octex.errors import ModelError
from octex.files import replacing
from octex.formats.images import ImageFormat, file_format, image_file, image_name
from octex.formats.models import Target, Written, colors_of_vertices, materials_of
from octex.source.materials import Material
from octex.source.models.mtl import KEYS
from octex.source.surface import Surface


def write(surface: Surface, target: Target) -> Written:
    """Write a surface as OBJ and .mtl; ModelError for factors above 1 and several sets of coordinates."""
    path, images, _ = target[:3]
    source = materials_of(surface)
    used = np.unique(source.triangle_materials).tolist()
    names = _names({number: source.materials[number] for number in used})
    coordinates = source.coordinates[0] if source.coordinates else None
    lines = [f"mtllib {path.stem}.mtl"]
    materials = []
    written: dict[tuple[object, ...], str] = {}
    for number in used:
        materials.append(f"newmtl {names[number]}")
        materials += _described(source.materials[number], path, number, images, written)
    with replacing(path.with_suffix(".mtl")) as file:
        file.write("\n".join([*materials, ""]).encode(errors="surrogateescape"))
    positions = surface.vertices
    colors = colors_of_vertices(surface)
    if colors is not None:  # sRGB after the position, a common extension
        positions = np.column_stack([positions, linear_to_srgb(colors[:, :3]).round(6)])
    lines += ["v " + " ".join(map(repr, each)) for each in positions.tolist()]
    columns = [surface.triangles]
    if coordinates is not None:
        lines += [f"vt {u!r} {1.0 - v!r}" for u, v in coordinates.values.astype(np.float64).tolist()]
        columns.append(coordinates.rows)
    frames = surface.posed_frames()
    if frames is not None:
        normals = frames.normals
        lines += [f"vn {x:.7g} {y:.7g} {z:.7g}" for x, y, z in normals.values.tolist()]
        columns.append(normals.rows)
    separator = "//" if coordinates is None else "/"
    corners = np.stack(columns, axis=-1) + 1
    for number in used:
        lines.append(f"usemtl {names[number]}")
        for triangle in corners[source.triangle_materials == number].tolist():
            lines.append("f " + " ".join(separator.join(map(str, corner)) for corner in triangle))
    with replacing(path) as file:
        file.write("\n".join([*lines, ""]).encode(errors="surrogateescape"))
    image_files = [path.with_name(name) for name in written.values()]
    image_bytes = sum(file.stat().st_size for file in image_files)
    return Written([path, path.with_suffix(".mtl"), *image_files], image_bytes)


def _names(materials: Mapping[int, Material]) -> dict[int, str]:
    """Return a distinct name for each material: its name in the model, as one word."""
    names: dict[int, str] = {}
    for number, material in materials.items():
        # Many readers end a name at a blank, and none reads zeros or unpaired surrogates.
        name = re.sub(r"[\s\0\ud800-\udfff]", "_", material.name) or f"material{number}"
        while name in names.values():
            name += "_"
        names[number] = name
    return names


def _described(
    material: Material, path: Path, number: int, images: ImageFormat, written: dict[tuple[object, ...], str]
) -> Iterator[str]:
    """Yield the lines of a material, and write its images; ``written`` are the names of finished images."""
    for channel, item in material.inputs.items():
        if channel not in KEYS or (channel == "alpha" and material.alpha_mode == "opaque"):
            continue
        if any(item.offset) or max(item.factor) > 1.0:
            raise ModelError(f"an .mtl file cannot scale {channel!r} above 1, or add to it; write a .glb")
        factor, word = KEYS[channel][:2]
        if item.texture is not None:
            if item.texture.slot != 0:
                raise ModelError("an .obj file has one set of texture coordinates; write a .glb")
            key = id(item.texture.texels), item.lanes
            if key not in written:
                data, ending = image_file(item.texture.texels, item.lanes, file_format(images, [channel]))
                stem = image_name(path.stem, material, channel, f"{number}-{channel}")
                written[key] = f"{stem}.{ending}"
                with replacing(path.with_name(written[key])) as file:
                    file.write(data)
            yield f"{word} {written[key]}"
        if factor:
            values = np.array(item.factor)
            if CHANNELS[channel].space == "srgb":
                values = linear_to_srgb(values)
            yield f"{factor} " + " ".join(f"{each:.7g}" for each in values)
