"""Texels of faces and their means, level by level, with rims from across the faces' edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int8s, Int32s, Int64s, Uint8s
from octex.formats.ptex.layout import BORDER_MODES
from octex.jit import inlined, kernel

_BLACK, _PERIODIC = BORDER_MODES.index("black"), BORDER_MODES.index("periodic")


class Pyramid(NamedTuple):
    """Texels of all faces at all levels, each face with a rim.

    Level i has both sides halved i times, down to 1. A quad's rim holds the texels across its edges; a
    triangle's the corners of texels along its edges (`triangles.fill_corners`).
    """

    pixels: Float32s  # (texels, columns)
    firsts: Int64s  # (levels, faces)   the first texel of the rim's first row
    log2: Int8s  # (levels, faces, 2)
    faces: Int32s  # (faces,)   the first level at which a face is one texel


def pyramid_of(values: Float32s, log2: Int8s, is_triangle: bool) -> Pyramid:
    """Return the pyramid of texels (n, columns), with empty rims; ``log2`` (faces, 2)."""
    levels = int(log2.max()) + 1
    sides = np.maximum(log2[None] - np.arange(levels)[:, None, None], 0).astype(np.int8)
    counts = ((np.int64(1) << sides.astype(np.int64)) + 2).prod(axis=2)
    lasts = log2.max(axis=1).astype(np.int32)
    counts[np.arange(levels)[:, None] > lasts] = 0  # a face ends with its level of one texel
    firsts = (np.cumsum(counts) - counts.ravel()).reshape(counts.shape)
    pixels = np.zeros((int(counts.sum()), values.shape[1]), np.float32)
    pyramid = Pyramid(pixels, firsts, sides, lasts)
    starts = np.cumsum(np.int64(1) << log2.sum(axis=1, dtype=np.int64))
    _fill(values, np.concatenate([[0], starts[:-1]]), pyramid, is_triangle)
    return pyramid


@kernel
def _fill(values: Float32s, starts: Int64s, pyramid: Pyramid, is_triangle: bool) -> None:
    """Write the texels of all levels, each from the one before."""
    columns = values.shape[1]
    for face in range(starts.size):
        for level in range(pyramid.faces[face] + 1):
            u, v = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
            first = pyramid.firsts[level, face] + u + 3
            across = down = 1
            finer_first, finer_width = 0, 0
            if level > 0:
                finer_width = (1 << pyramid.log2[level - 1, face, 0]) + 2
                finer_first = pyramid.firsts[level - 1, face] + finer_width + 1
                across = 1 << (pyramid.log2[level - 1, face, 0] - pyramid.log2[level, face, 0])
                down = 1 << (pyramid.log2[level - 1, face, 1] - pyramid.log2[level, face, 1])
            for row in range(v):
                for column in range(u):
                    texel = first + row * (u + 2) + column
                    for k in range(columns):
                        if level == 0:
                            pyramid.pixels[texel, k] = values[starts[face] + row * u + column, k]
                            continue
                        total = np.float32(0.0)
                        for j in range(down):
                            for i in range(across):
                                y, x = row * down + j, column * across + i
                                if is_triangle and i == 1 and j == 1:
                                    y, x = 2 * u - 1 - 2 * column, 2 * u - 1 - 2 * row
                                total += pyramid.pixels[finer_first + y * finer_width + x, k]
                        pyramid.pixels[texel, k] = total / np.float32(across * down)


@kernel
def fill_rims(pyramid: Pyramid, neighbors: Int32s, edges: Uint8s, subfaces: Bools, modes: Int64s) -> None:
    """Write the rims of quads: texels across edges, and corners; ``modes`` are those of borders."""
    for face in range(neighbors.shape[0]):
        for level in range(pyramid.faces[face] + 1):
            u, v = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
            first, width = pyramid.firsts[level, face], u + 2
            for edge in range(4):
                length = u if edge % 2 == 0 else v
                for i in range(length):
                    texel = first + _rim(edge, i, u, v, width, 0)
                    neighbour = _across(
                        pyramid, neighbors, edges, subfaces, face, level, edge, (i + 0.5) / length
                    )
                    if neighbour < 0:
                        mode = modes[0] if edge % 2 == 1 else modes[1]
                        if mode == _BLACK:
                            continue
                        neighbour = first + _rim(edge, i, u, v, width, 1)
                        if mode == _PERIODIC:
                            neighbour = first + _rim((edge + 2) % 4, length - 1 - i, u, v, width, 1)
                    pyramid.pixels[texel] = pyramid.pixels[neighbour]
            for corner in range(4):
                column, row = (0, width - 1)[corner % 2], (0, v + 1)[corner // 2]
                beside = 1 if column == 0 else -1
                upward = 1 if row == 0 else -1
                texel = first + row * width + column
                for k in range(pyramid.pixels.shape[1]):
                    pyramid.pixels[texel, k] = np.float32(0.5) * (
                        pyramid.pixels[texel + beside, k] + pyramid.pixels[texel + upward * width, k]
                    )


@inlined
def _rim(edge: int, i: int, u: int, v: int, width: int, inside: int) -> int:
    """Return the i-th texel of the rim along an edge, or with ``inside`` 1 the face's texel next to it."""
    if edge == 0:
        return inside * width + 1 + i
    if edge == 1:
        return (1 + i) * width + u + 1 - inside
    if edge == 2:
        return (v + 1 - inside) * width + u - i
    return (v - i) * width + inside


@inlined
def _across(
    pyramid: Pyramid, neighbors: Int32s, edges: Uint8s, subfaces: Bools, face: int, level: int, edge: int,
    along: float,
) -> int:  # fmt: skip
    """Return the texel across an edge at a fraction of its length, −1 for none."""
    other, other_edge = int(neighbors[face, edge]), int(edges[face, edge])
    if other < 0:
        return -1
    if subfaces[other] and not subfaces[face]:
        if along >= 0.5:  # the second of two subfaces
            turn = (other_edge + 3) % 4
            second = int(neighbors[other, turn])
            if second < 0:
                return -1
            other_edge, other = (int(edges[other, turn]) + 3) % 4, second
            along -= 0.5
        along *= 2.0
    elif subfaces[face] and not subfaces[other] and (edge == 0 or edge == 3):
        along = 0.5 * along if edge == 0 else 0.5 + 0.5 * along
    level = min(level, int(pyramid.faces[other]))
    u, v = 1 << pyramid.log2[level, other, 0], 1 << pyramid.log2[level, other, 1]
    length = u if other_edge % 2 == 0 else v
    i = min(int((1.0 - along) * length), length - 1)
    return int(pyramid.firsts[level, other]) + _rim(other_edge, i, u, v, u + 2, 1)
