"""The directory of an archive: what the render file of its content begins with, and records."""

from __future__ import annotations

import json
import lzma
import math
import mmap
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from octex import container
from octex.archive.layout import (
    BLOCK,
    FORMAT_VERSION,
    MAGIC,
    PIECE,
    START,
    TREE_NAMES,
    Coding,
    Content,
    DamagedError,
    Form,
    Named,
    Place,
    after_root,
    content_of,
    known_names,
    of_root,
)
from octex.archive.values import CLASSES, DTYPES, TERMS, WEIGHT_BITS
from octex.arrays import Array, Int64s, zeros
from octex.errors import ArgumentError, TextureFileError
from octex.tree.layout import FACING_FLAGS
from octex.tree.validate import check_layout

#: The longest directory, in bytes, and what its decompression may take.
_LONGEST, _MOST_FOR_XZ = 1 << 28, 1 << 26

#: Is told which bytes of the file, from … to before …, are about to be read.
Fetch = Callable[[Sequence[tuple[int, int]]], None]


class Directory(NamedTuple):
    """The directory of an archive, and room for what it holds."""

    begin: int  # where the streams end
    tensors: dict[str, Array]  # zeros, but for what the root has, named and ordered as in a render file
    metadata: dict[str, str]
    content: Content
    codings: dict[str, Coding]
    records: Int64s


def channels_in(metadata: Mapping[str, str]) -> list[str]:
    """Return the names of a render file's channels; raises KeyError, TypeError or ValueError."""
    channels = json.loads(metadata["channels"], object_pairs_hook=container.without_duplicates)
    return list(channels.keys()) if isinstance(channels, dict) else []


def pieces_of(sizes: Mapping[str, int], channels: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Yield the pieces of other tensors, of whose bytes there are so many: which, from where to where."""
    known = known_names(sizes, channels)
    for name, size in sizes.items():
        for begin in range(0, size if name not in known else 0, PIECE):
            yield name, begin, min(begin + PIECE, size)


def packed(content: bytes) -> bytes:
    """Return bytes packed by xz, at most some megabytes, which ``unpacked`` checks."""
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 4, "dict_size": PIECE}]
    return lzma.compress(content, check=lzma.CHECK_NONE, filters=filters)


def unpacked(content: bytes, length: int) -> bytes | None:
    """Return the bytes that xz has packed; None if they are not as many."""
    try:
        inflate = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_FOR_XZ)
        found = inflate.decompress(content, length + 1)
    except lzma.LZMAError:
        return None
    return found if len(found) == length and inflate.eof and not inflate.unused_data else None


def read_directory(content: mmap.mmap, fetch: Fetch) -> Directory:
    """Read the directory of an archive; raises DamagedError for one that no archive has."""
    if len(content) < START:
        raise DamagedError("is truncated; copy it again")
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
    text = unpacked(directory[12:], sum(lengths)) if is_right else None
    if text is None or lengths[2] % 4:
        raise DamagedError("its directory is damaged; copy it again")
    ends = np.cumsum([0, *lengths]).tolist()
    try:
        return Directory(begin, *_opened(*(text[a:b] for a, b in pairwise(ends))))
    except (
        LookupError,
        TypeError,
        ValueError,
        OverflowError,
        RecursionError,
        ArgumentError,
        TextureFileError,
    ):
        raise DamagedError("its directory is damaged; copy it again") from None


def _opened(header: bytes, root: bytes, records: bytes) -> Any:
    """Return a directory of its parts, but for where it begins; raises errors for what no archive has."""
    entries, metadata, size = container.described(header)
    channels, numbers = channels_in(metadata), np.frombuffer(records, "<u4").astype(np.int64)
    at = 0

    def take(count: int, dtype: str) -> Array:
        nonlocal at
        found = np.frombuffer(root, dtype, count, at)
        at += found.nbytes
        return found

    levels = [take(math.prod(entries[name].shape), "<i8") for name in TREE_NAMES[1:3]]
    _check_records(entries, channels, (levels[0], levels[1]), numbers.size)
    content = zeros(size)
    tensors = {name: container.view(content, entry) for name, entry in entries.items()}
    for name, level in zip(TREE_NAMES[1:3], levels, strict=True):
        tensors[name][:] = level
    found = content_of(tensors, channels)
    check_layout(*found[:3])
    codings = {}
    for name, channel in found.given.items():
        error, unit = take(2, "<u4").tolist()
        form = _form(channel, tensors[f"channels/{name}"].dtype, error, unit, found)
        weights = take(2 * form.components * CLASSES * TERMS, "<i4").astype(np.int64)
        if np.abs(weights).max() > 8 << WEIGHT_BITS:
            raise ValueError
        codings[name] = Coding(form, weights)
    place = after_root(root[at], int(levels[1][1]))
    for array in of_root(found, found.given, place):
        array.reshape(-1)[:] = take(array.size, "u1")
    if at != len(root):
        raise ValueError
    for cells in (found.split.cells, found.kept.cells):  # it is looked for by bisection what of them is there
        cells[:] = np.iinfo(cells.dtype).max
    found.arrays.groups[:1, 2] = 1 << 32 | 1  # the root's children, also where there are none
    found.split.cells[: place.split], found.kept.cells[: place.kept] = 0, 0
    found.split.facings[: place.split] = found.arrays.flags[0] & np.uint8(FACING_FLAGS)
    return tensors, metadata, found, codings, numbers


def _check_records(
    entries: Mapping[str, container.Entry], channels: list[str], levels: tuple[Array, Array], count: int
) -> None:
    """Refuse records that are not as many as the rest wants: what is decoded is bounded so."""
    (cells, nodes), known = levels, known_names(entries, channels)
    pairs = pairwise(nodes[:-1].tolist())
    blocks = sum((end - 1) // BLOCK - first // BLOCK + 1 for first, end in pairs if end > first)
    expected = blocks * (len(Place._fields) + 4 + 2 * len(channels))
    for name in entries.keys() - known:
        expected += 2 * -(-math.prod(entries[name].shape) * entries[name].dtype.itemsize // PIECE)
    rows = [entries[name].shape[0] for name in known - {*TREE_NAMES[1:3]}]
    if count != expected or max(rows) > 6 * int(cells[-1]) or cells[-1] > 8 * BLOCK * blocks + 1:
        raise ValueError


def _form(channel: Named, dtype: np.dtype[Any], error: int, unit: int, content: Content) -> Form:
    """Return what the values of a channel are."""
    _, components, size = channel.values.shape
    rows = content.arrays.flags.size, content.split.areas.size, content.kept.cells.size
    if [part.shape for part in channel] != [(n, components, size) for n in rows]:
        raise ValueError
    is_float = dtype.kind == "f"
    if not 1 <= components <= 4 or dtype.name not in DTYPES or unit > 32:
        raise ValueError
    if error >= (1 if is_float else 1 << 8 * size):
        raise ValueError
    return Form(components, size, int(is_float), error, unit)
