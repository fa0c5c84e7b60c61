"""What the benchmarks work on: a bumpy torus and a sphere of cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ChannelFormat
from octex.source.base import Source
from octex.tree.morton import decode_cells

Floats = npt.NDArray[np.float64]


class NoChannels(Source):
    """A source that gives a surface no values: what remains is its cells, with areas and flags."""

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """None."""
        return ()

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: Floats,  # noqa: ARG002
        widths: npt.NDArray[np.float32],  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        """Return no values for each point."""
        return np.empty((len(triangles), 0), np.float32)


def torus(around: int, across: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32], Floats]:
    """Return a bumpy torus in the unit cube: vertices, 2 · around · across triangles, and uv with a seam."""
    u, v = np.meshgrid(np.arange(around + 1) / around, np.arange(across + 1) / across, indexing="ij")
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    u, v = 2 * np.pi * u, 2 * np.pi * v
    radius = 0.14 + 0.03 * np.sin(9 * u) * np.cos(5 * v)
    ring = 0.32 + radius * np.cos(v)
    vertices = 0.5 + np.stack([ring * np.cos(u), ring * np.sin(u), radius * np.sin(v)], axis=-1).reshape(
        -1, 3
    )
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b, c, d = (p * (across + 1) + q for p, q in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    # Both sides of the seam are the same points to the last bit.
    grid = vertices.reshape(around + 1, across + 1, 3)
    grid[-1], grid[:, -1] = grid[0], grid[:, 0]
    return vertices.astype(np.float32), triangles.astype(np.int32), uv


def write_mesh(path: Path, vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.int32]) -> None:
    """Write a mesh as the peers read it: two counts, vertices, triangles."""
    with path.open("wb") as file:
        for array in (np.array([len(vertices), len(triangles)], np.int64), vertices, triangles):
            file.write(np.ascontiguousarray(array).tobytes())


def painted_torus(around: int, across: int, size: int) -> octex.Surface:
    """Return the torus with an image of size² texels: smooth colours with fine grain."""
    vertices, triangles, uv = torus(around, across)
    y, x = np.mgrid[:size, :size] / size
    waves = np.stack(
        [np.sin(2 * np.pi * (f * x + g * y)) for f, g in ((37, 11), (23, -31), (5, 53))], axis=-1
    )
    grain = np.random.default_rng(0).normal(0, 6, (size, size, 1))
    image = np.clip(128 + 100 * waves + grain, 0, 255).astype(np.uint8)
    return octex.Surface.from_arrays(vertices, triangles, uv=uv, image=image, name="torus")


RADIUS = 0.499


def sphere_cells(depth: int) -> npt.NDArray[np.int64]:
    """Morton codes of the cells that meet a sphere around the middle of the root cell."""
    codes = np.zeros(1, np.int64)
    for level in range(1, depth + 1):
        codes = (codes[:, None] << 3 | np.arange(8)).ravel()
        low = decode_cells(codes) / 2**level - 0.5
        high = low + 0.5**level
        nearest = (np.maximum(np.maximum(low, -high), 0) ** 2).sum(axis=1)
        farthest = (np.maximum(-low, high) ** 2).sum(axis=1)
        codes = codes[(nearest <= RADIUS**2) & (farthest >= RADIUS**2)]
    return codes


def seen_on_sphere(width: int, height: int) -> npt.NDArray[np.float32]:
    """Points where the rays of a camera meet the sphere, pixel after pixel."""
    eye = np.array([1.6, -0.5, 1.5])
    forward = (0.5 - eye) / np.linalg.norm(0.5 - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    y, x = np.mgrid[:height, :width]
    scale = np.tan(np.radians(17)) / (height / 2)
    rays = (
        forward
        + (x + 0.5 - width / 2)[..., None] * scale * right
        - (y + 0.5 - height / 2)[..., None] * scale * up
    )
    rays = rays.reshape(-1, 3) / np.linalg.norm(rays.reshape(-1, 3), axis=1)[:, None]
    along = rays @ (0.5 - eye)
    under = RADIUS**2 - ((0.5 - eye) ** 2).sum() + along**2
    hit = under >= 0
    return (eye + (along[hit] - np.sqrt(under[hit]))[:, None] * rays[hit]).astype(np.float32)


def scattered_on_sphere(count: int) -> npt.NDArray[np.float32]:
    """Random points of the sphere."""
    points = np.random.default_rng(7).normal(size=(count, 3))
    return (0.5 + RADIUS * points / np.linalg.norm(points, axis=1)[:, None]).astype(np.float32)
