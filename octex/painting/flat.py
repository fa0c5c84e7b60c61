"""A source of nothing: for the cells that a surface meets, their facings and areas."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],  # noqa: ARG002
        widths: npt.NDArray[np.float32],  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        """Return ones (n, 1)."""
        return np.ones((len(triangles), 1), np.float32)
