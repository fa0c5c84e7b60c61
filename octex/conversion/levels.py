"""The pass over a surface: the means of all cells, block by block, and the samples of the finest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Int64s, Uint8s, bit_counts, in_runs
from octex.channels import ALPHA, ChannelFormat, check_range, encode
from octex.conversion import large
from octex.conversion.detail import Wanted, deepest_wanted
from octex.conversion.gaps import average_transparent, with_bare_as_means
from octex.conversion.prune import Channels
from octex.conversion.samples import Samples, Taken, join, take_samples
from octex.editing.split import differ
from octex.errors import ArgumentError, ModelError
from octex.parallel import Progress, memory_size, ordered_map
from octex.source.base import Source
from octex.source.surface import Surface
from octex.texture.channel import Channel
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
    some_cells,
    sum_children,
    sum_fragments,
)

#: Bytes of memory that a conversion takes at least for each cell, and for each byte of the cell's values
#: (measured at its peak: 27 bytes for 3 of values, 41 for 11, 113 for 44); and with samples more for each
#: (58 bytes for 3).
CELL_MEMORY, VALUE_MEMORY = 18, 2
SAMPLE_MEMORY, SAMPLE_VALUE_MEMORY = 28, 2

#: So few blocks are cut into those of 8³ cells, of which only those are converted that are reached.
_FEW_BLOCKS, _SMALL_BITS = 1024, 3

#: Files of parts that are joined to one.
_JOINED = 16


class LevelCells(NamedTuple):
    """What is kept of one level's cells: means, encoded."""

    flags: Uint8s  # normal flags, and SPLIT
    areas: Uint8s
    values: list[Array]  # one array (cells, components) for each channel
    split_areas: Uint8s  # a row for each facing
    split_values: list[Array]


class Part(NamedTuple):
    """A run of blocks, converted."""

    codes: Int64s  # of the leaves
    gaps: Int64s  # of the cells that were left out
    levels: list[LevelCells]  # from the leaves' level up to below the blocks' own
    top: Sums  # of the blocks themselves
    taken: Taken | None
    wanted: Uint8s | None  # (leaves,)   the levels wanted there


class CellLevels(NamedTuple):
    """A surface, converted level by level."""

    channels: tuple[ChannelFormat, ...]  # as they are stored
    depth: int
    codes: list[Int64s]  # of the finest cells, in parts
    levels: list[list[LevelCells]]  # from the root down, each in parts
    taken: list[Taken] | None  # samples in the finest cells, in parts
    wanted: Uint8s | None  # (finest cells,)   the levels wanted there
    degenerate: int  # triangles without area
    has_gaps: bool
    gaps: Int64s  # finest cells in what was left out

    @property
    def n_leaves(self) -> int:
        """The number of finest cells."""
        return sum(map(len, self.codes))


class Filled(NamedTuple):
    """A tree all of whose leaves are of one level, filled."""

    tree: Octree
    channels: Channels  # means
    samples: Samples | None
    wanted: Uint8s | None  # (leaves,)   the levels wanted there
    has_gaps: bool  # whether cells of the surface may be missing


