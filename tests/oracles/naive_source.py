"""An independent slow reader of models, in plain Python, from the formats' specifications.

glTF 2.0 (Khronos), KHR_texture_transform and KHR_materials_pbrSpecularGlossiness; OBJ and MTL (Wavefront).
Only image files are decoded by others (Pillow, 8 bits); texels may be given instead.
"""

from __future__ import annotations

import base64
import io
import json
import math
import struct
import urllib.parse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import PIL.Image

Vector = tuple[float, ...]


def srgb_to_linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def wrapped(index: int, size: int, mode: str) -> int:
    if mode == "clamp":
        return min(max(index, 0), size - 1)
    if mode == "mirror":
        index %= 2 * size
        return index if index < size else 2 * size - 1 - index
    return index % size


@dataclass
class Image:
    """Texels as fractions of the largest code: rows of (red, green, blue, alpha), still sRGB."""

    texels: Sequence[Sequence[Vector]]
    wrap_u: str = "repeat"
    wrap_v: str = "repeat"
    nearest: bool = False

    def at(self, column: int, row: int, opaque: bool) -> Vector:
        """A texel: linear light and alpha."""
        height, width = len(self.texels), len(self.texels[0])
        texel = self.texels[wrapped(row, height, self.wrap_v)][wrapped(column, width, self.wrap_u)]
        return (*(srgb_to_linear(c) for c in texel[:3]), 1.0 if opaque else texel[3])

    def read(self, u: float, v: float, opaque: bool) -> Vector:
        """Colour, averaged with alpha as weight, and alpha; v runs down."""
        x, y = u * len(self.texels[0]), v * len(self.texels)
        if self.nearest:
            return self.at(math.floor(x), math.floor(y), opaque)
        x, y = x - 0.5, y - 0.5
        left, top = math.floor(x), math.floor(y)
        parts = []
        for row, weight_y in ((top, 1 - (y - top)), (top + 1, y - top)):
            for column, weight_x in ((left, 1 - (x - left)), (left + 1, x - left)):
                parts.append((weight_x * weight_y, self.at(column, row, opaque)))
        alpha = sum(w * texel[3] for w, texel in parts)
        if alpha == 0.0:
            return (*(sum(w * texel[i] for w, texel in parts) for i in range(3)), 0.0)
        return (*(sum(w * texel[3] * texel[i] for w, texel in parts) / alpha for i in range(3)), alpha)


@dataclass
class Material:
    factor: Vector = (1.0, 1.0, 1.0, 1.0)
    image: Image | None = None
    mode: str = "OPAQUE"
    cutoff: float = 0.5
    coordinates: str = "TEXCOORD_0"
    transform: Callable[[Vector], Vector] = lambda uv: uv


@dataclass
class Triangle:
    corners: list[Vector]
    uv: list[Vector] | None
    colors: list[Vector] | None
    material: Material


@dataclass
class Model:
    """Triangles in the order of the file."""

    triangles: list[Triangle] = field(default_factory=list)

    def evaluate(self, triangle: int, point: Sequence[float]) -> Vector:
        """Red, green, blue (linear light) and alpha at a point of a triangle."""
        each = self.triangles[triangle]
        weights = barycentric(each.corners, point)
        red, green, blue, alpha = each.material.factor
        if each.colors is not None:
            color = mixed(each.colors, weights)
            red, green, blue, alpha = red * color[0], green * color[1], blue * color[2], alpha * color[3]
        if each.material.image is not None:
            assert each.uv is not None
            u, v = mixed(each.uv, weights)
            color = each.material.image.read(u, v, each.material.mode == "OPAQUE")
            red, green, blue, alpha = red * color[0], green * color[1], blue * color[2], alpha * color[3]
        if each.material.mode == "OPAQUE":
            alpha = 1.0
        elif each.material.mode == "MASK":
            alpha = 1.0 if alpha >= each.material.cutoff else 0.0
        return red, green, blue, alpha


def mixed(values: Sequence[Vector], weights: Sequence[float]) -> Vector:
    return tuple(sum(w * v[i] for w, v in zip(weights, values, strict=True)) for i in range(len(values[0])))


def minus(a: Sequence[float], b: Sequence[float]) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def barycentric(corners: Sequence[Vector], point: Sequence[float]) -> Vector:
    """Weights of a triangle's corners at a point of its plane (Ericson, 3.4)."""
    e, f, g = minus(corners[1], corners[0]), minus(corners[2], corners[0]), minus(point, corners[0])
    ee, ef, ff, ge, gf = dot(e, e), dot(e, f), dot(f, f), dot(g, e), dot(g, f)
    scale = ee * ff - ef * ef
    b, c = (ff * ge - ef * gf) / scale, (ee * gf - ef * ge) / scale
    return 1.0 - b - c, b, c


