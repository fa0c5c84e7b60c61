"""Decodes an archive, whole or in part."""

from __future__ import annotations

import lzma
import math
import mmap
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np

from octex import container
from octex.archive.blocks import code_block
from octex.archive.entropy import AdaptiveModel
from octex.archive.layout import (
    AREAS,
    BLOCK,
    CLASSES,
    FORMAT_VERSION,
    MAGIC,
    PIECE,
    START,
    STRUCTURE,
    TERMS,
    TREE_NAMES,
    WEIGHT_BITS,
    Block,
    ChannelBytes,
    CodedArrays,
    Coding,
    DamagedError,
    Form,
    Place,
    after_root,
    channels_in,
    coded_arrays,
    known_names,
    pieces_of,
    root_arrays,
    runs,
)
from octex.archive.structure import OWN, around_nodes
from octex.arrays import Array, Bools, Int64s, zeros
from octex.channels import ONE
from octex.errors import ArgumentError, TextureFileError
from octex.files import open_file
from octex.parallel import ordered_map, workers
from octex.tree.layout import FACING_FLAGS
from octex.tree.validate import check_layout

#: The longest directory, and most memory of its decompression, in bytes.
_LONGEST, _MOST_FOR_XZ = 1 << 28, 1 << 26
_TRUNCATED = "is truncated; copy it again"
_BAD_DIRECTORY = "its directory is damaged; copy it again"

#: Called with ranges of the file's bytes, begin and end, before they are read.
Fetch = Callable[[Sequence[tuple[int, int]]], object]


class Decoded(NamedTuple):
    """The content of an archive."""

    tensors: dict[str, Array]  # named, and ordered, as in a render file
    metadata: dict[str, str]
    sizes: dict[str, int]  # bytes of its streams: structure, areas, each channel …


class _StreamPlace(NamedTuple):
    """A stream's place in the file."""

    begin: int
    length: int
    checksum: int

    def read(self, content: mmap.mmap) -> bytes:
        """Return its bytes."""
        stream = content[self.begin : self.begin + self.length]
        if zlib.crc32(stream) != self.checksum:
            raise self.damaged()
        return stream

    def damaged(self) -> DamagedError:
        """Return the error for wrong bytes."""
        return DamagedError(f"its bytes from {self.begin} on are damaged; copy it again")


#: A block, and where its streams lie.
_Part = tuple[Block, dict[str, _StreamPlace]]


@contextmanager
def naming(place: object) -> Iterator[None]:
    """Raise TextureFileError, with the file's name, for one that cannot be read."""
    try:
        yield
    except OSError as error:
        raise TextureFileError(f"{place}: cannot be read: {error.strerror or error}") from error
    except (MemoryError, OverflowError):
        raise TextureFileError(f"{place}: does not fit into memory") from None
    except (DamagedError, ArgumentError) as error:
        raise TextureFileError(f"{place}: {error}") from error


def read(path: str | os.PathLike[str]) -> Decoded:
    """Decode an archive into memory, or a large one into a mapped temporary file.

    Every stream's checksum and every count is checked. Raises TextureFileError for a file that is missing,
    damaged, no archive, or of another version.
    """
    with naming(path), open_file(path) as file:
        if os.fstat(file.fileno()).st_size < START:
            raise DamagedError(_TRUNCATED)
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            decoding = Decoding(content)
            decoding.decode_all()
            return decoding.contents


