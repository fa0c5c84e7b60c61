"""Benchmarks of light models: atlases of meshes that nobody modelled, and what few triangles keep of them."""

from __future__ import annotations

import resource
from typing import NamedTuple

import generated
import numpy as np
import numpy.typing as npt
import trimesh
from measuring import Report, Setup, codes, decibels, timed

import octex
from octex.baking.atlas import atlas_layout
from octex.baking.layout import Layout, doubled_areas, steps_between
from octex.nearest.triangles import Triangles
from octex.source.corners import area_vectors
from octex.source.mesh import Mesh
from octex.view.shading import corner_normals
from octex.view.zbuffer import z_buffer

Floats = npt.NDArray[np.float64]

#: The vertices of a ball move along its radius by this part of an edge, those of a dual grid by this part of
#: a cell. From two fifths of an edge on, single vertices are spikes, whose shadows no normal map holds.
_NOISE_OF_EDGES, _NOISE_OF_CELLS = 0.21, 0.1
_SAMPLES = 4
#: Points that differ by more of 255 show another part of the surface.
_WRONG = 32.0


class _Case(NamedTuple):
    """A mesh, and what is made of it."""

    divided: int  # how often the ball's triangles are
    side: int  # of the dual grid with about as many triangles
    atlas_seconds: float
    triangles: int  # of the light model
    size: int  # of its images
    seconds: float
    megabytes: float | None
    picture: int = 512  # pixels along the sides of pictures


_CASES = _Case(7, 263, 6.0, 50_000, 2048, 25.0, 8.0), _Case(8, 526, 25.0, 100_000, 4096, 60.0, None)
_QUICK = (_Case(3, 32, 6.0, 500, 256, 25.0, 8.0, picture=128),)
#: A ball, a dual grid and a map with which xatlas ends.
_BESIDE = _Case(6, 131, 6.0, 0, 1024, 0.0, None)


def light(setup: Setup, report: Report) -> None:
    """Lay out and bake meshes like those of scanners and generators, and compare pictures of both."""
    report.title("light: atlases, and models of few triangles, of a noisy ball and of a generated mesh")
    path = setup.folder / "generated.npz"
    for case in _QUICK if setup.quick else (_BESIDE, *_CASES):
        depth = 5 if setup.quick else 10
        ball = _ball(case.divided)
        np.savez(path, **generated.dual_grid(case.side, _NOISE_OF_CELLS))
        made = octex.load_surface(path, normals=True)
        for name, surface in (("ball", ball), ("generated", made)):
            _atlases(report, f"{name}, {len(surface.triangles):,}", surface, case)
        if case is _BESIDE:
            continue
        _models(setup, report, "ball", ball, octex.convert(ball, depth), case)
        _models(setup, report, "generated", made, octex.convert(path), case)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    report.at_most("light: peak memory of the process", peak, 4.0, "GB")


def _ball(divided: int) -> octex.Surface:
    ball = trimesh.creation.icosphere(divided)
    noise = _NOISE_OF_EDGES * ball.edges_unique_length.mean()
    noise = 1.0 + noise * np.random.default_rng(0).standard_normal((len(ball.vertices), 1))
    vertices, faces = ball.vertices * noise, np.asarray(ball.faces, np.int32)
    normals = np.empty_like(vertices)
    normals[faces] = corner_normals(vertices, faces, 180.0)
    surface = octex.Surface.from_arrays(vertices, faces, normals=normals)
    return surface.with_sources({"base_color": lambda points: 0.5 + 0.4 * np.sin(9.0 * points)})


def _atlases(report: Report, name: str, mesh: Mesh, case: _Case) -> None:
    """Lay a mesh out: by octex, and by xatlas where that ends."""
    for by_xatlas in (False, True):
        what = f"{name}, {'xatlas' if by_xatlas else 'octex'}"
        try:
            spent, layout = timed(lambda: atlas_layout(mesh, [case.size], None, 1e-9, by_xatlas=by_xatlas))  # noqa: B023
        except octex.OctexError as error:
            report.line(what, str(error))
            continue
        areas = np.bincount(layout.charts, np.abs(doubled_areas(layout.corners)) / 2.0)
        small, coverage = float((areas < 8).mean()), float(areas.sum()) / case.size**2
        stretch = _stretch(mesh, layout)
        figures = (
            f"{areas.size:,} charts, {small:.1%} below 8 texels, {coverage:.0%} covered, L2 {stretch:.3f}"
        )
        report.line(what, f"{spent}; {figures}")
        if not by_xatlas and case is not _BESIDE:
            report.at_most(f"light: atlas, {what}", spent.wall, case.atlas_seconds, "s")
            report.at_most(f"light: atlas, {what}, charts below 8 texels", 100.0 * small, 10.0, "%")
            report.at_least(f"light: atlas, {what}, covered", 100.0 * coverage, 60.0, "%")
            report.at_most(f"light: atlas, {what}, stretch", stretch, 1.15)


