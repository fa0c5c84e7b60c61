"""Painting where things fail: a full disk, files changed meanwhile, a lost GPU, a flood of requests."""

import json
import os
import re
import socket
import subprocess
import sys
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError, OutputError
from octex.session.painting import Session
from octex.viewer import Viewer, answers, server
from tests.make.browser import UNLIKE, lose_gpu, opened, restore_gpu
from tests.make.browser import served as serving
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.strokes import canvas, deflated, painted, plain, stroke, take
from tests.make.studio import imaged, middle


def touched(path):
    """Have another program write a file; return its bytes."""
    octex.convert(canvas()[1], depth=3).save(path)
    return path.read_bytes()


@pytest.mark.parametrize("there", [False, True])
def test_a_file_that_another_program_has_written_is_replaced_only_when_asked_and_kept(there, tmp_path):
    output = tmp_path / "out.octex"
    if there:
        canvas()[0].save(output)
    session = Session(*canvas(), output)
    if there:  # --force was said
        take(session, stroke(1), plain("save", 2))
        assert session.shown.status["isSaved"]
    first = 3 if there else 1
    session.take(stroke(first))
    other = touched(output)
    (tmp_path / "out.other.octex").mkdir()  # the name is taken
    take(session, plain("save", first + 1))
    asked = "Another program has changed out.octex. Which version do you want to keep?"
    assert session.shown.status["questions"]["output"] == asked
    assert not session.shown.status["isSaved"]
    assert output.read_bytes() == other
    take(session, stroke(first + 2))
    assert session.shown.status["questions"]["output"]  # it stays asked
    take(session, plain("save", first + 3, replace=True))
    assert session.shown.status["questions"]["output"] == ""
    assert session.shown.status["told"] == "The other version is kept as out.other-2.octex."
    assert (tmp_path / "out.other-2.octex").read_bytes() == other
    assert session.shown.status["isSaved"]
    assert_same(octex.open(output), session.shown.texture)
    take(session, stroke(first + 4), plain("save", first + 5))  # now it is this session's again
    assert session.shown.status["isSaved"]
    output.unlink()
    take(session, plain("save", first + 6))  # a file that was removed is written again
    assert session.shown.status["questions"]["output"] == ""
    assert_same(octex.open(output), session.shown.texture)
    assert session.close() == ""


def test_layers_that_another_program_has_written_are_kept_too(tmp_path):
    output, layers = tmp_path / "out.octex", tmp_path / "out.layers.octex"
    session = Session(*canvas(), output)
    other = touched(layers)
    take(session, plain("save", 1))  # without layers that file stays
    assert session.shown.status["isSaved"]
    take(session, plain("layer", 2, action="add"), stroke(3, layer=1), plain("save", 4))
    assert "changed out.layers.octex." in session.shown.status["questions"]["output"]
    take(session, plain("save", 5, replace=True))
    assert (tmp_path / "out.layers.other.octex").read_bytes() == other
    assert session.shown.status["isSaved"]
    assert session.close() == ""


def test_a_save_that_fails_leaves_the_version_of_the_other_program(session, tmp_path, monkeypatch):
    session.take(stroke(1))
    other = touched(tmp_path / "out.octex")

    def full(*_):
        raise OutputError("no room")

    with monkeypatch.context() as patched:
        patched.setattr(octex.OctreeTexture, "save", full)
        take(session, plain("save", 2, replace=True))
    assert session.shown.status["error"] == "no room"
    assert (tmp_path / "out.octex").read_bytes() == other


