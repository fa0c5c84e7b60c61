"""Which way up a photograph is: EXIF's orientation."""

from __future__ import annotations

import io
import warnings
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.source.alone import alone

Code = TypeVar("Code", bound=np.generic)

#: EXIF's tag of the orientation (CIPA DC-008, 4.6.5), and the first and last of its values.
_TAG, _UPRIGHT, _MOST = 0x0112, 1, 8


def orientation_of(data: bytes) -> int:
    """Return the EXIF orientation of an image file, 1 … 8; 1 if it says none."""
    try:
        with alone():
            warnings.simplefilter("ignore")
            with PIL.Image.open(io.BytesIO(data), formats=["JPEG", "PNG", "TIFF", "WEBP", "AVIF"]) as image:
                found = image.getexif().get(_TAG, _UPRIGHT)
    except Exception:  # Pillow's plugins raise nearly anything; what is no such file has no orientation
        return _UPRIGHT
    return found if isinstance(found, int) and _UPRIGHT <= found <= _MOST else _UPRIGHT


def turned(texels: npt.NDArray[Code], orientation: int) -> npt.NDArray[Code]:
    """Return texels (height, width, …), stored as an orientation says, upright."""
    bits = orientation - _UPRIGHT
    if bits & 4:  # rows are the picture's columns
        texels = texels.swapaxes(0, 1)
    if bits & 3 in (1, 2):
        texels = texels[:, ::-1]
    if bits & 3 in (2, 3):
        texels = texels[::-1]
    return np.ascontiguousarray(texels)
