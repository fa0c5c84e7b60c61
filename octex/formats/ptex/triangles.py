"""Interpolates triangular faces: linear within texels, continuous across edges.

A texel is a triangle. Its corners lie on a grid, each among six texels, or on an edge among three of the face
and three of the one across; a corner has their mean. Where resolutions differ, the coarser face's corners
count: the finer one takes its mean at the level of equal size, and is linear in between. A vertex of the mesh
has the mean of all faces around it, at the coarsest one's resolution.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Int32s, Int64s, Uint8s
from octex.formats.ptex.pyramid import Pyramid
from octex.jit import inlined, kernel


def fill_corners(pyramid: Pyramid, neighbors: Int32s, edges: Uint8s, vertices: Int64s) -> None:
    """Write the values at texels' corners along edges to the rims; ``vertices`` (faces, 3)."""
    log2 = pyramid.log2[0, :, 0].astype(np.int64)
    coarsest = np.full(int(vertices.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(coarsest, vertices, log2[:, None])
    coarsest[np.setdiff1d(np.arange(len(coarsest)), vertices)] = 0
    firsts = np.cumsum(coarsest + 1) - (coarsest + 1)  # of each vertex's values, by size
    values = np.zeros((int((coarsest + 1).sum()), pyramid.pixels.shape[1]), np.float32)
    counts = np.bincount(vertices.ravel(), minlength=len(coarsest))
    _fill_corners(pyramid, neighbors, edges, vertices, coarsest, firsts, counts, values)


@kernel
def _fill_corners(
    pyramid: Pyramid, neighbors: Int32s, edges: Uint8s, vertices: Int64s, coarsest: Int64s, firsts: Int64s,
    counts: Int64s, values: Float32s,
) -> None:  # fmt: skip
    pixels, columns = pyramid.pixels, values.shape[1]
    for face in range(vertices.shape[0]):
        log2 = int(pyramid.log2[0, face, 0])
        for corner in range(3):
            vertex = vertices[face, corner]
            for size in range(coarsest[vertex] + 1):
                last = (1 << size) - 1
                column, row = last if corner == 1 else 0, last if corner == 2 else 0
                at = pyramid.firsts[log2 - size, face] + (row + 1) * (last + 3) + column + 1
                for k in range(columns):
                    values[firsts[vertex] + size, k] += pixels[at, k] / np.float32(counts[vertex])
    left, right = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    for face in range(vertices.shape[0]):
        log2 = int(pyramid.log2[0, face, 0])
        for level in range(pyramid.faces[face] + 1):
            size = log2 - level
            side = 1 << size
            for edge in range(3):
                other, there = int(neighbors[face, edge]), int(edges[face, edge])
                if there > 2:
                    other = -1
                common = size if other < 0 else min(size, int(pyramid.log2[0, other, 0]))
                step = 1 << (size - common)
                for coarse in range(1 << common):
                    for end in range(2):
                        to, place = (left, coarse) if end == 0 else (right, coarse + 1)
                        if place == 0 or place == 1 << common:
                            vertex = vertices[face, (edge if place == 0 else edge + 1) % 3]
                            to[:] = values[firsts[vertex] + min(size, coarsest[vertex])]
                            continue
                        to[:] = np.float32(0.0)
                        share = np.float32(1.0) if other < 0 else np.float32(0.5)
                        _add_around(pyramid, face, log2 - common, edge, place, share, to)
                        if other >= 0:
                            its = int(pyramid.log2[0, other, 0]) - common
                            _add_around(pyramid, other, its, there, (1 << common) - place, share, to)
                    for fine in range(step):
                        a, b = _on_edge(side, edge, coarse * step + fine)
                        at = pyramid.firsts[level, face] + _rim(side, a, b)
                        part = np.float32(fine / step)
                        for k in range(columns):
                            pixels[at, k] = left[k] + part * (right[k] - left[k])


@inlined
def _on_edge(side: int, edge: int, along: int) -> tuple[int, int]:
    """Return the corner of cells at a distance along an edge."""
    if edge == 0:
        return along, 0
    if edge == 1:
        return side - along, along
    return 0, side - along


@inlined
def _rim(side: int, a: int, b: int) -> int:
    """Return the position in the rim of a corner of cells on an edge."""
    if b == 0:
        return a
    if a == 0:
        return b * (side + 2)
    return (side + 1) * (side + 2) + a


@inlined
def _add_around(
    pyramid: Pyramid, face: int, level: int, edge: int, along: int, share: np.float32, to: Float32s
) -> None:
    """Add a share of the mean of the three texels of a face around a corner on its edge."""
    side = 1 << pyramid.log2[level, face, 0]
    a, b = _on_edge(side, edge, along)
    for each in range(6):
        column, row = _around(side, a, b, each)
        if column >= 0:
            at = pyramid.firsts[level, face] + (row + 1) * (side + 2) + column + 1
            for k in range(to.size):
                to[k] += share / np.float32(3.0) * pyramid.pixels[at, k]


@inlined
def _triangle_texel(side: int, i: int, j: int, is_tip: bool) -> tuple[int, int]:
    """Return the column and the row where a texel of a triangle's cell is stored."""
    if is_tip:
        return side - 1 - j, side - 1 - i
    return i, j


@inlined
def add_triangle(
    pixels: Float32s, first: int, side: int, x: float, y: float, share: np.float32, to: Float32s
) -> None:
    """Add the value at (x, y) in cells, linear between texels' centres and corners."""
    i, j = min(int(x), side - 1), min(int(y), side - 1)
    if i + j > side - 1:  # rounded beyond the slanted edge
        i = side - 1 - j
    f, g = min(max(x - i, 0.0), 1.0), min(max(y - j, 0.0), 1.0)
    is_tip = f + g > 1.0 and i + j < side - 1
    if f + g > 1.0 and not is_tip:
        f, g = f / (f + g), g / (f + g)
    # Barycentric in the texel; the corner with the least coordinate is not in the third that holds the point.
    p, q, r = 1.0 - f - g, f, g
    if is_tip:
        p, q, r = f + g - 1.0, 1.0 - f, 1.0 - g
    least = min(p, min(q, r))
    column, row = _triangle_texel(side, i, j, is_tip)
    centre = share * np.float32(3.0 * least)
    at = first + (row + 1) * (side + 2) + column + 1
    for k in range(to.size):
        to[k] += centre * pixels[at, k]
    for corner in range(3):
        weight = (p if corner == 0 else (q if corner == 1 else r)) - least
        if weight <= 0.0:
            continue
        a, b = i, j
        if is_tip:
            a += 1 if corner != 1 else 0
            b += 1 if corner != 2 else 0
        else:
            a += 1 if corner == 1 else 0
            b += 1 if corner == 2 else 0
        if a == 0 or b == 0 or a + b == side:
            at, part = first + _rim(side, a, b), share * np.float32(weight)
            for k in range(to.size):
                to[k] += part * pixels[at, k]
            continue
        part = share * np.float32(weight / 6.0)
        for each in range(6):
            column, row = _around(side, a, b, each)
            at = first + (row + 1) * (side + 2) + column + 1
            for k in range(to.size):
                to[k] += part * pixels[at, k]


@inlined
def _around(side: int, a: int, b: int, each: int) -> tuple[int, int]:
    """Return the column and row of one of six texels around a corner of cells, −1 if it is missing."""
    i, j, is_tip = a, b, False
    if each == 1:
        i = a - 1
    elif each == 2:
        j = b - 1
    elif each == 3:
        i, is_tip = a - 1, True
    elif each == 4:
        j, is_tip = b - 1, True
    elif each == 5:
        i, j, is_tip = a - 1, b - 1, True
    if i < 0 or j < 0 or i + j > side - (2 if is_tip else 1):
        return -1, -1
    return _triangle_texel(side, i, j, is_tip)
