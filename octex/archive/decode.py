"""Decode an archive whose directory is read: whole, or what is asked for of it."""

from __future__ import annotations

import lzma
import math
import mmap
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import groupby, takewhile
from typing import Any, NamedTuple

import numpy as np

from octex.archive import blocks
from octex.archive.around import around_nodes
from octex.archive.blocks import Content, Span
from octex.archive.coding import Coding
from octex.archive.entropy import decoder, is_whole
from octex.archive.layout import KEPT, PIECE, SPLIT, START, TREE, Block, blocks_of, first_rows, named, parts
from octex.archive.models import Models
from octex.arrays import Array, Bools, Int64s, Uint8s, Uint16s, Uint32s
from octex.parallel import ordered_map, workers
from octex.tree import layout as tree_layout
from octex.tree.layout import FACING_FLAGS, KeptTable, SplitTable, TreeArrays
from octex.tree.octree import no_kept, no_split
from octex.tree.validate import check_layout

#: The most that xz may take.
_MOST_FOR_XZ = 1 << 26
#: The kinds of streams beside the channels, whose names have no such beginning.
_STRUCTURE, AREAS = "\0structure", "\0areas"

#: Is told which bytes of the file, from … to before …, are about to be read.
Fetch = Callable[[Sequence[tuple[int, int]]], None]


class DamagedError(Exception):
    """Say what is wrong, without the file's name."""


class Contents(NamedTuple):
    """What an archive holds."""

    tensors: dict[str, Array]  # named, and ordered, as in a render file
    metadata: dict[str, str]
    sizes: dict[str, int]  # bytes of its streams: structure, areas, each channel …


class _Stream(NamedTuple):
    """Where a stream lies."""

    begin: int
    length: int
    checksum: int

    @property
    def range(self) -> tuple[int, int]:
        """Where it begins and ends."""
        return self.begin, self.begin + self.length


class Head(NamedTuple):
    """What the head of a directory says, checked."""

    metadata: dict[str, str]
    level_cells: Int64s
    level_nodes: Int64s
    split_ends: Int64s  # how many split cells come before each level, and how many there are
    split_rows: int
    kept_ends: Int64s  # likewise of kept nodes
    root: tuple[int, int]  # flags and area
    channels: list[tuple[str, np.dtype[Any], Coding, Uint8s]]  # with the root's value
    others: list[tuple[str, np.dtype[Any], tuple[int, ...]]]


class _Streams:
    """Streams of a block, read one after the other."""

    def __init__(self, content: mmap.mmap, streams: list[_Stream]) -> None:
        self._content = content
        self._left = iter(streams)
        self._stream: _Stream
        self._open: tuple[Int64s, Uint32s]

    def damaged(self) -> DamagedError:
        """Return the error for a stream that is not what was written."""
        return DamagedError(f"its bytes from {self._stream.begin} on are damaged; copy it again")

    def next_bytes(self) -> bytes:
        """Return the next stream's bytes."""
        self._stream = next(self._left)
        found = self._content[self._stream.begin : self._stream.begin + self._stream.length]
        if zlib.crc32(found) != self._stream.checksum:
            raise self.damaged()
        return found

    def begin(self, most: int) -> tuple[Int64s, Uint32s]:  # noqa: ARG002 (for those that write)
        """Return the next stream and its coder."""
        self._open = decoder(words_in(self.next_bytes()))
        return self._open

    def end(self) -> None:
        """Raise for a stream that was not read to its end."""
        if self._stream.length % 2 or not is_whole(*self._open):
            begin = self._stream.begin
            raise DamagedError(f"its bytes from {begin} on make no sense: damaged, or not by octex")


class _Part(NamedTuple):
    """A block of a level, and its streams: structure and flags, areas, each channel."""

    block: Block
    span: Span
    streams: list[_Stream]


