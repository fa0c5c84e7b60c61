"""Studio light as the page reads it: the tables that the library lights its own pictures by.

One stream of 16-bit floats, each less the one before: the studio's tables, one after another, then A and B of
the reflectance A·F₀ + B.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from octex.drawing.environment import Environment
from octex.drawing.reflection import reflectances
from octex.viewer.streams import deflated, planes, zigzag


@cache
def packed_studio() -> tuple[dict[str, Any], bytes]:
    """Return what the page's header says of the studio light, and the stream."""
    tables, reflectance = Environment.studio().tables, reflectances()
    light = tables.light[:, 0]  # it is grey
    halves = np.concatenate([light, reflectance.ravel()]).astype("<f2").view("<u2").astype(np.int64)
    header = {"tables": tables.shapes.tolist(), "reflectances": len(reflectance), "numbers": halves.size}
    return header, deflated(planes(zigzag(np.diff(halves, prepend=0))), 9)
