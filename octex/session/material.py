"""Commands that paint several channels, and channels that pages add to a texture."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from octex.arrays import Array
from octex.channels import (
    BASE_COLOR,
    EMISSIVE,
    HEIGHT,
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
from octex.painting.image import Projection
from octex.painting.paint import format_of
from octex.session.commands import PageCommand, channel_of, codes_of, values_of
from octex.texture import Channel, OctreeTexture
from octex.texture.channel import row_counts

#: Channels that pages can add, with a start value that does not change the texture's look.
ADDED = {
    form.name: (form, value)
    for form, value in (
        (METALLIC, 0.0), (ROUGHNESS, 1.0), (OCCLUSION, 1.0), (EMISSIVE, 0.0), (SPECULAR, 0.04), (HEIGHT, 0.5),
    )
}  # fmt: skip


class Value(NamedTuple):
    """The value that a command paints into a channel."""

    form: ChannelFormat
    codes: Array  # (components,)   as in images: 8-bit sRGB for colours, else as the channel stores it

    @property
    def light(self) -> Array:
        """The value (components,) as `octex.fill` takes it."""
        return decode(self.codes, "srgb" if _is_color(self.form) else self.form.space)

    def imaged(self, projection: Projection) -> Projection:
        """Return an image with the same coverage and this value."""
        coverage = cast(Array, projection.image)[..., 3]
        dtype = self.codes.dtype if self.codes.dtype.kind == "u" else np.dtype(np.float32)
        image = np.zeros((*coverage.shape, 4), dtype)
        image[..., : self.codes.size] = self.codes
        image[..., 3] = coverage * (ONE[dtype.name] / 255.0)
        return replace(projection, image=image)


def images_of(
    command: PageCommand, projection: Projection, texture: OctreeTexture
) -> list[tuple[str, Projection]]:
    """Return the channels that a stroke paints, each with an image; raises ArgumentError as `paint_of`."""
    if not values_of(command):
        return [(BASE_COLOR.name, projection)]
    return [(value.form.name, value.imaged(projection)) for value in paint_of(command, texture)]


def paint_of(command: PageCommand, texture: OctreeTexture) -> list[Value]:
    """Return a command's values for channels, including its colour, in the texture's order.

    Raises ArgumentError for channels that the texture lacks, and for values out of range.
    """
    values = []
    for name, numbers in values_of(command).items():
        values.append(_value(format_of(texture, name), numbers))
    if "color" in command.fields:
        values.append(Value(texture.channels[BASE_COLOR.name].format, codes_of(command)))
    if len({value.form.name for value in values}) < len(values):
        raise ArgumentError(f"color is the value of {BASE_COLOR.name!r}; leave one of them out")
    order = list(texture.channels)
    return sorted(values, key=lambda value: order.index(value.form.name))


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


def with_channel(command: PageCommand, texture: OctreeTexture) -> OctreeTexture:
    """Return a texture with the channel that a command adds; raise ArgumentError if it exists."""
    name = channel_of(command)
    form, value = ADDED[as_choice(name, ADDED, "channel to add")]
    if name in texture.channels:
        raise ArgumentError(f"the texture has the channel {name!r} already")
    codes = encode(np.full(form.components, value), form.dtype, form.space)
    parts = (np.tile(codes, (n_rows, 1)) for n_rows in row_counts(texture.tree))
    return texture.with_cells(texture.tree, {**texture.channels, name: Channel(form, *parts)})
