"""Shaders: the lit colours of a surface, or one channel as data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s, Floats
from octex.channels import ALPHA, BASE_COLOR, LUMINANCE, NORMAL, SPECULAR, ChannelFormat, srgb_to_linear
from octex.checks import as_choice, as_number, as_text, is_several
from octex.drawing.compare import inside_cells
from octex.drawing.hits import Hits
from octex.errors import ArgumentError
from octex.source.base import by_channel

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


class Appearance(NamedTuple):
    """Appearance of points, in linear light."""

    reflected: Floats | None = None  # (n, 3)   of white light; None: nothing
    emitted: Floats | None = None  # (n, 3)   whatever the light
    coverage: Floats | None = None  # (n,)   the rest shows the surface behind; None: all covered
    normals: Floats | None = None  # (n, 3)   at rest, to light them by; None: those of the surface
    # How light is reflected that comes from all around; None is glTF's value for a non-metal.
    metallic: Floats | None = None  # (n,)   None: 0
    roughness: Floats | None = None  # (n,)   None: 1
    occlusion: Floats | None = None  # (n,)   how much of the light reaches it; None: 1
    specular: Floats | None = None  # (n, 3)   reflectance of non-metals along the normal; None: 0.04

    def bent(self, normals: Floats, slopes: Float64s) -> Appearance:
        """Return it with its normals, or else ``normals`` (n, 3), bent against ``slopes`` (n, 3).

        ``slopes`` are the gradient of a displacement along the normals (Blinn 1978).
        """
        smooth = (normals if self.normals is None else self.normals).astype(np.float64)
        smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
        along = np.einsum("nc,nc->n", slopes, smooth)[:, None] * smooth
        return self._replace(normals=smooth - (slopes - along))

    def unlit(self) -> Floats:
        """Return the light (n, 3) of points under white light."""
        parts = [part for part in (self.reflected, self.emitted) if part is not None]
        return np.asarray(np.clip(sum(parts), 0.0, 1.0))


#: Channels of reflection besides base colour.
_SCALARS = "metallic", "roughness", "occlusion"
_REFLECTION = NORMAL.name, *_SCALARS, SPECULAR.name

#: Maps hits to their appearance.
Shader = Callable[[Hits], Appearance]
#: (channel, height): bend normals as if the surface were displaced by the channel times height.
Bump = tuple[str, float]
_STEEPEST = 1e30


def as_bump(bump: Bump | None) -> Bump | None:
    """Return a checked channel and height or None, or raise ArgumentError."""
    if bump is None:
        return None
    pair = list(bump) if is_several(bump) else []
    if len(pair) != 2:
        raise ArgumentError(f"bump must be (channel, height), not {bump!r}")
    rise = as_number(pair[1], "bump's height", -_STEEPEST, _STEEPEST)
    return as_text(pair[0], "bump's channel"), rise


class ShownChannels(NamedTuple):
    """The channels of a texture or a surface that an image shows."""

    channel: ChannelFormat  # the channel that names the image
    names: list[str]  # all channels to read

    @classmethod
    def of(
        cls, formats: Iterable[ChannelFormat], channel: str | None = None, *, materials: bool = False
    ) -> ShownChannels:
        """Choose ``channel``, by default base colour, else the first colour, the first data or direction.

        Alpha is read too; with base colour also emitted light and, for ``materials``, the other material
        channels. Raises ArgumentError for an unknown channel, and for no channel.
        """
        known = {form.name: form for form in formats}
        if not known:
            raise ArgumentError("there is no channel to draw")
        if channel is None:
            kinds = [["srgb", "linear"], ["data"], ["direction"]]
            ranked = [name for kind in kinds for name, form in known.items() if form.space in kind]
            channel = "base_color" if "base_color" in known else ranked[0]
        as_choice(channel, known, "channel")
        others = [ALPHA.name]
        if channel == BASE_COLOR.name:
            others += ["emissive", *(_REFLECTION if materials else ())]
        return cls(known[channel], [channel, *(name for name in others if name in known and name != channel)])

    @property
    def is_lit(self) -> bool:
        """Whether the image is lit."""
        return self.channel.name == "base_color"

    def appearance(self, values: Mapping[str, Floats]) -> Appearance:
        """Return the appearance of values (n, components) by channel; shows data and directions as sRGB."""
        shown = values[self.channel.name]
        alpha = values.get(ALPHA.name) if self.channel.name != ALPHA.name else None
        coverage = None if alpha is None else alpha[:, 0]
        shown = shown[:, :3] if shown.shape[1] > 2 else np.repeat(shown[:, :1], 3, axis=1)
        if self.is_lit:
            emissive = values.get("emissive")
            metallic, roughness, occlusion = (
                None if name not in values else values[name][:, 0] for name in _SCALARS
            )
            return Appearance(
                shown,
                None if emissive is None else np.clip(emissive, 0.0, 1.0),
                coverage,
                values.get(NORMAL.name),
                metallic,
                roughness,
                occlusion,
                values.get(SPECULAR.name),
            )
        if self.channel.space == "direction":
            lengths = np.linalg.norm(shown, axis=1, keepdims=True)
            shown = (shown / np.maximum(lengths, 1e-30) + 1) / 2
        if self.channel.space in ("data", "direction"):
            shown = srgb_to_linear(np.clip(shown, 0.0, 1.0))
        return Appearance(emitted=np.clip(shown, 0.0, 1.0), coverage=coverage)


def source_shader(
    surface: Surface, channel: str | None = None, *, materials: bool = False, bump: Bump | None = None
) -> Shader:
    """Return a shader of a surface's source, averaged over each sample's footprint.

    channel      default: base colour in the light, with emitted light, or else the channel most like a colour
    materials    also read metallic, roughness, occlusion, specular and normal
    bump         bends normals by the channel's difference between adjacent samples

    Raises ArgumentError for an unknown channel.
    """
    shown = ShownChannels.of(surface.channels, channel, materials=materials)
    unreduced, surface = surface, surface.with_channels(shown.names)
    height = None if bump is None else unreduced.with_channels([_bumping(bump, unreduced.channels)])

    def shade(hits: Hits) -> Appearance:
        values = surface.evaluate_all(hits.triangles, hits.barycentric, hits.width)
        appearance = shown.appearance(by_channel(surface.channels, values))
        if height is None or bump is None:
            return appearance
        corners = height.rest[height.triangles[hits.triangles]]
        rises = []
        for step in (hits.dPdx, hits.dPdy):
            half = 0.5 * _shares(corners, step)
            before, after = (
                height.evaluate_all(hits.triangles, hits.barycentric + offset, hits.width)
                for offset in (-half, half)
            )
            channels = [by_channel(height.channels, each)[bump[0]] for each in (before, after)]
            rises.append(_luminance(channels[1]) - _luminance(channels[0]))
        return appearance.bent(hits.normals, bump[1] * _gradient(hits, *rises))

    return shade


def texture_shader(
    texture: OctreeTexture, channel: str | None = None, *, materials: bool = False, bump: Bump | None = None
) -> Shader:
    """Return a shader of a texture's field, averaged over each sample's footprint, for the visible face.

    Translucent surface in an empty cell stays invisible, though coarse averages reach it. ``channel`` and
    ``materials`` as for ``source_shader``; ``bump`` uses the field's gradient. Raises ArgumentError for an
    unknown channel.
    """
    formats = [stored.format for stored in texture.channels.values()]
    shown = ShownChannels.of(formats, channel, materials=materials)
    lies_on = inside_cells(texture) if ALPHA.name in shown.names else None
    if bump is not None:
        _bumping(bump, formats)

    def shade(hits: Hits) -> Appearance:
        values = texture.sample(hits.rest, shown.names, dPdx=hits.dPdx, dPdy=hits.dPdy, normals=hits.normals)
        if lies_on is not None:
            values[ALPHA.name][~lies_on(hits.rest)] = 0.0
        appearance = shown.appearance(values)
        if bump is None:
            return appearance
        return appearance.bent(hits.normals, field_slopes(texture, bump, hits.rest, hits.normals, hits.width))

    return shade


def _bumping(bump: Bump, formats: Iterable[ChannelFormat]) -> str:
    """Return the bump channel's name; refuse an unknown one, and directions."""
    known = {form.name: form for form in formats}
    as_choice(bump[0], known, "channel to bend normals by")
    if known[bump[0]].space == "direction":
        raise ArgumentError(f"{bump[0]} holds directions; bump needs numbers or colours")
    return bump[0]


