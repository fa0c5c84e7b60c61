"""Areas of cells, from their parents' and their siblings'.

The areas of a node's children make up its own. A surface that faces one axis has the same area over each
face of the lattice that it lies above or below: that is the sum of the cells in a column along the axis. So
the area of a cell that is alone in its column is that of one beside it, and of a cell above another it is
what that one leaves of the column. What is left of the node, and which cells lie around, say the rest.
"""

from __future__ import annotations

import numpy as np

from octex.archive.entropy import DECODES, Coder, code_token, wide
from octex.archive.structure import ABOUT, OWN
from octex.arrays import Int32s, Uint8s, Uint32s
from octex.jit import inlined, kernel, popcount
from octex.tree.layout import AREA_ONE, AREA_STEPS, FACING_FLAGS, TreeArrays

_PARTS = 6
#: Contexts: 21 of which cells are around, 3 of how many children are left, 4 each of the largest area beside
#: and of that along the axis, parts of the area that is left; then those of split rows.
_SHAPES = 21 * 3 * 4 * 4 + 3
CONTEXTS = _SHAPES * _PARTS, 0
_BITS = 30  # of an area of one
#: From so many steps of area below all of it on, what is left is a smaller part.
_STEPS = 4, 9, 17, 25, 36
_NO_AXIS = 20
#: 2³⁰ times the areas of codes, whole.
_AREAS = np.rint(np.exp2((np.arange(256) - AREA_ONE) / AREA_STEPS + _BITS)).astype(np.int64)
_AREAS[0] = 0
#: Steps of an octave, by the eight bits below the highest.
_STEPS_OF = np.floor(AREA_STEPS * np.log2(1 + (np.arange(256) + 0.5) / 256)).astype(np.uint8)
#: The axis that a cell of some facings faces, 3 for several.
_AXIS_OF = np.full(FACING_FLAGS + 1, 3, np.uint8)
_AXIS_OF[1 << np.arange(6)] = np.arange(6) >> 1
#: Tokens of differences: 8 less or more, 0, 1, 2, then how many bits they have less one, and 2; the last has
#: 7. Of each the bits, and the least that they are.
_TOKEN_OF = np.searchsorted([1, 2, 3, 5, 9, 17, 33, 65], np.arange(256), side="right").astype(np.uint8)
_BITS_OF = np.array([6, 5, 4, 3, 2, 1, 0, 0, 0, 0, 0, 1, 2, 3, 4, 7])
_LEAST_OF = np.array([65, 33, 17, 9, 5, 3, 2, 1, 0, 1, 2, 3, 5, 9, 17, 33])


@inlined
def _code(area: int) -> int:
    """Return the code of the largest area that is not above ``area``, below 2⁵²."""
    bits = wide(np.float64(area).view(np.int64))
    code = AREA_ONE + AREA_STEPS * ((bits >> 52) - 1023 - _BITS) + wide(_STEPS_OF[bits >> 44 & 255]) - 1
    code = min(max(code, 0), 253)
    # Areas ascend: neither waits for the other.
    return code + wide(_AREAS[np.uint64(code + 1)] <= area) + wide(_AREAS[np.uint64(code + 2)] <= area)


@inlined
def _code_area(area: int, guess: int, whole: int, rest: int, shape: int, coder: Coder) -> int:
    """Note or decode an area as part of a whole; return it. A ``guess`` below 0 is all that is left."""
    rest, part = max(rest, _AREAS[np.uint64(whole)] >> 8), wide(0)
    for step in _STEPS:
        part += wide(rest >= _AREAS[np.uint64(max(whole + 1 - step, 0))])
    if guess < 0:
        guess = _code(rest)
    far = (area - guess + 128 & 255) - 128
    size = abs(far)
    token = wide(_TOKEN_OF[np.uint64(size)])
    token = 8 - token if far < 0 else min(8 + token, 15)
    plain = size - _LEAST_OF[np.uint64(token)]
    token, plain = code_token(token, plain, _BITS_OF, shape * _PARTS + part, coder)
    far = wide(_LEAST_OF[np.uint64(token)] + plain)
    return guess + (-far if token < 8 else far) & 255


@inlined
def _size(area: int, whole: int) -> int:
    """Return one of four sizes of an area."""
    return wide(area > 0) * (1 + wide(whole - area >= 8) + wide(whole - area >= 16))


@kernel
def code_areas(arrays: TreeArrays, begin: int, rows: Int32s, around: Uint32s, coder: Coder) -> None:
    """Note or decode the areas of cells from ``begin`` on; ``rows``, ``around`` lie around them."""
    flags, areas = arrays.flags, arrays.areas
    rest = whole = wide(0)
    left, node = 1, -1
    beside = np.zeros(3, np.int64)
    for t in range(rows.shape[0]):
        if left == 1:
            node += 1
            # A child's face is a quarter of its parent's: so many steps.
            whole = min(wide(areas[around[node, OWN]]) + 2 * AREA_STEPS, 255)
            rest = _AREAS[whole]
        about = wide(rows[np.uint64(t), ABOUT])
        left = about & 15
        for k in range(3):
            other = wide(rows[np.uint64(t), k])
            # Whether one lies there is as good as random: no branch.
            is_there = -wide(other >= 0)
            beside[k] = wide(areas[np.uint64(begin + other & is_there)]) & is_there
        axis = wide(_AXIS_OF[flags[begin + t] & FACING_FLAGS])
        x, y, z = beside[0], beside[1], beside[2]
        along = y if axis == 1 else z if axis == 2 else x
        across = max(x if axis == 1 or axis == 2 else 0, max(0 if axis == 1 else y, 0 if axis == 2 else z))
        shape, guess = wide(_NO_AXIS), whole
        if axis < 3:
            pairs = about >> 8 & 63
            pair = pairs >> 2 * axis & 3
            shape = 5 * pair + popcount(pairs) - popcount(pair)
            if pair == 0:
                guess = across if across > 0 else whole
            elif pair < 3 and along > 0:
                column = _AREAS[areas[around[node, OWN]]]
                for k in range(2 * axis, 2 * axis + 2):
                    if around[node, k] != around[node, OWN]:
                        column += _AREAS[areas[around[node, k]]]
                guess = _code(max(column - _AREAS[along], column >> 6))
        context = ((shape * 3 + min(left, 3) - 1) * 4 + _size(across, whole)) * 4 + _size(along, whole)
        guess = -1 if left == 1 else guess
        area = _code_area(wide(areas[begin + t]), guess, whole, rest, context, coder)
        rest = max(rest, _AREAS[whole] >> 8) - _AREAS[area]
        if coder.work == DECODES:
            areas[begin + t] = area


@kernel
def code_row_areas(owners: Uint32s, areas: Uint8s, begin: int, cell_areas: Uint8s, coder: Coder) -> None:
    """Likewise the areas of rows from ``begin`` on, a row of each cell of ``owners``."""
    rest = whole = left = wide(0)
    for n in range(owners.size):
        if left == 0:
            while n + left < owners.size and owners[n + left] == owners[n]:
                left += 1
            whole = wide(cell_areas[owners[n]])
            rest = _AREAS[whole]
        context, guess = _SHAPES - 4 + min(left, 3), -1 if left == 1 else whole
        area = _code_area(wide(areas[begin + n]), guess, whole, rest, context, coder)
        rest = max(rest, _AREAS[whole] >> 8) - _AREAS[area]
        if coder.work == DECODES:
            areas[begin + n] = area
        left -= 1
