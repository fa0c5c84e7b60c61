"""Sessions of painting: what pages send is painted once, in order, as calls of the library do."""

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import zlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.errors import ArgumentError, OutputError
from octex.session import painting as sessions
from octex.session.painting import BusyError, OrderError, Session
from tests.make.painted import ball, balls
from tests.make.same import assert_same

PAGE = "01234567-89ab-cdef"
SIZE = 48, 32
OCTETS = "application/octet-stream"


@cache
def canvas():
    surface = ball(12)
    return octex.convert(surface, depth=5), surface


@cache
def camera():
    return octex.Camera.fitted(ball(12).vertices, (0.3, 0.2, 1.0), size=SIZE)


def stroke(number, page=PAGE, **given):
    """A round stroke on the ball, as pages send it."""
    seen_by, coverage = camera(), disc(number)
    command = {
        "page": page,
        "number": number,
        "kind": "stroke",
        "name": f"Brush {number}",
        "camera": {
            "width": SIZE[0],
            "height": SIZE[1],
            "K": seen_by.K.tolist(),
            "pose": seen_by.world_to_camera.tolist(),
        },
        "box": [10, 4, 40, 28],
        "color": [200, 10 * (number % 20), 30],
        "opacity": 0.8,
        "maxAngle": 85,
    }
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    content = given.pop("content", None)
    if content is None:
        content = packer.compress(coverage.tobytes()) + packer.flush()
    return json.dumps({**command, **given}).encode() + b"\n" + content


def plain(kind, number, page=PAGE, **given):
    return json.dumps({"page": page, "number": number, "kind": kind, **given}).encode() + b"\n"


def disc(number):
    y, x = np.mgrid[:24, :30]
    away = np.hypot(x - 8 - 3 * (number % 4), y - 12)
    return np.clip(255 * (6.5 - away), 0, 255).astype(np.uint8)


def picture_sent(number, color=None):
    """The picture of a stroke, by default in its own colour."""
    image = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    image[..., :3] = (200, 10 * (number % 20), 30) if color is None else color
    image[4:28, 10:40, 3] = disc(number)
    return image


def painted(painter, number, blend="over"):
    """Paint the same as a user of the library does."""
    picture = octex.Projection(picture_sent(number), camera(), opacity=0.8, blend=blend)
    painter.paint(picture, max_angle=85)


def take(session, *bodies):
    """Send commands, and wait until they are done."""
    for body in bodies:
        session.take(body)
    session.wait()


def test_a_stroke_may_be_a_picture_of_many_colours(session):
    colors = np.random.default_rng(1).integers(0, 256, (24, 30, 3), np.uint8)
    image = np.zeros((*SIZE[::-1], 4), np.uint8)
    image[4:28, 10:40] = np.dstack([colors, disc(1)])
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    planes = np.dstack([colors, disc(1)]).transpose(2, 0, 1)
    content = packer.compress(planes.tobytes()) + packer.flush()
    line, _, _ = stroke(1, content=content).partition(b"\n")
    fields = {name: value for name, value in json.loads(line).items() if name != "color"}
    take(session, json.dumps(fields).encode() + b"\n" + content)
    painter = octex.Painter(*canvas())
    painter.paint(octex.Projection(image, camera(), opacity=0.8), max_angle=85)
    assert_same(session.shown.texture, painter.texture())
    with pytest.raises(ArgumentError, match="red, green, blue and coverage of 720 pixels"):
        session.take(json.dumps({**fields, "number": 2}).encode() + b"\n" + stroke(2).partition(b"\n")[2])


def ones(points):
    return np.ones(len(points))


def test_what_is_sent_again_is_painted_once(session):
    for body in (stroke(1), stroke(1), stroke(2), stroke(1)):
        session.take(body)
    session.wait()
    assert session.shown.status["steps"] == ["Brush 1", "Brush 2"]
    with pytest.raises(OrderError, match="number is 5; the next one is 3"):
        session.take(stroke(5))
    session.take(stroke(1, "ffffffff-0000"))  # another page
    session.wait()
    assert session.shown.status["done"] == 3


