"""Which children a node has, which of them are leaves, and their flags, by what is known around.

Of each node in turn: which of the four lower octants are occupied, which of the upper four; which children
are leaves; then each child's flags. A cell shows no facing that its parent does not: where that has one, a
symbol says for all children at once that they have just it.
"""

from __future__ import annotations

import numpy as np

from octex.archive.around import OWN, children_of, lowest, ones
from octex.archive.entropy import DECODES, FAULT, PASS, Coder, Pool, code_symbol, wide
from octex.arrays import Int64s, Uint8s, Uint64s
from octex.jit import inlined, kernel
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT

#: Contexts, and symbols, of the three: 64 · 4 · 4 · 16 for each half; 3 · 4, and whether all flags are as the
#: parent's facing; 5 · 9 · 8 · 6.
OCCUPIED = 1 << 15, 16
LEAVES = 13, 256
FLAGS = 2160, 256


def facing_tables() -> tuple[Uint8s, Uint8s]:
    """Return bits (64, 64) of a mask that another has, close together from bit 0 on; and the way back."""
    together, apart = np.zeros((64, 64), np.uint8), np.zeros((64, 64), np.uint8)
    bits = np.arange(64)
    for mask in range(64):
        at = 0
        for place in range(6):
            if mask >> place & 1:
                together[mask] |= ((bits >> place & 1) << at).astype(np.uint8)
                apart[mask] |= ((bits >> at & 1) << place).astype(np.uint8)
                at += 1
    return together, apart


@inlined
def _mask(masks: Int64s, node: int) -> int:
    """Return the mask of a node of the block, 0 for one below it."""
    is_own = wide(node >= 0)  # as good as random: no branch
    return wide(masks[np.uint64(node * is_own)] & -is_own)


@kernel
def code_structure(
    groups: Uint64s,
    flags: Uint8s,
    first: int,
    last: int,
    next_node: int,
    next_cell: int,
    end_node: int,
    end_cell: int,
    may_be_nodes: bool,
    cells: Int64s,
    nodes: Int64s,
    facings: tuple[Uint8s, Uint8s],
    pools: tuple[Pool, Pool, Pool],
    coder: Coder,
) -> None:
    """Note or decode the children of nodes ``first`` … ``last``, around which lie cells and nodes.

    Decoding, it writes their masks and the groups' ranks, and their flags. Its children are numbered from
    ``next_node`` and ``next_cell`` on, up to the ends: what goes beyond sets FAULT. Where a parent has one
    facing, one symbol says whether all children have just it.
    """
    work = coder.state[PASS]
    decodes = work == DECODES
    together, apart = facings
    occupied_pool, leaves_pool, flags_pool = pools
    # Of the block's nodes: which children they have, and which is the first.
    masks, begins = np.zeros(last - first, np.int64), np.zeros(last - first, np.int64)
    kinds = 0  # of the children of the node before: nodes, mixed, leaves
    for node in range(first, last):
        own = node - first
        is_node = is_leaf = 0
        if not decodes:
            is_node, is_leaf, _, _ = children_of(groups, node)
        elif node & 7 == 0:
            groups[node >> 3, 0] = 0
            groups[node >> 3, 1] = 0
            groups[node >> 3, 2] = np.uint64(next_node) | np.uint64(next_cell) << np.uint64(32)
        faces = leaves_beside = 0
        for k in range(6):
            is_there = wide(cells[own, k] != cells[own, OWN])
            faces |= is_there << k
            leaves_beside += is_there & wide(nodes[own, k] < 0)
        x = _mask(masks, nodes[own, 0] - first)
        y = _mask(masks, nodes[own, 2] - first)
        z = _mask(masks, nodes[own, 4] - first)
        there = is_node | is_leaf
        context = ((faces << 2 | x >> 1 & 1 | x >> 2 & 2) << 2 | y >> 2 & 3) << 4 | z >> 4
        low = code_symbol(work, there & 15, context, occupied_pool, coder) & 15
        context = ((faces << 2 | x >> 5 & 1 | x >> 6 & 2) << 2 | y >> 6 & 3) << 4 | low
        high = code_symbol(work, there >> 4, 1 << 14 | context, occupied_pool, coder) & 15
        there = low | high << 4
        leaves = there
        if may_be_nodes:
            symbol = 255 if is_leaf == there else is_leaf
            symbol = code_symbol(work, symbol, 4 * kinds + min(leaves_beside, 3), leaves_pool, coder)
            leaves = symbol & there
            kinds = 0 if leaves == 0 else 2 if leaves == there else 1
        inner = there & ~leaves
        masks[own], begins[own] = there, next_cell
        if there == 0 or next_cell + ones(there) > end_cell or next_node + ones(inner) > end_node:
            coder.state[FAULT] = 1
            return
        parent = wide(flags[cells[own, OWN]])
        shown = parent & FACING_FLAGS
        many = min(ones(shown), 4)
        count = ones(there)
        bits = there
        if many == 1:
            alike = wide(1)
            for n in range(0 if decodes else count):
                alike &= wide(flags[next_cell + n] == shown)
            alike = code_symbol(work, alike, 12, leaves_pool, coder)
            if alike:
                for n in range(count if decodes else 0):
                    flags[next_cell + n] = shown
                next_cell += count
                bits = wide(0)
        union = split_before = 0
        while bits:
            octant = lowest(bits)
            bits &= bits - 1
            some = 0
            for axis in range(3 if many > 1 else 0):
                across = octant ^ 1 << axis
                other = own if octant >> axis & 1 else nodes[own, 2 * axis] - first
                if other >= 0 and masks[other] >> across & 1:
                    some |= wide(flags[begins[other] + ones(masks[other] & ((1 << across) - 1))])
            flag = 0 if decodes else wide(flags[next_cell])
            symbol = wide(together[shown, flag & FACING_FLAGS]) | flag & (SPLIT | KEPT)
            before = 0 if next_cell == begins[own] else 1 + (wide(together[shown, union]) & 7)
            context = (many * 9 + before) * 8 + (wide(together[shown, some & FACING_FLAGS]) & 7)
            context = context * 6 + 2 * split_before + (parent >> 7)
            symbol = code_symbol(work, symbol, context, flags_pool, coder)
            if decodes:
                flag = wide(apart[shown, symbol & FACING_FLAGS]) | symbol & (SPLIT | KEPT)
                if leaves >> octant & 1:
                    flag &= ~KEPT
                flags[next_cell] = flag
            union |= flag & FACING_FLAGS
            split_before = 1 + (flag >> 7)
            next_cell += 1
        next_node += ones(inner)
        if decodes:
            shift = np.uint64(8 * (node & 7))
            groups[node >> 3, 0] |= np.uint64(inner) << shift
            groups[node >> 3, 1] |= np.uint64(leaves) << shift
    if next_node != end_node or next_cell != end_cell:
        coder.state[FAULT] = 1
