"""Benchmarks of painting: what a ring of pictures gives back, and what a picture costs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from disturbed import Points, Ring, disturbed
from inputs import painted_torus, torus
from measuring import DROID, Report, Setup, clocked, codes, decibels, open3d, timed

import octex
from octex.drawing.hits import rest_normals, visible_hits
from octex.drawing.shaders import source_shader
from octex.view.zbuffer import z_buffer

Array = npt.NDArray[Any]

#: Where the cameras of the ring stand above or below the middle, in radians; two look along the axis.
_HEIGHTS = (0.5, -0.35, 0.15, 0.5, 1.35, 0.15, 0.5, -0.35, 0.15, 0.5, -1.35, 0.15)
_MAX_ANGLE = 75.0


def ring(setup: Setup, report: Report) -> None:
    """Twelve pictures of a model painted onto its bare mesh, as they are and disturbed."""
    size, points = (24, 500) if setup.quick else (1024, 200_000)
    report.title(
        f"ring: 12 pictures of {size}² pixels, unlit, painted onto the bare mesh; cells as wide as pixels"
    )
    for name, surface in _models(setup, report):
        cameras = ring_around(surface, size)
        pictures = [picture_of(surface, camera) for camera in cameras]
        widths = [
            hits.width
            for camera in cameras
            for _, hits in visible_hits(surface, camera, rest_normals(surface))
        ]
        width = float(np.concatenate(widths).mean())
        depth = int(np.round(np.log2(np.ptp(surface.bounds, axis=0).max() / width)))
        samples = surface.scatter(points, seed=3)
        each = np.stack([seen_by(surface, [camera], samples) for camera in cameras])
        seen = each.any(axis=0)
        truth = codes(octex.convert(surface, depth).sample(samples.rest, normals=samples.normals))
        given = Ring(pictures, cameras)
        spent, texture = timed(lambda: octex.paint(None, surface, given.projections(), max_depth=depth))  # noqa: B023
        error = codes(texture.sample(samples.rest, normals=samples.normals)) - truth
        found = decibels(error[seen])
        painted = texture.contains(samples.rest)
        report.line(
            f"{name}, depth {depth}", f"{found:.1f} dB, {spent.wall:.1f} s, {texture.tree.n_leaves:,} leaves"
        )
        report.at_least(f"ring: {name}", found, 34, "dB")
        report.at_most(f"ring: {name}, not painted", 100 * float((~painted[seen]).mean()), 0.5, "%")
        disturbed(report, name, surface, given, depth, Points(samples, truth, each))


def painting(setup: Setup, report: Report) -> None:
    """One picture onto a large model, and a small one onto a large texture."""
    around, across, depth, size = (60, 30, 6, (192, 108)) if setup.quick else (1024, 512, 10, (1920, 1080))
    surface = painted_torus(around, across, 256)
    count = len(surface.triangles)
    report.title(f"painting: {count:,} triangles, depth {depth}, two threads, wall time")
    texture = octex.convert(surface, depth)
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.5, 1.0), size=size)
    image = picture_of(surface, camera)
    shot = octex.Projection(image, camera)
    for what, fit, target in (("as means", False, 1.5), ("fitted", True, 2.5)):
        spent = _median(setup, lambda fit=fit: octex.paint(texture, surface, shot, max_depth=depth, fit=fit))
        report.at_most(f"painting: {size[0]}×{size[1]}, {what}", spent, target, "s")
    middle = surface.vertices[np.argmax(surface.vertices @ [0.3, 0.5, 1.0])]
    patch = octex.Camera.fitted(
        middle + 0.08 * (np.random.default_rng(0).random((50, 3)) - 0.5), (0.3, 0.5, 1.0), size=(256, 256)
    )
    brush = octex.Projection(np.full((256, 256, 3), 128, np.uint8), patch)
    spent = _median(setup, lambda: octex.paint(texture, surface, brush, max_depth=depth))
    report.line("leaves of the texture", f"{texture.tree.n_leaves:,}")
    report.at_most("painting: a brush of 256² pixels", spent, 0.25, "s")
    _strokes(setup, report)
    _beside_open3d(setup, report, depth)


def _strokes(setup: Setup, report: Report) -> None:
    """Strokes of a session, on cells as wide as the texture's and finer."""
    around, across, depth = (24, 12, 6) if setup.quick else (103, 52, 9)
    surface = painted_torus(around, across, 256)
    texture = octex.convert(surface, depth)
    report.line(f"strokes on {len(surface.triangles):,} triangles, leaves", f"{texture.tree.n_leaves:,}")
    for what, finer, target in (
        ("at its own depth", 0, 0.05),
        ("one finer", 1, 0.10),
        ("two finer", 2, 0.25),
    ):
        brush = _brush(surface, 1.1 * texture.placement.size / 2 ** (depth + finer))
        painter = octex.Painter(texture, surface)
        spent = _median(setup, lambda painter=painter, brush=brush: (painter.paint(brush), painter.undo()))
        report.at_most(f"painting: a brush of 128² pixels, {what}", spent, target, "s")
        painter.paint(brush)
        more = painter.texture().tree.n_leaves - texture.tree.n_leaves
        pixels = np.count_nonzero(np.asarray(brush.image)[..., 3])
        report.at_most(f"painting: leaves a pixel, {what}", more / pixels, 6.0 if finer else 2.0, "")
    spent = _median(setup, lambda: (painter.paint(brush), painter.undo()))
    report.at_most("painting: a brush of 128² pixels, two finer, again", spent, 0.05, "s")
    brush = _brush(surface, 1.1 * texture.placement.size / 2**depth)
    painter = octex.Painter(texture, surface)
    alone, spent = (
        _median(setup, lambda each=each: (painter.paint(each), painter.undo()))
        for each in (brush, _on_layer(brush, 256 if setup.quick else 1024))
    )
    report.at_most(
        "painting: a stroke on a transparent 1024² layer beside it cropped", spent / alone, 1.1, "×"
    )