def test_steps_are_named_and_a_new_one_forgets_those_undone(session):
    for body in (stroke(1), stroke(2), plain("undo", 3)):
        session.take(body)
    session.wait()
    assert (session.shown.status["steps"], session.shown.status["done"]) == (["Brush 1", "Brush 2"], 1)
    take(session, stroke(4))
    assert session.shown.status["steps"] == ["Brush 1", "Brush 4"]


@pytest.mark.parametrize("name", ["out.octex", "out.octz"])
def test_saving_writes_output_alone_and_a_clean_end_leaves_no_journal(name, tmp_path):
    session = Session(*canvas(), tmp_path / name)
    take(session, stroke(1), plain("save", 2))
    assert session.shown.status["isSaved"]
    assert_same(octex.open(tmp_path / name), session.shown.texture)
    assert session.close() == ""
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_what_is_undone_needs_no_saving(tmp_path):
    session = Session(*canvas(), tmp_path / "out.octex")
    said = []
    for body in (stroke(1), plain("undo", 2), plain("redo", 3), plain("save", 4), plain("undo", 5)):
        take(session, body)
        said.append(session.shown.status["isSaved"])
    assert said == [False, True, False, True, False]
    take(session, plain("redo", 6))
    assert session.close() == ""
    assert [each.name for each in tmp_path.iterdir()] == ["out.octex"]


def test_a_save_that_fails_is_told_and_changes_nothing(session, tmp_path):
    session.take(stroke(1))
    (tmp_path / "out.octex").mkdir()
    take(session, plain("save", 2), stroke(3))
    assert session.shown.status["done"] == 2
    take(session, plain("save", 4))
    assert "out.octex" in session.shown.status["error"]
    assert not session.shown.status["isSaved"]


