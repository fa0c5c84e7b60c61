"""Compile ahead: while a command compiles and runs, other processes compile what it needs later.

All keep what they compile in the same folders (`jit.cache`). `signatures.txt` lists what Python calls
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
    """Be a helper: compile its share of some sections while standard input lasts."""
    number, count = map(int, sys.argv[1:3])
    threading.Thread(target=_watch, daemon=True).start()
    gc.disable()  # 6 % faster; 3 MB more for each second of it
    for line in shared(lines(*sys.argv[3:]), count)[number::count]:
        with suppress(Exception):
            kernel, arguments = read(line)
            kernel.compile(arguments)


def shared(needed: list[str], helpers: int) -> list[str]:
    """Return lines in the order in which helpers compile them.

    First come the largest of those that helpers end before the command, which compiles the rest, needs them;
    then the rest, the last first.
    """
    sizes = [_size_of(line) for line in needed]
    early: set[int] = set()
    for place in sorted(range(len(needed)), key=lambda place: -sizes[place]):
        chosen, done, of_command = early | {place}, 0, 0
        for at, size in enumerate(sizes):
            if at not in chosen:
                of_command += size
                continue
            done += size
            if done > helpers * of_command:
                break
        else:
            early = chosen
    late = [at for at in reversed(range(len(needed))) if at not in early]
    return [needed[at] for at in (*sorted(early), *late)]


def _size_of(line: str) -> int:
    """Return how much bytecode is compiled for a line, to which time is in proportion: some 0.6 ms a byte."""
    with suppress(Exception):
        found, waiting = set(), [read(line)[0].py_func]
        while waiting:
            function = waiting.pop()
            found.add(function)
            named = map(function.__globals__.get, function.__code__.co_names)
            waiting += {each.py_func for each in named if hasattr(each, "py_func")} - found
        return sum(len(function.__code__.co_code) for function in found)
    return 0


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
    from octex.jit.cache import read_types

    home, text = line.split(" ", 1)
    module, name = home.split(":")
    return getattr(import_module(module), name), read_types(text)
