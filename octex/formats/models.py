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
    """Write a surface with images from ``bake``, or with vertex colours from ``bake_vertices``.

    path    ends in .glb (one file), .gltf (with a .bin and images), .obj (with .mtl and images), .usdz (one
            file) or .usd, .usda, .usdc (with images); with vertex colours also .ply or .3mf. USD needs the
            extra ``usd``, 3MF the extra ``3mf``
    images  format of the images: "png"; "webp", smaller, not in USD; "jpeg", lossy for colours without alpha;
            "jpeg-all", lossy for all maps without alpha; "exr" for maps of floats, not in glTF
    unit    what a length of 1 means in .3mf and USD

    Positions are the posed ones, normals the surface's ``frames``. Images of UDIM tiles are named
    NAME-base_color.1001.png.

    Returns ``files``, the written paths, and ``image_bytes``, the size of the images. Each file is replaced
    completely or not at all. Raises ArgumentError for another ending, ModelError for values that the format
    cannot hold, MissingExtraError, and OutputError if a file cannot be written.
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
