"""What pages are sent of a texture that has changed: as if they had loaded it anew, without doing so."""

import json
import zlib
from itertools import pairwise

import numpy as np
import pytest

import octex
from octex.editing.draft import Change, OpenTiles, change_in, cut_out, joined_change
from octex.viewer import Viewer
from octex.viewer.changes import change_between, change_of
from octex.viewer.pack import pack
from tests.conftest import needs_jit
from tests.make.browser import UNLIKE, Probe, differences, lose_gpu, restore_gpu
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.small_surfaces import sheet


def told(viewer, page):
    """Wait until a page has what is shown."""
    viewer.changed()
    shows = "(version) => viewer.version === version"
    page.wait_for_function(shows, arg=viewer.version()[0], polling=20)


def test_after_each_stroke_a_page_has_what_one_has_that_loads_anew(opens, tmp_path):
    surface = sheet(np.eye(3), 0.01)
    waves = surface.with_sources({"base_color": lambda p: 0.5 + 0.5 * np.sin(20 * p)})
    painter = octex.Painter(octex.convert(waves, depth=5, max_error=3), surface)
    low, high = surface.bounds
    middle, width = (low + high) / 2, float((high - low).max())
    strokes = [
        lambda: painter.fill(octex.Sphere(middle, 0.2 * width), (1.0, 0.1, 0.0), max_depth=7),
        lambda: painter.fill(octex.Sphere(low, 0.4 * width), (0.0, 0.3, 1.0), opacity=0.5),
        painter.undo,
        painter.undo,
        painter.redo,
    ]
    viewer = Viewer(painter.texture, tmp_path / "session.octex", surface)
    page = opens(viewer, (320, 240))
    page.evaluate("globalThis.isFirst = true")
    for stroke in strokes:
        before = painter.texture()
        stroke()
        assert painter.texture() is not before
        told(viewer, page)
        assert page.evaluate(UNLIKE) == []
    assert page.evaluate("isFirst")
    texture = painter.texture()
    assert texture.tree.split.cells.size
    assert texture.tree.kept.cells.size
    for facing in (False, True):
        shown(page, texture, surface, facing)
    lose_gpu(page)
    restore_gpu(page)
    shown(page, texture, surface, True)


@pytest.mark.parametrize("seed", range(2))
def test_random_strokes_change_a_page_to_what_one_has_that_loads_anew(seed, opens, tmp_path):
    random = np.random.default_rng(seed)
    surface = sheet(np.eye(3), 0.01) if seed % 2 else ball(12)
    waves = surface.with_sources({"base_color": lambda p: 0.5 + 0.5 * np.sin(20 * p)})
    painter = octex.Painter(octex.convert(waves, depth=4, max_error=3 if seed % 2 else None), surface)
    width = float(np.ptp(surface.bounds, axis=0).max())
    viewer = Viewer(painter.texture, tmp_path / "session.octex", surface)
    page = opens(viewer, (64, 48), is_drawn=False)
    for _ in range(25):
        middle = surface.scatter(1, seed=int(random.integers(1000))).rest[0]
        sphere = octex.Sphere(middle, width * random.uniform(0.01, 0.2))
        depth = None if random.random() < 0.5 else int(random.integers(4, 8))
        move = random.integers(4)
        if move < 2:
            painter.fill(sphere, random.random(3), max_depth=depth)
        else:
            (painter.undo if move == 2 else painter.redo)()
        told(viewer, page)
        assert page.evaluate(UNLIKE) == []
    assert painter.texture().tree.kept.cells.size


def shown(page, texture, surface, facing):
    """Compare what a page draws with lookups."""
    probe = Probe(page, texture, (48, 36), filter="quadratic", width=-1.0, facing=facing, level=20)
    header = pack(texture, surface).header
    for away in differences(probe, texture, header, "quadratic", -1.0, facing).values():
        assert away.size > 100
        assert away.max() <= 1.0


def test_a_stroke_without_new_cells_sends_the_rows_that_it_changes(opens, tmp_path):
    surface = ball(32)
    texture = octex.convert(surface.with_sources({"base_color": lambda p: np.full_like(p, 0.5)}), depth=7)
    painter = octex.Painter(texture, surface)
    viewer = Viewer(painter.texture, tmp_path / "session.octex", surface)
    page = opens(viewer, (320, 240), is_drawn=False)
    point = surface.scatter(1, seed=2).rest[0]
    painter.fill(octex.Sphere(point, 0.1), (1.0, 0.0, 0.0))
    told(viewer, page)
    rows = page.evaluate(
        "viewer.parts[0].stores.reduce((sum, { rows, read }) => sum + read().length * rows, 0)"
    )
    assert 0 < page.evaluate("viewer.uploadedRows") < rows / 2
    version = viewer.version()[0]
    painter.undo()
    viewer.changed()
    viewer.version()
    assert len(viewer.of_version(version)[1].streams["change-0"]) < 0.05 * texture.nbytes


