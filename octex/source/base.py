"""What a surface point's value comes from: a source. A new kind of source is one more class of this form."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from octex.channels import CHANNELS, ChannelFormat


class Source(ABC):
    """Anything that gives values to points of a surface."""

    @property
    @abstractmethod
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""

    @abstractmethod
    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return values (n, components) at points of triangles, averaged over widths in rest units.

        Colours are linear light. Called from any number of threads at once.
        """

    @property
    def has_gaps(self) -> bool:
        """Whether it may know nothing of some points: its channel ``alpha`` is 0 there."""
        return False

    def texel_edges(self, triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
        """Return the edge of a texel on triangles (n,), in rest units: what lies closer varies smoothly.

        0 where that is not known, infinity where nothing limits it but the triangles.
        """
        return np.zeros(len(triangles), np.float32)

    def with_rest(self, rest: npt.NDArray[np.float64]) -> Source:  # noqa: ARG002
        """Return the same source with widths and directions measured on other rest positions (n, 3)."""
        return self

    def with_filter(self, name: str) -> Source:  # noqa: ARG002
        """Return the same source with its images read by another filter."""
        return self

    def only(self, names: Sequence[str]) -> Source:
        """Return the same source with these of its channels alone."""
        return Combined(dict.fromkeys(names, self))


def in_order(names: Sequence[str]) -> list[str]:
    """Return names of channels in the order in which textures hold them; others last."""
    known = list(CHANNELS)
    return sorted(dict.fromkeys(names), key=lambda n: known.index(n) if n in known else len(known))


def by_channel(
    channels: Sequence[ChannelFormat], values: npt.NDArray[np.float32]
) -> dict[str, npt.NDArray[np.float32]]:
    """Return the columns of values (n, components) that are each channel's."""
    ends = np.cumsum([form.components for form in channels])
    parts = np.split(values, ends[:-1], axis=1)
    return {form.name: part for form, part in zip(channels, parts, strict=True)}


class Combined(Source):
    """Channels from several sources; ``sources`` names the one of each channel."""

    def __init__(self, sources: Mapping[str, Source]) -> None:
        self._sources = {name: sources[name] for name in in_order(list(sources))}
        self._channels = tuple(
            next(form for form in source.channels if form.name == name)
            for name, source in self._sources.items()
        )

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""
        return self._channels

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return every channel's values (n, components), each from its source."""
        found: dict[int, dict[str, npt.NDArray[np.float32]]] = {}
        for source in self._sources.values():
            if id(source) not in found:
                values = source.evaluate(triangles, barycentric, widths)
                found[id(source)] = by_channel(source.channels, values)
        return np.hstack([found[id(source)][name] for name, source in self._sources.items()])

    @property
    def has_gaps(self) -> bool:
        """Whether the source of ``alpha`` may know nothing of some points."""
        return "alpha" in self._sources and self._sources["alpha"].has_gaps

    def texel_edges(self, triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
        """Return the finest of the sources' texels."""
        sources = {id(source): source for source in self._sources.values()}.values()
        return np.asarray(np.min([source.texel_edges(triangles) for source in sources], axis=0), np.float32)

    def with_rest(self, rest: npt.NDArray[np.float64]) -> Combined:
        """Return the same sources on other rest positions (n, 3)."""
        return self._each(lambda source: source.with_rest(rest))

    def with_filter(self, name: str) -> Combined:
        """Return the same sources with their images read by another filter."""
        return self._each(lambda source: source.with_filter(name))

    def only(self, names: Sequence[str]) -> Source:
        """Return these channels alone; sources that give none of them are dropped."""
        wanted = {name: source for name, source in self._sources.items() if name in names}
        kept = {id(source): [n for n, each in wanted.items() if each is source] for source in wanted.values()}
        only = {id(source): source.only(kept[id(source)]) for source in wanted.values()}
        return Combined({name: only[id(source)] for name, source in wanted.items()})

    def _each(self, change: Callable[[Source], Source]) -> Combined:
        changed: dict[int, Source] = {}
        for source in self._sources.values():
            changed.setdefault(id(source), change(source))
        return Combined({name: changed[id(source)] for name, source in self._sources.items()})
