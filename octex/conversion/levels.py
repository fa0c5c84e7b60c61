"""Voxelizes a surface: the means of all cells, block by block, and the samples of the finest cells.

A *gap* is a finest cell in which the source has no value. It is left out of the tree, but its area counts as
transparent in the means above it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s, bit_counts
from octex.channels import ALPHA, ONE, ChannelFormat, check_range, decode, encode
from octex.conversion import large
from octex.conversion.detail import Wanted, deepest_wanted
from octex.conversion.prune import Channels
from octex.conversion.samples import UNIT, Samples, SamplesOfRun, join, take_samples
from octex.editing.averages import average
from octex.editing.nodes import nodes_at
from octex.editing.split import differ
from octex.errors import ArgumentError, ModelError
from octex.parallel import Progress, memory_size, ordered_map
from octex.source.base import Source
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import FACING_FLAGS, GRID_BITS, MAX_CELLS, SPLIT, SplitTable
from octex.tree.octree import Octree, distinct
from octex.tree.placement import Placement, on_grid
from octex.voxelize.fragments import (
    BlockRange,
    Blocks,
    Fragments,
    Reached,
    cut,
    divided,
    even_runs,
    most_fragments,
    whole,
)
from octex.voxelize.grid import count_degenerate
from octex.voxelize.sums import (
    SumColumns,
    Sums,
    by_channel,
    coverages,
    level_means,
    sum_children,
    sum_fragments,
    sums_of,
)

#: Least bytes of memory for each cell, and for each byte of its values (at the peak 27 bytes were measured
#: for 3 of values, 41 for 11, 113 for 44); and more where samples are taken (58 bytes for 3).
CELL_MEMORY, VALUE_MEMORY = 18, 2
SAMPLE_MEMORY, SAMPLE_VALUE_MEMORY = 28, 2
#: The memory at the peak, as a multiple of the least for all leaves.
_PEAK_PER_LEAF = 2.0
#: This many blocks or fewer are cut into blocks of 8³ cells, of which only the reached ones are converted.
_FEW_BLOCKS, SMALL_BITS = 1024, 3
#: Files of parts that are joined into one.
_JOINED = 16
#: A smaller alpha weighs hardly more than gaps: their sum loses it in float32's rounding.
_TRANSPARENT = 2.0**-20


class LevelCells(NamedTuple):
    """The encoded means of one level's cells."""

    flags: Uint8s  # normal flags, and SPLIT
    areas: Uint8s
    values: list[Array]  # one array (cells, components) for each channel
    split_areas: Uint8s  # a row for each facing
    split_values: list[Array]


class ConvertedRun(NamedTuple):
    """A converted run of blocks."""

    codes: Int64s  # of the leaves
    gaps: Int64s
    levels: list[LevelCells]  # from the leaves' level up to below the blocks' level
    top: Sums  # of the blocks themselves
    samples: SamplesOfRun | None
    wanted: Uint8s | None  # (leaves,)   levels


class CellLevels(NamedTuple):
    """A surface, converted level by level."""

    channels: tuple[ChannelFormat, ...]  # as they are stored
    depth: int
    codes: list[Int64s]  # of the finest cells, in parts
    levels: list[list[LevelCells]]  # from the root down, each in parts
    samples: list[SamplesOfRun] | None  # in parts
    wanted: Uint8s | None  # (finest cells,)   levels
    degenerate: int  # triangles without area
    has_gaps: bool
    gaps: Int64s

    @property
    def n_leaves(self) -> int:
        """The number of finest cells."""
        return sum(map(len, self.codes))


class Filled(NamedTuple):
    """A tree all of whose leaves are of one level, and its values."""

    tree: Octree
    channels: Channels  # means
    samples: Samples | None
    wanted: Uint8s | None  # (leaves,)   levels
    has_gaps: bool


