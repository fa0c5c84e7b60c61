"""Web files, .octw: textures of 8 bits, coarse levels first; FORMAT.md draws their bytes.

Pages get the same streams. Each chunk holds one or more levels as one stream of raw deflate. Per level:

    node masks, leaf masks   a byte for each node of the level above
    areas                    a byte for each cell that is a node, minus its parent's
    flags                    a byte for each cell, XOR its parent's
    values                   of each channel, component after component, a byte for each cell, minus its
                             parent's; red and blue of colours are stored minus green

Numbers of cells and nodes follow from the masks, as in octex.tree.layout. Values are 8-bit; other types are
cast, floats from their range. A last chunk holds the rows of kept nodes and of split cells, if there are any.
octex.archive.web reads the file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from octex.archive.layout import WEB_MAGIC
from octex.archive.web import VERSION, apart
from octex.arrays import Array, bit_counts
from octex.channels import ChannelFormat
from octex.formats.streams import deflated, planes
from octex.processing.mapping import cast
from octex.texture import Channel, OctreeTexture
from octex.tree.children import masks_of
from octex.tree.layout import FACING_FLAGS
from octex.tree.split import rows_of

#: Most cells that the page's 24-bit numbers can index; deeper trees lose their finest levels.
MOST_CELLS = 1 << 24
#: Cells in the first chunk.
_FIRST = 8_000


class Prepared(NamedTuple):
    """A texture with 8 bits for a page, and its part of the header."""

    texture: OctreeTexture
    header: dict[str, Any]


def prepared(texture: OctreeTexture) -> Prepared:
    """Return a texture as pages and web files store it."""
    texture, ranges, notes = _with_bytes(texture)
    tree = texture.tree
    formats = [each.format for each in texture.channels.values()]
    slots = _slots(formats)
    header: dict[str, Any] = {
        "depth": tree.max_depth,
        "origin": list(texture.placement.origin),
        "size": texture.placement.size,
        "bounds": texture.bounds.tolist(),
        "levelCells": tree.arrays.level_cells.tolist(),
        "levelNodes": tree.arrays.level_nodes.tolist(),
        "leaves": tree.n_leaves,
        "channels": [
            {
                "name": form.name,
                "components": form.components,
                "space": form.space,
                "at": slots[form.name],
                "range": ranges.get(form.name, [0.0, 1.0]),
            }
            for form in formats
        ],
        "area": slots["area"],
        "flags": slots["flags"],
        "planes": slots["planes"],
        "notes": notes,
        "isMixed": any(leaves for leaves, _ in tree.cells_by_depth()[:-1]) or tree.kept.cells.size > 0,
        "kept": tree.kept.cells.size,
        "split": [tree.split.cells.size, tree.split.areas.size],
    }
    return Prepared(texture, header)


def _chunks(texture: OctreeTexture) -> Iterator[tuple[list[int] | None, bytes]]:
    """Yield streams with the range of their levels, first and end; None for the tables."""
    tree = texture.tree
    cells = tree.arrays.level_cells.tolist()
    starts = [0, *(k for k in range(1, tree.max_depth + 1) if cells[k + 1] > _FIRST), tree.max_depth + 1]
    parts = list(_levels(texture))
    for first, end in pairwise(dict.fromkeys(starts)):
        yield [first, end], b"".join(parts[first:end])
    if tree.kept.cells.size + tree.split.cells.size:
        yield None, _tables(texture)


def _with_bytes(texture: OctreeTexture) -> tuple[OctreeTexture, dict[str, list[float]], list[str]]:
    """Return an 8-bit texture that a page can show, the channels' ranges, and notes on the differences."""
    notes: list[str] = []
    ranges: dict[str, list[float]] = {}
    channels = dict(texture.channels)
    for name, channel in texture.channels.items():
        if channel.format.dtype == "uint8":
            continue
        if channel.format.dtype.startswith("float") and channel.format.space != "direction":
            channels[name], ranges[name] = _in_range(channel)
        low, high = ranges.get(name, (-1 if channel.format.space == "direction" else 0, 1))
        notes.append(f"{name.replace('_', ' ')}: shown with 8 bits, {low:.4g} to {high:.4g}")
    if notes:
        texture = cast(texture.with_cells(texture.tree, channels), "uint8")
    depth = texture.tree.max_depth
    cells = texture.tree.arrays.level_cells
    while depth and int(cells[depth + 1]) > MOST_CELLS:
        depth -= 1
    if depth < texture.tree.max_depth:
        notes.append(f"depth {depth} of {texture.tree.max_depth}: a page shows {MOST_CELLS:,} cells at most")
        texture = texture.level(depth)
    return texture, ranges, notes


def _in_range(channel: Channel) -> tuple[Channel, list[float]]:
    """Return a channel of floats scaled to 0 … 1, and the values that 0 and 1 stand for."""
    low, high = 0.0, 1.0
    for values in channel[1:]:
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    if (low, high) == (0.0, 1.0):
        return channel, [low, high]
    form = channel.format._replace(dtype="float32")
    scaled = [((values.astype(np.float64) - low) / (high - low)).astype(np.float32) for values in channel[1:]]
    return Channel(form, *scaled), [low, high]


