"""Surfaces against what an independent reader finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.source.load import load_surface
from octex.source.surface import Surface
from tests.oracles import naive_source


def assert_agrees(path: Path, samples: int = 150) -> Surface:
    """The surface has the values that the independent reader finds, triangle by triangle."""
    surface = load_surface(path)
    model = naive_source.load(path)
    assert len(surface.triangles) == len(model.triangles)
    for corners, triangle in zip(surface.vertices[surface.triangles], model.triangles, strict=True):
        np.testing.assert_allclose(sorted(corners.tolist()), sorted(triangle.corners), atol=1e-6)
    found = surface.scatter(samples)
    expected = np.array(
        [model.evaluate(t, p) for t, p in zip(found.triangles.tolist(), found.points.tolist(), strict=True)]
    )
    np.testing.assert_allclose(surface.evaluate(found), expected[:, :3], atol=2e-4)
    if "alpha" in [channel.name for channel in surface.channels]:
        np.testing.assert_allclose(surface.evaluate(found, "alpha"), expected[:, 3:], atol=2e-4)
    return surface