def _stretch(mesh: Mesh, layout: Layout) -> float:
    """Return the L2 stretch of texture coordinates, 1 at best (Sander et al. 2001)."""
    rest = mesh.rest[mesh.triangles[layout.faces]]
    areas, flat = np.linalg.norm(area_vectors(rest), axis=1), np.abs(doubled_areas(layout.corners))
    right, down = steps_between(rest, layout.corners)
    squares = ((right**2).sum(axis=1) + (down**2).sum(axis=1)) / 2.0
    mapped = flat > 1e-9 * flat.mean()
    mean = (squares * areas)[mapped].sum() / areas[mapped].sum()
    return float(np.sqrt(mean * flat[mapped].sum() / areas[mapped].sum()))


def _models(
    setup: Setup, report: Report, name: str, surface: octex.Surface, texture: octex.OctreeTexture, case: _Case
) -> None:
    """Make a light model of a surface whose texture is there, and compare both."""
    path = setup.folder / f"{name}-{case.size}.glb"

    def work() -> None:
        made = octex.finish(surface, texture, triangles=case.triangles, texture_size=case.size)
        octex.write_model(made, path, images="jpeg-all")

    spent, _ = timed(work)
    made = octex.load_surface(path, normals=True)
    points = made.scatter(100_000, 1)
    nearest = Triangles.of(surface.rest, surface.triangles).nearest(
        points.points, points.normals, least_cosine=0.0
    )
    wanted = codes(texture.sample(surface.rest_at(nearest.triangles, nearest.barycentric)))
    errors = codes(made.evaluate(points)) - wanted
    colors, wrong = decibels(errors), float((np.abs(errors) > _WRONG).any(axis=1).mean())
    lit, off = _pictures(texture, surface, made, case.picture)
    octex.write_model(octex.bake_vertices(texture, surface), path.with_suffix(".ply"))  # for suns.py
    what = f"{name}, {len(surface.triangles):,} → {len(made.triangles):,} triangles, {case.size}²"
    megabytes = path.stat().st_size / 1e6
    figures = f"{megabytes:.1f} MB, colours {colors:.1f} dB, lit {lit:.1f} dB, {off} pixels"
    report.line(what, f"{spent}; {figures}")
    report.at_most(f"light: {what}", spent.wall, case.seconds, "s")
    if case.megabytes is not None:
        report.at_most(f"light: {what}, file", megabytes, case.megabytes, "MB")
    report.at_least(f"light: {what}, colours", colors, 38.0, "dB")
    report.at_most(f"light: {what}, points of another colour", 100.0 * wrong, 0.002, "%")
    report.at_least(f"light: {what}, lit", lit, 32.0, "dB")
    report.at_most(f"light: {what}, silhouette", off, 1.0, "pixels")
    if name == "generated":
        from_surface = np.abs(generated.distances(points.points)) * case.side
        back = decibels(codes(made.evaluate(points)) - codes(generated.colors(points.points)))
        far = float(np.percentile(from_surface, 99.9))
        report.at_most(f"light: {what}, from the exact surface (99.9 %)", far, 1.0, "voxels")
        report.at_least(f"light: {what}, beside the exact colours", back, 40.0, "dB")


def _pictures(
    texture: octex.OctreeTexture, surface: octex.Surface, made: octex.Surface, pixels: int
) -> tuple[float, int]:
    """Return how alike lit pictures are inside, in dB, and how many pixels apart the silhouettes.

    A pixel is in a silhouette if half of it is covered.
    """
    direction, studio = (1.0, 0.4, 0.7), octex.Environment.studio()
    camera, fine = (
        octex.Camera.fitted(surface.vertices, direction=direction, size=(size, size))
        for size in (pixels, pixels * _SAMPLES)
    )
    both = [octex.render(*each, camera, light=studio) for each in ((texture, surface), (None, made))]
    covers = [_covered(each, fine, pixels) for each in (surface, made)]
    inside = np.minimum(*covers) == 1.0
    masks = [each >= 0.5 for each in covers]
    off = max(_apart(*masks), _apart(*masks[::-1]))
    return decibels(both[0][inside].astype(np.float64) - both[1][inside]), off


def _covered(surface: octex.Surface, fine: octex.Camera, pixels: int) -> Floats:
    """Return how much of each pixel a surface covers."""
    seen = z_buffer(surface.vertices, surface.triangles, fine).triangle >= 0
    return np.asarray(seen.reshape(pixels, _SAMPLES, pixels, _SAMPLES).mean(axis=(1, 3)))


def _apart(one: npt.NDArray[np.bool_], other: npt.NDArray[np.bool_]) -> int:
    """Return by how many pixels one mask must be widened to hold another."""
    for pixels in range(len(one)):
        if not (other & ~one).any():
            return pixels
        rows = np.pad(one, 1)
        rows = rows[:-2] | rows[1:-1] | rows[2:]
        one = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return len(one)
