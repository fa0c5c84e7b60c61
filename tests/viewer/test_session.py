"""Sessions of painting: what pages send is painted once, in order, as calls of the library do."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.errors import ArgumentError, OutputError
from octex.painting import region
from octex.session import painting as sessions
from octex.session.painting import BusyError, OrderError, Session
from tests.make.painted import ball, balls
from tests.make.same import assert_same
from tests.make.strokes import (
    SIZE,
    assert_mirrored,
    camera,
    camera_sent,
    canvas,
    deflated,
    disc,
    painted,
    plain,
    stroke,
    take,
    without_color,
)


def test_a_stroke_may_be_an_image_of_many_colours(session):
    colors = np.random.default_rng(1).integers(0, 256, (24, 30, 3), np.uint8)
    image = np.zeros((*SIZE[::-1], 4), np.uint8)
    image[4:28, 10:40] = np.dstack([colors, disc(1)])
    planes = np.dstack([colors, disc(1)]).transpose(2, 0, 1)
    take(session, without_color(stroke(1, content=deflated(planes.tobytes()))))
    painter = octex.Painter(*canvas())
    painter.paint(octex.Projection(image, camera(), opacity=0.8), max_angle=85)
    assert_same(session.shown.texture, painter.texture())
    with pytest.raises(ArgumentError, match="red, green, blue and coverage of 720 pixels"):
        session.take(without_color(stroke(2)))


def test_what_is_sent_again_is_painted_once(session):
    take(session, stroke(1), stroke(1), stroke(2), stroke(1))
    assert session.shown.status["steps"] == ["Brush 1", "Brush 2"]
    with pytest.raises(OrderError, match="number is 5; the next one is 3"):
        session.take(stroke(5))
    take(session, stroke(1, "ffffffff-0000"))  # another page
    assert session.shown.status["done"] == 3


def test_steps_are_named_and_a_new_one_forgets_those_undone(session):
    take(session, stroke(1), stroke(2), plain("undo", 3))
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
    session, said = Session(*canvas(), tmp_path / "out.octex"), []
    for body in (stroke(1), *(plain(kind, n) for n, kind in enumerate(("undo", "redo", "save", "undo"), 2))):
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


#: Paints as many commands as it is told, and is killed: at once, or by others.
_KILLED = """
import os, signal, sys
from pathlib import Path
from octex.session.painting import Session
from tests.make.strokes import *
session = Session(*canvas(), Path(sys.argv[1]))
for number in range(1, int(sys.argv[2])):
    print(session.take(plain("undo", number) if number % 4 == 3 else stroke(number)), flush=True)
    if number % 8 == 0:
        session.wait()
