"""Which children a node has, which of them are leaves, and their flags, by what is known around."""

from __future__ import annotations

import numpy as np

from octex.archive.around import NO_NODE, NODES, OWN, before, children_of, lowest, ones
from octex.archive.entropy import DECODES, FAULT, Coder, code_bit, code_symbol, wide
from octex.archive.layout import Block
from octex.arrays import Int64s, Uint32s
from octex.jit import inlined, kernel
from octex.tree.layout import FACING_FLAGS, TreeArrays

# Where contexts of bits begin, of 3 · 4; 4 · 2; 4 · 3 · 4; 3 · 2 · 3; 2.
_LEAVES, _ALIKE, _FACINGS, _SPLIT, _KEPT, _BITS = 0, 8, 16, 64, 82, 84
#: Contexts of symbols, of the four lower octants 2¹⁰, of the upper 2¹¹; and of bits.
CONTEXTS = 3 << 10, _BITS
#: The most bits of a node: 8 children with a leaf, six facings and two other flags.
MOST = 8 * 9 + 3


@inlined
def _mask(masks: Int64s, node: int) -> int:
    """Return the mask of a node, by its number in the block, 0 for one outside it."""
    is_own = wide(node >= 0) & wide(node < masks.size)  # as good as random: no branch
    return wide(masks[np.uint64(node * is_own)] & -is_own)


@kernel
def code_structure(arrays: TreeArrays, block: Block, around: Uint32s, coder: Coder) -> None:
    """Note or decode the children of a block's nodes, around which lie cells and nodes.

    Decoding, it writes their masks and the groups' ranks, and their flags. What goes beyond the block's ends
    sets FAULT.
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
    # Of the block's nodes: which children they have, and which is the first.
    masks, begins = np.zeros(last - first, np.int64), np.zeros(last - first, np.int64)
    was_leaf = 0
    for node in range(first, last):
        own = node - first
        is_node = is_leaf = 0
        if not decodes:
            is_node, stored, _, _ = children_of(groups, node)
            is_leaf = stored ^ is_node
        elif node & 7 == 0:
            groups[node >> 3, 0] = 0
            groups[node >> 3, 1] = 0
            groups[node >> 3, 2] = np.uint64(next_node) | np.uint64(next_cell) << np.uint64(32)
        faces = leaves_beside = 0
        for k in range(6):
            is_there = wide(around[own, k] != around[own, OWN])
            faces |= is_there << k
            leaves_beside += is_there & wide(around[own, NODES + k] == NO_NODE)
        x = _mask(masks, wide(around[own, NODES + 0]) - first)
        y = _mask(masks, wide(around[own, NODES + 2]) - first)
        z = _mask(masks, wide(around[own, NODES + 4]) - first)
        given = wide(is_node | is_leaf)
        context = (x >> 1 & 1 | x >> 2 & 2) << 6 | (y >> 2 & 3) << 4 | z >> 4
        context |= (faces >> 1 & 1 | faces >> 2 & 2) << 8
        there = code_symbol(given & 15, context, coder)
        context = (x >> 5 & 1 | x >> 6 & 2) << 6 | (y >> 6 & 3) << 4 | there
        context |= (faces >> 1 & 1 | faces >> 2 & 2 | faces >> 3 & 4) << 8
        there |= code_symbol(given >> 4, 1024 + context, coder) << 4
        if there == 0 or next_cell + ones(there) > end_cell:
            coder.state[FAULT] = 1
            return
        masks[own], begins[own] = there, next_cell
        parent = wide(flags[around[own, OWN]])
        count, leaves, alike = ones(there), wide(0), wide(1)
        bits = there if may_be_nodes else 0
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            was_leaf = code_bit(is_leaf >> octant & 1, _LEAVES + was_leaf * 4 + min(leaves_beside, 3), coder)
            leaves |= was_leaf << octant
        if not may_be_nodes:
            leaves = there
        shown = parent & FACING_FLAGS
        for n in range(0 if decodes else count):
            alike &= wide(flags[np.uint64(next_cell + n)] == shown)
        alike = code_bit(alike, _ALIKE + 2 * min(ones(shown), 3) + (parent >> 7), coder)
        beside_split, union, bits = wide(0), wide(0), there & alike - 1
        for n in range(count if decodes and alike else 0):
            flags[np.uint64(next_cell + n)] = shown
        next_cell += count & -alike
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            some = wide(0)
            for axis in range(3):
                across = octant ^ 1 << axis
                other = own if octant >> axis & 1 else wide(around[own, NODES + 2 * axis]) - first
                if _mask(masks, other) >> across & 1:
                    some |= wide(flags[begins[other] + before(masks[other], across)])
            flag, found, left = (0 if decodes else wide(flags[next_cell])), wide(0), shown
            while left:
                facing = lowest(left)
                left &= left - 1
                place = 0 if found else 1 + wide(left == 0)
                known = (some >> facing & 1) << 1 | union >> facing & 1
                context = _FACINGS + (known * 3 + place) * 4 + min(ones(shown), 4) - 1
                found |= code_bit(flag >> facing & 1, context, coder) << facing
            context = _SPLIT + (min(ones(found), 2) * 2 + (parent >> 7)) * 3 + beside_split
            found |= code_bit(flag >> 7, context, coder) << 7
            if leaves >> octant & 1 == 0:
                found |= code_bit(flag >> 6 & 1, _KEPT + (parent >> 6 & 1), coder) << 6
            beside_split = 1 + (found >> 7)
            union |= found
            if decodes:
                flags[next_cell] = found
            next_cell += 1
        inner = there & ~leaves
        next_node += ones(inner)
        if next_node > end_node:
            coder.state[FAULT] = 1
            return
        if decodes:
            shift = np.uint64(8 * (node & 7))
            groups[node >> 3, 0] |= np.uint64(inner) << shift
            groups[node >> 3, 1] |= np.uint64(leaves) << shift
    if next_node != end_node or next_cell != end_cell:
        coder.state[FAULT] = 1
