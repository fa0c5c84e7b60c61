"""Benchmarks of filtered lookups: what they show far away, what they cost, and what they read of a file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from inputs import RADIUS, scattered_on_sphere, seen_on_sphere
from lookups import sphere_texture
from measuring import Report, Setup, clocked, megabytes, task
from painted_sphere import View, painted_sphere, view

import octex

Array = npt.NDArray[Any]

SIZES = (20, 64, 256)
#: RMS error in 8-bit levels, by size: all pixels and those wholly inside, of footprints from derivatives; and
#: all pixels, of round footprints.
TARGETS = {20: (2.0, 0.9, 3.0), 64: (1.1, 0.35, 1.9), 256: (0.35, 0.2, 0.7)}


def far(setup: Setup, report: Report) -> None:
    """Pictures of few pixels of a painted sphere, and of white noise, beside the true averages.

    These are averages of the field; for white noise of the leaves, since the field between leaves that are
    not fitted weighs them by other shares than the surface in them has.
    """
    depth, fine = (6, 160) if setup.quick else (10, 2560)
    for painted in (True, False):
        texture = painted_sphere(depth, painted=painted)
        kind = "painted" if painted else "white noise"
        report.title(f"far: sphere, {kind}, {1 << depth} cells along an edge, RMS errors in levels")
        for n in SIZES:
            _far(texture, n, max(-(-fine // n), 2), kind, report)


def _far(texture: octex.OctreeTexture, n: int, across: int, kind: str, report: Report) -> None:
    fine = view(n * across)
    pixels = np.flatnonzero(fine.hit)
    pixels = pixels // (n * across) // across * n + pixels % (n * across) // across
    count = np.bincount(pixels, minlength=n * n)
    truth_filter = "quadratic" if kind == "painted" else "nearest"
    colors = 255 * texture.sample(fine.points, filter=truth_filter).astype(np.float64)
    sums = np.stack([np.bincount(pixels, weights, n * n) for weights in colors.T], axis=1)
    truth = sums / np.maximum(count, 1)[:, None]
    seen = view(n)
    at = np.flatnonzero(seen.hit)
    at, points = at[count[at] > 0], count[at] > 0
    is_inside = count[at] == across * across
    area = np.linalg.norm(np.cross(seen.dPdx, seen.dPdy), axis=1)
    found = {
        "derivatives": texture.sample(seen.points, dPdx=seen.dPdx, dPdy=seen.dPdy)[points],
        "linear, derivatives": texture.sample(seen.points, filter="linear", dPdx=seen.dPdx, dPdy=seen.dPdy)[
            points
        ],
        "round": texture.sample(seen.points, width=np.sqrt(area))[points],
        "no footprint": texture.sample(seen.points)[points],
    }
    first_leaf = texture.tree.arrays.level_cells[texture.tree.max_depth]
    deviation = texture.channels["base_color"].values[first_leaf:].std()
    own = deviation * np.sqrt((1 / _cells_of_pixels(seen, texture)[points]).mean())
    for name, values in found.items():
        errors = 255 * values - truth[at]
        everywhere, inside = (np.sqrt((each**2).mean()) for each in (errors, errors[is_inside]))
        bias = np.abs((errors * count[at, None]).sum(axis=0) / count[at].sum()).max()
        within = np.abs(errors[is_inside].mean(axis=0)).max()
        report.line(
            f"{n}², {name}",
            f"all pixels {everywhere:.2f}, inside {inside:.2f}; means {bias:.3f}, {within:.3f} off",
        )
        if name == "no footprint" or name.startswith("linear"):
            continue
        report.at_most(f"far: {kind}, {n}², {name}: the picture's mean", bias, 0.1, "levels")
        if kind == "painted":
            whole, own_inside, iso = TARGETS[n]
            if name == "round":
                report.at_most(f"far: {n}², round, all pixels", everywhere, iso, "levels")
            else:
                report.at_most(f"far: {n}², derivatives, all pixels", everywhere, whole, "levels")
                report.at_most(f"far: {n}², derivatives, inside", inside, own_inside, "levels")
        else:
            what = f"far: noise, {n}², {name}, of a mean's own deviation, {own:.2f}"
            report.at_most(what, everywhere / own, 1.5, "×")


def _cells_of_pixels(seen: View, texture: octex.OctreeTexture) -> Array:
    """How many leaves a pixel covers, about: their areas add up to the sphere's."""
    leaf = 4 * np.pi * RADIUS**2 / texture.tree.n_leaves
    return np.maximum(np.linalg.norm(np.cross(seen.dPdx, seen.dPdy), axis=1) / leaf, 1.0)


