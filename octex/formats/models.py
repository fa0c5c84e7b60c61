"""Models written for other tools, by the endings of their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from octex.checks import as_choice, as_path
from octex.errors import ArgumentError
from octex.formats.gltf import write_gltf
from octex.formats.images import IMAGE_FORMATS, ImageFormat
from octex.formats.obj import write_obj
from octex.formats.ply import write_mesh
from octex.source.surface import Surface, as_surface

_WRITERS: dict[str, Callable[[Surface, Path, ImageFormat], None]] = {
    ".glb": write_gltf,
    ".gltf": write_gltf,
    ".obj": write_obj,
    ".ply": lambda surface, path, _: write_mesh(surface, path),
}

#: The endings of model files that octex writes.
WRITTEN_ENDINGS = tuple(_WRITERS)


def write_model(surface: Surface, path: str | os.PathLike[str], *, images: ImageFormat = "png") -> None:
    """Write a surface with images, as ``bake`` makes it, or vertex colours, as ``bake_vertices`` does.

    ``path`` ends in .glb (one file), .gltf (a .bin and images are written beside it), .obj (a .mtl and
    images) or .ply (vertex colours alone). ``images`` is how maps are stored: "png"; "webp", smaller,
    which fewer tools read; or with loss "jpeg" (those without alpha). Positions are the posed ones; normals
    are the surface's ``frames``, without which viewers shade it flat.

    Each file is replaced whole or not at all. Raises ArgumentError for another ending, ModelError for values
    that the format cannot say, and OutputError if a file cannot be written.
    """
    as_surface(surface)
    path = as_path(path, "path")
    as_choice(images, IMAGE_FORMATS, "images")
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ArgumentError(
            f"{path.name} must end in {', '.join(WRITTEN_ENDINGS[:-1])} or {WRITTEN_ENDINGS[-1]}"
        )
    writer(surface, path, images)