class Job(NamedTuple):
    """All that a task needs."""

    name: str  # of the surface
    source: Source | None
    channels: tuple[ChannelFormat, ...]  # as they are stored
    columns: SumColumns
    blocks: Blocks
    cell: float  # edge of a leaf in rest units
    has_samples: bool
    has_gaps: bool
    coverage: Source | None  # says where gaps are; None: alpha does
    wanted: Wanted | None

    @property
    def depth(self) -> int:
        """The level of the leaves."""
        return self.blocks.level + self.blocks.bits


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
    ``root`` has the triangles that count; by default all of the surface. What lies in blocks that are not
    ``reached`` is left out, and does not count for cells above these; but one block there always is. Cells
    that are gaps of the source alone are left out too, and do count.

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
    least, per_cell = _least_cells(area, depth), _cell_memory(channels, has_samples)
    if least > min(MAX_CELLS, math.inf if large.is_mapped() else memory_size() / per_cell):
        raise ArgumentError(
            f"depth {depth} needs about {least:.2g} cells for {surface.name}, more than fit into memory "
            "or can be numbered; use a smaller depth or a larger cell"
        )
    report("sort", 0, 1)
    blocks = divided(root, reached=reached)
    report("sort", 1, 1)
    columns, outside = SumColumns.of(channels), None
    has_gaps = source is not None and source.has_gaps
    coverage = source.only([]) if source is not None and has_gaps and not source.alpha_is_coverage else None
    if reached is not None and blocks.level and blocks.codes.size <= _FEW_BLOCKS:
        coarse, smaller = blocks, divided(blocks, _SMALL_BITS)
        is_reached = reached(smaller)
        blocks = smaller.some(is_reached)
        outside = _outside(coarse.of_cells(blocks.level), ~is_reached, columns) if has_gaps else None
    for each in (source, coverage):
        if each is not None:
            each.prepare()
    cell = placement.size / 2**depth
    job = Job(
        surface.name, source, channels, columns, blocks, cell, has_samples, has_gaps, coverage, wanted
    )  # fmt: skip
    runs = even_runs(most_fragments(blocks))
    converted = ordered_map(executor, partial(_convert_run, job), runs, stage="convert", progress=report)
    parts = _gathered(converted)
    gaps = np.concatenate([part.gaps for part in parts])
    tops = _end_to_end([part.top for part in parts], np.concatenate)
    if outside is not None:
        gaps = np.concatenate([gaps, outside.codes << 3 * blocks.bits])
        tops = _interleaved(tops, outside)
    codes = [part.codes for part in parts]  # joined later: a source of pictures takes much of the memory here
    left = np.concatenate([distinct(each >> 3 * blocks.bits) for each in codes]) if gaps.size else None
    upper, _ = climb(tops, blocks.level, channels, columns, left)
    levels = [[stored] for stored in reversed(upper)]
    levels += ([part.levels[step] for part in parts] for step in reversed(range(len(parts[0].levels))))
    taken = [part.taken for part in parts if part.taken is not None] if has_samples else None
    levels_wanted = [part.wanted for part in parts if part.wanted is not None]
    deepest = np.concatenate(levels_wanted) if wanted is not None else None
    return CellLevels(channels, depth, codes, levels, taken, deepest, degenerate, has_gaps, gaps)


def _outside(blocks: Blocks, chosen: Bools, columns: SumColumns) -> Sums:
    """Return the sums of some cells in blocks, of all that the surface meets; nothing is known of them."""
    run = BlockRange(0, blocks.codes.size, int(most_fragments(blocks).sum()))
    pieces, _ = _some_fragments(cut(blocks, run), chosen)
    values = np.zeros((pieces.entries.size, columns.first.size), np.float32)
    n_entries = int(bit_counts(pieces.flags).sum())
    sums = sum_fragments(pieces.entries, pieces.areas, values, columns.alpha, n_entries)
    return Sums(pieces.codes, pieces.flags, sums)


def _interleaved(one: Sums, other: Sums) -> Sums:
    """Return the sums of two sets of cells that have none in common."""
    codes, flags, sums = _end_to_end([one, other], np.concatenate)
    counts = bit_counts(flags).astype(np.int64)
    order = np.argsort(codes, kind="stable")
    rows = in_runs((np.cumsum(counts) - counts)[order], counts[order])
    return Sums(codes[order], flags[order], sums[rows])


def memory_needed(
    surface: Surface,
    channels: tuple[ChannelFormat, ...],
    placement: Placement,
    depth: int,
    *,
    has_samples: bool,
) -> float:
    """Return how many bytes of memory a conversion takes at least."""
    _, faces = count_degenerate(on_grid(surface.rest, placement), surface.triangles)
    return _least_cells(faces, depth) * _cell_memory(channels, has_samples)


def _least_cells(faces: float, depth: int) -> float:
    """Bound the cells that a surface meets from below: as many as its area, in square grid steps, has faces.

    It meets fewer only if it is folded within them.
    """
    return float(min(faces * 4.0 ** (depth - GRID_BITS), 8.0**depth))


