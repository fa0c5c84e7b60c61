"""Textures with other values: mapped, levels, curves, blurred, cast."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.arrays import bit_counts
from octex.channels import (
    ALPHA,
    BASE_COLOR,
    EMISSIVE,
    NORMAL,
    ROUGHNESS,
    decode,
    encode,
    linear_to_srgb,
    srgb_to_linear,
)
from octex.errors import ArgumentError
from octex.texture import Channel, OctreeTexture
from tests.conftest import needs_jit
from tests.make.small_surfaces import sheet
from tests.make.small_textures import UNIT, UNIT_BOUNDS, eight_colors, shell
from tests.make.strategies import textures
from tests.oracles import naive_processing as naive
from tests.oracles.naive import unmorton


def assert_same_values(one, other):
    assert one.channels.keys() == other.channels.keys()
    for name, channel in one.channels.items():
        for a, b in zip(channel[1:], other.channels[name][1:], strict=True):
            np.testing.assert_array_equal(a, b)


def assert_averaged(texture):
    """Every node is the mean of its children, but for rounding."""
    cells = naive.cells_of(texture)
    for name, channel in texture.channels.items():
        form = channel.format
        for place, cell in cells.items():
            if cell.is_leaf or not texture.tree.n_leaves:
                continue
            wanted = encode(naive.mean_below(texture, name, cells, place), form.dtype, form.space)
            tolerance = 1 if form.dtype.startswith("u") else 2e-3
            np.testing.assert_allclose(
                channel.values[cell.number].astype(float), wanted.astype(float), atol=tolerance
            )


def of_channel(values, form):
    """Eight leaves and their root."""
    stored = encode(np.broadcast_to(values, (9, form.components)), form.dtype, form.space)
    return eight_colors(channels={form.name: Channel(form, stored, stored[:0], stored[:0])})


# --- map


@given(textures(5))
def test_what_maps_to_itself_stays_as_it_was(texture):
    names = [
        name
        for name, channel in texture.channels.items()
        # the curve of floats is not undone to the last bit
        if not (channel.format.space == "srgb" and channel.format.dtype.startswith("float"))
    ]
    made = octex.map(texture, lambda values: values, names)
    made.validate()
    for name, channel in texture.channels.items():
        for a, b in zip(channel[1:], made.channels[name][1:], strict=True):
            if channel.format.dtype == "float32":  # in averages, the last bits
                np.testing.assert_allclose(a, b, atol=1e-6)
            else:
                np.testing.assert_array_equal(a, b)
    assert made.metadata["source"] == "drawn"


@given(textures(4), st.booleans())
def test_averages_are_the_means_of_what_was_mapped(texture, by_position):
    texture = naive.unfitted(texture)
    before = [array.copy() for channel in texture.channels.values() for array in channel[1:]]

    def bent(values, positions):
        return values**2 * (0.5 + 0.1 * np.sin(positions[:, :1]))

    made = octex.map(texture, bent if by_position else lambda values: values**3, list(texture.channels))
    made.validate()
    assert_averaged(made)
    after = [array for channel in texture.channels.values() for array in channel[1:]]
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_positions_are_the_centres_of_cells():
    made = octex.map(eight_colors(), lambda values, positions: positions + 0 * values)
    for place, cell in naive.cells_of(made).items():
        if cell.is_leaf:
            centre = [(0.25, 0.75)[place[1] >> axis & 1] for axis in range(3)]
            code = encode(np.array(centre), "uint8", "srgb")
            np.testing.assert_array_equal(made.channels["base_color"].values[cell.number], code)


@needs_jit
def test_an_affine_map_commutes_with_lookups():
    texture = octex.cast(shell(4), "float32")
    made = octex.map(texture, lambda values: 0.25 + 0.5 * values)
    points = np.random.default_rng(0).random((500, 3))
    for how in ({}, {"width": 0.1}, {"width": 0.3, "normals": points - 0.5}, {"filter": "nearest"}):
        found = texture.sample(points, **how)
        np.testing.assert_allclose(made.sample(points, **how), 0.25 + 0.5 * found, atol=2e-6)


def test_rows_of_split_nodes_follow_what_their_children_show():
    texture = octex.cast(shell(3), "float32")
    made = octex.map(texture, lambda values: values**2)
    tree = texture.tree
    cells = np.repeat(tree.split.cells, bit_counts(tree.split.facings))
    at_leaves = np.isin(cells, tree.leaf_cells())
    before, after = (each.channels["base_color"].split_values for each in (texture, made))
    np.testing.assert_allclose(after[at_leaves], before[at_leaves] ** 2, atol=1e-6)
    assert (np.abs(after - before**2)[~at_leaves] > 1e-3).any()  # means of squares are no squares of means
    back = octex.map(made, np.sqrt).channels["base_color"].split_values
    np.testing.assert_allclose(back[at_leaves], before[at_leaves], atol=1e-6)


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda values: values[:, :2],
         r"<lambda> must return an array of shape \(9, 3\), not \(9, 2\), for 9 points"),
        (lambda values: values + np.where(np.arange(len(values)) == 2, np.nan, 0)[:, None],
         r"<lambda> returned nan, nan, nan at \(0.75, 0.25, 0.25\); values must be finite"),
        (lambda values: values.undefined,
         r"raised AttributeError: .* for 9 points from \(0.5, 0.5, 0.5\) on"),
        (lambda values: values.astype(str), "must return real numbers, not <U32"),
    ],
)  # fmt: skip
def test_a_map_that_fails_is_named_with_the_first_bad_cell(f, message):
    with pytest.raises(ArgumentError, match=message):
        octex.map(eight_colors(), f)


def test_functions_that_tell_nothing_of_their_parameters_get_values():
    class Opaque:
        __signature__ = "none"

        def __call__(self, values):
            return values

    assert_same_values(octex.map(eight_colors(), Opaque()), eight_colors())


def test_unknown_channels_are_refused():
    with pytest.raises(ArgumentError, match="unknown channel 'paint'; there are: base_color"):
        octex.map(eight_colors(), np.sqrt, "paint")


# --- levels and curves


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("form", [BASE_COLOR, ROUGHNESS])
def test_levels_are_a_function_of_encoded_values(form, dtype):
    texture = naive.unfitted(octex.cast(shell(3), dtype))
    if form is ROUGHNESS:
        texture = of_channel(np.linspace(0, 1, 9)[:, None], form._replace(dtype=dtype))
    made = octex.levels(texture, form.name, 0.1, 0.8, 1.5, 0.2, 0.9)
    made.validate()
    before, after = texture.channels[form.name], made.channels[form.name]
    values = decode(before.values, before.format.space).astype(np.float64)
    encoded = linear_to_srgb(values) if form is BASE_COLOR else values
    top = np.inf if dtype == "float32" else 1
    wanted = 0.2 + 0.7 * np.clip((encoded - 0.1) / 0.7, 0, top) ** (1 / 1.5)
    light = (
        srgb_to_linear(np.minimum(wanted, 1) if dtype != "float32" else wanted)
        if form is BASE_COLOR
        else wanted
    )
    leaves = texture.tree.leaf_cells()
    found = decode(after.values, after.format.space)
    np.testing.assert_allclose(found[leaves], light[leaves], atol=0.01 if dtype == "uint8" else 1e-4)
    if form is BASE_COLOR:
        assert_averaged(made)


@given(textures(5))
def test_levels_and_curves_that_change_nothing_change_no_byte_of_integers(texture):
    names = [
        name
        for name, channel in texture.channels.items()
        if channel.format.dtype.startswith("u") and channel.format.space != "direction"
    ]
    assert_same_values(octex.levels(texture, names), texture)
    assert_same_values(octex.curves(texture, names, [(0, 0), (0.3, 0.3), (1, 1)]), texture)


def test_each_component_can_have_levels_of_its_own():
    texture = octex.map(eight_colors(), lambda values: np.full_like(values, 0.2))
    made = octex.levels(texture, gamma=(1, 2, 1), out_white=(1, 1, 0))
    code = texture.channels["base_color"].values[1, 0]
    expected = [code, round(255 * (code / 255) ** 0.5), 0]
    np.testing.assert_array_equal(made.channels["base_color"].values[1], expected)


def test_light_above_white_goes_on_in_floats():
    bright = of_channel(np.array([[4.0, 1.0, 0.0]]), EMISSIVE._replace(space="linear", dtype="float16"))
    same = octex.levels(bright, "emissive")
    np.testing.assert_allclose(
        same.channels["emissive"].values, bright.channels["emissive"].values, rtol=1e-3
    )


def test_a_curve_passes_its_points_and_never_turns_between_them():
    points = [(0.0, 0.1), (0.2, 0.15), (0.4, 0.8), (0.6, 0.8), (1.0, 0.9)]
    texture = of_channel(np.linspace(0, 1, 9)[:, None], ROUGHNESS._replace(dtype="float32"))
    for low, high in points:
        one = of_channel(np.array([[low]]), ROUGHNESS._replace(dtype="float32"))
        assert octex.curves(one, "roughness", points).channels["roughness"].values[1, 0] == pytest.approx(
            high
        )
    found = octex.curves(texture, "roughness", points).channels["roughness"].values[1:, 0]
    assert (np.diff(found) >= 0).all()
    flat = octex.curves(texture, "roughness", [(0.5, 0.25)])
    np.testing.assert_allclose(flat.channels["roughness"].values, 0.25)


def test_each_component_can_have_a_curve_of_its_own():
    texture = octex.map(eight_colors(), lambda values: np.full_like(values, 0.2))
    straight, inverted = [(0, 0), (1, 1)], [(0, 1), (0.5, 0.5), (1, 0)]
    made = octex.curves(texture, "base_color", [straight, inverted, straight])
    code = int(texture.channels["base_color"].values[1, 0])
    np.testing.assert_array_equal(made.channels["base_color"].values[1], [code, 255 - code, code])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda each: octex.levels(each, black=0.5, white=0.5), "black below white and gamma above zero"),
        (lambda each: octex.levels(each, gamma=0), "gamma above zero"),
        (lambda each: octex.levels(each, black=(0, 0)), "black of 'base_color' must be numbers of shape"),
        (lambda each: octex.levels(each, white=2), "white must be from 0 to 1, not 2"),
        (lambda each: octex.levels(each, "normal"), "'normal' holds directions, which have no levels"),
        (lambda each: octex.curves(each, "base_color", [(1, 0), (0, 1)]), "pairs of encoded values"),
        (lambda each: octex.curves(each, "base_color", []), "pairs of encoded values"),
        (lambda each: octex.curves(each, "base_color", ["x"]), "pairs of encoded values"),
        (lambda each: octex.curves(each, "base_color", [[(0, 0)], [(0, 0), (1, 1)]]), "pairs of encoded"),
        (lambda each: octex.curves(each, "base_color", [[(0, 0)], ["x"], [(0, 0), (1, 1)]]), "pairs of"),
        (lambda each: octex.curves(each, "base_color", 3), "pairs of"),
    ],
)  # fmt: skip
def test_levels_and_curves_out_of_range_are_refused(change, message):
    normal = Channel(NORMAL, *(np.zeros((rows, 3), np.uint8) for rows in (9, 0, 0)))
    texture = eight_colors()
    texture = eight_colors(channels={**texture.channels, "normal": normal})
    with pytest.raises(ArgumentError, match=message):
        change(texture)


# --- blur


@needs_jit
def test_the_blur_of_a_constant_is_the_constant():
    texture = octex.map(shell(4), lambda values: np.full_like(values, 0.3))
    for width in (0.01, 0.1, 1.0):
        made = octex.blur(texture, width)
        made.validate()
        assert_same_values(made, texture)


@needs_jit
def test_a_blur_of_no_width_changes_nothing_and_one_of_little_next_to_nothing():
    texture = shell(4)
    assert octex.blur(texture, 0.0) is texture
    fine = octex.cast(texture, "float32")
    made = octex.blur(fine, 1e-6).channels["base_color"]
    np.testing.assert_allclose(made.values, fine.channels["base_color"].values, atol=1e-3)
    np.testing.assert_allclose(made.kept_values, fine.channels["base_color"].kept_values, atol=1e-3)


@needs_jit
def test_a_blur_wider_than_all_is_the_mean_of_all():
    texture = eight_colors()
    wide, wider = (octex.blur(texture, width).channels["base_color"].values for width in (1e9, 1e308))
    np.testing.assert_array_equal(wide, wider)


def test_a_blur_is_what_a_lookup_of_that_width_says():
    texture = naive.unfitted(octex.cast(shell(4), "float32"))
    made = octex.blur(texture, 0.2)
    made.validate()
    assert_averaged(made)
    faces = texture.tree.arrays.flags
    checked = 0
    for (level, code), cell in naive.cells_of(texture).items():
        if cell.is_leaf and faces[cell.number] in (1, 2, 4, 8, 16, 32):
            facing = int(faces[cell.number]).bit_length() - 1
            normal = np.zeros(3)
            normal[facing // 2] = 1 - 2 * (facing % 2)
            centre = (np.array(unmorton(code)) + 0.5) / 2**level
            found = texture.sample([centre], width=0.2, normals=[normal])[0]
            np.testing.assert_allclose(made.channels["base_color"].values[cell.number], found, atol=1e-6)
            checked += 1
    assert checked > 10


@needs_jit
def test_nothing_bleeds_through_a_sheet():
    texture = octex.blur(octex.convert(sheet(np.eye(3), 1e-4), 5), 0.2)
    for normal, color in (((0, 0, 1), (1, 0, 0)), ((0, 0, -1), (0, 1, 0))):
        found = texture.sample([[0.0, 0.0, 0.0]], normals=[normal])[0]
        np.testing.assert_allclose(found, color, atol=0.02)


@pytest.mark.parametrize("width", [-1.0, np.inf, np.nan])
def test_a_width_that_is_none_is_refused(width):
    with pytest.raises(ArgumentError, match="width must be"):
        octex.blur(eight_colors(), width)


# --- ranges


def light(leaves, root, alphas, dtype):
    """Eight grey leaves and their root, with alpha, that of the root first."""
    colors = np.repeat(np.array([root, *leaves])[:, None], 3, axis=1)
    channels = {}
    space = "srgb" if dtype.startswith("u") else "linear"
    for form, values in ((BASE_COLOR._replace(space=space), colors), (ALPHA, np.array(alphas)[:, None])):
        stored = encode(values, dtype, form.space)
        channels[form.name] = Channel(form._replace(dtype=dtype), stored, stored[:0], stored[:0])
    return eight_colors(channels=channels)


@pytest.mark.parametrize("edit", [octex.map, octex.levels])
def test_alpha_stays_within_0_and_1_in_floats_too(edit):
    texture = light([0.5] * 8, 0.5, [0.5] * 9, "float32")
    how = {"f": lambda values: 4 * values - 1.5} if edit is octex.map else {"white": 0.3}
    made = edit(texture, channel=["alpha"], **how)
    alpha = made.channels["alpha"].values
    assert alpha.max() <= 1
    lower = edit(texture, channel=["alpha"], **(how if edit is octex.levels else {"f": lambda a: a - 2}))
    assert lower.channels["alpha"].values.min() >= 0


def test_what_was_transparent_does_not_show_once_it_is_opaque():
    texture = light([0.2] * 8, 0.9, [0.0] * 9, "float32")  # a colour that nothing covered
    made = octex.map(texture, lambda alpha: 1 - alpha, "alpha")
    np.testing.assert_allclose(made.channels["base_color"].values[0], 0.2, atol=0.002)


def test_a_node_that_gets_less_opaque_keeps_what_it_differs_by():
    texture = light([0.2] * 8, 0.3, [0.8] * 9, "float32")
    made = octex.map(texture, lambda alpha: alpha / 2, "alpha")
    np.testing.assert_allclose(made.channels["base_color"].values[0], 0.3, atol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_levels_of_colours_and_alpha_at_once_are_those_of_one_after_the_other(dtype):
    alphas = [0.45, *np.linspace(0.1, 0.8, 8)]
    colors = np.linspace(0.0, 1.0, 8)
    mean = np.average(colors, weights=alphas[1:])
    texture = light(colors.tolist(), mean, alphas, dtype)
    how = {"black": 0.3, "white": 0.6}
    at_once = octex.levels(texture, ["base_color", "alpha"], **how)
    one_by_one = octex.levels(octex.levels(texture, "alpha", **how), "base_color", **how)
    for name, channel in at_once.channels.items():
        other = one_by_one.channels[name].values.astype(float)
        tolerance = 1 if dtype == "uint8" else 1e-6
        np.testing.assert_allclose(channel.values.astype(float), other, atol=tolerance)


# --- cast


@given(textures(4))
def test_integers_come_back_from_wider_types(texture):
    for name, channel in texture.channels.items():
        dtype, space = channel.format.dtype, channel.format.space
        if dtype.startswith("u") and space != "linear":
            one = octex.cast(texture, channels=[name])
            for wider in ("uint16", "float32"):
                back = octex.cast(octex.cast(one, wider), dtype)
                back.validate()
                assert back.channels[name].format == channel.format
                assert_same_values(back, one)


def test_channels_are_dropped_and_ordered_and_types_given_by_name():
    tree = eight_colors().tree
    channels = {
        form.name: Channel(form, *(np.zeros((rows, form.components), np.uint8) for rows in (9, 0, 0)))
        for form in (BASE_COLOR, ROUGHNESS, NORMAL)
    }
    texture = OctreeTexture(tree, channels, UNIT, UNIT_BOUNDS)
    made = octex.cast(texture, {"normal": "uint16"}, ["normal", "base_color"])
    assert [(each.format.name, each.format.dtype) for each in made.channels.values()] == [
        ("normal", "uint16"),
        ("base_color", "uint8"),
    ]
    assert made.channels["base_color"] is texture.channels["base_color"]
    assert json.loads(made.metadata["processed"])[0]["operation"] == "cast"
    light = octex.cast(texture, "float16").channels["base_color"].format
    assert (light.dtype, light.space) == ("float16", "linear")
    for arguments, message in (
        (("int8",), "unknown dtype 'int8'"),
        (({"paint": "uint8"},), "unknown channel of dtype 'paint'"),
        ((None, ["paint"]), "unknown channel 'paint'"),
        ((None, ["normal", "normal"]), "named twice"),
    ):
        with pytest.raises(ArgumentError, match=message):
            octex.cast(texture, *arguments)


@pytest.mark.parametrize(("value", "where"), [(1.5, "above 1"), (-0.5, "below 0")])
def test_integers_do_not_take_what_they_cannot_hold(value, where):
    form = EMISSIVE._replace(space="linear", dtype="float16")
    bright = of_channel(np.array([[value, 0.0, 0.0]]), form)
    message = f"'emissive' has values {where}, which uint8 cannot hold; give it the dtype float16 or float32"
    with pytest.raises(ArgumentError, match=message):
        octex.cast(bright, "uint8")
    assert octex.cast(bright, "float32").channels["emissive"].values[0, 0] == value


def test_what_was_done_is_noted_after_what_was_done_before():
    made = octex.levels(octex.cast(eight_colors(), "uint16"), gamma=2)
    assert made.metadata["source"] == "eight"
    assert [each["operation"] for each in json.loads(made.metadata["processed"])] == ["cast", "levels"]
    odd = octex.cast(eight_colors(metadata={"processed": "by hand"}), "uint16")
    assert json.loads(odd.metadata["processed"])[0] == "by hand"