def _luminance(values: Floats) -> Float64s:
    """Return one number (…,) for the components (…, k) of a channel."""
    return np.asarray(values @ (LUMINANCE if values.shape[-1] == 3 else np.eye(values.shape[-1])[0]))


def _shares(corners: Float64s, steps: Float64s) -> Float64s:
    """Return the change of barycentric coordinates (n, 3) for steps (n, 3) along triangles (n, 3, 3)."""
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(one, other)
    square = np.maximum(np.einsum("nc,nc->n", across, across), 1e-300)
    second = np.einsum("nc,nc->n", np.cross(steps, other), across) / square
    third = np.einsum("nc,nc->n", np.cross(one, steps), across) / square
    return np.stack([-second - third, second, third], axis=1)


def _gradient(hits: Hits, right: Float64s, down: Float64s) -> Float64s:
    """Return the gradient (n, 3), along the surface at rest, from the change to the next samples."""
    normal = np.cross(hits.dPdx, hits.dPdy)
    square = np.maximum(np.einsum("nc,nc->n", normal, normal), 1e-300)[:, None]
    sums = np.cross(hits.dPdy, normal) * right[:, None] + np.cross(normal, hits.dPdx) * down[:, None]
    return np.asarray(sums / square)


def field_slopes(
    texture: OctreeTexture, bump: Bump, points: Floats, normals: Floats, width: npt.ArrayLike | None = None
) -> Float64s:
    """Return the gradient (n, 3) of the field's height by rest position, at points (n, 3)."""
    _, gradients = texture.sample(points, bump[0], width=width, normals=normals, gradient=True)
    return bump[1] * _luminance(np.moveaxis(gradients.astype(np.float64), 1, 2))
