"""Files at an address, fetched in blocks on demand, by fsspec.

A local file of the same length is mapped; blocks are fetched into it before they are read. It has no name and
ends with the process, or lies in a folder with a byte a block that marks fetched ones, for later processes.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any, BinaryIO

import numpy as np

from octex.arrays import Array, Int64s, Uint8s
from octex.errors import MissingExtraError, OutputError, TextureFileError

#: Bytes of a block.
BLOCK = 1 << 10
#: Most bytes of a request: the response is held in memory.
_MOST = 1 << 26
#: Entries of file systems that change with the file.
_STAMPS = "ETag", "etag", "Last-Modified", "LastModified", "last_modified", "mtime", "modified", "created"


class RemoteFile:
    """A file at an address, and its mapped local copy, of fetched blocks.

    ``cache`` is a folder for fetched blocks. Raises TextureFileError, with the address, for an unreachable
    file, here and when blocks are fetched; OutputError without room for them; MissingExtraError without
    fsspec, or a package that it needs for the protocol.
    """

    def __init__(self, address: str, cache: Path | None = None) -> None:
        self.address = address
        self._lock = RLock()
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise MissingExtraError.needed(f"{address}: to be read", "fsspec", "remote") from None
        try:
            self._files, self._path = url_to_fs(address)
        except ImportError as error:
            raise MissingExtraError(
                f"{address}: cannot be read: {error}; pip install 'octex[remote]' has what http needs"
            ) from None
        except Exception as error:
            raise self._failed(error) from error
        self.size, self._stamp = self._described()
        if len(self._stamp) == 1:  # a changed file would not be noticed
            cache = None
        self._folder = cache or tempfile.gettempdir()
        try:
            self._file, self._is_fetched = _local_file(cache, address, self._stamp, self.size)
        except OSError as error:
            raise self._full(error) from error
        self._checks_later, self._is_checked = False, True
        weakref.finalize(self, self._file.close)
        self.mapping = mmap.mmap(self._file.fileno(), self.size)
        self._first = np.frombuffer(self.mapping, np.uint8).ctypes.data

    @property
    def is_whole(self) -> bool:
        """Whether all blocks are fetched."""
        return bool(self._is_fetched.all())

    def fetch(self, ranges: Iterable[tuple[int, int]]) -> bool:
        """Fetch the missing blocks of ranges of bytes; return whether there were any."""
        with self._lock:
            is_wanted = np.zeros(self._is_fetched.size, np.bool_)
            for begin, end in ranges:
                is_wanted[begin // BLOCK : -(-end // BLOCK)] = True
            blocks = np.flatnonzero(is_wanted & (self._is_fetched == 0))
            if not blocks.size:
                return False
            for first in range(0, blocks.size, _MOST // BLOCK):
                batch = blocks[first : first + _MOST // BLOCK]
                parts = np.split(batch, np.flatnonzero(np.diff(batch) > 1) + 1)
                runs = np.array([(part[0], part[-1] + 1) for part in parts]) * BLOCK
                self._fetch(np.minimum(runs, self.size))
            self._is_checked = False
            if not self._checks_later:
                self._check_unchanged()
            return True

    @contextmanager
    def checked_once(self) -> Iterator[None]:
        """Check once, at the end of the block, whether the file changed while parts were fetched."""
        with self._lock:
            self._checks_later = True
            try:
                yield
            finally:
                self._checks_later = False
                if not self._is_checked:
                    self._check_unchanged()

    def fetch_all(self) -> None:
        """Fetch all missing blocks."""
        self.fetch([(0, self.size)])

    def holds(self, array: Array) -> bool:
        """Return whether an array is empty or a view of the mapping."""
        return not array.nbytes or 0 <= array.ctypes.data - self._first < self.size

    def _fetch(self, runs: Int64s) -> None:
        begins, ends = runs.T.tolist()
        try:
            contents = self._files.cat_ranges([self._path] * len(runs), begins, ends, on_error="raise")
        except Exception as error:
            self._check_unchanged()
            raise self._failed(error) from error
        for begin, end, part in zip(begins, ends, contents, strict=True):
            if len(part) > end - begin:
                raise TextureFileError(
                    f"{self.address}: its server does not answer requests for a part of a file (HTTP "
                    "ranges); copy the file and open that"
                )
            if len(part) < end - begin:
                self._check_unchanged()
                raise TextureFileError(
                    f"{self.address}: was cut off: bytes {begin} to {end} came as {len(part)}; open it again"
                )
        try:
            for begin, part in zip(begins, contents, strict=True):
                self._file.seek(begin)
                self._file.write(part)
            self._file.flush()
        except OSError as error:
            raise self._full(error) from error
        for begin, end in runs.tolist():
            self._is_fetched[begin // BLOCK : -(-end // BLOCK)] = 1

    def _described(self) -> tuple[int, tuple[str, ...]]:
        """Return the file's length, and its length and stamps, which change with the file."""
        try:
            self._files.invalidate_cache(self._path)
            info: dict[str, Any] = self._files.info(self._path)
        except Exception as error:
            raise self._failed(error) from error
        size = info.get("size")
        if info.get("type") == "directory" or not isinstance(size, int) or size <= 0:
            raise TextureFileError(
                f"{self.address}: has no known length; give the URL of an .octex or .octz file"
            )
        return size, (str(size), *(str(info[name]) for name in _STAMPS if info.get(name)))

    def _check_unchanged(self) -> None:
        """Raise TextureFileError if the file has changed: then all blocks are missing."""
        if self._described()[1] != self._stamp:
            self._is_fetched[:] = 0
            raise TextureFileError(f"{self.address}: changed after it was opened; open it again")
        self._is_checked = True

    def _full(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._folder}: the cache for {self.address} cannot be written: {error.strerror or error}; "
            "make room or choose another folder"
        )

    def _failed(self, error: Exception) -> TextureFileError:
        what = str(error) or type(error).__name__
        if isinstance(error, FileNotFoundError):
            what = _why_not_found(error, self.address)
        return TextureFileError(f"{self.address}: cannot be read: {what}")


