"""Reads web files, .octw, as the tensors of a render file; also from glTF models that contain one.

octex.formats.web writes them. They lack the areas of leaves and of split cells' rows: these share the rest of
their node's area evenly.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from octex.archive.layout import (
    KEPT_NAME,
    SPLIT_NAMES,
    TREE_NAMES,
    WEB_MAGIC,
    DamagedError,
    channel_names,
    render_metadata,
)
from octex.archive.read import Decoded, naming
from octex.arrays import Array, Bools, Int64s, Uint8s, bit_counts
from octex.channels import decode
from octex.errors import ModelError
from octex.files import OCTREE_EXTENSION, open_file
from octex.gltf import Document
from octex.tree.areas import AREAS, area_codes
from octex.tree.children import groups_of, octants_of
from octex.tree.layout import FACING_FLAGS, KEPT, MAX_CELLS, MAX_DEPTH, SPLIT
from octex.tree.split import shared_codes

VERSION = 1
_HEAD = 16
_AGAIN = "write it again"
_FAULTS = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RecursionError)


def read(path: str | os.PathLike[str]) -> Decoded:
    """Read a web file, or the one in a .glb or .gltf file with the extension EXT_octree_texture.

    Raises TextureFileError for a file that is missing, damaged, of another version or without an octree.
    """
    with naming(path), open_file(path) as file:
        content = file.read()
        if not content.startswith(WEB_MAGIC):
            content = _carried(Path(path), content)
        return _read(content)


def _carried(path: Path, content: bytes) -> bytes:
    """Return the web file in a glTF model."""
    try:
        document = Document(path, content)
        entry = document.json.get("extensions", {}).get(OCTREE_EXTENSION)
        if entry is None:
            raise DamagedError(f"is a model without {OCTREE_EXTENSION}; octex convert makes a texture of it")
        octree = entry["octrees"][0]
        if "uri" in octree:
            return document.resource(octree["uri"], OCTREE_EXTENSION)
        return bytes(document.view(octree["bufferView"])[0])
    except (*_FAULTS, ModelError) as error:
        raise DamagedError(f"its {OCTREE_EXTENSION} is damaged ({error}); {_AGAIN}") from None


class _Stream:
    """A stream of bytes, read from the front."""

    def __init__(self, name: str, packed: bytes, size: int) -> None:
        self.name, self._at = name, 0
        try:
            whole = zlib.decompressobj(-15).decompress(packed, size + 1)
        except zlib.error:
            raise self.damaged() from None
        if len(whole) != size:
            raise self.damaged()
        self._bytes: Uint8s = np.frombuffer(whole, np.uint8)

    def take(self, count: int) -> Uint8s:
        """Return the next bytes."""
        taken = self._bytes[self._at : self._at + count]
        self._at += count
        return taken

    def damaged(self) -> DamagedError:
        """Return the error for wrong bytes."""
        return DamagedError(f"is damaged, in {self.name}; {_AGAIN}")


class _PartContent:
    """The content of a part, as far as read."""

    def __init__(self, part: dict[str, Any]) -> None:
        #: The numbers of cells and of nodes before each level, and of all.
        self.level_cells, self.level_nodes = (
            np.array(part[name], np.int64) for name in ("levelCells", "levelNodes")
        )
        firsts, depth = (self.level_cells, self.level_nodes), part["depth"]
        if not 0 <= depth <= MAX_DEPTH or any(counts.shape != (depth + 2,) for counts in firsts):
            raise ValueError
        level_sizes, node_counts = map(np.diff, firsts)
        if self.level_cells[0] or self.level_nodes[0] or (node_counts < 0).any():
            raise ValueError
        if self.level_cells[-1] > MAX_CELLS or (level_sizes < np.maximum(node_counts, 1)).any():
            raise ValueError
        self.kept, (self.split, self.rows) = int(part["kept"]), map(int, part["split"])
        self.channels: dict[str, int] = {each["name"]: each["components"] for each in part["channels"]}
        cells, nodes = int(self.level_cells[-1]), int(self.level_nodes[-1])
        if not all(1 <= width <= 4 for width in self.channels.values()):
            raise ValueError
        if not (0 <= self.kept <= nodes and 0 <= self.split <= min(cells, self.rows) <= 6 * cells):
            raise ValueError
        self.masks = np.zeros((2, -(-nodes // 8) * 8), np.uint8)
        self.flags, self.areas = np.zeros((2, cells), np.uint8)
        self.values = {name: np.zeros((cells, width), np.uint8) for name, width in self.channels.items()}
        self.above = np.zeros(1, np.int64)  # the cells that are nodes of the level above
        self.tables: dict[str, Array] = {}
        self.row_values: dict[str, Array] = {}

    def size(self, levels: list[int] | None) -> int:
        """Return the bytes of the stream of levels, or of the tables for None."""
        width = sum(self.channels.values())
        if levels is None:
            return 4 * self.kept + 5 * self.split + width * (self.kept + self.rows)
        counts = self.level_cells, self.level_nodes
        cells, nodes = (np.diff(each)[slice(*levels)].sum() for each in counts)
        above = np.diff(self.level_nodes)[max(levels[0] - 1, 0) : levels[1] - 1].sum()
        return int(2 * above + nodes + (1 + width) * cells)

    def take_level(self, level: int, stream: _Stream) -> None:
        """Read the cells of a level."""
        level_nodes = self.level_nodes
        first, end = self.level_cells[level : level + 2].tolist()
        parents, is_node = np.zeros(1, np.int64), np.array([level_nodes[-1] > 0])
        has_parents = np.uint8(level > 0)
        if level:
            rows = slice(*level_nodes[level - 1 : level + 1].tolist())
            count = rows.stop - rows.start
            nodes, leaves = self.masks[:, rows] = stream.take(2 * count).reshape(2, count)
            owners, octants = octants_of(nodes | leaves)
            is_node = nodes[owners] >> octants & np.uint8(1) != 0
            parents = self.above[owners]
        if parents.size != end - first or is_node.sum() != np.diff(level_nodes)[level]:
            raise stream.damaged()
        above = parents[is_node]
        self.above = first + np.flatnonzero(is_node)
        self.areas[self.above] = stream.take(above.size) + has_parents * self.areas[above]
        if level:
            self._share_areas(first, parents, is_node)
        self.flags[first:end] = stream.take(end - first) ^ has_parents * self.flags[parents]
        for values in self.values.values():
            coded = stream.take(values.shape[1] * (end - first)).reshape(-1, end - first).T
            values[first:end] = coded + has_parents * apart(values[parents])
            if values.shape[1] == 3:  # the inverse of `apart`
                values[first:end, ::2] += values[first:end, 1:2]

    def _share_areas(self, first: int, parents: Int64s, is_node: Bools) -> None:
        """Set the areas of a level's leaves: equal parts of the rest of their parent's."""
        below = slice(int(parents[0]), int(parents[-1]) + 1)
        owners, size = parents - below.start, below.stop - below.start
        taken = np.bincount(owners[is_node], AREAS[self.areas[first:][: owners.size][is_node]], size)
        count = np.maximum(np.bincount(owners[~is_node], minlength=size), 1)
        # A child's face is a quarter of its node's.
        shares = np.maximum(4.0 * AREAS[self.areas[below]] - taken, 0.0) / count
        self.areas[first + np.flatnonzero(~is_node)] = area_codes(shares)[owners[~is_node]]

    def take_tables(self, stream: _Stream) -> None:
        """Read the rows of kept nodes and of split cells."""
        steps = stream.take(4 * (self.kept + self.split)).reshape(4, -1).T
        steps = np.ascontiguousarray(steps).view("<u4")[:, 0].astype(np.int64)
        kept, split = np.cumsum(steps[: self.kept]), np.cumsum(steps[self.kept :])
        facings = stream.take(self.split)
        counts = bit_counts(facings & np.uint8(FACING_FLAGS)).astype(np.int64)
        owners = np.concatenate([kept, np.repeat(split, counts)])
        if owners.size != self.kept + self.rows or (owners >= self.flags.size).any():
            raise stream.damaged()
        areas = np.repeat(shared_codes(self.areas[split], counts), counts)
        self.tables = dict(zip(SPLIT_NAMES, (split.astype(np.uint32), facings, areas), strict=True))
        self.tables[KEPT_NAME] = kept.astype(np.uint32)
        for name, values in self.values.items():
            rows = stream.take(values.shape[1] * owners.size).reshape(values.shape[1], -1).T
            self.row_values[name] = np.ascontiguousarray(rows + values[owners])


def apart(values: Uint8s) -> Uint8s:
    """Return colours (n, 3) with red and blue minus green; others unchanged."""
    if values.shape[1] != 3:
        return values
    return np.stack([values[:, 0] - values[:, 1], values[:, 1], values[:, 2] - values[:, 1]], axis=1)


def _read(content: bytes) -> Decoded:
    if len(content) < _HEAD or not content.startswith(WEB_MAGIC):
        raise DamagedError(f"is damaged: no octex web file; {_AGAIN}")
    version, length = struct.unpack_from("<II", content, len(WEB_MAGIC))
    if version != VERSION:
        raise DamagedError(f"has version {version} of web files, and octex reads {VERSION}; update octex")
    first = _HEAD + length
    try:
        return _contents(json.loads(content[_HEAD:first]), content, first)
    except _FAULTS:
        raise DamagedError(f"is damaged, in header; {_AGAIN}") from None


def _contents(header: dict[str, Any], content: bytes, first: int) -> Decoded:
    """Return the content, with streams from ``first`` on; raises one of ``_FAULTS`` for a bad header."""
    parts = header["parts"]
    if len(parts) != 1:
        raise DamagedError(f"has {len(parts)} parts; write a file of one part's texture")
    part = parts[0]
    tree = _PartContent(part)
    corner, size = [float(x) for x in part["origin"]], float(part["size"])
    bounds = part.get("bounds", [corner, [x + size for x in corner]])
    forms = {each["name"]: (each["space"], *map(float, each["range"])) for each in part["channels"]}
    chunks = [chunk["levels"] for chunk in part["chunks"]]
    if [k for levels in chunks if levels for k in range(*levels)] != list(range(part["depth"] + 1)):
        raise ValueError
    for number, levels in enumerate(chunks):
        name = f"0-levels-{number}"
        begin, length = map(int, header["streams"][name])
        packed = content[first + begin :][:length]
        if begin < 0 or len(packed) < length:
            raise DamagedError(
                f"ends too early: {first + begin + length:,} bytes are expected; copy it again"
            )
        stream = _Stream(name, packed, tree.size(levels))
        if levels is None:
            tree.take_tables(stream)
        else:
            for level in range(*levels):
                tree.take_level(level, stream)
    spaces = {
        name: space if (low, high) == (0.0, 1.0) or space != "srgb" else "linear"
        for name, (space, low, high) in forms.items()
    }
    metadata = render_metadata({"origin": corner, "size": size}, bounds, spaces, {})
    return Decoded(_tensors(tree, forms), metadata, {})


def _tensors(tree: _PartContent, forms: dict[str, tuple[str, float, float]]) -> dict[str, Array]:
    arrays = groups_of(tree.masks), tree.level_cells, tree.level_nodes, tree.flags, tree.areas
    tensors: dict[str, Array] = dict(zip(TREE_NAMES, arrays, strict=True))
    flagged = tree.flags & np.uint8(SPLIT | KEPT)
    if flagged.any() != bool(tree.tables):
        raise DamagedError(f"is damaged: its tables are not those of its flags; {_AGAIN}")
    has_split, has_kept = tree.split > 0, tree.kept > 0
    tensors |= {name: tree.tables[name] for name in SPLIT_NAMES if has_split}
    if has_kept:
        tensors[KEPT_NAME] = tree.tables[KEPT_NAME]
    for name, values in tree.values.items():
        rows = tree.row_values.get(name, values[:0])
        of_all = values, rows[tree.kept :], rows[: tree.kept]
        are_there = True, has_split, has_kept
        for key, codes, is_there in zip(channel_names(name), of_all, are_there, strict=True):
            if is_there:
                tensors[key] = _decoded(codes, *forms[name])
    return tensors


def _decoded(codes: Uint8s, space: str, low: float, high: float) -> Array:
    """Return codes, or for channels beyond 0 … 1 their values."""
    if (low, high) == (0.0, 1.0):
        return codes
    light = decode(codes, space)  # type: ignore[arg-type]
    return (low + (high - low) * light).astype(np.float32)
