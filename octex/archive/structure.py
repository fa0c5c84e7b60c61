"""The neighbours of a block's nodes and children; and the coding of children and flags from them.

A block is a run of nodes of one level. A node has six neighbours across faces, in the order −x, +x, −y, +y,
−z, +z. They are found from the root down, for the block's ancestors alone, so that a block needs only the
levels above it.
"""

from __future__ import annotations

import numpy as np

from octex.archive.entropy import DECODES, FAULT, Coder, code_bit, code_symbol, wide
from octex.archive.layout import Block
from octex.arrays import Int32s, Int64s, Uint32s, Uint64s
from octex.jit import inlined, kernel, part, popcount, trailing_zeros
from octex.tree.children import children
from octex.tree.layout import FACING_FLAGS, MAX_CELLS, TreeArrays

# A node's row: the cells around it, its cell, and the nodes around it. Its cell replaces missing cells,
# NO_NODE missing nodes.
OWN, NODES = 6, 7
_AROUND = 13
NO_NODE = MAX_CELLS
# A child's row: the block's cells across its faces −x, −y and −z, −1 for none; then ABOUT: bits 0 … 3 the
# number of remaining children of its node, including itself, 4 whether any of these is a node, 5 … 7 its
# octant, 8 … 13 for each axis whether a cell lies beyond its node, and a sibling.
ABOUT = 3

# Where contexts of bits begin, of 3 · 4; 4 · 2; 4 · 3 · 4; 3 · 2 · 3; 2.
_LEAVES, _ALIKE, _FACINGS, _SPLIT, _KEPT, _BITS = 0, 8, 16, 64, 82, 84
#: Contexts of symbols, of the four lower octants 2¹⁰, of the upper 2¹¹; and of bits.
CONTEXTS = 3 << 10, _BITS
#: The most bits of a node: 8 children with a leaf, six facings and two other flags.
MOST = 8 * 9 + 3


@inlined
def signed_children(groups: Uint64s, node: int) -> tuple[int, int, int, int]:
    """Return the result of `children`, with masks as signed integers."""
    nodes, stored, first_node, first_cell = children(groups, node)
    return int(np.int64(nodes)), int(np.int64(stored)), first_node, first_cell


@inlined
def before(mask: int, bit: int) -> int:
    """Count a mask's bits before a place."""
    return popcount(mask & (1 << bit) - 1)


@part
def _descended(groups: Uint64s, begin: int, above: Uint32s, first: int, last: int) -> Uint32s:
    """Return the neighbours of nodes ``first`` to ``last``, children of those from ``begin`` on."""
    below = np.empty((last - first, _AROUND), np.uint32)
    room = np.empty((4, 7), np.int64)
    inner, stored, next_node, next_cell = room[0], room[1], room[2], room[3]
    for row in range(above.shape[0]):
        inner[OWN], stored[OWN], next_node[OWN], next_cell[OWN] = signed_children(groups, begin + row)
        for k in range(6):
            node = int(np.int64(above[row, NODES + k]))
            inner[k] = stored[k] = 0
            if node != NO_NODE:
                inner[k], stored[k], next_node[k], next_cell[k] = signed_children(groups, node)
        child, bits = next_node[OWN], inner[OWN]
        while bits:
            octant = trailing_zeros(bits)
            bits &= bits - 1
            if first <= child < last:
                index, cell = np.uint64(child - first), next_cell[OWN] + before(stored[OWN], octant)
                below[index, OWN] = cell
                for k in range(6):
                    across = octant ^ 1 << (k >> 1)
                    at = np.uint64(k if octant >> (k >> 1) & 1 == k & 1 else OWN)  # else a sibling
                    other, node = next_cell[at] + before(stored[at], across), next_node[at]
                    node += before(inner[at], across)
                    below[index, k] = other if stored[at] >> across & 1 else cell
                    below[index, NODES + k] = node if inner[at] >> across & 1 else NO_NODE
            child += 1
    return below


@inlined
def _parent(groups: Uint64s, low: int, high: int, node: int) -> int:
    """Return the node of ``low`` … ``high`` that is a node's parent."""
    high -= 1
    while low < high:
        middle = low + high + 1 >> 1
        if signed_children(groups, middle)[2] <= node:
            low = middle
        else:
            high = middle - 1
    return low


