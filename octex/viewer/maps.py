"""The model's base colour images, shown next to the octree, and the mesh's coordinates in them.

Images are PNG, or WebP in small pages. The mesh's stream has each vertex's image coordinates, in multiples of
2⁻ᵇ, and vertex colours as sRGB codes, if any. Its triangles are sorted by material.
"""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import PIL.Image

from octex.arrays import Array, Float64s, Uint8s
from octex.channels import encode
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT, Texels
from octex.source.materials import Input, MaterialSource

if TYPE_CHECKING:
    from octex.source.surface import Surface

_QUALITY = 75  # of WebP
#: Bits by which coordinates are finer than texels, in small pages and in others.
_FINER_SMALL, _FINER = 2, 6
_LEAST_BITS = 12
_WRAPS = {REPEAT: "repeat", MIRROR: "mirror", CLAMP: "clamp"}
_MOST = 1 << 30
_WHITE = Input((1.0, 1.0, 1.0))


class Maps(NamedTuple):
    """The images and coordinates that the page shows as the source."""

    materials: Array  # (m,)   of each triangle; those of a material come together
    columns: Array  # (m, 3, k)   of their corners: coordinates, and colours if there are any
    header: dict[str, Any]
    images: list[bytes]
    notes: list[str]


def maps_of(surface: Surface, *, small: bool = False, room: int | None = None) -> Maps | None:
    """Return base colour images, if any; for a ``small`` page halved until they fit ``room`` bytes."""
    source = surface.source
    if not isinstance(source, MaterialSource):
        return None
    used = np.unique(source.triangle_materials).tolist()
    inputs = {number: source.materials[number].inputs.get("base_color", _WHITE) for number in used}
    textures = [each.texture for each in inputs.values() if each.texture is not None]
    if not textures:
        return None
    texels = {
        (id(each.texels), entry.lanes): each.texels for entry in inputs.values() if (each := entry.texture)
    }
    images, divisor = _files(texels, small, room)
    keys = list(texels)
    coordinates = np.zeros((len(surface.triangles), 3, 2))
    parts, first = [], 0
    for number in used:
        chosen, kind = source.triangle_materials == number, inputs[number]
        count = int(chosen.sum())
        part: dict[str, Any] = {"first": first, "count": count, "factor": list(kind.factor)}
        if kind.texture is not None:
            part["image"] = keys.index((id(kind.texture.texels), kind.lanes))
            part["wraps"] = [_WRAPS[kind.texture.wrap_u], _WRAPS[kind.texture.wrap_v]]
            part["isNearest"] = kind.texture.nearest
            corners = source.coordinates[kind.texture.slot]
            coordinates[chosen] = corners.values[corners.rows[chosen]]
        parts.append(part)
        first += count
    side = max(max(each.shape[:2]) for each in texels.values())
    bits = max(math.ceil(math.log2(side)) + (_FINER_SMALL if small else _FINER), _LEAST_BITS)
    bits = min(bits, math.floor(math.log2(_MOST / max(float(np.abs(coordinates).max()), 1.0))))
    columns = [np.rint(coordinates * (1 << bits)).astype(np.int32)]
    has_colors = source.colors is not None and bool((source.colors.values[:, :3] != 1.0).any())
    if has_colors:
        assert source.colors is not None
        colors = encode(np.clip(source.colors.values[:, :3], 0.0, 1.0), "uint8", "srgb")
        columns.append(colors[source.colors.rows].astype(np.int32))
    header = {"bits": bits, "hasColors": has_colors, "parts": parts, "bytes": [len(each) for each in images]}
    notes = [f"source: images at 1/{divisor} of their size"] if divisor > 1 else []
    return Maps(source.triangle_materials, np.concatenate(columns, axis=2), header, images, notes)


def _files(
    texels: dict[tuple[int, tuple[int, ...]], Texels], small: bool, room: int | None
) -> tuple[list[bytes], int]:
    """Return image files, and the factor by which they were reduced to fit."""
    divisor = 1
    encoded = [PIL.Image.fromarray(_codes(each, lanes)) for (_, lanes), each in texels.items()]
    while True:
        files = [_file(image, small) for image in encoded]
        if room is None or sum(map(len, files)) <= room or max(max(each.size) for each in encoded) == 1:
            return files, divisor
        divisor *= 2
        encoded = [each.reduce(2) for each in encoded]


def _file(image: PIL.Image.Image, small: bool) -> bytes:
    file = io.BytesIO()
    if small:
        image.save(file, "WEBP", quality=_QUALITY, method=6)
    else:
        image.save(file, "PNG", compress_level=1)
    return file.getvalue()


def _codes(texels: Texels, lanes: tuple[int, ...]) -> Uint8s:
    """Return sRGB codes (height, width, 3)."""
    chosen = texels[..., list(lanes)]
    if chosen.dtype == np.uint16:
        return np.asarray((chosen.astype(np.uint32) + 128) // 257, np.uint8)
    light: Float64s = np.clip(chosen, 0.0, 1.0)
    return np.asarray(encode(light, "uint8", "srgb"), np.uint8)
