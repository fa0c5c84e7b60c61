"""The streams of a block, in order: the same for noting and decoding."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, Protocol

import numpy as np

from octex.archive.areas import area_tables, code_areas, code_row_areas
from octex.archive.around import around_children, around_nodes, shapes
from octex.archive.coding import KEPT_NODES, SPLIT_ROWS, STEPS
from octex.archive.layout import Block, Named
from octex.archive.models import Models
from octex.archive.rows import code_rows
from octex.archive.structure import code_structure, facing_tables
from octex.archive.values import code_values
from octex.arrays import Int64s, Uint8s, Uint32s
from octex.tree.layout import KeptTable, SplitTable, TreeArrays


class Content(NamedTuple):
    """What is archived, or as far as it is decoded."""

    arrays: TreeArrays
    split: SplitTable
    kept: KeptTable
    given: dict[str, Named]
    decoded: dict[str, Named]  # as they will be read: the same arrays where nothing may move


#: Cells (nodes, 7) and nodes (nodes, 6) around the nodes of a block; see `around_nodes`.
Around = tuple[Int64s, Int64s]


class Streams(Protocol):
    """Where streams come from, or go to."""

    def begin(self, most: int) -> tuple[Int64s, Uint32s]:
        """Return the next stream and its coder; ``most`` is how many notes it may have."""

    def end(self) -> None:
        """Take a stream that is done; raises for one that makes no sense."""


@cache
def _fixed() -> tuple[Uint8s, tuple[Uint8s, Uint8s], tuple[Int64s, Uint8s, Uint8s]]:
    return shapes(), facing_tables(), area_tables()


class Span(NamedTuple):
    """The children of a block."""

    node: int
    cell: int
    end_node: int
    end_cell: int


def code_children(content: Content, models: Models, block: Block, span: Span, streams: Streams) -> None:
    """Code the children of nodes: structure and flags, areas, each channel."""
    around = around_nodes(content.arrays, *block)
    code_nodes(content, models, block, span, around, streams)
    rows = rows_of(content, block, span, around)
    code_areas_of(content, models, span, rows, around, streams)
    for name in models.codings:
        code_channel(name, content, models, span, rows, around, streams)


def code_nodes(
    content: Content, models: Models, block: Block, span: Span, around: Around, streams: Streams
) -> None:
    """Code the structure and the flags of the children of nodes."""
    arrays, pools = content.arrays, models.pools
    _, facings, _ = _fixed()
    cells, nodes = around
    may_be_nodes = block.level + 3 < arrays.level_cells.size
    coded = streams.begin(12 * (block.last - block.first))
    own = arrays.groups, arrays.flags, block.first, block.last, *span, may_be_nodes, cells, nodes
    code_structure(*own, models.version > 1, facings, (pools[0], pools[1], pools[2]), *coded)
    streams.end()


def rows_of(content: Content, block: Block, span: Span, around: Around) -> Uint32s:
    """Return what is known of the children of nodes whose structure is decoded."""
    rows = np.empty((span.end_cell - span.cell, 4), np.uint32)
    around_children(content.arrays.groups, block.first, block.last, *around, _fixed()[0], rows)
    return rows


def code_areas_of(
    content: Content, models: Models, span: Span, rows: Uint32s, around: Around, streams: Streams
) -> None:
    """Code the areas of the children of nodes."""
    coded = streams.begin(len(rows))
    code_areas(rows, around[0], content.arrays.areas, span.cell, _fixed()[2], models.pools[3], *coded)
    streams.end()


def code_channel(
    name: str,
    content: Content,
    models: Models,
    span: Span,
    rows: Uint32s,
    around: Around,
    streams: Streams,
) -> None:
    """Code a channel's values of the children of nodes."""
    coding, pool = models.codings[name], models.pool(name)
    coded = streams.begin(len(rows) * (4 * coding.order.size + 1))
    task = content.given[name].values, content.decoded[name].values, span.cell
    code_values(rows, around[0], *task, coding, STEPS, np.empty((0, 0, 0)), pool, *coded)
    streams.end()


def code_split(content: Content, models: Models, chosen: slice, firsts: Int64s, streams: Streams) -> None:
    """Code the rows of split cells: areas, each channel. ``firsts`` are their first rows."""
    code_split_areas(content, models, chosen, firsts, streams)
    for name in models.codings:
        code_split_channel(name, content, models, chosen, firsts, streams)


def code_split_areas(
    content: Content, models: Models, chosen: slice, firsts: Int64s, streams: Streams
) -> None:
    """Code the areas of the rows of split cells."""
    split = content.split
    coded = streams.begin(int(firsts[chosen.stop] - firsts[chosen.start]))
    own = split.facings[chosen], split.areas, int(firsts[chosen.start]), content.arrays.areas
    code_row_areas(split.cells[chosen], *own, _fixed()[2], models.pools[3], *coded)
    streams.end()


def code_split_channel(
    name: str, content: Content, models: Models, chosen: slice, firsts: Int64s, streams: Streams
) -> None:
    """Code a channel's values of the rows of split cells."""
    owners = np.repeat(content.split.cells[chosen], np.diff(firsts[chosen.start : chosen.stop + 1]))
    rows = content.given[name].split_values, content.decoded[name].split_values
    _code_rows(name, content, models, owners, int(firsts[chosen.start]), SPLIT_ROWS, rows, streams)


def code_kept(content: Content, models: Models, chosen: slice, streams: Streams) -> None:
    """Code the values of kept nodes, each channel."""
    for name in models.codings:
        code_kept_channel(name, content, models, chosen, streams)


def code_kept_channel(name: str, content: Content, models: Models, chosen: slice, streams: Streams) -> None:
    """Code a channel's values of kept nodes."""
    rows = content.given[name].kept_values, content.decoded[name].kept_values
    _code_rows(name, content, models, content.kept.cells[chosen], chosen.start, KEPT_NODES, rows, streams)


def _code_rows(
    name: str,
    content: Content,
    models: Models,
    owners: Uint32s,
    first: int,
    kind: int,
    rows: tuple[Uint8s, Uint8s],
    streams: Streams,
) -> None:
    coding = models.codings[name]
    coded = streams.begin(4 * owners.size * coding.order.size)
    task = *rows, first, kind, coding, STEPS, models.pool(name)
    code_rows(owners, content.decoded[name].values, *task, *coded)
    streams.end()
