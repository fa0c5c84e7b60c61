"""Read an archive: the directory, then the blocks of one level after those of the level above."""

from __future__ import annotations

import json
import lzma
import math
import mmap
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from octex.archive import blocks
from octex.archive.blocks import Content, Span
from octex.archive.coding import Coding, order_of, weights_of
from octex.archive.entropy import decoded_numbers, decoder, is_whole
from octex.archive.layout import (
    BLOCKS,
    FORMAT,
    FORMAT_VERSION,
    KEPT,
    MAGIC,
    PIECE,
    SPLIT,
    START,
    TREE,
    blocks_of,
    first_rows,
    named,
    parts,
)
from octex.archive.models import Models, most_numbers
from octex.archive.models import read as read_models
from octex.arrays import Array, Int64s, Uint8s, Uint16s, Uint32s, zeros
from octex.container import without_duplicates
from octex.errors import ArgumentError, TextureFileError
from octex.files import open_file
from octex.parallel import ordered_map, workers
from octex.tree import layout as tree_layout
from octex.tree.layout import FACING_FLAGS, MAX_CELLS, MAX_DEPTH, KeptTable, SplitTable, TreeArrays
from octex.tree.octree import no_kept, no_split
from octex.tree.validate import check_layout

_DTYPES = {"uint8": 1, "uint16": 2, "float16": 2, "float32": 4}
_OTHERS = ("uint", "int", "float")
#: The longest head, in bytes of JSON, and the most that xz may take.
_LONGEST_HEAD = 100_000_000
_MOST_FOR_XZ = 1 << 26
#: Numbers of models that a byte of their stream may say; those of an empty texture have about 1,000.
_MOST_OF_A_BYTE = 1 << 12


class _DamagedError(Exception):
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


class _Head(NamedTuple):
    """What the head of a directory says, checked."""

    metadata: dict[str, str]
    level_cells: Int64s
    level_nodes: Int64s
    split_cells: int
    split_rows: int
    kept_nodes: int
    root: tuple[int, int]  # flags and area
    channels: list[tuple[str, np.dtype[Any], Coding, Uint8s]]  # with the root's value
    others: list[tuple[str, np.dtype[Any], tuple[int, ...]]]


def read(path: str | os.PathLike[str]) -> Contents:
    """Decode an archive into memory, or where it is large into a temporary file that is mapped.

    Every stream is checked by its checksum, and every count. Raises TextureFileError for a file that is
    missing, damaged, no archive, or of a newer version.
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size < START:
                raise _DamagedError("is cut off; copy it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return _decoded(content)
    except OSError as error:
        raise TextureFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (MemoryError, OverflowError):
        raise TextureFileError(f"{path}: needs more memory than there is") from None
    except (_DamagedError, ArgumentError) as error:
        raise TextureFileError(f"{path}: {error}") from error


def _decoded(content: mmap.mmap) -> Contents:
    version, begin, text, model, records = _directory(content)
    try:
        head = _head(json.loads(text, object_pairs_hook=without_duplicates))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise _DamagedError("its head is damaged; copy it again") from None
    _check_records(head, version, records.size)
    by_cell = int(version == 1)
    codings = {name: coding._replace(by_cell=by_cell) for name, _, coding, _ in head.channels}
    try:
        models = read_models(_numbers(model, codings, version), codings, version)
    except ValueError:
        raise _DamagedError("its models are damaged; copy it again") from None
    tensors = _room(head)
    decoding = _Decoding(content, begin, head, models, records, tensors)
    decoding.run()
    sizes = {**decoding.sizes, "models and directory": len(content) - begin + START}
    return Contents(tensors, head.metadata, sizes)


def _directory(content: mmap.mmap) -> tuple[int, int, bytes, bytes, Int64s]:
    """Return the version, where the directory begins, the head's text, the models and the records."""
    first = content[:START]
    if first[:8] != MAGIC:
        raise _DamagedError("is no archive of octex")
    version, length = np.frombuffer(first, "<u4", 2, 8).tolist()
    if zlib.crc32(first[:28]) != int.from_bytes(first[28:], "little"):
        raise _DamagedError("its first bytes are damaged; copy it again")
    if not 1 <= version <= FORMAT_VERSION:
        raise _DamagedError(f"has format version {version}, newer than this octex reads; update octex")
    begin = int.from_bytes(first[16:24], "little")
    if not START <= begin <= len(content) or begin + length != len(content) or length < 12:
        raise _DamagedError(f"has {len(content)} bytes, which is not what it says: cut off; copy it again")
    directory = content[begin:]
    if zlib.crc32(directory) != int.from_bytes(first[24:28], "little"):
        raise _DamagedError("its directory is damaged; copy it again")
    lengths = np.frombuffer(directory, "<u4", 3).tolist()
    if 12 + sum(lengths) != length or lengths[1] < 4 or lengths[1] % 2 or lengths[2] % 4:
        raise _DamagedError("its directory is damaged; copy it again")
    inflate = zlib.decompressobj()
    try:
        text = inflate.decompress(directory[12 : 12 + lengths[0]], _LONGEST_HEAD)
    except zlib.error:
        raise _DamagedError("its head is damaged; copy it again") from None
    if not inflate.eof or inflate.unused_data:
        raise _DamagedError("its head is damaged; copy it again")
    at = 12 + lengths[0]
    model = directory[at : at + lengths[1]]
    return version, begin, text, model, np.frombuffer(directory[at + lengths[1] :], "<u4").astype(np.int64)