class VoxelJob(NamedTuple):
    """The input that all tasks share."""

    name: str  # of the surface
    source: Source | None
    channels: tuple[ChannelFormat, ...]  # as they are stored
    columns: SumColumns
    blocks: Blocks
    cell: float  # edge of a leaf in rest units
    has_samples: bool
    has_gaps: bool
    coverage: Source | None  # whose alpha is 0 in gaps; None: that of `source` is
    wanted: Wanted | None


def cell_levels(
    surface: Surface,
    source: Source | None,
    channels: tuple[ChannelFormat, ...],
    placement: Placement,
    depth: int,
    executor: Executor,
    report: Progress,
    *,
    has_samples: bool,
    wanted: Wanted | None = None,
    root: Blocks | None = None,
    reached: Reached | None = None,
) -> CellLevels:
    """Convert a surface into the means of all cells down to ``depth``, and samples if it ``has_samples``.

    ``channels`` are the source's, as they are stored. Without a source there are cells, facings and areas.
    ``root`` has the triangles to convert (default: all). Blocks that are not ``reached`` are left out, and do
    not count for cells above them; one block is always converted.

    Raises ModelError for a surface without area, ArgumentError for more cells than memory can hold.
    """
    if root is None:
        root = whole(on_grid(surface.rest, placement), surface.triangles, depth)
    faces = root.faces[root.members]
    degenerate, area = count_degenerate(root.grid, faces)
    if degenerate == len(faces):
        raise ModelError(
            f"{surface.name}: all {degenerate} triangles are degenerate (without area in steps of "
            f"{placement.size / 2**GRID_BITS:.3g}); there is nothing to convert"
        )
    room = math.inf if large.is_mapped() else memory_size() / _cell_memory(channels, has_samples)
    _check_count(_least_cells(area, depth), room, surface.name, depth)
    report("sort", 0, 1)
    blocks = divided(root, reached=reached)
    report("sort", 1, 1)
    columns, outside = SumColumns.of(channels), None
    has_gaps = source is not None and source.has_gaps
    coverage = source.only([]) if source is not None and has_gaps and not source.alpha_is_coverage else None
    if reached is not None and blocks.level and blocks.codes.size <= _FEW_BLOCKS:
        coarse, smaller = blocks, divided(blocks, SMALL_BITS)
        is_reached = reached(smaller)
        blocks = smaller.chosen(is_reached)
        outside = _outside(coarse.of_cells(blocks.level), ~is_reached, columns) if has_gaps else None
    source, coverage = (each and each.prepared(root.members) for each in (source, coverage))
    cell = placement.size / 2**depth
    job = VoxelJob(
        surface.name, source, channels, columns, blocks, cell, has_samples, has_gaps, coverage, wanted
    )  # fmt: skip
    runs = even_runs(most_fragments(blocks))
    converted = ordered_map(executor, partial(_convert_run, job), runs, stage="convert", progress=report)
    parts = _gathered(_counted(converted, room / _PEAK_PER_LEAF, surface.name, depth))
    gaps = np.concatenate([part.gaps for part in parts])
    tops = _end_to_end([part.top for part in parts], np.concatenate)
    if outside is not None:
        gaps = np.concatenate([gaps, outside.codes << 3 * blocks.bits])
        tops = _end_to_end([tops, outside], np.concatenate)
        tops = sums_of(tops, np.argsort(tops.codes, kind="stable"))
    codes = [part.codes for part in parts]  # joined later: a source of images takes much of the memory here
    filled = np.concatenate([distinct(each >> 3 * blocks.bits) for each in codes]) if gaps.size else None
    upper, _ = climb(tops, blocks.level, channels, columns, filled)
    levels = [[stored] for stored in reversed(upper)]
    levels += ([part.levels[step] for part in parts] for step in reversed(range(len(parts[0].levels))))
    samples = [part.samples for part in parts if part.samples is not None] if has_samples else None
    levels_wanted = [part.wanted for part in parts if part.wanted is not None]
    deepest = np.concatenate(levels_wanted) if wanted is not None else None
    return CellLevels(channels, depth, codes, levels, samples, deepest, degenerate, has_gaps, gaps)


