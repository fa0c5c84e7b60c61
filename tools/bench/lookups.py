"""Benchmarks of lookups: in cells of one size and of several, and beside what Python offers without octex."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import numpy.typing as npt
from inputs import looked_up_torus, painted_torus, scattered_on_sphere, sphere_texture, view
from measuring import Setup, clocked, colors_of, in_turns, line, note, open3d, rates, timed, title

import octex
from octex.drawing.hits import visible_hits


def sphere(setup: Setup) -> None:
    """Lookups in a band of cells around a sphere: on one thread by filter, and on two."""
    depth, pixels, count = (6, (36, 64), 2000) if setup.quick else (10, (1080, 1920), 2_000_000)
    texture = sphere_texture(depth)
    title(f"sphere: {1 << depth} cells along an edge, {texture.tree.n_leaves:,} in all, M lookups a second")
    for order, points in {
        "in pixel order": view(*pixels).points.astype(np.float32),
        "random": scattered_on_sphere(count),
    }.items():
        works = {
            name: partial(texture.sample, points, filter=name)
            for name in ("nearest", "linear", "quadratic", "quartic")
        }
        for name, rate in rates(setup, works, len(points)).items():
            line(f"{name}, {order}", f"{rate:.2f}")
        sample = partial(texture.sample, points, out=np.empty((len(points), 3), np.float32))
        with ThreadPoolExecutor(2) as two:
            works = {"one": partial(sample, threads=1), "two": partial(sample, run=octex.Run(executor=two))}
            spent = clocked(setup, works)
        line(f"two threads, {order}", f"{spent['one'].wall / spent['two'].wall:.2f} × one")


def lookups(setup: Setup) -> None:
    """Each kind of lookup in a model, relative to the colour at random points."""
    for name, path, depth in setup.models():
        if name in ("droid", "BoomBoxWithAxes"):
            _lookups(setup, name, octex.load_surface(path), depth)


def _lookups(setup: Setup, name: str, surface: octex.Surface, depth: int) -> None:
    count, calls = (2000, 100) if setup.quick else (300_000, 3000)
    texture = octex.convert(surface, depth, fit=False)
    color = octex.convert(surface, depth, fit=False, channels="base_color", dtype="float32")
    clear = octex.convert(surface, depth, fit=False, sources={"alpha": 0.5})
    samples = surface.scatter(count)
    points, normals = np.ascontiguousarray(samples.rest), samples.normals
    cell = texture.placement.size / 2**depth
    widths = cell * 2.0 ** np.random.default_rng(0).uniform(1, 6, count)
    ask: dict[str, Callable[[], object]] = {
        "base colour": lambda: texture.sample(points),
        "one component": lambda: texture.sample(points, "roughness"),
        "all channels": lambda: texture.sample(points, list(texture.channels)),
        "stored as float32": lambda: color.sample(points),
        "with alpha": lambda: clear.sample(points),
        "normals": lambda: texture.sample(points, normals=normals),
        "gradient": lambda: texture.sample(points, gradient=True),
        "quartic": lambda: texture.sample(points, filter="quartic"),
        "one width": lambda: texture.sample(points, width=4 * cell),
        "widths of 2 to 64 cells": lambda: texture.sample(points, width=widths),
        "widths, normals": lambda: texture.sample(points, width=widths, normals=normals),
    }
    for cells in (0.5, 1.0, 2.0, 5.0):
        ask[f"{cells:g} cells off"] = partial(texture.sample, points + cells * cell * normals)
    found = rates(setup, ask, count)
    title(f"lookups: {name} at depth {depth}, {texture.tree.n_leaves:,} leaves, quadratic, at random")
    line("base colour", f"{found['base colour']:.2f} M a second")
    for what, rate in found.items():
        line(what, f"{rate / found['base colour']:.2f} of that")
    spent, _ = timed(lambda: [texture.sample(points[:1]) for _ in range(calls)])
    line("a call with one point", f"{1e6 * spent.cpu / calls:.1f} µs")


def _tenth(points: npt.NDArray[np.floating]) -> octex.Sphere:
    """Return the ball around the first point that holds a tenth of all."""
    apart = np.linalg.norm(points - points[0], axis=1)
    return octex.Sphere(tuple(points[0].tolist()), float(np.quantile(apart, 0.1)))


def mixed(setup: Setup) -> None:
    """Lookups in adaptive textures, and where a tenth was painted more finely, beside even ones."""
    many, side = (3000, 64) if setup.quick else (500_000, 1024)
    for name, path, depth in setup.models():
        surface = colors_of(path)
        even = octex.convert(surface, depth, fit=False)
        points = surface.scatter(many).rest.astype(np.float32)
        textures = {
            "even": even,
            "adaptive": octex.convert(surface, depth, max_error=2),
            "painted": octex.fill(even, surface, _tenth(points), (1, 0, 0), max_depth=depth + 1),
        }
        camera = octex.Camera.fitted(surface.vertices, (0.5, 0.4, 1.0), size=(side, side))
        seen = [hit.rest for _, hit in visible_hits(surface, camera)]
        title(f"mixed: {name} at depth {depth}, {even.tree.n_leaves:,} leaves, quadratic")
        for what, each in {
            "in pixel order": np.concatenate(seen).astype(np.float32),
            f"{many:,} at random": points,
            "3,000 at random": points[:3000],
        }.items():
            calls = max(100_000 // len(each), 1)
            ask = {kind: partial(_repeated, texture, each, calls) for kind, texture in textures.items()}
            found = rates(setup, ask, calls * len(each))
            shares = ", ".join(f"{kind} {found[kind] / found['even']:.2f}" for kind in list(textures)[1:])
            line(what, f"{found['even']:.2f} M a second; of that {shares}")


def _repeated(texture: octex.OctreeTexture, points: npt.NDArray[np.float32], calls: int) -> None:
    for _ in range(calls):
        texture.sample(points)


def today(setup: Setup) -> None:
    """Lookups as a Python user does them today: Open3D's closest point, its UV, and a bilinear read."""
    around, across, size, depth = (20, 10, 64, 6) if setup.quick else (320, 156, 2048, 10)
    title(f"today: a torus of {2 * around * across:,} triangles with an image of {size}²")
    surface = painted_torus(around, across, size)
    texture = octex.convert(surface, depth, fit=False)
    points = surface.scatter(2000 if setup.quick else 500_000).rest.astype(np.float32)
    own = rates(setup, {"": lambda: texture.sample(points)}, len(points))[""]
    line("octex, quadratic, random", f"{own:.2f} M a second")
    arrays = looked_up_torus(around, across, size, points)
    with open3d(setup, "look_up", core=setup.core, **arrays) as peer:
        for name, theirs in in_turns(peer, setup.repeats).items():
            rate = len(points) / theirs.cpu / 1e6
            note(f"{name}, random: {rate:.2f} M a second: octex {own / rate:.1f} × as fast")
