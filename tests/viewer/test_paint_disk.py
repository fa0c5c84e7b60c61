"""Painting sessions where disks and files are not as they were: full, changed meanwhile, or gone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

import octex
from octex.errors import ArgumentError
from octex.viewer import Viewer, server
from octex.viewer.session import Session
from tests.conftest import needs_jit
from tests.make.browser import opened
from tests.make.browser import served as serving
from tests.make.same import assert_same
from tests.viewer.test_session import canvas, plain, stroke


def touched(path: Path) -> bytes:
    """Have another program write a file; return its bytes."""
    octex.convert(canvas()[1], depth=3).save(path)
    return path.read_bytes()


@pytest.mark.parametrize("there", [False, True])
def test_a_file_that_another_program_has_written_is_replaced_only_when_asked(
    there: bool, tmp_path: Path
) -> None:
    output = tmp_path / "out.octex"
    if there:
        canvas()[0].save(output)
    session = Session(*canvas(), output)
    if there:
        session.take(stroke(1))
        session.take(plain("save", 2))  # --force was said
        session.wait()
        assert session.shown.told["isSaved"]
    first = 3 if there else 1
    session.take(stroke(first))
    other = touched(output)
    session.take(plain("save", first + 1))
    session.wait()
    assert session.shown.told["question"] == "Another program has changed out.octex."
    assert not session.shown.told["isSaved"]
    assert output.read_bytes() == other
    session.take(stroke(first + 2))
    session.wait()
    assert session.shown.told["question"]  # it stays asked
    session.take(plain("save", first + 3, replace=True))
    session.wait()
    assert session.shown.told["question"] == ""
    assert session.shown.told["isSaved"]
    assert_same(octex.open(output), session.shown.texture)
    session.take(stroke(first + 4))
    session.take(plain("save", first + 5))  # now it is this session's again
    session.wait()
    assert session.shown.told["isSaved"]
    with pytest.raises(ArgumentError, match="replace must be True or False"):
        session.take(plain("save", first + 6, replace="yes"))
    assert session.close() == ""


def test_a_file_that_was_removed_meanwhile_is_written_again(tmp_path: Path) -> None:
    session = Session(*canvas(), tmp_path / "out.octex")
    for body in (stroke(1), plain("save", 2)):
        session.take(body)
    session.wait()
    (tmp_path / "out.octex").unlink()
    session.take(plain("save", 3))
    session.wait()
    assert session.shown.told["question"] == ""
    assert_same(octex.open(tmp_path / "out.octex"), session.shown.texture)
    assert session.close() == ""


def test_pages_hear_that_the_texture_which_was_opened_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_BEAT", 0.05)
    path, (texture, surface) = tmp_path / "ball.octex", canvas()
    texture.save(path)
    session = Session(texture, surface, tmp_path / "out.octex")
    viewer = Viewer(lambda: octex.open(path), path, surface, session=session)
    before = viewer.version()
    assert before[1] == ""
    with serving(viewer):
        connection = HTTPConnection("127.0.0.1", viewer.port, timeout=20)
        connection.request("GET", f"/{viewer.token}/events")
        line = connection.getresponse()
        touched(path)
        seen = b""
        while b"event: changing" not in seen:
            seen += line.readline()
        assert line.readline() == b"data: ball.octex has changed: you paint on what was opened\n"
        session.take(stroke(1))
        session.wait()
        while b"version\ndata: 1-" not in seen:  # strokes are told nevertheless
            seen += line.readline()
        line.close()
        connection.close()
    assert viewer.version()[0] != before[0]
    session.close()


#: Paints and saves with files of at most so many bytes, and says what it hears.
_FULL = """
import json, resource, sys; sys.path.insert(0, '.')
from pathlib import Path
from tests.viewer.test_session import *
most, session = int(sys.argv[2]), Session(*canvas(), Path(sys.argv[1]))
session.take(stroke(1))
session.wait()
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
said = []
def tried(body):
    try:
        session.take(body)
        session.wait()
        said.append(session.shown.told['fault'])
    except OutputError as error:
        said.append(str(error))
tried(plain('save', 2))
for _ in range(2):
    tried(stroke(3, name='x' * 40, filler='y' * 60_000))
resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
number = 3 if 'File too large' in said[1] else 4
tried(stroke(number))
tried(plain('save', number + 1))
told = session.shown.told
print(json.dumps([said, told['done'], told['isSaved'], session.close()]))
"""


@pytest.mark.skipif(os.name != "posix", reason="POSIX systems limit files")
def test_a_full_disk_loses_nothing_and_painting_goes_on_once_there_is_room(tmp_path: Path) -> None:
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


@needs_jit
def test_the_page_asks_whether_to_replace_what_another_program_has_written(
    browser: Any, tmp_path: Path
) -> None:
    texture, surface = canvas()
    output = tmp_path / "out.octex"
    session = Session(texture, surface, output)
    viewer = Viewer(lambda: texture, tmp_path / "ball.octex", surface, session=session)
    with serving(viewer):
        page = opened(browser, viewer.url, (800, 400))
        page.wait_for_function("viewer.painting && viewer.isSharp", timeout=60_000)
        session.take(stroke(1))
        other = touched(output)
        page.keyboard.press("Control+s")
        page.wait_for_selector("#question:visible")
        with page.expect_download() as waited:
            page.click("#copy")
        waited.value.save_as(tmp_path / "copy.octex")
        assert_same(octex.open(tmp_path / "copy.octex"), session.shown.texture)
        assert output.read_bytes() == other
        page.click("#replace")
        page.wait_for_function("viewer.painting.last.isSaved", timeout=60_000)
        assert page.locator("#question").is_hidden()
        assert_same(octex.open(output), session.shown.texture)
        assert page.complaints == []
        page.close()
    session.close()
