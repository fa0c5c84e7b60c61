"""How deep to go where: functions, channels and stretch."""

import re

import numpy as np
import pytest

import octex
from octex.channels import ChannelFormat
from octex.conversion.convert import with_detail
from octex.conversion.detail import deepest_wanted, wanted_levels
from octex.errors import ArgumentError, ModelError
from octex.voxelize.fragments import Fragments
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES
from tests.make.small_surfaces import FaceSource

DEPTH = 10
MIDDLES = np.full((2, 3), 1 / 3)
NO_WIDTHS = np.zeros(2, np.float32)
BOTH = np.arange(2, dtype=np.int32)  # the square's triangles


def square(posed=SQUARE):
    return octex.Surface.from_arrays(posed, SQUARE_TRIANGLES, rest=SQUARE)


def painted(values):
    form = ChannelFormat("wear", 1, "data")
    return square().with_sources({"wear": FaceSource((form,), np.reshape(values, (-1, 1)))})


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


@pytest.mark.parametrize(
    ("detail", "message"),
    [
        *((odd, "detail must return an array of shape (2,), not (") for odd in (7, [7], [[7, 7]], [7] * 3)),
        *((odd, "detail must return") for odd in (["deep", "deeper"], [[1], [2, 3]], None)),
        ([3, np.nan], "returned nan at (0.333333, 0.666667, 0); values must be numbers"),
    ],
)
def test_a_function_must_return_a_number_for_each_point(detail, message):
    with pytest.raises(ArgumentError, match=re.escape(message)):
        levels(lambda _: detail, square())


@pytest.mark.parametrize(
    ("detail", "message"),
    [
        ("wear", "unknown detail 'wear'; there are: base_color, flow, stretch"),
        *((name, f"with one component in 0 … 1, and '{name}' is not") for name in ("base_color", "flow")),
        *((odd, 'a function, the name of a channel or "stretch"') for odd in (3, ["wear"], b"stretch")),
    ],
)
def test_a_detail_that_is_none_is_refused(detail, message):
    flow = FaceSource((ChannelFormat("flow", 1, "direction"),), [[1], [1]])
    with pytest.raises(ArgumentError, match=message):
        levels(detail, square().with_sources({"flow": flow}))


@pytest.mark.parametrize(
    ("detail", "expected"),
    [
        ([1, 0.5], [DEPTH, DEPTH - 1]),  # the resolution relative to the finest
        ([0.25, 1 / 256], [DEPTH - 2, DEPTH - 8]),
        ([0, -1], [DEPTH - 8, DEPTH - 8]),  # cells at most 256 times as wide
        ([7, np.nan], [DEPTH, DEPTH]),
        (lambda _: [-3, 40], [0, DEPTH]),
        (lambda _: [np.inf, -np.inf], [DEPTH, 0]),
        ("stretch", [DEPTH, DEPTH]),  # of no pose
    ],
)
def test_channels_and_functions_say_how_deep_to_go(detail, expected):
    is_channel = isinstance(detail, list)
    found = levels("wear", painted(detail)) if is_channel else levels(detail, square())
    assert found == expected


def test_a_channel_goes_no_higher_than_the_root():
    assert levels("wear", painted([0, 0.5]), 3) == [0, 2]


def test_an_image_of_the_channel_detail_says_how_deep_to_go():
    grey = np.full((2, 2, 3), 128, np.uint8)
    plain = octex.Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, uv=SQUARE[:, :2])
    found = levels("detail", plain.with_sources({"detail": grey}))
    np.testing.assert_allclose(found, DEPTH + np.log2(128 / 255), atol=1e-6)


def test_a_channel_that_detail_names_is_read_with_the_others():
    assert with_detail(["a"], "wear") == ["a", "wear"]
    for detail in ("stretch", "a", None, lambda points: points[:, 0]):
        assert with_detail(["a"], detail) == ["a"]
    assert with_detail(None, "wear") is None


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


def test_a_rest_mesh_or_a_pose_without_area_has_no_stretch():
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 2, 0]], float)  # the second triangle is a line
    surface = octex.Surface.from_arrays(SQUARE, [[0, 1, 2], [0, 2, 3]], rest=flat)
    with pytest.raises(ModelError, match="its rest mesh has no area"):
        levels("stretch", surface)
    with pytest.raises(ModelError, match='its pose has no area, which detail="stretch" needs'):
        levels("stretch", square(SQUARE * [1, 0, 0]))


def deepest(wanted, flags, entries):
    """How deep cells go that have these flags, and pieces in these entries of them."""
    count = len(entries)
    places = np.zeros(count, np.int32), np.full((count, 3), 1 / 3)
    codes = np.array([4, 7][: len(flags)])
    pieces = Fragments(codes, np.uint8(flags), np.int32(entries), *places, np.ones(count))
    return list(deepest_wanted(wanted, pieces, np.zeros(count, np.float32)))


def test_a_cell_goes_as_deep_as_any_surface_in_it_wants():
    entries = [1, 0, 2, 2]  # the first cell has two, one for each facing
    assert deepest(lambda *_: np.array([3.0, 5.0, 2.2, 4.04]), [0b110000, 0b000010], entries) == [5, 4]


@pytest.mark.parametrize(
    ("code", "level"), [(255, 10), (134, 10), (128, 9), (64, 8), (65, 8), (1, 2), (0, 2)]
)
def test_halves_in_eight_bits_are_whole_levels(code, level):
    wanted = wanted_levels("wear", painted([code / 255] * 2), DEPTH)
    assert deepest(wanted, [1], [0]) == [level]
