"""What no image saw is filled over the surface, and never through thin parts or from part to part."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import octex
from octex.editing.draft import OpenTiles
from octex.errors import ArgumentError
from octex.painting.first import filled
from octex.painting.multigrid import graph_of, solve
from octex.painting.sheets import sheets_of
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement
from tests.conftest import needs_jit
from tests.make.painted import above, ball, one_color, plain, square, together
from tests.oracles import naive_sheets


def cut(surface, level):
    placement = Placement.around(surface.bounds, level)
    with ThreadPoolExecutor(1) as executor:
        return sheets_of(surface, placement, level, executor), placement


def tilted(mesh, seed):
    """Turn a mesh at random."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return mesh[0] @ turn, mesh[1]


def places(surface, sheets):
    """Where the middles of the sheets' largest pieces rest."""
    corners = surface.rest[surface.triangles[sheets.triangles]]
    return np.einsum("nck,nc->nk", corners, sheets.barycentric)


@pytest.mark.parametrize("seed", range(3))
def test_sheets_are_what_hangs_together_in_cells(seed):
    thin = together(square(0.0, steps=3), square(0.02, steps=2), square(0.3, steps=1))
    surface = plain(tilted(thin, seed))
    sheets, placement = cut(surface, 3)
    naive = naive_sheets.Sheets(placement.to_texture_space(surface.rest) * 8, surface.triangles)
    table = sheets.table
    triangles = np.repeat(np.arange(len(surface.triangles)), np.diff(table.firsts))
    found = [
        (tuple(cell), frozenset(triangles[table.sheets == n].tolist()))
        for n, cell in enumerate(decode_cells(sheets.codes).tolist())
    ]
    assert len(found) == len(naive.sheets)
    numbers = [naive.sheets.index(each) for each in found]
    np.testing.assert_allclose(sheets.areas, np.array(naive.areas)[numbers], atol=1e-6)
    assert {frozenset((numbers[a], numbers[b])) for a, b in sheets.pairs.tolist()} == naive.pairs
    own = sheets.at(sheets.triangles, sheets.barycentric)
    np.testing.assert_array_equal(own, np.arange(len(found)))


def test_triangles_without_area_part_no_sheets():
    points, triangles = tilted(square(steps=5), 2)
    flat = np.concatenate([triangles[:, [0, 0, 1]], triangles[:, [1, 2, 1]]])
    expected, _ = cut(plain((points, triangles)), 3)
    found, _ = cut(plain((points, np.concatenate([triangles, flat]))), 3)
    np.testing.assert_array_equal(found.codes, expected.codes)
    np.testing.assert_array_equal(found.pairs, expected.pairs)


def test_a_solution_is_that_of_a_dense_solve():
    random = np.random.default_rng(0)
    surface = plain(tilted(together(square(steps=5), square(0.4, steps=2)), 1))
    sheets, _ = cut(surface, 4)
    values, known = random.random((len(sheets.codes), 3)), random.random(len(sheets.codes)) < 0.1
    known &= places(surface, sheets) @ np.ones(3) < 0.3
    found = filled(sheets, values, known, values[known].mean(axis=0))
    expected = naive_sheets.harmonic(sheets.pairs, sheets.ties, values, known, 1e-9)
    apart = np.abs(found - expected).max(axis=1)
    assert apart.max() < 1e-4 * np.ptp(values)
    np.testing.assert_array_equal(found[known], values[known])


def test_conjugate_gradients_need_few_steps(monkeypatch):
    surface = ball(rings=16)
    sheets, _ = cut(surface, 6)
    count = len(sheets.codes)
    hold = np.where(places(surface, sheets)[:, 1] > 0.95, 1e6, 0.0)
    right = hold[:, None] * np.random.default_rng(0).random((count, 1))
    graph = graph_of(sheets.pairs, sheets.ties, count)
    exact = solve(graph, sheets.codes, 6, hold, right)
    monkeypatch.setattr("octex.painting.multigrid._STEPS", 20)
    assert np.abs(solve(graph, sheets.codes, 6, hold, right) - exact).max() < 1e-3


def test_a_fill_is_harmonic_on_a_sphere():
    surface = ball(rings=32)
    sheets, _ = cut(surface, 6)
    points = places(surface, sheets)
    height = points @ np.array([1, 2, 0]) / np.sqrt(5) / np.linalg.norm(points, axis=1)
    harmonic = np.arctanh(np.clip(height, -0.99, 0.99))[:, None]
    known = np.abs(height) > 0.5
    found = filled(sheets, np.where(known[:, None], harmonic, 0), known, np.zeros(1))
    assert np.abs(found - harmonic)[~known].max() < 0.04 * np.ptp(harmonic[~known])


