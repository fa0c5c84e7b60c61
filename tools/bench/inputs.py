"""What the benchmarks work on: a bumpy torus, spheres of cells, and what a camera sees of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ChannelFormat
from octex.texture import Channel
from octex.tree.layout import AREA_ONE, AREA_STEPS
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

UNIT_CUBE = Placement((0.0, 0.0, 0.0), 1.0)
RADIUS = 0.499
EYE = np.array([1.6, -0.5, 1.5])


def torus(around: int, across: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32], Floats]:
    """Return a bumpy torus in the unit cube: vertices, 2 · around · across triangles, and uv with a seam."""
    u, v = np.meshgrid(np.arange(around + 1) / around, np.arange(across + 1) / across, indexing="ij")
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    u, v = 2 * np.pi * u, 2 * np.pi * v
    radius = 0.14 + 0.03 * np.sin(9 * u) * np.cos(5 * v)
    ring = 0.32 + radius * np.cos(v)
    grid = 0.5 + np.stack([ring * np.cos(u), ring * np.sin(u), radius * np.sin(v)], axis=-1)
    grid[-1], grid[:, -1] = grid[0], grid[:, 0]  # both sides of the seam, to the last bit
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b, c, d = (p * (across + 1) + q for p, q in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return grid.reshape(-1, 3).astype(np.float32), triangles.astype(np.int32), uv


def painted_torus(around: int, across: int, size: int) -> octex.Surface:
    """Return the torus with an image of size² texels: smooth colours with fine grain."""
    vertices, triangles, uv = torus(around, across)
    y, x = np.mgrid[:size, :size] / size
    waves = np.stack(
        [np.sin(2 * np.pi * (f * x + g * y)) for f, g in ((37, 11), (23, -31), (5, 53))], axis=-1
    )
    grain = np.random.default_rng(0).normal(0, 6, (size, size, 1))
    image = np.clip(128 + 100 * waves + grain, 0, 255).astype(np.uint8)
    return octex.Surface.from_arrays(vertices, triangles, uv=uv, image=image, name="torus")


def looked_up_torus(around: int, across: int, size: int, points: Array) -> dict[str, Array]:
    """Return the arrays of a torus with an image, and of points, that Open3D looks up."""
    vertices, triangles, uv = torus(around, across)
    image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
    return {"vertices": vertices, "triangles": triangles, "uv": uv, "image": image, "points": points}


def sphere_cells(depth: int, middle: float = 0.5) -> npt.NDArray[np.int64]:
    """Morton codes of the cells that meet a sphere around a place on the root cell's x axis."""
    codes = np.zeros(1, np.int64)
    for level in range(1, depth + 1):
        codes = (codes[:, None] << 3 | np.arange(8)).ravel()
        low = decode_cells(codes) / 2**level - (middle, 0.5, 0.5)
        high = low + 0.5**level
        nearest = (np.maximum(np.maximum(low, -high), 0) ** 2).sum(axis=1)
        farthest = (np.maximum(-low, high) ** 2).sum(axis=1)
        codes = codes[(nearest <= RADIUS**2) & (farthest >= RADIUS**2)]
    return codes


def _texture(tree: Octree, values: Array, space: Any) -> octex.OctreeTexture:
    channel = Channel(ChannelFormat("base_color", 3, space, "uint8"), values, values[:0], values[:0])
    return octex.OctreeTexture(tree, {"base_color": channel}, UNIT_CUBE, [[0, 0, 0], [1, 1, 1]])


def sphere_texture(depth: int, middle: float = 0.5) -> octex.OctreeTexture:
    """Return a band of cells around a sphere with random values."""
    tree = Octree.from_leaves(sphere_cells(depth, middle), depth)
    tree = tree.with_cell_data(np.ones(tree.n_cells, np.uint8), np.full(tree.n_cells, 207, np.uint8))
    values = np.random.default_rng(0).integers(0, 256, (tree.n_cells, 3), np.uint8)
    return _texture(tree, values, "srgb")


def scattered_on_sphere(count: int) -> npt.NDArray[np.float32]:
    """Random points of the sphere."""
    points = np.random.default_rng(7).normal(size=(count, 3))
    return (0.5 + RADIUS * points / np.linalg.norm(points, axis=1)[:, None]).astype(np.float32)


class View(NamedTuple):
    """What the pixels of an image see, row by row."""

    hit: Array  # (pixels,)   which see the sphere
    points: Array  # (hits, 3)
    dPdx: Array  # (hits, 3)   how the points change from a pixel to the next
    dPdy: Array  # (hits, 3)


