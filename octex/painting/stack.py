"""A stack of layers in one texture, its composite, and its file.

All layers have the cells of one tree. The bottom's channels have the usual names. A layer has a channel for
each one that it paints, and the coverage of each as alpha. The composite is stored where it may differ from
the bottom, so that an edit composites only the tiles that it touches.

In a file the usual names are the composite's, so that programs without layers show it. The bottom follows
where it differs; the metadata list the layers, with a digest of the composite that reveals later edits.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.arrays import Array, Bools, Float32s, Floats, Int64s
from octex.channels import ALPHA, alpha_of, channel_in, plain_name
from octex.checks import as_choice, as_flag, as_number
from octex.conversion.large import digest_of
from octex.editing.averages import Residuals, average, residuals
from octex.editing.nodes import Nodes, all_leaves
from octex.errors import ArgumentError
from octex.painting.blend import KINDS, Kind, alpha_first, mixed, mixed_residuals, read, write
from octex.painting.layer import COVERAGE
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts
from octex.tree.children import children_of, node_cells
from octex.tree.split import rows_of

#: How layers combine with what is below them.
LayerBlend = Literal["over", "multiply", "screen", "add"]
LAYER_BLENDS: tuple[LayerBlend, ...] = get_args(LayerBlend)

#: The composite's prefix, where layers have a number.
_ALL = "all"
_LONGEST_NAME = 40
#: Cells that are blended in one pass.
_BLOCK = 1 << 16


class Layer(NamedTuple):
    """A layer of a stack.

    opacity     0 … 1, multiplies its coverage
    blend       how it combines with what is below, in linear light: over, multiply, screen or add
    has_mask    whether its mask, coverage that can be painted for itself, counts
    """

    number: int
    name: str
    opacity: float = 1.0
    blend: LayerBlend = "over"
    is_visible: bool = True
    has_mask: bool = False

    def paints(self, channel: str) -> str:
        """Return the name of the layer's own values of a channel."""
        return channel_in(f"{self.number} {channel}", channel)

    @property
    def mask(self) -> str:
        """The name of the layer's mask: how much of it is hidden."""
        return channel_in(f"{self.number} mask", ALPHA.name)

    def of_own(self, layer: Layer, name: str) -> str:
        """Return the name of another layer's channel in this one."""
        if name == layer.mask:
            return self.mask
        theirs, ours = (channel_in(f"{each.number} ", plain_name(name)) for each in (layer, self))
        return ours + name.removeprefix(theirs)

    def painted(self, names: Sequence[str] | Mapping[str, Channel]) -> list[str]:
        """Return which channels the layer paints."""
        return [name for name in names if self.paints(name) in names]

    def owns(self, name: str) -> bool:
        """Return whether a channel of a texture is this layer's."""
        return name.startswith(channel_in(f"{self.number} ", plain_name(name)))


def check_layer(layer: Layer) -> Layer:
    """Return a checked layer, or raise ArgumentError."""
    name = layer.name
    if not isinstance(name, str) or not name.strip() or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ArgumentError(f"name must be a line of 1 to {_LONGEST_NAME} characters, not {name!r}")
    as_choice(layer.blend, LAYER_BLENDS, "blend")
    return layer._replace(
        opacity=as_number(layer.opacity, "opacity", 0.0, 1.0),
        is_visible=as_flag(layer.is_visible, "is_visible"),
        has_mask=as_flag(layer.has_mask, "has_mask"),
    )


Stack = tuple[Layer, ...]  # from the lowest to the highest


def composite_name(channel: str) -> str:
    """Return the name of the composite of a channel."""
    return channel_in(_ALL, channel)


def bottom_names(texture: OctreeTexture) -> list[str]:
    """Return the names of the channels of a stack's bottom."""
    return [name for name in texture.channels if name == plain_name(name)]


