"""Differences between textures and models, measured again in slow and obvious ways."""

import math
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat, encode, linear_to_srgb
from octex.drawing import compare
from octex.drawing.compare import difference
from octex.errors import ArgumentError
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.layout import AREA_ONE
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

ROUGHNESS = ChannelFormat("roughness", 1, "data")
NORMAL = ChannelFormat("normal", 3, "direction", "float32")
UNIT = Placement((0.0, 0.0, 0.0), 1.0)


DROID = Path(octex.__file__).parents[1] / "samples" / "droid.glb"


def sheet(values, depth=3, *, rows=slice(None), placement=UNIT, layer=0, areas=AREA_ONE):
    """A texture of one layer of cells; values per cell broadcast to (rows, columns, components)."""
    width = 1 << depth
    cells = np.stack(np.meshgrid(*[np.arange(width)] * 2, indexing="ij"), axis=-1)[rows].reshape(-1, 2)
    codes = encode_cells(np.column_stack([cells, np.full(len(cells), layer)]))
    order = np.argsort(codes)
    tree = Octree.from_leaves(codes[order], np.full(len(codes), depth))
    leaves = tree.leaf_cells()
    flags, codes = np.full(tree.n_cells, 16, np.uint8), np.zeros(tree.n_cells, np.uint8)
    codes[leaves] = np.broadcast_to(areas, (width, width))[rows].reshape(-1)[order]
    tree = tree.with_cell_data(flags, codes)
    channels = {}
    for form, value in values.items():
        every = np.broadcast_to(np.asarray(value, np.float64), (width, width, form.components))[rows]
        stored = np.zeros((tree.n_cells, form.components))
        stored[leaves] = every.reshape(-1, form.components)[order]
        array = (
            stored.astype(form.dtype) if form.space == "direction" else encode(stored, form.dtype, form.space)
        )
        channels[form.name] = Channel(form, array, array[:0], array[:0])
    corners = np.array([placement.origin, np.add(placement.origin, placement.size)])
    return OctreeTexture(tree, channels, placement, corners, {})


def noise(seed, components=3, depth=3):
    return np.random.default_rng(seed).random((1 << depth, 1 << depth, components))


def code(linear):
    return 255 * (12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)


def test_two_textures_are_compared_leaf_by_leaf():
    a, b = sheet({BASE_COLOR: noise(1)}), sheet({BASE_COLOR: noise(2)})
    found = difference(a, b)
    squares, largest = [], []
    for i in range(8):
        for j in range(8):
            point = [[(i + 0.5) / 8, (j + 0.5) / 8, 0.5 / 8]]
            apart = [code(v) - code(u) for u, v in zip(a.sample(point)[0], b.sample(point)[0], strict=True)]
            squares += [each**2 for each in apart]
            largest.append((max(map(abs, apart)), point[0], a.sample(point)[0], b.sample(point)[0]))
    result = found["base_color"]
    rms = math.sqrt(sum(squares) / len(squares))
    assert result.measure == "sRGB, 1/255"
    assert result.rms == pytest.approx(rms, rel=1e-5)
    assert result.psnr == pytest.approx(20 * math.log10(255 / rms), rel=1e-5)
    most, where, *values = max(largest, key=lambda each: each[0])
    assert result.maximum == pytest.approx(most, rel=1e-5)
    assert list(result.where) == pytest.approx(where)
    for got, expected in zip((result.a, result.b), values, strict=True):
        assert list(got) == pytest.approx([code(each) for each in expected], abs=1e-3)
    ranked = sorted(each[0] for each in largest)
    assert result.p99 == pytest.approx(ranked[math.ceil(0.99 * 64) - 1], rel=1e-3)
    assert found.points == 128  # the leaves of both
    assert found.width is None
    assert found.unmatched == ((), ())
    assert found.areas == pytest.approx((1.0, 1.0))
    assert found.uncovered == (0.0, 0.0)


def test_textures_are_read_with_the_filter_asked_for():
    values = np.zeros((8, 8, 1))
    values[2, 5] = 1.0
    a, b = sheet({ROUGHNESS: 0.0}), sheet({ROUGHNESS: values})
    for options, filter, most in (({}, "quadratic", 0.75**2), ({"filter": "nearest"}, "nearest", 1.0)):
        found = difference(a, b, **options)
        assert (found.filter, found["roughness"].measure) == (filter, "0 to 1")
        assert found["roughness"].maximum == pytest.approx(most)  # the spline's weight in the middle


