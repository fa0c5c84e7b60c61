"""Opens textures: files on disk, and at addresses."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from octex import container
from octex.archive.layout import GLB_MAGIC, MAGIC, WEB_MAGIC
from octex.checks import as_path
from octex.errors import ArgumentError, TextureFileError
from octex.files import is_address, open_file
from octex.texture.file import Storage
from octex.texture.texture import OctreeTexture, texture_of

if TYPE_CHECKING:
    from octex.archive.read import Decoded


def open_texture(
    path: str | os.PathLike[str], *, cache: str | os.PathLike[str] | None = None
) -> OctreeTexture:
    """Open a texture's file, on disk or at a URL; the content decides, not the name.

    path    a file: ``.octex``, which is memory-mapped; ``.octz``, decoded, into a temporary file from 256 MB
            on; ``.octw``, or a glTF model with EXT_octree_texture, of 8 bits, with estimated areas. Or a URL
            of an ``.octex`` or ``.octz``, ``https://…`` or any that fsspec supports (``pip install
            'octex[remote]'``; for ``s3://…`` also install s3fs)
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
    read = _decoder(path)
    if read is not None:
        archived = read(path)
        storage = Storage(str(path), None, dict(archived.tensors), dict(archived.metadata), archived.sizes)
    else:
        contents = container.read(path)
        storage = Storage(str(path), contents.mapping, dict(contents.tensors), dict(contents.metadata))
    return texture_of(storage)


def _decoder(path: Path) -> Callable[[Path], Decoded] | None:
    """Return the decoder of a file that begins as an archive, a web file or a glTF model does."""
    head = b""
    with suppress(OSError), open_file(path) as file:
        head = file.read(len(MAGIC))
    if head == MAGIC:
        from octex.archive.read import read

        return read
    if head == WEB_MAGIC or head.startswith(GLB_MAGIC) or path.suffix.lower() == ".gltf":
        from octex.archive.web import read as read_web

        return read_web
    return None