class Decoding:
    """The decoding of one archive, whole or in part: each block's stream after the levels above it.

    ``fetch`` is called with the ranges of ``content`` before they are read. Raises DamagedError, as its
    methods do.
    """

    def __init__(self, content: mmap.mmap, fetch: Fetch = lambda _ranges: None) -> None:
        self._content, self._fetch = content, fetch
        self._models: dict[str, AdaptiveModel] = {}
        #: Where the streams end.
        self._end, header, root, records = _directory(content, fetch)
        try:
            self._open(header, root, records)
        except (LookupError, TypeError, ValueError, OverflowError, RecursionError, TextureFileError):
            raise DamagedError(_BAD_DIRECTORY) from None
        self._at_byte = START
        self._kinds = STRUCTURE, AREAS, *self.channels
        self._parts = list(self._planned())
        sizes = {name: array.nbytes for name, array in self._tensors.items()}
        self._others = [(*piece, self._stream()) for piece in pieces_of(sizes, self.channels)]
        if self._at_byte != self._end:
            raise DamagedError("has bytes outside of all blocks; copy it again")
        #: The number of rows of each table before each block.
        begins = np.array([block.begin for block, _ in self._parts], np.int64).reshape(-1, len(Place._fields))
        self._firsts = dict(zip(Place._fields, begins.T.copy(), strict=True))
        #: Which blocks are decoded of each kind.
        self._done = {kind: np.zeros(len(self._parts), np.bool_) for kind in self._kinds}
        self.is_whole = False

    def _open(self, header: bytes, root: bytes, records: bytes) -> None:
        """Allocate the described arrays; raises errors for impossible ones."""
        entries, self._metadata, size = container.described(header)
        channels, numbers = channels_in(self._metadata), np.frombuffer(records, "<u4").tolist()
        at = 0

        def take(count: int, dtype: str) -> Array:
            nonlocal at
            numbers = np.frombuffer(root, dtype, count, at)
            at += numbers.nbytes
            return numbers

        levels = [take(math.prod(entries[name].shape), "<i8") for name in TREE_NAMES[1:3]]
        _check_records(entries, channels, levels, len(numbers))
        room = zeros(size)
        self._tensors = {name: container.view(room, entry) for name, entry in entries.items()}
        for name, level in zip(TREE_NAMES[1:3], levels, strict=True):
            self._tensors[name][:] = level
        self._records, self._coded = iter(numbers), coded_arrays(self._tensors, channels)
        arrays, split, kept, original, _ = self._coded
        check_layout(arrays, split, kept)
        self._codings: dict[str, Coding] = {}
        for name, channel in original.items():
            error, unit = take(2, "<u4").tolist()
            form = _form(channel, entries[f"channels/{name}"].dtype, error, unit, self._coded)
            weights = take(2 * form.components * CLASSES * TERMS, "<i4").astype(np.int64)
            if np.abs(weights).max() > 8 << WEIGHT_BITS:
                raise ValueError
            self._codings[name] = Coding(form, weights)
        place = after_root(root[at], int(levels[1][1]))
        for array in root_arrays(self._coded, place):
            array.reshape(-1)[:] = take(array.size, "u1")
        if at != len(root):
            raise ValueError
        # The tables are searched by bisection: rows that are not decoded yet stand behind all others.
        for cells in (split.cells, kept.cells):
            cells[:] = np.iinfo(cells.dtype).max
        arrays.groups[:1, 2] = 1 << 32 | 1  # the root's children, also where there are none
        split.cells[: place.split], kept.cells[: place.kept] = 0, 0
        split.facings[: place.split] = arrays.flags[0] & np.uint8(FACING_FLAGS)

    @property
    def channels(self) -> list[str]:
        """The names of the channels."""
        return list(self._codings)

    @property
    def contents(self) -> Decoded:
        """The decoded content, zeros for the rest."""
        names = {STRUCTURE: "structure and flags", AREAS: "areas"}
        sizes = {
            names.get(kind, f"channel {kind}"): sum(streams[kind].length for _, streams in self._parts)
            for kind in self._kinds
        }
        sizes["other"] = sum(stream.length for *_, stream in self._others)
        sizes["directory"] = len(self._content) - self._end + START
        return Decoded(self._tensors, self._metadata, sizes)

    def decode_all(self) -> None:
        """Decode everything."""
        if self.is_whole:
            return
        self._fetch([(START, self._end)])
        self._decode({kind: np.ones(len(self._parts), np.bool_) for kind in self._kinds})
        for name, begin, end, stream in self._others:
            unpacked = _unpacked(stream.read(self._content), end - begin)
            if unpacked is None:
                raise stream.damaged()
            flat = self._tensors[name].reshape(-1).view(np.uint8)
            flat[begin:end] = np.frombuffer(unpacked, np.uint8)
        self.is_whole = True

    def decode(self, wanted: Mapping[str, Sequence[tuple[str, Int64s]]], level: int = 0) -> bool:
        """Decode AREAS and channels: rows of tables, named as in `Place`, for each kind.

        Structure, flags and tables are decoded down to these rows, and at least to ``level``. Returns whether
        there was anything to do.
        """
        marked = {kind: self._marked(rows) for kind, rows in wanted.items()}
        level = max([level, *(self.level_of(*rows) for tables in wanted.values() for rows in tables)])
        above = np.array([block.level < level for block, _ in self._parts], np.bool_)
        was_more = self._decode({STRUCTURE: above})
        for kind, blocks in marked.items():
            blocks &= ~self._done[kind]
            for number in range(blocks.size - 1, -1, -1):  # with the levels above, which predict them
                if blocks[number]:
                    around = around_nodes(self._coded.arrays, self._parts[number][0])
                    cells = around[:, : OWN + 1].astype(np.int64).reshape(-1)
                    blocks |= self._marked([("cell", cells)]) & ~self._done[kind]
        return self._decode(marked) or was_more

    def level_of(self, table: str, rows: Int64s) -> int:
        """Return the level of the last cell with any of these rows of a table."""
        number = int(np.searchsorted(self._firsts[table], rows.max(initial=0), "right")) - 1
        return self._parts[number][0].level + 1 if number >= 0 else 0

    def _marked(self, wanted: Sequence[tuple[str, Int64s]]) -> Bools:
        """Mark the blocks with rows of tables; the root's are in none."""
        marked = np.zeros(len(self._parts), np.bool_)
        for table, rows in wanted:
            blocks = np.searchsorted(self._firsts[table], rows, "right") - 1
            marked[blocks[blocks >= 0]] = True
        return marked

    def _decode(self, wanted: Mapping[str, Bools]) -> bool:
        """Decode kinds of streams of blocks, level by level; the levels above are decoded, or wanted too."""
        missing = {kind: marked & ~self._done[kind] for kind, marked in wanted.items()}
        todo: list[_Part] = []
        for number in np.flatnonzero(np.any(list(missing.values()), axis=0)) if missing else ():
            block, streams = self._parts[number]
            todo.append((block, {k: streams[k] for k in self._kinds if k in missing and missing[k][number]}))
        all_streams = [stream for _, streams in todo for stream in streams.values()]
        self._fetch([(stream.begin, stream.begin + stream.length) for stream in all_streams])
        with workers() as executor:
            for _, level in groupby(todo, key=lambda part: part[0].level):
                for _ in ordered_map(executor, self._decode_block, list(level)):
                    pass
        for kind, marked in missing.items():
            self._done[kind] |= marked
        return bool(todo)

    def _decode_block(self, part: _Part) -> None:
        block, streams = part
        read = ((stream.begin, stream.read(self._content)) for stream in streams.values())
        code_block(self._coded, self._codings, block, list(streams), self._models, read)

    def _stream(self) -> _StreamPlace:
        """Return the place of the file's next stream."""
        begin, length = self._at_byte, next(self._records)
        self._at_byte += length
        if self._at_byte > self._end:
            raise DamagedError("its blocks are longer than the file; copy it again")
        return _StreamPlace(begin, length, next(self._records))

    def _planned(self) -> Iterator[_Part]:
        """Yield the blocks, level by level."""
        arrays, split, kept = self._coded[:3]
        cells, nodes = arrays.level_cells.tolist(), arrays.level_nodes.tolist()
        place = after_root(int(arrays.flags[0]), nodes[1])
        for level in range(len(cells) - 2):
            for first, last in runs(nodes[level], nodes[level + 1]):
                before = place
                place = Place(*(count + next(self._records) for count in before))
                streams = {kind: self._stream() for kind in self._kinds}
                yield Block(level, first, last, before, place), streams
            if place[:2] != (nodes[level + 2], cells[level + 2]):
                raise DamagedError(f"level {level + 1} has not as many cells as its blocks; copy it again")
        if place[2:] != (split.cells.size, split.areas.size, kept.cells.size):
            raise DamagedError("its blocks, split cells and kept nodes disagree; copy it again")


