"""O-Voxel's files, .vxz: chunks of a grid, each an octree of child masks and a byte for each value.

The layout is that of Microsoft's TRELLIS.2, o-voxel/o_voxel/io/vxz.py, version 0: "VXZ", a byte for the
version, where the data begin (4 bytes, big-endian), a JSON header, and the chunks one after another. The
octree of a chunk has a byte for each node, depth first, whose bit 4x + 2y + z says that there is a child;
its values are in the order of its leaves.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from typing import Any

import numpy as np

from octex.arrays import Array, Int64s, Uint8s, bit_counts
from octex.errors import ModelError
from octex.jit import kernel

ENDING = ".vxz"
_LZMA = [{"id": lzma.FILTER_LZMA2, "preset": 9}]
# Deflate packs at most 1032 bytes into one; LZMA about 7000.
_MOST_PER_BYTE = 8192
_DEEPEST_CHUNK = 10


def unpack_vxz(data: bytes, name: str) -> tuple[Int64s, dict[str, Array]]:
    """Return the coords (n, 3) of a file's voxels, and their values (n, components), uint8, by name.

    Raises ModelError, with ``name``, for what is damaged, and for filters and codes that octex does not read.
    """
    if data[:3] != b"VXZ" or len(data) < 8:
        raise ModelError(f"{name} is no .vxz file, or is damaged")
    if data[3]:
        raise ModelError(f"{name} is a .vxz file of version {data[3]}; octex reads version 0")
    try:
        (start,) = struct.unpack_from(">I", data, 4)
        header = json.loads(data[8:start])
        for key, known in (("filter", ("none",)), ("compression", ("none", "deflate", "lzma"))):
            if header[key] not in known:
                raise ModelError(
                    f"{name} has the {key} {header[key]!r}, which octex does not read; write it with "
                    f"{key}={known[-1]!r}"
                )
        parts = [_chunk(memoryview(data)[start:], chunk, header) for chunk in header["chunks"]]
    except ModelError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        raise ModelError(f"{name} is damaged ({type(error).__name__}: {error}); write it again") from None
    except (zlib.error, lzma.LZMAError, RecursionError, struct.error) as error:
        raise ModelError(f"{name} is damaged ({error}); write it again") from None
    if not parts:
        raise ModelError(f"{name} has no voxels")
    names = parts[0][1]
    values = {each: np.concatenate([rows[each] for _, rows in parts]) for each in names}
    return np.concatenate([coords for coords, _ in parts]), values


def _chunk(
    data: memoryview, chunk: dict[str, Any], header: dict[str, Any]
) -> tuple[Int64s, dict[str, Array]]:
    first, length = chunk["ptr"]
    content = data[first : first + length]

    def part(key: str) -> Uint8s:
        begin, size = chunk[key]
        if begin < 0 or size < 0 or begin + size > len(content):
            raise ValueError(f"{key} reaches outside of its chunk")
        return np.frombuffer(_unpacked(content[begin : begin + size], header["compression"]), np.uint8)

    edge = int(header["chunk_size"])
    depth = edge.bit_length() - 1
    if edge != 1 << depth or not 1 <= depth <= _DEEPEST_CHUNK:
        raise ValueError(f"a chunk size of {edge}")
    masks = part("svo")
    count = int(bit_counts(masks).sum())
    coords = np.empty((count, 3), np.int64)
    leaves = _walk(masks, depth, coords)
    if leaves < 0:
        raise ValueError("its octree ends early, or has more than it says")
    coords = coords[:leaves]
    widths = {str(each): int(width) for each, width in header["attr"]}
    style = header["attr_interleave"]
    values: dict[str, Array] = {}
    if style == "all":
        rows = part("attr").reshape(leaves, sum(widths.values()))
        ends = np.cumsum([*widths.values()])
        values = dict(zip(widths, np.split(rows, ends[:-1], axis=1), strict=True))
    elif style == "as_is":
        values = {each: part(each).reshape(leaves, width) for each, width in widths.items()}
    else:
        for each, width in widths.items():
            values[each] = np.stack([part(f"{each}_{i}").reshape(leaves) for i in range(width)], axis=1)
    place = np.array(chunk["idx"], np.int64).reshape(3)
    return coords + place * edge, values


def _unpacked(data: memoryview, compression: str) -> bytes:
    most = _MOST_PER_BYTE * len(data)
    if compression == "none":
        return bytes(data)
    if compression == "deflate":
        return zlib.decompressobj(wbits=-15).decompress(data, most)
    return lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_LZMA).decompress(data, most)


@kernel
def _walk(masks: Uint8s, depth: int, coords: Int64s) -> int:
    """Write the leaves' coords (n, 3), depth first; return how many there are, −1 for a damaged octree."""
    left = np.zeros(depth, np.uint8)  # of each node above, the children to come
    place = np.zeros((depth + 1, 3), np.int64)
    level, at, count = 0, 0, 0
    if masks.size == 0:
        return 0
    left[0] = masks[0]
    at = 1
    while level >= 0:
        mask = np.int64(left[level])
        if mask == 0:
            level -= 1
            continue
        octant = 0
        while mask >> octant & 1 == 0:
            octant += 1
        left[level] = np.uint8(mask & (mask - 1))
        for axis in range(3):
            place[level + 1, axis] = 2 * place[level, axis] + (octant >> (2 - axis) & 1)
        if level + 1 == depth:
            coords[count] = place[depth]
            count += 1
        elif at == masks.size:
            return -1
        else:
            level += 1
            left[level] = masks[at]
            at += 1
    return count if at == masks.size else -1
