"""Large arrays, in memory or in mapped files, and tasks that return them in files.

Inside a ``scratch`` block what is made here lies in files of its folder, whose pages the system writes out
when memory is scarce. The same code runs on the same values either way. A file loses its name as soon as it
is mapped, so that its space is free when the array is.
"""

from __future__ import annotations

import errno
import mmap
import pickle
import secrets
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Int64s, zeros_in
from octex.errors import ArgumentError, OctexError, OutputError
from octex.files import scratch_folder

#: How often a task is given out again that its worker did not live to finish.
_ATTEMPTS = 3
#: A file of what was pickled: the arrays; the pickle and where they are, pickled; where that is, in 8 bytes.
_ALIGNED = 64
#: Rows that are taken at once.
_ROWS = 1 << 20
#: Errors of a folder that is full, or cannot be written to.
_NO_PLACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

_folder: ContextVar[Path | None] = ContextVar("scratch", default=None)


@contextmanager
def scratch(parent: Path) -> Iterator[Path]:
    """Have large arrays lie in files of a folder beside others until the end of the block.

    Raises OutputError if they have no place there.
    """
    try:
        with scratch_folder(parent) as folder:
            token = _folder.set(folder)
            try:
                yield folder
            finally:
                _folder.reset(token)
    except OSError as error:
        if error.errno not in _NO_PLACE:
            raise
        raise OutputError(
            f"{parent}: has no room for temporary files: {error.strerror}; make room or choose another"
        ) from error


def is_mapped() -> bool:
    """Say whether large arrays lie in files."""
    return _folder.get() is not None


def _new_path(folder: Path) -> Path:
    return folder / secrets.token_hex(8)


def empty(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Return an array that is still to be filled; in a file it is zeros."""
    folder, sizes = _folder.get(), shape if isinstance(shape, tuple) else (shape,)
    size = int(np.prod(sizes)) * np.dtype(dtype).itemsize
    if folder is None or not size:
        return np.empty(sizes, dtype)
    path = _new_path(folder)
    with path.open("x+b") as file:
        mapping = zeros_in(file, size)
    _forget(path)
    array: Array = np.frombuffer(mapping, dtype).reshape(sizes)
    return array


def _forget(path: Path) -> None:
    """Remove the name of a mapped file; where the system keeps it, it goes with the folder."""
    with suppress(OSError):
        path.unlink()


def zeros(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Return an array of zeros."""
    return empty(shape, dtype) if is_mapped() else np.zeros(shape, dtype)


def joined(arrays: Sequence[Array]) -> Array:
    """Lay arrays of alike rows end to end."""
    if not is_mapped():
        return np.concatenate(arrays)
    found = empty((sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
    return np.concatenate(arrays, out=found)


def taken(array: Array, rows: Int64s) -> Array:
    """Return some rows of an array."""
    if not is_mapped():
        return array[rows]
    found = empty((rows.size, *array.shape[1:]), array.dtype)
    for begin in range(0, rows.size, _ROWS):
        some = slice(begin, begin + _ROWS)
        found[some] = array[rows[some]]
    return found


def copied(array: Array) -> Array:
    """Return a copy of an array."""
    return joined([array])


def moved(given: Any) -> Any:
    """Return the same, with its arrays in a file inside a ``scratch`` block."""
    folder = _folder.get()
    if folder is None:
        return given
    path = _new_path(folder)
    _dump(given, path)
    found = _load(path)
    _forget(path)
    return found


def _dump(given: Any, path: Path) -> int:
    """Write anything to a file, whole or not at all; return its checksum."""
    checksum = 0
    places: list[tuple[int, int]] = []
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    with temporary.open("xb") as file:

        def put(content: bytes | memoryview) -> None:
            nonlocal checksum
            file.write(content)
            checksum = zlib.crc32(content, checksum)

        def put_array(buffer: pickle.PickleBuffer) -> None:
            raw = buffer.raw()
            places.append((file.tell(), raw.nbytes))
            put(raw)
            put(b"\0" * (-raw.nbytes % _ALIGNED))

        text = pickle.dumps(given, protocol=5, buffer_callback=put_array)
        begin = file.tell()
        put(pickle.dumps((text, places)))
        put(begin.to_bytes(8, "little"))
    temporary.replace(path)
    return checksum


def _load(path: str | Path, checksum: int | None = None) -> Any:
    """Read what was written to a file, whose arrays are views of it; raises OSError for another checksum."""
    with Path(path).open("rb") as file:
        mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    if checksum is not None and zlib.crc32(mapping) != checksum:
        raise OSError(f"{path} came damaged")
    text, places = pickle.loads(mapping[int.from_bytes(mapping[-8:], "little") : -8])
    whole = memoryview(mapping)
    return pickle.loads(text, buffers=[whole[begin : begin + size] for begin, size in places])


class Tasks(Executor):
    """Gives tasks to an executor; their results come back in files of a scratch folder.

    What is called is written there once, and read there once by each process; ``is_here`` says that the
    executor works in this process, and needs neither. A task whose worker ends is given out again, and done
    here in the end.
    """

    def __init__(self, executor: Executor, folder: Path, *, is_here: bool) -> None:
        self._executor, self._folder = executor, folder
        self.here = executor if is_here else None  # as `parallel.sharing` asks
        self._written: dict[int, tuple[Any, str]] = {}

    def submit(self, function: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Start a task."""
        if named:
            function = partial(function, **named)
        task = function if self.here else self._file_of(function)
        return _Task(lambda: self._start(task, given), partial(function, *given))

    def _file_of(self, function: Callable[..., Any]) -> str:
        """Return the file that a function is in."""
        if id(function) not in self._written:
            path = _new_path(self._folder)
            try:
                _dump(function, path)
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise ArgumentError(
                    f"the surface cannot be sent to workers: {error}; define its functions in a module"
                ) from error
            self._written[id(function)] = function, str(path)
        return self._written[id(function)][1]

    def _start(self, task: Callable[..., Any] | str, given: tuple[Any, ...]) -> Future[Any]:
        return self._executor.submit(_work, task, given, str(_new_path(self._folder)))


class _Task(Future[Any]):
    """A task that is given out; its result is read when it is asked for."""

    def __init__(self, start: Callable[[], Future[Any]], call: Callable[[], Any]) -> None:
        super().__init__()
        self._start, self._call = start, call
        self._given = self._begin()

    def _begin(self) -> Future[Any] | None:
        try:
            return self._start()
        except OctexError:
            raise
        except Exception:  # the executor is broken
            return None

    def result(self, timeout: float | None = None) -> Any:
        """Return what the task returns; raises what it raises."""
        for _ in range(_ATTEMPTS):
            if self._given is None:
                break
            try:
                path, checksum, error = self._given.result(timeout)
                found = None if error else _load(path, checksum)
            except (Exception, CancelledError):  # the worker's end, not the task's
                self._given = self._begin()
                continue
            if error is not None:
                raise error
            _forget(Path(path))
            return found
        return self._call()

    def cancel(self) -> bool:
        """Drop the task if it has not begun."""
        return self._given is not None and self._given.cancel()


@lru_cache(4)
def _read(path: str) -> Any:
    return _load(path)


def _work(
    task: Callable[..., Any] | str, given: tuple[Any, ...], place: str
) -> tuple[str, int, Exception | None]:
    """Do a task; return where its result is, and its checksum; or what it raises."""
    function = _read(task) if isinstance(task, str) else task
    try:
        found = function(*given)
    except Exception as error:
        return place, 0, error
    return place, _dump(found, Path(place)), None
