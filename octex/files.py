"""Files read whole and replaced whole: devices and pipes are refused, and no partial file remains.

Every unfinished file is registered here from before it exists until it is complete. A command that is asked
to end calls ``undo_all``; so do SIGTERM where it would end the process at once, and Python at its end.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import secrets
import shutil
import signal
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import FrameType
from typing import BinaryIO

from octex.errors import ModelError, OctexError, OutputError

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

#: The glTF extension by which a model carries its octree.
OCTREE_EXTENSION = "EXT_octree_texture"
#: The names of files that are being written, and of scratch folders.
_TEMPORARY = re.compile(r"\.octex-[0-9a-f]{16}")
#: The start of a Git LFS pointer.
_POINTER = b"version https://git-lfs."
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(://|::)")
#: Errors of a full disk, of a full share of it, and of a file that is too large for it.
_FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG

_undos: dict[object, Callable[[], None]] = {}


def is_address(path: object) -> bool:
    """Return whether a path is an address: ``protocol://…``, or protocols chained by ``::``."""
    return isinstance(path, str) and _ADDRESS.match(path) is not None


def open_file(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a file to read its bytes.

    Raises OSError, also for a pipe or a device, which may have no end, for an invalid name, and for a Git LFS
    pointer.
    """
    try:
        # Open a pipe without a writer at once; for files this changes nothing.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError as error:
        raise OSError(errno.EINVAL, f"it is not a valid file name ({error})", repr(path)) from None
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))
        file = os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise
    if file.peek(len(_POINTER)).startswith(_POINTER):
        file.close()
        raise OSError(errno.EINVAL, "it is a Git LFS pointer, not the file; run 'git lfs pull'", str(path))
    return file


def size_of(text: str) -> int:
    """Return the bytes of a text like 20MB, 800 kB, 2GiB or 5000; raises ValueError for other text."""
    units = {"": 1, "b": 1, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]*)\s*", text.lower())
    if match is None or match[2] not in units or not 1 <= float(match[1]) * units[match[2]] < 2**53:
        raise ValueError(f"{text!r} is not a size like 20MB")
    return int(float(match[1]) * units[match[2]])


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file; raises OSError as ``open_file`` does."""
    with open_file(path) as file:
        return file.read()


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise ModelError with the file's name where it cannot be read or does not fit into memory."""
    try:
        yield
    except OctexError:
        raise
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise ModelError(f"{path.name} does not fit into memory") from None


def is_absolute(path: str) -> bool:
    """Return whether a path is absolute, on this system or another."""
    windows = PureWindowsPath(path)
    return PurePosixPath(path).is_absolute() or bool(windows.drive or windows.root)


def referred(folder: Path, name: str) -> Path:
    """Return the path of a file named by one in ``folder``; raises OSError for an absolute path."""
    if is_absolute(name):
        raise OSError(
            errno.EINVAL, "absolute paths are not followed; name it from the referring file's folder"
        )
    return folder / name


@contextlib.contextmanager
def undone_on_failure(undo: Callable[[], None]) -> Iterator[None]:
    """Call ``undo``, at any time and perhaps twice, if the block fails or the process ends in it."""
    key = object()
    with _undone_by_sigterm():
        _undos[key] = undo
        try:
            yield
        except BaseException:
            undo()
            _undos.pop(key, None)
            raise
        _undos.pop(key, None)


@contextlib.contextmanager
def _undone_by_sigterm() -> Iterator[None]:
    """Let SIGTERM undo all before it ends the process; only the main thread can set this."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _end(number: int, _frame: FrameType | None) -> None:
    undo_all()
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)


def undo_all() -> None:
    """Undo all unfinished files, for a process that is about to end."""
    for undo in list(_undos.values()):
        with contextlib.suppress(Exception):
            undo()
    _undos.clear()


atexit.register(undo_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_undos.clear)  # they are the parent's


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a new file that replaces ``path`` at the end of the block, completely or not at all.

    Where the system allows, the new file has no name before it is complete, so that nothing remains of it
    however the process ends. Remains of killed processes in the folder are removed. Raises OutputError if
    anything cannot be written (also for an OSError of the block itself).
    """
    target = Path(path)
    try:
        real = Path(os.path.realpath(target))  # through links, so that a link stays one
    except ValueError as error:
        raise OutputError(f"{str(target)!r}: is not a valid file name ({error}); choose another") from error
    try:
        if real.is_symlink() or (real.exists() and not real.is_file()):  # a link still: it leads to itself
            raise OutputError(f"{target}: is not a file that can be replaced; choose another name")
        temporary = real.with_name(f".octex-{secrets.token_hex(8)}")
        with undone_on_failure(lambda: temporary.unlink(missing_ok=True)):
            nameless = _nameless_file(real.parent)
            with nameless or _named_file(temporary) as file:
                if nameless:
                    _lock(file)
                yield file
                file.flush()
                os.fsync(file.fileno())
                if nameless:
                    _name(file, temporary)
                if fcntl:  # a locked file is never removed as a remain
                    temporary.replace(real)
            if not fcntl:  # systems without these locks do not rename open files
                temporary.replace(real)
        _remove_leavings(real.parent)
    except OSError as error:
        reason, is_full = error.strerror or str(error), error.errno in _FULL
        what = "make room or choose another place" if is_full else "choose another place"
        raise OutputError(f"{target}: cannot be written: {reason}; {what}") from error


@contextlib.contextmanager
def scratch_folder(parent: Path | None = None) -> Iterator[Path]:
    """Make a folder that is removed, with its content, at the end of the block or of the process.

    It lies in ``parent``, by default where temporary files do. Remains of killed processes there are removed.
    """
    parent = parent or Path(tempfile.gettempdir())
    _remove_leavings(parent)
    folder = parent / f".octex-{secrets.token_hex(8)}"
    remove = partial(shutil.rmtree, folder, ignore_errors=True)
    with undone_on_failure(remove), contextlib.ExitStack() as held:
        folder.mkdir(mode=0o700)
        while fcntl:
            with contextlib.suppress(FileNotFoundError):
                _lock(held.enter_context(_opened(folder)))
            if folder.is_dir():
                break
            folder.mkdir(mode=0o700)  # it was removed before it was locked
        yield folder
        remove()


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    """Open a file or a folder, but no link, to lock it."""
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        yield number
    finally:
        os.close(number)


def _nameless_file(folder: Path) -> BinaryIO | None:
    """Open a new file that no folder lists; None where the system or the file system has none."""
    if hasattr(os, "O_TMPFILE") and Path("/proc/self/fd").is_dir():
        with contextlib.suppress(OSError):
            return os.fdopen(os.open(folder, os.O_TMPFILE | os.O_WRONLY, 0o666), "wb")
    return None


def _named_file(path: Path) -> BinaryIO:
    """Open a new locked file, and check that it is still the one at its path."""
    while True:
        file = path.open("xb")
        if _lock(file):
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    return file
            file.close()  # removed before it was locked
        else:
            return file


def _lock(file: BinaryIO | int) -> bool:
    """Lock a file or a folder as long as it is open; return whether the system can."""
    if not fcntl:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:  # some file systems have no locks
        return False
    return True


def _remove_leavings(folder: Path) -> None:
    """Remove unlocked unfinished files and scratch folders of killed processes."""
    if not fcntl:
        return
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if _TEMPORARY.fullmatch(path.name):
                with contextlib.suppress(OSError), _opened(path) as number:
                    fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    elif path.is_file():
                        path.unlink()


def _name(file: BinaryIO, path: Path) -> None:
    """Give a nameless file its name."""
    number = file.fileno()
    # Given a folder's number Python follows the link to the file; for an absolute path it means nothing else.
    os.link(f"/proc/self/fd/{number}", path, src_dir_fd=number, follow_symlinks=True)


def count_text(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def listing(names: Sequence[str], most: int = 5) -> str:
    """Return the first names, and the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(map(repr, names[:most])) or "none") + more


def bytes_text(number: int) -> str:
    """Return a number of bytes for a person."""
    if number < 1000:
        return f"{number} bytes"
    size, units = number / 1000, ["PB", "TB", "GB", "MB", "kB"]
    while size >= 999.5 and len(units) > 1:
        size /= 1000
        units.pop()
    return f"{size:.3g} {units[-1]}"
