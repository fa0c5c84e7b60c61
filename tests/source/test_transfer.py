"""Channels of another model, taken where its surface is nearest; one texture over several surfaces."""

import json

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR, DETAIL, ROUGHNESS
from octex.errors import ArgumentError, ModelError
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.fixtures import ply, ply_square
from tests.make.painted import ball, plain, square, together
from tests.make.small_surfaces import FACES, TETRAHEDRON, FaceSource, sheet, tetrahedron, whole


def rainbow(rings=24):
    """A ball whose colour says where it is."""
    vertices, triangles = ball(rings).vertices, ball(rings).triangles
    return Surface.from_arrays(vertices, triangles, colors=(vertices + 1.2) / 2.5, name="rainbow")


def test_a_ball_of_other_triangles_gets_the_colours_of_the_nearest_places():
    target = plain((ball(17).vertices * 1.01, ball(17).triangles))
    made = target.with_sources(octex.Transfer(rainbow()).sources)
    samples = made.scatter(500)
    nearest = samples.rest / np.linalg.norm(samples.rest, axis=1)[:, None]
    np.testing.assert_allclose(made.evaluate(samples), (nearest + 1.2) / 2.5, atol=0.01)


def test_a_model_transferred_to_itself_is_itself():
    surface = whole()
    made = plain((surface.vertices, surface.triangles)).with_sources(octex.Transfer(surface).sources)
    assert [form.name for form in made.channels] == [form.name for form in surface.channels]
    samples = surface.scatter(200)
    for form in surface.channels:
        np.testing.assert_allclose(
            made.evaluate(samples, form.name), surface.evaluate(samples, form.name), atol=1e-6
        )


@needs_jit
def test_what_is_farther_than_the_distance_stays_empty_and_is_counted():
    near, far = square(0.0), square(1.0)
    both = plain(together(near, far))
    red = Surface.from_arrays(*near, colors=np.tile([1.0, 0.0, 0.0], (len(near[0]), 1)))
    texture = octex.convert(both, 6, sources=octex.Transfer(red, distance=0.1).sources)
    texture.validate()
    whole_texture = octex.convert(both, 6)
    empty = json.loads(texture.metadata["convert"])["empty"]
    assert empty == whole_texture.tree.n_leaves - texture.tree.n_leaves
    samples = both.scatter(2000)
    upper = samples.rest[:, 2] > 0.5
    assert not texture.contains(samples.rest[upper]).any()
    assert texture.contains(samples.rest[~upper]).all()
    np.testing.assert_allclose(
        texture.sample(samples.rest[~upper]), np.tile([1.0, 0, 0], ((~upper).sum(), 1)), atol=1e-3
    )
    assert np.array_equal(texture.sample(samples.rest[~upper], "alpha"), np.ones(((~upper).sum(), 1)))


def test_beside_a_gap_colours_do_not_darken():
    half = square(0.0)
    wide = half[0] * [2.0, 1.0, 1.0]
    white = Surface.from_arrays(*half, colors=np.ones((len(half[0]), 3)))
    texture = octex.convert(plain((wide, half[1])), 6, sources=octex.Transfer(white, distance=0.03).sources)
    samples = plain((wide, half[1])).scatter(3000)
    inside = texture.contains(samples.rest)
    assert 0.3 < inside.mean() < 0.7
    assert texture.sample(samples.rest[inside]).min() > 0.99


@needs_jit
@pytest.mark.parametrize("max_error", [None, 2.0])
def test_nodes_beside_gaps_face_as_what_is_left_of_them_does(max_error):
    moved = plain((ball(17).vertices + np.array([0.3, 0.2, 0.1]), ball(17).triangles))
    sources = octex.Transfer(rainbow(), distance=0.1).sources
    texture = octex.convert(moved, 5, sources=sources, max_error=max_error)
    assert json.loads(texture.metadata["convert"])["empty"] > 0
    texture.validate()


def test_nodes_beside_gaps_in_a_thin_sheet_keep_a_value_for_each_side_that_is_left():
    thin = sheet(np.eye(3), 0.01)
    front, back = thin.triangles[:72], thin.triangles[72:]
    some = np.concatenate([front[:20], back[10:30]])
    part = Surface(thin.vertices, some, FaceSource((BASE_COLOR,), np.repeat([[1.0, 0, 0], [0, 1, 0]], 20, 0)))
    texture = octex.convert(thin, 6, sources=octex.Transfer(part, distance=0.001, max_angle=60.0).sources)
    texture.validate()
    assert texture.tree.split.cells.size


