"""A folder of finished stages, which later calls reuse.

A stage's file is named after a digest of its inputs, so changed inputs have another file. Damaged files, and
those of other stages, are replaced.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

import octex
from octex import container
from octex.arrays import Array
from octex.checks import as_path
from octex.conversion import large
from octex.errors import OutputError, TextureFileError
from octex.texture import OctreeTexture, open_texture

Rows = TypeVar("Rows")

#: Version of the stored stages, in addition to that of octex.
_VERSION = 5


class Stages(NamedTuple):
    """The stages in a folder whose inputs have the digest ``key``; without a folder nothing is stored."""

    folder: Path | None = None
    key: bytes = b""

    def of(self, parts: Callable[[], Sequence[Any]]) -> Stages:
        """Return the stages with additional inputs; see `digest_of`."""
        return self if self.folder is None else Stages(self.folder, digest_of(self.key, *parts()))

    def arrays(
        self,
        stage: str,
        make: Callable[[], Mapping[str, Array]],
        is_sound: Callable[[Mapping[str, Array]], bool] = lambda _: True,
    ) -> Mapping[str, Array]:
        """Return the arrays of a stage, made if missing or unsound; OutputError if they cannot be stored."""
        if self.folder is None:
            return make()
        name = f"{stage}-{self.key.hex()}"
        path = self.folder / f"{name[: len(stage) + 33]}.safetensors"
        for is_written in (False, True):
            if is_written:
                container.write(path, make(), {"stage": name})
            try:
                contents = container.read(path)
            except TextureFileError:
                continue
            if contents.metadata.get("stage") == name and is_sound(contents.tensors):
                container.read_ahead(contents.mapping)
                return contents.tensors
        raise OutputError(f"{path}: lost a file that was written there; choose another folder")

    def placed(self, arrays: Rows) -> Rows:
        """Return arrays of a stage, mapped from its file or stored by `large.moved`."""
        return arrays if self.folder is not None else large.moved(arrays)

    def texture(self, stage: str, make: Callable[[], OctreeTexture]) -> OctreeTexture:
        """Return the texture of a stage, mapped; made if missing."""
        if self.folder is None:
            return make()
        path = self.folder / f"{stage}-{self.key.hex()[:32]}.octex"
        try:
            return open_texture(path)
        except TextureFileError:
            make().save(path)
        return open_texture(path)


NOT_STORED = Stages()


def stages_in(folder: str | os.PathLike[str] | None) -> Stages:
    """Return the stages in a folder, which is created; raise OutputError if that fails."""
    if folder is None:
        return NOT_STORED
    path = as_path(folder, "resume")
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot store intermediate results: {error.strerror}; choose a folder"
        ) from error
    return Stages(path, digest_of(octex.__version__, _VERSION))


def digest_of(*parts: Any) -> bytes:
    """Return a digest of arrays, numbers, text, bytes and sequences of them."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape};".encode())
            digest.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
        elif isinstance(part, (tuple, list)):
            digest.update(b"(" + digest_of(*part))
        else:
            digest.update(f"{part!r};".encode())
    return digest.digest()
