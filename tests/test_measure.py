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
from octex.conversion.measure import exceeding


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
