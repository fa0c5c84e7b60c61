"""The streams of a block, in order: the same for noting and for decoding."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from octex.archive import areas, structure, values
from octex.archive.around import around_children, around_nodes
from octex.archive.entropy import DECODES, Coder, Model, decoder, encoded, is_whole, noter
from octex.archive.layout import AREAS, STRUCTURE, Block, Coding, Content, DamagedError, owners_of
from octex.arrays import Int32s, Uint8s, Uint32s
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT

_AREA_TABLES = areas.area_tables()


def code_block(
    content: Content,
    codings: Mapping[str, Coding],
    block: Block,
    kinds: Sequence[str],
    models: dict[str, Model],
    streams: Iterator[tuple[int, bytes]] | None = None,
) -> list[bytes]:
    """Code streams of a block: STRUCTURE, AREAS, channels, those of ``kinds`` in this order.

    Returns the streams, or decodes those that are given, each with the byte of the file where it begins;
    raises DamagedError for one that makes no sense. ``models`` are what streams have learned in the last
    level of one block. They are copied, or if the block is its level's only one, go on.
    """
    arrays, begin, end, found = content.arrays, block.begin, block.end, []
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
        if streams is None:
            coder = noter(model, _most_notes(kind, codings, block))
        else:
            place, stream = next(streams)
            coder = decoder(model, stream)
        if kind == STRUCTURE:
            places = block.first, block.last, begin.node, begin.cell, end.node, end.cell
            may_be_nodes = block.level + 3 < arrays.level_cells.size
            structure.code_structure(arrays.groups, arrays.flags, *places, may_be_nodes, around, coder)
        elif kind == AREAS:
            areas.code_areas(rows, around, arrays.flags, arrays.areas, begin.cell, _AREA_TABLES, coder)
            row_areas = owners, content.split.areas, begin.row, arrays.areas
            areas.code_row_areas(*row_areas, _AREA_TABLES, coder)
        else:
            _code_channel(content, kind, codings[kind], block, (owners, rows, around), coder)
        if streams is None:
            found.append(encoded(coder))
        elif len(stream) % 4 or not is_whole(coder):
            raise DamagedError(
                f"its bytes from {place} on cannot be decoded: the file is damaged, or octex did not write it"
            )
        elif kind == STRUCTURE:
            _list_flagged(content, block)
    return found


def _new_model(kind: str, codings: Mapping[str, Coding]) -> Model:
    if kind in codings:
        return values.model_of(codings[kind].form)
    return areas.model() if kind == AREAS else structure.model()


def _most_notes(kind: str, codings: Mapping[str, Coding], block: Block) -> int:
    """Return how many notes a stream may have."""
    _, cell, _, row, kept = (after - before for before, after in zip(block.begin, block.end, strict=True))
    if kind == STRUCTURE:
        return structure.MOST * (block.last - block.first)
    if kind == AREAS:
        return cell + row
    form = codings[kind].form
    return (cell + row + kept) * (form.components * (1 if form.size == 1 else 9) + 1)


def _list_flagged(content: Content, block: Block) -> None:
    """List in the tables which cells of a block are split, or kept nodes, by their decoded flags."""
    begin, end, flags = block.begin, block.end, content.arrays.flags
    for flag, cells in (
        (SPLIT, content.split.cells[begin.split : end.split]),
        (KEPT, content.kept.cells[begin.kept : end.kept]),
    ):
        found = np.flatnonzero(flags[begin.cell : end.cell] & np.uint8(flag)) + begin.cell
        if found.size != cells.size:
            raise DamagedError("its blocks and its flags disagree; copy it again")
        cells[:] = found
    own = content.split.cells[begin.split : end.split]
    content.split.facings[begin.split : end.split] = flags[own] & np.uint8(FACING_FLAGS)
    if owners_of(content.split, block).size != end.row - begin.row:
        raise DamagedError("its blocks and its split cells disagree; copy it again")


def _code_channel(
    content: Content,
    name: str,
    coding: Coding,
    block: Block,
    found: tuple[Uint32s, Int32s, Uint32s],
    coder: Coder,
) -> None:
    """Note or decode the values of a channel, those of cells, of rows of split cells, and of kept nodes."""
    form, (owners, rows, around), begin, end = coding.form, found, block.begin, block.end
    given, decoded = content.given[name], content.decoded[name]
    cells, kept = slice(begin.cell, end.cell), slice(begin.kept, end.kept)
    decodes = coder.work == DECODES

    def numbers_of(raw: Uint8s, room: int = 0) -> Uint32s:
        numbers = np.zeros((len(raw) + room, form.components), np.uint32)
        if not decodes:
            numbers[: len(raw)] = values.numbers_of(raw, form)
        return numbers

    def keep(numbers: Uint32s, raw: Uint8s) -> None:
        if decodes or form.error:  # else they are what was given
            values.write_numbers(numbers, raw, form)

    numbers, raw = numbers_of(given.values[cells], 1), decoded.values.reshape(-1)
    values.code_values(rows, around, raw, numbers, form, coding.weights, values.STEPS, coder)
    keep(numbers[:-1], decoded.values[cells])
    for owned, own, theirs, ours, kind in (
        (owners, slice(begin.row, end.row), given.split_values, decoded.split_values, values.SPLIT_ROWS),
        (content.kept.cells[kept], kept, given.kept_values, decoded.kept_values, values.KEPT_NODES),
    ):
        if owned.size:
            numbers, of_cells = numbers_of(theirs[own]), values.numbers_of(decoded.values[owned], form)
            values.code_rows(owned, of_cells, numbers, kind, form, values.STEPS, coder)
            keep(numbers, ours[own])
