"""Nearest points of triangles and of clouds, beside a look at every one of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octex.nearest.points import Points
from octex.nearest.triangles import Triangles
from tests.oracles.naive_nearest import around, nearest_on_triangles


def soup(seed, count, size):
    """Triangles at random, some of them slivers or without area."""
    random = np.random.default_rng(seed)
    corners = random.random((count, 1, 3)) + size * random.normal(size=(count, 3, 3))
    corners[count // 3 : count // 2, 2] = corners[count // 3 : count // 2, :2].mean(axis=1)
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def directions(seed, count):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 80),
    size=st.sampled_from([0.01, 0.2, 3.0]),
    shift=st.sampled_from([0.0, 1e5]),
    distance=st.sampled_from([np.inf, 0.3, 0.0]),
    facing=st.booleans(),
)
def test_what_is_nearest_on_triangles_is_what_a_look_at_all_of_them_finds(
    seed, count, size, shift, distance, facing
):
    vertices, faces = soup(seed, count, size)
    random = np.random.default_rng(seed + 1)
    near = vertices[random.integers(len(vertices), size=40)] + 0.01 * random.normal(size=(40, 3))
    points = np.concatenate([random.random((20, 3)) * 6 - 3, near, near + 1e-4])
    wanted = directions(seed, len(points)) if facing else None
    mesh = Triangles.of(vertices + shift, faces)
    found = mesh.nearest(points + shift, wanted, distance=distance, least_cosine=0.2)
    truth = nearest_on_triangles(vertices + shift, faces, points + shift, wanted, distance, 0.2)
    assert np.array_equal(found.triangles < 0, ~np.isfinite(truth))
    assert np.isinf(found.squares[found.triangles < 0]).all()
    there = found.triangles >= 0
    close = 1e-9 * (1 + shift)
    np.testing.assert_allclose(np.sqrt(found.squares[there]), truth[there], atol=close)
    corners = vertices[faces[found.triangles[there]]] + shift
    places = np.einsum("nc,ncx->nx", found.barycentric[there], corners)
    apart = np.linalg.norm(places - points[there] - shift, axis=1)
    np.testing.assert_allclose(apart, truth[there], atol=close)
    assert (found.barycentric[there] > -1e-9).all()


def test_of_triangles_that_are_equally_near_the_first_is_found():
    vertices, _ = soup(0, 1, 1.0)
    faces = np.zeros((20, 3), np.int32) + np.arange(3, dtype=np.int32)
    found = Triangles.of(vertices, faces).nearest(np.random.default_rng(0).random((50, 3)))
    assert (found.triangles == 0).all()


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 600),
    radius=st.sampled_from([0.0, 0.05, 0.4]),
    nearest=st.sampled_from([None, 0.1, np.inf]),
    facing=st.booleans(),
)
def test_what_is_around_a_place_is_what_a_look_at_all_points_finds(seed, count, radius, nearest, facing):
    random = np.random.default_rng(seed)
    positions, values = random.random((count, 3)), random.random((count, 3)).astype(np.float32)
    normals = directions(seed, count).astype(np.float32)
    places = np.concatenate([random.random((30, 3)) * 3 - 1, positions[:20], positions[:20] + 1e-3])
    radii = np.where(np.arange(len(places)) % 3, radius, 1.5 * radius)
    wanted = directions(seed + 1, len(places)) if facing else None
    cloud = Points.of(positions, values, normals)
    means, found = cloud.around(places, radii, wanted, nearest=nearest, least_cosine=0.3)
    true_means, true_found = around(positions, values, normals, places, radii, wanted, nearest, 0.3)
    assert np.array_equal(found, true_found)
    np.testing.assert_allclose(means, true_means, atol=2e-6)


def test_normals_do_not_count_for_clouds_without_them():
    cloud = Points.of(np.zeros((1, 3)), np.ones((1, 1), np.float32))
    wanted = np.array([[0.0, 0.0, 1.0]])
    means, found = cloud.around(np.ones((1, 3)), np.zeros(1), wanted, nearest=9.0, least_cosine=1.0)
    assert means.tolist() == [[1.0]] and found.tolist() == [True]


@pytest.mark.parametrize("count", [2, 9, 1000])
def test_the_spacing_of_a_grid_is_its_step(count):
    positions = np.arange(count)[:, None] * np.array([[0.25, 0.0, 0.0]])
    assert Points.of(positions, np.zeros((count, 1), np.float32)).spacing() == pytest.approx(0.25)
