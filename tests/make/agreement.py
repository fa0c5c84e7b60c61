"""Surfaces against what an independent reader finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.source.load import load_surface
from octex.source.surface import Surface
from tests.oracles import naive_obj
from tests.oracles.naive_gltf import Reference


def assert_agrees(path: Path, samples: int = 150) -> Surface:
    """The surface has the values that the independent reader finds, triangle by triangle."""
    surface = load_surface(path)
    found = surface.scatter(samples)
    triangles = found.triangles.astype(np.int64)
    if path.suffix == ".obj":
        model = naive_obj.load(path)
        corners = np.array([each.corners for each in model])
        points = zip(triangles.tolist(), found.points.tolist(), strict=True)
        values = np.array([model[number].evaluate(point) for number, point in points])
        expected = {"base_color": values[:, :3], "alpha": values[:, 3:]}
    else:
        reference = Reference(path)
        corners = reference.positions
        expected = {
            name: reference.values(name, triangles, found.barycentric) for name in ("base_color", "alpha")
        }
    np.testing.assert_allclose(surface.vertices[surface.triangles], corners, rtol=1e-6, atol=1e-6)
    for name in expected.keys() & {channel.name for channel in surface.channels}:
        np.testing.assert_allclose(surface.evaluate(found, name), expected[name], atol=2e-4)
    return surface
