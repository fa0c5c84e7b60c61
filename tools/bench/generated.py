"""A mesh like those of generators: blobs, thin parts and holes in a dual grid, as O-Voxel files have them."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_BLOCK = 16
#: Middles and radii of blobs, in the cube from −0.5 to 0.5; the last ones lie apart.
_BLOBS = np.array(
    [
        (0.0, 0.0, 0.0, 0.2), (0.14, 0.12, 0.05, 0.13), (-0.15, 0.1, -0.06, 0.12), (0.05, -0.16, 0.1, 0.11),
        (-0.1, -0.12, -0.14, 0.1), (0.4, 0.4, 0.4, 0.02), (-0.42, 0.38, 0.1, 0.02), (0.3, -0.41, -0.4, 0.02),
    ]
)  # fmt: skip
#: How softly blobs join, and how deep the ripples on everything are.
_SOFT, _RIPPLES = 0.03, 0.0015


def distances(points: Floats) -> Floats:
    """Return about how far points (n, 3) are from the surface; negative inside."""
    apart = np.linalg.norm(points[:, None] - _BLOBS[:, :3], axis=2) - _BLOBS[:, 3]
    least = apart.min(axis=1)
    blobs = least - _SOFT * np.log(np.exp((least[:, None] - apart) / _SOFT).sum(axis=1))
    x, y, z = points.T
    around = np.hypot(x, y)
    blobs = np.maximum(blobs, 0.05 - np.hypot(x - 0.09, z))
    disc = np.maximum(np.abs(z + 0.02 * np.cos(9.0 * x)) - 0.006, around - 0.42)
    slots = np.abs(np.mod(np.arctan2(y, x) * 8.0 / np.pi, 2.0) - 1.0) - 0.35
    disc = np.maximum(disc, -np.maximum(0.1 * slots, np.abs(around - 0.36) - 0.03))
    rod = np.maximum(np.hypot(np.abs(x) - 0.2, np.abs(y) - 0.2) - 0.008, np.abs(z) - 0.4)
    ripples = _RIPPLES * np.sin(70.0 * x) * np.sin(60.0 * y + 1.0) * np.sin(80.0 * z)
    return np.minimum(np.minimum(blobs, disc), rod) + ripples


def colors(points: Floats) -> Floats:
    """Return colours (n, 3) at points, linear light."""
    return 0.5 + 0.4 * np.sin(18.0 * points + np.array([0.0, 2.0, 4.0]))


def dual_grid(side: int, noise: float) -> dict[str, npt.NDArray[Any]]:
    """Return O-Voxel's arrays of the surface in ``side`` cells a side; vertices move by ``noise`` cells."""
    corners, axes, parts = _crossed_edges(side)
    places, moved = [], []
    step = np.eye(3, dtype=np.int64)
    points = corners - step[axes] * (1.0 - parts[:, None])
    for first, second in product((0, 1), repeat=2):
        voxel = corners - 1 + first * step[(axes + 1) % 3] + second * step[(axes + 2) % 3]
        places.append(voxel)
        moved.append(points - voxel)
    keys = np.concatenate(places) @ np.array([side**2, side, 1])
    known, rows = np.unique(keys, return_inverse=True)
    count = np.bincount(rows)
    within = np.stack([np.bincount(rows, each) for each in np.concatenate(moved).T], axis=1) / count[:, None]
    within += noise * np.random.default_rng(0).standard_normal(within.shape)
    crossed = np.zeros((len(known), 3), np.bool_)
    crossed[rows[: len(corners)], axes] = True
    coords = np.stack(np.unravel_index(known, (side,) * 3), axis=1)
    shades = np.clip(colors((coords + 0.5) / side - 0.5), 0.0, 1.0)
    coded = np.where(shades <= 0.0031308, 12.92 * shades, 1.055 * shades ** (1 / 2.4) - 0.055)
    return {
        "coords": coords,
        "base_color": np.rint(255.0 * coded).astype(np.uint8),
        "dual_vertices": np.clip(within, 0.0, 1.0),
        "intersected": crossed,
        "origin": np.full(3, -0.5),
        "voxel_size": np.array(1.0 / side),
    }


def _crossed_edges(side: int) -> tuple[Ints, Ints, Floats]:
    """Return the edges (n,) that the surface crosses: their higher ends, axes, and where along them."""
    blocks = np.stack(np.meshgrid(*[np.arange(-(-side // _BLOCK))] * 3, indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    middles = (blocks + 0.5) * _BLOCK / side - 0.5
    near = np.abs(distances(middles)) < 0.95 * _BLOCK / side
    lattice = np.stack(np.meshgrid(*[np.arange(_BLOCK + 1)] * 3, indexing="ij"), axis=-1)
    corners, axes, parts = [], [], []
    for block in blocks[near]:
        at = block * _BLOCK + lattice
        values = distances(at.reshape(-1, 3) / side - 0.5).reshape(lattice.shape[:3])
        for axis in range(3):
            others = [slice(0, -1)] * 3
            low = values[tuple(others)]
            others[axis] = slice(1, None)
            high = values[tuple(others)]
            found = np.nonzero((low < 0.0) != (high < 0.0))
            higher = np.stack(found, axis=1) + block * _BLOCK
            higher[:, axis] += 1
            corners.append(higher)
            axes.append(np.full(len(higher), axis))
            parts.append(low[found] / (low[found] - high[found]))
    return np.concatenate(corners), np.concatenate(axes), np.concatenate(parts)
