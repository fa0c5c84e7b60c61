"""How deep to go where: functions, channels and stretch."""

import re

import numpy as np
import pytest

import octex
from octex.channels import ChannelFormat
from octex.conversion.convert import with_detail
from octex.conversion.detail import deepest_wanted, wanted_levels
from octex.errors import ArgumentError, ModelError
from octex.source.base import Source
from octex.voxelize.fragments import Fragments
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES

DEPTH = 10
MIDDLES = np.full((2, 3), 1 / 3)
NO_WIDTHS = np.zeros(2, np.float32)
BOTH = np.arange(2, dtype=np.int32)  # the square's triangles


class Painted(Source):
    """A channel with a value for each triangle."""

    def __init__(self, values, form):
        self.values = np.asarray(values, np.float32).reshape(-1, form.components)
        self.form = form

    @property
    def channels(self):
        return (self.form,)

    def evaluate(self, triangles, _barycentric, _widths):
        return self.values[triangles]


def square(posed=SQUARE):
    return octex.Surface.from_arrays(posed, SQUARE_TRIANGLES, rest=SQUARE)


def painted(values):
    source = Painted(values, ChannelFormat("wear", 1, "data"))
    return square().with_sources({"wear": source})


def levels(detail, surface, depth=DEPTH):
    return list(wanted_levels(detail, surface, depth)(BOTH, MIDDLES, NO_WIDTHS))


def test_a_function_is_asked_at_rest_positions():
    asked = []

    def detail(points):
        asked.append(points)
        return points[:, 0] * 9

    surface = square(SQUARE * 5)
    found = levels(detail, surface)
    expected = SQUARE[SQUARE_TRIANGLES].mean(axis=1)
    np.testing.assert_allclose(asked[0], expected)
    np.testing.assert_allclose(found, expected[:, 0] * 9)


def test_what_a_function_returns_is_cut_to_the_depths_there_are():
    assert levels(lambda _: [-3, 40], square()) == [0, DEPTH]
    assert levels(lambda _: [np.inf, -np.inf], square()) == [DEPTH, 0]


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ([7, [7], [[7, 7]], [7, 7, 7]], "detail must return an array of shape (2,), not ("),
        ([["deep", "deeper"], [[1], [2, 3]], None], "detail must return"),
    ],
)
def test_a_function_must_return_a_number_for_each_point(answers, message):
    for answer in answers:
        with pytest.raises(ArgumentError, match=re.escape(message)):
            levels(lambda _, answer=answer: answer, square())


def test_a_function_must_not_return_nan():
    with pytest.raises(
        ArgumentError, match=r"returned nan at \(0\.333333, 0\.666667, 0\); values must be numbers"
    ):
        levels(lambda _: np.array([3, np.nan]), square())


def test_a_channel_is_the_resolution_relative_to_the_finest():
    assert levels("wear", painted([1, 0.5])) == [DEPTH, DEPTH - 1]
    assert levels("wear", painted([0.25, 1 / 256])) == [DEPTH - 2, DEPTH - 8]


def test_a_channel_makes_cells_at_most_256_times_as_wide():
    assert levels("wear", painted([0, -1])) == [DEPTH - 8, DEPTH - 8]
    assert levels("wear", painted([0, 0.5]), 3) == [0, 2]


def test_a_channel_above_one_or_not_a_number_goes_to_the_full_depth():
    assert levels("wear", painted([7, np.nan])) == [DEPTH, DEPTH]


def test_an_image_of_the_channel_detail_says_how_deep_to_go():
    grey = np.full((2, 2, 3), 128, np.uint8)
    plain = octex.Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=SQUARE[:, :2])
    found = levels("detail", plain.with_sources({"detail": grey}))
    np.testing.assert_allclose(found, DEPTH + np.log2(128 / 255), atol=1e-6)


def test_a_detail_that_is_no_channel_lists_those_there_are():
    with pytest.raises(ArgumentError, match="unknown detail 'wear'; there are: base_color, stretch"):
        levels("wear", square())


@pytest.mark.parametrize("name", ["base_color", "flow"])
def test_a_channel_must_be_one_number(name):
    source = Painted([1, 1], ChannelFormat("flow", 1, "direction"))
    with pytest.raises(ArgumentError, match=f"with one component in 0 … 1, and '{name}' is not"):
        levels(name, square().with_sources({"flow": source}))


@pytest.mark.parametrize("detail", [3, ["wear"], b"stretch"])
def test_detail_must_be_a_function_or_a_name(detail):
    with pytest.raises(ArgumentError, match='detail must be a function, the name of a channel or "stretch"'):
        levels(detail, square())


