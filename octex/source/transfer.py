"""Values of another model, from the nearest point of its surface."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from octex.arrays import Float32s, Float64s
from octex.channels import ALPHA, ChannelFormat
from octex.checks import as_choice, as_number, is_path
from octex.nearest.triangles import Triangles
from octex.source.base import Combined, Placeable, Source, SpatialSource, least_cosine
from octex.source.load import load_surface
from octex.source.mesh import Mesh
from octex.source.surface import Surface, as_surface


class Transfer(Placeable):
    """Another model's channels, from the nearest point of its surface, both at rest.

    model      a file, or a Surface
    distance   how far away the other surface may be, in the model's units (None: any distance); surface
               farther away stays empty
    max_angle  largest angle in degrees between the normals of the two faces. Below 180, the two sides of
               a thin wall keep their own colours

    Use it for one channel, ``{"base_color": transfer}``, or for all channels of the other model, ``sources``.
    """

    def __init__(
        self,
        model: str | os.PathLike[str] | Surface,
        *,
        distance: float | None = None,
        max_angle: float = 180.0,
    ) -> None:
        self._surface = as_surface(load_surface(model) if is_path(model) else model, "model")  # type: ignore[arg-type]
        self.distance = None if distance is None else as_number(distance, "distance", 0.0, np.inf)
        self.max_angle = as_number(max_angle, "max_angle", 0.0, 180.0)

    def __repr__(self) -> str:
        return f"<Transfer from {self._surface!r}>"

    @property
    def sources(self) -> dict[str, Transfer]:
        """The transfer for every channel of the other model, as ``Surface.with_sources`` takes it."""
        return dict.fromkeys(self._surface.source.channel_names, self)

    @cached_property
    def _nearest(self) -> Triangles:
        return Triangles.of(self._surface.rest, self._surface.triangles, self._surface.name)

    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:  # noqa: ARG002
        """Return the source of a channel. All channels share it on the same mesh.

        Raises ArgumentError for a channel that the other model lacks, ModelError if it has no area.
        """
        as_choice(form.name, self.sources, f"channel of {self._surface.name}:")
        source = self._shared(mesh, lambda: _TransferSource(self, mesh))
        return source, {f"source_{form.name}": f"nearest surface of {self._surface.name}"}


class _TransferSource(SpatialSource):
    def __init__(self, transfer: Transfer, mesh: Mesh) -> None:
        super().__init__((), mesh.rest, mesh.triangles)
        self._inputs = (transfer._surface.source,)
        self._nearest = transfer._nearest
        self._distance = np.inf if transfer.distance is None else transfer.distance
        is_faced = transfer.max_angle < 180.0
        self._least_cosine = least_cosine(transfer.max_angle) if is_faced else -np.inf

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The other's channels, and ``alpha`` last if there are gaps and it has none."""
        channels = self._inputs[0].channels
        return (*channels, ALPHA) if self._adds_alpha else channels

    @property
    def has_gaps(self) -> bool:
        """Whether points may be too far from the other surface or face another way, or that has gaps."""
        return bool(np.isfinite(self._distance) or np.isfinite(self._least_cosine)) or super().has_gaps

    @property
    def _adds_alpha(self) -> bool:
        return self.has_gaps and ALPHA.name not in self._inputs[0].channel_names

    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:
        """Return the other's values (n, components) at the points nearest to these."""
        nearest = self._nearest.nearest(
            points,
            normals if np.isfinite(self._least_cosine) else None,
            distance=self._distance,
            least_cosine=self._least_cosine,
        )
        rows = np.flatnonzero(nearest.triangles >= 0)
        others = self._inputs[0].evaluate(nearest.triangles[rows], nearest.barycentric[rows], widths[rows])
        values = np.zeros((len(points), others.shape[1] + self._adds_alpha), np.float32)
        values[rows, : others.shape[1]] = others
        values[rows, others.shape[1] :] = 1.0
        return values

    def only(self, names: Sequence[str]) -> _TransferSource:
        """Return the same source with only these channels, and ``alpha`` if it has gaps."""
        [other] = self._inputs
        common = [name for name in other.channel_names if name in names]
        return self._of_inputs([other.only(common) if common or other.has_gaps else Combined({})])
