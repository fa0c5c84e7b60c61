"""How points are looked at: what users ask for, checked, and as the field takes it."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import NamedTuple, Protocol, TypedDict

import numpy as np
import numpy.typing as npt

from octex.arrays import Array
from octex.checks import as_array, as_choice, as_number, as_point_rows
from octex.errors import ArgumentError
from octex.field.footprints import Footprints, long_footprints, round_footprints
from octex.field.lookups import Query
from octex.field.splines import FILTERS
from octex.texture.lookup import Given

#: Difference of a front and a back, of 1, that footprints without normals may mix.
BLEED_THRESHOLD = 1 / 32

#: How much longer than wide a footprint may be, if nobody says.
ANISOTROPY = 16.0

#: Most that a footprint may be longer than wide.
MOST_ANISOTROPY = 256.0

_MOST_BLUR = float(np.finfo(np.float64).max)


class LookupOptions(TypedDict, total=False):
    """How points are looked at: see `OctreeTexture.sample`."""

    width: npt.ArrayLike | None
    normals: npt.ArrayLike | None
    dPdx: npt.ArrayLike | None
    dPdy: npt.ArrayLike | None
    anisotropy: float
    blur: float
    sharpness: float
    bleed_threshold: float
    normalize: bool
    threads: int | None
    executor: Executor | None


class SurfacePoints(Protocol):
    """Points of a surface, as ``Surface.scatter`` returns them; or a record of hits of one's own."""

    @property
    def rest(self) -> npt.ArrayLike:
        """Rest positions (n, 3). Beside them are normals there: ``rest_normals``, else ``normals``."""


def placed(
    points: npt.ArrayLike | SurfacePoints, normals: npt.ArrayLike | None = None
) -> tuple[Array, npt.ArrayLike | None]:
    """Return rest positions (n, 3), and normals: those that are given, else those that points come with.

    Raises ArgumentError for what are no positions.
    """
    if not hasattr(points, "rest"):
        return as_point_rows(points), normals
    if normals is None:
        normals = getattr(points, "rest_normals", getattr(points, "normals", None))
    return as_point_rows(points.rest, "points' rest"), normals


class Lens(NamedTuple):
    """What is the same for all points of a lookup; see `OctreeTexture.sample`."""

    filter: str
    anisotropy: float = ANISOTROPY
    blur: float = 0.0
    sharpness: float = 0.0
    bleed_threshold: float = BLEED_THRESHOLD

    def given(
        self,
        points: npt.ArrayLike | SurfacePoints,
        *,
        normals: npt.ArrayLike | None,
        gradient: bool = False,
        **more: npt.ArrayLike | None,
    ) -> dict[str, Array]:
        """Return what is given of points, a row for each. Raises ArgumentError for what does not fit."""
        places, normals = placed(points, normals)
        given = {"points": places}
        as_choice(self.filter, FILTERS, "filter")
        if gradient and self.filter == "nearest":
            raise ArgumentError(f"nearest has no gradient; {', '.join(FILTERS[1:])} have one")
        as_number(self.anisotropy, "anisotropy", 1.0, MOST_ANISOTROPY)
        as_number(self.blur, "blur", 0.0, _MOST_BLUR)
        as_number(self.sharpness, "sharpness", 0.0, 1.0)
        as_number(self.bleed_threshold, "bleed_threshold", 0.0, np.inf)
        n = len(places)
        for name, array in (("normals", normals), *more.items()):
            if array is None:
                continue
            if name == "width":
                given[name] = _as_widths(array, n)
            else:
                given[name] = as_point_rows(array, name)
                if len(given[name]) != n:
                    raise ArgumentError(
                        f"{name} must have a row for each of {n} points, not {len(given[name])}"
                    )
        if ("dPdx" in given) != ("dPdy" in given):
            raise ArgumentError("dPdx and dPdy are given together or not at all")
        if "width" in given and "dPdx" in given:
            raise ArgumentError("a footprint has a width, or dPdx and dPdy, not both")
        if self.sharpness > 0 and not self.has_footprints(given):
            raise ArgumentError("sharpness is for footprints: give a width, or dPdx and dPdy, or blur")
        if self.anisotropy != ANISOTROPY and "dPdx" not in given:
            raise ArgumentError("anisotropy is for footprints longer than wide: give dPdx and dPdy")
        if self.bleed_threshold != BLEED_THRESHOLD and ("normals" in given or not self.has_footprints(given)):
            raise ArgumentError(
                "bleed_threshold is for footprints without normals: leave it out, or give a width, or dPdx "
                "and dPdy, or blur, and no normals"
            )
        return given

    def has_footprints(self, given: Given) -> bool:
        """Say whether points are looked up with footprints."""
        return "width" in given or "dPdx" in given or self.blur > 0

    def query(self, given: Given) -> Query:
        """Return what is asked of a block of points, whose arrays are as kernels take them."""
        footprints: Footprints | None = None
        if "dPdx" in given:
            derivatives = given["dPdx"], given["dPdy"]
            footprints = long_footprints(*derivatives, self.blur, self.anisotropy, self.sharpness)
        elif self.has_footprints(given):
            widths = given["width"].astype(np.float64) if "width" in given else np.zeros(len(given["points"]))
            footprints = round_footprints(widths + self.blur, self.sharpness)
        normals = given.get("normals")
        if normals is not None:
            most = np.finfo(np.float32).max
            normals = np.clip(normals, -most, most).astype(np.float32, copy=False)
        return Query(self.filter, footprints, normals)


def _as_widths(width: npt.ArrayLike, n: int) -> Array:
    array = as_array(width)
    if array.dtype.kind not in "fiu" or array.shape not in ((), (n,)):
        raise ArgumentError(f"width must be a real number or (n,) of them, not {array.dtype} {array.shape}")
    return np.broadcast_to(array, (n,))