def test_nothing_passes_through_thin_parts_or_between_parts():
    """Two sheets of a wall thinner than a cell, and a third part that no one sees."""
    surface = plain(together(square(0.0, steps=6), square(-0.01, steps=6), square(-0.4, side=0.5)))
    sheets, _ = cut(surface, 5)
    points = places(surface, sheets)
    values = np.where(points[:, 2:] > -0.005, 1.0, 0.0)
    known = (points[:, 0] < 0) & (points[:, 2] > -0.1)
    mean = np.average(values[known], axis=0, weights=sheets.areas[known])
    found = filled(sheets, np.where(known[:, None], values, 0.5), known, mean)[:, 0]
    near = points[:, 2] > -0.1
    np.testing.assert_allclose(found[near], values[near, 0], atol=1e-5)
    np.testing.assert_allclose(found[~near], mean[0], atol=1e-5)


@needs_jit
def test_a_new_texture_is_whole_and_what_was_there_stays():
    surface = ball(rings=24)
    camera = octex.Camera.fitted(surface.vertices, (0.0, 0.0, 1.0), size=(48, 48))
    image = octex.Projection(one_color(camera, (0.6, 0.3, 0.1)), camera)
    points = surface.scatter(2000)
    whole = octex.paint(None, surface, image, coverage=True)
    left = octex.paint(None, surface, image, holes="leave", coverage=True)
    whole.validate()
    assert whole.contains(points.rest).all()
    seen = left.contains(points.rest)
    assert 0.2 < seen.mean() < 0.6
    found = whole.sample(points.rest, normals=points.normals)
    np.testing.assert_allclose(found, np.tile([0.6, 0.3, 0.1], (2000, 1)), atol=0.01)
    covered = whole.sample(points.rest, "coverage", "nearest")[:, 0]
    front, back = points.rest[:, 2] > 0.85, points.rest[:, 2] < 0.15
    assert covered[front].min() > 0.99
    assert covered[back].max() == 0.0
    assert covered[~front & ~back].max() > 0.3
    np.testing.assert_array_equal(left.sample(points.rest[front], "coverage", "nearest"), 1.0)
    colored = octex.convert(ball(rings=24), 5)
    painted = octex.paint(colored, surface, image, coverage=True)
    np.testing.assert_allclose(
        painted.sample(points.rest[back]), colored.sample(points.rest[back]), atol=1e-6
    )
    twice = octex.paint(painted, surface, image, coverage=True)
    again = twice.sample(points.rest, "coverage", "nearest")[:, 0]
    once = painted.sample(points.rest, "coverage", "nearest")[:, 0]
    np.testing.assert_allclose(again, 1 - (1 - once) ** 2, atol=0.01)


@needs_jit
@pytest.mark.parametrize("holes", ["smooth", "leave"])
def test_a_new_texture_is_its_first_layer_where_that_covers_it(holes):
    surface = ball(rings=24)
    camera = octex.Camera.fitted(surface.vertices, (0.0, 0.0, 1.0), size=(96, 96))
    image = np.random.default_rng(0).random((96, 96, 3)).astype(np.float32)
    projection = octex.Projection(image, camera)
    layer, made = octex.project(surface, projection), octex.paint(None, surface, projection, holes=holes)
    made.validate()
    assert not made.tree.kept.cells.size
    assert list(made.channels) == ["base_color"]
    points = surface.scatter(4000)
    inside = layer.sample(points.rest, "alpha")[:, 0] > 1 - 1e-6
    assert inside.mean() > 0.1
    for normals in (None, points.normals[inside]):
        own, found = (each.sample(points.rest[inside], normals=normals) for each in (layer, made))
        np.testing.assert_allclose(found, own, atol=1e-6)
    seen = layer.contains(points.rest)
    assert made.contains(points.rest[seen]).all()
    assert made.contains(points.rest).all() == (holes == "smooth")
    known = np.abs(made.sample(points.rest[~seen]) - image.mean(axis=(0, 1))).max(axis=1)
    assert holes == "leave" or np.median(known) < 0.1


