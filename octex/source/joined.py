"""Several surfaces as one, each with its own source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, NORMAL, ChannelFormat
from octex.source.base import Combined, Source, by_channel, in_order, placed
from octex.source.materials import DEFAULTS


class Joined(Source):
    """Sources of surfaces whose vertices and triangles follow each other.

    ``vertices`` and ``faces`` say where those of each surface begin, and where the last ones end. It has the
    channels that any of the sources has: elsewhere what materials give that do not state them, and for
    directions the normals of the faces of ``rest`` (n, 3) and ``triangles`` (m, 3).
    """

    def __init__(
        self,
        sources: Sequence[Source],
        vertices: Sequence[int],
        faces: Sequence[int],
        rest: Float64s,
        triangles: Int32s,
    ) -> None:
        self._inputs, self._vertices, self._faces = tuple(sources), vertices, faces
        self._rest, self._triangles = rest, triangles
        forms: dict[str, ChannelFormat] = {}
        for form in (form for source in sources for form in source.channels):
            known = forms.setdefault(form.name, form)
            if form.dtype.startswith("float") and not known.dtype.startswith("float"):
                forms[form.name] = form
        self._channels = tuple(forms[name] for name in in_order(list(forms)))

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether the ``alpha`` of every source that has it says no more than where it knows something."""
        with_alpha = [s for s in self._inputs if ALPHA.name in [form.name for form in s.channels]]
        return self.has_gaps and all(source.alpha_is_coverage for source in with_alpha)

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return every channel's values (n, components), each point's from its own source."""
        values = np.empty((len(triangles), sum(form.components for form in self._channels)), np.float32)
        for source, rows, within in self._by_source(triangles):
            columns = by_channel(source.channels, source.evaluate(within, barycentric[rows], widths[rows]))
            values[rows] = np.hstack(
                [
                    columns[form.name] if form.name in columns else self._default(form, triangles[rows])
                    for form in self._channels
                ]
            )
        return values

    def _by_source(self, triangles: Int32s) -> Iterator[tuple[Source, Int64s, Int32s]]:
        """Yield the sources that triangles (n,) are of, with their rows, and their numbers in its surface."""
        owners = np.searchsorted(self._faces, triangles, side="right") - 1
        for number in np.flatnonzero(np.bincount(owners)).tolist():
            rows = np.flatnonzero(owners == number)
            yield self._inputs[number], rows, np.asarray(triangles[rows] - self._faces[number], np.int32)

    def _default(self, form: ChannelFormat, triangles: Int32s) -> Float32s:
        if form.name == NORMAL.name:
            middles = np.full((len(triangles), 3), 1 / 3)
            return placed(self._rest, self._triangles, triangles, middles)[1].astype(np.float32)
        return np.full((len(triangles), form.components), DEFAULTS.get(form.name, 1.0), np.float32)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        edges = np.full(len(triangles), np.inf, np.float32)
        for source, rows, within in self._by_source(triangles):
            edges[rows] = source.texel_edges(within)
        return edges

    def with_rest(self, rest: Float64s) -> Joined:
        """Return the same sources with widths and directions measured on other rest positions (n, 3)."""
        parts = [slice(*self._vertices[n : n + 2]) for n in range(len(self._inputs))]
        sources = [source.with_rest(rest[part]) for source, part in zip(self._inputs, parts, strict=True)]
        return Joined(sources, self._vertices, self._faces, rest, self._triangles)

    def only(self, names: Sequence[str]) -> Joined:
        """Return the same source with these of its channels alone."""

        def restricted(source: Source) -> Source:
            wanted = [form.name for form in source.channels if form.name in names]
            return source.only(wanted) if wanted or (source.has_gaps and not names) else Combined({})

        return self._reading([restricted(source) for source in self._inputs])

    def _reading(self, inputs: Sequence[Source]) -> Joined:
        return Joined(inputs, self._vertices, self._faces, self._rest, self._triangles)
