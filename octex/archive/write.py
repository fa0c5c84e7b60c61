"""Write an archive: note what occurs, choose the models, encode; block by block, from mapped arrays."""

from __future__ import annotations

import json
import lzma
import os
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial, reduce
from itertools import chain
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from octex.archive import blocks
from octex.archive.around import ABOUT, OWN, around_children, around_nodes, shapes
from octex.archive.blocks import Content, Span
from octex.archive.coding import STEPS, Coding, numbers_of, order_of, weights_of
from octex.archive.entropy import (
    MEASURES,
    NOTES,
    PLACE,
    encoded_numbers,
    intervals_of,
    new_coder,
    pool_of,
    words_of,
)
from octex.archive.layout import (
    FORMAT,
    FORMAT_VERSION,
    KEPT,
    MAGIC,
    PIECE,
    SPLIT,
    START,
    TREE,
    Block,
    Named,
    blocks_of,
    ends_of,
    first_rows,
    known_names,
    named,
    parts,
)
from octex.archive.models import Models, counting, made, no_counts
from octex.archive.values import code_values
from octex.archive.weights import new_squares, solve
from octex.arrays import Array, Int64s, Uint8s, Uint32s, unlocked, zeros
from octex.files import replacing
from octex.parallel import ordered_map, workers
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree, no_kept, no_split

#: About so many cells of nodes, and of leaves, are looked at to choose weights, so often.
_SAMPLE = 1 << 13
_SAMPLED = 1 << 9  # nodes at a time
_ROUNDS = 6
#: So many bytes of notes are kept until they are encoded.
_MOST_NOTES = 1 << 28


def write(
    path: str | os.PathLike[str],
    tensors: Mapping[str, Array],
    metadata: Mapping[str, str],
    channels: Sequence[str],
    max_error: int = 0,
) -> None:
    """Write a texture's tensors, named as in its render file, and metadata; ``channels`` are their names.

    Values of integer channels may move by ``max_error`` codes; all else comes back bit for bit. The same
    input gives the same bytes. Raises TextureFileError for a tree that is not sound, and OutputError if the
    file cannot be written: then what stood at ``path`` still stands.
    """
    tensors = {name: unlocked(array) for name, array in tensors.items()}
    arrays = TreeArrays(*(tensors[name] for name in TREE))
    split = SplitTable(*(tensors[name] for name in SPLIT)) if SPLIT[0] in tensors else no_split()
    kept = KeptTable(tensors[KEPT]) if KEPT in tensors else no_kept()
    Octree(arrays, split, kept).validate()
    given = {name: named(tensors, name) for name in channels}
    errors = {name: max_error if tensors[f"channels/{name}"].dtype.kind == "u" else 0 for name in channels}
    others = {name: tensors[name] for name in tensors if name not in known_names(tensors, channels)}
    sampled = _sampled(arrays)
    codings = {
        name: _coding(channel, tensors[f"channels/{name}"].dtype.kind == "f", errors[name], sampled)
        for name, channel in given.items()
    }
    decoded = {name: _copied(channel) if errors[name] else channel for name, channel in given.items()}
    content = Content(arrays, split, kept, given, decoded)
    with replacing(path) as file, workers() as executor:
        counts, noted = _noted(content, codings, executor)
        models, numbers = made(counts, codings)
        head = {
            "format": FORMAT,
            "metadata": dict(metadata),
            "level_cells": arrays.level_cells.tolist(),
            "level_nodes": arrays.level_nodes.tolist(),
            "split_cells": np.diff(ends_of(split.cells, arrays.level_cells)).tolist(),
            "split_rows": split.areas.size,
            "kept_nodes": np.diff(ends_of(kept.cells, arrays.level_cells)).tolist(),
            "root": [int(arrays.flags[0]), int(arrays.areas[0])],
            "channels": [
                {
                    "name": name,
                    "dtype": tensors[f"channels/{name}"].dtype.name,
                    "components": given[name].values.shape[1],
                    "max_error": coding.error,
                    "unit": coding.unit,
                    "root": given[name].values[0].tobytes().hex(),
                }
                for name, coding in codings.items()
            ],
            "others": [
                {"name": name, "dtype": array.dtype.name, "shape": list(array.shape)}
                for name, array in others.items()
            ],
        }
        encoded = ordered_map(executor, partial(_encoded, intervals_of(models.pools)), noted)
        _write_file(file, encoded, head, numbers, others)


