"""What a camera sees of points between its pixels' centres, beside rays against every triangle."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from octex.channels import BASE_COLOR
from octex.painting.pictures import Projection
from octex.painting.projected import Projected, stretches_of, take_shot, terms_of
from octex.parallel import threads
from octex.source.surface import Surface
from octex.view.camera import Camera
from octex.view.visibility import distances_to_edges, look, straight, view_of
from tests.painted import above, ball, one_color, plain, square, together

Array = npt.NDArray[Any]


def seen(surface: Surface, camera: Camera, triangles: Array, barycentric: Array, **terms: Any) -> Array:
    """Coverage of points under a white picture."""
    white = Projection(one_color(camera, (1, 1, 1)), camera)
    with threads(1) as pool:
        feather = terms.get("feather", 0.0)
        shot = take_shot(white, BASE_COLOR, surface.vertices, surface.triangles, feather, 1.0, pool)
    source = Projected(
        [shot],
        BASE_COLOR,
        terms_of(terms.get("max_angle", 90.0), terms.get("feather", 0.0), terms.get("back_faces", False)),
        surface.vertices,
        surface.triangles,
        stretches_of(surface.vertices, surface.rest, surface.triangles),
    )
    return source.evaluate(triangles.astype(np.int32), barycentric, np.zeros(len(triangles), np.float32))[
        :, 3
    ]


def unhidden(surface: Surface, eye: Array, points: Array, own: Array) -> Array:
    """Whether no triangle lies between a camera and points: all are tried (Möller and Trumbore)."""
    free = np.ones(len(points), bool)
    a, b, c = (surface.vertices[surface.triangles[:, n]] for n in range(3))
    for n, point in enumerate(points):
        ray = point - eye
        p = np.cross(ray, c - a)
        det = np.einsum("nx,nx->n", b - a, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("nx,nx->n", eye - a, p) / det
            q = np.cross(eye - a, b - a)
            v = q @ ray / det
            t = np.einsum("nx,nx->n", c - a, q) / det
            hit = (u > 1e-9) & (v > 1e-9) & (u + v < 1 - 1e-9) & (t > 1e-9) & (t < 1 - 1e-6)
        hit[own[n]] = False
        free[n] = not hit.any()
    return free


@pytest.mark.parametrize("seed", [0, 1])
def test_points_are_seen_as_rays_see_them_but_beside_edges(seed: int) -> None:
    random = np.random.default_rng(seed)
    blobs = []
    for middle in ((-0.6, -0.6, 0.6), (0.6, 0.5, -0.6), (-0.5, 0.6, -0.6), (0.1, 0.0, 0.55)):
        one = ball(8, 0.5)
        blobs.append((one.vertices * random.uniform(0.4, 1, 3) + middle, one.triangles))
    surface = plain(together(*blobs))
    camera = Camera.fitted(surface.vertices, random.normal(size=3), size=(96, 80))
    samples = surface.scatter(3000, seed)
    found = seen(surface, camera, samples.triangles, samples.barycentric)
    eye = camera.position
    faces = np.einsum("nx,nx->n", samples.normals, eye - samples.points) > 0
    expected = faces & unhidden(surface, eye, samples.points, samples.triangles)
    assert (found[~faces] == 0).all()
    wrong = (found > 0.5) != expected
    pixels, _ = camera.project(samples.points)
    margins = distances_to_edges(look(surface.vertices, surface.triangles, camera)[0], view_of(camera), 9.0)
    near_edge = margins[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] < 2.5
    assert not wrong[~near_edge].any()
    assert wrong.mean() < 0.03
    assert expected.mean() > 0.15


@pytest.mark.parametrize("gap", [1.0, 0.1, 0.01])
def test_the_nearer_of_two_close_sheets_hides_the_other(gap: float) -> None:
    camera = above(size=64)
    pixel = 3.0 / 128
    surface = plain(together(square(), square(-gap * pixel * 2)))
    middles = np.full((len(surface.triangles), 3), 1 / 3)
    found = seen(surface, camera, np.arange(len(surface.triangles)), middles)
    front = len(surface.triangles) // 2
    assert (found[:front] == 1).all()
    inner = np.abs(surface.vertices[surface.triangles[front:]].mean(axis=1)[:, :2]).max(axis=1) < 0.4
    assert (found[front:][inner] == 0).all()


def test_a_crease_is_seen_right_into_its_corner() -> None:
    floor, wall = square(), square()
    wall = wall[0][:, [0, 2, 1]] * [1, 1, 1] + [0, 0.0, 0.5], wall[1][:, ::-1]
    surface = plain(together(floor, wall))
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, np.cos(0.7), np.sin(0.7)], [0, -np.sin(0.7), np.cos(0.7)]]).T
    pose[:3, 3] = pose[:3, 2] * 4
    camera = Camera.pinhole((128, 128), pose=pose, convention="opengl", focal=300.0)
    samples = surface.scatter(4000, 3)
    eye = camera.position
    faces = np.einsum("nx,nx->n", samples.normals, eye - samples.points) > 0.2
    expected = faces & unhidden(surface, eye, samples.points, samples.triangles)
    beside = expected & (np.abs(samples.points[:, 1]) < 0.01) & (samples.points[:, 2] < 0.4)
    pixels, _ = camera.project(samples.points)
    beside &= ((pixels > 2) & (pixels < 126)).all(axis=1) & (np.abs(samples.points[:, 0]) < 0.45)
    assert beside.sum() > 10
    assert (seen(surface, camera, samples.triangles, samples.barycentric)[beside] > 0.5).all()


def test_paint_fades_at_grazing_angles() -> None:
    surface, camera = ball(), above(4.0, 200)
    samples = surface.scatter(5000, 1)
    toward = camera.position - samples.points
    cosine = np.einsum("nx,nx->n", samples.normals, toward) / np.linalg.norm(toward, axis=1)
    angles = np.degrees(np.arccos(cosine))
    found = seen(surface, camera, samples.triangles, samples.barycentric, max_angle=60.0)
    assert (found[angles > 60] == 0).all()
    assert (found[angles < 49.9] == 1).all()
    between = (angles > 52) & (angles < 58)
    assert (found[between] > 0).all()
    assert (found[between] < 1).all()


def test_back_faces_are_painted_only_if_asked_for() -> None:
    points, triangles = square()
    surface = plain((points, triangles[:, ::-1]))
    middles = np.full((len(triangles), 3), 1 / 3)
    assert (seen(surface, above(), np.arange(len(triangles)), middles) == 0).all()
    assert (seen(surface, above(), np.arange(len(triangles)), middles, back_faces=True) == 1).all()


def test_feathers_fade_toward_the_rim_and_toward_edges_in_depth() -> None:
    surface = plain(together(square(side=4.0, steps=40), square(1.0, side=0.3)))
    camera = above(4.0, 100, 200.0)
    samples = surface.scatter(20_000, 2)
    behind = samples.points[:, 2] < 0.5
    found = seen(surface, camera, samples.triangles, samples.barycentric, feather=8.0)
    pixels, _ = camera.project(samples.points)
    rim = np.minimum(pixels, 100 - pixels).min(axis=1)
    half = 0.15 / 3 * 200  # of the square before
    away = np.abs(pixels - 50).max(axis=1) - half
    inside = behind & (rim > 0) & (away > 0)
    whole = inside & (rim > 8) & (away > 10)
    assert (found[whole] == 1).all()
    near = inside & ((rim < 7) | (away < 6))
    assert (found[near] < 1).all()


def test_distances_to_edges_are_those_of_the_nearest_background() -> None:
    surface, camera = ball(), above(4.0, 80, 120.0)
    found, _ = look(surface.vertices, surface.triangles, camera)
    distances = distances_to_edges(found, view_of(camera), 50.0)
    row, column = np.nonzero(found.triangle < 0)
    inside = np.argwhere(found.triangle >= 0)
    for r, c in inside[:: len(inside) // 50]:
        expected = np.hypot(row - r, column - c).min()
        rim = min(r, c, 79 - r, 79 - c) + 0.5
        assert abs(distances[r, c] - min(expected, rim)) < 0.09 * expected + 0.6
    assert (distances[row, column] == 0).all()


def test_a_lens_is_seen_through_a_pinhole_that_is_wide_enough() -> None:
    surface = ball()
    plain_camera = above(3.0, 120, 100.0)
    camera = Camera.pinhole(
        (120, 120),
        pose=np.linalg.inv(plain_camera.world_to_camera),
        convention="opengl",
        focal=100.0,
        distortion=(-0.2, 0.02, 0.001, -0.002),
    )
    # The pose is ours, world-to-camera with y down: read it as it is.
    camera = Camera(120, 120, camera.K, plain_camera.world_to_camera, "pinhole", camera.distortion)
    wide = straight(camera)
    assert wide.width > 120
    samples = surface.scatter(2000, 4)
    there, _ = camera.project(samples.points)
    inside = ((there > 1) & (there < 119)).all(axis=1)
    again, _ = wide.project(samples.points[inside])
    assert ((again > 0) & (again < [wide.width, wide.height])).all()
    toward = camera.position - samples.points
    cosine = np.einsum("nx,nx->n", samples.normals, toward) / np.linalg.norm(toward, axis=1)
    found = seen(surface, camera, samples.triangles, samples.barycentric)
    assert (found[inside & (cosine > 0.3)] == 1).all()
    assert straight(plain_camera) is plain_camera
