"""Benchmark of the whole way: pictures of a model, painted onto its bare mesh, baked, written, read again."""

from __future__ import annotations

from time import perf_counter, process_time

import numpy as np
from measuring import DROID, Report, Setup
from painting import picture_of, ring_around, seen_by

import octex
from octex.channels import linear_to_srgb


def whole(setup: Setup, report: Report) -> None:
    """Twelve pictures of a model, painted onto its bare mesh, baked to a .glb, read back beside the model."""
    size, side, points = (48, 1024, 2_000) if setup.quick else (1024, 2048, 200_000)
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
    truth = _codes(model.evaluate(samples, "base_color")[seen])
    written = setup.folder / "whole.glb"
    spent: dict[str, tuple[float, float]] = {}
    for _ in range(1 if setup.quick else 2):  # the second is warm
        marks = [(perf_counter(), process_time())]
        texture = octex.paint(None, bare, shots)
        marks.append((perf_counter(), process_time()))
        baked = octex.bake(texture, bare, texture_size=side)
        marks.append((perf_counter(), process_time()))
        octex.write_model(baked, written)
        marks.append((perf_counter(), process_time()))
        steps = np.diff(marks, axis=0).tolist()
        spent = {what: tuple(step) for what, step in zip(("painted", "baked", "written"), steps, strict=True)}
    for what, (wall, cpu) in spent.items():
        report.line(f"{name}: {what}", f"{wall:.1f} s, {cpu:.1f} of processors")
    report.line(f"{name}: the texture", f"depth {texture.tree.max_depth}, {texture.tree.n_leaves:,} leaves")
    read = octex.load_surface(written, channels=["base_color"])
    for what, values in (
        ("the texture", texture.sample(samples.rest, normals=samples.normals)),
        (f"{written.stat().st_size / 1e6:.1f} MB .glb", read.evaluate(samples, "base_color")),
    ):
        error = _codes(values[seen]) - truth
        decibels = float(20 * np.log10(255 / np.sqrt((error**2).mean())))
        report.line(f"{name}: {what} at seen points", f"{decibels:.1f} dB")
    report.at_least(f"whole: {name}", decibels, 32, "dB")
    report.at_most(f"whole: {name}", sum(wall for wall, _ in spent.values()), 12, "s")


def _codes(linear: np.ndarray) -> np.ndarray:
    return 255 * linear_to_srgb(np.clip(linear, 0, 1))
