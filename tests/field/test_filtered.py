"""Filtered lookups: footprints, what faces a normal, and the paper's rule."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from octex.channels import ChannelFormat
from octex.errors import ArgumentError
from octex.parallel import Run
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.layout import SplitTable
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from tests.make.small_textures import UNIT, UNIT_BOUNDS, shell, unit
from tests.oracles.naive_views import Views

each_filter = pytest.mark.parametrize("filter", FILTERS)


def on_shell(count, seed=0):
    """Points of the shell, and directions."""
    random = np.random.default_rng(seed)
    away, normals = random.normal(size=(2, count, 3))
    return 0.5 + 0.45 * away / np.linalg.norm(away, axis=1)[:, None], normals


def as_four(texture, points, filter, **views):
    """What the same colours give as four components."""
    form = texture.channels["base_color"].format._replace(name="other", components=4)
    channel = texture.channels["base_color"]
    wide = [np.ascontiguousarray(np.repeat(part, 2, axis=1)[:, :4]) for part in channel[1:]]
    both = OctreeTexture(texture.tree, {"other": Channel(form, *wide)}, texture.placement, texture.bounds)
    return both.sample(points, "other", filter, **views)[:, [0, 2]]


# --- beside the slow reference


@each_filter
@pytest.mark.parametrize("keep", [0.0, 0.3])
def test_footprints_and_facings_are_those_of_the_reference(filter, keep):
    texture = shell(4, keep)
    points, normals = on_shell(40)
    points[-5:] = 0.5 + 0.2 * (points[-5:] - 0.5)  # off the surface
    widths = np.random.default_rng(1).choice([0.01, 0.1, 0.13, 0.2, 0.3, 0.5, 1.0, 3.0], 40)
    views = Views(texture, "base_color", filter)
    for given_normals in (None, normals):
        found = texture.sample(points, filter=filter, width=widths, normals=given_normals)
        wide = as_four(texture, points, filter, width=widths, normals=given_normals)
        np.testing.assert_allclose(wide, found[:, :2], atol=2e-6)
        for n in range(len(points)):
            normal = None if given_normals is None else unit(normals[n])
            expected = views.value(points[n], float(widths[n]), normal)
            np.testing.assert_allclose(found[n], expected, atol=2e-4)


@pytest.mark.parametrize("filter", ["quadratic", "quartic"])
def test_gradients_follow_what_footprints_without_normals_leave_to_finer_levels(filter):
    texture = shell(4, 0.4)
    points, _ = on_shell(300)
    for width in (0.07, 0.2, 0.5):
        _, gradients = texture.sample(points, filter=filter, gradient=True, width=width)
        step = 1e-4
        for axis in range(3):
            ahead, behind = (
                texture.sample(points + sign * step * np.eye(3)[axis], filter=filter, width=width)
                for sign in (1, -1)
            )
            slopes = (ahead.astype(float) - behind) / (2 * step)
            wrong = np.abs(slopes - gradients[:, :, axis]) > 0.005 * np.abs(slopes).max()
            assert wrong.mean() < 0.01  # where a step crosses what bends


# --- footprints


def test_a_width_of_nothing_is_the_field_and_a_great_one_the_roots_average():
    texture = shell(4, 0.0)
    points, _ = on_shell(50)
    np.testing.assert_allclose(texture.sample(points, width=0.0), texture.sample(points), atol=1e-6)
    whole = texture.level(0).sample(points)
    np.testing.assert_allclose(texture.sample(points, width=1e30, bleed_threshold=9), whole, atol=1e-6)


def test_one_width_and_one_for_each_point_are_alike():
    texture = shell(4, 0.0)
    points, normals = on_shell(50)
    twice, widths = np.repeat(points, 2, axis=0), np.tile([0.13, 0.3], 50)
    for sharpness in (0.0, 0.7):
        one = texture.sample(points, width=0.13, sharpness=sharpness)
        many = texture.sample(twice, width=widths, sharpness=sharpness)
        np.testing.assert_allclose(one, many[::2], atol=1e-6)
    one = texture.sample(points, width=0.13, normals=normals)
    many = texture.sample(twice, width=widths, normals=np.repeat(normals, 2, axis=0))
    np.testing.assert_allclose(one, many[::2], atol=1e-6)


@pytest.mark.parametrize("executor", [False, True])
def test_blocks_and_runs_do_not_change_what_is_found(monkeypatch, executor):
    texture = shell(4, 0.3)
    points, normals = on_shell(90)
    right, down = np.random.default_rng(4).normal(size=(2, 90, 3)) * [[[0.3]], [[0.05]]]
    views = {"dPdx": right, "dPdy": down, "normals": normals}
    expected = texture.sample(points, **views), as_four(texture, points, "quadratic", **views)
    monkeypatch.setattr("octex.texture.lookup.BLOCK", 32)
    monkeypatch.setattr("octex.field.footprints._ROOM", 100)
    monkeypatch.setattr("octex.field.field.BLOCK", 50)
    with ThreadPoolExecutor(2) as pool:
        run = Run(executor=pool if executor else None)
        np.testing.assert_allclose(texture.sample(points, **views, run=run), expected[0], atol=1e-6)
        found = as_four(texture, points, "quadratic", **views, run=run)
        np.testing.assert_allclose(found, expected[1], atol=1e-6)


def wavy(depth, frequency):
    """A plate in the plane z = ½ whose brightness is a wave along x, exactly averaged."""
    places = np.mgrid[: 2**depth, : 2**depth].reshape(2, -1).T
    codes = np.sort(encode_cells(np.column_stack([places, np.full(len(places), 2 ** (depth - 1))])))
    tree = Octree.from_leaves(codes, depth)
    values = np.empty((tree.n_cells, 3), np.float32)
    for level in range(depth + 1):
        x = decode_cells(tree.level_codes(level))[:, 0] / 2**level
        ends = np.stack([x, x + 0.5**level])
        means = np.diff(np.sin(frequency * ends), axis=0)[0] / frequency * 2**level
        first = tree.arrays.level_cells[level]
        values[first : first + len(x)] = 0.5 + 0.5 * means[:, None]
    none = values[:0]
    form = ChannelFormat("base_color", 3, "linear", "float32")
    return OctreeTexture(tree, {"base_color": Channel(form, values, none, none)}, UNIT, UNIT_BOUNDS)


@each_filter
def test_footprints_have_the_variance_of_a_box(filter):
    frequency = 2 * np.pi * 3
    texture = wavy(8, frequency)
    x = np.linspace(0.3, 0.7, 400)
    points = np.column_stack([x, np.full_like(x, 0.41), np.full_like(x, 0.502)])
    for width in (0.04, 0.05, 0.06, 0.08, 0.1):
        shown = texture.sample(points, filter=filter, width=width)[:, 0] - 0.5
        contrast = 2 * np.abs(np.linalg.lstsq(_waves(x, frequency), shown, rcond=None)[0][:2]).max()
        box = np.sin(frequency * width / 2) / (frequency * width / 2)
        assert abs((1 - contrast) / (1 - box) - 1) < (1.5 if filter == "nearest" else 0.65)


def _waves(x, frequency):
    return np.column_stack([np.cos(frequency * x), np.sin(frequency * x), np.ones_like(x)])


@pytest.mark.parametrize("filter", ["linear", "quadratic", "quartic"])
def test_long_footprints_average_along_and_not_across(filter):
    frequency = 2 * np.pi * 6
    texture = wavy(9, frequency)
    x = np.linspace(0.35, 0.65, 200)
    points = np.column_stack([x, np.full_like(x, 0.41), np.full_like(x, 0.502)])
    along, across = np.tile([[0.08, 0.0, 0.0]], (200, 1)), np.tile([[0.0, 0.01, 0.0]], (200, 1))
    box = np.sin(frequency * 0.08 / 2) / (frequency * 0.08 / 2)
    for right, down, expected in (
        (along, across, box),
        (across, along, box),
        (along[:, [1, 0, 2]], across[:, [1, 0, 2]], 0.98),
    ):
        shown = texture.sample(points, filter=filter, dPdx=right, dPdy=down)[:, 0] - 0.5
        truth = 0.5 * expected * np.cos(frequency * x)
        assert np.abs(shown - truth).max() < 0.03, (filter, expected)


def test_a_mean_is_a_mean_however_it_is_looked_at():
    texture = shell(4, 0.0)
    channel = texture.channels["base_color"]
    plain = channel._replace(
        values=np.full_like(channel.values, 77), split_values=np.full_like(channel.split_values, 77)
    )
    texture = OctreeTexture(texture.tree, {"base_color": plain}, UNIT, UNIT_BOUNDS)
    points, normals = on_shell(300)
    expected = texture.sample(points[:1])[0, 0]
    random = np.random.default_rng(2)
    right, down = random.normal(size=(2, 300, 3)) * 2.0 ** random.uniform(-9, 2, (2, 300, 1))
    for filter in FILTERS:
        for views in (
            {"width": random.random(300)},
            {"width": 0.1, "sharpness": 1.0},
            {"dPdx": right, "dPdy": down},
            {"dPdx": right, "dPdy": down, "normals": normals, "blur": 0.1},
        ):
            np.testing.assert_allclose(texture.sample(points, filter=filter, **views), expected, atol=1e-6)


def test_sharpness_sharpens_what_is_coarser_than_leaves():
    frequency = 2 * np.pi * 3
    texture = wavy(8, frequency)
    x = np.linspace(0.3, 0.7, 200)
    points = np.column_stack([x, np.full_like(x, 0.41), np.full_like(x, 0.502)])
    contrasts = [np.ptp(texture.sample(points, width=0.1, sharpness=s)[:, 0]) for s in (0, 0.5, 1)]
    assert contrasts[0] < contrasts[1] < contrasts[2]
    assert contrasts[2] == pytest.approx(1.0, abs=0.1)
    fine = [texture.sample(points, width=1e-4, sharpness=s) for s in (0, 1)]
    np.testing.assert_array_equal(*fine)


def test_blur_is_added_to_widths():
    texture = shell(4, 0.0)
    points, _ = on_shell(50)
    expected = texture.sample(points, width=0.15)
    np.testing.assert_allclose(texture.sample(points, width=0.05, blur=0.1), expected, atol=1e-6)
    np.testing.assert_allclose(texture.sample(points, blur=0.15), expected, atol=1e-6)
    right, down = unit(np.random.default_rng(0).normal(size=(2, 50, 3)))
    down = unit(np.cross(right, down))
    longer = texture.sample(points, dPdx=right * 0.3, dPdy=down * 0.12)
    np.testing.assert_allclose(
        texture.sample(points, dPdx=right * 0.2, dPdy=down * 0.02, blur=0.1), longer, atol=1e-5
    )


def test_anisotropy_widens_what_is_too_long():
    texture = shell(5, 0.0)
    points, _ = on_shell(50)
    right, down = unit(np.random.default_rng(0).normal(size=(2, 50, 3)))
    down = unit(np.cross(right, down))
    expected = texture.sample(points, dPdx=right * 0.4, dPdy=down * 0.1)
    for narrow in (0.1, 0.01, 0.0):
        found = texture.sample(points, dPdx=right * 0.4, dPdy=down * narrow, anisotropy=4)
        if narrow:
            np.testing.assert_allclose(found, expected, atol=1e-4)
        else:
            assert np.isfinite(found).all()


def test_alpha_weighs_levels_too():
    texture = shell(3, 0.0)
    color = texture.channels["base_color"]
    alpha = color.format._replace(name="alpha", components=1, space="data")
    values = np.where(np.arange(texture.tree.n_cells) % 2, 255, 0).astype(np.uint8)[:, None]
    split = np.full((texture.tree.split.areas.size, 1), 255, np.uint8)
    both = OctreeTexture(
        texture.tree,
        {"base_color": color, "alpha": Channel(alpha, values, split, values[:0])},
        UNIT,
        UNIT_BOUNDS,
    )
    points, normals = on_shell(60)
    for filter in FILTERS:
        for views in ({"width": 0.35}, {"normals": normals}, {"width": 0.35, "normals": normals}):
            alone = both.sample(points, "base_color", filter, **views)
            beside = both.sample(points, ["base_color", "alpha"], filter, **views)["base_color"]
            np.testing.assert_allclose(alone, beside, atol=1e-6)
    found = both.sample(points, ["base_color", "alpha"], width=0.3, bleed_threshold=9)
    colors, covers = Views(both, "base_color", "quadratic"), Views(both, "alpha", "quadratic")
    colors.values *= covers.values
    for n in range(60):
        alpha_there = covers.value(points[n], 0.3, None, 9)
        np.testing.assert_allclose(found["alpha"][n], alpha_there, atol=1e-4)
        expected = colors.value(points[n], 0.3, None, 9) / alpha_there
        np.testing.assert_allclose(found["base_color"][n], expected, atol=1e-3)


# --- levels


def test_levels_share_what_is_built_for_them():
    texture = shell(4, 0.0)
    assert texture.level(2)._field is texture.level(2)._field
    assert texture.level(3).level(2).tree.n_cells == texture.level(2).tree.n_cells
    texture.sample([[0.5, 0.5, 0.95]], width=0.5, bleed_threshold=9)
    assert "tiles" not in texture._field.__dict__  # the leaves were not looked at


# --- what is refused


@pytest.mark.parametrize(
    ("views", "message"),
    [
        ({"width": -1.0}, r"width must be finite and not below zero, but width\[0\] is -1.0"),
        ({"width": [0.1, np.nan, 0.1]}, r"width must be finite and not below zero, but width\[1\] is nan"),
        ({"width": [0.1, 0.2]}, r"width must be a real number or \(n,\) of them, not float64 \(2,\)"),
        ({"width": "wide"}, "width must be a real number"),
        ({"width": 0.1, "dPdx": np.ones((3, 3)), "dPdy": np.ones((3, 3))}, "not both"),
        ({"dPdx": np.ones((3, 3))}, "dPdx and dPdy are given together"),
        ({"dPdx": np.ones((3, 3)), "dPdy": np.ones((2, 3))}, "dPdy must have a row for each of 3 points"),
        ({"dPdx": np.full((3, 3), np.inf), "dPdy": np.ones((3, 3))}, r"dPdx must be finite, but dPdx\[0\]"),
        (
            {"normals": [[0, 0, 1]] * 2 + [[0, np.nan, 1]]},
            r"normals must be finite, but normals\[2\] is \[0.0, nan",
        ),
        ({"normals": [[0, 0, 1]]}, "normals must have a row for each of 3 points, not 1"),
        ({"normals": [0, 0, 1]}, r"normals must have shape \(n, 3\)"),
        ({"anisotropy": 0.5}, "anisotropy must be from 1 to 256, not 0.5"),
        ({"anisotropy": "much"}, "anisotropy must be a number, not 'much'"),
        ({"blur": -1}, "blur must be from 0 on, not -1"),
        ({"blur": np.inf}, "blur must be from 0 on, not inf"),
        ({"sharpness": 2, "width": 0.1}, "sharpness must be from 0 to 1, not 2"),
        ({"sharpness": 0.5}, "sharpness is for footprints: give a width"),
        ({"bleed_threshold": -0.1}, "bleed_threshold must be from 0 on"),
        ({"anisotropy": 4}, "anisotropy is for footprints longer than wide: give dPdx and dPdy"),
        ({"anisotropy": 4, "width": 0.1}, "anisotropy is for footprints longer than wide"),
        ({"bleed_threshold": 0.5}, "bleed_threshold is for footprints without normals"),
        ({"bleed_threshold": 0.5, "width": 0.1, "normals": np.ones((3, 3))}, "and no normals"),
    ],
)
def test_views_that_make_no_sense_are_refused(views, message):
    with pytest.raises(ArgumentError, match=message):
        shell(2).sample(np.full((3, 3), 0.5), **views)


def test_defaults_may_be_given_where_they_do_nothing():
    points, texture = np.full((3, 3), 0.5), shell(2)
    found = texture.sample(points, anisotropy=16, bleed_threshold=1 / 32, blur=0.0, sharpness=0.0)
    assert np.array_equal(found, texture.sample(points))
    texture.sample(points, blur=0.1, bleed_threshold=0.5)
    texture.sample(points, dPdx=points, dPdy=points, anisotropy=np.float32(4), bleed_threshold=0.5)


def test_any_finite_number_has_an_answer():
    texture = shell(4)
    big, small = np.finfo(np.float64).max, np.finfo(np.float64).tiny
    points = np.full((6, 3), 0.5)
    widths = [0.0, small, 1e-300, 1e300, big, 5e-324]
    assert np.isfinite(texture.sample(points, width=widths)).all()
    steps = np.array(widths)[:, None] * np.array([[1.0, 0.0, 0.0]])
    for views in ({"dPdx": steps[:4], "dPdy": steps[:4]}, {"dPdx": steps[:3], "dPdy": steps[1:4]}):
        n = len(views["dPdx"])
        assert np.isfinite(texture.sample(points[:n], **views)).all()
    assert np.isfinite(texture.sample(points, normals=np.zeros((6, 3)))).all()
    up = texture.sample(points, normals=np.tile([0.0, 0.0, 1.0], (6, 1)))
    for length in (1e300, 1e30, 1e-30):
        long = texture.sample(points, normals=np.tile([0.0, 0.0, length], (6, 1)))
        np.testing.assert_allclose(long, up, atol=1e-6)


def test_split_tables_that_lie_do_no_harm():
    texture = shell(3, 0.0)
    n, arrays = texture.tree.n_cells, texture.tree.arrays
    liars = SplitTable(np.zeros(0, np.uint32), np.zeros(0, np.uint8), np.zeros(0, np.uint8))
    tree = texture.tree.with_cell_data(np.full(n, 0xBF, np.uint8), arrays.areas, liars)
    channel = texture.channels["base_color"]
    texture = OctreeTexture(
        tree, {"base_color": channel._replace(split_values=channel.split_values[:0])}, UNIT, UNIT_BOUNDS
    )
    points, normals = on_shell(40)
    assert np.isfinite(texture.sample(points, normals=normals)).all()
    assert np.isfinite(texture.sample(points, width=0.2)).all()
