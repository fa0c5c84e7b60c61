"""Subdivision surfaces: Catmull–Clark and Loop, with creases, and their limits.

Creases, corners and boundaries (edge-and-corner) are OpenSubdiv's (DeRose, Kass & Truong 1998; Hoppe et al.
1994). Edges of more than two faces are sharp. Limits: Halstead, Kass & DeRose 1993; Loop 1987.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float64s, Int64s
from octex.source.parts import join

Scheme = Literal["catmull-clark", "loop"]
SCHEMES: tuple[Scheme, ...] = ("catmull-clark", "loop")

#: Sharpness from which on an edge stays sharp at every level.
INFINITE = 10.0
_SMOOTH, _CREASE, _CORNER = 0, 1, 2
#: A vertex with a single sharp edge gets its limit by this many more levels around it.
_ROUNDS = 64


class CageLevel(NamedTuple):
    """A control mesh: faces of v vertices, e edges and c corners, listed face after face."""

    values: Float64s  # (v, k)   positions, and other values that are subdivided like them
    corners: Int64s  # (c,)     the vertex of each corner
    sizes: Int64s  # (f,)     the corners of each face
    sides: Int64s  # (c,)     the edge from each corner to the next one of its face
    edges: Int64s  # (e, 2)   vertices
    sharpness: Float64s  # (e,)     of edges: 0 smooth, from INFINITE on sharp for good
    spikes: Float64s  # (v,)     likewise of vertices
    domain: Float64s  # (c, 2)   each corner's position in the plane of its face of the first level
    faces: Int64s  # (f,)     that face

    @property
    def following(self) -> Int64s:
        """The next corner of each corner's face (c,)."""
        return self._turned(1)

    @property
    def preceding(self) -> Int64s:
        """The corner before each corner in its face (c,)."""
        return self._turned(-1)

    def _turned(self, by: int) -> Int64s:
        firsts = np.repeat(np.cumsum(self.sizes) - self.sizes, self.sizes)
        within = np.arange(len(self.corners)) - firsts
        return np.asarray(firsts + (within + by) % np.repeat(self.sizes, self.sizes), np.int64)

    @property
    def owners(self) -> Int64s:
        """The face of each corner (c,)."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)


def base_level(
    values: Float64s, corners: Int64s, sizes: Int64s, domain: Float64s,
    creases: tuple[Int64s, Float64s], spikes: tuple[Int64s, Float64s],
) -> CageLevel:  # fmt: skip
    """Return the first level; ``creases`` are edges (k, 2), ``spikes`` vertices (j,), and their sharpness."""
    count, faces = len(values), np.arange(len(sizes))
    nothing = np.empty((0, 2), np.int64), np.empty(0)
    level = CageLevel(values, corners, sizes, corners, *nothing, np.zeros(count), domain, faces)
    keys, sides, uses = np.unique(
        _keys(corners, corners[level.following], count), return_inverse=True, return_counts=True
    )
    sharpness = np.zeros(len(keys))
    sharp_keys = _keys(creases[0][:, 0], creases[0][:, 1], count)
    edges = np.minimum(np.searchsorted(keys, sharp_keys), len(keys) - 1)
    is_edge = keys[edges] == sharp_keys
    np.maximum.at(sharpness, edges[is_edge], creases[1][is_edge])
    sharpness[uses != 2] = INFINITE
    np.maximum.at(level.spikes, spikes[0], spikes[1])
    level = level._replace(
        sides=sides.reshape(-1), edges=np.stack([keys // count, keys % count], axis=1), sharpness=sharpness
    )
    level.spikes[_is_apart(level, uses)] = INFINITE
    return level


def _keys(a: Int64s, b: Int64s, count: int) -> Int64s:
    return np.asarray(np.minimum(a, b) * count + np.maximum(a, b), np.int64)


def _is_apart(level: CageLevel, uses: Int64s) -> Bools:
    """Say which vertices (v,) are corners: of a single face, or of faces that no edges join."""
    count = len(level.values)
    ends = level.edges.ravel()
    faces = np.bincount(level.corners, minlength=count)
    borders = np.bincount(ends[np.repeat(uses == 1, 2)], minlength=count)
    branches = np.bincount(ends[np.repeat(uses > 2, 2)], minlength=count)
    is_lone = (faces == 1) & (borders == 2)
    odd = (branches > 0) & ((branches != 2) | (borders > 0))
    return np.asarray(is_lone | odd | ((branches == 0) & (_fans(level, uses) > 1)))


def _fans(level: CageLevel, uses: Int64s) -> Int64s:
    """Return the number of fans of faces around each vertex (v,): edges of two faces join these."""
    count = len(level.values)
    sides = np.concatenate([level.sides, level.sides[level.preceding]])
    joining = np.flatnonzero(uses[sides] == 2)
    corners = np.tile(np.arange(len(level.corners)), 2)[joining]
    order = np.argsort(sides[joining] * count + level.corners[corners], kind="stable")
    pairs = corners[order].reshape(-1, 2)
    parents = np.arange(len(level.corners))
    join(parents, pairs[:, 0].copy(), pairs[:, 1].copy())
    return np.bincount(level.corners[parents == np.arange(len(parents))], minlength=count)


def divided(level: CageLevel, scheme: Scheme) -> CageLevel:
    """Return the next level: its vertices are this level's, moved, then one an edge, one a face."""
    count, n_edges = len(level.values), len(level.edges)
    before, owners = level.preceding, level.owners
    values, corners, sides = level.values, level.corners, level.sides
    middles = values[level.edges[:, 0]] + values[level.edges[:, 1]]
    valences = np.bincount(level.edges.ravel(), minlength=count)[:, None]
    weights = np.clip(level.sharpness, 0.0, 1.0)[:, None]
    if scheme == "loop":
        added = _sums(sides, values, n_edges, corners[before])
        smooth = 0.375 * middles + 0.125 * added
        centres = np.empty((0, values.shape[1]))
        beta = _beta(valences)
        vertex_values = (1 - valences * beta) * values + beta * _ring_sums(level)
    else:
        firsts = np.cumsum(level.sizes) - level.sizes
        centres = np.add.reduceat(values[corners], firsts, axis=0) / level.sizes[:, None]
        smooth = (middles + _sums(sides, centres, n_edges, owners)) / 4
        faces = _sums(corners, centres, count, owners)
        vertex_values = ((valences - 2) * values + (_ring_sums(level) + faces) / valences) / valences
    edge_values = weights * (middles / 2) + (1 - weights) * smooth
    softer = _softer(level.sharpness)
    vertex_values = _sharpened(level, vertex_values)

    # Edges: both halves of each, then one a corner, between the new points.
    halves = 2 * sides + (level.edges[sides, 1] == corners)
    back = 2 * sides[before] + (level.edges[sides[before], 1] == corners)
    across = 2 * n_edges + np.arange(len(corners))
    edge_points = count + np.arange(n_edges)
    first = np.stack([level.edges.ravel(), np.repeat(edge_points, 2)], axis=1)
    domain = level.domain
    between = (domain + domain[level.following]) / 2
    after, ahead = count + sides, count + sides[before]
    if scheme == "loop":
        child_corners = np.stack([corners, after, ahead], axis=1)
        child_sides = np.stack([halves, across, back], axis=1)
        child_domain = np.stack([domain, between, between[before]], axis=1)
        inner = after.reshape(-1, 3), across.reshape(-1, 3)[:, [1, 2, 0]], between.reshape(-1, 3, 2)
        child_corners = np.concatenate([child_corners, inner[0]])
        child_sides = np.concatenate([child_sides, inner[1]])
        child_domain = np.concatenate([child_domain, inner[2]])
        first_faces = np.concatenate([level.faces[owners], level.faces])
        second = np.stack([after, ahead], axis=1)
    else:
        centre_points = count + n_edges + owners
        child_corners = np.stack([corners, after, centre_points, ahead], axis=1)
        child_sides = np.stack([halves, across, across[before], back], axis=1)
        flat = np.add.reduceat(domain, firsts, axis=0) / level.sizes[:, None]
        child_domain = np.stack([domain, between, flat[owners], between[before]], axis=1)
        first_faces = level.faces[owners]
        second = np.stack([after, centre_points], axis=1)
    return CageLevel(
        np.concatenate([vertex_values, edge_values, centres]),
        child_corners.ravel(),
        np.full(len(child_corners), child_corners.shape[1]),
        child_sides.ravel(),
        np.concatenate([first, second]),
        np.concatenate([np.repeat(softer, 2), np.zeros(len(second))]),
        np.concatenate([_softer(level.spikes), np.zeros(len(edge_values) + len(centres))]),
        child_domain.reshape(-1, 2),
        first_faces,
    )


