"""Small files of octex, and what damages them: blindly, or knowing what stands where.

A way takes the parts of a file that is sound, and chance, and returns the bytes of one that is not, with
what of it was changed. Checksums are made right again, but where they are what is changed.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from octex.archive.layout import MAGIC, START, Place, channels_in, pieces_of, runs
from octex.archive.write import packed
from octex.channels import ChannelFormat
from octex.texture import Channel, OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.strategies import random_values, with_random_data

#: The bytes of a damaged file, and what was changed.
Damaged = tuple[bytes, str]
EDGES = (0, 1, 7, 255, 2**31 - 1, 2**32 - 1, 2**32, 2**48, 2**63 - 1, 2**64 - 1)
CHANNELS = ("base_color", "alpha", "height")
#: What comes of reading a file that was damaged before.
UNREADABLE = (ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError, RecursionError)
UNREADABLE += (struct.error, zlib.error, lzma.LZMAError)


def made(seed: int) -> OctreeTexture:
    """Make a small texture with split cells, kept nodes and channels of any type."""
    chance = np.random.default_rng(seed)
    depth = int(chance.integers(0, 6))
    codes = np.unique(chance.integers(0, 8**depth, int(chance.integers(0, 60))))
    leaves = [np.empty(0, np.int64)] * (depth + 1)
    if depth > 1:
        coarse = np.unique(codes[::7] >> 3)
        leaves[depth - 1], codes = coarse, codes[~np.isin(codes >> 3, coarse)]
    leaves[depth] = codes
    tree = with_random_data(Octree.from_levels(leaves), seed)
    channels = {}
    for name in CHANNELS[: int(chance.integers(1, 4))]:
        kinds = ["uint8", "uint16", "float16", "float32"] if name == "height" else ["uint8", "uint16"]
        dtype = "uint8" if name == "base_color" else str(chance.choice(kinds))
        components = 3 if name == "base_color" else 1
        counts = tree.n_cells, tree.split.areas.size, tree.kept.cells.size
        form = ChannelFormat(name, components, "srgb" if components == 3 else "data", dtype)  # type: ignore[arg-type]
        channels[name] = Channel(
            form, *(random_values((count, components), dtype, chance) for count in counts)
        )
    return OctreeTexture(tree, channels, Placement((0.0, 0.0, 0.0), 1.0), [[0.0] * 3, [1.0] * 3])


# Bytes.


def blind(content: bytes, chance: Random) -> bytes:
    """Change bytes, knowing nothing."""
    found = bytearray(content)
    at = chance.randrange(max(len(found), 1))
    count = chance.choice((1, 1, 2, 8, 100))
    match chance.randrange(7):
        case 0:
            return bytes(found[:at])
        case 1:
            return bytes(found[:at] + found[at : at + count] + found[at:])
        case 2:
            return bytes(found[:at] + found[at + count :])
        case 3:
            found[at : at + count] = bytes(len(found[at : at + count]))
        case 4:
            found[at : at + count] = b"\xff" * len(found[at : at + count])
        case 5:
            found[at : at + count] = chance.randbytes(len(found[at : at + count]))
        case _:
            for _ in range(count if found else 0):
                found[chance.randrange(len(found))] ^= 1 << chance.randrange(8)
    return bytes(found)


def odd_number(old: int, bits: int, chance: Random) -> int:
    """Return another whole number of so many bits."""
    new = (old + 1, old - 1, old ^ 1 << chance.randrange(bits), chance.getrandbits(bits), *EDGES)
    return chance.choice(new) % (1 << bits)


# JSON.

_INSIDE = object()  # a step into JSON that is a text


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the ways to all that a value of JSON holds, also in texts that are JSON."""
    if isinstance(value, str) and value[:1] in ("[", "{"):
        path, value = (*path, _INSIDE), json.loads(value)
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield (*path, key)
        yield from places(value[key], (*path, key))