def test_a_channel_that_detail_names_is_read_with_the_others():
    assert with_detail(["a"], "wear") == ["a", "wear"]
    for detail in ("stretch", "a", None, lambda points: points[:, 0]):
        assert with_detail(["a"], detail) == ["a"]
    assert with_detail(None, "wear") is None


def test_without_a_pose_stretch_goes_to_the_full_depth_everywhere():
    assert levels("stretch", square()) == [DEPTH, DEPTH]


def test_stretch_is_the_largest_singular_value():
    # The second triangle is sheared in the pose: its corner moves along its base.
    rng = np.random.default_rng(5)
    rest, posed = rng.normal(size=(2, 6, 3))
    triangles = np.arange(6, dtype=np.int32).reshape(2, 3)
    surface = octex.Surface.from_arrays(posed, triangles, rest=rest)

    def stretch(triangle):
        edges = [(p[triangle[1:]] - p[triangle[0]]).T for p in (rest, posed)]
        return float(np.linalg.norm(edges[1] @ np.linalg.pinv(edges[0]), 2))

    expected = [stretch(triangle) for triangle in triangles]
    found = levels("stretch", surface)
    assert max(found) == DEPTH
    np.testing.assert_allclose(found[1] - found[0], np.log2(expected[1] / expected[0]), rtol=1e-9)


def test_stretch_of_a_hundredth_of_the_pose_does_not_coarsen_the_rest():
    # A thousand triangles of one size, nine of which are stretched 40 times in the pose, and thin there.
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])[None] + np.arange(1000)[:, None, None] * [2, 0, 0]
    posed = rest.astype(float).copy()
    posed[:9] *= [0.0001, 40, 1]
    triangles = np.arange(3000).reshape(-1, 3)
    surface = octex.Surface.from_arrays(posed.reshape(-1, 3), triangles, rest=rest.reshape(-1, 3))
    wanted = wanted_levels("stretch", surface, DEPTH)
    some = np.array([0, 8, 9, 999], np.int32)
    found = wanted(some, np.full((4, 3), 1 / 3), np.zeros(4, np.float32))
    assert list(found) == [DEPTH] * 4


def test_a_part_that_shrinks_in_the_pose_goes_less_deep():
    corners = np.concatenate([SQUARE, SQUARE + np.array([3, 0, 0])])
    triangles = np.concatenate([SQUARE_TRIANGLES, SQUARE_TRIANGLES + 4])
    posed = np.concatenate([SQUARE, SQUARE / 8])
    surface = octex.Surface.from_arrays(posed, triangles, rest=corners)
    wanted = wanted_levels("stretch", surface, DEPTH)
    some = np.array([0, 2], np.int32)
    np.testing.assert_allclose(wanted(some, MIDDLES, NO_WIDTHS), [DEPTH, DEPTH - 3])


def test_triangles_without_area_at_rest_do_not_count():
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 2, 0]], float)  # the second triangle is a line
    surface = octex.Surface.from_arrays(SQUARE, [[0, 1, 2], [0, 2, 3]], rest=flat)
    with pytest.raises(ModelError, match="its rest mesh has no area"):
        levels("stretch", surface)


def test_a_pose_without_area_has_no_stretch():
    with pytest.raises(ModelError, match='its pose has no area, which detail="stretch" needs'):
        levels("stretch", square(SQUARE * [1, 0, 0]))


def test_a_cell_goes_as_deep_as_any_surface_in_it_wants():
    def wanted(*_):
        return np.array([3.0, 5.0, 2.2, 4.04])

    pieces = Fragments(
        codes=np.array([4, 7]),
        flags=np.array([0b110000, 0b000010], np.uint8),
        entries=np.array([1, 0, 2, 2], np.int32),  # the first cell has two entries, one for each facing
        triangles=np.zeros(4, np.int32),
        barycentric=np.full((4, 3), 1 / 3),
        areas=np.ones(4),
    )
    assert list(deepest_wanted(wanted, pieces, np.zeros(4, np.float32))) == [5, 4]


@pytest.mark.parametrize(
    ("code", "level"), [(255, 10), (134, 10), (128, 9), (64, 8), (65, 8), (1, 2), (0, 2)]
)
def test_halves_in_eight_bits_are_whole_levels(code, level):
    surface = painted([code / 255] * 2)
    pieces = Fragments(
        codes=np.array([4]),
        flags=np.array([1], np.uint8),
        entries=np.zeros(1, np.int32),
        triangles=np.zeros(1, np.int32),
        barycentric=MIDDLES[:1],
        areas=np.ones(1),
    )
    assert deepest_wanted(wanted_levels("wear", surface, DEPTH), pieces, NO_WIDTHS[:1]) == [level]
