"""Sources compute the values of surface points. A new kind of source is one more subclass of `Source`.

A spatial source computes values from rest positions. A placeable becomes a source when put on a surface.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, CHANNELS, NORMAL, ChannelFormat
from octex.jit import kernel
from octex.source.mesh import Mesh
from octex.source.vectors import between, cross_product, edges_from, length_of


class Source(ABC):
    """Computes the values of surface points. It has gaps where its ``_inputs`` have gaps."""

    _channels: tuple[ChannelFormat, ...]
    _inputs: tuple[Source, ...] = ()

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""
        return self._channels

    @property
    def channel_names(self) -> list[str]:
        """The names of the channels."""
        return [form.name for form in self.channels]

    @abstractmethod
    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components), averaged over widths in rest units; any thread may call it."""

    @property
    def has_gaps(self) -> bool:
        """Whether the surface may have gaps, points without a value: there the channel ``alpha`` is 0."""
        return any(source.has_gaps for source in self._inputs)

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether ``alpha`` only marks gaps: it is 1 everywhere else."""
        with_alpha = [source for source in self._inputs if ALPHA.name in source.channel_names]
        return bool(self._inputs) and self.has_gaps and all(source.alpha_is_coverage for source in with_alpha)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units; 0 unknown, infinity without texels."""
        return np.zeros(len(triangles), np.float32)

    def prepared(self, triangles: Int32s) -> Self:
        """Return this source for points of triangles (n,), with the tables that processes then receive."""
        for source in self._inputs:
            source.prepared(triangles)
        return self

    def with_rest(self, rest: Float64s) -> Source:
        """Return the same source with widths and directions measured on other rest positions (n, 3)."""
        return self._of_inputs([source.with_rest(rest) for source in self._inputs])

    def with_filter(self, name: str) -> Source:
        """Return the same source with its images read by another filter."""
        return self._of_inputs([source.with_filter(name) for source in self._inputs])

    def only(self, names: Sequence[str]) -> Source:
        """Return the source with these channels, and ``alpha`` if it has gaps; no names: only ``alpha``."""
        return Combined(dict.fromkeys(names, self), [self])

    def _of_inputs(self, inputs: Sequence[Source]) -> Self:
        return self._changed(_inputs=tuple(inputs)) if inputs else self

    def _changed(self, *stale: str, **attributes: Any) -> Self:
        """Return a copy with other attributes, without the cached properties named in ``stale``."""
        other = copy.copy(self)
        for name in stale:
            vars(other).pop(name, None)
        vars(other).update(attributes)
        return other


class Forwarded(Source):
    """Reads triangle i at triangle ``targets[i]`` (m,) of another source; has its channels and gaps."""

    def __init__(self, source: Source, targets: Int32s) -> None:
        self._inputs = (source,)
        self._targets = targets

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""
        return self._inputs[0].channels

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self._inputs[0].evaluate(self._targets[triangles], barycentric, widths)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        return self._inputs[0].texel_edges(self._targets[triangles])

    def only(self, names: Sequence[str]) -> Self:
        """Return the same source with only these channels."""
        return self._of_inputs([self._inputs[0].only(names)])


class PartSource(Forwarded):
    """The source of a part of a surface with ``rest`` (n, 3): of its ``triangles`` and ``vertices``."""

    def __init__(self, source: Source, triangles: Int32s, vertices: Int32s, rest: Float64s) -> None:
        super().__init__(source, triangles)
        self._vertices = vertices
        self._rest = rest

    def with_rest(self, rest: Float64s) -> PartSource:
        """Return the same source on other rest positions of the part's vertices (v, 3)."""
        whole = self._rest.copy()
        whole[self._vertices] = rest
        return PartSource(self._inputs[0].with_rest(whole), self._targets, self._vertices, whole)


def in_order(names: Sequence[str]) -> list[str]:
    """Return names of channels in the order in which textures store them; unknown names last."""
    order = list(CHANNELS)
    return sorted(dict.fromkeys(names), key=lambda n: order.index(n) if n in order else len(order))


