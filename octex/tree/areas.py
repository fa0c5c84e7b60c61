"""Codes of areas; see layout.

A code is of the area relative to its cell's edge squared, "in cell faces": a child's face is a quarter of its
node's.
"""

from __future__ import annotations

import numpy as np

from octex.arrays import Float64s, Uint8s
from octex.jit import inlined, kernel
from octex.tree.layout import AREA_ONE, AREA_STEPS

#: Areas in cell faces by code. Cells that the surface only touches, code 0, count only where no others do.
AREAS: Float64s = 2.0 ** ((np.arange(256) - AREA_ONE) / AREA_STEPS)
AREAS[0] = 2.0**-44
#: The area of skirts, cells next to painted ones that the surface does not enter: the least area.
SKIRT = np.uint8(1)
#: Smaller areas are contacts: the sum of eight contacts is less, a quarter of the least area more.
_LEAST = 2.0**-40
#: Steps of an area's code by the seven leading mantissa bits.
_MANTISSA_STEPS = np.rint(AREA_STEPS * np.log2(1 + (np.arange(128) + 0.5) / 128)).astype(np.int64)


@inlined
def area_code(area: float) -> int:
    """Return the code of an area in cell faces."""
    if area < _LEAST:
        return 0
    # The float's own exponent, and its leading mantissa bits through a table: a fifth of log2's time.
    bits = np.int64(np.float32(area).view(np.int32))
    code = AREA_STEPS * ((bits >> 23) - 127) + _MANTISSA_STEPS[(bits >> 16) & 127] + AREA_ONE
    return 1 if code < 1 else 255 if code > 255 else code


def area_codes(areas: Float64s) -> Uint8s:
    """Return the codes of areas in cell faces, of any shape."""
    codes = np.empty(areas.shape, np.uint8)
    _write_codes(np.ascontiguousarray(areas).reshape(-1), codes.reshape(-1))
    return codes


@kernel
def _write_codes(areas: Float64s, codes: Uint8s) -> None:
    for n in range(areas.size):
        codes[n] = area_code(areas[n])
