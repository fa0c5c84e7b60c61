"""Writes models for other tools, by the endings of their files; helpers that the writers share."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Uint8s
from octex.channels import encode
from octex.checks import as_choice, as_path
from octex.errors import ArgumentError, MissingExtraError, ModelError
from octex.formats.images import IMAGE_FORMATS, ImageFormat
from octex.source.materials import MaterialSource
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture

Unit = Literal["meter", "centimeter", "millimeter", "inch", "foot"]
#: Units of length that files can state, in metres.
METERS: dict[Unit, float] = {
    "meter": 1.0, "centimeter": 0.01, "millimeter": 0.001, "inch": 0.0254, "foot": 0.3048,
}  # fmt: skip
#: Models that reach no farther from the origin than this multiple of their size keep their positions: float32
#: moves no vertex by more than 4·10⁻⁶ of the size.
_FAR = 64.0
#: Significant digits of an origin, so that every format stores it exactly.
_DIGITS = 5
#: Modules that write models, by file ending. Those of USD and 3MF import optional packages.
_WRITERS = {
    ".glb": "gltf",
    ".gltf": "gltf",
    ".obj": "obj",
    **dict.fromkeys((".usdz", ".usd", ".usda", ".usdc"), "usd"),
    ".ply": "ply",
    ".3mf": "threemf",
}
#: Writers that need a module, its package, and the extra with it.
_EXTRAS = {"threemf": ("lib3mf", "lib3mf", "3mf"), "usd": ("pxr", "usd-core", "usd")}

#: The image format that a writer's files cannot hold, and why.
_REFUSED = {
    "gltf": ("exr", "glTF holds no exr images; write a .obj or .usdz, or png with 16 bits"),
    "usd": ("webp", "USD holds no webp images; write png, jpeg or exr"),
}

#: File endings of models that octex writes.
WRITTEN_ENDINGS = tuple(_WRITERS)


class Target(NamedTuple):
    """Where and how a model is written."""

    path: Path
    images: ImageFormat
    unit: Unit  # the length of 1
    octree: OctreeTexture | None = None  # embedded in the model


class Written(NamedTuple):
    """The files of a model."""

    files: list[Path]  # the model first
    image_bytes: int  # size of its images, inside the model's file or next to it


def materials_of(surface: Surface) -> MaterialSource:
    """Return the materials of a surface; raises ModelError if its source has none."""
    if not isinstance(surface.source, MaterialSource):
        raise ModelError(f"{surface.name}: its values do not come from materials; bake it first")
    return surface.source


def colors_of_vertices(surface: Surface) -> Float32s | None:
    """Return linear colours and alpha (n, 4) of vertices, or None; ModelError for several at one vertex."""
    colors = materials_of(surface).colors
    if colors is None:
        return None
    if colors.rows is not surface.triangles and not np.array_equal(colors.rows, surface.triangles):
        raise ModelError(f"{surface.name}: its colours belong to corners, not to vertices; bake it first")
    return colors.values


def needed_colors(surface: Surface, ending: str) -> Float32s:
    """Return colours of vertices, or raise ModelError: files with this ending hold nothing else."""
    colors = colors_of_vertices(surface)
    if colors is None:
        raise ModelError(
            f"{surface.name}: {ending} files hold colours at vertices; use bake_vertices, or write a .glb"
        )
    return colors


def codes_of(colors: Float32s) -> Uint8s:
    """Return colours (n, 4), linear light and alpha, as 8-bit integers: sRGB and coverage."""
    codes = [encode(colors[:, :3], "uint8", "srgb"), encode(colors[:, 3:], "uint8", "data")]
    return np.concatenate(codes, axis=1)


def origin_of(vertices: Float64s) -> Float64s:
    """Return the origin (3,) that float32 positions are relative to: (0, 0, 0) unless that is far away."""
    low, high = vertices.min(axis=0, initial=np.inf), vertices.max(axis=0, initial=-np.inf)
    if not np.maximum(-low, high).max() > _FAR * (high - low).max():
        return np.zeros(3)
    return np.array([float(f"{each:.{_DIGITS - 1}e}") for each in (low + high) / 2])


def check_written(path: Path, images: ImageFormat) -> str:
    """Return the module that writes a file with images; raises errors like ``write_model``."""
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ArgumentError(
            f"{path.name} must end in {', '.join(WRITTEN_ENDINGS[:-1])} or {WRITTEN_ENDINGS[-1]}"
        )
    refused, why = _REFUSED.get(writer, ("", ""))
    if images == refused:
        raise ModelError(f"{path.name}: {why}")
    module, package, extra = _EXTRAS.get(writer, ("", "", ""))
    if module and find_spec(module) is None:
        raise MissingExtraError.needed(f"to write {path.name}", package, extra)
    return writer


def write_model(
    surface: Surface,
    path: str | os.PathLike[str],
    *,
    images: ImageFormat = "png",
    unit: Unit = "meter",
    octree: OctreeTexture | None = None,
) -> Written:
    """Write a surface with images from ``bake``, or with vertex colours from ``bake_vertices``.

    path    ends in .glb (one file), .gltf (with a .bin and images), .obj (with .mtl and images), .usdz (one
            file) or .usd, .usda, .usdc (with images); with vertex colours also .ply or .3mf. USD needs the
            extra ``usd``, 3MF the extra ``3mf``
    images  format of the images: "png"; "webp", smaller, not in USD; "jpeg", lossy for colours without alpha;
            "jpeg-all", lossy for all maps without alpha; "exr" for maps of floats, not in glTF
    unit    what a length of 1 means in .3mf and USD
    octree  the texture itself, which a .glb or .gltf then carries with 8 bits, by EXT_octree_texture. Viewers
            that know the extension show it, and ``octex.open`` reads it; others show the images or vertex
            colours. For a .gltf it is the separate file NAME.octw

    Positions are the posed ones, normals the surface's ``frames``. Images of UDIM tiles are named
    NAME-base_color.1001.png.

    Returns ``files``, the written paths, and ``image_bytes``, the size of the images. Each file is replaced
    completely or not at all. Raises ArgumentError for another ending, for an ``octree`` in another format and
    for one of another surface; ModelError for values that the format cannot hold; MissingExtraError; and
    OutputError if a file cannot be written.
    """
    as_surface(surface)
    path = as_path(path, "path")
    as_choice(images, IMAGE_FORMATS, "images")
    as_choice(unit, METERS, "unit")
    writer = check_written(path, images)
    if octree is not None:
        if writer != "gltf":
            raise ArgumentError(f"{path.name} cannot carry an octree; write a .glb or .gltf")
        surface = surface.placed_on(as_texture(octree))
    target = Target(path, images, unit, octree)
    written: Written = import_module(f"octex.formats.{writer}").write(surface, target)
    return written
