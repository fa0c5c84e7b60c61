"""Points by themselves: the cells that they lie in become the texture."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

import octex
from octex.arrays import Uint8s
from octex.channels import ALPHA, BASE_COLOR
from octex.checks import as_choice, as_names
from octex.conversion.levels import CellLevels, assemble, climb
from octex.nearest.boxes import order_of, rows_in
from octex.parallel import Progress
from octex.source.cloud import PointCloud
from octex.texture import OctreeTexture
from octex.texture.channel import Dtypes, formats_as
from octex.tree.layout import FACING_FLAGS, GRID_BITS, MAX_DEPTH
from octex.tree.morton import encode_cells
from octex.tree.placement import Placement, on_grid
from octex.voxelize.sums import SumColumns, Sums

#: By default cells are so many times as wide as points are apart: those of an even cloud have no holes, and
#: of cells around points at random a twentieth or so is empty.
_CELLS_A_SPACING = 2.0
_DEEPEST = 14


def convert_points(
    cloud: PointCloud,
    depth: int | None = None,
    *,
    cell: float | None = None,
    channels: Sequence[str] | None = None,
    dtype: Dtypes = None,
    report: Progress,
) -> OctreeTexture:
    """Convert points into an octree texture, whose leaves are the finest cells that hold one.

    A leaf's value is the mean of its points' colours, in linear light and weighted by alpha, and a node's
    that of its children: every leaf weighs the same, however many points lie in it. With normals, cells face
    as their points do, and those that show both ways along an axis keep a mean for each. By default cells are
    about twice as wide as points are apart, ``PointCloud.spacing``, and at most 14 levels deep.

    Raises ArgumentError for unknown channels and types, and for cells that are too small.
    """
    report("points", 0, 1)
    forms = [BASE_COLOR, ALPHA] if cloud.is_translucent else [BASE_COLOR]
    names = None if channels is None else as_names(channels, "channels")
    for name in names or ():
        as_choice(name, [form.name for form in forms], "channel")
    forms = [form for form in forms if names is None or form.name in names]
    stored = formats_as(forms, dtype)
    bounds = np.array([cloud.points.min(axis=0), cloud.points.max(axis=0)])
    if cell is not None:
        placement, depth = Placement.with_cell(bounds, cell)
    else:
        if depth is None:
            width = _CELLS_A_SPACING * cloud.spacing
            extent = float((bounds[1] - bounds[0]).max())
            depth = int(np.clip(np.rint(np.log2(extent / width)), 0, _DEEPEST)) if 0 < width < np.inf else 0
        placement = Placement.around(bounds, depth)
    columns = SumColumns.of(stored)
    leaves = _leaves(cloud, placement, depth, [form.name for form in stored])
    levels, _ = climb(leaves, depth, stored, columns)
    stored_levels = [[level] for level in reversed(levels)]
    filled = CellLevels(stored, depth, [leaves.codes], stored_levels, None, None, 0, False, leaves.codes[:0])
    tree, values, *_ = assemble(filled)
    if cloud.normals is None:
        flags = tree.arrays.flags & np.uint8(0xFF ^ FACING_FLAGS)
        tree = tree.with_cell_data(flags, tree.arrays.areas)
    options = {
        **({"depth": depth} if cell is None else {"cell": float(cell)}),
        "channels": {form.name: form.dtype for form in stored},
        "points": len(cloud),
    }
    metadata = {"source": cloud.name, "octex": octex.__version__, "convert": json.dumps(options)}
    report("points", 1, 1)
    return OctreeTexture(tree, values, placement, bounds, metadata)


def _leaves(cloud: PointCloud, placement: Placement, depth: int, names: Sequence[str]) -> Sums:
    """Add up the points in each cell, by the way they face; a cell's area is that of one of its faces."""
    codes = encode_cells(on_grid(cloud.points, placement) >> (GRID_BITS - depth))
    facings = np.zeros(len(cloud), np.int64)
    if cloud.normals is not None:
        axes = np.abs(cloud.normals).argmax(axis=1)
        facings = 2 * axes + (np.take_along_axis(cloud.normals, axes[:, None], axis=1)[:, 0] < 0)
    if depth < MAX_DEPTH:
        order = order_of(codes << 3 | facings, 3 * depth + 3)
    else:  # keys of 66 bits
        order = np.lexsort((facings, codes))
    codes, facings = codes[order], facings[order]
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    counts = np.diff(starts, append=codes.size)
    areas = np.repeat(1.0 / counts, counts)
    rows = rows_in(order, cloud.colors).astype(np.float64)
    if ALPHA.name in names:
        rows[:, 3] *= areas
        rows[:, :3] *= rows[:, 3:]
    else:
        rows[:, :3] *= areas[:, None]
    columns = [*([0, 1, 2] if BASE_COLOR.name in names else []), *([3] if ALPHA.name in names else [])]
    rows = np.column_stack([rows[:, columns], areas])
    entries = np.flatnonzero((np.diff(codes, prepend=-1) != 0) | (np.diff(facings, prepend=-1) != 0))
    bits = (np.uint8(1) << facings.astype(np.uint8)).astype(np.uint8)
    flags: Uint8s = np.bitwise_or.reduceat(bits, starts)
    return Sums(codes[starts], flags, np.add.reduceat(rows, entries))
