"""Read an .octex file with numpy alone, from octex/formats/FORMAT.md: nearest and quadratic lookups.

    python read_octex.py FILE CHANNEL nearest|quadratic < points.txt

reads a rest position a line and prints its value a line, as octex.open(FILE).sample does. It is written to be
read, a point at a time; octex does the same a million times faster.
"""

from __future__ import annotations

import json
import sys
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np

DTYPES = {"U8": "u1", "U16": "<u2", "U32": "<u4", "U64": "<u8", "I64": "<i8", "F16": "<f2", "F32": "<f4"}
AROUND = list(product((-1, 0, 1), repeat=3))  # x slowest
KEPT = 0x40


class File:
    """The arrays of a file, mapped, and what its metadata say."""

    def __init__(self, path: str | Path) -> None:
        content = np.memmap(path, np.uint8, "r")
        begin = 8 + int(content[:8].view("<u8")[0])
        header = json.loads(content[8:begin].tobytes())
        metadata = header.pop("__metadata__")
        if metadata.get("format") != "octex" or metadata.get("format_version") != "1":
            raise ValueError("not an .octex file of version 1")
        self.arrays = {}
        for name, entry in header.items():
            first, last = (begin + offset for offset in entry["data_offsets"])
            if entry["dtype"] in DTYPES:  # others are not octex's own
                array = content[first:last].view(DTYPES[entry["dtype"]])
                self.arrays[name] = array.reshape(entry["shape"])
        placement = json.loads(metadata["placement"])
        self.origin, self.size = np.array(placement["origin"]), placement["size"]
        self.spaces = json.loads(metadata["channels"])

    def rows(self, name: str) -> np.ndarray:
        """Return a channel's values: of the cells, then of the kept nodes; linear light."""
        parts = [self.arrays[f"channels/{name}"], self.arrays.get(f"kept/channels/{name}")]
        stored = np.concatenate([part for part in parts if part is not None])
        values = stored.astype(np.float64)
        if stored.dtype.kind == "u":
            values /= np.iinfo(stored.dtype).max
        if self.spaces[name] == "srgb":
            bright = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
            values = np.where(values <= 0.04045, values / 12.92, bright)
        if self.spaces[name] == "direction" and stored.dtype.kind == "u":
            values = 2 * values - 1
        return values


