#!/usr/bin/env python
"""Damage .octex, .octz and .npz files in every way, and see that octex refuses them or answers.

    python tools/fuzz/damaged_files.py --count 10000              seeds 0 … 9999
    python tools/fuzz/damaged_files.py --first 4711 --count 1     one again
    python tools/fuzz/damaged_files.py --count 500000 --log all.jsonl   go on after its last seed
    NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=/tmp/bounds python tools/fuzz/damaged_files.py --count 1000

A seed takes a small file that is sound, a texture or layer as .octex or .octz, points, voxels or cameras as
.npz, another texture every 200 seeds, and damages it (see damage.py): blindly, or knowing its structure, any
field of a header, any element of an array, with every checksum made right
again. It is then opened, described, validated, and some of this is done, by chance: a lookup in some way,
also of a level, of an archive as one elsewhere of which a part is read, a save, as an archive and back,
a merge as a layer, a conversion, a projection.

A finding is what is no OctexError: an end of the process, more than 60 s or 2 GB of memory, any other
exception; an archive that opens although bytes of it were changed and no checksum made right; a file that
validates although its structure is not that of its leaves, a lookup is not finite, or an archive of it
comes back otherwise. At the end it says how many files of each format were damaged where, and what became
of them: refused, unsound (opened, but does not validate), sound.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

import damage
import numpy as np
from damage import Archive, Arrays, Render

import octex
from octex.conversion.voxels import convert_voxels
from octex.errors import OctexError
from octex.parallel import at_most
from octex.source.surface import Surface
from octex.source.voxels import Voxels
from octex.texture import FILTERS, OctreeTexture
from octex.tree.octree import Octree
from octex.view.camera_files import read_cameras

MEMORY = 2 << 30
SECONDS = 60
#: So many seeds damage files that are made of one texture.
SHARE = 200
#: Archives are read in part where fsspec is.
HAS_FSSPEC = find_spec("fsspec") is not None
#: Of twenty files so many are of a kind.
KINDS = (".octex",) * 8 + (".octz",) * 8 + ("points", "voxels", "voxels", "cameras")
SCRATCH = "/dev/shm" if Path("/dev/shm").is_dir() else None  # files of a millisecond's life


def main() -> int:
    text = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=text[0], epilog=text[2], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--count", type=int, default=1000, help="how many")
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no batch later than that")
    parser.add_argument("--batch", type=int, default=2000, help="files that one process tries")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where findings are kept")
    parser.add_argument(
        "--log", type=Path, metavar="FILE",
        help="note each batch there; if there are some, go on after the last and sum up all",
    )  # fmt: skip
    options = parser.parse_args()
    began, tried = time.monotonic(), Tried(options.log)
    seed = max(options.first, tried.end)
    end = seed + options.count
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        warm_up(Path(folder))
    while seed < end and time.monotonic() - began < options.seconds:
        upto = min((seed // options.batch + 1) * options.batch, end)
        done, told, status = _batch(seed, upto, options.keep)
        found = [text for word, text in told if word == "FOUND"]
        if status:
            alone = _batch(done, done + 1, options.keep)[2] or "nothing"
            found.append(f"seed {done}: the process ended by {status}; alone by {alone}")
            done += 1
        for text in found:
            print(text, flush=True)
        tried.add(seed, done, Counter(f"{word}|{what}" for word, what in told if word != "FOUND"), found)
        seed = done
    print(tried.table())
    print(f"the next seed is {seed}")
    return 1 if tried.findings else 0


class Tried:
    """What became of all files so far, also those of a log."""

    def __init__(self, log: Path | None) -> None:
        self._log = log
        self._counts: Counter[str] = Counter()
        self.findings: list[str] = []
        self.end = 0
        for line in log.read_text(encoding="utf-8").splitlines() if log and log.exists() else ():
            batch = json.loads(line)
            self._sum(batch)
            self.end = max(self.end, batch["end"])

    def _sum(self, batch: dict[str, Any]) -> None:
        self._counts.update(batch["counts"])
        self.findings += batch["findings"]

    def add(self, first: int, end: int, counts: Counter[str], findings: list[str]) -> None:
        """Add a batch."""
        batch = {"first": first, "end": end, "counts": dict(counts), "findings": findings}
        self._sum(batch)
        if self._log:
            with self._log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(batch) + "\n")

    def table(self) -> str:
        """Return how many files were damaged where, and what became of them."""
        words = ("refused", "unsound", "sound")
        rows: dict[str, Counter[str]] = {}
        for key, count in self._counts.items():
            word, what = key.removesuffix(", then blind").split("|", 1)
            form = what.split(":", 1)[0]
            for name in (what, form, "all"):
                rows.setdefault(name, Counter())[word] += count
        lines = [f"{'files':>9} {' '.join(f'{word:>9}' for word in words)}  damaged"]
        for name in sorted(rows, key=lambda name: (name == "all", name)):
            counts = rows[name]
            lines.append(f"{counts.total():9} {' '.join(f'{counts[word]:9}' for word in words)}  {name}")
        return "\n".join([*lines, f"{len(self.findings)} findings"])


def _batch(first: int, end: int, keep: Path | None) -> tuple[int, list[tuple[str, str]], str]:
    """Try some seeds in a process of their own: how far it came, what it told, and what ended it."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads idle
        child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            most = pages * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
            with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
                for seed in range(first, end):
                    signal.alarm(SECONDS)
                    os.write(writing, json.dumps(attempt(seed, Path(folder), keep)).encode() + b"\n")
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
    for n in range(16):
        for kind, parts in files(n, folder).items():
            path = folder / f"good{parts.ending}"
            path.write_bytes(parts.content)
            for seed in range(40):
                use(path, kind, Random(seed))
    files.cache_clear()


