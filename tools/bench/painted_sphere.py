"""A sphere with painted content or white noise, and what a camera sees of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt
from inputs import RADIUS, sphere_cells

import octex
from octex.channels import ChannelFormat
from octex.texture import Channel
from octex.tree.layout import AREA_ONE, AREA_STEPS
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

Array = npt.NDArray[Any]

EYE = np.array([1.6, -0.5, 1.5])


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
def _shade(painted: bool, points: Array, colors: Array) -> None:
    """Write eight octaves of noise with grain of ±3 levels, or white noise (n, 3) of 8 bits."""
    for n in range(len(points)):
        x, y, z = points[n]
        for c in range(3):
            grain = np.int64(_hash(3 * n + c))
            if not painted:
                colors[n, c] = grain & 255
                continue
            frequency, amplitude, total = 3.0, 0.5, 0.0
            for octave in range(8):
                total += amplitude * _noise(
                    x * frequency + 9, y * frequency + 9, z * frequency + 9, 17 * octave + c
                )
                frequency *= 2.03
                amplitude *= 0.6
            value = 255 * min(max((total - 0.15) * 1.25, 0.0), 1.0) + grain % 7 - 3
            colors[n, c] = min(max(value + 0.5, 0.0), 255.0)


def painted_sphere(depth: int, *, painted: bool = True) -> octex.OctreeTexture:
    """Return a sphere of one leaf a texel, whose averages weigh texels by their area."""
    codes = sphere_cells(depth)
    tree = Octree.from_leaves(codes, depth)
    centres = (decode_cells(codes) + 0.5) / 2**depth - 0.5
    colors = np.empty((len(codes), 3), np.uint8)
    _shade(painted, centres / np.linalg.norm(centres, axis=1)[:, None], colors)
    areas = _areas(codes, depth)
    areas *= 4 * np.pi * RADIUS**2 * 4.0**depth / areas.sum()  # in faces of the finest cells
    values, sums = np.zeros((tree.n_cells, 3), np.uint8), colors * areas[:, None]
    first = tree.arrays.level_cells
    values[first[depth] :] = colors
    coded = np.zeros(tree.n_cells, np.uint8)
    coded[first[depth] :] = _coded(areas)
    for level in range(depth - 1, -1, -1):
        parents = codes >> 3
        starts = np.flatnonzero(np.diff(parents, prepend=-1))
        codes, areas, sums = parents[starts], np.add.reduceat(areas, starts), np.add.reduceat(sums, starts)
        values[first[level] : first[level + 1]] = np.floor(sums / areas[:, None] + 0.5)
        coded[first[level] : first[level + 1]] = _coded(areas / 4.0 ** (depth - level))
    tree = tree.with_cell_data(tree.arrays.flags, coded)
    none = np.empty((0, 3), np.uint8)
    channel = Channel(ChannelFormat("base_color", 3, "data", "uint8"), values, none, none)
    return octex.OctreeTexture(
        tree, {"base_color": channel}, Placement((0.0, 0.0, 0.0), 1.0), [[0, 0, 0], [1, 1, 1]]
    )


def _coded(areas: Array) -> Array:
    return np.clip(np.rint(AREA_STEPS * np.log2(areas) + AREA_ONE), 1, 255)


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


class View(NamedTuple):
    """What the pixels of a picture of n² see, row by row."""

    hit: Array  # (n²,)   which see the sphere
    points: Array  # (hits, 3)
    dPdx: Array  # (hits, 3)   how the points change from a pixel to the next
    dPdy: Array  # (hits, 3)
    normals: Array  # (hits, 3)


def view(n: int) -> View:
    """Look at the sphere, which just fits into the picture."""
    forward = (0.5 - EYE) / np.linalg.norm(0.5 - EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    distance = np.linalg.norm(0.5 - EYE)
    half = 1.02 * RADIUS / np.sqrt(distance**2 - RADIUS**2)
    pixel = 2 * half / n
    steps = (np.arange(n) + 0.5) * pixel - half
    x, y = np.meshgrid(steps, -steps)
    rays = (forward + x[..., None] * right + y[..., None] * up).reshape(-1, 3)  # 1 deep
    unit = rays / np.linalg.norm(rays, axis=1)[:, None]
    along = unit @ (0.5 - EYE)
    under = RADIUS**2 - ((0.5 - EYE) ** 2).sum() + along**2
    hit = under >= 0
    points = EYE + (along[hit] - np.sqrt(under[hit]))[:, None] * unit[hit]
    normals = (points - 0.5) / RADIUS
    rays = rays[hit]
    deep = ((points - EYE) @ forward)[:, None]
    facing = (normals * rays).sum(axis=1)[:, None]
    dPdx, dPdy = (pixel * deep * (step - rays * (normals @ step)[:, None] / facing) for step in (right, -up))
    return View(hit, points, dPdx, dPdy, normals)
