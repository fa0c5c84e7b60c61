"""Filtered lookups: footprints, what faces a normal, and the paper's rule."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.channels import ChannelFormat, linear_to_srgb
from octex.errors import ArgumentError
from octex.field.blend import Codes
from octex.field.filtered import Query, filtered_colors
from octex.source.surface import Surface
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.layout import SPLIT, SplitTable
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from tests.conftest import needs_jit
from tests.naive_views import Views
from tests.small_textures import UNIT, UNIT_BOUNDS, shell
from tests.strategies import textures

Array = npt.NDArray[Any]
each_filter = pytest.mark.parametrize("filter", FILTERS)


def on_shell(count: int, seed: int = 0) -> tuple[Array, Array]:
    """Points of the shell, and directions."""
    random = np.random.default_rng(seed)
    away, normals = random.normal(size=(2, count, 3))
    return 0.5 + 0.45 * away / np.linalg.norm(away, axis=1)[:, None], normals


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def as_list(texture: OctreeTexture, points: Array, filter: str, **views: Any) -> Array:
    """What the way through lists of taps finds, which a dtype that is decoded late must take."""
    form = texture.channels["base_color"].format._replace(name="other", components=4)
    channel = texture.channels["base_color"]
    wide = [np.ascontiguousarray(np.repeat(part, 2, axis=1)[:, :4]) for part in channel[1:]]
    both = OctreeTexture(texture.tree, {"other": Channel(form, *wide)}, texture.placement, texture.bounds)
    return both.sample(points, "other", filter, **views)[:, [0, 2]]


# --- beside the slow reference


@each_filter
@pytest.mark.parametrize("keep", [0.0, 0.3])
def test_footprints_and_facings_are_those_of_the_reference(filter: str, keep: float) -> None:
    texture = shell(4, keep)
    points, normals = on_shell(40)
    points[-5:] = 0.5 + 0.2 * (points[-5:] - 0.5)  # off the surface
    widths = np.random.default_rng(1).choice([0.01, 0.1, 0.13, 0.2, 0.3, 0.5, 1.0, 3.0], 40)
    views = Views(texture, "base_color", filter)
    for given_normals in (None, normals):
        found = texture.sample(points, filter=filter, width=widths, normals=given_normals)
        listed = as_list(texture, points, filter, width=widths, normals=given_normals)
        np.testing.assert_allclose(listed, found[:, :2], atol=2e-6)
        for n in range(len(points)):
            normal = None if given_normals is None else unit(normals[n])
            expected = views.value(points[n], float(widths[n]), normal)
            np.testing.assert_allclose(found[n], expected, atol=2e-4)


@each_filter
@given(textures(5), st.integers(0, 2**32 - 1))
def test_any_texture_is_looked_up_as_by_the_reference(filter: str, texture: OctreeTexture, seed: int) -> None:
    random = np.random.default_rng(seed)
    channels = {name: each for name, each in texture.channels.items() if name != "alpha"}
    texture = OctreeTexture(texture.tree, channels, texture.placement, texture.bounds)
    points = texture.placement.to_rest(random.random((3, 3)))
    widths = texture.placement.size * 2.0 ** random.uniform(-6, 1, 3)
    normals = unit(random.normal(size=(3, 3)))
    plain = texture.sample(points, list(channels), filter, width=widths, normalize=False)
    facing = texture.sample(points, list(channels), filter, normals=normals, normalize=False)
    for name in channels:
        views = Views(texture, name, filter)
        for n in range(3):
            expected = views.value(points[n], float(widths[n]))
            np.testing.assert_allclose(plain[name][n], expected, rtol=1e-3, atol=3e-4)
            expected = views.value(points[n], None, normals[n])
            np.testing.assert_allclose(facing[name][n], expected, rtol=1e-3, atol=3e-4)


def test_gradients_of_footprints_are_those_of_what_they_show() -> None:
    texture = shell(4)
    points, normals = on_shell(60)
    for views in ({"width": 0.07}, {"width": 0.2, "normals": normals}, {"normals": normals}):
        values, gradients = texture.sample(points, gradient=True, **views)
        np.testing.assert_allclose(values, texture.sample(points, **views), atol=2e-6)
        step = 1e-4
        for axis in range(3):
            ahead, behind = (
                texture.sample(points + sign * step * np.eye(3)[axis], **views).astype(float)
                for sign in (1, -1)
            )
            slopes = (ahead - behind) / (2 * step)
            bad = np.abs(slopes - gradients[:, :, axis]) > 0.02 * np.abs(gradients).max()
            assert bad.mean() < 0.05  # where a step crosses what bends


# --- footprints


def test_a_width_of_nothing_is_the_field_and_a_great_one_the_roots_average() -> None:
    texture = shell(4, 0.0)
    points, _ = on_shell(50)
    np.testing.assert_allclose(texture.sample(points, width=0.0), texture.sample(points), atol=1e-6)
    whole = texture.level(0).sample(points)
    np.testing.assert_allclose(texture.sample(points, width=1e30, bleed_threshold=9), whole, atol=1e-6)
    np.testing.assert_allclose(
        texture.sample(points, width=1e30), as_blind(texture).sample(points, width=1e30), atol=1
    )


def as_blind(texture: OctreeTexture) -> OctreeTexture:
    """A texture without facings."""
    tree = texture.tree.with_cell_data(np.zeros(texture.tree.n_cells, np.uint8), texture.tree.arrays.areas)
    channel = texture.channels["base_color"]
    channel = channel._replace(split_values=channel.split_values[:0], kept_values=channel.kept_values[:0])
    return OctreeTexture(tree, {"base_color": channel}, UNIT, UNIT_BOUNDS)


def test_one_width_and_one_for_each_point_are_alike() -> None:
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
def test_blocks_and_runs_do_not_change_what_is_found(monkeypatch: pytest.MonkeyPatch, executor: bool) -> None:
    texture = shell(4, 0.3)
    points, normals = on_shell(90)
    right, down = np.random.default_rng(4).normal(size=(2, 90, 3)) * [[[0.3]], [[0.05]]]
    views = {"dPdx": right, "dPdy": down, "normals": normals}
    expected = texture.sample(points, **views), as_list(texture, points, "quadratic", **views)
    monkeypatch.setattr("octex.texture.lookup.BLOCK", 32)
    monkeypatch.setattr("octex.field.footprints._ROOM", 100)
    monkeypatch.setattr("octex.field.filtered._LOOKS_OF_TAPS", 50)
    with ThreadPoolExecutor(2) as pool:
        pool = pool if executor else None
        np.testing.assert_allclose(texture.sample(points, **views, executor=pool), expected[0], atol=1e-6)
        found = as_list(texture, points, "quadratic", **views, executor=pool)
        np.testing.assert_allclose(found, expected[1], atol=1e-6)


def wavy(depth: int, frequency: float) -> OctreeTexture:
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
def test_footprints_have_the_variance_of_a_box(filter: str) -> None:
    frequency = 2 * np.pi * 3
    texture = wavy(8, frequency)
    x = np.linspace(0.3, 0.7, 400)
    points = np.column_stack([x, np.full_like(x, 0.41), np.full_like(x, 0.502)])
    for width in (0.04, 0.05, 0.06, 0.08, 0.1):
        shown = texture.sample(points, filter=filter, width=width)[:, 0] - 0.5
        contrast = 2 * np.abs(np.linalg.lstsq(_waves(x, frequency), shown, rcond=None)[0][:2]).max()
        box = np.sin(frequency * width / 2) / (frequency * width / 2)
        assert abs((1 - contrast) / (1 - box) - 1) < (1.5 if filter == "nearest" else 0.65)


def _waves(x: Array, frequency: float) -> Array:
    return np.column_stack([np.cos(frequency * x), np.sin(frequency * x), np.ones_like(x)])


@pytest.mark.parametrize("filter", ["linear", "quadratic", "quartic"])
def test_long_footprints_average_along_and_not_across(filter: str) -> None:
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


def test_a_mean_is_a_mean_however_it_is_looked_at() -> None:
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


def bent(thickness: float) -> Surface:
    """A strip bent to a half circle, each side with bands of its own colours."""
    turn, along = (grid.ravel() for grid in np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(0, 1, 11)))
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    axis = np.column_stack([np.zeros_like(turn), np.zeros_like(turn), along])
    grid = np.arange(11 * 61).reshape(11, 61)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    vertices = np.concatenate([outward + axis, (1 - thickness) * outward + axis])
    bands = 0.5 + 0.5 * np.sin(9 * turn)
    none = np.zeros_like(bands)
    colors = np.concatenate([np.column_stack([bands, none, none]), np.column_stack([none, bands, none])])
    return Surface.from_arrays(vertices, np.concatenate([faces, faces[:, ::-1] + 11 * 61]), colors=colors)


@needs_jit
@pytest.mark.parametrize("facing", [False, True])
def test_nothing_jumps_along_a_slow_zoom_or_a_slow_path(facing: bool) -> None:
    texture = octex.convert(bent(0.02), depth=5)
    steps = 20_000
    turn = np.linspace(0.3, 2.8, steps)
    outward = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    path = outward + np.array([0.0, 0.0, 0.43])
    for width in (0.0, 0.05, 0.3, 1.0):
        found = texture.sample(path, width=width, normals=outward if facing else None)
        assert np.abs(np.diff(found, axis=0)).max() < 0.003
        assert np.ptp(found) > 0.05
    point = np.repeat(path[5000:5001], steps, axis=0)
    normals = np.repeat(outward[5000:5001], steps, axis=0) if facing else None
    widths = np.exp(np.linspace(np.log(0.005), np.log(9.0), steps))
    zoom = texture.sample(point, width=widths, normals=normals)
    assert np.abs(np.diff(zoom, axis=0)).max() < 0.003
    right, down = np.array([[1.0, 0.3, 0.0]]), np.array([[0.0, 0.2, 0.2]])
    long = texture.sample(point, dPdx=right * widths[:, None], dPdy=down * widths[:, None], normals=normals)
    assert np.abs(np.diff(long, axis=0)).max() < 0.003
    blind = texture.sample(point, width=widths, bleed_threshold=np.inf)
    assert np.abs(np.diff(blind, axis=0)).max() < 0.003


def test_sharpness_sharpens_what_is_coarser_than_leaves() -> None:
    frequency = 2 * np.pi * 3
    texture = wavy(8, frequency)
    x = np.linspace(0.3, 0.7, 200)
    points = np.column_stack([x, np.full_like(x, 0.41), np.full_like(x, 0.502)])
    contrasts = [np.ptp(texture.sample(points, width=0.1, sharpness=s)[:, 0]) for s in (0, 0.5, 1)]
    assert contrasts[0] < contrasts[1] < contrasts[2]
    assert contrasts[2] == pytest.approx(1.0, abs=0.1)
    fine = [texture.sample(points, width=1e-4, sharpness=s) for s in (0, 1)]
    np.testing.assert_array_equal(*fine)


def test_blur_is_added_to_widths() -> None:
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


def test_anisotropy_widens_what_is_too_long() -> None:
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


def test_alpha_weighs_levels_too() -> None:
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
    points, _ = on_shell(60)
    found = both.sample(points, ["base_color", "alpha"], width=0.3, bleed_threshold=9)
    colors, covers = Views(both, "base_color", "quadratic"), Views(both, "alpha", "quadratic")
    colors.values *= covers.values
    for n in range(60):
        alpha_there = covers.value(points[n], 0.3, None, 9)
        np.testing.assert_allclose(found["alpha"][n], alpha_there, atol=1e-4)
        expected = colors.value(points[n], 0.3, None, 9) / alpha_there
        np.testing.assert_allclose(found["base_color"][n], expected, atol=1e-3)


# --- thin things


def sheet(turn: Array, thickness: float, *, gap: float = 0.0) -> Surface:
    """A square, red on its front and green on its back, so thick."""
    steps = np.linspace(-0.5, 0.5, 7)
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
    flat = np.column_stack([x, y, np.full(49, gap)])
    grid = np.arange(49).reshape(7, 7)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    half = np.array([0.0, 0.0, thickness / 2])
    vertices = np.concatenate([flat + half, flat - half])
    colors = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 49, axis=0)
    return Surface.from_arrays(vertices @ turn.T, np.concatenate([faces, faces[:, ::-1] + 49]), colors=colors)


def turned(seed: int) -> Array:
    """An axis-aligned pose, one across an edge of cells, or any other."""
    if seed == 0:
        return np.eye(3)
    if seed == 1:
        return np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(q * np.linalg.det(q))


@needs_jit
@pytest.mark.parametrize("fit", [False, True])
@pytest.mark.parametrize("thickness", [0.0, 0.004, 0.02, 0.035])  # cells are 0.038 or so wide
@pytest.mark.parametrize("seed", range(5))
def test_each_side_of_something_thin_shows_its_own_colour(seed: int, thickness: float, fit: bool) -> None:
    turn = turned(seed)
    surface = sheet(turn, thickness)
    texture = octex.convert(surface, depth=5, fit=fit)
    texture.validate()
    cell = texture.placement.size / 32
    samples = surface.scatter(150)
    is_front = (samples.triangles < len(surface.triangles) // 2)[:, None]
    normals = np.where(is_front, turn[:, 2], -turn[:, 2])
    expected = np.where(is_front, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    tangents = unit(np.cross(normals, [0.3, 0.5, 0.8]))
    across = np.cross(normals, tangents)
    for cells in (0.1, 0.7, 1, 3, 10, 40):
        width = cells * cell
        for filter in FILTERS:
            found = texture.sample(samples.rest, filter=filter, width=width, normals=normals)
            assert np.abs(found - expected).max() <= 1 / 255
        found = texture.sample(samples.rest, dPdx=5 * width * tangents, dPdy=width * across, normals=normals)
        assert np.abs(found - expected).max() <= 1 / 255
    away = np.cross(normals, [[0.3, -0.5, 0.1]])  # what faces neither shows both
    both = texture.sample(samples.rest, width=40 * cell, normals=1e-3 * away)
    assert (both[:, 2] < 0.01).all()


def test_the_papers_rule_goes_down_to_where_sides_are_apart() -> None:
    surface = sheet(np.eye(3), 0.2)
    texture = octex.convert(surface, depth=6, fit=False)
    samples = surface.scatter(300)
    is_front = (samples.triangles < len(surface.triangles) // 2)[:, None]
    expected = np.where(is_front, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    for width in (0.01, 0.2, 1.0, 10.0):
        found = texture.sample(samples.rest, filter="nearest", width=width)
        assert np.abs(found - expected).max() <= 1 / 255
        # The spline between cells reaches the other side's cells where they are the next ones.
        assert np.abs(texture.sample(samples.rest, width=width) - expected).max() < 0.45
    blind = texture.sample(samples.rest, width=10.0, bleed_threshold=2.0)
    np.testing.assert_allclose(blind, [[0.5, 0.5, 0.0]] * 300, atol=0.01)


def test_a_front_and_a_back_that_are_nearly_alike_may_mix() -> None:
    surface = sheet(np.eye(3), 0.2)
    half = len(surface.triangles) // 2
    colors = np.where(np.arange(2 * half)[:, None] < half, 0.5, 0.52) * np.ones(3)
    alike = Surface.from_arrays(surface.vertices, surface.triangles, face_colors=colors)
    texture = octex.convert(alike, depth=6, fit=False)
    assert texture.tree.arrays.flags[0] & SPLIT
    rest = alike.scatter(50).rest
    np.testing.assert_allclose(texture.sample(rest, width=10.0), 0.51, atol=0.003)
    apart = texture.sample(rest, filter="nearest", width=10.0, bleed_threshold=0.01)
    assert (np.abs(apart - 0.51) > 0.006).all()


def test_sheets_that_face_the_same_way_cannot_be_told_apart() -> None:
    below, above = sheet(np.eye(3), 0.0), sheet(np.eye(3), 0.0, gap=0.01)
    half = len(below.triangles) // 2
    vertices = np.concatenate([below.vertices, above.vertices])
    triangles = np.concatenate([below.triangles[:half], above.triangles[:half] + len(below.vertices)])
    colors = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], len(below.vertices), axis=0)
    surface = Surface.from_arrays(vertices, triangles, colors=colors)
    texture = octex.convert(surface, depth=5)
    found = texture.sample([[0.0, 0.0, 0.0]], width=0.1, normals=[[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(found, [[0.5, 0.0, 0.5]], atol=0.1)


def test_the_outside_and_the_inside_of_a_hairpin_cannot_be_told_apart() -> None:
    upper, lower = sheet(np.eye(3), 0.004, gap=0.01), sheet(np.diag([1.0, -1.0, -1.0]), 0.004, gap=0.01)
    surface = Surface.from_arrays(
        np.concatenate([upper.vertices, lower.vertices]),
        np.concatenate([upper.triangles, lower.triangles + len(upper.vertices)]),
        colors=np.tile(np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 49, axis=0), (2, 1)),
    )
    texture = octex.convert(surface, depth=4)
    outside = np.column_stack([np.linspace(-0.4, 0.4, 50), np.zeros(50), np.full(50, 0.012)])
    found = texture.sample(outside, width=0.2, normals=np.tile([[0.0, 0.0, 1.0]], (50, 1)))
    np.testing.assert_allclose(found, [[0.5, 0.5, 0.0]] * 50, atol=0.05)


@needs_jit
def test_a_model_without_thin_places_has_no_leaf_split_and_pays_nothing() -> None:
    steps = np.linspace(0, 2 * np.pi, 41)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, np.linspace(0, np.pi, 21)))
    vertices = np.column_stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    grid = np.arange(21 * 41).reshape(21, 41)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, c, b]), np.column_stack([a, d, c])])
    surface = Surface.from_arrays(vertices, faces, colors=np.abs(np.sin(5 * vertices)))
    texture = octex.convert(surface, depth=6)
    assert (texture.tree.split.cells < texture.tree.arrays.level_cells[3]).all()


def test_leaves_that_only_look_moved_are_not_split() -> None:
    tree = octex.convert(sheet(np.eye(3), 0.0), depth=4, fit=False).tree
    assert np.array_equal(tree.split.cells, np.arange(tree.n_cells))


# --- averages


@needs_jit
def test_averages_are_the_sources_whether_fitted_or_not() -> None:
    random = np.random.default_rng(3)
    surface = sheet(turned(3), 0.3)
    colors = random.random((len(surface.vertices), 3))
    surface = Surface.from_arrays(surface.vertices, surface.triangles, colors=colors)
    fitted, means = octex.convert(surface, depth=5), octex.convert(surface, depth=5, fit=False)
    nodes = slice(0, int(means.tree.arrays.level_cells[5]))
    a, b = (each.channels["base_color"].values for each in (fitted, means))
    assert np.array_equal(a[nodes], b[nodes])
    assert not np.array_equal(a, b)
    samples = surface.scatter(400_000)
    source = surface.evaluate(samples)
    cells = np.floor((samples.rest - means.placement.origin) / means.placement.size * 2).astype(int) @ [
        1,
        2,
        4,
    ]
    at_level_one = means.level(1)
    for code, octant in enumerate(at_level_one.tree.level_codes(1).tolist()):
        mean = source[cells == octant].mean(axis=0)
        stored = at_level_one.channels["base_color"].values[1 + code]
        assert np.abs(255 * linear_to_srgb(mean) - stored).max() < 1.0


# --- levels


def test_levels_share_what_is_built_for_them() -> None:
    texture = shell(4, 0.0)
    assert texture.level(2)._field is texture.level(2)._field
    assert texture.level(3).level(2).tree.n_cells == texture.level(2).tree.n_cells
    texture.sample([[0.5, 0.5, 0.95]], width=0.5, bleed_threshold=9)
    assert "tiles" not in texture._field.__dict__  # the leaves were not looked at


def test_colours_of_trees_without_tiles_take_the_other_way() -> None:
    texture = shell(4, 0.5)
    assert texture._field.tiles is None
    codes = Codes(*(np.zeros((1, 3), np.uint8),) * 2, np.zeros(256, np.float32))
    query = Query("quadratic", normals=np.ones((1, 3), np.float32))
    assert (
        filtered_colors(
            texture._field, np.full((1, 3), 0.5), UNIT, query, codes, np.empty((1, 3), np.float32)
        )
        is None
    )


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
    ],
)
def test_views_that_make_no_sense_are_refused(views: dict[str, Any], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        shell(2).sample(np.full((3, 3), 0.5), **views)


def test_any_finite_number_has_an_answer() -> None:
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


def test_split_tables_that_lie_do_no_harm() -> None:
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
