"""Images of materials as files for other tools."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import PIL.Image

from octex.arrays import Array, Float32s, Uint8s
from octex.channels import encode
from octex.errors import ModelError
from octex.parallel import ordered_map, workers
from octex.source.materials import Material, MaterialSource
from octex.source.surface import Surface

ImageFormat = Literal["png", "jpeg", "webp"]
IMAGE_FORMATS: tuple[ImageFormat, ...] = ("png", "jpeg", "webp")
#: How Pillow writes them. zlib's level 3 takes a third of the time of its own choice, for a tenth more bytes.
_SETTINGS: dict[ImageFormat, dict[str, Any]] = {
    "png": {"compress_level": 3},
    "jpeg": {"quality": 95, "subsampling": 0},
    "webp": {"lossless": True, "exact": True},
}


def materials_of(surface: Surface) -> MaterialSource:
    """Return the materials that a surface's values come from; raises ModelError if they do not."""
    if not isinstance(surface.source, MaterialSource):
        raise ModelError(f"{surface.name}: its values do not come from materials; bake it first")
    return surface.source


def normals_of_vertices(surface: Surface) -> Float32s | None:
    """Return shading normals of posed vertices (n, 3), the mean of their corners'; None if there are none."""
    frames = surface.posed_frames()
    if frames is None:
        return None
    sums = np.zeros(surface.vertices.shape)
    for corner in range(3):
        np.add.at(sums, surface.triangles[:, corner], frames.normals.values[frames.normals.rows[:, corner]])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray(sums / np.where(lengths > 0.0, lengths, 1.0), np.float32)


def colors_of_vertices(surface: Surface) -> Float32s | None:
    """Return colours of vertices (n, 4), linear light and alpha; None where a surface has none.

    Raises ModelError for colours that differ between the corners of a vertex.
    """
    colors = materials_of(surface).colors
    if colors is None:
        return None
    if colors.rows is not surface.triangles and not np.array_equal(colors.rows, surface.triangles):
        raise ModelError(f"{surface.name}: its colours belong to corners, not to vertices; bake it first")
    return colors.values


def codes_of(colors: Float32s) -> Uint8s:
    """Return colours (n, 4), linear light and alpha, as codes of 8 bits: sRGB and coverage."""
    codes = [encode(colors[:, :3], "uint8", "srgb"), encode(colors[:, 3:], "uint8", "data")]
    return np.concatenate(codes, axis=1)


def encoded_images(
    materials: Sequence[Material], form: ImageFormat
) -> tuple[list[tuple[bytes, ImageFormat]], dict[int, int]]:
    """Return the files of all images that materials read, each once, and their numbers by the ids of texels.

    Alpha is in a file if a material that is not opaque reads it.
    """
    texels: dict[int, tuple[Array, bool]] = {}
    for material in materials:
        for name, given in material.inputs.items():
            if given.texture is not None:
                key = id(given.texture.texels)
                _, is_covered = texels.get(key, (None, False))
                is_covered |= name == "alpha" and material.alpha_mode != "opaque"
                texels[key] = given.texture.texels, is_covered
    with workers(None, None, len(texels)) as pool:
        files = ordered_map(
            pool, lambda each: image_file(each[0], slice(4 if each[1] else 3), form), list(texels.values())
        )
        return list(files), {key: number for number, key in enumerate(texels)}


def image_file(
    texels: Array, lanes: slice | tuple[int, ...], form: ImageFormat = "png"
) -> tuple[bytes, ImageFormat]:
    """Return an image file of some lanes of texels (height, width, 4), and its format.

    With alpha "jpeg" gives a PNG. Raises ModelError for floats.
    """
    if texels.dtype != np.uint16:
        raise ModelError("images of 8 bits hold no floats; bake the surface first")
    codes = ((texels[..., lanes] + np.uint32(128)) // np.uint32(257)).astype(np.uint8)
    image = PIL.Image.fromarray(codes[..., 0] if codes.shape[-1] == 1 else codes)
    made: ImageFormat = "png" if form == "jpeg" and codes.shape[-1] == 4 else form
    file = io.BytesIO()
    image.save(file, made, **_SETTINGS[made])
    return file.getvalue(), made
