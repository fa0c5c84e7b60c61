"""Some of a surface's triangles, with its source."""

from __future__ import annotations

from octex.arrays import Float32s, Float64s, Int32s
from octex.source.base import OfAnother, Source


class Picked(OfAnother):
    """The source of a whole surface, for a surface of some of its triangles.

    ``triangles`` (k,) and ``vertices`` (v,) are their numbers in the whole, ``rest`` (n, 3) the whole's rest
    positions. What the source keeps ready is shared by all that is picked from it.
    """

    def __init__(self, source: Source, triangles: Int32s, vertices: Int32s, rest: Float64s) -> None:
        self._source = source
        self._triangles = triangles
        self._vertices = vertices
        self._rest = rest

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self._source.evaluate(self._triangles[triangles], barycentric, widths)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        return self._source.texel_edges(self._triangles[triangles])

    def with_rest(self, rest: Float64s) -> Picked:
        """Return the same source on other rest positions of the picked vertices (v, 3)."""
        whole = self._rest.copy()
        whole[self._vertices] = rest
        return Picked(self._source.with_rest(whole), self._triangles, self._vertices, whole)
