"""Photographs: a ball, cameras around it, and what they see."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import BASE_COLOR
from octex.painting.project import Projected, take_shots
from octex.painting.surface import PaintedSurface, terms_of
from octex.parallel import pool_of
from octex.source.surface import Surface
from tests.make.painted import ball, codes, image_of

Image = npt.NDArray[Any]


@cache
def _ring(count: int, size: int) -> tuple[Surface, list[octex.Camera], list[Image]]:
    surface = ball(rings=32)
    cameras = [
        octex.Camera.fitted(
            surface.vertices, (np.sin(turn), 0.2 * (-1) ** n, np.cos(turn)), size=(size, size)
        )
        for n, turn in enumerate(2 * np.pi * np.arange(count) / count)
    ]
    return surface, cameras, [image_of(surface, camera) for camera in cameras]


def ring(count: int = 8, size: int = 96) -> tuple[Surface, list[octex.Camera], list[Image]]:
    """A ball of smooth colours, cameras all around it, and their images."""
    surface, cameras, images = _ring(count, size)
    return surface, list(cameras), [image.copy() for image in images]


def projections(images: Sequence[Image], cameras: Sequence[octex.Camera]) -> list[octex.Projection]:
    return [octex.Projection(*pair) for pair in zip(images, cameras, strict=True)]


def source_of(surface: Surface, shown: Sequence[octex.Projection]) -> Projected:
    """What images show of a surface's colours."""
    with pool_of(1) as pool:
        painted = PaintedSurface(surface)
        sights = painted.sights([each.camera for each in shown], 0.0, pool)
        shots = list(take_shots(shown, BASE_COLOR, [1.0] * len(shown), sights, pool))
    return painted.projected(shots, BASE_COLOR, terms_of(75, 0, False))


def error(found: octex.OctreeTexture, surface: Surface) -> float:
    """Root of the mean square, in codes, where a texture covers a surface: nearly everywhere."""
    samples = surface.scatter(5000)
    seen = found.contains(samples.rest)
    assert seen.mean() > 0.85
    apart = codes(found.sample(samples.rest)) - codes(surface.evaluate(samples))
    return float(np.sqrt((apart[seen] ** 2).mean()))
