"""Which children a node has, and what flags: bits, each by what is known around it.

Of each node in turn, of each octant in turn: is it occupied; if so, is it a node; of the facings that the
parent shows, which does it show; is it kept, if it is a node; is it split. A cell shows no facing that its
parent does not.
"""

from __future__ import annotations

import numpy as np

from octex.archive.around import children_of, ones, place_beside
from octex.archive.entropy import COUNTS, DECODES, FAULT, PASS, adapted, code_bit, wide
from octex.arrays import Int64s, Uint8s, Uint32s, Uint64s
from octex.jit import inlined, kernel
from octex.tree.layout import FACING_FLAGS, KEPT, POSITIVE_FACINGS, SPLIT

# Contexts, one after the other.
_OCCUPIED = 0  # 2¹³: 10 cells of the parent's level, 3 of the child's
_IS_NODE = _OCCUPIED + (1 << 13)  # 3 · 4 · 4
_FACING = _IS_NODE + 48  # 3 · 2 · 2 · 3 · 2 · 2
_SPLIT = _FACING + 144  # 2 · 3 · 2 · 2
_KEPT = _SPLIT + 24  # 2 · 3
CONTEXTS = _KEPT + 6
#: A bit's chance moves by 2⁻⁶ of the way at each.
_SHIFT = 6


