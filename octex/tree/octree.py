"""The octree: built from leaves, immutable; and its leaves in Morton order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Bools, Int64s, Integers, Uint8s, Uint32s, Uint64s, bit_counts
from octex.checks import as_array, as_depth
from octex.errors import ArgumentError
from octex.jit import kernel, trailing_zeros
from octex.tree.children import children, groups_of
from octex.tree.layout import KEPT, MAX_CELLS, MAX_DEPTH, NO_KEPT, NO_SPLIT, KeptTable, SplitTable, TreeArrays
from octex.tree.search import child
from octex.tree.validate import check_layout, check_meaning


class Octree:
    """An immutable octree: structure, flags and areas of its cells, the split table and the kept nodes.

    Every cell is a leaf or a node. Two trees have one cell only: the root as a leaf (no nodes), and the empty
    tree (the root as a node without children).

    Raises ArgumentError if types, lengths and levels of the arrays do not fit together; ``validate`` checks
    their content.
    """

    __slots__ = ("arrays", "kept", "level_cells", "level_nodes", "split")

    def __init__(self, arrays: TreeArrays, split: SplitTable = NO_SPLIT, kept: KeptTable = NO_KEPT) -> None:
        self.arrays, self.split, self.kept = arrays, split, kept
        check_layout(arrays, split, kept)
        self.level_cells, self.level_nodes = arrays.level_cells, arrays.level_nodes

    def __repr__(self) -> str:
        return f"<Octree of depth {self.max_depth}: {self.n_leaves:,} leaves, {self.n_nodes:,} nodes>"

    @classmethod
    def from_leaves(cls, codes: npt.ArrayLike, depths: npt.ArrayLike) -> Octree:
        """Build a tree from its leaves; flags and areas are zero.

        ``codes`` (n,) are Morton codes, each of its leaf's depth; ``depths`` one for all, or (n,).
        The leaves are disjoint and in Morton order, that is, sorted by ``code << 3·(21 − depth)``. The leaves
        of one level are numbered in this order.

        Raises ArgumentError for leaves out of order or overlapping, for codes outside their depth, and for
        trees of more than 2³² − 1 cells.
        """
        codes = np.ascontiguousarray(_whole(codes, "codes"), np.int64)
        if isinstance(depths, (int, np.integer)):
            depths = np.full(codes.shape, as_depth(depths), np.uint8)  # type: ignore[arg-type]
        depths = _whole(depths, "depths")
        if depths.shape != codes.shape:
            raise ArgumentError(
                f"codes and depths must be whole numbers, one each, not {codes.shape} and {depths.shape}"
            )
        if codes.size and not 0 <= depths.min() <= depths.max() <= MAX_DEPTH:
            raise ArgumentError(f"depths must be 0 to {MAX_DEPTH}")
        depths = np.ascontiguousarray(depths, np.uint8)
        fault = _first_fault(codes, depths)
        if fault >= 0:
            raise ArgumentError(
                f"leaf {fault} (code {codes[fault]}, depth {depths[fault]}) is not a cell of its depth, "
                "overlaps the leaf before it, or does not come after it in Morton order"
            )
        deepest = int(depths.max(initial=0))
        if depths.min(initial=deepest) == deepest:
            return cls(_build({deepest: codes}, deepest))
        levels = np.flatnonzero(np.bincount(depths)).tolist()
        return cls(_build({level: codes[depths == level] for level in levels}, deepest))

    @classmethod
    def from_levels(cls, leaves: Sequence[Int64s]) -> Octree:
        """Build a tree from the ascending Morton codes of each level's leaves, from the root's on.

        Flags and areas are zero. Raises ArgumentError for leaves that overlap or are out of order.
        """
        deepest = max((level for level, codes in enumerate(leaves) if codes.size), default=0)
        return cls(_build({level: leaves[level] for level in range(deepest + 1)}, deepest))

    def with_cell_data(
        self, flags: Uint8s, areas: Uint8s, split: SplitTable = NO_SPLIT, kept: KeptTable = NO_KEPT
    ) -> Octree:
        """Return a tree of the same structure with other flags, areas, split table and kept nodes."""
        return Octree(self.arrays._replace(flags=flags, areas=areas), split, kept)

    @property
    def max_depth(self) -> int:
        """The level of the deepest cell."""
        return self.level_cells.size - 2

    @property
    def n_cells(self) -> int:
        """Number of leaves and nodes."""
        return int(self.level_cells[-1])

    @property
    def n_nodes(self) -> int:
        """Number of cells with children (in the empty tree, the root)."""
        return int(self.level_nodes[-1])

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return self.n_cells - self.n_nodes

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in (*self.arrays, *self.split, *self.kept))

    def cells_by_depth(self) -> list[tuple[int, int]]:
        """Numbers of leaves and of nodes at each level."""
        cells = np.diff(self.level_cells)
        nodes = np.diff(self.level_nodes)
        return list(zip((cells - nodes).tolist(), nodes.tolist(), strict=True))

    def walk(self) -> Iterator[tuple[Int64s, Bools]]:
        """Yield for each level its cells' Morton codes and which of them are nodes, in the cells' order."""
        cells, nodes = self.arrays.level_cells, self.arrays.level_nodes
        codes = np.zeros(1, np.int64)
        is_node = np.full(1, self.n_nodes > 0)
        yield codes, is_node
        for level in range(self.max_depth):
            codes, is_node = _children(
                self.arrays.groups,
                int(nodes[level]),
                int(nodes[level + 1]),
                codes[is_node],
                int(cells[level + 2] - cells[level + 1]),
            )
            yield codes, is_node

    def level_codes(self, level: int) -> Int64s:
        """Morton codes of all cells of a level, in order. Raises ArgumentError if there is no such level."""
        return self.walked_to(level)[0]

    def is_node(self, level: int) -> Bools:
        """Return which cells of a level are nodes. Raises ArgumentError if there is no such level."""
        return self.walked_to(level)[1]

    def cells_at(self, level: int) -> slice:
        """Return the numbers of a level's cells."""
        return slice(*self.level_cells[level : level + 2].tolist())

    def leaf_cells(self) -> Int64s:
        """Numbers of all leaves, level by level."""
        is_node = np.concatenate([is_node for _, is_node in self.walk()])
        return np.flatnonzero(~is_node)

    def walked_to(self, level: int) -> tuple[Int64s, Bools]:
        """Return the item of ``walk`` for a level. Raises ArgumentError if there is no such level."""
        if as_depth(level, "level") > self.max_depth:
            raise ArgumentError(f"there is no level {level}: the deepest is {self.max_depth}")
        return next(islice(self.walk(), level, None))

    def truncated(self, level: int) -> Octree:
        """Return the tree of levels 0 … ``level``; nodes there become leaves without kept coefficients.

        Copies the groups of the nodes above, and the flags if a kept node becomes a leaf; all else is a view.
        Nothing deeper is read.
        """
        if as_depth(level, "level") >= self.max_depth:
            return self
        arrays = self.arrays
        n_cells, n_nodes = int(arrays.level_cells[level + 1]), int(arrays.level_nodes[level])
        groups = arrays.groups[: -(-n_nodes // 8)].copy()
        _cut(groups, int(arrays.level_nodes[level - 1]) if level else 0, n_nodes)
        level_nodes = arrays.level_nodes[: level + 2].copy()
        level_nodes[-1] = n_nodes
        n_split = count_before(self.split.cells, n_cells)
        facings = self.split.facings[:n_split]
        rows = int(bit_counts(facings).sum())
        kept = self.kept.cells[: count_before(self.kept.cells, n_cells)]
        n_kept = count_before(kept, int(arrays.level_cells[level]))
        flags = arrays.flags[:n_cells]
        if n_kept < kept.size:
            flags = flags.copy()
            flags[arrays.level_cells[level] :] &= np.uint8(0xFF ^ KEPT)
        return Octree(
            TreeArrays(groups, arrays.level_cells[: level + 2], level_nodes, flags, arrays.areas[:n_cells]),
            SplitTable(self.split.cells[:n_split], facings, self.split.areas[:rows]),
            KeptTable(kept[:n_kept]),
        )

    def validate(self) -> None:
        """Check that the arrays form an octree; raise TextureFileError for the first fault."""
        check_meaning(self.arrays, self.split, self.kept)


def _whole(numbers: npt.ArrayLike, name: str) -> Array:
    """Return whole numbers (n,) of any type, or raise ArgumentError."""
    array = as_array(numbers)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ArgumentError(f"{name} must be whole numbers of shape (n,), not {array.dtype} {array.shape}")
    if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
        raise ArgumentError(f"{name} must be below 2⁶³, not {array.max()}")
    return array


def count_before(cells: Uint32s, end: int) -> int:
    """Count the cells before ``end``, without reading the far end of a large file."""
    bound = 1
    while bound < cells.size and cells[bound] < end:
        bound *= 2
    return int(np.searchsorted(cells[:bound], np.uint32(end)))  # any other type would copy the cells


def distinct(codes: Integers) -> Int64s:
    """Return codes in ascending order, each once: in a seventieth of np.unique's time.

    Codes in order, or in a few ordered runs, are the fastest: merge sort takes 1 to 6 ns each.
    """
    wide = np.ascontiguousarray(codes, np.int64)
    unique = np.empty(wide.size, np.int64)
    count = _write_distinct(wide, unique)
    if count < 0:
        count = _write_distinct(np.sort(wide, kind="stable"), unique)
    return unique if count == unique.size else unique[:count].copy()


def _build(leaves_of: dict[int, Int64s], deepest: int) -> TreeArrays:
    """Build from the deepest level up: the nodes of a level are the parents of the cells below."""
    level_nodes = np.zeros(deepest + 2, np.int64)
    level_cells = np.zeros(deepest + 2, np.int64)
    is_empty = not any(codes.size for codes in leaves_of.values())
    nodes = np.zeros(int(is_empty), np.int64)
    masks = [(np.zeros(nodes.size, np.uint8), np.zeros(nodes.size, np.uint8))]
    for level in range(deepest, -1, -1):
        leaves = leaves_of.pop(level, nodes[:0])
        level_cells[level + 1] = nodes.size + leaves.size
        level_nodes[level + 1] = nodes.size
        parents, node_masks, leaf_masks = _parents(nodes, leaves)
        if nodes.size + leaves.size and not parents.size:
            raise ArgumentError(f"leaves of level {level} overlap others, or are out of order")
        if level:
            nodes = parents
            masks.append((node_masks, leaf_masks))
    np.cumsum(level_cells, out=level_cells)
    np.cumsum(level_nodes, out=level_nodes)
    n_cells = int(level_cells[-1])
    if n_cells > MAX_CELLS:
        raise ArgumentError(f"{n_cells} cells are more than a tree can hold; use a smaller depth")
    n_nodes = int(level_nodes[-1])
    packed = np.zeros((2, -(-n_nodes // 8) * 8), np.uint8)
    for word in range(2):
        np.concatenate([pair[word] for pair in reversed(masks)], out=packed[word, :n_nodes])
    flags, areas = np.zeros((2, n_cells), np.uint8)
    return TreeArrays(groups_of(packed), level_cells, level_nodes, flags, areas)


@kernel
def _write_distinct(codes: Int64s, unique: Int64s) -> int:
    """Write ascending codes, each once, and count them; −1 if they do not ascend."""
    count = 0
    last = np.int64(-1)
    for n in range(codes.size):
        code = codes[n]
        if n > 0 and code < last:
            return -1
        if n == 0 or code != last:
            unique[count] = code
            count += 1
        last = code
    return count


@kernel
def _first_fault(codes: Int64s, depths: Uint8s) -> int:
    """Index of the first leaf that is no cell of its depth or not wholly after the one before, or −1."""
    last = np.int64(-1)
    for n in range(codes.size):
        depth = np.int64(depths[n])
        shift = 3 * (MAX_DEPTH - depth)
        first = codes[n] << shift
        if codes[n] >> (3 * depth) != 0 or first <= last:
            return n
        last = first | ~(np.int64(-1) << shift)
    return -1


@kernel
def _parents(nodes: Int64s, leaves: Int64s) -> tuple[Int64s, Uint8s, Uint8s]:
    """Merge the nodes and leaves of a level; return their parents' codes, node masks and leaf masks.

    Returns none where the leaves do not ascend, or one is a node.
    """
    n_cells = nodes.size + leaves.size
    codes = np.empty(n_cells, np.int64)
    node_masks = np.empty(n_cells, np.uint8)
    leaf_masks = np.empty(n_cells, np.uint8)
    n, next_node, next_leaf = -1, 0, 0
    parent = last = np.int64(-1)
    node_mask = leaf_mask = 0
    for _ in range(n_cells):
        is_node = next_node < nodes.size and (
            next_leaf == leaves.size or nodes[next_node] < leaves[next_leaf]
        )
        code = nodes[next_node] if is_node else leaves[next_leaf]
        if code <= last:
            return codes[:0], node_masks[:0], leaf_masks[:0]
        last = code
        if code >> 3 != parent:
            parent = code >> 3
            n += 1
            codes[n] = parent
            node_mask = leaf_mask = 0
        if is_node:
            next_node += 1
            node_mask |= 1 << (code & 7)
        else:
            next_leaf += 1
            leaf_mask |= 1 << (code & 7)
        node_masks[n] = node_mask
        leaf_masks[n] = leaf_mask
    return codes[: n + 1], node_masks[: n + 1], leaf_masks[: n + 1]


@kernel
def _cut(groups: Uint64s, first: int, end: int) -> None:
    """Make the child nodes of nodes first … end−1, a level's, leaves and drop the nodes from ``end`` on."""
    for node in range(first, 8 * groups.shape[0]):
        g = node >> 3
        byte = np.uint64(0xFF) << np.uint64(8 * (node & 7))
        if node < end:
            groups[g, 1] |= groups[g, 0] & byte
        else:
            groups[g, 1] &= ~byte
        groups[g, 0] &= ~byte
    for g in range((first >> 3) + 1, groups.shape[0]):  # their child nodes come after all
        groups[g, 2] = groups[g, 2] & ~np.uint64(0xFFFFFFFF) | np.uint64(end)


@kernel
def _children(groups: Uint64s, first: int, end: int, codes: Int64s, n_children: int) -> tuple[Int64s, Bools]:
    """Return the codes of the children of nodes first … end−1, from their codes, and which are nodes."""
    child_codes = np.zeros(n_children, np.int64)
    is_node = np.zeros(n_children, np.bool_)
    n = 0
    for node in range(first, min(end, first + codes.size)):
        nodes, stored, _, _ = children(groups, node)
        while stored != np.uint64(0) and n < n_children:
            octant = trailing_zeros(stored)
            stored &= stored - np.uint64(1)
            child_codes[n] = codes[node - first] << 3 | octant
            is_node[n] = nodes >> np.uint64(octant) & np.uint64(1) != 0
            n += 1
    return child_codes, is_node


class Leaves(NamedTuple):
    """Leaves: their cell numbers, Morton codes and depths."""

    cells: Int64s
    codes: Int64s
    depths: Uint8s


def walk_leaves(arrays: TreeArrays, block: int = 1 << 16) -> Iterator[Leaves]:
    """Yield all leaves in Morton order, at most ``block`` at once, in the memory of one block.

    Damaged arrays yield at most as many leaves as their counts.
    """
    remaining = int(arrays.level_cells[-1] - arrays.level_nodes[-1])
    if arrays.level_nodes[-1] == 0:
        yield Leaves(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, np.uint8))
        return
    path = np.zeros((MAX_DEPTH + 2, 3), np.int64)
    while remaining > 0:
        count = min(block, remaining)
        cells, codes, depths = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.uint8)
        n_found = _next_leaves(arrays, path, cells, codes, depths)
        if n_found:
            yield Leaves(cells[:n_found], codes[:n_found], depths[:n_found])
        if n_found < count:
            return
        remaining -= n_found


@kernel
def _next_leaves(arrays: TreeArrays, path: Int64s, cells: Int64s, codes: Int64s, depths: Uint8s) -> int:
    """Continue a walk until ``cells`` is full; return the number found.

    ``path`` holds (node, its code, its next octant) for each level down to the walk's place. Its last row is
    that level, or −1 at the end, and the number of nodes entered.
    """
    level, entered = path[-1, 0], path[-1, 1]
    count = 0
    while level >= 0 and count < cells.size:
        octant = path[level, 2]
        if octant == 8:
            level -= 1
            continue
        path[level, 2] += 1
        cell, node = child(arrays, path[level, 0], octant)
        if cell < 0:
            continue
        code = path[level, 1] << 3 | octant
        if node < 0:
            cells[count], codes[count], depths[count] = cell, code, level + 1
            count += 1
        elif level + 1 < MAX_DEPTH and entered < arrays.level_nodes[-1]:
            level += 1
            entered += 1
            path[level, 0], path[level, 1], path[level, 2] = node, code, 0
    path[-1, 0], path[-1, 1] = level, entered
    return count
