"""Blur over the surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Uint8s
from octex.channels import ALPHA, decode, encode
from octex.checks import as_number
from octex.editing.averages import average_plain, coverage, weighted_means
from octex.editing.nodes import all_leaves
from octex.parallel import Run, as_run
from octex.processing.edit import Centres, names_of, with_operation, with_values
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import AREAS
from octex.tree.layout import FACING_FLAGS
from octex.tree.split import Rows, rows_of


def blur(
    texture: OctreeTexture,
    width: float,
    channel: str | Sequence[str] | None = None,
    *,
    threads: int | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Return a texture that is blurred over its surface.

    width     width of the blur, in the model's units
    channel   one name, several, or None for all. Unless alpha is blurred too, it stays and weights the others
    run       how to work (octex.Run)

    Each leaf becomes ``texture.sample(centre, width=width, normals=facing)``: the average over a square
    around its centre, of surface with the same facing. So nothing bleeds through a thin sheet. Split leaves
    are blurred for each facing. Leaves wider than ``width`` are blurred in part: a width of 0 changes
    nothing. Averages are recomputed.

    Raises ArgumentError for unknown channels, and for a negative or non-finite width.
    """
    run, names = as_run(run, threads), names_of(texture, channel)
    width = as_number(width, "width", 0.0, np.finfo(np.float64).max)
    if width == 0:
        return texture
    tree = texture.tree
    channels = {name: texture.channels[name].copied() for name in names}
    is_leaf = all_leaves(tree)
    rows = rows_of(tree.split)
    rows = rows.of(is_leaf[rows.cells])
    is_leaf[rows.cells] = False
    plain, kept = np.flatnonzero(is_leaf), tree.kept.cells.astype(np.int64)
    # The share that stays of each cell's difference from the field: of nodes, the mean of the leaves' shares.
    first = tree.arrays.level_cells
    edges = texture.placement.size * np.ldexp(1.0, -np.arange(first.size - 1))
    shares = np.repeat(np.maximum(edges - width, 0) / edges, np.diff(first)).astype(np.float32)
    average_plain(tree, shares)
    centres_of = Centres(tree, texture.placement)
    flags = tree.arrays.flags & np.uint8(FACING_FLAGS)
    for index, numbers, cells, facings in (
        (0, plain, plain, flags[plain]),
        (1, *rows),
        (2, np.arange(kept.size), kept, flags[kept]),
    ):
        centres = centres_of[cells]
        blurred = _sampled(texture, names, centres, facings, width, run)
        partly = np.flatnonzero(shares[cells] > 0)
        field = _sampled(texture, names, centres[partly], facings[partly], None, run)
        for name, (form, *arrays) in channels.items():
            stored = arrays[index]
            old = decode(stored[numbers[partly]], form.space)
            blurred[name][partly] += shares[cells[partly], None] * (old - field[name])
            stored[numbers] = encode(blurred[name], form.dtype, form.space)
    _average_facings(texture, channels, rows, shares)
    wide = shares[:, None].astype(np.float64)
    changes = dict.fromkeys(names, lambda cells, values, means: wide[cells] * (values - means))
    metadata = with_operation(texture.metadata, "blur", channels=names, width=width)
    return with_values(texture, channels, changes, metadata)


def _sampled(
    texture: OctreeTexture,
    names: list[str],
    centres: Float64s,
    facings: Uint8s,
    width: float | None,
    run: Run,
) -> dict[str, Float32s]:
    """Return the field at centres (n, 3), for facing flags (n,); a normal selects a single facing."""
    axes = np.stack([(facings >> bit & 1).astype(np.int8) for bit in range(6)], axis=1)
    normals = (axes[:, 0::2] - axes[:, 1::2]).astype(np.float32)
    has_normal = (axes[:, 0::2] & axes[:, 1::2] == 0).all(axis=1) & (facings > 0)
    sampled = {
        name: np.empty((len(centres), texture.channels[name].format.components), np.float32) for name in names
    }
    for mask, facing in ((has_normal, normals[has_normal]), (~has_normal, None)):
        values = texture.sample(centres[mask], names, width=width, normals=facing, normalize=False, run=run)
        for name, of_mask in values.items():
            sampled[name][mask] = of_mask
    return sampled


def _average_facings(
    texture: OctreeTexture, blurred: Mapping[str, Channel], rows: Rows, shares: Float32s
) -> None:
    """Set split leaves to the means of their rows, in place, plus ``shares`` of their residuals."""
    starts = np.flatnonzero(np.diff(rows.cells, prepend=-1, append=-1))
    split = rows.cells[starts[:-1]]
    areas = AREAS[texture.tree.split.areas[rows.rows]].astype(np.float32)

    def means(channels: Mapping[str, Channel], name: str) -> Float32s:
        weights = areas
        if name != ALPHA.name and ALPHA.name in channels:
            weights = areas * coverage(channels[ALPHA.name].split_values[rows.rows])
        channel = channels[name]
        return weighted_means(starts, weights, channel.split_values[rows.rows], channel.format.space)

    channels = {**texture.channels, **blurred}
    for name, channel in blurred.items() if split.size else ():
        form = channel.format
        residuals = decode(texture.channels[name].values[split], form.space) - means(texture.channels, name)
        values = means(channels, name) + shares[split, None] * residuals
        channel.values[split] = encode(values, form.dtype, form.space)