def _outside(blocks: Blocks, chosen: Bools, columns: SumColumns) -> Sums:
    """Return the areas of chosen cells, whose values are unknown."""
    run = BlockRange(0, blocks.codes.size, int(most_fragments(blocks).sum()))
    pieces, _ = _fragments_in(cut(blocks, run), chosen)
    values = np.zeros((pieces.entries.size, columns.first.size), np.float32)
    n_entries = int(bit_counts(pieces.flags).sum())
    sums = sum_fragments(pieces.entries, pieces.areas, values, columns.alpha, n_entries)
    return Sums(pieces.codes, pieces.flags, sums)


def memory_needed(
    surface: Surface,
    channels: tuple[ChannelFormat, ...],
    placement: Placement,
    depth: int,
    *,
    has_samples: bool,
) -> float:
    """Return how many bytes of memory a conversion takes at least."""
    _, area = count_degenerate(on_grid(surface.rest, placement), surface.triangles)
    return _least_cells(area, depth) * _cell_memory(channels, has_samples)


def _least_cells(area: float, depth: int) -> float:
    """Bound the number of cells from below by a surface's area in cell faces; it ignores folds in a cell."""
    return float(min(area * 4.0 ** (depth - GRID_BITS), 8.0**depth))


def _cell_memory(channels: tuple[ChannelFormat, ...], has_samples: bool) -> int:
    row = sum(channel.components * np.dtype(channel.dtype).itemsize for channel in channels)
    per_sample = SAMPLE_MEMORY + SAMPLE_VALUE_MEMORY * row if has_samples else 0
    return CELL_MEMORY + VALUE_MEMORY * row + per_sample


def _check_count(count: float, room: float, name: str, depth: int) -> None:
    if count > min(room, MAX_CELLS):
        problem, way_out = "a tree can hold", "a smaller depth or a larger cell"
        if count <= MAX_CELLS:
            problem = "fit into memory"
            way_out = "a smaller depth, a larger cell, or files instead of memory (octex convert --memory)"
        raise ArgumentError(
            f"depth {depth} needs at least {count:.2g} cells for {name}, more than {problem}; use {way_out}"
        )


def _counted(parts: Iterable[ConvertedRun], room: float, name: str, depth: int) -> Iterator[ConvertedRun]:
    """Yield parts; raise ArgumentError as soon as they have more leaves than there is ``room`` for."""
    count = 0
    for part in parts:
        count += part.codes.size
        _check_count(count, room, name, depth)
        yield part


def _gathered(parts: Iterable[ConvertedRun]) -> list[ConvertedRun]:
    """Return all parts; parts in files are joined, since each keeps its file open."""
    if not large.is_mapped():
        return list(parts)
    gathered, latest = [], []
    for part in parts:
        latest.append(part)
        if len(latest) == _JOINED:
            gathered.append(large.moved(_end_to_end(latest, np.concatenate)))
            latest = []
    return gathered + latest


def _end_to_end(parts: Sequence[Any], join: Callable[[Sequence[Array]], Array]) -> Any:
    """Join arrays, or those in tuples and lists of them; None stays None."""
    first = parts[0]
    if first is None or isinstance(first, np.ndarray):
        return first if first is None else join(parts)
    each = [_end_to_end(column, join) for column in zip(*parts, strict=True)]
    return each if isinstance(first, list) else type(first)(*each)


