"""Models written for other tools, by the endings of their files."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from octex.checks import as_choice, as_path
from octex.errors import ArgumentError, MissingExtraError
from octex.formats.images import IMAGE_FORMATS, ImageFormat
from octex.formats.shared import METERS, Target, Unit, Written
from octex.source.surface import Surface, as_surface

#: The modules that write models, by the endings of the files. Those of USD and 3MF import optional packages.
_WRITERS = {
    ".glb": "gltf",
    ".gltf": "gltf",
    ".obj": "obj",
    **dict.fromkeys((".usdz", ".usd", ".usda", ".usdc"), "usd"),
    ".ply": "ply",
    ".3mf": "threemf",
}
#: What some writers need: a module, its package, and the extra of it.
_EXTRAS = {"threemf": ("lib3mf", "lib3mf", "3mf"), "usd": ("pxr", "usd-core", "usd")}

#: The endings of model files that octex writes.
WRITTEN_ENDINGS = tuple(_WRITERS)


def check_extra(path: Path) -> None:
    """Raise MissingExtraError if a package is not installed that writes files of this ending."""
    module, package, extra = _EXTRAS.get(_WRITERS.get(path.suffix.lower(), ""), ("", "", ""))
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
    written: Written = import_module(f"octex.formats.{writer}").write(surface, Target(path, images, unit))
    return written
