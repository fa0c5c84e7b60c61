#!/usr/bin/env python
"""Damage .octex and .octz files in every way, and see that octex refuses them or answers.

    python tools/fuzz_files.py --count 10000              seeds 0 … 9999
    python tools/fuzz_files.py --first 4711 --count 1     one again
    NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=/tmp/bounds python tools/fuzz_files.py --count 1000

A seed makes a small texture, saves it, and damages the file: blindly (bytes changed, cut, doubled), or
knowing its structure (any field of a header, any element of an array, any number of an archive's models,
with every checksum made right again). It is then opened, described, validated, looked up in every way, cut to
a level and saved. A finding is what is no OctexError (an end of the process, more than 20 s or 4 GB of
memory, any other exception), a file that validates although its structure is not that of its leaves, and one
whose archive comes back otherwise.
"""

from __future__ import annotations

import argparse
import json
import lzma
import os
import resource
import signal
import struct
import sys
import tempfile
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import octex
from octex.archive import entropy
from octex.channels import ChannelFormat
from octex.errors import OctexError
from octex.parallel import at_most
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT, KeptTable, SplitTable
from octex.tree.octree import Octree
from octex.tree.placement import Placement

MEMORY = 4 << 30
SECONDS = 20
BLOCK = 1 << 14  # of an archive
EDGES = (0, 1, 7, 255, 2**31 - 1, 2**32 - 1, 2**32, 2**48, 2**63 - 1, 2**64 - 1)
Random = np.random.Generator
#: What comes of reading a file that was damaged before.
_UNREADABLE = (ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError)
_UNREADABLE += (struct.error, zlib.error, lzma.LZMAError)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=500, help="files that one process tries")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where findings are kept")
    options = parser.parse_args()
    outcomes: Counter[str] = Counter()
    findings = 0
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Path(folder))
    seed, end = options.first, options.first + options.count
    while seed < end:
        done, told, status = _batch(seed, min(seed + options.batch, end), options.keep)
        outcomes.update(word for word, _ in told)
        for word, text in told:
            if word == "FOUND":
                findings += 1
                print(text, flush=True)
        seed = done
        if status:
            findings += 1
            print(f"seed {seed}: the process ended by {status}", flush=True)
            seed += 1
    print(f"{options.count} files: {dict(outcomes)}, {findings} findings")
    return 1 if findings else 0