def limits(level: CageLevel, scheme: Scheme, first: int | None = None, rounds: int = _ROUNDS) -> Float64s:
    """Return the limits of a level's ``first`` vertices (v, k); for Catmull–Clark all faces are quads."""
    values, count = level.values, len(level.values)
    sums, n = _ring_sums(level), np.bincount(level.edges.ravel(), minlength=count)[:, None].astype(np.float64)
    if scheme == "catmull-clark":
        across = level.corners.reshape(-1, 4)[:, [2, 3, 0, 1]].ravel()
        diagonals = _sums(level.corners, values, count, across)
        smooth = (n * n * values + 4 * sums + diagonals) / (n * (n + 5))
    else:
        share = 1 / (0.375 / _beta(n) + n)
        smooth = (1 - n * share) * values + share * sums
    kinds, ends = _kinds(level, level.sharpness, level.spikes)
    limited = _by_kind(kinds, values, (4 * values + ends) / 6, smooth)[:first]
    # Where another rule will hold, and where a single edge is sharp, the limits are those of the next level.
    lone = np.bincount(level.edges[level.sharpness > 0].ravel(), minlength=count) == 1
    passing = (level.sharpness > 0) & (level.sharpness < INFINITE)
    lone[level.edges[passing]] = True
    lone |= (level.spikes > 0) & (level.spikes < INFINITE)
    unfinished = np.flatnonzero((lone & (level.spikes < INFINITE))[:first])
    if rounds and len(unfinished):
        following = divided(_around(level, unfinished), scheme)
        limited[unfinished] = limits(following, scheme, len(unfinished), rounds - 1)
    return limited


