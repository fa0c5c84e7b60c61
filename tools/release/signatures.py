"""Write octex/signatures.txt: what Python calls kernels with, in the order of need.

usage: python tools/release/signatures.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "samples" / "droid.glb"
_HEAD = "# What kernels are called with, by `tools/release/signatures.py`. See `octex/ahead.py`.\n"
_RECORDER = """
import importlib, json, sys, threading
from numba.core import event
from octex import ahead
from octex.jit.signatures import types_text

ahead.cpu_count = lambda: 1  # no helpers
calls = []

class Depth(threading.local):  # of compilations within another, a thread each
    now = 0

depth = Depth()

class Recorder(event.Listener):
    def on_start(self, told):
        function = told.data["dispatcher"].py_func
        if depth.now == 0:  # what Python calls, and not a kernel
            calls.append(f"{function.__module__}:{function.__qualname__} {types_text(told.data['args'])}")
        depth.now += 1

    def on_end(self, told):
        depth.now -= 1

event.register("numba:compile", Recorder())
module, *arguments = sys.argv[1:]
code = importlib.import_module(module).main(arguments)
print(json.dumps(calls))
sys.exit(code)
"""


def record(command: str, *arguments: str | Path) -> list[str]:
    """Run a command of octex and return what it calls kernels with, each once."""
    call = [sys.executable, "-c", _RECORDER, f"octex.cli.{command}", *map(str, arguments), "--quiet"]
    with tempfile.TemporaryDirectory() as cache:  # an empty one: what is compiled is what is recorded
        variables = {**os.environ, "NUMBA_CACHE_DIR": cache}
        done = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=True, env=variables)
    return list(dict.fromkeys(json.loads(done.stdout.splitlines()[-1])))


def main() -> int:
    with tempfile.TemporaryDirectory() as name:
        texture, preview, view, camera, painted = (
            Path(name) / file for file in ("t.octex", "preview.png", "view.png", "camera.json", "p.octex")
        )
        sections = {}
        sections["convert"] = record("convert", MODEL, texture)
        sections["preview"] = record("convert", MODEL, texture, "--preview", preview, "--force")
        sections["view"] = record("paint", MODEL, texture, "--view", view, "--camera-out", camera)
        sections["paint"] = record(
            "paint", MODEL, texture, view, "--whole", "--camera", camera, "--out", painted
        )
        sections["warm-up"] = record("convert", "--warm-up")
    sections["preview"] = [line for line in sections["preview"] if line not in sections["convert"]]
    blocks = ["\n".join([f"[{name}]", *lines, ""]) for name, lines in sections.items()]
    (ROOT / "octex" / "signatures.txt").write_text(_HEAD + "\n".join(blocks), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
