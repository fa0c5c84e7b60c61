"""An independent writer of O-Voxel's files, by the text of their layout: slow, and of small chunks."""

from __future__ import annotations

import json
import lzma
import struct
import sys
import zlib
from collections.abc import Mapping
from importlib import import_module
from itertools import pairwise, product
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Place = tuple[int, ...]
#: The voxels that one is written as a difference from: the last one that is there counts.
BESIDE = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)]


def octree(places: Mapping[Place, Array], depth: int) -> tuple[bytes, list[Place], list[Array]]:
    """Child masks, depth first, the leaves in that order, and the differences of the filter "parent"."""
    masks, order, steps = bytearray(), [], [places[min(places, key=path_to(depth))]]

    def first(inside: list[Place]) -> Array:
        return places[min(inside, key=path_to(depth))]

    def visit(level: int, inside: list[Place]) -> None:
        if level == depth:
            order.extend(inside)
            return
        bit = depth - level - 1
        children: dict[int, list[Place]] = {}
        for place in inside:
            x, y, z = (each >> bit & 1 for each in place)
            children.setdefault(4 * x + 2 * y + z, []).append(place)
        masks.append(sum(1 << octant for octant in children))
        rows = [children[octant] for octant in sorted(children)]
        steps.extend(first(b) - first(a) for a, b in pairwise(rows))
        for row in rows:
            visit(level + 1, row)

    visit(0, list(places))
    return bytes(masks), order, steps


def path_to(depth: int) -> Any:
    """The octants from the root to a place."""
    return lambda place: [[each >> bit & 1 for each in place] for bit in range(depth - 1, -1, -1)]


def beside(places: Mapping[Place, Array], place: Place) -> Array:
    """The difference of the filter "neighbor"."""
    others = [tuple(int(a - b) for a, b in zip(place, step, strict=True)) for step in BESIDE]
    found = [places[other] for other in others if other in places]
    return places[place] - found[-1] if found else places[place]


def packed(data: bytes, compression: str) -> bytes:
    """Bytes as O-Voxel packs them."""
    if compression == "none":
        return data
    if compression == "deflate":
        return zlib.compress(data, 9)[2:-4]
    if compression == "zstd":
        module = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
        return bytes(import_module(module).compress(data))
    # Not 64 MB of a dictionary, and ten times that beside it, for a few bytes.
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 16}]
    return lzma.compress(data, lzma.FORMAT_RAW, filters=filters)


def vxz(
    coords: Array,
    values: Mapping[str, Array],
    *,
    compression: str = "lzma",
    style: str = "as_is",
    filtered: str = "none",
    **changes: Any,
) -> bytes:
    """A .vxz file of chunks of 8 cells, and some of its header changed."""
    widths = {name: each.shape[1] for name, each in values.items()}
    every = np.hstack(list(values.values()))
    chunks, binary = [], b""
    for index in np.unique(coords // 8, axis=0).tolist():
        chosen = np.flatnonzero((index == coords // 8).all(axis=1))
        places = {tuple((coords[row] % 8).tolist()): every[row] for row in chosen}
        masks, order, steps = octree(places, 3)
        by_filter = {"parent": steps, "neighbor": [beside(places, each) for each in order]}
        rows = np.stack(by_filter.get(filtered, [places[each] for each in order]))
        columns = np.split(rows, np.cumsum([*widths.values()])[:-1], axis=1)
        parts: dict[str, Array] = dict(zip(widths, columns, strict=True))
        if style == "all":
            parts = {"attr": rows}
        elif style == "none":
            parts = {f"{name}_{i}": each[:, i] for name, each in parts.items() for i in range(each.shape[1])}
        chunk: dict[str, Any] = {"idx": index}
        body = b""
        for key, data in (("svo", masks), *((key, each.tobytes()) for key, each in parts.items())):
            part = packed(data, compression)
            chunk[key] = [len(body), len(part)]
            body += part
        chunk["ptr"] = [len(binary), len(body)]
        binary += body
        chunks.append(chunk)
    header = {"num_voxel": len(coords), "chunk_size": 8, "filter": filtered, "compression": compression}
    header |= {"attr_interleave": style, "attr": [[name, width] for name, width in widths.items()]}
    text = json.dumps({**header, "chunks": chunks, **changes}).encode()
    return b"VXZ\0" + struct.pack(">I", len(text) + 8) + text + binary


def dual_grid(inside: Any, side: int) -> tuple[Array, Array, Array]:
    """Voxels of a grid, whose surface is where a function of positions (n, 3), 0 … 1, changes its sign.

    Returns the coords of voxels that have a crossed edge, their vertices within them (n, 3), at the mean of
    the crossings, and which of their edges along x, y and z to the highest corner are crossed (n, 3).
    """
    crossings: dict[Place, list[Array]] = {}
    crossed: dict[Place, list[bool]] = {}
    for corner in product(range(1, side), repeat=3):
        for axis in range(3):
            step = np.eye(3, dtype=int)[axis]
            low, high = (np.array(corner) - step) / side, np.array(corner) / side
            a, b = inside(low[None])[0], inside(high[None])[0]
            if (a < 0) == (b < 0):
                continue
            there = low + (high - low) * (a / (a - b))
            u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
            for move in (0 * u, u, v, u + v):
                voxel = tuple((np.array(corner) - 1 + move).tolist())
                crossings.setdefault(voxel, []).append(there * side - voxel)
                crossed.setdefault(voxel, [False] * 3)
            crossed[tuple((np.array(corner) - 1).tolist())][axis] = True
    coords = np.array(sorted(crossings))
    dual = np.stack([np.mean(crossings[tuple(each)], axis=0) for each in coords.tolist()])
    return coords, dual, np.array([crossed[tuple(each)] for each in coords.tolist()])
