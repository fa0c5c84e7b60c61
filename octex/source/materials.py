"""What a surface point's value comes from.

A source has ``channels`` and ``evaluate(triangles, barycentric, widths)``; a surface asks nothing more of it.
``MaterialSource`` is the one that model files have: base colour = factor × vertex colour × texture, in linear
light, and alpha likewise where a material uses it (glTF 2.0, 3.9.2 to 3.9.4). Another channel of a material
is another column of the kernel's output; anything else that yields values is another class of this form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, BASE_COLOR, ChannelFormat
from octex.jit import kernel

#: How a material's alpha counts: not at all, as a coverage of 0 or 1 about a cutoff, or as it is.
AlphaMode = Literal["opaque", "mask", "blend"]
ALPHA_MODES: tuple[AlphaMode, ...] = ("opaque", "mask", "blend")


class Source(Protocol):
    """Anything that gives values to points of a surface."""

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels, in the order of the values' columns."""

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""

    def with_rest(self, rest: npt.NDArray[np.float64]) -> Source:
        """Return the same source with widths measured on other rest positions (n, 3)."""


class Material(NamedTuple):
    """One material of a model file."""

    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)  # linear light, alpha
    alpha_mode: AlphaMode = "opaque"
    cutoff: float = 0.5  # of "mask": the least alpha that covers


class Corners(NamedTuple):
    """An attribute of triangle corners: rows of values, and the row of each corner."""

    values: npt.NDArray[np.float32]  # (rows, components)
    rows: npt.NDArray[np.int32]  # (triangles, 3)


class Tables(NamedTuple):
    """Materials and what is bound to triangles, as kernels see them."""

    materials: npt.NDArray[np.int32]  # (triangles,)
    factors: npt.NDArray[np.float32]  # (materials, 4)
    alpha_modes: npt.NDArray[np.uint8]  # (materials,)   index into ALPHA_MODES
    cutoffs: npt.NDArray[np.float32]  # (materials,)
    colors: npt.NDArray[np.float32]  # (rows, 4)   linear light and alpha; no rows: no vertex colours
    color_rows: npt.NDArray[np.int32]  # (triangles, 3)


class MaterialSource:
    """Base colour, and alpha where a material uses it, of a model with materials.

    ``materials`` and the material of each triangle; ``colors`` at corners, linear light and alpha (rows, 4).
    """

    def __init__(
        self,
        materials: Sequence[Material],
        triangle_materials: npt.NDArray[np.int32],
        *,
        colors: Corners | None = None,
    ) -> None:
        used = set(np.unique(triangle_materials).tolist())
        has_alpha = any(materials[i].alpha_mode != "opaque" for i in used)
        self.channels: tuple[ChannelFormat, ...] = (BASE_COLOR, ALPHA) if has_alpha else (BASE_COLOR,)
        none = Corners(np.empty((0, 4), np.float32), np.empty((0, 3), np.int32))
        self._tables = Tables(
            materials=triangle_materials,
            factors=np.array([m.factor for m in materials], np.float32),
            alpha_modes=np.array([ALPHA_MODES.index(m.alpha_mode) for m in materials], np.uint8),
            cutoffs=np.array([m.cutoff for m in materials], np.float32),
            colors=(colors or none).values,
            color_rows=(colors or none).rows,
        )

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return base colour (n, 3), linear light, not multiplied by alpha; and alpha as a fourth column."""
        values = np.empty((len(triangles), 3 + (len(self.channels) == 2)), np.float32)
        _evaluate(self._tables, triangles, barycentric, widths, values)
        return values

    def with_rest(self, rest: npt.NDArray[np.float64]) -> MaterialSource:
        """Return the same source with widths measured on other rest positions (n, 3)."""
        return self


@kernel
def _evaluate(
    tables: Tables,
    triangles: npt.NDArray[np.int32],
    barycentric: npt.NDArray[np.float64],
    widths: npt.NDArray[np.float32],
    values: npt.NDArray[np.float32],
) -> None:
    for i in range(len(triangles)):
        triangle = np.int64(triangles[i])
        b0, b1, b2 = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        material = np.int64(tables.materials[triangle])
        red, green = np.float64(tables.factors[material, 0]), np.float64(tables.factors[material, 1])
        blue, alpha = np.float64(tables.factors[material, 2]), np.float64(tables.factors[material, 3])
        if tables.colors.shape[0] > 0:
            rows = tables.color_rows[triangle]
            c0, c1, c2 = tables.colors[rows[0]], tables.colors[rows[1]], tables.colors[rows[2]]
            red *= b0 * c0[0] + b1 * c1[0] + b2 * c2[0]
            green *= b0 * c0[1] + b1 * c1[1] + b2 * c2[1]
            blue *= b0 * c0[2] + b1 * c1[2] + b2 * c2[2]
            alpha *= b0 * c0[3] + b1 * c1[3] + b2 * c2[3]
        mode = tables.alpha_modes[material]
        if mode == 0:
            alpha = 1.0
        elif mode == 1:
            alpha = 1.0 if alpha >= tables.cutoffs[material] else 0.0
        values[i, 0] = red
        values[i, 1] = green
        values[i, 2] = blue
        if values.shape[1] == 4:
            values[i, 3] = alpha
