# SPDX-License-Identifier: GPL-3.0-or-later
"""What octex does for the extension, in a process of its own: work.py JOB.json.

Prints lines of JSON: stages with shares, warnings, and at last the answer or an error.
"""

import json
import re
import shutil
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import octex
from octex.drawing.views import as_png, draw_paintable
from octex.formats.images import image_file
from octex.formats.osl import output_name
from octex.source.images.decode import image_size, read_image_file
from octex.source.materials import Input, MaterialSource

#: Half of white in sRGB, as linear light.
_GREY = 0.2140
#: What images of 16 bits differ by that differ by one code of 8.
_CODE = 257
#: What Blender's Principled shader shows.
_CHANNELS = ("base_color", "alpha", "roughness", "metallic", "emissive", "normal")


def say(**told: Any) -> None:
    print(json.dumps(told), flush=True)


def progress(stage: str, done: int, total: int) -> None:
    say(stage=stage, share=done / max(total, 1))


def surface_of(
    job: dict[str, Any], shaded: bool = False, **options: Any
) -> tuple[octex.Surface, dict[str, np.ndarray]]:
    """Return the mesh of a job, with its shading normals if asked for, and its arrays."""
    folder = Path(job["folder"])
    with np.load(folder / "mesh.npz") as arrays:
        mesh = dict(arrays)
    vertices = mesh["rest"]
    if "matrix" in job:  # as the scene shows it
        matrix = np.array(job["matrix"])
        vertices = np.load(folder / "posed.npy") @ matrix[:3, :3].T + matrix[:3, 3]
    if shaded:
        options["normals"] = mesh["normals"]
    surface = octex.Surface.from_arrays(
        vertices,
        mesh["triangles"],
        rest=mesh["rest"],
        name=job["name"],
        **options,
    )
    return surface, mesh


def model_of(job: dict[str, Any]) -> Path:
    """Return the model that export.py has written."""
    return Path(job["folder"]) / "model.glb"


def save(texture: octex.OctreeTexture, path: str) -> None:
    """Save a texture; the file that was there stays as NAME.octex1, like Blender's .blend1."""
    if Path(path).exists():
        shutil.copyfile(path, f"{path}1")
    texture.save(path)


def make(job: dict[str, Any]) -> dict[str, Any]:
    """Make a texture of a model's materials, or of grey."""
    if job["origin"] == "MATERIAL":
        surface = octex.load_surface(model_of(job), normals=True)
        surface = surface.with_channels([each.name for each in surface.channels if each.name in _CHANNELS])
    else:
        surface, _ = surface_of(job, factor=(_GREY,) * 3)
    texture = octex.convert(surface, job["depth"], progress=progress)
    save(texture, job["output"])
    return {"cells": int(texture.tree.n_cells), "channels": list(texture.channels)}


def colors(job: dict[str, Any]) -> dict[str, Any]:
    """Look up the colour at each corner of the mesh, averaged over the width of its triangles."""
    texture = octex.open(job["texture"])
    surface, mesh = surface_of(job)
    surface.placed_on(texture)
    rest, triangles = mesh["rest"], mesh["triangles"]
    sides = np.linalg.norm(rest[triangles] - rest[np.roll(triangles, 1, axis=1)], axis=2)
    names = [name for name in ("base_color", "alpha") if name in texture.channels]
    found = texture.sample(
        rest[triangles.reshape(-1)], names, width=np.repeat(sides.mean(axis=1), 3),
        normals=mesh["normals"].reshape(-1, 3),
    )  # fmt: skip
    made = np.ones((int(mesh["corners"].max()) + 1, 4), np.float32)
    corners = mesh["corners"].reshape(-1)
    made[corners, :3] = found["base_color"]
    if "alpha" in found:
        made[corners, 3:] = found["alpha"]
    np.save(Path(job["folder"]) / "colors.npy", made)
    return {"channels": names}


