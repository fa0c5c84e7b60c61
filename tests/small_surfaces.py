"""Small surfaces for conversions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.channels import BASE_COLOR, EMISSIVE, METALLIC, NORMAL, ROUGHNESS, ChannelFormat
from octex.source.base import Source
from octex.source.surface import Surface

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1, 0.1], [0.3, 0.2, 0.9]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)


def tetrahedron(**options: object) -> Surface:
    colors = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7], [0.5, 0.5, 0.1]])
    return Surface.from_arrays(TETRAHEDRON, FACES, colors=colors, **options)  # type: ignore[arg-type]


class FaceSource(Source):
    """A row of values for each triangle, in channels of any kind."""

    def __init__(self, channels: tuple[ChannelFormat, ...], values: npt.ArrayLike) -> None:
        self._channels = channels
        self._values = np.array(values, np.float32)

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        return self._channels

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],  # noqa: ARG002
        widths: npt.NDArray[np.float32],  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        return self._values[triangles]


LIGHT = EMISSIVE._replace(space="linear", dtype="float16")
#: As many channels as a material has, and what each of the tetrahedron's faces holds.
WHOLE = (BASE_COLOR, METALLIC, ROUGHNESS, LIGHT, NORMAL)
WHOLE_VALUES = [
    [0.9, 0.1, 0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    [0.1, 0.8, 0.3, 1.0, 0.4, 9.5, 3.0, 0.5, 0.0, -0.6, 0.8],
    [0.2, 0.3, 0.7, 0.5, 0.9, 0.1, 0.2, 0.3, -1.0, 0.0, 0.0],
    [0.5, 0.5, 0.1, 0.25, 0.1, 100.0, 0.0, 1e-3, 0.8, 0.0, -0.6],
]


def whole() -> Surface:
    return Surface(TETRAHEDRON, FACES, FaceSource(WHOLE, WHOLE_VALUES))