def odd(value: Any, chance: Random) -> Any:
    """Return something else in the place of a value of JSON."""
    others: list[Any] = [None, True, -1, 1.5, 1e308, float("nan"), "", "x", [], {}, [value], "\ud800", *EDGES]
    if isinstance(value, int):
        others += [value + 1, value - 1, value * 2, -value] * 5
    if isinstance(value, float):
        others += [-value, value * 2, value * 1e30, value * 1e-30] * 3
    if isinstance(value, list):
        others += [value[:-1], value + value[:1], value[::-1], value * 100] * 3
    if isinstance(value, str):
        words = ("U8", "U16", "F16", "F32", "F64", "I64", "BF16", "uint8", "float32", "float16", "2", "srgb")
        others += [chance.choice(words), chance.choice(words), value + "0", value[:-1], value * 1000]
    return chance.choice(others)


def changed(value: Any, path: tuple[Any, ...], chance: Random) -> Any:
    """Return a value of JSON with another in one place, or without it, or under another name."""
    if not path:
        return odd(value, chance)
    if path[0] is _INSIDE:
        return json.dumps(changed(json.loads(value), path[1:], chance))
    copy = dict(value) if isinstance(value, dict) else list(value)
    key = path[0]
    if len(path) > 1 or chance.random() < 0.8:
        copy[key] = changed(value[key], path[1:], chance)
    elif isinstance(value, dict) and chance.random() < 0.5:
        copy[chance.choice((key + "x", key[:-1], *value))] = copy.pop(key)
    else:
        del copy[key]
    return copy


def named(path: tuple[Any, ...]) -> str:
    """Return the name of a place, for tables: the same for all elements of a list."""
    return "/".join("#" if isinstance(step, int) else step for step in path if step is not _INSIDE)


# The render file.


