"""Benchmarks of where colours come from: another model's nearest surface, and clouds of points."""

from __future__ import annotations

from functools import partial

import numpy as np
from inputs import painted_torus, torus
from measuring import Report, Setup, clocked, in_turns, open3d, pinned, timed

import octex


def transfer(setup: Setup, report: Report) -> None:
    """Another model's colours where its surface is nearest, beside Open3D's closest point."""
    around, across, size, depth = (24, 12, 64, 5) if setup.quick else (1024, 488, 1024, 10)
    source = painted_torus(around, across, size)
    vertices, triangles, _ = torus(around * 15 // 16, across * 15 // 16)
    target = octex.Surface.from_arrays(vertices, triangles)
    report.title(
        f"transfer: {len(source.triangles):,} triangles with an image of {size}² onto {len(triangles):,}, at "
        "the points that a conversion asks for, one thread"
    )
    samples = target.scatter(2000 if setup.quick else 2_000_000)
    order = np.argsort(samples.triangles, kind="stable")
    where = samples.triangles[order], samples.barycentric[order], np.zeros(order.size, np.float32)
    with pinned({setup.core}):
        spent, laid = timed(lambda: target.with_sources(octex.Transfer(source).sources))
        report.line("made ready", spent)
        laid.source.evaluate(*(each[:100] for each in where))
        path = setup.folder / "transfer.npz"
        own, faces, uv = torus(around, across)
        image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
        points = np.asarray(samples.rest[order], np.float32)
        np.savez(path, vertices=own, triangles=faces, uv=uv, image=image, points=points)
        with open3d(setup, report, "look_up", path, core=setup.core) as peer:
            ours = {"octex": lambda: timed(lambda: laid.source.evaluate(*where))[0]}
            found = in_turns({**ours, **peer}, setup.repeats)
    for name, each in found.items():
        report.line(name, f"{order.size / each.cpu / 1e6:.2f} M points/s")
    if "Open3D" in found:
        report.at_least("transfer: of Open3D's rate", found["Open3D"].cpu / found["octex"].cpu, 5)
    convert = partial(octex.convert, target, depth, fit=False)
    works = {"whole": partial(convert, sources=octex.Transfer(source).sources), "bare": convert}
    walls = {name: each.wall for name, each in clocked(setup, works).items()}
    whole = f"{walls['whole']:.2f} s (bare: {walls['bare']:.2f} s)"
    report.line(f"the whole conversion at depth {depth}, as means", whole)


def cloud(setup: Setup, report: Report) -> None:
    """Coloured points, laid on a mesh and by themselves."""
    count, around, across, depth = (5000, 24, 12, 5) if setup.quick else (10_000_000, 1024, 488, 10)
    report.title(
        f"cloud: {count:,} points on {4 * around * across // 2:,} triangles, depth {depth}, all cores"
    )
    surface = painted_torus(around, across, 256)
    samples = surface.scatter(count)
    points, colors, normals = samples.rest, surface.evaluate(samples), samples.normals
    bare = octex.Surface.from_arrays(surface.vertices, surface.triangles)

    def laid() -> octex.OctreeTexture:
        sources = octex.PointCloud(points, colors, normals).sources
        return octex.convert(bare, depth, sources=sources, fit=False)

    def alone() -> octex.OctreeTexture:
        return octex.convert(octex.PointCloud(points, colors, normals), depth)

    found = clocked(setup, {"laid": laid, "alone": alone})
    rate = count / found["laid"].wall / 1e6
    report.at_least("cloud: laid on the mesh, all in", rate, 1, "M points/s")
    report.line("by themselves", f"{count / found['alone'].wall / 1e6:.2f} M points/s")
