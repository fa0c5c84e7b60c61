"""Sessions of painting: what single calls give, bit for bit, forth and back."""

import pickle
import threading
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

import octex
from octex.conversion.levels import cell_levels
from octex.errors import ArgumentError, OutputError
from octex.painting import painter as painters
from octex.painting.image import BLENDS
from octex.painting.merge import merged
from octex.painting.project import sight_of
from octex.painting.surface import TriangleGrid
from tests.editing.test_draft import case
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.properties import edit_models

DIRECTIONS = (0.3, 0.5, 1.0), (-1.0, 0.2, 0.1)


def shots(surface, random):
    """Images with a hole or two, of a few cameras."""
    found = []
    for _ in range(random.integers(1, 3)):
        camera = octex.Camera.fitted(surface.vertices, DIRECTIONS[random.integers(2)], size=(24, 18))
        image = edit_models.random_image(int(random.integers(1000)), 24, 18, translucent=True)
        image[: random.integers(12), :, 3] = 0
        blend = BLENDS[(0, 1, 4)[random.integers(3)]]
        found.append(octex.Projection(image, camera, opacity=float(random.choice([0.5, 1])), blend=blend))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_a_session_gives_what_single_calls_give_forth_and_back(seed, monkeypatch):
    monkeypatch.setattr(painters, "_IN_MEMORY", seed % 3)
    random, surface, texture, depth = case(seed)
    painter = octex.Painter(texture, surface)
    states, at = [texture], 0
    for _ in range(10):
        move = random.choice(["paint", "fill", "undo", "redo"], p=[0.35, 0.2, 0.3, 0.15])
        if move in ("paint", "fill"):
            if states[at].tree.n_cells > 60_000:
                continue
            before = states[at]
            if move == "paint":
                given, max_depth = shots(surface, random), int(random.integers(depth - 1, depth + 2))
                pose = surface.with_pose(surface.vertices * random.uniform(0.7, 1.3, 3))
                pose, seen = (None, surface) if random.random() < 0.5 else (pose, pose)
                stroke = painter.paint(given, max_depth=max_depth, pose=pose)
                expected = octex.paint(before, seen, given, max_depth=max_depth)
            else:
                middle = surface.rest[surface.triangles[random.integers(len(surface.triangles))]].mean(axis=0)
                sphere = octex.Sphere(tuple(middle.tolist()), 0.1 * float(np.ptp(surface.rest, axis=0).max()))
                color = random.random(3)
                stroke = painter.fill(sphere, color, opacity=0.7)
                expected = octex.fill(before, surface, sphere, color, opacity=0.7)
            assert_same(painter.texture(), expected)
            assert bool(stroke) == (expected is not before)
            if stroke:
                states[at + 1 :] = [expected]
                at += 1
        elif move == "undo":
            assert painter.undo() == (at > 0)
            at = max(at - 1, 0)
        else:
            assert painter.redo() == (at + 1 < len(states))
            at = min(at + 1, len(states) - 1)
        if random.random() < 0.5:
            painter.store(waits=bool(random.random() < 0.5))
        assert len(painter.strokes) == painter.count == at
        painter.texture().tree.validate()
        assert_same(painter.texture(), states[at])


def begun(depth):
    """A sphere, its texture, and what paints it."""
    surface = edit_models.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, depth)
    return surface, texture, octex.Painter(texture, surface)


def brush(surface, color, pixels=12):
    """A disc of a colour on a small part of a surface."""
    camera = octex.Camera.fitted(surface.vertices, DIRECTIONS[0], size=(96, 96))
    image = np.zeros((96, 96, 4), np.uint8)
    y, x = np.mgrid[:96, :96]
    image[np.hypot(x - 48, y - 48) < pixels / 2] = (color, 20, 30, 255)
    return octex.Projection(image, camera)


