"""A .ptx file read in the most obvious way: a slow and simple judge of octex's."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

TYPES = ("<u1", "<u2", "<f2", "<f4")


def read(path: Path) -> tuple[list[Any], list[dict[int, np.ndarray]], dict[str, bytes]]:
    """Return the faces' records, their texels (v, u, channels) by level and face, and metadata as bytes."""
    data = path.read_bytes()
    head = struct.unpack("<4sIIIiHHIIIIIIQII", data[:64])
    kind, channels, levels, count = np.dtype(TYPES[head[3]]), head[5], head[6], head[7]
    extended, info, constants, sizes, leveldata = head[8], head[9], head[10], head[11], head[13]
    large = struct.unpack("<HHHHIIQQQ", data[64:104])
    assert extended == 40
    at = 104
    faces = list(struct.iter_unpack("<bbBB4i", zlib.decompress(data[at : at + info])))
    at += info
    pixel = kind.itemsize * channels
    averages = zlib.decompress(data[at : at + constants])
    at += constants
    assert sizes == 16 * levels
    infos = list(struct.iter_unpack("<QII", data[at : at + sizes]))
    at += sizes
    assert infos[0][2] == count == len(faces)
    place = at
    found: list[dict[int, np.ndarray]] = []
    shortest = [1 if flags & 1 else min(u, v) for u, v, _, flags, *_ in faces]
    for level, (_, header, n) in enumerate(infos):
        words = struct.unpack(f"<{n}I", zlib.decompress(data[place : place + header]))
        place += header
        order = sorted(range(count), key=lambda face: -shortest[face]) if level else range(count)
        found.append({})
        for face, word in zip(order, words, strict=False):
            u, v, _, flags = faces[face][:4]
            block = data[place : place + (word & 0x3FFFFFFF)]
            place += len(block)
            if flags & 1:
                one = np.frombuffer(averages[face * pixel :][:pixel], kind)
                found[level][face] = np.broadcast_to(one, (1 << v, 1 << u, channels))
            else:
                found[level][face] = decoded(block, word >> 30, u - level, v - level, channels, kind)
    at += leveldata
    metadata: dict[str, bytes] = {}
    entries = zlib.decompress(data[at : at + head[14]]) if head[14] else b""
    at += head[14] + 8
    while entries:
        size = entries[0]
        key, (length,) = entries[1:size].decode(), struct.unpack("<I", entries[size + 2 : size + 6])
        metadata[key], entries = entries[size + 6 : size + 6 + length], entries[size + 6 + length :]
    entries = zlib.decompress(data[at : at + large[4]]) if large[4] else b""
    at += large[4]
    while entries:
        size = entries[0]
        key, (_, zipped) = entries[1:size].decode(), struct.unpack("<II", entries[size + 2 : size + 10])
        metadata[key], entries = zlib.decompress(data[at : at + zipped]), entries[size + 10 :]
        at += zipped
    return faces, found, metadata


def decoded(block: bytes, encoding: int, u: int, v: int, channels: int, kind: np.dtype) -> np.ndarray:
    """Return the texels of a block."""
    if encoding == 0:
        return np.broadcast_to(np.frombuffer(block, kind), (1 << v, 1 << u, channels))
    if encoding == 3:
        tile_u, tile_v, header = struct.unpack("<bbI", block[:6])
        words = [word for (word,) in struct.iter_unpack("<I", zlib.decompress(block[6 : 6 + header]))]
        place, rows = 6 + header, []
        for _ in range(1 << v - tile_v):
            row = []
            for _ in range(1 << u - tile_u):
                word = words.pop(0)
                size = word & 0x3FFFFFFF
                row.append(decoded(block[place : place + size], word >> 30, tile_u, tile_v, channels, kind))
                place += size
            rows.append(np.concatenate(row, axis=1))
        return np.concatenate(rows, axis=0)
    values = np.frombuffer(zlib.decompress(block), kind).tolist()
    if encoding == 2:
        total = 0
        for n, step in enumerate(values):
            total = (total + step) % (1 << 8 * kind.itemsize)
            values[n] = total
    planar = np.array(values, kind).reshape(channels, 1 << v, 1 << u)
    return planar.transpose(1, 2, 0)
