"""Benchmark of fitted and adaptive conversion: leaves, how far the fields are apart, and time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from inputs import painted_torus
from measuring import DROID, Report, Setup, clocked, pinned

import octex
from octex.channels import linear_to_srgb

#: The deepest level of each model's trees: cells of half a texel to three.
MODELS = {
    "Avocado/Avocado.gltf": 10,
    "BoomBoxWithAxes/BoomBoxWithAxes.gltf": 10,
    "Suzanne/Suzanne.gltf": 10,
    "spot-triangulated/spot.obj": 9,
}
MAX_ERROR = 2
PLAIN, FITTED, ADAPTIVE = "plain", "fitted", "adaptive"


def adaptive(setup: Setup, report: Report) -> None:
    """Leaves of adaptive trees, how far their fields are from the full ones, and time beside plain ones."""
    count = 2000 if setup.quick else 1_000_000
    report.title(f"adaptive: max_error={MAX_ERROR}, {count:,} points, 8-bit codes, one thread")
    rows = []
    for name, surface, depth in _surfaces(setup, report):
        full, merged, times = _converted(setup, surface, depth)
        leaves, left = full.tree.n_leaves, merged.tree.n_leaves
        rms, most = _apart(full, merged, surface.scatter(count).rest)
        fit_time, whole_time = (times[each] / times[PLAIN] for each in (FITTED, ADAPTIVE))
        rows.append(
            [
                name, depth, f"{leaves:,}", f"{left:,}", f"{left / leaves:.1%}", f"{rms:.3f}", f"{most:.2f}",
                f"{times[PLAIN]:.2f} s", f"{fit_time:.2f} ×", f"{whole_time:.2f} ×",
            ]
        )  # fmt: skip
        report.at_most(f"adaptive: {name}, root mean square", rms, 1, "codes")
        report.at_most(f"adaptive: {name}, 99.9 %", most, 3, "codes")
        report.at_most(f"adaptive: {name}, time with the fit beside plain", fit_time, 4, "×")
        report.at_most(f"adaptive: {name}, time with both beside plain", whole_time, 4, "×")
    heads = ["model", "depth", "leaves", "adaptive", "of all", "RMS", "99.9 %", PLAIN, FITTED, ADAPTIVE]
    report.table(heads, rows)
    share = _decal(6 if setup.quick else 9)
    report.at_most("adaptive: leaves of a flat body with a decal", 100 * share, 5, "%")


def _surfaces(setup: Setup, report: Report) -> Iterator[tuple[str, octex.Surface, int]]:
    """Yield names, models and depths."""
    if setup.quick or not setup.models:
        report.note("left out: real models (--models); a painted torus in their place")
        yield (
            "torus",
            *((painted_torus(40, 20, 256), 5) if setup.quick else (painted_torus(120, 70, 2048), 9)),
        )
        return
    for path, depth in MODELS.items():
        if (setup.models / path).is_file():
            surface = octex.load_surface(setup.models / path, channels=["base_color"])
            yield path.split("/")[-1], surface, depth
        else:
            report.note(f"left out: there is no {path}")
    if DROID.is_file():
        yield DROID.name, octex.load_surface(DROID, channels=["base_color"]), 10


def _converted(
    setup: Setup, surface: octex.Surface, depth: int
) -> tuple[octex.OctreeTexture, octex.OctreeTexture, dict[str, float]]:
    """Convert a model in all three ways; return what is fitted, what is adaptive, and seconds."""
    ways = {PLAIN: {"fit": False}, FITTED: {}, ADAPTIVE: {"max_error": MAX_ERROR}}
    with pinned({setup.core}), ThreadPoolExecutor(1) as pool:

        def convert(options: dict[str, object]) -> octex.OctreeTexture:
            return octex.convert(surface, depth, run=octex.Run(executor=pool), **options)  # type: ignore[arg-type]

        full, merged = (convert(ways[each]) for each in (FITTED, ADAPTIVE))
        spent = clocked(setup, {way: partial(convert, options) for way, options in ways.items()})
    return full, merged, {way: each.cpu for way, each in spent.items()}


def _apart(a: octex.OctreeTexture, b: octex.OctreeTexture, points: np.ndarray) -> tuple[float, float]:
    """Return by how many codes colours differ: root mean square, and 99.9th percentile of all components."""
    codes = [255 * linear_to_srgb(each.sample(points, "base_color")) for each in (a, b)]
    apart = np.abs(codes[0] - codes[1])
    return float(np.sqrt(np.mean(apart**2))), float(np.quantile(apart, 0.999))


def _decal(depth: int) -> float:
    """Return the part of all leaves that is left of a square in one colour with a small speckled decal."""
    size = 1 << depth - 1
    image = np.full((size, size, 3), 90, np.uint8)
    decal = size // 16
    speckles = np.random.default_rng(0).integers(0, 256, (decal, decal, 3))
    image[decal : 2 * decal, decal : 2 * decal] = speckles
    corners = np.array([[0.0, 0, 0], [1, 0, 0.2], [1, 1, 0.3], [0, 1, 0.1]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    surface = octex.Surface.from_arrays(corners, triangles, uv=corners[:, :2], image=image)
    full, merged = octex.convert(surface, depth), octex.convert(surface, depth, max_error=MAX_ERROR)
    return merged.tree.n_leaves / full.tree.n_leaves
