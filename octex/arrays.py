"""The types of arrays by element; large zeros in files; and counts of bits."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Callable
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from octex.errors import OutputError

Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]
Int8s = npt.NDArray[np.int8]
Int16s = npt.NDArray[np.int16]
Int32s = npt.NDArray[np.int32]
Int64s = npt.NDArray[np.int64]
Integers = npt.NDArray[np.integer[Any]]
Uint8s = npt.NDArray[np.uint8]
Uint16s = npt.NDArray[np.uint16]
Uint32s = npt.NDArray[np.uint32]
Uint64s = npt.NDArray[np.uint64]
Float32s = npt.NDArray[np.float32]
Float64s = npt.NDArray[np.float64]
Complex128s = npt.NDArray[np.complex128]
#: Of any precision.
Floats = npt.NDArray[np.floating[Any]]
#: Integers that stand for numbers from 0 to 1, or −1 to 1.
ChannelCodes = npt.NDArray[np.uint8 | np.uint16]
#: What channels store.
ChannelValues = npt.NDArray[np.uint8 | np.uint16 | np.float32]


def zeros(count: int, most_in_memory: int = 1 << 28) -> Uint8s:
    """Return zero bytes, above a limit in a temporary file; raises OutputError without room for it."""
    if count <= most_in_memory:
        return np.zeros(count, np.uint8)
    try:
        with tempfile.TemporaryFile() as file:
            return np.frombuffer(zeros_in(file, count), np.uint8)
    except OSError as error:
        raise OutputError(
            f"{tempfile.gettempdir()}: has no room for {count:,} bytes: {error.strerror or error}; make room"
        ) from error


def zeros_in(file: IO[bytes], count: int) -> mmap.mmap:
    """Extend a new file to ``count`` zeros and map it; writes to the map are writes to the file."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, count)  # a page without room would end the process
    else:
        file.truncate(count)
    return mmap.mmap(file.fileno(), count)


def in_runs(firsts: Integers, counts: Int64s) -> Int64s:
    """Return whole numbers in runs (n,): each run's first, and ``counts`` consecutive ones."""
    return np.repeat(firsts - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())


def _bit_counts(words: Integers) -> Uint8s:
    """Count the bits of unsigned integers by a table, for numpy 1, which has no ``bitwise_count``."""
    octets = np.ascontiguousarray(words).view(np.uint8).reshape(*words.shape, words.itemsize)
    counts: Uint8s = _BITS_OF_BYTES[octets].sum(axis=-1, dtype=np.uint8)
    return counts


_BITS_OF_BYTES = np.array([byte.bit_count() for byte in range(256)], np.uint8)
#: Counts the 1 bits of each unsigned integer.
bit_counts: Callable[[Integers], Uint8s] = getattr(np, "bitwise_count", _bit_counts)
