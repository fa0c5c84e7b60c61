"""Files of a session that other programs may change meanwhile; the other versions are kept."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISREG
from tempfile import TemporaryDirectory

from octex.errors import OctexError, OutputError, TextureFileError
from octex.texture import OctreeTexture, open_texture


def stamp_of(path: Path) -> tuple[int, ...] | None:
    """Return a fingerprint that changes when another program writes the file; None for no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_mtime_ns, status.st_size, status.st_ino) if S_ISREG(status.st_mode) else None


@contextmanager
def put_aside(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Rename files, so that the block can write others; yield their new names. Undone if the block fails."""
    renamed: list[tuple[Path, Path]] = []
    try:
        for path in map(Path, map(os.path.realpath, paths)):
            aside = _free_name(path)
            path.rename(aside)
            renamed.append((path, aside))
        yield [aside for _, aside in renamed]
    except BaseException as error:
        for path, aside in renamed:
            aside.replace(path)
        if isinstance(error, OSError):
            raise OutputError(f"{error.filename}: {error.strerror or error}") from None
        raise


def _free_name(path: Path) -> Path:
    """Return a name that no file has, in the same folder."""
    number = 1
    while True:
        aside = path.with_name(f"{path.stem}.other{'' if number == 1 else f'-{number}'}{path.suffix}")
        if not os.path.lexists(aside):
            return aside
        number += 1


def texture_of(content: bytes, path: Path) -> OctreeTexture:
    """Return the texture in the bytes of a file, in memory. Raises TextureFileError."""
    with TemporaryDirectory() as folder:
        copied = Path(folder, path.name)
        copied.write_bytes(content)
        try:
            texture = open_texture(copied)
            texture.validate()
        except OctexError as error:
            raise TextureFileError(str(error).replace(str(copied), path.name)) from None
        return copy.deepcopy(texture)
