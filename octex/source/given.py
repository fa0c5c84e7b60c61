"""A channel that the user gives: an image for texture coordinates, a value, a function, or else."""

from __future__ import annotations

import json
from numbers import Real
from typing import Any

import numpy as np

from octex.channels import CHANNELS, ChannelFormat
from octex.checks import as_choice
from octex.errors import ArgumentError, ModelError
from octex.functions import name_of
from octex.source.base import Source
from octex.source.function import FunctionSource
from octex.source.images.decode import read_image
from octex.source.materials import Input, Material, MaterialSource, Texture
from octex.source.mesh import Mesh
from octex.source.spatial import Placeable
from octex.source.tangents import corner_frames


def given_source(mesh: Mesh, channel: str, given: object, filter: str) -> tuple[Source, dict[str, str]]:
    """Return a source of one channel, and what provenance says of it.

    Raises as ``Surface.with_sources`` does.
    """
    form = CHANNELS[as_choice(channel, CHANNELS, "channel")]
    if isinstance(given, Placeable):
        return given.on(mesh, form, filter)
    if callable(given):
        return FunctionSource(form, given, mesh.rest, mesh.triangles), {
            f"source_{channel}": json.dumps({"function": name_of(given)})
        }
    components = tuple(range(form.components))
    provenance: dict[str, str] = {}
    texture, factor = None, (1.0,) * form.components
    if isinstance(given, (Real, tuple, list)):
        factor = _value(form, given)
        provenance[f"source_{channel}"] = json.dumps(factor)
    elif mesh.uv is None:
        raise ModelError(
            f"{mesh.name} has no texture coordinates for an image of {channel}; "
            "give a MappedImage (--project box), or a value"
        )
    else:
        texels, origin = read_image(given)
        texture = Texture(texels)
        provenance[f"source_{channel}"] = json.dumps(origin)
    frames = None
    if form.space == "direction":
        normals = None if mesh.frames is None else mesh.frames.normals
        frames = corner_frames(mesh.rest, mesh.triangles, normals, None, mesh.uv)
    source = MaterialSource(
        [
            Material(
                {channel: Input(factor, texture, components)}, "blend" if channel == "alpha" else "opaque"
            )
        ],
        np.zeros(len(mesh.triangles), np.int32),
        mesh.rest,
        mesh.triangles,
        coordinates=[] if mesh.uv is None else [mesh.uv],
        frames=frames,
        name=mesh.name,
        filter=filter,
        channels=[channel],
    )
    return source, provenance


def _value(form: ChannelFormat, given: Any) -> tuple[float, ...]:
    """Return a value with a number for each component."""
    numbers = tuple(given) if isinstance(given, (tuple, list)) else (given,)
    if len(numbers) == 1:
        numbers *= form.components
    most = float(np.finfo(np.float64).max) if form.name == "emissive" else 1.0
    fits = len(numbers) == form.components and all(
        isinstance(number, Real) and 0 <= number <= most  # type: ignore[operator]
        for number in numbers
    )
    if form.space == "direction":
        raise ArgumentError(f"{form.name} must be an image or a Source, not {given!r}")
    if not fits:
        range_text = "from 0 on" if most > 1.0 else "in 0 … 1"
        wanted = f"{form.components} numbers" if form.components > 1 else "a number"
        raise ArgumentError(f"{form.name} must be {wanted} {range_text}, or an image, not {given!r}")
    return tuple(map(float, numbers))
