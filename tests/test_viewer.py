"""What a browser shows: each pixel as lookups have it; the page, its tools, and pages of one file."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octex
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.viewer import write_page
from octex.viewer.pack import pack
from tests.browser import Probe, chromium, file_url, opened
from tests.conftest import needs_jit
from tests.painted import ball
from tests.small_surfaces import sheet

SIZE = 64, 48
FILTERS = "nearest", "linear", "quadratic"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


def colored(surface: Surface, **sources: object) -> Surface:
    """A surface of colours that vary much within a cell, and of other channels."""
    low, high = surface.bounds
    waves = lambda p: 0.5 + 0.5 * np.sin(40 * (p - low) / (high - low).max() * [1.0, 1.3, 0.7])  # noqa: E731
    return surface.with_sources({"base_color": waves, "roughness": lambda p: waves(p)[:, :1], **sources})


def even() -> tuple[OctreeTexture, Surface]:
    surface = colored(ball())
    return octex.convert(surface, depth=6), surface


def adaptive() -> tuple[OctreeTexture, Surface]:
    def spots(p: Any) -> Any:
        return 0.5 + 0.4 * np.sign(np.sin(30 * p[:, :1])) * (p[:, 1:2] > 0.2) * [1.0, 0.5, -1.0]

    surface = ball().with_sources({"base_color": spots})
    return octex.convert(surface, depth=6, max_error=3), surface


def painted() -> tuple[OctreeTexture, Surface]:
    surface = colored(ball())
    texture = octex.convert(surface, depth=4)
    red = octex.fill(texture, surface, octex.Sphere((0.3, 0.3, 0.8), 0.4), (1.0, 0.1, 0.0), depth=6)
    return red, surface


def thin() -> tuple[OctreeTexture, Surface]:
    surface = sheet(np.eye(3), 0.01)
    return octex.convert(surface, depth=5), surface


def covered() -> tuple[OctreeTexture, Surface]:
    surface = colored(ball(), alpha=lambda p: np.clip(0.6 + p[:, :1], 0.0, 1.0))
    return octex.convert(surface, depth=5), surface


MADE = {each.__name__: each for each in (even, adaptive, painted, thin, covered)}


@needs_jit
@pytest.mark.parametrize("name", MADE)
def test_each_pixel_is_what_a_lookup_there_gives(name: str, browser: Any, tmp_path: Path) -> None:
    texture, surface = MADE[name]()
    write_page(texture, tmp_path / "page.html", surface)
    page = opened(browser, file_url(tmp_path / "page.html"))
    assert page.complaints == []
    parity(page, texture, surface)
    page.close()


def parity(page: Any, texture: OctreeTexture, surface: Surface) -> dict[str, float]:
    """Compare all channels, filters, widths, levels and sides; return the largest differences, of 255."""
    header = pack(texture, surface, title="").header
    is_split = texture.tree.split.cells.size > 0
    found = {}
    filters = ("nearest", "quadratic") if header["isMixed"] else FILTERS
    looks = [(width, texture.tree.max_depth) for width in (0.0, -1.0, 0.03)]
    for filter, facing, (width, level) in product(filters, {False, is_split}, [*looks, (0.0, 3), (0.2, 3)]):
        probe = Probe(page, texture, SIZE, filter=filter, width=width, facing=facing, level=level)
        case = f"{filter}, width {width}, facing {facing}, level {level}"
        found[case] = compared(probe, texture.level(level), header, filter, width, facing, case)
    return found


def compared(
    probe: Probe,
    texture: OctreeTexture,
    header: dict[str, Any],
    filter: str,
    width: float,
    facing: bool,
    case: str,
) -> float:
    assert probe.seen.sum() > 300
    options: dict[str, Any] = {"width": probe.widths} if width else {}
    if facing:
        options["normals"] = probe.normals
    elif width:
        options["bleed_threshold"] = 10.0
    names = list(texture.channels)
    expected = texture.sample(probe.points, names, filter, normalize=False, **options)
    worst = 0.0
    cell = np.full(3, 2.0**-texture.tree.max_depth)
    is_inner = np.abs(probe.places / cell - np.rint(probe.places / cell)).min(axis=1) > 1e-6 / cell[0]
    is_compared = is_inner if filter == "nearest" else np.ones_like(is_inner)
    for channel in header["channels"]:
        plane, slot = channel["at"]
        components = channel["components"]
        values = probe.alpha[:, None]
        if channel["name"] != "alpha":
            values = probe.plane(plane)[:, slot : slot + components]
        if channel["space"] == "direction":
            values = 2 * values - 1
        away = 255 * np.abs(values - expected[channel["name"]]).max(axis=1)[is_compared]
        assert away.max() <= 2.0, f"{channel['name']}, {case}: {away.max()}"
        assert (away > 1.0).mean() <= 0.001, f"{channel['name']}, {case}: {(away > 1.0).mean()}"
        worst = max(worst, float(away.max()))
    return worst