def _write_file(
    file: BinaryIO,
    encoded: Iterable[Encoded],
    head: dict[str, Any],
    numbers: Int64s,
    others: Mapping[str, Array],
) -> None:
    file.write(bytes(START))
    records: list[int] = []
    for numbers_of_children, streams in chain(encoded, _pieces(others)):
        records += numbers_of_children
        for stream in streams:
            file.write(stream)
            records += [len(stream), zlib.crc32(stream)]
    text = zlib.compress(
        json.dumps(head, ensure_ascii=False, separators=(",", ":")).encode("utf-8", "replace"), 9
    )
    model = numbers.size.to_bytes(4, "little") + encoded_numbers(numbers).astype("<u2").tobytes()
    record = np.array(records, "<u4").tobytes()
    lengths = np.array([len(text), len(model), len(record)], "<u4").tobytes()
    begin = file.tell()
    directory = lengths + text + model + record
    file.write(directory)
    first = MAGIC + np.array([FORMAT_VERSION, len(directory)], "<u4").tobytes() + begin.to_bytes(8, "little")
    first += zlib.crc32(directory).to_bytes(4, "little")
    file.seek(0)
    file.write(first + zlib.crc32(first).to_bytes(4, "little"))
    file.seek(0, os.SEEK_END)


Noted = tuple[list[int], list[Uint32s]]
Encoded = tuple[list[int], list[bytes]]
_Note = tuple["partial[Noted]", "Noted | None"]


def _pieces(others: Mapping[str, Array]) -> Iterator[Encoded]:
    """Yield other tensors, compressed."""
    for array in others.values():
        flat = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        for begin in range(0, flat.size, PIECE):
            yield [], [lzma.compress(flat[begin : begin + PIECE].tobytes(), check=lzma.CHECK_NONE)]


# The weights.