def load(path: Path) -> Model:
    return load_obj(path) if path.suffix == ".obj" else load_gltf(path)


def texels_of(data: bytes) -> list[list[Vector]]:
    with PIL.Image.open(io.BytesIO(data)) as image:
        whole = image.convert("RGBA")
        width, height = whole.size
        raw = whole.tobytes()
    rows = []
    for y in range(height):
        row = [raw[4 * (y * width + x) : 4 * (y * width + x) + 4] for x in range(width)]
        rows.append([tuple(code / 255 for code in texel) for texel in row])
    return rows


# glTF


def load_gltf(path: Path) -> Model:
    data = path.read_bytes()
    binary = b""
    if data[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", data, 12)
        text = data[20 : 20 + length]
        binary = data[20 + length + 8 :]
    else:
        text = data
    gltf = json.loads(text)

    def fetch(uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.split(",", 1)[1])
        return (path.parent / urllib.parse.unquote(uri)).read_bytes()

    buffers = [fetch(b["uri"]) if "uri" in b else binary for b in gltf.get("buffers", [])]

    def view(number: int) -> bytes:
        entry = gltf["bufferViews"][number]
        start = entry.get("byteOffset", 0)
        return buffers[entry["buffer"]][start : start + entry["byteLength"]]

    letters = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
    tops = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}

    def rows(entry: dict[str, Any], count: int, width: int, kind: int, stride: int) -> list[Vector]:
        data = view(entry["bufferView"])
        start = entry.get("byteOffset", 0)
        return [
            struct.unpack_from(f"<{width}{letters[kind]}", data, start + i * stride) for i in range(count)
        ]

    def accessor(number: int) -> list[Vector]:
        entry = gltf["accessors"][number]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[entry["type"]]
        kind = entry["componentType"]
        packed = width * struct.calcsize(letters[kind])
        values: list[Vector] = [(0.0,) * width] * entry["count"]
        if "bufferView" in entry:
            stride = gltf["bufferViews"][entry["bufferView"]].get("byteStride", packed)
            values = rows(entry, entry["count"], width, kind, stride)
        if "sparse" in entry:
            sparse = entry["sparse"]
            code = sparse["indices"]["componentType"]
            size = struct.calcsize(letters[code])
            places = rows(sparse["indices"], sparse["count"], 1, code, size)
            changes = rows(sparse["values"], sparse["count"], width, kind, packed)
            values = list(values)
            for (place,), change in zip(places, changes, strict=True):
                values[int(place)] = change
        if entry.get("normalized"):
            values = [tuple(max(c / tops[kind], -1.0) for c in value) for value in values]
        return values

    images: dict[int, list[list[Vector]]] = {}

    def image(number: int) -> list[list[Vector]]:
        if number not in images:
            entry = gltf["images"][number]
            data = view(entry["bufferView"]) if "bufferView" in entry else fetch(entry["uri"])
            images[number] = texels_of(data)
        return images[number]

    def material(number: int | None) -> Material:
        if number is None:
            return Material()
        entry = gltf["materials"][number]
        found = Material(mode=entry.get("alphaMode", "OPAQUE"), cutoff=entry.get("alphaCutoff", 0.5))
        pbr = entry.get("pbrMetallicRoughness", {})
        factor, info = pbr.get("baseColorFactor"), pbr.get("baseColorTexture")
        older = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if older is not None:
            factor, info = older.get("diffuseFactor"), older.get("diffuseTexture")
        if factor is not None:
            found.factor = tuple(factor)
        if info is None:
            return found
        texture = gltf["textures"][info["index"]]
        sampler = gltf["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wraps = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
        source = texture.get("source")
        if source is None:
            source = texture["extensions"]["EXT_texture_webp"]["source"]
        found.image = Image(
            image(source),
            wraps[sampler.get("wrapS", 10497)],
            wraps[sampler.get("wrapT", 10497)],
            sampler.get("magFilter") == 9728,
        )
        change = info.get("extensions", {}).get("KHR_texture_transform", {})
        found.coordinates = f"TEXCOORD_{change.get('texCoord', info.get('texCoord', 0))}"
        (su, sv), (ou, ov) = change.get("scale", (1, 1)), change.get("offset", (0, 0))
        cos, sin = math.cos(change.get("rotation", 0)), math.sin(change.get("rotation", 0))
        found.transform = lambda uv: (
            cos * su * uv[0] + sin * sv * uv[1] + ou,
            -sin * su * uv[0] + cos * sv * uv[1] + ov,
        )
        return found

    model = Model()

    def visit(number: int, place: Callable[[Vector], Vector]) -> None:
        node = gltf["nodes"][number]

        def placed(point: Vector) -> Vector:
            return place(transformed(node, point))

        for primitive in gltf["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            mode = primitive.get("mode", 4)
            if mode < 4:
                continue
            attributes = primitive["attributes"]
            points = [placed(point) for point in accessor(attributes["POSITION"])]
            order = [int(i) for (i,) in accessor(primitive["indices"])] if "indices" in primitive else None
            order = list(range(len(points))) if order is None else order
            bound = material(primitive.get("material"))
            colors = None
            if "COLOR_0" in attributes:
                colors = [(*color, 1.0)[:4] for color in accessor(attributes["COLOR_0"])]
            uv = None
            if bound.image is not None:
                uv = [bound.transform(pair) for pair in accessor(attributes[bound.coordinates])]
            for corners in triangles_of(order, mode):
                model.triangles.append(
                    Triangle(
                        [points[i] for i in corners],
                        None if uv is None else [uv[i] for i in corners],
                        None if colors is None else [colors[i] for i in corners],
                        bound,
                    )
                )
        for child in node.get("children", ()):
            visit(child, placed)

    for root in gltf["scenes"][gltf.get("scene", 0)]["nodes"]:
        visit(root, lambda point: point)
    return model


def triangles_of(order: list[int], mode: int) -> list[tuple[int, int, int]]:
    if mode == 4:
        return [(order[i], order[i + 1], order[i + 2]) for i in range(0, len(order) - 2, 3)]
    if mode == 5:
        found = [(order[i], order[i + 1], order[i + 2]) for i in range(len(order) - 2)]
        return [(a, b, c) if i % 2 == 0 else (a, c, b) for i, (a, b, c) in enumerate(found)]
    return [(order[i + 1], order[i + 2], order[0]) for i in range(len(order) - 2)]


def transformed(node: dict[str, Any], point: Vector) -> Vector:
    if "matrix" in node:
        m = node["matrix"]
        return tuple(
            m[i] * point[0] + m[4 + i] * point[1] + m[8 + i] * point[2] + m[12 + i] for i in range(3)
        )
    scaled = [p * s for p, s in zip(point, node.get("scale", (1, 1, 1)), strict=True)]
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    # p + 2w(q × p) + 2q × (q × p)
    first = cross((x, y, z), scaled)
    second = cross((x, y, z), first)
    turned = [p + 2 * w * a + 2 * b for p, a, b in zip(scaled, first, second, strict=True)]
    return tuple(p + t for p, t in zip(turned, node.get("translation", (0, 0, 0)), strict=True))


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


# OBJ of triangles and convex polygons; relative paths


def load_obj(path: Path) -> Model:
    materials: dict[str, Material] = {}
    points: list[Vector] = []
    colors: list[Vector] = []
    coordinates: list[Vector] = []
    current = Material()
    model = Model()
    for line in path.read_text().splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "mtllib":
            materials = load_mtl(path.parent / words[1])
        elif words[0] == "usemtl":
            current = materials[words[1]]
        elif words[0] == "v":
            points.append(tuple(map(float, words[1:4])))
            if len(words) >= 7:
                colors.append((*(srgb_to_linear(float(c)) for c in words[4:7]), 1.0))
        elif words[0] == "vt":
            coordinates.append((float(words[1]), 1.0 - float(words[2])))
        elif words[0] == "f":
            corners = [(*word.split("/"), "")[:2] for word in words[1:]]
            at = [int(v) - 1 if int(v) > 0 else len(points) + int(v) for v, _ in corners]
            uv = [int(t) - 1 if int(t) > 0 else len(coordinates) + int(t) for _, t in corners if t]
            for i in range(1, len(at) - 1):
                fan = (0, i, i + 1)
                model.triangles.append(
                    Triangle(
                        [points[at[j]] for j in fan],
                        [coordinates[uv[j]] for j in fan] if uv else None,
                        [colors[at[j]] for j in fan] if colors else None,
                        current,
                    )
                )
    return model


def load_mtl(path: Path) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    for line in path.read_text().splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "newmtl":
            materials[words[1]] = Material()
            last = materials[words[1]]
        elif words[0] == "Kd":
            last.factor = (*(srgb_to_linear(float(c)) for c in words[1:4]), last.factor[3])
        elif words[0] in ("d", "Tr"):
            alpha = float(words[1]) if words[0] == "d" else 1.0 - float(words[1])
            last.factor = (*last.factor[:3], alpha)
            last.mode = "BLEND" if alpha < 1.0 else "OPAQUE"
        elif words[0] == "map_Kd":
            rows = texels_of((path.parent / words[-1]).read_bytes())
            last.image = Image([[(*texel[:3], 1.0) for texel in row] for row in rows])
    return materials
