"""What the codes of areas say, and what says areas; see layout.

A code is of the area relative to its own cell's edge squared, "in cell faces": a child's face is a quarter of
its node's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s, Uint8s
from octex.tree.layout import AREA_ONE, AREA_STEPS

#: Areas in cell faces by their codes. What the surface only touches, code 0, weighs next to nothing, so that
#: it decides only where it is alone.
AREAS: Float64s = 2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS)
AREAS[0] = 2.0**-30
#: The area of skirts, cells that the surface is not in, there for the paint beside them: the least there is.
SKIRT = np.uint8(1)
#: Less is a contact: a quarter of the least that is none is more than this, of eight contacts less.
_LEAST = 2.0**-28


def area_codes(areas: Float64s) -> Uint8s:
    """Return the codes of areas in cell faces, of any shape."""
    codes = np.rint(AREA_STEPS * np.log2(np.maximum(areas, _LEAST))) + AREA_ONE
    return np.where(areas >= _LEAST, np.clip(codes, 1, 255), 0).astype(np.uint8)


def shared_codes(codes: Uint8s, parts: npt.ArrayLike) -> Uint8s:
    """Return the codes of areas (n,) that are divided evenly into so many parts, each 1 at least."""
    steps = np.rint(codes - AREA_STEPS * np.log2(np.maximum(parts, 1)))
    return np.where(codes > 0, np.clip(steps, 1, 255), 0).astype(np.uint8)