@needs_jit
def test_a_distance_that_leaves_nothing_out_leaves_no_trace():
    surface = rainbow()
    target = plain((surface.vertices, surface.triangles))
    limited = octex.convert(target, 4, sources=octex.Transfer(surface, distance=1.0).sources)
    free = octex.convert(target, 4, sources=octex.Transfer(surface).sources)
    assert list(limited.channels) == ["base_color"]
    assert np.array_equal(limited.channels["base_color"].values, free.channels["base_color"].values)


def test_nothing_near_is_refused():
    surface = rainbow()
    far = plain((surface.vertices + 10.0, surface.triangles))
    with pytest.raises(ModelError, match="has no value anywhere on it: it is too far away"):
        octex.convert(far, 3, sources=octex.Transfer(surface, distance=1.0).sources)


def test_with_an_angle_each_side_of_a_thin_sheet_takes_its_own_colour():
    thin = sheet(np.eye(3), 0.01)
    moved = thin.vertices + np.array([0.0, 0.0, 0.006])
    target = plain((moved, thin.triangles))
    samples = target.scatter(400)
    facing = np.abs(samples.normals[:, 2]) > 0.9
    truth = thin.evaluate(samples)
    by_angle = target.with_sources(octex.Transfer(thin, max_angle=60.0).sources).evaluate(samples)
    assert np.allclose(by_angle[facing], truth[facing], atol=1e-6)
    blind = target.with_sources(octex.Transfer(thin).sources).evaluate(samples)
    assert not np.allclose(blind[facing], truth[facing], atol=0.1)


def test_files_are_read_and_channels_that_are_not_there_refused(tmp_path):
    ply(tmp_path / "square.ply", ply_square())
    transfer = octex.Transfer(tmp_path / "square.ply")
    with pytest.raises(ArgumentError, match=r"channel of square\.ply"):
        tetrahedron().with_sources({"roughness": transfer})
    assert "square.ply" in repr(transfer)


@pytest.mark.parametrize("options", [{"distance": -1.0}, {"distance": np.nan}, {"max_angle": 200.0}])
def test_numbers_out_of_range_are_refused(options):
    with pytest.raises(ArgumentError, match=next(iter(options))):
        octex.Transfer(tetrahedron(), **options)


def test_a_model_without_area_is_refused():
    flat = Surface.from_arrays(np.zeros((3, 3)), [[0, 1, 2]], name="flat")
    with pytest.raises(ModelError, match="flat: all triangles are degenerate"):
        tetrahedron().with_sources(octex.Transfer(flat).sources)


@needs_jit
def test_normals_that_are_the_same_agree_at_any_angle():
    surface = rainbow()
    target = plain((surface.vertices, surface.triangles))
    made = target.with_sources(octex.Transfer(surface, max_angle=0.0).sources)
    assert (made.evaluate(made.scatter(500), "alpha") == 1).all()


def leaves_and_gaps(surface, depth, sources):
    texture = octex.convert(surface, depth, sources=sources)
    texture.validate()
    return texture, json.loads(texture.metadata["convert"]).get("empty", 0)


def two_squares():
    """A red square, and it in grey with another one above."""
    near = square(0.0)
    red = Surface.from_arrays(*near, colors=np.tile([1.0, 0.0, 0.0], (len(near[0]), 1)))
    return red, plain(together(near, square(1.0)))


def in_half(points):
    return (points[:, 0] > 0.1).astype(np.float64)


@needs_jit
def test_gaps_do_not_darken_averages_of_what_is_transparent_beside_them():
    red, both = two_squares()
    clear = octex.Transfer(red.with_sources({"alpha": 0.0}), distance=0.1)
    texture, empty = leaves_and_gaps(both, 4, clear.sources)
    assert empty > 0
    assert (texture.channels["alpha"].values == 0).all()
    np.testing.assert_array_equal(texture.channels["base_color"].values, [[255, 0, 0]] * texture.tree.n_cells)


