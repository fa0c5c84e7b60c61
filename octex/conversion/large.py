"""Arrays in files: large ones, tasks' results, and finished stages that later calls reuse.

Inside a ``scratch`` block large arrays lie in files of its folder, whose pages the system writes out when
memory is scarce. A file loses its name as soon as it is mapped, so that its space is freed with the array.

A stage's file is named after a digest of its inputs, so changed inputs have another file. Damaged files, and
those of other stages, are replaced.
"""

from __future__ import annotations

import errno
import hashlib
import mmap
import os
import pickle
import secrets
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

import octex
from octex import container
from octex.arrays import Array, Int64s, zeros_in
from octex.checks import as_path
from octex.errors import ArgumentError, OctexError, OutputError, TextureFileError
from octex.files import scratch_folder
from octex.texture import OctreeTexture, open_texture

Rows = TypeVar("Rows")

#: How often a task is started again after its worker died.
_ATTEMPTS = 3
#: A pickled file has its arrays, aligned; the pickle and their offsets, pickled; that offset in 8 bytes.
_ALIGNED = 64
#: Rows that are taken at once.
_ROWS = 1 << 20
#: Errors of a folder that is full or read-only.
_NO_PLACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

#: Version of the stored stages, in addition to that of octex.
_VERSION = 5

_folder: ContextVar[Path | None] = ContextVar("scratch", default=None)


@contextmanager
def scratch(parent: Path) -> Iterator[Path]:
    """Put large arrays into files of a new folder in ``parent`` until the end of the block.

    Raises OutputError without room for them.
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
    """Return an array without values; in a file it has zeros."""
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
    """Remove the name of a mapped file; where the system refuses, the folder's end removes it."""
    with suppress(OSError):
        path.unlink()