def _directory(content: mmap.mmap, fetch: Fetch) -> tuple[int, bytes, bytes, bytes]:
    """Return where the directory begins, and its parts: header, root and records."""
    if len(content) < START:
        raise DamagedError(_TRUNCATED)
    fetch([(0, START)])
    first = content[:START]
    if first[:8] != MAGIC:
        raise DamagedError("is not an octex archive")
    version, length = np.frombuffer(first, "<u4", 2, 8).tolist()
    if zlib.crc32(first[:28]) != int.from_bytes(first[28:], "little"):
        raise DamagedError("its header is damaged; copy it again")
    if version != FORMAT_VERSION:
        raise DamagedError(f"has format version {version}, newer than this octex reads; update octex")
    begin = int.from_bytes(first[16:24], "little")
    if not START <= begin <= len(content) or begin + length != len(content) or length < 12:
        raise DamagedError(
            f"has {len(content)} bytes, which is not the size in its header: it is truncated; copy it again"
        )
    fetch([(begin, len(content))])
    directory = content[begin:]
    lengths = np.frombuffer(directory, "<u4", 3).tolist()
    is_right = zlib.crc32(directory) == int.from_bytes(first[24:28], "little") and sum(lengths) <= _LONGEST
    text = _unpacked(directory[12:], sum(lengths)) if is_right else None
    if text is None or lengths[2] % 4:
        raise DamagedError(_BAD_DIRECTORY)
    header, root, records = (text[a:b] for a, b in pairwise(np.cumsum([0, *lengths]).tolist()))
    return begin, header, root, records


