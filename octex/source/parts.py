"""The parts of a surface, and which of them intersect or nearly touch.

Such parts share cells of an octree texture, and their colours run together (Benson & Davis 2002, 4.3.1 and
6.2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.checks import as_number
from octex.jit import kernel
from octex.nearest.distances import Mesh, gap, mesh_of
from octex.source.welding import first_equal

if TYPE_CHECKING:
    from manifold3d import Manifold

Why = Literal["open", "not manifold", "without volume"]

#: Solids that share less than this part of the smaller one's volume only touch.
_SHARED = 1e-9
#: Pairs of boxes are looked for so many at a time.
_BLOCK = 1 << 22


class Overlap(NamedTuple):
    """Two parts that intersect, or come nearer than the margin."""

    a: int
    b: int
    volume: float | None  # of what both fill, in cubic units; None unless both are solid
    gap: float  # smallest distance of their surfaces; 0 where they cross, infinite where beyond the margin


class Unchecked(NamedTuple):
    """A part that is no solid: only the distance of its surface is known, not what lies inside it."""

    part: int
    triangles: int
    why: Why


class Overlaps(NamedTuple):
    """Which parts of a surface intersect or come nearer than a margin."""

    margin: float
    parts: Int32s  # (m,)   the part of each triangle, numbered by their first triangles
    pairs: tuple[Overlap, ...]  # sorted
    unchecked: tuple[Unchecked, ...]

    @property
    def n_parts(self) -> int:
        """The number of parts."""
        return int(self.parts.max()) + 1

    def __str__(self) -> str:
        lines = [
            f"{_many(self.n_parts, 'part')}, {_many(len(self.pairs), 'pair')} that intersect or come near"
        ]
        for a, b, volume, distance in self.pairs:
            apart = f"are {distance:.4g} apart" if distance else "cross or touch"
            if math.isinf(distance):
                apart = f"are more than {self.margin:g} apart" if self.margin else "do not cross"
            shared = f"share a volume of {volume:.4g}" if volume else "share no volume"
            lines.append(
                f"parts {a} and {b}: their surfaces {apart}" + ("" if volume is None else f"; they {shared}")
            )
        lines += [
            f"part {part} of {_many(triangles, 'triangle')} is {why}: only its surface was checked, not "
            "what lies inside"
            for part, triangles, why in self.unchecked
        ]
        return "\n".join(lines)


def _many(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def overlapping_parts(rest: Float64s, triangles: Int32s, margin: float = 0.0) -> Overlaps:
    """Find the parts that intersect or come nearer than ``margin``: ``Surface.overlapping_parts``."""
    margin = as_number(margin, "margin", 0.0, 1e30)
    welded = first_equal(rest)
    parts = parts_of(triangles, welded)
    order = np.argsort(parts, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)
    solids = [_solid(rest, triangles[part], welded) for part in members]
    surfaces: dict[int, Mesh] = {}
    pairs = []
    low, high = boxes_of(rest, triangles, parts)
    for first, second in _near_boxes(low, high, margin):
        for a, b in zip(first.tolist(), second.tolist(), strict=True):
            for part in (a, b):
                if part not in surfaces:
                    surfaces[part] = mesh_of(rest[triangles[members[part]]])
            distance = gap(surfaces[a], surfaces[b], margin)
            within = (low[a] >= low[b]).all() and (high[a] <= high[b]).all()
            around = (low[a] <= low[b]).all() and (high[a] >= high[b]).all()
            # Apart and not one in the other: nothing is shared, and needs no boolean.
            is_clear = distance > 0.0 and not within and not around
            volume = _shared_volume(solids[a], solids[b], is_clear)
            if volume or distance < margin or (distance == 0.0 and volume is None):
                pairs.append(Overlap(min(a, b), max(a, b), volume, distance))
    unchecked = [
        Unchecked(part, len(members[part]), solid)
        for part, solid in enumerate(solids)
        if solid == "open" or solid == "not manifold" or solid == "without volume"
    ]
    return Overlaps(margin, parts, tuple(sorted(pairs)), tuple(unchecked))


def boxes_of(rest: Float64s, triangles: Int32s, parts: Int32s) -> tuple[Float64s, Float64s]:
    """Return the lowest and the highest corners (parts, 3) of parts."""
    low = np.full((int(parts.max()) + 1, 3), np.inf)
    high = -low
    corners = rest[triangles]
    np.minimum.at(low, parts, corners.min(axis=1))
    np.maximum.at(high, parts, corners.max(axis=1))
    return low, high


def parts_of(triangles: Int32s, welded: Int64s) -> Int32s:
    """Return the part of each triangle (m,), numbered by their first triangles.

    Triangles are in one part if they share a vertex, or an edge (of the same positions, ``welded``) that no
    third has: so seams do not cut, and boxes that stand on each other stay two. What is not closed then is
    joined with what touches it at a vertex.
    """
    parents = np.arange(len(welded))
    join(parents, np.repeat(triangles[:, 0], 2).astype(np.int64), triangles[:, 1:].ravel().astype(np.int64))
    keys, _ = edges_of(triangles, welded)
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    pairs = starts[np.diff(starts, append=len(keys)) == 2]
    owners = np.tile(triangles[:, 0], 3).astype(np.int64)
    join(parents, owners[order[pairs]], owners[order[pairs + 1]])
    roots = parents[triangles[:, 0]]
    loose = triangles[np.isin(roots, _unbalanced(triangles, welded, roots))].ravel().astype(np.int64)
    _, first, places = np.unique(welded[loose], return_index=True, return_inverse=True)
    join(parents, loose, loose[first[places]])
    _, first, parts = np.unique(parents[triangles[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[parts]


def edges_of(triangles: Int32s, welded: Int64s) -> tuple[Int64s, Int64s]:
    """Return the edges of triangles (3·m,), edge after edge: a number, and which way it is run through."""
    corners = welded[triangles]
    a = corners.T.ravel()
    b = corners[:, [1, 2, 0]].T.ravel()
    return np.minimum(a, b) * len(welded) + np.maximum(a, b), np.sign(b - a)


def _unbalanced(triangles: Int32s, welded: Int64s, owners: Int64s) -> Int64s:
    """Return those of the triangles' owners (m,) with an edge that is not run through equally both ways."""
    keys, ways = edges_of(triangles, welded)
    owners = np.tile(owners, 3)
    order = np.lexsort((keys, owners))
    keys, owners = keys[order], owners[order]
    starts = np.flatnonzero((np.diff(keys, prepend=-1) != 0) | (np.diff(owners, prepend=-1) != 0))
    return np.unique(owners[starts[np.add.reduceat(ways[order], starts) != 0]])


