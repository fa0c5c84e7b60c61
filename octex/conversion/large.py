"""Large arrays, in memory or in mapped files, and tasks that pass files, not arrays.

Inside a ``Scratch`` block what is made here lies in files of its folder, whose pages the system writes out
when memory is scarce. The same code runs on the same values either way.

What is passed through a file is pickled, its arrays as they are; arrays that lie in files of a scratch folder
already are named, not copied.
"""

from __future__ import annotations

import errno
import io
import mmap
import os
import pickle
import secrets
import weakref
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Int64s, zeros_in
from octex.errors import ArgumentError, OctexError, OutputError
from octex.files import scratch_folder

#: How often a task is given out again that its worker did not live to finish.
_ATTEMPTS = 3
#: A file of what was pickled: the arrays; the pickle; where they are, pickled; and where that is, in 8 bytes.
_ALIGNED = 64
#: Rows that are taken at once.
_ROWS = 1 << 20
#: Errors of a folder that is full, or cannot be written to.
_NO_PLACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}


class _File(NamedTuple):
    address: int
    size: int
    mapping: weakref.ref[mmap.mmap]


class Scratch:
    """A folder for large arrays. The file of an array goes with it, unless a task names the file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[Path, _File] = {}
        self._named: dict[Path, mmap.mmap] = {}
        self._process = os.getpid()

    def new_path(self) -> Path:
        """Return the path of a file that is not there yet."""
        return self.folder / secrets.token_hex(8)

    def empty(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Array:
        """Return an array of zeros in a file of its own."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not size:
            return np.empty(shape, dtype)
        path = self.new_path()
        with path.open("x+b") as file:
            mapping = zeros_in(file, size)
        array: Array = np.frombuffer(mapping, dtype).reshape(shape)
        self._files[path] = _File(array.ctypes.data, size, weakref.ref(mapping))
        weakref.finalize(mapping, self._free, path)
        return array

    def _free(self, path: Path) -> None:
        del self._files[path]
        if os.getpid() == self._process:  # not a fork of it
            with suppress(OSError):
                path.unlink()

    def flush(self) -> None:
        """Write out what other machines are about to read."""
        for file in list(self._files.values()):
            mapping = file.mapping()
            if mapping is not None:
                mapping.flush()

    def place_of(self, array: Array) -> tuple[str, int] | None:
        """Return the file that an array lies in, and where there; None for an array in memory.

        The file then stays until the scratch folder goes.
        """
        address = array.ctypes.data
        for path, file in list(self._files.items()):
            mapping = file.mapping()
            if mapping is not None and 0 <= address - file.address < file.size:
                self._named[path] = mapping
                return str(path), address - file.address
        return None


_current: ContextVar[Scratch | None] = ContextVar("scratch", default=None)


@contextmanager
def scratch(parent: Path) -> Iterator[Scratch]:
    """Have large arrays lie in files of a folder beside others until the end of the block.

    Raises OutputError if they have no place there.
    """
    try:
        with scratch_folder(parent) as folder:
            made = Scratch(folder)
            token = _current.set(made)
            try:
                yield made
            finally:
                _current.reset(token)
    except OSError as error:
        if error.errno not in _NO_PLACE:
            raise
        raise OutputError(
            f"{parent}: has no place for large arrays: {error.strerror}; make room or choose another"
        ) from error


def is_mapped() -> bool:
    """Say whether large arrays lie in files."""
    return _current.get() is not None


