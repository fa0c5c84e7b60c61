"""octree-convert as a stranger meets it."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
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
        else ["octree-x: compiling: up to a minute, this once (octree-convert --warm-up does it ahead)"]
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
    for folder in ("folder.octex", "."):
        with pytest.raises(OutputError, match="is a folder; give OUTPUT0 a file's name"):
            check(folder)
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
        (999_900_000, "1 GB"),
        (5 * 10**15, "5 PB"),
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


# --- conversions


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small box whose corners have colours."""
    import trimesh

    box = trimesh.creation.box((2, 1, 1))
    colors = np.random.default_rng(0).integers(0, 255, (len(box.vertices), 4)).astype(np.uint8)
    colors[:, 3] = 255
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=colors)
    path = tmp_path_factory.mktemp("model") / "box.glb"
    path.write_bytes(box.export(file_type="glb"))
    return path


@pytest.fixture(scope="module")
def made(model: Path) -> Path:
    """The box as an octree texture of depth 4."""
    path = model.with_name("box.octex")
    octex.convert(model, 4).save(path)
    return path


def result(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run octree-convert, which must succeed; return what it prints on stdout."""
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert code == ExitCode.DONE, captured.err
    return captured.out


def test_a_model_becomes_an_octree_texture(
    model: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "box.octex"
    summary = result(capsys, model, out, "--depth", 4)
    assert out.read_bytes() == made.read_bytes()
    texture = octex.open(out)
    cells = rf"{texture.tree.n_leaves:,} leaves, depth 4 \(cells of [\d.]+\)"
    size = bytes_text(out.stat().st_size)
    assert re.fullmatch(rf"{re.escape(str(out))}: {cells}, {re.escape(size)}, [\d.]+ s\n", summary)


def test_stages_are_told_on_stderr(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(model), str(tmp_path / "box.octex"), "--depth", "3"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "compiling" not in line]
    assert lines
    assert all(re.fullmatch(r"octree-convert: \w+: done in \d+\.\d s", line) for line in lines)
    assert [lines[0].split()[1], lines[-1].split()[1]] == ["read:", "write:"]


def test_a_machine_reads_one_json_object_and_quiet_is_silent(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "box.octex"
    assert main([str(model), str(out), "--depth", "3", "--json", "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    made = json.loads(captured.out)
    texture = octex.open(out)
    assert made.pop("seconds") > 0
    assert made == {
        "output": str(out),
        "leaves": texture.tree.n_leaves,
        "nodes": texture.tree.n_nodes,
        "depth": 3,
        "cell": texture.placement.size / 8,
        "bytes": out.stat().st_size,
    }
    assert main([str(model), str(out), "--depth", "3", "--quiet", "--force"]) == 0
    assert capsys.readouterr() == ("", "")


def test_cells_can_be_asked_for_by_their_size(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result(capsys, model, tmp_path / "box.octex", "--cell", 0.25)
    texture = octex.open(tmp_path / "box.octex")
    assert texture.placement.size / 2**texture.tree.max_depth == 0.25


def test_the_result_does_not_depend_on_the_threads(
    model: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for threads in (1, 3):
        out = tmp_path / f"{threads}.octex"
        result(capsys, model, out, "--depth", 4, "--threads", threads)
        assert out.read_bytes() == made.read_bytes()


def test_a_rest_mesh_places_the_texture(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import trimesh

    posed = trimesh.load(model, force="mesh")
    posed.apply_scale(3)
    posed.export(tmp_path / "posed.glb")
    out = tmp_path / "box.octex"
    result(capsys, tmp_path / "posed.glb", out, "--rest", model, "--depth", 3)
    np.testing.assert_allclose(octex.open(out).bounds, octex.load_surface(model).bounds)
    trimesh.creation.icosahedron().export(tmp_path / "other.glb")
    assert "other.glb" in refusal(capsys, model, tmp_path / "x.octex", "--rest", tmp_path / "other.glb")
    assert not (tmp_path / "x.octex").exists()


def test_points_are_the_same_from_the_model_and_from_its_texture(
    model: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = result(capsys, model, tmp_path / "a.ply", "--depth", 4)
    result(capsys, made, tmp_path / "b.PLY")
    assert f"{octex.open(made).tree.n_leaves:,} leaves" in out
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.PLY").read_bytes()


def test_a_texture_can_be_made_coarser_but_not_finer(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "coarse.octex"
    for depth in (0, 2):
        result(capsys, made, out, "--depth", depth, "--force")
        texture = octex.open(out)
        texture.validate()
        assert texture.tree.max_depth == depth
        level = octex.open(made).level(depth)
        np.testing.assert_array_equal(
            texture.channels["base_color"].values, level.channels["base_color"].values
        )
    result(capsys, made, tmp_path / "coarse.ply", "--depth", 2)
    assert refusal(capsys, made, tmp_path / "x.octex", "--depth", 5) == (
        f"{made}: has depth 4; --depth 5 is finer and needs the model"
    )
    assert refusal(capsys, made, tmp_path / "x.octex") == (
        f"{made}: is an octree texture already; --depth makes it coarser"
    )
    for option in (["--cell", "0.1"], ["--rest", str(made.with_suffix(".glb"))]):
        assert refusal(capsys, made, tmp_path / "x.octex", *option) == (
            f"{made}: {option[0]} needs the model, and this is a texture made from one"
        )
    assert not (tmp_path / "x.octex").exists()


def test_a_preview_is_drawn_of_models_and_of_textures(
    model: Path,
    made: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[tuple[str, bool]] = []

    def write_preview(path: Path, surface: Any, texture: Any) -> None:
        drawn.append((path.name, surface is not None))
        assert texture.tree.max_depth == 3

    monkeypatch.setattr("octex.preview.write_preview", write_preview)
    out = result(capsys, model, tmp_path / "a.octex", "--depth", 3, "--preview", tmp_path / "a.png")
    assert out.splitlines()[1] == f"{tmp_path / 'a.png'}: a picture of it"
    out = result(capsys, made, tmp_path / "b.ply", "--depth", 3, "--preview", tmp_path / "b.png", "--json")
    assert json.loads(out)["preview"] == str(tmp_path / "b.png")
    assert drawn == [("a.png", True), ("b.png", False)]
    assert "writes .png here" in refusal(capsys, model, tmp_path / "c.octex", "--preview", tmp_path / "c.gif")
    (tmp_path / "a.png").touch()
    assert "--force" in refusal(capsys, model, tmp_path / "c.octex", "--preview", tmp_path / "a.png")


def test_the_help_names_the_librarys_default_depth() -> None:
    from octex.conversion.convert import DEFAULT_DEPTH

    assert f"(default {DEFAULT_DEPTH})" in " ".join(parser().format_help().split())


# --- bad input: one line, nothing written


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.glb", None),
        ("empty.glb", b""),
        ("broken.gltf", b"{"),
        ("words.txt", b"words"),
        ("missing.octex", None),
        ("empty.octex", b""),
        ("words.octex", b"words and words and words"),
    ],
)
def test_bad_input_is_refused_by_name_and_nothing_is_written(
    name: str, content: bytes | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.glb").mkdir()
    before = sorted(tmp_path.iterdir())
    assert main([str(tmp_path / name), str(tmp_path / "out.ply")]) == ExitCode.REFUSED
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert name in captured.err
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_is_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "folder.glb").mkdir()
    assert "folder.glb" in refusal(capsys, tmp_path / "folder.glb", tmp_path / "out.octex")


def test_a_depth_out_of_range_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for depth in (-1, 22):
        expected = f"--depth must be a whole number from 0 to 21, not {depth}"
        assert refusal(capsys, tmp_path / "missing.glb", tmp_path / "out.octex", "--depth", depth) == expected


def test_nothing_is_overwritten_without_force(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")
    assert refusal(capsys, model, out, "--depth", 3) == f"{out}: exists already; --force overwrites it"
    assert out.read_bytes() == b"old"
    result(capsys, model, out, "--depth", 3, "--force")
    octex.open(out).validate()


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "octree-convert: interrupted"),
        (MemoryError(), 2, "octree-convert: error: out of memory; a smaller depth needs less"),
        (RuntimeError("odd"), 70, "octree-convert: this is a defect of octex: RuntimeError: odd; run with"),
    ],
)
def test_whatever_happens_while_writing_the_old_file_stays(
    error: BaseException,
    code: int,
    line: str,
    model: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")

    def fail(_descriptor: int) -> None:
        raise error

    monkeypatch.setattr(os, "fsync", fail)
    assert main([str(model), str(out), "--depth", "3", "--force"]) == code
    assert capsys.readouterr().err.splitlines()[-1].startswith(line)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


# --- a look at a texture


def test_info_is_text_for_people_and_json_for_machines(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    texture = octex.open(made)
    assert json.loads(result(capsys, "--info", made, "--json")) == texture.info()
    text = result(capsys, "--info", made)
    assert re.search(r"^depth +4, finest cells of edge [\d.]+$", text, re.MULTILINE)
    assert re.search(rf"^ +all +{texture.tree.n_leaves:,} +{texture.tree.n_nodes:,}$", text, re.MULTILINE)
    assert re.search(r"^channels +base_color: 3 x uint8, srgb$", text, re.MULTILINE)
    assert re.search(rf"^total +{made.stat().st_size:,} ", text, re.MULTILINE)
    assert re.search(r"^source +box\.glb$", text, re.MULTILINE)


def test_validate_proves_a_texture_or_names_what_is_broken(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert result(capsys, "--validate", made) == "valid\n"
    assert result(capsys, "--validate", made, "--quiet") == ""
    assert json.loads(result(capsys, "--validate", made, "--json")) == {
        "file": str(made),
        "valid": True,
        "broken": None,
    }
    damaged = bytearray(made.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    (tmp_path / "damaged.octex").write_bytes(damaged)
    (tmp_path / "short.octex").write_bytes(made.read_bytes()[:5000])
    for name in ("damaged.octex", "short.octex"):
        assert main(["--validate", str(tmp_path / name)]) == ExitCode.INVALID
        captured = capsys.readouterr()
        assert captured.err == ""
        assert captured.out.count("\n") == 1
        assert name in captured.out
        assert main(["--validate", str(tmp_path / name), "--json"]) == ExitCode.INVALID
        report = json.loads(capsys.readouterr().out)
        assert not report["valid"]
        assert name in report["broken"]
    assert main(["--validate", str(tmp_path / "short.octex"), "--quiet"]) == ExitCode.INVALID
    assert capsys.readouterr() == ("", "")


def test_a_file_that_cannot_be_read_is_not_a_broken_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for word in ("--validate", "--info"):
        assert "missing.octex" in refusal(capsys, word, tmp_path / "missing.octex")
        assert str(tmp_path) in refusal(capsys, word, tmp_path)


def test_warming_up_says_how_long_it_took(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert re.fullmatch(r"compiled and cached in \d+\.\d s\n", result(capsys, "--warm-up"))
    monkeypatch.setattr("octex.cli.warm_up.warm_up", lambda _progress: None)
    assert result(capsys, "--warm-up", "--quiet") == ""


def test_warming_up_calls_every_kernel_that_is_called_from_python() -> None:
    code = """
import ast, functools, importlib, inspect, pkgutil
import octex
from octex import jit, parallel

called = set()

def recorded(function):
    @functools.wraps(function)
    def wrapper(*arguments):
        called.add(wrapper.kernel)
        return function(*arguments)
    wrapper.kernel = function.__module__ + "." + function.__name__
    return wrapper

decorators = {"kernel", "inlined", "summing_kernel"}
for name in decorators:
    setattr(jit, name, recorded)
names = [module.name for module in pkgutil.walk_packages(octex.__path__, "octex.")]
entries = set()
for module in map(importlib.import_module, names):
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.FunctionDef) and not decorators & {
            getattr(decorator, "id", "") for decorator in node.decorator_list
        }:
            words = {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}
            used = [getattr(module, word, None) for word in words]
            entries |= {value.kernel for value in used if hasattr(value, "kernel")}
