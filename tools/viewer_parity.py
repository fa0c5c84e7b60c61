#!/usr/bin/env python
"""Compare what the viewer's shader draws with lookups, on real models, in the browser that is installed.

usage: tools/viewer_parity.py [MODEL …] [--depth 8] [--size 160x120]

A row for each model (by default the droid, and four of OCTEX_TEST_MODELS where that is set), kind of tree,
filter, width and side: pixels, the largest difference of 255 in any channel, the share of pixels beyond 1,
fetches a pixel on average and at most, of all channels together. Exit code 1 if any is beyond 2, or more
than 0.1 % beyond 1.
Kinds: even; adaptive, at 3 codes; painted, a level more finely in a ball. Lookups of a side are compared
where cells are split. Widths are in root cells; "footprint" is each pixel's own.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import octex  # noqa: E402
from octex.source.surface import Surface  # noqa: E402
from octex.texture import OctreeTexture  # noqa: E402
from octex.viewer import write_page  # noqa: E402
from octex.viewer.pack import pack  # noqa: E402
from tests.make.browser import Probe, differences, file_url, opened, started  # noqa: E402

MODELS = "BoomBoxWithAxes/BoomBoxWithAxes.gltf", "Avocado/Avocado.gltf", "Suzanne/Suzanne.gltf"
MODELS = *MODELS, "spot-triangulated/spot.obj"
#: Filters and widths; −1 for the pixel's own.
LOOKS = ("nearest", 0.0), ("linear", 0.0), ("quadratic", 0.0), ("quadratic", -1.0), ("quadratic", 0.02)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL")
    parser.add_argument("--depth", type=int, default=8)
    parser.add_argument("--size", default="160x120")
    options = parser.parse_args()
    models = options.models or [ROOT / "samples" / "droid.glb", *_others()]
    width, height = map(int, options.size.split("x"))
    failed = False
    head = f"{'model':10} {'tree':9} {'filter':10} {'width':10}"
    print(f"{head} side  pixels   worst   beyond 1  fetches  most      s")
    with started() as browser, TemporaryDirectory() as folder:
        for model in models:
            surface = octex.load_surface(model)
            for kind, texture in _trees(surface, options.depth):
                write_page(texture, Path(folder) / "page.html", surface.placed_in(texture))
                page = opened(browser, file_url(Path(folder) / "page.html"), (640, 480))
                for line, is_bad in _compared(page, texture, surface, (width, height)):
                    print(f"{model.stem[:10]:10} {kind:9} {line}", flush=True)
                    failed |= is_bad
                page.close()
    return int(failed)


def _others() -> list[Path]:
    folder = os.environ.get("OCTEX_TEST_MODELS")
    return [] if folder is None else [Path(folder) / name for name in MODELS]


def _trees(surface: Surface, depth: int) -> Iterator[tuple[str, OctreeTexture]]:
    even = octex.convert(surface, depth=depth)
    yield "even", even
    yield "adaptive", octex.convert(surface, depth=depth, max_error=3)
    low, high = surface.bounds
    point = surface.scatter(1, seed=1).rest[0]
    ball = octex.Sphere(point, 0.2 * float((high - low).max()))
    yield "painted", octex.fill(even, surface, ball, (1.0, 0.1, 0.0), max_depth=depth + 1)


def _compared(
    page: Any, texture: OctreeTexture, surface: Surface, size: tuple[int, int]
) -> Iterator[tuple[str, bool]]:
    header = pack(texture, surface).header
    for facing in (False, True) if texture.tree.split.cells.size else (False,):
        for filter, width in LOOKS:
            began = time.perf_counter()
            probe = Probe(page, texture, size, filter=filter, width=width, facing=facing)
            found = differences(probe, texture, header, filter, width, facing)
            away = np.max(list(found.values()), axis=0)
            worst, beyond = float(away.max()), float((away > 1).mean())
            of_width = "footprint" if width < 0 else f"{width:g}"
            side = "seen" if facing else "all"
            figures = f"{away.size:6} {worst:7.4f} {100 * beyond:8.3f} %"
            figures += f" {probe.fetches.mean():8.1f} {int(probe.fetches.max()):5}"
            seconds = time.perf_counter() - began
            yield f"{filter:10} {of_width:10} {side:5} {figures} {seconds:6.1f}", worst > 2 or beyond > 0.001


if __name__ == "__main__":
    sys.exit(main())
