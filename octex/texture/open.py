"""Textures opened: files here, and at addresses."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from octex import container
from octex.archive.layout import MAGIC
from octex.checks import as_path
from octex.errors import ArgumentError, TextureFileError
from octex.files import is_address, open_file
from octex.texture.file import Source
from octex.texture.texture import OctreeTexture, opened


def open_texture(
    path: str | os.PathLike[str], *, cache: str | os.PathLike[str] | None = None
) -> OctreeTexture:
    """Open an ``.octex`` or ``.octz`` file, on disk or at a URL; the content decides, not the name.

    path    a file, which is memory-mapped (``.octex``) or decoded (``.octz``; into a temporary file from 256
            MB on); or a URL, ``https://…`` or any that fsspec supports (``pip install 'octex[remote]'``;
            for ``s3://…`` also install s3fs)
    cache   for a URL: a folder that caches what was fetched, also for later processes, until the file
            changes. Default: a temporary file

    At a URL ``sample``, ``taps`` and ``contains`` fetch the blocks that they read by range requests, and
    ``level`` fetches the coarse levels; everything else fetches what it needs completely.

    If another program shortens a mapped file, the system ends the process that reads it (SIGBUS): replace
    files by new ones, as ``save`` does.

    Raises TextureFileError for a file that is missing, damaged, of another type or of a newer version, and,
    also later, for a URL that cannot be read or whose file changed; OutputError without room for the
    cache; ArgumentError for a ``cache`` without a URL.
    """
    if is_address(path):
        from octex.texture.remote import open_remote

        return open_remote(str(path), None if cache is None else as_path(cache, "cache"))
    if cache is not None:
        raise ArgumentError("cache is for addresses, like https://…; files here need none")
    path = as_path(path)
    if os.path.isdir(path):  # noqa: PTH112  # a name too long is none, and no error
        raise TextureFileError(f"{path}: is a folder; octex.TextureSet.open opens a texture set")
    if _is_archive(path):
        from octex.archive.read import read

        archived = read(path)
        source = Source(str(path), None, dict(archived.tensors), dict(archived.metadata), archived.sizes)
    else:
        contents = container.read(path)
        source = Source(str(path), contents.mapping, dict(contents.tensors), dict(contents.metadata))
    return opened(source)


def _is_archive(path: Path) -> bool:
    """Say whether a file begins as an archive does."""
    with suppress(OSError), open_file(path) as file:
        return file.read(len(MAGIC)) == MAGIC
    return False
