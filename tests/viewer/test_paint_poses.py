"""Painting frames of animations and surfaces laid flat, as the library paints what is posed or unwrapped."""

import json
import zlib
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pytest

import octex
from octex.errors import ModelError
from octex.session.commands import Moment, command_of, stroke_of
from octex.session.painting import Session, mirrored
from octex.source.motion import Animation, Links, Motion
from tests.make.browser import lose_gpu, restore_gpu
from tests.make.painted import ball, balls
from tests.make.same import assert_same
from tests.make.strokes import SIZE, assert_mirrored, camera_sent, canvas, plain, stroke, take
from tests.make.studio import Studio, imaged
from tests.viewer.test_session_refusals import SPOT

FRAMES = 9


def bending(surface):
    """The upper half of a surface bends to the side and back; a second animation stretches it."""
    vertices = surface.vertices
    upper = np.clip(0.5 + vertices[:, 1], 0.0, 1.0)
    shares = np.column_stack([1 - upper, upper])
    count = len(vertices)
    bones = Links(np.arange(0, 2 * count + 1, 2), np.tile([0, 1], count), shares.ravel())
    targets = Links(np.zeros(count + 1, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    angles = np.sin(np.linspace(0, np.pi, FRAMES))
    moves = np.tile(np.eye(4)[:3], (2, FRAMES, 2, 1, 1))
    for n, angle in enumerate(angles):
        moves[0, n, 1, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        moves[0, n, :, 0, 3] = 0.2 * angle
        moves[1, n, :, 1, 1] = 1 + 0.5 * angle
    none = np.zeros((FRAMES, 0))
    animations = [Animation("bend", 2.0, moves[0], none), Animation("stretch", 1.0, moves[1], none)]
    return Motion(vertices.copy(), bones, targets, np.zeros((0, 3)), animations, [])


@pytest.fixture(scope="module")
def bent(browser, tmp_path_factory):
    """A ball that bends, and a page that paints it."""
    with Studio(browser, tmp_path_factory.mktemp("bent"), motion=bending(ball(32))).shared() as found:
        yield found


@pytest.mark.parametrize("mirror", ["", "x"])
def test_strokes_on_frames_are_bit_for_bit_what_the_library_paints_on_the_posed_surface(mirror, tmp_path):
    texture, surface = canvas()
    motion, expected = bending(surface), texture
    session = Session(texture, surface, tmp_path / "out.octex", motion=motion)
    moments = [(0, 0.61), (0, 0.61), (1, 0.5), None, (0, 99.0)]
    for number, moment in enumerate(moments, 1):
        body = stroke(number, moved=moment and Moment(*moment)._asdict(), mirror=mirror)
        take(session, body)
        posed = surface.with_pose(motion.positions_at(*moment)) if moment else surface
        image, options, _ = stroke_of(command_of(body))
        expected = octex.paint(expected, posed, image, **options)
        if mirror:
            used = posed.vertices[np.unique(posed.triangles)]
            middle = float((used[:, 0].min() + used[:, 0].max()) / 2)
            expected = octex.paint(expected, posed, mirrored(image, 0, middle), **options)
        assert session.shown.status["error"] == ""
        assert_same(session.shown.texture, expected)
    take(session, plain("undo", 6), plain("redo", 7))
    assert_same(session.shown.texture, expected)
    assert "--recover" in session.close()
    again = Session(texture, surface, tmp_path / "out.octex", motion=motion, recover=True)
    assert_same(again.shown.texture, expected)
    again.close()


def test_a_frame_of_an_animation_that_is_not_there_is_told(tmp_path):
    texture, surface = canvas()
    for number, motion in ((2, bending(surface)), (0, None)):
        session = Session(texture, surface, tmp_path / f"{number}.octex", motion=motion)
        take(session, stroke(1, moved={"animation": number, "time": 0.0}))
        told = f"there is no animation {number}; {surface.name} has {number}"
        assert session.shown.status["error"] == told
        session.close()


def test_a_stroke_on_a_frame_is_seen_at_once_as_it_is_painted_and_bends_with_the_model(bent):
    with bent.restored() as page:
        page.evaluate("viewer.player.choose(0), viewer.player.seek(0.9)")
        plain_image = imaged(page)
        with bent.held(page):
            page.evaluate("viewer.player.play(true)")
            bent.drag(page, (-60, 0), (0, -40), (40, -60))
        moved = page.evaluate("viewer.painting.commands.waiting[0].moved")
        assert moved["animation"] == 0
        assert page.evaluate("viewer.player.steppedAt") is None  # the pen stops it
        page.evaluate("(time) => viewer.player.seek(time)", 0.9)
        assert (imaged(page) == plain_image).all()  # of another pose nothing is shown until it is painted
        page.evaluate("(time) => viewer.player.seek(time)", moved["time"])
        before, plain_image = imaged(page), imaged(page, strokes=None)
        is_painted = np.abs(before - plain_image).max(axis=2) > 60
        assert 0.01 < is_painted.mean() < 0.3
        bent.bake(page)
        inside = (before - imaged(page))[is_painted]
        assert np.sqrt((inside**2).mean()) <= 2
        assert bent.session.shown.status["error"] == ""
        page.evaluate("viewer.player.choose(-1)")
        bent.drag(page, (-30, 30), (30, 30))
        bent.is_done(page)


def flat_camera(radius=0.6):
    """A camera that sees a patch from the front, as pages send it."""
    low = np.array([-radius, -radius, 0.0])
    return camera_sent(octex.Camera.fitted(np.array([low, -low]), (0, 0, 1), size=SIZE))


def unwrapped(image, surface, spot):
    """An image that is painted through a patch of a surface."""
    patch = octex.unwrap(surface, spot["center"], spot["radius"], up=spot["up"])
    return replace(image, camera=replace(patch, camera=image.camera))


def test_strokes_on_a_patch_are_bit_for_bit_what_the_library_paints_through_it(tmp_path):
    texture, surface = canvas()
    motion, expected = bending(surface), texture
    session = Session(texture, surface, tmp_path / "out.octex", motion=motion)
    far, moved = {**SPOT, "center": [-0.4, 0.2, 0.9]}, {"animation": 0, "time": 1.0}
    given = [{"patch": SPOT}, {"patch": SPOT}, {"patch": far, "moved": moved}, {}]
    given.append({"patch": SPOT, "mirror": "x"})
    for number, fields in enumerate(given, 1):
        seen_by = {"camera": flat_camera()} if "patch" in fields else {}
        body = stroke(number, **fields, **seen_by)
        take(session, body)
        image, options, _ = stroke_of(command_of(body))
        posed = surface if "moved" not in fields else surface.with_pose(motion.positions_at(0, 1.0))
        shown = [unwrapped(image, posed, fields["patch"]) if "patch" in fields else image]
        if "mirror" in fields:
            middle = (surface.vertices[:, 0].min() + surface.vertices[:, 0].max()) / 2
            center = [2 * middle - SPOT["center"][0], *SPOT["center"][1:]]
            shown.append(unwrapped(mirrored(image, 0, 0.0), surface, {**SPOT, "center": center}))
        before = expected
        for each in shown:
            expected = octex.paint(expected, posed, each, **options)
        assert expected.tree.n_cells != before.tree.n_cells or number > 1
        assert session.shown.status["error"] == ""
        assert_same(session.shown.texture, expected)
    take(session, plain("undo", 6), plain("redo", 7))
    assert_same(session.shown.texture, expected)
    session.close()
    again = Session(texture, surface, tmp_path / "out.octex", motion=motion, recover=True)
    assert_same(again.shown.texture, expected)
    again.close()


@pytest.mark.parametrize("axis", range(3))
def test_the_mirror_of_a_patch_lands_where_a_mirror_has_it(axis, session):
    spot = {"center": [0.5, 0.5, 0.7], "radius": 0.5, "up": [0.1, 1.0, 0.0]}
    take(session, stroke(1, patch=spot, camera=flat_camera(0.5), mirror="xyz"[axis], opacity=1.0))
    assert session.shown.status["error"] == ""
    assert_mirrored(session, axis, 6000, 30, 0.2, 0.2)


def test_a_patch_beside_the_surface_is_said_and_paints_nothing(session):
    beside = {**SPOT, "center": [9.0, 0.0, 0.0]}
    with pytest.raises(ModelError, match="farther than the radius"):
        session.patch(json.dumps({"patch": beside}))
    take(session, stroke(1, patch=beside, camera=flat_camera()))
    assert "farther than the radius" in session.shown.status["error"]
    assert_same(session.shown.texture, canvas()[0])


def test_pages_are_sent_a_patch_as_a_mesh(served):
    status, body = served.ask(f"patch?{quote(json.dumps({'patch': SPOT, 'moved': None}))}")
    line, _, stream = body.partition(b"\n")
    assert status == 200
    told = json.loads(line)
    patch = octex.unwrap(canvas()[1], SPOT["center"], SPOT["radius"], up=SPOT["up"])
    assert told["mesh"]["triangles"] == len(patch.triangles)
    assert told["mesh"]["posed"]
    assert told["faults"] == patch.faults == []
    mesh = told["mesh"]
    size = 4 * (8 * mesh["vertices"] + mesh["corners"]) + mesh["edges"]
    assert len(zlib.decompress(stream, -15)) == size
    assert served.ask("patch?nothing") == (400, b"a request for a patch must be a JSON object\n")


def test_what_is_painted_flat_is_seen_at_once_as_it_is_painted_and_then_on_the_model(bent):
    with bent.restored() as page:
        page.evaluate("viewer.player.choose(0), viewer.player.seek(0.9)")
        model, camera = imaged(page), page.evaluate("JSON.stringify(viewer.camera.state)")
        page.keyboard.press("v")
        bent.drag(page, (300, 150))  # beside the model
        bent.drag(page, (20, 20))
        page.wait_for_selector("#flat:visible")
        assert page.evaluate("viewer.painting.tool.name") == "brush"
        assert page.locator("#other-view").is_visible()  # of the model
        radius = page.evaluate("viewer.display.patch.spot.radius")
        for _ in range(2):  # at once
            page.click("#flat-wider")
        page.wait_for_function("(most) => viewer.display.patch.spot.radius > most", arg=1.9 * radius)
        for _ in range(2):
            page.click("#flat-narrower")
        page.wait_for_function("(most) => viewer.display.patch.spot.radius < most", arg=1.1 * radius)
        page.evaluate("viewer.camera.orbit(0.2, 0.1)")
        assert page.evaluate("[viewer.camera.turn, viewer.camera.tilt]") == [0, 0]  # it is moved
        page.evaluate("viewer.camera.reset(1, 1)")
        before = imaged(page)
        with bent.held(page):
            bent.drag(page, (-60, 0), (0, -50), (60, 20))
        sent = page.evaluate("viewer.painting.commands.waiting[0]")
        assert sent["moved"] == {"animation": 0, "time": 0.9}
        assert 0.1 < sent["patch"]["radius"] < 1
        drawn_flat = imaged(page)
        is_painted = np.abs(drawn_flat - before).max(axis=2) > 60
        assert 0.02 < is_painted.mean() < 0.3
        box = page.locator("#other-view").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert page.evaluate("[viewer.display.patch, viewer.camera.isFlat]") == [None, False]
        page.keyboard.press("Escape")
        assert page.evaluate("JSON.stringify(viewer.camera.state)") == camera
        page.wait_for_function("viewer.isDrawn")
        assert (imaged(page) == model).all()  # of another view nothing is shown until it is painted
        bent.bake(page)
        assert bent.session.shown.status["error"] == ""
        assert (np.abs(imaged(page) - model).max(axis=2) > 60).mean() > 0.005
        spot = [sent["patch"], sent["moved"]]
        page.evaluate("([spot, moved]) => viewer.painting.flat.show(spot, moved)", spot)
        page.evaluate("viewer.camera.reset()")
        inside = (drawn_flat - imaged(page))[is_painted]
        assert np.sqrt((inside**2).mean()) <= 2
        lose_gpu(page)
        restore_gpu(page)
        page.keyboard.press("v")  # back to the model, which moves again
        assert page.locator("#flat").is_hidden()
        assert (np.abs(imaged(page) - model).max(axis=2) > 60).mean() > 0.005
        assert page.evaluate("viewer.display.moment") == sent["moved"]


def test_parts_that_were_moved_apart_are_painted_posed_and_flat(tmp_path):
    whole = balls([1.5, 0.0, 0.0], 8, 8)
    texture = octex.convert(octex.separate(whole, depth=5).surface, depth=5)
    motion, expected = bending(whole), texture
    session = Session(texture, whole, tmp_path / "out.octex", motion=motion)
    posed = whole.with_pose(motion.positions_at(1, 0.5))
    assert session.patch(json.dumps({"patch": SPOT})).triangles.size > 0
    flat = {"patch": SPOT, "camera": flat_camera()}
    for number, fields in enumerate([{"moved": {"animation": 1, "time": 0.5}}, flat, {}], 1):
        body = stroke(number, **fields)
        take(session, body)
        image, options, _ = stroke_of(command_of(body))
        if "patch" in fields:
            image = unwrapped(image, whole, SPOT)
        expected = octex.paint(expected, posed if "moved" in fields else whole, image, **options)
        assert session.shown.status["error"] == ""
        assert session.shown.status["done"] == number
        assert_same(session.shown.texture, expected)
    session.close()
