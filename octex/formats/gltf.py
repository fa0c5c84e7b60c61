"""Writes glTF 2.0: a surface with images as .glb, one file, or as .gltf with separate files."""

from __future__ import annotations

import json
import os
import struct
import urllib.parse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from octex.arrays import Array, Integers
from octex.errors import ModelError
from octex.files import OCTREE_EXTENSION, replacing
from octex.formats.images import ImageFormat, encoded_images, image_names
from octex.formats.models import Target, Written, materials_of, origin_of
from octex.formats.web import texture_file
from octex.gltf import COMPONENT_TYPES
from octex.source.materials import Input, Material, MaterialSource
from octex.source.models.gltf import NEAREST, WRAPS
from octex.source.surface import Surface
from octex.source.welding import distinct_rows
from octex.texture import OctreeTexture

_CODES = {kind: code for code, kind in COMPONENT_TYPES.items()}
_ARRAYS, _ELEMENTS = 34962, 34963
_WRAPS = {wrap: code for code, wrap in WRAPS.items()}
_LINEAR, _MIPMAPS = 9729, 9987
_JSON, _BIN = 0x4E4F534A, 0x004E4942
#: Reflectance of a dielectric whose specular colour is 1 in KHR_materials_specular.
_DIELECTRIC = 0.04


