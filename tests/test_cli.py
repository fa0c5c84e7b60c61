"""octree-convert as a stranger meets it."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import octex
from octex.cli.common import Reporter, bytes_text, check_outputs, run, say
from octex.cli.convert import COMMAND, main, parser
from octex.errors import ExitCode, InputError, ModelError, OutputError

HEAVY = ("numpy", "numba", "PIL", "trimesh", "manifold3d", "tqdm", "octex.texture", "octex.tree")


def python(code: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=600, **options
    )


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
def test_a_failure_is_one_line_on_stderr_and_an_exit_code(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def body() -> int:
        raise error

    assert run("octree-x", body) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == line + "\n"


def test_a_defect_shows_its_traceback_if_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OCTEX_TRACEBACK", "1")
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED
    error = capsys.readouterr().err
    assert error.startswith("Traceback")
    assert "this is a defect of octex: ZeroDivisionError" in error.splitlines()[-1]


class Broken(io.StringIO):
    """A stream whose reader has gone, or whose disk is full."""

    def __init__(self, error: OSError) -> None:
        super().__init__()
        self.error = error

    def write(self, _text: str, /) -> int:
        raise self.error

    def isatty(self) -> bool:
        return False


def test_a_reader_that_has_gone_away_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", Broken(BrokenPipeError()))
    say("result")
    assert run("octree-x", lambda: ExitCode.INVALID) == ExitCode.INVALID


def test_output_that_cannot_be_written_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdout", Broken(OSError(28, "No space left on device")))
    assert run("octree-x", lambda: ExitCode.DONE) == ExitCode.REFUSED
    expected = "octree-x: error: standard output cannot be written: No space left on device\n"
    assert capsys.readouterr().err == expected


def test_closed_streams_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    say("result")
    with Reporter("octree-x") as progress:
        progress("stage", 1, 1)
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED


def test_names_that_are_no_text_can_be_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = (tmp_path / "out").open("w", encoding="ascii")
    with file:
        monkeypatch.setattr(sys, "stdout", file)
        say("caf\u00e9 \udcff")
    assert (tmp_path / "out").read_text() == "caf\\xe9 \\udcff\n"


# --- progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_there_is_a_bar_with_the_stages_name(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_elsewhere_a_finished_stage_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_stage_that_fails_is_not_said_to_be_done(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ModelError), Reporter("octree-x") as progress:
        progress("cells", 1, 2)
        raise ModelError("bad")
    assert capsys.readouterr().err == ""


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with Reporter("octree-x", quiet=True) as progress:
        progress("cells", 1, 1)
        progress.note("a note")
    assert capsys.readouterr().err == ""


def test_nothing_that_happens_to_stderr_stops_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Broken(BrokenPipeError()))
    with Reporter("octree-x") as progress:
        for stage in ("cells", "colours", "cells"):
            progress(stage, 1, 1)
        progress.note("a note")
    assert run("octree-x", lambda: 1 // 0) == ExitCode.CRASHED


def test_compilation_is_announced_once(capsys: pytest.CaptureFixture[str]) -> None:
    import numba

    from octex import jit

    with Reporter("octree-x"):
        for number in range(2):
            numba.njit(lambda value: value + number)(1)  # noqa: B023
    expected = (
        []
        if jit.DISABLED
        else ["octree-x: compiling; later runs need not (octree-convert --warm-up does it ahead)"]
    )
    assert capsys.readouterr().err.splitlines() == expected


# --- checks before any work


def test_outputs_are_checked_before_any_work(tmp_path: Path) -> None:
    model = tmp_path / "model.glb"
    model.write_bytes(b"model")
    there = tmp_path / "there.octex"
    there.write_bytes(b"old")
    (tmp_path / "folder.octex").mkdir()
    alias = tmp_path / "alias.octex"
    alias.symlink_to(model)

    def check(*names: str, force: bool = False) -> None:
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
    with pytest.raises(OutputError, match=r"folder\.octex: is a folder; give OUTPUT0 a file's name"):
        check("folder.octex")
    with pytest.raises(OutputError, match=r"there is no folder .*nowhere; make it first"):
        check("nowhere/a.octex")
    with pytest.raises(OutputError, match=r"there\.octex: exists already; --force overwrites it"):
        check("there.octex")
    with pytest.raises(OutputError, match="OUTPUT0 is also an input; give it another name"):
        check("alias.octex", force=True)
    with pytest.raises(OutputError, match="OUTPUT1 is also OUTPUT0; give it another name"):
        check("a.octex", "sub/../a.octex" if (tmp_path / "sub").mkdir() is None else "")


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(OutputError, match="cannot be written"):
        check_outputs([(tmp_path / "a.octex", (".octex",), "OUTPUT")], [], force=False)


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "1 kB"),
        (1_234_567, "1.23 MB"),
        (999_900_000, "1000 MB"),
        (5 * 10**15, "5000 TB"),
    ],
)
def test_bytes_are_readable(count: int, text: str) -> None:
    assert bytes_text(count) == text


# --- usage


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run octree-convert, which must refuse in one line; return what it says."""
    assert main([str(argument) for argument in arguments]) == ExitCode.REFUSED
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith(f"{COMMAND}: error: ")
    return captured.err.removeprefix(f"{COMMAND}: error: ").rstrip("\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "INPUT is missing; see octree-convert --help"),
        ("a.glb", "OUTPUT is missing; see octree-convert --help"),
        ("a.glb b.octex c", "unrecognized arguments: c; see octree-convert --help"),
        ("a.glb b.octex --dept 3", "unrecognized arguments: --dept 3; see octree-convert --help"),
        ("a.glb b.octex --depth x", "argument --depth: 'x' is no whole number; see octree-convert --help"),
        ("a.glb b.octex --depth", "argument --depth: expected one argument; see octree-convert --help"),
        ("a.glb b.octex --cell x", "argument --cell: 'x' is no number; see octree-convert --help"),
        (
            "a.glb b.octex --cell 0",
            "argument --cell: 0 is not a finite number above zero; see octree-convert --help",
        ),
        ("a.glb b.octex --threads 0", "argument --threads: 0 is not above zero; see octree-convert --help"),
        (
            "a.glb b.octex --threads x",
            "argument --threads: 'x' is no whole number; see octree-convert --help",
        ),
        (
            "a.glb b.octex --depth 0 --cell 1",
            "--depth and --cell both say how fine the cells are; give one of them",
        ),
        ("--info a.octex b.octex", "INPUT has no meaning with --info; see octree-convert --help"),
        ("--info a.octex --depth 0", "--depth has no meaning with --info; see octree-convert --help"),
        ("--info a.octex --quiet", "--quiet has no meaning with --info; see octree-convert --help"),
        (
            "--info a.octex --validate a.octex",
            "--validate has no meaning with --info; see octree-convert --help",
        ),
        ("--validate a.octex --force", "--force has no meaning with --validate; see octree-convert --help"),
        ("--warm-up --json", "--json has no meaning with --warm-up; see octree-convert --help"),
        ("--warm-up --threads 2", "--threads has no meaning with --warm-up; see octree-convert --help"),
    ],
)
def test_bad_usage_is_refused_by_name(
    arguments: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refusal(capsys, *arguments.split()) == message


def test_help_shows_the_table_of_exit_codes_and_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for code in ExitCode:
        assert f"{code:3}  {code.meaning}" in text
    for action in parser()._actions:
        name = action.option_strings[-1] if action.option_strings else action.dest
        assert text.count(name) >= 2, f"{name} is not in the usage and the list"


def test_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"octree-convert {octex.__version__}\n"


def test_help_and_refusals_import_nothing_heavy() -> None:
    code = f"""
import sys
from octex.cli.convert import main
assert main(["--help"]) == 0
assert main(["model.glb", "nowhere/model.octex"]) == 2
print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
    done = python(code)
    assert done.stderr.splitlines()[-1] == "[]"
