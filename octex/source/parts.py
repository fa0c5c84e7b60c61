"""The parts of a surface: finds parts that intersect or nearly touch, and moves them apart at rest.

Such parts share cells of a texture, and their colours bleed (Benson & Davis 2002, 4.3.1 and 6.2).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.checks import as_number, as_positive
from octex.errors import ArgumentError
from octex.files import count_text
from octex.jit import kernel
from octex.nearest.triangles import MeshBoxes, gap, mesh_of
from octex.source.welding import first_equal, paired_sides

if TYPE_CHECKING:
    from manifold3d import Manifold

    from octex.source.mesh import Mesh

Reason = Literal["open", "not manifold", "without volume"]

#: The key of the moved parts in provenance.
SEPARATION = "separation"
#: At most this many parts are also placed one by one, besides in groups.
_SINGLY = 300
#: Solids that share less than this fraction of the smaller one's volume only touch.
_SHARED = 1e-9


class Overlap(NamedTuple):
    """Two parts that intersect, or come nearer than the margin."""

    a: int
    b: int
    volume: float | None  # of their intersection, in cubic units; None unless both are solid
    gap: float  # smallest distance of their surfaces; 0 if they cross, infinity beyond the margin


class Unchecked(NamedTuple):
    """A part that is no solid: parts inside it are not found, only parts near its surface."""

    part: int
    triangles: int
    why: Reason


class Overlaps(NamedTuple):
    """The pairs of a surface's parts that intersect or come nearer than a margin."""

    margin: float
    parts: Int32s  # (m,)   the part of each triangle, numbered by their first triangles
    pairs: tuple[Overlap, ...]  # sorted
    unchecked: tuple[Unchecked, ...]

    @property
    def n_parts(self) -> int:
        """The number of parts."""
        return int(self.parts.max()) + 1

    def __str__(self) -> str:
        parts, pairs = count_text(self.n_parts, "part"), count_text(len(self.pairs), "pair")
        lines = [f"{parts}, {pairs} that intersect or come near"]
        for a, b, volume, distance in self.pairs:
            apart = f"are {distance:.4g} apart" if distance else "cross or touch"
            if math.isinf(distance):
                apart = f"are more than {self.margin:g} apart" if self.margin else "do not cross"
            shared = f"share a volume of {volume:.4g}" if volume else "share no volume"
            lines.append(
                f"parts {a} and {b}: their surfaces {apart}" + ("" if volume is None else f"; they {shared}")
            )
        lines += [
            f"part {part} of {count_text(triangles, 'triangle')} is {why}: only its surface was checked, not "
            "what lies inside"
            for part, triangles, why in self.unchecked
        ]
        return "\n".join(lines)


