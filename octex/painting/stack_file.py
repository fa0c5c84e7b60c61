"""A stack of layers as one texture that can be saved: its channels have names that files may have.

Channels with the usual names are the composite, so that all else shows the file as it looks. Where the bottom
differs, it stands beside that; the stack is listed in the metadata.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from octex.channels import alpha_of, channel_in, plain_name
from octex.errors import ArgumentError
from octex.painting.stack import Layer, Stack, check_layer, composite_name, named, with_composite
from octex.texture import Channel, OctreeTexture

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
        channels[made] = named(own, made)
    order = sorted(channels, key=lambda name: _IN_LAYER in name or _IN_BOTTOM in name)
    metadata = {**texture.metadata, LISTED: json.dumps([layer._asdict() for layer in stack])}
    made_of = {name: channels[name] for name in order}
    return OctreeTexture(texture.tree, made_of, texture.placement, texture.bounds, metadata)


def from_file(texture: OctreeTexture) -> tuple[OctreeTexture, Stack]:
    """Return a stack's texture and its layers, of one that was saved; of any other itself and none.

    Raises ArgumentError for a list of layers that cannot be read.
    """
    if LISTED not in texture.metadata:
        return texture, ()
    try:
        listed = json.loads(texture.metadata[LISTED])
        stack = tuple(check_layer(Layer(**each)) for each in listed)
        if len({layer.number for layer in stack}) < len(stack) or any(
            type(layer.number) is not int or layer.number < 1 for layer in stack
        ):
            raise ArgumentError("the layers' numbers are not their own")
    except (ValueError, TypeError, ArgumentError) as error:
        raise ArgumentError(f"the texture's metadata {LISTED!r} is no list of layers: {error}") from None
    channels = {}
    bottoms = {name.removesuffix(_IN_BOTTOM) for name in texture.channels if name.endswith(_IN_BOTTOM)}
    for name, own in texture.channels.items():
        plain, mark, layer = name.partition(_IN_LAYER)
        made = channel_in(layer, plain) if mark else name.removesuffix(_IN_BOTTOM)
        if name not in bottoms:
            channels[made] = named(own, made)
    _check(channels, stack)
    metadata = {name: text for name, text in texture.metadata.items() if name != LISTED}
    texture = OctreeTexture(texture.tree, channels, texture.placement, texture.bounds, metadata)
    return with_composite(texture, stack), stack


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
