"""Drafts: what is cut out and put back is as it was, and paint on a draft is paint on the whole."""

from functools import cache
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.editing.draft import Change, OpenTiles, cut_out, put_back, tiles_around
from octex.painting import merge as tilewise
from octex.painting.first import with_coverage
from octex.painting.image import BLENDS
from octex.tree.octree import distinct
from tests.make.same import assert_same
from tests.make.strategies import textures
from tests.properties import edit_models

CHANNELS = (["base_color"], ["base_color", "alpha"], ["base_color", "alpha", "roughness", "normal"])


@st.composite
def textures_and_tiles(draw):
    """A texture, and some cells of a level below its root."""
    texture = draw(textures().filter(lambda each: each.tree.max_depth >= 1))
    level = draw(st.integers(1, texture.tree.max_depth), label="level")
    codes = texture.tree.level_codes(level)
    chosen = draw(st.sets(st.integers(0, len(codes) - 1), max_size=6), label="tiles")
    return texture, OpenTiles(level, codes[sorted(chosen)])


@given(textures_and_tiles())
def test_what_is_cut_out_is_put_back_as_it_was(drawn):
    texture, tiles = drawn
    level, part = tiles.level, cut_out(texture, tiles)
    part.tree.validate()
    assert_same(put_back(texture, tiles, part), texture)
    below = part.tree.n_cells - int(part.tree.arrays.level_cells[min(level, part.tree.max_depth) + 1])
    whole = sum(
        int((np.isin(texture.tree.level_codes(deeper) >> 3 * (deeper - level), tiles.codes)).sum())
        for deeper in range(level + 1, texture.tree.max_depth + 1)
    )
    assert below == whole


@given(textures_and_tiles(), st.sets(st.sampled_from(["values", "kept_values", "split_values"])))
def test_a_change_of_values_alone_is_put_into_the_texture_as_any_draft_is(drawn, arrays):
    texture, tiles = drawn
    part = cut_out(texture, tiles)
    channels = {
        name: channel._replace(**{each: getattr(channel, each)[::-1].copy() for each in arrays})
        for name, channel in part.channels.items()
    }
    edited = part.with_cells(part.tree, channels)
    with mock.patch("octex.editing.draft.put_back", side_effect=AssertionError("cells are where they were")):
        found = Change(tiles, part, edited).put_into(texture)
    assert_same(found, put_back(texture, tiles, edited))


def stroke(random, surface, depth):
    """A small edit: texture in, texture out."""
    blend = BLENDS[max(random.integers(-1, len(BLENDS)), 0)]
    depth = int(np.clip(depth + random.integers(-2, 3), 1, 8))
    middle = surface.rest[surface.triangles[random.integers(len(surface.triangles))]].mean(axis=0)
    extent = float(np.ptp(surface.rest, axis=0).max())
    if random.random() < 0.5:
        radius, soft = extent * random.choice([0.02, 0.06, 0.15]), extent * random.choice([0.0, 0.03])
        sphere = octex.Sphere(tuple(middle.tolist()), float(radius), float(soft))
        color, opacity = random.random(3), float(random.choice([1.0, 0.5]))
        return lambda texture: octex.fill(
            texture, surface, sphere, color, opacity=opacity, blend=blend, max_depth=depth
        )
    camera = edit_models.camera(surface, int(random.integers(1000)), 24, 18)
    image = edit_models.random_image(int(random.integers(1000)), 24, 18, bool(random.integers(2)))
    row, column = random.integers(0, 14), random.integers(0, 18)
    around = np.ones((18, 24), np.bool_)
    around[row : row + 4, column : column + 5] = False
    image[around] = 0
    shot, fit = octex.Projection(image, camera, blend=blend), bool(random.integers(2))
    return lambda texture: octex.paint(texture, surface, shot, max_depth=depth, fit=fit)


def case(seed):
    """A texture of a small surface, fitted or adaptive or neither."""
    random = np.random.default_rng([7, seed])
    kind = edit_models.MESHES[random.integers(len(edit_models.MESHES))]
    names = CHANNELS[random.integers(len(CHANNELS))]
    surface = edit_models.waved(kind, int(random.integers(1000)), names, int(random.integers(1000)))
    depth = int(random.integers(5, 8))
    max_error = float(random.choice([1, 4, 16])) if random.random() < 0.4 else None
    texture = octex.convert(surface, depth, fit=bool(random.integers(2)), max_error=max_error)
    if random.random() < 0.3:
        texture = octex.cast(texture, str(random.choice(["uint16", "float16", "float32"])))
    return random, surface, texture, depth


def test_the_brightest_light_far_away_limits_averages_of_a_draft_too():
    surface = edit_models.waved("sphere", 0, ["base_color"], 0)
    texture = octex.cast(octex.convert(surface, 7), "float32")
    bright = octex.fill(texture, surface, octex.Sphere((1, 0, 0), 0.1), (5, 9, 2), blend="add")
    sphere = octex.Sphere((-1, 0, 0), 0.1)
    found = octex.fill(bright, surface, sphere, (7, 7, 7), blend="add")
    with mock.patch.object(tilewise, "tiles_around", lambda *_: None):
        assert_same(found, octex.fill(bright, surface, sphere, (7, 7, 7), blend="add"))
    tiles = tiles_around(bright, [np.empty(0, np.int64)] * 7 + [bright.tree.level_codes(7)[:1]], 7)
    assert tiles is not None
    values, part = bright.channels["base_color"].values, cut_out(bright, tiles).channels["base_color"].values
    assert part.max() == values.max() > 1
    assert len(part) < 0.5 * len(values)


