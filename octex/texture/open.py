"""Textures opened: files here, and at addresses."""

from __future__ import annotations

import os

from octex import container
from octex.archive.layout import is_archive
from octex.checks import as_path
from octex.errors import ArgumentError, TextureFileError
from octex.files import is_address
from octex.texture.file import Source
from octex.texture.texture import OctreeTexture, opened


def open_texture(
    path: str | os.PathLike[str], *, cache: str | os.PathLike[str] | None = None
) -> OctreeTexture:
    """Open an ``.octex`` file, or an archive, ``.octz``, whatever their names.

    The former is mapped: only its header is read, the rest when it is looked at. The latter is decoded whole:
    into memory, or from 256 MB on into a temporary file, whose pages need not stay in memory. If another
    program cuts a mapped file off, the system ends the process that reads it (SIGBUS): files should be
    replaced by new ones of the same name, as ``save`` does, and those that others write copied first.

    An address, ``https://…`` or any that fsspec knows (``pip install 'octex[remote]'``; what else it needs,
    like s3fs for ``s3://…``, is your own to install), is opened by parts: ``sample``, ``taps`` and
    ``contains`` fetch the blocks of the file that they read, by range requests, ``level`` the coarse levels,
    all else what it asks for whole. Of an archive come the structure of the levels looked at, and blocks of
    what they hold, which are decoded into memory. What is fetched stays in a temporary file, or in the folder
    ``cache``, where the next process finds them as long as the file has not changed.

    Raises TextureFileError for a file that is missing, damaged, of another type or of a newer version, and,
    also later, for an address that cannot be read any more, or whose file has changed; OutputError if there
    is no place for what is fetched; ArgumentError for a ``cache`` without an address.
    """
    if is_address(path):
        from octex.texture.remote import open_remote

        return open_remote(str(path), None if cache is None else as_path(cache, "cache"))
    if cache is not None:
        raise ArgumentError("cache is for addresses, like https://…; files here need none")
    path = as_path(path)
    if os.path.isdir(path):  # noqa: PTH112  # a name too long is none, and no error
        raise TextureFileError(f"{path}: is a folder; octex.TextureSet.open opens a texture set")
    if is_archive(path):
        from octex.archive.read import read

        archived = read(path)
        source = Source(str(path), None, dict(archived.tensors), dict(archived.metadata), archived.sizes)
    else:
        contents = container.read(path)
        source = Source(str(path), contents.mapping, dict(contents.tensors), dict(contents.metadata))
    return opened(source)
