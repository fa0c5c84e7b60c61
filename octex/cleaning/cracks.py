"""Closes cracks: moves pairs of facing border vertices, closer than a cell, to their middle."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.jit import kernel, part
from octex.source.parts import edges_of
from octex.source.vectors import length_of, minus, row_of
from octex.source.welding import welded
from octex.tree.morton import encode, encode_cells

#: Largest number of rounds of pairing; each leaves fewer open edges.
_ROUNDS = 8
#: Vertices along the same border are the other side of a crack only if the border runs this many times
#: farther than the straight distance.
_DETOUR = 3.0
#: Largest number of border vertices searched around a vertex.
_NEAR = 64
_MOST_CELLS = 1 << 20
#: Cells with more border vertices than this stay open: else a part far from the others would take hours.
_CROWDED = 1_000


def closed_cracks(
    rest: Float64s, vertices: Float64s, triangles: Int32s, width: float
) -> tuple[Float64s, Float64s, int]:
    """Return rest and posed positions (n, 3) with cracks narrower than ``width`` closed, and how many moved.

    A crack closes where two vertices of open edges are mutually nearest and no triangle joins them: both move
    to their middle. Vertices at one rest position move as one.
    """
    positions = np.concatenate([rest, vertices], axis=1)
    width = max(width, float(np.ptp(rest, axis=0).max()) / _MOST_CELLS)
    has_moved = np.zeros(len(rest), np.bool_)
    for _ in range(_ROUNDS):
        names = welded(np.ascontiguousarray(positions[:, :3])).astype(np.int64)
        _, first = np.unique(names, return_index=True)
        edges, counts = np.unique(edges_of(triangles, names)[0], return_counts=True)
        border = edges[counts == 1]
        a, b = border // len(names), border % len(names)
        if not border.size:
            break
        open_vertices, ends = np.unique(np.concatenate([a, b]), return_inverse=True)
        order = np.argsort(ends, kind="stable")
        starts = np.searchsorted(ends[order], np.arange(len(open_vertices) + 1))
        others = np.roll(ends, len(a))[order]
        points = positions[first[open_vertices], :3]
        cells = np.floor((points - points.min(axis=0)) / width).astype(np.int64) + 1
        codes = encode_cells(cells)
        by_code = np.argsort(codes, kind="stable")
        nearest = _nearest(points, starts, others, cells, codes[by_code], by_code, width)
        numbers = np.arange(len(open_vertices))
        is_mutual = np.where(nearest >= 0, nearest[nearest], -1) == numbers
        pairs = np.flatnonzero(is_mutual & (nearest > numbers))
        one, other = open_vertices[pairs], open_vertices[nearest[pairs]]
        is_joined = np.isin(np.minimum(one, other) * len(names) + np.maximum(one, other), edges)
        one, other = one[~is_joined], other[~is_joined]
        if not one.size:
            break
        middles = (positions[first[one]] + positions[first[other]]) / 2
        moved = np.full(len(first), -1, np.int64)
        moved[one] = moved[other] = np.arange(len(one))
        pair_numbers = moved[names]
        positions[pair_numbers >= 0] = middles[pair_numbers[pair_numbers >= 0]]
        has_moved |= pair_numbers >= 0
    return positions[:, :3], positions[:, 3:], int(has_moved.sum())


@kernel
def _nearest(
    points: Float64s,
    starts: Int64s,
    others: Int64s,
    cells: Int64s,
    codes: Int64s,
    by_code: Int64s,
    width: float,
) -> Int64s:
    """Return each vertex's nearest vertex across a crack, or −1, both on open edges.

    ``others`` from ``starts`` on lists the vertices that share an open edge; ``codes`` are sorted.
    """
    nearest = np.full(len(points), -1, np.int64)
    border = np.empty(_NEAR, np.int64)
    lengths = np.empty(_NEAR, np.float64)
    for n in range(len(points)):
        count = _own_border(points, starts, others, n, _DETOUR * width, border, lengths)
        least = width
        for number in range(27):
            i = cells[n, 0] + number // 9 - 1
            j = cells[n, 1] + number // 3 % 3 - 1
            k = cells[n, 2] + number % 3 - 1
            code = encode(i, j, k)
            first, end = np.searchsorted(codes, code), np.searchsorted(codes, code, side="right")
            if end - first > _CROWDED:
                continue
            for other in by_code[first:end]:
                distance = length_of(minus(row_of(points, other), row_of(points, n)))
                if other == n or distance >= least:
                    continue
                is_own = False
                for at in range(count):
                    is_own = is_own or (border[at] == other and lengths[at] <= _DETOUR * distance)
                if not is_own:
                    least = distance
                    nearest[n] = other
    return nearest


@part
def _own_border(
    points: Float64s, starts: Int64s, others: Int64s, n: int, reach: float, border: Int64s, lengths: Float64s
) -> int:
    """List vertices along the border from vertex ``n``, with their distance along it; return their number."""
    border[0], lengths[0] = n, 0.0
    count, done = 1, 0
    while done < count:
        vertex, length = border[done], lengths[done]
        done += 1
        for row in range(starts[vertex], starts[vertex + 1]):
            other = others[row]
            other_length = length + length_of(minus(row_of(points, other), row_of(points, vertex)))
            is_new = other_length <= reach
            for at in range(count):
                is_new = is_new and border[at] != other
            if is_new and count < border.size:
                border[count], lengths[count] = other, other_length
                count += 1
    return count
