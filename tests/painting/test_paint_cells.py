"""Which cells paint makes, and where none is needed."""

import numpy as np
import pytest

import octex
from octex.painting.layer import paint_of, wanted_depths
from octex.tree.morton import decode_cells
from octex.tree.neighbours import boundary
from tests.conftest import needs_jit
from tests.make.painted import above, ball, one_color, plain, square
from tests.painting.test_paint import spot
from tests.properties.edit_claims import cells_of

pytestmark = needs_jit


def test_the_boundary_is_one_cell_of_the_same_size_around_paint():
    surface, camera = plain(square()), above(3.0, 64, 192.0)
    layer = octex.project(surface, octex.Projection(spot(camera, (1, 0, 0), 8), camera))
    paint = paint_of(layer, 1.0)
    for level, each in enumerate(paint):
        around = boundary(each.codes, level)
        if not each.codes.size:
            assert not around.size
            continue
        own, beside = decode_cells(each.codes), decode_cells(around)
        assert not set(map(tuple, own.tolist())) & set(map(tuple, beside.tolist()))
        apart = np.abs(beside[:, None] - own[None]).max(axis=2).min(axis=1)
        assert (apart == 1).all()


@pytest.mark.parametrize(("opacity", "blend"), [(1.0, "over"), (0.5, "over"), (0.5, "replace"), (1.0, "add")])
def test_what_opaque_paint_covers_keeps_nothing_and_has_no_skirts(opacity, blend):
    surface = ball(24)
    texture = octex.convert(surface, 6)
    edge = texture.placement.size / 2**6
    sphere = octex.Sphere((1.0, 0.0, 0.0), 0.8)
    found = octex.fill(texture, surface, sphere, (0.2, 0.5, 0.7), max_depth=7, opacity=opacity, blend=blend)
    leaves = found.tree.leaf_cells()
    cells = cells_of(found)
    middles = (cells.low + cells.high) / 2
    skirts = middles[leaves[found.tree.arrays.areas[leaves] == 1]]
    kept = middles[found.tree.kept.cells]
    hides = (opacity == 1.0 and blend == "over") or blend == "replace"
    for off in (skirts, kept):
        inside = 0.8 - np.linalg.norm(off - [1.0, 0.0, 0.0], axis=1)
        assert len(off)
        assert (inside.max() < 6 * edge) == hides
    points = surface.scatter(2000, 1)
    away = np.linalg.norm(points.rest - [1.0, 0.0, 0.0], axis=1)
    if hides:
        np.testing.assert_allclose(found.sample(points)[away < 0.8 - 2 * edge][:, 1], 0.5, atol=4e-3)
    beside = away > 0.8 + 3 * edge
    before, after = (each.sample(points.rest[beside]) for each in (texture, found))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_images_get_cells_of_half_a_pixel_to_one_unless_they_may_be_finer():
    surface = plain(square(0.0, 1.0))
    image = spot(above(size=64), (1, 0, 0), 20.0)
    for pixels_per_unit in (20.0, 30.0, 40.0, 55.0):
        pose = np.eye(4)
        pose[2, 3] = 2.0
        camera = octex.Camera.orthographic(
            (64, 64), pose=pose, convention="opengl", pixels_per_unit=pixels_per_unit
        )
        layer = octex.project(surface, octex.Projection(image, camera))
        deepest = octex.project(surface, octex.Projection(image, camera), max_depth=12)
        cell = layer.placement.size / 2**layer.tree.max_depth * pixels_per_unit
        assert 0.5 < cell < 1.1
        finest = deepest.placement.size / 2**deepest.tree.max_depth * pixels_per_unit
        assert 0.25 < finest < 0.55
        assert finest < cell
        assert octex.project(surface, octex.Projection(image, camera), max_depth=3).tree.max_depth == 3


def test_paint_of_one_color_is_that_color_in_all_leaves():
    surface, camera = ball(), above(4.0, 64)
    image = np.full((64, 64, 4), (200, 40, 90, 0), np.uint8)
    y, x = np.mgrid[:64, :64] - 31.5
    image[..., 3] = np.clip(25 * (24 - np.hypot(x, y)), 0, 255)
    layer = octex.project(surface, octex.Projection(image, camera))
    leaves = layer.tree.leaf_cells()
    assert (layer.channels["base_color"].values[leaves] == (200, 40, 90)).all()
    assert np.unique(layer.channels["alpha"].values[leaves]).size > 100


