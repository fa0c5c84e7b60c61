"""Benchmarks of conversion: cells of a mesh, models, very many leaves, and where colours come from."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from statistics import median

import numpy as np
import numpy.typing as npt
from inputs import looked_up_torus, painted_torus
from inputs import torus as torus_mesh
from measuring import (
    Setup,
    Spent,
    clocked,
    in_turns,
    line,
    open3d,
    pinned,
    rates,
    table,
    task,
    timed,
    title,
)

import octex
from octex.channels import linear_to_srgb

Floats = npt.NDArray[np.floating]

_FILTERS = ("trilinear", "ewa")
_STRETCHES = (1, 2, 4, 8, 16)
_WIDTHS = (0.7, 1.5, 4.0)  # of the footprint's short side, in texels


def torus(setup: Setup) -> None:
    """Cut a torus of a million triangles into cells, beside Open3D, on one thread."""
    around, across, depth = (40, 20, 6) if setup.quick else (1000, 500, 10)
    title(f"torus: {2 * around * across:,} triangles, {1 << depth} cells along an edge, one thread")
    vertices, triangles, _ = torus_mesh(around, across)
    arrays = {"vertices": vertices, "triangles": triangles}
    if not setup.quick:  # so that its memory is not that of compiling
        with task(setup, "tree", pin=False, around=20, across=10, depth=6) as work:
            work()
    with (
        task(setup, "tree", around=around, across=across, depth=depth) as work,
        open3d(setup, "cells", 1 << depth, core=setup.core, **arrays) as peer,
    ):
        built = work()
        own = {"octex, tree with flags and areas": lambda: Spent(**work()["spent"])}
        for name, each in in_turns(own | peer, setup.repeats).items():
            line(name, f"{each}   {built['leaves'] / each.cpu / 1e6:.2f} M cells/s")
    line("cells; peak memory", f"{built['leaves']:,}; {built['peak'] / 2**20:.0f} MB")


def models(setup: Setup) -> None:
    """Convert models in every way: as averages, on two threads, all channels, fitted, adaptive."""
    title("models: leaves, and seconds beside those of averages; RMS and 99.9 % of the difference in 1/255")
    rows = []
    for name, path, depth in setup.models():
        surface = octex.load_surface(path)
        colors = surface.with_channels(["base_color"])
        with ThreadPoolExecutor(1) as pool, ThreadPoolExecutor(2) as two:
            one = octex.Run(executor=pool)
            works = {
                "averages": partial(octex.convert, colors, depth, fit=False, run=one),
                "all channels": partial(octex.convert, surface, depth, fit=False, run=one),
                "fitted": partial(octex.convert, colors, depth, run=one),
                "max_error=2": partial(octex.convert, colors, depth, max_error=2, run=one),
            }
            spent = clocked(setup, works, setup.core)
            run = octex.Run(executor=two)
            both = clocked(setup, {"": partial(octex.convert, colors, depth, fit=False, run=run)})
            full, merged = works["fitted"](), works["max_error=2"]()
        points = surface.scatter(2000 if setup.quick else 1_000_000).rest
        codes = [255 * linear_to_srgb(each.sample(points, "base_color")) for each in (full, merged)]
        apart = np.abs(codes[0] - codes[1])
        leaves, base = full.tree.n_leaves, spent.pop("averages")
        times = (f"{each.cpu / base.cpu:.2f} ×" for each in spent.values())
        share = f"{merged.tree.n_leaves / leaves:.1%}"
        far = f"{np.sqrt(np.mean(apart**2)):.3f}", f"{np.quantile(apart, 0.999):.2f}"
        rows.append([name, depth, f"{leaves:,}", f"{base.cpu:.2f} s", *times])
        rows[-1] += [f"{both[''].wall:.2f} s", share, *far]
    heads = ["model", "depth", "leaves", "averages", "all channels", "fitted", "max_error=2"]
    table([*heads, "two threads", "leaves of max_error=2", "RMS", "99.9 %"], rows)


def large(setup: Setup) -> None:
    """Memory that a model of fifty million leaves takes, and what opening it and a coarse look cost."""
    around, across, size, depth = (40, 20, 256, 6) if setup.quick else (1000, 500, 4096, 12)
    title(f"large: painted torus, {2 * around * across:,} triangles, {size}² texels, depth {depth}")
    path, level = setup.folder / "large.octex", 3 if setup.quick else 5
    mesh = {"around": around, "across": across, "size": size, "depth": depth}
    with task(setup, "large", pin=False, path=str(path), **mesh) as work:
        made = work()
    line("leaves, bytes of the file", f"{made['leaves']:,}, {made['bytes']:,}")
    line("convert, all processors", Spent(**made["convert"]))
    line("peak memory of the conversion", f"{made['peak'] / 2**30:.2f} GB")
    line("save", Spent(**made["save"]))
    with task(setup, "look", path=str(path), level=level) as work:
        looks = [work() for _ in range(setup.repeats)]
    look = {name: median(look[name] for look in looks) for name in looks[0]}
    line("open: nothing cached, cached", f"{look['cold'] * 1e3:.2f} ms, {look['warm'] * 1e3:.2f} ms")
    line("new memory after opening (first time)", f"{looks[0]['opened'] / 2**20:.2f} MB")
    read = f"{look['look'] * 1e3:.2f} ms, {look['touched'] / 2**20:.2f} MB read"
    line(f"20 × 20 points at level {level}, nothing cached", read)
    path.unlink()


def transfer(setup: Setup) -> None:
    """Another model's colours where its surface is nearest, beside Open3D's closest point."""
    around, across, size, depth = (24, 12, 64, 5) if setup.quick else (1024, 488, 1024, 10)
    source = painted_torus(around, across, size)
    vertices, triangles, _ = torus_mesh(around * 15 // 16, across * 15 // 16)
    target = octex.Surface.from_arrays(vertices, triangles)
    title(
        f"transfer: {len(source.triangles):,} triangles with an image of {size}² onto {len(triangles):,}, at "
        "the points that a conversion asks for, one thread"
    )
    samples = target.scatter(2000 if setup.quick else 2_000_000)
    order = np.argsort(samples.triangles, kind="stable")
    where = samples.triangles[order], samples.barycentric[order], np.zeros(order.size, np.float32)
    arrays = looked_up_torus(around, across, size, samples.rest[order].astype(np.float32))
    with pinned(setup.core):
        spent, laid = timed(lambda: target.with_sources(octex.Transfer(source).sources))
        line("made ready", spent)
        laid.source.evaluate(*(each[:100] for each in where))
        with open3d(setup, "look_up", core=setup.core, **arrays) as peer:
            ours = {"octex": lambda: timed(lambda: laid.source.evaluate(*where))[0]}
            for name, each in in_turns(ours | peer, setup.repeats).items():
                line(name, f"{order.size / each.cpu / 1e6:.2f} M points/s")
    convert = partial(octex.convert, target, depth, fit=False)
    works = {"with colours": partial(convert, sources=octex.Transfer(source).sources), "bare": convert}
    for name, each in clocked(setup, works).items():
        line(f"the whole conversion at depth {depth}, averages, {name}", each)


def cloud(setup: Setup) -> None:
    """Coloured points, laid on a mesh and by themselves."""
    count, around, across, depth = (5000, 24, 12, 5) if setup.quick else (10_000_000, 1024, 488, 10)
    title(f"cloud: {count:,} points, {2 * around * across:,} triangles, depth {depth}, averages, all cores")
    surface = painted_torus(around, across, 256)
    samples = surface.scatter(count)
    given = samples.rest, surface.evaluate(samples), samples.normals
    bare = octex.Surface.from_arrays(surface.vertices, surface.triangles)
    works = {
        "laid on the mesh": lambda: octex.convert(
            bare, depth, sources=octex.PointCloud(*given).sources, fit=False
        ),
        "by themselves": lambda: octex.convert(octex.PointCloud(*given), depth),
    }
    for name, each in clocked(setup, works).items():
        line(name, each)


def filters(setup: Setup) -> None:
    """Image filters under stretched footprints: error beside the mean over the footprint, and time."""
    side, count, fine, angles = (64, 20, 8, [0.3]) if setup.quick else (512, 300, 48, [0.0, 0.3, 0.8, 1.2])
    title(f"filters: {side}² texels, footprints of {_WIDTHS} texels times the stretch, turned")
    rng = np.random.default_rng(0)
    heads = ["RMS, sRGB codes; stretch", *(f"{stretch} : 1" for stretch in _STRETCHES)]
    rows = []
    for image, texels in _images(rng, side).items():
        errors = np.zeros((len(_FILTERS), len(_STRETCHES)))
        for number, stretch in enumerate(_STRETCHES):
            for width, angle in product(_WIDTHS, angles):
                errors[:, number] += _squared_errors(texels, (stretch, width, angle), count, fine, rng)
        errors = np.sqrt(errors / (len(_WIDTHS) * len(angles)))
        rows += [
            [f"{image}, {name}", *(f"{error:.2f}" for error in own)]
            for name, own in zip(_FILTERS, errors, strict=True)
        ]
    across = 30 if setup.quick else 300  # points in rows
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(across)), axis=-1).reshape(-1, 2) / across
    places = grid[grid[:, 0] >= grid[:, 1]] * 4.0
    texels = rng.integers(0, 256, (side, side, 3)).astype(np.uint8)
    for name in _FILTERS:
        works = {
            stretch: partial(_read_all, [_surface(texels, stretch, w, 0.5, name) for w in _WIDTHS], places)
            for stretch in _STRETCHES
        }
        found = rates(setup, works, len(_WIDTHS) * len(places))
        rows.append([f"ns a lookup, {name}", *(f"{1e3 / rate:.0f}" for rate in found.values())])
    table(heads, rows)


def _images(rng: np.random.Generator, side: int) -> dict[str, npt.NDArray[np.uint8]]:
    """Return what fades with frequency, as images do, with hard edges and without."""
    frequencies = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    frequencies[0, 0] = 1.0
    pink = np.fft.ifft2(np.fft.fft2(rng.normal(size=(side, side))) / frequencies).real
    pink = (pink - pink.mean()) / pink.std()
    smooth = np.clip(128 + 50 * pink, 0, 255).astype(np.uint8)
    edges = np.where((10 * pink).astype(int) % 2 == 0, 30, 220).astype(np.uint8)
    return {"pink noise": smooth, "its contours, hard": edges}


def _surface(
    texels: npt.NDArray[np.uint8], stretch: float, width: float, angle: float, filter: str
) -> octex.Surface:
    """Return a triangle whose unit of length is width × (width · stretch) texels, turned in the image."""

    def rotation(angle: float) -> Floats:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    turned = rotation(angle) @ np.diag([width, width * stretch]) @ rotation(1.7 * angle + 1.0)
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    uv = corners @ turned.T / len(texels)
    vertices = np.column_stack([corners, np.zeros(3)])
    return octex.Surface.from_arrays(vertices, [[0, 1, 2]], uv=uv, image=texels, filter=filter)


def _read(surface: octex.Surface, places: Floats, width: float) -> npt.NDArray[np.float32]:
    """Return values at places (n, 2) of the triangle."""
    x, y = places.T / 4.0
    triangles = np.zeros(len(places), np.int32)
    barycentric = np.stack([1.0 - x, x - y, y], axis=1)
    return surface.evaluate_all(triangles, barycentric, np.full(len(places), width, np.float32))


def _read_all(surfaces: list[octex.Surface], places: Floats) -> None:
    for surface in surfaces:
        _read(surface, places, 1.0)


def _squared_errors(
    texels: npt.NDArray[np.uint8],
    footprint: tuple[float, float, float],
    count: int,
    fine: int,
    rng: np.random.Generator,
) -> Floats:
    """Return each filter's mean squared error beside the mean of fine² reads in the footprint's square."""
    places = 0.5 + 3.0 * np.sort(rng.random((count, 2)), axis=1)[:, ::-1]
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    fine_places = (places[:, None] + square).reshape(-1, 2)
    reads = _read(_surface(texels, *footprint, "bilinear"), fine_places, 0.0)
    truth = linear_to_srgb(reads.reshape(count, -1, 3).mean(axis=1))
    found = (linear_to_srgb(_read(_surface(texels, *footprint, name), places, 1.0)) for name in _FILTERS)
    return np.array([np.mean((255.0 * (each - truth)) ** 2) for each in found])
