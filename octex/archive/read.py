"""Decode an archive, whole or what is asked for of it."""

from __future__ import annotations

import mmap
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from octex.archive.around import OWN, around_nodes
from octex.archive.blocks import code_block
from octex.archive.entropy import Model
from octex.archive.head import Fetch, pieces_of, read_directory, unpacked
from octex.archive.layout import (
    AREAS,
    START,
    STRUCTURE,
    Block,
    DamagedError,
    Place,
    after_root,
    runs,
)
from octex.arrays import Array, Bools, Int64s
from octex.errors import ArgumentError, TextureFileError
from octex.files import open_file
from octex.parallel import ordered_map, workers


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

    def read(self, content: mmap.mmap) -> bytes:
        """Return its bytes."""
        found = content[self.begin : self.begin + self.length]
        if zlib.crc32(found) != self.checksum:
            raise self.damaged()
        return found

    def damaged(self) -> DamagedError:
        """Return the error for a stream that is not what was written."""
        return DamagedError(f"its bytes from {self.begin} on are damaged; copy it again")


class _Part(NamedTuple):
    """A block, and where its streams lie."""

    block: Block
    streams: dict[str, _Stream]


def read(path: str | os.PathLike[str]) -> Contents:
    """Decode an archive into memory, or where it is large into a temporary file that is mapped.

    Every stream is checked by its checksum, and every count. Raises TextureFileError for a file that is
    missing, damaged, no archive, or of another version.
    """
    try:
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size < START:
                raise DamagedError("is truncated; copy it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                decoding = Decoding(content)
                decoding.decode_all()
                return decoding.contents
    except OSError as error:
        raise TextureFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (MemoryError, OverflowError):
        raise TextureFileError(f"{path}: does not fit into memory") from None
    except (DamagedError, ArgumentError) as error:
        raise TextureFileError(f"{path}: {error}") from error


class Decoding:
    """The decoding of one archive, whole or in part: a block's stream after what it is decoded with.

    ``fetch`` is told which bytes of ``content`` are about to be read. Raises DamagedError, as its methods do.
    """

    def __init__(self, content: mmap.mmap, fetch: Fetch = lambda _ranges: None) -> None:
        self._content, self._fetch = content, fetch
        self._directory = read_directory(content, fetch)
        self._models: dict[str, Model] = {}
        self._coded, self._codings = self._directory.content, self._directory.codings
        self._records, self._at_byte = iter(self._directory.records.tolist()), START
        self._kinds = STRUCTURE, AREAS, *self.channels
        self._parts = list(self._planned())
        sizes = {name: array.nbytes for name, array in self._directory.tensors.items()}
        self._others = [(*piece, self._stream()) for piece in pieces_of(sizes, self.channels)]
        if self._at_byte != self._directory.begin:
            raise DamagedError("has bytes outside of all blocks; copy it again")
        #: What of each comes before each block, and which blocks are decoded of each kind.
        self._firsts = {
            name: np.array([getattr(part.block.begin, name) for part in self._parts], np.int64)
            for name in Place._fields
        }
        self._done = {kind: np.zeros(len(self._parts), np.bool_) for kind in self._kinds}
        self.is_whole = False

    @property
    def channels(self) -> list[str]:
        """The names of the channels."""
        return list(self._codings)

    @property
    def contents(self) -> Contents:
        """What is decoded, zeros for what is not."""
        names = {STRUCTURE: "structure and flags", AREAS: "areas"}
        sizes = {
            names.get(kind, f"channel {kind}"): sum(part.streams[kind].length for part in self._parts)
            for kind in self._kinds
        }
        sizes["other"] = sum(stream.length for *_, stream in self._others)
        sizes["directory"] = len(self._content) - self._directory.begin + START
        return Contents(self._directory.tensors, self._directory.metadata, sizes)

    def decode_all(self) -> None:
        """Decode what is not decoded yet."""
        if not self.is_whole:
            self._fetch([(START, self._directory.begin)])
            self._decode({kind: np.ones(len(self._parts), np.bool_) for kind in self._kinds})
            for name, begin, end, stream in self._others:
                found = unpacked(stream.read(self._content), end - begin)
                if found is None:
                    raise stream.damaged()
                flat = self._directory.tensors[name].reshape(-1).view(np.uint8)
                flat[begin:end] = np.frombuffer(found, np.uint8)
            self.is_whole = True

    def decode_structure(self, level: int) -> bool:
        """Decode structure, flags and tables down to a level; say whether there was anything to do."""
        return self._decode({STRUCTURE: np.array([part.block.level < level for part in self._parts], bool)})

    def decode(self, wanted: Mapping[str, Sequence[tuple[str, Int64s]]]) -> bool:
        """Decode AREAS and channels: of each kind rows of tables, which are named as in `Place`.

        Says as ``decode_structure`` whether there was anything to do.
        """
        marked = {kind: self._marked(rows) for kind, rows in wanted.items()}
        level = max((self.level_of(*rows) for each in wanted.values() for rows in each), default=0)
        was_more = self.decode_structure(level)
        for kind, blocks in marked.items():
            blocks &= ~self._done[kind]
            for number in range(blocks.size - 1, -1, -1):  # with what they are guessed from, levels above
                if blocks[number]:
                    around = around_nodes(self._coded.arrays, self._parts[number].block)
                    cells = around[:, : OWN + 1].astype(np.int64).reshape(-1)
                    blocks |= self._marked([("cell", cells)]) & ~self._done[kind]
        return self._decode(marked) or was_more

    def level_of(self, table: str, rows: Int64s) -> int:
        """Return the level of the last of the cells that some rows of a table are of."""
        number = int(np.searchsorted(self._firsts[table], rows.max(initial=0), "right")) - 1
        return self._parts[number].block.level + 1 if number >= 0 else 0

    def _marked(self, wanted: Sequence[tuple[str, Int64s]]) -> Bools:
        """Mark the blocks that have rows of tables; the root's are in none."""
        marked = np.zeros(len(self._parts), np.bool_)
        for table, rows in wanted:
            found = np.searchsorted(self._firsts[table], rows, "right") - 1
            marked[found[found >= 0]] = True
        return marked

    def _decode(self, wanted: Mapping[str, Bools]) -> bool:
        """Decode kinds of streams of blocks, level by level; what they are decoded with is, or is wanted."""
        todo: list[tuple[_Part, list[str]]] = []
        left = {kind: marked & ~self._done[kind] for kind, marked in wanted.items()}
        for number in np.flatnonzero(np.any(list(left.values()), axis=0)) if left else ():
            kinds = [kind for kind in self._kinds if kind in left and left[kind][number]]
            todo.append((self._parts[number], kinds))
        streams = [part.streams[kind] for part, kinds in todo for kind in kinds]
        self._fetch([(stream.begin, stream.begin + stream.length) for stream in streams])
        with workers() as executor:
            for _, level in groupby(todo, key=lambda each: each[0].block.level):
                for _ in ordered_map(executor, self._decode_block, list(level)):
                    pass
        for kind, marked in left.items():
            self._done[kind] |= marked
        return bool(todo)

    def _decode_block(self, task: tuple[_Part, list[str]]) -> None:
        part, kinds = task
        streams = ((each.begin, each.read(self._content)) for each in map(part.streams.get, kinds) if each)
        code_block(self._coded, self._codings, part.block, kinds, self._models, streams)

    def _stream(self) -> _Stream:
        """Return where the next stream of the file lies."""
        begin, length = self._at_byte, next(self._records)
        self._at_byte += length
        if self._at_byte > self._directory.begin:
            raise DamagedError("its blocks are longer than the file; copy it again")
        return _Stream(begin, length, next(self._records))

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
                yield _Part(Block(level, first, last, before, place), streams)
            if place[:2] != (nodes[level + 2], cells[level + 2]):
                raise DamagedError(f"level {level + 1} has not as many cells as its blocks; copy it again")
        if place[2:] != (split.cells.size, split.areas.size, kept.cells.size):
            raise DamagedError("its blocks, split cells and kept nodes disagree; copy it again")