def test_strokes_with_new_cells_send_the_rows_that_they_change(opens, tmp_path):
    surface = ball(32)
    texture = octex.convert(surface.with_sources({"base_color": lambda p: np.full_like(p, 0.5)}), depth=7)
    painter = octex.Painter(texture, surface)
    last = surface.rest[np.argmax(surface.rest.sum(axis=1))]  # in Morton order cells there stand behind most
    viewer = Viewer(painter.texture, tmp_path / "session.octex", surface)
    page = opens(viewer, (320, 240), is_drawn=False)
    sent = []
    for radius in (0.1, 0.105, 0.11):
        painter.fill(octex.Sphere(last, radius), (1.0, 0.0, 0.0), max_depth=8)
        told(viewer, page)
        sent.append(page.evaluate("viewer.uploadedRows"))
        shown(page, painter.texture(), surface, False)
    used = page.evaluate(
        "viewer.parts[0].stores.flatMap(({ read, size }) => read().map(({ length }) => length / size / 4096))"
        ".reduce((sum, rows) => sum + rows)"
    )
    assert sent[0] > used / 2 > max(sent[1:]), (sent, used)
    assert page.evaluate("viewer.gpu.gl.getError()") == 0


def test_what_is_otherwise_than_the_page_can_be_sent_is_loaded_anew(opens, tmp_path):
    surface, path = ball(8), tmp_path / "ball.octex"
    rough = surface.with_sources({"roughness": 0.5, "base_color": lambda p: np.full_like(p, 0.5)})
    octex.convert(rough, depth=3).save(path)
    viewer = Viewer(lambda: octex.open(path), path, surface)
    page = opens(viewer, (320, 240), is_drawn=False)
    octex.convert(rough, depth=3, channels=["base_color"]).save(path)
    page.wait_for_function("globalThis.viewer?.header?.parts[0].channels.length === 1 && viewer.isLoaded")


def test_runs_and_new_cells_make_up_the_texture_that_is_now():
    waves = ball(8).with_sources({"base_color": lambda p: 0.5 + 0.5 * np.sin(20 * p)})
    before = octex.convert(waves, depth=4)
    low, _ = before.bounds
    after = octex.fill(before, ball(8), octex.Sphere(low + 0.3, 0.5), (1.0, 0.0, 0.0), max_depth=5)
    counts, stream = change_between(before, after)
    numbers = np.frombuffer(stream[: 12 * counts["runs"]], np.uint8).reshape(3, 4, -1).astype(np.int64)
    gaps, begins, lengths = (numbers * 256 ** np.arange(4)[:, None]).sum(axis=1)
    assert gaps.sum() + lengths.sum() <= after.tree.n_cells
    assert lengths.sum() + counts["cells"] == after.tree.n_cells
    values, at = after.channels["base_color"].values, 0
    for gap, begin, length in zip(gaps, begins, lengths, strict=True):
        at += gap
        old = before.channels["base_color"].values[begin : begin + length]
        np.testing.assert_array_equal(values[at : at + length], old)
        at += length
    nothing, stream = change_between(after, after)
    assert nothing == {"runs": 1, "cells": 0, "kept": 0, "sides": 0}
    assert len(stream) == 12