def _brush(surface: octex.Surface, pixel: float) -> octex.Projection:
    """Return a soft disc of 128² pixels, each so wide, on the part of a surface nearest to a camera."""
    toward = np.array([0.3, 0.5, 1.0]) / np.linalg.norm([0.3, 0.5, 1.0])
    middle = surface.vertices[np.argmax(surface.vertices @ toward)]
    across = np.cross(toward, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    along = np.cross(toward, across)
    corners = [middle + 64 * pixel * (x * across + y * along) for x in (-1, 1) for y in (-1, 1)]
    y, x = np.mgrid[:128, :128] - 63.5
    image = np.full((128, 128, 4), (200, 40, 90, 255), np.uint8)
    image[..., 3] = np.clip(25.5 * (60 - np.hypot(x, y)), 0, 255)
    return octex.Projection(image, octex.Camera.fitted(np.array(corners), tuple(toward), size=(128, 128)))


def _on_layer(brush: octex.Projection, size: int) -> octex.Projection:
    """Return the same picture in the middle of a transparent one."""
    picture, camera = np.asarray(brush.image), brush.camera
    assert isinstance(camera, octex.Camera)
    first = (size - len(picture)) // 2
    image = np.zeros((size, size, 4), np.uint8)
    image[first : first + len(picture), first : first + len(picture)] = picture
    K = camera.K + np.array([[0, 0, first], [0, 0, first], [0, 0, 0]])
    larger = octex.Camera.pinhole((size, size), pose=camera.world_to_camera, convention="opencv", K=K)
    return octex.Projection(image, larger)


def _beside_open3d(setup: Setup, report: Report, depth: int) -> None:
    """Paint a picture onto 100 k triangles; Open3D projects it into an image of 2048² texels."""
    if setup.quick:
        return
    vertices, triangles, uv = torus(316, 158)
    surface = octex.Surface.from_arrays(vertices, triangles)
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.5, 1.0), size=(1920, 1080))
    image = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3), np.uint8)
    path = setup.folder / "paint.npz"
    np.savez(
        path, vertices=vertices, triangles=triangles.astype(np.int64), uv=uv, image=image,
        intrinsic=camera.K, extrinsic=camera.world_to_camera,
    )  # fmt: skip
    texture = octex.convert(surface, depth)
    shot = octex.Projection(image, camera)
    ours = _median(setup, lambda: octex.paint(texture, surface, shot, max_depth=depth))
    report.line(f"onto {len(triangles):,} triangles, fitted", f"{ours:.2f} s")
    with open3d(setup, report, "paint", path) as peer:
        for name, work in peer.items():
            theirs = work().wall
            ratio = f"octex {theirs / ours:.1f} × as fast"
            report.line(f"{name}, into an image of 2048²", f"{theirs:.2f} s: {ratio}")


def _median(setup: Setup, work: Any) -> float:
    return clocked(setup, {"": work})[""].wall


def _models(setup: Setup, report: Report) -> Iterator[tuple[str, octex.Surface]]:
    if setup.quick:
        yield "torus", painted_torus(24, 12, 64)
        return
    yield "droid", octex.load_surface(DROID, channels=["base_color"])
    if setup.models is None:
        report.note("left out: real models (--models)")
        return
    for name, path in (
        ("spot", "spot-triangulated/spot.obj"),
        ("BoomBox", "BoomBoxWithAxes/BoomBoxWithAxes.gltf"),
    ):
        yield name, octex.load_surface(setup.models / path, channels=["base_color"])


def ring_around(surface: octex.Surface, size: int) -> list[octex.Camera]:
    turns = 2 * np.pi * np.arange(12) / 12
    return [
        octex.Camera.fitted(
            surface.vertices,
            (np.cos(turn) * np.cos(height), np.sin(height), np.sin(turn) * np.cos(height)),
            size=(size, size),
        )
        for turn, height in zip(turns, _HEIGHTS, strict=True)
    ]


def picture_of(surface: octex.Surface, camera: octex.Camera) -> Array:
    """Draw a surface unlit, 2 × 2 samples a pixel: linear light, and alpha where it is seen."""
    fine = camera.scaled(2)
    image = np.zeros((fine.height * fine.width, 4), np.float32)
    look = source_shader(surface, "base_color")
    for pixels, hits in visible_hits(surface, fine, rest_normals(surface)):
        image[pixels, :3], image[pixels, 3] = look(hits).unlit(), 1
    image = image.reshape(camera.height, 2, camera.width, 2, 4).sum((1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1)
    image[..., 3] = image[..., 3] > 0
    return image


def seen_by(surface: octex.Surface, cameras: list[octex.Camera], samples: Any) -> npt.NDArray[np.bool_]:
    """Say which samples a camera sees, by the triangles in a picture of three times its size."""
    found = np.zeros(len(samples.points), np.bool_)
    for camera in cameras:
        fine = camera.scaled(3)
        triangles = z_buffer(surface.vertices, surface.triangles, fine).triangle
        places, _ = fine.project(samples.points)
        i, j = np.clip(places.astype(np.int64), 0, [fine.width - 1, fine.height - 1]).T
        toward = camera.position - samples.points
        cosines = np.einsum("nk,nk->n", toward, samples.normals) / np.linalg.norm(toward, axis=1)
        found |= (triangles[j, i] == samples.triangles) & (cosines > np.cos(np.radians(_MAX_ANGLE)))
    return found
