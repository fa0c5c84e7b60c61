"""Some of a surface's triangles, with its source."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat
from octex.errors import ArgumentError
from octex.source.base import Source
from octex.source.corners import Frames

if TYPE_CHECKING:
    from octex.source.surface import Surface

Floats = npt.NDArray[np.float64]
Int32s = npt.NDArray[np.int32]


class Picked(Source):
    """The source of a whole surface, for a surface of some of its triangles.

    ``triangles`` (k,) and ``vertices`` (v,) are their numbers in the whole, ``rest`` (n, 3) the whole's rest
    positions. What the source keeps ready is shared by all that is picked from it.
    """

    def __init__(self, source: Source, triangles: Int32s, vertices: Int32s, rest: Floats) -> None:
        self._source = source
        self._triangles = triangles
        self._vertices = vertices
        self._rest = rest

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""
        return self._source.channels

    @property
    def has_gaps(self) -> bool:
        """Whether the whole's source may know nothing of some points."""
        return self._source.has_gaps

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether the whole's ``alpha`` says no more than where it knows something."""
        return self._source.alpha_is_coverage

    def evaluate(
        self, triangles: Int32s, barycentric: Floats, widths: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self._source.evaluate(self._triangles[triangles], barycentric, widths)

    def texel_edges(self, triangles: Int32s) -> npt.NDArray[np.float32]:
        """Return the edge of a texel on triangles (n,), in rest units."""
        return self._source.texel_edges(self._triangles[triangles])

    def with_rest(self, rest: Floats) -> Picked:
        """Return the same source on other rest positions of the picked vertices (v, 3)."""
        whole = self._rest.copy()
        whole[self._vertices] = rest
        return Picked(self._source.with_rest(whole), self._triangles, self._vertices, whole)

    def with_filter(self, name: str) -> Picked:
        """Return the same source with its images read by another filter."""
        return self._of(self._source.with_filter(name))

    def only(self, names: Sequence[str]) -> Picked:
        """Return the same source with these of its channels alone."""
        return self._of(self._source.only(names))

    def _of(self, source: Source) -> Picked:
        return Picked(source, self._triangles, self._vertices, self._rest)


def part_of(surface: Surface, triangles: npt.ArrayLike, source: Source | None = None) -> Surface:
    """Return some triangles of a surface: ``Surface.part``."""
    if source is not None and not isinstance(source, Source):
        raise ArgumentError(f"source must be a Source, not {source!r}")
    try:
        chosen = np.asarray(triangles)
    except ValueError:  # rows of unequal lengths
        chosen = np.empty(1, np.void)
    if chosen.size and (chosen.ndim != 1 or chosen.dtype.kind not in "iu"):
        raise ArgumentError(
            f"triangles must be whole numbers of shape (k,), not {chosen.dtype} {chosen.shape}"
        )
    if chosen.size and not 0 <= chosen.min() <= chosen.max() < len(surface.triangles):
        raise ArgumentError(
            f"{surface.name} has triangles 0 to {len(surface.triangles) - 1}, not all of these"
        )
    chosen = chosen.astype(np.int32)
    faces = surface.triangles[chosen]
    used = np.zeros(len(surface.vertices), np.bool_)
    used[faces] = True
    names = np.cumsum(used, dtype=np.int32) - np.int32(1)
    frames = surface.frames
    return type(surface)(
        surface.vertices[used],
        names[faces],
        source or Picked(surface.source, chosen, np.flatnonzero(used).astype(np.int32), surface.rest),
        rest=None if surface.rest is surface.vertices else surface.rest[used],
        uv=surface.uv and surface.uv.of(chosen),
        frames=frames and Frames(frames.normals.of(chosen), frames.tangents.of(chosen)),
        name=surface.name,
        provenance=surface.provenance,
    )
