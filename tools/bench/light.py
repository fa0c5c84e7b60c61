"""Benchmark of light models: atlases of meshes that nobody modelled, and what few triangles keep of them."""

from __future__ import annotations

import resource
from typing import NamedTuple

import generated
import numpy as np
import numpy.typing as npt
import trimesh
from measuring import Setup, decibels, line, timed, title

import octex
from octex.baking.atlas import atlas_layout
from octex.baking.layout import Layout, doubled_areas, steps_between
from octex.nearest.triangles import Triangles
from octex.source.corners import area_vectors
from octex.source.mesh import Mesh
from octex.view.shading import corner_normals
from octex.view.zbuffer import z_buffer
from tests.make.painted import codes

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
    triangles: int  # of the light model; 0: only an atlas is made
    size: int  # of its images
    image: int = 512  # pixels along the sides of images


_QUICK = (_Case(3, 24, 300, 128, image=64),)
#: The first is one with which xatlas ends.
_CASES = _Case(6, 131, 0, 1024), _Case(7, 263, 50_000, 2048), _Case(8, 526, 100_000, 4096)


def light(setup: Setup) -> None:
    """Lay out and bake meshes like those of scanners and generators, and compare images of both."""
    title("light: atlases, and models of few triangles, of a noisy ball and of a generated mesh")
    path, depth = setup.folder / "generated.npz", 5 if setup.quick else 10
    for case in _QUICK if setup.quick else _CASES:
        ball = _ball(case.divided)
        np.savez(path, **generated.dual_grid(case.side, _NOISE_OF_CELLS))
        made = octex.load_surface(path, normals=True)
        for name, surface in (("ball", ball), ("generated", made)):
            for by_xatlas in (False, True):
                _atlas(f"{name}, {len(surface.triangles):,}", surface, case.size, by_xatlas=by_xatlas)
        if case.triangles:
            _model(setup, "ball", ball, octex.convert(ball, depth), case)
            _model(setup, "generated", made, octex.convert(path), case)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    line("peak memory of the process", f"{peak:.2f} GB")


def _ball(divided: int) -> octex.Surface:
    ball = trimesh.creation.icosphere(divided)
    noise = _NOISE_OF_EDGES * ball.edges_unique_length.mean()
    noise = 1.0 + noise * np.random.default_rng(0).standard_normal((len(ball.vertices), 1))
    vertices, faces = ball.vertices * noise, np.asarray(ball.faces, np.int32)
    normals = np.empty_like(vertices)
    normals[faces] = corner_normals(vertices, faces, 180.0)
    surface = octex.Surface.from_arrays(vertices, faces, normals=normals)
    return surface.with_sources({"base_color": lambda points: 0.5 + 0.4 * np.sin(9.0 * points)})


def _atlas(name: str, mesh: Mesh, size: int, *, by_xatlas: bool) -> None:
    """Lay a mesh out, by octex or by xatlas if that ends."""
    what = f"{name}, {'xatlas' if by_xatlas else 'octex'}"
    try:
        spent, layout = timed(lambda: atlas_layout(mesh, [size], None, 1e-9, by_xatlas=by_xatlas))
    except octex.OctexError as error:
        line(what, str(error))
        return
    areas = np.bincount(layout.charts, np.abs(doubled_areas(layout.corners)) / 2.0)
    figures = f"{areas.size:,} charts, {(areas < 8).mean():.1%} below 8 texels"
    covered = f"{areas.sum() / size**2:.0%} covered, L2 {_stretch(mesh, layout):.3f}"
    line(what, f"{spent}; {figures}, {covered}")


def _stretch(mesh: Mesh, layout: Layout) -> float:
    """Return the L2 stretch of texture coordinates, 1 at best (Sander et al. 2001)."""
    rest = mesh.rest[mesh.triangles[layout.faces]]
    areas, flat = np.linalg.norm(area_vectors(rest), axis=1), np.abs(doubled_areas(layout.corners))
    right, down = steps_between(rest, layout.corners)
    squares = ((right**2).sum(axis=1) + (down**2).sum(axis=1)) / 2.0
    mapped = flat > 1e-9 * flat.mean()
    mean = (squares * areas)[mapped].sum() / areas[mapped].sum()
    return float(np.sqrt(mean * flat[mapped].sum() / areas[mapped].sum()))


def _model(
    setup: Setup, name: str, surface: octex.Surface, texture: octex.OctreeTexture, case: _Case
) -> None:
    """Make a light model of a surface whose texture is there, and compare both."""
    path = setup.folder / f"{name}-{case.size}.glb"

    def work() -> None:
        made = octex.finish(surface, texture, triangles=case.triangles, texture_size=case.size)
        octex.write_model(made, path, images="jpeg-all")

    spent, _ = timed(work)
    made = octex.load_surface(path, normals=True)
    points = made.scatter(100_000, 1)
    triangles = Triangles.of(surface.rest, surface.triangles)
    nearest = triangles.nearest(points.points, points.normals, least_cosine=0.0)
    wanted = codes(texture.sample(surface.rest_at(nearest.triangles, nearest.barycentric)))
    found = codes(made.evaluate(points))
    wrong = 100.0 * float((np.abs(found - wanted) > _WRONG).any(axis=1).mean())
    lit, off = _images(texture, surface, made, case.image)
    octex.write_model(octex.bake_vertices(texture, surface), path.with_suffix(".ply"))  # for suns.py
    line(f"{name}, {len(surface.triangles):,} → {len(made.triangles):,} triangles, {case.size}²", spent)
    line("  file", f"{path.stat().st_size / 1e6:.1f} MB")
    line("  colours; points of another colour", f"{decibels(found - wanted):.1f} dB; {wrong:.4f} %")
    line("  lit; silhouette", f"{lit:.1f} dB; {off} pixels off")
    if name == "generated":
        far = float(np.percentile(np.abs(generated.distances(points.points)) * case.side, 99.9))
        back = decibels(found - codes(generated.colors(points.points)))
        line("  beside the exact surface (99.9 %) and colours", f"{far:.2f} voxels, {back:.1f} dB")


def _images(
    texture: octex.OctreeTexture, surface: octex.Surface, made: octex.Surface, pixels: int
) -> tuple[float, int]:
    """Return how alike lit images are inside, in dB, and how many pixels apart the silhouettes.

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
