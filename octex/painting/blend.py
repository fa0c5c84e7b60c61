"""Blends paint with a texture, and averages the nodes above.

A node's residual is weighted: the texture's for the part without paint, the layer's for the painted part. So
averages stay those of the source where nothing changed, and become those of the paint where all did.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from octex.arrays import Array, Bools, Float32s, Floats, Int64s, Uint8s
from octex.channels import ALPHA, ChannelFormat, alpha_of, decode, encode, plain_name
from octex.editing.averages import Residuals, average, average_rows, residuals_at, with_summed_areas
from octex.editing.nodes import Nodes, nodes_at
from octex.editing.split import rows_facing, split_in_vain, with_split, without_split
from octex.errors import DefectError, InputError
from octex.painting.image import Blend
from octex.painting.layer import Paint, leave_bare, painted_channel
from octex.painting.surface import Job
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.edit import among, locate, with_all_above
from octex.tree.layout import FACING_FLAGS, POSITIVE_FACINGS, SPLIT
from octex.tree.octree import Octree, distinct
from octex.tree.split import Rows, rows_of

#: Least coverage of paint that hides the texture: less than half a step of 8 bits shows through.
_HIDING = 1.0 - 1.0 / 512.0

#: The arrays of a channel: of cells, of the facings of split cells, and of kept nodes.
Kind: TypeAlias = Literal["values", "split_values", "kept_values"]
KINDS: tuple[Kind, ...] = get_args(Kind)


class Merge(NamedTuple):
    """A layer to merge into a texture."""

    job: Job
    texture: OctreeTexture
    layer: OctreeTexture  # for a piece, the layer around it
    target: str  # the painted channel
    blend: Blend
    opacity: float
    coarsest: int  # the level of the largest leaf or kept node that the layer touches

    @property
    def is_all_painted(self) -> bool:
        """Whether the texture has only painted channels."""
        painted = {self.target, alpha_of(self.target)} if self.blend == "over" else {self.target}
        return painted >= self.texture.channels.keys()

    @property
    def hiding(self) -> float:
        """The least coverage of paint that hides the texture."""
        least = {"over": _HIDING, "erase": _HIDING, "replace": 0.0}
        return least.get(self.blend, np.inf) if self.is_all_painted else np.inf


class Raised(NamedTuple):
    """A texture raised to paint."""

    texture: OctreeTexture
    old: Int64s  # (cells,)   each cell's number in the texture before; −1 for new cells
    is_fresh: Bools  # (cells,)   cells where the texture had none
    is_skirt: Bools  # (cells,)   leaves without surface
    added: list[Int64s]  # cells of the layer where the texture had none, by level


class Merged(NamedTuple):
    """A texture with paint merged into it."""

    texture: OctreeTexture
    parts: OctreeTexture  # the same cells; the painted part of the painted channels, 0 … 1
    is_fresh: Bools  # (cells,)   cells where the texture had no cell, nor a larger leaf
    is_new: Bools  # (cells,)   cells that the texture did not have
    painted: list[Int64s]  # the painted leaves, by level
    averages_rows: bool  # whether split rows of all channels are averaged
    added: list[Int64s]  # cells of the layer where the texture had none, by level


class Above(NamedTuple):
    """The nodes above paint, and their numbers in other trees; see `nodes_at`."""

    nodes: Nodes
    before: Nodes  # in the texture before it was raised
    layer: Nodes  # in the paint octree


@contextmanager
def own_making() -> Iterator[None]:
    """Raise DefectError for any refusal inside: for parts that octex made from checked input."""
    try:
        yield
    except InputError as error:
        raise DefectError(str(error)) from error


def blended(base: Float32s, paint: Float32s, coverage: Float32s, blend: Blend) -> Float32s:
    """Blend paint (n, components) of a coverage (n,) with ``base`` values; see BLENDS."""
    if blend == "replace":
        coverage = (coverage > 0).astype(np.float32)
    part = coverage[:, None]
    if blend == "add":
        return base + part * paint
    if blend == "multiply":
        paint = base * paint
    elif blend == "screen":
        paint = 1 - (1 - base) * (1 - paint)
    elif blend == "erase":
        paint = np.zeros_like(base)
    return (1 - part) * base + part * paint  # exactly the paint where it is opaque, however bright the base


def read(channel: Channel, kind: Kind, rows: Int64s) -> Float32s:
    """Return the decoded values of rows (n,) of a kind."""
    return decode(getattr(channel, kind).take(rows, axis=0), channel.format.space)


def write(channel: Channel, kind: Kind, rows: Int64s, values: Array) -> None:
    """Encode values (n, components), and write them to rows of a kind."""
    getattr(channel, kind)[rows] = encode(values, channel.format.dtype, channel.format.space)


def covers(blend: Blend, target: str) -> bool:
    """Return whether paint on a channel adds to its alpha: in layers in each mode, else only ``over``."""
    return blend == "over" or (blend in ("multiply", "screen", "add") and target != plain_name(target))


def mixed(
    blend: Blend,
    target: str,
    old: Mapping[str, Float32s],
    paint: Float32s,
    coverage: Float32s,
    is_fresh: Bools,
) -> dict[str, tuple[Float32s, Float32s]]:
    """Return channels' values after paint (n, components), and its part of each (n,)."""
    ones = np.ones((len(paint), 1), np.float32)
    alpha = alpha_of(target)
    if blend == "erase":
        paint = 0 * ones
    elif alpha is None:
        paint = ones
    mixes = {target: (paint, (coverage > 0).astype(np.float32) if blend == "replace" else coverage)}
    if blend != "over" and alpha is not None and covers(blend, target):
        # In a layer, paint on nothing keeps its colour, and covers as much in each mode.
        old_alpha = np.where(is_fresh, np.float32(0), old[alpha][:, 0])
        full = blended(old[target], paint, np.ones_like(coverage), blend)
        paint, blend = blended(paint, full, old_alpha, "over"), "over"
    if blend == "over" and alpha is not None and alpha in old:
        # Over a translucent colour, paint counts for more of the colour (Porter & Duff 1984).
        old_alpha = np.where(is_fresh, np.float32(0), old[alpha][:, 0])
        united = coverage + old_alpha * (1 - coverage)
        part = np.where(united > 0, coverage / np.maximum(united, np.float32(1e-9)), np.float32(0))
        mixes = {target: (paint, part), alpha: (ones, coverage)}
    elif alpha is not None and alpha in old and is_fresh.any():
        mixes[alpha] = ones, np.zeros_like(coverage)
    for name, (values, part) in mixes.items():
        new = blended(old[name], values, part, "over" if name == alpha else blend)
        new[is_fresh] = values[is_fresh] if name == target else coverage[is_fresh, None]
        mixes[name] = new, np.where(is_fresh, np.float32(1), part)
    return mixes


