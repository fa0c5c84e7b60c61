"""Damage good .ptx files, and read what becomes of them: an error that is octex's own, or texels, soon.

The files are those of OCTEX_TEST_MODELS, and files that octex writes of random contents. Bytes are
overwritten, cut off, moved or left out, numbers of the headers replaced by odd ones, and faces changed below
their compression. Of each file the metadata, the averages and some faces with their reductions are read.
"""

from __future__ import annotations

import os
import random
import sys
import time
import zlib
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "bench" / "peers"))
from damage import blind
from ptex_peer import random_contents

from octex.errors import ModelError
from octex.formats.ptex.layout import EXTENDED_HEADER, FACE_INFO, HEADER
from octex.formats.ptex.reader import PtexFile
from octex.formats.ptex.writer import write_contents
from octex.parallel import Run, workers

ODD = (0, 1, 2, 3, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
FACES = 12
#: Bytes that a process may take beside what it has at first, and seconds of a processor for a file.
MEMORY, SECONDS = 256 << 20, 1.0


def damaged(data: bytes, draw: random.Random) -> bytes:
    """Return a file with something wrong in it."""
    made = bytearray(data)
    match draw.randrange(7):
        case 0:
            at = draw.randrange(0, 26) * 4
            made[at : at + 4] = draw.choice(ODD).to_bytes(4, "little")
        case 1:
            made[draw.randrange(4, min(len(made), 160))] = draw.randrange(256)
        case 2:
            return changed_faces(data, draw)
        case _:
            return blind(data, draw)
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
            if file.most_bytes < 1 << 27:
                file.all_texels()
    except ModelError as error:
        assert path.name in str(error) or str(path) in str(error), error
        return "refused"
    return "read"


@cache
def good() -> list[bytes]:
    """Return files that are read as they stand."""
    folder = os.environ.get("OCTEX_TEST_MODELS")
    paths = sorted(Path(folder).rglob("*.ptx")) if folder else []
    found = [path.read_bytes() for path in paths if attempt(path, random.Random(0)) == "read"]
    with TemporaryDirectory() as made, workers(Run(threads=1)) as executor:
        path = Path(made) / "made.ptx"
        for seed in range(20):
            write_contents(random_contents(seed), path, executor)
            found.append(path.read_bytes())
        attempt(path, random.Random(0))  # compiles
    return found


def check(seed: int) -> str:
    """Read a damaged file; return what became of it."""
    draw = random.Random(seed)
    files = good() if seed % 10 == 0 else [each for each in good() if len(each) < 1 << 18]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.ptx"
        path.write_bytes(damaged(draw.choice(files), draw))
        began = time.process_time()
        result = attempt(path, draw)
    spent = time.process_time() - began
    assert spent < SECONDS, f"{spent:.2f} s"
    return result
