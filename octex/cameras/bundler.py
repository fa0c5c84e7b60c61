"""Cameras of Bundler, .out, which RealityCapture, Metashape, VisualSFM and others write too.

A camera sees X at R·X + t, looking along −z with y up; f·(1 + k1·s + k2·s²) times what it sees at (x, y),
s = x² + y², are pixels from the middle of the picture. Pictures' names stand in a list beside it.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, centred, is_file, picture_path, rigid, view_of
from octex.files import read_bytes

MARK = b"# Bundle file"
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
#: How many numbers a camera has.
_WIDTH = 15


def read(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras that have a focal length; the others are not placed."""
    words = content.decode("utf-8", errors="replace").partition("\n")[2].split()
    what = "the number of cameras"
    count = Record({what: words[0] if words else None}, are_texts=True).number(what)
    if not (0 <= 2 + _WIDTH * count <= len(words) and count.is_integer()):
        raise BrokenError(f"the number of cameras, {count:g}, is more than the file has room for")
    names = _names(path)
    if names and len(names) != count:
        raise BrokenError(f"its list names {len(names)} pictures for {count:g} cameras; export both again")
    frames = []
    for number in range(int(count)):
        with within(f"camera {number}"):
            f, k1, k2, *pose = words[2 + _WIDTH * number : 2 + _WIDTH * (number + 1)]
            fields = {"f": f, "k1": k1, "k2": k2, "R": pose[:9], "t": pose[9:]}
            record = Record(fields, are_texts=True)
            focal, *bends = (record.number(field) for field in ("f", "k1", "k2"))
            rotation, shift = record.numbers("R", 9), record.numbers("t", 3)
            if focal == 0.0:
                continue
            if focal < 0.0:
                raise BrokenError(f"f must be above zero, not {focal:g}")
            view = view_of(_TO_OPENCV @ rigid(rotation.reshape(3, 3), shift))
        name = names[number] if names else str(number)
        optics = Optics(None, partial(centred, focal), (*bends, 0.0, 0.0))
        image = picture_path(path, name) if names else None
        frames.append(Frame(name, path, optics, view, image, is_named=bool(names)))
    return frames


def _names(path: Path) -> list[str]:
    """Return the pictures that the list beside a file names: list.txt, or one of its own; none without."""
    for name in (f"{path.stem}.list.txt", f"{path.stem}_list.txt", "list.txt"):
        if is_file(path.with_name(name)):
            lines = read_bytes(path.with_name(name)).decode("utf-8", errors="replace").splitlines()
            # Bundler's own lists say zero and a focal length after a name.
            return [re.sub(r"\s+0\s+\S+$", "", line.strip()) for line in lines if line.strip()]
    return []