@pytest.mark.parametrize("seed", range(8))
def test_strokes_on_drafts_are_strokes_on_the_whole(seed):
    random, surface, texture, depth = case(seed)
    for _ in range(3):
        paint = stroke(random, surface, depth)
        found = paint(texture)
        found.tree.validate()
        with mock.patch.object(tilewise, "tiles_around", lambda *_: None):
            assert_same(found, paint(texture))
        texture = found
        if texture.tree.n_cells > 100_000:
            break


@cache
def layered(seed):
    """A texture, a layer of three images for it, their surface and an opacity."""
    random, surface, texture, depth = case(seed)
    if seed % 2:  # in part without cells
        image, camera = edit_models.random_image(seed, 60, 60), edit_models.camera(surface, seed, 60, 60)
        shot = octex.Projection(image, camera)
        texture = octex.paint(None, surface, shot, max_depth=depth)
    shots = [
        octex.Projection(
            edit_models.random_image(int(random.integers(1000)), 60, 60, bool(random.integers(2))),
            edit_models.camera(surface, int(random.integers(1000)), 60, 60),
        )
        for _ in range(3)
    ]
    layer = octex.project(surface, shots, like=texture, max_depth=int(random.integers(depth, 9)))
    return texture, layer, surface, float(random.choice([1.0, 0.5]))


@pytest.mark.parametrize(
    ("seed", "blend"),
    [(2, "over"), (2, "multiply"), (3, "erase"), (4, "replace"), (4, "over"), (8, "over"), (8, "erase")],
)
def test_a_layer_merged_tile_by_tile_is_the_layer_merged_at_once(seed, blend):
    texture, layer, surface, opacity = layered(seed)
    how = {"opacity": opacity, "blend": blend}
    whole = octex.merge(texture, layer, surface, **how)
    piece = max(400, layer.tree.n_leaves // 20)
    with mock.patch.multiple(tilewise, WHOLE=piece, PIECE=piece, MOST=1000.0):
        assert tilewise.pieces_of(texture, layer, tilewise.coarsest_near_layer(texture, layer)) is not None
        found = octex.merge(texture, layer, surface, **how)
        covered = with_coverage(found, [layer])
    found.validate()
    assert_same(found, whole)
    assert_same(covered, with_coverage(whole, [layer]))


def test_cells_split_in_one_tile_change_rows_of_all_channels_above_as_at_once():
    surface = edit_models.waved("open", 19, ["base_color", "alpha"], 48)
    texture = octex.convert(surface, 5, dtype="uint16", fit=False)
    shots = [
        octex.Projection(edit_models.stroke(876, 25, 39), edit_models.camera(surface, 527, 25, 39)),
        octex.Projection(edit_models.random_image(324, 29, 35), edit_models.camera(surface, 202, 29, 35)),
    ]
    layer = octex.project(
        surface, shots, like=texture, max_depth=4, fit=False, back_faces=True, max_angle=180.0
    )
    whole = octex.merge(texture, layer, surface, blend="replace")
    rows = (own.channels["alpha"].split_values for own in (texture, whole))
    assert not np.array_equal(*rows)
    with mock.patch.multiple(tilewise, WHOLE=500, PIECE=500, MOST=1000.0):
        assert_same(octex.merge(texture, layer, surface, blend="replace"), whole)


def test_a_change_made_tile_by_tile_is_small():
    surface = edit_models.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, 8)
    painter = octex.Painter(texture, surface)
    sphere = octex.Sphere((1, 0, 0), 0.3)
    at_once = painter.fill(sphere, (1, 0, 0))
    whole = painter.texture()
    with mock.patch.multiple(tilewise, WHOLE=400, PIECE=400, MOST=1000.0):
        painter = octex.Painter(texture, surface)
        by_tiles = painter.fill(sphere, (1, 0, 0))
    assert_same(painter.texture(), whole)
    assert sum(each.nbytes for each in by_tiles) == sum(each.nbytes for each in at_once) < texture.nbytes
    painter.undo()
    assert_same(painter.texture(), texture)


def test_a_small_stroke_needs_a_small_draft():
    surface = edit_models.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, 8)
    codes = [np.empty(0, np.int64)] * 8 + [texture.tree.level_codes(8)[:10]]
    tiles = tiles_around(texture, codes, 8)
    assert tiles is not None
    assert tiles.level == 5
    assert np.isin(distinct(codes[8] >> 9), tiles.codes).all()
    part = cut_out(texture, tiles).tree
    assert part.n_cells < 0.1 * texture.tree.n_cells
    # Above the tiles too, no more cells are there than near them.
    assert (np.diff(part.level_cells)[:6] <= 6 * 6 * 6).all()
