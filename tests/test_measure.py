"""How far values are apart in codes: by sRGB's curve, by ratio, by steps, and as they are covered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import (
    ALPHA,
    BASE_COLOR,
    EMISSIVE,
    NORMAL,
    ROUGHNESS,
    ChannelFormat,
    linear_to_srgb,
    srgb_to_linear,
)
from octex.conversion.measure import exceeding, exceeding_between


def far(form: ChannelFormat, found: float, source: float, most: float) -> bool:
    """Whether two values, in each component, are farther apart than ``most`` codes."""
    rows = np.full((1, form.components), found, np.float32)
    return bool(exceeding(rows, np.full(rows.shape, source), (form,), most)[0])


@pytest.mark.parametrize("form", [BASE_COLOR, EMISSIVE._replace(space="linear", dtype="float16")])
@given(st.floats(0, 1, width=32), st.floats(0, 255))
def test_light_is_apart_by_codes_of_its_curve(form: ChannelFormat, light: float, code: float):
    other = srgb_to_linear(code / 255)
    apart = abs(255 * linear_to_srgb(light) - code)
    assert far(form, light, other, apart - 1e-3)
    assert not far(form, light, other, apart + 1e-3)


def test_light_above_one_is_apart_by_ratio():
    form = EMISSIVE._replace(space="linear", dtype="float16")
    expected = 255 * 1.055 / 2.4 * np.log(1.5)
    assert not far(form, 6.0, 4.0, expected + 1e-3)
    assert far(form, 6.0, 4.0, expected - 1e-3)
    assert not far(form, 1.0 + 1e-6, 1.0 - 1e-6, 1e-3)


def test_fractions_and_directions_are_apart_by_their_codes():
    assert far(ROUGHNESS, 0.5, 0.5 + 2.01 / 255, 2)
    assert not far(ROUGHNESS, 0.5, 0.5 + 1.99 / 255, 2)
    assert far(NORMAL, -0.5, -0.5 + 2.01 / 127.5, 2)
    assert not far(NORMAL, -0.5, -0.5 + 1.99 / 127.5, 2)


def test_what_is_not_a_number_is_far_from_anything():
    assert far(ROUGHNESS, np.nan, 0.5, 1e9)
    assert far(ROUGHNESS, 0.5, np.nan, 1e9)


def test_what_is_covered_in_part_counts_by_as_much():
    found = np.full((2, 4), 0.5, np.float32)
    source = np.array([[0.5, 0.5, 0.4, 1.0], [0.5, 0.5, 0.4, 0.5]])
    apart = 255 * abs(linear_to_srgb(0.5) - linear_to_srgb(0.4))
    assert list(exceeding(found, source, (BASE_COLOR, ALPHA), 200)) == [False, False]
    assert list(exceeding(found, source, (BASE_COLOR, ALPHA), apart - 0.1)) == [True, False]
    found[:, 3] /= 2
    assert list(exceeding(found, source, (BASE_COLOR, ALPHA), 100)) == [True, False]


@given(st.integers(0, 2**32 - 1))
def test_what_is_quadratic_between_the_points_of_a_patch_exceeds_its_bound_nowhere(seed: int):
    random = np.random.default_rng(seed)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + random.normal(size=(4, 2)) / 8
    middle = corners.mean(axis=0)
    after = np.roll(corners, -1, axis=0)
    points = np.stack([corners, (corners + middle) / 2, (corners + after) / 2], axis=1).reshape(-1, 2)
    points = np.concatenate([middle[None], points])
    factors = random.normal(size=(6, 2)) * (random.random((6, 1)) < 0.5)

    def values(points: np.ndarray) -> np.ndarray:
        x, y = points.T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1) @ factors

    weights = random.dirichlet([1, 1, 1], 500)
    inside = [weights @ [middle, *ends] for ends in zip(corners, after, strict=True)]
    largest = np.abs(values(np.concatenate(inside))).max()
    firsts = np.array([0, len(points)])
    differences = values(points).astype(np.float32)
    assert exceeding_between(differences, firsts, 0.999 * largest - 1e-5)[0]
    flat = (factors[3:] == 0).all()
    at_points = np.abs(differences).max()
    assert not exceeding_between(differences, firsts, (1 if flat else 8) * at_points + 1e-5)[0]


def test_what_rises_between_the_points_of_a_patch_is_found():
    # A triangle of a patch of one: all its points are near, and yet a parabola through them is not.
    differences = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0, 0], np.float32)[:, None]
    firsts = np.array([0, 10])
    assert exceeding_between(differences, firsts, 1.9)[0]
    assert not exceeding_between(differences, firsts, 2.1)[0]
    differences[5] = np.nan
    assert exceeding_between(differences, firsts, 1e9)[0]
