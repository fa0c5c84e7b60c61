"""Compile ahead: helper processes compile the last kernels that a command needs while it compiles the first.

All share the same cache (`jit.cache`). `signatures.txt` lists the kernels of commands and the types of their
arguments, in the order of need; `tools/release/signatures.py` writes it. A helper skips lines that no longer
fit: the command compiles those.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from octex.parallel import Progress, cpu_count

#: Sections of the list: kernels of commands; "warm-up" has the others.
SECTIONS = "convert", "preview", "view", "paint", "warm-up"
LIST = Path(__file__).with_name("signatures.txt")
#: The target of a wheel's code: numba's names of a processor and its features.
PORTABLE = {
    "NUMBA_CPU_NAME": "x86-64-v3",
    "NUMBA_CPU_FEATURES": "+avx,+avx2,+bmi,+bmi2,+crc32,+cx16,+f16c,+fma,+fxsr,+lzcnt,+movbe,+popcnt,+sahf,"
    "+sse3,+sse4.1,+sse4.2,+ssse3,+xsave",
}
#: An array's type as text: ``uint8:2C`` has two axes, in C order.
_ARRAY = re.compile(r"(\w+):(\d+)([ACF])")
#: Most helpers: more would compile the same.
_MOST = 3
#: A helper's arguments: -P leaves the working directory out of the module path.
_CALL = ("-P", "-c", "from octex.ahead import main; main()")


def use_shipped_code() -> None:
    """Make numba, in this process and those that it starts, use the code that came with a wheel.

    Call it before numba is imported. It changes nothing without such code, on a processor that lacks one of
    the features, or where the environment names another processor.
    """
    if not LIST.with_name("compiled").is_dir() or PORTABLE.keys() & os.environ.keys():
        return
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    if all(features.get(name.lstrip("+")) for name in PORTABLE["NUMBA_CPU_FEATURES"].split(",")):
        os.environ.update(PORTABLE)


@contextmanager
def at_first_compilation(action: Callable[[], object]) -> Iterator[None]:
    """While the block lasts, call ``action`` when numba first misses a kernel in its cache."""
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        is_called = False

        def on_start(self, _event: Any) -> None:
            if not self.is_called:
                self.is_called = True
                action()

        def on_end(self, _event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


@contextmanager
def ahead(*sections: str) -> Iterator[None]:
    """While the block lasts, let helpers compile sections of the list, once a kernel is missing."""
    count = min(cpu_count() - 1, _MOST) if sections else 0
    # A program that Python is built into starts no helpers.
    if count == 0 or not Path(sys.executable or "").name.startswith("python"):
        yield
        return
    helpers: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        null = subprocess.DEVNULL
        for number in range(count):
            call = [sys.executable, *_CALL, str(number), str(count), *sections]
            with suppress(OSError):
                helpers.append(
                    subprocess.Popen(call, stdin=subprocess.PIPE, stdout=null, stderr=null, env=environment)
                )

    try:
        with at_first_compilation(start):
            yield
    finally:
        for helper in helpers:
            with suppress(OSError, subprocess.TimeoutExpired):
                helper.communicate(timeout=5.0)  # the end of its input ends it
            helper.kill()


def main() -> None:
    """Run a helper: compile its share of sections, the last lines first, while standard input lasts."""
    from octex.jit.cache import WRITING  # before a second thread imports octex

    number, count = map(int, sys.argv[1:3])
    threading.Thread(target=_watch, args=[WRITING], daemon=True).start()
    for line in lines(*sys.argv[3:])[::-1][number::count]:
        _compile(line)


def compile_listed(progress: Progress) -> None:
    """Compile everything listed; later commands start at once."""
    listed = lines(*SECTIONS)
    for done, line in enumerate(listed):
        progress("compile", done, len(listed))
        _compile(line)
    progress("compile", len(listed), len(listed))


def _compile(line: str) -> None:
    """Compile a line of the list, or skip one that no longer fits."""
    with suppress(Exception):
        kernel, arguments = read(line)
        kernel.compiled.compile(arguments)


def _watch(writing: AbstractContextManager[Any]) -> None:
    """End this process with its input, but not while a file is unfinished."""
    os.read(0, 1)  # not sys.stdin, whose lock a thread must not hold when Python ends
    with writing:
        os._exit(0)


def lines(*sections: str) -> list[str]:
    """Return the lines of sections, each once."""
    listed: dict[str, None] = {}
    section = ""
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif section in sections and line and not line.startswith("#"):
            listed[line] = None
    return list(listed)


def read(line: str) -> tuple[Any, tuple[Any, ...]]:
    """Return the kernel and the argument types of a line; raises an error for a line that no longer fits."""
    home, text = line.split(" ", 1)
    module, name = home.split(":")
    return getattr(import_module(module), name), read_types(text)


def types_text(arguments: Any) -> str:
    """Return the names of the types of arguments."""
    return ", ".join(map(_type_text, arguments))


def _type_text(kind: Any) -> str:
    from numba import types

    if isinstance(kind, types.Array):
        return f"{kind.dtype}:{kind.ndim}{kind.layout}"
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    of = getattr(kind, "instance_class", tuple)
    return f"{of.__module__}.{of.__qualname__}({types_text(kind.types)})"


def read_types(text: str) -> tuple[Any, ...]:
    """Return the types in a text of ``types_text``; raises an error for unknown ones."""
    types, start, depth = [], 0, 0
    for end, letter in enumerate(f"{text}," if text else ""):
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            types.append(_read_type(text[start:end].strip()))
            start = end + 1
    return tuple(types)


def _read_type(text: str) -> Any:
    from numba import types

    array = _ARRAY.fullmatch(text)
    if array is not None:
        dtype, dimensions, layout = array.groups()
        return types.Array(_read_type(dtype), int(dimensions), layout)
    if not text.endswith(")"):
        return types.boolean if text == "bool" else getattr(types, text)
    name, _, inner = text[:-1].partition("(")
    module, _, name = name.rpartition(".")
    of, within = getattr(import_module(module), name), read_types(inner)
    if len(getattr(of, "_fields", within)) != len(within):
        raise ValueError(f"{of} has not {len(within)} fields")
    return types.BaseTuple.from_types(within, None if of is tuple else of)
