"""How far values are apart in codes: by sRGB's curve, by ratio, by steps, and as they are covered."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import ALPHA, BASE_COLOR, NORMAL, ROUGHNESS, linear_to_srgb, srgb_to_linear
from octex.conversion.measure import ErrorColumns, are_near, are_near_between, are_surely_near, subtract
from octex.jit import kernel
from tests.make.small_surfaces import LIGHT


@kernel
def _near(values, columns, most, differences):
    near = True
    for component in range(values.shape[1]):
        subtract(values, columns, component, 1, differences)
        near &= are_near(differences, 1, most)
    return near


@kernel
def _apart_by_less(values, columns, component, count, most):
    return are_surely_near(values, columns, component, count, most)


@kernel
def _near_between(differences, count, most):
    return are_near_between(differences, count, most)


def far_rows(found, source, forms, most):
    """Whether rows of several channels are farther apart than ``most`` codes."""
    values = np.array([found, source], np.float32)[:, :, None]
    return not _near(values, ErrorColumns.of(forms), float(most), np.zeros((2, 1)))


def far(form, found, source, most):
    """Whether two values, in each component, are farther apart than ``most`` codes."""
    rows = (np.full(form.components, each, np.float32) for each in (found, source))
    return far_rows(*rows, (form,), most)


@pytest.mark.parametrize("form", [BASE_COLOR, LIGHT])
@given(st.floats(0, 1, width=32), st.floats(0, 255))
def test_light_is_apart_by_codes_of_its_curve(form, light, code):
    other = srgb_to_linear(code / 255)
    apart = abs(255 * linear_to_srgb(light) - code)
    assert far(form, light, other, apart - 1e-3)
    assert not far(form, light, other, apart + 1e-3)


@pytest.mark.parametrize(
    ("form", "found", "source", "apart"),
    [
        (LIGHT, 6.0, 4.0, 255 * 1.055 / 2.4 * np.log(1.5)),  # above one by ratio
        (ROUGHNESS, 0.5, 0.5 + 2 / 255, 2),
        (NORMAL, -0.5, -0.5 + 2 / 127.5, 2),
    ],
)
def test_bright_light_fractions_and_directions_are_apart_by_ratio_and_codes(form, found, source, apart):
    assert far(form, found, source, apart - 1e-3)
    assert not far(form, found, source, apart + 1e-3)
    assert not far(LIGHT, 1.0 + 1e-6, 1.0 - 1e-6, 1e-3)


def test_what_is_not_a_number_is_far_from_anything():
    assert far(ROUGHNESS, np.nan, 0.5, 1e9)
    assert far(ROUGHNESS, 0.5, np.nan, 1e9)


def test_what_is_covered_in_part_counts_by_as_much():
    found = np.full(4, 0.5, np.float32)
    whole, half = np.array([0.5, 0.5, 0.4, 1.0]), np.array([0.5, 0.5, 0.4, 0.5])
    apart = 255 * abs(linear_to_srgb(0.5) - linear_to_srgb(0.4))
    forms = BASE_COLOR, ALPHA
    assert not far_rows(found, whole, forms, 200)
    assert far_rows(found, whole, forms, 126)  # of the alpha
    assert far_rows(found, half, forms, apart / 2 - 0.1)
    assert not far_rows(found, half, forms, apart / 2 + 0.1)


def test_directions_count_as_unit_vectors_too():
    short, other = np.array([0.1, 0, 0.5], np.float32), np.array([0.2, 0, 0.5], np.float32)
    apart = 127.5 * abs(0.1 / np.hypot(0.1, 0.5) - 0.2 / np.hypot(0.2, 0.5))
    assert apart > 127.5 * 0.1
    assert far_rows(short, other, (NORMAL,), apart - 0.1)
    assert not far_rows(short, other, (NORMAL,), apart + 0.1)


@given(st.integers(0, 2**32 - 1))
def test_points_that_surely_are_near_are_near(seed):
    random = np.random.default_rng(seed)
    forms = (BASE_COLOR, ROUGHNESS)
    columns = ErrorColumns.of(forms)
    count = int(random.integers(1, 17))
    values = np.zeros((2, 4, 16), np.float32)
    values[0] = random.random((4, 1)) ** 4 * 2 + random.random((4, 16)) * 0.1
    values[1] = values[0] + random.normal(size=(4, 16)) * 10 ** -random.uniform(1, 4)
    values[1] = np.maximum(values[1], 0)
    values[:, :, count:] = values[:, :, :1]
    most, component = 10 ** random.uniform(-1, 2), int(random.integers(4))
    if _apart_by_less(values, columns, component, count, most):
        for point in range(count):
            rows = np.zeros((2, 4), np.float32)
            rows[:, component] = values[:, component, point]
            assert not far_rows(*rows, forms, 1.001 * most + 1e-3)
    assert _apart_by_less(values, columns, component, count, 1e9)
    assert _apart_by_less(values[[0, 0]], columns, component, count, 0.0)
    values[0, component, random.integers(count)] = np.nan
    assert not _apart_by_less(values, columns, component, count, 1e9)


@given(st.integers(0, 2**32 - 1))
def test_what_is_quadratic_between_the_points_of_a_patch_exceeds_its_bound_nowhere(seed):
    random = np.random.default_rng(seed)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + random.normal(size=(4, 2)) / 8
    middle = corners.mean(axis=0)
    after = np.roll(corners, -1, axis=0)
    points = np.concatenate([middle[None], corners, (corners + middle) / 2, (corners + after) / 2])
    factors = random.normal(size=(6, 2)) * (random.random((6, 1)) < 0.5)

    def values(points):
        x, y = points.T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1) @ factors

    weights = random.dirichlet([1, 1, 1], 500)
    inside = [weights @ [middle, *ends] for ends in zip(corners, after, strict=True)]
    largest = np.abs(values(np.concatenate(inside))).max()
    differences = values(points).T.copy()
    count = len(points)
    assert not _near_between(differences, count, 0.999 * largest - 1e-9)
    flat = (factors[3:] == 0).all()
    at_points = np.abs(differences).max()
    assert _near_between(differences, count, (1 if flat else 3) * at_points + 1e-9)


def test_what_rises_between_the_points_of_a_patch_is_found():
    # A triangle of a patch of one: all its points are near, and yet a parabola through them is not.
    differences = np.array([[0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0]])
    assert not _near_between(differences, 10, 1.9)
    assert _near_between(differences, 10, 2.1)
    differences[0, 5] = np.nan
    assert not _near_between(differences, 10, 1e9)
