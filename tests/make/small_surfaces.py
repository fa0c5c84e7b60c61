"""Small surfaces for conversions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.channels import BASE_COLOR, EMISSIVE, METALLIC, NORMAL, ROUGHNESS, ChannelFormat
from octex.source.base import Source
from octex.source.surface import Surface
from tests.make.painted import halved_quads

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1, 0.1], [0.3, 0.2, 0.9]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
OCTAHEDRON_FACES = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]], np.int32
)


def tetrahedron(**options: object) -> Surface:
    colors = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7], [0.5, 0.5, 0.1]])
    return Surface.from_arrays(TETRAHEDRON, FACES, colors=colors, **options)


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
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        values = self._values[triangles]
        self.vary(values, barycentric)
        return values

    def vary(self, values: npt.NDArray[np.float32], barycentric: npt.NDArray[np.float64]) -> None:
        """Change values (n, components) by where in a triangle they are."""


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


def sheet(turn: npt.NDArray[np.float64], thickness: float, *, gap: float = 0.0) -> Surface:
    """A square, red on its front and green on its back, so thick."""
    steps = np.linspace(-0.5, 0.5, 7)
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
    flat = np.column_stack([x, y, np.full(49, gap)])
    faces = halved_quads(7, 7)
    half = np.array([0.0, 0.0, thickness / 2])
    vertices = np.concatenate([flat + half, flat - half])
    colors = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 49, axis=0)
    return Surface.from_arrays(vertices @ turn.T, np.concatenate([faces, faces[:, ::-1] + 49]), colors=colors)


def turned(seed: int) -> npt.NDArray[np.float64]:
    """An axis-aligned pose, one across an edge of cells, or any other."""
    if seed == 0:
        return np.eye(3)
    if seed == 1:
        return np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(q * np.linalg.det(q))


def bent(thickness: float) -> Surface:
    """A strip bent to a half circle, each side with bands of its own colours."""
    turn, along = (grid.ravel() for grid in np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(0, 1, 11)))
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    axis = np.column_stack([np.zeros_like(turn), np.zeros_like(turn), along])
    faces = halved_quads(11, 61)
    vertices = np.concatenate([outward + axis, (1 - thickness) * outward + axis])
    bands = 0.5 + 0.5 * np.sin(9 * turn)
    none = np.zeros_like(bands)
    colors = np.concatenate([np.column_stack([bands, none, none]), np.column_stack([none, bands, none])])
    return Surface.from_arrays(vertices, np.concatenate([faces, faces[:, ::-1] + 11 * 61]), colors=colors)
