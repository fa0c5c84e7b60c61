"""Models written for other tools, by the endings of their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from octex.checks import as_choice, as_path
from octex.errors import ArgumentError, MissingExtraError
from octex.formats.gltf import write_gltf
from octex.formats.images import IMAGE_FORMATS, ImageFormat, Written
from octex.formats.obj import write_obj
from octex.formats.ply import write_mesh
from octex.formats.threemf import write_3mf
from octex.formats.units import METERS, Unit
from octex.formats.usd import write_usd
from octex.source.surface import Surface, as_surface

_WRITERS: dict[str, Callable[[Surface, Path, ImageFormat, Unit], Written]] = {
    ".glb": lambda surface, path, images, _: write_gltf(surface, path, images),
    ".gltf": lambda surface, path, images, _: write_gltf(surface, path, images),
    ".obj": lambda surface, path, images, _: write_obj(surface, path, images),
    ".usdz": write_usd,
    ".usd": write_usd,
    ".usda": write_usd,
    ".usdc": write_usd,
    ".ply": lambda surface, path, *_: write_mesh(surface, path),
    ".3mf": lambda surface, path, _, unit: write_3mf(surface, path, unit),
}

#: What some endings need: a module, its package, and the extra of it.
_EXTRAS = {
    ".3mf": ("lib3mf", "lib3mf", "3mf"),
    **dict.fromkeys((".usdz", ".usd", ".usda", ".usdc"), ("pxr", "usd-core", "usd")),
}

#: The endings of model files that octex writes.
WRITTEN_ENDINGS = tuple(_WRITERS)


def check_extra(path: Path) -> None:
    """Raise MissingExtraError if a package is not installed that writes files of this ending."""
    module, package, extra = _EXTRAS.get(path.suffix.lower(), ("", "", ""))
    if module and find_spec(module) is None:
        raise MissingExtraError.needed(f"to write {path.name}", package, extra)


def write_model(
    surface: Surface, path: str | os.PathLike[str], *, images: ImageFormat = "png", unit: Unit = "meter"
) -> Written:
    """Write a surface with images, as ``bake`` makes it, or vertex colours, as ``bake_vertices`` does.

    ``path`` ends in .glb (one file), .gltf (a .bin and images are written beside it), .obj (a .mtl and
    images), .usdz (one file; of the extra ``usd``) or .usd, .usda, .usdc (images beside them); with vertex
    colours also in .ply, or .3mf for printing (of the extra ``3mf``). ``images`` is how maps are stored:
    "png", of 16 bits where maps have that; "webp", smaller, which fewer tools read, and none of USD; with
    loss "jpeg" (colours without alpha; other maps are png) or "jpeg-all" (all maps without alpha); or "exr"
    (OpenEXR) for maps of floats, which glTF has none of. Images of UDIM tiles are named by channel and tile:
    NAME-base_color.1001.png. ``unit`` is what a length of 1 stands for, where a file states it: .3mf and USD.
    Positions are the posed ones; normals are the surface's ``frames``, without which viewers shade it flat.

    Returns ``files``, the paths of what is written, and ``image_bytes``, what the images take. Each file is
    replaced whole or not at all. Raises ArgumentError for another ending, ModelError for values that the
    format cannot say, MissingExtraError, and OutputError if a file cannot be written.
    """
    as_surface(surface)
    path = as_path(path, "path")
    as_choice(images, IMAGE_FORMATS, "images")
    as_choice(unit, METERS, "unit")
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ArgumentError(
            f"{path.name} must end in {', '.join(WRITTEN_ENDINGS[:-1])} or {WRITTEN_ENDINGS[-1]}"
        )
    check_extra(path)
    return writer(surface, path, images, unit)
