"""Everything that octex compiles, compiled: a tiny model taken along every path."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import octex
from octex.formats.ply import write_points
from octex.parallel import Progress
from octex.preview import write_preview


def warm_up(progress: Progress) -> None:
    """Convert, save, open, sample, validate and draw a tiny model, so that all kernels are in the cache."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], np.float64)
    triangles = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    uv = np.array([(0, 0), (3, 0), (0, 3), (2, 2)], np.float64)
    image = np.full((4, 4, 4), 128, np.uint8)
    surfaces = [
        octex.Surface.from_arrays(vertices, triangles, colors=np.full((4, 4), 0.5), uv=uv, image=image),
        octex.Surface.from_arrays(vertices, triangles, rest=vertices[:, ::-1] * (1, 1, -1)),
    ]
    stages = 2 * len(surfaces)
    with TemporaryDirectory() as folder:
        for number, surface in enumerate(surfaces):
            progress("compile", 2 * number, stages)
            _convert_and_read(surface, Path(folder))
            progress("compile", 2 * number + 1, stages)
            write_preview(Path(folder, "model.png"), surface, octex.convert(surface, 3), (64, 64))
            progress("compile", 2 * number + 2, stages)


def _convert_and_read(surface: octex.Surface, folder: Path) -> None:
    samples = surface.scatter(100)
    for channel in surface.channels:
        surface.evaluate(samples, channel.name, width=0.1)
    octex.convert(surface, 4).save(folder / "model.octex")
    texture = octex.open(folder / "model.octex")
    texture.validate()
    for points in (samples.rest, samples.rest.astype(np.float32)):
        texture.contains(points)
        texture.sample(points, list(texture.channels))
        texture.level(2).sample(points)
    write_points(texture, folder / "model.ply")
    write_preview(folder / "texture.png", None, texture, (64, 64))
