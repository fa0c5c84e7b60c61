"""Reads the arrays of an .npz file; checks its declared sizes before it takes memory."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Container
from typing import IO

import numpy as np

from octex.arrays import Array

#: What a byte of a file may become: deflate makes 1032 of one at most.
_MOST_OF_A_BYTE = 1100
_LONGEST_HEADER = 10_000  # numpy's own limit
_KINDS = "biufUS"


def read_npz(file: IO[bytes], names: Container[str] | None = None) -> dict[str, Array]:
    """Return the arrays of an .npz file, by default all: of numbers or texts, not of objects.

    Takes at most about 1100 times the file's bytes. Raises ValueError, with the reason, for a damaged file,
    and OSError where it cannot be read.
    """
    size = file.seek(0, io.SEEK_END)
    try:
        with zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if sum(info.file_size for info in members.values()) > _MOST_OF_A_BYTE * size:
                raise ValueError("its arrays are larger than the file can hold")
            return {
                name: _read_array(archive, info)
                for name, info in members.items()
                if info.filename.endswith(".npy") and (names is None or name in names)
            }
    except OSError:
        raise
    except Exception as error:  # zipfile, zlib, tokenize have errors of their own
        raise ValueError(str(error) or type(error).__name__) from None


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Array:
    with archive.open(info) as member:
        content = bytearray(member.read())  # with room to write: kernels know arrays of one kind
    head = io.BytesIO(content[: 2 * _LONGEST_HEADER])
    version = np.lib.format.read_magic(head)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"{info.filename} is of version {version}")
    shape, is_fortran, dtype = read[version](head, max_header_size=_LONGEST_HEADER)
    if dtype.kind not in _KINDS or not dtype.itemsize:
        raise ValueError(f"{info.filename} has the type {dtype}; save numbers or text")
    if any(type(length) is not int or length < 0 for length in shape):
        raise ValueError(f"{info.filename} has no shape")
    count, rest = 1, len(content) - head.tell()
    for length in shape:
        count *= length
    if count * dtype.itemsize != rest:
        raise ValueError(f"{info.filename} has {rest} bytes, not {shape} of {dtype}")
    array = np.frombuffer(content, dtype, count, head.tell()) if count else np.empty(0, dtype)
    return array.reshape(shape, order="F" if is_fortran else "C")
