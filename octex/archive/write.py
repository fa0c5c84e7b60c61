"""Writes an archive, block by block, from mapped arrays."""

from __future__ import annotations

import lzma
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from typing import Any

import numpy as np

from octex import container
from octex.archive.blocks import code_block
from octex.archive.entropy import AdaptiveModel, new_model, noter
from octex.archive.layout import (
    AREAS,
    CLASSES,
    FORMAT_VERSION,
    MAGIC,
    PIECE,
    START,
    STRUCTURE,
    TERMS,
    WEIGHT_BITS,
    Block,
    ChannelBytes,
    CodedArrays,
    Coding,
    Form,
    Place,
    after_root,
    channels_in,
    coded_arrays,
    pieces_of,
    root_arrays,
    runs,
)
from octex.archive.structure import around_children, around_nodes
from octex.archive.values import code_values, extent, numbers_of
from octex.arrays import Array, Int32s, Int64s, Uint8s, Uint32s, zeros
from octex.files import replacing
from octex.parallel import ordered_map, workers
from octex.tree.children import children_before
from octex.tree.layout import TreeArrays
from octex.tree.octree import Octree
from octex.tree.split import counts_of

#: The number of last cells that determine a unit.
_LAST = 1 << 14
#: Weights are learned from about _SAMPLE nodes of each of the two deepest levels, in runs, repeatedly.
_SAMPLE, _RUN, _ROUNDS = 1 << 13, 1 << 8, 3
_MOST = 8 << WEIGHT_BITS

#: For sampled nodes: their children's first cell, and the neighbours of children and nodes.
_Sampled = list[tuple[int, Int32s, Uint32s]]


def write(
    path: str | os.PathLike[str], tensors: Mapping[str, Array], metadata: Mapping[str, str], max_error: int
) -> None:
    """Write the tensors and metadata of a texture's render file.

    Values of integer channels may change by ``max_error`` codes; all else is restored bit for bit. The same
    input gives the same bytes. Raises TextureFileError for an invalid tree, and OutputError if the file
    cannot be written: the old file at ``path`` is then unchanged.
    """
    first, channels = container.header(tensors, metadata), channels_in(metadata)
    content = coded_arrays(tensors, channels)
    Octree(*content[:3]).validate()
    place = after_root(int(content.arrays.flags[0]), int(content.arrays.level_nodes[1]))
    sample, codings, decoded = _sampled(content.arrays), {}, dict(content.original)
    for name, channel in content.original.items():
        form = _form(channel, tensors[f"channels/{name}"].dtype, max_error)
        codings[name] = Coding(form, _learned(channel.values, form, sample))
        if form.error:  # all values but the root's will differ
            decoded[name] = ChannelBytes(*(zeros(array.size).reshape(array.shape) for array in channel))
            for rows, original, count in zip(decoded[name], channel, (1, place.row, place.kept), strict=True):
                rows[:count] = original[:count]
    content, kinds = content._replace(decoded=decoded), (STRUCTURE, AREAS, *codings)
    models: dict[str, AdaptiveModel] = {}

    def encode(block: Block) -> tuple[list[int], list[bytes]]:
        """Return the start of a block's record, and its streams."""
        return list(block.counts), code_block(content, codings, block, kinds, models)

    with replacing(path) as file, workers() as executor:
        file.write(bytes(START))
        records: list[int] = []
        levels = (ordered_map(executor, encode, level) for level in _planned(content))
        for counts, streams in chain(chain.from_iterable(levels), _pieces(tensors, channels)):
            records += counts
            for stream in streams:
                file.write(stream)
                records += [len(stream), zlib.crc32(stream)]
        described: list[Array] = [*content.arrays[1:3]]
        for form, weights in codings.values():
            described += [np.array([form.error, form.unit], "<u4"), weights.astype("<i4")]
        begins = b"".join(array.tobytes() for array in [*described, *root_arrays(content, place)])
        parts = first[8:].rstrip(b" "), begins, np.array(records, "<u4").tobytes()
        begin, sizes = file.tell(), np.array([len(part) for part in parts], "<u4").tobytes()
        directory = sizes + packed(b"".join(parts))
        file.write(directory)
        lengths = np.array([FORMAT_VERSION, len(directory)], "<u4").tobytes()
        start = MAGIC + lengths + begin.to_bytes(8, "little") + zlib.crc32(directory).to_bytes(4, "little")
        file.seek(0)
        file.write(start + zlib.crc32(start).to_bytes(4, "little"))
        file.seek(0, os.SEEK_END)


