"""Runs octree-convert as tests need it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octex.cli.convert import COMMAND, main
from octex.errors import ExitCode


def python(code: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=600, **options
    )


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run octree-convert, which must refuse in one line; return what it says."""
    assert main([str(argument) for argument in arguments]) == ExitCode.REFUSED
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith(f"{COMMAND}: error: ")
    return captured.err.removeprefix(f"{COMMAND}: error: ").rstrip("\n")


def result(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run octree-convert, which must succeed; return what it prints on stdout."""
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert code == ExitCode.DONE, captured.err
    return captured.out


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