def _unpacked(content: bytes, length: int) -> bytes | None:
    """Unpack xz; None unless it has exactly ``length`` bytes."""
    try:
        inflate = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_FOR_XZ)
        unpacked = inflate.decompress(content, length + 1)
    except lzma.LZMAError:
        return None
    return unpacked if len(unpacked) == length and inflate.eof and not inflate.unused_data else None


def _check_records(
    entries: Mapping[str, container.Entry], channels: list[str], levels: list[Array], count: int
) -> None:
    """Raise ValueError for a wrong number of records: this bounds the size of the decoded arrays."""
    (cells, nodes), block_tensors = levels, known_names(entries, channels)
    pairs = pairwise(nodes[:-1].tolist())
    blocks = sum((end - 1) // BLOCK - first // BLOCK + 1 for first, end in pairs if end > first)
    expected = blocks * (len(Place._fields) + 4 + 2 * len(channels))
    for name in entries.keys() - block_tensors:
        expected += 2 * -(-math.prod(entries[name].shape) * entries[name].dtype.itemsize // PIECE)
    rows = [entries[name].shape[0] for name in block_tensors - {*TREE_NAMES[1:3]}]
    if count != expected or max(rows) > 6 * int(cells[-1]) or cells[-1] > 8 * BLOCK * blocks + 1:
        raise ValueError


def _form(channel: ChannelBytes, dtype: np.dtype[Any], error: int, unit: int, content: CodedArrays) -> Form:
    """Return the form of a channel's values."""
    _, components, size = channel.values.shape
    rows = content.arrays.flags.size, content.split.areas.size, content.kept.cells.size
    if [part.shape for part in channel] != [(n, components, size) for n in rows]:
        raise ValueError
    is_float = dtype.kind == "f"
    if not 1 <= components <= 4 or dtype.name not in ONE or unit > 32:
        raise ValueError
    if error >= (1 if is_float else 1 << 8 * size):
        raise ValueError
    return Form(components, size, int(is_float), error, unit)