@kernel
def around_nodes(arrays: TreeArrays, block: Block) -> Uint32s:
    """Return a row for each of a block's nodes (n, 13), from the levels above."""
    groups, level_nodes, level = arrays.groups, arrays.level_nodes, block.level
    runs = np.empty((level + 1, 2), np.int64)
    runs[level, 0], runs[level, 1] = block.first, block.last
    for above in range(level - 1, -1, -1):
        low, high = level_nodes[above], level_nodes[above + 1]
        runs[above, 0] = _parent(groups, low, high, runs[above + 1, 0])
        runs[above, 1] = _parent(groups, low, high, runs[above + 1, 1] - 1) + 1
    around = np.zeros((1, _AROUND), np.uint32)
    around[0, NODES:] = NO_NODE
    for above in range(level):
        around = _descended(groups, runs[above, 0], around, runs[above + 1, 0], runs[above + 1, 1])
    return around


@kernel
def around_children(arrays: TreeArrays, block: Block, around: Uint32s) -> Int32s:
    """Return a row for each child of the nodes of a block, in order."""
    first, begin, count = block.first, block.begin.cell, block.last - block.first
    rows = np.empty((block.end.cell - begin, 4), np.int32)
    stored, firsts = np.empty(count, np.uint8), np.empty(count, np.int32)
    has_nodes = np.empty(count, np.uint8)
    for n in range(count):
        inner, mask, _, cell = signed_children(arrays.groups, first + n)
        has_nodes[n], stored[n], firsts[n] = inner != 0, mask, cell - begin
    masks, begins = np.zeros(7, np.int64), np.zeros(7, np.int64)
    t = 0
    for index in range(count):
        masks[OWN], begins[OWN] = stored[index], firsts[index]
        for k in range(6):
            beyond = np.int64(around[index, NODES + k]) - first
            masks[k], begins[k] = 0xFF if around[index, k] != around[index, OWN] else 0, -1
            if 0 <= beyond < count:
                masks[k], begins[k] = stored[beyond], firsts[beyond]
        remaining = popcount(masks[OWN])
        bits = masks[OWN]
        while bits:
            octant = trailing_zeros(bits)
            bits &= bits - 1
            about, row = remaining | np.int64(has_nodes[index]) << 4 | octant << 5, np.uint64(t)
            for axis in range(3):
                across = octant ^ 1 << axis
                upper = octant >> axis & 1
                beyond = masks[np.uint64(2 * axis + upper)] >> across & 1
                about |= ((masks[OWN] >> across & 1) << 1 | beyond) << 2 * axis + 8
                at = np.uint64(OWN if upper else 2 * axis)
                other = begins[at] + before(masks[at], across)
                is_beside = (masks[at] >> across & 1) & np.int64(begins[at] >= 0)
                rows[row, axis] = other if is_beside else -1
            rows[row, ABOUT] = about
            remaining -= 1
            t += 1
    return rows


@inlined
def _mask(masks: Int64s, node: int) -> int:
    """Return the mask of a node, by its number in the block, 0 outside it."""
    is_own = wide(node >= 0) & wide(node < masks.size)  # random: no branch
    return wide(masks[np.uint64(node * is_own)] & -is_own)