def packed(content: bytes) -> bytes:
    """Pack up to a few megabytes by xz, as ``read`` unpacks them."""
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 4, "dict_size": PIECE}]
    return lzma.compress(content, check=lzma.CHECK_NONE, filters=filters)


def _pieces(tensors: Mapping[str, Array], channels: Sequence[str]) -> Iterator[tuple[list[int], list[bytes]]]:
    """Yield other tensors, compressed."""
    for name, begin, end in pieces_of({name: array.nbytes for name, array in tensors.items()}, channels):
        array = tensors[name]
        flat = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        yield [], [packed(flat[begin:end].tobytes())]


def _planned(content: CodedArrays) -> Iterator[list[Block]]:
    """Yield the blocks of each level."""
    arrays, split, kept = content.arrays, content.split, content.kept
    rows = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts_of(split.facings))])

    def place(node: int, cell: int) -> Place:
        n_split = int(np.searchsorted(split.cells, cell))
        return Place(node, cell, n_split, int(rows[n_split]), int(np.searchsorted(kept.cells, cell)))

    for level, (first_node, end_node) in enumerate(pairwise(arrays.level_nodes[:-1].tolist())):
        blocks = list(runs(first_node, end_node))
        firsts = np.array([*(first for first, _ in blocks), end_node])
        cells, nodes = children_before(arrays.groups, firsts)
        places = list(map(place, nodes.tolist(), cells.tolist()))
        yield [Block(level, *run, *ends) for run, ends in zip(blocks, pairwise(places), strict=True)]


def _form(channel: ChannelBytes, dtype: np.dtype[Any], error: int) -> Form:
    """Return the form of a channel's values; neighbours differ by about eight units."""
    _, components, size = channel.values.shape
    form = Form(components, size, int(dtype.kind == "f"), 0, 0)
    if size > 1:  # floats and 16 bits differ by far more steps than 8 bits do
        differ = np.abs(np.diff(numbers_of(channel.values[-_LAST:], form), axis=0))
        unit = max(int(np.median(differ)).bit_length() - 3, 0) if differ.size else 0
        form = form._replace(unit=unit)
    return form._replace(error=0 if form.is_float else error)


def _sampled(arrays: TreeArrays) -> _Sampled:
    """Sample nodes all over the two deepest levels of nodes."""
    sampled = []
    for level in range(max(arrays.level_cells.size - 4, 0), arrays.level_cells.size - 2):
        begin, end = int(arrays.level_nodes[level]), int(arrays.level_nodes[level + 1])
        count = min(_SAMPLE // _RUN, -(-(end - begin) // _RUN))
        for first in (begin + (end - begin) * n // count for n in range(count)):
            last = min(first + _RUN, end)
            begins = children_before(arrays.groups, np.array([first, last]))[0].tolist()
            block = Block(level, first, last, *(Place(0, cell, 0, 0, 0) for cell in begins))
            around = around_nodes(arrays, block)
            sampled.append((begins[0], around_children(arrays, block, around), around))
    return sampled


def _learned(raw: Uint8s, form: Form, sample: _Sampled) -> Int64s:
    """Return the weights (2 · components · classes · terms,) after coding a sample of a channel."""
    first = np.zeros((2, form.components, CLASSES, TERMS), np.int64)
    first[:, 1:, :, 5] = 1 << WEIGHT_BITS - 1  # components differ from their parents' like the first
    weights = first.reshape(-1)
    for begin, rows, around in sample * _ROUNDS:
        numbers = np.zeros((len(rows) + 1, form.components), np.uint32)
        numbers[:-1] = numbers_of(raw[begin : begin + len(rows)], form)
        contexts, most = extent(form, len(rows))
        coder = noter(new_model(*contexts), most)
        code_values(rows, around, raw.reshape(-1), numbers, form, weights, coder)
    return np.clip(weights, -_MOST, _MOST)
