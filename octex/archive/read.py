"""Read an archive: its directory, checked; then all is decoded, or what is asked for."""

from __future__ import annotations

import json
import math
import mmap
import os
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from octex.archive.coding import Coding, order_of, weights_of
from octex.archive.decode import Contents, DamagedError, Decoding, Fetch, Head, words_in
from octex.archive.entropy import decoded_numbers
from octex.archive.layout import (
    BLOCKS,
    FORMAT,
    FORMAT_VERSION,
    KEPT,
    MAGIC,
    PIECE,
    SPLIT,
    START,
    TREE,
)
from octex.archive.models import most_numbers
from octex.archive.models import read as read_models
from octex.arrays import Array, Int64s, Uint8s, zeros
from octex.container import without_duplicates
from octex.errors import ArgumentError, TextureFileError
from octex.files import open_file
from octex.tree.layout import MAX_CELLS, MAX_DEPTH

_DTYPES = {"uint8": 1, "uint16": 2, "float16": 2, "float32": 4}
_OTHERS = ("uint", "int", "float")
#: The longest head, in bytes of JSON.
_LONGEST_HEAD = 100_000_000
#: Numbers of models that a byte of their stream may say; those of an empty texture have about 1,000.
_MOST_OF_A_BYTE = 1 << 12


def _nothing(_ranges: Sequence[tuple[int, int]]) -> None:
    pass


def read(path: str | os.PathLike[str]) -> Contents:
    """Decode an archive into memory, or where it is large into a temporary file that is mapped.

    Every stream is checked by its checksum, and every count. Raises TextureFileError for a file that is
    missing, damaged, no archive, or of a newer version.
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size < START:
                raise DamagedError("is cut off; copy it again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return _decoded(content)
    except OSError as error:
        raise TextureFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (MemoryError, OverflowError):
        raise TextureFileError(f"{path}: needs more memory than there is") from None
    except (DamagedError, ArgumentError) as error:
        raise TextureFileError(f"{path}: {error}") from error


def _decoded(content: mmap.mmap) -> Contents:
    decoding = opened(content)
    decoding.decode_all()
    return decoding.contents


def opened(content: mmap.mmap, fetch: Fetch = _nothing) -> Decoding:
    """Read the directory of an archive; ``fetch`` is told which bytes are about to be read.

    Raises DamagedError for a directory that no archive has.
    """
    if len(content) < START:
        raise DamagedError("is cut off; copy it again")
    fetch([(0, START)])
    version, begin, text, model, records = _directory(content, fetch)
    try:
        head = _head(json.loads(text, object_pairs_hook=without_duplicates), version)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise DamagedError("its head is damaged; copy it again") from None
    _check_records(head, version, records.size)
    by_cell = int(version == 1)
    codings = {name: coding._replace(by_cell=by_cell) for name, _, coding, _ in head.channels}
    try:
        models = read_models(_numbers(model, codings, version), codings, version)
    except ValueError:
        raise DamagedError("its models are damaged; copy it again") from None
    return Decoding(content, fetch, begin, head, models, records, _room(head))


def _directory(content: mmap.mmap, fetch: Fetch) -> tuple[int, int, bytes, bytes, Int64s]:
    """Return the version, where the directory begins, the head's text, the models and the records."""
    first = content[:START]
    if first[:8] != MAGIC:
        raise DamagedError("is no archive of octex")
    version, length = np.frombuffer(first, "<u4", 2, 8).tolist()
    if zlib.crc32(first[:28]) != int.from_bytes(first[28:], "little"):
        raise DamagedError("its first bytes are damaged; copy it again")
    if not 1 <= version <= FORMAT_VERSION:
        raise DamagedError(f"has format version {version}, newer than this octex reads; update octex")
    begin = int.from_bytes(first[16:24], "little")
    if not START <= begin <= len(content) or begin + length != len(content) or length < 12:
        raise DamagedError(f"has {len(content)} bytes, which is not what it says: cut off; copy it again")
    fetch([(begin, len(content))])
    directory = content[begin:]
    if zlib.crc32(directory) != int.from_bytes(first[24:28], "little"):
        raise DamagedError("its directory is damaged; copy it again")
    lengths = np.frombuffer(directory, "<u4", 3).tolist()
    if 12 + sum(lengths) != length or lengths[1] < 4 or lengths[1] % 2 or lengths[2] % 4:
        raise DamagedError("its directory is damaged; copy it again")
    inflate = zlib.decompressobj()
    try:
        text = inflate.decompress(directory[12 : 12 + lengths[0]], _LONGEST_HEAD)
    except zlib.error:
        raise DamagedError("its head is damaged; copy it again") from None
    if not inflate.eof or inflate.unused_data:
        raise DamagedError("its head is damaged; copy it again")
    at = 12 + lengths[0]
    model = directory[at : at + lengths[1]]
    return version, begin, text, model, np.frombuffer(directory[at + lengths[1] :], "<u4").astype(np.int64)


