"""Codes the streams of a block in order: the same code encodes and decodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from octex.archive import structure, values
from octex.archive.entropy import DECODES, AdaptiveModel, Coder, decoder, encoded, is_whole, new_model, noter
from octex.archive.layout import AREAS, STRUCTURE, Block, CodedArrays, Coding, DamagedError, owners_of
from octex.arrays import Array
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT


def code_block(
    content: CodedArrays,
    codings: Mapping[str, Coding],
    block: Block,
    kinds: Sequence[str],
    models: dict[str, AdaptiveModel],
    streams: Iterator[tuple[int, bytes]] | None = None,
) -> list[bytes]:
    """Code streams of a block: those of ``kinds``, in the order STRUCTURE, AREAS, channels.

    Returns the encoded streams, or decodes ``streams``, each with its first byte in the file; raises
    DamagedError for an invalid one. ``models`` hold the state of streams after the last level of one block.
    They are copied, or continue if the block is the only one of its level.
    """
    arrays, encoded_streams = content.arrays, []
    around = structure.around_nodes(arrays, block)
    rows, owners = np.empty((0, 4), np.int32), np.empty(0, np.uint32)
    is_only = arrays.level_nodes[block.level : block.level + 2].tolist() == [block.first, block.last]
    for kind in kinds:
        if kind != STRUCTURE and not rows.size:  # once the children are decoded
            rows, owners = structure.around_children(arrays, block, around), owners_of(content.split, block)
        contexts, most_notes = _extent(kind, codings, block)
        model = models.get(kind) or new_model(*contexts)
        if is_only:
            models[kind] = model
        else:
            model = AdaptiveModel(model.numbers.copy(), model.odds.copy())
        if streams is None:
            coder = noter(model, most_notes)
        else:
            first_byte, stream = next(streams)
            coder = decoder(model, stream)
        if kind == STRUCTURE:
            structure.code_structure(arrays, block, around, coder)
        elif kind == AREAS:
            values.code_areas(arrays, block.begin.cell, rows, around, coder)
            values.code_row_areas(owners, content.split.areas, block.begin.row, arrays.areas, coder)
        else:
            _code_channel(content, kind, codings[kind], block, (owners, rows, around), coder)
        if streams is None:
            encoded_streams.append(encoded(coder))
        elif len(stream) % 4 or not is_whole(coder):
            raise DamagedError(
                f"its bytes from {first_byte} on cannot be decoded: the file is damaged, or octex did not "
                "write it"
            )
        elif kind == STRUCTURE:
            _list_flagged(content, block)
    return encoded_streams


def _extent(kind: str, codings: Mapping[str, Coding], block: Block) -> tuple[tuple[int, int], int]:
    """Return a stream's numbers of contexts of symbols and of bits, and its largest number of notes."""
    _, cell, _, row, kept = block.counts
    if kind == STRUCTURE:
        return structure.CONTEXTS, structure.MOST * (block.last - block.first)
    if kind == AREAS:
        return values.AREA_CONTEXTS, cell + row
    return values.extent(codings[kind].form, cell + row + kept)


def _list_flagged(content: CodedArrays, block: Block) -> None:
    """List the split cells and kept nodes of a block in the tables, from its decoded flags."""
    begin, end, flags = block.begin, block.end, content.arrays.flags
    for flag, cells in (
        (SPLIT, content.split.cells[begin.split : end.split]),
        (KEPT, content.kept.cells[begin.kept : end.kept]),
    ):
        flagged = np.flatnonzero(flags[begin.cell : end.cell] & np.uint8(flag)) + begin.cell
        if flagged.size != cells.size:
            raise DamagedError("its blocks and its flags disagree; copy it again")
        cells[:] = flagged
    split_cells = content.split.cells[begin.split : end.split]
    content.split.facings[begin.split : end.split] = flags[split_cells] & np.uint8(FACING_FLAGS)
    if owners_of(content.split, block).size != end.row - begin.row:
        raise DamagedError("its blocks and its split cells disagree; copy it again")


def _code_channel(
    content: CodedArrays, name: str, coding: Coding, block: Block, related: tuple[Array, ...], coder: Coder
) -> None:
    """Code the values of a channel: of cells, of rows of split cells, and of kept nodes."""
    form, (owners, rows, around), begin, end = coding.form, related, block.begin, block.end
    decodes, raw = coder.work == DECODES, content.decoded[name].values
    tables = zip(
        (values.CELLS, values.SPLIT_ROWS, values.KEPT_NODES),
        (slice(begin.cell, end.cell), slice(begin.row, end.row), slice(begin.kept, end.kept)),
        (None, owners, content.kept.cells[begin.kept : end.kept]),
        content.original[name],
        content.decoded[name],
        strict=True,
    )
    for kind, rows_here, cells, source, result in tables:
        original = source[rows_here]
        numbers = np.zeros((len(original) + 1, form.components), np.uint32)  # the last row is room
        if not decodes:
            numbers[:-1] = values.numbers_of(original, form)
        if cells is None:
            values.code_values(rows, around, raw.reshape(-1), numbers, form, coding.weights.copy(), coder)
        elif cells.size:
            values.code_rows(cells, values.numbers_of(raw[cells], form), numbers, kind, form, coder)
        if decodes or form.error:  # else they are unchanged
            values.write_numbers(numbers[:-1], result[rows_here], form)