def by_channel(channels: Sequence[ChannelFormat], values: Float32s) -> dict[str, Float32s]:
    """Return each channel's columns of values (n, components)."""
    parts = np.split(values, np.cumsum([form.components for form in channels]), axis=1)
    return {form.name: part for form, part in zip(channels, parts, strict=False)}


class Combined(Source):
    """Channels from several sources; ``sources`` maps each channel's name to its source.

    ``alpha`` is 0 where any of them, or of ``others``, has a gap. Elsewhere its source gives it, or it is 1.
    """

    def __init__(self, sources: Mapping[str, Source], others: Sequence[Source] = ()) -> None:
        self._inputs = tuple({id(source): source for source in [*sources.values(), *others]}.values())
        #: The index of each channel's source, and the indices of the sources with gaps.
        self._owners = {name: self._inputs.index(sources[name]) for name in in_order(list(sources))}
        self._with_gaps = [index for index, source in enumerate(self._inputs) if source.has_gaps]
        forms = {
            name: next(form for form in self._inputs[index].channels if form.name == name)
            for name, index in self._owners.items()
        }
        if self._with_gaps:
            forms.setdefault(ALPHA.name, ALPHA)
        self._channels = tuple(forms[name] for name in in_order(list(forms)))

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return the values of all channels (n, components), each from its source."""
        values = [
            by_channel(source.channels, source.evaluate(triangles, barycentric, widths))
            for source in self._inputs
        ]
        columns = {name: values[index][name] for name, index in self._owners.items()}
        for index in self._with_gaps:
            alpha = columns.get(ALPHA.name, np.float32(1.0))
            columns[ALPHA.name] = alpha * (values[index][ALPHA.name] > 0)
        nothing = np.empty((len(triangles), 0), np.float32)
        return np.hstack([nothing, *(columns[form.name] for form in self._channels)])

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether ``alpha`` only marks the gaps of the sources."""
        owner = self._owners.get(ALPHA.name)
        return self.has_gaps and (owner is None or self._inputs[owner].alpha_is_coverage)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of the finest source's texel."""
        without_texels = np.full(len(triangles), np.inf, np.float32)
        edges = (source.texel_edges(triangles) for source in self._inputs)
        return np.asarray(np.minimum.reduce([without_texels, *edges]), np.float32)

    def only(self, names: Sequence[str]) -> Source:
        """Return only these channels, from only the sources that give them.

        Without names, and for an ``alpha`` without a source, all sources stay because all of them have gaps.
        """
        owners = {name: index for name, index in self._owners.items() if name in names}
        asks_for_gaps = not names or (ALPHA.name in names and ALPHA.name not in self._owners)
        sources = {
            index: self._inputs[index].only([name for name, owner in owners.items() if owner == index])
            for index in dict.fromkeys([*owners.values(), *(self._with_gaps if asks_for_gaps else [])])
        }
        return Combined({name: sources[index] for name, index in owners.items()}, list(sources.values()))

    def _of_inputs(self, inputs: Sequence[Source]) -> Combined:
        return Combined({name: inputs[index] for name, index in self._owners.items()}, inputs)


#: Default value of a channel that a material does not define (glTF 2.0), where it is not 1.
DEFAULTS = {"emissive": 0.0, "specular": 0.04}


