"""Where the root cell lies: rest positions, in the model's units, to texture space and back.

Texture space is the root cell [0, 1)³. The bounds' centre is put at a third of a finest cell on each axis, so
that the faces of a box do not lie on cell planes, where rounding decides which cell a point is in.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s, Int32s
from octex.checks import as_depth, as_points, as_positive, as_real, as_reals
from octex.errors import ArgumentError, ModelWarning
from octex.tree.layout import GRID_BITS, MAX_DEPTH

#: The least and the largest edge of a root cell, and how far from 0 its corner may be: slopes by position,
#: footprints and the squares of distances then stay inside the range of single precision.
SMALLEST, LARGEST = 1e-15, 1e30
#: Cells along the longest side at depth 10, the default of conversions.
_USUAL = (1 << 10) - 3


class Placement(NamedTuple):
    """The root cell in rest space: its lowest corner and the length of its edge."""

    origin: tuple[float, float, float]
    size: float

    @classmethod
    def checked(cls, placement: Placement) -> Placement:
        """Return a placement of plain numbers, or raise ArgumentError for anything else, or out of range."""
        if not isinstance(placement, Placement):
            raise ArgumentError(f"placement must be a Placement, not {placement!r}")
        x, y, z = as_reals(placement.origin, "the corner of the root cell", (3,)).tolist()
        plain = cls((x, y, z), as_real(placement.size, "the size of the root cell"))
        plain.check()
        return plain

    @classmethod
    def around(cls, bounds: npt.ArrayLike, depth: int) -> Placement:
        """Fit a root cell of ``depth`` levels around ``bounds`` (2, 3) with the smallest safe margin.

        The longest side takes 2ᵈ − 3 finest cells (of depth 2 at least), so every side has a margin of at
        least one of them. Raises ArgumentError for bounds that are not finite, out of order, or too far out
        or too close together.
        """
        bounds, extent = _checked(bounds)
        cells = 1 << max(as_depth(depth), 2)
        return cls._centred(bounds, extent / (cells - 3) * cells if extent > 0 else 1.0, depth)

    @classmethod
    def with_cell(cls, bounds: npt.ArrayLike, cell: float) -> tuple[Placement, int]:
        """Fit a root cell around ``bounds`` (2, 3) whose finest cells have the edge ``cell``, and the depth.

        Raises ArgumentError if that takes more than 21 levels; warns if the model is smaller than one.
        """
        bounds, extent = _checked(bounds)
        cell = as_positive(cell, "cell")
        if 0 < extent < cell:
            warnings.warn(
                f"cell {cell:g} is larger than the model, whose longest side is {extent:.4g}; the default "
                f"depth has cells of {extent / _USUAL:.2g}",
                ModelWarning,
                stacklevel=4,
            )
        for depth in range(2, MAX_DEPTH + 1):
            if ((1 << depth) - 3) * cell >= extent:
                return cls._centred(bounds, (1 << depth) * cell, depth), depth
        smallest = extent / ((1 << MAX_DEPTH) - 3)
        raise ArgumentError(
            f"cell {cell:g} needs more than {MAX_DEPTH} levels; the smallest for this model is {smallest:g}"
        )

    def check(self) -> None:
        """Raise ArgumentError for a root cell whose size or corner is not finite or out of range."""
        if not SMALLEST <= self.size <= LARGEST or not all(abs(each) <= LARGEST for each in self.origin):
            raise ArgumentError(
                f"the root cell must have a size from {SMALLEST:g} to {LARGEST:g} and a corner no farther "
                f"from 0, not size {self.size:g} at {tuple(self.origin)}; use other units"
            )

    @classmethod
    def _centred(cls, bounds: Float64s, size: float, depth: int) -> Placement:
        cells = 1 << depth
        size = as_positive(size, "the size of the root cell")
        centre = bounds[0] + (bounds[1] - bounds[0]) / 2
        x, y, z = (centre - (cells // 2 + 1 / 3) * (size / cells)).tolist()
        placement = cls((x, y, z), size)
        placement.check()
        return placement

    def to_texture_space(self, points: npt.ArrayLike) -> Float64s:
        """Map rest positions (n, 3) into texture space, in float64."""
        return np.asarray((as_points(points) - np.array(self.origin)) * (1.0 / self.size))

    def to_rest(self, points: npt.ArrayLike) -> Float64s:
        """Map points (n, 3) of texture space to rest positions, in float64."""
        return np.asarray(as_points(points) * self.size + np.array(self.origin), np.float64)


def on_grid(rest: npt.ArrayLike, placement: Placement) -> Int32s:
    """Round finite rest positions (n, 3) to steps of 2⁻³⁰ of the root's edge, clamped into it.

    Shifted right by 30 − depth they are the cells that lookups find.
    """
    steps = placement.to_texture_space(rest)
    steps *= 1 << GRID_BITS
    np.rint(steps, out=steps)
    np.clip(steps, 0, (1 << GRID_BITS) - 1, out=steps)
    return steps.astype(np.int32)


def _checked(bounds: npt.ArrayLike) -> tuple[Float64s, float]:
    box = as_points(bounds, "bounds").astype(np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
        raise ArgumentError(f"bounds must be a finite lowest and highest corner, not {box.tolist()}")
    return box, float((box[1] - box[0]).max())