def test_what_a_stroke_changes_can_be_applied_elsewhere_and_is_small():
    surface, texture, painter = begun(8)
    (change,) = painter.paint(brush(surface, 200), max_depth=8)
    assert change.nbytes < 0.1 * texture.nbytes
    (sent,) = pickle.loads(pickle.dumps([change]))
    assert_same(sent.applied(texture), painter.texture())
    assert_same(sent.inverted().applied(painter.texture()), texture)
    (deeper,) = painter.paint(brush(surface, 100), max_depth=9)
    for other in (texture, texture.level(2)):
        with pytest.raises(ArgumentError, match="belongs to another texture"):
            deeper.inverted().applied(other)


def test_strokes_in_a_file_are_as_they_were_and_none_is_lost_without_one(tmp_path):
    surface, _, painter = begun(6)
    assert painter.last == ()
    colors = range(0, 250, 40)
    strokes = [painter.paint(brush(surface, color), max_depth=6) for color in colors]
    with pytest.raises(OutputError, match=r"strokes cannot be stored: .*nowhere"):
        painter.store(tmp_path / "nowhere")
    assert painter.strokes == tuple(strokes)
    painter.store(tmp_path)
    assert painter.strokes[-1] is strokes[-1]
    assert painter.strokes[0] is not strokes[0]
    for (found,), (change,) in zip(painter.strokes, strokes, strict=True):
        assert found.tiles is not None and change.tiles is not None
        np.testing.assert_array_equal(found.tiles.codes, change.tiles.codes)
        assert_same(found.before, change.before)
        assert_same(found.after, change.after)
    assert_same(painter.last[0].after, strokes[-1][0].after)


def test_strokes_are_compressed_while_the_next_ones_are_painted(tmp_path, monkeypatch):
    surface, texture, painter = begun(6)
    may_pack, pack = threading.Event(), painters._packed
    monkeypatch.setattr(painters, "_packed", lambda stroke: may_pack.wait(20) and pack(stroke))
    for color in range(0, 200, 25):
        painter.paint(brush(surface, color), max_depth=6)
        painter.store(tmp_path, waits=False)  # returns at once
    assert len(painter._done._strokes) == painter.count == 8
    may_pack.set()
    painter.paint(brush(surface, 250), max_depth=6)
    painter.store(tmp_path, waits=False)  # now too many wait
    assert len(painter._done._strokes) <= painters._IN_MEMORY + painters._MOST_WAITING
    while painter.undo():
        pass
    assert_same(painter.texture(), texture)


@pytest.mark.parametrize("seed", range(4))
def test_a_session_writes_to_no_texture_that_somebody_has(seed):
    random, surface, texture, depth = case(seed)
    watched, alone = octex.Painter(texture, surface), octex.Painter(texture, surface)
    seen = []  # textures that `watched` has returned, and copies of them as they were
    for _ in range(8):
        move = random.choice(["paint", "undo", "redo"], p=[0.6, 0.25, 0.15])
        given, max_depth = shots(surface, random), int(random.integers(depth - 1, depth + 1))
        for painter in (watched, alone):
            if move != "paint":
                getattr(painter, move)()
            elif len(painter.strokes) < 4:
                painter.paint(given, max_depth=max_depth)
        seen.append((watched.texture(), pickle.loads(pickle.dumps(watched.texture()))))
        if random.random() < 0.2:
            seen.append((alone.texture(), pickle.loads(pickle.dumps(alone.texture()))))
    assert_same(alone.texture(), watched.texture())
    for found, copy in seen:
        assert_same(found, copy)
    while alone.undo():
        pass
    assert_same(alone.texture(), texture)


def test_a_call_that_fails_in_its_second_layer_leaves_all_as_it_was():
    surface, _, painter = begun(7)
    painter.paint(brush(surface, 10), max_depth=7)
    before = pickle.loads(pickle.dumps(painter._texture))
    count = 0

    def second_fails(*given):
        nonlocal count
        count += 1
        if count == 2:
            raise KeyboardInterrupt
        return merged(*given)

    layers = [brush(surface, 200), replace(brush(surface, 90), blend="multiply")]
    with mock.patch.object(painter, "_merging", second_fails), pytest.raises(KeyboardInterrupt):
        painter.paint(layers, max_depth=7)
    assert count == 2
    assert_same(painter.texture(), before)
    assert len(painter.strokes) == 1