def write(surface: Surface, target: Target) -> Written:
    """Write a surface with images as glTF 2.0; raises ModelError for values that glTF materials cannot hold.

    A model far from the origin is moved by a translation of its node. Without ``frames``, viewers shade flat.
    """
    path = target.path
    content = _Content(surface, target.images, target.octree)
    octree = None if target.octree is None else texture_file(target.octree, Path(surface.name).stem)
    image_bytes = sum(len(data) for data, _ in content.images)
    if path.suffix.lower() == ".glb":
        if octree is not None:
            content.carry({"bufferView": content.view(octree)})
        words = content.finish({}, content.embed)
        words += b" " * (-len(words) % 4)
        size = sum(map(len, content.arrays))
        total = 12 + 8 + len(words) + 8 + size
        if total >= 2**32:
            raise ModelError(f"{path.name}: {total:,} bytes are more than a .glb holds; write a .gltf")
        with replacing(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<II", len(words), _JSON) + words)
            file.write(struct.pack("<II", size, _BIN))
            file.writelines(content.arrays)
        return Written([path], image_bytes)
    names = image_names(content.materials, path.stem, content.images)
    arrays = path.with_name(f"{path.stem}.bin")
    datas = ([data] for data, _ in content.images)
    side_files = list(zip(map(path.with_name, names), datas, strict=True))
    if octree is not None:
        side_files.append((path.with_suffix(".octw"), [octree]))
        content.carry(_reference(side_files[-1][0].name))
    words = content.finish(_reference(arrays.name), lambda number: _reference(names[number]))
    for file_path, blocks in [*side_files, (arrays, content.arrays), (path, [words])]:
        with replacing(file_path) as file:
            file.writelines(blocks)
    return Written([path, arrays, *(file_path for file_path, _ in side_files)], image_bytes)


class _Content:
    """The JSON of a file, and the bytes that it refers to."""

    def __init__(self, surface: Surface, images: ImageFormat, octree: OctreeTexture | None) -> None:
        source = materials_of(surface)
        self._format, self._octree = images, octree
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "octex"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
        }
        self.arrays: list[bytes] = []  # of buffer views
        self._views: list[dict[str, Any]] = []
        self._extensions: set[str] = set()
        self._frames = surface.posed_frames()
        self._origin = origin_of(surface.vertices)
        primitives = []
        used = np.unique(source.triangle_materials).tolist()
        self.materials = [source.materials[n] for n in used]
        self.images, self._numbers = encoded_images(self.materials, self._format)
        self._textures: dict[tuple[object, ...], int] = {}
        self.json["materials"] = [self._material(each) for each in self.materials]
        for number, material in enumerate(self.materials):
            triangles = np.flatnonzero(source.triangle_materials == used[number])
            normal = material.inputs.get("normal")
            has_map = normal is not None and normal.texture is not None
            primitives.append({**self._primitive(surface, source, triangles, has_map), "material": number})
        name = Path(surface.name).stem
        self.json["meshes"] = [{"name": name, "primitives": primitives}]
        self.json["nodes"] = [{"name": name, "mesh": 0}]
        if self._origin.any():
            self.json["nodes"][0]["translation"] = self._origin.tolist()
        if self._extensions:
            self.json["extensionsUsed"] = sorted(self._extensions)
        if self._format == "webp" and self.images:
            self.json["extensionsRequired"] = ["EXT_texture_webp"]

    def _primitive(
        self, surface: Surface, source: MaterialSource, triangles: Integers, has_normal_map: bool
    ) -> dict[str, Any]:
        """Add triangles with the data of their corners; equal corners become one vertex."""
        columns = {f"TEXCOORD_{slot}": column for slot, column in enumerate(source.coordinates)}
        if source.colors is not None:
            columns["COLOR_0"] = source.colors
        if self._frames is not None:
            columns["NORMAL"] = self._frames.normals
            if has_normal_map:
                columns["TANGENT"] = self._frames.tangents
        rows = [surface.triangles, *(column.rows for column in columns.values())]
        corners = np.stack([each[triangles] for each in rows], axis=-1)
        vertices, indices = distinct_rows(corners.reshape(-1, corners.shape[-1]))
        positions = surface.vertices[vertices[:, 0]] - self._origin
        attributes = {"POSITION": self._array(positions.astype("<f4"), limits=True)}
        for number, (name, column) in enumerate(columns.items(), 1):
            attributes[name] = self._array(column.values[vertices[:, number]].astype("<f4"))
        at_rest = self._at_rest(surface, vertices[:, 0])
        accessor = self._array(indices.astype("<u4"), _ELEMENTS)
        return {"attributes": attributes, "indices": accessor, **at_rest}

    def _at_rest(self, surface: Surface, vertices: Integers) -> dict[str, Any]:
        """Return the extension for the vertices' rest positions in the octree's root cell, if they differ."""
        if self._octree is None:
            return {}
        origin, size = self._octree.placement
        extension: dict[str, Any] = {"octree": 0, "scale": 1.0 / size}
        extension["offset"] = ((self._origin - origin) / size).tolist()
        if surface.rest is not surface.vertices:
            extension["rest"] = self._array((surface.rest[vertices] - self._origin).astype("<f4"))
        return {"extensions": {OCTREE_EXTENSION: extension}}

    def carry(self, file: Mapping[str, Any]) -> None:
        """Refer to the octree's web file."""
        self.json["extensions"] = {OCTREE_EXTENSION: {"octrees": [file]}}
        self.json["extensionsUsed"] = sorted({*self._extensions, OCTREE_EXTENSION})

    def _array(self, values: Array, target: int = _ARRAYS, *, limits: bool = False) -> int:
        """Add numbers (n,), or vectors (n, 2 to 4), and return the number of their accessor."""
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target), "componentType": _CODES[values.dtype.str],
            "count": len(values), "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }  # fmt: skip
        if limits:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.json.setdefault("accessors", []).append(accessor)
        return len(self.json["accessors"]) - 1

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes, and return the number of their buffer view."""
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": sum(map(len, self.arrays)),
            "byteLength": len(data),
        }
        self._views.append(view if target is None else {**view, "target": target})
        self.arrays.append(data + bytes(-len(data) % 4))
        return len(self._views) - 1

    def _texture(self, item: Input) -> dict[str, Any]:
        """Return the reference to a texture, which is added if it is new."""
        texture = item.texture
        assert texture is not None
        key = (id(texture.texels), *texture[1:])
        if key not in self._textures:
            sampler = {
                "magFilter": NEAREST if texture.nearest else _LINEAR,
                "minFilter": NEAREST if texture.nearest else _MIPMAPS,
                "wrapS": _WRAPS[texture.wrap_u], "wrapT": _WRAPS[texture.wrap_v],
            }  # fmt: skip
            samplers = self.json.setdefault("samplers", [])
            if sampler not in samplers:
                samplers.append(sampler)
            entry: dict[str, Any] = {"sampler": samplers.index(sampler)}
            image = self._numbers[id(texture.texels)]
            if self._format == "webp":
                entry["extensions"] = {"EXT_texture_webp": {"source": image}}
                self._extensions.add("EXT_texture_webp")
            else:
                entry["source"] = image
            textures = self.json.setdefault("textures", [])
            textures.append(entry)
            self._textures[key] = len(textures) - 1
        info: dict[str, Any] = {"index": self._textures[key]}
        return {**info, "texCoord": texture.slot} if texture.slot else info

    def _material(self, material: Material) -> dict[str, Any]:
        """Return a material as glTF has it; raises ModelError for values that it cannot hold."""
        inputs = material.inputs
        for name, item in inputs.items():
            lanes = _LANES.get(name, item.lanes)
            if any(item.offset) or (item.texture is not None and item.lanes[: len(lanes)] != lanes):
                raise ModelError(f"glTF cannot hold the source of channel {name!r}; bake it first")
        color, alpha = inputs.get("base_color", Input((1.0,) * 3)), inputs.get("alpha", Input((1.0,)))
        pbr: dict[str, Any] = {"baseColorFactor": [*color.factor, *alpha.factor]}
        for name, factor in (("metallic", "metallicFactor"), ("roughness", "roughnessFactor")):
            pbr[factor] = inputs[name].factor[0] if name in inputs else float(name == "roughness")
        for pair, key in (
            (("base_color", "alpha"), "baseColorTexture"),
            (("metallic", "roughness"), "metallicRoughnessTexture"),
        ):
            textured = _in_one_image(inputs, pair)
            if textured is not None:
                pbr[key] = self._texture(textured)
        entry: dict[str, Any] = {"pbrMetallicRoughness": pbr}
        if material.name:
            entry["name"] = material.name
        if material.double_sided:
            entry["doubleSided"] = True
        if material.alpha_mode != "opaque":
            entry["alphaMode"] = material.alpha_mode.upper()
        if material.alpha_mode == "mask":
            entry["alphaCutoff"] = material.cutoff
        textures = {
            name: self._texture(inputs[name])
            for name in ("occlusion", "normal", "emissive", "specular")
            if name in inputs and inputs[name].texture is not None
        }
        extensions: dict[str, Any] = {}
        if "occlusion" in textures:
            entry["occlusionTexture"] = textures["occlusion"]
        if "normal" in textures:
            entry["normalTexture"] = {**textures["normal"], "scale": inputs["normal"].factor[0]}
        if "emissive" in inputs:
            strength = max(1.0, *inputs["emissive"].factor)
            entry["emissiveFactor"] = [each / strength for each in inputs["emissive"].factor]
            if "emissive" in textures:
                entry["emissiveTexture"] = textures["emissive"]
            if strength > 1.0:
                extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
        if "specular" in inputs:
            factors = [each / _DIELECTRIC for each in inputs["specular"].factor]
            extensions["KHR_materials_specular"] = {"specularColorFactor": factors}
            if "specular" in textures:
                extensions["KHR_materials_specular"]["specularColorTexture"] = textures["specular"]
        if extensions:
            entry["extensions"] = extensions
            self._extensions |= extensions.keys()
        return entry

    def finish(self, buffer: Mapping[str, Any], place: Callable[[int], dict[str, Any]]) -> bytes:
        """Return the JSON; ``place`` returns where the image with a number is."""
        if self.images:
            self.json["images"] = [place(number) for number in range(len(self.images))]
        self.json["buffers"] = [{**buffer, "byteLength": sum(map(len, self.arrays))}]
        self.json["bufferViews"] = self._views
        return json.dumps(self.json, separators=(",", ":")).encode()

    def embed(self, number: int) -> dict[str, Any]:
        """Put an image into the buffer, and return the reference to it."""
        data, ending = self.images[number]
        return {"bufferView": self.view(data), "mimeType": f"image/{ending}"}


def _in_one_image(inputs: Mapping[str, Input], pair: tuple[str, str]) -> Input | None:
    """Return an input with the image of two channels, in which a number is 1; None if both are numbers."""
    defaults = {"base_color": Input((1.0,) * 3)}
    present = {name: each for name, each in {**defaults, **inputs}.items() if name in pair}
    textured = [each for each in present.values() if each.texture is not None]
    texels = [each.texture.texels for each in textured if each.texture is not None]
    numbers = [name for name, each in present.items() if each.texture is None and name != "alpha"]
    is_one = all(each is texels[0] for each in texels)
    if texels and not (is_one and all((texels[0][..., _LANES[name]] == 65535).all() for name in numbers)):
        raise ModelError(f"glTF needs {pair[0]} and {pair[1]} in one image; bake them first")
    return textured[0] if textured else None


#: Lanes in which glTF reads a channel from its texture.
_LANES = {
    "base_color": (0, 1, 2), "alpha": (3,), "occlusion": (0,), "roughness": (1,), "metallic": (2,),
    "emissive": (0, 1, 2), "specular": (0, 1, 2), "normal": (0, 1, 2),
}  # fmt: skip


def _reference(file: str) -> dict[str, Any]:
    """Return the reference to a file next to the .gltf."""
    return {"uri": urllib.parse.quote(os.fsencode(file))}