def _why_not_found(error: FileNotFoundError, address: str) -> str:
    """Return the reason of an error; of HTTP, fsspec raises it for silent servers and refusals too."""
    cause = error.__cause__ if address.startswith("http") else None
    status = getattr(cause, "status", None)
    if status is not None and status not in (404, 410):
        return f"its server answers {status} {getattr(cause, 'message', '')}".rstrip()
    if status is None and cause is not None and not isinstance(cause, FileNotFoundError):
        return f"its server does not answer: {str(cause) or type(cause).__name__}"
    return f"there is no such file ({error})"


def _local_file(
    cache: Path | None, address: str, stamp: tuple[str, ...], size: int
) -> tuple[BinaryIO, Uint8s]:
    """Make the local file, or find it in the ``cache``; return it, and the marks of fetched blocks."""
    blocks = -(-size // BLOCK)
    if cache is None:
        nameless: Any = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  (it is kept open)
        nameless.truncate(size)
        return nameless, np.zeros(blocks, np.uint8)
    cache.mkdir(parents=True, exist_ok=True)
    name = hashlib.sha256(address.encode()).hexdigest()[:16]
    version = hashlib.sha256("\n".join(stamp).encode()).hexdigest()[:16]
    for old in cache.glob(f"{name}-*"):
        if not old.name.startswith(f"{name}-{version}."):
            old.unlink(missing_ok=True)
    opened: list[BinaryIO] = []
    is_new = False  # then no block is fetched, whatever its file marks
    for ending, length in (("part", size), ("blocks", blocks)):
        path = cache / f"{name}-{version}.{ending}"
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666), "r+b", 0)
        if is_new or path.stat().st_size != length:
            is_new = True
            file.truncate(0)
            file.truncate(length)
        opened.append(file)
    with opened[1] as flags:
        return opened[0], np.frombuffer(mmap.mmap(flags.fileno(), blocks), np.uint8)