def _sampled(arrays: TreeArrays) -> list[tuple[Span, Uint32s, Int64s]]:
    """Return the children of some nodes, all over the fine levels, and what lies around them."""
    found = []
    for level in range(max(arrays.level_cells.size - 4, 0), arrays.level_cells.size - 2):
        begin, end = int(arrays.level_nodes[level]), int(arrays.level_nodes[level + 1])
        count = min(_SAMPLE // (4 * _SAMPLED), -(-(end - begin) // _SAMPLED))
        for n in range(count):
            first = begin + (end - begin) * n // count
            block = Block(level, first, min(first + _SAMPLED, end))
            cells, nodes = around_nodes(arrays, *block)
            span = _span(arrays, block)
            rows = np.empty((span.end_cell - span.cell, 4), np.uint32)
            around_children(arrays.groups, block.first, block.last, cells, nodes, shapes(), rows)
            found.append((span, rows, cells))
    return found


def _coding(
    channel: Named, is_float: bool, error: int, sampled: list[tuple[Span, Uint32s, Int64s]]
) -> Coding:
    raw = channel.values
    _, components, size = raw.shape
    weights = np.zeros(weights_of(components), np.int64)
    coding = Coding(order_of(components), size, int(is_float), 0, 0, 0, weights)
    if size > 1:  # floats and 16 bits differ by far more steps than 8 bits do
        coding = coding._replace(unit=_unit(raw, coding, sampled))
    pool = pool_of(np.zeros(0, np.uint8), np.zeros((0, 256), np.int64))
    for _ in range(_ROUNDS):
        squares = new_squares(components)
        for span, rows, cells in sampled:
            state = squares, pool, new_coder(MEASURES), np.empty(0, np.uint32)
            code_values(rows, cells, raw, raw, span.cell, coding, STEPS, *state)
        solve(squares, weights)
    return coding._replace(error=error)


def _unit(raw: Uint8s, coding: Coding, sampled: list[tuple[Span, Uint32s, Int64s]]) -> int:
    """Return the unit in which values differ from their parents' by about eight, or none if that is less."""
    usual = []
    for span, rows, cells in sampled:
        node = np.cumsum(np.append(1, rows[:-1, ABOUT] >> 4 & 15 == 1)) - 1
        parents = numbers_of(raw[cells[node, OWN]], coding)
        usual.append(np.abs(numbers_of(raw[span.cell : span.end_cell], coding) - parents).reshape(-1))
    return max(int(np.median(np.concatenate(usual))).bit_length() - 3, 0) if usual else 0


def _copied(channel: Named) -> Named:
    """Return arrays of the same shapes for the values that will be read; the root's are kept."""
    copy = Named(*(zeros(array.size).reshape(array.shape) for array in channel))
    copy.values[0] = channel.values[0]
    return copy


# The blocks.


def _span(arrays: TreeArrays, block: Block) -> Span:
    """Return the first node and cell below a block, and those after its last."""
    node, cell = _first_below(arrays, block.first)
    if block.last < arrays.level_nodes[block.level + 1]:
        return Span(node, cell, *_first_below(arrays, block.last))
    below = block.level + 2
    return Span(node, cell, int(arrays.level_nodes[below]), int(arrays.level_cells[below]))


def _first_below(arrays: TreeArrays, node: int) -> tuple[int, int]:
    nodes, leaves, first = (int(word) for word in arrays.groups[node >> 3])
    below = (1 << 8 * (node & 7)) - 1
    return (
        (first & 0xFFFFFFFF) + (nodes & below).bit_count(),
        (first >> 32) + ((nodes | leaves) & below).bit_count(),
    )


class _Streams:
    """Streams of notes."""

    def __init__(self) -> None:
        self._open: tuple[Int64s, Uint32s]
        self.found: list[Uint32s] = []

    def begin(self, most: int) -> tuple[Int64s, Uint32s]:
        """Return a coder and room for so many notes."""
        self._open = new_coder(NOTES), np.empty(most, np.uint32)
        return self._open

    def end(self) -> None:
        """Keep the notes of a stream."""
        coder, stream = self._open
        self.found.append(stream[: coder[PLACE]].copy())


class _Pass(NamedTuple):
    """What blocks are noted with."""

    content: Content
    models: Callable[[], Models]

    def block(self, block: Block) -> Noted:
        """Note the children of nodes."""
        span, streams = _span(self.content.arrays, block), _Streams()
        blocks.code_children(self.content, self.models(), block, span, streams)
        return [span.end_node - span.node, span.end_cell - span.cell], streams.found

    def split(self, chosen: slice, firsts: Int64s) -> Noted:
        """Note the rows of split cells."""
        streams = _Streams()
        blocks.code_split(self.content, self.models(), chosen, firsts, streams)
        return [], streams.found

    def kept(self, chosen: slice) -> Noted:
        """Note the values of kept nodes."""
        streams = _Streams()
        blocks.code_kept(self.content, self.models(), chosen, streams)
        return [], streams.found

    def tasks(self) -> list[list[partial[Noted]]]:
        """Return what notes all, level by level: the blocks of a level in parallel."""
        arrays, split, kept = self.content.arrays, self.content.split, self.content.kept
        tasks: list[list[partial[Noted]]] = [
            [partial(self.block, block) for block in blocks_of(arrays.level_nodes, level)]
            for level in range(arrays.level_cells.size - 2)
        ]
        firsts = first_rows(split.facings)
        of_split, of_kept = (ends_of(each.cells, arrays.level_cells) for each in (split, kept))
        tasks.append([partial(self.split, part, firsts) for part in parts(of_split)])
        tasks.append([partial(self.kept, part) for part in parts(of_kept)])
        return tasks


def _called(task: partial[Noted]) -> Noted:
    return task()


def _noted(
    content: Content, codings: dict[str, Coding], executor: Executor
) -> tuple[list[Int64s], list[_Note]]:
    """Return how often what occurs, each thread having counts of its own; and the notes of each block.

    Of many, only the first are kept: the others are made anew.
    """
    found: list[list[Int64s]] = []
    here = threading.local()

    def own() -> Models:
        if not hasattr(here, "models"):
            counts = no_counts(codings)
            found.append(counts)
            here.models = counting(counts, codings)
        return here.models  # type: ignore[no-any-return]

    noted: list[_Note] = []
    size = 0
    for level in _Pass(content, own).tasks():
        for task, (numbers, streams) in zip(level, ordered_map(executor, _called, level), strict=True):
            size += sum(stream.nbytes for stream in streams)
            noted.append((task, (numbers, streams) if size <= _MOST_NOTES else None))
    return [reduce(np.add, each) for each in zip(*found or [no_counts(codings)], strict=True)], noted


def _encoded(models: tuple[Uint32s, Uint32s], note: _Note) -> Encoded:
    """Return a block's numbers of children and its streams."""
    task, noted = note
    numbers, streams = noted or task()
    return numbers, [words_of(stream, *models).astype("<u2").tobytes() for stream in streams]
