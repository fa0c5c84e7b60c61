"""Named arrays and strings in a file, and back: safetensors, readable from every language.

    8 bytes     the header's length N, little-endian
    N bytes     the header, JSON, padded with spaces so that the arrays begin at a multiple of 4096
    the rest    the arrays, without gaps, in order of falling item size: each is aligned to its items

Reading maps the file: arrays are views of it, and pages are loaded when they are touched.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import sys
from collections.abc import Mapping
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from octex.arrays import Array
from octex.errors import ArgumentError, TextureFileError
from octex.files import open_file, replacing

#: safetensors' names of the types that octex reads and writes.
_DTYPES = {
    "U8": "uint8", "U16": "uint16", "U32": "uint32", "U64": "uint64",
    "I8": "int8", "I16": "int16", "I32": "int32", "I64": "int64",
    "F16": "float16", "F32": "float32", "F64": "float64",
}  # fmt: skip
_NAMES = {name: code for code, name in _DTYPES.items()}
_PAGE = 4096
_LONGEST_HEADER = 100_000_000  # safetensors' own limit
_NO_HEADER = (
    "is not an octree texture file (it does not begin with a safetensors header); octex convert makes one"
)
_METADATA = "__metadata__"


class Contents(NamedTuple):
    """The content of a file."""

    tensors: dict[str, Array]  # views, in the file's order; writable, but never written to the file
    metadata: dict[str, str]
    mapping: mmap.mmap


def header(tensors: Mapping[str, Array], metadata: Mapping[str, str]) -> bytes:
    """Return the bytes before the arrays; raises ArgumentError for bad names, types and metadata."""
    entries: dict[str, Any] = {_METADATA: dict(metadata)}
    if not all(isinstance(text, str) for pair in metadata.items() for text in pair):
        raise ArgumentError("metadata must map strings to strings")
    offset = 0
    for name, array in _in_file_order(tensors):
        if not name or name == _METADATA:
            raise ArgumentError(f"a tensor cannot have the name {name!r}")
        if array.dtype.name not in _NAMES:
            raise ArgumentError(f"tensor {name!r}: a file cannot hold {array.dtype}")
        entries[name] = {
            "dtype": _NAMES[array.dtype.name],
            "shape": list(array.shape),
            "data_offsets": [offset, offset + array.nbytes],
        }
        offset += array.nbytes
    # File names need not be valid text; invalid parts become question marks.
    text = json.dumps(entries, ensure_ascii=False, separators=(",", ":")).encode("utf-8", "replace")
    length = -(-(8 + len(text)) // _PAGE) * _PAGE - 8
    return length.to_bytes(8, "little") + text.ljust(length)


def _in_file_order(tensors: Mapping[str, Array]) -> list[tuple[str, Array]]:
    return sorted(tensors.items(), key=lambda item: -item[1].dtype.itemsize)


def write(path: str | os.PathLike[str], tensors: Mapping[str, Array], metadata: Mapping[str, str]) -> None:
    """Write arrays and strings to ``path``; the same input gives the same bytes.

    Raises ArgumentError like ``header``, and OutputError if the file cannot be written: the old file at
    ``path`` is then unchanged.
    """
    first = header(tensors, metadata)
    with replacing(path) as file:
        file.write(first)
        for _, array in _in_file_order(tensors):
            if array.size:
                little_endian = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
                file.write(little_endian.reshape(-1).view(np.uint8).data)


def read(path: str | os.PathLike[str]) -> Contents:
    """Map a file and read its header; raises TextureFileError for a missing or damaged one."""
    try:
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size < 8:
                raise TextureFileError(f"{path}: {_NO_HEADER}")
            mapping = _mapped(file)
    except OSError as error:
        raise TextureFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    return read_mapped(mapping, str(path))


def read_mapped(mapping: mmap.mmap, name: str) -> Contents:
    """Read the header of a mapped file; ``name`` is for errors, which are as in ``read``."""
    size, begin = len(mapping), header_length(mapping)
    try:
        if size < 8 or not 2 <= begin - 8 <= _LONGEST_HEADER:
            raise TextureFileError(_NO_HEADER)
        if begin > size:
            raise TextureFileError(f"is cut off inside its header ({size} bytes); copy or make it again")
        entries, metadata, end = described(mapping[8:begin], begin)
        if end != size:
            raise TextureFileError(
                f"has {size} bytes, but its header describes {end}: cut off or damaged; copy or make it again"
            )
    except TextureFileError as error:
        raise TextureFileError(f"{name}: {error}") from error
    return Contents({name: view(mapping, entry) for name, entry in entries.items()}, metadata, mapping)


class Entry(NamedTuple):
    """An array's place in a file."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int