def view(height: int, width: int | None = None) -> View:
    """Look at the sphere, which just fits into the image."""
    width = height if width is None else width
    distance = np.linalg.norm(0.5 - EYE)
    forward = (0.5 - EYE) / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    pixel = 2.04 * RADIUS / np.sqrt(distance**2 - RADIUS**2) / height
    y, x = np.mgrid[:height, :width] + 0.5
    x, y = (x - width / 2) * pixel, (height / 2 - y) * pixel
    rays = (forward + x[..., None] * right + y[..., None] * up).reshape(-1, 3)  # 1 deep
    unit = rays / np.linalg.norm(rays, axis=1)[:, None]
    along = unit @ (0.5 - EYE)
    under = RADIUS**2 - distance**2 + along**2
    hit = under >= 0
    points = EYE + (along[hit] - np.sqrt(under[hit]))[:, None] * unit[hit]
    normals, rays = (points - 0.5) / RADIUS, rays[hit]
    deep = ((points - EYE) @ forward)[:, None]
    facing = (normals * rays).sum(axis=1)[:, None]
    dPdx, dPdy = (pixel * deep * (step - rays * (normals @ step)[:, None] / facing) for step in (right, -up))
    return View(hit, points, dPdx, dPdy)


@numba.njit(cache=True)
def _hash(x: Any) -> Any:
    x = np.uint32(x)
    x ^= x >> np.uint32(16)
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x ^= x >> np.uint32(15)
    x = np.uint32(x * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@numba.njit(cache=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Interpolate random numbers of a lattice smoothly."""
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    f, g, h = x - i, y - j, z - k
    f, g, h = f * f * (3 - 2 * f), g * g * (3 - 2 * g), h * h * (3 - 2 * h)
    result = 0.0
    for n in range(8):
        a, b, c = n & 1, n >> 1 & 1, n >> 2
        at = np.uint32(np.int64(i + a) * 73856093) ^ np.uint32(np.int64(j + b) * 19349663)
        at ^= np.uint32(np.int64(k + c) * 83492791) ^ np.uint32(seed)
        share = (f if a else 1 - f) * (g if b else 1 - g) * (h if c else 1 - h)
        result += share * _hash(at) / 4294967296.0
    return result


@numba.njit(cache=True)
def _paint(points: Array, colors: Array) -> None:
    """Write eight octaves of noise with grain of ±3 levels (n, 3)."""
    for n in range(len(points)):
        x, y, z = points[n]
        for c in range(3):
            frequency, amplitude, total = 3.0, 0.5, 0.0
            for octave in range(8):
                places = x * frequency + 9, y * frequency + 9, z * frequency + 9
                total += amplitude * _noise(*places, 17 * octave + c)
                frequency *= 2.03
                amplitude *= 0.6
            grain = np.int64(_hash(3 * n + c)) % 7 - 3
            value = 255 * min(max((total - 0.15) * 1.25, 0.0), 1.0) + grain
            colors[n, c] = min(max(value + 0.5, 0.0), 255.0)


def painted_sphere(depth: int) -> octex.OctreeTexture:
    """Return a sphere of one leaf a texel, whose averages weigh texels by their area."""
    codes = sphere_cells(depth)
    tree = Octree.from_leaves(codes, depth)
    centres = (decode_cells(codes) + 0.5) / 2**depth - 0.5
    colors = np.empty((len(codes), 3), np.uint8)
    _paint(centres / np.linalg.norm(centres, axis=1)[:, None], colors)
    areas = _areas(codes, depth)
    areas *= 4 * np.pi * RADIUS**2 * 4.0**depth / areas.sum()  # in faces of the finest cells
    values, coded = np.zeros((tree.n_cells, 3), np.uint8), np.zeros(tree.n_cells, np.uint8)
    first, sums = tree.arrays.level_cells, colors * areas[:, None]
    for level in range(depth, -1, -1):
        own = slice(first[level], first[level + 1])
        values[own] = colors if level == depth else np.floor(sums / areas[:, None] + 0.5)
        steps = AREA_STEPS * np.log2(areas / 4.0 ** (depth - level)) + AREA_ONE
        coded[own] = np.clip(np.rint(steps), 1, 255)
        starts = np.flatnonzero(np.diff(codes >> 3, prepend=-1))
        codes, areas, sums = codes[starts] >> 3, *(np.add.reduceat(a, starts) for a in (areas, sums))
    return _texture(tree.with_cell_data(tree.arrays.flags, coded), values, "data")


def _areas(codes: Array, depth: int) -> Array:
    """Estimate how much of the sphere lies in each cell, from random points of it."""
    counts = np.full(len(codes), 1e-3)
    random = np.random.default_rng(1)
    for _ in range(16):
        points = random.normal(size=(2 * len(codes), 3))
        points = 0.5 + RADIUS * points / np.linalg.norm(points, axis=1)[:, None]
        own = encode_cells((points * 2**depth).astype(np.int64))
        at = np.minimum(np.searchsorted(codes, np.sort(own)), len(codes) - 1)
        counts += np.bincount(at, minlength=len(codes))
    return counts
