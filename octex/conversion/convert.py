"""The main job: a textured model in, an octree texture out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ONE, ChannelFormat, encode
from octex.checks import as_depth
from octex.conversion.accumulate import Sums, count_entries, level_means, sum_children, sum_pieces
from octex.conversion.cells import BLOCK_BITS, SPREAD, load_triangle
from octex.conversion.pieces import Blocks, bin_triangles, cut, most_pieces
from octex.errors import ArgumentError, ModelError
from octex.jit import kernel
from octex.parallel import Progress, memory_size, ordered_map, silent, workers
from octex.source.load import at_rest, load_surface
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import GRID_BITS, MAX_CELLS, SPLIT, SplitTable
from octex.tree.octree import Octree
from octex.tree.placement import Placement

DEFAULT_DEPTH = 10
#: Bytes of memory that a conversion takes at least for each cell (measured at its peak: 27).
CELL_MEMORY = 24
#: Bound of the pieces in one task: enough to hide what a task costs, few enough to stay in the cache.
TASK_PIECES = 400_000


class Stored(NamedTuple):
    """What is kept of one level's cells: means, encoded."""

    flags: npt.NDArray[np.uint8]  # normal flags, and SPLIT
    areas: npt.NDArray[np.uint8]
    values: list[npt.NDArray[np.generic]]  # one array (cells, components) for each channel
    split_cells: npt.NDArray[np.int64]  # index into these cells
    split_facings: npt.NDArray[np.uint8]
    split_areas: npt.NDArray[np.uint8]  # a row for each facing
    split_values: list[npt.NDArray[np.generic]]


class Part(NamedTuple):
    """A run of blocks, converted."""

    codes: npt.NDArray[np.int64]  # of the leaves
    levels: list[Stored]  # from the leaves' level up to below the blocks' own
    top: Sums  # of the blocks themselves


class Job(NamedTuple):
    """All that a task needs."""

    surface: Surface
    grid: npt.NDArray[np.int32]
    blocks: Blocks
    depth: int
    block_level: int
    cell: float  # edge of a leaf in rest units