def blend_rows(
    task: Merge,
    channels: Mapping[str, Channel],
    parts: Mapping[str, Channel],
    kind: Kind,
    rows: Int64s,
    old: Mapping[str, Float32s],
    paint: Float32s,
    coverage: Float32s,
    is_fresh: Bools,
    bare: Int64s | None = None,
) -> None:
    """Blend paint (n, components) with ``old`` values, and write rows (n,) of channels and painted parts.

    Fresh rows without paint get the values of the cells ``bare`` (n,), if given, but in alpha.
    """
    for name, (new, part) in mixed(task.blend, task.target, old, paint, coverage, is_fresh).items():
        if bare is not None and alpha_of(name) is not None:
            is_bare = is_fresh & (coverage == 0)
            new[is_bare] = read(channels[name], "values", bare[is_bare])
        write(channels[name], kind, rows, new)
        if kind != "kept_values":
            getattr(parts[name], kind)[rows, 0] = part


def facings_of_paint(task: Merge, paint: Paint, bits: Uint8s) -> tuple[Float32s, Float32s]:
    """Return the paint on facings (n,) of cells (n,), and its coverage.

    A facing that the layer's cell lacks gets the paint of the whole cell, unless that has SPLIT.
    """
    layer = task.layer
    values = rows_facing(layer, layer.channels[painted_channel(layer)], paint.cells, bits)
    coverage = rows_facing(layer, layer.channels[ALPHA.name], paint.cells, bits)[:, 0]
    coverage *= np.float32(task.opacity)
    is_absent = layer.tree.arrays.flags[paint.cells] & bits == 0
    values[is_absent] = paint.values[is_absent]
    is_bare = leave_bare(bits, paint.flags)
    coverage[is_absent] = np.where(is_bare, np.float32(0), paint.coverage)[is_absent]
    return values, coverage


def no_parts(tree: Octree, names: Iterable[str]) -> dict[str, Channel]:
    """Return painted parts of channels, by name: 0 in all cells."""
    return {name: Channel.full(ChannelFormat(name, 1, "data", "float32"), tree) for name in names}