def _cell_memory(channels: tuple[ChannelFormat, ...], has_samples: bool) -> int:
    """Return how many bytes of memory a conversion takes for each cell."""
    row = sum(channel.components * np.dtype(channel.dtype).itemsize for channel in channels)
    per_sample = SAMPLE_MEMORY + SAMPLE_VALUE_MEMORY * row if has_samples else 0
    return CELL_MEMORY + VALUE_MEMORY * row + per_sample


def _gathered(parts: Iterable[Part]) -> list[Part]:
    """Return all parts; where they come as files, many are joined, as each keeps its file open."""
    if not large.is_mapped():
        return list(parts)
    found, some = [], []
    for part in parts:
        some.append(part)
        if len(some) == _JOINED:
            found.append(large.moved(_end_to_end(some, np.concatenate)))
            some = []
    return found + some


def _end_to_end(parts: Sequence[Any], join: Callable[[Sequence[Array]], Array]) -> Any:
    """Join arrays that follow one another, or those in tuples and lists of them; None stays None."""
    first = parts[0]
    if first is None or isinstance(first, np.ndarray):
        return first if first is None else join(parts)
    each = [_end_to_end(some, join) for some in zip(*parts, strict=True)]
    return each if isinstance(first, list) else type(first)(*each)


def _convert_run(job: Job, run: BlockRange) -> Part:
    """Convert a run of blocks."""
    source = job.source
    fragments = cut(job.blocks, run)
    # A fragment is read with a footprint of its own size: a cell's mean is then that of all that lies in it.
    widths = (np.sqrt(fragments.areas) * job.cell).astype(np.float32)
    values = np.empty((widths.size, 0), np.float32)
    if source is not None:
        values = source.evaluate(fragments.triangles, fragments.barycentric, widths)
    end = 0
    for given, stored in zip(() if source is None else source.channels, job.channels, strict=True):
        start, end = end, end + given.components
        check_range(values[:, start:end], given, stored.dtype, job.name)
    n_entries = int(bit_counts(fragments.flags).sum())
    sums = sum_fragments(fragments.entries, fragments.areas, values, job.columns.alpha, n_entries)
    leaves = Sums(fragments.codes, fragments.flags, sums)
    codes, left, gaps = fragments.codes, None, fragments.codes[:0]
    if job.has_gaps:
        form = next((channel for channel in job.channels if channel.name == ALPHA.name), ALPHA)
        covered, alpha = leaves, job.columns.alpha
        if job.coverage is not None:
            form, alpha = ALPHA, 0
            known = job.coverage.evaluate(fragments.triangles, fragments.barycentric, widths)
            sums = sum_fragments(fragments.entries, fragments.areas, known, alpha, n_entries)
            covered = leaves._replace(sums=sums)
        is_left = encode(coverages(covered, alpha), form.dtype, form.space) > 0
        if not is_left.all():
            codes, gaps = codes[is_left], codes[~is_left]
            left = codes
            if job.has_samples or job.wanted is not None:
                fragments, chosen = _some_fragments(fragments, is_left)
                widths, values = widths[chosen], values[chosen]
    levels, top = climb(leaves, job.blocks.bits, job.channels, job.columns, left)
    levels.pop()  # the blocks themselves: in top
    wanted = None if job.wanted is None else deepest_wanted(job.wanted, fragments, widths)
    taken = None
    if job.has_samples and source is not None:
        taken = take_samples(
            source, job.blocks, fragments, widths, values, job.cell, job.channels, job.columns.alpha
        )
    return Part(codes, gaps, levels, top, taken, wanted)


def _some_fragments(fragments: Fragments, cells: Bools) -> tuple[Fragments, Bools]:
    """Return the fragments of some cells, and say which they are."""
    owned = np.repeat(cells, bit_counts(fragments.flags))
    chosen = owned[fragments.entries]
    some = Fragments(
        fragments.codes[cells],
        fragments.flags[cells],
        (np.cumsum(owned, dtype=np.int32) - np.int32(1))[fragments.entries[chosen]],
        fragments.triangles[chosen],
        fragments.barycentric[chosen],
        fragments.areas[chosen],
    )
    return some, chosen