def _words(stream: bytes) -> Uint16s:
    return np.frombuffer(stream, "<u2", len(stream) // 2)


def _numbers(model: bytes, codings: dict[str, Coding], version: int) -> Int64s:
    """Return the numbers of the models: how many there are, then their stream."""
    count = int.from_bytes(model[:4], "little")
    if count > min(most_numbers(codings, version), _MOST_OF_A_BYTE * len(model)):
        raise ValueError
    numbers = decoded_numbers(_words(model[4:]), count)
    if numbers is None:
        raise ValueError
    return numbers


def _head(given: Any) -> _Head:
    """Return the head; raises KeyError, TypeError or ValueError for one that no archive has."""
    if given["format"] != FORMAT:
        raise ValueError
    metadata = given["metadata"]
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise TypeError
    level_cells, level_nodes = _wholes(given["level_cells"]), _wholes(given["level_nodes"])
    _check_levels(level_cells, level_nodes)
    split_cells, split_rows, kept_nodes = (
        _whole(given[name], int(level_cells[-1]) * factor)
        for name, factor in (("split_cells", 1), ("split_rows", 6), ("kept_nodes", 1))
    )
    flags, area = (_whole(number, 255) for number in given["root"])
    channels = [_channel(each) for each in given["channels"]]
    others = [_other(each) for each in given["others"]]
    if len({name for name, *_ in channels}) < len(channels) or len({each[0] for each in others}) < len(
        others
    ):
        raise ValueError
    if any(name in (*TREE, *SPLIT, KEPT) for name, *_ in others):
        raise ValueError
    return _Head(
        metadata,
        level_cells,
        level_nodes,
        split_cells,
        split_rows,
        kept_nodes,
        (flags, area),
        channels,
        others,
    )


def _check_levels(cells: Int64s, nodes: Int64s) -> None:
    """Raise ValueError for levels that no tree has, whose blocks could not be told."""
    if not 2 <= cells.size <= MAX_DEPTH + 2 or nodes.size != cells.size or cells[0] or nodes[0]:
        raise ValueError
    own_cells, own_nodes = np.diff(cells), np.diff(nodes)
    is_empty = cells.size == 2 and own_nodes[0] == 1
    if (own_cells < 1).any() or own_cells[0] != 1 or (own_nodes > own_cells).any():
        raise ValueError
    if (own_cells[1:] > 8 * own_nodes[:-1]).any() or (own_nodes[:-1] < 1).any():
        raise ValueError
    if own_nodes[-1] != 0 and not is_empty:
        raise ValueError


def _channel(given: Any) -> tuple[str, np.dtype[Any], Coding, Uint8s]:
    name, dtype = _name(given["name"]), given["dtype"]
    size, components = _DTYPES[dtype], _whole(given["components"], 4)
    error, unit = _whole(given["max_error"], 65535), _whole(given["unit"], 32)
    root = np.frombuffer(bytes.fromhex(given["root"]), np.uint8)
    is_float = dtype.startswith("float")
    if components < 1 or root.size != components * size or (error and is_float) or error >= 1 << 8 * size:
        raise ValueError
    none = np.zeros(weights_of(components), np.int64)
    coding = Coding(order_of(components), size, int(is_float), error, unit, 0, none)
    return name, np.dtype(dtype), coding, root.reshape(components, size)


def _other(given: Any) -> tuple[str, np.dtype[Any], tuple[int, ...]]:
    shape = tuple(_whole(size, 1 << 40) for size in given["shape"])
    dtype = given["dtype"]
    if not isinstance(dtype, str) or not dtype.startswith(_OTHERS) or len(shape) > 8:
        raise ValueError
    found = np.dtype(dtype)
    if math.prod(size or 1 for size in shape) >= 1 << 40 or found.itemsize > 8 or found.kind not in "uif":
        raise ValueError
    return _name(given["name"]), found, shape


def _name(name: Any) -> str:
    if not isinstance(name, str) or not name or name != name.encode(errors="replace").decode():
        raise ValueError
    return name


def _whole(number: Any, most: int) -> int:
    if type(number) is not int or not 0 <= number <= most:
        raise ValueError
    return number


def _wholes(numbers: Any) -> Int64s:
    return np.array([_whole(number, MAX_CELLS) for number in numbers], np.int64)


def _pieces(head: _Head) -> Iterator[tuple[str, int, int]]:
    """Yield the pieces of other tensors: which, from which byte to which."""
    for name, dtype, shape in head.others:
        size = math.prod(shape) * dtype.itemsize
        for begin in range(0, size, PIECE):
            yield name, begin, min(begin + PIECE, size)


def _check_records(head: _Head, version: int, count: int) -> None:
    """Refuse a directory whose records are not as many as the head wants: what is decoded is bounded so."""
    channels = len(head.channels)
    nodes, size = head.level_nodes, BLOCKS[version]
    expected = sum(
        (int(nodes[level + 1]) - 1) // size - int(nodes[level]) // size + 1 for level in range(nodes.size - 2)
    ) * (2 + 2 * (2 + channels))
    expected += -(-head.split_cells // size) * 2 * (1 + channels)
    expected += -(-head.kept_nodes // size) * 2 * channels
    expected += 2 * sum(-(-math.prod(shape) * dtype.itemsize // PIECE) for _, dtype, shape in head.others)
    if count != expected:
        raise _DamagedError("its directory has not as many blocks as its head says; copy it again")


def _room(head: _Head) -> dict[str, Array]:
    """Return tensors of zeros for all that will be decoded, in a render file's order."""
    n_cells, n_nodes = int(head.level_cells[-1]), int(head.level_nodes[-1])
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        TREE[0]: (np.uint64, (-(-n_nodes // 8), 3)),
        TREE[1]: (np.int64, head.level_cells.shape),
        TREE[2]: (np.int64, head.level_nodes.shape),
        TREE[3]: (np.uint8, (n_cells,)),
        TREE[4]: (np.uint8, (n_cells,)),
    }
    if head.split_cells:
        shapes[SPLIT[0]] = np.uint32, (head.split_cells,)
        shapes[SPLIT[1]] = np.uint8, (head.split_cells,)
        shapes[SPLIT[2]] = np.uint8, (head.split_rows,)
    if head.kept_nodes:
        shapes[KEPT] = np.uint32, (head.kept_nodes,)
    for name, dtype, coding, _ in head.channels:
        components = coding.order.size
        shapes[f"channels/{name}"] = dtype, (n_cells, components)
        if head.split_cells:
            shapes[f"split/channels/{name}"] = dtype, (head.split_rows, components)
        if head.kept_nodes:
            shapes[f"kept/channels/{name}"] = dtype, (head.kept_nodes, components)
    for name, dtype, shape in head.others:
        if name in shapes:  # of a channel
            raise _DamagedError("its head is damaged; copy it again")
        shapes[name] = dtype, shape
    sizes = {key: np.dtype(dtype).itemsize * math.prod(shape) for key, (dtype, shape) in shapes.items()}
    content = zeros(sum(size + 63 & -64 for size in sizes.values()))
    tensors: dict[str, Array] = {}
    at = 0
    for key, (dtype, shape) in shapes.items():
        tensors[key] = content[at : at + sizes[key]].view(dtype).reshape(shape)
        at += sizes[key] + 63 & -64
    return tensors


class _Streams:
    """Streams of a block, read one after the other."""

    def __init__(self, content: mmap.mmap, streams: list[_Stream]) -> None:
        self._content = content
        self._left = iter(streams)
        self._stream: _Stream
        self._open: tuple[Int64s, Uint32s]

    def damaged(self) -> _DamagedError:
        """Return the error for a stream that is not what was written."""
        return _DamagedError(f"its bytes from {self._stream.begin} on are damaged; copy it again")

    def next_bytes(self) -> bytes:
        """Return the next stream's bytes."""
        self._stream = next(self._left)
        found = self._content[self._stream.begin : self._stream.begin + self._stream.length]
        if zlib.crc32(found) != self._stream.checksum:
            raise self.damaged()
        return found

    def begin(self, most: int) -> tuple[Int64s, Uint32s]:  # noqa: ARG002 (for those that write)
        """Return the next stream and its coder."""
        self._open = decoder(_words(self.next_bytes()))
        return self._open

    def end(self) -> None:
        """Raise for a stream that was not read to its end."""
        if self._stream.length % 2 or not is_whole(*self._open):
            begin = self._stream.begin
            raise _DamagedError(f"its bytes from {begin} on make no sense: damaged, or not by octex")


class _Decoding:
    """The decoding of one archive."""

    def __init__(
        self,
        content: mmap.mmap,
        end: int,
        head: _Head,
        models: Models,
        records: Int64s,
        tensors: dict[str, Array],
    ) -> None:
        self._content = content
        self._end = end  # of the streams
        self._head = head
        self._models = models
        self._records = records
        self._tensors = tensors
        self._at_record = 0
        channels = (f"channel {name}" for name, *_ in head.channels)
        self.sizes = dict.fromkeys(("structure and flags", "areas", *channels, "other"), 0)
        self._at_byte = START
        self._arrays = TreeArrays(*(tensors[name] for name in TREE))
        self._channels = {name: named(tensors, name) for name, *_ in head.channels}

    def run(self) -> None:
        """Decode everything."""
        head, arrays = self._head, self._arrays
        arrays.level_cells[:] = head.level_cells
        arrays.level_nodes[:] = head.level_nodes
        arrays.flags[0], arrays.areas[0] = head.root
        for name, _, _, root in head.channels:
            self._channels[name].values[0] = root
        if arrays.groups.size:
            arrays.groups[0, 2] = 1 << 32 | 1
        with workers() as executor:
            for level in range(arrays.level_cells.size - 2):
                self._decode(self._level(level), executor)
            split, kept = self._tables()
            check_layout(arrays, split, kept)
            content = self._content_of(split, kept)
            firsts = first_rows(split.facings)
            rows = partial(blocks.code_split, content, self._models)
            kept_values = partial(blocks.code_kept, content, self._models)
            channels = len(self._channels)
            tasks: list[Callable[[], None]] = [
                partial(rows, part, firsts, self._streams(1, 1 + channels))
                for part in parts(split.cells.size, self._models.version)
            ]
            self._decode(tasks, executor)
            tasks = [
                partial(kept_values, part, self._streams(2, channels))
                for part in parts(kept.cells.size, self._models.version)
            ]
            self._decode(tasks, executor)
            tasks = [
                partial(self._piece, *piece, self._streams(len(self.sizes) - 1, 1)) for piece in _pieces(head)
            ]
            self._decode(tasks, executor)
        if self._at_byte != self._end:
            raise _DamagedError("has bytes that belong to no block; copy it again")

    def _decode(self, tasks: Sequence[Callable[[], None]], executor: Executor) -> None:
        for _ in ordered_map(executor, _call, tasks):
            pass

    def _numbers(self, count: int) -> list[int]:
        found: list[int] = self._records[self._at_record : self._at_record + count].tolist()
        self._at_record += count
        return found

    def _streams(self, first: int, count: int) -> _Streams:
        """Return the next streams of the file; the first is that of the so-manieth of ``sizes``."""
        found = []
        names = list(self.sizes)
        for n in range(count):
            length, checksum = self._numbers(2)
            found.append(_Stream(self._at_byte, length, checksum))
            self._at_byte += length
            self.sizes[names[first + n]] += length
        if self._at_byte > self._end:
            raise _DamagedError("its blocks are longer than the file; copy it again")
        return _Streams(self._content, found)

    def _content_of(self, split: SplitTable, kept: KeptTable) -> Content:
        return Content(self._arrays, split, kept, self._channels, self._channels)

    def _level(self, level: int) -> list[Callable[[], None]]:
        """Return what decodes the children of a level's nodes."""
        arrays = self._arrays
        tasks: list[Callable[[], None]] = []
        node, cell = int(arrays.level_nodes[level + 1]), int(arrays.level_cells[level + 1])
        content = self._content_of(no_split(), no_kept())
        for block in blocks_of(arrays.level_nodes, level, self._models.version):
            nodes, cells = self._numbers(2)
            streams = self._streams(0, 2 + len(self._channels))
            span = Span(node, cell, node + nodes, cell + cells)
            tasks.append(partial(blocks.code_children, content, self._models, block, span, streams))
            node, cell = node + nodes, cell + cells
        if node != arrays.level_nodes[level + 2] or cell != arrays.level_cells[level + 2]:
            raise _DamagedError(f"level {level + 1} has not as many cells as its blocks; copy it again")
        return tasks

    def _tables(self) -> tuple[SplitTable, KeptTable]:
        """Return the split table, without areas, and the kept nodes, by the flags."""
        head, tensors, flags = self._head, self._tensors, self._arrays.flags
        split = SplitTable(np.empty(0, np.uint32), np.empty(0, np.uint8), np.empty(0, np.uint8))
        kept = KeptTable(np.empty(0, np.uint32))
        if head.split_cells:
            split = SplitTable(*(tensors[name] for name in SPLIT))
            _list_flagged(flags, tree_layout.SPLIT, split.cells)
            split.facings[:] = flags[split.cells] & np.uint8(FACING_FLAGS)
        if head.kept_nodes:
            kept = KeptTable(tensors[KEPT])
            _list_flagged(flags, tree_layout.KEPT, kept.cells)
        if first_rows(split.facings)[-1] != head.split_rows:
            raise _DamagedError("its split cells have other rows than its head says; copy it again")
        return split, kept

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


def _call(task: Callable[[], None]) -> None:
    task()


def _list_flagged(flags: Uint8s, flag: int, cells: Uint32s) -> None:
    """Write the cells that have a flag, which must be as many as there is room for."""
    at = 0
    for begin in range(0, flags.size, PIECE):
        found = np.flatnonzero(flags[begin : begin + PIECE] & np.uint8(flag))
        if at + found.size > cells.size:
            break
        cells[at : at + found.size] = found + begin
        at += found.size
    else:
        if at == cells.size:
            return
    raise _DamagedError("its flags mark other cells than its head says; copy it again")
