"""Benchmarks of painting in the browser: what the server takes from a stroke to its change."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import numpy as np
from inputs import painted_torus
from measuring import HERE, Report, Setup, Spent

import octex

sys.path.append(str(HERE.parents[1]))
from tests.make.paint_server import PaintServer, disc

_TOWARD = (0.0, 0.9, 0.35)
_VIEW = 1200, 800


def session(setup: Setup, report: Report) -> None:
    """Strokes sent to octex view, until their changes are read; a texture, and a seventh of it."""
    around, across, depth, sizes = (24, 12, 6, (8,)) if setup.quick else (103, 52, 10, (32, 128, 512))
    surface = painted_torus(around, across, 256)
    texture = octex.convert(surface, depth)
    part = octex.crop(texture, (0.3, 0.75, -1.0), (0.75, 2.0, 2.0))
    counts = [each.tree.n_leaves for each in (part, texture)]
    report.title(f"session: strokes on {counts[0]:,} and {counts[1]:,} leaves, from sending to the change")
    spent: dict[tuple[int, int], Spent] = {}
    for name, leaves, each in zip(("part", "whole"), counts, (part, texture), strict=True):
        with _served(setup.folder / name, each, surface) as server:
            cell = texture.placement.size / 2**depth
            times = list(_strokes(server, surface, cell, [sizes[0], *np.repeat(sizes, setup.repeats)]))
        report.line(f"the first stroke, {leaves:,} leaves", f"{times[0].wall:.3f} s")
        for number, size in enumerate(sizes):
            own = times[1:][number * setup.repeats :][: setup.repeats]
            spent[leaves, size] = Spent(median(t.cpu for t in own), median(t.wall for t in own))
            report.line(f"a stroke of {size}² pixels, {leaves:,} leaves", spent[leaves, size])
    report.at_most("session: the first stroke", times[0].wall, 0.3, "s")
    for size, target in zip(sizes, (0.08, 0.15, 0.5), strict=False):
        small, large = (spent[leaves, size] for leaves in counts)
        report.at_most(f"session: a stroke of {size}² pixels", large.wall, target, "s")
        report.at_most(f"session: {size}² pixels, growth with the texture", large.cpu / max(small.cpu, 0.01), 1.2, "×")


def _strokes(server: PaintServer, surface: octex.Surface, cell: float, sizes: list[int]) -> Iterator[Spent]:
    """Send discs of some sizes, of pixels as wide as 1.1 cells; yield what each takes."""
    toward = np.array(_TOWARD) / np.linalg.norm(_TOWARD)
    middle = surface.vertices[np.argmax(surface.vertices @ toward)]
    corners = middle + 0.55 * cell * np.array(_VIEW).min() * np.array([[-1, 0, 0], [1, 0, 0]])
    camera = octex.Camera.fitted(corners, _TOWARD, size=_VIEW)
    for number, size in enumerate(sizes, 1):
        place = camera.project(middle[None])[0][0] + 3.0 * (number % 5)
        body = disc(number, camera, place, size / 2, [200, 10 * number % 256, 30])
        cpu, wall = _cpu_of(server), time.perf_counter()
        assert server.send(body)
        server.wait(number)
        wall = time.perf_counter() - wall
        time.sleep(0.3)  # until it has put the stroke away
        yield Spent(_cpu_of(server) - cpu, wall)
    assert server.told["done"] == len(sizes), "a stroke has hit nothing"


def _cpu_of(server: PaintServer) -> float:
    words = Path(f"/proc/{server.process.pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def _served(folder: Path, texture: octex.OctreeTexture, surface: octex.Surface) -> Iterator[PaintServer]:
    folder.mkdir()
    texture.save(folder / "a.octex")
    octex.write_model(surface, folder / "a.glb")
    server = PaintServer(folder / "a.octex", folder / "a.glb", folder / "out.octex")
    server.wait(0)
    time.sleep(1.0)  # until all is compiled
    yield server
    server.end()