def _numbers(model: bytes, codings: dict[str, Coding], version: int) -> Int64s:
    """Return the numbers of the models: how many there are, then their stream."""
    count = int.from_bytes(model[:4], "little")
    if count > min(most_numbers(codings, version), _MOST_OF_A_BYTE * len(model)):
        raise ValueError
    numbers = decoded_numbers(words_in(model[4:]), count)
    if numbers is None:
        raise ValueError
    return numbers


def _head(given: Any, version: int) -> Head:
    """Return the head; raises KeyError, TypeError or ValueError for one that no archive has."""
    if given["format"] != FORMAT:
        raise ValueError
    metadata = given["metadata"]
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise TypeError
    level_cells, level_nodes = _wholes(given["level_cells"]), _wholes(given["level_nodes"])
    _check_levels(level_cells, level_nodes)
    split_ends, kept_ends = (
        _ends(given[name], level_cells, version) for name in ("split_cells", "kept_nodes")
    )
    split_rows = _whole(given["split_rows"], int(level_cells[-1]) * 6)
    flags, area = (_whole(number, 255) for number in given["root"])
    channels = [_channel(each) for each in given["channels"]]
    others = [_other(each) for each in given["others"]]
    if len({name for name, *_ in channels}) < len(channels) or len({each[0] for each in others}) < len(
        others
    ):
        raise ValueError
    if any(name in (*TREE, *SPLIT, KEPT) for name, *_ in others):
        raise ValueError
    return Head(
        metadata,
        level_cells,
        level_nodes,
        split_ends,
        split_rows,
        kept_ends,
        (flags, area),
        channels,
        others,
    )


def _ends(given: Any, level_cells: Int64s, version: int) -> Int64s:
    """Return how many cells come before each level, of numbers by level; before version 3 of one for all."""
    counts = np.zeros(level_cells.size - 1, np.int64)
    if version < 3:
        counts[-1] = _whole(given, int(level_cells[-1]))
    else:
        counts[:] = _wholes(given)
        if (counts > np.diff(level_cells)).any():
            raise ValueError
    found: Int64s = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    return found


def _check_levels(cells: Int64s, nodes: Int64s) -> None:
    """Raise ValueError for levels that no tree has, whose blocks could not be told."""
    if not 2 <= cells.size <= MAX_DEPTH + 2 or nodes.size != cells.size or cells[0] or nodes[0]:
        raise ValueError
    own_cells, own_nodes = np.diff(cells), np.diff(nodes)
    is_empty = cells.size == 2 and own_nodes[0] == 1
    if (own_cells < 1).any() or own_cells[0] != 1 or (own_nodes > own_cells).any():
        raise ValueError
    if (own_cells[1:] > 8 * own_nodes[:-1]).any() or (own_nodes[:-1] < 1).any():
        raise ValueError
    if own_nodes[-1] != 0 and not is_empty:
        raise ValueError


def _channel(given: Any) -> tuple[str, np.dtype[Any], Coding, Uint8s]:
    name, dtype = _name(given["name"]), given["dtype"]
    size, components = _DTYPES[dtype], _whole(given["components"], 4)
    error, unit = _whole(given["max_error"], 65535), _whole(given["unit"], 32)
    root = np.frombuffer(bytes.fromhex(given["root"]), np.uint8)
    is_float = dtype.startswith("float")
    if components < 1 or root.size != components * size or (error and is_float) or error >= 1 << 8 * size:
        raise ValueError
    none = np.zeros(weights_of(components), np.int64)
    coding = Coding(order_of(components), size, int(is_float), error, unit, 0, none)
    return name, np.dtype(dtype), coding, root.reshape(components, size)


