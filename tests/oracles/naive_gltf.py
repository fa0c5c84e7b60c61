"""What the materials of a glTF file look like at points of its surface, slowly.

Written from the texts of glTF 2.0 (sections in brackets), KHR_texture_transform, KHR_materials_unlit,
KHR_materials_emissive_strength, KHR_materials_pbrSpecularGlossiness and mikktspace.c, not from octex.
Where the texts leave the order of steps open, or have another one, this takes octex's:

* normal maps: vectors are scaled and normalized before they are interpolated, the texts do it afterwards;
* colours of materials whose alpha counts are interpolated by coverage, the texts interpolate them apart.
"""

from __future__ import annotations

import base64
import io
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt
from PIL import Image

from tests.oracles.naive_mikktspace import mikktspace, unit

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
Json = dict[str, Any]

COMPONENTS = {"base_color": 3, "alpha": 1, "metallic": 1, "roughness": 1, "occlusion": 1} | {
    "emissive": 3,
    "specular": 3,
    "normal": 3,
}
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_REPEAT, _MIRROR, _CLAMP, _NEAREST = 10497, 33648, 33071, 9728


class Document:
    """The JSON of a file, and the arrays and images that it names."""

    def __init__(self, path: Path) -> None:
        data, self.binary = path.read_bytes(), b""
        if data[:4] == b"glTF":  # 4.4
            length = struct.unpack_from("<I", data, 12)[0]
            data, rest = data[20 : 20 + length], data[20 + length :]
            self.binary = rest[8 : 8 + struct.unpack_from("<I", rest)[0]] if rest else b""
        self.folder = path.parent
        self.json: Json = json.loads(data)
        self.images: dict[int, npt.NDArray[np.uint8]] = {}

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return (self.folder / unquote(uri)).read_bytes()

    def _view(self, number: int) -> tuple[bytes, int | None]:
        view = self.json["bufferViews"][number]
        buffer = self.json["buffers"][view["buffer"]]
        data = self._uri(buffer["uri"]) if "uri" in buffer else self.binary
        first = view.get("byteOffset", 0)
        return data[first : first + view["byteLength"]], view.get("byteStride")

    def array(self, number: int) -> Floats:
        """The elements of an accessor, one a row (3.6.2)."""
        entry = self.json["accessors"][number]
        width = _WIDTHS[entry["type"]]
        rows = np.zeros((entry["count"], width))
        if "bufferView" in entry:
            rows[:] = self._elements(entry, entry["componentType"], entry["count"], width)
        if "sparse" in entry:
            sparse, count = entry["sparse"], entry["sparse"]["count"]
            places = self._elements(sparse["indices"], sparse["indices"]["componentType"], count, 1)
            values = self._elements(sparse["values"], entry["componentType"], count, width)
            rows[places[:, 0].astype(int)] = values
        if entry.get("normalized"):
            top = np.iinfo(np.dtype(_DTYPES[entry["componentType"]])).max
            rows = np.maximum(rows / top, -1)  # 3.6.2.2
        return rows

    def _elements(self, entry: Json, component: int, count: int, width: int) -> Floats:
        data, stride = self._view(entry["bufferView"])
        dtype = np.dtype(_DTYPES[component])
        step = stride or dtype.itemsize * width
        first = entry.get("byteOffset", 0)
        rows = [np.frombuffer(data, dtype, width, first + i * step) for i in range(count)]
        return np.array(rows, np.float64).reshape(count, width)

    def image(self, number: int) -> npt.NDArray[np.uint8]:
        """Texels (height, width, 4) of eight bits."""
        if number not in self.images:
            entry = self.json["images"][number]
            data = self._view(entry["bufferView"])[0] if "bufferView" in entry else self._uri(entry["uri"])
            image = Image.open(io.BytesIO(data))
            assert not image.mode.startswith(("I", "F")), "images of more than eight bits are not for this"
            self.images[number] = np.asarray(image.convert("RGBA"))
        return self.images[number]


class Instance(NamedTuple):
    """A primitive as one node shows it: what its corners have, (triangles, 3, …)."""

    material: Json
    positions: Floats  # in the scene
    normals: Floats  # in the scene, of unit length
    tangents: Floats  # in the scene, of unit length, and handedness; NaN where there is none
    colors: Floats | None  # (triangles, 3, 4)
    coordinates: dict[int, Floats]  # by set, (triangles, 3, 2)


