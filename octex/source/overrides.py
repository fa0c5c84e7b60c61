"""Overrides of a model's channels: a function of position, an image at texture coordinates, a value."""

from __future__ import annotations

import json
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import CHANNELS, ChannelFormat, color_in_light
from octex.checks import answer, as_choice, name_of, takes_both
from octex.errors import ArgumentError, ModelError
from octex.source.base import Placeable, Source, SpatialSource
from octex.source.images.decode import read_image
from octex.source.materials import MOST_IN_FLOAT16, Input, Material, MaterialSource, Texture, light_format
from octex.source.mesh import Mesh
from octex.source.tangents import corner_frames

# Values may leave their range by this much; they are clipped.
_ROUNDING = 1e-6


class FunctionSource(SpatialSource):
    """One channel computed by a function: ``function(points)`` or ``function(points, normals)``.

    It is called with rest positions (n, 3) and, if it requires a second argument, the faces' unit normals
    (n, 3), in batches, from several threads at once. It returns (n, components), or (n,) for one component:
    linear light, 0 … 1 (0 … 65504 for ``emissive``), or vectors of any length in rest space for ``normal``.
    It is read at points, without averaging over footprints.

    Raises ArgumentError for a function that takes other arguments; and, when it is read, if it raises an
    error, which is chained, or returns another shape, or anything but finite numbers in the range.
    """

    def __init__(
        self, form: ChannelFormat, function: Callable[..., Any], rest: Float64s, triangles: Int32s
    ) -> None:
        most = MOST_IN_FLOAT16 if form.name == "emissive" else 1.0
        super().__init__([light_format(form, most)], rest, triangles)
        self._least, self._most = -1.0 if form.space == "direction" else 0.0, most
        self._function = function
        self._what = f"the function {name_of(function)} of {form.name}"
        self._takes_normals = takes_both(function, self._what, "positions", "normals")

    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:  # noqa: ARG002
        """Return values (n, components) at rest positions (n, 3)."""
        [form] = self.channels
        count = len(points)
        if count == 0:
            return np.empty((0, form.components), np.float32)
        arguments = (points.copy(), normals.copy()) if self._takes_normals else (points.copy(),)
        shapes = [(count, form.components)] + [(count,)] * (form.components == 1)
        values = answer(
            self._function, arguments, shapes, self._what, points.__getitem__,
            least=self._least, most=self._most, slack=_ROUNDING,
        ).reshape(count, form.components)  # fmt: skip
        if form.space == "direction":
            lengths = np.linalg.norm(values, axis=1, keepdims=True)
            if not lengths.all():
                point = ", ".join(f"{x:.6g}" for x in points[int(np.argmin(lengths))])
                raise ArgumentError(f"{self._what} returned all zeros at ({point}), which is not a direction")
            values = values / lengths
        return np.clip(values, self._least, self._most).astype(np.float32)


def override_source(mesh: Mesh, channel: str, value: object, filter: str) -> tuple[Source, dict[str, str]]:
    """Return a source of one channel, and its entries of provenance. Raises as ``Surface.with_sources``."""
    form = CHANNELS[as_choice(channel, CHANNELS, "channel")]
    entry = f"source_{channel}"
    if isinstance(value, Placeable):
        return value.on(mesh, form, filter)
    if callable(value):
        function = FunctionSource(form, value, mesh.rest, mesh.triangles)
        return function, {entry: json.dumps({"function": name_of(value)})}
    texture, factor, frames = None, (1.0,) * form.components, None
    origin: object
    if isinstance(value, str) and value.startswith("#") and "." not in value:
        value = tuple(color_in_light(value, form).tolist())
    if isinstance(value, (Real, tuple, list)):
        origin = factor = _factor(form, value)
    elif mesh.uv is None:
        raise ModelError(
            f"{mesh.name} has no texture coordinates for an image of {channel}; "
            "give a MappedImage (--project box), or a value"
        )
    else:
        texels, origin = read_image(value)
        texture = Texture(texels)
    if form.space == "direction":
        normals = None if mesh.frames is None else mesh.frames.normals
        frames = corner_frames(mesh.rest, mesh.triangles, normals, None, mesh.uv)
    inputs = {channel: Input(factor, texture, tuple(range(form.components)))}
    source = MaterialSource(
        [Material(inputs, "blend" if channel == "alpha" else "opaque")],
        np.zeros(len(mesh.triangles), np.int32), mesh.rest, mesh.triangles,
        coordinates=[] if mesh.uv is None else [mesh.uv], frames=frames, name=mesh.name, filter=filter,
        channels=[channel],
    )  # fmt: skip
    return source, {entry: json.dumps(origin)}


def _factor(form: ChannelFormat, value: Any) -> tuple[float, ...]:
    """Return one number for each component."""
    if form.space == "direction":
        raise ArgumentError(f"{form.name} must be an image or a Source, not {value!r}")
    numbers = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    if len(numbers) == 1:
        numbers *= form.components
    most = float(np.finfo(np.float64).max) if form.name == "emissive" else 1.0
    fits = [isinstance(number, Real) and 0 <= number <= most for number in numbers]  # type: ignore[operator]
    if len(numbers) != form.components or not all(fits):
        range_text = "from 0 on" if most > 1.0 else "in 0 … 1"
        wanted = f"{form.components} numbers" if form.components > 1 else "a number"
        divide = "; divide numbers up to 255 by 255" if most == 1.0 else ""
        raise ArgumentError(f"{form.name} must be {wanted} {range_text}, or an image, not {value!r}{divide}")
    return tuple(map(float, numbers))
