"""What all commands share."""

import io
import os
import re
import sys
from contextlib import nullcontext

import pytest

from octex.cli.common import Reporter, bytes_text, check_outputs, run, say
from octex.errors import ExitCode, InputError, ModelError, OutputError

DEFECT = "this is a defect of octex:"
HINT = "run with OCTEX_TRACEBACK=1 for the traceback"

# --- one line for every failure


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ModelError("a.glb: is empty"), 2, "error: a.glb: is empty"),
        (OutputError("a.octex: disk\nfull"), 2, "error: a.octex: disk full"),
        (PermissionError(13, "Permission denied", "b.obj"), 2, "error: b.obj: Permission denied"),
        (OSError("odd"), 2, "error: odd"),
        (MemoryError(), 2, "error: out of memory; a smaller depth needs less"),
        (MemoryError("8 GiB"), 2, "error: out of memory (8 GiB); a smaller depth needs less"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("1/0"), 70, f"{DEFECT} ZeroDivisionError: 1/0; {HINT}"),
        (AssertionError(), 70, f"{DEFECT} AssertionError; {HINT}"),
    ],
)
def test_a_failure_is_one_line_on_stderr_and_an_exit_code(error, code, line, capsys):
    def body():
        raise error

    assert run("octree-x", body) == code
    assert capsys.readouterr() == ("", f"octree-x: {line}\n")


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


def test_closed_streams_are_no_error_and_names_that_are_no_text_can_be_printed(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    say("result")
    with Reporter("octree-x") as progress:
        progress("stage", 1, 1)
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED
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


@pytest.mark.parametrize(("quiet", "fails"), [(False, False), (False, True), (True, False)])
def test_elsewhere_a_finished_stage_is_a_line_unless_it_is_quiet(quiet, fails, capsys):
    with pytest.raises(ModelError) if fails else nullcontext(), Reporter("octree-x", quiet) as progress:
        for done in range(100):
            progress("cells", done, 100)
        progress.note("a note")
        progress("colours", 1, 2)
        if fails:
            raise ModelError("bad")
    lines = ["a note", "cells: done in N s", "colours: done in N s"][: 2 if fails else 3]
    said = re.sub(r"\d+\.\d", "N", capsys.readouterr().err).splitlines()
    assert said == ([] if quiet else [f"octree-x: {line}" for line in lines])


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


def test_outputs_are_checked_before_any_work_and_folders_that_cannot_be_written_are_refused(
    tmp_path, monkeypatch
):
    model = tmp_path / "model.glb"
    model.write_bytes(b"model")
    (tmp_path / "there.octex").write_bytes(b"old")
    (tmp_path / "alias.octex").symlink_to(model)
    for folder in ("folder.octex", "sub"):
        (tmp_path / folder).mkdir()

    def check(*names, force=False):
        outputs = [(tmp_path / name, (".octex", ".ply"), f"OUTPUT{n}") for n, name in enumerate(names)]
        check_outputs(outputs, [model], force=force)

    check("new.octex", "new.PLY")
    check("there.octex", force=True)
    for names, force, message in (
        (["a.obj"], False, r"a\.obj: OUTPUT0 has the ending '\.obj'; octex writes \.octex and \.ply"),
        (["a"], False, "OUTPUT0 has no ending"),
        (["folder.octex"], False, "is a folder; give OUTPUT0 a file name"),
        (["."], False, "is a folder; give OUTPUT0 a file name"),
        (["nowhere/a.octex"], False, r"there is no folder .*nowhere; make it first"),
        (["there.octex"], False, r"there\.octex: exists already; --force overwrites it"),
        (["alias.octex"], True, "OUTPUT0 is also an input; give it another name"),
        (["a.octex", "sub/../a.octex"], False, "OUTPUT1 is also OUTPUT0; give it another name"),
    ):
        with pytest.raises((InputError, OutputError), match=message):
            check(*names, force=force)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(OutputError, match="cannot be written"):
        check_outputs([(tmp_path / "a.octex", (".octex",), "OUTPUT")], [], force=False)


def test_bytes_are_readable():
    counts = 0, 999, 1000, 1_234_567, 999_900_000, 5 * 10**15
    assert [*map(bytes_text, counts)] == ["0 bytes", "999 bytes", "1 kB", "1.23 MB", "1 GB", "5 PB"]
