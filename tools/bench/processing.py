"""Benchmarks of textures made from textures."""

from __future__ import annotations

import numpy as np
from measuring import Report, Setup, clocked

import octex
from octex.channels import BASE_COLOR
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement


def processing(setup: Setup, report: Report) -> None:
    """Values changed, and two large textures in one."""
    depth = 5 if setup.quick else 10
    first, second = (_band(depth, middle) for middle in (0.5, 0.55))
    leaves = first.tree.n_leaves
    report.title(f"processing: bands of cells around spheres, {leaves:,} leaves each, two threads")
    works = {
        "levels, averages and all": lambda: octex.levels(first, gamma=1.5),
        "map of a function": lambda: octex.map(first, lambda light: 0.5 * light),
        "combined": lambda: octex.combine(first, second),
        "mixed": lambda: octex.mix(first, second, 0.3),
    }
    spent = clocked(setup, works)
    for what, each in spent.items():
        report.line(what, each)
    report.at_most("processing: two textures combined, wall time", spent["combined"].wall, 1.0, "s")


def _band(depth: int, middle: float) -> OctreeTexture:
    """Return a band of cells around a sphere with random values."""
    edge = 1 << depth
    centres = (np.arange(edge) + 0.5) / edge
    across = np.hypot((centres - middle)[:, None], (centres - 0.5)[None, :])
    cells = []
    for k, z in enumerate(centres):
        i, j = np.nonzero(np.abs(np.hypot(across, z - 0.5) - 0.3) < 1.7 / edge)
        cells.append(np.stack([i, j, np.full(i.size, k)], axis=1))
    tree = Octree.from_leaves(np.sort(encode_cells(np.concatenate(cells))), depth)
    random = np.random.default_rng(0)
    tree = tree.with_cell_data(np.ones(tree.n_cells, np.uint8), np.full(tree.n_cells, 207, np.uint8))
    values = random.integers(0, 256, (tree.n_cells, 3), dtype=np.uint8)
    channel = Channel(BASE_COLOR, values, values[:0], values[:0])
    return OctreeTexture(tree, {"base_color": channel}, Placement((0.0, 0.0, 0.0), 1.0), [[0] * 3, [1] * 3])
