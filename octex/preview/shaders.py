"""What is shown of a surface: its colours as light falls on them, or one channel as it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Floats, Int32s
from octex.channels import ALPHA, ChannelFormat, srgb_to_linear
from octex.checks import as_choice
from octex.compare import inside_cells
from octex.errors import ArgumentError
from octex.source.base import by_channel

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


class Hits(NamedTuple):
    """Points of a surface that a picture's samples see."""

    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    rest: Float64s  # (n, 3)   rest positions
    width: Float32s  # (n,)   what a sample covers there, in rest units
    dPdx: Float64s  # (n, 3)   how rest positions change to the sample at its right
    dPdy: Float64s  # (n, 3)   and to the one below
    normals: Float64s  # (n, 3)   of the surface at rest


class Appearance(NamedTuple):
    """What points look like, in linear light."""

    reflected: Floats | None = None  # (n, 3)   of white light; None: nothing
    emitted: Floats | None = None  # (n, 3)   whatever the light
    coverage: Floats | None = None  # (n,)   the rest is background; None: all covered

    def unlit(self) -> Floats:
        """Return what is seen in white light (n, 3)."""
        parts = [part for part in (self.reflected, self.emitted) if part is not None]
        return np.asarray(np.clip(sum(parts), 0.0, 1.0))


#: Gives hits their appearance.
Shader = Callable[[Hits], Appearance]


class Shown(NamedTuple):
    """The channels of a texture or of a surface that a picture shows."""

    channel: ChannelFormat  # the one that gives the picture its name
    names: list[str]  # all that are read

    @classmethod
    def of(cls, formats: Iterable[ChannelFormat], channel: str | None = None) -> Shown:
        """Choose ``channel``; or base colour; else the first colour, the first data, the first direction.

        Alpha comes with it, and with base colour emitted light. Raises ArgumentError if there is none such.
        """
        known = {form.name: form for form in formats}
        if not known:
            raise ArgumentError("there is no channel to draw")
        if channel is None:
            kinds = [["srgb", "linear"], ["data"], ["direction"]]
            ranked = [name for kind in kinds for name, form in known.items() if form.space in kind]
            channel = "base_color" if "base_color" in known else ranked[0]
        as_choice(channel, known, "channel")
        others = [ALPHA.name, "emissive"] if channel == "base_color" else [ALPHA.name]
        return cls(known[channel], [channel, *(name for name in others if name in known and name != channel)])

    @property
    def is_lit(self) -> bool:
        """Whether the light falls on it."""
        return self.channel.name == "base_color"

    def appearance(self, values: Mapping[str, Floats]) -> Appearance:
        """Return what values (n, components) by channel look like.

        Data and directions are shown as sRGB values: data as they are, unit vectors as (x + 1) / 2.
        """
        shown = values[self.channel.name]
        alpha = values.get(ALPHA.name) if self.channel.name != ALPHA.name else None
        coverage = None if alpha is None else alpha[:, 0]
        shown = shown[:, :3] if shown.shape[1] > 2 else np.repeat(shown[:, :1], 3, axis=1)
        if self.is_lit:
            emissive = values.get("emissive")
            return Appearance(shown, None if emissive is None else np.clip(emissive, 0.0, 1.0), coverage)
        if self.channel.space == "direction":
            lengths = np.linalg.norm(shown, axis=1, keepdims=True)
            shown = (shown / np.maximum(lengths, 1e-30) + 1) / 2
        if self.channel.space in ("data", "direction"):
            shown = srgb_to_linear(np.clip(shown, 0.0, 1.0))
        return Appearance(emitted=np.clip(shown, 0.0, 1.0), coverage=coverage)


def source_shader(surface: Surface, channel: str | None = None) -> Shader:
    """Show a surface by its source, averaged over what each sample covers.

    ``channel`` is shown as it is; by default base colour in the light, with what the surface emits, or else
    the channel that is most like a colour. Raises ArgumentError for a channel that is not there.
    """
    shown = Shown.of(surface.channels, channel)
    surface = surface.with_channels(shown.names)

    def look(hits: Hits) -> Appearance:
        values = surface.evaluate_all(hits.triangles, hits.barycentric, hits.width)
        return shown.appearance(by_channel(surface.channels, values))

    return look


def texture_shader(texture: OctreeTexture, channel: str | None = None) -> Shader:
    """Show a surface by the field of a texture, averaged over what each sample covers, on the side it sees.

    What is translucent is not shown where the texture has no cell, though coarse averages reach there.
    ``channel`` as for ``source_shader``. Raises ArgumentError for a channel that is not there.
    """
    shown = Shown.of((stored.format for stored in texture.channels.values()), channel)
    lies_on = inside_cells(texture) if ALPHA.name in shown.names else None

    def look(hits: Hits) -> Appearance:
        values = texture.sample(hits.rest, shown.names, dPdx=hits.dPdx, dPdy=hits.dPdy, normals=hits.normals)
        if lies_on is not None:
            finest = texture.placement.size / 2**texture.tree.max_depth
            values[ALPHA.name][~lies_on(hits.rest, np.full(len(hits.rest), finest))] = 0.0
        return shown.appearance(values)

    return look