def test_after_a_crash_the_same_session_is_painted_again(tmp_path):
    texture, surface = canvas()
    output = tmp_path / "out.octex"
    code = (
        "import sys, os, signal; sys.path.insert(0, '.')\n"
        "from pathlib import Path\n"
        "from tests.viewer.test_session import *\n"
        "session = Session(*canvas(), Path(sys.argv[1]))\n"
        "for body in (stroke(1), stroke(2), plain('undo', 3), stroke(4)):\n"
        "    session.take(body)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    root = Path(octex.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code, str(output)], cwd=root, timeout=300)
    assert done.returncode == -signal.SIGKILL
    with pytest.raises(OutputError, match=r"out.octex.strokes has 4 commands .* --recover paints them again"):
        Session(texture, surface, output)
    with pytest.raises(OutputError, match="is of another texture or model"):
        Session(octex.convert(surface, depth=4), surface, output, recover=True)
    journal = output.with_name("out.octex.strokes")
    journal.write_bytes(journal.read_bytes() + b"\x20\0\0\0half a record")
    session = Session(texture, surface, output, recover=True)
    assert session.repeated == 4
    painter = octex.Painter(texture, surface)
    painted(painter, 1)
    painted(painter, 4)
    assert_same(session.shown.texture, painter.texture())
    assert session.shown.status["steps"] == ["Brush 1", "Brush 4"]
    assert not session.shown.status["isSaved"]
    session.take(stroke(4))  # its page has not heard that it came
    take(session, stroke(5))
    assert session.shown.status["done"] == 3
    assert "--recover" in session.close()
    again = Session(texture, surface, output, recover=True)
    assert again.shown.status["done"] == 3
    again.close()


#: Paints until it is killed, and says what it has taken.
_KILLED = """
import sys; sys.path.insert(0, '.')
from pathlib import Path
from tests.viewer.test_session import *
session = Session(*canvas(), Path(sys.argv[1]))
for number in range(1, 10**6):
    print(session.take(stroke(number)) if number % 4 else session.take(plain('undo', number)), flush=True)
    if number % 8 == 0:
        session.wait()
"""


@pytest.mark.parametrize("seed", range(int(os.environ.get("OCTEX_TEST_KILLS", "2"))))
def test_killed_at_any_moment_it_has_lost_nothing_that_was_taken(seed, tmp_path):
    random, output = np.random.default_rng(seed), tmp_path / "out.octex"
    words = [sys.executable, "-c", _KILLED, str(output)]
    root = Path(octex.__file__).parents[1]
    taken = 0
    with subprocess.Popen(words, cwd=root, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        killer = threading.Timer(60.0, process.kill)
        for line in process.stdout:
            if not taken:
                killer.cancel()
                killer = threading.Timer(random.uniform(0.0, 1.0), process.kill)
                killer.start()
            taken = int(line)
        killer.join()
    assert taken
    texture, surface = canvas()
    session = Session(texture, surface, output, recover=True)
    assert session.repeated in (taken, taken + 1)  # the last one may not have been said
    painter = octex.Painter(texture, surface)
    for number in range(1, session.repeated + 1):
        if number % 4:
            painted(painter, number)
        else:
            painter.undo()
    assert_same(session.shown.texture, painter.texture())
    session.close()


def test_a_texture_without_base_color_is_refused(tmp_path):
    surface = ball(12)
    rough = octex.convert(surface.with_sources({"roughness": 0.5}).with_channels(["roughness"]), depth=3)
    with pytest.raises(ArgumentError, match="base_color"):
        Session(rough, surface, tmp_path / "out.octex")
    assert not [*tmp_path.iterdir()]


def test_one_session_at_a_time_writes_an_output(session, tmp_path):
    if os.name != "posix":
        pytest.skip("files are locked on POSIX systems")
    with pytest.raises(OutputError, match="another octex view paints this file"):
        Session(*canvas(), tmp_path / "out.octex")
    assert session.take(stroke(1)) == 1


def test_a_stroke_that_no_disk_takes_is_refused_and_can_be_sent_again(session, monkeypatch):
    def full(_file):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left on device"):
            session.take(stroke(1))
    assert session.take(stroke(1)) == 1
    session.wait()
    assert session.shown.status["done"] == 1


def test_of_too_many_strokes_the_last_ones_are_to_be_sent_later(session, monkeypatch):
    monkeypatch.setattr(sessions, "_MOST_WAITING", 2)
    held = threading.Event()
    do = session._do
    monkeypatch.setattr(session, "_do", lambda command: (held.wait(20), do(command)))
    number = 0
    with pytest.raises(BusyError, match="too many strokes wait"):
        for number in range(1, 10):
            session.take(stroke(number))
    held.set()
    session.wait()
    assert session.take(stroke(number)) == number


def test_what_fails_or_hits_nothing_is_no_step(session, monkeypatch):
    take(session, stroke(1, content=deflated(bytes(30 * 24))))
    assert session.shown.status["steps"] == []
    with monkeypatch.context() as patched:
        patched.setattr(octex.Painter, "paint", lambda *_, **__: 1 / 0)
        take(session, stroke(2))
    assert "ZeroDivisionError" in session.shown.status["error"]
    take(session, stroke(3))
    assert (session.shown.status["error"], session.shown.status["done"]) == ("", 1)


def test_a_mirrored_stroke_of_which_half_fails_leaves_nothing(session, monkeypatch):
    paint, calls = octex.Painter.paint, iter(range(9))

    def fails(painter, *given, **options):
        return paint(painter, *given, **options) if next(calls) == 0 else 1 / 0

    take(session, stroke(1), stroke(2), plain("undo", 3))
    before = session.shown.texture
    with monkeypatch.context() as patched:
        patched.setattr(octex.Painter, "paint", fails)
        take(session, stroke(4, mirror="x"))
    assert_same(session.shown.texture, before)
    for number, kind in enumerate(("redo", "undo", "redo"), 5):
        session.take(plain(kind, number))
    session.wait()
    assert session.shown.status["steps"] == ["Brush 1"]
    assert_same(session.shown.texture, before)


def deflated(content):
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(content) + packer.flush()


NAN = float("nan")
BAD = [
    (b"", "the command's line must be a JSON object"),
    (b"\xff\xfe{}\n", "must be a JSON object"),
    (b"[" * 100_000, "must be a JSON object"),
    (b"[]\n", "must be a JSON object"),
    (plain("undo", 1, page="../../etc"), "page must be"),
    (plain("undo", 0), "number"),
    (plain("undo", 10**30), "number"),
    (json.dumps({"page": PAGE, "number": "1", "kind": "undo"}).encode(), "number"),
    (plain("erase all", 1), "kind must be one of"),
    (plain("undo", 1) + b"more", "has no content"),
    (plain("fill", 1, color=[1, 2]), "color"),
    (plain("fill", 1, color=[1, 2, 3], opacity=2), "opacity"),
    (stroke(1, name="x" * 50), "name must be"),
    (stroke(1, name="a\x1b[2J"), "name must be"),
    (stroke(1, color=[NAN, 0, 0]), "color"),
    (stroke(1, color=[-1, 0, 0]), "color"),
    (stroke(1, color="red"), "color"),
    (stroke(1, opacity=NAN), "opacity"),
    (stroke(1, maxAngle=NAN), "max_angle"),
    (stroke(1, backFaces="yes"), "back_faces"),
    (stroke(1, camera=None), "camera"),
    (stroke(1, camera={"width": 10**9, "height": 10**9}), "width"),
    (stroke(1, camera={"width": 48, "height": 32, "K": [[NAN] * 3] * 3, "pose": np.eye(4).tolist()}), "K"),
    (stroke(1, camera={"width": 48, "height": 32, "K": np.eye(3).tolist(), "pose": [[NAN] * 4] * 4}), "pose"),
    (stroke(1, box=[0, 0, 1e9, 1e9]), "box must be a part"),
    (stroke(1, box=[0, 0, 48.5, 32]), "box must be a part"),
    (stroke(1, box=[10, 4, 10, 28]), "box must be a part"),
    (stroke(1, box=[NAN, 4, 10, 28]), "box"),
    (stroke(1, content=b"not deflated"), "not deflated coverage of 720 pixels"),
    (stroke(1, content=deflated(bytes(719))), "not deflated coverage of 720 pixels"),
    (stroke(1, content=deflated(bytes(10**8))), "not deflated coverage of 720 pixels"),
    (stroke(1)[:-5], "not deflated coverage of 720 pixels"),
]


def test_what_is_no_command_is_refused(session):
    gc.collect()  # what earlier tests left open must not be closed, with a warning, deep in a recursion
    for body, why in BAD:
        with pytest.raises(ArgumentError, match=why):
            session.take(body)
    assert session.take(stroke(1)) == 1


def two_balls():
    surface = balls([3.0, 0.0, 0.0], 8, 8)
    return octex.convert(surface, depth=6), surface


def test_a_part_is_filled_and_the_one_that_a_mirror_shows(tmp_path):
    texture, surface = two_balls()
    session, painter = Session(texture, surface, tmp_path / "out.octex"), octex.Painter(texture, surface)
    color = decode(np.array([250, 0, 10], np.uint8), "srgb")
    given = {"color": [250, 0, 10], "at": [0.0, 1.0, 0.0]}
    session.take(plain("fill", 1, **given))
    painter.fill(surface.parts == 0, color)
    session.wait()
    assert_same(session.shown.texture, painter.texture())
    take(session, plain("undo", 2), plain("fill", 3, **given, mirror="x"))
    painter.fill(surface.parts == 1, color)
    step = session.shown.texture
    assert_same(step, painter.texture())
    assert session.shown.status["done"] == 1
    take(session, plain("undo", 4))
    assert_same(session.shown.texture, texture)
    take(session, plain("redo", 5))
    assert_same(session.shown.texture, step)
    session.close()


def assert_mirrored(session, axis, count, least, most_apart, beyond):
    """Check that paint on the ball is its own mirror image, and on both sides."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    image = points.copy()
    image[:, axis] *= -1

    def is_painted(points):
        apart = session.shown.texture.sample(points) - canvas()[0].sample(points)
        return np.abs(apart).max(axis=1) > 0.1

    here, there = is_painted(points), is_painted(image)
    assert least < here.sum() < 2000
    assert (here != there).sum() < most_apart * here.sum()  # cells are not where a mirror has them
    assert here[points[:, axis] > beyond].any()
    assert here[points[:, axis] < -beyond].any()


def test_mirrored_strokes_are_one_step_and_land_where_a_mirror_has_them(session):
    texture, _ = canvas()
    take(session, stroke(1, mirror="x", name="Brush"))
    assert session.shown.status["steps"] == ["Brush"]
    assert_mirrored(session, 0, 4000, 50, 0.15, 0.3)
    take(session, plain("undo", 2))
    assert_same(session.shown.texture, texture)
    with pytest.raises(ArgumentError, match="mirror must be x, y, z"):
        session.take(stroke(3, mirror="w"))
