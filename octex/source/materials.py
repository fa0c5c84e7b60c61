"""What a surface point's value comes from.

A source has ``channels`` and ``evaluate(triangles, barycentric, widths)``; a surface asks nothing more of it.
``MaterialSource`` is the one that model files have: base colour = factor × vertex colour × texture, in linear
light, and alpha likewise where a material uses it (glTF 2.0, 3.9.2 to 3.9.4). Another channel of a material
is another column of the kernel's output; anything else that yields values is another class of this form.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, BASE_COLOR, ChannelFormat
from octex.errors import ModelError
from octex.jit import kernel
from octex.source.pyramid import REPEAT, Layer, Pyramids, build_pyramids, read

#: How a material's alpha counts: not at all, as a coverage of 0 or 1 about a cutoff, or as it is.
AlphaMode = Literal["opaque", "mask", "blend"]
ALPHA_MODES: tuple[AlphaMode, ...] = ("opaque", "mask", "blend")
OPAQUE, MASK, BLEND = 0, 1, 2


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


class Texture(NamedTuple):
    """An image and how coordinates meet it."""

    texels: npt.NDArray[np.uint16]  # (height, width, 4)   sRGB codes and alpha; v runs down
    wrap_u: int = REPEAT
    wrap_v: int = REPEAT
    nearest: bool = False  # magnified without interpolation


class Material(NamedTuple):
    """One material of a model file."""

    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)  # linear light, alpha
    texture: Texture | None = None
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
    images: npt.NDArray[np.int32]  # (materials,)   index into the pyramids, −1 for none
    wraps: npt.NDArray[np.uint8]  # (materials, 2)
    nearest: npt.NDArray[np.bool_]  # (materials,)
    colors: npt.NDArray[np.float32]  # (rows, 4)   linear light and alpha; no rows: no vertex colours
    color_rows: npt.NDArray[np.int32]  # (triangles, 3)
    coordinates: npt.NDArray[np.float32]  # (rows, 2)   v down; no rows: no textures
    coordinate_rows: npt.NDArray[np.int32]  # (triangles, 3)


class Footprints(NamedTuple):
    """How a rest unit on each triangle looks in its image: an ellipse's long axis and short radius."""

    major: npt.NDArray[np.float32]  # (triangles, 2)   in texture coordinates
    lengths: npt.NDArray[np.float32]  # (triangles, 2)   of the long and of the short axis, in texels


