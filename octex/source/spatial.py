"""Sources whose values depend on where in space a point of the surface lies, and what turns into them."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ChannelFormat
from octex.jit import kernel
from octex.source.base import Source
from octex.source.mesh import Mesh
from octex.source.vectors import between, cross_product, edges_from, length_of

#: By how much a cosine of normals in single precision may seem less than it is.
_COSINE_ROUNDING = 1e-6


class Placeable(ABC):
    """Something that gives a channel's values once it is laid on a surface: see ``Surface.with_sources``."""

    _latest: tuple[Float64s, Int32s, Source] | None = None

    @abstractmethod
    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:
        """Return a source of one channel for a surface, and what provenance says of it.

        ``filter``, one of filters.FILTERS, is how images are averaged over footprints. Raises ModelError,
        ImageError or ArgumentError for what cannot be laid on that surface.
        """

    def _shared(self, mesh: Mesh, make: Callable[[], Source]) -> Source:
        """Return what ``make`` returns for a mesh: the same source for all channels, one after another."""
        latest = self._latest
        if latest is None or latest[0] is not mesh.rest or latest[1] is not mesh.triangles:
            latest = self._latest = mesh.rest, mesh.triangles, make()
        return latest[2]


def least_cosine(degrees: float) -> float:
    """Return the cosine of an angle that normals are to agree within, less what it may be rounded by."""
    return float(np.cos(np.radians(degrees))) - _COSINE_ROUNDING


class SpatialSource(Source):
    """Gives values to rest positions and face normals.

    ``rest`` (n, 3) positions and ``triangles`` (m, 3) are those of the surface.
    """

    def __init__(self, channels: Sequence[ChannelFormat], rest: Float64s, triangles: Int32s) -> None:
        self._channels = tuple(channels)
        self._rest = rest
        self._triangles = triangles

    @abstractmethod
    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at rest positions (n, 3), averaged over widths in rest units.

        ``normals`` (n, 3) are those of the faces at rest, of length 1; zeros on triangles without area.
        """

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self.at(*placed(self._rest, self._triangles, triangles, barycentric), widths)

    def with_rest(self, rest: Float64s) -> SpatialSource:
        """Return the same values by position, on other rest positions (n, 3)."""
        other = copy.copy(self)
        other._rest = rest
        return other


def placed(
    rest: Float64s, faces: Int32s, triangles: Int32s, barycentric: Float64s
) -> tuple[Float64s, Float64s]:
    """Return the rest positions (n, 3) of points of triangles, and the unit normals of their faces there."""
    points, normals = np.empty((2, len(triangles), 3))
    _place(rest, faces, triangles, barycentric, points, normals)
    return points, normals


@kernel
def _place(
    rest: Float64s,
    faces: Int32s,
    triangles: Int32s,
    barycentric: Float64s,
    points: Float64s,
    normals: Float64s,
) -> None:
    """Fill in the positions and unit normals of points of triangles."""
    last = -1
    x = y = z = 0.0
    for n in range(triangles.size):
        triangle = int(triangles[n])
        shares = barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        points[n, 0], points[n, 1], points[n, 2] = between(rest, faces, triangle, shares)
        if triangle != last:
            last = triangle
            e, f = edges_from(rest, faces, triangle)
            x, y, z = cross_product(e, f)
            length = length_of((x, y, z))
            if length > 0.0:
                x, y, z = x / length, y / length, z / length
        normals[n, 0], normals[n, 1], normals[n, 2] = x, y, z
