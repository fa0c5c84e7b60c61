"""The main job: a textured model in, an octree texture out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ONE, ChannelFormat, encode, linear_to_srgb
from octex.checks import as_choice, as_depth
from octex.conversion.accumulate import (
    Columns,
    Sums,
    by_channel,
    count_entries,
    level_means,
    sum_children,
    sum_pieces,
)
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
DEFAULT_FILTER = "ewa"
#: Bytes of memory that a conversion takes at least for each cell, and for each byte of the cell's values
#: (measured at its peak: 27 bytes for 3 of values, 41 for 11, 113 for 44).
CELL_MEMORY, VALUE_MEMORY = 18, 2
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
    channels: tuple[ChannelFormat, ...]  # as they are stored
    columns: Columns
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
    channels: Sequence[str] | None = None,
    sources: Mapping[str, object] | None = None,
    dtype: str | Mapping[str, str] | None = None,
    filter: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Convert a model into an octree texture.

    ``model`` is a file or a Surface. The finest cells are 2⁻ᵈᵉᵖᵗʰ of the root cell (10 by default), or have
    the edge ``cell`` in model units. ``rest`` gives rest positions, as for ``load_surface``. Work is spread
    over ``executor``, by default a thread for each processor; the result does not depend on it. ``progress``
    is called with the stage's name, the units done and the units in all.

    ``channels`` names those to convert, by default all that the model has; ``sources`` gives some from
    elsewhere, as for ``Surface.with_sources``; ``filter`` is how images are averaged over cells, as for
    ``load_surface``. ``dtype``, "uint8", "uint16", "float16" or "float32", is the stored type of all channels
    or of each by its name; the default is the source's: uint8, or float16 for light above 1. Floats store
    linear light.

    A leaf is stored for exactly the cells that the surface meets at rest. Its value, and that of every node
    above, is the area-weighted mean of the source over the surface inside it, taken in linear light, all
    channels weighted by alpha too if it is among them (Benson & Davis 2002, 3.1, 3.5 and 5). Directions are
    averaged as vectors: the less they agree, the shorter is the mean. A cell in which the surface shows both
    ways along an axis keeps a mean for each facing too, if one differs from the whole by more than 1/255 of
    the encoded range; light stored as floats is compared on sRGB's curve, and above 1 by ratio (0.9 %).

    Raises ModelError and ImageError for a model that cannot be used, ArgumentError for a depth out of range,
    a cell too small, more cells than can be numbered, unknown names, and an integer type for a channel that
    goes above 1.
    """
    report = progress or silent
    if depth is not None and cell is not None:
        raise ArgumentError("give depth or cell, not both")
    if depth is not None:
        as_depth(depth)
    surface = _surface(model, rest, channels, sources or {}, filter, report)
    stored = _stored_as(surface, dtype)
    if cell is not None:
        placement, depth = Placement.with_cell(surface.bounds, cell)
    else:
        depth = DEFAULT_DEPTH if depth is None else depth
        placement = Placement.around(surface.bounds, depth)
    levels, codes, degenerate = _fill(surface, stored, placement, depth, executor, report)
    report("build", 0, 1)
    options = {
        **({"depth": depth} if cell is None else {"cell": float(cell)}),
        "channels": {channel.name: channel.dtype for channel in stored},
        "triangles": len(surface.triangles),
        "degenerate": degenerate,
    }
    metadata = {**surface.provenance, "octex": octex.__version__, "convert": json.dumps(options)}
    tree, values = _assemble(stored, depth, levels, codes)
    texture = OctreeTexture(tree, values, placement, surface.bounds, metadata)
    report("build", 1, 1)
    return texture


def _surface(
    model: str | Path | Surface,
    rest: str | Path | npt.ArrayLike | None,
    channels: Sequence[str] | None,
    sources: Mapping[str, object],
    filter: str | None,
    report: Progress,
) -> Surface:
    """Return what is to be converted, with the wanted channels alone."""
    if not isinstance(model, Surface):
        report("read", 0, 1)
        surface = load_surface(
            model, rest, channels=channels, sources=sources, filter=filter or DEFAULT_FILTER
        )
        report("read", 1, 1)
        return surface
    surface = model if rest is None else at_rest(model, rest)
    surface = surface.completed(sources, channels)
    return surface if filter is None else surface.with_filter(filter)


def _stored_as(surface: Surface, dtype: str | Mapping[str, str] | None) -> tuple[ChannelFormat, ...]:
    """Return how each channel of a surface is stored."""
    names = [channel.name for channel in surface.channels]
    wanted = dict(dtype) if isinstance(dtype, Mapping) else dict.fromkeys(names, dtype)
    for name in wanted:
        as_choice(name, names, "channel of dtype")
    formats = []
    for channel in surface.channels:
        chosen = wanted.get(channel.name)
        if chosen is None:
            formats.append(channel)
            continue
        as_choice(chosen, ONE, "dtype")
        space = channel.space
        if chosen.startswith("float"):
            space = "linear" if space == "srgb" else space
        elif space == "linear" and channel.dtype.startswith("float"):
            raise ArgumentError(
                f"{surface.name}: channel {channel.name!r} goes above 1, which {chosen} cannot hold; "
                "give it the dtype float16 or float32"
            )
        formats.append(channel._replace(space=space, dtype=chosen))
    return tuple(formats)


