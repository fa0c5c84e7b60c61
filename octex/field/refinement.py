"""What passes between the windows of a walk: coefficients down to finer cells, shares up to coarser ones."""

from __future__ import annotations

import numpy as np

from octex.field.splines import LINEAR, refine, send_up
from octex.field.windows import (
    BEGIN,
    COLOR,
    CONTENT,
    COVER,
    INSIDE,
    KEEPING,
    REFINED,
    SHARES,
    UPPER,
    Walk,
    bit_at,
    place_of,
)
from octex.jit import inlined, trailing_zeros


@inlined
def leave_refined(walk: Walk, level: int, filter_code: int, parents: int, columns: int) -> bool:
    """Leave in a window what falls on cells that are refined, and nothing else; say whether there is any."""
    windows, levels = walk.windows, walk.levels
    begin = levels[level, BEGIN]
    if filter_code == LINEAR:
        find_colors(walk, level)
    found = False
    for word in range(1 if parents == 2 else 4):
        inside = INSIDE[parents - 2, begin, word]
        refined = ~walk.real[level, word]
        if filter_code == LINEAR:
            refined = walk.below_leaves[level, word]
        elif levels[level, KEEPING]:
            refined |= walk.below_kept[level, word] & ~walk.cells[level, word]
        bits = inside & ~refined
        while bits != 0:
            at = place_of(parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(columns):
                windows[SHARES + column, at] = 0.0
        bits = inside & refined
        while bits != 0:
            at = place_of(parents, begin, 64 * word + trailing_zeros(bits))
            bits &= bits - np.uint64(1)
            for column in range(columns):
                found |= windows[SHARES + column, at] != 0.0
                if filter_code == LINEAR:
                    windows[SHARES + column, at] /= windows[COLOR, at]
    return found


@inlined
def change_level(walk: Walk, row: int, level: int, parents: int, down: bool) -> None:
    """Refine a row from the window above a level to that of the level, or send it up to the one above."""
    windows = walk.windows
    side = 2 * parents - 1
    is_quartic = parents == 3
    step = 1
    for axis in range(3):
        upper = walk.levels[level, UPPER] >> axis & 1 != 0
        for block in range(0, side * side * side, side * step):
            for at in range(block, block + step):
                a, b, c = windows[row, at], windows[row, at + step], windows[row, at + 2 * step]
                d = e = 0.0
                if is_quartic:
                    d, e = windows[row, at + 3 * step], windows[row, at + 4 * step]
                if upper:
                    a, b, c, d, e = (e, d, c, b, a) if is_quartic else (c, b, a, d, e)
                a, b, c, d, e = (
                    refine(is_quartic, a, b, c, d, e) if down else send_up(is_quartic, a, b, c, d, e)
                )
                if upper:
                    a, b, c, d, e = (e, d, c, b, a) if is_quartic else (c, b, a, d, e)
                windows[row, at], windows[row, at + step], windows[row, at + 2 * step] = a, b, c
                if is_quartic:
                    windows[row, at + 3 * step], windows[row, at + 4 * step] = d, e
        step *= side


@inlined
def find_colors(walk: Walk, level: int) -> None:
    """Find how much of the refined cells of a window comes from cells with a colour, as ``linear`` has it."""
    windows = walk.windows
    begin = walk.levels[level - 1, BEGIN]
    windows[COLOR, :27] = 0.0
    nodes, cells, kept = walk.nodes[level - 1, 0], walk.cells[level - 1, 0], walk.kept[level - 1, 0]
    bits = (cells ^ nodes | kept | walk.below_leaves[level - 1, 0]) & INSIDE[0, begin, 0]
    while bits != 0:
        windows[COLOR, place_of(2, begin, trailing_zeros(bits))] = 1.0
        bits &= bits - np.uint64(1)
    change_level(walk, COLOR, level, 2, True)


@inlined
def weigh(walk: Walk, level: int, parents: int) -> None:
    """Find the weights of the coefficients in the windows down to a level."""
    windows, levels = walk.windows, walk.levels
    places = 125 if parents == 3 else 27
    if walk.previous[5] < 0 or levels[walk.previous[5], CONTENT] == 0:
        above = 0
        while levels[above + 1, CONTENT] == 0:
            above += 1
        windows[COVER + above, :places] = 0.0
        windows[COVER + above, places // 2] = levels[above, CONTENT]  # the root's, or nothing
        walk.previous[5] = above
    while walk.previous[5] < level:
        walk.previous[5] += 1
        below = int(walk.previous[5])
        begin = levels[below, BEGIN]
        for at in range(places):
            windows[REFINED + below, at] = windows[COVER + below - 1, at]
        change_level(walk, REFINED + below, below, parents, True)
        for word in range(1 if parents == 2 else 4):
            real, below_kept = walk.real[below, word], walk.below_kept[below, word]
            nodes, cells, kept = walk.nodes[below, word], walk.cells[below, word], walk.kept[below, word]
            refined = ~real | below_kept & ~(nodes & ~kept)
            ones = (cells ^ nodes | kept) & ~below_kept
            bits = INSIDE[parents - 2, begin, word]
            while bits != 0:
                place = trailing_zeros(bits)
                bits &= bits - np.uint64(1)
                at = place_of(parents, begin, 64 * word + place)
                weight = 1.0 if ones & bit_at(place) != 0 else 0.0
                if refined & bit_at(place) != 0:
                    weight = windows[REFINED + below, at]
                windows[COVER + below, at] = weight
