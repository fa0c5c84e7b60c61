"""Repairs a surface: removes useless triangles, closes cracks, and counts both."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s
from octex.checks import as_flag, as_positive
from octex.cleaning.cracks import closed_cracks
from octex.cleaning.inner import seen_triangles
from octex.errors import ModelError
from octex.source.corners import has_area
from octex.source.surface import NOT_FINITE, Surface, as_surface
from octex.source.welding import first_equal, welded
from octex.tree.placement import Placement

#: The provenance entry that counts the changes of a repair.
REPAIR = "repair"
#: Cracks are narrower than a cell of this depth, if no cell is given.
_DEPTH = 10


class Repairs(NamedTuple):
    """Numbers of removed triangles, by reason, and of moved vertices."""

    not_finite: int  # triangles with a non-finite vertex
    degenerate: int  # triangles without area
    duplicate: int  # triangles with the corners of an earlier one, in the same order
    inner: int  # triangles that are invisible from outside
    moved: int  # vertices moved to close cracks

    def __str__(self) -> str:
        names = "not finite", "without area", "duplicate", "inner"
        parts = [f"{count:,} {name}" for name, count in zip(names, self, strict=False) if count]
        text = f"left out triangles: {', '.join(parts)}" if parts else "left out no triangle"
        return f"{text}; moved {self.moved:,} vertices to close cracks" if self.moved else text


def repair(surface: Surface, *, cell: float | None = None, inner: bool = True) -> tuple[Surface, Repairs]:
    """Return a surface without the usual defects of scans and generated meshes, and counts of changes.

    cell   cracks narrower than this are closed, in the model's units (default: a cell of depth 10)
    inner  remove triangles that are invisible from outside, from both sides

    It removes triangles without area, and those with the corners of an earlier one in the same order. Open
    edges that face each other across a crack are joined: pairs of vertices move to their middle. The other
    triangles keep their order, values, texture coordinates and normals.

    A triangle is visible if a straight line from a point of it reaches space connected to the outside and
    hits no other triangle before. Lines run in 64 directions, and toward such space near the point. That
    space is found in cells of 1/256 of the model, so triangles behind a hole wider than a cell stay. Those in
    a cell of more than 10,000 triangles stay too, and so do cracks in one of more than 1,000 border vertices.

    ``load_surface(…, finite=True)`` removes triangles with non-finite vertices; they are counted here too.
    The same surface gives the same result; the result's provenance holds the counts.

    Raises ArgumentError for an argument that is not a Surface, and for a cell that is not above zero;
    ModelError if no triangle has an area.
    """
    as_surface(surface)
    as_flag(inner, "inner")
    width = Placement.around(surface.bounds, _DEPTH).size / 2**_DEPTH if cell is None else cell
    width = as_positive(width, "cell")
    degenerate, duplicate = _useless(surface.rest, surface.triangles)
    if degenerate.all():
        raise ModelError(f"{surface.name}: no triangle has an area")
    counts = [int(degenerate.sum()), int(duplicate.sum()), 0]
    repaired = surface.part(np.flatnonzero(~(degenerate | duplicate)))
    is_kept = np.ones(len(repaired.triangles), np.bool_)
    rest, vertices, moved = closed_cracks(repaired.rest, repaired.vertices, repaired.triangles, width)
    if moved:
        is_posed = repaired.rest is not repaired.vertices
        repaired = repaired.with_rest(rest)
        repaired = repaired.with_pose(vertices if is_posed else repaired.rest)
        degenerate, duplicate = _useless(repaired.rest, repaired.triangles)
        counts[0] += int(degenerate.sum())
        counts[1] += int(duplicate.sum())
        is_kept = ~(degenerate | duplicate)
    if inner:
        candidates = np.flatnonzero(is_kept)
        is_kept[candidates] = seen_triangles(repaired.rest, repaired.triangles[candidates])
        counts[2] = int(candidates.size - is_kept.sum())
    repaired = repaired.part(np.flatnonzero(is_kept))
    degenerates, duplicates, hidden = counts
    not_finite = int(surface.provenance.get(NOT_FINITE, 0))
    repairs = Repairs(not_finite, degenerates, duplicates, hidden, moved)
    repaired.provenance[REPAIR] = json.dumps(repairs._asdict())
    return repaired, repairs


def _useless(rest: Float64s, triangles: Int32s) -> tuple[Bools, Bools]:
    """Say which triangles (m,) have no area, and which of the others have the corners of an earlier one."""
    degenerate = ~has_area(rest[triangles])
    names = welded(rest)[triangles]
    least = names.argmin(axis=1)[:, None]
    turned = np.take_along_axis(names, (least + np.arange(3)) % 3, axis=1)
    duplicate = first_equal(turned) != np.arange(len(triangles))
    return degenerate, duplicate & ~degenerate
