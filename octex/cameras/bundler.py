"""Cameras of Bundler, .out, which RealityCapture, Metashape, VisualSFM and others write too.

A camera sees X at R·X + t, looking along −z with y up; f·(1 + k1·s + k2·s²) times what it sees at (x, y),
s = x² + y², are pixels from the middle of the picture. Pictures' names stand in a list beside it.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import (
    BrokenError,
    Frame,
    Lens,
    beside,
    intrinsics_of,
    is_file,
    number_of,
    view_of_pose,
    within,
)
from octex.files import read_bytes

#: What a file starts with.
MARK = b"# Bundle file"
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
#: A camera's numbers.
_FIELDS = "f", "k1", "k2", *"R" * 9, *"t" * 3


def read_bundler(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras that have a focal length; the others are not placed."""
    words = content.decode("utf-8", errors="replace").partition("\n")[2].split()
    count = number_of(words[0] if words else None, "the number of cameras")
    width = len(_FIELDS)
    if not (0 <= 2 + width * count <= len(words) and count.is_integer()):
        raise BrokenError(f"the number of cameras, {count:g}, is more than the file has room for")
    names = _names(path)
    if names and len(names) != count:
        raise BrokenError(f"its list names {len(names)} pictures for {count:g} cameras; export both again")
    frames = []
    for number in range(int(count)):
        name = names[number] if names else str(number)
        with within(f"camera {number}"):
            given = words[2 + width * number :][:width]
            focal, k1, k2, *pose = (number_of(*each) for each in zip(given, _FIELDS, strict=True))
            if focal == 0.0:
                continue
            if focal < 0.0:
                raise BrokenError(f"f must be above zero, not {focal:g}")
            view = np.eye(4)
            view[:3, :3], view[:3, 3] = np.reshape(pose[:9], (3, 3)), pose[9:]
            view = view_of_pose(_TO_OPENCV @ view, "opencv")
        image = beside(path, name) if names else None
        lens, bends = _lens(focal), (k1, k2, 0.0, 0.0)
        frames.append(Frame(name, image, None, path, lens, view, distortion=bends, is_named=bool(names)))
    return frames


def _lens(focal: float) -> Lens:
    def lens(width: int, height: int) -> Float64s:
        return intrinsics_of(focal, focal, width / 2, height / 2)

    return lens


def _names(path: Path) -> list[str]:
    """Return the pictures that the list beside a file names: list.txt, or one of its own; none without."""
    for name in (f"{path.stem}.list.txt", f"{path.stem}_list.txt", "list.txt"):
        if is_file(path.with_name(name)):
            lines = read_bytes(path.with_name(name)).decode("utf-8", errors="replace").splitlines()
            # Bundler's own lists say zero and a focal length after a name.
            return [re.sub(r"\s+0\s+\S+$", "", line.strip()) for line in lines if line.strip()]
    return []
