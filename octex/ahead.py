"""Compile ahead: while a command compiles and runs its first stages, another process compiles its last.

Both keep what they compile in the same folders (`jit_cache`). `signatures.txt` lists what Python calls
kernels with, in the order of need, in sections; `tools/signatures.py` writes it. A line that no longer fits
is passed over: the command compiles what it misses.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from octex.parallel import cpu_count

LIST = Path(__file__).with_name("signatures.txt")
#: Helpers at most: more would compile the same.
_MOST = 3
#: What a helper runs; without the folder that the command is called in among those of modules.
_CALL = ("-P", "-c", "from octex.ahead import main; main()")
#: Held while a file is unfinished.
WRITING = threading.Lock()

_wanted: tuple[str, ...] = ()
_helpers: list[subprocess.Popen[bytes]] = []


@contextmanager
def ahead(*sections: str) -> Iterator[None]:
    """While the block lasts, have sections of the list compiled elsewhere too, once a kernel is missing."""
    global _wanted
    _wanted = sections
    if sections and _is_new():
        begin()
    try:
        yield
    finally:
        _wanted = ()
        while _helpers:
            _end(_helpers.pop())


def _is_new() -> bool:
    """Tell whether nothing has been compiled, as far as can be told before numba is imported: a second."""
    room = LIST.parent
    if {"NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT"} & os.environ.keys() or not os.access(room, os.W_OK):
        return False
    return not (room / "compiled").exists() and not any(room.glob("**/__pycache__/*.nbc"))


def begin() -> None:
    """Start what `ahead` asks for, if there are processors for it: once, when first a kernel is missing."""
    global _wanted
    sections, _wanted = _wanted, ()
    count = min(cpu_count() - 1, _MOST) if sections else 0
    if not Path(sys.executable or "").name.startswith("python"):  # a program that Python is built into
        return
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    for number in range(count):
        with suppress(OSError):
            helper = subprocess.Popen(
                [sys.executable, *_CALL, str(number), str(count), *sections],
                stdin=subprocess.PIPE,  # whose end tells the helper that this process has ended
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
            _helpers.append(helper)
            threading.Thread(target=helper.wait, name="octex ahead", daemon=True).start()


def _end(helper: subprocess.Popen[bytes]) -> None:
    assert helper.stdin is not None
    with suppress(OSError):
        helper.stdin.close()
    try:
        helper.wait(5.0)
    except subprocess.TimeoutExpired:
        helper.kill()
        helper.wait()


def main() -> None:
    """Be a helper: compile its share of some sections, the last first, while standard input lasts."""
    number, count = map(int, sys.argv[1:3])
    threading.Thread(target=_watch, daemon=True).start()
    from octex.jit import MANY_OBJECTS

    gc.set_threshold(MANY_OBJECTS)
    for line in lines(*sys.argv[3:])[::-1][number::count]:
        with suppress(Exception):
            kernel, arguments = read(line)
            kernel.compile(arguments)


def _watch() -> None:
    os.read(0, 1)  # not sys.stdin, whose lock a thread must not hold when Python ends
    with WRITING:
        os._exit(0)


def lines(*sections: str) -> list[str]:
    """Return the lines of some sections, each once."""
    found: dict[str, None] = {}
    section = ""
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif section in sections and line and not line.startswith("#"):
            found[line] = None
    return list(found)


def read(line: str) -> tuple[Any, tuple[Any, ...]]:
    """Return a kernel and the types of arguments that a line names; raises what is raised if it has none."""
    from octex.jit_cache import read_types

    home, text = line.split(" ", 1)
    module, name = home.split(":")
    return getattr(import_module(module), name), read_types(text)
