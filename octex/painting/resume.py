"""A folder of what painting has done so far, from which a later call goes on.

Each thing lies in a file that is named by what it was made from: the same is found again, and a picture that
has changed, another camera or another surface is not. A file that is damaged is made anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

import octex
from octex import container
from octex.arrays import Array
from octex.checks import as_path
from octex.errors import OutputError, TextureFileError
from octex.texture import OctreeTexture, open_texture

Found = TypeVar("Found")

#: Changes with what is kept, beside the version of octex.
_VERSION = 2


class Kept(NamedTuple):
    """What is kept in a folder; ``made_from`` is what all of it was made from, as a digest."""

    folder: Path
    made_from: bytes = b""

    def of(self, *parts: Any) -> Kept:
        """Return what is kept of what was also made from ``parts``; see `digest_of`."""
        return Kept(self.folder, digest_of(self.made_from, *parts))

    def arrays(
        self,
        kind: str,
        make: Callable[[], Mapping[str, Array]],
        as_found: Callable[[Mapping[str, Array]], Found | None],
    ) -> Found:
        """Return arrays, mapped, as what ``as_found`` makes of them; ``make`` is asked where there are none.

        ``as_found`` returns None for arrays that cannot be those. Raises OutputError where there is no place.
        """
        path = self._path(kind, "safetensors")
        found = _read(path, as_found)
        if found is None:
            container.write(path, make(), {})
            found = _read(path, as_found)
        if found is None:
            raise OutputError(f"{path}: does not keep what is written there; choose another folder")
        return found

    def texture(self, kind: str, make: Callable[[], OctreeTexture]) -> OctreeTexture:
        """Return a texture, mapped; ``make`` is asked where there is none."""
        path = self._path(kind, "octex")
        try:
            return open_texture(path)
        except TextureFileError:
            make().save(path)
        return open_texture(path)

    def _path(self, kind: str, ending: str) -> Path:
        return self.folder / f"{kind}-{self.made_from.hex()[:32]}.{ending}"


def kept_in(folder: str | os.PathLike[str] | None) -> Kept | None:
    """Return what is kept in a folder, which is made; None for no folder. Raises OutputError if it cannot."""
    if folder is None:
        return None
    path = as_path(folder, "resume")
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot keep what was done: {error.strerror}; choose a folder") from error
    return Kept(path, digest_of(octex.__version__, _VERSION))


def digest_of(*parts: Any) -> bytes:
    """Return a digest of arrays, numbers, text, bytes and sequences of them."""
    made = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            made.update(f"{part.dtype.str}{part.shape};".encode())
            made.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
        elif isinstance(part, (tuple, list)):
            made.update(b"(" + digest_of(*part))
        else:
            made.update(f"{part!r};".encode())
    return made.digest()


def fits(arrays: Mapping[str, Array], expected: Mapping[str, tuple[str, tuple[int, ...]]]) -> bool:
    """Say whether arrays are those expected, by name, type and shape."""
    return arrays.keys() == expected.keys() and all(
        (arrays[name].dtype, arrays[name].shape) == (np.dtype(dtype), shape)
        for name, (dtype, shape) in expected.items()
    )


def _read(path: Path, as_found: Callable[[Mapping[str, Array]], Found | None]) -> Found | None:
    try:
        contents = container.read(path)
    except TextureFileError:
        return None
    container.read_ahead(contents.mapping)
    return as_found(contents.tensors)