def _convert_run(job: VoxelJob, run: BlockRange) -> ConvertedRun:
    """Convert a run of blocks."""
    source, alpha = job.source, job.columns.alpha
    fragments = cut(job.blocks, run)
    # A fragment is read with a footprint of its size, so that a cell's mean covers everything in the cell.
    widths = (np.sqrt(fragments.areas) * job.cell).astype(np.float32)
    values = np.empty((widths.size, 0), np.float32)
    if source is not None:
        values = source.evaluate(fragments.triangles, fragments.barycentric, widths)
    end = 0
    for form, stored in zip(() if source is None else source.channels, job.channels, strict=True):
        start, end = end, end + form.components
        check_range(values[:, start:end], form, stored.dtype, job.name)
    n_entries = int(bit_counts(fragments.flags).sum())
    sums = sum_fragments(fragments.entries, fragments.areas, values, alpha, n_entries)
    leaves = Sums(fragments.codes, fragments.flags, sums)
    codes, filled, gaps = fragments.codes, None, fragments.codes[:0]
    if job.has_gaps:
        form, covered, column = ALPHA, leaves, 0
        if job.coverage is None:
            column = alpha
            form = next((channel for channel in job.channels if channel.name == ALPHA.name), ALPHA)
        else:
            known = job.coverage.evaluate(fragments.triangles, fragments.barycentric, widths)
            sums = sum_fragments(fragments.entries, fragments.areas, known, column, n_entries)
            covered = leaves._replace(sums=sums)
        is_filled = encode(coverages(covered, column), form.dtype, form.space) > 0
        if not is_filled.all():
            codes, gaps = codes[is_filled], codes[~is_filled]
            filled = codes
            if job.has_samples or job.wanted is not None:
                fragments, chosen = _fragments_in(fragments, is_filled)
                widths, values = widths[chosen], values[chosen]
    levels, top = climb(leaves, job.blocks.bits, job.channels, job.columns, filled)
    levels.pop()  # the blocks themselves: in top
    wanted = None if job.wanted is None else deepest_wanted(job.wanted, fragments, widths)
    samples = None
    if job.has_samples and source is not None:
        samples = take_samples(source, job.blocks, fragments, widths, values, job.cell, job.channels, alpha)
    return ConvertedRun(codes, gaps, levels, top, samples, wanted)


def _fragments_in(fragments: Fragments, cells: Bools) -> tuple[Fragments, Bools]:
    """Return the fragments of chosen cells (cells,), and which fragments these are."""
    entries = np.repeat(cells, bit_counts(fragments.flags))
    chosen = entries[fragments.entries]
    return Fragments(
        fragments.codes[cells],
        fragments.flags[cells],
        (np.cumsum(entries, dtype=np.int32) - np.int32(1))[fragments.entries[chosen]],
        fragments.triangles[chosen],
        fragments.barycentric[chosen],
        fragments.areas[chosen],
    ), chosen


def climb(
    sums: Sums,
    steps: int,
    channels: Sequence[ChannelFormat],
    columns: SumColumns,
    codes: Int64s | None = None,
) -> tuple[list[LevelCells], Sums]:
    """Encode a level and the ``steps`` levels above it; return them, and the sums of the last.

    Only the cells with ascending ``codes`` are encoded, and the cells above them; None: all.
    """
    levels = []
    for step in range(steps + 1):
        if step:
            sums = sum_children(sums)
            codes = None if codes is None else distinct(codes >> 3)
        level = sums if codes is None else sums_of(sums, np.searchsorted(sums.codes, codes))
        levels.append(_encoded(level, channels, columns))
    return levels, sums


def _encoded(level: Sums, channels: Sequence[ChannelFormat], columns: SumColumns) -> LevelCells:
    """Encode a level's means; split the cells in which a facing's mean differs from the cell's."""
    means = level_means(level, columns)
    cells, facing_areas = means.two_sided, means.facing_areas

    def encoded(rows: Array) -> list[Array]:
        each = zip(channels, by_channel(rows, channels), strict=True)
        return [encode(values, channel.dtype, channel.space) for channel, values in each]

    values, flags = encoded(means.values), level.flags
    facing_values = [np.empty((0, channel.components), channel.dtype) for channel in channels]
    if len(cells):
        facing_values = encoded(means.facing_values)
        counts = bit_counts(flags[cells]).astype(np.int64)
        owners = np.repeat(cells, counts)
        differs = np.zeros(len(owners), np.bool_)
        for channel, whole, facing in zip(channels, values, facing_values, strict=True):
            differs |= differ(channel, facing, whole[owners])
        is_split = np.logical_or.reduceat(differs, np.cumsum(counts) - counts)
        rows = np.repeat(is_split, counts)
        cells, facing_areas = cells[is_split], facing_areas[rows]
        facing_values = [each[rows] for each in facing_values]
        flags = flags.copy()
        flags[cells] |= SPLIT
    return LevelCells(flags, means.areas, values, facing_areas, facing_values)


