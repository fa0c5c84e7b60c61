"""Several channels that one command paints, and channels that pages add to a texture."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from octex.arrays import Array
from octex.channels import (
    BASE_COLOR,
    EMISSIVE,
    METALLIC,
    OCCLUSION,
    ONE,
    ROUGHNESS,
    SPECULAR,
    ChannelFormat,
    decode,
    encode,
)
from octex.checks import as_choice
from octex.errors import ArgumentError
from octex.painting.options import format_of
from octex.painting.picture import Projection
from octex.session.commands import Command, channel_of, codes_of, values_of
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts

#: The channel that pages show as relief.
HEIGHT = ChannelFormat("height", 1, "data")
#: Channels that pages add, and the value that a new one has: a texture looks the same with it and without.
ADDED = {
    form.name: (form, value)
    for form, value in (
        (METALLIC, 0.0), (ROUGHNESS, 1.0), (OCCLUSION, 1.0), (EMISSIVE, 0.0), (SPECULAR, 0.04), (HEIGHT, 0.5),
    )
}  # fmt: skip


class Value(NamedTuple):
    """What a command paints a channel with."""

    form: ChannelFormat
    codes: Array  # (components,)   as pictures have it: 8-bit sRGB for colours, else as the channel stores it

    @property
    def light(self) -> Array:
        """The value (components,) as `octex.fill` takes it."""
        return decode(self.codes, "srgb" if _is_color(self.form) else self.form.space)

    def pictured(self, projection: Projection) -> Projection:
        """Return a picture with the same coverage and this value."""
        coverage = cast(Array, projection.image)[..., 3]
        dtype = self.codes.dtype if self.codes.dtype.kind == "u" else np.dtype(np.float32)
        image = np.zeros((*coverage.shape, 4), dtype)
        image[..., : self.codes.size] = self.codes
        image[..., 3] = coverage * (ONE[dtype.name] / 255.0)
        return replace(projection, image=image)


def pictures_of(
    command: Command, projection: Projection, texture: OctreeTexture
) -> list[tuple[str, Projection]]:
    """Return the channels that a stroke paints, and a picture for each; raise ArgumentError as `paint_of`."""
    if not values_of(command):
        return [(BASE_COLOR.name, projection)]
    return [(value.form.name, value.pictured(projection)) for value in paint_of(command, texture)]


def paint_of(command: Command, texture: OctreeTexture) -> list[Value]:
    """Return what the colour and the values of a command paint channels with, in the texture's order.

    Raises ArgumentError for channels that the texture does not have, and for values that they cannot hold.
    """
    found = []
    for name, given in values_of(command).items():
        found.append(_value(format_of(texture, name), given))
    if "color" in command.given:
        found.append(Value(texture.channels[BASE_COLOR.name].format, codes_of(command)))
    if len({value.form.name for value in found}) < len(found):
        raise ArgumentError(f"color is the value of {BASE_COLOR.name!r}; leave one of them out")
    order = list(texture.channels)
    return sorted(found, key=lambda value: order.index(value.form.name))


def _value(form: ChannelFormat, numbers: Array) -> Value:
    name = form.name
    if form.space == "direction":
        raise ArgumentError(f"{name!r} holds directions, which values do not paint")
    if numbers.size != form.components:
        raise ArgumentError(f"values of {name!r} must be {form.components}, not {numbers.size}")
    if _is_color(form):
        if ((numbers < 0) | (numbers > 255)).any():
            raise ArgumentError(f"values of {name!r} must be codes of 0 to 255")
        return Value(form, np.rint(numbers).astype(np.uint8))
    if form.dtype.startswith("u") and ((numbers < 0) | (numbers > 1)).any():
        raise ArgumentError(f"values of {name!r} must be from 0 to 1")
    return Value(form, encode(numbers, form.dtype, form.space))


def _is_color(form: ChannelFormat) -> bool:
    return form.components == 3 and form.space in ("srgb", "linear")


def with_channel(command: Command, texture: OctreeTexture) -> OctreeTexture:
    """Return a texture with the channel that a command adds; raise ArgumentError if it has that."""
    name = channel_of(command)
    form, value = ADDED[as_choice(name, ADDED, "channel to add")]
    if name in texture.channels:
        raise ArgumentError(f"the texture has the channel {name!r} already")
    codes = encode(np.full(form.components, value), form.dtype, form.space)
    parts = (np.tile(codes, (count, 1)) for count in row_counts(texture.tree))
    return texture.with_cells(texture.tree, {**texture.channels, name: Channel(form, *parts)})