def _other(given: Any) -> tuple[str, np.dtype[Any], tuple[int, ...]]:
    shape = tuple(_whole(size, 1 << 40) for size in given["shape"])
    dtype = given["dtype"]
    if not isinstance(dtype, str) or not dtype.startswith(_OTHERS) or len(shape) > 8:
        raise ValueError
    found = np.dtype(dtype)
    if math.prod(size or 1 for size in shape) >= 1 << 40 or found.itemsize > 8 or found.kind not in "uif":
        raise ValueError
    return _name(given["name"]), found, shape


def _name(name: Any) -> str:
    if not isinstance(name, str) or not name or name != name.encode(errors="replace").decode():
        raise ValueError
    return name


def _whole(number: Any, most: int) -> int:
    if type(number) is not int or not 0 <= number <= most:
        raise ValueError
    return number


def _wholes(numbers: Any) -> Int64s:
    return np.array([_whole(number, MAX_CELLS) for number in numbers], np.int64)


def _check_records(head: Head, version: int, count: int) -> None:
    """Refuse a directory whose records are not as many as the head wants: what is decoded is bounded so."""
    channels = len(head.channels)
    nodes, size = head.level_nodes, BLOCKS[version]
    expected = sum(
        (int(nodes[level + 1]) - 1) // size - int(nodes[level]) // size + 1 for level in range(nodes.size - 2)
    ) * (2 + 2 * (2 + channels))
    expected += int((-(-np.diff(head.split_ends) // size)).sum()) * 2 * (1 + channels)
    expected += int((-(-np.diff(head.kept_ends) // size)).sum()) * 2 * channels
    expected += 2 * sum(-(-math.prod(shape) * dtype.itemsize // PIECE) for _, dtype, shape in head.others)
    if count != expected:
        raise DamagedError("its directory has not as many blocks as its head says; copy it again")


def _room(head: Head) -> dict[str, Array]:
    """Return tensors of zeros for all that will be decoded, in a render file's order."""
    n_cells, n_nodes = int(head.level_cells[-1]), int(head.level_nodes[-1])
    split_cells, kept_nodes = int(head.split_ends[-1]), int(head.kept_ends[-1])
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        TREE[0]: (np.uint64, (-(-n_nodes // 8), 3)),
        TREE[1]: (np.int64, head.level_cells.shape),
        TREE[2]: (np.int64, head.level_nodes.shape),
        TREE[3]: (np.uint8, (n_cells,)),
        TREE[4]: (np.uint8, (n_cells,)),
    }
    if split_cells:
        shapes[SPLIT[0]] = np.uint32, (split_cells,)
        shapes[SPLIT[1]] = np.uint8, (split_cells,)
        shapes[SPLIT[2]] = np.uint8, (head.split_rows,)
    if kept_nodes:
        shapes[KEPT] = np.uint32, (kept_nodes,)
    for name, dtype, coding, _ in head.channels:
        components = coding.order.size
        shapes[f"channels/{name}"] = dtype, (n_cells, components)
        if split_cells:
            shapes[f"split/channels/{name}"] = dtype, (head.split_rows, components)
        if kept_nodes:
            shapes[f"kept/channels/{name}"] = dtype, (kept_nodes, components)
    for name, dtype, shape in head.others:
        if name in shapes:  # of a channel
            raise DamagedError("its head is damaged; copy it again")
        shapes[name] = dtype, shape
    sizes = {key: np.dtype(dtype).itemsize * math.prod(shape) for key, (dtype, shape) in shapes.items()}
    content = zeros(sum(size + 63 & -64 for size in sizes.values()))
    tensors: dict[str, Array] = {}
    at = 0
    for key, (dtype, shape) in shapes.items():
        tensors[key] = content[at : at + sizes[key]].view(dtype).reshape(shape)
        at += sizes[key] + 63 & -64
    return tensors
