"""The arrays of .npz files, and what damages them."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from random import Random

import numpy as np
from damage import EDGES, Damaged, blind, odd_number


class Arrays:
    """The arrays of an ``.npz`` file of points, of voxels or of cameras."""

    ending = ".npz"

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.members = [self._member(name, array) for name, array in arrays.items()]
        self.content = self._zipped(self.members)

    @staticmethod
    def _member(name: str, array: np.ndarray) -> tuple[str, bytes, np.ndarray]:
        file = io.BytesIO()
        np.lib.format.write_array(file, array, allow_pickle=False)
        return name, file.getvalue()[: -array.nbytes or None], array

    @staticmethod
    def _zipped(members: list[tuple[str, bytes, np.ndarray]]) -> bytes:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for name, head, array in members:
                archive.writestr(f"{name}.npy", head + array.tobytes())
        return file.getvalue()

    def blind(self, chance: Random) -> Damaged:
        """Change bytes."""
        return blind(self.content, chance), "blind"

    def zipped(self, chance: Random) -> Damaged:
        """Change a byte of what zip says of its members."""
        found = bytearray(self.content)
        kinds = (("member", b"PK\3\4", 30), ("directory", b"PK\1\2", 46), ("end", b"PK\5\6", 22))
        name, mark, size = chance.choice(kinds)
        begins = [at for at in range(len(found)) if found[at : at + 4] == mark]
        at = chance.choice(begins) + chance.randrange(size)
        found[at] = chance.choice((0, 1, 255, found[at] ^ 1 << chance.randrange(8)))
        return bytes(found), f"zip {name}"

    def described(self, chance: Random) -> Damaged:
        """Change what an array says of itself: its type, order, shape."""
        members = list(self.members)
        at = chance.randrange(len(members))
        name, head, array = members[at]
        if chance.random() < 0.3:
            head = blind(head, chance)
        else:
            types = (
                "|O", "<U4", "|V8", "<f2", "<f8", ">f4", "<i8", "|b1", "<c8", "<M8[s]", "<u8", "|S0", "<f16",
            )  # fmt: skip
            descr = chance.choice((array.dtype.str, *types, [("a", "<f4")]))
            shape = list(array.shape)
            if chance.random() < 0.7:
                sizes = [], [0], [-1], [2**63], [2**31, 2**31], [1e9], [True], [2**40]
                shape = chance.choice((*sizes, [*shape, 1], shape[1:], shape[::-1]))
                if chance.random() < 0.3:
                    shape = [chance.choice(EDGES), *array.shape[1:]]
            text = repr(
                {"descr": descr, "fortran_order": chance.choice((False, True, 3)), "shape": tuple(shape)}
            )
            text = text.ljust(117) + "\n"
            head = head[:8] + struct.pack("<H", len(text)) + text.encode()
        members[at] = name, head, array
        return self._zipped(members), f"header {name}"

    def valued(self, chance: Random) -> Damaged:
        """Change an element, or rows."""
        members = list(self.members)
        at = chance.randrange(len(members))
        name, head, array = members[at]
        copy = array.copy()
        flat = copy.reshape(-1)
        if not flat.size or array.dtype.kind not in "iuf":
            return self.blind(chance)
        for _ in range(chance.choice((1, 1, 3))):
            place = chance.randrange(flat.size)
            if array.dtype.kind == "f":
                flat[place] = chance.choice(
                    (np.nan, np.inf, -np.inf, 1e308, 1e-320, -1.0, 0.0, 1e30, -flat[place])
                )
            else:
                size = array.dtype.itemsize
                flat.view(f"u{size}")[place] = odd_number(int(flat.view(f"u{size}")[place]), 8 * size, chance)
        members[at] = name, head, copy
        return self._zipped(members), f"values {name}"

    def listed(self, chance: Random) -> Damaged:
        """Leave arrays out, name them otherwise, or twice."""
        members = list(self.members)
        at = chance.randrange(len(members))
        name, head, array = members[at]
        match chance.randrange(4):
            case 0:
                del members[at]
            case 1:
                members[at] = chance.choice([each for each, *_ in self.members]), head, array
            case 2:
                members[at] = (
                    chance.choice(("coords", "points", "depth", "", "../x", "names", "K", "size", "é")),
                    head,
                    array,
                )
            case _:
                cut = array[: chance.randrange(len(array) + 1)] if array.ndim else array[None]
                members[at] = self._member(name, cut)
        return self._zipped(members), f"members {name}"

    ways: tuple[tuple[int, Callable[[Arrays, Random], Damaged]], ...] = (
        (2, blind), (2, zipped), (4, described), (5, valued), (2, listed)
    )  # fmt: skip


def points(chance: np.random.Generator) -> Arrays:
    """Return coloured points with normals."""
    n = int(chance.integers(1, 30))
    normals = chance.normal(size=(n, 3)).astype(np.float32)
    return Arrays({"points": chance.random((n, 3)), "colors": chance.random((n, 4)), "normals": normals})


def voxels(chance: np.random.Generator) -> Arrays:
    """Return voxels of several depths."""
    n, depth = int(chance.integers(1, 30)), int(chance.integers(1, 5))
    coords = np.unique(chance.integers(0, 1 << depth, (n, 3), dtype=np.int32), axis=0)
    n = len(coords)
    arrays = {
        "coords": coords,
        "depths": np.full(n, depth, np.uint8),
        "origin": chance.random(3),
        "size": np.array(2.0),
    }
    return Arrays(
        {
            **arrays,
            "base_color": chance.integers(0, 256, (n, 3), dtype=np.uint8),
            "roughness": chance.random((n, 1)),
        }
    )


def cameras(chance: np.random.Generator) -> Arrays:
    """Return cameras with lenses."""
    n = int(chance.integers(1, 4))
    turns = np.linalg.qr(chance.normal(size=(n, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, chance.normal(size=(n, 3))
    K = np.array([[40.0, 0.0, 16.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    arrays = {
        "Ks": np.tile(K, (n, 1, 1)),
        "width": np.array(32),
        "height": np.full(n, 24),
        "distortion": chance.normal(0, 0.01, (n, 4)),
    }
    names = np.array([f"{k}.png" for k in range(n)])
    if chance.random() < 0.5:
        return Arrays({"viewmats": poses, **arrays, "names": names})
    return Arrays({"camtoworlds": poses, "convention": np.array("opengl"), **arrays, "names": names})