def climb(
    sums: Sums,
    steps: int,
    channels: Sequence[ChannelFormat],
    columns: SumColumns,
    left: Int64s | None = None,
) -> tuple[list[LevelCells], Sums]:
    """Store a level and the ``steps`` levels above it; return them, and the sums of the last.

    ``left`` are the codes, ascending, of the cells that are stored, with those above them; None: of all.
    """
    levels = [sums if left is None else some_cells(sums, left)]
    for _ in range(steps):
        sums = sum_children(sums)
        left = None if left is None else distinct(left >> 3)
        levels.append(sums if left is None else some_cells(sums, left))
    finest, *above = levels  # the others are encoded at once: a call takes as long as some hundred cells
    return [_stored(finest, channels, columns), *_stored_levels(above, channels, columns)], sums


def _stored(level: Sums, channels: Sequence[ChannelFormat], columns: SumColumns) -> LevelCells:
    """Encode a level's means; split the cells whose facings show something else than the whole."""
    means = level_means(level, columns)
    cells, facing_areas = means.two_sided, means.facing_areas
    values = [
        encode(each, channel.dtype, channel.space)
        for channel, each in zip(channels, by_channel(means.values, channels), strict=True)
    ]
    facing_values = [np.empty((0, channel.components), channel.dtype) for channel in channels]
    flags = level.flags
    if len(cells):
        facing_values = [
            encode(each, channel.dtype, channel.space)
            for channel, each in zip(channels, by_channel(means.facing_values, channels), strict=True)
        ]
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


def _stored_levels(
    levels: Sequence[Sums], channels: Sequence[ChannelFormat], columns: SumColumns
) -> Iterator[LevelCells]:
    """Encode the means of several levels together."""
    if not levels:
        return
    flags, areas, values, split_areas, split_values = _stored(
        Sums(*map(np.concatenate, zip(*levels, strict=True))), channels, columns
    )
    rows = np.cumsum(np.where(flags & SPLIT, bit_counts(flags & np.uint8(FACING_FLAGS)), 0))
    cell = row = 0
    for level in levels:
        own = slice(cell, cell := cell + level.codes.size)
        split = slice(row, row := int(rows[cell - 1]) if cell else 0)
        yield LevelCells(
            flags[own], areas[own], [each[own] for each in values],
            split_areas[split], [each[split] for each in split_values],
        )  # fmt: skip


def assemble(filled: CellLevels) -> Filled:
    """Build the tree, and lay the parts of each level, and of the samples, end to end; they are given up.

    Raises ArgumentError for more cells than can be numbered.
    """
    channels = filled.channels
    cells: LevelCells = _end_to_end([part for level in filled.levels for part in level], large.joined)
    split_cells = np.flatnonzero(cells.flags & SPLIT).astype(np.uint32)
    facings = cells.flags[split_cells] & np.uint8(FACING_FLAGS)
    split = SplitTable(split_cells, facings, cells.split_areas)
    codes = large.joined(filled.codes)
    tree = Octree.from_leaves(codes, filled.depth).with_cell_data(cells.flags, cells.areas, split)
    values = {
        form.name: Channel(form, own, rows, np.empty((0, form.components), form.dtype))
        for form, own, rows in zip(channels, cells.values, cells.split_values, strict=True)
    }
    samples = None if filled.taken is None else join(filled.depth, channels, codes, filled.taken)
    if filled.gaps.size:
        average_transparent(tree, values, filled.gaps)
    if filled.has_gaps and samples is not None:
        samples = with_bare_as_means(samples, values)
    return Filled(tree, values, samples, filled.wanted, filled.has_gaps)


def is_degenerate(surface: Surface, placement: Placement) -> bool:
    """Say whether a surface has no area in a root cell, so that there is nothing to convert."""
    count, _ = count_degenerate(on_grid(surface.rest, placement), surface.triangles)
    return count == len(surface.triangles)
