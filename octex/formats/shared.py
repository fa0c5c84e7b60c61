"""What the writers of models share: where and how they write, and what they read of a surface."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Uint8s
from octex.channels import encode
from octex.errors import ModelError
from octex.formats.images import ImageFormat
from octex.source.materials import MaterialSource
from octex.source.surface import Surface

Unit = Literal["meter", "centimeter", "millimeter", "inch", "foot"]
#: Units of length that files can state, in metres.
METERS: dict[Unit, float] = {
    "meter": 1.0, "centimeter": 0.01, "millimeter": 0.001, "inch": 0.0254, "foot": 0.3048,
}  # fmt: skip
#: Models that reach no farther from the origin than so many times their size are written as they are:
#: float32 moves no vertex by more than 4·10⁻⁶ of that.
_FAR = 64.0
#: Significant digits of an origin: as many as all files hold.
_DIGITS = 5


class Target(NamedTuple):
    """Where a model is written to, and how."""

    path: Path
    images: ImageFormat
    unit: Unit  # the length that 1 stands for


class Written(NamedTuple):
    """The files of a model."""

    files: list[Path]  # the model's own first
    image_bytes: int  # how many bytes its images take, inside the model's file or beside it


def materials_of(surface: Surface) -> MaterialSource:
    """Return the materials that a surface's values come from; raises ModelError if they do not."""
    if not isinstance(surface.source, MaterialSource):
        raise ModelError(f"{surface.name}: its values do not come from materials; bake it first")
    return surface.source


def colors_of_vertices(surface: Surface) -> Float32s | None:
    """Return linear colours and alpha (n, 4) of vertices, or None; refuse several at one vertex."""
    colors = materials_of(surface).colors
    if colors is None:
        return None
    if colors.rows is not surface.triangles and not np.array_equal(colors.rows, surface.triangles):
        raise ModelError(f"{surface.name}: its colours belong to corners, not to vertices; bake it first")
    return colors.values


def needed_colors(surface: Surface, ending: str) -> Float32s:
    """Return colours of vertices, or raise ModelError: files of this ending hold nothing else."""
    colors = colors_of_vertices(surface)
    if colors is None:
        raise ModelError(
            f"{surface.name}: {ending} files hold colours at vertices; use bake_vertices, or write a .glb"
        )
    return colors


def codes_of(colors: Float32s) -> Uint8s:
    """Return colours (n, 4), linear light and alpha, as codes of 8 bits: sRGB and coverage."""
    codes = [encode(colors[:, :3], "uint8", "srgb"), encode(colors[:, 3:], "uint8", "data")]
    return np.concatenate(codes, axis=1)


def origin_of(vertices: Float64s) -> Float64s:
    """Return the origin (3,) that float32 positions are written from, (0, 0, 0) unless it is far away."""
    low, high = vertices.min(axis=0, initial=np.inf), vertices.max(axis=0, initial=-np.inf)
    if not np.maximum(-low, high).max() > _FAR * (high - low).max():
        return np.zeros(3)
    return np.array([float(f"{each:.{_DIGITS - 1}e}") for each in (low + high) / 2])