@inlined
def _coded(bit: int, context: int, chances: Int64s, counts: Int64s, coder: Int64s, stream: Uint32s) -> int:
    if coder[PASS] == COUNTS:
        counts[context, bit] += 1
        return bit
    chance = chances[context]
    bit = code_bit(bit, chance, coder, stream)
    chances[context] = adapted(chance, bit, _SHIFT)
    return bit


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
    chances: Int64s,
    counts: Int64s,
    coder: Int64s,
    stream: Uint32s,
) -> None:
    """Count, encode or decode the children of nodes ``first`` … ``last``, around which lie cells and nodes.

    Decoding, it writes their masks and the groups' ranks, and their flags. Its children are numbered from
    ``next_node`` and ``next_cell`` on, up to the ends: what goes beyond sets FAULT.
    """
    decodes = coder[PASS] == DECODES
    for node in range(first, last):
        own = node - first
        shift = np.uint64(8 * (node & 7))
        is_node = is_leaf = 0
        if decodes:
            if node & 7 == 0:
                groups[node >> 3, 0] = 0
                groups[node >> 3, 1] = 0
                groups[node >> 3, 2] = np.uint64(next_node) | np.uint64(next_cell) << np.uint64(32)
        else:
            is_node, is_leaf, _, _ = children_of(groups, node)
        there = is_node | is_leaf
        parent = wide(flags[cells[own, 13]])
        shown = parent & FACING_FLAGS
        many = min(ones(shown), 3)
        inner = leaves = union = 0
        before = -1  # the sibling before
        for octant in range(8):
            x = 1 if octant & 1 else -1
            y = 3 if octant & 2 else -3
            z = 9 if octant & 4 else -9
            context = wide(cells[own, 13 + x] >= 0)
            context |= wide(cells[own, 13 + y] >= 0) << 1
            context |= wide(cells[own, 13 + z] >= 0) << 2
            context |= wide(cells[own, 13 + x + y] >= 0) << 3
            context |= wide(cells[own, 13 + x + z] >= 0) << 4
            context |= wide(cells[own, 13 + y + z] >= 0) << 5
            context |= wide(cells[own, 13 + x + y + z] >= 0) << 6
            context |= wide(cells[own, 13 - x] >= 0) << 7
            context |= wide(cells[own, 13 - y] >= 0) << 8
            context |= wide(cells[own, 13 - z] >= 0) << 9
            # Of the cells at −x, −y and −z, those of this block: flags set, and not; which are nodes.
            some = other = split_beside = 0
            known = node_beside = 0
            for axis in range(3):
                bit = 1 << axis
                across = octant ^ bit
                beside = -1
                if octant & bit:
                    if (inner | leaves) >> across & 1:
                        beside = next_cell - ones((inner | leaves) >> across)
                        node_beside += inner >> across & 1
                else:
                    dx, dy, dz = -(axis == 0), -(axis == 1), -(axis == 2)
                    place, _ = place_beside(octant, dx, dy, dz)
                    beyond = nodes[own, place]
                    if first <= beyond < node:
                        inner2, leaves2, _, cell2 = children_of(groups, beyond)
                        if (inner2 | leaves2) >> across & 1:
                            beside = cell2 + ones((inner2 | leaves2) & ((1 << across) - 1))
                            node_beside += inner2 >> across & 1
                if beside >= 0:
                    context |= 1 << 10 + axis
                    known += 1
                    found = wide(flags[beside])
                    some |= found
                    other |= ~found
                    split_beside |= found & SPLIT
            is_there = _coded(there >> octant & 1, _OCCUPIED + context, chances, counts, coder, stream)
            if not is_there:
                continue
            if next_cell >= end_cell:
                coder[FAULT] = 1
                return
            inside = 0
            if may_be_nodes:
                siblings = 0 if before < 0 else 1 + (inner >> before & 1)
                context = _IS_NODE + siblings + 3 * known + 12 * node_beside
                inside = _coded(is_node >> octant & 1, context, chances, counts, coder, stream)
                if inside and next_node >= end_node:
                    coder[FAULT] = 1
                    return
                next_node += inside
            flag = wide(flags[next_cell]) if not decodes else 0
            last_flags = wide(flags[next_cell - 1])
            facings = 0
            for place in range(6):
                if not shown >> place & 1:
                    continue
                sibling = 0 if before < 0 else 1 + (last_flags >> place & 1)
                context = (many - 1) + 3 * (some >> place & 1) + 6 * (other >> place & 1) + 12 * sibling
                context += 36 * (union >> place & 1) + 72 * wide(facings != 0)
                facings |= (
                    _coded(flag >> place & 1, _FACING + context, chances, counts, coder, stream) << place
                )
            union |= facings
            both = wide((facings & facings >> 1 & POSITIVE_FACINGS) != 0)
            sibling = 0 if before < 0 else 1 + (last_flags >> 7 & 1)
            context = _SPLIT + (parent >> 7) + 2 * sibling + 6 * wide(split_beside != 0) + 12 * both
            found = facings | _coded(flag >> 7 & 1, context, chances, counts, coder, stream) * SPLIT
            if inside:
                sibling = 0 if before < 0 else 1 + (last_flags >> 6 & 1)
                context = _KEPT + (parent >> 6 & 1) + 2 * sibling
                found |= _coded(flag >> 6 & 1, context, chances, counts, coder, stream) * KEPT
            if decodes:
                flags[next_cell] = found
            inner |= inside << octant
            leaves |= (1 - inside) << octant
            before = octant
            next_cell += 1
        if decodes:
            groups[node >> 3, 0] |= np.uint64(inner) << shift
            groups[node >> 3, 1] |= np.uint64(leaves) << shift
            if inner | leaves == 0:
                coder[FAULT] = 1
                return
    if next_node != end_node or next_cell != end_cell:
        coder[FAULT] = 1


def chances_of(counts: Int64s) -> Int64s:
    """Return how likely bits (contexts, 2) are 1, in 63 steps of their logits, 0 where none was seen."""
    seen = counts.sum(axis=1) > 0
    chance = (counts[:, 1] + 0.4) / (counts.sum(axis=1) + 0.8)
    steps = np.clip(np.rint(4 * np.log2(chance / (1 - chance))), -31, 31) + 32
    return np.where(seen, steps, 0).astype(np.int64)


def chances_from(steps: Int64s) -> Int64s:
    """Return the chances of 4096 that steps stand for."""
    logits = np.exp2((np.arange(64) - 32) / 4)
    table = np.clip(np.rint(4096 * logits / (1 + logits)), 1, 4095).astype(np.int64)
    found: Int64s = table[np.minimum(steps, 63)]
    return found