def test_a_texture_does_not_differ_from_itself_and_which_is_first_matters_for_the_names_alone():
    texture = sheet({BASE_COLOR: noise(1), ROUGHNESS: noise(2, 1)})
    found = difference(texture, texture)
    assert list(found) == ["base_color", "roughness"]
    for result in found.values():
        assert (result.rms, result.p99, result.maximum, result.psnr) == (0.0, 0.0, 0.0, math.inf)
        assert result.a == result.b
    a, b = sheet({BASE_COLOR: noise(1)}), sheet({BASE_COLOR: noise(2)}, rows=slice(2, 8))
    there, back = difference(a, b), difference(b, a)
    assert there["base_color"].rms == pytest.approx(back["base_color"].rms)
    assert there["base_color"].a == back["base_color"].b
    assert there.areas == back.areas[::-1]
    assert there.uncovered == back.uncovered[::-1]


@pytest.mark.parametrize(
    ("larger", "rms", "p99"),
    [(16, math.sqrt(4 / 67), 1.0), (-16, math.sqrt(0.25 / 63.25), 0.0)],  # at last less than a hundredth
)
def test_leaves_count_by_their_area(larger, rms, p99):
    values, areas = np.zeros((8, 8, 1)), np.full((8, 8), AREA_ONE)
    values[2, 5] = 1.0
    areas[2, 5] += larger  # four times as much, or a quarter
    a, b = (sheet({ROUGHNESS: each}, areas=areas) for each in (0.0, values))
    result = difference(a, b, filter="nearest")["roughness"]
    assert result.rms == pytest.approx(rms)
    assert (result.p99, result.maximum) == (p99, 1.0)


def test_textures_of_another_placement_and_depth_are_compared_where_they_are():
    # The same colours, once as leaves of depth 3, once shifted by whole cells in a larger root, finer.
    values = noise(3)
    a = sheet({BASE_COLOR: values})
    fine = np.zeros((32, 32, 3))
    fine[8:24, 8:24] = values.repeat(2, axis=0).repeat(2, axis=1)
    whole = sheet({BASE_COLOR: fine}, 5, placement=Placement((-0.5, -0.5, -0.01), 2.0))
    found = difference(a, whole, filter="nearest")
    assert found["base_color"].maximum < 1e-4
    assert found.areas == pytest.approx((1.0, 4.0))
    assert found.uncovered == (0.0, 0.75)
    assert found.points == 64 + 16**2


def test_what_only_one_texture_covers_is_left_out_and_counted():
    a = sheet({ROUGHNESS: 0.0}, rows=slice(0, 6))
    found = difference(a, sheet({ROUGHNESS: 1.0}, rows=slice(4, 8)))
    assert found.uncovered == pytest.approx((4 / 6, 2 / 4))
    assert found.areas == pytest.approx((6 / 8, 4 / 8))
    assert found.points == 2 * 2 * 8
    assert (found["roughness"].rms, found["roughness"].psnr) == (1.0, 0.0)
    for place in ({"rows": slice(6, 8)}, {"layer": 1}):
        with pytest.raises(ArgumentError, match="do not overlap: do they have the same rest positions"):
            difference(a, sheet({ROUGHNESS: 0.0}, **place))


def test_channels_that_only_one_has_are_named_and_one_that_means_something_else_is_refused():
    a, b = sheet({BASE_COLOR: 0.5, ROUGHNESS: 0.5}), sheet({ROUGHNESS: 0.25, ALPHA: 0.5})
    found = difference(a, b)
    assert list(found) == ["roughness"]
    assert found.unmatched == (("base_color",), ("alpha",))
    assert list(difference(a, a, channels=["roughness", "base_color"])) == ["roughness", "base_color"]
    for other, channels, message in (
        (b, ["alpha"], "unknown channel in both 'alpha'; there are: roughness"),
        (sheet({ALPHA: 0.5}), None, "no channel to compare: one has base_color, roughness, the other alpha"),
        (b, [], "no channel to compare"),
    ):
        with pytest.raises(ArgumentError, match=message):
            difference(a, other, channels=channels)
    light, data = ChannelFormat("own", 3, "linear", "float32"), ChannelFormat("own", 1, "data")
    with pytest.raises(
        ArgumentError,
        match=r"'own' has 3 components \(sRGB, 1/255\) on one side and 1 components \(0 to 1\) on the other",
    ):
        difference(sheet({light: 0.5}), sheet({data: 0.5}))