class Tree:
    """The octree of a file, down to a level: at that level nodes count as leaves."""

    def __init__(self, file: File, level: int | None = None) -> None:
        self.groups = file.arrays["tree/groups"]
        self.flags = file.arrays["tree/flags"]
        self.kept = file.arrays.get("kept/cells", np.empty(0, np.uint32)).tolist()
        deepest = file.arrays["tree/level_cells"].size - 2
        self.depth = deepest if level is None else min(level, deepest)
        self.find = cache(self._find)
        self.coefficient = cache(self._coefficient)

    def _find(self, level: int, place: tuple[int, ...]) -> tuple[int, bool, int]:
        """Return the number of a cell, −1 if it is not stored; whether it is a node; which node it is."""
        if not all(0 <= i < 1 << level for i in place):
            return -1, False, -1
        if level == 0:
            is_node = len(self.groups) > 0
            return 0, is_node and self.depth > 0, 0
        cell, is_node, node = self.find(level - 1, tuple(i >> 1 for i in place))
        if cell < 0 or not is_node:
            return -1, False, -1
        octant = (place[0] & 1) + 2 * (place[1] & 1) + 4 * (place[2] & 1)
        nodes, leaves, firsts = (int(word) for word in self.groups[node >> 3])
        bit = 1 << 8 * (node & 7) + octant
        if not (nodes | leaves) & bit:
            return -1, False, -1
        cell = (firsts >> 32) + ((nodes | leaves) & (bit - 1)).bit_count()
        node = (firsts & 0xFFFFFFFF) + (nodes & (bit - 1)).bit_count()
        return cell, bool(nodes & bit) and level < self.depth, node

    def holding(self, level: int, place: tuple[int, ...]) -> tuple[int, int, bool]:
        """Return the cell stored at a place, or the leaf above it: its number and level, if it is a leaf."""
        for above in range(level, -1, -1):
            cell, is_node, _ = self.find(above, tuple(i >> level - above for i in place))
            if cell >= 0 and (above == level or not is_node):
                return cell, above, not is_node
            if cell >= 0:
                break
        return -1, -1, False

    def nearest(self, point: np.ndarray) -> int:
        """Return the leaf that holds a point of texture space, else the stored cell nearest to it."""
        point = np.clip(point, 0, 1)
        fixed = [min(int(x * 2**30 + 0.5) >> 9, 2**21 - 1) for x in point]
        for level in range(self.depth, -1, -1):
            middle = [i >> 21 - level for i in fixed]
            cell, _, is_leaf = self.holding(level, tuple(middle))
            if is_leaf:
                return cell
            best = None
            for offset in AROUND:
                place = [i + o for i, o in zip(middle, offset, strict=True)]
                cell, own, _ = self.holding(level, tuple(place))
                if cell < 0:
                    continue
                low = np.array([i >> level - own for i in place]) / 2**own
                away = np.maximum(np.maximum(low - point, point - low - 1 / 2**own), 0)
                key = float(away @ away), morton(low)
                if best is None or key < best[0]:
                    best = key, cell
            if best is not None:
                return best[1]
        raise ValueError("the root is not stored")

    def own(self, cell: int, is_node: bool) -> dict[int, float]:
        """Return what a cell has itself: rows of values and their weights."""
        if cell < 0:
            return {}
        if not is_node:
            return {cell: 1.0}
        if self.flags[cell] & KEPT:
            return {len(self.flags) + self.kept.index(cell): 1.0}
        return {}

    def _coefficient(self, level: int, place: tuple[int, ...]) -> dict[int, float]:
        """Return a cell's coefficient, see FORMAT.md: rows of values and their weights."""
        cell, is_node, _ = self.find(level, place)
        if level == 0:
            return self.own(cell, is_node)
        above, is_below_node, _ = self.find(level - 1, tuple(i >> 1 for i in place))
        if is_below_node and not self.flags[above] & KEPT:
            return self.own(cell, is_node)
        refined: dict[int, float] = {}
        for offset in AROUND:
            weight = 1.0
            for i, o in zip(place, offset, strict=True):
                weight *= (0.25, 0.75, 0.0)[o + 1] if not i & 1 else (0.0, 0.75, 0.25)[o + 1]
            if weight:
                parent = tuple((i >> 1) + o for i, o in zip(place, offset, strict=True))
                for row, share in self.coefficient(level - 1, parent).items():
                    refined[row] = refined.get(row, 0.0) + weight * share
        if not is_below_node or cell < 0:
            return refined
        total = sum(refined.values())
        return {row: total * share for row, share in self.own(cell, is_node).items()}

    def quadratic(self, point: np.ndarray) -> dict[int, float]:
        """Return the rows of values that the field blends at a point of texture space, and their weights."""
        point = np.clip(point, 0, 1)
        fixed = [min(int(x * 2**21), 2**21 - 1) for x in point]
        for level in range(22):
            middle = [i >> 21 - level for i in fixed]
            window = [tuple(i + o for i, o in zip(middle, offset, strict=True)) for offset in AROUND]
            if not any(self.find(level, place)[1] for place in window):
                break
        t = point * 2**level - middle
        spline = np.stack([(1 - t) ** 2 / 2, 0.75 - (t - 0.5) ** 2, t**2 / 2])
        taps: dict[int, float] = {}
        for place, (i, j, k) in zip(window, product(range(3), repeat=3), strict=True):
            weight = float(spline[i, 0] * spline[j, 1] * spline[k, 2])
            for row, share in self.coefficient(level, place).items():
                taps[row] = taps.get(row, 0.0) + weight * share
        return taps


def morton(low: np.ndarray) -> int:
    """Return a number that orders cells as their file does, from their lowest corners."""
    i, j, k = (low * 2**21).astype(int).tolist()
    return sum((i >> b & 1 | (j >> b & 1) << 1 | (k >> b & 1) << 2) << 3 * b for b in range(21))


def sample(file: File, name: str, points: np.ndarray, filter: str) -> np.ndarray:
    """Return a channel's values at rest positions (n, 3)."""
    rows = file.rows(name)
    deepest = file.arrays["tree/level_cells"].size - 2
    trees = [Tree(file, level) for level in range(deepest, -1, -1)]
    coverage = file.rows("alpha")[:, 0] if "alpha" in file.spaces and name != "alpha" else np.ones(len(rows))
    found = []
    for point in (points - file.origin) / file.size:
        if filter == "nearest":
            found.append(rows[trees[0].nearest(point)])
            continue
        # Off the surface nothing weighs anything: the deepest level whose averages do answers.
        taps = next(taps for taps in (tree.quadratic(point) for tree in trees) if sum(taps.values()) > 0)
        numbers = list(taps)
        weights = np.array(list(taps.values()))
        seen = weights * coverage[numbers]
        weights = seen if seen.sum() > 0 else weights
        found.append(weights @ rows[numbers] / weights.sum())
    return np.array(found)


def main() -> None:
    path, name, filter = sys.argv[1:]
    points = np.loadtxt(sys.stdin, ndmin=2)
    for value in sample(File(path), name, points, filter):
        print(*(f"{number:.9g}" for number in value))


if __name__ == "__main__":
    main()
