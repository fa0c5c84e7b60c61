r"""The archive of a texture: what is on disk.

    8 bytes     89 4F 43 54 5A 0D 0A 1A: "\x89OCTZ\r\n\x1a"
    u32         the format's version, 3
    u32         bytes of the directory
    u64         where it begins: after the streams, at the end of the file
    u32         CRC-32 of the directory
    u32         CRC-32 of the 28 bytes before
    …           streams, coarse levels first, without gaps
    …           the directory

The directory is three lengths (u32), and as many bytes: the head, JSON compressed with zlib; the models, one
stream of numbers (see entropy); and a record for each block.

A block is the children of nodes 16384·n … 16384·n + 16383 of one level; in version 1 of 4096. It has a
stream for their structure and flags, one for their areas, and one for each channel; it is decoded with
nothing but the levels above it. Its record is u32s: how many of the children are nodes, how many children
there are, and of each stream its bytes and their CRC-32. After the levels come blocks of as many split cells
(areas of rows, then each channel), of as many kept nodes (each channel), both of one level from version 3 on,
and other tensors in pieces of a megabyte, compressed with xz.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Int64s, Uint8s, Uint32s
from octex.files import open_file
from octex.tree.layout import SplitTable, TreeArrays
from octex.tree.split import counts_of

MAGIC = b"\x89OCTZ\r\n\x1a"
FORMAT = "octex archive"
FORMAT_VERSION = 3
#: Nodes of a block, by version, a multiple of eight: blocks of one level share no group. Also split cells,
#: kept nodes.
BLOCKS = {1: 1 << 12, 2: 1 << 14, 3: 1 << 14}
PIECE = 1 << 20
START = 32

TREE = tuple(f"tree/{name}" for name in TreeArrays._fields)
SPLIT = tuple(f"split/{name}" for name in SplitTable._fields)
KEPT = "kept/cells"


def is_archive(path: str | os.PathLike[str]) -> bool:
    """Say whether a file begins as an archive does."""
    with suppress(OSError), open_file(path) as file:
        return file.read(len(MAGIC)) == MAGIC
    return False


class Block(NamedTuple):
    """The children of some nodes of a level."""

    level: int  # of the nodes
    first: int
    last: int


class Named(NamedTuple):
    """A channel's arrays as bytes (rows, components, bytes of a value)."""

    values: Uint8s
    split_values: Uint8s
    kept_values: Uint8s


def blocks_of(level_nodes: Int64s, level: int, version: int = FORMAT_VERSION) -> Iterator[Block]:
    """Yield the blocks of a level's nodes."""
    size = BLOCKS[version]
    begin, end = int(level_nodes[level]), int(level_nodes[level + 1])
    while begin < end:
        last = min((begin // size + 1) * size, end)
        yield Block(level, begin, last)
        begin = last


def parts(ends: Int64s, version: int = FORMAT_VERSION) -> Iterator[slice]:
    """Yield runs of split cells or kept nodes, of which ``ends`` (levels + 1,) come before each level."""
    for first, end in pairwise(ends.tolist()):
        for begin in range(first, end, BLOCKS[version]):
            yield slice(begin, min(begin + BLOCKS[version], end))


def ends_of(cells: Uint32s, level_cells: Int64s) -> Int64s:
    """Return how many of some cells, ascending, come before each level, and how many there are."""
    found: Int64s = np.searchsorted(cells, level_cells).astype(np.int64)
    return found


def as_bytes(array: Array) -> Uint8s:
    """Return values (rows, components) as bytes (rows, components, size)."""
    rows, components = array.shape
    return array.view(np.uint8).reshape(rows, components, array.dtype.itemsize)


def named(tensors: Mapping[str, Array], name: str) -> Named:
    """Return a channel's arrays; those that are not there have no rows."""
    values = as_bytes(tensors[f"channels/{name}"])
    return Named(
        values,
        *(
            as_bytes(tensors[key]) if key in tensors else values[:0]
            for key in (f"split/channels/{name}", f"kept/channels/{name}")
        ),
    )


def known_names(tensors: Mapping[str, Array], channels: Sequence[str]) -> set[str]:
    """Return the names of the tensors that are not coded as they are."""
    found = {*TREE, *SPLIT, KEPT}
    for name in channels:
        found |= {f"channels/{name}", f"split/channels/{name}", f"kept/channels/{name}"}
    return found & tensors.keys()


def first_rows(facings: Uint8s) -> Int64s:
    """Return the first row of each split cell, then the number of rows."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts_of(facings))])
