"""octex, the one command: its first word, its helps and pages, and that it does what octree-convert does."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import octex
from octex.cli.main import main
from octex.cli.options import COMMANDS
from octex.docs import TOPICS, topic
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import Cli, colored_box, python

NAMES = [*COMMANDS]


class Octex(Cli):
    """Runs octex, with any first word."""

    def run(self, *arguments):
        return main([str(each) for each in arguments])


@pytest.fixture
def cli(capsys):
    return Octex(capsys)


@needs_jit
def test_the_doors_are_two_of_the_commands(tmp_path, cli):
    model, texture, other = colored_box(tmp_path), tmp_path / "box.octex", tmp_path / "other.octex"
    assert cli.result("convert", "--depth", 4, model, texture, "--quiet") == ""
    assert main(["convert", str(model), str(other), "--depth", "4", "--quiet"], "octree-convert") == 0
    assert other.read_bytes() == texture.read_bytes()
    for door in ("convert", "paint"):
        for word, text in (("--help", cli.result(door, "--help")), ("--version", cli.result("--version"))):
            assert main([door, word], f"octree-{door}") == 0
            own = f"octex {door}" if word == "--help" else "octex"
            assert cli.said()[0] == text.replace(own, f"octree-{door}")
    assert cli.result("--version") == f"octex {octex.__version__}\n"


@pytest.mark.parametrize("name", NAMES)
def test_each_commands_help_is_a_screen_with_every_option(name, cli):
    text = cli.result(name, "--help")
    assert name in TOPICS or text == cli.result("help", name)
    assert text.startswith(f"usage: octex {name}")
    assert f"\n\n  octex {name}" in text
    assert text.count("\n") <= 45
    assert max(map(len, text.splitlines())) <= 100
    command = COMMANDS[name]
    assert all(f"\n  {each.word}" in text for each in (*command.files, *command.options))
    assert len(command.options) <= {"convert": 26, "paint": 28, "bake": 23, "diff": 8}.get(name, 22)


def test_every_exit_code_is_explained(cli):
    text = cli.result("help", "commands")
    assert all(re.search(rf"{code}`? +\| {re.escape(code.meaning)}", text) for code in ExitCode)


@pytest.mark.parametrize("name", NAMES)
def test_the_examples_of_helps_are_understood(name, tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)  # without any file
    text = cli.result(name, "--help")
    for example in re.findall(rf"^  octex {name} (.+)$", text.split("\n\n")[2], re.MULTILINE):
        message = cli.errors(name, *example.split(), code=ExitCode.REFUSED).splitlines()[-1]
        assert not re.search("not an option|too many|needs a value|cannot be used|missing", message), message


def test_the_overview_names_every_command_and_page(cli):
    text = cli.result("--help")
    assert text == cli.result("help") == cli.result("help", "--help")
    for name in NAMES:
        assert f"\n  {name} " in text
    assert all(name in text for name in TOPICS)
    assert max(map(len, text.splitlines())) <= 130


@pytest.mark.parametrize("name", TOPICS)
def test_each_page_is_there(name, cli):
    text = topic(name)
    assert text.startswith("# ")
    assert cli.result("help", name) == text + "\n"
    for command, word in re.findall(r"octex ([a-z]+) [^\n`]*?(--[a-z-]+)", text):
        assert COMMANDS[command].has(word), (command, word)


def test_what_is_no_command_is_refused_with_those_that_there_are(cli):
    names = "convert, view, draw, paint, bake, edit, info, diff, validate, overlaps, warm-up, help"
    for words, said in (
        ("", "a command is missing"),
        ("convrt a", "'convrt' is not a command, do you mean 'convert'"),
        ("a.glb", "'a.glb' is not a command"),
        ("--quiet info", "--quiet stands before the command"),
    ):
        expected = f"octex: error: {said}: the commands are {names}; see octex --help"
        assert cli.refused(*words.split()) == expected
    assert cli.refused("help", "x").startswith("octex: error: there is no page on 'x'; there are tutorial, ")
    assert cli.refused("help", "printing") == (
        "octex: error: there is no page on 'printing'; do you mean 'print'? octex help lists all"
    )


INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)

class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

from octex.cli import start
for name in [name for name in sys.modules if name == "octex.errors"]:
    del sys.modules[name]
sys.meta_path.insert(0, Finder())
function = getattr(start, sys.argv.pop(2))
sys.exit(function())
"""


SCRIPTS = tomllib.loads((Path(octex.__file__).parents[1] / "pyproject.toml").read_text())["project"][
    "scripts"
]
MODULES = "octex.errors", "octex.cli.common", "octex.cli.values"


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("command", "module"),
    [*((each, "octex.cli.main") for each in SCRIPTS), *(("octex", each) for each in MODULES)],
)
def test_a_command_that_is_interrupted_while_it_is_imported_says_so_in_one_line(command, module):
    home, _, function = SCRIPTS[command].partition(":")
    assert home == "octex.cli.start"
    done = python(INTERRUPTED, module, function, "--version")
    assert (done.returncode, done.stderr) == (130, f"{command}: interrupted\n")


def test_python_runs_octex_as_a_module():
    call = [sys.executable, "-m", "octex", "--version"]
    done = subprocess.run(call, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == f"octex {octex.__version__}\n"


def test_a_page_is_not_viewed_again(tmp_path, cli):
    page = tmp_path / "droid.html"
    assert cli.refused("view", str(page)).endswith("error: TEXTURE is missing; see octex view --help")
    page.write_text("<html>")
    assert cli.refused("view", str(page)).endswith("droid.html: is a page already; open it in a browser")