def test_light_is_compared_alike_however_it_is_stored_as_far_as_it_is_covered():
    linear = ChannelFormat("base_color", 3, "linear", "float32")
    stored = difference(sheet({BASE_COLOR: 0.25}), sheet({linear: 0.25}))["base_color"]
    assert stored.maximum < 0.5  # as stored in eight bits
    result = difference(sheet({linear: 1.0}), sheet({linear: 16.0}))["base_color"]
    assert result.maximum == pytest.approx(code(16.0) - 255, rel=1e-6)  # above 1, the curve goes on
    assert result.b == pytest.approx((code(16.0),) * 3)
    clear, half = {ALPHA: 0.0}, {ALPHA._replace(dtype="float32"): 0.5}
    for form, one, other, expected in (
        (BASE_COLOR, clear, clear, 0.0),
        (BASE_COLOR, half, half, code(0.5)),
        (BASE_COLOR, {}, clear, 255),  # without alpha on one side, light counts whole
        (ROUGHNESS, clear, clear, 1.0),  # data do not fade
    ):
        found = difference(sheet({form: 0.0, **one}), sheet({form: 1.0, **other}))
        assert found[form.name].maximum == pytest.approx(expected)


def test_directions_are_compared_by_components_and_by_angle():
    a, b = np.zeros((8, 8, 3)), np.zeros((8, 8, 3))
    a[..., 2] = b[..., 2] = 1.0
    b[3, 4] = [0.0, math.sin(math.radians(10)), math.cos(math.radians(10))]
    b[5, 6] = [0.0, 0.0, 0.5]  # a shorter mean of the same direction
    b[7, 7] = 0.0  # no direction at all
    result = difference(sheet({NORMAL: a}), sheet({NORMAL: b}), filter="nearest")["normal"]
    assert (result.measure, result.maximum) == ("components", 1.0)
    angle = result.angle
    assert angle is not None
    assert angle.measure == "degrees"
    assert angle.maximum == pytest.approx(10.0, abs=1e-4)
    assert angle.rms == pytest.approx(10 / 8, abs=1e-4)
    assert angle.psnr == pytest.approx(20 * math.log10(180 / angle.rms))
    assert angle.where == pytest.approx((3.5 / 8, 4.5 / 8, 0.5 / 8))
    assert angle.a == (0.0, 0.0, 1.0)


def test_memory_and_results_do_not_depend_on_the_blocks(monkeypatch):
    a, b = sheet({BASE_COLOR: noise(1)}), sheet({BASE_COLOR: noise(2)})
    whole = difference(a, b)
    calls = []
    monkeypatch.setattr(compare, "_BLOCK", 10)
    parts = difference(a, b, progress=lambda *call: calls.append(call))
    assert {call[0] for call in calls} == {"compare"}
    assert calls[0][1:] == (0, 128)
    assert calls[-1][1:] == (128, 128)
    assert max(np.diff([done for _, done, _ in calls])) <= 10
    for got, expected in zip(parts["base_color"][1:4], whole["base_color"][1:4], strict=True):
        assert got == pytest.approx(expected)
    assert parts["base_color"][4:] == whole["base_color"][4:]


# --- a texture and a model