def composited(texture: OctreeTexture, stack: Stack) -> list[str]:
    """Return the channels whose composite may differ from the bottom: all, where alpha weighs them."""
    names = bottom_names(texture)
    painted = [name for name in names if any(layer.paints(name) in texture.channels for layer in stack)]
    return names if painted and ALPHA.name in names else painted


def with_channels(texture: OctreeTexture, channels: Mapping[str, Channel]) -> OctreeTexture:
    """Return a texture with other channels of the same cells."""
    return texture.with_cells(texture.tree, channels)


def only(texture: OctreeTexture, names: Collection[str]) -> OctreeTexture:
    """Return a texture with those of its channels that have these names."""
    return with_channels(texture, {name: each for name, each in texture.channels.items() if name in names})


def shown_names(texture: OctreeTexture) -> dict[str, str]:
    """Return for each of the bottom's channels the name of its composite: the bottom's where they agree."""
    names = {name: composite_name(name) for name in bottom_names(texture)}
    return {name: composite if composite in texture.channels else name for name, composite in names.items()}


def shown(texture: OctreeTexture, names: Mapping[str, str]) -> OctreeTexture:
    """Return the composite of a stack's texture as a texture, which shares the arrays."""
    return with_channels(
        texture, {name: texture.channels[stored].named(name) for name, stored in names.items()}
    )


def with_layer_channels(texture: OctreeTexture, names: Iterable[str]) -> OctreeTexture:
    """Return a stack's texture with these channels of layers and of the composite; new ones have no paint."""
    channels = dict(texture.channels)
    for name in names:
        if name in channels or name == plain_name(name):
            continue
        bottom = channels.get(plain_name(name))
        if bottom is not None and name == composite_name(plain_name(name)):
            channels[name] = bottom.copied().named(name)
            continue
        form = COVERAGE if bottom is None or alpha_of(name) is None else bottom.format
        channels[name] = Channel.full(form, texture.tree).named(name)
    return with_channels(texture, channels)


def with_composite(texture: OctreeTexture, stack: Stack, first: int = 0) -> OctreeTexture:
    """Return a stack's texture with its composite computed; leaves before cell ``first`` keep theirs.

    Nodes whose children all equal the bottom's do so too. Others are the means of their children, plus the
    residuals of the bottom and of the layers, each weighted by its visible part.
    """
    tree, names = texture.tree, composited(texture, stack)
    channels = {
        name: channel
        for name, channel in texture.channels.items()
        if name != composite_name(plain_name(name))
    }
    if not names:
        return with_channels(texture, channels)
    visible = [layer for layer in stack if layer.is_visible and layer.opacity > 0]
    layers = [layer for layer in visible if _has_paint(texture, layer)]
    covered = list(_covered(texture, layers)) if visible else []
    is_leaf = all_leaves(tree)
    owners = rows_of(tree.split).cells
    chosen = is_leaf.copy()
    chosen[:first] = False
    stays = is_leaf & ~chosen
    composites = {}
    for name in names:
        bottom, composite = texture.channels[name], texture.channels.get(composite_name(name))
        arrays: list[Array] = [*bottom[1:]]
        if covered:
            arrays = [array.copy() for array in arrays]
            if composite is not None:
                arrays[0][stays] = composite.values[stays]
                arrays[1][stays[owners]] = composite.split_values[stays[owners]]
        composites[name] = Channel(bottom.format._replace(name=composite_name(name)), *arrays)
    channels |= {channel.format.name: channel for channel in composites.values()}
    whole = with_channels(texture, channels)
    if not covered:
        return whole
    masks = chosen, chosen[owners], np.ones(tree.kept.cells.size, np.bool_)
    for kind, is_covered, mask in zip(KINDS, covered, masks, strict=True):
        rows = np.flatnonzero(is_covered & mask)
        for begin in range(0, rows.size, _BLOCK):
            block = rows[begin : begin + _BLOCK]
            for name, values in _folded(texture, layers, names, kind, block).items():
                write(composites[name], kind, block, values)
    _average(whole, layers, composites)
    return whole


