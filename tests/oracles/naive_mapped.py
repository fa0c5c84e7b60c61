"""Where an image lies on points of space, point by point, from what the mappings' documentation says."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tests.oracles.naive_filters import dense_reads

Vector = npt.NDArray[np.float64]

X, Y, Z = np.eye(3)
AXES = {"x": X, "-x": -X, "y": Y, "-y": -Y, "z": Z, "-z": -Z}
#: Where the front of a box, a cylinder and a sphere is.
FRONTS = {"x": -Y, "-x": -Y, "y": Z, "-y": -Z, "z": -Y, "-z": -Y}
#: Where the top of a plane's image is.
TOPS = {"x": Y, "-x": Y, "y": -Z, "-y": Z, "z": Y, "-z": Y}


def sides_of(axis: str) -> list[tuple[Vector, Vector]]:
    """Each side of a box: which way it looks, and where its image's top is."""
    up, front = AXES[axis], FRONTS[axis]
    right = np.cross(up, front)
    return [(up, -front), (-up, front), (front, up), (-front, up), (right, up), (-right, up)]


def on_plane(at: Vector, outward: Vector, top: Vector, size: Vector) -> tuple[float, float]:
    """Coordinates of an image that is not mirrored as seen from outside."""
    right = np.cross(top, outward)
    u = 0.5 + float(at @ right) / float(size @ abs(right))
    v = 0.5 - float(at @ top) / float(size @ abs(top))
    return u, v


def coordinates(
    kind: str, axis: str, center: Vector, size: Vector, point: Vector, normal: Vector
) -> tuple[float, float, bool]:
    """u, v, and whether u goes around the axis."""
    at = point - center
    up, front = AXES[axis], FRONTS[axis]
    if kind == "planar":
        return *on_plane(at, up, TOPS[axis], size), False
    sides = sides_of(axis)
    if kind == "box":
        side = max(range(6), key=lambda i: round(float(normal @ sides[i][0]), 5))
        return *on_plane(at, *sides[side], size), False
    height = float(at @ up)
    if kind == "cylindrical" and abs(math.degrees(math.asin(float(np.clip(normal @ up, -1, 1))))) > 45.0001:
        return *on_plane(at, *sides[0 if normal @ up > 0 else 1], size), False
    phase = cmath.phase(complex(float(at @ front), float(at @ np.cross(up, front))))
    u = 0.5 + phase / (2 * math.pi)
    if kind == "cylindrical":
        return u, 0.5 - height / float(size @ abs(up)), True
    distance = math.sqrt(float(at @ at))
    return u, (math.acos(max(min(height / distance, 1.0), -1.0)) if distance else 0.0) / math.pi, True


def wraps_of(kind: str, wraps: tuple[str, str], around: bool) -> tuple[str, str]:
    if not around:
        return wraps
    return "repeat", "mirror" if kind == "spherical" else wraps[1]


def read(
    image: npt.NDArray[np.floating],
    kind: str,
    axis: str,
    center: Vector,
    size: Vector,
    wraps: tuple[str, str],
    points: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    flat: bool = False,
) -> npt.NDArray[np.float64]:
    """The values (n, k) of an image (height, width, k), bilinear or of flat texels, at points."""
    each = [coordinates(kind, axis, center, size, *at) for at in zip(points, normals, strict=True)]
    found = np.empty((len(points), image.shape[2]))
    for around in (False, True):
        chosen = [i for i, at in enumerate(each) if at[2] == around]
        uv = np.array([each[i][:2] for i in chosen]).reshape(-1, 2)
        found[chosen] = dense_reads(image.astype(np.float64), wraps_of(kind, wraps, around), uv, flat)
    return found


def means(
    image: npt.NDArray[np.floating],
    kind: str,
    axis: str,
    center: Vector,
    size: Vector,
    wraps: tuple[str, str],
    points: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    widths: Sequence[float],
    steps: int = 10,
) -> npt.NDArray[np.float64]:
    """Means over squares on the planes of the normals, each point of them mapped by itself."""
    found = []
    places = (np.arange(steps) + 0.5) / steps - 0.5
    for point, normal, width in zip(points, normals, widths, strict=True):
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        square = [point + width * (a * first + b * second) for a in places for b in places]
        each = read(image, kind, axis, center, size, wraps, np.array(square), np.tile(normal, (steps**2, 1)))
        found.append(each.mean(axis=0))
    return np.array(found)