def test_a_camera_that_stays_looks_once():
    surface, _, painter = begun(6)
    with mock.patch("octex.painting.surface.sight_of", wraps=sight_of) as look:
        for color in (10, 20, 30):
            painter.paint(brush(surface, color, 30))
        assert look.call_count == 1
        painter.paint(octex.Projection(brush(surface, 1).image, brush(surface, 1).camera), edge_feather=2.0)
        assert look.call_count == 2


@pytest.mark.parametrize("kind", ["pinhole", "lens", "orthographic"])
def test_what_no_image_sees_is_left_out_without_a_difference(kind):
    sphere = ball(12)
    x, y, z = sphere.vertices.T
    rest = np.column_stack([1.7 * x + 0.3 * y**2, y - 0.5 * z, 0.6 * z + 0.2 * x * y])
    surface = octex.Surface.from_arrays(sphere.vertices, sphere.triangles, rest=rest, factor=(0.5, 0.5, 0.5))
    texture = octex.convert(surface, 8)
    camera = octex.Camera.fitted(sphere.vertices, (0.4, 0.3, 1.0), size=(160, 160))
    if kind == "lens":
        camera = replace(camera, distortion=(0.2, 0.05, 0.01, -0.01))
    elif kind == "orthographic":
        camera = replace(
            camera, projection="orthographic", K=np.array([[60.0, 0, 80], [0, 60, 80], [0, 0, 1]])
        )
    rows, columns = np.mgrid[:160, :160]
    image = np.full((160, 160, 4), (200, 40, 90, 255), np.uint8)
    image[..., 3] = np.clip(20 * (16 - np.hypot(columns - 60, rows - 90)), 0, 255)
    cells = []

    def counted(*given, **options):
        found = cell_levels(*given, **options)
        cells.append(found.n_leaves + found.gaps.size)
        return found

    def whole(*given, reached, **options):
        assert reached
        return counted(*given, **options)

    made = []
    for own in (counted, whole):
        with mock.patch("octex.painting.steps.cell_levels", own):
            made.append(octex.paint(texture, surface, octex.Projection(image, camera), max_depth=8))
    assert_same(*made)
    assert not np.array_equal(made[0].channels["base_color"].values, texture.channels["base_color"].values)
    assert kind == "lens" or cells[0] < 0.75 * cells[1]  # what a lens bends is looked for in all the image


def test_a_stroke_beside_the_surface_is_none():
    _, texture, painter = begun(5)
    assert painter.fill(octex.Sphere((9, 9, 9), 0.1), (1, 0, 0)) == ()
    assert painter.texture() is texture
    assert not painter.undo()
    assert not painter.redo()


def test_a_refused_stroke_leaves_all_as_it_was():
    surface, texture, painter = begun(5)
    with pytest.raises(ArgumentError, match="channel"):
        painter.paint(brush(surface, 9), channel="roughness")
    assert painter.texture() is texture
    with pytest.raises(ArgumentError, match=r"must be an octex\.OctreeTexture"):
        octex.Painter(None, surface)


def test_what_is_no_pose_of_the_surface_is_refused():
    surface = ball(8)
    painter = octex.Painter(octex.convert(surface, depth=4), surface)
    for other, what in ((ball(9), "triangles"), (surface.with_rest(surface.rest * 2.0), "rest")):
        with pytest.raises(ArgumentError, match=f"surface is no pose of surface: it has other {what}"):
            painter.paint(shots(surface, np.random.default_rng(0)), pose=other)
    with pytest.raises(ArgumentError, match=r"pose must be an octex\.Surface"):
        painter.paint([], pose=surface.vertices)
    assert painter.strokes == ()


def test_poses_share_what_is_known_of_the_surface_at_rest():
    surface = ball(8)
    painter = octex.Painter(octex.convert(surface, depth=4), surface)
    random, grids = np.random.default_rng(0), []
    init = TriangleGrid.__init__
    with mock.patch.object(TriangleGrid, "__init__", lambda *given: grids.append(given) or init(*given)):
        for scale in (1.0, 0.9, 1.1):
            assert painter.paint(shots(surface, random), pose=surface.with_pose(surface.vertices * scale))
        assert painter.paint(shots(surface, random))
    assert len(grids) == 1
