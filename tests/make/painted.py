"""Small surfaces, cameras and images to paint with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octex.cameras.camera import Camera
from octex.channels import linear_to_srgb
from octex.drawing.hits import rest_normals, visible_hits
from octex.drawing.shaders import Shader, source_shader
from octex.source.surface import Surface

Array = npt.NDArray[Any]


def ball(rings: int = 24, radius: float = 1.0, **options: Any) -> Surface:
    """A sphere of smoothly varying colours."""
    around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * rings + 1), np.linspace(0, np.pi, rings + 1))
    points = radius * np.column_stack(
        [(np.sin(up) * np.cos(around)).ravel(), np.cos(up).ravel(), (np.sin(up) * np.sin(around)).ravel()]
    )
    width = 2 * rings + 1
    first = (np.arange(rings)[:, None] * width + np.arange(2 * rings)).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([first, first + 1, first + width]),
            np.column_stack([first + 1, first + width + 1, first + width]),
        ]
    )
    colors = 0.5 + 0.4 * np.sin(3 * points / radius)
    return Surface.from_arrays(points, triangles, colors=colors, **options)


def square(height: float = 0.0, side: float = 1.0, steps: int = 4) -> tuple[Array, Array]:
    """Vertices and triangles of a square across z that faces +z."""
    line = np.linspace(-side / 2, side / 2, steps + 1)
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    return points, halved_quads(steps + 1, steps + 1)


def halved_quads(rows: int, columns: int) -> Array:
    """Triangles between the vertices of a grid, which are numbered row by row."""
    grid = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def together(*parts: tuple[Array, Array]) -> tuple[Array, Array]:
    """Put meshes into one."""
    counts = np.cumsum([0, *(len(points) for points, _ in parts)])
    return (
        np.concatenate([points for points, _ in parts]),
        np.concatenate([triangles + n for (_, triangles), n in zip(parts, counts, strict=False)]),
    )


def plain(mesh: tuple[Array, Array], color: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Surface:
    return Surface.from_arrays(*mesh, factor=color)


def balls(step: npt.ArrayLike, *rings: int) -> Surface:
    """Grey balls, each a step beside the one before."""
    shapes = [(n, ball(each)) for n, each in enumerate(rings)]
    return plain(together(*((each.vertices + n * np.asarray(step), each.triangles) for n, each in shapes)))


def above(distance: float = 3.0, size: int = 64, focal: float | None = None) -> Camera:
    """A camera on the z axis that looks down at the origin; a unit there is ``focal / distance`` pixels."""
    pose = np.eye(4)
    pose[2, 3] = distance
    return Camera.pinhole((size, size), pose=pose, convention="opengl", focal=float(focal or 2 * size))


def image_of(surface: Surface, camera: Camera, look: Shader | None = None) -> Array:
    """What a camera sees, unlit: linear light and alpha (height, width, 4)."""
    image = np.zeros((camera.height * camera.width, 4), np.float32)
    for pixels, hits in visible_hits(surface, camera, rest_normals(surface)):
        image[pixels, :3] = (look or source_shader(surface, "base_color"))(hits).unlit()
        image[pixels, 3] = 1
    return image.reshape(camera.height, camera.width, 4)


def one_color(camera: Camera, color: tuple[float, ...], alpha: float = 1.0) -> Array:
    image = np.empty((camera.height, camera.width, 4), np.float32)
    image[..., :3], image[..., 3] = color, alpha
    return image


def centres(surface: Surface, camera: Camera) -> tuple[Array, Array, Array]:
    """Pixels, and rest positions and normals of what their centres see."""
    found = list(visible_hits(surface, camera, rest_normals(surface)))
    return tuple(
        np.concatenate([part(pixels, hits) for pixels, hits in found])
        for part in (lambda p, _: p, lambda _, h: h.rest, lambda _, h: h.normals)
    )


def codes(linear: Array) -> Array:
    """sRGB codes, 0 … 255."""
    return 255 * linear_to_srgb(np.clip(linear, 0, 1))


def waves(points: Array) -> Array:
    """Smooth colours by position."""
    return np.asarray(0.5 + 0.4 * np.sin(3.0 * points + [0.0, 1.0, 2.0]))
