"""Write an archive: count what occurs, choose the models, encode; block by block, from mapped arrays."""

from __future__ import annotations

import json
import lzma
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import chain
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from octex.archive import values
from octex.archive.areas import code_areas, code_row_areas, linear_areas
from octex.archive.around import SHAPE, around_children, around_nodes, shapes
from octex.archive.entropy import COUNTS, ENCODES, encoded_numbers, new_coder, words_of
from octex.archive.layout import (
    BLOCK,
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
    blocks,
    first_rows,
    known_names,
    named,
    parts,
    room,
)
from octex.archive.models import Counts, Models, made, no_counts, uncounted
from octex.archive.structure import code_structure
from octex.arrays import Array, Int64s, Uint8s, Uint32s
from octex.files import replacing
from octex.parallel import ordered_map, workers
from octex.tree.layout import KeptTable, SplitTable, TreeArrays
from octex.tree.octree import Octree, no_kept, no_split

#: Blocks that one task counts or encodes.
_TOGETHER = 8
#: About so many cells of nodes, and of leaves, are looked at to choose weights.
_SAMPLE = 1 << 14


class _Subject(NamedTuple):
    """What is archived."""

    arrays: TreeArrays
    split: SplitTable
    kept: KeptTable
    channels: dict[str, Named]
    decoded: dict[str, Named]  # as they will be read: the same arrays where nothing may move
    codings: dict[str, values.Coding]
    linear: Int64s
    shapes: Uint8s


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
    arrays = TreeArrays(*(tensors[name] for name in TREE))
    split = SplitTable(*(tensors[name] for name in SPLIT)) if SPLIT[0] in tensors else no_split()
    kept = KeptTable(tensors[KEPT]) if KEPT in tensors else no_kept()
    Octree(arrays, split, kept).validate()
    given = {name: named(tensors, name) for name in channels}
    errors = {name: max_error if tensors[f"channels/{name}"].dtype.kind == "u" else 0 for name in channels}
    others = {name: tensors[name] for name in tensors if name not in known_names(tensors, channels)}
    sampled = _sampled(arrays)
    codings = {
        name: _coding(channel, tensors[f"channels/{name}"].dtype.kind == "f", errors[name], sampled, arrays)
        for name, channel in given.items()
    }
    decoded = {name: _copied(channel) if errors[name] else channel for name, channel in given.items()}
    subject = _Subject(arrays, split, kept, given, decoded, codings, linear_areas(), shapes())
    with replacing(path) as file, workers() as executor:
        counts = _counted(subject, executor)
        models, numbers = made(counts, codings)
        head = {
            "format": FORMAT,
            "metadata": dict(metadata),
            "level_cells": arrays.level_cells.tolist(),
            "level_nodes": arrays.level_nodes.tolist(),
            "split_cells": split.cells.size,
            "split_rows": split.areas.size,
            "kept_nodes": kept.cells.size,
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
        _write_file(file, subject, models, head, numbers, others, executor)


def _write_file(
    file: BinaryIO,
    subject: _Subject,
    models: Models,
    head: dict[str, Any],
    numbers: Int64s,
    others: Mapping[str, Array],
    executor: Executor,
) -> None:
    file.write(bytes(START))
    records: list[int] = []
    encoded = chain.from_iterable(_encoded(subject, models, executor))
    for numbers_of_children, streams in chain(encoded, _pieces(others)):
        records += numbers_of_children
        for stream in streams:
            file.write(stream)
            records += [len(stream), zlib.crc32(stream)]
    text = zlib.compress(
        json.dumps(head, ensure_ascii=False, separators=(",", ":")).encode("utf-8", "replace"), 9
    )
    model = np.append(np.uint32(numbers.size), encoded_numbers(numbers)).astype("<u4").tobytes()
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


Encoded = tuple[list[int], list[bytes]]


def _pieces(others: Mapping[str, Array]) -> Iterator[Encoded]:
    """Yield other tensors, compressed."""
    for array in others.values():
        flat = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        for begin in range(0, flat.size, PIECE):
            yield [], [lzma.compress(flat[begin : begin + PIECE].tobytes(), check=lzma.CHECK_NONE)]


# The weights.


def _sampled(arrays: TreeArrays) -> list[tuple[Block, Int64s]]:
    """Return some blocks, all over the fine levels, and what lies around their children."""
    chosen: list[Block] = []
    for level in range(max(arrays.level_cells.size - 4, 0), arrays.level_cells.size - 2):
        begin, end = int(arrays.level_nodes[level]), int(arrays.level_nodes[level + 1])
        size = BLOCK // 8
        count = min(max(_SAMPLE // (4 * size), 1), -(-(end - begin) // size))
        for n in range(count):
            first = begin + (end - begin) * n // count
            chosen.append(Block(level, first, min(first + size, end)))
    return [(block, _rows(arrays, block)[0]) for block in chosen]


def _coding(
    channel: Named, is_float: bool, error: int, sampled: list[tuple[Block, Int64s]], arrays: TreeArrays
) -> values.Coding:
    _, components, size = channel.values.shape
    order = values.order_of(components)
    none = np.zeros((2 * components * values.CLASSES, values.TERMS), np.int64)
    coding = values.Coding(order, size, int(is_float), error, 0, none)
    terms, found, is_node = [], [], []
    for block, rows in sampled:
        own = np.zeros((len(rows), components, values.TERMS), np.int64)
        differences = np.zeros((len(rows), components), np.int64)
        begin = _children(arrays, block)[1]
        values.gather(rows, channel.values, begin, coding, values.PARTS, own.reshape(-1), differences)
        terms.append(own)
        found.append(differences)
        is_node.append((rows[:, SHAPE] >> 6).astype(np.uint8))
    if not terms:
        return coding
    wanted = np.concatenate(found)
    # Floats and 16 bits differ by far more steps than 8 bits do.
    usual = int(np.median(np.abs(wanted))) if size > 1 else 0
    unit = max(usual.bit_length() - 3, 0)
    weights = values.fitted(np.concatenate(terms), wanted, np.concatenate(is_node), unit)
    return coding._replace(unit=unit, weights=weights)


def _copied(channel: Named) -> Named:
    """Return arrays of the same shapes for the values that will be read; the root's are kept."""
    copy = Named(*(room(array.size).reshape(array.shape) for array in channel))
    copy.values[0] = channel.values[0]
    return copy


# The blocks.


def _children(arrays: TreeArrays, block: Block) -> tuple[int, int, int, int]:
    """Return the first node and cell below a block, and those after its last."""
    node, cell = _first_below(arrays, block.first)
    if block.last < arrays.level_nodes[block.level + 1]:
        return node, cell, *_first_below(arrays, block.last)
    below = block.level + 2
    return node, cell, int(arrays.level_nodes[below]), int(arrays.level_cells[below])


def _first_below(arrays: TreeArrays, node: int) -> tuple[int, int]:
    nodes, leaves, first = (int(word) for word in arrays.groups[node >> 3])
    below = (1 << 8 * (node & 7)) - 1
    return (
        (first & 0xFFFFFFFF) + (nodes & below).bit_count(),
        (first >> 32) + ((nodes | leaves) & below).bit_count(),
    )


def _rows(arrays: TreeArrays, block: Block) -> tuple[Int64s, Int64s, Int64s]:
    """Return what lies around a block's children, and around its nodes."""
    cells, nodes = around_nodes(arrays, *block)
    _, begin, _, end = _children(arrays, block)
    return around_children(arrays.groups, block.first, block.last, cells, nodes, end - begin), cells, nodes


class _Pass(NamedTuple):
    """What blocks are counted or encoded with."""

    subject: _Subject
    models: Models
    work: int

    def stream(self, most: int) -> tuple[Int64s, Uint32s]:
        """Return a coder and room for so many intervals."""
        return new_coder(self.work), np.empty(most if self.work == ENCODES else 0, np.uint32)

    def block(self, block: Block, counts: Counts) -> Encoded:
        """Count or encode the children of nodes."""
        subject, arrays, models = self.subject, self.subject.arrays, self.models
        rows, cells, nodes = _rows(arrays, block)
        node, cell, end_node, end_cell = _children(arrays, block)
        numbers = block.first, block.last, node, cell, end_node, end_cell
        may_be_nodes = block.level + 3 < arrays.level_cells.size
        coder, stream = self.stream(80 * (block.last - block.first))
        state = models.chances.copy(), counts.bits, coder, stream
        code_structure(arrays.groups, arrays.flags, *numbers, may_be_nodes, cells, nodes, *state)
        found = [(coder, stream)]
        coder, stream = self.stream(len(rows))
        tables = models.area_tables, counts.areas, models.areas.starts, models.areas.symbols
        code_areas(rows, arrays.areas, cell, subject.linear, subject.shapes, *tables, coder, stream)
        found.append((coder, stream))
        for name, (coding, own) in models.channels.items():
            coder, stream = self.stream(4 * len(rows) * coding.order.size)
            given, decoded = subject.channels[name].values, subject.decoded[name].values
            symbols = counts.channels[name], own.starts, own.symbols
            values.code_values(rows, given, decoded, cell, coding, values.STEPS, *symbols, coder, stream)
            found.append((coder, stream))
        return [end_node - node, end_cell - cell], self.words(found)

    def rows(self, chosen: slice, firsts: Int64s, counts: Counts) -> Encoded:
        """Count or encode the rows of split cells."""
        subject, models, split = self.subject, self.models, self.subject.split
        cells, facings = split.cells[chosen], split.facings[chosen]
        owners = np.repeat(cells, np.diff(firsts[chosen.start : chosen.stop + 1]))
        first = int(firsts[chosen.start])
        coder, stream = self.stream(owners.size)
        tables = models.area_tables, counts.areas, models.areas.starts, models.areas.symbols
        own = split.areas, first, subject.arrays.areas, subject.linear
        code_row_areas(cells, facings, *own, *tables, coder, stream)
        found = [(coder, stream)]
        for name in models.channels:
            given, decoded = subject.channels[name].split_values, subject.decoded[name].split_values
            found.append(self.values(name, owners, given, decoded, first, values.SPLIT_ROWS, counts))
        return [], self.words(found)

    def kept(self, chosen: slice, counts: Counts) -> Encoded:
        """Count or encode the values of kept nodes."""
        subject, cells = self.subject, self.subject.kept.cells[chosen]
        found = []
        for name in self.models.channels:
            given, decoded = subject.channels[name].kept_values, subject.decoded[name].kept_values
            found.append(self.values(name, cells, given, decoded, chosen.start, values.KEPT_NODES, counts))
        return [], self.words(found)

    def values(
        self,
        name: str,
        owners: Uint32s,
        given: Uint8s,
        decoded: Uint8s,
        first: int,
        kind: int,
        counts: Counts,
    ) -> tuple[Int64s, Uint32s]:
        """Count or encode rows of values by the cells that own them."""
        coding, tables = self.models.channels[name]
        coder, stream = self.stream(4 * owners.size * coding.order.size)
        cells = self.subject.decoded[name].values
        symbols = counts.channels[name], tables.starts, tables.symbols
        task = owners, cells, given, decoded, first, kind, coding, values.STEPS
        values.code_rows(*task, *symbols, coder, stream)
        return coder, stream

    def words(self, found: list[tuple[Int64s, Uint32s]]) -> list[bytes]:
        """Return streams as bytes."""
        return [] if self.work == COUNTS else [words_of(*each).tobytes() for each in found]

    def several(self, each: Sequence[partial[Encoded]]) -> tuple[Counts, list[Encoded]]:
        """Count or encode some blocks."""
        counts = no_counts(self.subject.codings)
        return counts, [one(counts=counts) for one in each]

    def all(self, executor: Executor) -> Iterator[tuple[Counts, list[Encoded]]]:
        """Count or encode all, level by level: those of a level, several at a time, in parallel."""
        arrays, split = self.subject.arrays, self.subject.split
        tasks: list[list[partial[Encoded]]] = [
            [partial(self.block, block) for block in blocks(arrays.level_nodes, level)]
            for level in range(arrays.level_cells.size - 2)
        ]
        firsts = first_rows(split.facings)
        tasks.append([partial(self.rows, part, firsts) for part in parts(split.cells.size)])
        tasks.append([partial(self.kept, part) for part in parts(self.subject.kept.cells.size)])
        for level in tasks:
            some = [level[n : n + _TOGETHER] for n in range(0, len(level), _TOGETHER)]
            yield from ordered_map(executor, self.several, some, window=8)


def _counted(subject: _Subject, executor: Executor) -> Counts:
    counts = no_counts(subject.codings)
    for found, _ in _Pass(subject, uncounted(subject.codings), COUNTS).all(executor):
        counts.add(found)
    return counts


def _encoded(subject: _Subject, models: Models, executor: Executor) -> Iterator[list[Encoded]]:
    for _, found in _Pass(subject, models, ENCODES).all(executor):
        yield found
