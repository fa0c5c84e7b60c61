"""Other stored types, fewer channels, another order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from octex.arrays import Array
from octex.channels import ONE, ChannelFormat, decode, encode
from octex.checks import as_choice, as_entries, as_names
from octex.errors import ArgumentError
from octex.processing.edit import noted
from octex.texture import Channel, OctreeTexture, as_texture

#: Values by so much above 1 or below 0 are rounded: half a code of 16 bits is twice that.
_ROUNDING = 2.0**-18


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
    is_integer = dtype.startswith("u")
    space = form.space
    if not is_integer and space == "srgb":
        space = "linear"
    elif is_integer and space == "linear" and form.dtype.startswith("float"):
        space = "srgb"
    return in_format(channel, form._replace(dtype=dtype, space=space))


def in_format(channel: Channel, form: ChannelFormat) -> Channel:
    """Return a channel as another format of as many components stores it. Raises ArgumentError."""
    if form == channel.format:
        return channel
    return Channel(form, *(_recoded(values, channel.format, form) for values in channel[1:]))


def _recoded(values: Array, form: ChannelFormat, made: ChannelFormat) -> Array:
    found = np.empty(values.shape, made.dtype)
    for begin in range(0, len(values), 1 << 14):
        here = slice(begin, begin + (1 << 14))
        block = decode(values[here], form.space)
        if made.dtype.startswith("u") and form.space != "direction" and form.dtype.startswith("float"):
            beyond = ((block > 1 + _ROUNDING, "above 1"), (block < -_ROUNDING, "below 0"))
            for is_beyond, where in beyond:
                if is_beyond.any():
                    raise ArgumentError(
                        f"channel {form.name!r} goes {where}, which {made.dtype} cannot hold; "
                        "give it the dtype float16 or float32"
                    )
        found[here] = encode(block, made.dtype, made.space)
    return found