@needs_jit
@pytest.mark.parametrize(("kind", "alpha"), [("transfer", 0.5), ("radius", 1.0), ("distance", in_half)])
def test_alpha_from_elsewhere_does_not_fill_gaps(kind, alpha):
    red, both = two_squares()
    colors = octex.Transfer(red, distance=0.1)
    if kind != "transfer":
        dots = red.scatter(2000).rest
        limit = {kind: 0.1}
        colors = octex.PointCloud(dots, np.tile(np.float32([1, 0, 0]), (len(dots), 1)), **limit)
    texture, empty = leaves_and_gaps(both, 4, {"base_color": colors, "alpha": alpha})
    bare, missing = leaves_and_gaps(both, 4, {"base_color": colors})
    assert empty == missing > 0
    assert texture.tree.n_leaves == bare.tree.n_leaves  # also those whose own alpha is 0
    assert np.array_equal(texture.tree.level_codes(4), bare.tree.level_codes(4))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (100, 3)) * [1, 1, 0]
    points = points[np.abs(points[:, 0] - 0.1) > 0.15]
    wanted = alpha(points) if callable(alpha) else np.full(len(points), alpha)
    np.testing.assert_allclose(texture.sample(points, "alpha")[:, 0], wanted, atol=0.003)
    shown = wanted > 0
    np.testing.assert_allclose(texture.sample(points)[shown], [[1.0, 0, 0]] * shown.sum(), atol=2e-3)


@needs_jit
def test_any_of_several_sources_may_leave_gaps():
    red, both = two_squares()
    half = Surface(red.vertices, red.triangles[:16], red.source)
    wide, narrow = octex.Transfer(red, distance=0.1), octex.Transfer(half, distance=0.01)
    alone = [leaves_and_gaps(both, 4, {"base_color": each}) for each in (wide, narrow)]
    texture, empty = leaves_and_gaps(both, 4, {"base_color": wide, "roughness": Rough(narrow)})
    assert np.array_equal(texture.tree.level_codes(4), alone[1][0].tree.level_codes(4))
    assert empty == alone[1][1] > alone[0][1] > 0
    # what is not asked for leaves none
    made = both.with_sources({"base_color": wide, "roughness": Rough(narrow)})
    assert (
        json.loads(octex.convert(made, 4, channels=["base_color"]).metadata["convert"])["empty"]
        == alone[0][1]
    )
    assert not made.with_sources({"base_color": (1.0, 0, 0), "roughness": 0.5}).source.has_gaps


class Rough(octex.Transfer):
    """The red of another model as roughness."""

    def __init__(self, other):
        surface = other._surface
        values = surface.evaluate(surface.scatter(1))[:, :1]
        rough = FaceSource((ROUGHNESS,), np.tile(values, (len(surface.triangles), 1)))
        super().__init__(Surface(surface.vertices, surface.triangles, rough), distance=other.distance)


@needs_jit
def test_gaps_of_the_other_model_are_gaps_here():
    red, both = two_squares()
    other = both.with_sources({"base_color": octex.Transfer(red, distance=0.1), "alpha": 1.0})
    for sources in (octex.Transfer(other).sources, {"base_color": octex.Transfer(other)}):
        texture, empty = leaves_and_gaps(both, 4, sources)
        assert empty == texture.tree.n_leaves > 0


def test_resolution_is_read_from_its_own_channel_beside_gaps():
    surface = tetrahedron()
    steps = Surface(surface.vertices, surface.triangles, FaceSource((DETAIL,), np.full((4, 1), 0.25)))
    made = [
        octex.convert(surface, 4, channels=["base_color"], detail="detail", sources={"detail": transfer})
        for transfer in (octex.Transfer(steps), octex.Transfer(steps, distance=9.0))
    ]
    assert made[0].tree.max_depth == made[1].tree.max_depth == 2


def test_gaps_stay_with_channels_and_rest_positions_chosen_later():
    surface = tetrahedron()
    made = surface.with_sources(octex.Transfer(surface, distance=0.1).sources)
    assert [form.name for form in made.with_channels(["base_color"]).channels] == ["base_color", "alpha"]
    samples = made.scatter(50)
    assert (made.with_channels(["alpha"]).evaluate(samples, "alpha") == 1).all()
    away = made.with_rest(surface.vertices + 5.0)
    assert (away.evaluate(samples, "alpha") == 0).all()
    assert (made.with_filter("nearest").evaluate(samples, "alpha") == 1).all()