@kernel
def join(parents: Int64s, a: Int64s, b: Int64s) -> None:
    """Join the sets of a[i] and b[i]; afterwards every parent is its set's least member."""
    for i in range(a.size):
        x, y = a[i], b[i]
        while parents[x] != x:
            parents[x] = parents[parents[x]]
            x = parents[x]
        while parents[y] != y:
            parents[y] = parents[parents[y]]
            y = parents[y]
        if x < y:
            parents[y] = x
        else:
            parents[x] = y
    for i in range(parents.size):
        parents[i] = parents[parents[i]]


def _solid(rest: Float64s, triangles: Int32s, welded: Int64s) -> Manifold | Why:
    """Return the solid that triangles enclose, turned outside out, or why they enclose none."""
    from manifold3d import Error, Manifold, Mesh64

    keys, _ = edges_of(triangles, welded)
    if (np.unique(keys, return_counts=True)[1] % 2).any():
        return "open"
    used, corners = np.unique(welded[triangles], return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.uint64)
    solid = Manifold(Mesh64(rest[used], faces))
    if solid.status() != Error.NoError:
        return "not manifold"
    if solid.volume() < 0.0:
        solid = Manifold(Mesh64(rest[used], np.ascontiguousarray(faces[:, ::-1])))
    return solid if solid.volume() > 0.0 else "without volume"


def _near_boxes(low: Float64s, high: Float64s, margin: float) -> Iterator[tuple[Int64s, Int64s]]:
    """Yield pairs of boxes, low and high (n, 3), that come as near as ``margin`` to each other."""
    if len(low) < 2:
        return
    sweeps = []
    for axis in range(3):  # the axis along which the fewest follow each other so nearly
        order = np.argsort(low[:, axis], kind="stable")
        ends = np.searchsorted(low[order, axis], high[order, axis] + margin, side="right")
        sweeps.append((order, ends - np.arange(1, len(low) + 1)))
    order, counts = min(sweeps, key=lambda sweep: int(sweep[1].sum()))
    totals = np.cumsum(counts)
    first = 0
    while first < len(low):
        done = totals[first - 1] if first else 0
        last = max(int(np.searchsorted(totals, done + _BLOCK, side="right")), first + 1)
        repeats = counts[first:last]
        a = np.repeat(np.arange(first, last), repeats)
        b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        a, b = order[a], order[b]
        meets = ((low[a] <= high[b] + margin) & (low[b] <= high[a] + margin)).all(axis=1)
        yield a[meets], b[meets]
        first = last


def _shared_volume(a: Manifold | Why, b: Manifold | Why, is_clear: bool) -> float | None:
    """Return the volume that two solids share; 0 if they only touch, None if one is no solid."""
    if isinstance(a, str) or isinstance(b, str):
        return None
    if is_clear:
        return 0.0
    volume: float = (a ^ b).volume()
    return volume if volume > _SHARED * min(a.volume(), b.volume()) else 0.0
