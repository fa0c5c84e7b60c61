"""The cache of compiled kernels on disk.

Each state of a module has a folder, named after a digest of its source and of all octex modules that it
imports: code never outlives its source. The folder has numba's files and their checksums, since numba would
load a damaged file and crash. While a file is written its folder is locked: processes that add versions at
the same time would corrupt numba's index.
"""

from __future__ import annotations

import gc
import hashlib
import os
import re
import shutil
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: Code that comes with a wheel (`tools/release/wheels.py`) for commands (`octex.ahead`).
SHIPPED = Path(__file__).parents[1] / "compiled"
#: Objects after which Python collects garbage while numba compiles: with the usual 700 this takes a tenth of
#: the time, and another thread could free code that LLVM is reading.
MANY_OBJECTS = 100_000
#: Bytes free on a disk, below which nothing is written: numba fails where a file does not fit.
ROOM = 1 << 26
#: Imports of octex, of whole modules or of names in them.
_IMPORT = re.compile(r"^(?:from|import) (octex[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)
#: The file of checksums, and the files that it covers.
_SUMS, _FILES = "checksums", "*.nb[ci]"
#: Held while a file is unfinished.
WRITING = threading.RLock()
_lock = threading.Lock()
_checked: set[Path] = set()


def cached(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return a function compiled by numba with ``options``, cached on disk where a folder is writable."""
    with _lock:
        folder = _folder_of(function.__module__)
        if not _has_room(folder):  # each process compiles
            return numba.njit(**options)(function)
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(folder)
        try:
            compiled = numba.njit(cache=True, **options)(function)
        except (OSError, RuntimeError):  # of source that lies in no file
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = before
        with suppress(OSError):
            _check(folder, Path(compiled.stats.cache_path))
    return compiled


@cache
def _folder_of(module: str) -> Path:
    """Return the folder of this state of a module; removes those of other states in the default folder."""
    in_tree = Path(__file__).parents[1] / "__pycache__"
    root = Path(numba.config.CACHE_DIR) if numba.config.CACHE_DIR else in_tree
    if root == in_tree and not _has_room(root):
        root = _user_folder()
    state = f"{numba.__version__} {numba.config.BOUNDSCHECK} {digest_behind(module)}"
    folder = root / f"{module}.{hashlib.sha256(state.encode()).hexdigest()[:16]}"
    for other in root.glob(f"{module}.{'?' * 16}") if root == in_tree else ():
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    return folder


@cache
def _has_room(folder: Path) -> bool:
    """Return whether files can be put into a folder."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        return os.access(folder, os.W_OK) and shutil.disk_usage(folder).free > ROOM
    return False


def _user_folder() -> Path:
    """Return the operating system's cache folder of a user."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "octex" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "octex"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "octex"


def _check(folder: Path, path: Path) -> None:
    """Remove damaged files from numba's folder ``path``; copy a wheel's files, or those of a moved octex."""
    if path in _checked:
        return
    _checked.add(path)
    with _locked(path):
        if not (path / _SUMS).exists():
            others = [*(SHIPPED / folder.name).glob("*/*"), *folder.glob("*/*")]
            for other in others:
                if other.parent != path:
                    shutil.copyfile(other, path / other.name)
        sums = _read_sums(path)
        for file in sorted(path.glob(_FILES)):
            if sums.get(file.name) != zlib.crc32(file.read_bytes()):
                file.unlink()


def _read_sums(path: Path) -> dict[str, int]:
    try:
        lines = [line.split(" ", 1) for line in (path / _SUMS).read_text().splitlines()]
        return {name: int(number) for number, name in lines}
    except (OSError, ValueError):  # none yet, or damaged
        return {}


def _write_sums(path: Path) -> None:
    lines = [f"{zlib.crc32(file.read_bytes())} {file.name}" for file in sorted(path.glob(_FILES))]
    new = path / f"{_SUMS}.{os.getpid()}"
    new.write_text("\n".join(lines))
    new.replace(path / _SUMS)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a folder for writing."""
    with WRITING, (path / "lock").open("wb") as file:
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


class _Saving(event.Listener):  # type: ignore[misc]
    """Lock a folder while numba saves a compiled function, and write checksums.

    numba reports when it compiles, and when it takes and releases its lock. It saves a function before the
    first release after compiling it.
    """

    def __init__(self) -> None:
        self._own = threading.local()
        self._lock = threading.Lock()
        self._waiting = 0  # threads that compile, or wait to
        self._usual: tuple[int, ...] = ()  # Python's thresholds while none does

    def on_start(self, happened: Any) -> None:
        """Make Python collect less garbage."""
        if happened.kind == "numba:compiler_lock":
            with self._lock:
                if self._waiting == 0:
                    self._usual = gc.get_threshold()
                    gc.set_threshold(max(self._usual[0], MANY_OBJECTS) if self._usual[0] else 0)
                self._waiting += 1

    def on_end(self, happened: Any) -> None:
        """Lock the folder of a compiled function; unlock it when that is saved."""
        if happened.kind == "numba:compile":
            path = happened.data["dispatcher"].stats.cache_path
            if path is not None and Path(path) in _checked:
                self._own.held, self._own.path = ExitStack(), Path(path)
                with suppress(OSError):
                    self._own.held.enter_context(_locked(Path(path)))
            return
        if getattr(self._own, "held", None) is not None:
            with suppress(OSError):
                _write_sums(self._own.path)
            self._own.held.close()
            self._own.held = None
        with self._lock:
            self._waiting -= 1
            if self._waiting == 0:
                gc.set_threshold(*self._usual)


_SAVING = _Saving()
for _kind in ("numba:compile", "numba:compiler_lock"):
    event.register(_kind, _SAVING)


@cache
def digest_behind(module: str) -> str:
    """Return a digest of a module and of all octex modules that it imports."""
    digests = (_digest_of(name) for name in sorted(modules_behind(module)))
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def modules_behind(module: str) -> set[str]:
    """Return a module and all octex modules that it imports, directly or not."""
    modules, waiting = {module}, [module]
    while waiting:
        new = _imports_of(waiting.pop()) - modules
        modules |= new
        waiting += new
    return modules


@cache
def _imports_of(module: str) -> frozenset[str]:
    """Return the octex modules that a module imports at its top: kernels see no others."""
    names = set()
    for package, listed in _IMPORT.findall(_source_of(module)):
        names |= {package, *(f"{package}.{name}" for name in re.findall(r"\w+", listed))}
    return frozenset(name for name in names if _source_of(name))


@cache
def _digest_of(module: str) -> str:
    return hashlib.sha256(f"{module}\n{_source_of(module)}".encode()).hexdigest()


@cache
def _source_of(module: str) -> str:
    """Return a module's text; empty for modules outside octex."""
    path = Path(__file__).parents[2].joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return ""