class Place(NamedTuple):
    """Points of one instance."""

    instance: Instance
    triangles: Numbers  # (n,)
    barycentric: Floats  # (n, 3)

    def interpolated(self, corners: Floats) -> Floats:
        """Return an attribute at the points."""
        result: Floats = np.einsum("nc,nck->nk", self.barycentric, corners[self.triangles])
        return result


class Reference:
    """The surface that a file's scene shows; its triangles in the order of nodes depth first."""

    def __init__(self, path: Path) -> None:
        self.document = Document(path)
        self.instances = [
            instance
            for mesh, matrix in self._nodes()
            for primitive in self.document.json["meshes"][mesh]["primitives"]
            if (instance := self._instance(primitive, matrix)) is not None
        ]
        self.positions: Floats = np.concatenate([each.positions for each in self.instances])
        self._firsts = np.cumsum([0, *(len(each.positions) for each in self.instances)])

    def values(self, channel: str, triangles: Numbers, barycentric: Floats) -> Floats:
        """Values (n, components) of a channel; NaN where the texts leave them open.

        Colours are linear light. Barycentric coordinates may lie outside of triangles: all that is known
        goes on as it is there.
        """
        found = np.full((len(triangles), COMPONENTS[channel]), np.nan)
        for number, instance in enumerate(self.instances):
            here = (triangles >= self._firsts[number]) & (triangles < self._firsts[number + 1])
            if here.any():
                place = Place(instance, triangles[here] - self._firsts[number], barycentric[here])
                found[here] = getattr(self, f"_{channel}")(place)
        return found

    # ---- the scene (3.5)

    def _nodes(self) -> Iterator[tuple[int, Floats]]:
        nodes = self.document.json["nodes"]
        if "scenes" in self.document.json:
            roots = self.document.json["scenes"][self.document.json.get("scene", 0)].get("nodes", [])
        else:
            below = {child for node in nodes for child in node.get("children", [])}
            roots = [number for number in range(len(nodes)) if number not in below]

        def visit(number: int, parent: Floats) -> Iterator[tuple[int, Floats]]:
            node = nodes[number]
            matrix = parent @ _local(node)
            if "mesh" in node:
                yield node["mesh"], matrix
            for child in node.get("children", []):
                yield from visit(child, matrix)

        for root in roots:
            yield from visit(root, np.eye(4))

    def _instance(self, primitive: Json, matrix: Floats) -> Instance | None:
        document = self.document
        attributes = {name: document.array(number) for name, number in primitive["attributes"].items()}
        count = len(attributes.get("POSITION", ()))
        indices = (
            document.array(primitive["indices"])[:, 0].astype(int)
            if "indices" in primitive
            else np.arange(count)
        )
        corners = _triangles(indices, primitive.get("mode", 4))
        if not len(corners):
            return None
        linear = matrix[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        if mirrored:  # the order of corners then says which side is in front (3.7.4)
            corners = corners[:, ::-1]
        at = {name: rows[corners] for name, rows in attributes.items()}
        material = document.json["materials"][primitive["material"]] if "material" in primitive else {}
        coordinates = {int(name[9:]): rows for name, rows in at.items() if name.startswith("TEXCOORD_")}
        colors = None
        if "COLOR_0" in at:
            colors = np.ones((len(corners), 3, 4))
            colors[..., : at["COLOR_0"].shape[2]] = at["COLOR_0"]
        normals, tangents = self._frames(at, material, coordinates, mirrored)
        across = np.linalg.inv(linear).T  # of normals (3.7.2.1, as any covector)
        along = np.empty_like(tangents)
        along[..., :3] = unit(tangents[..., :3] @ linear.T)
        # A mirrored frame keeps the bitangent that the mirror shows.
        along[..., 3] = -tangents[..., 3] if mirrored else tangents[..., 3]
        return Instance(
            material,
            at["POSITION"] @ linear.T + matrix[:3, 3],
            unit(normals @ across.T),
            along,
            colors,
            coordinates,
        )

    def _frames(
        self, at: dict[str, Floats], material: Json, coordinates: dict[int, Floats], mirrored: bool
    ) -> tuple[Floats, Floats]:
        """Normals and tangents in the mesh's own space (3.7.2.1)."""
        positions = at["POSITION"]
        given = "NORMAL" in at
        if given:
            normals = unit(at["NORMAL"])
        else:
            flat = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
            normals = np.repeat(unit(-flat if mirrored else flat)[:, None], 3, axis=1)
        if given and "TANGENT" in at:
            return normals, at["TANGENT"]
        info = material.get("normalTexture")
        if info is None:
            return normals, np.full((*normals.shape[:2], 4), np.nan)
        uv = _transformed(info, coordinates[_set(info)])
        # Normal maps have their second axis up the image, texture coordinates run down it (3.9.3).
        upright = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1)
        step = slice(None, None, -1) if mirrored else slice(None)
        tangents = mikktspace(positions[:, step], normals[:, step], upright[:, step])
        return normals, tangents[:, step]

    # ---- textures (3.8)

    def _texels(self, info: Json, place: Place, decoded: Callable[[Floats], Floats]) -> Floats:
        """Return a texture at points, interpolated between texels that are decoded from fractions (n, 4)."""
        document = self.document
        texture = document.json["textures"][info["index"]]
        source = texture.get("source")
        for extension in ("EXT_texture_webp", "EXT_texture_avif"):
            source = texture.get("extensions", {}).get(extension, {}).get("source", source)
        sampler = document.json["samplers"][texture["sampler"]] if "sampler" in texture else {}
        texels = document.image(source)
        height, width = texels.shape[:2]
        uv = _transformed(info, place.interpolated(place.instance.coordinates[_set(info)]))

        def texel(column: Floats, row: Floats) -> Floats:
            x = _wrapped(column.astype(int), width, sampler.get("wrapS", _REPEAT))
            y = _wrapped(row.astype(int), height, sampler.get("wrapT", _REPEAT))
            return decoded(texels[y, x] / 255)

        u, v = uv[:, 0] * width, uv[:, 1] * height
        if sampler.get("magFilter") == _NEAREST:
            return texel(np.floor(u), np.floor(v))
        u, v = u - 0.5, v - 0.5
        left, top = np.floor(u), np.floor(v)
        x, y = (u - left)[:, None], (v - top)[:, None]
        above = (1 - x) * texel(left, top) + x * texel(left + 1, top)
        below = (1 - x) * texel(left, top + 1) + x * texel(left + 1, top + 1)
        return (1 - y) * above + y * below

    # ---- materials (3.9)

    def _covered(self, place: Place) -> tuple[Floats, Floats]:
        """Base colour in linear light, and alpha as its mode counts it."""
        material = place.instance.material
        older = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is not None:
            factor, info = older.get("diffuseFactor", [1] * 4), older.get("diffuseTexture")
        else:
            pbr = material.get("pbrMetallicRoughness", {})
            factor, info = pbr.get("baseColorFactor", [1] * 4), pbr.get("baseColorTexture")
        base = np.broadcast_to(np.array(factor, float), (len(place.triangles), 4))
        if place.instance.colors is not None:
            base = base * place.interpolated(place.instance.colors)
        mode, cutoff = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)

        def coverage(alpha: Floats) -> Floats:
            if mode == "OPAQUE":
                return np.ones_like(alpha)
            return (alpha >= cutoff).astype(float) if mode == "MASK" else alpha

        if info is None:
            return base[:, :3], coverage(base[:, 3:])
        plain = self._texels(info, place, lambda t: np.hstack([_linear(t[:, :3]), t[:, 3:]]))
        if mode == "OPAQUE":
            return base[:, :3] * plain[:, :3], coverage(base[:, 3:] * plain[:, 3:])
        texel = self._texels(info, place, lambda t: np.hstack([_linear(t[:, :3]) * t[:, 3:], t[:, 3:]]))
        with np.errstate(invalid="ignore"):  # between clear texels the plain mean, as octex has it
            color = np.where(texel[:, 3:] > 0, texel[:, :3] / texel[:, 3:], plain[:, :3])
        return base[:, :3] * color, coverage(base[:, 3:] * texel[:, 3:])

    def _base_color(self, place: Place) -> Floats:
        return self._covered(place)[0]

    def _alpha(self, place: Place) -> Floats:
        return self._covered(place)[1]

    def _metallic_roughness(self, place: Place, name: str, lane: int) -> Floats:
        pbr = place.instance.material.get("pbrMetallicRoughness", {})
        factor = pbr.get(f"{name}Factor", 1.0)
        if "metallicRoughnessTexture" not in pbr:
            return np.full((len(place.triangles), 1), float(factor))
        return factor * self._texels(pbr["metallicRoughnessTexture"], place, lambda t: t[:, lane : lane + 1])

    def _metallic(self, place: Place) -> Floats:
        if "KHR_materials_pbrSpecularGlossiness" in place.instance.material.get("extensions", {}):
            return np.full((len(place.triangles), 1), np.nan)
        return self._metallic_roughness(place, "metallic", 2)

    def _roughness(self, place: Place) -> Floats:
        older = place.instance.material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is None:
            return self._metallic_roughness(place, "roughness", 1)
        glossiness = np.full((len(place.triangles), 1), float(older.get("glossinessFactor", 1)))
        if "specularGlossinessTexture" in older:
            glossiness *= self._texels(older["specularGlossinessTexture"], place, lambda t: t[:, 3:])
        return 1 - glossiness

    def _specular(self, place: Place) -> Floats:
        older = place.instance.material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is None:
            return np.full((len(place.triangles), 3), np.nan)
        factor = np.broadcast_to(
            np.array(older.get("specularFactor", [1, 1, 1]), float), (len(place.triangles), 3)
        )
        if "specularGlossinessTexture" not in older:
            return factor
        return factor * self._texels(older["specularGlossinessTexture"], place, lambda t: _linear(t[:, :3]))

    def _occlusion(self, place: Place) -> Floats:
        info = place.instance.material.get("occlusionTexture")
        if info is None:
            return np.ones((len(place.triangles), 1))
        return 1 + info.get("strength", 1) * (self._texels(info, place, lambda t: t[:, :1]) - 1)

    def _emissive(self, place: Place) -> Floats:
        material = place.instance.material
        extension = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        factor = np.array(material.get("emissiveFactor", [0, 0, 0]), float)
        light = np.broadcast_to(factor * extension.get("emissiveStrength", 1), (len(place.triangles), 3))
        if "emissiveTexture" not in material:
            return light
        return light * self._texels(material["emissiveTexture"], place, lambda t: _linear(t[:, :3]))

    def _normal(self, place: Place) -> Floats:
        """In the scene, of unit length."""
        normal = unit(place.interpolated(place.instance.normals))
        info = place.instance.material.get("normalTexture")
        if info is None:
            return normal
        scale = np.array([info.get("scale", 1), info.get("scale", 1), 1])
        across, up, out = self._texels(info, place, lambda t: unit((2 * t[:, :3] - 1) * scale)).T[..., None]
        tangent = place.interpolated(place.instance.tangents)
        along = tangent[:, :3] - normal * np.sum(normal * tangent[:, :3], axis=1, keepdims=True)
        along = unit(along)
        bitangent = np.cross(normal, along) * np.where(tangent[:, 3:] < 0, -1, 1)
        return unit(across * along + up * bitangent + out * normal)


