"""Runs the commands of octex as tests need it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octex.cli.main import main
from octex.cli.options import COMMANDS
from octex.cli.values import is_texture_name
from octex.errors import ExitCode

#: Marks of `painting`: the next word is OUTPUT, of octex paint or of octex draw.
OUT, VIEW = "the painted texture:", "the view to paint on:"


def python(code: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=600, **options
    )


def run(*arguments: object, program: str = "octree-convert") -> int:
    """Run a command of octex, or one of its doors where the first word is no command's.

    Where OUT or VIEW stands among the words, they are those of `painting`.
    """
    words = words_of(*arguments)
    if words and words[0] in COMMANDS:
        return main(words)
    return main([program.removeprefix("octree-"), *words], program)


def words_of(*arguments: object) -> list[str]:
    """Return the words of a command: see `run`."""
    words = [str(argument) for argument in arguments]
    return words if {OUT, VIEW}.isdisjoint(words) else painting(*words)


class Cli:
    """Runs commands as a user does: what they print, what they refuse. By default octree-convert."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def run(self, *arguments: object) -> int:
        """Run a command; return its exit code."""
        return run(*arguments)

    def said(self) -> tuple[str, str]:
        """Return what was printed on stdout and stderr since it was last asked for."""
        return self._capsys.readouterr()

    def result(self, *arguments: object) -> str:
        """Run a command, which must succeed; return what it prints on stdout."""
        code = self.run(*arguments)
        out, err = self.said()
        assert code == ExitCode.DONE, err
        return out

    def facts(self, *arguments: object) -> dict[str, Any]:
        """Run a command with --json, which must succeed; return what it tells."""
        return dict(json.loads(self.result(*arguments, "--json")))

    def errors(self, *arguments: object, code: int = ExitCode.DONE) -> str:
        """Run a command; return what it prints on stderr."""
        assert self.run(*arguments) == code
        return self.said()[1]

    def refused(self, *arguments: object) -> str:
        """Run a command, which must refuse in one line; return that."""
        assert self.run(*arguments) == ExitCode.REFUSED
        out, err = self.said()
        assert (out, err.count("\n")) == ("", 1)
        return err.rstrip("\n")

    def refusal(self, *arguments: object) -> str:
        """Run a command, which must refuse; return what it says."""
        words = words_of(*arguments)
        assert self.run(*arguments) == ExitCode.REFUSED
        out, err = self.said()
        program, _, message = err.splitlines()[-1].partition(": error: ")
        first = words[0] if words else ""
        assert (out, program) == ("", f"octex {first}" if first in COMMANDS else "octree-convert")
        assert first in ("paint", "draw") or err.count("\n") == 1  # these tell what they have read
        return message


def painting(*arguments: object) -> list[str]:
    """Return the words of octex paint, or of octex draw --as paint; OUT or VIEW stands before OUTPUT."""
    words = [str(argument) for argument in arguments]
    output: list[str] = []
    is_view = False
    for mark in {OUT, VIEW}.intersection(words):
        at = words.index(mark)
        output = [words[at + 1]]
        is_view = mark == VIEW
        del words[at : at + 2]
    if not output:
        return ["paint", *words]
    first = 2 if words and is_texture_name(words[0]) else 1
    words[first:first] = output
    return ["draw", *words, "--as", "paint"] if is_view else ["paint", *words]


def colored_box(folder: Path) -> Path:
    """A small box whose corners have colours."""
    import trimesh

    box = trimesh.creation.box((2, 1, 1))
    colors = np.random.default_rng(0).integers(0, 255, (len(box.vertices), 4)).astype(np.uint8)
    colors[:, 3] = 255
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=colors)
    path = folder / "box.glb"
    path.write_bytes(box.export(file_type="glb"))
    return path
