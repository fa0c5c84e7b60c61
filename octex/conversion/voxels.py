"""Voxels by themselves: each is a leaf of the texture."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

import octex
from octex.arrays import Array
from octex.channels import ALPHA, ChannelFormat, check_range, decode, encode
from octex.checks import as_choice, as_names
from octex.editing.averages import average, with_summed_areas
from octex.editing.nodes import all_nodes
from octex.errors import ArgumentError, ModelError
from octex.parallel import Progress, silent
from octex.source.voxels import Values, Voxels
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import Dtypes, formats_as
from octex.tree.areas import area_codes
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement


def convert_voxels(
    voxels: Voxels,
    *,
    channels: Sequence[str] | None = None,
    dtype: Dtypes = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Convert voxels into an octree texture, whose leaves they are.

    A leaf has its voxel's value, codes as they are where their type is stored, and a node the mean of its
    children, in linear light and weighted by alpha: every leaf weighs as its face is wide.

    Raises ArgumentError for unknown channels and types, and ModelError for voxels that overlap.
    """
    report = progress or silent
    report("voxels", 0, 1)
    names = [*voxels.values]
    wanted = names if channels is None else as_names(channels, "channels")
    for name in wanted:
        as_choice(name, names, "channel")
    forms = formats_as([voxels.values[name].form for name in names if name in wanted], dtype)
    deepest = int(voxels.depths.max())
    codes, depths = encode_cells(voxels.coords), voxels.depths
    order = np.argsort(codes << 3 * (deepest - depths.astype(np.int64)), kind="stable")
    codes, depths = codes[order], depths[order]
    try:
        tree = Octree.from_leaves(codes, depths)
    except ArgumentError:
        raise ModelError(f"{voxels.name}: some of its voxels overlap; keep one at each place") from None
    leaves = np.empty(len(voxels), np.int64)
    for level, (_, is_node) in enumerate(tree.walk()):
        leaves[depths == level] = np.flatnonzero(~is_node) + tree.arrays.level_cells[level]
    areas = np.full(tree.n_cells, area_codes(np.ones(1))[0], np.uint8)
    tree = with_summed_areas(tree.with_cell_data(tree.arrays.flags, areas), all_nodes(tree))
    made = {}
    for form in forms:
        rows = np.zeros((tree.n_cells, form.components), form.dtype)
        given = voxels.values[form.name]
        check_range(given.rows, given.form, form.dtype, voxels.name)
        rows[leaves] = _stored(given, form)[order]
        none = np.empty((0, form.components), form.dtype)
        made[form.name] = Channel(form, rows, none, none)
    edges = np.ldexp(voxels.size, -voxels.depths.astype(np.int32))[:, None]
    low, high = (voxels.coords * edges).min(axis=0), ((voxels.coords + 1) * edges).max(axis=0)
    options = {"channels": {form.name: form.dtype for form in forms}, "voxels": len(voxels)}
    metadata = {"source": voxels.name, "octex": octex.__version__, "convert": json.dumps(options)}
    placement = Placement(voxels.origin, voxels.size)
    texture = OctreeTexture(tree, made, placement, np.array([low, high]) + voxels.origin, metadata)
    for name in sorted(made, key=lambda each: each != ALPHA.name):  # which the others are weighed by
        average(texture, made[name])
    report("voxels", 1, 1)
    return texture


def _stored(values: Values, form: ChannelFormat) -> Array:
    """Return values as they are stored; codes of the same form are not touched."""
    if values.form == form and values.rows.dtype == form.dtype:
        return values.rows
    given = values.rows
    linear = decode(given, values.form.space) if given.dtype.kind == "u" else given
    return encode(linear, form.dtype, form.space)