def _tables(texture: OctreeTexture) -> bytes:
    """Return the last chunk: the rows of kept nodes and of split cells, minus the values of their cells."""
    split, kept = texture.tree.split, texture.tree.kept
    facings = split.facings & np.uint8(FACING_FLAGS)
    owners = np.concatenate([kept.cells, rows_of(split).cells])
    steps = [np.diff(cells.astype(np.int64), prepend=0) for cells in (kept.cells, split.cells)]
    parts = [planes(np.concatenate(steps)), facings.tobytes()]
    for channel in texture.channels.values():
        rows = np.concatenate([channel.kept_values, channel.split_values])
        parts.append(np.ascontiguousarray((rows - channel.values[owners]).T).tobytes())
    return b"".join(parts)


def _slots(formats: list[ChannelFormat]) -> dict[str, Any]:
    """Return where channels, areas and flags lie, [plane, first component], and which planes are sRGB."""
    planes_left: list[tuple[bool, list[int]]] = []
    slots: dict[str, Any] = {}

    def place(name: str, components: int, is_srgb: bool) -> None:
        for number, (is_srgb_plane, free_lanes) in enumerate([] if is_srgb else planes_left):
            lanes = [slot for slot in free_lanes if slot == 3 or not is_srgb_plane][:components]
            if len(lanes) == components and (components == 1 or lanes[0] == 0):
                slots[name] = [number, lanes[0]]
                planes_left[number] = is_srgb_plane, [slot for slot in free_lanes if slot not in lanes]
                return
        slots[name] = [len(planes_left), 0]
        planes_left.append((is_srgb, [slot for slot in range(components, 4) if planes_left or slot < 3]))

    slots["area"] = [0, 3]
    ranked = sorted(formats, key=lambda form: (form.name != "base_color", form.components != 3))
    if not formats or ranked[0].components == 4:
        planes_left.append((False, [0, 1, 2]))
    for form in ranked:
        place(form.name, form.components, form.space == "srgb")
    place("flags", 1, False)
    slots["planes"] = [is_srgb for is_srgb, _ in planes_left]
    return slots


def _levels(texture: OctreeTexture) -> Iterator[bytes]:
    """Yield the stream of each level."""
    arrays = texture.tree.arrays
    n_nodes = texture.tree.n_nodes
    node_masks, leaf_masks = (masks_of(arrays.groups, word)[:n_nodes] for word in range(2))
    parents_above = np.zeros(1, np.int64)  # nodes of the level above
    for level, (_, is_node) in enumerate(texture.tree.walk()):
        first, end = arrays.level_cells[level : level + 2].tolist()
        parts: list[Array] = []
        parents = np.zeros(1, np.int64)
        if level:
            node_rows = slice(*arrays.level_nodes[level - 1 : level + 1].tolist())
            parts += [node_masks[node_rows], leaf_masks[node_rows]]
            parents = np.repeat(parents_above, bit_counts(node_masks[node_rows] | leaf_masks[node_rows]))
        has_parent = np.uint8(level > 0)
        nodes = np.flatnonzero(is_node)
        parts.append(arrays.areas[first:end][nodes] - has_parent * arrays.areas[parents[nodes]])
        parts.append(arrays.flags[first:end] ^ has_parent * arrays.flags[parents])
        for channel in texture.channels.values():
            cells, parent_cells = apart(channel.values[first:end]), apart(channel.values[parents])
            parts.append(np.ascontiguousarray((cells - has_parent * parent_cells).T))
        parents_above = nodes + first
        yield b"".join(part.tobytes() for part in parts)


def packed_levels(texture: OctreeTexture, level: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return a part's header, with its chunks, and their streams by name; ``level`` 1 to 9 is deflate's."""
    texture, header = prepared(texture)
    streams: dict[str, bytes] = {}
    header["chunks"] = []
    for levels, stream in _chunks(texture):
        name = f"levels-{len(streams)}"
        streams[name] = deflated(stream, level)
        header["chunks"].append({"levels": levels, "bytes": len(streams[name])})
    return header, streams


def web_file(title: str, parts: Sequence[Mapping[str, Any]], streams: Mapping[str, bytes]) -> bytes:
    """Return a web file of parts and their streams N-NAME: a header, then meshes, then levels."""
    names = sorted(
        streams, key=lambda name: (not name.endswith("mesh"), *map(int, re.findall(r"\d+", name)[::-1]))
    )
    ends = np.cumsum([0, *(len(streams[name]) for name in names)]).tolist()
    spans = {name: [first, end - first] for name, (first, end) in zip(names, pairwise(ends), strict=True)}
    header = json.dumps({"title": title, "parts": parts, "streams": spans}).encode()
    head = WEB_MAGIC + np.array([VERSION, len(header)], "<u4").tobytes()
    return b"".join([head, header, *(streams[name] for name in names)])


def texture_file(texture: OctreeTexture, title: str) -> bytes:
    """Return the web file of a texture, without a mesh."""
    header, streams = packed_levels(texture, 9)
    return web_file(title, [{"name": "", **header}], {f"0-{name}": each for name, each in streams.items()})
