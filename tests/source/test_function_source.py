"""Channels that functions of position give."""

import json
import re
from functools import partial

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.source.surface import Surface
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
