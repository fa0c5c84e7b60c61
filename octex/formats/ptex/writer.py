"""Writes .ptx files."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float64s, Floats, Int8s, Int64s, Uint32s
from octex.channels import ONE
from octex.files import replacing
from octex.formats.ptex import layout
from octex.formats.ptex.layout import Faces
from octex.parallel import ordered_map, start

#: Smaller blocks, in bytes, choose their encoding by an estimate, not by trial: zlib takes 8 µs per call.
_TRIED = 512
#: Bytes of faces that are encoded together.
_TOGETHER = 1 << 20
#: Smaller faces, in bytes, are encoded by one thread: parallel tasks would wait for each other.
_SHARED = 4096
#: Uncertainty of the estimate in bits, in favour of differences.
_UNSURE = 32


class PtexContents(NamedTuple):
    """The contents of a .ptx file."""

    mesh_type: str
    faces: Faces
    texels: Array  # (texels, channels)   of layout.DTYPES; face after face, each in rows from v = 0 up
    alpha_channel: int | None = None
    border_modes: tuple[str, str] = ("clamp", "clamp")
    edge_filter: str = "none"
    metadata: Mapping[str, str] = {}


def write_contents(contents: PtexContents, path: Path, executor: Executor) -> None:
    """Write a .ptx file with all levels.

    Each block gets the smaller encoding: texels, their differences, or one pixel. Faces of 128 KB and more
    are tiled, so that readers can decode parts. Averages are rounded, and multiplied by alpha. Raises
    OutputError if the file cannot be written.
    """
    faces, texels = contents.faces, contents.texels
    is_constant = _constant(texels, faces.counts)
    packing = start(executor, zlib.compress, layout.packed_faces(faces, is_constant).tobytes(), 9)
    levels, constants = _levels(contents, is_constant, executor)
    info = np.zeros(len(levels), layout.LEVEL_INFO)
    info["header"] = [len(level[0]) for level in levels]
    info["bytes"] = [sum(map(len, level)) for level in levels]
    info["faces"] = [len(level) - 1 for level in levels]
    packed = packing.result()
    averages = zlib.compress(constants.tobytes(), 9)
    entries = b""
    for name, text in contents.metadata.items():
        key, data = name.encode() + b"\0", text.encode() + b"\0"
        entries += bytes([len(key)]) + key + b"\0" + len(data).to_bytes(4, "little") + data
    zipped = zlib.compress(entries) if entries else b""

    header = np.zeros(1, layout.HEADER)
    header["magic"] = layout.MAGIC
    header["version"], header["minor_version"] = layout.VERSION, layout.MINOR_VERSION
    header["mesh_type"] = layout.MESH_TYPES.index(contents.mesh_type)
    header["data_type"] = layout.DTYPES.index(texels.dtype.name)
    header["alpha_channel"] = -1 if contents.alpha_channel is None else contents.alpha_channel
    header["channels"], header["levels"], header["faces"] = texels.shape[1], len(levels), len(faces.log2)
    header["extended_header"] = layout.EXTENDED_HEADER.itemsize
    header["face_info"], header["constants"], header["level_info"] = len(packed), len(averages), info.nbytes
    header["level_data"] = info["bytes"].sum()
    header["metadata_zipped"], header["metadata"] = len(zipped), len(entries)
    extended = np.zeros(1, layout.EXTENDED_HEADER)
    extended["u_border"], extended["v_border"] = map(layout.BORDER_MODES.index, contents.border_modes)
    extended["edge_filter"] = layout.EDGE_FILTERS.index(contents.edge_filter)
    before = [header.tobytes(), extended.tobytes(), packed, averages, info.tobytes()]
    after = [zipped, bytes(layout.BARRIER)]
    length = sum(map(len, [*before, *after])) + int(info["bytes"].sum())
    extended["edits_at"] = length
    before[1] = extended.tobytes()
    with replacing(path) as file:
        file.writelines(before)
        for level in levels:
            file.writelines(level)
        file.writelines(after)


def _levels(
    contents: PtexContents, is_constant: Bools, executor: Executor
) -> tuple[list[list[bytes]], Array]:
    """Return all levels, each a header and blocks, and the average of each face (n, channels)."""
    faces, texels, alpha = contents.faces, contents.texels, contents.alpha_channel
    dtype, is_triangle = texels.dtype, contents.mesh_type == layout.MESH_TYPES[layout.TRIANGLE]
    order, counts = layout.reduced_order(faces.log2, is_constant)
    sums = np.zeros((len(faces.log2), texels.shape[1]))
    firsts = np.cumsum(faces.counts) - faces.counts
    sums[is_constant] = texels[firsts[is_constant]]
    words = [np.zeros(count, np.uint32) for count in counts]
    blocks: list[list[bytes]] = [[b""] * count for count in counts.tolist()]
    places = np.empty_like(order)
    places[order] = np.arange(len(order))
    encode = partial(_encoded_group, texels, alpha, is_triangle)
    pixel = texels.shape[1] * dtype.itemsize
    groups = list(_groups(faces.log2, firsts, ~is_constant, pixel))
    small = [each for each in groups if pixel << each.u + each.v < _SHARED]
    large = [each for each in groups if pixel << each.u + each.v >= _SHARED]
    encoded = chain(
        zip(large, ordered_map(executor, encode, large), strict=True),
        zip(small, map(encode, small), strict=True),
    )
    for group, (averages, level_blocks) in encoded:
        sums[group.faces] = averages
        for level, (group_words, group_blocks) in enumerate(level_blocks):
            numbers = group.faces if level == 0 else places[group.faces]
            words[level][numbers] = group_words
            for number, block in zip(numbers.tolist(), group_blocks, strict=True):
                blocks[level][number] = block
    heads = [zlib.compress(each.astype("<u4").tobytes(), 9) for each in words]
    levels = [[head, *level] for head, level in zip(heads, blocks, strict=True)]
    return levels, _stored(sums, dtype).astype(dtype.newbyteorder("<"))


class _FaceGroup(NamedTuple):
    """Faces of one resolution."""

    faces: Int64s  # (n,)
    firsts: Int64s  # (n,)   the first texel of each
    u: int
    v: int


def _groups(log2: Int8s, firsts: Int64s, chosen_faces: Bools, pixel: int) -> Iterator[_FaceGroup]:
    key = log2[:, 0].astype(np.int64) << 8 | log2[:, 1]
    for each in np.unique(key[chosen_faces]).tolist():
        u, v = each >> 8, each & 255
        chosen = np.flatnonzero(chosen_faces & (key == each))
        step = max(_TOGETHER // (pixel << u + v), 1)
        for begin in range(0, len(chosen), step):
            part = chosen[begin : begin + step]
            yield _FaceGroup(part, firsts[part], u, v)


def _encoded_group(
    texels: Array, alpha: int | None, is_triangle: bool, group: _FaceGroup
) -> tuple[Float64s, list[tuple[Uint32s, list[bytes]]]]:
    """Return the averages (n, channels) of faces, and their blocks in each level."""
    u, v = group.u, group.v
    rows = group.firsts[:, None] + np.arange(1 << u + v)
    values = texels[rows].reshape(len(rows), 1 << v, 1 << u, -1)
    levels = [_encoded(values)]
    exact = values.astype(np.float64)
    if alpha is not None:
        multiply(exact, alpha, ONE[texels.dtype.name])
    for _ in range(1, min(u, v) - 1):
        exact = halved(exact, is_triangle)
        levels.append(_encoded(_stored(exact, texels.dtype)))
    averages = exact.mean(axis=(1, 2))
    if alpha is not None:
        share = averages[:, alpha, None] / ONE[texels.dtype.name]
        averages[:, _colors(alpha)] /= np.where(share == 0, 1.0, share)
    return averages, levels


def _encoded(values: Array) -> tuple[Uint32s, list[bytes]]:
    """Return the words and the blocks of faces' texels (n, v, u, channels)."""
    count, v, u, channels = values.shape
    pixel = channels * values.dtype.itemsize
    log2 = u.bit_length() - 1, v.bit_length() - 1
    tile = layout.tile_log2(*log2, pixel)
    if tile == log2:
        return _blocks(values)
    words, blocks = np.empty(count, np.uint32), []
    rows, columns = 1 << tile[1], 1 << tile[0]
    grid = values.reshape(count, v // rows, rows, u // columns, columns, channels).swapaxes(2, 3)
    for number, tiles in enumerate(grid):
        tile_words, tile_blocks = _blocks(tiles.reshape(-1, rows, columns, channels))
        header = zlib.compress(tile_words.astype("<u4").tobytes())
        prefix = np.array(tile, np.int8).tobytes() + len(header).to_bytes(4, "little")
        blocks.append(b"".join([prefix, header, *tile_blocks]))
        words[number] = len(blocks[-1]) | layout.TILED << layout.BLOCK_BITS
    return words, blocks


def _blocks(values: Array) -> tuple[Uint32s, list[bytes]]:
    """Return words and blocks of texels (n, v, u, channels), none of them tiled."""
    count = len(values)
    planar = np.ascontiguousarray(np.moveaxis(values, 3, 1)).reshape(count, -1)
    little = values.dtype.newbyteorder("<")
    size = planar.shape[1] * values.dtype.itemsize
    plain = planar.astype(little, copy=False).view(np.uint8)
    encodings = np.full(count, layout.ZIPPED, np.uint32)
    blocks: list[bytes]
    if values.dtype.kind == "u":
        steps = np.empty_like(planar)
        steps[:, 0] = planar[:, 0]
        np.subtract(planar[:, 1:], planar[:, :-1], out=steps[:, 1:])
        differences = steps.astype(little, copy=False).view(np.uint8)
        if size < _TRIED:
            is_differenced = _estimated_bits(differences) <= _estimated_bits(plain) + _UNSURE
            chosen = np.where(is_differenced[:, None], differences, plain).tobytes()
            encodings[is_differenced] = layout.DIFFERENCED
            blocks = [zlib.compress(chosen[at : at + size], 6, 9) for at in range(0, len(chosen), size)]
        else:
            blocks = []
            for number, (row, steps_of_row) in enumerate(zip(plain, differences, strict=True)):
                zipped, differenced = zlib.compress(row.tobytes()), zlib.compress(steps_of_row.tobytes())
                blocks.append(min(differenced, zipped, key=len))
                if len(differenced) <= len(zipped):
                    encodings[number] = layout.DIFFERENCED
    else:
        blocks = [zlib.compress(row.tobytes()) for row in plain]
    whole = np.ascontiguousarray(values).view(np.uint8).reshape(count, -1, values.shape[3] * little.itemsize)
    for number in np.flatnonzero((whole == whole[:, :1]).all(axis=(1, 2))).tolist():
        blocks[number] = whole[number, 0].tobytes()
        encodings[number] = layout.CONSTANT
    sizes = np.array([len(block) for block in blocks], np.uint32)
    return sizes | encodings << np.uint32(layout.BLOCK_BITS), blocks


def _estimated_bits(rows: Array) -> Int64s:
    """Estimate zlib's bits for rows of bytes (n, k): 8, from 144 on 9, in runs of equal bytes 1."""
    bits = (rows >= 144) + np.uint8(8)
    is_same = rows[:, 1:] == rows[:, :-1]
    bits[:, 3:][is_same[:, 2:] & is_same[:, 1:-1] & is_same[:, :-2]] = 1
    total: Int64s = bits.sum(axis=1, dtype=np.int64)
    return total


def _constant(texels: Array, counts: Int64s) -> Bools:
    """Return which faces have a single value (n,)."""
    firsts = np.cumsum(counts) - counts
    raw = np.ascontiguousarray(texels).view(np.uint8).reshape(len(texels), -1)
    differs = (raw[1:] != raw[:-1]).any(axis=1)
    differs = np.concatenate([[False], differs])
    differs[firsts] = False  # compared with the face before
    constant: Bools = ~np.logical_or.reduceat(differs, firsts)
    return constant


def multiply(values: Floats, alpha: int, one: float) -> None:
    """Multiply the colours' channels by alpha, where they are."""
    values[..., _colors(alpha)] *= values[..., alpha : alpha + 1] / one


def _colors(alpha: int) -> slice:
    """Return the channels that are multiplied by alpha: those before it, or if it is the first all others."""
    return slice(0, alpha) if alpha else slice(1, None)


def halved(texels: Array, is_triangle: bool) -> Array:
    """Return means (n, v/2, u/2, channels) of four texels (n, v, u, channels), a triangle's as it divides."""
    values = texels if texels.dtype == np.float64 else texels.astype(np.float64)
    total = values[:, ::2, ::2] + values[:, ::2, 1::2] + values[:, 1::2, ::2]
    last = values[:, 1::2, 1::2]
    if is_triangle:
        last = np.swapaxes(values[:, ::-2, ::-2], 1, 2)
    return _stored((total + last) / 4, texels.dtype)


def _stored(values: Floats, dtype: np.dtype) -> Array:
    """Return values as numbers of a type, whole ones rounded to nearest."""
    if dtype.kind == "u":
        return np.rint(np.clip(values, 0, np.iinfo(dtype).max)).astype(dtype)
    with np.errstate(over="ignore"):
        return values.astype(dtype)
