"""Benchmarks of painting: what a ring of images gives back, what an image costs, and processing."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from disturbed import Points, Ring, disturbed
from inputs import painted_torus, sphere_texture, torus
from measuring import Setup, clocked, colors_of, decibels, line, note, open3d, table, timed, title

import octex
from octex.drawing.hits import visible_hits
from octex.photos import refine
from octex.view.zbuffer import z_buffer
from tests.make import painted

Array = npt.NDArray[Any]

#: Where the cameras of the ring stand above or below the middle, in radians; two look along the axis.
_HEIGHTS = (0.5, -0.35, 0.15, 0.5, 1.35, 0.15, 0.5, -0.35, 0.15, 0.5, -1.35, 0.15)
_MAX_ANGLE = 75.0
_TOWARD = (0.3, 0.5, 1.0)


def ring(setup: Setup) -> None:
    """Twelve images of a model painted onto its bare mesh, as they are and disturbed."""
    size, count = (24, 500) if setup.quick else (1024, 200_000)
    title(f"ring: 12 images of {size}² pixels, unlit, painted onto the bare mesh; cells as wide as pixels")
    for constant in ("_POINTS", "_COARSE", "_TELLING", "_MOST", "_TRIES") if setup.quick else ():
        setattr(refine, constant, getattr(refine, constant) // 20)
    for name, surface in _models(setup):
        cameras = _around(setup, surface, size)
        images = [_image(surface, camera) for camera in cameras]
        hits = [each for c in cameras for _, each in visible_hits(surface, c)]
        width = float(np.concatenate([each.width for each in hits]).mean())
        depth = int(np.round(np.log2(np.ptp(surface.bounds, axis=0).max() / width)))
        samples = surface.scatter(count, seed=3)
        seen_by = np.stack([_seen(surface, camera, samples) for camera in cameras])
        seen = seen_by.any(axis=0)
        truth = painted.codes(octex.convert(surface, depth).sample(samples.rest, normals=samples.normals))
        given, rows = Ring(images, cameras), []
        for mode in ("average", "robust", "best"):
            paint = partial(octex.paint, None, surface, given.projections(), max_depth=depth, pictures=mode)
            spent, texture = timed(paint)
            found = painted.codes(texture.sample(samples.rest, normals=samples.normals))
            missed = 100 * float((~texture.contains(samples.rest))[seen].mean())
            level = f"{decibels((found - truth)[seen]):.1f}"
            rows.append([mode, level, f"{missed:.2f} %", f"{texture.tree.n_leaves:,}", spent])
        table([f"{name}, depth {depth}", "dB", "left out", "leaves", "time"], rows)
        disturbed(setup, name, surface, given, depth, Points(samples, truth, seen_by))


def _models(setup: Setup) -> Iterator[tuple[str, octex.Surface]]:
    if setup.quick:
        yield "torus", painted_torus(24, 12, 64)
        return
    for name, path, _ in setup.models():
        if name in ("droid", "spot", "BoomBoxWithAxes"):
            yield name, colors_of(path)


def whole(setup: Setup) -> None:
    """Twelve images of a model, painted onto its bare mesh, baked to a .glb, read back beside the model."""
    size, side, count = (24, 256, 500) if setup.quick else (1024, 2048, 200_000)
    title(f"whole: 12 images of {size}² pixels painted onto the bare mesh, baked {side}², as a .glb")
    name, path, _ = next(
        (each for each in setup.models() if each[0].startswith("BoomBox")), next(setup.models())
    )
    model = colors_of(path)
    bare = octex.Surface.from_arrays(model.vertices, model.triangles)
    cameras = _around(setup, model, size)
    shots = [octex.Projection(_image(model, camera), camera) for camera in cameras]
    written = setup.folder / "whole.glb"
    for _ in range(1 if setup.quick else 2):  # the second is warm
        paint, texture = timed(lambda: octex.paint(None, bare, shots))
        bake, baked = timed(partial(octex.bake, texture, bare, texture_size=side))
        write, _ = timed(partial(octex.write_model, baked, written))
    for what, each in (("painted", paint), ("baked", bake), ("written", write)):
        line(f"{name}: {what}", each)
    samples = model.scatter(count, seed=3)
    seen = np.any([_seen(model, camera, samples) for camera in cameras], axis=0)
    truth = painted.codes(model.evaluate(samples, "base_color")[seen])
    for what, values in (
        ("the texture", texture.sample(samples.rest, normals=samples.normals)),
        (f"{written.stat().st_size / 1e6:.1f} MB .glb", colors_of(written).evaluate(samples, "base_color")),
    ):
        level = decibels(painted.codes(values[seen]) - truth)
        line(f"{name}: {what} at seen points", f"{level:.1f} dB")


def painting(setup: Setup) -> None:
    """One image onto a large model, and a small one onto a large texture; wall time."""
    around, across, depth, size = (60, 30, 6, (192, 108)) if setup.quick else (1024, 512, 10, (1920, 1080))
    surface = painted_torus(around, across, 256)
    texture = octex.convert(surface, depth)
    title(f"painting: {len(surface.triangles):,} triangles, {texture.tree.n_leaves:,} leaves, all cores")
    camera = octex.Camera.fitted(surface.vertices, _TOWARD, size=size)
    shot = octex.Projection(_image(surface, camera), camera)
    middle = surface.vertices[np.argmax(surface.vertices @ _TOWARD)]
    corners = middle + 0.08 * (np.random.default_rng(0).random((50, 3)) - 0.5)
    patch = octex.Camera.fitted(corners, _TOWARD, size=(256, 256))
    brush = octex.Projection(np.full((256, 256, 3), 128, np.uint8), patch)
    paint = partial(octex.paint, texture, surface, max_depth=depth)
    works = {
        f"{size[0]} × {size[1]}, averages": partial(paint, shot, fit=False),
        f"{size[0]} × {size[1]}, fitted": partial(paint, shot),
        "a brush of 256² pixels": partial(paint, brush),
    }
    for what, each in clocked(setup, works).items():
        line(what, each)
    if not setup.quick:
        _beside_open3d(setup, depth)


def _beside_open3d(setup: Setup, depth: int) -> None:
    """Paint an image onto 100 k triangles; Open3D projects it into an image of 2048² texels."""
    vertices, triangles, uv = torus(316, 158)
    surface = octex.Surface.from_arrays(vertices, triangles)
    camera = octex.Camera.fitted(surface.vertices, _TOWARD, size=(1920, 1080))
    image = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3), np.uint8)
    texture, shot = octex.convert(surface, depth), octex.Projection(image, camera)
    ours = clocked(setup, {"": lambda: octex.paint(texture, surface, shot, max_depth=depth)})[""].wall
    line(f"onto {len(triangles):,} triangles, fitted", f"{ours:.2f} s")
    arrays = {"vertices": vertices, "triangles": triangles.astype(np.int64), "uv": uv, "image": image}
    arrays |= {"intrinsic": camera.K, "extrinsic": camera.world_to_camera}
    with open3d(setup, "paint", **arrays) as peer:
        for name, work in peer.items():
            theirs = work().wall
            note(f"{name}, into an image of 2048²: {theirs:.2f} s: octex {theirs / ours:.1f} × as fast")


def processing(setup: Setup) -> None:
    """Values changed, and two large textures in one; with averages."""
    first, second = (sphere_texture(5 if setup.quick else 10, middle) for middle in (0.5, 0.55))
    title(f"processing: cells around spheres, {first.tree.n_leaves:,} leaves each, all cores")
    works = {
        "levels": lambda: octex.levels(first, gamma=1.5),
        "map of a function": lambda: octex.map(first, lambda light: 0.5 * light),
        "combined": lambda: octex.combine(first, second),
        "mixed": lambda: octex.mix(first, second, 0.3),
    }
    for what, each in clocked(setup, works).items():
        line(what, each)


def _around(setup: Setup, surface: octex.Surface, size: int) -> list[octex.Camera]:
    turns = zip(2 * np.pi * np.arange(12) / 12, _HEIGHTS, strict=True)
    toward = [(np.cos(t) * np.cos(up), np.sin(up), np.sin(t) * np.cos(up)) for t, up in turns]
    chosen = toward[::4] if setup.quick else toward
    return [octex.Camera.fitted(surface.vertices, each, size=(size, size)) for each in chosen]


def _image(surface: octex.Surface, camera: octex.Camera) -> Array:
    """Draw a surface unlit, 2 × 2 samples a pixel: linear light, and alpha where it is seen."""
    fine = painted.image_of(surface, camera.scaled(2))
    image = fine.reshape(camera.height, 2, camera.width, 2, 4).sum((1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1)
    image[..., 3] = image[..., 3] > 0
    return image


def _seen(surface: octex.Surface, camera: octex.Camera, samples: Any) -> npt.NDArray[np.bool_]:
    """Say which samples a camera sees, by the triangles in an image of three times its size."""
    fine = camera.scaled(3)
    triangles = z_buffer(surface.vertices, surface.triangles, fine).triangle
    places, _ = fine.project(samples.points)
    i, j = np.clip(places.astype(np.int64), 0, [fine.width - 1, fine.height - 1]).T
    toward = fine.position - samples.points
    cosines = np.einsum("nk,nk->n", toward, samples.normals) / np.linalg.norm(toward, axis=1)
    return (triangles[j, i] == samples.triangles) & (cosines > np.cos(np.radians(_MAX_ANGLE)))
