"""Write octex/signatures.txt: what Python calls kernels with, in the order of need.

usage: python tools/release/signatures.py
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba

from octex import ahead, jit
from octex.ahead import types_text
from octex.jit.decorators import Kernel

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "samples" / "droid.glb"
_HEAD = "# What kernels are called with, by `tools/release/signatures.py`. See `octex/ahead.py`.\n"


@contextmanager
def recorded() -> Iterator[list[str]]:
    """List what Python calls kernels with while the block lasts."""
    calls: dict[str, None] = {}

    def called(kernel: Any, *arguments: Any) -> Any:
        given = tuple(map(jit.unlocked, arguments))
        function = kernel.py_func
        calls[f"{function.__module__}:{function.__qualname__} {types_text(map(numba.typeof, given))}"] = None
        return kernel.compiled(*given)

    found: list[str] = []
    usual, Kernel.__call__ = Kernel.__call__, called  # type: ignore[method-assign]
    try:
        yield found
    finally:
        Kernel.__call__ = usual  # type: ignore[method-assign]
        found += calls


def record(module: str, *arguments: str | Path) -> list[str]:
    """Run a module's command in a process of its own; return what it calls kernels with, each once."""
    call = [sys.executable, __file__, module, *map(str, arguments)]
    done = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=True)
    return list(json.loads(done.stdout.splitlines()[-1]))


def command(*words: str | Path) -> list[str]:
    """Return what a command of octex calls kernels with."""
    return record("octex.cli.main", *words, "--quiet")


def recorder(module: str, *arguments: str) -> int:
    """Be that process."""
    ahead.cpu_count = lambda: 1  # no helpers
    jit.direct = lambda kernel: kernel
    with recorded() as found:
        code = importlib.import_module(module).main(list(arguments))
    print(json.dumps(found))
    return int(code)


def main() -> int:
    with tempfile.TemporaryDirectory() as name:
        texture, preview, view, camera, painted = (
            Path(name) / file for file in ("t.octex", "preview.png", "view.png", "camera.json", "p.octex")
        )
        sections = {}
        sections["convert"] = command("convert", MODEL, texture)
        sections["preview"] = command("convert", MODEL, texture, "--preview", preview, "--force")
        sections["view"] = command("draw", texture, MODEL, view, "--as", "paint", "--camera-out", camera)
        sections["paint"] = command(
            "paint", texture, MODEL, painted, view, "--since", "nothing", "--camera", camera
        )
        sections["warm-up"] = record("every_path")
    sections["preview"] = [line for line in sections["preview"] if line not in sections["convert"]]
    blocks = ["\n".join([f"[{name}]", *lines, ""]) for name, lines in sections.items()]
    (ROOT / "octex" / "signatures.txt").write_text(_HEAD + "\n".join(blocks), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(recorder(*sys.argv[1:]) if sys.argv[1:] else main())
