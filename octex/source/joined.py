"""Several surfaces as one, each with its own source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, NORMAL, ChannelFormat
from octex.source.base import Combined, Source, by_channel, in_order
from octex.source.materials import DEFAULTS
from octex.source.spatial import SpatialSource


class Member(NamedTuple):
    """One of the surfaces."""

    source: Source
    vertices: slice
    triangles: slice


class Joined(Source):
    """Sources of surfaces whose vertices and triangles follow each other.

    It has the channels that any of them has: elsewhere what materials give that do not state them, and for
    directions the normals of the ``faces``.
    """

    def __init__(self, parts: Sequence[Member], faces: Source) -> None:
        self._parts = list(parts)
        self._firsts = np.array([part.triangles.start for part in parts])
        self._faces = faces
        forms: dict[str, ChannelFormat] = {}
        for form in (form for part in parts for form in part.source.channels):
            known = forms.setdefault(form.name, form)
            if not known.dtype.startswith("float"):
                forms[form.name] = form if form.dtype.startswith("float") else known
        self._channels = tuple(forms[name] for name in in_order(list(forms)))

    @property
    def has_gaps(self) -> bool:
        """Whether any of the sources may know nothing of some points."""
        return any(part.source.has_gaps for part in self._parts)

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether the ``alpha`` of every source that has it says no more than where it knows something."""
        sources = [part.source for part in self._parts]
        having = [source for source in sources if ALPHA.name in [form.name for form in source.channels]]
        return self.has_gaps and all(source.alpha_is_coverage for source in having)

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return every channel's values (n, components), each point's from its own source."""
        values = np.empty((len(triangles), sum(form.components for form in self._channels)), np.float32)
        for part, rows, within in self._by_part(triangles):
            columns = by_channel(
                part.source.channels, part.source.evaluate(within, barycentric[rows], widths[rows])
            )
            values[rows] = np.hstack(
                [
                    columns[form.name] if form.name in columns else self._default(form, triangles[rows])
                    for form in self._channels
                ]
            )
        return values

    def _by_part(self, triangles: Int32s) -> Iterator[tuple[Member, Int64s, Int32s]]:
        """Yield the parts that triangles (n,) are of, with their rows, and their numbers in the part."""
        owners = np.searchsorted(self._firsts, triangles, side="right") - 1
        for number in np.flatnonzero(np.bincount(owners)).tolist():
            part, rows = self._parts[number], np.flatnonzero(owners == number)
            yield part, rows, np.asarray(triangles[rows] - part.triangles.start, np.int32)

    def _default(self, form: ChannelFormat, triangles: Int32s) -> Float32s:
        if form.name == NORMAL.name:
            thirds = np.full((len(triangles), 3), 1 / 3)
            return self._faces.evaluate(triangles, thirds, np.zeros(len(triangles), np.float32))
        return np.full((len(triangles), form.components), DEFAULTS.get(form.name, 1.0), np.float32)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        edges = np.full(len(triangles), np.inf, np.float32)
        for part, rows, within in self._by_part(triangles):
            edges[rows] = part.source.texel_edges(within)
        return edges

    def prepare(self) -> None:
        """Prepare all sources."""
        for part in self._parts:
            part.source.prepare()

    def with_rest(self, rest: Float64s) -> Joined:
        """Return the same sources with widths and directions measured on other rest positions (n, 3)."""
        faces = self._faces.with_rest(rest)
        return self._each(lambda source, part: source.with_rest(rest[part.vertices]), faces)

    def with_filter(self, name: str) -> Joined:
        """Return the same sources with their images read by another filter."""
        return self._each(lambda source, _: source.with_filter(name), self._faces)

    def only(self, names: Sequence[str]) -> Source:
        """Return the same source with these of its channels alone."""

        def restricted(source: Source, _: Member) -> Source:
            wanted = [form.name for form in source.channels if form.name in names]
            return source.only(wanted) if wanted or (source.has_gaps and not names) else Combined({})

        return self._each(restricted, self._faces)

    def _each(self, change: Callable[[Source, Member], Source], faces: Source) -> Joined:
        return Joined([part._replace(source=change(part.source, part)) for part in self._parts], faces)


class FaceNormals(SpatialSource):
    """The normals of the faces at rest."""

    def at(
        self,
        points: Float64s,  # noqa: ARG002
        normals: Float64s,
        widths: Float32s,  # noqa: ARG002
    ) -> Float32s:
        """Return the normals themselves (n, 3)."""
        return normals.astype(np.float32)
