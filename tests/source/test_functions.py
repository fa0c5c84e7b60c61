"""Channels that functions of position give, and surfaces, against the shapes that they describe."""

import json
import math
import re
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from manifold3d import Error, Manifold, Mesh64

import octex
from octex.errors import ArgumentError, ModelError
from octex.source import implicit
from octex.source.surface import Surface
from octex.tree.morton import decode_cells
from tests.conftest import needs_jit
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


def cube(**options):
    return Surface.from_arrays(CUBE, CUBE_TRIANGLES, **options)


def ramp(points):
    return points * [1, 0.5, 0.25]


def height(points, normals):
    return np.asarray(points[:, 2] * (normals[:, 0] > 0.5))


def values(function, channel="base_color", **options):
    surface = cube(**options).with_sources({channel: function})
    samples = surface.scatter(50)
    return surface.evaluate(samples, channel, 0.1), samples


def test_a_function_of_two_arguments_gets_the_normals_of_faces_at_rest():
    found, samples = values(height, "roughness", rest=CUBE[:, [1, 2, 0]])
    assert found.shape == (50, 1)
    turned = samples.normals[:, [1, 2, 0]]
    np.testing.assert_allclose(found[:, 0], samples.rest[:, 2] * (turned[:, 0] > 0.5), atol=1e-6)
    assert found.any()


class Thing:
    def __call__(self, points):
        return ramp(points)

    def method(self, points, normals):
        return ramp(points) + 0 * normals


@pytest.mark.parametrize(
    "function",
    [
        ramp,
        Thing(),
        Thing().method,
        lambda points, scale=1.0: ramp(points) * scale,
        lambda *arguments: ramp(arguments[0]),
        partial(lambda scale, points: scale * ramp(points), 1.0),
        np.abs,
        np.ndarray.copy,
    ],
)
def test_whatever_can_be_called_is_read_at_rest_positions(function):
    found, samples = values(function, rest=CUBE / 2)
    expected = samples.rest if function in (np.abs, np.ndarray.copy) else ramp(samples.rest)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert found.dtype == np.float32


def test_integers_are_numbers_too_and_what_rounding_does_is_forgiven():
    found, _ = values(lambda points: np.ones(points.shape, np.uint8))
    assert (found == 1).all()
    found, _ = values(lambda points: np.full(points.shape, 1.0 + 1e-12))
    assert (found == 1).all()


def test_emissive_light_may_be_above_1_and_normals_are_made_unit_vectors():
    surface = cube().with_sources({"emissive": lambda points: points * 50, "normal": lambda p: 0.3 * p - 0.2})
    samples = surface.scatter(50)
    assert [(form.name, form.space, form.dtype) for form in surface.channels[1:]] == [
        ("emissive", "linear", "float16"),
        ("normal", "direction", "uint8"),
    ]
    np.testing.assert_allclose(surface.evaluate(samples, "emissive"), samples.rest * 50, rtol=1e-6)
    directions = 0.3 * samples.rest - 0.2
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), directions, atol=1e-6)


def test_a_function_may_write_to_what_it_is_given():
    def greedy(points, normals):
        points *= 0.5
        normals[:] = 7
        return points

    found, samples = values(greedy)
    np.testing.assert_allclose(found, samples.rest / 2, rtol=1e-6)


def test_no_points_are_not_asked_for():
    surface = cube().with_sources({"base_color": lambda _: 1 / 0})
    assert surface.evaluate(surface.scatter(0)).shape == (0, 3)


def test_other_rest_positions_and_filters_are_followed():
    surface = cube().with_sources({"base_color": ramp}).with_filter("trilinear").with_rest(CUBE / 4)
    samples = surface.scatter(20)
    np.testing.assert_allclose(surface.evaluate(samples), ramp(samples.rest), rtol=1e-6)
    assert json.loads(surface.provenance["source_base_color"]) == {"function": "ramp"}


@needs_jit
def test_what_a_function_does_wrong_stops_a_conversion_with_one_error():
    def holes(points):
        return np.where(points[:, :1] > 0.7, np.nan, points)

    with pytest.raises(ArgumentError, match="the function holes of base_color returned nan, nan, nan at"):
        octex.convert(cube(), 6, sources={"base_color": holes})


def at(index, value):
    """A function that gives a value in one row."""

    def patched(points):
        result = np.full(points.shape, 0.5)
        result[index] = value
        return result

    return patched


