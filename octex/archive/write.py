"""Write an archive, block by block, from mapped arrays."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, pairwise
from typing import Any

import numpy as np

from octex import container
from octex.archive.blocks import code_block
from octex.archive.entropy import Model
from octex.archive.head import channels_in, packed, pieces_of
from octex.archive.layout import (
    AREAS,
    FORMAT_VERSION,
    MAGIC,
    START,
    STRUCTURE,
    Block,
    Coding,
    Content,
    Form,
    Named,
    Place,
    after_root,
    content_of,
    of_root,
    runs,
)
from octex.archive.values import numbers_of
from octex.archive.weights import fitted, sampled
from octex.arrays import Array, zeros
from octex.files import replacing
from octex.parallel import ordered_map, workers
from octex.tree.children import children_before
from octex.tree.octree import Octree
from octex.tree.split import counts_of

#: So many of the last cells are looked at to choose a unit.
_SAMPLE = 1 << 14


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
    sample, codings = sampled(content.arrays), {}
    for name, channel in content.given.items():
        form = _form(channel, tensors[f"channels/{name}"].dtype, max_error)
        codings[name] = Coding(form, fitted(channel.values, form, sample))
    place = after_root(int(content.arrays.flags[0]), int(content.arrays.level_nodes[1]))
    root = of_root(content, content.given, place)
    decoded = dict(content.given)
    for name, channel in content.given.items():
        if codings[name].form.error:  # what is read will differ, but for the root's
            decoded[name] = Named(*(zeros(array.size).reshape(array.shape) for array in channel))
            own = [of_root(content, {name: each}, place)[3:] for each in (decoded[name], channel)]
            for array, given in zip(*own, strict=True):
                array[:] = given
    encode = partial(_encoded, content._replace(decoded=decoded), codings, {})
    with replacing(path) as file, workers() as executor:
        file.write(bytes(START))
        records: list[int] = []
        levels = (ordered_map(executor, encode, level) for level in _planned(content))
        for counts, streams in chain(chain.from_iterable(levels), _pieces(tensors, channels)):
            records += counts
            for stream in streams:
                file.write(stream)
                records += [len(stream), zlib.crc32(stream)]
        told: list[Array] = [*content.arrays[1:3]]
        for form, weights in codings.values():
            told += [np.array([form.error, form.unit], "<u4"), weights.astype("<i4")]
        begins = b"".join(array.tobytes() for array in [*told, *root])
        parts = [first[8:].rstrip(b" "), begins, np.array(records, "<u4").tobytes()]
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


def _planned(content: Content) -> Iterator[list[Block]]:
    """Yield the blocks of each level."""
    arrays, split, kept = content.arrays, content.split, content.kept
    rows = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts_of(split.facings))])

    def place(node: int, cell: int) -> Place:
        n_split = int(np.searchsorted(split.cells, cell))
        return Place(node, cell, n_split, int(rows[n_split]), int(np.searchsorted(kept.cells, cell)))

    for level, (first_node, end_node) in enumerate(pairwise(arrays.level_nodes[:-1].tolist())):
        own = list(runs(first_node, end_node))
        firsts = np.array([*(first for first, _ in own), end_node])
        cells, nodes = children_before(arrays.groups, firsts)
        places = list(map(place, nodes.tolist(), cells.tolist()))
        yield [Block(level, *run, *ends) for run, ends in zip(own, pairwise(places), strict=True)]


def _form(channel: Named, dtype: np.dtype[Any], error: int) -> Form:
    """Return what the values of a channel are, in the unit in which neighbours differ by about eight."""
    _, components, size = channel.values.shape
    form = Form(components, size, int(dtype.kind == "f"), 0, 0)
    if size > 1:  # floats and 16 bits differ by far more steps than 8 bits do
        differ = np.abs(np.diff(numbers_of(channel.values[-_SAMPLE:], form), axis=0))
        unit = max(int(np.median(differ)).bit_length() - 3, 0) if differ.size else 0
        form = form._replace(unit=unit)
    return form._replace(error=0 if form.is_float else error)


def _encoded(
    content: Content, codings: Mapping[str, Coding], models: dict[str, Model], block: Block
) -> tuple[list[int], list[bytes]]:
    """Return what a block's record begins with, and its streams."""
    streams = code_block(content, codings, block, (STRUCTURE, AREAS, *codings), models)
    return [after - before for before, after in zip(block.begin, block.end, strict=True)], streams