@needs_jit
def test_thin_walls_seen_from_one_side_are_filled_on_the_other():
    """The far side of a wall thinner than a cell, part of it its own colour by a second image."""
    vertices, faces = square(-1e-4, steps=4)
    surface = plain(together(square(0.0, steps=4), (vertices, faces[:, ::-1])))
    front, back = (octex.Camera.fitted(vertices, (0.0, 0.0, z), size=(64, 64)) for z in (1.0, -1.0))
    shown = one_color(back, (0.1, 0.8, 0.1))
    shown[:, 32:, 3] = 0.0
    given = [octex.Projection(one_color(front, (0.8, 0.1, 0.1)), front), octex.Projection(shown, back)]
    made = octex.paint(None, surface, given)
    made.validate()
    points = surface.scatter(2000)
    found = made.sample(points.rest, normals=points.normals)
    is_front = points.normals[:, 2] > 0
    np.testing.assert_allclose(found[is_front], np.tile([0.8, 0.1, 0.1], (is_front.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(found[~is_front], np.tile([0.1, 0.8, 0.1], ((~is_front).sum(), 1)), atol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_region_has_the_sheets_of_the_whole(seed):
    surface = plain(tilted(together(square(0.0, steps=3), square(0.02, steps=2), square(0.3, steps=1)), seed))
    whole, placement = cut(surface, 7)
    codes = np.unique(whole.codes >> 9)
    region = OpenTiles(4, codes[np.random.default_rng(seed).random(codes.size) < 0.3])
    with ThreadPoolExecutor(1) as executor:
        some = sheets_of(surface, placement, 7, executor, region)
    own = np.isin(whole.codes >> 9, region.codes)
    assert 0 < own.sum() < own.size
    np.testing.assert_array_equal(some.codes, whole.codes[own])
    np.testing.assert_allclose(some.areas, whole.areas[own], rtol=1e-12)
    np.testing.assert_array_equal(some.triangles, whole.triangles[own])
    inside = own[whole.pairs].all(axis=1)
    np.testing.assert_array_equal(some.pairs, (np.cumsum(own) - 1)[whole.pairs[inside]])


@needs_jit
def test_translucent_paint_lies_on_the_fill():
    """Half of a square is painted, its rim half transparent: between both, the fill's colours go on."""
    surface = plain(square(steps=4))
    camera = above(3.0, 64)
    image = one_color(camera, (0.2, 0.4, 0.8))
    image[:, 32:, 3] = 0.0
    image[:, 28:32, 3] = 0.4
    texture = octex.paint(None, surface, octex.Projection(image, camera))
    points = surface.scatter(3000)
    np.testing.assert_allclose(texture.sample(points.rest), np.tile([0.2, 0.4, 0.8], (3000, 1)), atol=0.01)


@needs_jit
@pytest.mark.parametrize("blend", ["over", "multiply", "erase"])
def test_holes_may_have_a_colour_and_paint_blends_with_it(blend):
    surface = ball(rings=24)
    camera = octex.Camera.fitted(surface.vertices, (0.0, 0.0, 1.0), size=(48, 48))
    image = one_color(camera, (1.0, 0.5, 0.25))
    projection = octex.Projection(image, camera, opacity=0.75, blend=blend)
    color = np.array([0.2, 0.4, 0.8])
    texture = octex.paint(None, surface, projection, holes=color)
    texture.validate()
    points = surface.scatter(2000)
    found = texture.sample(points.rest)
    front, back = points.rest[:, 2] > 0.85, points.rest[:, 2] < 0.15
    over = {"over": [1.0, 0.5, 0.25], "multiply": color * [1.0, 0.5, 0.25], "erase": color}[blend]
    np.testing.assert_allclose(
        found[front], np.tile(0.25 * color + 0.75 * np.array(over), (front.sum(), 1)), atol=0.01
    )
    np.testing.assert_allclose(found[back], np.tile(color, (back.sum(), 1)), atol=0.003)


def test_what_is_not_known_of_holes_is_refused():
    surface = plain(square())
    image = octex.Projection(one_color(above(), (1.0, 0.0, 0.0)), above())
    with pytest.raises(ArgumentError, match="unknown holes 'fill'; there are: leave, smooth"):
        octex.paint(None, surface, image, holes="fill")
    with pytest.raises(ArgumentError, match="color of 'base_color' must be from 0 to 1"):
        octex.paint(None, surface, image, holes=(0, 0, 255))
    with pytest.raises(ArgumentError, match="coverage must be"):
        octex.paint(None, surface, image, coverage="yes")
