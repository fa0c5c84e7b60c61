#!/usr/bin/env python
"""Damage good .ptx files, and read what becomes of them: an error that is octex's own, or texels, soon.

usage: tools/fuzz/ptex.py [FILE.ptx|FOLDER...] [--count N] [--seed N] [--seconds 1] [--memory 256]

Files that octex writes of random contents are damaged as well. Bytes are overwritten, cut off, moved or put
in, numbers of the headers replaced by odd ones, and faces changed below their compression. Of each file the
metadata, the averages and some faces with their reductions are read. Files that are refused as they
stand are left out. Exit code 1 if anything else is raised, or takes more than --seconds of a processor or
--memory megabytes. Linux only.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import time
import traceback
import zlib
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "bench" / "peers"))
from ptex_peer import random_contents

from octex.errors import ModelError
from octex.formats.ptex.layout import EXTENDED_HEADER, FACE_INFO, HEADER
from octex.formats.ptex.reader import PtexFile, all_texels
from octex.formats.ptex.writer import write_contents
from octex.parallel import Run, workers

ODD = (0, 1, 2, 3, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
FACES = 12


def damaged(data: bytes, draw: random.Random) -> bytes:
    """Return a file with something wrong in it."""
    made = bytearray(data)
    kind = draw.randrange(7)
    if kind == 0:
        for _ in range(draw.randrange(1, 5)):
            made[draw.randrange(len(made))] = draw.randrange(256)
    elif kind == 1:
        del made[draw.randrange(len(made)) :]
    elif kind == 2:
        at = draw.randrange(len(made))
        made[at:at] = draw.randbytes(draw.randrange(1, 20))
    elif kind == 3:
        at, size = draw.randrange(len(made)), draw.randrange(1, 50)
        made[at : at + size] = made[draw.randrange(len(made)) :][:size]
    elif kind == 4:
        at = draw.randrange(0, 26) * 4
        made[at : at + 4] = draw.choice(ODD).to_bytes(4, "little")
    elif kind == 5:
        at = draw.randrange(4, min(len(made), 160))
        made[at] = draw.randrange(256)
    else:
        return changed_faces(data, draw)
    return bytes(made)


def changed_faces(data: bytes, draw: random.Random) -> bytes:
    """Return a file with other faces, or other sizes of blocks, whose streams are sound."""
    header = np.frombuffer(data[: HEADER.itemsize], HEADER).copy()
    first = HEADER.itemsize + int(header["extended_header"][0])
    if draw.random() < 0.5:
        name, begin, size = "face_info", first, int(header["face_info"][0])
    else:
        begin = first + int(header["face_info"][0])
        name, size = "constants", int(header["constants"][0])
    content = bytearray(zlib.decompress(data[begin : begin + size]))
    for _ in range(draw.randrange(1, 4)):
        at = draw.randrange(len(content))
        if name == "face_info":  # resolutions, most of the time
            at = at // FACE_INFO.itemsize * FACE_INFO.itemsize + draw.choice((0, 1, 2, 3, at % 20))
        content[at] = draw.choice((draw.randrange(256), draw.randrange(14)))
    zipped = zlib.compress(bytes(content))
    header[name] = len(zipped)
    second = data[HEADER.itemsize : HEADER.itemsize + EXTENDED_HEADER.itemsize]
    extended = np.frombuffer(second.ljust(EXTENDED_HEADER.itemsize, b"\0"), EXTENDED_HEADER).copy()
    if extended["edits_at"][0]:
        extended["edits_at"] = int(extended["edits_at"][0]) + len(zipped) - size
    middle = extended.tobytes()[: first - HEADER.itemsize]
    return b"".join(
        [header.tobytes(), middle, data[HEADER.itemsize + len(middle) : begin], zipped, data[begin + size :]]
    )


def attempt(path: Path, draw: random.Random) -> str:
    """Read a file; say what became of it."""
    try:
        with PtexFile(path) as file:
            _ = file.metadata, file.constants
            for face in draw.sample(range(file.n_faces), min(FACES, file.n_faces)):
                u, v = file.faces.log2[face].tolist()
                texels = file.texels(face)
                assert texels.shape == (1 << v, 1 << u, file.n_channels)
                if min(u, v):
                    assert file.texels(face, 1).shape == (1 << v - 1, 1 << u - 1, file.n_channels)
            if file.most_bytes < 1 << 27:
                all_texels(file)
    except ModelError as error:
        assert path.name in str(error) or str(path) in str(error), error
        return "refused"
    return "read"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--memory", type=int, default=256, help="megabytes")
    options = parser.parse_args(arguments)
    counts: Counter[str] = Counter()
    slowest = 0.0
    with TemporaryDirectory() as folder, workers(Run(threads=1)) as executor:
        path = Path(folder) / "damaged.ptx"
        good = []
        files = [
            f for each in options.files for f in (sorted(each.rglob("*.ptx")) if each.is_dir() else [each])
        ]
        for file in files:
            if attempt(file, random.Random(0)) == "read":
                good.append(file.read_bytes())
            else:
                print(f"{file.name} is refused as it stands, and left out")
        for seed in range(20):
            write_contents(random_contents(seed), path, executor)
            good.append(path.read_bytes())
        path.write_bytes(good[-1])
        attempt(path, random.Random(0))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (options.memory << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        small = [each for each in good if len(each) < 1 << 18]
        for number in range(options.seed, options.seed + options.count):
            draw = random.Random(number)
            path.write_bytes(damaged(draw.choice(good if number % 10 == 0 else small), draw))
            began = time.process_time()
            try:
                result = attempt(path, draw)
            except Exception:
                result = "WRONG"
                print(f"seed {number}: {traceback.format_exc()}")
            spent = time.process_time() - began
            slowest = max(slowest, spent)
            if spent > options.seconds:
                result = "SLOW"
                print(f"seed {number}: {spent:.2f} s")
            counts[result] += 1
    print(
        ", ".join(f"{count:,} {result}" for result, count in counts.most_common()), f"slowest {slowest:.2f} s"
    )
    return 1 if counts["WRONG"] or counts["SLOW"] else 0


if __name__ == "__main__":
    sys.exit(main())
