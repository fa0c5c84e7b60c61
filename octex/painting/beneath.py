"""What a stack would show if a layer had other paint: what pages show of a stroke before it is painted.

A stroke takes a composite a part of the way, its coverage, to the one in which all of the layer has the
stroke's paint: that is exact, as layers blend linearly. An eraser goes to the one without the layer.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

from octex.channels import ALPHA, BASE_COLOR, ONE, alpha_of
from octex.checks import as_choice
from octex.editing.draft import change_of_values, places_in
from octex.painting.layer import COVERAGE
from octex.painting.restore import restored
from octex.painting.stack import (
    Layer,
    Stack,
    composite_name,
    shown_names,
    with_composite,
    with_layer_channels,
)
from octex.texture import Channel, OctreeTexture
from octex.tree.split import rows_of

#: What a stroke leads to: the layer erased, its mask without anything hidden, or painted.
Leads = Literal["erased", "unmasked", "painted"]
_LEADS: tuple[Leads, ...] = get_args(Leads)
#: The channel of the composite with white paint, beside that with black paint.
WHITE = "white"


class Stacked(NamedTuple):
    """A stack at a time."""

    texture: OctreeTexture  # with the channels of all layers
    stack: Stack
    opened: OctreeTexture  # the bottom as it was opened


def beneath(stacked: Stacked, number: int | None, leads: Leads) -> OctreeTexture | None:
    """Return the base colour of the composite to which strokes in a layer lead; None is the bottom.

    Of paint it is that of black, and beside it as ``white`` that of white. Alpha is 0 in cells that are not
    known, where nothing is painted that a stroke meets. None if there is no such paint at all, for textures
    with alpha of their own, and for a layer that is not there: a page may ask while the layer is undone.
    """
    as_choice(leads, _LEADS, "leads")
    texture, stack, opened = stacked
    place = next((at for at, each in enumerate(stack) if each.number == number), -1)
    if ALPHA.name in texture.channels or (place < 0 and number is not None):
        return None
    if place < 0 and leads != "painted":
        if stack:
            erased = _filled(texture, Channel(COVERAGE, *texture.channels[BASE_COLOR.name][1:]), 1)
            color = _composite(restored(texture, opened, erased), stack)
            return texture.with_cells(texture.tree, {BASE_COLOR.name: color.named(BASE_COLOR.name)})
        return opened.with_cells(opened.tree, {BASE_COLOR.name: opened.channels[BASE_COLOR.name]})
    layer = stack[place] if place >= 0 else None
    met = [each for each in stack[place + 1 :] if each.is_visible and each.opacity > 0]
    if layer is not None and (leads != "painted" or layer.opacity < 1 or layer.blend != "over"):
        met.append(layer)
    names = [alpha_of(each.paints(name)) or "" for each in met for name in each.painted(texture.channels)]
    bare = {name: _filled(texture, texture.channels[name], 0) for name in names}
    change = change_of_values(texture.with_cells(texture.tree, {**texture.channels, **bare}), texture)
    if change is None:
        return None
    draft = change.after
    known = np.ones(draft.tree.n_cells, np.bool_)
    if change.tiles is not None:
        known = places_in(texture, change.tiles, draft) >= 0
    if leads == "painted":
        colors = {name: _composite(_painted(draft, layer, value), stack) for name, value in _PAINTS.items()}
    else:
        own = () if leads == "erased" or layer is None else (layer._replace(has_mask=False),)
        colors = {BASE_COLOR.name: _composite(draft, (*stack[:place], *own, *stack[place + 1 :]))}
    tree, rows = draft.tree, rows_of(draft.tree.split).cells
    alphas = (np.where(known[at], ONE[ALPHA.dtype], 0) for at in (slice(None), rows, tree.kept.cells))
    alpha = Channel(ALPHA, *(each.astype(ALPHA.dtype)[:, None] for each in alphas))
    channels = {name: color.named(name) for name, color in colors.items()}
    return draft.with_cells(tree, {**channels, ALPHA.name: alpha})


_PAINTS = {BASE_COLOR.name: 0, WHITE: 1}


def _composite(texture: OctreeTexture, stack: Stack) -> Channel:
    """Return the base colour of a stack's composite."""
    made = with_composite(texture.with_cells(texture.tree, _bare(texture)), stack)
    return made.channels[shown_names(made)[BASE_COLOR.name]]


def _bare(texture: OctreeTexture) -> dict[str, Channel]:
    """Return a stack's channels without its composite."""
    own = composite_name(BASE_COLOR.name)
    return {name: channel for name, channel in texture.channels.items() if name != own}


def _painted(texture: OctreeTexture, layer: Layer | None, value: int) -> OctreeTexture:
    """Return a stack's texture with all of a layer, or of the bottom, painted black or white."""
    color = BASE_COLOR.name if layer is None else layer.paints(BASE_COLOR.name)
    cover = None if layer is None else alpha_of(color)
    texture = with_layer_channels(texture, [each for each in (color, cover) if each])
    painted = {color: _filled(texture, texture.channels[color], value)}
    if cover:
        painted[cover] = _filled(texture, texture.channels[cover], 1)
    return texture.with_cells(texture.tree, {**texture.channels, **painted})


def _filled(texture: OctreeTexture, channel: Channel, value: int) -> Channel:
    return Channel.full(channel.format, texture.tree, value * ONE[channel.format.dtype])
