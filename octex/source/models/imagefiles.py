"""The image files of a material file, and what it asks to be done to them before they are used."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from octex.arrays import Int64s, Uint16s
from octex.channels import LUMINANCE
from octex.files import read_bytes
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import CLAMP, Texels

# Grey images that went through JPEG differ by a few codes of 255; normal maps by about a hundred.
_GREY = 8 / 255
_ROWS = 256  # how many rows of an image are in work at a time


class ImageFiles:
    """The images of a model's materials, each read and changed once, and the digests of what was read."""

    def __init__(self, folder: Path) -> None:
        self.files: dict[str, str] = {}
        self._folder = folder
        self._texels: dict[tuple[object, ...], Texels] = {}

    def note(self, path: Path, data: bytes) -> None:
        """Remember that a file was read."""
        inside = path.is_relative_to(self._folder)
        name = path.relative_to(self._folder).as_posix() if inside else path.name
        self.files[name] = hashlib.sha256(data).hexdigest()

    def read(self, path: Path, what: str, base: float = 0.0, gain: float = 1.0) -> Texels:
        """Return texels whose values t are made base + gain · t, kept in 0 … 1; light above 1 stays."""
        key = (path, base, gain)
        if key not in self._texels:
            if (base, gain) == (0.0, 1.0):
                data = read_bytes(path)
                self.note(path, data)
                self._texels[key] = decode_image(data, what)
            else:
                self._texels[key] = _ranged(self.read(path, what), base, gain)
        return self._texels[key]

    def luminance(self, texels: Texels) -> Texels:
        """Return an image whose red is another's luminance, taken of stored values, which are no light."""
        key = ("luminance", id(texels))
        if key not in self._texels:
            grey = texels[..., :3].astype(np.float32) @ LUMINANCE.astype(np.float32)
            grey = np.repeat(grey[..., None], 4, axis=2)
            self._texels[key] = np.rint(grey).astype(np.uint16) if texels.dtype.kind == "u" else grey
        return self._texels[key]

    def normals(self, texels: Texels, lane: int, strength: float, wrap: int) -> Texels:
        """Return the normal map of one lane's heights."""
        key = ("normals", id(texels), lane, strength, wrap)
        if key not in self._texels:
            unit = 65535.0 if texels.dtype.kind == "u" else 1.0
            self._texels[key] = normals_of_heights(texels[..., lane], strength / unit, wrap)
        return self._texels[key]


def _ranged(texels: Texels, base: float, gain: float) -> Texels:
    changed: Texels
    if texels.dtype.kind == "u":
        codes = np.clip(np.rint(65535.0 * base + gain * np.arange(65536)), 0, 65535)
        changed = codes.astype(np.uint16)[texels]
    else:
        changed = np.maximum(np.float32(base) + np.float32(gain) * texels, np.float32(0))
    return changed


def is_grey(texels: Texels) -> bool:
    """Say whether red, green and blue are the same all over an image."""
    limit = _GREY * (65535.0 if texels.dtype.kind == "u" else 1.0)
    for first in range(0, len(texels), _ROWS):
        block = texels[first : first + _ROWS, :, :3].astype(np.float32)
        if (np.ptp(block, axis=2) > limit).any():
            return False
    return True


def normals_of_heights(
    heights: npt.NDArray[np.floating | np.unsignedinteger], strength: float, wrap: int
) -> Uint16s:
    """Return the tangent-space normal map (height, width, 4) of a height map (height, width), rows down.

    The slopes are central differences, per texel, of ``strength`` × height; at the border the image is
    continued by ``wrap``, REPEAT or CLAMP. Codes are (x + 1) / 2 of 65535, x right, y up, z out.
    """
    height, width = heights.shape
    texels = np.full((height, width, 4), 65535, np.uint16)
    columns = _continued(np.arange(-1, width + 1), width, wrap)
    for first in range(0, height, _ROWS):
        last = min(first + _ROWS, height)
        rows = _continued(np.arange(first - 1, last + 1), height, wrap)
        block = heights[rows][:, columns].astype(np.float32) * np.float32(strength / 2)
        right = block[1:-1, 2:] - block[1:-1, :-2]
        up = block[:-2, 1:-1] - block[2:, 1:-1]
        normals = np.stack([-right, -up, np.ones_like(up)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        texels[first:last, :, :3] = np.rint((normals + 1) * np.float32(32767.5))
    return texels


def _continued(indices: Int64s, size: int, wrap: int) -> Int64s:
    return np.clip(indices, 0, size - 1) if wrap == CLAMP else indices % size