class MaterialSource:
    """Base colour, and alpha where a material uses it, of a model with materials.

    ``materials``, and the material of each triangle (m,); ``colors`` at corners, linear light and alpha
    (rows, 4); texture ``coordinates`` at corners (rows, 2), v running down. ``rest`` (n, 3) and ``triangles``
    (m, 3) are what widths are measured on.

    Raises ModelError, with ``name``, for colours, or texture coordinates in use, that are not finite.
    """

    def __init__(
        self,
        materials: Sequence[Material],
        triangle_materials: npt.NDArray[np.int32],
        rest: npt.NDArray[np.float64],
        triangles: npt.NDArray[np.int32],
        *,
        colors: Corners | None = None,
        coordinates: Corners | None = None,
        name: str = "surface",
    ) -> None:
        used = [materials[i] for i in np.unique(triangle_materials)]
        has_alpha = any(material.alpha_mode != "opaque" for material in used)
        self.channels: tuple[ChannelFormat, ...] = (BASE_COLOR, ALPHA) if has_alpha else (BASE_COLOR,)
        self._rest = rest
        self._triangles = triangles
        colors = colors or Corners(np.empty((0, 4), np.float32), np.empty((0, 3), np.int32))
        coordinates = coordinates or Corners(np.empty((0, 2), np.float32), np.empty((0, 3), np.int32))
        images, self._pyramids = _pyramids(materials)
        textures = [material.texture for material in materials]
        if not (np.isfinite(colors.values).all() and np.isfinite([m.factor for m in materials]).all()):
            raise ModelError(f"{name}: colours are not all finite; repair the model")
        if not np.isfinite(coordinates.values).all():
            textured = images[triangle_materials] >= 0
            if not np.isfinite(coordinates.values[coordinates.rows[textured]]).all():
                raise ModelError(f"{name}: texture coordinates are not all finite; repair the model")
        self._tables = Tables(
            materials=triangle_materials,
            factors=np.array([m.factor for m in materials], np.float32),
            alpha_modes=np.array([ALPHA_MODES.index(m.alpha_mode) for m in materials], np.uint8),
            cutoffs=np.array([m.cutoff for m in materials], np.float32),
            images=images,
            wraps=np.array([(t.wrap_u, t.wrap_v) if t else (0, 0) for t in textures], np.uint8),
            nearest=np.array([t.nearest if t else False for t in textures], np.bool_),
            colors=colors.values,
            color_rows=colors.rows,
            coordinates=coordinates.values,
            coordinate_rows=coordinates.rows,
        )

    def evaluate(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return base colour (n, 3), linear light, not multiplied by alpha; and alpha as a fourth column."""
        values = np.empty((len(triangles), sum(c.components for c in self.channels)), np.float32)
        _evaluate(self._tables, self._pyramids, self._footprints, triangles, barycentric, widths, values)
        return values

    def with_rest(self, rest: npt.NDArray[np.float64]) -> MaterialSource:
        """Return the same source with widths measured on other rest positions (n, 3)."""
        other = copy.copy(self)
        other._rest = rest
        other.__dict__.pop("_footprints", None)
        return other

    @cached_property
    def _footprints(self) -> Footprints:
        # Made on the first use; two threads that meet here make the same twice.
        count = len(self._triangles) if len(self._tables.coordinates) else 0
        footprints = Footprints(np.zeros((count, 2), np.float32), np.zeros((count, 2), np.float32))
        _measure(self._tables, self._pyramids, self._rest, self._triangles, footprints)
        return footprints


def _pyramids(materials: Sequence[Material]) -> tuple[npt.NDArray[np.int32], Pyramids]:
    """Build a pyramid for each way in which an image is used; return the pyramid of each material too."""
    numbers = np.full(len(materials), -1, np.int32)
    known: dict[tuple[int, bool, float], int] = {}
    layers: list[Layer] = []
    for i, material in enumerate(materials):
        if material.texture is None:
            continue
        uses_alpha = material.alpha_mode != "opaque"
        threshold = -1.0
        if material.alpha_mode == "mask":
            threshold = material.cutoff / material.factor[3] if material.factor[3] > 0 else np.inf
        key = (id(material.texture.texels), uses_alpha, threshold)
        if key not in known:
            known[key] = len(layers)
            layers.append(Layer(material.texture.texels, uses_alpha, threshold))
        numbers[i] = known[key]
    return numbers, build_pyramids(layers)


@kernel
def _measure(
    tables: Tables,
    pyramids: Pyramids,
    rest: npt.NDArray[np.float64],
    triangles: npt.NDArray[np.int32],
    footprints: Footprints,
) -> None:
    """Fill in the singular axes of the map from each triangle's plane, in rest units, to texels."""
    for triangle in range(len(footprints.major)):
        image = np.int64(tables.images[tables.materials[triangle]])
        if image < 0:
            continue
        level = pyramids.levels[pyramids.first_levels[image]]
        width, height = float(level[1]), float(level[2])
        a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        e0, e1, e2 = rest[b, 0] - rest[a, 0], rest[b, 1] - rest[a, 1], rest[b, 2] - rest[a, 2]
        f0, f1, f2 = rest[c, 0] - rest[a, 0], rest[c, 1] - rest[a, 1], rest[c, 2] - rest[a, 2]
        base = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        if not base > 0.0:
            continue
        shift = (e0 * f0 + e1 * f1 + e2 * f2) / base
        n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
        rise = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / base
        if not rise > 1e-12 * base:
            continue
        a, b, c = (
            tables.coordinate_rows[triangle, 0],
            tables.coordinate_rows[triangle, 1],
            tables.coordinate_rows[triangle, 2],
        )
        st = tables.coordinates
        s1, t1 = (np.float64(st[b, 0]) - st[a, 0]) * width, (np.float64(st[b, 1]) - st[a, 1]) * height
        s2, t2 = (np.float64(st[c, 0]) - st[a, 0]) * width, (np.float64(st[c, 1]) - st[a, 1]) * height
        # The Jacobian's columns are texels per unit along the base and across it.
        sx, tx = s1 / base, t1 / base
        sy, ty = (s2 - sx * shift) / rise, (t2 - tx * shift) / rise
        ss, st_, tt = sx * sx + sy * sy, sx * tx + sy * ty, tx * tx + ty * ty
        half = 0.5 * (ss - tt)
        largest = 0.5 * (ss + tt) + np.sqrt(half * half + st_ * st_)
        if not 0.0 < largest < 1e30:
            continue
        major = np.sqrt(largest)
        if half >= 0.0:
            x, y = largest - tt, st_
        else:
            x, y = st_, largest - ss
        length = np.sqrt(x * x + y * y)
        if length > 0.0:
            x, y = x / length * major, y / length * major
        else:
            x, y = major, 0.0
        footprints.major[triangle, 0] = x / width
        footprints.major[triangle, 1] = y / height
        footprints.lengths[triangle, 0] = major
        footprints.lengths[triangle, 1] = abs(sx * ty - sy * tx) / major


@kernel
def _evaluate(
    tables: Tables,
    pyramids: Pyramids,
    footprints: Footprints,
    triangles: npt.NDArray[np.int32],
    barycentric: npt.NDArray[np.float64],
    widths: npt.NDArray[np.float32],
    values: npt.NDArray[np.float32],
) -> None:
    # What a triangle's points share is loaded once for a run of them: a quarter off each read.
    last = -1
    has_colors = tables.colors.shape[0] > 0
    columns = values.shape[1]
    material = mode = wrap_u = wrap_v = 0
    image = -1
    nearest = False
    u0 = u1 = u2 = v0 = v1 = v2 = major_u = major_v = major = minor = 0.0
    base_red = base_green = base_blue = base_alpha = 0.0
    for i in range(len(triangles)):
        triangle = int(triangles[i])
        if triangle != last:
            last = triangle
            material = int(tables.materials[triangle])
            base_red = float(tables.factors[material, 0])
            base_green = float(tables.factors[material, 1])
            base_blue = float(tables.factors[material, 2])
            base_alpha = float(tables.factors[material, 3])
            mode = int(tables.alpha_modes[material])
            image = int(tables.images[material])
            if image >= 0:
                r0 = int(tables.coordinate_rows[triangle, 0])
                r1 = int(tables.coordinate_rows[triangle, 1])
                r2 = int(tables.coordinate_rows[triangle, 2])
                u0, v0 = float(tables.coordinates[r0, 0]), float(tables.coordinates[r0, 1])
                u1, v1 = float(tables.coordinates[r1, 0]), float(tables.coordinates[r1, 1])
                u2, v2 = float(tables.coordinates[r2, 0]), float(tables.coordinates[r2, 1])
                wrap_u, wrap_v = int(tables.wraps[material, 0]), int(tables.wraps[material, 1])
                nearest = tables.nearest[material]
                major_u = float(footprints.major[triangle, 0])
                major_v = float(footprints.major[triangle, 1])
                major = float(footprints.lengths[triangle, 0])
                minor = float(footprints.lengths[triangle, 1])
        b0, b1, b2 = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        red, green, blue, alpha = base_red, base_green, base_blue, base_alpha
        if has_colors:
            colors = tables.colors
            c0, c1, c2 = (
                tables.color_rows[triangle, 0],
                tables.color_rows[triangle, 1],
                tables.color_rows[triangle, 2],
            )
            red *= b0 * colors[c0, 0] + b1 * colors[c1, 0] + b2 * colors[c2, 0]
            green *= b0 * colors[c0, 1] + b1 * colors[c1, 1] + b2 * colors[c2, 1]
            blue *= b0 * colors[c0, 2] + b1 * colors[c1, 2] + b2 * colors[c2, 2]
            alpha *= b0 * colors[c0, 3] + b1 * colors[c1, 3] + b2 * colors[c2, 3]
        threshold = -1.0
        if mode == MASK:
            threshold = tables.cutoffs[material] / alpha if alpha > 0.0 else np.inf
        coverage = 1.0 if threshold <= 1.0 else 0.0
        if image >= 0:
            width = float(widths[i])
            r, g, b, read_coverage = read(
                pyramids,
                image,
                b0 * u0 + b1 * u1 + b2 * u2,
                b0 * v0 + b1 * v1 + b2 * v2,
                wrap_u,
                wrap_v,
                nearest,
                threshold,
                width * major_u,
                width * major_v,
                width * major,
                width * minor,
            )
            red *= float(r)
            green *= float(g)
            blue *= float(b)
            if pyramids.translucent[image]:
                coverage = float(read_coverage)
        values[i, 0] = red
        values[i, 1] = green
        values[i, 2] = blue
        if columns == 4:
            values[i, 3] = alpha * coverage if mode == BLEND else coverage
