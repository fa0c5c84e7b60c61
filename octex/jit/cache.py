"""Where compiled kernels are kept, and whether they are still what the source says.

Each version of a kernel is a file of its own, named after what it is compiled for, in the folder that numba
chooses: two processes that add versions at once keep both. (numba lists versions in an index and numbers
their files: two processes can lose an entry, or file code under another version's types.) A file begins with
a digest of what it belongs to (numba's version, the state of all modules that the kernel is compiled from,
and its key) and of its content: a damaged file is compiled anew.
"""

from __future__ import annotations

import hashlib
import pickle
import re
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numba
from numba import types
from numba.core.serialize import dumps

from octex.ahead import WRITING, begin

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: Bytes of a file's digest.
_SIZE = hashlib.sha256().digest_size
#: Seconds that a process waits, at most, for another, which may have been stopped, to compile the same.
LONGEST = 600.0
#: Imports of octex, of whole modules or of names in them.
_IMPORT = re.compile(r"^(?:from|import) (octex[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)

#: Code that a wheel brings along (`tools/wheels.py`), for every processor with these features: x86-64-v3.
SHIPPED = Path(__file__).parents[1] / "compiled"
PORTABLE = (
    "x86-64-v3",
    "+avx,+avx2,+bmi,+bmi2,+crc32,+cx16,+f16c,+fma,+fxsr,+lzcnt,+movbe,+popcnt,+sahf,+sse3,+sse4.1,+sse4.2,"
    "+ssse3,+xsave",
)


class CodeFiles:
    """The versions of one kernel on disk, in place of numba's ``IndexDataCacheFile``.

    ``stamp`` tells the state of the kernel's own file, as numba sees it.
    """

    def __init__(self, folder: str, function: Any, stamp: object = None) -> None:
        code, python = function.__code__, f"py{sys.version_info[0]}{sys.version_info[1]}"
        name = re.sub("[<>]", "", f"{function.__module__}.{function.__qualname__}")
        self._own = threading.local()
        self._folder = Path(folder)
        self._name = f"{name}-{code.co_firstlineno}.{python}{getattr(sys, 'abiflags', '')}"
        self._state = f"numba {numba.__version__}, {stamp!r}, {digest_behind(function.__module__)}"

    def _path(self, folder: Path, key: str) -> Path:
        return folder / f"{self._name}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.nbc"

    def load(self, key: Any) -> Any:
        """Return what is kept under a key of numba's; None if nothing is, or it is of another state."""
        found = self._load(self._folder, key)
        if found is None and _can_run_shipped(key):
            signature, (triple, *_), bytecode = key
            found = self._load(SHIPPED, (signature, (triple, *PORTABLE), bytecode))
        if found is None:
            begin()
            turns = getattr(self._own, "turns", None)
            if turns is not None and fcntl is not None:
                turns.append(_turn(self._path(self._folder, key_text(key))))
                found = self._load(self._folder, key)
        return found

    @contextmanager
    def turns(self) -> Iterator[None]:
        """While the block lasts, be alone in compiling what is not there, among processes.

        Functions wait for those that they call alone: no two processes wait for each other.
        """
        if hasattr(self._own, "turns"):
            yield
            return
        turns = self._own.turns = list[IO[bytes] | None]()
        try:
            yield
        finally:
            del self._own.turns
            for turn in filter(None, turns):
                with turn, suppress(OSError):
                    Path(turn.name).unlink(missing_ok=True)
                    fcntl.flock(turn, fcntl.LOCK_UN)  # also where a child of this process has the file open

    def _load(self, folder: Path, key: Any) -> Any:
        text = key_text(key)
        try:
            content = self._path(folder, text).read_bytes()
            # Damaged code would crash where it is run.
            if content[:_SIZE] == self._digest(text, content[_SIZE:]):
                return pickle.loads(content[_SIZE:])
        except (OSError, AttributeError, ImportError):
            pass  # not there, or of types that are no longer there
        return None

    def _digest(self, text: str, content: bytes) -> bytes:
        return hashlib.sha256(f"{self._state}\n{text}\n".encode() + content).digest()

    def save(self, key: Any, data: Any) -> None:
        """Keep something under a key; without room for it nothing is kept."""
        text = key_text(key)
        path = self._path(self._folder, text)
        unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex[:16]}")
        with WRITING, suppress(OSError):
            try:
                content = dumps(data)
                unfinished.write_bytes(self._digest(text, content) + content)
                unfinished.replace(path)
            finally:
                unfinished.unlink(missing_ok=True)

    def flush(self) -> None:
        """Remove all versions."""
        for path in self._folder.glob(f"{self._name}.*.nbc"):
            path.unlink(missing_ok=True)


