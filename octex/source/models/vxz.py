"""Read .vxz files: sparse voxels with attributes of bytes, as O-Voxel writes them.

The layout is that of Microsoft's TRELLIS.2, o-voxel/o_voxel/io/vxz.py, version 0: "VXZ", the version, the
offset of the binary part (big endian), a JSON header, and chunks. The octree of a chunk has a byte for each
node, depth first: bit 4x + 2y + z marks a child. The leaves' attributes follow in that order, or differences:
at each node from the child before ("parent"), or from a neighbouring voxel ("neighbor").
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from octex.arrays import Array, Int64s, Uint8s, bit_counts
from octex.errors import ModelError
from octex.jit import kernel
from octex.source.zstd import unpack_zstd

_LZMA = [{"id": lzma.FILTER_LZMA2, "preset": 9}]
_DEEPEST_CHUNK = 10
_MOST_COLUMNS = 64
#: Largest index of a chunk: that of the largest grid.
_FARTHEST = 1 << 21
#: Offsets to the voxel that a difference was taken from: the last of these that is stored.
_NEIGHBOURS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]], np.int64
)


def unpack_vxz(data: bytes, name: str) -> tuple[Int64s, dict[str, Array]]:
    """Return the coords (n, 3) of a file's voxels, and their values (n, components), uint8, by name.

    Raises ModelError, with ``name``, for damaged or unknown data, MissingExtraError if zstd is missing.
    """
    if data[:3] != b"VXZ" or len(data) < 8:
        raise ModelError(f"{name} is not a .vxz file, or is damaged; write it again")
    if data[3]:
        raise ModelError(f"{name} is a .vxz file of version {data[3]}; octex reads version 0: write it so")
    try:
        (start,) = struct.unpack_from(">I", data, 4)
        header = json.loads(data[8:start])
        choices_by_key = {
            "filter": ("neighbor", "parent", "none"),
            "compression": ("none", "deflate", "zstd", "lzma"),
            "attr_interleave": ("none", "all", "as_is"),
        }
        for key, choices in choices_by_key.items():
            if header[key] not in choices:
                raise ModelError(
                    f"{name} has the {key} {header[key]!r}, which octex does not read; write it with "
                    f"{key}={choices[-1]!r}"
                )
        parts = [_chunk(memoryview(data)[start:], chunk, header, name) for chunk in header["chunks"]]
    except ModelError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        raise ModelError(f"{name} is damaged ({type(error).__name__}: {error}); write it again") from None
    except (zlib.error, lzma.LZMAError, RecursionError, struct.error) as error:
        raise ModelError(f"{name} is damaged ({error}); write it again") from None
    if not parts:
        raise ModelError(f"{name} has no voxels; write it again")
    values = {key: np.concatenate([columns[key] for _, columns in parts]) for key in parts[0][1]}
    return np.concatenate([coords for coords, _ in parts]), values


def _chunk(
    data: memoryview, chunk: dict[str, Any], header: dict[str, Any], name: str
) -> tuple[Int64s, dict[str, Array]]:
    first, length = chunk["ptr"]
    content = data[first : first + length]
    unpack = _unpacker(header["compression"], name)

    def part(key: str, most: int) -> Uint8s:
        begin, size = chunk[key]
        if begin < 0 or size < 0 or begin + size > len(content):
            raise ValueError(f"{key} reaches outside of its chunk")
        return np.frombuffer(unpack(content[begin : begin + size], most + 1), np.uint8)

    edge = int(header["chunk_size"])
    depth = edge.bit_length() - 1
    if edge != 1 << depth or not 1 <= depth <= _DEEPEST_CHUNK:
        raise ValueError(f"a chunk size of {edge}")
    masks = part("svo", edge**3 // 7)
    coords = np.empty((int(bit_counts(masks).sum()), 3), np.int64)
    leaves = _walk(masks, depth, np.empty((0, 0), np.uint8), coords, np.empty((0, 0), np.uint8))
    if leaves < 0:
        raise ValueError("its octree ends early, or has more than it says")
    coords = coords[:leaves]
    widths = {str(key): int(width) for key, width in header["attr"]}
    if any(not 1 <= width <= _MOST_COLUMNS for width in widths.values()):
        raise ValueError(f"attributes of {max(widths.values())} columns")
    parts = {
        "all": {"attr": sum(widths.values())},
        "as_is": widths,
        "none": {f"{key}_{i}": 1 for key, width in widths.items() for i in range(width)},
    }[header["attr_interleave"]]
    rows = np.hstack([part(key, leaves * width).reshape(leaves, width) for key, width in parts.items()])
    if header["filter"] == "parent":
        steps, rows = rows, np.empty_like(rows)
        _walk(masks, depth, steps, coords, rows)
    elif header["filter"] == "neighbor":
        codes = (coords[:, 2] * edge + coords[:, 1]) * edge + coords[:, 0]
        order = np.argsort(codes)
        rows = np.ascontiguousarray(rows[order])
        _add_neighbours(coords[order], codes[order], edge, rows)
        rows[order] = rows.copy()
    columns = np.split(rows, np.cumsum([*widths.values()])[:-1], axis=1)
    index = np.array(chunk["idx"], np.int64).reshape(3)
    if (np.abs(index) > _FARTHEST).any():
        raise ValueError(f"a chunk at {index.tolist()}")
    return coords + index * edge, dict(zip(widths, columns, strict=True))


def _unpacker(compression: str, name: str) -> Callable[[memoryview, int], bytes]:
    """Return a function that unpacks bytes, up to a number of them."""
    if compression == "none":
        return lambda data, most: bytes(data[:most])
    if compression == "zstd":
        return lambda data, most: unpack_zstd(data, most, name)[0]
    if compression == "deflate":
        return lambda data, most: zlib.decompressobj(wbits=-15).decompress(data, most)
    return lambda data, most: lzma.LZMADecompressor(lzma.FORMAT_RAW, None, _LZMA).decompress(data, most)


@kernel
def _walk(masks: Uint8s, depth: int, steps: Uint8s, coords: Int64s, values: Uint8s) -> int:
    """Write the leaves' coords (n, 3), depth first; return their number, −1 for a damaged octree.

    With columns of steps, write values too: the root has the first row, a first child its parent's value, and
    each other child the value of the child before plus the next row.
    """
    # A stack of cells: level, x, y and z; and their values.
    stack = np.zeros((7 * depth + 1, 4), np.int64)
    stack_values = np.zeros((7 * depth + 1, steps.shape[1]), np.uint8)
    if len(steps) > 0:
        stack_values[0] = steps[0]
    above = min(masks.size, 1)
    at = count = 0
    row = 1
    while above > 0:
        above -= 1
        level, x, y, z = stack[above, 0], stack[above, 1], stack[above, 2], stack[above, 3]
        if level == depth:
            coords[count, 0], coords[count, 1], coords[count, 2] = x, y, z
            for k in range(stack_values.shape[1]):
                values[count, k] = stack_values[above, k]
            count += 1
            continue
        if at == masks.size:
            return -1
        mask = np.int64(masks[at])
        at += 1
        end = above
        for octant in range(8):
            end += int(mask >> octant & 1)
        child = end
        for octant in range(8):
            if mask >> octant & 1 == 0:
                continue
            child -= 1
            stack[child, 0], stack[child, 1] = level + 1, 2 * x + (octant >> 2)
            stack[child, 2], stack[child, 3] = 2 * y + (octant >> 1 & 1), 2 * z + (octant & 1)
            is_first = child == end - 1
            for k in range(stack_values.shape[1]):
                step = np.uint8(0) if is_first else steps[row, k]
                stack_values[child, k] = stack_values[above if is_first else child + 1, k] + step
            row += 0 if is_first else 1
        above = end
    return count if at == masks.size else -1


@kernel
def _add_neighbours(coords: Int64s, codes: Int64s, edge: int, values: Uint8s) -> None:
    """Add to each voxel, sorted by z, y and x, the value of a neighbour, which is complete by then."""
    for n in range(codes.size):
        for number in range(len(_NEIGHBOURS) - 1, -1, -1):
            step = _NEIGHBOURS[number]
            x, y, z = coords[n, 0] - step[0], coords[n, 1] - step[1], coords[n, 2] - step[2]
            code = (z * edge + y) * edge + x
            if min(x, min(y, z)) < 0:
                continue
            other = np.searchsorted(codes[:n], code)
            if other < n and codes[other] == code:
                for k in range(values.shape[1]):
                    values[n, k] += values[other, k]
                break
