"""Tangents against MikkTSpace in plain Python, and where geometry says what they must be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.source.corners import Corners
from octex.source.tangents import carried, corner_frames, transformed
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV
from tests.make.painted import halved_quads
from tests.make.small_surfaces import turned
from tests.oracles import naive_tangents

SQUARE_ROWS = SQUARE_TRIANGLES.astype(np.int32)
UP = np.array([[0, 0, 1]] * 4, np.float32)


def square(uv=SQUARE_UV, normals=UP, tangents=None):
    return corner_frames(
        SQUARE.astype(np.float64),
        SQUARE_ROWS,
        None if normals is None else Corners(normals, SQUARE_ROWS),
        None if tangents is None else Corners(tangents, SQUARE_ROWS),
        Corners(uv.astype(np.float32), SQUARE_ROWS),
    )


def at_corners(corners):
    return corners.values[corners.rows]


def assert_sound(frames, count):
    """Every corner has unit vectors at right angles, and a handedness."""
    normals, tangents = at_corners(frames.normals), at_corners(frames.tangents)
    assert normals.shape == (count, 3, 3) and tangents.shape == (count, 3, 4)
    assert normals.dtype == tangents.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(tangents[..., :3], axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose((normals * tangents[..., :3]).sum(axis=-1), 0, atol=1e-5)
    assert set(np.unique(tangents[..., 3])) <= {-1.0, 1.0}


def wavy(columns, rows, seed=0):
    """A height field with noise; its vertices and triangles."""
    random = np.random.default_rng(seed)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0)))
    points = np.stack([x, y, np.sin(x) + 0.5 * np.cos(2 * y)], axis=1) + random.normal(0, 0.1, (len(x), 3))
    return points, halved_quads(rows + 1, columns + 1).astype(np.int32)


@pytest.mark.parametrize(
    ("flip", "tangent"), [((1, 1), (1, 0, 0, 1)), ((-1, 1), (-1, 0, 0, -1)), ((1, -1), (1, 0, 0, -1))]
)
def test_the_tangent_is_u_and_the_bitangent_runs_against_v_also_of_a_mirrored_image(flip, tangent):
    frames = square(SQUARE_UV * flip)
    np.testing.assert_allclose(at_corners(frames.normals), np.broadcast_to([0, 0, 1], (2, 3, 3)))
    np.testing.assert_allclose(at_corners(frames.tangents), np.broadcast_to(tangent, (2, 3, 4)))


@given(seed=st.integers(0, 10**6), tie=st.booleans())
def test_random_meshes_agree_with_the_naive_version(seed, tie):
    random = np.random.default_rng(seed)
    points = random.integers(-2, 3, (7, 3)).astype(np.float64)
    triangles = random.integers(0, 7, (12, 3)).astype(np.int32)
    # Few values, so that corners meet, triangles lose their area and images are mirrored.
    uv = random.integers(0, 3, (5, 2)).astype(np.float32) / 2
    uv_rows = triangles % 5 if tie else random.integers(0, 5, (12, 3)).astype(np.int32)
    normals = random.normal(size=(3, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    normal_rows = triangles % 3 if tie else random.integers(0, 3, (12, 3)).astype(np.int32)
    frames = corner_frames(
        points, triangles, Corners(normals, normal_rows), None, Corners(uv, uv_rows.astype(np.int32))
    )
    assert_sound(frames, 12)
    expected = naive_tangents.tangents(
        [tuple(p) for p in points.tolist()],
        triangles.tolist(),
        [[tuple(n) for n in corners] for corners in frames.normals.values[normal_rows].tolist()],
        [[tuple(t) for t in corners] for corners in uv[uv_rows].tolist()],
    )
    found = at_corners(frames.tangents)
    for triangle, corners in enumerate(expected):
        for corner, tangent in enumerate(corners):
            if tangent is not None:
                np.testing.assert_allclose(found[triangle, corner], tangent, atol=1e-4)


def test_tangents_do_not_depend_on_how_rows_are_shared():
    points, triangles = wavy(6, 4)
    uv = (points[:, :2] * 0.3 + 0.1 * points[:, 2:]).astype(np.float32)
    normals = np.tile(np.float32([0, 0.6, 0.8]), (len(points), 1))
    shared = corner_frames(points, triangles, Corners(normals, triangles), None, Corners(uv, triangles))
    apart = np.arange(triangles.size, dtype=np.int32).reshape(-1, 3)
    split = corner_frames(
        points[triangles].reshape(-1, 3),
        apart,
        Corners(normals[triangles].reshape(-1, 3), apart),
        None,
        Corners(uv[triangles].reshape(-1, 2), apart),
    )
    np.testing.assert_array_equal(at_corners(shared.tangents), at_corners(split.tangents))


def test_without_normals_triangles_are_flat_and_given_tangents_do_not_count():
    points, triangles = wavy(2, 2)
    uv = Corners(points[:, :2].astype(np.float32), triangles)
    given_tangents = Corners(np.ones((len(points), 4), np.float32), triangles)
    frames = corner_frames(points, triangles, None, given_tangents, uv)
    assert_sound(frames, len(triangles))
    corners = points[triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    crosses /= np.linalg.norm(crosses, axis=1, keepdims=True)
    np.testing.assert_allclose(at_corners(frames.normals), np.repeat(crosses[:, None], 3, axis=1), atol=1e-6)


def test_given_tangents_are_kept_but_for_their_length():
    tangents = np.array([[0, 2, 0, -1], [3, 0, 0, 1], [1, 1, 0, 1], [0, -1, 0, -0.5]], np.float32)
    found = square(tangents=tangents).tangents
    half = 0.5**0.5
    expected = [[0, 1, 0, -1], [1, 0, 0, 1], [half, half, 0, 1], [0, -1, 0, -1]]
    np.testing.assert_allclose(found.values, expected, atol=1e-6)
    np.testing.assert_array_equal(found.rows, SQUARE_ROWS)


def test_without_coordinates_tangents_only_fit_the_normals():
    points, triangles = wavy(3, 3)
    assert_sound(corner_frames(points, triangles, None, None, None), len(triangles))


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_has_no_direction_takes_one_that_fits(value):
    nothing = np.full((4, 4), value, np.float32)
    assert_sound(square(tangents=nothing), 2)
    frames = square(normals=nothing[:, :3], uv=np.full((4, 2), value, np.float32))
    assert_sound(frames, 2)
    np.testing.assert_allclose(at_corners(frames.normals), np.broadcast_to([0, 0, 1], (2, 3, 3)))


@pytest.mark.parametrize("length", [1e-38, 1e38])
def test_normals_may_have_any_length(length):
    np.testing.assert_allclose(square(normals=UP * np.float32(length)).normals.values, UP)


def test_triangles_without_area_take_the_tangents_of_their_neighbours():
    points = np.concatenate([SQUARE, [[0.5, 0, 0], [2, 0, 0]]]).astype(np.float64)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 1], [1, 2, 5]], np.int32)
    uv = np.concatenate([SQUARE_UV * (-1, 1), [[0.5, 1], [-1, 0.5]]]).astype(np.float32)  # the last: a line
    normals = Corners(np.tile(UP[:1], (6, 1)), triangles)
    frames = corner_frames(points, triangles, normals, None, Corners(uv, triangles))
    assert_sound(frames, 4)
    found = at_corners(frames.tangents)
    np.testing.assert_allclose(found[2], [[-1, 0, 0, -1]] * 3)
    np.testing.assert_allclose(found[3, :2], [[-1, 0, 0, -1]] * 2)
    assert (found[3, :, 3] == -1).all()


def test_zeros_of_either_sign_meet():
    points = SQUARE.astype(np.float64)
    split = np.array([[0, 1, 2], [4, 2, 3]], np.int32)
    points = np.concatenate([points, [[-0.0, -0.0, -0.0]]])
    points[:, 2] = [0, 1, 0, 2, 0]
    uv = Corners(np.concatenate([SQUARE_UV, [[-0.0, 1]]]).astype(np.float32), split)
    normals = Corners(np.tile(UP[:1], (5, 1)), split)
    found = at_corners(corner_frames(points, split, normals, None, uv).tangents)
    np.testing.assert_array_equal(found[0, 0], found[1, 0])


def test_a_mesh_may_be_empty():
    nothing = np.empty((0, 3), np.int32)
    frames = corner_frames(np.empty((0, 3)), nothing, None, None, Corners(SQUARE_UV, nothing))
    assert_sound(frames, 0)


def leaning(points, triangles):
    """Frames whose normals are not those of the triangles."""
    normals = np.column_stack([0.3 * np.cos(points[:, 0]), 0.2 * np.sin(points[:, 1]), np.ones(len(points))])
    uv = Corners(points[:, :2].astype(np.float32), triangles)
    return corner_frames(points, triangles, Corners(normals.astype(np.float32), triangles), None, uv)


@pytest.mark.parametrize("scale", [1.0, 0.01, 40.0])
def test_frames_turn_with_a_body_that_is_turned_moved_and_scaled(scale):
    points, triangles = wavy(4, 4)
    frames, turn = leaning(points, triangles), turned(3)
    moved = carried(frames, triangles, points, scale * points @ turn.T + (5, 6, 7))
    assert_sound(moved, len(triangles))
    np.testing.assert_allclose(at_corners(moved.normals), at_corners(frames.normals) @ turn.T, atol=1e-5)
    tangents = at_corners(frames.tangents)
    np.testing.assert_allclose(at_corners(moved.tangents)[..., :3], tangents[..., :3] @ turn.T, atol=1e-5)
    np.testing.assert_array_equal(at_corners(moved.tangents)[..., 3], tangents[..., 3])


def test_frames_carried_there_and_back_are_the_same():
    points, triangles = wavy(4, 4)
    frames = leaning(points, triangles)
    other = points * (1, 2, 0.5) + 0.3 * np.sin(points[:, ::-1])
    there = carried(frames, triangles, points, other)
    assert_sound(there, len(triangles))
    back = carried(there, triangles, other, points)
    np.testing.assert_allclose(at_corners(back.normals), at_corners(frames.normals), atol=1e-4)
    np.testing.assert_allclose(at_corners(back.tangents), at_corners(frames.tangents), atol=1e-4)


def test_tangents_in_a_triangle_stay_on_its_stretched_edges():
    points, triangles = SQUARE.astype(np.float64), SQUARE_ROWS
    other = points @ np.array([[2, 0, 1], [1, 3, 0], [0, 0, 1]], float)
    diagonal = np.array([[1, 1, 0, 1]] * 4, np.float32)
    moved = carried(square(tangents=diagonal), triangles, points, other)
    edge = other[2] - other[0]
    found = at_corners(moved.tangents)[..., :3]
    np.testing.assert_allclose(found, np.broadcast_to(edge / np.linalg.norm(edge), found.shape), atol=1e-6)


def test_frames_stay_where_a_triangle_has_no_area():
    points, triangles = SQUARE.astype(np.float64), SQUARE_ROWS
    flat = points.copy()
    flat[1] = flat[0]
    for before, after in ((points, flat), (flat, points)):
        moved = carried(square(), triangles, before, after)
        assert_sound(moved, 2)
        np.testing.assert_allclose(at_corners(moved.tangents)[0], [[1, 0, 0, 1]] * 3)


@pytest.mark.parametrize("sizes", [(1, 1, 1), (3, 3, 3), (-1, 1, 1), (-2, -2, -2), (2, -2, 2), (0.5, 2, -3)])
def test_a_transform_takes_the_frames_of_a_body_to_those_of_its_image(sizes):
    points, triangles = wavy(4, 4)
    matrix = turned(2) @ np.diag(sizes)
    uv = Corners(points[:, :2].astype(np.float32), triangles)
    found = transformed(corner_frames(points, triangles, None, None, uv), matrix)
    assert_sound(found, len(triangles))
    order = slice(None, None, -1 if np.linalg.det(matrix) < 0 else 1)
    image = corner_frames(
        points @ matrix.T, triangles[:, order], None, None, Corners(uv.values, triangles[:, order])
    )
    np.testing.assert_allclose(at_corners(found.normals)[:, order], at_corners(image.normals), atol=1e-5)
    np.testing.assert_allclose(at_corners(found.tangents)[:, order], at_corners(image.tangents), atol=1e-5)


@pytest.mark.parametrize("linear", [np.zeros((3, 3)), np.diag([0.0, 1.0, 1.0]), np.full((3, 3), np.nan)])
def test_a_transform_that_leaves_no_direction_leaves_the_old_one(linear):
    found = transformed(square(), linear)
    for corners in found:
        assert (np.linalg.norm(at_corners(corners)[..., :3], axis=-1) > 0.99).all()


def test_a_flattening_transform_keeps_the_normals_of_what_is_flattened():
    found = transformed(square(), np.diag([2.0, 1.0, 0.0]))
    np.testing.assert_allclose(at_corners(found.normals), np.broadcast_to([0, 0, 1], (2, 3, 3)))