def overlapping_parts(rest: Float64s, triangles: Int32s, margin: float = 0.0) -> Overlaps:
    """Find the parts that intersect or come nearer than ``margin``: ``Surface.overlapping_parts``."""
    margin = as_number(margin, "margin", 0.0, 1e30)
    welded = first_equal(rest)
    parts = parts_of(triangles, welded)
    order = np.argsort(parts, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)
    solids = [_solid(rest, triangles[part], welded) for part in members]
    boxes: dict[int, MeshBoxes] = {}
    pairs = []
    low, high = boxes_of(rest, triangles, parts)
    for a, b in _near_boxes(low, high, margin):
        for part in (a, b):
            if part not in boxes:
                boxes[part] = mesh_of(rest[triangles[members[part]]])
        distance = gap(boxes[a], boxes[b], margin)
        is_inside = (low[a] >= low[b]).all() and (high[a] <= high[b]).all()
        is_outside = (low[a] <= low[b]).all() and (high[a] >= high[b]).all()
        # Apart and not one in the other: the intersection is empty without a boolean.
        is_clear = distance > 0.0 and not is_inside and not is_outside
        solid_a, solid_b, volume = solids[a], solids[b], None
        if not (isinstance(solid_a, str) or isinstance(solid_b, str)):
            shared = 0.0 if is_clear else (solid_a ^ solid_b).volume()
            volume = shared if shared > _SHARED * min(solid_a.volume(), solid_b.volume()) else 0.0
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

    Triangles are in one part if they share a vertex, or an edge (by position, ``welded``) without a third
    triangle. An open part is then joined with the parts that touch it at a vertex.
    """
    parents = np.arange(len(welded))
    join(parents, np.repeat(triangles[:, 0], 2).astype(np.int64), triangles[:, 1:].ravel().astype(np.int64))
    corners = welded[triangles]
    pairs = paired_sides(corners.ravel(), np.roll(corners, -1, axis=1).ravel())
    join(parents, *(triangles[sides // 3, 0].astype(np.int64) for sides in pairs))
    # A part is open if an edge has unequal numbers of triangles in both directions.
    roots = parents[triangles[:, 0]]
    keys, ways = edges_of(triangles, welded)
    owners = np.tile(roots, 3)
    order = np.lexsort((keys, owners))
    keys, owners = keys[order], owners[order]
    starts = np.flatnonzero((np.diff(keys, prepend=-1) != 0) | (np.diff(owners, prepend=-1) != 0))
    is_open = np.isin(roots, owners[starts[np.add.reduceat(ways[order], starts) != 0]])
    loose = triangles[is_open].ravel().astype(np.int64)
    _, first, inverse = np.unique(welded[loose], return_index=True, return_inverse=True)
    join(parents, loose, loose[first[inverse]])
    _, first, parts = np.unique(parents[triangles[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[parts]


def edges_of(triangles: Int32s, welded: Int64s) -> tuple[Int64s, Int64s]:
    """Return the numbers of the edges of triangles (3·m,), and their directions."""
    corners = welded[triangles]
    a = corners.T.ravel()
    b = corners[:, [1, 2, 0]].T.ravel()
    return np.minimum(a, b) * len(welded) + np.maximum(a, b), np.sign(b - a)


@kernel
def join(parents: Int64s, a: Int64s, b: Int64s) -> None:
    """Join the sets of a[i] and b[i]. Then every parent is the least member of its set (union-find)."""
    for i in range(a.size):
        x, y = a[i], b[i]
        while parents[x] != x:
            parents[x] = parents[parents[x]]
            x = parents[x]
        while parents[y] != y:
            parents[y] = parents[parents[y]]
            y = parents[y]
        parents[max(x, y)] = min(x, y)
    for i in range(parents.size):
        parents[i] = parents[parents[i]]


def _solid(rest: Float64s, triangles: Int32s, welded: Int64s) -> Manifold | Reason:
    """Return the solid that triangles enclose, with outward normals, or a reason why they enclose none."""
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


def _near_boxes(low: Float64s, high: Float64s, margin: float) -> Iterator[tuple[int, int]]:
    """Yield pairs of boxes, ``low`` and ``high`` (n, 3), with gaps of at most ``margin``."""
    sweeps = []
    for axis in range(3):
        order = np.argsort(low[:, axis], kind="stable")
        ends = np.searchsorted(low[order, axis], high[order, axis] + margin, side="right")
        sweeps.append((order, ends))
    order, ends = min(sweeps, key=lambda sweep: int(sweep[1].sum()))  # the axis with the fewest overlaps
    for number, (a, end) in enumerate(zip(order.tolist(), ends.tolist(), strict=True), 1):
        others = order[number:end]
        meets = ((low[a] <= high[others] + margin) & (low[others] <= high[a] + margin)).all(axis=1)
        for b in others[meets].tolist():
            yield a, b


def separation_of(mesh: Mesh, margin: float, overlaps: Overlaps | None) -> str | None:
    """Return the entry of provenance that moves parts nearer than ``margin`` apart; None without any."""
    margin = as_positive(margin, "margin")
    overlaps = mesh.overlapping_parts(margin) if overlaps is None else overlaps
    if not isinstance(overlaps, Overlaps):
        raise ArgumentError(f"overlaps must be the result of overlapping_parts, not {overlaps!r}")
    if overlaps.margin < margin or len(overlaps.parts) != len(mesh.triangles):
        raise ArgumentError(
            f"the overlaps were computed with a margin of {overlaps.margin:g}, or for another surface"
        )
    pairs = [(pair.a, pair.b) for pair in overlaps.pairs if pair.gap < margin or pair.gap == 0.0]
    if not pairs:
        return None
    offsets = _offsets(*boxes_of(mesh.rest, mesh.triangles, overlaps.parts), pairs, margin)
    moves = {int(part): offsets[part].tolist() for part in np.flatnonzero(offsets.any(axis=1))}
    return json.dumps({"parts": overlaps.n_parts, "digest": _digest(overlaps.parts), "moved": moves})


def separated_rest(mesh: Mesh, separation: str) -> Float64s:
    """Return the rest positions (n, 3) of a mesh after the moves in an entry of provenance."""
    parts = mesh.parts
    try:
        content: dict[str, Any] = json.loads(separation)
        count, digest = int(content["parts"]), str(content["digest"])
        moves = {int(part): [float(step) for step in offset] for part, offset in content["moved"].items()}
        is_sound = all(0 <= part < count and len(offset) == 3 for part, offset in moves.items())
        if not is_sound or not np.isfinite(list(moves.values())).all():
            raise ValueError
    except (ValueError, TypeError, KeyError, AttributeError):
        raise ArgumentError(
            f"the texture's metadata about its separated parts cannot be read: {separation[:80]!r}"
        ) from None
    if digest != _digest(parts):
        raise ArgumentError(
            f"the texture's {count} parts were moved apart, and they are not the {int(parts.max()) + 1} of "
            f"{mesh.name}: the texture belongs to another model, or to other rest positions"
        )
    offsets = np.zeros((count, 3))
    offsets[list(moves)] = list(moves.values())
    rest = mesh.rest.copy()
    part_of = np.full(len(rest), -1, np.int64)
    part_of[mesh.triangles] = parts[:, None]
    is_used = part_of >= 0
    rest[is_used] += offsets[part_of[is_used]]
    return rest


def _digest(parts: Int32s) -> str:
    return hashlib.sha256(parts.astype("<i4").tobytes()).hexdigest()


def _offsets(low: Float64s, high: Float64s, pairs: Iterable[tuple[int, int]], margin: float) -> Float64s:
    """Return offsets (parts, 3) that move parts of too near ``pairs`` next to the model."""
    # Classes of parts that are not near each other, the largest first. Class 0 does not move.
    sizes = np.ptp([low, high], axis=0).max(axis=1)
    neighbours: dict[int, set[int]] = {}
    for a, b in pairs:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    classes = np.zeros(len(low), np.int64)
    class_of: dict[int, int] = {}
    for part in sorted(neighbours, key=lambda part: (-sizes[part], part)):
        taken = {class_of[other] for other in neighbours[part] if other in class_of}
        classes[part] = class_of[part] = next(k for k in range(len(taken) + 1) if k not in taken)
    groups = [np.flatnonzero(classes == k) for k in range(classes.max() + 1)]
    base = low[groups[0]].min(axis=0), high[groups[0]].max(axis=0)
    layouts = [_packed(low, high, base, groups[1:], margin)]
    moving = np.flatnonzero(classes)
    if len(moving) <= _SINGLY:
        layouts.append(_packed(low, high, base, [moving[i : i + 1] for i in range(len(moving))], margin))

    def size(offsets: Float64s) -> tuple[float, float]:
        extent = np.ptp([(low + offsets).min(axis=0), (high + offsets).max(axis=0)], axis=0)
        return float(extent.max()), float(extent.sum())

    return min(layouts, key=size)


def _packed(
    low: Float64s, high: Float64s, base: tuple[Float64s, Float64s], groups: list[Int64s], margin: float
) -> Float64s:
    """Return offsets (parts, 3) that move groups of parts next to a base, where the bounds grow least.

    Candidates are the extreme points of Crainic et al. 2008.
    """
    offsets = np.zeros_like(low)
    boxes = [(low[group].min(axis=0), high[group].max(axis=0)) for group in groups]
    sides = [high - low for low, high in boxes]
    placed = [base]
    margins = margin * np.eye(3)
    points = base[0] + np.diag(base[1] - base[0]) + margins
    for number in sorted(range(len(groups)), key=lambda number: -sides[number].max()):
        side = sides[number]
        lows, highs = (np.array(corners) for corners in zip(*placed, strict=True))
        whole = np.maximum(points + side, highs.max(axis=0)) - lows.min(axis=0)
        for candidate in np.lexsort((whole.sum(axis=1), whole.max(axis=1))):
            point = points[candidate]
            gaps = np.maximum(lows - (point + side), point - highs).max(axis=1)
            if (gaps >= margin * (1.0 - 1e-9)).all():
                break
        offsets[groups[number]] = point - boxes[number][0]
        placed.append((point, point + side))
        points = np.concatenate([np.delete(points, candidate, axis=0), point + np.diag(side) + margins])
    return offsets