def _batch(first: int, end: int, keep: Path | None) -> tuple[int, list[tuple[str, str]], str]:
    """Try some seeds in a process of their own: how far it came, what it told, and what ended it."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads idle
        child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            with os.fdopen(writing, "w", buffering=1) as pipe, tempfile.TemporaryDirectory() as folder:
                for seed in range(first, end):
                    signal.alarm(SECONDS)
                    pipe.write(json.dumps(attempt(seed, Path(folder), keep)) + "\n")
            os._exit(0)
        finally:
            os._exit(70)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        told = [tuple(json.loads(line)) for line in pipe]
    _, status = os.waitpid(child, 0)
    ended = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else ""
    if not ended and first + len(told) < end:
        ended = f"exit code {os.waitstatus_to_exitcode(status)}"
    return first + len(told), told, ended


def warm_up(folder: Path) -> None:
    """Compile what is needed, on files that are sound: processes that are forked later have it."""
    for seed in range(16):
        for ending in (".octz", ".octex"):
            random = np.random.default_rng(seed)
            made(random).save(folder / f"good{ending}")
            use(folder / f"good{ending}", random)


def attempt(seed: int, folder: Path, keep: Path | None = None) -> tuple[str, str]:
    """Try a seed: "refused", "unsound", "sound" or "FOUND", and a word on it."""
    random = np.random.default_rng(seed)
    content, what = damaged(random, folder)
    path = folder / f"damaged{'.octz' if content[:5] == ARCHIVE[:5] else '.octex'}"
    path.write_bytes(content)
    try:
        return use(path, random), what
    except Exception:
        if keep:
            (keep / f"{seed}{path.suffix}").write_bytes(content)
        return "FOUND", f"seed {seed}, {what}: {traceback.format_exc()}"


def use(path: Path, random: Random) -> str:
    """Do everything with a file that may be damaged; raises what is no OctexError, or any if it validates."""
    try:
        texture = octex.open(path)
    except OctexError:
        return "refused"
    json.dumps(texture.info())
    try:
        texture.validate()
        word = "sound"
    except OctexError:
        word = "unsound"
    try:
        look_up(texture, random, is_mapped=path.suffix == ".octex")
    except OctexError:
        if word == "sound":
            raise
    if word == "sound":
        leaves = [codes[~is_node] for codes, is_node in texture.tree.walk()]
        if any(codes.size for codes in leaves):
            twin = Octree.from_levels(leaves).arrays
            if not all(np.array_equal(*pair) for pair in zip(twin[:3], texture.tree.arrays[:3], strict=True)):
                raise AssertionError("it validates, but its structure is not that of its leaves")
        again = [path.with_name(f"again{ending}") for ending in (".octz", ".octex", ".2.octex")]
        texture.save(again[0])
        texture.save(again[1])
        octex.open(again[0]).save(again[2])
        if again[1].read_bytes() != again[2].read_bytes():
            raise AssertionError("its archive comes back as another file")
    return word


def look_up(texture: OctreeTexture, random: Random, *, is_mapped: bool) -> None:
    """Look up every channel in every way, at points on the model and off it.

    Of a mapped file list also which bytes that reads.
    """
    low, high = (np.clip(corner, -1e6, 1e6) for corner in texture.bounds)
    points = np.concatenate([low + (high - low) * random.random((24, 3)), random.normal(0, 1, (8, 3))])
    normals = random.normal(0, 1, points.shape)
    for channel in texture.channels:
        for filter in FILTERS:
            texture.sample(points, channel, filter)
            if is_mapped:
                texture.blocks(points, channel, filter, block_size=64)
        texture.sample(points, channel, normals=normals, width=0.1)
        if is_mapped:
            texture.blocks(points, channel, normals=normals, width=0.1, block_size=64)
            texture.blocks(points, channel, width=0.05, block_size=64)
    texture.contains(points)
    if texture.channels:
        texture.level(2).sample(points, next(iter(texture.channels)))


# What is damaged.


def made(random: Random) -> OctreeTexture:
    """Make a small texture with split cells, kept nodes and channels of any type."""
    depth = int(random.integers(0, 6))
    codes = np.unique(random.integers(0, 8**depth, int(random.integers(0, 60))))
    leaves = [np.empty(0, np.int64)] * (depth + 1)
    if depth > 1:
        coarse = np.unique(codes[::7] >> 3)
        leaves[depth - 1], codes = coarse, codes[~np.isin(codes >> 3, coarse)]
    leaves[depth] = codes
    tree = Octree.from_levels(leaves)
    flags = random.integers(1, FACING_FLAGS + 1, tree.n_cells, dtype=np.uint8)
    masks = [(found, is_node) for found, is_node in tree.walk()]
    begins = tree.arrays.level_cells
    for level in range(tree.max_depth - 1, -1, -1):
        own = flags[begins[level] : begins[level + 1]]
        own[masks[level][1]] = 0
        below = flags[begins[level + 1] : begins[level + 2]]
        np.bitwise_or.at(own, np.searchsorted(masks[level][0], masks[level + 1][0] >> 3), below)
    split = SplitTable(np.empty(0, np.uint32), np.empty(0, np.uint8), np.empty(0, np.uint8))
    is_kept = np.zeros(tree.n_cells, np.bool_)
    if random.random() < 0.5:
        is_split = random.random(tree.n_cells) < 0.3
        facings = flags[is_split]
        rows = int(np.bitwise_count(facings).sum())
        areas = random.integers(0, 256, rows, dtype=np.uint8)
        split = SplitTable(np.flatnonzero(is_split).astype(np.uint32), facings, areas)
        if tree.n_cells > 1:
            is_kept = np.concatenate([is_node for _, is_node in masks]) & (random.random(tree.n_cells) < 0.3)
        flags[is_split] |= SPLIT
        flags[is_kept] |= KEPT
    kept = KeptTable(np.flatnonzero(is_kept).astype(np.uint32))
    tree = tree.with_cell_data(flags, random.integers(0, 256, tree.n_cells, dtype=np.uint8), split, kept)
    channels = {}
    for name in ("base_color", "alpha", "height")[: int(random.integers(1, 4))]:
        dtype = (
            "uint8" if name == "base_color" else str(random.choice(["uint8", "uint16", "float16", "float32"]))
        )
        components = 3 if name == "base_color" else 1
        counts = tree.n_cells, split.areas.size, kept.cells.size
        values = [random.random((count, components)) for count in counts]
        one = 1 if dtype.startswith("f") else np.iinfo(dtype).max
        form = ChannelFormat(name, components, "srgb" if components == 3 else "data", dtype)  # type: ignore[arg-type]
        channels[name] = Channel(form, *((each * one).astype(dtype) for each in values))
    return OctreeTexture(tree, channels, Placement((0.0, 0.0, 0.0), 1.0), [[0.0] * 3, [1.0] * 3])


ARCHIVE = b"\x89OCTZ\r\n\x1a"


def damaged(random: Random, folder: Path) -> tuple[bytes, str]:
    """Return a damaged file, and how it was damaged."""
    path = folder / f"good{random.choice(['.octex', '.octz'])}"
    made(random).save(path)
    content = path.read_bytes()
    ways: list[Callable[[bytes, Random], bytes]] = [blind]
    ways += [archive] * 3 if path.suffix == ".octz" else [header, array, array]
    way = ways[int(random.integers(len(ways)))]
    for _ in range(int(random.choice([1, 1, 1, 2, 5]))):
        try:
            content = way(content, random)
        except _UNREADABLE:
            content = blind(content, random)  # what was damaged before is read no more
    return content, f"{path.suffix} {way.__name__}"


def blind(content: bytes, random: Random) -> bytes:
    """Change bytes, knowing nothing."""
    found = bytearray(content)
    at = int(random.integers(max(len(found), 1)))
    count = int(random.choice([1, 1, 2, 8, 100]))
    match int(random.integers(6)):
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
        case _:
            for place in random.integers(0, max(len(found), 1), count).tolist():
                if place < len(found):
                    found[place] ^= 1 << int(random.integers(8))
    return bytes(found)


def odd(value: Any, random: Random) -> Any:
    """Return something else in the place of a value of JSON."""
    others: list[Any] = [None, True, -1, 1.5, 1e308, "", "x", [], {}, [value], "\ud800", *EDGES]
    if isinstance(value, int):
        others += [value + 1, value - 1, value * 2, -value] * 3
    if isinstance(value, list) and value:
        changed = list(value)
        at = int(random.integers(len(value)))
        changed[at] = odd(changed[at], random)
        others += [changed] * 20 + [value[:-1], value + value[:1]]
    if isinstance(value, dict) and value:
        changed = dict(value)
        key = str(random.choice(list(changed)))
        changed[key] = odd(changed[key], random)
        without = dict(value)
        del without[key]
        others += [changed] * 30 + [without, {**value, key + "x": value[key]}]
    if isinstance(value, str) and value[:1] in "[{":
        others += [json.dumps(odd(json.loads(value), random))] * 20
    if isinstance(value, str):
        others += [
            str(random.choice(["U8", "U16", "F32", "F64", "I64", "uint8", "float32", "2"])),
            value + "0",
        ]
    return others[int(random.integers(len(others)))]


def header(content: bytes, random: Random) -> bytes:
    """Change a field of an .octex file's header."""
    length = int.from_bytes(content[:8], "little")
    text = json.dumps(odd(json.loads(content[8 : 8 + length]), random)).encode()
    size = len(text) if random.random() < 0.1 else max(length, len(text))
    return size.to_bytes(8, "little") + text.ljust(size) + content[8 + length :]


