"""Benchmark of the whole way: pictures of a model, painted onto its bare mesh, baked, written, read again."""

from __future__ import annotations

from functools import partial

from measuring import DROID, Report, Setup, codes, decibels, timed
from painting import picture_of, ring_around, seen_by

import octex


def whole(setup: Setup, report: Report) -> None:
    """Twelve pictures of a model, painted onto its bare mesh, baked to a .glb, read back beside the model."""
    size, side, points = (24, 256, 500) if setup.quick else (1024, 2048, 200_000)
    report.title(f"whole: 12 pictures of {size}² pixels painted onto the bare mesh, baked {side}², as a .glb")
    path, name = DROID, "droid"
    if setup.models is not None and not setup.quick:
        path, name = setup.models / "BoomBoxWithAxes" / "BoomBoxWithAxes.gltf", "BoomBox"
    model = octex.load_surface(path, channels=["base_color"])
    bare = octex.Surface.from_arrays(model.vertices, model.triangles)
    cameras = ring_around(model, size)
    shots = [octex.Projection(picture_of(model, camera), camera) for camera in cameras]
    samples = model.scatter(points, seed=3)
    seen = seen_by(model, cameras, samples)
    truth = codes(model.evaluate(samples, "base_color")[seen])
    written = setup.folder / "whole.glb"
    spent = {}
    for _ in range(1 if setup.quick else 2):  # the second is warm
        spent["painted"], texture = timed(lambda: octex.paint(None, bare, shots))
        spent["baked"], baked = timed(partial(octex.bake, texture, bare, texture_size=side))
        spent["written"], _ = timed(partial(octex.write_model, baked, written))
    for what, each in spent.items():
        report.line(f"{name}: {what}", f"{each.wall:.1f} s, {each.cpu:.1f} of processors")
    report.line(f"{name}: the texture", f"depth {texture.tree.max_depth}, {texture.tree.n_leaves:,} leaves")
    read = octex.load_surface(written, channels=["base_color"])
    for what, values in (
        ("the texture", texture.sample(samples.rest, normals=samples.normals)),
        (f"{written.stat().st_size / 1e6:.1f} MB .glb", read.evaluate(samples, "base_color")),
    ):
        level = decibels(codes(values[seen]) - truth)
        report.line(f"{name}: {what} at seen points", f"{level:.1f} dB")
    report.at_least(f"whole: {name}", level, 32, "dB")
    report.at_most(f"whole: {name}", sum(each.wall for each in spent.values()), 12, "s")
