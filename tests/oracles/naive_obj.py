"""An independent slow reader of OBJ and MTL (Wavefront), in plain Python, from the formats' specifications.

Triangles and convex polygons; relative paths. Only image files are decoded by others (Pillow, 8 bits).
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import PIL.Image

Vector = tuple[float, ...]


def srgb_to_linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


@dataclass
class Material:
    factor: Vector = (1.0, 1.0, 1.0, 1.0)
    image: list[list[Vector]] | None = None  # rows of red, green, blue, linear light

    def read(self, u: float, v: float) -> Vector:
        """Colour of the image, which repeats; v runs down."""
        assert self.image is not None
        height, width = len(self.image), len(self.image[0])
        x, y = u * width - 0.5, v * height - 0.5
        left, top = math.floor(x), math.floor(y)
        parts = []
        for row, weight_y in ((top, 1 - (y - top)), (top + 1, y - top)):
            for column, weight_x in ((left, 1 - (x - left)), (left + 1, x - left)):
                parts.append((weight_x * weight_y, self.image[row % height][column % width]))
        return tuple(sum(w * texel[i] for w, texel in parts) for i in range(3))


@dataclass
class Triangle:
    corners: list[Vector]
    uv: list[Vector] | None
    colors: list[Vector] | None
    material: Material

    def evaluate(self, point: Sequence[float]) -> Vector:
        """Red, green, blue (linear light) and alpha at a point."""
        weights = barycentric(self.corners, point)
        *color, alpha = self.material.factor
        if self.colors is not None:
            color = [a * b for a, b in zip(color, mixed(self.colors, weights), strict=True)]
        if self.material.image is not None:
            assert self.uv is not None
            u, v = mixed(self.uv, weights)
            color = [a * b for a, b in zip(color, self.material.read(u, v), strict=True)]
        return *color, alpha


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


def load(path: Path) -> list[Triangle]:
    """Return the triangles in the order of the file."""
    materials: dict[str, Material] = {}
    points: list[Vector] = []
    colors: list[Vector] = []
    coordinates: list[Vector] = []
    current = Material()
    found: list[Triangle] = []
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
                colors.append(tuple(srgb_to_linear(float(c)) for c in words[4:7]))
        elif words[0] == "vt":
            coordinates.append((float(words[1]), 1.0 - float(words[2])))
        elif words[0] == "f":
            corners = [(*word.split("/"), "")[:2] for word in words[1:]]
            at = [int(v) - 1 if int(v) > 0 else len(points) + int(v) for v, _ in corners]
            uv = [int(t) - 1 if int(t) > 0 else len(coordinates) + int(t) for _, t in corners if t]
            for i in range(1, len(at) - 1):
                fan = (0, i, i + 1)
                found.append(
                    Triangle(
                        [points[at[j]] for j in fan],
                        [coordinates[uv[j]] for j in fan] if uv else None,
                        [colors[at[j]] for j in fan] if colors else None,
                        current,
                    )
                )
    return found


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
        elif words[0] == "map_Kd":
            with PIL.Image.open(io.BytesIO((path.parent / words[-1]).read_bytes())) as image:
                whole = image.convert("RGB")
            raw, width = whole.tobytes(), 3 * whole.width
            rows = [raw[at : at + width] for at in range(0, len(raw), width)]
            last.image = [
                [tuple(srgb_to_linear(code / 255) for code in row[x : x + 3]) for x in range(0, width, 3)]
                for row in rows
            ]
    return materials
