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
    places = np.concatenate([rest, vertices], axis=1)
    width = max(width, float(np.ptp(rest, axis=0).max()) / _MOST_CELLS)
    has_moved = np.zeros(len(rest), np.bool_)
    for _ in range(_ROUNDS):
        names = welded(np.ascontiguousarray(places[:, :3])).astype(np.int64)
        _, first = np.unique(names, return_index=True)
        edges, counts = np.unique(edges_of(triangles, names)[0], return_counts=True)
        border = edges[counts == 1]
        a, b = border // len(names), border % len(names)
        if not border.size:
            break
        known, ends = np.unique(np.concatenate([a, b]), return_inverse=True)
        order = np.argsort(ends, kind="stable")
        starts = np.searchsorted(ends[order], np.arange(len(known) + 1))
        others = np.roll(ends, len(a))[order]
        points = places[first[known], :3]
        cells = np.floor((points - points.min(axis=0)) / width).astype(np.int64) + 1
        codes = encode_cells(cells)
        by_code = np.argsort(codes, kind="stable")
        nearest = _nearest(points, starts, others, cells, codes[by_code], by_code, width)
        partner = np.where(nearest >= 0, nearest[nearest], -1)
        one = np.flatnonzero((partner == np.arange(len(known))) & (nearest > np.arange(len(known))))
        other = nearest[one]
        keys = np.minimum(known[one], known[other]) * len(names) + np.maximum(known[one], known[other])
        at = np.searchsorted(edges, keys)
        is_joined = edges[np.minimum(at, len(edges) - 1)] == keys
        one, other = known[one[~is_joined]], known[other[~is_joined]]
        if not one.size:
            break
        middles = (places[first[one]] + places[first[other]]) / 2
        moved = np.full(len(first), -1, np.int64)
        moved[one] = moved[other] = np.arange(len(one))
        to = moved[names]
        places[to >= 0] = middles[to[to >= 0]]
        has_moved |= to >= 0
    return places[:, :3], places[:, 3:], int(has_moved.sum())


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
    near = np.empty(_NEAR, np.int64)
    ways = np.empty(_NEAR, np.float64)
    for n in range(len(points)):
        count = _own_border(points, starts, others, n, _DETOUR * width, near, ways)
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
                    is_own = is_own or (near[at] == other and ways[at] <= _DETOUR * distance)
                if not is_own:
                    least = distance
                    nearest[n] = other
    return nearest


@part
def _own_border(
    points: Float64s, starts: Int64s, others: Int64s, n: int, reach: float, near: Int64s, ways: Float64s
) -> int:
    """List vertices along the border from vertex ``n``, with their distance along it; return their number."""
    near[0], ways[0] = n, 0.0
    count, done = 1, 0
    while done < count:
        here, way = near[done], ways[done]
        done += 1
        for row in range(starts[here], starts[here + 1]):
            other = others[row]
            far = way + length_of(minus(row_of(points, other), row_of(points, here)))
            is_new = far <= reach
            for at in range(count):
                is_new = is_new and near[at] != other
            if is_new and count < near.size:
                near[count], ways[count] = other, far
                count += 1
    return count