def on_grid(rest: npt.NDArray[np.float64], placement: Placement) -> npt.NDArray[np.int32]:
    """Round rest positions (n, 3) to steps of 2⁻³⁰ of the root's edge."""
    steps = placement.to_texture_space(rest)
    steps *= 1 << GRID_BITS
    np.rint(steps, out=steps)
    np.clip(steps, 0, (1 << GRID_BITS) - 1, out=steps)
    return steps.astype(np.int32)


def _fill(
    surface: Surface,
    channels: tuple[ChannelFormat, ...],
    placement: Placement,
    depth: int,
    executor: Executor | None,
    report: Progress,
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
    row = sum(channel.components * np.dtype(channel.dtype).itemsize for channel in channels)
    if least > min(MAX_CELLS, memory_size() / (CELL_MEMORY + VALUE_MEMORY * row)):
        raise ArgumentError(
            f"depth {depth} needs about {least:.2g} cells for {surface.name}, more than fit into memory "
            "or can be numbered; use a smaller depth or a larger cell"
        )
    report("sort", 0, 1)
    blocks = bin_triangles(grid, surface.triangles, depth)
    report("sort", 1, 1)
    block_level = max(depth - BLOCK_BITS, 0)
    columns = Columns.of(channels)
    job = Job(surface, channels, columns, grid, blocks, depth, block_level, placement.size / 2**depth)
    runs = _even_runs(most_pieces(grid, surface.triangles, blocks, depth))
    with workers(executor) as pool:
        parts = list(ordered_map(pool, partial(_convert_run, job), runs, stage="convert", progress=report))
    top = Sums(*(np.concatenate(arrays) for arrays in zip(*(part.top for part in parts), strict=True)))
    upper, _ = _climb(top, block_level, channels, columns)
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
    sums = sum_pieces(pieces.entries, pieces.areas, values, job.columns.alpha, n_entries)
    leaves = Sums(pieces.codes, pieces.flags, sums)
    levels, top = _climb(leaves, job.depth - job.block_level, job.channels, job.columns)
    levels.pop()  # the blocks themselves: in top
    return Part(pieces.codes, levels, top)


def _climb(
    sums: Sums, steps: int, channels: Sequence[ChannelFormat], columns: Columns
) -> tuple[list[Stored], Sums]:
    """Store a level and the ``steps`` levels above it; return them, and the sums of the last."""
    levels = [_stored(sums, channels, columns)]
    for _ in range(steps):
        sums = sum_children(sums)
        levels.append(_stored(sums, channels, columns))
    return levels, sums


def _stored(level: Sums, channels: Sequence[ChannelFormat], columns: Columns) -> Stored:
    """Encode a level's means; split the cells whose facings show something else than the whole."""
    means = level_means(level, columns)
    cells, facing_areas = means.two_sided, means.facing_areas
    values = [
        encode(each, channel.dtype, channel.space)
        for channel, each in zip(channels, by_channel(means.values, channels), strict=True)
    ]
    facing_values = [
        encode(each, channel.dtype, channel.space)
        for channel, each in zip(channels, by_channel(means.facing_values, channels), strict=True)
    ]
    flags = level.flags
    if len(cells):
        counts = np.bitwise_count(flags[cells]).astype(np.int64)
        owners = np.repeat(cells, counts)
        differs = np.zeros(len(owners), np.bool_)
        for channel, whole, facing in zip(channels, values, facing_values, strict=True):
            apart = _in_codes(facing, channel) - _in_codes(whole[owners], channel)
            differs |= (np.abs(apart) > 1.0).any(axis=1)
        is_split = np.logical_or.reduceat(differs, np.cumsum(counts) - counts)
        rows = np.repeat(is_split, counts)
        cells, facing_areas = cells[is_split], facing_areas[rows]
        facing_values = [each[rows] for each in facing_values]
        flags = flags.copy()
        flags[cells] |= SPLIT
    return Stored(flags, means.areas, values, cells, level.flags[cells], facing_areas, facing_values)


def _in_codes(stored: npt.NDArray[np.generic], channel: ChannelFormat) -> npt.NDArray[np.floating]:
    """Return stored values on the scale of 8-bit codes: light on sRGB's curve, a logarithm from 1 on."""
    if channel.space == "linear" and channel.dtype.startswith("float"):
        light = stored.astype(np.float64)
        slope = 1.055 / 2.4  # of the curve at 1
        return 255.0 * (linear_to_srgb(np.minimum(light, 1.0)) + slope * np.log(np.maximum(light, 1.0)))
    scale = 255.0 / ONE[channel.dtype]
    if channel.space == "direction" and channel.dtype.startswith("float"):
        scale /= 2  # −1 … 1
    return stored.astype(np.float32) * np.float32(scale)


def _assemble(
    channels: Sequence[ChannelFormat], depth: int, levels: list[list[Stored]], codes: npt.NDArray[np.int64]
) -> tuple[Octree, dict[str, Channel]]:
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
    values = {
        channel.name: Channel(
            channel,
            np.concatenate([part.values[i] for part in parts]),
            np.concatenate([part.split_values[i] for part in parts]),
            np.empty((0, channel.components), channel.dtype),
        )
        for i, channel in enumerate(channels)
    }
    return tree, values


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