def images(job: dict[str, Any]) -> dict[str, Any]:
    """Bake images of the texture: of each material at the mesh's own UVs, or one set at new ones."""
    texture = octex.open(job["texture"])
    folder, output = Path(job["folder"]), Path(job["output"])
    for path, pixels in job["shown"].items():
        check_taken(Path(path), folder / pixels if pixels else None)
    if job["layout"] == "KEEP":
        surface, layout = octex.load_surface(model_of(job), normals=True), "keep"
    else:
        (surface, mesh), layout = surface_of(job, shaded=True), "atlas"
    wanted = [name for name in _CHANNELS if name in texture.channels]
    baked = octex.bake(
        texture, surface, uv=layout, texture_size=job["texture_size"], channels=wanted, progress=progress
    )
    if layout == "atlas":
        uv = baked.source.coordinates[0]
        np.save(folder / "uv.npy", at_corners(mesh["corners"], uv.values[uv.rows] * (1, -1) + (0, 1)))
    made: list[dict[str, Any]] = []
    for material in baked.source.materials:
        name = material.name if layout == "keep" else ""
        maps, values = {}, {}
        for channel, given in material.inputs.items():
            if given.texture is None:
                values[channel] = given.factor
            else:
                path = output.with_name("-".join([output.stem, *re.findall(r"\w+", name), channel]) + ".png")
                path.write_bytes(image_file(given.texture.texels, given.lanes)[0])
                maps[channel] = str(path)
        if "base_color" in maps:
            unpainted(maps["base_color"]).write_bytes(Path(maps["base_color"]).read_bytes())
        made.append({"name": name, "maps": maps, "values": values})
    return {"materials": made}


def check_taken(image: Path, pixels: Path | None) -> None:
    """Refuse to bake over an image, perhaps with unsaved pixels, that was painted on since it was baked."""
    before = unpainted(image)
    if not before.is_file() or not (pixels or image).is_file():
        return
    old = read_image_file(before)[0]
    if pixels is None:
        texels = read_image_file(image)[0]
    else:
        texels = _CODE * np.rint(255 * np.fromfile(pixels, np.float32)).astype(np.uint16)
        texels = texels.reshape(old.shape)[::-1] if texels.size == old.size else texels
    if texels.shape != old.shape or strokes_on(texels, old).any():
        raise octex.OctexError(
            f"{image.name} was painted on: take that over first, or delete {before.name} to lose it"
        )