@pytest.mark.parametrize("file", ["output", "opened"])
def test_the_version_of_another_program_is_taken_as_a_step(file, tmp_path):
    paths = {"output": tmp_path / "out.octex", "opened": tmp_path / "ball.octex"}
    canvas()[0].save(paths["opened"])
    session = Session(*canvas(), paths["output"], opened=paths["opened"])
    take(session, plain("layer", 1, action="add"), stroke(2, layer=1))
    mine = session.shown.texture
    touched(paths[file])
    other = octex.open(paths[file])
    take(session, plain("take", 3, file=file, name="Take"))
    assert session.shown.status["error"] == ""
    assert session.shown.status["steps"][2:] == ["Take"]
    assert session.shown.status["layers"] == []
    assert_same(session.shown.texture, other)
    take(session, stroke(4), plain("undo", 5), plain("undo", 6), plain("save", 7))
    assert_same(session.shown.texture, mine)
    assert len(session.shown.status["layers"]) == 1
    assert bool(session.shown.status["questions"]["output"]) == (file == "output")  # it would be lost
    take(session, plain("redo", 8), plain("save", 9), stroke(10))
    assert session.shown.status["questions"] == {"output": "", "opened": ""}
    expected = octex.Painter(other, canvas()[1])
    painted(expected, 10)
    assert_same(session.shown.texture, expected.texture())
    points = canvas()[1].scatter(2000).rest
    is_red = np.abs(session.shown.texture.sample(points) - other.sample(points)).max(axis=1) > 0.3
    take(session, stroke(11, erases=True, opacity=1.0, content=deflated(b"\xff" * 720)))  # down to it
    apart = session.shown.texture.sample(points[is_red]) - other.sample(points[is_red])
    assert is_red.sum() > 20
    assert np.abs(apart).max() < 0.1
    paths[file].unlink()  # a crash needs it no more
    session.close()
    again = Session(*canvas(), paths["output"], recover=True)
    assert_same(again.shown.texture, session.shown.texture)
    again.close()


def test_a_version_that_cannot_be_taken_changes_nothing(session, tmp_path):
    output = tmp_path / "out.octex"
    take(session, stroke(1))
    before = session.shown.texture
    for file, why in (("output", r"out.octex: No such file"), ("opened", "was opened without a texture")):
        with pytest.raises(ArgumentError, match=why):
            session.take(plain("take", 2, file=file))
    octex.convert(ball(12, 0.5), depth=3).save(output)
    take(session, plain("take", 2, file="output"))
    assert "out.octex cannot be taken: " in session.shown.status["error"]
    assert "the texture belongs to another model" in session.shown.status["error"]
    output.write_bytes(b"nothing")
    take(session, plain("take", 3, file="output"))
    assert "out.octex cannot be taken: out.octex: " in session.shown.status["error"]
    assert session.shown.texture is before
    assert session.shown.status["done"] == 1


def test_pages_ask_when_the_texture_which_was_opened_has_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "_BEAT", 0.05)
    path, (texture, surface) = tmp_path / "ball.octex", canvas()
    texture.save(path)
    session = Session(texture, surface, tmp_path / "out.octex", opened=path)
    viewer = Viewer(lambda: octex.open(path), path, surface, session=session)

    def asked():
        viewer.version()
        session.wait()
        return session.shown.status["questions"]["opened"]

    assert asked() == ""
    with serving(viewer):
        connection = HTTPConnection("127.0.0.1", viewer.port, timeout=20)
        connection.request("GET", f"/{viewer.token}/events")
        line = connection.getresponse()
        touched(path)
        seen = b""
        while not re.search(rb"version\ndata: [1-9]", seen):  # the question may count more than once
            seen += line.readline()
            assert len(seen) < 100_000
        line.close()
        connection.close()
    assert asked() == "Another program has changed ball.octex. Which version do you want to paint on?"
    take(session, plain("keep", 1))
    assert asked() == ""
    touched(path)
    assert asked()
    take(session, plain("take", 2, file="opened"))
    assert asked() == ""
    assert_same(session.shown.texture, octex.open(path))
    session.close()


#: Paints and saves with files of at most so many bytes, and says what it hears.
_FULL = """
import json, resource, sys
from pathlib import Path
from octex.errors import OutputError
from tests.make.strokes import *
most, session = int(sys.argv[2]), Session(*canvas(), Path(sys.argv[1]))
take(session, stroke(1))
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
said = []
def tried(body):
    try:
        take(session, body)
        said.append(session.shown.status['error'])
    except OutputError as error:
        said.append(str(error))
tried(plain('save', 2))
for _ in range(2):
    tried(stroke(3, name='x' * 40, filler='y' * 60_000))
resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
number = 3 if 'File too large' in said[1] else 4
tried(stroke(number))
tried(plain('save', number + 1))
told = session.shown.status
print(json.dumps([said, told['done'], told['isSaved'], session.close()]))
"""