def _local(node: Json) -> Floats:
    """A node's matrix (3.5.3)."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), float)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), float)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _triangles(indices: Numbers, mode: int) -> Numbers:
    """The vertices of triangles, strips and fans (3.7.2.1); nothing for points and lines."""
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    count = max(len(indices) - 2, 0)
    if mode == 5:
        rows = [[i, i + 1 + i % 2, i + 2 - i % 2] for i in range(count)]
    elif mode == 6:
        rows = [[i + 1, i + 2, 0] for i in range(count)]
    else:
        rows = []
    return indices[np.array(rows, int).reshape(-1, 3)]


def _set(info: Json) -> int:
    """Which set of texture coordinates a texture is read with."""
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    number: int = transform.get("texCoord", info.get("texCoord", 0))
    return number


def _transformed(info: Json, uv: Floats) -> Floats:
    """Texture coordinates as KHR_texture_transform moves them.

    "Rotate the UVs by this many radians counter-clockwise" as they lie on an image whose v runs down; the
    signs of the matrix printed there are the wrong way round (KhronosGroup/glTF issue 1563).
    """
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    angle = transform.get("rotation", 0)
    u, v = np.moveaxis(uv * np.array(transform.get("scale", [1, 1]), float), -1, 0)
    turned = np.stack([np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u], axis=-1)
    moved: Floats = turned + np.array(transform.get("offset", [0, 0]), float)
    return moved


def _wrapped(index: Numbers, size: int, mode: int) -> Numbers:
    """The texel that stands for one outside of the image (3.8.4.4)."""
    if mode == _CLAMP:
        return np.clip(index, 0, size - 1)
    if mode == _MIRROR:
        index = index % (2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    assert mode == _REPEAT
    return index % size


def _linear(code: Floats) -> Floats:
    """Linear light of sRGB codes (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
