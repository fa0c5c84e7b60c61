"""The parts of an archive: blocks, their streams, and names; octex/formats/FORMAT.md draws the bytes.

A block is the children of up to ``BLOCK`` nodes of one level, with the rows of split ones and the
coefficients of kept ones. It has a stream for its structure and flags, one for its areas, and one for each
channel. A stream needs only the levels above its block.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Int64s, Uint8s, Uint32s, bit_counts
from octex.container import without_duplicates
from octex.tree.layout import FACING_FLAGS, KEPT, NO_KEPT, NO_SPLIT, SPLIT, KeptTable, SplitTable, TreeArrays

MAGIC = b"\x89OCTZ\r\n\x1a"
FORMAT_VERSION = 1
#: The format of render files, which octex/texture/file.py draws.
RENDER_FORMAT, RENDER_VERSION = "octex", 1
#: How web files begin, and glTF models of one file.
WEB_MAGIC, GLB_MAGIC = b"octexweb", b"glTF"
#: Nodes of a block, a multiple of eight: blocks share no group.
BLOCK = 1 << 14
#: Bytes of a piece of another tensor.
PIECE = 1 << 20
START = 32
#: Terms of a prediction: sums of differences on the cell's side, on all sides, of neighbours; the mean of the
#: siblings so far; errors and differences of 3 components.
TERMS = 10
#: Weights are parts of 2²⁰, one set for each class of variance around.
WEIGHT_BITS, CLASSES = 20, 5

#: The kinds of streams besides the channels, whose names begin otherwise.
STRUCTURE, AREAS = "\0structure", "\0areas"

TREE_NAMES = tuple(f"tree/{name}" for name in TreeArrays._fields)
SPLIT_NAMES = tuple(f"split/{name}" for name in SplitTable._fields)
KEPT_NAME = "kept/cells"


class DamagedError(Exception):
    """A fault of the file, without the file's name."""


class Place(NamedTuple):
    """Counts of all that precedes a place in the file's order."""

    node: int
    cell: int
    split: int  # split cells
    row: int  # their rows
    kept: int  # kept nodes


class Block(NamedTuple):
    """The children of nodes of a level."""

    level: int  # of the nodes
    first: int
    last: int
    begin: Place
    end: Place

    @property
    def counts(self) -> Place:
        """The block's counts."""
        return Place(*(after - before for before, after in zip(self.begin, self.end, strict=True)))


class ChannelBytes(NamedTuple):
    """A channel's arrays as bytes (rows, components, bytes of a value)."""

    values: Uint8s
    split_values: Uint8s
    kept_values: Uint8s


class Form(NamedTuple):
    """The form of a channel's values."""

    components: int
    size: int  # bytes of a value: 1, 2, 4
    is_float: int
    error: int  # the largest change of a value
    unit: int  # differences are measured in 2ᵘⁿⁱᵗ


class Coding(NamedTuple):
    """The coding of a channel's values."""

    form: Form
    weights: Int64s  # (groups · terms,)   of guesses


class CodedArrays(NamedTuple):
    """The arrays to archive, or decoded so far."""

    arrays: TreeArrays
    split: SplitTable
    kept: KeptTable
    original: dict[str, ChannelBytes]
    decoded: dict[str, ChannelBytes]  # as they will be read: the same arrays where nothing may move


def coded_arrays(tensors: Mapping[str, Array], channels: Sequence[str]) -> CodedArrays:
    """Return a render file's tensors as arrays by kind; raises KeyError for missing ones."""
    has_split, has_kept = SPLIT_NAMES[0] in tensors, KEPT_NAME in tensors
    split = SplitTable(*(tensors[name] for name in SPLIT_NAMES)) if has_split else NO_SPLIT
    kept = KeptTable(tensors[KEPT_NAME]) if has_kept else NO_KEPT
    named = {}
    for name in channels:
        keys = channel_names(name)
        values = _as_bytes(tensors[keys[0]])
        of_split = _as_bytes(tensors[keys[1]]) if has_split else values[:0]
        named[name] = ChannelBytes(values, of_split, _as_bytes(tensors[keys[2]]) if has_kept else values[:0])
    return CodedArrays(TreeArrays(*(tensors[name] for name in TREE_NAMES)), split, kept, named, named)


def _as_bytes(array: Array) -> Uint8s:
    rows, components = array.shape
    return array.view(np.uint8).reshape(rows, components, array.dtype.itemsize)


def channel_names(name: str) -> tuple[str, str, str]:
    """Return the names of a channel's tensors."""
    return f"channels/{name}", f"split/channels/{name}", f"kept/channels/{name}"


def known_names(tensors: Mapping[str, object], channels: Sequence[str]) -> set[str]:
    """Return the names of the tensors that streams of blocks hold."""
    names = {*TREE_NAMES, *SPLIT_NAMES, KEPT_NAME}.union(*map(channel_names, channels))
    return names & tensors.keys()


def render_metadata(
    placement: Any, bounds: Any, spaces: Mapping[str, str], provenance: Mapping[str, str]
) -> dict[str, str]:
    """Return the metadata of a render file."""
    parts = {"placement": placement, "bounds": bounds, "channels": spaces, "provenance": provenance}
    texts = {name: json.dumps(part) for name, part in parts.items()}
    return {"format": RENDER_FORMAT, "format_version": str(RENDER_VERSION), **texts}


def channels_in(metadata: Mapping[str, str]) -> list[str]:
    """Return the names of a render file's channels; raises KeyError, TypeError or ValueError."""
    channels = json.loads(metadata["channels"], object_pairs_hook=without_duplicates)
    return list(channels.keys()) if isinstance(channels, dict) else []


def pieces_of(sizes: Mapping[str, int], channels: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Yield the pieces of other tensors, from their sizes in bytes: name, begin and end."""
    block_tensors = known_names(sizes, channels)
    for name, size in sizes.items():
        for begin in range(0, size if name not in block_tensors else 0, PIECE):
            yield name, begin, min(begin + PIECE, size)


def runs(first: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield the first node of each block of a level, and the end of the block."""
    while first < end:
        last = min((first // BLOCK + 1) * BLOCK, end)
        yield first, last
        first = last


def after_root(flags: int, n_nodes: int) -> Place:
    """Return the place after the root, by its flags."""
    is_split = flags // SPLIT
    rows = (flags & FACING_FLAGS).bit_count() * is_split
    return Place(min(n_nodes, 1), 1, is_split, rows, int(flags & KEPT > 0))


def root_arrays(content: CodedArrays, place: Place) -> list[Array]:
    """Return the root's data: flags, area, areas of its rows, and its rows of values by channel."""
    arrays, rows = content.arrays, (1, place.row, place.kept)
    listed = [arrays.flags[:1], arrays.areas[:1], content.split.areas[: place.row]]
    for channel in content.original.values():
        listed += [array[:count] for array, count in zip(channel, rows, strict=True)]
    return listed


def owners_of(split: SplitTable, block: Block) -> Uint32s:
    """Return the cell of each row of a block's split cells."""
    split_cells = slice(block.begin.split, block.end.split)
    return np.repeat(
        split.cells[split_cells], bit_counts(split.facings[split_cells] & np.uint8(FACING_FLAGS))
    )
