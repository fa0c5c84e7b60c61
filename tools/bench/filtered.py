"""Benchmarks of filtered lookups: what they show far away, and what they cost."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from inputs import RADIUS, painted_sphere, scattered_on_sphere, sphere_texture, view
from measuring import Setup, line, rates, table, title

Array = npt.NDArray[Any]

WIDTHS = {f"{4**n}": 4.0**n for n in range(7)} | {"5.66": 32**0.5, "22.6": 512**0.5, "any from 4 to 64": 0.0}


def far(setup: Setup) -> None:
    """Images of few pixels of a painted sphere, beside the true averages of the field."""
    depth, fine = (6, 160) if setup.quick else (10, 2560)
    texture = painted_sphere(depth)
    title(f"far: painted sphere, {1 << depth} cells along an edge, RMS errors in 1/255")
    for n in (20, 64, 256):
        across = max(-(-fine // n), 2)
        seen, all_of_it = view(n), view(n * across)
        pixels = np.flatnonzero(all_of_it.hit)
        pixels = pixels // (n * across) // across * n + pixels % (n * across) // across
        count = np.bincount(pixels, minlength=n * n)
        colors = 255 * texture.sample(all_of_it.points).astype(np.float64)
        sums = np.stack([np.bincount(pixels, weights, n * n) for weights in colors.T], axis=1)
        at = np.flatnonzero(seen.hit)
        points = count[at] > 0
        at = at[points]
        weights, is_inside = count[at, None], count[at] == across * across
        derivatives = {"dPdx": seen.dPdx, "dPdy": seen.dPdy}
        area = np.linalg.norm(np.cross(seen.dPdx, seen.dPdy), axis=1)
        for name, options in {
            "derivatives": derivatives,
            "linear, derivatives": derivatives | {"filter": "linear"},
            "round": {"width": np.sqrt(area)},
            "no footprint": {},
        }.items():
            errors = 255 * texture.sample(seen.points, **options)[points] - sums[at] / weights
            everywhere, inside = (np.sqrt((each**2).mean()) for each in (errors, errors[is_inside]))
            mean = np.abs((errors * weights).sum(axis=0) / weights.sum()).max()
            line(f"{n}², {name}", f"all pixels {everywhere:.2f}, inside {inside:.2f}; their mean {mean:.3f}")


def footprints(setup: Setup) -> None:
    """Lookups of footprints by width, in cells, and of long ones."""
    depth, pixels, count = (6, (36, 64), 2000) if setup.quick else (10, (1080, 1920), 1_000_000)
    texture, cell = sphere_texture(depth), 0.5**depth
    points = {"in pixel order": view(*pixels).points, "random": scattered_on_sphere(count)}
    title(f"footprints: sphere, {1 << depth} cells along an edge, one thread, M lookups a second")
    rows = []
    for order, each in points.items():
        drawn = cell * 2.0 ** np.random.default_rng(0).uniform(2, 6, len(each))
        each = each.astype(np.float32)
        works = {
            name: partial(texture.sample, each, width=cell * cells if cells else drawn)
            for name, cells in WIDTHS.items()
        }
        found = rates(setup, works, len(each))
        rows.append([order, *(f"{rate:.1f}" for rate in found.values())])
    table(["quadratic", *WIDTHS], rows)
    for order, each in points.items():
        some = each[: 2000 if setup.quick else 200_000].astype(np.float32)
        right, down = (cell * step.astype(np.float32) for step in _tangents(some))
        works = {
            name: partial(texture.sample, some, filter=name, dPdx=8 * right, dPdy=down)
            for name in ("quadratic", "linear")
        }
        for name, rate in rates(setup, works, len(some)).items():
            line(f"8 × 1 cells, {name}, {order}", f"{rate:.2f}")


def _tangents(points: Array) -> tuple[Array, Array]:
    along = np.cross(points - 0.5, [0.3, 0.2, 1.0])
    along /= np.linalg.norm(along, axis=1)[:, None]
    return along, np.cross((points - 0.5) / RADIUS, along)


def stretched(setup: Setup) -> None:
    """Long footprints' errors, beside those of round ones of the same area."""
    depth = 6 if setup.quick else 9
    texture, cell = painted_sphere(depth), 0.5**depth
    points = scattered_on_sphere(500 if setup.quick else 20_000).astype(np.float64)
    along, across = _tangents(points)
    title(f"stretched: painted sphere, {1 << depth} cells along an edge, 8 × 1, RMS errors in 1/255")
    for cells in (1.0, 4.0):
        right, down = 8 * cells * cell * along, cells * cell * across
        n, m = 8 * max(int(cells), 2), 2 * max(int(cells), 2)
        steps = [(a, b) for a in (np.arange(n) + 0.5) / n - 0.5 for b in (np.arange(m) + 0.5) / m - 0.5]
        truth = sum(255 * texture.sample(points + a * right + b * down) for a, b in steps) / (n * m)
        found = {
            "quadratic": texture.sample(points, dPdx=right, dPdy=down),
            "linear": texture.sample(points, filter="linear", dPdx=right, dPdy=down),
            "round": texture.sample(points, width=8**0.5 * cells * cell),
        }
        errors = (f"{name} {np.sqrt(((255 * v - truth) ** 2).mean()):.2f}" for name, v in found.items())
        line(f"of {cells:g} cells", ", ".join(errors))