class Decoding:
    """The decoding of one archive, whole or in part.

    Of the structure whole levels are decoded, one after the other. Areas and channels are decoded by blocks,
    after the structure around them and what they are guessed from: the cells around their nodes.
    """

    def __init__(
        self,
        content: mmap.mmap,
        fetch: Fetch,
        end: int,
        head: Head,
        models: Models,
        records: Int64s,
        tensors: dict[str, Array],
    ) -> None:
        self._content, self._fetch = content, fetch
        self._end = end  # of the streams
        self._head, self._models, self._tensors = head, models, tensors
        self._records, self._at_record, self._at_byte = records, 0, START
        names = [name for name, *_ in head.channels]
        channels = (f"channel {name}" for name in names)
        self._sizes = dict.fromkeys(("structure and flags", "areas", *channels, "other"), 0)
        self._arrays = TreeArrays(*(tensors[name] for name in TREE))
        self._channels = {name: named(tensors, name) for name in names}
        self._split, self._kept = _tables(head, tensors)
        self.reached = 0  # the level that the structure is decoded to
        self._places = {kind: place for place, kind in enumerate((_STRUCTURE, AREAS, *names))}
        #: How many blocks of split cells, and of kept nodes, are decoded of each kind.
        self._rows_reached = dict.fromkeys((AREAS, *names), (0, 0))
        self._listed = 0  # cells, whose flags are listed in the tables
        self.is_whole = False
        self._begin()
        self._levels = [self._planned(level) for level in range(self.depth)]
        self._parts = [part for level in self._levels for part in level]
        self._first_cells = np.array([part.span.cell for part in self._parts], np.int64)
        #: Which blocks are decoded of each kind.
        self._done = {kind: np.zeros(len(self._parts), np.bool_) for kind in self._rows_reached}
        version, count = models.version, len(names)
        self._of_split = [(part, self._streams(1, 1 + count)) for part in parts(head.split_ends, version)]
        self._of_kept = [(part, self._streams(2, count)) for part in parts(head.kept_ends, version)]
        self._of_others = [(piece, self._streams(len(self._sizes) - 1, 1)) for piece in pieces_of(head)]
        if self._at_byte != end:
            raise DamagedError("has bytes that belong to no block; copy it again")

    @property
    def depth(self) -> int:
        """The deepest level."""
        return self._arrays.level_cells.size - 2

    @property
    def channels(self) -> list[str]:
        """The names of the channels."""
        return list(self._channels)

    @property
    def contents(self) -> Contents:
        """What is decoded, zeros for what is not."""
        sizes = {**self._sizes, "models and directory": len(self._content) - self._end + START}
        return Contents(self._tensors, self._head.metadata, sizes)

    def _begin(self) -> None:
        head, arrays = self._head, self._arrays
        arrays.level_cells[:] = head.level_cells
        arrays.level_nodes[:] = head.level_nodes
        arrays.flags[0], arrays.areas[0] = head.root
        for name, _, _, root in head.channels:
            self._channels[name].values[0] = root
        if arrays.groups.size:
            arrays.groups[0, 2] = 1 << 32 | 1

    def decode_all(self) -> None:
        """Decode what is not decoded yet."""
        if self.is_whole:
            return
        self._fetch([(START, self._end)])
        with workers() as executor:
            if self.reached:
                self._decode_structure(self.depth, executor)
                self._decode_blocks({kind: np.ones_like(done) for kind, done in self._done.items()}, executor)
            else:
                for level in self._levels:
                    self._run([partial(self._children, part) for part in level], executor)
                self.reached = self.depth
                self._list(self.depth)
                self._done = {kind: np.ones_like(done) for kind, done in self._done.items()}
            check_layout(self._arrays, self._split, self._kept)
            for kind in (AREAS, *self._channels):
                self._decode_rows(kind, self.depth, executor)
            pieces = [partial(self._piece, *piece, self._read(own)) for piece, own in self._of_others]
            self._run(pieces, executor)
        self.is_whole = True

    def level_of_split_row(self, row: int) -> int:
        """Return the level of the cell that a split row is of; decodes the structure as far as that."""
        ends = self._head.split_ends
        while True:
            listed = int(np.searchsorted(self._split.cells, self._listed))
            firsts = first_rows(self._split.facings[:listed])
            if row < firsts[-1] or self.reached == self.depth:
                cell = int(np.searchsorted(firsts, row, "right")) - 1
                return min(int(np.searchsorted(ends, cell, "right")) - 1, self.depth)
            self.decode_structure(self.reached + 1)

    def level_of_kept_row(self, row: int) -> int:
        """Return the level of a kept node, by its number among those."""
        return int(np.searchsorted(self._head.kept_ends, row, "right")) - 1

    def decode_rows(self, kind: str, level: int) -> bool:
        """Decode AREAS or a channel of split cells and kept nodes down to a level; as ``decode_cells``."""
        was_more = self.decode_structure(level)
        with workers() as executor:
            return self._decode_rows(kind, level, executor) or was_more

    def _decode_rows(self, kind: str, level: int, executor: Executor) -> bool:
        content, models, place = self._coded, self._models, self._places[kind] - 1
        if models.version < 3 and level < self.depth:
            return False
        split, kept = self._rows_reached[kind]
        firsts = first_rows(self._split.facings)
        of_split = _down_to(level, self._head.split_ends, self._of_split[split:])
        of_kept = [] if kind == AREAS else _down_to(level, self._head.kept_ends, self._of_kept[kept:])
        marked = np.zeros(len(self._parts), np.bool_)
        for cells, parts_of in ((self._split.cells, of_split), (self._kept.cells, of_kept)):
            for part, _ in parts_of:
                self._mark(cells[part].astype(np.int64), marked)
        self._decode_blocks({kind: marked}, executor)
        streams = [own[place] for _, own in of_split] + [own[place - 1] for _, own in of_kept]
        self._fetch([each.range for each in streams])
        tasks: list[Callable[[], None]] = []
        for part, own in of_split:
            task = content, models, part, firsts, self._read([own[place]])
            if kind == AREAS:
                tasks.append(partial(blocks.code_split_areas, *task))
            else:
                tasks.append(partial(blocks.code_split_channel, kind, *task))
        for part, own in of_kept:
            task_of_kept = content, models, part, self._read([own[place - 1]])
            tasks.append(partial(blocks.code_kept_channel, kind, *task_of_kept))
        self._run(tasks, executor)
        self._rows_reached[kind] = split + len(of_split), kept + len(of_kept)
        return bool(tasks)

    def decode_structure(self, level: int) -> bool:
        """Decode structure, flags and tables down to a level; say whether there was anything to do."""
        with workers() as executor:
            return self._decode_structure(level, executor)

    def _decode_structure(self, level: int, executor: Executor) -> bool:
        has_tables = bool(self._split.cells.size or self._kept.cells.size)
        if self._models.version < 3 and has_tables:  # of which blocks are not of one level
            level = self.depth
        todo = self._levels[self.reached : level]
        self._fetch([part.streams[0].range for each in todo for part in each])
        for each in todo:
            self._run([partial(self._one, _STRUCTURE, part) for part in each], executor)
            self.reached += 1
        self._list(self.reached)
        return bool(todo)

    def decode_cells(self, wanted: Mapping[str, Sequence[Int64s]]) -> bool:
        """Decode AREAS and channels of cells, given by their numbers; as ``decode_structure``."""
        marked = {kind: np.zeros(len(self._parts), np.bool_) for kind in wanted}
        deepest = 0
        for kind, cells in wanted.items():
            for each in cells:
                self._mark(each, marked[kind])
                level = int(np.searchsorted(self._arrays.level_cells, each.max(initial=0), "right")) - 1
                deepest = max(deepest, level)
        with workers() as executor:
            was_more = self._decode_structure(deepest, executor)
            return self._decode_blocks(marked, executor) or was_more

    def _mark(self, cells: Int64s, marked: Bools) -> None:
        """Mark the blocks that cells are decoded in; the root is in none, and −1 is no cell."""
        found = np.searchsorted(self._first_cells, cells, "right") - 1
        marked[found[found >= 0]] = True

    def _decode_blocks(self, wanted: Mapping[str, Bools], executor: Executor) -> bool:
        """Decode blocks of AREAS and channels, whose structure is decoded, and what they are guessed from."""
        todo: list[tuple[str, _Part]] = []
        for kind, marked in wanted.items():
            marked &= ~self._done[kind]
            for number in range(marked.size - 1, -1, -1):
                if marked[number]:
                    self._mark(around_nodes(self._arrays, *self._parts[number].block)[0].reshape(-1), marked)
                    marked &= ~self._done[kind]
            todo += [(kind, self._parts[number]) for number in np.flatnonzero(marked)]
        self._fetch([part.streams[self._places[kind]].range for kind, part in todo])
        todo.sort(key=lambda each: each[1].block.level)
        for _, level in groupby(todo, key=lambda each: each[1].block.level):
            self._run([partial(self._one, *each) for each in level], executor)
        for kind, marked in wanted.items():
            self._done[kind] |= marked
        return bool(todo)

    def _children(self, part: _Part) -> None:
        blocks.code_children(self._coded, self._models, part.block, part.span, self._read(part.streams))

    def _one(self, kind: str, part: _Part) -> None:
        """Decode one stream of a block."""
        content, models, (block, span, streams) = self._coded, self._models, part
        around = around_nodes(self._arrays, *block)
        own = self._read([streams[self._places[kind]]])
        if kind == _STRUCTURE:
            blocks.code_nodes(content, models, block, span, around, own)
            return
        rows = blocks.rows_of(content, block, span, around)
        if kind == AREAS:
            blocks.code_areas_of(content, models, span, rows, around, own)
        else:
            blocks.code_channel(kind, content, models, span, rows, around, own)

    def _run(self, tasks: Sequence[Callable[[], None]], executor: Executor) -> None:
        for _ in ordered_map(executor, _call, tasks):
            pass

    def _numbers(self, count: int) -> list[int]:
        found: list[int] = self._records[self._at_record : self._at_record + count].tolist()
        self._at_record += count
        return found

    def _streams(self, first: int, count: int) -> list[_Stream]:
        """Return the next streams of the file; the first is that of the so-manieth of the sizes."""
        found = []
        names = list(self._sizes)
        for n in range(count):
            length, checksum = self._numbers(2)
            found.append(_Stream(self._at_byte, length, checksum))
            self._at_byte += length
            self._sizes[names[first + n]] += length
        if self._at_byte > self._end:
            raise DamagedError("its blocks are longer than the file; copy it again")
        return found

    def _read(self, streams: list[_Stream]) -> _Streams:
        return _Streams(self._content, streams)

    @property
    def _coded(self) -> Content:
        return Content(self._arrays, self._split, self._kept, self._channels, self._channels)

    def _planned(self, level: int) -> list[_Part]:
        """Return what the children of a level's nodes are decoded from."""
        arrays = self._arrays
        found = []
        node, cell = int(arrays.level_nodes[level + 1]), int(arrays.level_cells[level + 1])
        for block in blocks_of(arrays.level_nodes, level, self._models.version):
            nodes, cells = self._numbers(2)
            streams = self._streams(0, 2 + len(self._channels))
            found.append(_Part(block, Span(node, cell, node + nodes, cell + cells), streams))
            node, cell = node + nodes, cell + cells
        if node != arrays.level_nodes[level + 2] or cell != arrays.level_cells[level + 2]:
            raise DamagedError(f"level {level + 1} has not as many cells as its blocks; copy it again")
        return found

    def _list(self, level: int) -> None:
        """List in the tables which cells down to a level are split, or kept nodes, by their flags."""
        head, flags = self._head, self._arrays.flags
        end = int(head.level_cells[level + 1])
        if end == self._listed or (self._models.version < 3 and level < self.depth):
            return
        here, before = slice(self._listed, end), int(np.searchsorted(head.level_cells, self._listed))
        for flag, table, ends in (
            (tree_layout.SPLIT, self._split.cells, head.split_ends),
            (tree_layout.KEPT, self._kept.cells, head.kept_ends),
        ):
            _list_flagged(flags, flag, here, table[int(ends[before]) : int(ends[level + 1])])
        split, count = self._split, int(head.split_ends[level + 1])
        split.facings[:count] = flags[split.cells[:count]] & np.uint8(FACING_FLAGS)
        rows = first_rows(split.facings)[-1]
        if rows > head.split_rows or (level == self.depth and rows < head.split_rows):
            raise DamagedError("its split cells have other rows than its head says; copy it again")
        self._listed = end

    def _piece(self, name: str, begin: int, end: int, streams: _Streams) -> None:
        found = streams.next_bytes()
        try:
            inflate = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_FOR_XZ)
            content = inflate.decompress(found, end - begin + 1)
        except lzma.LZMAError:
            raise streams.damaged() from None
        if len(content) != end - begin or not inflate.eof or inflate.unused_data:
            raise streams.damaged()
        self._tensors[name].reshape(-1).view(np.uint8)[begin:end] = np.frombuffer(content, np.uint8)