@pytest.mark.parametrize("seed", range(4))
def test_a_change_of_a_painter_is_packed_as_if_both_textures_were_compared(seed):
    random = np.random.default_rng(seed)
    surface = sheet(np.eye(3), 0.01) if seed % 2 else ball(24)
    waves = surface.with_sources({"base_color": lambda p: 0.5 + 0.5 * np.sin(20 * p)})
    texture = octex.convert(waves, depth=6 + seed % 2, max_error=3 if seed > 1 else None)
    painter = octex.Painter(texture, surface)
    low, high = surface.bounds
    width, is_small, is_joined = float((high - low).max()), 0, 0
    first, together = texture, list[Change]()
    for _ in range(12):
        middle = surface.scatter(1, seed=int(random.integers(1000))).rest[0]
        before, move = painter.texture(), random.integers(4)
        if move < 3:
            sphere = octex.Sphere(middle, width * random.uniform(0.005, 0.1))
            changes = painter.fill(sphere, random.random(3), max_depth=int(random.integers(6, 10)))
        else:
            changes = (
                tuple(change.inverted() for change in painter.strokes[-1:][0]) if painter.strokes else ()
            )
            painter.undo()
        for change in changes:
            after = painter.texture()
            assert change_of(change, before, after) == change_between(before, after)
            is_small += change.tiles is not None
        together += changes
        if len(together) == 3:
            after = painter.texture()
            joined = joined_change(together, first, after)
            assert change_of(joined, first, after) == change_between(first, after)
            assert_same(joined.put_into(first), after)
            is_joined += joined.tiles is not None
            first, together = after, []
    assert is_small > 2
    assert is_joined > 0


def test_a_page_that_is_behind_gets_change_after_change(tmp_path):
    surface = ball(8)
    painter = octex.Painter(octex.convert(surface, depth=3), surface)
    viewer = Viewer(painter.texture, tmp_path / "session.octex", None)
    versions = [viewer.version()[0]]
    for red in (0.2, 0.6):
        painter.fill(octex.Sphere(surface.bounds[0], 1.0), (red, 0.0, 0.0))
        viewer.changed()
        versions.append(viewer.version()[0])
    for since, then in pairwise(versions):
        change = viewer.of_version(since)[1]
        assert json.loads(json.dumps(change.header))["version"] == then
        assert zlib.decompress(change.streams["change-0"], -15)
    assert viewer.of_version(versions[-1])[1].header == {}
    assert [packed.header for packed in viewer.of_version("none")] == [{}, {}]
    viewer._server.server_close()


def test_the_page_and_cameras_agree_on_what_a_pixel_sees(opens, browser, tmp_path):
    if browser.browser_type.name == "firefox":
        pytest.skip("WebDriver BiDi does not tell playwright of downloads")
    surface, path = ball(32), tmp_path / "ball.octex"
    octex.convert(surface.with_sources({"base_color": lambda p: np.full_like(p, 0.5)}), depth=4).save(path)
    viewer = Viewer(lambda: octex.open(path), path, surface)
    page = opens(viewer, (900, 320), is_drawn=False)
    page.evaluate("viewer.camera.orbit(0.4, 0.2); viewer.camera.pan(0.1, -0.05); viewer.camera.zoom(1.5)")
    with page.expect_download() as waiting:
        page.click("#save-camera")
    waiting.value.save_as(tmp_path / "camera.json")
    assert waiting.value.suggested_filename == "ball-camera.json"
    (frame,) = octex.read_cameras(tmp_path / "camera.json")
    camera = frame.camera()
    assert frame.name == "ball.png"
    assert [camera.width, camera.height] == page.evaluate(
        "[viewer.canvas.clientWidth, viewer.canvas.clientHeight]"
    )
    for pixel in ([370, 130], [330, 190], [400, 100]):
        found = page.evaluate("(at) => viewer.pick(...at)", pixel)
        point = np.array([found["rest"]])
        # To what rasterizers round corners to: a sixteenth of a pixel.
        np.testing.assert_allclose(camera.project(point)[0][0], np.add(pixel, 0.5), atol=1 / 16)


@needs_jit
@pytest.mark.parametrize("depth", [None, 8])
def test_parents_of_a_changed_tile_are_sent_with_all_their_children(depth):
    surface = ball(24)
    before = octex.convert(surface, 7)
    painter = octex.Painter(before, surface)
    (change,) = painter.fill(octex.Sphere(surface.vertices[300], 0.03), (1.0, 0.0, 0.0), max_depth=depth)
    after = painter.texture()
    assert change.tiles is not None

    def below(texture, tiles):
        draft = cut_out(texture, tiles)
        return draft.channels["base_color"].values[draft.tree.arrays.level_cells[tiles.level + 1] :]

    each = [OpenTiles(change.tiles.level, code[None]) for code in change.tiles.codes]
    differing = [own.codes for own in each if not np.array_equal(below(before, own), below(after, own))]
    fewest = change_in(OpenTiles(change.tiles.level, np.concatenate(differing)), before, after)
    assert 0 < len(differing) < 8
    assert change_of(fewest, before, after) == change_between(before, after)