def united(texture: OctreeTexture, layers: Stack, into: Layer) -> dict[str, Channel]:
    """Return the channels of a layer that looks like several, each over those before it."""
    merged = {}
    for name in bottom_names(texture):
        painted = [layer.paints(name) for layer in layers if layer.paints(name) in texture.channels]
        if not painted:
            continue
        used = {*painted, *map(alpha_of, painted), *(layer.mask for layer in layers)}
        channels = {each: channel for each, channel in texture.channels.items() if each in used}
        for form in (texture.channels[name].format, COVERAGE._replace(name=ALPHA.name)):
            channels[form.name] = Channel.full(form, texture.tree)
        whole = with_composite(with_channels(texture, channels), layers).channels
        paint = into.paints(name)
        for stored, plain in ((paint, name), (alpha_of(paint) or "", ALPHA.name)):
            merged[stored] = whole[composite_name(plain)].named(stored)
    return merged


def _has_paint(texture: OctreeTexture, layer: Layer) -> bool:
    """Return whether a layer covers anything; in a draft most do not."""
    return any(array.any() for channel in _coverages(texture, [layer]) for array in channel[1:])


def _covered(texture: OctreeTexture, layers: Sequence[Layer]) -> Iterator[Bools]:
    """Yield which rows of each kind any layer covers."""
    coverages = _coverages(texture, layers)
    for kind, count in zip(KINDS, row_counts(texture.tree), strict=True):
        is_covered = np.zeros(count, np.bool_)
        for channel in coverages:
            is_covered |= getattr(channel, kind)[:, 0] > 0
        yield is_covered


def _coverages(texture: OctreeTexture, layers: Sequence[Layer]) -> list[Channel]:
    """Return the coverage of each channel that layers paint."""
    paints = [layer.paints(name) for layer in layers for name in layer.painted(texture.channels)]
    return [texture.channels[alpha_of(paint) or ""] for paint in paints]


def _folded(
    texture: OctreeTexture,
    layers: Sequence[Layer],
    names: Sequence[str],
    kind: Kind,
    rows: Int64s,
    residuals: dict[str, Floats] | None = None,
    layer_residuals: Mapping[str, Floats] | None = None,
) -> dict[str, Float32s]:
    """Blend rows of layers over the bottom's, decoded.

    ``residuals`` are the bottom's in these rows, and become the composite's; ``layer_residuals`` are the
    layers'.
    """
    composite = {name: read(texture.channels[name], kind, rows) for name in names}
    nowhere = np.zeros(rows.size, np.bool_)
    for layer in layers:
        for name in layer.painted(texture.channels):
            paint = layer.paints(name)
            part = read(texture.channels[alpha_of(paint) or ""], kind, rows)[:, 0]
            part = part * np.float32(layer.opacity)
            if layer.has_mask and layer.mask in texture.channels:
                part = part * (1 - read(texture.channels[layer.mask], kind, rows)[:, 0])
            old = {each: composite[each] for each in (name, ALPHA.name) if each in composite}
            values = read(texture.channels[paint], kind, rows)
            for each, (new, share) in mixed(layer.blend, name, old, values, part, nowhere).items():
                if not texture.channels[each].format.dtype.startswith("float"):
                    new = np.clip(new, -1.0, 1.0)
                composite[each] = new
                if residuals is not None and layer_residuals is not None:
                    takes_on = each == name and layer.blend == "over"
                    added = layer_residuals[paint] if takes_on else None
                    residuals[each] = mixed_residuals(residuals[each], added, share[:, None])
    return composite