class Render:
    """The parts of an ``.octex`` file."""

    ending = ".octex"

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.length = int.from_bytes(content[:8], "little")
        self.entries = json.loads(content[8 : 8 + self.length])
        self.tensors = {name: entry for name, entry in self.entries.items() if "dtype" in entry}
        self.places = list(places(self.entries))
        self.arrays = [
            name for name, each in self.tensors.items() if each["data_offsets"][1] > each["data_offsets"][0]
        ]

    def of(self, name: str) -> tuple[int, int, int]:
        """Return where an array begins and ends, and the bytes of an element."""
        first, last = (8 + self.length + offset for offset in self.tensors[name]["data_offsets"])
        return first, last, int(self.tensors[name]["dtype"][1:]) // 8

    def blind(self, chance: Random) -> Damaged:
        """Change bytes."""
        return blind(self.content, chance), "blind"

    def header(self, chance: Random) -> Damaged:
        """Change a field of the header."""
        path = chance.choice(self.places)
        text = json.dumps(changed(self.entries, path, chance)).encode()
        if chance.random() < 0.02:  # a name twice
            key = chance.choice(list(self.entries))
            text = b"{%s:%s," % (json.dumps(key).encode(), json.dumps(self.entries[key]).encode()) + text[1:]
        size = len(text) if chance.random() < 0.1 else max(self.length, len(text))
        return size.to_bytes(8, "little") + text.ljust(size) + self.content[
            8 + self.length :
        ], f"header {named(path)}"

    def size(self, chance: Random) -> Damaged:
        """Change the length of the header."""
        return odd_number(self.length, 64, chance).to_bytes(8, "little") + self.content[8:], "header length"

    def array(self, chance: Random) -> Damaged:
        """Change an element of an array."""
        name = chance.choice(self.arrays)
        first, last, size = self.of(name)
        at = first + size * chance.randrange((last - first) // size)
        if chance.random() < 0.2:
            other = first + size * chance.randrange((last - first) // size)
            new = self.content[other : other + size]
        else:
            old = int.from_bytes(self.content[at : at + size], "little")
            new = odd_number(old, 8 * size, chance).to_bytes(size, "little")
        return self.content[:at] + new + self.content[at + size :], f"array {name}"

    def resized(self, chance: Random) -> Damaged:
        """Make an array longer or shorter, or of another type, with a header that says so."""
        name = chance.choice(list(self.tensors))
        entries = json.loads(json.dumps(self.entries))
        entry, (first, last, size) = entries[name], self.of(name)
        data = self.content[first:last]
        if chance.random() < 0.3:
            same = [
                each
                for each in ("U8", "I8", "U16", "F16", "U32", "F32", "U64", "F64")
                if int(each[1:]) == 8 * size
            ]
            entry["dtype"] = chance.choice(same)
        elif chance.random() < 0.3:
            entry["shape"] = chance.choice((entry["shape"][::-1], [*entry["shape"], 1], [len(data) // size]))
        else:
            row = max(size * (entry["shape"][1] if len(entry["shape"]) > 1 else 1), 1)
            rows = max(entry["shape"][0] + chance.choice((-1, 1, -entry["shape"][0], 7)), 0)
            data = (data + data + bytes(8 * row))[: rows * row]
            entry["shape"][0] = len(data) // row
        more = len(data) - (last - first)
        begin = entry["data_offsets"][0]
        for other, each in entries.items():
            if "dtype" in each and (
                each["data_offsets"][0] > begin
                or (other != name and each["data_offsets"] > entry["data_offsets"])
            ):
                each["data_offsets"] = [offset + more for offset in each["data_offsets"]]
        entry["data_offsets"][1] += more
        text = json.dumps(entries, separators=(",", ":")).encode().ljust(self.length)
        return len(text).to_bytes(8, "little") + text + self.content[
            8 + self.length : first
        ] + data + self.content[last:], f"resized {name}"

    ways: tuple[tuple[int, Callable[[Render, Random], Damaged]], ...] = (
        (4, blind), (1, size), (8, header), (9, array), (2, resized)
    )  # fmt: skip


# The archive.


#: Of an archive's first bytes the names, where they begin, and how many they are.
_START = (
    ("magic", 0, 8), ("version", 8, 4), ("length", 12, 4), ("begin", 16, 8), ("directory's checksum", 24, 4),
    ("checksum", 28, 4),
)  # fmt: skip


class Archive:
    """The parts of an ``.octz`` file."""

    ending = ".octz"

    def __init__(self, content: bytes) -> None:
        self.content = content
        begin = int.from_bytes(content[16:24], "little")
        lengths = struct.unpack_from("<3I", content, begin)
        text = lzma.decompress(content[begin + 12 :])
        ends = np.cumsum([0, *lengths]).tolist()
        header, self.root, records = (text[a:b] for a, b in pairwise(ends))
        self.head = json.loads(header)
        self.records: list[int] = np.frombuffer(records, "<u4").tolist()
        self.places = list(places(self.head))
        self.fields = [*self._fields()]  # what each record is: its name, or of a stream its kind
        at = START
        self.streams: list[tuple[str, int, bytes]] = []  # kind, which record has its length, bytes
        for n, name in enumerate(self.fields):
            if name.endswith("length"):
                self.streams.append((name.removesuffix(" length"), n, content[at : at + self.records[n]]))
                at += self.records[n]

    def _fields(self) -> Iterator[str]:
        channels = channels_in(self.head["__metadata__"])
        size = self.head["tree/level_nodes"]["shape"][0]
        nodes = np.frombuffer(self.root, "<i8", size, 8 * size).tolist()
        for first, end in pairwise(nodes[:-1]):
            for _ in runs(first, end):
                yield from Place._fields
                for name in ["structure", "areas", *(f"channel {name}" for name in channels)]:
                    yield from (f"{name} length", f"{name} checksum")
        sizes = {
            name: each["data_offsets"][1] - each["data_offsets"][0]
            for name, each in self.head.items()
            if name != "__metadata__"
        }
        for _ in pieces_of(sizes, channels):
            yield from ("other length", "other checksum")

    def built(
        self,
        *,
        head: Any = None,
        root: bytes | None = None,
        records: list[int] | None = None,
        streams: list[bytes] | None = None,
    ) -> bytes:
        """Return a file of other parts, whose checksums are right."""
        text = json.dumps(self.head if head is None else head).encode()
        found = list(self.records if records is None else records)
        contents = [content for _, _, content in self.streams]
        if streams is not None:
            for (_, record, _), content in zip(self.streams, streams, strict=True):
                found[record : record + 2] = len(content), zlib.crc32(content)
            contents = streams
        parts = [text, self.root if root is None else root, struct.pack(f"<{len(found)}I", *found)]
        directory = struct.pack("<3I", *map(len, parts)) + packed(b"".join(parts))
        return self.begun(directory, b"".join(contents))

    def begun(self, directory: bytes, streams: bytes) -> bytes:
        """Return a file with its first bytes."""
        first = MAGIC + self.content[8:12]
        first += struct.pack("<IQI", len(directory), START + len(streams), zlib.crc32(directory))
        return first + struct.pack("<I", zlib.crc32(first)) + streams + directory

    def blind(self, chance: Random) -> Damaged:
        """Change bytes."""
        return blind(self.content, chance), "blind"

    def start(self, chance: Random) -> Damaged:
        """Change a field of the first bytes."""
        name, at, size = chance.choice(_START)
        old = int.from_bytes(self.content[at : at + size], "little")
        new = odd_number(old, 8 * size, chance).to_bytes(size, "little")
        first = self.content[:at] + new + self.content[at + size : START]
        if name != "checksum":
            first = first[:28] + struct.pack("<I", zlib.crc32(first[:28]))
        return first + self.content[START:], f"start {name}"

    def described(self, chance: Random) -> Damaged:
        """Change a field of the head."""
        path = chance.choice(self.places)
        return self.built(head=changed(self.head, path, chance)), f"head {named(path)}"

    def directory(self, chance: Random) -> Damaged:
        """Change bytes of the directory: its lengths, what xz has packed."""
        begin = int.from_bytes(self.content[16:24], "little")
        lengths, after = self.content[begin : begin + 12], self.content[begin + 12 :]
        if chance.random() < 0.5:
            lengths = blind(lengths, chance)
        else:
            after = blind(after, chance)
        return self.begun(lengths + after, self.content[START:begin]), "directory"

    def beginning(self, chance: Random) -> Damaged:
        """Change the levels, the channels' forms and weights, or what the root has."""
        return self.built(root=blind(self.root, chance)), "root"

    def recorded(self, chance: Random) -> Damaged:
        """Change a number of the records."""
        if not self.records:
            return self.blind(chance)
        at = chance.randrange(len(self.records))
        records = list(self.records)
        records[at] = odd_number(records[at], 32, chance)
        return self.built(records=records), f"records {self.fields[at]}"

    def streamed(self, chance: Random) -> Damaged:
        """Change a stream."""
        if not self.streams:
            return self.blind(chance)
        streams = [content for _, _, content in self.streams]
        at = chance.randrange(len(streams))
        if chance.random() < 0.1:
            streams[at] = chance.choice(streams)
        else:
            streams[at] = blind(streams[at], chance)
        return self.built(streams=streams), f"stream {self.streams[at][0]}"

    ways: tuple[tuple[int, Callable[[Archive, Random], Damaged]], ...] = (
        (3, blind), (1, start), (2, beginning), (6, described), (3, directory), (4, recorded), (8, streamed),
    )  # fmt: skip


# Arrays of numpy.


def parted(path: Path) -> Render | Archive:
    """Return the parts of a file that is sound."""
    content = path.read_bytes()
    return Archive(content) if content.startswith(MAGIC) else Render(content)