def described(text: bytes, begin: int = 0) -> tuple[dict[str, Entry], dict[str, str], int]:
    """Return a header's tensors, metadata and end, or raise TextureFileError if it is damaged."""
    try:
        entries = json.loads(text, object_pairs_hook=without_duplicates)
    except (ValueError, RecursionError) as error:
        raise TextureFileError(
            f"its header is not JSON ({error}): another type of file, or damaged"
        ) from error
    metadata = entries.pop(_METADATA, {}) if isinstance(entries, dict) else None
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise TextureFileError("its header is damaged: the metadata are not strings")
    tensors: dict[str, Entry] = {}
    end = 0
    checked = [(name, *_checked_entry(name, entry)) for name, entry in entries.items()]
    for name, dtype, shape, first, last in sorted(checked, key=lambda entry: entry[3:]):
        if first != end or last - first != math.prod(shape) * dtype.itemsize:
            raise TextureFileError(f"its header is damaged: the bytes of {name!r} do not fit its shape")
        tensors[name] = Entry(dtype, shape, begin + first)
        end = last
    return tensors, metadata, begin + end


def without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object, as ``object_pairs_hook``; raises ValueError for a duplicate name."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise ValueError("a name twice")
    return entries


def _checked_entry(name: str, entry: Any) -> tuple[np.dtype[Any], tuple[int, ...], int, int]:
    """Return the type, shape, first and last byte of a tensor that numpy can hold."""
    if not name or name != name.encode(errors="replace").decode():
        raise TextureFileError(f"its header is damaged: a tensor cannot have the name {name!r}")
    if not isinstance(entry, dict) or not {"dtype", "shape", "data_offsets"} <= entry.keys():
        raise TextureFileError(f"its header is damaged: {name!r} lacks its dtype, shape or data_offsets")
    dtype, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(dtype, str) or dtype not in _DTYPES:
        raise TextureFileError(f"{name!r} has the dtype {dtype!r}, which octex does not read")
    is_shape = _is_whole(shape) and len(shape) <= 8 and math.prod(size or 1 for size in shape) < 2**48
    if not is_shape or not _is_whole(offsets) or len(offsets) != 2:
        raise TextureFileError(f"its header is damaged: {name!r} has impossible shape or data_offsets")
    return np.dtype(_DTYPES[dtype]).newbyteorder("<"), tuple(shape), offsets[0], offsets[1]


def _is_whole(numbers: Any) -> bool:
    return isinstance(numbers, list) and all(type(n) is int and 0 <= n < 2**48 for n in numbers)


def _mapped(file: BinaryIO) -> mmap.mmap:
    if sys.platform == "win32":
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    # Private pages are writable, which keeps one type of array in the kernels; where nothing is reserved for
    # them, a file may be larger than memory.
    no_reserve = getattr(mmap, "MAP_NORESERVE", 0)  # from Python 3.13 on
    mapping = mmap.mmap(
        file.fileno(), 0, flags=mmap.MAP_PRIVATE | no_reserve, prot=mmap.PROT_READ | mmap.PROT_WRITE
    )
    # A coarse look then loads single pages; reading ahead pulled in 160 MB for 20 bytes.
    mapping.madvise(mmap.MADV_RANDOM)
    return mapping


def header_length(mapping: mmap.mmap) -> int:
    """Return the number of bytes of a mapped file before the arrays."""
    return 8 + int.from_bytes(mapping[:8], "little")


def read_ahead(mapping: mmap.mmap) -> None:
    """Prepare to read most of a mapped file, where the system takes such advice."""
    if sys.platform != "win32":
        mapping.madvise(mmap.MADV_NORMAL)


def view(content: mmap.mmap | Array, entry: Entry) -> Array:
    """Return an array of a file's content; a copy where it is not aligned."""
    count = math.prod(entry.shape)
    if count == 0:
        return np.empty(entry.shape, entry.dtype)
    array = np.frombuffer(content, entry.dtype, count, entry.offset).reshape(entry.shape)
    # Files by others need not align their arrays.
    return array if array.flags.aligned else array.copy()