def _average(texture: OctreeTexture, layers: Sequence[Layer], composites: Mapping[str, Channel]) -> None:
    """Average composites, in place, in nodes with children that differ from the bottom."""
    tree = texture.tree
    rows = rows_of(tree.split)
    differs = np.zeros(tree.n_cells, np.bool_)

    def compare(cells: slice) -> None:
        split = slice(*np.searchsorted(rows.cells, [cells.start, cells.stop]).tolist())
        for name, composite in composites.items():
            bottom = texture.channels[name]
            differs[cells] |= (composite.values[cells] != bottom.values[cells]).any(axis=1)
            rows_differ = (composite.split_values[split] != bottom.split_values[split]).any(axis=1)
            differs[rows.cells[split][rows_differ]] = True

    painted = [layer.paints(name) for layer in layers for name in layer.painted(texture.channels)]
    ends = tree.arrays.level_nodes.tolist()
    cells = node_cells(tree.arrays)
    level_cells = tree.arrays.level_cells.tolist()
    compare(slice(level_cells[tree.max_depth], level_cells[tree.max_depth + 1]))
    for level in reversed(range(tree.max_depth)):
        numbers = np.arange(ends[level], ends[level + 1])
        if numbers.size:
            firsts, _ = children_of(tree.arrays.groups, numbers)
            end = level_cells[level + 2]
            is_above = np.logical_or.reduceat(differs[:end], firsts)
            nodes = Nodes(numbers[is_above], cells[numbers[is_above]])
            if nodes.cells.size:
                _average_at(texture, layers, composites, painted, nodes)
        compare(slice(level_cells[level], level_cells[level + 1]))


def _average_at(
    texture: OctreeTexture,
    layers: Sequence[Layer],
    composites: Mapping[str, Channel],
    painted: Sequence[str],
    nodes: Nodes,
) -> None:
    """Average composites, in place, in nodes of one level."""
    before = {name: residuals(texture, name, nodes) for name in (*composites, *painted)}
    of_rows = rows_of(texture.tree.split, nodes.cells).rows
    after: list[dict[str, Floats]] = []  # of nodes, and of their rows
    for number, (kind, rows) in enumerate(zip(KINDS, (nodes.cells, of_rows), strict=False)):
        of_kind = {name: each[number] for name, each in before.items()}
        _folded(texture, layers, list(composites), kind, rows, of_kind, dict(of_kind))
        after.append(of_kind)
    for name in alpha_first(composites):
        # The limit of bright light must not depend on the part of the texture in this draft.
        is_light = composites[name].format.space in ("srgb", "linear")
        mix = Residuals(*(of_kind[name] for of_kind in after))
        average(texture, composites[name], mix, nodes, (0.0, np.inf) if is_light else None)


#: What to keep of a file whose composite was edited after it was saved.
Keep = Literal["layers", "shown"]

#: The metadata that lists the layers, and infixes and suffixes of their channels.
LISTED = "layers"
_IN_LAYER, _IN_BOTTOM = " in layer ", " in the bottom"


def as_file(texture: OctreeTexture, stack: Stack) -> OctreeTexture:
    """Return the texture that a stack's file holds."""
    channels = {}
    for name, channel in texture.channels.items():
        plain = plain_name(name)
        if name == plain:
            stored = name + _IN_BOTTOM if composite_name(name) in texture.channels else name
        elif name == composite_name(plain):
            stored = plain
        else:
            stored = plain + _IN_LAYER + name.removeprefix(channel_in("", plain))
        channels[stored] = channel.named(stored)
    order = sorted(channels, key=_is_of_stack)
    listed = {
        "composite": _digest(channels, texture),
        "channels": [*filter(_is_of_stack, order)],
        "layers": [layer._asdict() for layer in stack],
    }
    metadata = {**texture.metadata, LISTED: json.dumps(listed)}
    return texture.with_cells(texture.tree, {name: channels[name] for name in order}, metadata)