def footprints(setup: Setup, report: Report) -> None:
    """Lookups of footprints by width, and of long ones."""
    depth = 6 if setup.quick else 10
    texture = sphere_texture(depth)
    cell = 1 / (1 << depth)
    points = {
        "coherent": seen_on_sphere(*((64, 36) if setup.quick else (1920, 1080))),
        "random": scattered_on_sphere(2000 if setup.quick else 1_000_000),
    }
    report.title(f"footprints: sphere, {1 << depth} cells along an edge, one thread, M lookups a second")
    widths = {"1 cell": 1.0, "4": 4.0, "16": 16.0, "64": 64.0, "256": 256.0, "1024": 1024.0, "4096": 4096.0}
    widths |= {"5.66": 32**0.5, "22.6": 512**0.5, "any from 4 to 64": 0.0}
    for filter in ("quadratic", "linear"):
        rows = []
        for order, each in points.items():
            drawn = cell * 2.0 ** np.random.default_rng(0).uniform(2, 6, len(each))
            works: dict[str, Callable[[], Any]] = {
                name: partial(texture.sample, each, filter=filter, width=cell * cells if cells else drawn)
                for name, cells in widths.items()
            }
            rates = _rates(works, len(each), setup)
            rows.append([order, *(f"{rate / 1e6:.1f}" for rate in rates.values())])
            if filter == "quadratic":
                slowest = min(rates[name] for name in ("4", "16", "64", "256", "1024", "4096"))
                report.at_least(
                    f"footprints: {order}, 4 to 4096 cells, one cell's rate", slowest / rates["1 cell"], 1
                )
                between = min(rates[name] for name in ("5.66", "22.6", "any from 4 to 64"))
                report.line(f"{order}, between levels, one cell's rate", f"{between / rates['1 cell']:.2f} ×")
        report.table([filter, *widths], rows)
    _long(texture, points, cell, setup, report)


def _rates(works: dict[str, Callable[[], Any]], count: int, setup: Setup) -> dict[str, float]:
    """Lookups a second of some work, in turns."""
    return {name: count / each.cpu for name, each in clocked(setup, works, setup.core).items()}


def _long(
    texture: octex.OctreeTexture,
    points: dict[str, npt.NDArray[np.float32]],
    cell: float,
    setup: Setup,
    report: Report,
) -> None:
    for order, each in points.items():
        some = each[: 200_000 if not setup.quick else 2000].astype(np.float64)
        along, across = _tangents(some)
        for cells in (1.0, 4.0):
            right, down = ((each * cells * cell).astype(np.float32) for each in (8 * along, across))
            works = {
                filter: partial(texture.sample, some.astype(np.float32), filter=filter, dPdx=right, dPdy=down)
                for filter in ("quadratic", "linear")
            }
            for filter, rate in _rates(works, len(some), setup).items():
                report.line(f"8×1, of {cells:g} cells, {filter}, {order}", f"{rate / 1e6:.2f} M/s")


def _tangents(points: Array) -> tuple[Array, Array]:
    along = np.cross(points - 0.5, [0.3, 0.2, 1.0])
    along /= np.linalg.norm(along, axis=1)[:, None]
    return along, np.cross((points - 0.5) / RADIUS, along)


def stretched(setup: Setup, report: Report) -> None:
    """Long footprints' errors, beside those of round ones of the same area."""
    depth = 6 if setup.quick else 9
    texture = painted_sphere(depth)
    cell = 1 / (1 << depth)
    points = scattered_on_sphere(500 if setup.quick else 20_000).astype(np.float64)
    along, across = _tangents(points)
    report.title(f"stretched: painted sphere, {1 << depth} cells along an edge, 8×1, RMS errors in levels")
    for cells in (1.0, 4.0):
        right, down = 8 * cells * cell * along, cells * cell * across
        n, m = 8 * max(int(cells), 2), 2 * max(int(cells), 2)
        truth = np.zeros((len(points), 3))
        for a in (np.arange(n) + 0.5) / n - 0.5:
            for b in (np.arange(m) + 0.5) / m - 0.5:
                truth += texture.sample(points + a * right + b * down)
        truth *= 255 / (n * m)
        found = {
            "quadratic": texture.sample(points, dPdx=right, dPdy=down),
            "linear": texture.sample(points, filter="linear", dPdx=right, dPdy=down),
            "round": texture.sample(points, width=8**0.5 * cells * cell),
        }
        errors = {name: float(np.sqrt(((255 * v - truth) ** 2).mean())) for name, v in found.items()}
        report.line(f"of {cells:g} cells", ", ".join(f"{name} {error:.2f}" for name, error in errors.items()))
        for name in ("quadratic", "linear"):
            report.at_most(
                f"stretched: of {cells:g} cells, {name}, the round ones' error",
                errors[name] / errors["round"],
                1 / 3,
            )


def pages(setup: Setup, report: Report) -> None:
    """Pictures from a large file that is not in the system's cache, and what they read of it."""
    depth = 7 if setup.quick else 11
    path = setup.folder / "sphere.octex"
    sphere_texture(depth).save(path)
    size = path.stat().st_size
    report.title(f"pages: pictures from a file of {megabytes(size)}")
    sizes = (20, 64) if setup.quick else (20, 256, 1024)
    for n in sizes:
        with task(setup, "picture", pin=False, path=str(path), pixels=n) as work:
            answer = work.run()
        report.line(f"{n}², read", f"{answer['touched'] / 1e6:.2f} MB in {answer['wall']:.3f} s")
        if n == 20:
            report.at_most("pages: 20²", answer["touched"] / 1e6, 0.5, "MB")
        if n == sizes[-1]:
            report.at_most(f"pages: {n}², of the file", answer["touched"] / size, 1.0)