os.kill(os.getpid(), signal.SIGKILL)
"""
_ROOT = Path(octex.__file__).parents[1]


def painted_by_library(count):
    """Return what the first commands of a killed session paint."""
    painter = octex.Painter(*canvas())
    for number in range(1, count + 1):
        painter.undo() if number % 4 == 3 else painted(painter, number)
    return painter.texture()


def test_after_a_crash_the_same_session_is_painted_again(tmp_path):
    texture, surface = canvas()
    output = tmp_path / "out.octex"
    done = subprocess.run([sys.executable, "-c", _KILLED, str(output), "5"], cwd=_ROOT, timeout=300)
    assert done.returncode == -signal.SIGKILL
    with pytest.raises(OutputError, match=r"out.octex.strokes has 4 commands .* --recover paints them again"):
        Session(texture, surface, output)
    with pytest.raises(OutputError, match="is of another texture or model"):
        Session(octex.convert(surface, depth=4), surface, output, recover=True)
    journal = output.with_name("out.octex.strokes")
    journal.write_bytes(journal.read_bytes() + b"\x20\0\0\0half a record")
    session = Session(texture, surface, output, recover=True)
    assert session.repeated == 4
    assert_same(session.shown.texture, painted_by_library(4))
    assert session.shown.status["steps"] == ["Brush 1", "Brush 4"]
    assert not session.shown.status["isSaved"]
    take(session, stroke(4), stroke(5))  # the page of the first has not heard that it came
    assert session.shown.status["done"] == 3
    assert "--recover" in session.close()
    again = Session(texture, surface, output, recover=True)
    assert again.shown.status["done"] == 3
    again.close()


@pytest.mark.parametrize("seed", range(int(os.environ.get("OCTEX_TEST_KILLS", "2"))))
def test_killed_at_any_moment_it_has_lost_nothing_that_was_taken(seed, tmp_path):
    random, output = np.random.default_rng(seed), tmp_path / "out.octex"
    words = [sys.executable, "-c", _KILLED, str(output), "1000000"]
    taken = 0
    with subprocess.Popen(words, cwd=_ROOT, stdout=subprocess.PIPE, text=True) as process:
        killer = threading.Timer(60.0, process.kill)
        for line in process.stdout:
            if not taken:
                killer.cancel()
                killer = threading.Timer(random.uniform(0.0, 1.0), process.kill)
                killer.start()
            taken = int(line)
        killer.join()
    assert taken
    session = Session(*canvas(), output, recover=True)
    assert session.repeated in (taken, taken + 1)  # the last one may not have been said
    assert_same(session.shown.texture, painted_by_library(session.repeated))
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
    take(session, stroke(1))
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
    fails = lambda *given, **named: paint(*given, **named) if next(calls) == 0 else 1 / 0  # noqa: E731
    take(session, stroke(1), stroke(2), plain("undo", 3))
    before = session.shown.texture
    with monkeypatch.context() as patched:
        patched.setattr(octex.Painter, "paint", fails)
        take(session, stroke(4, mirror="x"))
    assert_same(session.shown.texture, before)
    take(session, plain("redo", 5), plain("undo", 6), plain("redo", 7))
    assert session.shown.status["steps"] == ["Brush 1"]
    assert_same(session.shown.texture, before)


def test_a_part_is_filled_and_the_one_that_a_mirror_shows(tmp_path):
    surface = balls([3.0, 0.0, 0.0], 8, 8)
    texture = octex.convert(surface, depth=6)
    session, painter = Session(texture, surface, tmp_path / "out.octex"), octex.Painter(texture, surface)
    color = decode(np.array([250, 0, 10], np.uint8), "srgb")
    given = {"color": [250, 0, 10], "at": [0.0, 1.0, 0.0]}
    take(session, plain("fill", 1, **given))
    painter.fill(surface.parts == 0, color)
    assert_same(session.shown.texture, painter.texture())
    take(session, plain("undo", 2), plain("fill", 3, **given, mirror="x"))
    painter.fill(surface.parts == 1, color)
    step = session.shown.texture
    assert_same(step, painter.texture())
    assert session.shown.status["done"] == 1
    for number, (kind, expected) in enumerate((("undo", texture), ("redo", step)), 4):
        take(session, plain(kind, number))
        assert_same(session.shown.texture, expected)
    session.close()


def test_a_fill_after_a_stroke_from_close_up_is_as_deep_as_most_of_the_texture(session, monkeypatch):
    monkeypatch.setattr(region, "_FEW", 1 << 12)
    near = octex.Camera.fitted([[0.0, 0.1, 1.0], [0.2, 0.3, 1.0]], (0.0, 0.0, 1.0), size=SIZE)
    take(session, stroke(1, camera=camera_sent(near)))
    before = session.shown.texture
    assert before.tree.max_depth >= canvas()[0].tree.max_depth + 3
    take(session, plain("fill", 2, color=[250, 0, 10]))
    filled = session.shown.texture
    assert filled.tree.n_leaves <= before.tree.n_leaves
    points = canvas()[1].scatter(2000).rest
    color = decode(np.array([250, 0, 10], np.uint8), "srgb")
    np.testing.assert_allclose(filled.sample(points), np.tile(color, (2000, 1)), atol=1 / 255)


def test_mirrored_strokes_are_one_step_and_land_where_a_mirror_has_them(session):
    take(session, stroke(1, mirror="x", name="Brush"))
    assert session.shown.status["steps"] == ["Brush"]
    assert_mirrored(session, 0, 4000, 50, 0.15, 0.3)
    take(session, plain("undo", 2))
    assert_same(session.shown.texture, canvas()[0])
