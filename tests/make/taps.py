"""The taps of rest positions in a field, listed."""

from __future__ import annotations

from octex.arrays import Floats
from octex.field.blend import Listed, joined, listed
from octex.field.field import Field, Finder
from octex.tree.placement import Placement


def taps_of(
    field: Field, points: Floats, placement: Placement, filter: str = "quadratic", *, gradient: bool = False
) -> Listed:
    blocks = Finder(field, placement, filter, gradient=gradient).blocks(points, field.weighing(field, False))
    return joined([listed(taps, 1.0 / placement.size) for _, taps in blocks])
