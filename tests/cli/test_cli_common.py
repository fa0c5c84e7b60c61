"""What all commands share."""

import io
import os
import re
import sys

import pytest

from octex.cli.common import Reporter, bytes_text, check_outputs, run, say
from octex.errors import ExitCode, InputError, ModelError, OutputError

# --- one line for every failure


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ModelError("a.glb: is empty"), 2, "octree-x: error: a.glb: is empty"),
        (OutputError("a.octex: disk\nfull"), 2, "octree-x: error: a.octex: disk full"),
        (PermissionError(13, "Permission denied", "b.obj"), 2, "octree-x: error: b.obj: Permission denied"),
        (OSError("odd"), 2, "octree-x: error: odd"),
        (MemoryError(), 2, "octree-x: error: out of memory; a smaller depth needs less"),
        (MemoryError("8 GiB"), 2, "octree-x: error: out of memory (8 GiB); a smaller depth needs less"),
        (KeyboardInterrupt(), 130, "octree-x: interrupted"),
        (
            ZeroDivisionError("1/0"),
            70,
            "octree-x: this is a defect of octex: ZeroDivisionError: 1/0; "
            "run with OCTEX_TRACEBACK=1 for the traceback",
        ),
        (
            AssertionError(),
            70,
            "octree-x: this is a defect of octex: AssertionError; "
            "run with OCTEX_TRACEBACK=1 for the traceback",
        ),
    ],
)
def test_a_failure_is_one_line_on_stderr_and_an_exit_code(error, code, line, capsys):
    def body():
        raise error

    assert run("octree-x", body) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == line + "\n"


def test_a_defect_shows_its_traceback_if_asked(monkeypatch, capsys):
    monkeypatch.setenv("OCTEX_TRACEBACK", "1")
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED
    error = capsys.readouterr().err
    assert error.startswith("Traceback")
    assert "this is a defect of octex: ZeroDivisionError" in error.splitlines()[-1]


class Broken(io.StringIO):
    """A stream whose reader has gone, or whose disk is full."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, _text, /):
        raise self.error

    def isatty(self):
        return False


def test_a_reader_that_has_gone_away_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Broken(BrokenPipeError()))
    say("result")
    assert run("octree-x", lambda: ExitCode.INVALID) == ExitCode.INVALID


def test_output_that_cannot_be_written_is_an_error(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", Broken(OSError(28, "No space left on device")))
    assert run("octree-x", lambda: ExitCode.DONE) == ExitCode.REFUSED
    expected = "octree-x: error: standard output cannot be written: No space left on device\n"
    assert capsys.readouterr().err == expected


def test_closed_streams_are_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    say("result")
    with Reporter("octree-x") as progress:
        progress("stage", 1, 1)
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED


def test_names_that_are_no_text_can_be_printed(monkeypatch, tmp_path):
    file = (tmp_path / "out").open("w", encoding="ascii")
    with file:
        monkeypatch.setattr(sys, "stdout", file)
        say("caf\u00e9 \udcff")
    assert (tmp_path / "out").read_text() == "caf\\xe9 \\udcff\n"


# --- progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_there_is_a_bar_with_the_stages_name(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Reporter("octree-x") as progress:
        progress("cells", 0, 4)
        progress("cells", 4, 4)
        progress("colours", 1, 2)
        progress.note("a note")
    shown = terminal.getvalue()
    assert "cells" in shown
    assert "colours" in shown
    assert "octree-x: a note\n" in shown
    assert "done in" not in shown
    assert shown.endswith("\r")  # no bar is left behind


def test_elsewhere_a_finished_stage_is_a_line(capsys):
    with Reporter("octree-x") as progress:
        for done in range(100):
            progress("cells", done, 100)
        progress("colours", 1, 1)
        progress.note("a note")
    lines = capsys.readouterr().err.splitlines()
    assert [re.sub(r"\d+\.\d", "N", line) for line in lines] == [
        "octree-x: cells: done in N s",
        "octree-x: a note",
        "octree-x: colours: done in N s",
    ]


def test_a_stage_that_fails_is_not_said_to_be_done(capsys):
    with pytest.raises(ModelError), Reporter("octree-x") as progress:
        progress("cells", 1, 2)
        raise ModelError("bad")
    assert capsys.readouterr().err == ""


def test_quiet_says_nothing(capsys):
    with Reporter("octree-x", quiet=True) as progress:
        progress("cells", 1, 1)
        progress.note("a note")
    assert capsys.readouterr().err == ""


def test_nothing_that_happens_to_stderr_stops_the_work(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Broken(BrokenPipeError()))
    with Reporter("octree-x") as progress:
        for stage in ("cells", "colours", "cells"):
            progress(stage, 1, 1)
        progress.note("a note")
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED


def test_compilation_is_announced_once(capsys):
    import numba

    from octex import jit

    with Reporter("octree-x"):
        for number in range(2):
            numba.njit(lambda value: value + number)(1)  # noqa: B023
    expected = [] if jit.DISABLED else ["octree-x: compiling kernels, once (octex warm-up compiles all)"]
    assert capsys.readouterr().err.splitlines() == expected


# --- checks before any work


def test_outputs_are_checked_before_any_work(tmp_path):
    model = tmp_path / "model.glb"
    model.write_bytes(b"model")
    there = tmp_path / "there.octex"
    there.write_bytes(b"old")
    (tmp_path / "folder.octex").mkdir()
    alias = tmp_path / "alias.octex"
    alias.symlink_to(model)

    def check(*names, force=False):
        outputs = [(tmp_path / name, (".octex", ".ply"), f"OUTPUT{n}") for n, name in enumerate(names)]
        check_outputs(outputs, [model], force=force)

    check("new.octex", "new.PLY")
    check("there.octex", force=True)
    with pytest.raises(
        InputError, match=r"a\.obj: OUTPUT0 has the ending '\.obj'; octex writes \.octex and \.ply"
    ):
        check("a.obj")
    with pytest.raises(InputError, match="OUTPUT0 has no ending"):
        check("a")
    for folder in ("folder.octex", "."):
        with pytest.raises(OutputError, match="is a folder; give OUTPUT0 a file name"):
            check(folder)
    with pytest.raises(OutputError, match=r"there is no folder .*nowhere; make it first"):
        check("nowhere/a.octex")
    with pytest.raises(OutputError, match=r"there\.octex: exists already; --force overwrites it"):
        check("there.octex")
    with pytest.raises(OutputError, match="OUTPUT0 is also an input; give it another name"):
        check("alias.octex", force=True)
    with pytest.raises(OutputError, match="OUTPUT1 is also OUTPUT0; give it another name"):
        check("a.octex", "sub/../a.octex" if (tmp_path / "sub").mkdir() is None else "")


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(OutputError, match="cannot be written"):
        check_outputs([(tmp_path / "a.octex", (".octex",), "OUTPUT")], [], force=False)


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 bytes"), (999, "999 bytes"), (1000, "1 kB"), (1_234_567, "1.23 MB"), (999_900_000, "1 GB"),
        (5 * 10**15, "5 PB"),
    ],
)  # fmt: skip
def test_bytes_are_readable(count, text):
    assert bytes_text(count) == text