def _around(level: CageLevel, centres: Int64s) -> CageLevel:
    """Return the faces around the vertices ``centres`` (k,), which become the first k."""
    size = int(level.sizes[0])
    is_chosen, is_near = np.zeros((2, len(level.values)), np.bool_)
    is_chosen[centres] = True
    faces = np.flatnonzero(is_chosen[level.corners].reshape(-1, size).any(axis=1))
    rows = (size * faces[:, None] + np.arange(size)).ravel()
    is_near[level.corners[rows]] = True
    vertices = np.concatenate([centres, np.flatnonzero(is_near & ~is_chosen)])
    numbers = np.empty(len(level.values), np.int64)
    numbers[vertices] = np.arange(len(vertices))
    is_side = np.bincount(level.sides[rows], minlength=len(level.edges)) > 0
    return CageLevel(
        level.values[vertices], numbers[level.corners[rows]], level.sizes[faces],
        (np.cumsum(is_side) - 1)[level.sides[rows]], numbers[level.edges[is_side]], level.sharpness[is_side],
        level.spikes[vertices], level.domain[rows], level.faces[faces],
    )  # fmt: skip


def _sums(owners: Int64s, values: Float64s, count: int, rows: Int64s) -> Float64s:
    """Return the sums (count, k) of ``rows`` (m,) of values (n, k), by owner."""
    sums = np.empty((count, values.shape[1]))
    for k, column in enumerate(np.ascontiguousarray(values.T)):
        sums[:, k] = np.bincount(owners, column[rows], count)
    return sums


def _ring_sums(level: CageLevel) -> Float64s:
    """Return for each vertex the sum of the other ends of its edges (v, k)."""
    ends = level.edges.ravel()
    return _sums(ends, level.values, len(level.values), level.edges[:, ::-1].ravel())


def _beta(n: Float64s | Int64s) -> Float64s:
    """Return Loop's weight of a neighbour, for valences (v, 1)."""
    return np.asarray((0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / n)) ** 2) / n)


def _softer(sharpness: Float64s) -> Float64s:
    return np.where(sharpness >= INFINITE, sharpness, np.maximum(sharpness - 1, 0.0))


def _by_kind(kinds: Array, values: Float64s, creased: Float64s, smooth: Float64s) -> Float64s:
    return np.select([(kinds == _CORNER)[:, None], (kinds == _CREASE)[:, None]], [values, creased], smooth)


def _kinds(level: CageLevel, sharpness: Float64s, spikes: Float64s) -> tuple[Array, Float64s]:
    """Return each vertex's rule (v,), and the sum of the other ends of its sharp edges (v, k)."""
    sharp, count = level.edges[sharpness > 0], len(spikes)
    n_sharp = np.bincount(sharp.ravel(), minlength=count)
    kinds = np.where(n_sharp > 2, _CORNER, np.where(n_sharp == 2, _CREASE, _SMOOTH))
    ends = _sums(sharp.ravel(), level.values, count, sharp[:, ::-1].ravel())
    return np.where(spikes > 0, _CORNER, kinds), ends


def _sharpened(level: CageLevel, smooth: Float64s) -> Float64s:
    """Return moved vertices (v, k): the ``smooth`` ones, except on creases and corners.

    If the next level has another rule, this one weighs by the mean of the remaining sharpness.
    """
    values, sharpness, spikes = level.values, level.sharpness, level.spikes
    if not (sharpness > 0).any() and not (spikes > 0).any():
        return smooth
    softer, blunter = _softer(sharpness), _softer(spikes)
    (kinds, sums), (next_kinds, next_sums) = _kinds(level, sharpness, spikes), _kinds(level, softer, blunter)
    rows = np.flatnonzero((kinds != _SMOOTH) | (next_kinds != _SMOOTH))
    by_rule, by_next = (
        _by_kind(kind[rows], values[rows], 0.75 * values[rows] + 0.125 * ends[rows], smooth[rows])
        for kind, ends in ((kinds, sums), (next_kinds, next_sums))
    )
    ending, blunt = (sharpness > 0) & (softer <= 0), (spikes > 0) & (blunter <= 0)
    at = level.edges[ending].ravel()
    remaining = np.bincount(at, np.repeat(sharpness[ending], 2), len(spikes)) + np.where(blunt, spikes, 0.0)
    counts = np.bincount(at, minlength=len(spikes)) + blunt
    share = np.minimum(remaining / np.maximum(counts, 1), 1.0)[rows, None]
    is_changing = (kinds != next_kinds)[rows, None]
    smooth[rows] = np.where(is_changing, share * by_rule + (1 - share) * by_next, by_rule)
    return smooth