def strokes_on(texels: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return which texels of an image (h, w) were painted on."""
    return np.abs(np.subtract(texels, before, dtype=np.int32))[..., :3].max(axis=2) > _CODE


def unpainted(image: str | Path) -> Path:
    """Return the path of the copy that shows what was painted on a baked image."""
    return Path(image).with_name(f"{Path(image).stem}-before.png")


def at_corners(corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return texture coordinates of polygons' corners (n, 2) by those of triangles' (m, 3, 2)."""
    values = np.zeros((int(corners.max()) + 1, 2), np.float32)
    values[corners.reshape(-1)] = uv.reshape(-1, 2)
    if (np.abs(values[corners] - uv) > 1e-6).any():
        raise octex.OctexError(
            "The new UV map cuts faces with more than three corners; triangulate the object first"
        )
    return values


def exact(job: dict[str, Any]) -> dict[str, Any]:
    """Write a shader of the texture, the image that it reads, and where the mesh rests."""
    texture = octex.open(job["texture"])
    surface, mesh = surface_of(job)
    surface.placed_on(texture)
    normals = np.empty((int(mesh["corners"].max()) + 1, 3))
    normals[mesh["corners"]] = mesh["normals"]
    for name, values in (("rest", mesh["rest"]), ("normals", normals)):
        upright = values[:, [0, 2, 1]] * (1, -1, 1)
        np.save(Path(job["folder"]) / f"{name}.npy", upright.astype(np.float32))
    octex.write_osl(texture, job["output"])
    forms = [each.format for each in texture.channels.values() if each.format.components <= 3]
    kinds = [0 if form.space == "direction" else 1 if form.components == 1 else 3 for form in forms]
    return {
        "shader": job["output"],
        "outputs": [
            (output_name(form.name), kind, form.name) for form, kind in zip(forms, kinds, strict=True)
        ],
    }


def strokes(job: dict[str, Any]) -> dict[str, Any]:
    """Merge what was painted on baked images: their texels that differ from those that were baked."""
    texture = octex.open(job["texture"])
    shown = octex.load_surface(model_of(job), channels=["base_color"])
    surface = shown.placed_on(texture)
    materials, n_painted, taken = [], 0, {}
    for material in shown.source.materials:
        image, baked = material.inputs["base_color"].texture, job["images"].get(material.name)
        if image is None or baked is None or not (before := unpainted(baked)).is_file():
            raise octex.OctexError(f"{material.name} shows no image that was baked: bake to images first")
        texels, old = image.texels.copy(), read_image_file(before)[0]
        if old.shape != texels.shape:
            raise octex.OctexError(f"the image of {material.name} was resized: bake to images first")
        is_painted = strokes_on(texels, old)
        texels[..., 3] = 65535 * is_painted
        n_painted += int(is_painted.sum())
        taken[before] = image_file(image.texels, slice(3))[0]
        own = image._replace(texels=texels)
        paint = {"base_color": Input((1.0,) * 3, own), "alpha": Input((1.0,), own, (3,))}
        materials.append(material._replace(inputs=paint, alpha_mode="blend"))
    if not n_painted:
        raise octex.OctexError(f"nothing was painted on the images of {job['name']}")
    source = MaterialSource(
        materials, shown.source.triangle_materials, surface.rest, surface.triangles,
        coordinates=shown.source.coordinates,
    )  # fmt: skip
    painted = surface.with_sources({"base_color": source, "alpha": source})
    layer = octex.convert(painted, texture.tree.max_depth, fit=False, progress=progress)
    texture = octex.merge(texture, layer, surface, progress=progress)
    save(texture, job["texture"])
    for before, content in taken.items():
        before.write_bytes(content)
    return {"texels": n_painted}


def view(job: dict[str, Any]) -> dict[str, Any]:
    """Draw the texture on the mesh as a camera sees it, to be painted on."""
    surface, _ = surface_of(job)
    camera = camera_of(job["camera"], job["size"])
    codes = draw_paintable(octex.open(job["texture"]), surface, camera, "base_color")
    Path(job["output"]).write_bytes(as_png(codes))
    return {"output": job["output"], "pixels": int((codes[..., 3] > 0).sum())}


def camera_of(given: dict[str, Any], size: Sequence[int]) -> octex.Camera:
    """Return a camera of Blender's, whose images are so many pixels wide and high."""
    width, height = size
    is_wide = given["fit"] == "HORIZONTAL" or (given["fit"] == "AUTO" and width >= height)
    side, (right, up) = width if is_wide else height, given["shift"]
    return octex.Camera.pinhole(
        (width, height), pose=np.array(given["pose"]), convention="opengl", focal=given["lens"] * side,
        center=(width / 2 - right * side, height / 2 + up * side),
    )  # fmt: skip


def image_of(given: dict[str, Any], folder: Path) -> tuple[Path | np.ndarray, Sequence[int]]:
    """Return a photograph's file, or its pixels if it is in no file, and its width and height."""
    path = folder / given["image"]
    if "pixels" not in given:
        return path, image_size(path)
    width, height, components = given["pixels"]
    pixels = np.fromfile(path, np.float32).reshape(height, width, components)[::-1]
    if not given["is_linear"]:
        return np.rint(255 * pixels).astype(np.uint8), (width, height)
    pixels[..., :3] /= np.maximum(pixels[..., 3:], 1e-6) if components == 4 else 1  # it is premultiplied
    return pixels, (width, height)


def of_files(path: Path) -> list[octex.Projection]:
    """Return the images of a camera file, or of a folder with a COLMAP model, as far as they are there."""
    folder = path if path.is_dir() else path.parent
    projections, missing = [], []
    for frame in octex.read_cameras(path):
        name = Path(frame.name)
        places = [
            frame.image,
            *(up / each for up in (folder, *folder.parents[:3]) for each in (name, "images" / name)),
        ]
        image = next((each for each in places if each is not None and each.is_file()), None)
        if image is None:
            missing.append(frame.name)
        else:
            projections.append(octex.Projection(image, frame.camera(image_size(image))))
    if not projections:
        raise octex.OctexError(
            f"{path}: none of its {len(missing)} images is there or in the folder images next to it"
        )
    if missing:
        say(warning=f"{len(missing)} images of {path.name} are missing, {missing[0]} is one")
    return projections


def photographs(job: dict[str, Any]) -> dict[str, Any]:
    """Project photographs onto the mesh, into its texture or a new one."""
    surface, _ = surface_of(job)
    projections = [
        octex.Projection(image, camera_of(each, size), since=each["since"] or None)
        for each in job["photographs"]
        for image, size in [image_of(each, Path(job["folder"]))]
    ]
    if job["cameras"]:
        projections += of_files(Path(job["cameras"]))
    before = octex.open(job["texture"]) if job["texture"] else None
    texture = octex.paint(
        before, surface, projections, max_depth=job["depth"], back_faces=job["mirrored"], progress=progress
    )
    if texture is before:
        raise octex.OctexError("No camera sees the object, or no view was painted on; nothing is changed")
    save(texture, job["output"])
    return {"cells": int(texture.tree.n_cells), "channels": list(texture.channels)}


TASKS = {each.__name__: each for each in (make, colors, images, exact, strokes, view, photographs)}


def main() -> int:
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))

    def named(message: object) -> str:
        return str(message).replace(model_of(job).name, job["name"])

    warnings.showwarning = lambda message, *_: say(warning=named(message))
    try:
        say(**TASKS[job["task"]](job))
    except octex.OctexError as error:
        say(error=named(error))
    except Exception:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
