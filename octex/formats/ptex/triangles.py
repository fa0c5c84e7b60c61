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
                texel = pyramid.firsts[log2 - size, face] + (row + 1) * (last + 3) + column + 1
                for k in range(columns):
                    values[firsts[vertex] + size, k] += pixels[texel, k] / np.float32(counts[vertex])
    left, right = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    for face in range(vertices.shape[0]):
        log2 = int(pyramid.log2[0, face, 0])
        for level in range(pyramid.faces[face] + 1):
            size = log2 - level
            side = 1 << size
            for edge in range(3):
                other, other_edge = int(neighbors[face, edge]), int(edges[face, edge])
                if other_edge > 2:
                    other = -1
                common = size if other < 0 else min(size, int(pyramid.log2[0, other, 0]))
                step = 1 << (size - common)
                for coarse in range(1 << common):
                    for end in range(2):
                        target, along = (left, coarse) if end == 0 else (right, coarse + 1)
                        if along == 0 or along == 1 << common:
                            vertex = vertices[face, (edge if along == 0 else edge + 1) % 3]
                            target[:] = values[firsts[vertex] + min(size, coarsest[vertex])]
                            continue
                        target[:] = np.float32(0.0)
                        share = np.float32(1.0) if other < 0 else np.float32(0.5)
                        _add_around(pyramid, face, log2 - common, edge, along, share, target)
                        if other >= 0:
                            other_level = int(pyramid.log2[0, other, 0]) - common
                            along = (1 << common) - along
                            _add_around(pyramid, other, other_level, other_edge, along, share, target)
                    for fine in range(step):
                        a, b = _on_edge(side, edge, coarse * step + fine)
                        texel = pyramid.firsts[level, face] + _rim(side, a, b)
                        part = np.float32(fine / step)
                        for k in range(columns):
                            pixels[texel, k] = left[k] + part * (right[k] - left[k])


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
    pyramid: Pyramid, face: int, level: int, edge: int, along: int, share: np.float32, sums: Float32s
) -> None:
    """Add a share of the mean of the three texels of a face around a corner on its edge."""
    side = 1 << pyramid.log2[level, face, 0]
    a, b = _on_edge(side, edge, along)
    for number in range(6):
        column, row = _around(side, a, b, number)
        if column >= 0:
            texel = pyramid.firsts[level, face] + (row + 1) * (side + 2) + column + 1
            for k in range(sums.size):
                sums[k] += share / np.float32(3.0) * pyramid.pixels[texel, k]


@inlined
def _triangle_texel(side: int, i: int, j: int, is_tip: bool) -> tuple[int, int]:
    """Return the column and the row where a texel of a triangle's cell is stored."""
    if is_tip:
        return side - 1 - j, side - 1 - i
    return i, j


@inlined
def add_triangle(
    pixels: Float32s, first: int, side: int, x: float, y: float, share: np.float32, sums: Float32s
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
    texel = first + (row + 1) * (side + 2) + column + 1
    for k in range(sums.size):
        sums[k] += centre * pixels[texel, k]
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
            texel, part = first + _rim(side, a, b), share * np.float32(weight)
            for k in range(sums.size):
                sums[k] += part * pixels[texel, k]
            continue
        part = share * np.float32(weight / 6.0)
        for number in range(6):
            column, row = _around(side, a, b, number)
            texel = first + (row + 1) * (side + 2) + column + 1
            for k in range(sums.size):
                sums[k] += part * pixels[texel, k]


@inlined
def _around(side: int, a: int, b: int, number: int) -> tuple[int, int]:
    """Return the column and row of one of six texels around a corner of cells, −1 if it is missing."""
    i, j, is_tip = a, b, False
    if number == 1:
        i = a - 1
    elif number == 2:
        j = b - 1
    elif number == 3:
        i, is_tip = a - 1, True
    elif number == 4:
        j, is_tip = b - 1, True
    elif number == 5:
        i, j, is_tip = a - 1, b - 1, True
    if i < 0 or j < 0 or i + j > side - (2 if is_tip else 1):
        return -1, -1
    return _triangle_texel(side, i, j, is_tip)
