"""What paint comes from: a source that also says where it is, and how fine."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.channels import ALPHA, ChannelFormat
from octex.source.base import Source
from octex.voxelize.fragments import Blocks

#: Coverage is kept in 16 bits: 8 would change a wash by up to half a step.
COVERAGE = ALPHA._replace(dtype="uint16")


class PaintSource(Source):
    """Gives a channel's components, and their coverage, to points of a surface."""

    def __init__(self, form: ChannelFormat) -> None:
        self._channels = (form, COVERAGE)

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channel that is painted, and its coverage, ``alpha``."""
        return self._channels

    @property
    def color(self) -> Float32s | None:
        """The value (components,) that all of the paint has, decoded; None if it may have several."""
        return None

    @abstractmethod
    def touched(self) -> Int32s:
        """Return triangles, ascending, in whose neighbourhood all paint lies."""

    @abstractmethod
    def on(self, chosen: Int32s) -> PaintSource:
        """Return the same paint for a surface of some of the triangles, in that order."""

    def reaches(
        self,
        blocks: Blocks,
        corners: Float64s,  # noqa: ARG002
        edge: float,  # noqa: ARG002
        rest: Float64s,  # noqa: ARG002
    ) -> Bools:
        """Say in which of blocks paint may lie, given their lowest corners (n, 3) and their edge at rest."""
        return np.ones(blocks.codes.size, np.bool_)

    def widths(
        self,
        triangles: Int32s,
        barycentric: Float64s,  # noqa: ARG002
    ) -> Float32s:
        """Return how wide the finest detail of the paint is at points (n,), in rest units; 0: any."""
        return np.zeros(len(triangles), np.float32)