@lru_cache(maxsize=1)
def files(number: int, folder: Path) -> dict[str, Render | Archive | Arrays]:
    """Return the parts of files that are sound, by their kind."""
    texture = damage.made(number)
    found: dict[str, Render | Archive | Arrays] = {}
    for ending in (".octex", ".octz"):
        texture.save(folder / f"good{ending}")
        found[ending] = damage.parted(folder / f"good{ending}")
    chance = np.random.default_rng(number)
    return found | {each.__name__: each(chance) for each in (damage.points, damage.voxels, damage.cameras)}


def attempt(seed: int, folder: Path, keep: Path | None = None) -> tuple[str, str]:
    """Try a seed: "refused", "unsound", "sound", and what was damaged; or "FOUND", and what it is."""
    chance = Random(seed)
    kind = chance.choice(KINDS)
    parts = files(seed // SHARE, folder)[kind]
    path = folder / f"damaged{parts.ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content, what, is_changed = damaged(parts, chance)
        path.write_bytes(content)
        try:
            word = use(path, kind, chance)
            if is_changed and parts.ending == ".octz" and word != "refused":
                raise AssertionError("it opens, but bytes of it were changed")
        except Exception:
            if keep:
                (keep / f"{seed}{parts.ending}").write_bytes(content)
            return "FOUND", f"seed {seed}, {kind}: {what}: {traceback.format_exc()}"
    return word, f"{kind}: {what}"


def damaged(parts: Render | Archive | Arrays, chance: Random) -> tuple[bytes, str, bool]:
    """Return a damaged file, what was damaged, and whether at last blindly, into another file."""
    weights, ways = zip(*parts.ways, strict=True)
    content, what = chance.choices(ways, weights)[0](parts, chance)
    before = parts.content if what == "blind" else content
    if chance.random() < 0.05:
        before, content, what = content, damage.blind(content, chance), f"{what}, then blind"
    return content, what, what.endswith("blind") and content != before


def use(path: Path, kind: str, chance: Random) -> str:
    """Do something with a file that may be damaged.

    Raises what is no OctexError, or any if it validates.
    """
    if not kind.startswith("."):
        return _use_arrays(path, kind, chance)
    try:
        texture = octex.open(path)
    except OctexError:
        if kind != ".octex" and HAS_FSSPEC:
            _read_in_part(path, chance, is_sound=False)
        return "refused"
    json.dumps(texture.info())
    try:
        texture.validate()
        word = "sound"
    except OctexError:
        word = "unsound"
    try:
        if kind != ".octex" and HAS_FSSPEC and chance.random() < 0.4:
            _read_in_part(path, chance, is_sound=word == "sound")
        if word == "unsound" or chance.random() < 0.4:
            look_up(texture, chance, is_mapped=kind == ".octex", is_sound=word == "sound")
    except OctexError:
        if word == "sound":
            raise
    if word == "sound":
        leaves = [codes[~is_node] for codes, is_node in texture.tree.walk()]
        if any(codes.size for codes in leaves):
            twin = Octree.from_levels(leaves).arrays
            if not all(np.array_equal(*pair) for pair in zip(twin[:3], texture.tree.arrays[:3], strict=True)):
                raise AssertionError("it validates, but its structure is not that of its leaves")
    match chance.randrange(24):
        case 0:
            _save(texture, path, is_sound=word == "sound")
        case 1 if word == "sound":
            _merge(texture)
        case _:
            pass
    return word


def _read_in_part(path: Path, chance: Random, *, is_sound: bool) -> None:
    """Look up an archive as one elsewhere, of which a part is decoded."""
    try:
        texture = octex.open(path.resolve().as_uri())
        look_up(texture, chance, is_mapped=False, is_sound=is_sound)
        look_up(texture, chance, is_mapped=False, is_sound=is_sound)
    except OctexError:
        if is_sound:
            raise


def look_up(texture: OctreeTexture, chance: Random, *, is_mapped: bool, is_sound: bool) -> None:
    """Look up a channel in some way, at points on the model and off it.

    Of a mapped file list also which bytes that reads.
    """
    given: dict[str, Any] = {}
    low, high = (np.clip(corner, -1e6, 1e6) for corner in texture.bounds)
    random = np.frombuffer(chance.randbytes(32 * 6 * 2), np.uint16).reshape(32, 6) / 65535.0
    points = np.where(np.arange(32)[:, None] < 24, low + (high - low) * random[:, :3], 4 * random[:, :3] - 2)
    if not texture.channels:
        texture.contains(points)
        return
    channel = chance.choice(list(texture.channels))
    match chance.randrange(8):
        case 0:
            given["width"] = 0.05
        case 1:
            given.update(normals=random[:, 3:] - 0.5, width=0.1)
        case 2:
            given["normals"] = random[:, 3:] - 0.5
        case 3:
            texture.contains(points)
            texture.level(2).sample(points, channel)
            return
        case _:
            given["filter"] = chance.choice(list(FILTERS))
    if is_mapped and chance.random() < 0.25:
        texture.blocks(points, channel, block_size=64, **given)
        return
    found = texture.sample(points, channel, **given)
    values = texture.channels[channel]
    if is_sound and values.format.dtype != "float32" and not np.isfinite(found).all():
        raise AssertionError(f"it validates, but a lookup {given} is not finite")


def _save(texture: OctreeTexture, path: Path, *, is_sound: bool) -> None:
    """Save a texture, as an archive too; what is not sound must be refused, or saved."""
    again = [path.with_name(f"again{ending}") for ending in (".octz", ".octex", ".2.octex")]
    texture.save(again[1])
    try:
        texture.save(again[0])
    except OctexError:
        if is_sound:
            raise
        return
    octex.open(again[0]).save(again[2])
    if again[1].read_bytes() != again[2].read_bytes():
        raise AssertionError("its archive comes back as another file")


@cache
def _below() -> tuple[OctreeTexture, Surface]:
    """Return a texture and its surface, for layers to be merged into."""
    vertices = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1, 0.1], [0.3, 0.2, 0.9]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    return damage.made(2), Surface.from_arrays(vertices, faces, colors=vertices)


def _merge(layer: OctreeTexture) -> None:
    texture, surface = _below()
    try:
        octex.merge(texture, layer, surface)
    except OctexError:
        return  # another root cell, other channels


def _use_arrays(path: Path, kind: str, chance: Random) -> str:
    try:
        if kind == "points":
            cloud = octex.PointCloud.load(path)
            if chance.random() < 0.25:
                _ = cloud.spacing
        elif kind == "voxels":
            voxels = Voxels.load(path)
            if chance.random() < 0.25:
                convert_voxels(voxels).validate()
        else:
            for frame in read_cameras(path):
                frame.camera().project(np.eye(3))
    except OctexError:
        return "refused"
    return "sound"


if __name__ == "__main__":
    with at_most(1):
        sys.exit(main())