def test_one_level_serves_where_pixels_vary_little():
    # Cells as wide as these would be of levels 6.6, 7.5, 5.3 and 8.6.
    widths = np.repeat([1 / 100, 1 / 180, 1 / 40, 1 / 400], [60, 20, 17, 3])
    areas = np.ones(100)
    found = wanted_depths(widths, areas, 1.0, 1.0)
    assert found == (7, 9, False)
    some = np.array([1 / 100, 1 / 180, 1 / 40, 1 / 400, 1 / 12, np.inf])
    assert np.ceil(found.levels(some, 1.0, 1.0)).tolist() == [7, 7, 7, 9, 4, 0]
    assert wanted_depths(widths[:-3], areas[:-3], 1.0, 1.0) == (7, 7, True)
    alone = wanted_depths(widths, areas, 1.0, 1.0, is_single=True)
    assert alone == (9, 9, False)
    assert np.ceil(alone.levels(some, 1.0, 1.0)).tolist() == [7, 9, 6, 9, 4, 0]
    assert wanted_depths(widths, areas, 1.0, 1.0, 6) == (6, 6, True)
    assert wanted_depths(widths[:0], areas[:0], 1.0, 1.0) == (0, 0, True)
    surface, camera = ball(), above(4.0, 100)
    layer = octex.project(surface, octex.Projection(one_color(camera, (1, 0, 0)), camera))
    assert [level for level, (leaves, _) in enumerate(layer.tree.cells_by_depth()) if leaves] == [7]


@pytest.mark.parametrize(("size", "place"), [((512, 384), (0.02, 0.9)), ((391, 450), (0.5, 0.5))])
@pytest.mark.parametrize(("max_depth", "feather"), [(7, 0.0), (3, 0.0), (6, 20.0), (6, 100.0)])
def test_transparent_parts_far_from_paint_are_not_looked_at(size, place, max_depth, feather, monkeypatch):
    """Nor do they change the paint, but for how pixels fit into those of smaller images."""
    surface = ball(12)
    texture = octex.convert(surface, 4)
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.5, 1.0), size=size)
    y, x = np.mgrid[: size[1], : size[0]]
    image = np.full((size[1], size[0], 4), (200, 40, 90, 0), np.uint8)
    image[..., 3] = np.clip(25 * (30 - np.hypot(x - place[0] * size[0], y - place[1] * size[1])), 0, 255)
    shot = octex.Projection(image, camera)
    found = octex.paint(texture, surface, shot, max_depth=max_depth, edge_feather=feather)
    monkeypatch.setattr("octex.painting.paint.AROUND", 1 << 20)
    expected = octex.paint(texture, surface, shot, max_depth=max_depth, edge_feather=feather)
    seen = surface.scatter(20_000)
    np.testing.assert_allclose(found.sample(seen), expected.sample(seen), atol=0.02)
    if size[0] % 64 == 0:
        np.testing.assert_array_equal(found.tree.arrays.flags, expected.tree.arrays.flags)
        one, other = (each.channels["base_color"].values.astype(int) for each in (found, expected))
        assert np.abs(one - other).max() <= 1


def test_a_mask_is_its_alpha_wherever_the_paint_is():
    """A mask that has alpha is not read by its light, though near the paint all of it is opaque."""
    surface = plain(square())
    camera = above(size=512)
    image = spot(camera, (200, 40, 90), 12.0)
    mask = np.zeros((512, 512, 4), np.uint8)
    mask[100:412, 100:412, 3] = 255
    texture = octex.convert(surface, 5)
    found = octex.paint(texture, surface, octex.Projection(image, camera, mask=mask))
    expected = octex.paint(texture, surface, octex.Projection(image, camera))
    np.testing.assert_array_equal(found.sample(surface.scatter(500)), expected.sample(surface.scatter(500)))
