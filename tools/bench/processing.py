"""Benchmarks of textures made from textures."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from measuring import Report, Setup, Spent

import octex
from octex.channels import BASE_COLOR
from octex.processing.mapping import look_up_codes
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement


def processing(setup: Setup, report: Report) -> None:
    """Levels beside numpy's look-up of the same bytes, and two large textures in one."""
    depth = 5 if setup.quick else 10
    first, second = (_band(depth, middle) for middle in (0.5, 0.55))
    leaves = first.tree.n_leaves
    report.title(f"processing: bands of cells around spheres, {leaves:,} leaves each, two threads")
    codes = first.channels["base_color"].values.reshape(-1)
    table = np.arange(256, dtype=np.uint8)[::-1].copy()
    found = np.empty_like(codes)
    columns = codes.reshape(-1, 1), table[None], found.reshape(-1, 1)
    own = _spent(setup, lambda: look_up_codes(*columns))
    numpys = _spent(setup, lambda: table[codes])
    levels = _spent(setup, lambda: octex.levels(first, gamma=1.5))
    report.line(f"a table on {codes.size:,} bytes", own)
    report.line("numpy's table[codes]", numpys)
    report.line("levels, averages and all", levels)
    report.at_most("processing: a table's time, of numpy's", own.cpu / max(numpys.cpu, 1e-9), 1.0, "")
    report.line("map of a function", _spent(setup, lambda: octex.map(first, lambda light: 0.5 * light)))
    combined = _spent(setup, lambda: octex.combine(first, second))
    report.line("combined", combined)
    report.at_most("processing: two textures combined, wall time", combined.wall, 1.0, "s")
    report.line("mixed", _spent(setup, lambda: octex.mix(first, second, 0.3)))


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


def _spent(setup: Setup, work: Callable[[], object]) -> Spent:
    """Return the median of some rounds, after one that does not count."""
    work()
    rounds = []
    for _ in range(setup.repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        rounds.append(Spent(time.process_time() - cpu, time.perf_counter() - wall))
    return sorted(rounds)[len(rounds) // 2]
