"""Lookups of random textures at random points, and what such lookups have found."""

import numpy as np
import pytest

from octex.channels import BASE_COLOR
from octex.errors import ArgumentError
from octex.field.weights import mark_mixed
from octex.jit import DISABLED
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.small_textures import UNIT, UNIT_BOUNDS, shell
from tests.properties.random_lookups import check


@pytest.mark.parametrize("seed", range(4 if DISABLED else 80))
def test_random_textures_are_looked_up_as_by_the_references(seed):
    check(seed)


@pytest.mark.parametrize("filter", FILTERS)
def test_a_level_is_looked_up_as_a_texture_of_its_own(filter):
    random = np.random.default_rng(0)
    points, normals = random.random((60, 3)), random.normal(size=(60, 3))
    for whole in (shell(4, 0.0), shell(4, 0.4)):
        level = whole.level(3)
        alone = OctreeTexture(level.tree, level.channels, level.placement, level.bounds)
        for views in ({}, {"normals": normals}, {"width": 0.2}, {"width": 0.2, "normals": normals}):
            expected = alone.sample(points, filter=filter, **views)
            np.testing.assert_array_equal(level.sample(points, filter=filter, **views), expected)


@pytest.mark.parametrize("filter", FILTERS)
def test_points_at_the_rim_of_a_splines_support_have_an_answer(filter):
    tree = Octree.from_leaves(np.array([0, 63]), 2)
    values = np.array([[9] * 3, [40] * 3, [50] * 3, [100] * 3, [200] * 3], np.uint8)
    channel = Channel(BASE_COLOR, values, values[:0], values[:0])
    other = channel._replace(format=BASE_COLOR._replace(name="other"))
    texture = OctreeTexture(tree, {"base_color": channel, "other": other}, UNIT, UNIT_BOUNDS)
    corners = np.stack(np.meshgrid(*[np.arange(33) / 32] * 3), axis=-1).reshape(-1, 3)
    for step in (0.0, 1e-16, -1e-16, 1e-14, -1e-14, 1e-11, 1e-8):
        points = corners + step
        normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        for views in ({}, {"width": 0.3}, {"normals": normals}, {"width": 0.1, "normals": normals}):
            for names in ("base_color", ["base_color", "other"]):
                found = texture.sample(points, names, filter, **views)
                for each in found.values() if isinstance(found, dict) else [found]:
                    assert np.isfinite(each).all()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("filter", FILTERS)
def test_a_row_that_is_not_finite_is_named_however_it_is_looked_at(filter, wrong):
    texture, points = shell(3), np.full((20, 3), 0.4)
    points[[7, 15], 1] = wrong
    right, down, normals = np.random.default_rng(0).normal(size=(3, 20, 3))
    views = [
        {},
        {"width": 0.2},
        {"width": np.linspace(0.01, 1, 20)},
        {"dPdx": right, "dPdy": down},
        {"dPdx": 0.1 * right, "dPdy": down, "normals": normals},
        {"blur": 0.3},
    ]
    for each in views:
        for gradient in (False, True) if filter != "nearest" else (False,):
            with pytest.raises(ArgumentError, match=rf"must be finite, but points\[7\] is \[0.4, {wrong}"):
                texture.sample(points, filter=filter, gradient=gradient, **each)


@pytest.mark.parametrize("extent", [1e-200, 1e-40, 1e40, 1e200])
def test_bounds_whose_root_cell_is_out_of_range_are_refused(extent):
    with pytest.raises(ArgumentError, match="the root cell must have a size from"):
        Placement.around(np.array([[0.0] * 3, [extent] * 3]), 5)


@pytest.mark.parametrize("rows", [0, 1])
def test_no_row_beyond_a_split_table_is_read(rows):
    values = np.array([[0.0], [5.0], [9.0]], np.float32)
    cells, facings, mixed = np.zeros(1, np.uint32), np.array([3], np.uint8), np.zeros(3, np.uint8)
    mark_mixed(cells, facings, np.empty(0, np.float32), values[:rows], 0, 1e-9, mixed)
    assert not mixed.any()
