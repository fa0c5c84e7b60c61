"""Filtered lookups, slow and obvious: a point at a time, a tap at a time, in double precision."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import decode
from octex.field.field import Field
from octex.field.footprints import ROUND_FINER, WHOLE
from octex.field.splines import FILTERS
from octex.field.weights import AREA_WEIGHTS
from octex.texture import OctreeTexture
from octex.tree.layout import SPLIT
from tests.make.taps import taps_of

Array = npt.NDArray[Any]

AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
AWAY, OFF = 1e-6, 1e-9


class Views:
    """Looks up one channel of a texture; alpha does not count."""

    def __init__(self, texture: OctreeTexture, name: str, filter: str) -> None:
        channel, self.tree = texture.channels[name], texture.tree
        parts = channel.values, channel.kept_values, channel.split_values
        self.values = np.concatenate([decode(part, channel.format.space) for part in parts]).astype(float)
        self.texture, self.filter = texture, filter
        self.fields = [Field(self.tree.truncated(level)) for level in range(self.tree.max_depth + 1)]
        self.areas = self.tree.arrays.areas.copy()
        self.areas[self.tree.leaf_cells()] = 0  # leaves do not weigh by them
        self.rows: dict[int, dict[int, int]] = {}  # of each split cell, by facing
        row = self.tree.n_cells + self.tree.kept.cells.size
        for cell, facings in zip(
            self.tree.split.cells.tolist(), self.tree.split.facings.tolist(), strict=True
        ):
            self.rows[cell] = {}
            for facing in _bits(facings):
                self.rows[cell][facing] = row
                row += 1

    def taps(self, point: Array, level: int) -> tuple[list[tuple[int, float]], float]:
        """Rows, weights of sum 1, and the weight of all, of the field over a level's averages."""
        field = self.fields[level]
        taps = taps_of(field, point[None], self.texture.placement, self.filter)
        moved = self.tree.n_cells - field.tree.n_cells
        rows = [row + (moved if row >= field.tree.n_cells else 0) for row in taps.rows.tolist()]
        found = list(zip(rows, taps.weights.tolist(), strict=True))
        if level < self.tree.max_depth:  # averages weigh by the roots of areas
            areas = self.areas
            found = [
                (row, weight * (float(AREA_WEIGHTS[areas[row]]) if row < field.tree.n_cells else 1.0))
                for row, weight in found
            ]
        total = sum(weight for _, weight in found)
        cover = float(taps.covers[0])
        return [(row, weight / total) for row, weight in found], cover * total if cover > 0 else OFF

    def facing(self, row: int, normal: Array) -> tuple[Array, float]:
        """What a row shows of what faces a normal, and how much it counts."""
        kept = row - self.tree.n_cells
        source = row if kept < 0 else int(self.tree.kept.cells[kept])  # what is kept faces as its cell
        flags = int(self.tree.arrays.flags[source])
        cosines = {facing: float(normal @ AXES[facing]) for facing in _bits(flags & 63)}
        toward = {facing: cosine for facing, cosine in cosines.items() if cosine > 0}
        part = max((_ramp(cosine) for cosine in toward.values()), default=0.0) if cosines else 1.0
        if not flags & SPLIT or not toward:
            return self.values[row], part + AWAY
        most = max(toward.values())
        shares = {facing: max(cosine - most + 0.2, 0.0) for facing, cosine in toward.items()}
        mean = sum(share * self.values[self.rows[source][facing]] for facing, share in shares.items())
        return mean / sum(shares.values()), part + AWAY

    def is_mixed(self, row: int, threshold: float) -> bool:
        """Whether a cell's opposite facings differ."""
        rows = self.rows.get(row, {})
        return any(
            np.abs(self.values[rows[facing]] - self.values[rows[facing + 1]]).max() >= threshold
            for facing in (0, 2, 4)
            if {facing, facing + 1} <= rows.keys()
        )

    def look(self, point: Array, level: int, normal: Array | None, threshold: float) -> tuple[Array, float]:
        """Sum and weight of what one look adds up."""
        taps, cover = self.taps(point, level)
        if normal is not None:
            seen = [(*self.facing(row, normal), weight) for row, weight in taps]
            total = sum(part * weight for _, part, weight in seen)
            return cover * sum(value * part * weight for value, part, weight in seen), cover * total
        first = int(self.fields[level].tree.arrays.level_cells[level])
        is_last = level == self.tree.max_depth
        mixed = [not is_last and row >= first and self.is_mixed(row, threshold) for row, _ in taps]
        weight = sum(weight for (_, weight), out in zip(taps, mixed, strict=True) if not out)
        total = cover * sum(
            (self.values[row] * weight for (row, weight), out in zip(taps, mixed, strict=True) if not out),
            np.zeros(self.values.shape[1]),
        )
        weight *= cover
        left = sum(weight for (_, weight), out in zip(taps, mixed, strict=True) if out)
        if left > 0:
            below, part = self.look(point, level + 1, None, threshold)
            total, weight = total + left * below, weight + left * part
        return total, weight

    def value(
        self, point: Array, width: float | None, normal: Array | None = None, threshold: float = 1 / 32
    ) -> Array:
        """What a footprint shows."""
        looks = [(self.tree.max_depth, 1.0)]
        if width is not None:
            looks = list(_levels(self.texture.placement.size, width, self.tree.max_depth, self.filter))
        found = [(share, *self.look(point, level, normal, threshold)) for level, share in looks]
        total = sum(share * total for share, total, _ in found)
        return np.asarray(total / sum(share * weight for share, _, weight in found))


def _bits(flags: int) -> list[int]:
    return [facing for facing in range(6) if flags >> facing & 1]


def _ramp(cosine: float) -> float:
    t = min(max(cosine, 0.0) / 0.5, 1.0)
    return t * t * (3 - 2 * t)


def _levels(size: float, width: float, depth: int, filter: str) -> Iterator[tuple[int, float]]:
    level = math.log2(size / width) + ROUND_FINER[FILTERS.index(filter)]
    lower = math.floor(level)
    upper = min(max((level - lower - WHOLE) / (1 - 2 * WHOLE), 0.0), 1.0)
    for each, share in ((lower, 1 - upper), (lower + 1, upper)):
        if share > 0:
            yield min(max(each, 0), depth), share