def from_file(texture: OctreeTexture, keep: Keep | None = None) -> tuple[OctreeTexture, Stack]:
    """Return the stack's texture and layers from a file's texture; any other texture has no layers.

    ``keep`` "shown" drops the layers. Raises ArgumentError for an unreadable list of layers, and without
    ``keep`` for a composite that was edited after it was saved.
    """
    if keep is not None:
        as_choice(keep, get_args(Keep), "keep")
    if LISTED not in texture.metadata:
        return texture, ()
    metadata = {name: text for name, text in texture.metadata.items() if name != LISTED}
    if keep == "shown":
        channels = {name: each for name, each in texture.channels.items() if not _is_of_stack(name)}
        return texture.with_cells(texture.tree, channels, metadata), ()
    try:
        listed = json.loads(texture.metadata[LISTED])
        digest, names = listed["composite"], {str(name) for name in listed["channels"]}
        stack = tuple(check_layer(Layer(**each)) for each in listed["layers"])
        if len({layer.number for layer in stack}) < len(stack) or any(
            type(layer.number) is not int or layer.number < 1 for layer in stack
        ):
            raise ArgumentError("the layers' numbers are not distinct")
    except (ValueError, TypeError, KeyError, ArgumentError) as error:
        raise ArgumentError(f"the texture's metadata {LISTED!r} is no list of layers: {error}") from None
    channels = {}
    bottoms = {name.removesuffix(_IN_BOTTOM) for name in texture.channels if name.endswith(_IN_BOTTOM)}
    for name, channel in texture.channels.items():
        plain, mark, layer = name.partition(_IN_LAYER)
        unpacked = channel_in(layer, plain) if mark else name.removesuffix(_IN_BOTTOM)
        if name not in bottoms:
            channels[unpacked] = channel.named(unpacked)
    _check(channels, stack)
    stacked = with_composite(texture.with_cells(texture.tree, channels, metadata), stack)
    is_whole = names <= texture.channels.keys()
    is_same = digest == _digest(texture.channels, texture) or _looks_like(stacked, texture)
    if keep is None and not (is_whole and is_same):
        raise ArgumentError(
            "the texture was edited after its layers were saved, so they no longer make what it shows; "
            "keep shown leaves the layers out, keep layers leaves the edit out"
        )
    return stacked, stack


def settled(texture: OctreeTexture, keep: Keep) -> OctreeTexture:
    """Return a texture whose layers make what it shows. Raises ArgumentError as `from_file`."""
    texture, stack = from_file(texture, keep)
    return as_file(texture, stack) if stack else texture


def _is_of_stack(name: str) -> bool:
    return _IN_LAYER in name or _IN_BOTTOM in name


def _digest(channels: Mapping[str, Channel], texture: OctreeTexture) -> str:
    """Return a digest of a file's composite and tree."""
    tree = texture.tree
    composite = [(name, *channels[name]) for name in sorted(channels) if not _is_of_stack(name)]
    return digest_of([*tree.arrays], [*tree.split], [*tree.kept], composite).hex()


def _looks_like(stacked: OctreeTexture, texture: OctreeTexture) -> bool:
    """Return whether a stack's composite equals a file's in leaves: `crop` changes the nodes."""
    tree = stacked.tree
    is_leaf = all_leaves(tree)
    masks = is_leaf, is_leaf[rows_of(tree.split).cells], np.ones(tree.kept.cells.size, np.bool_)
    return all(
        np.array_equal(ours[mask], stored[mask])
        for name, channel in shown(stacked, shown_names(stacked)).channels.items()
        if name in texture.channels
        for ours, stored, mask in zip(channel[1:], texture.channels[name][1:], masks, strict=True)
    )


def _check(channels: Mapping[str, Channel], stack: Stack) -> None:
    """Raise ArgumentError for a layer's paint that lacks coverage, or fits no channel of the bottom."""
    components = {name: channel.format.components for name, channel in channels.items()}
    for layer in stack:
        for name in filter(layer.owns, channels):
            plain, alpha = plain_name(name), alpha_of(name)
            wanted = 1 if alpha is None else components.get(plain)
            if components[name] != wanted or (alpha is not None and components.get(alpha) != 1):
                raise ArgumentError(
                    f"layer {layer.name!r} paints {plain} in another way than the texture has it: the file "
                    "is damaged, or another program has changed its channels"
                )