def with_split_cells(texture: OctreeTexture, cells: Int64s) -> OctreeTexture:
    """Return a texture with these cells, ascending, split."""
    if not cells.size:
        return texture
    return with_split(texture, cells, texture.tree.arrays.flags[cells] & np.uint8(FACING_FLAGS), {})


def writable(texture: OctreeTexture, names: Collection[str]) -> dict[str, Channel]:
    """Return a texture's channels, with copies of those of these names."""
    return {name: each.copied() if name in names else each for name, each in texture.channels.items()}


def may_differ(tree: Octree, cells: Int64s, painted: Uint8s, above: Above) -> Int64s:
    """Return the cells, ascending, whose facings may differ after paint with flags (n,) on leaves."""
    flags = tree.arrays.flags
    facings = flags & np.uint8(FACING_FLAGS)
    leaves = cells[((flags[cells] | painted) & SPLIT != 0) & (facings[cells] != 0)]
    nodes = above.nodes.cells
    opposite = facings[nodes] & facings[nodes] >> np.uint8(1) & np.uint8(POSITIVE_FACINGS)
    return np.sort(np.concatenate([leaves, nodes[(opposite != 0) | (flags[nodes] & SPLIT != 0)]]))


def all_above(codes: Sequence[Int64s]) -> list[Int64s]:
    """Return the cells above cells, listed by level."""
    return with_all_above([each >> 3 for each in codes[1:]])


def with_areas_above(texture: OctreeTexture, codes: Sequence[Int64s]) -> OctreeTexture:
    """Return a texture whose nodes above cells, listed by level, have the areas of their children."""
    tree = with_summed_areas(texture.tree, nodes_at(texture.tree, all_above(codes)))
    return texture.with_cells(tree, texture.channels)


def nodes_above(tree: Octree, codes: Sequence[Int64s], is_new: Bools, before: Octree, layer: Octree) -> Above:
    """Find the nodes above leaves, listed by level, and split old nodes above new cells."""
    above = all_above(codes)
    has_turned = bool(is_new.any() and before.split.cells.size)
    over_new = np.empty(0, np.int64)
    for level, (level_codes, is_node) in reversed(list(enumerate(tree.walk())) if has_turned else []):
        span = slice(*tree.arrays.level_cells[level : level + 2].tolist())
        split = level_codes[is_node & (tree.arrays.flags[span] & SPLIT != 0)]
        split = split[among(split, over_new)]
        where = locate(before, split, level)
        if level < len(above):
            was_node = (where.levels == level) & ~where.is_leaf
            above[level] = distinct(np.concatenate([above[level], split[was_node]]))
        over_new = distinct(np.concatenate([over_new, level_codes[is_new[span]]]) >> 3)
    nodes = nodes_at(tree, above)
    is_same = tree.arrays.groups is before.arrays.groups
    return Above(nodes, nodes if is_same else nodes_at(before, above), nodes_at(layer, above))


def averaged(
    task: Merge,
    draft: OctreeTexture,
    raised: Raised,
    base: OctreeTexture,
    channels: dict[str, Channel],
    parts: dict[str, Channel],
    above: Above,
    painted: list[Int64s],
    averages_rows: bool = False,
) -> Merged:
    """Average the nodes above painted leaves, in place; join split cells whose facings agree.

    base        the raised texture, with more cells split: those whose facings may differ
    channels    its channels with paint on the leaves
    parts       the painted part of channels on the leaves
    painted     the painted leaves, by level
    """
    is_new, is_fresh = raised.old < 0, raised.is_fresh
    after = base.with_cells(base.tree, channels)
    names = channels if is_new.any() else averaged_with(channels, parts)
    rows = rows_of(base.tree.split, above.nodes.cells)
    _, values, facings, _ = task.layer.channels[painted_channel(task.layer)]
    is_one = values.dtype.kind == "u" and np.array_equal(values[1:], values[:-1])
    is_one = is_one and bool((facings == values[0]).all())  # then none of its residuals differs from 0
    residuals = {}
    for name in alpha_first(names):
        residuals[name] = _residuals_before(draft, raised, name, above, rows)
        if name in parts:
            takes_on = (
                name == task.target and task.blend in ("over", "replace") and alpha_of(name) is not None
            )
            layer = task.layer if takes_on and not is_one else None
            residuals[name] = _residuals_after(
                after, channels[name].format, parts[name], above, rows, residuals[name], layer
            )
        average(after, channels[name], residuals[name], above.nodes)
    new_split = np.flatnonzero(base.tree.arrays.flags & ~raised.texture.tree.arrays.flags & SPLIT)
    excess = split_in_vain(after, new_split)
    has_rows = averages_rows or excess.size < new_split.size
    stays = ~among(rows.cells, excess)
    texture = without_split(after, excess)
    if has_rows or excess.size:
        copies = {
            name: each._replace(split_values=each.split_values.copy())
            for name, each in texture.channels.items()
        }
        texture = texture.with_cells(texture.tree, copies)
        rows = rows_of(texture.tree.split, above.nodes.cells)
        of_rows = {name: each.rows[stays] for name, each in residuals.items()}
        if has_rows:
            for name in copies.keys() - residuals.keys():
                of_rows[name] = _residuals_before(draft, raised, name, above, rows).rows
        for name in alpha_first(of_rows):
            average_rows(texture, copies[name], of_rows[name], above.nodes)
    remaining_parts = without_split(base.with_cells(base.tree, parts), excess)
    return Merged(texture, remaining_parts, is_fresh, is_new, painted, has_rows, raised.added)


