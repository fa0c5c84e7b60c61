"""Other stored types, fewer channels, another order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from octex.channels import ONE, ChannelFormat, check_range, decode, encode
from octex.checks import as_choice, as_entries, as_names
from octex.errors import ArgumentError
from octex.processing.edit import noted
from octex.texture import Channel, OctreeTexture, as_texture

#: Values that are recoded at once.
_BLOCK = 1 << 14


def cast(
    texture: OctreeTexture,
    dtype: str | Mapping[str, str] | None = None,
    channels: Sequence[str] | None = None,
) -> OctreeTexture:
    """Return a texture with other stored types, and optionally only some channels.

    dtype      "uint8", "uint16", "float16" or "float32", for all channels or a dict by name. Floats store
               linear light, integers sRGB
    channels   names of the channels to keep, in this order (default: all)

    Raises ArgumentError for unknown channels and types, and for an integer type if light or data exceed 0 …
    1.
    """
    as_texture(texture)
    names = list(texture.channels) if channels is None else as_names(channels, "channels")
    for name in names:
        as_choice(name, texture.channels, "channel")
    if len(set(names)) < len(names):
        raise ArgumentError(f"channels are named twice: {', '.join(names)}")
    wanted = as_entries(dtype, "dtype") if isinstance(dtype, Mapping) else dict.fromkeys(names, dtype)
    for name, each in wanted.items():
        as_choice(name, names, "channel of dtype")
        if each is not None:
            as_choice(each, ONE, "dtype")
    made = {name: channel_as(texture.channels[name], wanted.get(name)) for name in names}
    metadata = noted(
        texture.metadata, "cast", channels={name: each.format.dtype for name, each in made.items()}
    )
    return OctreeTexture(texture.tree, made, texture.placement, texture.bounds, metadata)


def channel_as(channel: Channel, dtype: str | None) -> Channel:
    """Return a channel as another type stores it."""
    form = channel.format
    if dtype is None or dtype == form.dtype:
        return channel
    space = form.space
    if dtype.startswith("float") and space == "srgb":
        space = "linear"
    elif dtype.startswith("u") and space == "linear" and form.dtype.startswith("float"):
        space = "srgb"
    return in_format(channel, form._replace(dtype=dtype, space=space))


def in_format(channel: Channel, form: ChannelFormat) -> Channel:
    """Return a channel as another format of as many components stores it. Raises ArgumentError."""
    before = channel.format
    if form == before:
        return channel
    arrays = [np.empty(values.shape, form.dtype) for values in channel[1:]]
    for values, recoded in zip(channel[1:], arrays, strict=True):
        for begin in range(0, len(values), _BLOCK):
            block = decode(values[begin : begin + _BLOCK], before.space)
            check_range(block, before, form.dtype)
            recoded[begin : begin + _BLOCK] = encode(block, form.dtype, form.space)
    return Channel(form, *arrays)