@kernel
def code_structure(arrays: TreeArrays, block: Block, around: Uint32s, coder: Coder) -> None:
    """Code the children of a block's nodes, from the cells and nodes around.

    Decoding, it writes their masks, the groups' ranks, and their flags. A count beyond the block's ends sets
    FAULT.
    """
    groups, flags, first, last = arrays.groups, arrays.flags, block.first, block.last
    next_node, next_cell, end_node, end_cell = (
        block.begin.node,
        block.begin.cell,
        block.end.node,
        block.end.cell,
    )
    may_be_nodes = block.level + 3 < arrays.level_cells.size
    decodes = coder.work == DECODES
    # The stored children of the block's nodes, and the first of each.
    masks, begins = np.zeros(last - first, np.int64), np.zeros(last - first, np.int64)
    was_leaf = 0
    for node in range(first, last):
        index = node - first
        is_node = is_leaf = 0
        if not decodes:
            is_node, stored, _, _ = signed_children(groups, node)
            is_leaf = stored ^ is_node
        elif node & 7 == 0:
            groups[node >> 3, 0] = 0
            groups[node >> 3, 1] = 0
            groups[node >> 3, 2] = np.uint64(next_node) | np.uint64(next_cell) << np.uint64(32)
        faces = leaves_beside = 0
        for k in range(6):
            is_there = wide(around[index, k] != around[index, OWN])
            faces |= is_there << k
            leaves_beside += is_there & wide(around[index, NODES + k] == NO_NODE)
        x = _mask(masks, wide(around[index, NODES + 0]) - first)
        y = _mask(masks, wide(around[index, NODES + 2]) - first)
        z = _mask(masks, wide(around[index, NODES + 4]) - first)
        present = wide(is_node | is_leaf)
        context = (x >> 1 & 1 | x >> 2 & 2) << 6 | (y >> 2 & 3) << 4 | z >> 4
        context |= (faces >> 1 & 1 | faces >> 2 & 2) << 8
        mask = code_symbol(present & 15, context, coder)
        context = (x >> 5 & 1 | x >> 6 & 2) << 6 | (y >> 6 & 3) << 4 | mask
        context |= (faces >> 1 & 1 | faces >> 2 & 2 | faces >> 3 & 4) << 8
        mask |= code_symbol(present >> 4, 1024 + context, coder) << 4
        if mask == 0 or next_cell + popcount(mask) > end_cell:
            coder.state[FAULT] = 1
            return
        masks[index], begins[index] = mask, next_cell
        parent = wide(flags[around[index, OWN]])
        count, leaves, alike = popcount(mask), wide(0), wide(1)
        bits = mask if may_be_nodes else 0
        while bits:
            octant = trailing_zeros(bits)
            bits &= bits - 1
            was_leaf = code_bit(is_leaf >> octant & 1, _LEAVES + was_leaf * 4 + min(leaves_beside, 3), coder)
            leaves |= was_leaf << octant
        if not may_be_nodes:
            leaves = mask
        shown = parent & FACING_FLAGS
        for n in range(0 if decodes else count):
            alike &= wide(flags[np.uint64(next_cell + n)] == shown)
        alike = code_bit(alike, _ALIKE + 2 * min(popcount(shown), 3) + (parent >> 7), coder)
        beside_split, union, bits = wide(0), wide(0), mask & alike - 1
        for n in range(count if decodes and alike else 0):
            flags[np.uint64(next_cell + n)] = shown
        next_cell += count & -alike
        while bits:
            octant = trailing_zeros(bits)
            bits &= bits - 1
            flags_beside = wide(0)
            for axis in range(3):
                across = octant ^ 1 << axis
                other = index if octant >> axis & 1 else wide(around[index, NODES + 2 * axis]) - first
                if _mask(masks, other) >> across & 1:
                    flags_beside |= wide(flags[begins[other] + before(masks[other], across)])
            flag, coded_flags, remaining = (0 if decodes else wide(flags[next_cell])), wide(0), shown
            while remaining:
                facing = trailing_zeros(remaining)
                remaining &= remaining - 1
                position = 0 if coded_flags else 1 + wide(remaining == 0)
                known_bits = (flags_beside >> facing & 1) << 1 | union >> facing & 1
                context = _FACINGS + (known_bits * 3 + position) * 4 + min(popcount(shown), 4) - 1
                coded_flags |= code_bit(flag >> facing & 1, context, coder) << facing
            context = _SPLIT + (min(popcount(coded_flags), 2) * 2 + (parent >> 7)) * 3 + beside_split
            coded_flags |= code_bit(flag >> 7, context, coder) << 7
            if leaves >> octant & 1 == 0:
                coded_flags |= code_bit(flag >> 6 & 1, _KEPT + (parent >> 6 & 1), coder) << 6
            beside_split = 1 + (coded_flags >> 7)
            union |= coded_flags
            if decodes:
                flags[next_cell] = coded_flags
            next_cell += 1
        inner = mask & ~leaves
        next_node += popcount(inner)
        if next_node > end_node:
            coder.state[FAULT] = 1
            return
        if decodes:
            shift = np.uint64(8 * (node & 7))
            groups[node >> 3, 0] |= np.uint64(inner) << shift
            groups[node >> 3, 1] |= np.uint64(leaves) << shift
    if next_node != end_node or next_cell != end_cell:
        coder.state[FAULT] = 1
