"""Painting frames of animations: as the library paints the posed surface, at rest on the model."""

import numpy as np
import pytest

import octex
from octex.session.commands import Moment, command_of, stroke_of
from octex.session.painting import Session, mirrored
from octex.source.motion import Animation, Links, Motion
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.strokes import canvas, plain, stroke, take
from tests.make.studio import Studio, imaged

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


def test_a_stroke_on_a_frame_is_seen_at_once_as_it_is_painted_and_bends_with_the_model(browser, tmp_path):
    studio = Studio(browser, tmp_path, motion=bending(ball(32)))
    with studio.opened() as page:
        page.evaluate("viewer.player.choose(0), viewer.player.seek(0.9)")
        plain_image = imaged(page)
        with studio.held(page):
            page.evaluate("viewer.player.play(true)")
            studio.drag(page, (-60, 0), (0, -40), (40, -60))
        moved = page.evaluate("viewer.painting.commands.waiting[0].moved")
        assert moved["animation"] == 0
        assert page.evaluate("viewer.player.steppedAt") is None  # the pen stops it
        page.evaluate("(time) => viewer.player.seek(time)", 0.9)
        assert (imaged(page) == plain_image).all()  # of another pose nothing is shown until it is painted
        page.evaluate("(time) => viewer.player.seek(time)", moved["time"])
        before, plain_image = imaged(page), imaged(page, strokes=None)
        is_painted = np.abs(before - plain_image).max(axis=2) > 60
        assert 0.01 < is_painted.mean() < 0.3
        studio.bake(page, 1)
        inside = (before - imaged(page))[is_painted]
        assert np.sqrt((inside**2).mean()) <= 2
        assert studio.session.shown.status["error"] == ""
        page.evaluate("viewer.player.choose(-1)")
        studio.drag(page, (-30, 30), (30, 30))
        studio.is_done(page, 2)
