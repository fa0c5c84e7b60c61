"""Repair a surface: leave out triangles that add nothing, close cracks, and count all of it."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int32s
from octex.checks import as_flag, as_positive
from octex.cleaning.cracks import closed_cracks
from octex.cleaning.inner import seen_triangles
from octex.source.corners import has_area
from octex.source.surface import NOT_FINITE, Surface, as_surface
from octex.source.welding import welded
from octex.tree.placement import Placement

#: The entry of provenance that counts what a repair changed.
REPAIR = "repair"
#: Cracks are narrower than a cell of this depth, if no cell is given.
_DEPTH = 10


class Repairs(NamedTuple):
    """How many triangles a repair left out, and how many vertices it moved."""

    not_finite: int  # triangles with a vertex that is not finite
    degenerate: int  # triangles without area
    duplicate: int  # triangles with the corners of an earlier one, in the same order
    inner: int  # triangles that nothing outside can see
    moved: int  # vertices that were moved to close cracks

    def __str__(self) -> str:
        names = "not finite", "without area", "duplicate", "inner"
        parts = [f"{count:,} {name}" for name, count in zip(names, self, strict=False) if count]
        text = f"left out triangles: {', '.join(parts)}" if parts else "left out no triangle"
        return f"{text}; moved {self.moved:,} vertices to close cracks" if self.moved else text


def repair(surface: Surface, *, cell: float | None = None, inner: bool = True) -> tuple[Surface, Repairs]:
    """Return a surface without what scans and generated meshes have too much of, and the counts of that.

    cell   cracks narrower than this are closed, in the model's units (default: a cell of depth 10)
    inner  leave out triangles that nothing outside can see, from either side

    Triangles without area are left out, and those with the corners of an earlier one in the same order. Open
    edges that face each other across a crack are drawn together: pairs of vertices move to their middle. The
    other triangles keep their order, values, texture coordinates and normals.

    A triangle is seen if a straight line from a point of it meets no other triangle on its way to space that
    is connected with the outside. Lines run in 64 directions, and toward such space near the point. That
    space is found in cells of 1/256 of the model, so a hole wider than a cell keeps what lies behind it.

    ``load_surface(…, finite=True)`` leaves out triangles with vertices that are not finite; they are counted
    here too. The same surface gives the same result; the result's provenance holds the counts.

    Raises ArgumentError for anything but a Surface, and for a cell that is not above zero; ModelError if no
    triangle has an area.
    """
    as_surface(surface)
    as_flag(inner, "inner")
    width = Placement.around(surface.bounds, _DEPTH).size / 2**_DEPTH if cell is None else cell
    width = as_positive(width, "cell")
    degenerate, duplicate = _useless(surface.rest, surface.triangles)
    counts = [int(degenerate.sum()), int(duplicate.sum()), 0]
    kept = surface.part(np.flatnonzero(~(degenerate | duplicate)))
    seen = np.ones(len(kept.triangles), np.bool_)
    rest, vertices, moved = closed_cracks(kept.rest, kept.vertices, kept.triangles, width)
    if moved:
        is_posed = kept.rest is not kept.vertices
        kept = kept.with_rest(rest)
        kept = kept.with_pose(vertices if is_posed else kept.rest)
        degenerate, duplicate = _useless(kept.rest, kept.triangles)
        counts[0] += int(degenerate.sum())
        counts[1] += int(duplicate.sum())
        seen = ~(degenerate | duplicate)
    if inner:
        chosen = np.flatnonzero(seen)
        seen[chosen] = seen_triangles(kept.rest, kept.triangles[chosen])
        counts[2] = int(chosen.size - seen.sum())
    kept = kept.part(np.flatnonzero(seen))
    degenerates, duplicates, hidden = counts
    not_finite = int(surface.provenance.get(NOT_FINITE, 0))
    found = Repairs(not_finite, degenerates, duplicates, hidden, moved)
    kept.provenance[REPAIR] = json.dumps(found._asdict())
    return kept, found


def _useless(rest: Float64s, triangles: Int32s) -> tuple[Bools, Bools]:
    """Say which triangles (m,) have no area, and which of the others have the corners of an earlier one."""
    degenerate = ~has_area(rest[triangles])
    names = welded(rest)[triangles]
    least = names.argmin(axis=1)[:, None]
    turned = np.take_along_axis(names, (least + np.arange(3)) % 3, axis=1)
    _, first = np.unique(numbers := welded(turned), return_index=True)
    duplicate = first[numbers] != np.arange(len(triangles))
    return degenerate, duplicate & ~degenerate