class Joined(Source):
    """Sources of concatenated surfaces, whose first vertices and triangles are ``vertices`` and ``faces``.

    A channel that a source lacks has its default value there; ``normal`` has the face normals at rest.
    """

    def __init__(
        self, sources: Sequence[Source], vertices: Sequence[int], faces: Sequence[int], rest: Float64s,
        triangles: Int32s,
    ) -> None:  # fmt: skip
        self._inputs, self._vertices, self._faces = tuple(sources), vertices, faces
        self._rest, self._triangles = rest, triangles
        forms: dict[str, ChannelFormat] = {}
        for form in (form for source in sources for form in source.channels):
            earlier = forms.setdefault(form.name, form)
            if form.dtype.startswith("float") and not earlier.dtype.startswith("float"):
                forms[form.name] = form
        self._channels = tuple(forms[name] for name in in_order(list(forms)))

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return the values of all channels (n, components), each point's from its surface's source."""
        values = np.empty((len(triangles), sum(form.components for form in self._channels)), np.float32)
        for source, rows, within in self._by_source(triangles):
            columns = by_channel(source.channels, source.evaluate(within, barycentric[rows], widths[rows]))
            for form in self._channels:
                if form.name not in columns:
                    columns[form.name] = self._default(form, triangles[rows])
            values[rows] = np.hstack([columns[form.name] for form in self._channels])
        return values

    def _by_source(self, triangles: Int32s) -> Iterator[tuple[Source, Int64s, Int32s]]:
        """Yield each source of triangles (n,), with its rows of them and their numbers in its surface."""
        owners = np.searchsorted(self._faces, triangles, side="right") - 1
        for number in np.flatnonzero(np.bincount(owners)).tolist():
            rows = np.flatnonzero(owners == number)
            yield self._inputs[number], rows, np.asarray(triangles[rows] - self._faces[number], np.int32)

    def _default(self, form: ChannelFormat, triangles: Int32s) -> Float32s:
        if form.name == NORMAL.name:
            middles = np.full((len(triangles), 3), 1 / 3)
            return points_with_normals(self._rest, self._triangles, triangles, middles)[1].astype(np.float32)
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
        """Return the same source with only these channels."""

        def restricted(source: Source) -> Source:
            common = [name for name in source.channel_names if name in names]
            return source.only(common) if common or (source.has_gaps and not names) else Combined({})

        return self._of_inputs([restricted(source) for source in self._inputs])

    def _of_inputs(self, inputs: Sequence[Source]) -> Joined:
        return Joined(inputs, self._vertices, self._faces, self._rest, self._triangles)


#: Rounding of a cosine between normals in single precision.
_COSINE_ROUNDING = 1e-6


class Placeable(ABC):
    """An object that becomes a channel's source on a surface: see ``Surface.with_sources``."""

    _latest: tuple[Float64s, Int32s, Source] | None = None

    @abstractmethod
    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:
        """Return a source of one channel for a surface, and its entries of provenance.

        Raises ModelError, ImageError or ArgumentError if it does not fit that surface.
        """

    def _shared(self, mesh: Mesh, make: Callable[[], Source]) -> Source:
        """Return ``make()``, cached for the latest mesh, so that all of its channels share one source."""
        latest = self._latest
        if latest is None or latest[0] is not mesh.rest or latest[1] is not mesh.triangles:
            latest = self._latest = mesh.rest, mesh.triangles, make()
        return latest[2]


def least_cosine(degrees: float) -> float:
    """Return the cosine of the largest angle between matching normals, minus its rounding."""
    return float(np.cos(np.radians(degrees))) - _COSINE_ROUNDING


class SpatialSource(Source):
    """Computes values from the rest positions and face normals of surface points."""

    def __init__(self, channels: Sequence[ChannelFormat], rest: Float64s, triangles: Int32s) -> None:
        self._channels = tuple(channels)
        self._rest = rest
        self._triangles = triangles

    @abstractmethod
    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at rest positions (n, 3), averaged over widths in rest units.

        ``normals`` (n, 3) are the faces' unit normals at rest; zeros on triangles without area.
        """

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self.at(*points_with_normals(self._rest, self._triangles, triangles, barycentric), widths)

    def with_rest(self, rest: Float64s) -> SpatialSource:
        """Return the same values by position, on other rest positions (n, 3)."""
        return self._changed(_rest=rest)


def points_with_normals(
    rest: Float64s, faces: Int32s, triangles: Int32s, barycentric: Float64s
) -> tuple[Float64s, Float64s]:
    """Return the rest positions (n, 3) of points of triangles, and the unit normals of their faces there."""
    points, normals = np.empty((2, len(triangles), 3))
    _place(rest, faces, triangles, barycentric, points, normals)
    return points, normals


@kernel
def _place(
    rest: Float64s, faces: Int32s, triangles: Int32s, barycentric: Float64s, points: Float64s,
    normals: Float64s,
) -> None:  # fmt: skip
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