def test_each_surface_keeps_its_own_values_in_one_texture():
    one = tetrahedron(name="one")
    other = Surface.from_arrays(
        TETRAHEDRON + np.array([2, 0, 0]), FACES, colors=np.full((4, 3), 0.5), name="other"
    )
    texture = octex.convert([one, other], 6)
    texture.validate()
    for surface in (one, other):
        samples = surface.scatter(300)
        assert texture.contains(samples.rest).all()
        assert np.abs(texture.sample(samples.rest) - surface.evaluate(samples)).mean() < 0.01
    assert json.loads(texture.metadata["sources"]) == ["one", "other"]


def test_joined_is_what_the_same_triangles_are_as_one_surface():
    a, b = plain(square(0.0)), plain(square(0.5))
    together = octex.convert([a, b], 5)
    vertices = np.concatenate([a.vertices, b.vertices])
    faces = np.concatenate([a.triangles, b.triangles + len(a.vertices)])
    whole_surface = octex.convert(plain((vertices, faces)), 5)
    assert np.array_equal(together.tree.arrays.groups, whole_surface.tree.arrays.groups)
    assert np.array_equal(together.channels["base_color"].values, whole_surface.channels["base_color"].values)


def test_channels_that_a_surface_does_not_state_are_what_materials_give():
    bare, rich = tetrahedron(), whole()
    made = Surface.joined([bare, rich])
    assert [form.name for form in made.channels] == [form.name for form in rich.channels]
    samples = made.scatter(200)
    first = samples.triangles < len(bare.triangles)
    assert (made.evaluate(samples, "roughness")[first] == 1).all()
    assert (made.evaluate(samples, "emissive")[first] == 0).all()
    np.testing.assert_allclose(made.evaluate(samples, "normal")[first], samples.normals[first], atol=1e-6)
    own = samples._replace(
        triangles=samples.triangles[~first] - np.int32(len(bare.triangles)),
        barycentric=samples.barycentric[~first],
    )
    for form in rich.channels:
        np.testing.assert_allclose(
            made.evaluate(samples, form.name)[~first], rich.evaluate(own, form.name), atol=1e-6
        )
    only = made.with_channels(["roughness"])
    assert (only.evaluate(samples, "roughness") == made.evaluate(samples, "roughness")).all()


def test_rest_positions_and_filters_reach_every_part():
    a, b = tetrahedron(), tetrahedron(rest=TETRAHEDRON + np.array([3.0, 0.0, 0.0]))
    made = Surface.joined([a, b]).with_filter("nearest")
    assert np.array_equal(made.rest, np.concatenate([a.rest, b.rest]))
    moved = made.with_rest(made.rest * 2)
    samples = moved.scatter(20)
    assert np.allclose(moved.evaluate(samples), made.evaluate(samples))
    assert (made.source.texel_edges(np.array([0, 5], np.int32)) == np.inf).all()


def test_a_part_with_gaps_leaves_the_others_whole():
    source = FaceSource((ALPHA,), np.zeros((4, 1)))
    clear = Surface(TETRAHEDRON, FACES, source)
    near = octex.Transfer(tetrahedron(), distance=0.1)
    far = Surface.from_arrays(TETRAHEDRON + np.array([9, 0, 0]), FACES).with_sources(near.sources)
    texture = octex.convert([tetrahedron(), far], 5)
    assert texture.contains(tetrahedron().scatter(100).rest).all()
    assert not texture.contains(far.scatter(100).rest).any()
    assert Surface.joined([tetrahedron(), clear]).source.has_gaps is False


def test_nothing_to_join_is_refused():
    with pytest.raises(ArgumentError, match="surface to join is missing"):
        Surface.joined([])


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        (3, "not 3"),
        ([3], "not a list with 3"),
        ([tetrahedron(), octex.PointCloud(np.eye(3), np.eye(3))], "not a list with <PointCloud"),
    ],
)
def test_what_is_no_model_is_refused(model, complaint):
    with pytest.raises(ArgumentError, match=complaint):
        octex.convert(model, 3)
