"""A source of nothing: for the cells that a surface meets, their facings and areas."""

from __future__ import annotations

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ALPHA, ChannelFormat
from octex.source.base import Source


class Flat(Source):
    """One everywhere."""

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """A channel that nobody reads."""
        return (ALPHA._replace(name="flat"),)

    def evaluate(
        self,
        triangles: Int32s,
        barycentric: Float64s,  # noqa: ARG002
        widths: Float32s,  # noqa: ARG002
    ) -> Float32s:
        """Return ones (n, 1)."""
        return np.ones((len(triangles), 1), np.float32)
