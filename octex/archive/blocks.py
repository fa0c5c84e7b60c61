"""The streams of a block, in order: the same for noting and for decoding."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np

from octex.archive.areas import area_tables, code_areas, code_row_areas
from octex.archive.around import around_children, around_nodes
from octex.archive.coding import KEPT_NODES, SPLIT_ROWS, STEPS
from octex.archive.entropy import Coder
from octex.archive.layout import AREAS, STRUCTURE, Block, Content, owners_of
from octex.archive.models import Models
from octex.archive.structure import code_structure, facing_tables
from octex.archive.values import code_rows, code_values
from octex.arrays import Int64s, Uint32s

_NO_SQUARES = np.empty((0, 0, 0))


class Streams(Protocol):
    """Where streams come from, or go to."""

    def begin(self, most: int) -> Coder:
        """Return the coder of the next stream; ``most`` is how many notes it may have."""

    def end(self) -> None:
        """Take a stream that is done; raises for one that makes no sense."""

    def list_flagged(self, content: Content, block: Block) -> None:
        """List a block's split cells and kept nodes, whose flags are coded."""


@cache
def _fixed() -> tuple[Any, Any]:
    return facing_tables(), area_tables()


def code_block(
    content: Content, models: Models, block: Block, kinds: Sequence[str], streams: Streams
) -> None:
    """Code streams of a block: STRUCTURE, AREAS, channels, those of ``kinds`` in this order."""
    around = around_nodes(content.arrays, block)
    if kinds[0] == STRUCTURE:
        _code_structure(content, models, block, around, streams)
        kinds = kinds[1:]
    if kinds:
        rows = np.empty((block.end.cell - block.begin.cell, 4), np.uint32)
        around_children(content.arrays.groups, block.first, block.last, *around, rows)
        for kind in kinds:
            if kind == AREAS:
                _code_areas(content, models, block, around[0], rows, streams)
            else:
                _code_channel(kind, content, models, block, around[0], rows, streams)


def _code_structure(
    content: Content, models: Models, block: Block, around: tuple[Int64s, Int64s], streams: Streams
) -> None:
    arrays, (begin, end) = content.arrays, (block.begin, block.end)
    may_be_nodes = block.level + 3 < arrays.level_cells.size
    coded = streams.begin(12 * (block.last - block.first))
    places = block.first, block.last, begin.node, begin.cell, end.node, end.cell, may_be_nodes
    pools = models.pools[0], models.pools[1], models.pools[2]
    code_structure(arrays.groups, arrays.flags, *places, *around, _fixed()[0], pools, coded)
    streams.end()
    streams.list_flagged(content, block)


def _code_areas(
    content: Content, models: Models, block: Block, cells: Int64s, rows: Uint32s, streams: Streams
) -> None:
    begin, end = block.begin, block.end
    own, split = content.arrays.areas, content.split
    coded = _fixed()[1], models.pools[3], streams.begin(len(rows) + end.row - begin.row)
    code_areas(rows, cells, content.arrays.flags, own, begin.cell, *coded)
    code_row_areas(owners_of(split, block), split.areas, begin.row, own, *coded)
    streams.end()


def _code_channel(
    name: str,
    content: Content,
    models: Models,
    block: Block,
    cells: Int64s,
    rows: Uint32s,
    streams: Streams,
) -> None:
    given, decoded, coding = content.given[name], content.decoded[name], models.codings[name]
    (begin, end), split = (block.begin, block.end), content.split
    count = len(rows) + end.row - begin.row + end.kept - begin.kept
    coded = models.pool(name), streams.begin(count * (4 * coding.form.components + 1))
    own = rows, cells, given.values, decoded.values, begin.cell, coding, STEPS, _NO_SQUARES
    code_values(*own, *coded)
    owners = owners_of(split, block)
    of_split = owners, decoded.values, given.split_values, decoded.split_values, begin.row, SPLIT_ROWS
    owners = content.kept.cells[begin.kept : end.kept]
    of_kept = owners, decoded.values, given.kept_values, decoded.kept_values, begin.kept, KEPT_NODES
    for task in (of_split, of_kept):
        code_rows(*task, coding, STEPS, *coded)
    streams.end()