def _tables(head: Head, tensors: dict[str, Array]) -> tuple[SplitTable, KeptTable]:
    """Return the tables, of which nothing is listed."""
    split, kept = no_split(), no_kept()
    if head.split_ends[-1]:
        split = SplitTable(*(tensors[name] for name in SPLIT))
    if head.kept_ends[-1]:
        kept = KeptTable(tensors[KEPT])
    for cells in (split.cells, kept.cells):  # it is looked for by bisection what of them is there
        cells[:] = np.iinfo(cells.dtype).max
    return split, kept


def _down_to(
    level: int, ends: Int64s, blocks_left: list[tuple[slice, list[_Stream]]]
) -> list[tuple[slice, list[_Stream]]]:
    """Return the blocks of split cells or kept nodes that end by a level."""
    return list(takewhile(lambda each: each[0].stop <= ends[level + 1], blocks_left))


def _call(task: Callable[[], None]) -> None:
    task()


def _list_flagged(flags: Uint8s, flag: int, here: slice, cells: Uint32s) -> None:
    """Write the cells that have a flag, which must be as many as there is room for."""
    at = 0
    for begin in range(here.start, here.stop, PIECE):
        found = np.flatnonzero(flags[begin : min(begin + PIECE, here.stop)] & np.uint8(flag))
        if at + found.size > cells.size:
            break
        cells[at : at + found.size] = found + begin
        at += found.size
    else:
        if at == cells.size:
            return
    raise DamagedError("its flags mark other cells than its head says; copy it again")


def words_in(stream: bytes) -> Uint16s:
    """Return the words of a stream."""
    return np.frombuffer(stream, "<u2", len(stream) // 2)


def pieces_of(head: Head) -> Iterator[tuple[str, int, int]]:
    """Yield the pieces of other tensors: which, from which byte to which."""
    for name, dtype, shape in head.others:
        size = math.prod(shape) * dtype.itemsize
        for begin in range(0, size, PIECE):
            yield name, begin, min(begin + PIECE, size)
