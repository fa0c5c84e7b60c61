"""Parts moved apart by so many cells, before a conversion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from octex.checks import as_depth, as_number, as_positive
from octex.errors import ArgumentError
from octex.source.parts import Overlaps
from octex.source.surface import Surface, as_surface
from octex.tree.placement import Placement

DEFAULT_DEPTH = 10
#: Parts that are so many cells apart share none, and no lookup at the finest level reads both: the widest
#: filter reads two cells to each side.
CELLS = 3.0
#: How many cells parts may be kept apart by.
RANGE = (1.0, 1e6)
# Surfaces n cells apart along no axis may be √3 times as far from each other.
_DIAGONAL = math.sqrt(3.0)
# Beyond so many times the surface's extent, cells grow as fast as what parts must be apart.
_MOST = 4.0


class Separated(NamedTuple):
    """A surface whose parts are apart, and which were not."""

    surface: Surface
    found: Overlaps  # of the surface as it was


def as_margin(separate: float | bool | None) -> float | None:
    """Return by how many finest cells to keep parts apart, None for not at all, or raise ArgumentError."""
    if isinstance(separate, (bool, np.bool_)):
        return CELLS if separate else None
    return None if separate is None else as_number(separate, "separate", *RANGE)


def as_fineness(depth: int | None, cell: float | None) -> tuple[int | None, float | None]:
    """Return ``depth`` and ``cell`` as numbers, one at most, or raise ArgumentError."""
    if depth is not None and cell is not None:
        raise ArgumentError("give depth or cell, not both")
    return None if depth is None else as_depth(depth), None if cell is None else as_positive(cell, "cell")


def separate(
    surface: Surface, cells: float = CELLS, *, depth: int | None = None, cell: float | None = None
) -> Separated:
    """Move parts of a surface apart that come nearer to each other than ``cells`` finest cells.

    ``depth`` or ``cell`` is the texture's resolution, as for ``convert``. Afterwards at least ``cells`` empty
    cells lie between such parts along some axis. Coarse levels still mix parts, over twice the distance with
    every level. See ``Surface.separated``.

    Raises ArgumentError for numbers out of range, and for a depth with too few cells for all parts.
    """
    as_surface(surface)
    cells = as_number(cells, "cells", *RANGE)
    depth, cell = as_fineness(depth, cell)
    depth = DEFAULT_DEPTH if depth is None else depth

    def reach(placed: Surface) -> float:
        edge = Placement.around(placed.bounds, depth).size / 2**depth if cell is None else cell
        return _DIAGONAL * cells * edge

    margin = reach(surface)
    most = max(margin, _MOST * float((surface.bounds[1] - surface.bounds[0]).max()))
    found = surface.overlapping_parts(margin)
    while margin <= most:
        if found.margin < margin:
            found = surface.overlapping_parts(2.0 * margin)
        made = surface.separated(margin, found)
        # The whole has grown, and with it the cells.
        if reach(made) <= margin * (1.0 + 1e-9):
            return Separated(made, found)
        margin = 1.01 * reach(made)
    raise ArgumentError(
        f"{surface.name}: {found.n_parts} parts do not fit {cells:g} cells apart into depth {depth}; "
        "use a larger depth"
    )
