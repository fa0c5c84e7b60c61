"""A stack of layers as one texture that can be saved: its channels have names that files may have.

Channels with the usual names are the composite, so that all else shows the file as it looks. Where the bottom
differs, it stands beside that; the stack is listed in the metadata, with a digest of the composite. What
edits the composite alone leaves that digest behind, so that neither the edit nor the layers are lost.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from octex.channels import alpha_of, channel_in, plain_name
from octex.checks import as_choice
from octex.errors import ArgumentError
from octex.painting.resume import digest_of
from octex.painting.stack import (
    Layer,
    Stack,
    check_layer,
    composite_name,
    shown,
    shown_names,
    with_composite,
)
from octex.texture import Channel, OctreeTexture
from octex.tree.children import node_cells
from octex.tree.split import rows_of

#: What stays of a stack whose composite was edited after it was saved.
Keep = Literal["layers", "shown"]

#: The metadata that lists the layers, and what names of channels say of them.
LISTED = "layers"
_IN_LAYER, _IN_BOTTOM = " in layer ", " in the bottom"


def as_file(texture: OctreeTexture, stack: Stack) -> OctreeTexture:
    """Return a stack's texture as it is saved."""
    channels = {}
    for name, own in texture.channels.items():
        plain = plain_name(name)
        if name == plain:
            has_twin = composite_name(name) in texture.channels
            made = name + _IN_BOTTOM if has_twin else name
        elif name == composite_name(plain):
            made = plain
        else:
            made = plain + _IN_LAYER + name.removeprefix(channel_in("", plain))
        channels[made] = own.named(made)
    order = sorted(channels, key=_is_of_stack)
    listed = {
        "composite": _digest(channels, texture),
        "channels": [*filter(_is_of_stack, order)],
        "layers": [layer._asdict() for layer in stack],
    }
    metadata = {**texture.metadata, LISTED: json.dumps(listed)}
    made_of = {name: channels[name] for name in order}
    return OctreeTexture(texture.tree, made_of, texture.placement, texture.bounds, metadata)


def from_file(texture: OctreeTexture, keep: Keep | None = None) -> tuple[OctreeTexture, Stack]:
    """Return a stack's texture and its layers, of one that was saved; of any other itself and none.

    ``keep`` "shown" leaves the layers out. Raises ArgumentError for a list of layers that cannot be read, and
    without ``keep`` for a composite that was edited after it was saved.
    """
    if keep is not None:
        as_choice(keep, get_args(Keep), "keep")
    if LISTED not in texture.metadata:
        return texture, ()
    if keep == "shown":
        return _flat(texture), ()
    try:
        listed = json.loads(texture.metadata[LISTED])
        digest, names = listed["composite"], {str(name) for name in listed["channels"]}
        stack = tuple(check_layer(Layer(**each)) for each in listed["layers"])
        if len({layer.number for layer in stack}) < len(stack) or any(
            type(layer.number) is not int or layer.number < 1 for layer in stack
        ):
            raise ArgumentError("the layers' numbers are not their own")
    except (ValueError, TypeError, KeyError, ArgumentError) as error:
        raise ArgumentError(f"the texture's metadata {LISTED!r} is no list of layers: {error}") from None
    channels = {}
    bottoms = {name.removesuffix(_IN_BOTTOM) for name in texture.channels if name.endswith(_IN_BOTTOM)}
    for name, own in texture.channels.items():
        plain, mark, layer = name.partition(_IN_LAYER)
        made = channel_in(layer, plain) if mark else name.removesuffix(_IN_BOTTOM)
        if name not in bottoms:
            channels[made] = own.named(made)
    _check(channels, stack)
    metadata = {name: text for name, text in texture.metadata.items() if name != LISTED}
    made_of = with_composite(
        OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, metadata), stack
    )
    is_whole = names <= texture.channels.keys()
    is_same = digest == _digest(texture.channels, texture) or _looks_like(made_of, texture)
    if keep is None and not (is_whole and is_same):
        raise ArgumentError(
            "the texture was edited after its layers were saved, so they no longer make what it shows; "
            "keep shown leaves the layers out, keep layers leaves the edit out"
        )
    return made_of, stack


def settled(texture: OctreeTexture, keep: Keep) -> OctreeTexture:
    """Return a texture of which the layers make what it shows again. Raises ArgumentError as `from_file`."""
    texture, stack = from_file(texture, keep)
    return as_file(texture, stack) if stack else texture


def _flat(texture: OctreeTexture) -> OctreeTexture:
    """Return a texture as it is shown, without the layers that were saved with it."""
    channels = {name: own for name, own in texture.channels.items() if not _is_of_stack(name)}
    metadata = {name: text for name, text in texture.metadata.items() if name != LISTED}
    return OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, metadata)


def _is_of_stack(name: str) -> bool:
    return _IN_LAYER in name or _IN_BOTTOM in name


def _digest(channels: Mapping[str, Channel], texture: OctreeTexture) -> str:
    """Return a digest of what a file shows: its tree, and the channels that are not the stack's alone."""
    tree = texture.tree
    seen = [(name, own.format, *own[1:]) for name, own in sorted(channels.items()) if not _is_of_stack(name)]
    return digest_of([*tree.arrays], [*tree.split], [*tree.kept], seen).hex()


def _looks_like(made: OctreeTexture, texture: OctreeTexture) -> bool:
    """Say whether a stack gives what a file of it shows: as if all of it was cropped."""
    tree = made.tree
    is_leaf = np.ones(tree.n_cells, np.bool_)
    is_leaf[node_cells(tree.arrays)] = False
    chosen = is_leaf, is_leaf[rows_of(tree.split).cells], np.ones(tree.kept.cells.size, np.bool_)
    return all(
        np.array_equal(one[rows], other[rows])
        for name, own in shown(made, shown_names(made)).channels.items()
        if name in texture.channels
        for one, other, rows in zip(own[1:], texture.channels[name][1:], chosen, strict=True)
    )


def _check(channels: Mapping[str, Channel], stack: Stack) -> None:
    """Raise ArgumentError for paint of a layer that lacks its coverage, or fits no channel of the bottom."""
    components = {name: own.format.components for name, own in channels.items()}
    for layer in stack:
        for name in filter(layer.owns, channels):
            plain, alpha = plain_name(name), alpha_of(name)
            wanted = 1 if alpha is None else components.get(plain)
            if components[name] != wanted or (alpha is not None and components.get(alpha) != 1):
                raise ArgumentError(
                    f"layer {layer.name!r} paints {plain} in another way than the texture has it: the file "
                    "is damaged, or another program has changed its channels"
                )