def convert(
    model: str | Path | Surface,
    depth: int | None = None,
    *,
    cell: float | None = None,
    rest: str | Path | npt.ArrayLike | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Convert a model into an octree texture.

    ``model`` is a file or a Surface. The finest cells are 2⁻ᵈᵉᵖᵗʰ of the root cell (10 by default), or have
    the edge ``cell`` in model units. ``rest`` gives rest positions, as for ``load_surface``. Work is spread
    over ``executor``, by default a thread for each processor; the result does not depend on it. ``progress``
    is called with the stage's name, the units done and the units in all.

    A leaf is stored for exactly the cells that the surface meets at rest. Its value, and that of every node
    above, is the area-weighted mean of the source over the surface inside it, taken in linear light, colours
    weighted by alpha too where the model has it (Benson & Davis 2002, 3.1, 3.5 and 5). A cell in which the
    surface shows both ways along an axis keeps a mean for each facing too, if one differs from the whole by
    more than 1/255.

    Raises ModelError and ImageError for a model that cannot be used, ArgumentError for a depth out of range,
    a cell too small, or more cells than can be numbered.
    """
    report = progress or silent
    if depth is not None and cell is not None:
        raise ArgumentError("give depth or cell, not both")
    if depth is not None:
        as_depth(depth)
    if isinstance(model, Surface):
        surface = model if rest is None else at_rest(model, rest)
    else:
        report("read", 0, 1)
        surface = load_surface(model, rest=rest)
        report("read", 1, 1)
    if cell is not None:
        placement, depth = Placement.with_cell(surface.bounds, cell)
    else:
        depth = DEFAULT_DEPTH if depth is None else depth
        placement = Placement.around(surface.bounds, depth)
    levels, codes, degenerate = _fill(surface, placement, depth, executor, report)
    report("build", 0, 1)
    texture = _assemble(surface, placement, depth, levels, codes, degenerate)
    report("build", 1, 1)
    return texture


def on_grid(rest: npt.NDArray[np.float64], placement: Placement) -> npt.NDArray[np.int32]:
    """Round rest positions (n, 3) to steps of 2⁻³⁰ of the root's edge."""
    steps = placement.to_texture_space(rest)
    steps *= 1 << GRID_BITS
    np.rint(steps, out=steps)
    np.clip(steps, 0, (1 << GRID_BITS) - 1, out=steps)
    return steps.astype(np.int32)


def _fill(
    surface: Surface, placement: Placement, depth: int, executor: Executor | None, report: Progress
) -> tuple[list[list[Stored]], npt.NDArray[np.int64], int]:
    """Return what is stored of each level from the root down, in parts; the leaves' codes; degenerates."""
    grid = on_grid(surface.rest, placement)
    degenerate, faces = _count_degenerate(grid, surface.triangles)
    if degenerate == len(surface.triangles):
        raise ModelError(
            f"{surface.name}: all {degenerate} triangles are degenerate (without area in steps of "
            f"{placement.size / 2**GRID_BITS:.3g}); there is nothing to convert"
        )
    # A surface meets at least as many cells as its area has faces, unless it is folded within them.
    least = min(faces * 4.0 ** (depth - GRID_BITS), 8.0**depth)
    if least > min(MAX_CELLS, memory_size() / CELL_MEMORY):
        raise ArgumentError(
            f"depth {depth} needs about {least:.2g} cells for {surface.name}, more than fit into memory "
            "or can be numbered; use a smaller depth or a larger cell"
        )
    report("sort", 0, 1)
    blocks = bin_triangles(grid, surface.triangles, depth)
    report("sort", 1, 1)
    block_level = max(depth - BLOCK_BITS, 0)
    job = Job(surface, grid, blocks, depth, block_level, placement.size / 2**depth)
    runs = _even_runs(most_pieces(grid, surface.triangles, blocks, depth))
    with workers(executor) as pool:
        parts = list(ordered_map(pool, partial(_convert_run, job), runs, stage="convert", progress=report))
    top = Sums(*(np.concatenate(arrays) for arrays in zip(*(part.top for part in parts), strict=True)))
    upper, _ = _climb(top, block_level, surface.channels)
    levels = [[stored] for stored in reversed(upper)]
    levels += ([part.levels[step] for part in parts] for step in reversed(range(len(parts[0].levels))))
    return levels, np.concatenate([part.codes for part in parts]), degenerate


class Run(NamedTuple):
    """The work of one task: a run of blocks, with a bound of their pieces."""

    first_block: int
    last_block: int  # exclusive
    most: int


def _even_runs(bounds: npt.NDArray[np.int64]) -> list[Run]:
    """Cut blocks into runs of about TASK_PIECES, by the bounds of their pieces."""
    totals = np.cumsum(bounds)
    ends = np.searchsorted(totals, np.arange(TASK_PIECES, totals[-1], TASK_PIECES)) + 1
    ends = np.unique(np.append(ends, len(totals)))
    starts = np.append(0, ends[:-1])
    most = np.add.reduceat(bounds, starts)
    return [Run(*row) for row in zip(starts.tolist(), ends.tolist(), most.tolist(), strict=True)]


def _convert_run(job: Job, run: Run) -> Part:
    """Convert a run of blocks."""
    surface = job.surface
    pieces = cut(
        job.grid,
        surface.triangles,
        job.blocks,
        run.first_block,
        run.last_block,
        job.depth,
        run.most,
        0,
        SPREAD,
    )
    # A piece is read with a footprint of its own size: a cell's mean is then the mean over what lies in it.
    widths = (np.sqrt(pieces.areas) * job.cell).astype(np.float32)
    values = surface.evaluate_all(pieces.triangles, pieces.barycentric, widths)
    n_entries = count_entries(pieces.flags)
    sums = sum_pieces(pieces.entries, pieces.areas, values, _alpha_column(surface.channels), n_entries)
    leaves = Sums(pieces.codes, pieces.flags, sums)
    levels, top = _climb(leaves, job.depth - job.block_level, surface.channels)
    levels.pop()  # the blocks themselves: in top
    return Part(pieces.codes, levels, top)


def _climb(sums: Sums, steps: int, channels: Sequence[ChannelFormat]) -> tuple[list[Stored], Sums]:
    """Store a level and the ``steps`` levels above it; return them, and the sums of the last."""
    levels = [_stored(sums, channels)]
    for _ in range(steps):
        sums = sum_children(sums)
        levels.append(_stored(sums, channels))
    return levels, sums


def _stored(level: Sums, channels: Sequence[ChannelFormat]) -> Stored:
    """Encode a level's means; split the cells whose facings show something else than the whole."""
    means = level_means(level, _alpha_column(channels))
    cells, facing_areas = means.two_sided, means.facing_areas
    counts = np.bitwise_count(level.flags[cells]).astype(np.int64)
    owners = np.repeat(cells, counts)
    values, facing_values = [], []
    differs = np.zeros(len(owners), np.bool_)
    first = 0
    for channel in channels:
        part = slice(first, first + channel.components)
        first = part.stop
        values.append(encode(means.values[:, part], channel.dtype, channel.space))
        facing_values.append(encode(means.facing_values[:, part], channel.dtype, channel.space))
        step = ONE[channel.dtype] / 255
        apart = facing_values[-1].astype(np.float32) - values[-1][owners].astype(np.float32)
        differs |= (np.abs(apart) > step).any(axis=1)
    flags = level.flags
    if len(cells):
        is_split = np.logical_or.reduceat(differs, np.cumsum(counts) - counts)
        rows = np.repeat(is_split, counts)
        cells, facing_areas = cells[is_split], facing_areas[rows]
        facing_values = [each[rows] for each in facing_values]
        flags = flags.copy()
        flags[cells] |= SPLIT
    return Stored(flags, means.areas, values, cells, level.flags[cells], facing_areas, facing_values)


def _assemble(
    surface: Surface,
    placement: Placement,
    depth: int,
    levels: list[list[Stored]],
    codes: npt.NDArray[np.int64],
    degenerate: int,
) -> OctreeTexture:
    """Build the tree, and lay the parts of each level end to end."""
    tree = Octree.from_leaves(codes, depth)
    parts = [part for level in levels for part in level]
    starts = np.cumsum([0, *(len(part.flags) for part in parts)])
    split = SplitTable(
        np.concatenate([part.split_cells + start for part, start in zip(parts, starts, strict=False)]).astype(
            np.uint32
        ),
        np.concatenate([part.split_facings for part in parts]),
        np.concatenate([part.split_areas for part in parts]),
    )
    tree = tree.with_cell_data(
        np.concatenate([part.flags for part in parts]), np.concatenate([part.areas for part in parts]), split
    )
    channels = {
        channel.name: Channel(
            channel,
            np.concatenate([part.values[i] for part in parts]),
            np.concatenate([part.split_values[i] for part in parts]),
        )
        for i, channel in enumerate(surface.channels)
    }
    metadata = dict(surface.provenance)
    metadata["octex"] = octex.__version__
    metadata["convert"] = json.dumps(
        {"depth": depth, "triangles": len(surface.triangles), "degenerate": degenerate}
    )
    return OctreeTexture(tree, channels, placement, surface.bounds, metadata)


def _alpha_column(channels: Sequence[ChannelFormat]) -> int:
    """Return the component that holds coverage, or −1."""
    first = 0
    for channel in channels:
        if channel.name == "alpha":
            return first
        first += channel.components
    return -1


@kernel
def _count_degenerate(grid: npt.NDArray[np.int32], triangles: npt.NDArray[np.int32]) -> tuple[int, float]:
    """Count the triangles that are degenerate on the grid; also add up all areas, in square grid steps."""
    corners = np.empty((3, 3), np.int64)
    normal = np.empty(3, np.int64)
    count = 0
    doubled = 0.0
    for i in range(triangles.shape[0]):
        if load_triangle(grid, triangles, i, corners, normal) < 0:
            count += 1
        else:
            x, y, z = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])
            doubled += np.sqrt(x * x + y * y + z * z)
    return count, 0.5 * doubled
