"""Parts that are too near to each other, moved apart at rest (Benson & Davis 2002, 4.3.1 and 6.2)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s
from octex.checks import as_positive
from octex.errors import ArgumentError
from octex.source.mesh import Mesh
from octex.source.parts import Overlaps, boxes_of

#: The entry of provenance that says which parts were moved, and how far.
SEPARATION = "separation"
#: So many parts find a place each for themselves; more are also moved as they lie.
_SINGLY = 300


def separation_of(mesh: Mesh, margin: float, found: Overlaps | None = None) -> str | None:
    """Return how parts nearer than ``margin`` are moved apart, as an entry of provenance; None if none are.

    Raises ArgumentError as ``Surface.separated`` does.
    """
    margin = as_positive(margin, "margin")
    found = mesh.overlapping_parts(margin) if found is None else found
    if not isinstance(found, Overlaps):
        raise ArgumentError(f"found must be what overlapping_parts returns, not {found!r}")
    if found.margin < margin or len(found.parts) != len(mesh.triangles):
        raise ArgumentError(f"the overlaps given are of a margin of {found.margin:g}, or of another surface")
    pairs = [(pair.a, pair.b) for pair in found.pairs if pair.gap < margin or pair.gap == 0.0]
    if not pairs:
        return None
    offsets = _offsets(*boxes_of(mesh.rest, mesh.triangles, found.parts), pairs, margin)
    moved = {int(part): offsets[part].tolist() for part in np.flatnonzero(offsets.any(axis=1))}
    return json.dumps({"parts": found.n_parts, "digest": _digest(found.parts), "moved": moved})


def separated_rest(mesh: Mesh, separation: str) -> Float64s:
    """Return the rest positions (n, 3) of a mesh whose parts are moved as an entry of provenance says.

    Raises ArgumentError for one of other parts.
    """
    parts = mesh.parts
    try:
        content: dict[str, Any] = json.loads(separation)
        count, digest = int(content["parts"]), str(content["digest"])
        moved = {int(part): [float(step) for step in offset] for part, offset in content["moved"].items()}
        is_sound = all(0 <= part < count and len(offset) == 3 for part, offset in moved.items())
        if not is_sound or not np.isfinite(list(moved.values())).all():
            raise ValueError
    except (ValueError, TypeError, KeyError, AttributeError):
        raise ArgumentError(
            f"what the texture says of its separated parts cannot be read: {separation[:80]!r}"
        ) from None
    if digest != _digest(parts):
        raise ArgumentError(
            f"the texture's {count} parts were moved apart, and they are not the {int(parts.max()) + 1} of "
            f"{mesh.name}: the texture belongs to another model, or to other rest positions"
        )
    offsets = np.zeros((count, 3))
    offsets[list(moved)] = list(moved.values())
    rest = mesh.rest.copy()
    owners = np.full(len(rest), -1, np.int64)
    owners[mesh.triangles] = parts[:, None]
    used = owners >= 0
    rest[used] += offsets[owners[used]]
    return rest


def _digest(parts: Int32s) -> str:
    return hashlib.sha256(parts.astype("<i4").tobytes()).hexdigest()


def _offsets(low: Float64s, high: Float64s, pairs: Iterable[tuple[int, int]], margin: float) -> Float64s:
    """Return how far each part moves (parts, 3), so that what was too near comes to lie beside the rest."""
    # Classes without near parts in one, the largest first: class 0 is what stays.
    sizes = np.ptp([low, high], axis=0).max(axis=1)
    neighbours: dict[int, set[int]] = {}
    for a, b in pairs:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    classes = np.zeros(len(low), np.int64)
    done: dict[int, int] = {}
    for part in sorted(neighbours, key=lambda part: (-sizes[part], part)):
        taken = {done[other] for other in neighbours[part] if other in done}
        classes[part] = done[part] = next(k for k in range(len(taken) + 1) if k not in taken)
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
    """Return offsets (parts, 3) that put groups of parts beside a base, where the whole grows least.

    Each goes to a place beside one that is there already (the extreme points of Crainic et al. 2008).
    """
    offsets = np.zeros_like(low)
    boxes = [(low[group].min(axis=0), high[group].max(axis=0)) for group in groups]
    sides = [high - low for low, high in boxes]
    placed = [base]
    beside = margin * np.eye(3)
    points = base[0] + np.diag(base[1] - base[0]) + beside
    for number in sorted(range(len(groups)), key=lambda number: -sides[number].max()):
        side = sides[number]
        lows, highs = (np.array(corners) for corners in zip(*placed, strict=True))
        whole = np.maximum(points + side, highs.max(axis=0)) - lows.min(axis=0)
        for place in np.lexsort((whole.sum(axis=1), whole.max(axis=1))):
            point = points[place]
            apart = np.maximum(lows - (point + side), point - highs).max(axis=1)
            if (apart >= margin * (1.0 - 1e-9)).all():
                break
        offsets[groups[number]] = point - boxes[number][0]
        placed.append((point, point + side))
        points = np.concatenate([np.delete(points, place, axis=0), point + np.diag(side) + beside])
    return offsets