assert len(entries) > 20
from octex.cli.warm_up import warm_up
warm_up(parallel.silent)
print(sorted(entries - called))
"""
    done = python(code, env={**os.environ, "NUMBA_DISABLE_JIT": "1"})
    assert (done.stdout, done.stderr) == ("[]\n", "")


# --- as a process

CONVERT = "import sys; from octex.cli.convert import main; sys.exit(main())"
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals, limits and devices of POSIX")


@posix
def test_a_full_disk_leaves_the_old_file_whole(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")
    filling = """
import resource, sys
from octex.cli import convert

class Filling(convert.Reporter):
    def __call__(self, stage, done, total):
        if stage == "write":
            resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

convert.Reporter = Filling
sys.exit(convert.main())
"""
    done = python(filling, str(model), str(out), "--depth", "3", "--force")
    assert done.returncode == ExitCode.REFUSED, done.stderr
    assert done.stderr.startswith(
        f"octree-convert: error: {out}: cannot be written: File too large; make room"
    )
    assert done.stderr.count("\n") == 1
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@posix
def test_interruption_ends_with_130_and_leaves_nothing(model: Path, tmp_path: Path) -> None:
    interrupting = """
import os, signal, sys
from octex.cli import convert

class Interrupting(convert.Reporter):
    def __call__(self, stage, done, total):
        super().__call__(stage, done, total)
        if stage == "convert":
            os.kill(os.getpid(), signal.SIGINT)

convert.Reporter = Interrupting
sys.exit(convert.main())
"""
    done = python(interrupting, str(model), str(tmp_path / "box.octex"), "--depth", "3")
    assert done.returncode == ExitCode.INTERRUPTED
    assert done.stderr.splitlines()[-1] == "octree-convert: interrupted"
    assert list(tmp_path.iterdir()) == []


@posix
def test_a_broken_pipe_is_harmless_and_a_full_device_is_not(made: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as broken:
        arguments = [sys.executable, "-c", CONVERT, "--info", str(made)]
        done = subprocess.run(arguments, stdout=broken, stderr=subprocess.PIPE, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (ExitCode.DONE, "")
    if Path("/dev/full").exists():
        with Path("/dev/full").open("wb") as full:
            done = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True, timeout=600)
        assert done.returncode == ExitCode.REFUSED
        assert done.stderr == (
            "octree-convert: error: standard output cannot be written: No space left on device\n"
        )