def array(content: bytes, random: Random) -> bytes:
    """Change an element of an array of an .octex file."""
    length = int.from_bytes(content[:8], "little")
    entries = json.loads(content[8 : 8 + length])
    names = [name for name, entry in entries.items() if "dtype" in entry and entry["data_offsets"][1] > 0]
    first, last = entries[str(random.choice(names))]["data_offsets"]
    size = int(random.choice([1, 2, 4, 8]))
    at = 8 + length + int(random.integers(first, max(last - size, first) + 1))
    old = int.from_bytes(content[at : at + size], "little")
    new = [old + 1, old - 1, old ^ 1 << int(random.integers(8 * size)), *EDGES]
    number = int(new[int(random.integers(len(new)))]) % (1 << 8 * size)
    return content[:at] + number.to_bytes(size, "little") + content[at + size :]


def archive(content: bytes, random: Random) -> bytes:
    """Change a part of an archive, and make its checksums right."""
    begin = int.from_bytes(content[16:24], "little")
    directory = content[begin:]
    lengths = struct.unpack_from("<3I", directory)
    text = zlib.decompress(directory[12 : 12 + lengths[0]])
    model = directory[12 + lengths[0] : 12 + lengths[0] + lengths[1]]
    records = np.frombuffer(directory[12 + sum(lengths[:2]) :], "<u4").copy()
    streams = bytearray(content[32:begin])
    match int(random.integers(5)):
        case 0:
            text = json.dumps(odd(json.loads(text), random)).encode()
        case 1:
            count = int.from_bytes(model[:4], "little")
            numbers = entropy.decoded_numbers(np.frombuffer(model[4:], "<u2"), count)
            if numbers is None:
                raise ValueError
            for at in random.integers(0, count, int(random.choice([1, 3, 50]))).tolist():
                numbers[at] = int(random.choice([0, 1, 2, 255, 256, 4095, 4096, 65536, 2**31, 2**32 - 2]))
            model = count.to_bytes(4, "little") + entropy.encoded_numbers(numbers).tobytes()
        case 2:
            if records.size:
                at = int(random.integers(records.size))
                near = [int(records[at]) + 1, int(records[at]) - 1, *EDGES[:6]]
                records[at] = int(random.choice(near)) % 2**32
        case 3:
            model = blind(model, random)
        case _:
            streams = bytearray(blind(bytes(streams), random).ljust(len(streams), b"\0")[: len(streams)])
    _set_checksums(json.loads(text), records, bytes(streams))
    text = zlib.compress(text)
    directory = struct.pack("<3I", len(text), len(model), 4 * records.size) + text + model + records.tobytes()
    version = int(random.choice([1, 2, 2, 2]))
    first = ARCHIVE + struct.pack("<IIQI", version, len(directory), 32 + len(streams), zlib.crc32(directory))
    return first + struct.pack("<I", zlib.crc32(first)) + bytes(streams) + directory


def _set_checksums(head: Any, records: np.ndarray, streams: bytes) -> None:
    """Make the records' checksums those of their streams."""
    channels = len(head["channels"])
    groups = []
    for level in range(len(head["level_nodes"]) - 2):
        first, end = head["level_nodes"][level : level + 2]
        groups += [(2, 2 + channels)] * ((end - 1) // BLOCK - first // BLOCK + 1)
    groups += [(0, 1 + channels)] * -(-head["split_cells"] // BLOCK)
    groups += [(0, channels)] * -(-head["kept_nodes"] // BLOCK)
    at = place = 0
    for numbers, count in groups[: records.size]:
        at += numbers
        for _ in range(count):
            length = int(records[at])
            records[at + 1] = zlib.crc32(streams[place : place + length])
            at, place = at + 2, place + length


if __name__ == "__main__":
    with at_most(1):
        sys.exit(main())
