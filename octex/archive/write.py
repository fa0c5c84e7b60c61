"""Write an archive: note what occurs, choose the models, encode; block by block, from mapped arrays."""

from __future__ import annotations

import os
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial, reduce
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np

from octex import container
from octex.archive.around import ABOUT, OWN, around_children, around_nodes
from octex.archive.blocks import code_block
from octex.archive.coding import STEPS, Coding, Form, coding_of, numbers_of
from octex.archive.entropy import (
    MEASURES,
    NOTES,
    PLACE,
    Coder,
    counting_pool,
    encoded,
    intervals_of,
    new_coder,
)
from octex.archive.head import channels_in, packed, pieces_of
from octex.archive.layout import (
    AREAS,
    FORMAT_VERSION,
    MAGIC,
    START,
    STRUCTURE,
    Block,
    Content,
    Named,
    Place,
    after_root,
    content_of,
    of_root,
    runs,
)
from octex.archive.models import Models, counting, made
from octex.archive.values import code_values
from octex.archive.weights import new_squares, solve
from octex.arrays import Array, Int64s, Uint32s, zeros
from octex.files import replacing
from octex.parallel import ordered_map, workers
from octex.tree.layout import TreeArrays
from octex.tree.octree import Octree
from octex.tree.split import counts_of

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
    max_error: int = 0,
) -> None:
    """Write a texture's tensors and metadata, as they are in its render file.

    Values of integer channels may move by ``max_error`` codes; all else comes back bit for bit. The same
    input gives the same bytes. Raises TextureFileError for a tree that is not sound, and OutputError if the
    file cannot be written: then what stood at ``path`` still stands.
    """
    first, channels = container.header(tensors, metadata), channels_in(metadata)
    content = content_of(tensors, channels)
    Octree(*content[:3]).validate()
    blocks = list(_planned(content))
    sampled = _sampled(content.arrays, blocks)
    codings = {
        name: _coding(channel, tensors[f"channels/{name}"].dtype, max_error, sampled)
        for name, channel in content.given.items()
    }
    place = after_root(int(content.arrays.flags[0]), int(content.arrays.level_nodes[1]))
    root = of_root(content, content.given, place)
    decoded = dict(content.given)
    for name, channel in content.given.items():
        if codings[name].form.error:  # what is read will differ, but for the root's
            decoded[name] = Named(*(zeros(array.size).reshape(array.shape) for array in channel))
            own = [of_root(content, {name: each}, place)[3:] for each in (decoded[name], channel)]
            for array, given in zip(*own, strict=True):
                array[:] = given
    content = content._replace(decoded=decoded)
    with replacing(path) as file, workers() as executor:
        noting = _Noting(content, codings)
        noted = noting.all(blocks, executor)
        models, numbers = made(noting.counts(), codings)
        file.write(bytes(START))
        records: list[int] = []
        encode = partial(_encoded, noting, intervals_of(models.pools))
        for counts, streams in chain(ordered_map(executor, encode, noted), _pieces(tensors, channels)):
            records += counts
            for stream in streams:
                file.write(stream)
                records += [len(stream), zlib.crc32(stream)]
        forms = [(coding.form.error, coding.form.unit) for coding in codings.values()]
        begins = [*content.arrays[1:3], np.array(forms, "<u4"), *root]
        parts = [first[8:].rstrip(b" "), b"".join(array.tobytes() for array in begins), numbers]
        parts.append(np.array(records, "<u4").tobytes())
        begin, sizes = file.tell(), np.array([len(part) for part in parts], "<u4").tobytes()
        directory = sizes + packed(b"".join(parts))
        file.write(directory)
        lengths = np.array([FORMAT_VERSION, len(directory)], "<u4").tobytes()
        start = MAGIC + lengths + begin.to_bytes(8, "little") + zlib.crc32(directory).to_bytes(4, "little")
        file.seek(0)
        file.write(start + zlib.crc32(start).to_bytes(4, "little"))
        file.seek(0, os.SEEK_END)


def _pieces(tensors: Mapping[str, Array], channels: Sequence[str]) -> Iterator[tuple[list[int], list[bytes]]]:
    """Yield other tensors, compressed."""
    for name, begin, end in pieces_of({name: array.nbytes for name, array in tensors.items()}, channels):
        array = tensors[name]
        flat = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        yield [], [packed(flat[begin:end].tobytes())]


def _planned(content: Content) -> Iterator[Block]:
    """Yield all blocks, level by level."""
    arrays, split, kept = content.arrays, content.split, content.kept
    rows = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts_of(split.facings))])

    def place(node: int, cell: int) -> Place:
        n_split = int(np.searchsorted(split.cells, cell))
        return Place(node, cell, n_split, int(rows[n_split]), int(np.searchsorted(kept.cells, cell)))

    for level, (first_node, end_node) in enumerate(pairwise(arrays.level_nodes[:-1].tolist())):
        own = list(runs(first_node, end_node))
        places = [place(*_first_below(arrays, first)) for first, _ in own]
        places.append(place(int(arrays.level_nodes[level + 2]), int(arrays.level_cells[level + 2])))
        for (first, last), (begin, end) in zip(own, pairwise(places), strict=True):
            yield Block(level, first, last, begin, end)