@pytest.mark.parametrize(
    ("function", "channel", "message"),
    [
        (lambda points: points[:, :2], "base_color", "shape (50, 3), not (50, 2), for 50 points"),
        (lambda _: 0.5, "roughness", "shape (50, 1) or (50,), not (), for 50 points"),
        (lambda points: [[1], [2, 3]] * (len(points) // 2), "base_color", "array of shape (50, 3)"),
        (lambda points: points.astype(str), "base_color", "real numbers, not <U32"),
        (at(7, np.nan), "base_color", "returned nan, nan, nan at {7}; values must be from 0 to 1"),
        (at(3, [0.5, -0.25, 0]), "base_color", "returned 0.5, -0.25, 0 at {3}; values must be from 0 to 1"),
        (at(9, [0, 1.01, 0]), "base_color", "returned 0, 1.01, 0 at {9}; values must be from 0 to 1"),
        (at(0, np.inf), "emissive", "returned inf, inf, inf at {0}; values must be from 0 to 65504"),
        (at(0, -1), "emissive", "returned -1, -1, -1 at {0}; values must be from 0 to 65504"),
        (at(5, -1.5), "normal", "returned -1.5, -1.5, -1.5 at {5}; values must be from -1 to 1"),
        (at(5, 0), "normal", "returned all zeros at {5}, which is not a direction"),
    ],
)
def test_what_a_function_must_not_return_is_named(function, channel, message):
    surface = cube().with_sources({channel: function})
    samples = surface.scatter(50)
    places = ["({})".format(", ".join(f"{x:.6g}" for x in point)) for point in samples.rest]
    with pytest.raises(ArgumentError, match=re.escape(message.format(*places))) as caught:
        surface.evaluate(samples, channel)
    assert f"the function {function.__name__} of {channel} " in str(caught.value)


@pytest.mark.parametrize(("error", "told"), [(KeyError("wood"), "KeyError: 'wood'"), (OSError(), "OSError")])
def test_what_a_function_raises_is_told_and_kept(error, told):
    def broken(_):
        raise error

    surface = cube().with_sources({"base_color": broken})
    samples = surface.scatter(8)
    first = ", ".join(f"{x:.6g}" for x in samples.rest[0])
    message = f"the function broken of base_color raised {told} for 8 points from ({first}) on"
    with pytest.raises(ArgumentError, match=re.escape(message)) as caught:
        surface.evaluate(samples)
    assert caught.value.__cause__ is error


@pytest.mark.parametrize(
    "function",
    [lambda: 0, lambda a, b, c: a + b + c, lambda points, *, scale: scale * points, lambda *, points: points],
)
def test_a_function_must_take_positions_or_positions_and_normals(function):
    with pytest.raises(ArgumentError, match="must take positions, or positions and normals, not \\("):
        cube().with_sources({"base_color": function})


BOX = [[-1.5] * 3, [1.5] * 3]


def ball(points):
    return np.linalg.norm(points - [0.1, 0.2, 0.3], axis=1) - 1


def solid(surface):
    return Manifold(Mesh64(surface.vertices.copy(), surface.triangles.astype(np.uint64)))


def test_vertices_lie_on_the_surface_and_triangles_near_it():
    errors = []
    for edge in (0.2, 0.1, 0.05):
        surface = Surface.from_function(ball, BOX, edge)
        assert np.abs(ball(surface.vertices)).max() < 1e-14
        corners = surface.vertices[surface.triangles]
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        assert edge / 2 < lengths.max() < 1.3 * edge
        errors.append(-ball(corners.mean(axis=1)).min())
        assert errors[-1] < edge**2 / 4
    assert 3 < errors[0] / errors[1] < 5
    assert 3 < errors[1] / errors[2] < 5


def test_what_is_below_the_level_is_inside():
    small, large = (Surface.from_function(ball, BOX, 0.1, level=level) for level in (-0.5, 0.1))
    for surface, radius in ((small, 0.5), (large, 1.1)):
        made = solid(surface)
        assert made.status() == Error.NoError
        assert made.volume() == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.02)
        assert made.num_vert() == len(surface.vertices)
    swapped = Surface.from_function(lambda points: -ball(points), BOX, 0.2)
    assert solid(swapped).volume() == pytest.approx(27 - 4 / 3 * math.pi, rel=0.02)


def test_the_bounds_cut_flatly():
    surface = Surface.from_function(ball, [[-1.5] * 3, [1.5, 1.5, 0.5]], 0.1)
    assert surface.bounds[1, 2] == 0.5
    on_lid = surface.vertices[:, 2] == 0.5
    assert np.abs(ball(surface.vertices[~on_lid])).max() < 1e-14
    assert ball(surface.vertices[on_lid]).max() < 0.005
    cap = 1 - 0.2
    assert solid(surface).volume() == pytest.approx(
        4 / 3 * math.pi - math.pi * cap**2 * (3 - cap) / 3, rel=0.02
    )


def test_the_grid_is_that_of_calls_for_single_points():
    asked = []

    def alone(x, y, z):
        asked.append((x, y, z))
        return -float(ball(np.array([[x, y, z]]))[0])

    wanted = Manifold.level_set(alone, [*BOX[0], *BOX[1]], 0.25).to_mesh64()
    given_points = []

    def together(points):
        given_points.append(points)
        return ball(points)

    low, high = np.array(BOX)
    vertices, triangles = implicit._polygonized(lambda p: -together(p), low, high, 0.25)
    assert np.array_equal(given_points[0], asked)
    assert np.array_equal(vertices, wanted.vert_properties[:, :3])
    assert np.array_equal(triangles, wanted.tri_verts)


def test_functions_are_called_in_batches_and_those_do_not_matter(monkeypatch):
    whole = Surface.from_function(ball, BOX, 0.3)
    sizes = []

    def counted(points):
        sizes.append(len(points))
        assert points.dtype == np.float64
        return ball(points)

    monkeypatch.setattr(implicit, "_BATCH", 100)
    assert np.array_equal(Surface.from_function(counted, BOX, 0.3).vertices, whole.vertices)
    assert max(sizes) == 100


@given(st.integers(0, 2**32 - 1))
def test_no_vertex_is_moved_far_or_to_a_worse_place(seed):
    random = np.random.default_rng(seed)
    waves, shifts = 6 * random.normal(size=(4, 3)), random.random(4)

    def rough(points):
        smooth = np.sin(points @ waves.T + shifts).sum(axis=1)
        return np.where(points[:, 0] > 0, np.abs(smooth) - 0.3, np.round(3 * smooth) + 0.5)

    start = random.random((50, 3)) * 2 - 1
    moved = implicit._moved_onto(rough, start, 0.1)
    assert np.linalg.norm(moved - start, axis=1).max() <= 0.1 * (1 + 1e-9)
    assert (np.abs(rough(moved)) <= np.abs(rough(start))).all()


def test_steps_and_infinite_values_make_a_surface_too():
    def far(points):
        return np.where(np.linalg.norm(points, axis=1) < 1, -np.inf, np.inf)

    surface = Surface.from_function(far, BOX, 0.2)
    assert np.abs(np.linalg.norm(surface.vertices, axis=1) - 1).max() < 0.2


def test_it_is_grey_or_has_the_sources_that_are_given():
    grey = Surface.from_function(ball, BOX, 0.4, name="ball")
    assert repr(grey).startswith("<Surface 'ball' of ")
    assert np.allclose(grey.evaluate(grey.scatter(5)), 0.5)
    red = Surface.from_function(ball, BOX, 0.4, sources={"base_color": (1.0, 0.0, 0.0), "roughness": 0.5})
    assert [form.name for form in red.channels] == ["base_color", "roughness"]
    assert np.allclose(red.evaluate(red.scatter(5)), [1, 0, 0])


@needs_jit
def test_the_cells_are_those_of_the_true_sphere():
    depth, edge, shift = 4, 0.35, 0.123

    def sphere(points):
        return np.linalg.norm(points - shift, axis=1) - 1

    surface = Surface.from_function(sphere, np.array(BOX) + shift, edge * 2 / (2**depth - 3))
    texture = octex.convert(surface, depth, fit=False)
    cells = decode_cells(texture.tree.level_codes(depth)).astype(np.int64)
    found = np.zeros((2**depth,) * 3, bool)
    found[tuple(cells.T)] = True
    edge_length = texture.placement.size / 2**depth
    low = np.array(texture.placement.origin)[:, None] - shift + edge_length * np.arange(2**depth)
    near = np.maximum(np.maximum(low, -(low + edge_length)), 0.0) ** 2
    far = np.maximum(np.abs(low), np.abs(low + edge_length)) ** 2
    nearest, farthest = (np.add.outer(np.add.outer(axes[0], axes[1]), axes[2]) for axes in (near, far))
    assert np.array_equal(found, (nearest <= 1) & (farthest >= 1))


def raising(_points):
    raise RuntimeError("no idea")


def holed(points):
    return np.where((points > 0).all(axis=1), np.nan, ball(points))


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (raising, r"raised RuntimeError: no idea for \d+ points from \(-.*\) on"),
        (lambda _points: 1.0, r"must return an array of shape \(\d+,\), not \(\), for \d+ points"),
        (lambda points: points, r"must return an array of shape .* not \(\d+, 3\)"),
        (lambda points: ["a"] * len(points), "must return real numbers, not <U1"),
        (holed, r"returned nan at \([0-9., ]+\); values must be numbers"),
    ],
)
def test_functions_that_give_no_values_are_refused(f, message):
    with pytest.raises(ArgumentError, match=message):
        Surface.from_function(f, BOX, 0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((ball, [[0, 0, 0]], 0.1), "bounds must be a finite lowest and highest corner"),
        ((ball, [[0, 0, 0], [1, 0, 1]], 0.1), "bounds must be a finite"),
        ((ball, [[0, 0, 0], [1, np.inf, 1]], 0.1), "bounds must be a finite"),
        ((ball, BOX, 0.0), "edge_length must be finite and above zero"),
        ((ball, BOX, 1e-5), r"an edge_length of 1e-05 takes about 5\.7e\+16 values of the function"),
    ],
)
def test_bounds_and_lengths_out_of_range_are_refused(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        Surface.from_function(*arguments)
    for level in (math.nan, "a"):
        with pytest.raises(ArgumentError, match="level"):
            Surface.from_function(ball, BOX, 0.1, level=level)


def test_a_function_without_a_surface_is_refused():
    with pytest.raises(ModelError, match=r"has no surface at -2 inside \[-1\.5, .*\] … \[1\.5, .*\]"):
        Surface.from_function(ball, BOX, 0.5, level=-2.0)