def averaged_with(channels: Iterable[str], changed: Collection[str]) -> list[str]:
    """Return the channels that changed, or whose alpha did."""
    return [name for name in channels if name in changed or alpha_of(name) in changed]


def alpha_first(names: Iterable[str]) -> list[str]:
    """Return channels in the order to average them in: averages of alpha weigh the others."""
    return sorted(names, key=lambda name: alpha_of(name) is not None)


def mixed_residuals(before: Floats, paint: Floats | None, part: Float32s) -> Floats:
    """Weight residuals by the part without paint, and the paint's residuals, if given, by its part."""
    rest = before * (1 - part)
    return rest if paint is None else rest + paint * part


def _residuals_before(draft: OctreeTexture, raised: Raised, name: str, above: Above, rows: Rows) -> Residuals:
    """Return the residuals of nodes and their ``rows`` before the merge; 0 where the texture had no cell."""
    nodes, was = above.nodes, above.before.numbers >= 0
    owners = np.searchsorted(nodes.cells, rows.cells)
    known = residuals_at(draft, name, above.before, owners, rows.bits)
    is_done = was | raised.is_fresh[nodes.cells]
    if is_done.all():
        return known
    missing = nodes._replace(numbers=np.where(is_done, -1, nodes.numbers))
    added = residuals_at(raised.texture, name, missing, owners, rows.bits)
    return Residuals(known.nodes + added.nodes, known.rows + added.rows)


def _residuals_after(
    texture: OctreeTexture,
    form: ChannelFormat,
    part: Channel,
    above: Above,
    rows: Rows,
    before: Residuals,
    layer: OctreeTexture | None,
) -> Residuals:
    """Mix residuals with the layer's, if given, by its ``part``, whose nodes are averaged in place."""
    part = part._replace(format=form._replace(components=1, space="data", dtype="float32"))
    average(texture, part, nodes=above.nodes)
    parts = part.values[above.nodes.cells], part.split_values[rows.rows]
    paint: Residuals | tuple[None, None] = (None, None)
    if layer is not None:
        owners = np.searchsorted(above.nodes.cells, rows.cells)
        paint = residuals_at(layer, painted_channel(layer), above.layer, owners, rows.bits)
    return Residuals(*map(mixed_residuals, before, paint, parts))


def averaged_above(task: Merge, draft: OctreeTexture, merged: Merged) -> Merged:
    """Average the nodes above painted tiles, which are leaves here, in ``draft`` and in the layer."""
    texture = merged.texture
    old = np.where(merged.is_new, -1, 0)
    raised = Raised(texture, old, merged.is_fresh, np.zeros(old.size, np.bool_), [])
    above = nodes_above(texture.tree, merged.painted, merged.is_new, draft.tree, task.layer.tree)
    may_split = may_differ(texture.tree, np.empty(0, np.int64), np.empty(0, np.uint8), above)
    base, parts = (with_split_cells(each, may_split) for each in (texture, merged.parts))
    channels, part_channels = writable(base, base.channels), writable(parts, parts.channels)
    return averaged(
        task, draft, raised, base, channels, part_channels, above, merged.painted, merged.averages_rows
    )
