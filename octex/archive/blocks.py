"""The streams of a block, in order: the same for noting and decoding."""

from __future__ import annotations

from collections.abc import Callable
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
    arrays, pools = content.arrays, models.pools
    shape_of, facings, areas = _fixed()
    cells, nodes = around_nodes(arrays, *block)
    may_be_nodes = block.level + 3 < arrays.level_cells.size
    coded = streams.begin(12 * (block.last - block.first))
    own = arrays.groups, arrays.flags, block.first, block.last, *span, may_be_nodes, cells, nodes
    code_structure(*own, models.version > 1, facings, (pools[0], pools[1], pools[2]), *coded)
    streams.end()
    rows = np.empty((span.end_cell - span.cell, 4), np.uint32)
    around_children(arrays.groups, block.first, block.last, cells, nodes, shape_of, rows)
    coded = streams.begin(len(rows))
    code_areas(rows, cells, arrays.areas, span.cell, areas, pools[3], *coded)
    streams.end()
    for (name, coding), pool in zip(models.codings.items(), pools[4:], strict=True):
        coded = streams.begin(len(rows) * (4 * coding.order.size + 1))
        task = content.given[name].values, content.decoded[name].values, span.cell
        none = np.empty((0, 0, 0))
        code_values(rows, cells, *task, coding, STEPS, none, pool, *coded)
        streams.end()


def code_split(content: Content, models: Models, chosen: slice, firsts: Int64s, streams: Streams) -> None:
    """Code the rows of split cells: areas, each channel. ``firsts`` are their first rows."""
    split = content.split
    cells, first = split.cells[chosen], int(firsts[chosen.start])
    owners = np.repeat(cells, np.diff(firsts[chosen.start : chosen.stop + 1]))
    coded = streams.begin(owners.size)
    own = split.facings[chosen], split.areas, first, content.arrays.areas
    code_row_areas(cells, *own, _fixed()[2], models.pools[3], *coded)
    streams.end()
    _code_rows(content, models, owners, first, SPLIT_ROWS, lambda each: each.split_values, streams)


def code_kept(content: Content, models: Models, chosen: slice, streams: Streams) -> None:
    """Code the values of kept nodes, each channel."""
    cells = content.kept.cells[chosen]
    _code_rows(content, models, cells, chosen.start, KEPT_NODES, lambda each: each.kept_values, streams)


def _code_rows(
    content: Content,
    models: Models,
    owners: Uint32s,
    first: int,
    kind: int,
    rows_of: Callable[[Named], Uint8s],
    streams: Streams,
) -> None:
    for (name, coding), pool in zip(models.codings.items(), models.pools[4:], strict=True):
        coded = streams.begin(4 * owners.size * coding.order.size)
        given, decoded = content.given[name], content.decoded[name]
        task = rows_of(given), rows_of(decoded), first, kind, coding, STEPS, pool
        code_rows(owners, decoded.values, *task, *coded)
        streams.end()