def _turn(path: Path) -> IO[bytes] | None:
    """Wait while another process compiles a version; return the file that makes others wait for this one."""
    turn = None
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        turn = path.with_name(f"{path.name}.lock").open("wb")
        end = time.monotonic() + LONGEST
        while time.monotonic() < end:
            try:
                fcntl.flock(turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.02)
    return turn


def _can_run_shipped(key: Any) -> bool:
    """Tell whether this processor has all that the shipped code may use, and nobody asks for other code."""
    _, (_, _, features), _ = key
    return set(PORTABLE[1].split(",")) <= set(features.split(",")) and not numba.config.BOUNDSCHECK


def key_text(key: tuple[Any, tuple[str, ...], tuple[str, ...]]) -> str:
    """Return the same words for the same types, machine and bytecode."""
    signature, machine, bytecode = key
    return "\n".join([types_text(signature), *machine, *bytecode])


def types_text(signature: Any) -> str:
    """Return the names of the types of arguments."""
    return ", ".join(map(type_text, getattr(signature, "args", signature)))


def type_text(kind: Any) -> str:
    """Return the name of a type of arguments, those of named tuples with their modules."""
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    of = getattr(kind, "instance_class", tuple)
    return f"{of.__module__}:{of.__qualname__}({', '.join(map(type_text, kind.types))})"


def read_types(text: str) -> tuple[Any, ...]:
    """Return the types that some words of `type_text`, with commas between them, name.

    Raises AttributeError, ImportError or ValueError for what is no type.
    """
    found, start, depth = [], 0, 0
    for place, letter in enumerate(f"{text}," if text else ""):
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            found.append(_read_type(text[start:place].strip()))
            start = place + 1
    return tuple(found)


def _read_type(text: str) -> Any:
    name, _, inner = text.removesuffix(")").partition("(")
    if name == "array":
        dtype, dimensions, layout = inner.split(", ")
        return types.Array(_read_type(dtype), int(dimensions.removesuffix("d")), layout)
    if ":" in name:
        module, _, name = name.partition(":")
        of, within = getattr(import_module(module), name), read_types(inner)
        if len(getattr(of, "_fields", within)) != len(within):
            raise ValueError(f"{of} has not {len(within)} fields")
        return types.BaseTuple.from_types(within, None if of is tuple else of)
    return types.boolean if name == "bool" else getattr(types, name)


@cache
def digest_behind(module: str) -> str:
    """Tell this state of a module, and of all that it imports of octex, from any other."""
    digests = (_digest_of(name) for name in sorted(modules_behind(module)))
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def modules_behind(module: str) -> set[str]:
    """Return a module and those of octex that it imports, and so on."""
    found, waiting = {module}, [module]
    while waiting:
        new = _imports_of(waiting.pop()) - found
        found |= new
        waiting += new
    return found


@cache
def _imports_of(module: str) -> frozenset[str]:
    """Return the modules of octex that one imports at its top: what functions import, no kernel sees."""
    names = set()
    for package, listed in _IMPORT.findall(_source_of(module)):
        names |= {package, *(f"{package}.{name}" for name in re.findall(r"\w+", listed))}
    return frozenset(name for name in names if _source_of(name))


@cache
def _digest_of(module: str) -> str:
    return hashlib.sha256(f"{module}\n{_source_of(module)}".encode()).hexdigest()


@cache
def _source_of(module: str) -> str:
    """Return a module's text; nothing for what is not a module of octex."""
    path = Path(__file__).parents[2].joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return ""