def quarters():
    """A square of four colours, not along the axes."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.3], [0, 1, 0.3]])
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    return Surface.from_arrays(
        vertices,
        np.array([[0, 1, 2], [0, 2, 3]]),
        uv=vertices[:, :2],
        image=image.repeat(8, axis=0).repeat(8, axis=1),
        mag_filter="nearest",
    )


def test_a_texture_is_compared_with_its_model_at_points_on_it():
    surface = quarters()
    texture = octex.convert(surface, 4)
    found = difference(surface, texture, points=2000, width=0.0, seed=5)
    samples = surface.scatter(2000, _block_seed(5))
    truth, stored = surface.evaluate(samples), texture.sample(samples.rest)
    errors = [
        [code(u) - code(v) for u, v in zip(*pair, strict=True)] for pair in zip(truth, stored, strict=True)
    ]
    result = found["base_color"]
    assert result.rms == pytest.approx(float(np.sqrt(np.mean(np.square(errors)))), rel=1e-5)
    most = [max(map(abs, each)) for each in errors]
    assert result.maximum == pytest.approx(max(most), rel=1e-5)
    assert list(result.where) == samples.rest[int(np.argmax(most))].tolist()
    assert result.p99 == pytest.approx(sorted(most)[math.ceil(0.99 * 2000) - 1], rel=1e-3)
    assert (found.points, found.width) == (2000, 0.0)
    assert found.uncovered == (0.0, None)
    assert found.areas == pytest.approx((math.hypot(1, 0.3),) * 2, rel=0.04)
    swapped = difference(texture, surface, points=2000, width=0.0, seed=5)
    assert swapped["base_color"].a == result.b
    assert swapped.uncovered == (None, 0.0)


def _block_seed(seed):
    return int(np.random.SeedSequence([seed, 0]).generate_state(1, np.uint64)[0])


def test_a_model_is_averaged_over_the_finest_cells_unless_told_otherwise():
    surface = quarters()
    texture = octex.convert(surface, 4)
    found = difference(texture, surface, points=500)
    assert found.width == texture.placement.size / 16
    assert found == difference(texture, surface, points=500, width=texture.placement.size / 16)
    assert found["base_color"].rms < difference(texture, surface, points=500, width=0.0)["base_color"].rms
    assert found != difference(texture, surface, points=500, seed=1)


def test_both_are_averaged_over_a_wider_footprint():
    surface = octex.load_surface(DROID, channels=["base_color"])
    texture = octex.convert(surface, 7)
    width = 8 * texture.placement.size / 128
    found = difference(texture, surface, points=10_000, width=width)["base_color"].rms
    points = surface.scatter(10_000, seed=0)
    widths = np.full(10_000, width, np.float32)
    colors = surface.evaluate_all(points.triangles, points.barycentric, widths)
    apart = linear_to_srgb(texture.sample(points.rest)) - linear_to_srgb(colors)
    assert found < 0.9 * 255 * np.sqrt((apart**2).mean())


def test_parts_of_a_model_that_the_texture_lacks_are_counted():
    surface = quarters()
    above = Surface(surface.vertices + np.array([0.0, 0.0, 2.0]), surface.triangles, surface.source)
    twice = Surface.joined([surface, above])
    found = difference(twice, octex.convert(surface, 5), points=2000)
    first, second = found.uncovered
    assert first == pytest.approx(0.5, abs=0.05)
    assert second is None
    assert found.points == round(2000 * (1 - first))
    assert found["base_color"].rms < 60
    assert found.areas[0] == pytest.approx(2 * math.hypot(1, 0.3))


def test_a_model_is_compared_where_it_is_at_rest():
    surface = quarters()
    texture = octex.convert(surface, 4)
    posed = Surface(surface.vertices * 3, surface.triangles, surface.source, rest=surface.rest)
    found = difference(posed, texture, points=1000)
    assert found.uncovered[0] == 0.0
    assert found.areas[0] == pytest.approx(math.hypot(1, 0.3))
    assert found["base_color"] == difference(surface, texture, points=1000)["base_color"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": 0}, "points must be a whole number from 1 to 1099511627776, not 0"),
        ({"seed": -1}, "seed must be a whole number from 0 to 1099511627776, not -1"),
        ({"width": -1.0}, "width must be from 0 to 1e.30, not -1"),
        ({"width": math.nan}, "width must be from 0 to 1e.30, not nan"),
        ({"filter": "cubic"}, "unknown filter 'cubic'; there are: nearest"),
        ({"b": quarters()}, "two models cannot be compared with each other"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, message):
    surface = quarters()
    with pytest.raises(ArgumentError, match=message):
        difference(surface, **{"b": octex.convert(surface, 2), **arguments})


def test_values_that_are_not_finite_are_refused_by_their_channel():
    surface = Surface.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    texture = octex.convert(surface, 3, dtype="float32")
    channel = texture.channels["base_color"]
    values = channel.values.copy()
    values[-1] = np.nan
    channels = {"base_color": channel._replace(values=values)}
    texture = octex.OctreeTexture(texture.tree, channels, texture.placement, texture.bounds)
    with pytest.raises(ArgumentError, match="channel 'base_color' has values that are not finite; validate"):
        difference(texture, surface, points=1000)
