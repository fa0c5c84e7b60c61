"""Points and voxels without a surface: the cells that hold them become the texture."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

import octex
from octex.arrays import Array, Uint8s
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat, check_range, decode, encode
from octex.checks import as_names
from octex.conversion.levels import CellLevels, assemble, climb
from octex.conversion.samples import nearest_facings
from octex.editing.averages import average, with_summed_areas
from octex.editing.nodes import all_nodes
from octex.errors import ArgumentError, ModelError
from octex.nearest.boxes import order_of
from octex.parallel import Progress
from octex.source.cloud import PointCloud
from octex.source.voxels import Voxels, VoxelValues
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import Dtypes, formats_as
from octex.tree.areas import area_codes
from octex.tree.layout import FACING_FLAGS, GRID_BITS, MAX_DEPTH
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement, on_grid
from octex.voxelize.sums import SumColumns, Sums

#: Default cell width over the spacing of points: an even cloud gets no holes, a random one leaves about a
#: twentieth of the surface's cells empty.
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
    as their points do, and cells with two opposite facings store a mean for each. By default cells are about
    twice as wide as ``PointCloud.spacing``, and at most 14 levels deep.

    Raises ArgumentError for unknown channels and types, and for cells that are too small.
    """
    report("points", 0, 1)
    forms = _stored([BASE_COLOR, ALPHA] if cloud.is_translucent else [BASE_COLOR], channels, dtype)
    bounds = np.array([cloud.points.min(axis=0), cloud.points.max(axis=0)])
    if cell is not None:
        placement, depth = Placement.with_cell(bounds, cell)
    else:
        if depth is None:
            width = _CELLS_A_SPACING * cloud.spacing
            extent = float((bounds[1] - bounds[0]).max())
            depth = int(np.clip(np.rint(np.log2(extent / width)), 0, _DEEPEST)) if 0 < width < np.inf else 0
        placement = Placement.around(bounds, depth)
    leaves = _leaves(cloud, placement, depth, [form.name for form in forms])
    levels, _ = climb(leaves, depth, forms, SumColumns.of(forms))
    stored = [[level] for level in reversed(levels)]
    tree, values, *_ = assemble(
        CellLevels(forms, depth, [leaves.codes], stored, None, None, 0, False, leaves.codes[:0])
    )
    if cloud.normals is None:
        flags = tree.arrays.flags & np.uint8(0xFF ^ FACING_FLAGS)
        tree = tree.with_cell_data(flags, tree.arrays.areas)
    options = {
        **({"depth": depth} if cell is None else {"cell": float(cell)}),
        "channels": {form.name: form.dtype for form in forms},
        "points": len(cloud),
    }
    report("points", 1, 1)
    return OctreeTexture(tree, values, placement, bounds, _metadata(cloud.name, options))


def _stored(
    known: Sequence[ChannelFormat], channels: Sequence[str] | None, dtype: Dtypes
) -> tuple[ChannelFormat, ...]:
    """Return the storage formats of the chosen channels, by default of all."""
    names = [form.name for form in known]
    wanted = names if channels is None else as_names(channels, "channels", names)
    return formats_as([form for form in known if form.name in wanted], dtype)


def _metadata(source: str, options: dict[str, object]) -> dict[str, str]:
    return {"source": source, "octex": octex.__version__, "convert": json.dumps(options)}


def _leaves(cloud: PointCloud, placement: Placement, depth: int, names: Sequence[str]) -> Sums:
    """Add up the points of each cell by facing; a cell's area is that of one of its faces."""
    codes = encode_cells(on_grid(cloud.points, placement) >> (GRID_BITS - depth))
    facings = np.zeros(len(cloud), np.int64)
    if cloud.normals is not None:
        facings = nearest_facings(cloud.normals)
    if depth < MAX_DEPTH:
        order = order_of(codes << 3 | facings, 3 * depth + 3)
    else:  # keys of 66 bits
        order = np.lexsort((facings, codes))
    codes, facings = codes[order], facings[order]
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    counts = np.diff(starts, append=codes.size)
    areas = np.repeat(1.0 / counts, counts)
    rows = cloud.colors.take(order, axis=0).astype(np.float64)
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


def convert_voxels(
    voxels: Voxels, *, channels: Sequence[str] | None = None, dtype: Dtypes = None, report: Progress
) -> OctreeTexture:
    """Convert voxels into an octree texture: each voxel becomes a leaf.

    A leaf stores its voxel's value, integers unchanged where their type is stored, and a node the mean of its
    children, in linear light and weighted by alpha: every leaf weighs as its face is wide.

    Raises ArgumentError for unknown channels and types, and ModelError for voxels that overlap.
    """
    report("voxels", 0, 1)
    forms = _stored([each.form for each in voxels.values.values()], channels, dtype)
    codes, depths = encode_cells(voxels.coords), voxels.depths
    order = np.argsort(codes << 3 * (int(depths.max()) - depths.astype(np.int64)), kind="stable")
    codes, depths = codes[order], depths[order]
    try:
        tree = Octree.from_leaves(codes, depths)
    except ArgumentError:
        raise ModelError(f"{voxels.name}: voxels overlap; keep one at each position") from None
    leaves = np.empty(len(voxels), np.int64)
    for level, (_, is_node) in enumerate(tree.walk()):
        leaves[depths == level] = np.flatnonzero(~is_node) + tree.arrays.level_cells[level]
    areas = np.full(tree.n_cells, area_codes(np.ones(1))[0], np.uint8)
    tree = with_summed_areas(tree.with_cell_data(tree.arrays.flags, areas), all_nodes(tree))
    by_name = {}
    for form in forms:
        values = voxels.values[form.name]
        check_range(values.rows, values.form, form.dtype, voxels.name)
        rows = np.zeros((tree.n_cells, form.components), form.dtype)
        rows[leaves] = _encoded(values, form)[order]
        by_name[form.name] = Channel(form, rows, rows[:0], rows[:0])
    edges = np.ldexp(voxels.size, -voxels.depths.astype(np.int32))[:, None]
    low, high = (voxels.coords * edges).min(axis=0), ((voxels.coords + 1) * edges).max(axis=0)
    bounds = np.array([low, high]) + voxels.origin
    options = {"channels": {form.name: form.dtype for form in forms}, "voxels": len(voxels)}
    metadata = _metadata(voxels.name, options)
    texture = OctreeTexture(tree, by_name, Placement(voxels.origin, voxels.size), bounds, metadata)
    for name in sorted(by_name, key=lambda each: each != ALPHA.name):  # alpha first: it weighs the others
        average(texture, by_name[name])
    report("voxels", 1, 1)
    return texture


def _encoded(values: VoxelValues, form: ChannelFormat) -> Array:
    if values.form == form and values.rows.dtype == form.dtype:
        return values.rows
    is_coded = values.rows.dtype.kind == "u"
    return encode(decode(values.rows, values.form.space) if is_coded else values.rows, form.dtype, form.space)