def zeros(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> Array:
    """Return an array of zeros."""
    return empty(shape, dtype) if is_mapped() else np.zeros(shape, dtype)


def joined(arrays: Sequence[Array]) -> Array:
    """Concatenate arrays."""
    if not is_mapped():
        return np.concatenate(arrays)
    whole = empty((sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
    return np.concatenate(arrays, out=whole)


def taken(array: Array, rows: Int64s) -> Array:
    """Return rows (n,) of an array."""
    if not is_mapped():
        return array.take(rows, axis=0)
    result = empty((rows.size, *array.shape[1:]), array.dtype)
    for begin in range(0, rows.size, _ROWS):
        block = slice(begin, begin + _ROWS)
        array.take(rows[block], axis=0, out=result[block], mode="clip")
    return result


def copied(array: Array) -> Array:
    """Return a copy of an array."""
    return joined([array])


def moved(content: Any) -> Any:
    """Return an equal object; inside a ``scratch`` block its arrays lie in a file, as do changes to them."""
    folder = _folder.get()
    if folder is None:
        return content
    path = _new_path(folder)
    _dump(content, path)
    copy = _load(path, access=mmap.ACCESS_WRITE)
    _forget(path)
    return copy


def _dump(content: Any, path: Path) -> int:
    """Write an object to a file, whole or not at all; return its checksum."""
    checksum = 0
    places: list[tuple[int, int]] = []
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    with temporary.open("xb") as file:

        def put(part: bytes | memoryview) -> None:
            nonlocal checksum
            file.write(part)
            checksum = zlib.crc32(part, checksum)

        def put_array(buffer: pickle.PickleBuffer) -> None:
            raw = buffer.raw()
            places.append((file.tell(), raw.nbytes))
            put(raw)
            put(b"\0" * (-raw.nbytes % _ALIGNED))

        text = pickle.dumps(content, protocol=5, buffer_callback=put_array)
        begin = file.tell()
        put(pickle.dumps((text, places)))
        put(begin.to_bytes(8, "little"))
    temporary.replace(path)
    return checksum


def _load(path: str | Path, checksum: int | None = None, access: int = mmap.ACCESS_COPY) -> Any:
    """Read an object, whose arrays are views of the file; raises OSError for another checksum."""
    with Path(path).open("r+b" if access == mmap.ACCESS_WRITE else "rb") as file:
        mapping = mmap.mmap(file.fileno(), 0, access=access)
    if checksum is not None and zlib.crc32(mapping) != checksum:
        raise OSError(f"{path} is damaged")
    text, places = pickle.loads(mapping[int.from_bytes(mapping[-8:], "little") : -8])
    whole = memoryview(mapping)
    return pickle.loads(text, buffers=[whole[begin : begin + size] for begin, size in places])


class Tasks(Executor):
    """Gives tasks to an executor, and takes their results from files of a scratch folder.

    A function is written there once, and each process reads it once, unless the executor's threads are in
    this process (``is_here``). A task whose worker dies is started again, and at last runs here.
    """

    def __init__(self, executor: Executor, folder: Path, *, is_here: bool) -> None:
        self._executor, self._folder = executor, folder
        self.here = executor if is_here else None  # as `parallel.sharing` asks
        self._written: dict[int, tuple[Any, str]] = {}

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Start a task."""
        if named:
            function = partial(function, **named)
        task = function if self.here else self._file_of(function)
        folder = self._folder
        return _Task(
            lambda: self._executor.submit(_work, task, arguments, str(_new_path(folder))),
            partial(function, *arguments),
        )

    def _file_of(self, function: Callable[..., Any]) -> str:
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


class _Task(Future[Any]):
    """A task of an executor; its result is read when it is asked for."""

    def __init__(self, start: Callable[[], Future[Any]], call: Callable[[], Any]) -> None:
        super().__init__()
        self._start, self._call = start, call
        self._started = self._begin()

    def _begin(self) -> Future[Any] | None:
        try:
            return self._start()
        except OctexError:
            raise
        except Exception:  # the executor is broken
            return None

    def result(self, timeout: float | None = None) -> Any:
        """Return the task's result, or raise its error."""
        for _ in range(_ATTEMPTS):
            if self._started is None:
                break
            try:
                path, checksum, error = self._started.result(timeout)
                result = None if error else _load(path, checksum)
            except (Exception, CancelledError):  # of the worker, not of the task
                self._started = self._begin()
                continue
            if error is not None:
                raise error
            _forget(Path(path))
            return result
        return self._call()

    def cancel(self) -> bool:
        """Drop the task if it has not begun."""
        return self._started is not None and self._started.cancel()


@lru_cache(4)
def _read(path: str) -> Any:
    return _load(path)


def _work(
    task: Callable[..., Any] | str, arguments: tuple[Any, ...], path: str
) -> tuple[str, int, Exception | None]:
    """Run a task, and write its result to a file; return the path and its checksum, or the task's error."""
    function = _read(task) if isinstance(task, str) else task
    try:
        result = function(*arguments)
    except Exception as error:
        return path, 0, error
    return path, _dump(result, Path(path)), None


class Stages(NamedTuple):
    """The stages in a folder whose inputs have the digest ``key``; without a folder nothing is stored."""

    folder: Path | None = None
    key: bytes = b""

    def of(self, parts: Callable[[], Sequence[Any]]) -> Stages:
        """Return the stages with additional inputs; see `digest_of`."""
        return self if self.folder is None else Stages(self.folder, digest_of(self.key, *parts()))

    def arrays(
        self,
        stage: str,
        make: Callable[[], Mapping[str, Array]],
        is_sound: Callable[[Mapping[str, Array]], bool] = lambda _: True,
    ) -> Mapping[str, Array]:
        """Return the arrays of a stage, made if missing or unsound; OutputError if they cannot be stored."""
        if self.folder is None:
            return make()
        name = f"{stage}-{self.key.hex()}"
        path = self.folder / f"{name[: len(stage) + 33]}.safetensors"
        for is_written in (False, True):
            if is_written:
                container.write(path, make(), {"stage": name})
            try:
                contents = container.read(path)
            except TextureFileError:
                continue
            if contents.metadata.get("stage") == name and is_sound(contents.tensors):
                container.read_ahead(contents.mapping)
                return contents.tensors
        raise OutputError(f"{path}: lost a file that was written there; choose another folder")

    def placed(self, arrays: Rows) -> Rows:
        """Return arrays of a stage, mapped from its file or stored by `moved`."""
        return arrays if self.folder is not None else moved(arrays)

    def texture(self, stage: str, make: Callable[[], OctreeTexture]) -> OctreeTexture:
        """Return the texture of a stage, mapped; made if missing."""
        if self.folder is None:
            return make()
        path = self.folder / f"{stage}-{self.key.hex()[:32]}.octex"
        try:
            return open_texture(path)
        except TextureFileError:
            make().save(path)
        return open_texture(path)


NOT_STORED = Stages()


def stages_in(folder: str | os.PathLike[str] | None) -> Stages:
    """Return the stages in a folder, which is created; raise OutputError if that fails."""
    if folder is None:
        return NOT_STORED
    path = as_path(folder, "resume")
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot store intermediate results: {error.strerror}; choose a folder"
        ) from error
    return Stages(path, digest_of(octex.__version__, _VERSION))


def digest_of(*parts: Any) -> bytes:
    """Return a digest of arrays, numbers, text, bytes and sequences of them."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape};".encode())
            digest.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
        elif isinstance(part, (tuple, list)):
            digest.update(b"(" + digest_of(*part))
        else:
            digest.update(f"{part!r};".encode())
    return digest.digest()