@pytest.mark.skipif(os.name != "posix", reason="POSIX systems limit files")
def test_a_full_disk_loses_nothing_and_painting_goes_on_once_there_is_room(tmp_path):
    output = tmp_path / "out.octex"
    words = [sys.executable, "-c", _FULL, str(output), "20000"]
    root = Path(octex.__file__).parents[1]
    done = subprocess.run(words, cwd=root, timeout=300, capture_output=True, text=True, check=True)
    said, steps, is_saved, left = json.loads(done.stdout)
    assert said[0] == f"{output}: cannot be written: File too large; make room or choose another place"
    assert said[1] == said[2] == f"{output}.strokes: File too large"  # refused, to be sent again
    assert said[3:] == ["", ""]
    assert (steps, is_saved, left) == (2, True, "")
    assert [each.name for each in tmp_path.iterdir()] == ["out.octex"]


def test_the_page_asks_which_version_to_keep_and_keeps_it(browser, tmp_path):
    texture, surface = canvas()
    output = tmp_path / "out.octex"
    session = Session(texture, surface, output)
    viewer = Viewer(lambda: texture, tmp_path / "ball.octex", surface, session=session)
    with serving(viewer):
        page = opened(browser, viewer.url, (800, 400), is_drawn=False)
        page.wait_for_function("viewer.painting")
        session.take(stroke(1))
        other = touched(output)
        page.keyboard.press("Control+s")
        page.wait_for_selector("#question:visible")
        with page.expect_download() as waited:
            page.click("#copy")
        waited.value.save_as(tmp_path / "copy.octex")
        mine = session.shown.texture
        assert_same(octex.open(tmp_path / "copy.octex"), mine)
        assert output.read_bytes() == other
        page.click("#take-output")  # the other one is coarser, so the page loads all again
        done = "(n) => globalThis.viewer?.painting?.status.done === n"
        page.wait_for_function(done, arg=2)
        assert page.locator("#question").is_hidden()
        assert_same(session.shown.texture, octex.open(output))
        assert page.evaluate(UNLIKE) == []
        page.keyboard.press("Control+z")
        page.wait_for_function(done, arg=1)
        touched(output)
        page.keyboard.press("Control+s")
        page.click("#replace")
        page.wait_for_function("globalThis.viewer?.painting?.status.isSaved")
        assert page.locator("#question").is_hidden()
        assert page.locator("#paint-note").inner_text() == "The other version is kept as out.other.octex."
        assert (tmp_path / "out.other.octex").read_bytes() == other
        assert_same(octex.open(output), mine)
        assert not [line for line in page.complaints if "410 (Gone)" not in line]
        page.close()
    session.close()


def test_a_gpu_that_is_lost_in_a_stroke_costs_that_stroke_alone(studio, page):
    def finish(page):
        page.mouse.move(left + 40, top, steps=3)
        page.mouse.up()

    studio.drag(page, (-30, -20), (0, -20))
    studio.is_done(page)
    before = imaged(page)
    left, top = middle(page)
    for first, then in ((finish, restore_gpu), (restore_gpu, finish)):
        page.mouse.move(left, top)
        page.mouse.down()
        page.mouse.move(left + 20, top)
        lose_gpu(page)
        first(page)
        then(page)
        assert page.evaluate("[viewer.painting.pen, viewer.painting.strokes.current]") == [None, None]
        assert page.evaluate("viewer.painting.commands.waiting.length") == 0
        assert (imaged(page) == before).all()
    studio.drag(page, (0, 20), (30, 20))
    studio.is_done(page)
    assert studio.session.shown.status["done"] == 2
    assert np.abs(imaged(page) - before).max() > 60


def test_strokes_are_painted_while_many_lines_wait_and_many_are_refused(served, monkeypatch):
    monkeypatch.setattr(answers.Handler, "timeout", 3.0)
    address = "127.0.0.1", served.viewer.port
    refused = f"GET /{'a' * 22}/ HTTP/1.1\r\nHost: 127.0.0.1:{served.viewer.port}\r\n\r\n".encode()
    with ExitStack() as held:
        lines = (socket.create_connection(address, timeout=20) for _ in range(200))
        idle = [held.enter_context(each) for each in lines]
        for each in idle[::2]:
            each.sendall(refused)
        for number in range(1, 6):
            assert served.post(stroke(number))[0] == 200
        served.session.wait()
        assert served.session.shown.status["done"] == 5
        for n, each in enumerate(idle):  # each is answered, or given up
            assert each.recv(4096).startswith(b"HTTP/1.1 403" if n % 2 == 0 else b"")
    assert len(served.lines) == 1
