"""Benchmarks of lookups: beside what Python offers without octex, and their memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import numpy.typing as npt
from inputs import painted_torus, scattered_on_sphere, seen_on_sphere, sphere_cells, torus
from measuring import DROID, Report, Setup, Spent, clocked, in_turns, millions, open3d, task, timed

import octex
from octex.channels import BASE_COLOR
from octex.drawing.hits import rest_normals, visible_hits
from octex.texture import Channel
from octex.tree.octree import Octree
from octex.tree.placement import Placement

UNIT_CUBE = Placement((0.0, 0.0, 0.0), 1.0)


def sphere_texture(depth: int) -> octex.OctreeTexture:
    """Return a band of cells around a sphere with random values."""
    tree = Octree.from_leaves(sphere_cells(depth), depth)
    values = np.random.default_rng(0).integers(0, 256, (tree.n_cells, 3), np.uint8)
    channel = Channel(BASE_COLOR, values, values[:0], values[:0])
    return octex.OctreeTexture(tree, {"base_color": channel}, UNIT_CUBE, [[0, 0, 0], [1, 1, 1]])


def _times(
    texture: octex.OctreeTexture,
    points: dict[str, npt.NDArray[np.float32]],
    filters: tuple[str, ...],
    setup: Setup,
) -> dict[tuple[str, str], Spent]:
    """Return what lookups of each filter and order of points take on one thread."""
    works = {
        (name, order): partial(texture.sample, each, filter=name)
        for name in filters
        for order, each in points.items()
    }
    return clocked(setup, works, setup.core)


def lookup(setup: Setup, report: Report) -> None:
    """Lookups in a band of cells around a sphere, on one thread."""
    small = setup.quick
    points = {
        "coherent": seen_on_sphere(*((64, 36) if small else (1920, 1080))),
        "random": scattered_on_sphere(2000 if small else 2_000_000),
    }
    filters = "nearest", "linear", "quadratic"
    for depth in (6,) if small else (8, 9, 10, 11):
        texture = sphere_texture(depth)
        report.title(f"lookup: sphere, {1 << depth} cells along an edge, {texture.tree.n_leaves:,} in all")
        filters_here = (*filters, "quartic") if depth in (6, 10) else filters
        for (name, order), spent in _times(texture, points, filters_here, setup).items():
            report.line(f"octex, {name}, {order}", f"{millions(len(points[order]) / spent.cpu)} lookups/s")
        if depth in (6, 10):
            _two_threads(texture, points, setup, report)


def _two_threads(
    texture: octex.OctreeTexture, points: dict[str, npt.NDArray[np.float32]], setup: Setup, report: Report
) -> None:
    for order, each in points.items():
        out = np.empty((len(each), 3), np.float32)
        sample = partial(texture.sample, each, out=out)
        with ThreadPoolExecutor(2) as two:
            works = {"one": partial(sample, threads=1), "two": partial(sample, run=octex.Run(executor=two))}
            spent = clocked(setup, works)
        report.at_least(
            f"lookup: two threads, quadratic, {order}", spent["one"].wall / spent["two"].wall, 1.8
        )


#: The least rate of each question, of that of one colour in an even tree.
QUESTIONS = {
    "roughness": 0.9, "float32": 0.6, "all channels": 0.4, "with alpha": 0.7, "normals": 0.7,
    "gradient": 0.5, "quartic": 0.2, "painted": 0.7, "max_error=2": 0.7, "half a cell off": 0.5,
    "a cell off": 0.5, "two cells off": 0.5, "five cells off": 0.5, "one width": 0.5, "widths": 0.5,
    "widths, normals": 0.4,
}  # fmt: skip


def questions(setup: Setup, report: Report) -> None:
    """Each question that lookups answer, beside the colour of a point in an even tree."""
    models = {"droid": DROID}
    if setup.models:
        models["BoomBox"] = setup.models / "BoomBoxWithAxes" / "BoomBoxWithAxes.gltf"
    else:
        report.note("questions: left out without --models: BoomBox")
    for name, path in models.items():
        _questions(name, octex.load_surface(path), setup, report)


def _questions(name: str, surface: octex.Surface, setup: Setup, report: Report) -> None:
    depth, count = (5, 2000) if setup.quick else (10, 300_000)
    texture = octex.convert(surface, depth, fit=False)
    color = octex.convert(surface, depth, fit=False, channels="base_color", dtype="float32")
    merged = octex.convert(surface, depth, max_error=2, channels="base_color")
    clear = octex.convert(surface, depth, fit=False, sources={"alpha": 0.5})
    samples = surface.scatter(count)
    points, normals = np.ascontiguousarray(samples.rest), samples.normals
    painted = octex.fill(texture, surface, _tenth(points), (1, 0, 0), max_depth=depth + 1)
    cell = texture.placement.size / 2**depth
    widths = cell * 2.0 ** np.random.default_rng(0).uniform(1, 6, count)
    names = list(texture.channels)
    ask: dict[str, Callable[[], object]] = {
        "base": lambda: texture.sample(points),
        "roughness": lambda: texture.sample(points, "roughness"),
        "float32": lambda: color.sample(points),
        "all channels": lambda: texture.sample(points, names),
        "with alpha": lambda: clear.sample(points),
        "normals": lambda: texture.sample(points, normals=normals),
        "gradient": lambda: texture.sample(points, gradient=True),
        "quartic": lambda: texture.sample(points, filter="quartic"),
        "painted": lambda: painted.sample(points),
        "max_error=2": lambda: merged.sample(points),
        "one width": lambda: texture.sample(points, width=4 * cell),
        "widths": lambda: texture.sample(points, width=widths),
        "widths, normals": lambda: texture.sample(points, width=widths, normals=normals),
    }
    for what, cells in (("half a", 0.5), ("a", 1), ("two", 2), ("five", 5)):
        beside = points + cells * cell * normals
        word = "cells" if cells > 1 else "cell"
        ask[f"{what} {word} off"] = lambda beside=beside: texture.sample(beside)  # type: ignore[misc]
    spent = clocked(setup, ask, setup.core)
    report.title(
        f"questions: {name} at depth {depth}, {texture.tree.n_leaves:,} leaves, quadratic, at random"
    )
    report.line("base_color", f"{millions(count / spent['base'].cpu)} lookups/s")
    for what, least in QUESTIONS.items():
        report.at_least(f"questions: {name}, {what}", spent["base"].cpu / spent[what].cpu, least, "of that")
    one = points[:1]
    calls = 100 if setup.quick else 3000
    taken = timed(lambda: [texture.sample(one) for _ in range(calls)])[0]
    report.at_most(f"questions: {name}, a call with one point", 1e6 * taken.cpu / calls, 25, "µs")


def _tenth(points: npt.NDArray[np.floating]) -> octex.Sphere:
    """Return the ball around the first point that holds a tenth of all."""
    apart = np.linalg.norm(points - points[0], axis=1)
    return octex.Sphere(tuple(points[0].tolist()), float(np.quantile(apart, 0.1)))


#: Models whose lookups in adaptive and painted textures are compared with those in even ones.
MIXED = ("BoomBox", "Avocado", "Suzanne")
#: The least rates then, of that of as many points in an even tree: adaptive, painted.
MIXED_RATES = {"along a view": (0.6, 0.7), "500 k at random": (0.7, 0.7), "3 k at random": (0.2, None)}


def mixed(setup: Setup, report: Report) -> None:
    """Lookups in adaptive textures, and where a tenth was painted more finely, beside even ones."""
    depth, many, side = (5, 3000, 64) if setup.quick else (10, 500_000, 1024)
    if not setup.models:
        report.note("mixed: left out without --models")
        return
    for name in MIXED:
        path = next(
            (each for each in sorted(setup.models.rglob("*.gl*")) if each.name.startswith(name)), None
        )
        if path is None:
            report.note(f"mixed: left out {name}, which is not there")
            continue
        surface = octex.load_surface(path).with_channels(["base_color"])
        even = octex.convert(surface, depth, fit=False)
        samples = surface.scatter(many)
        points = np.ascontiguousarray(samples.rest, np.float32)
        textures = {
            "even": even,
            "adaptive": octex.convert(surface, depth, max_error=2),
            "painted": octex.fill(even, surface, _tenth(points), (1, 0, 0), max_depth=depth + 1),
        }
        camera = octex.Camera.fitted(surface.vertices, (0.5, 0.4, 1.0), size=(side, side))
        hits = [hit.rest for _, hit in visible_hits(surface, camera, rest_normals(surface))]
        report.title(f"mixed: {name} at depth {depth}, {even.tree.n_leaves:,} leaves, quadratic")
        orders = np.concatenate(hits).astype(np.float32), points, points[:3000]
        for (what, least), each in zip(MIXED_RATES.items(), orders, strict=True):
            calls = max(100_000 // len(each), 1)
            ask = {
                kind: lambda texture=texture, each=each, calls=calls: [  # type: ignore[misc]
                    texture.sample(each) for _ in range(calls)
                ]
                for kind, texture in textures.items()
            }
            spent = clocked(setup, ask, setup.core)
            report.line(f"even, {what}", f"{millions(calls * len(each) / spent['even'].cpu)} lookups/s")
            for kind, share in zip(("adaptive", "painted"), least, strict=True):
                ratio = spent["even"].cpu / spent[kind].cpu
                if share is None:
                    report.line(f"{kind}, {what}", f"{ratio:.2f} of that")
                else:
                    report.at_least(f"mixed: {name}, {kind}, {what}", ratio, share, "of that")


def resident(setup: Setup, report: Report) -> None:
    """Memory that a process takes for lookups in a file, and beside it in arrays of its own."""
    depth = 6 if setup.quick else 10
    texture = sphere_texture(depth)
    leaves = texture.tree.n_leaves
    path = setup.folder / "sphere.octex"
    texture.save(path)
    report.title(f"resident: sphere, {1 << depth} cells along an edge, bytes a cell")
    report.line("all arrays", f"{texture.nbytes / leaves:.2f}")
    count = 2000 if setup.quick else 2_000_000
    with task(setup, "resident", pin=False, path=str(path), count=count) as work:
        answer = work.run()
    report.line("tiles", f"{answer['tiles'] / leaves:.2f}")
    report.at_most(
        "resident: after 2 M random quadratic lookups", answer["grown"] / leaves, 8.5, "bytes a cell"
    )


def today(setup: Setup, report: Report) -> None:
    """Lookups as a Python user does them today: Open3D's closest point, its UV, and a bilinear read."""
    around, across, size, depth = (20, 10, 64, 6) if setup.quick else (320, 156, 2048, 10)
    report.title(f"today: a torus of {2 * around * across:,} triangles with an image of {size}²")
    surface = painted_torus(around, across, size)
    texture = octex.convert(surface, depth, fit=False)
    samples = surface.scatter(2000 if setup.quick else 500_000)
    points = {"random": np.ascontiguousarray(samples.rest, np.float32)}
    spent = _times(texture, points, ("quadratic",), setup)["quadratic", "random"]
    rate = len(points["random"]) / spent.cpu
    report.line("octex, quadratic, random", f"{millions(rate)} lookups/s")
    vertices, triangles, uv = torus(around, across)
    path = setup.folder / "today.npz"
    image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
    np.savez(path, vertices=vertices, triangles=triangles, uv=uv, image=image, points=points["random"])
    with open3d(setup, report, "look_up", path, core=setup.core) as peer:
        for name, theirs in in_turns(peer, setup.repeats).items():
            rate, ratio = len(points["random"]) / theirs.cpu, theirs.cpu / spent.cpu
            report.line(f"{name}, random", f"{millions(rate)} lookups/s: octex {ratio:.1f} × as fast")
