"""octex, the one command: its first word, its helps and pages, and that it does what octree-convert does."""

from __future__ import annotations

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

import octex
from octex.cli.convert_options import COMMANDS
from octex.cli.main import main
from octex.docs import TOPICS, topic
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import colored_box, python

NAMES = [*COMMANDS, "paint", "view"]


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(each) for each in arguments]) == ExitCode.DONE
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(each) for each in arguments]) == ExitCode.REFUSED
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err.rstrip("\n")


@needs_jit
def test_each_command_does_what_octree_convert_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from octex.cli.convert import main as convert

    model, texture, coarse = colored_box(tmp_path), tmp_path / "box.octex", tmp_path / "coarse.octex"
    assert said(capsys, "convert", "--depth", 4, model, texture, "--quiet") == ""
    said(capsys, "edit", texture, "--depth", 3, coarse)
    assert octex.open(coarse).tree.max_depth == 3
    assert json.loads(said(capsys, "validate", coarse, "--json"))["valid"]
    for command, files, options in (
        ("info", [texture], []),
        ("info", [texture], ["--json"]),
        ("validate", [texture], []),
        ("diff", [texture, model], ["--points", 1000]),
        ("diff", [texture, model], ["--points", 1000, "--threads", 1]),
        ("overlaps", [model], ["--margin", 0.1]),
        ("overlaps", [model], ["--threads", 1]),
    ):
        wanted = [f"--{command}", *map(str, files), *map(str, options)]
        assert convert(wanted) == ExitCode.DONE
        expected = capsys.readouterr().out
        assert said(capsys, command, *options, *files) == expected


@pytest.mark.parametrize("name", NAMES)
def test_each_commands_help_is_a_screen_with_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, name, "--help")
    assert text.startswith(f"usage: octex {name}")
    assert f"examples:\n  octex {name}" in text
    assert text.count("\n") <= 60
    everything = said(capsys, name, "--help-all")
    assert all(f"{code:3}  {code.meaning}" in everything for code in ExitCode)


@pytest.mark.parametrize("name", NAMES)
def test_the_examples_of_helps_are_understood(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # without any file
    text = said(capsys, name, "--help")
    for example in re.findall(rf"^  octex {name} (.+)$", text.split("\n\n")[2], re.MULTILINE):
        assert main([name, *example.split()]) == ExitCode.REFUSED
        message = capsys.readouterr().err.splitlines()[-1]
        assert not re.search("no option|too many|needs a value|no meaning|missing", message), message


def test_the_overview_names_every_command_and_page(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "--help")
    assert text == said(capsys, "help")
    for name in NAMES:
        assert f"\n  {name} " in text
    assert all(name in text for name in TOPICS)
    assert max(map(len, text.splitlines())) <= 130


@pytest.mark.parametrize("name", TOPICS)
def test_each_page_is_there(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = topic(name)
    assert text.startswith("# ")
    assert said(capsys, "help", name) == text + "\n"
    for command, word in re.findall(r"(octex [a-z]+|octree-[a-z]+) [^\n]*?(--[a-z-]+)", text):
        name = command.split()[-1].removeprefix("octree-")
        family = name if name in ("paint", "bake", "view") else "convert"
        assert f"  {word}" in said(capsys, family, "--help-all"), (command, word)


def test_help_of_a_command_is_all_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "help", "diff") == said(capsys, "diff", "--help-all")


def test_what_is_no_command_is_refused_with_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    known = "the commands are convert, view, paint, bake, edit, info, diff, validate, overlaps, warm-up, help"
    end = f"{known}; see octex --help"
    assert refused(capsys) == f"octex: error: a command is missing: {end}"
    assert (
        refused(capsys, "convrt", "a")
        == f"octex: error: 'convrt' is no command, do you mean 'convert': {end}"
    )
    assert refused(capsys, "a.glb") == f"octex: error: 'a.glb' is no command: {end}"
    assert refused(capsys, "--quiet", "info") == f"octex: error: --quiet stands before the command: {end}"
    assert refused(capsys, "help", "x").startswith(
        "octex: error: there is no page on 'x'; there are tutorial, "
    )
    message = "octex edit: error: a.glb: is no .octex file; octex convert makes one of a model"
    assert refused(capsys, "edit", "a.glb", "b.octex") == message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("info", "FILE is missing"),
        ("diff a.octex", "A B are missing"),
        ("validate a b", "b is one file too many for octex validate FILE"),
        ("warm-up now", "now is one file too many for octex warm-up"),
        ("edit a.octex b.octex --dpeth=3", "--dpeth is no option: do you mean --depth"),
        ("convert a.glb b.octex --qqq", "--qqq is no option"),
        (
            "convert a.octex b.glb --mesh a.glb --uv keep",
            "--uv is an option of octex bake, not of octex convert",
        ),
        (
            "diff a.octex b.octex --depth 3",
            "--depth is an option of octex convert and of octex edit and of octex view, not of octex diff",
        ),
        ("overlaps a.glb --margin --json", "--margin needs a value, SIZE"),
        ("paint a.glb --camera", "--camera needs a value, FILE[#NAME]"),
    ],
)
def test_words_that_do_not_fit_are_named(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"octex {words.split()[0]}"
    assert refused(capsys, *words.split()) == f"{command}: error: {message}; see {command} --help"


def test_a_model_is_not_converted_to_another_but_baked_to(capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(capsys, "convert", "a.glb", "b.glb")
    assert message.endswith("convert a.glb to NAME.octex first, then that with --mesh a.glb")
    assert refused(capsys, "convert", "a.octex", "b.glb").endswith("give --mesh MODEL")


def test_a_file_of_functions_needs_the_name_of_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = refused(capsys, "convert", "shapes.py", tmp_path / "a.octex", "--quiet")
    assert message.endswith("shapes.py: name the function in it, like shapes.py:NAME")


def test_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "--version") == f"octex {octex.__version__}\n"


def test_help_and_pages_import_nothing_heavy() -> None:
    code = """
import sys
from octex.cli.main import main
words = ("--help", "convert --help", "paint --help", "help painting", "x")
codes = [main(each.split()) for each in words]
print(*sorted({"numpy", "numba", "PIL", "trimesh", "manifold3d", "tqdm"} & set(sys.modules)), file=sys.stderr)
"""
    assert python(code).stderr.splitlines()[-1] == ""


INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)

class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

from octex.cli import start
for name in [name for name in sys.modules if name in ("argparse", "octex.errors")]:
    del sys.modules[name]
sys.meta_path.insert(0, Finder())
function = getattr(start, sys.argv.pop(2))
sys.exit(function())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("module", ["argparse", "octex.errors", "octex.cli.common", "octex.cli.arguments"])
def test_a_command_that_is_interrupted_while_it_is_imported_says_so_in_one_line(module: str) -> None:
    scripts = tomllib.loads((Path(octex.__file__).parents[1] / "pyproject.toml").read_text())["project"]
    for command, target in scripts["scripts"].items():
        home, _, function = target.partition(":")
        assert home == "octex.cli.start"
        done = python(INTERRUPTED, module, function, "--version")
        assert (done.returncode, done.stderr) == (130, f"{command}: interrupted\n")