def _first_below(arrays: TreeArrays, node: int) -> tuple[int, int]:
    """Return the first child node and the first child of a node."""
    first = int(arrays.groups[node >> 3, 2])
    below = (1 << 8 * (node & 7)) - 1
    nodes, leaves = (int(word) & below for word in arrays.groups[node >> 3, :2])
    return (first & 0xFFFFFFFF) + nodes.bit_count(), (first >> 32) + (nodes | leaves).bit_count()


# The weights.

_Sampled = list[tuple[int, Uint32s, Int64s]]


def _sampled(arrays: TreeArrays, blocks: list[Block]) -> _Sampled:
    """Return of some nodes, all over the fine levels, the first child and what lies around the children."""
    found = []
    for level in range(max(arrays.level_cells.size - 4, 0), arrays.level_cells.size - 2):
        begin, end = int(arrays.level_nodes[level]), int(arrays.level_nodes[level + 1])
        count = min(_SAMPLE // (4 * _SAMPLED), -(-(end - begin) // _SAMPLED))
        for n in range(count):
            first = begin + (end - begin) * n // count
            last = min(first + _SAMPLED, end)
            cell = _first_below(arrays, first)[1]
            after = _first_below(arrays, last)[1] if last < end else int(arrays.level_cells[level + 2])
            block = blocks[0]._replace(level=level, first=first, last=last)
            cells, nodes = around_nodes(arrays, block)
            rows = np.empty((after - cell, 4), np.uint32)
            around_children(arrays.groups, first, last, cells, nodes, rows)
            found.append((cell, rows, cells))
    return found


def _coding(channel: Named, dtype: np.dtype[Any], error: int, sampled: _Sampled) -> Coding:
    raw = channel.values
    _, components, size = raw.shape
    form = Form(components, size, int(dtype.kind == "f"), 0, 0)
    if size > 1:  # floats and 16 bits differ by far more steps than 8 bits do
        form = form._replace(unit=_unit(channel, form, sampled))
    coding = coding_of(form)
    pool = counting_pool(0, 0, 0)
    for _ in range(_ROUNDS):
        squares = new_squares(components)
        for cell, rows, cells in sampled:
            own = rows, cells, raw, raw, cell, coding, STEPS, squares
            code_values(*own, pool, new_coder(MEASURES, 0))
        solve(squares, coding.weights)
    return coding._replace(form=form._replace(error=0 if form.is_float else error))


def _unit(channel: Named, form: Form, sampled: _Sampled) -> int:
    """Return the unit in which values differ from their parents' by about eight, or none if that is less."""
    usual = []
    for cell, rows, cells in sampled:
        node = np.cumsum(np.append(1, rows[:-1, ABOUT] & 15 == 1)) - 1
        parents = numbers_of(channel.values[cells[node, OWN]], form)
        own = numbers_of(channel.values[cell : cell + len(rows)], form)
        usual.append(np.abs(own - parents).reshape(-1))
    return max(int(np.median(np.concatenate(usual))).bit_length() - 3, 0) if usual else 0


# The blocks.


class _Streams:
    """Streams of notes."""

    def __init__(self) -> None:
        self._coder: Coder
        self.found: list[Uint32s] = []

    def begin(self, most: int) -> Coder:
        """Return a coder with room for so many notes."""
        self._coder = new_coder(NOTES, most)
        return self._coder

    def end(self) -> None:
        """Keep the notes of a stream."""
        self.found.append(self._coder.stream[: self._coder.state[PLACE]].copy())

    def list_flagged(self, content: Content, block: Block) -> None:
        """Do nothing: they are listed."""


class _Noted(NamedTuple):
    """A block, and its notes if they are kept."""

    block: Block
    streams: list[Uint32s] | None


class _Noting:
    """Notes blocks. Each thread counts for itself what occurs."""

    def __init__(self, content: Content, codings: dict[str, Coding]) -> None:
        self._content, self._codings = content, codings
        self._kinds = (STRUCTURE, AREAS, *codings)
        self._here = threading.local()
        self._counted: list[list[Uint32s]] = []

    def block(self, block: Block) -> list[Uint32s]:
        """Note a block's streams."""
        if not hasattr(self._here, "models"):
            self._here.models = counting(self._codings)
            self._counted.append(_counts(self._here.models))
        streams = _Streams()
        code_block(self._content, self._here.models, block, self._kinds, streams)
        return streams.found

    def all(self, blocks: list[Block], executor: Executor) -> list[_Noted]:
        """Note all blocks, level by level. Of many notes only the first are kept."""
        found, size = [], 0
        for level in sorted({block.level for block in blocks}):
            own = [block for block in blocks if block.level == level]
            for block, streams in zip(own, ordered_map(executor, self.block, own), strict=True):
                size += sum(stream.nbytes for stream in streams)
                found.append(_Noted(block, streams if size <= _MOST_NOTES else None))
        return found

    def counts(self) -> list[Uint32s]:
        """Return how often which symbols occurred, of each pool."""
        counted = self._counted or [_counts(counting(self._codings))]
        return [reduce(np.add, each) for each in zip(*counted, strict=True)]


def _counts(models: Models) -> list[Uint32s]:
    return [pool.counts for pool in models.pools]


def _encoded(
    noting: _Noting, intervals: tuple[Uint32s, Uint32s], noted: _Noted
) -> tuple[list[int], list[bytes]]:
    """Return what a block's record begins with, and its streams."""
    begin, end = noted.block.begin, noted.block.end
    streams = noted.streams or noting.block(noted.block)
    counts = [after - before for before, after in zip(begin, end, strict=True)]
    return counts, [encoded(stream, *intervals) for stream in streams]