def assemble(levels: CellLevels) -> Filled:
    """Build the tree, and lay the parts of each level, and of the samples, end to end.

    This empties the samples' parts, which saves memory. Raises ArgumentError for more cells than can be
    numbered.
    """
    channels = levels.channels
    cells: LevelCells = _end_to_end([part for level in levels.levels for part in level], large.joined)
    split_cells = np.flatnonzero(cells.flags & SPLIT).astype(np.uint32)
    facings = cells.flags[split_cells] & np.uint8(FACING_FLAGS)
    split = SplitTable(split_cells, facings, cells.split_areas)
    codes = large.joined(levels.codes)
    tree = Octree.from_leaves(codes, levels.depth).with_cell_data(cells.flags, cells.areas, split)
    values = {
        form.name: Channel(form, each, rows, np.empty((0, form.components), form.dtype))
        for form, each, rows in zip(channels, cells.values, cells.split_values, strict=True)
    }
    samples = None if levels.samples is None else join(levels.depth, channels, codes, levels.samples)
    if levels.gaps.size:
        _average_transparent(tree, values, levels.gaps)
    if levels.has_gaps and samples is not None:
        samples = _with_means_where_bare(samples, values)
    return Filled(tree, values, samples, levels.wanted, levels.has_gaps)


def _average_transparent(tree: Octree, channels: Mapping[str, Channel], gaps: Int64s) -> None:
    """Recompute, in place, the colours of transparent nodes above gaps, from their children.

    A gap weighs as much as transparent surface, so it has a part in such a node's colour.
    """
    cells = np.flatnonzero(decode(channels[ALPHA.name].values[:, 0], "data") < _TRANSPARENT)
    if not cells.size:
        return
    texture = OctreeTexture(tree, channels, UNIT, np.zeros((2, 3)))
    gaps, codes_of_levels = np.sort(gaps, kind="stable"), []
    for level, (codes, is_node) in enumerate(tree.walk()):
        first, end = np.searchsorted(cells, tree.arrays.level_cells[level : level + 2]).tolist()
        rows = cells[first:end] - tree.arrays.level_cells[level]
        codes, shift = codes[rows[is_node[rows]]], 3 * (tree.max_depth - level)
        begins, ends = np.searchsorted(gaps, [codes << shift, codes + 1 << shift])
        codes_of_levels.append(codes[begins < ends])
    nodes = nodes_at(tree, codes_of_levels)
    for name, channel in channels.items():
        if name != ALPHA.name and nodes.cells.size:
            average(texture, channel, nodes=nodes)


def _with_means_where_bare(samples: Samples, channels: Mapping[str, Channel]) -> Samples:
    """Give samples of alpha 0 the means of their cells: as black they would darken the rim of a gap."""
    columns = np.cumsum([0, *(form.components for form in samples.channels)]).tolist()
    names = [form.name for form in samples.channels]
    bare = np.flatnonzero(samples.values[:, columns[names.index(ALPHA.name)]] == 0)
    cells = np.repeat(np.arange(samples.codes.size), np.diff(samples.firsts))[bare]
    values = large.copied(samples.values)
    for name, first, end in zip(names, columns[:-1], columns[1:], strict=True):
        if name != ALPHA.name:
            finest = channels[name].values[-samples.codes.size :]
            values[bare, first:end] = decode(finest[cells], channels[name].format.space)
    return samples._replace(values=values)


def without_opaque(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Leave out a channel ``alpha`` that is 1 everywhere."""
    alpha = channels[ALPHA.name]
    is_opaque = (alpha.values == ONE[alpha.format.dtype]).all()
    return {name: channel for name, channel in channels.items() if not (is_opaque and name == ALPHA.name)}
