"""The tiles around points, found for 64 of them at once.

All points are placed, by vectors, before any tile is read, and all tiles are found before any value: of
random points most of the time is waiting for memory, and so they wait together. What is known of a tile is
kept while points stay in it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Int64s, Uint8s
from octex.field.tiles import Integer, Tiles, tile_row
from octex.jit import inlined, kernel, prefetch, trailing_zeros

#: Points placed at once: enough that all can wait for memory together, few enough to stay in the first cache.
GROUP = 64


_AXIS_BITS = 20  # of a tile's coordinate plus one, in a key


class Near(NamedTuple):
    """The tiles around each point of a group. Octants are counted over all tiles."""

    keys: Int64s  # (GROUP,)   the tile of the lowest cell that is read, see `tile_key`
    reached: Uint8s  # (GROUP,)   whether cells of the next tile are read too: a bit for each axis
    slots: Int64s  # (GROUP,)   where `octants` of the point begin
    octants: Int64s  # (8 · (GROUP + 1),)   the first of each of 2×2×2 tiles, as far as they are reached
    latest: Int64s  # (3,)   the latest key, its slot, and which of its tiles are known


@kernel
def new_near() -> Near:
    """Return what knows nothing. It serves one tree."""
    return Near(
        np.zeros(GROUP, np.int64),
        np.zeros(GROUP, np.uint8),
        np.zeros(GROUP, np.int64),
        np.zeros(8 * (GROUP + 1), np.int64),
        np.array([-1, 0, 0]),
    )


@inlined
def tile_key(i: Integer, j: Integer, k: Integer) -> Any:
    """Return one number for a tile's coordinates, each from −1 on."""
    one = np.int64(1)
    return i + one | (j + one) << np.int64(_AXIS_BITS) | (k + one) << np.int64(2 * _AXIS_BITS)


@inlined
def _find(tiles: Tiles, key: int, other: int) -> int:
    """Find the first octant of one of the 2×2×2 tiles from that of a key on, and ask for it."""
    low = (1 << _AXIS_BITS) - 1
    i = (key & low) - 1 + (other & 1)
    j = (key >> _AXIS_BITS & low) - 1 + (other >> 1 & 1)
    k = (key >> 2 * _AXIS_BITS) - 1 + (other >> 2)
    octant = 8 * tile_row(tiles, i, j, k)
    prefetch(tiles.masks, octant)
    prefetch(tiles.firsts, octant)
    return octant


@inlined
def find_tiles(tiles: Tiles, near: Near, count: int) -> None:
    """Find the tiles of a group of points, whose keys and reach are known, and ask for them."""
    octants = near.octants
    key, slot, known = near.latest[0], near.latest[1], near.latest[2]
    for other in range(8):
        octants[other] = octants[slot + other]
    slot = 0
    for n in range(count):
        at = np.uint64(n)
        if near.keys[at] != key:
            key = near.keys[at]
            slot += 8
            octants[np.uint64(slot)] = _find(tiles, key, 0)
            known = np.int64(1)
        near.slots[at] = slot
        reached = np.int64(near.reached[at])
        if reached != 0:
            wanted = 1 | (reached & 1) << 1
            wanted |= wanted << 2 & -(reached >> 1 & 1)
            wanted |= wanted << 4 & -(reached >> 2)
            missing = wanted & ~known
            known |= missing
            while missing != 0:
                other = trailing_zeros(np.uint64(missing))
                missing &= missing - 1
                octants[np.uint64(slot + other)] = _find(tiles, key, other)
    near.latest[0], near.latest[1], near.latest[2] = key, slot, known