def empty(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Return an array that is still to be filled."""
    here = _current.get()
    sizes = shape if isinstance(shape, tuple) else (shape,)
    return np.empty(sizes, dtype) if here is None else here.empty(sizes, dtype)


def zeros(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Return an array of zeros."""
    return np.zeros(shape, dtype) if _current.get() is None else empty(shape, dtype)


def joined(arrays: Sequence[Array]) -> Array:
    """Lay arrays of alike rows end to end."""
    if _current.get() is None:
        return np.concatenate(arrays)
    found = empty((sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
    begin = 0
    for array in arrays:
        found[begin : begin + len(array)] = array
        begin += len(array)
    return found


def taken(array: Array, rows: Int64s) -> Array:
    """Return some rows of an array."""
    if _current.get() is None:
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
    here = _current.get()
    if here is None:
        return given
    path = here.new_path()
    _dump(given, path, here, is_checked=False)
    found = _load(path)
    with suppress(OSError):
        path.unlink()
    return found


class _Pickler(pickle.Pickler):
    """Names arrays that lie in files."""

    def __init__(self, file: Any, scratch: Scratch, take: Callable[[pickle.PickleBuffer], Any]) -> None:
        super().__init__(file, protocol=5, buffer_callback=take)
        self._scratch = scratch

    def reducer_override(self, given: Any) -> Any:
        if type(given) is np.ndarray and given.nbytes and given.flags.c_contiguous:
            place = self._scratch.place_of(given)
            if place is not None:
                return _array_in, (*place, given.shape, given.dtype.str)
        return NotImplemented


@lru_cache(64)
def _mapped(path: str) -> mmap.mmap:
    with Path(path).open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)


def _array_in(path: str, offset: int, shape: tuple[int, ...], dtype: str) -> Array:
    return np.frombuffer(_mapped(path), dtype, int(np.prod(shape)), offset).reshape(shape)


def _dump(given: Any, path: Path, scratch: Scratch, *, is_checked: bool = True) -> int:
    """Write anything to a file, whole or not at all; return the checksum, 0 for what is not checked."""
    checksum = 0
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    with temporary.open("xb") as file:
        places: list[tuple[int, int]] = []

        def put(content: Any) -> None:
            nonlocal checksum
            file.write(content)
            checksum = zlib.crc32(content, checksum) if is_checked else 0

        def take(buffer: pickle.PickleBuffer) -> None:
            raw = buffer.raw()
            places.append((file.tell(), raw.nbytes))
            put(raw)
            put(b"\0" * (-raw.nbytes % _ALIGNED))

        text = io.BytesIO()
        _Pickler(text, scratch, take).dump(given)
        begin = file.tell()
        put(pickle.dumps((text.getvalue(), places)))
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
    """Gives tasks to an executor as the names of files, in which their results come back.

    What is called is written to the scratch folder once, and read there once by each process; ``is_here``
    says that the executor works in this process, and needs neither. A task whose worker ends is given out
    again, and done here in the end.
    """

    def __init__(self, executor: Executor, scratch: Scratch, *, is_here: bool) -> None:
        self._executor, self._scratch, self._is_here = executor, scratch, is_here
        self.here = executor if is_here else None  # as `parallel.sharing` asks
        self._written: dict[int, tuple[Any, str]] = {}

    def submit(self, function: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Start a task."""
        if named:
            function = partial(function, **named)
        return _Task(self._start, partial(function, *given), self._task(function), given)

    def _task(self, function: Callable[..., Any]) -> Callable[..., Any] | str:
        """Return what is called: itself, or the file that it is in."""
        if self._is_here:
            return function
        if id(function) not in self._written:
            path = self._scratch.new_path()
            self._scratch.flush()
            try:
                _dump(function, path, self._scratch)
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise ArgumentError(
                    f"the surface cannot be sent to workers: {error}; define its functions in a module"
                ) from error
            self._written[id(function)] = function, str(path)
        return self._written[id(function)][1]

    def _start(self, task: Callable[..., Any] | str, given: tuple[Any, ...]) -> Future[Any]:
        place = str(self._scratch.new_path())
        return self._executor.submit(_work, task, given, place, self._scratch if self._is_here else None)


class _Task(Future[Any]):
    """A task that is given out; its result is read when it is asked for."""

    def __init__(self, start: Callable[..., Future[Any]], call: Callable[[], Any], *task: Any) -> None:
        super().__init__()
        self._again, self._call = partial(start, *task), call
        self._given: Future[Any] | None = self._begin()

    def _begin(self) -> Future[Any] | None:
        try:
            return self._again()
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
            with suppress(OSError):
                Path(path).unlink()
            return found
        return self._call()

    def cancel(self) -> bool:
        """Drop the task if it has not begun."""
        return self._given is not None and self._given.cancel()


@lru_cache(4)
def _read(path: str) -> Any:
    return _load(path)


def _work(
    task: Callable[..., Any] | str, given: tuple[Any, ...], place: str, here: Scratch | None
) -> tuple[str, int, Exception | None]:
    """Do a task; return where its result is, and its checksum; or what it raises."""
    function = _read(task) if isinstance(task, str) else task
    try:
        found = function(*given)
    except Exception as error:
        return place, 0, error
    return place, _dump(found, Path(place), here or Scratch(Path(place).parent)), None
