"""The streams of a block, in order: the same for noting and for decoding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from octex.archive import areas, structure, values
from octex.archive.around import around_children, around_nodes
from octex.archive.entropy import Coder, Model
from octex.archive.layout import AREAS, STRUCTURE, Block, Coding, Content, Form, owners_of
from octex.arrays import Int32s, Uint8s, Uint32s

_AREA_TABLES = areas.area_tables()


class Streams(Protocol):
    """Where streams come from, or go to."""

    def begin(self, model: Model, most: int) -> Coder:
        """Return the coder of the next stream; ``most`` is how many notes it may have."""

    def end(self) -> None:
        """Take a stream that is done; raises for one that makes no sense."""

    def read(self, numbers: Uint32s, raw: Uint8s, form: Form) -> None:
        """Write values (n, components, size) as whole ``numbers``, unless these are decoded."""

    def write(self, numbers: Uint32s, raw: Uint8s, form: Form) -> None:
        """Write values as they are decoded."""

    def list_flagged(self, content: Content, block: Block) -> None:
        """List a block's split cells and kept nodes, whose flags are coded."""


def code_block(
    content: Content,
    codings: Mapping[str, Coding],
    block: Block,
    kinds: Sequence[str],
    streams: Streams,
    models: dict[str, Model],
) -> None:
    """Code streams of a block: STRUCTURE, AREAS, channels, those of ``kinds`` in this order.

    ``models`` are what streams have learned in the last level of one block. They are copied, or if the block
    is its level's only one, go on.
    """
    arrays, begin, end = content.arrays, block.begin, block.end
    around = around_nodes(arrays, block)
    rows = np.empty((0, 4), np.int32)
    is_only = arrays.level_nodes[block.level : block.level + 2].tolist() == [block.first, block.last]
    for kind in kinds:
        if kind != STRUCTURE and len(rows) == 0:  # once which children there are is known
            rows, owners = np.empty((end.cell - begin.cell, 4), np.int32), owners_of(content.split, block)
            around_children(arrays.groups, block.first, block.last, around, begin.cell, rows)
        model = models.get(kind) or _new_model(kind, codings)
        if is_only:
            models[kind] = model
        else:
            model = Model(model.numbers.copy(), model.odds.copy())
        if kind == STRUCTURE:
            coder = streams.begin(model, structure.MOST * (block.last - block.first))
            places = block.first, block.last, begin.node, begin.cell, end.node, end.cell
            may_be_nodes = block.level + 3 < arrays.level_cells.size
            structure.code_structure(arrays.groups, arrays.flags, *places, may_be_nodes, around, coder)
        elif kind == AREAS:
            coder = streams.begin(model, len(rows) + owners.size)
            areas.code_areas(rows, around, arrays.flags, arrays.areas, begin.cell, _AREA_TABLES, coder)
            row_areas = owners, content.split.areas, begin.row, arrays.areas
            areas.code_row_areas(*row_areas, _AREA_TABLES, coder)
        else:
            count = len(rows) + owners.size + end.kept - begin.kept
            form = codings[kind].form
            coder = streams.begin(model, count * (form.components * (1 if form.size == 1 else 9) + 1))
            _code_channel(content, kind, codings[kind], block, (owners, rows, around), streams, coder)
        streams.end()
        if kind == STRUCTURE:
            streams.list_flagged(content, block)


def _new_model(kind: str, codings: Mapping[str, Coding]) -> Model:
    if kind in codings:
        return values.model_of(codings[kind].form)
    return areas.model() if kind == AREAS else structure.model()


def _code_channel(
    content: Content,
    name: str,
    coding: Coding,
    block: Block,
    found: tuple[Uint32s, Int32s, Uint32s],
    streams: Streams,
    coder: Coder,
) -> None:
    form, (owners, rows, around), begin, end = coding.form, found, block.begin, block.end
    given, decoded = content.given[name], content.decoded[name]
    own = slice(begin.cell, end.cell)
    numbers = np.zeros((len(rows) + 1, form.components), np.uint32)
    streams.read(numbers[:-1], given.values[own], form)
    raw = decoded.values.reshape(-1)
    values.code_values(rows, around, raw, numbers, form, coding.weights, values.STEPS, coder)
    streams.write(numbers[:-1], decoded.values[own], form)
    kept = slice(begin.kept, end.kept)
    for owned, own, theirs, ours, kind in (
        (owners, slice(begin.row, end.row), given.split_values, decoded.split_values, values.SPLIT_ROWS),
        (content.kept.cells[kept], kept, given.kept_values, decoded.kept_values, values.KEPT_NODES),
    ):
        if owned.size:
            numbers = np.zeros((owned.size, form.components), np.uint32)
            streams.read(numbers, theirs[own], form)
            of_cells = values.numbers_of(decoded.values[owned], form)
            values.code_rows(owned, of_cells, numbers, kind, form, values.STEPS, coder)
            streams.write(numbers, ours[own], form)
