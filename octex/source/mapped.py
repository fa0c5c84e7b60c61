"""Images mapped onto surfaces without texture coordinates: from a plane, a box, a cylinder or a sphere.

Kernels use the mapping's frame, with its centre as origin: x to the right, y up, and z along the axis,
towards the viewer of a plane. An image has u to the right and v down, and spans 0 … 1.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ChannelFormat
from octex.checks import as_choice, as_number, as_reals
from octex.errors import ArgumentError
from octex.jit import inlined, kernel
from octex.source.base import Placeable, Source, SpatialSource, points_with_normals
from octex.source.images.decode import read_image
from octex.source.images.filters import MOST_VARIANCE, find_taps, footprint, kernel_code, reads_mips
from octex.source.images.pyramid import MIRROR, REPEAT, WRAPS, Images, ImageTexels, as_wraps, store
from octex.source.images.taps import MOST_TAPS, Footprint, gather
from octex.source.materials import light_format, unit_directions
from octex.source.mesh import Mesh
from octex.source.tangents import carried
from octex.source.vectors import Vector, cross_product, dot_product, length_of, minus, row_of, times

_X, _Y, _Z = np.eye(3)
#: The directions right and up for a viewer on each axis, facing the origin.
FRAMES = {"x": (-_Z, _Y), "-x": (_Z, _Y), "y": (_X, -_Z), "-y": (_X, _Z), "z": (_X, _Y), "-z": (-_X, _Y)}
_FARTHEST = 1e30
#: The kinds of mappings.
KINDS = ("planar", "box", "cylindrical", "spherical")
PLANAR, BOX, CYLINDRICAL, SPHERICAL = range(4)

#: A unit normal belongs to the axis, not to the side, if its component along the axis is above this.
CAP = math.sqrt(0.5)
# Tolerance for normals from rounded positions: without it a bevel of 45° would become a patchwork.
_TIE = 1e-6


class MappedImage(Placeable):
    """An image projected onto a surface by rest positions instead of texture coordinates.

    image       a file, a Pillow image or an array, as for ``Surface.with_sources``
    kind        "planar": along the axis, through the whole surface; on faces turned away it is mirrored.
                "box": six sides, chosen by the largest component of a face's normal, unfolded like a cross.
                "cylindrical": once around the axis; on faces within 45° of the axis as on a box.
                "spherical": longitude and latitude, its top row at the pole that the axis points to
    axis        "x", "y", "z", "-x", "-y" or "-z". The front is −y; for y it is +z, for −y −z
    center      (x, y, z): the image's centre, or that of the shape (default: of the bounds at rest)
    size        width of one copy along x, y and z in the model's units; one number makes square copies
                (default: the bounds; for a box their longest side). A sphere has none; around a cylinder
                there is always one copy
    wrap        "repeat", "mirror" or "clamp", or one for u and one for v; around an axis images repeat
    mag_filter  "linear" or "nearest"

    The image is upright and, from outside, not mirrored. For a plane, its top is toward +y; along y toward
    −z, along −y toward +z. Filtering follows the mapping's stretch. A normal map is in the tangent space of
    the mapping's u and the shading normals (``frames``; without them, of the triangles' normals).

    Raises ArgumentError for other names and numbers.
    """

    def __init__(
        self,
        image: str | os.PathLike[str] | PIL.Image.Image | npt.ArrayLike,
        kind: str,
        *,
        axis: str = "z",
        center: Sequence[float] | None = None,
        size: float | Sequence[float] | None = None,
        wrap: str | tuple[str, str] = "repeat",
        mag_filter: str = "linear",
    ) -> None:
        self._image = image
        self._kind = KINDS.index(as_choice(kind, KINDS, "kind of mapping"))
        self._axis = as_choice(axis, FRAMES, "axis")
        self._center = None if center is None else _three(center, "center", -_FARTHEST)
        if size is not None and self._kind == SPHERICAL:
            raise ArgumentError(
                "a spherical projection has no size: it goes once around and from pole to pole"
            )
        self._size = None if size is None else _three(size, "size", 1.0 / _FARTHEST)
        self._wraps = as_wraps(wrap)
        self._is_flat = as_choice(mag_filter, ("linear", "nearest"), "mag_filter") == "nearest"

    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:
        """Return the image projected onto a surface by rest positions, and its entries of provenance.

        Raises ImageError for an image that cannot be used.
        """
        texels, origin = read_image(self._image)
        least, most = mesh.bounds
        center = (least + most) / 2 if self._center is None else self._center
        size = self._size
        if size is None:
            extents = most - least
            largest = float(extents.max()) or 1.0
            # Where the model has no extent, the image keeps its aspect.
            is_squeezed = (extents <= 1e-9 * largest) | (self._kind == BOX)
            size = np.where(is_squeezed, largest, extents)
        right, up = FRAMES[self._axis]
        frame = np.stack([right, up, np.cross(right, up)])
        mapping = Mapping(self._kind, *self._wraps, frame, center, np.abs(frame) @ size)
        if form.space == "direction":
            texels = unit_directions(texels, (1.0, 1.0, 1.0))
        elif form.space == "srgb" and texels.dtype == np.float32:
            form = light_format(form, float(texels[..., : form.components].max()))
        # How codes are decoded depends on the channel's colour space, not on its stored type.
        image = ImageTexels(texels, form.space in ("srgb", "linear"))
        source = MappedSource(form, mapping, image, self._is_flat, filter, mesh)
        record = {
            **origin,
            "mapping": KINDS[self._kind],
            "axis": self._axis,
            "center": center.tolist(),
            "size": None if self._kind == SPHERICAL else size.tolist(),
            "wrap": [WRAPS[wrap] for wrap in self._wraps],
            "mag_filter": "nearest" if self._is_flat else "linear",
        }
        return source, {f"source_{form.name}": json.dumps(record)}


class MappedSource(SpatialSource):
    """One channel of a mapped image; normal maps refer to the mesh's frames."""

    def __init__(
        self, form: ChannelFormat, mapping: Mapping, image: ImageTexels, flat: bool, filter: str, mesh: Mesh
    ) -> None:
        super().__init__([form], mesh.rest, mesh.triangles)
        self._mapping = mapping
        self._image = image
        self._flat = flat
        self._frames = mesh.frames if form.space == "direction" else None
        self._filter = kernel_code(filter)
        self._images, _ = store([image], reads_mips(self._filter))

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        points, normals = points_with_normals(self._rest, self._triangles, triangles, barycentric)
        shading = normals
        if self._frames is not None:
            shading = self._frames.normals.at(triangles, barycentric)
            shading /= np.maximum(np.linalg.norm(shading, axis=1, keepdims=True), 1e-30)
        return self._read(points, normals, shading, widths)

    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at rest positions (n, 3), averaged over widths in rest units."""
        return self._read(points, normals, normals, widths)

    def _read(self, points: Float64s, normals: Float64s, shading: Float64s, widths: Float32s) -> Float32s:
        [form] = self.channels
        values = np.empty((len(points), form.components), np.float32)
        read_mapped(
            self._mapping, self._images, self._filter, self._flat, form.space == "direction",
            points, normals, shading, widths, values,
        )  # fmt: skip
        return values

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the shorter edge of a texel in the middle of triangles (n,), in rest units."""
        middles = np.full((len(triangles), 3), 1 / 3)
        points, normals = points_with_normals(self._rest, self._triangles, triangles, middles)
        height, width = self._image.texels.shape[:2]
        edges = np.empty(len(triangles), np.float32)
        mapped_edges(self._mapping, width, height, points, normals, edges)
        return edges

    def with_rest(self, rest: Float64s) -> MappedSource:
        """Return the same mapping of space on other rest positions (n, 3)."""
        frames = self._frames and carried(self._frames, self._triangles, self._rest, rest)
        return self._changed(_rest=rest, _frames=frames)

    def with_filter(self, name: str) -> MappedSource:
        """Return the same source with its image read by another filter."""
        code, images = kernel_code(name), self._images
        if reads_mips(code) != reads_mips(self._filter):
            images, _ = store([self._image], reads_mips(code))
        return self._changed(_filter=code, _images=images)


def _three(values: float | Sequence[float], name: str, least: float) -> Float64s:
    numbers = np.broadcast_to(as_reals(values, name, (3,), *([()] if name == "size" else [])), 3)
    return np.array([as_number(number, name, least, _FARTHEST) for number in numbers])


class Mapping(NamedTuple):
    """A mapping, for kernels."""

    kind: int
    wrap_u: int
    wrap_v: int
    frame: Float64s  # (3, 3)   rows: right, up and the axis, in rest space
    center: Float64s  # (3,)   in rest space
    size: Float64s  # (3,)   extents of a copy of the image along right, up and the axis


@inlined
def map_point(
    mapping: Mapping, point: Vector, normal: Vector, width: float
) -> tuple[float, float, Vector, Vector, bool]:
    """Return u and v of a point, their gradients, and whether u runs around the axis.

    Near the axis or the centre gradients are limited: the variance of a box of ``width`` is at most that of
    the whole image.
    """
    x, y, z = point
    n_x, n_y, n_z = normal
    across, high, deep = mapping.size[0], mapping.size[1], mapping.size[2]
    lean = abs(n_z)
    if mapping.kind == SPHERICAL or (mapping.kind == CYLINDRICAL and lean <= CAP + _TIE):
        radius = math.sqrt(x * x + y * y)
        cosine, sine = (x / radius, y / radius) if radius > 0.0 else (0.0, -1.0)
        u = 0.5 + math.atan2(cosine, -sine) / (2.0 * math.pi)
        turn = 1.0 / _norm(2.0 * math.pi * radius, width)
        u_slope = (-sine * turn, cosine * turn, 0.0)
        if mapping.kind == CYLINDRICAL:
            return u, 0.5 - z / deep, u_slope, (0.0, 0.0, -1.0 / deep), True
        distance = _norm(radius, z)
        down, out = (z / distance, radius / distance) if distance > 0.0 else (1.0, 0.0)
        turn = 1.0 / _norm(math.pi * distance, width)
        v_slope = (down * cosine * turn, down * sine * turn, -out * turn)
        return u, math.atan2(radius, z) / math.pi, u_slope, v_slope, True
    side_x, side_y = abs(n_x), abs(n_y)
    if mapping.kind != BOX or lean + _TIE >= max(side_x, side_y):
        # A box and a cylinder unfold from the front, which is towards −y.
        up = -1.0 if n_z < 0.0 and mapping.kind != PLANAR else 1.0
        return 0.5 + x / across, 0.5 - up * y / high, (1.0 / across, 0.0, 0.0), (0.0, -up / high, 0.0), False
    v, v_slope = 0.5 - z / deep, (0.0, 0.0, -1.0 / deep)
    if side_y + _TIE >= side_x:
        right = 1.0 / across if n_y < 0.0 else -1.0 / across
        return 0.5 + x * right, v, (right, 0.0, 0.0), v_slope, False
    right = 1.0 / high if n_x > 0.0 else -1.0 / high
    return 0.5 + y * right, v, (0.0, right, 0.0), v_slope, False


@inlined
def _norm(x: float, y: float) -> float:
    """Return the length of (x, y), but at least 10⁻¹⁵⁰."""
    return max(math.sqrt(x * x + y * y), 1e-150)


@inlined
def _in_frame(mapping: Mapping, vector: Vector) -> Vector:
    right, up, axis = row_of(mapping.frame, 0), row_of(mapping.frame, 1), row_of(mapping.frame, 2)
    return dot_product(right, vector), dot_product(up, vector), dot_product(axis, vector)


@inlined
def _point_in_frame(mapping: Mapping, points: Float64s, i: int) -> Vector:
    x, y, z = mapping.center[0], mapping.center[1], mapping.center[2]
    return _in_frame(mapping, minus(row_of(points, i), (x, y, z)))


@inlined
def _covariance(u_slope: Vector, v_slope: Vector, normal: Vector, square: float) -> Vector:
    """Return the covariance (uu, uv, vv) of a box in a normal's plane; ``square`` is its side squared."""
    along_u, along_v = dot_product(u_slope, normal), dot_product(v_slope, normal)
    scale = square / 12.0
    return (
        max(dot_product(u_slope, u_slope) - along_u * along_u, 0.0) * scale,
        (dot_product(u_slope, v_slope) - along_u * along_v) * scale,
        max(dot_product(v_slope, v_slope) - along_v * along_v, 0.0) * scale,
    )


@kernel
def read_mapped(
    mapping: Mapping, images: Images, filter: int | None, flat: bool, is_direction: bool,
    points: Float64s, normals: Float64s, shading: Float64s, widths: Float32s, values: Float32s,
) -> None:  # fmt: skip
    """Fill in the values of points from the one image of ``images``.

    ``normals`` (n, 3) are face normals. Normal maps refer to the shading normals ``shading``.
    """
    indices, weights = np.empty(MOST_TAPS, np.int64), np.empty(MOST_TAPS, np.float64)
    lanes = np.empty(4, np.float32)
    level = images.layouts[0, 0]
    across, down = images.levels[level, 1], images.levels[level, 2]
    for i in range(len(points)):
        point = _point_in_frame(mapping, points, i)
        normal = _in_frame(mapping, row_of(normals, i))
        width = np.float64(widths[i])
        u, v, u_slope, v_slope, is_around = map_point(mapping, point, normal, width)
        wrap_u, wrap_v = mapping.wrap_u, mapping.wrap_v
        if is_around:
            wrap_u = REPEAT
            if mapping.kind == SPHERICAL:
                wrap_v = MIRROR  # a footprint reaches back across a pole
        xx = xy = yy = least = most = 0.0
        if width > 0.0:
            uu, uv, vv = _covariance(u_slope, v_slope, normal, width * width)
            xx, xy, yy, least, most = footprint(uu, uv, vv, across, down)
            if most > MOST_VARIANCE:
                part = MOST_VARIANCE / most
                xx, xy, yy, least, most = xx * part, xy * part, yy * part, least * part, MOST_VARIANCE
        foot = Footprint(u, v, xx, xy, yy, least, most, wrap_u, wrap_v, flat)
        count, cut, scale = find_taps(images, 0, filter, foot, indices, weights)
        gather(images, 0, 0, indices, weights, count, cut, scale, -1.0, lanes, 0)
        if is_direction:
            _write_direction(mapping, lanes, u_slope, v_slope, row_of(shading, i), width == 0.0, values, i)
        else:
            for column in range(values.shape[1]):
                values[i, column] = lanes[column]


@inlined
def _write_direction(
    mapping: Mapping, lanes: Float32s, u_slope: Vector, v_slope: Vector, shading: Vector, is_point: bool,
    values: Float32s, i: int,
) -> None:  # fmt: skip
    """Transform a direction of a normal map to rest space; at a point, normalize it.

    On the surface, u grows and v is constant along the tangent. If v has no slope there, the tangent is the
    gradient of u.
    """
    normal = _in_frame(mapping, shading)
    if dot_product(normal, normal) == 0.0:
        normal = (0.0, 0.0, 1.0)
    level = cross_product(normal, v_slope)
    hand = 1.0 if dot_product(u_slope, level) >= 0.0 else -1.0
    tangent = times(level, hand)
    if dot_product(level, level) <= _TIE * _TIE * dot_product(v_slope, v_slope):
        along = dot_product(u_slope, normal)
        tangent = minus(u_slope, times(normal, along))
    other = cross_product(normal, tangent)
    x, y, z = 2.0 * lanes[0] - 1.0, 2.0 * lanes[1] - 1.0, 2.0 * lanes[2] - 1.0
    unit = 1.0 / max(length_of((x, y, z)), 1e-150) if is_point else 1.0
    length = 1.0 / max(length_of(tangent), 1e-150)
    x, y, z = x * unit * length, y * unit * length * hand, z * unit
    for column in range(3):
        direction = 0.0
        for k in range(3):
            direction += mapping.frame[k, column] * (x * tangent[k] + y * other[k] + z * normal[k])
        values[i, column] = direction


@kernel
def mapped_edges(
    mapping: Mapping, width: int, height: int, points: Float64s, normals: Float64s, edges: Float32s
) -> None:
    """Fill in the shorter edge of a texel at points, in rest units; infinity for an image of one texel."""
    for i in range(len(points)):
        point = _point_in_frame(mapping, points, i)
        normal = _in_frame(mapping, row_of(normals, i))
        _, _, u_slope, v_slope, _ = map_point(mapping, point, normal, 0.0)
        uu, uv, vv = _covariance(u_slope, v_slope, normal, 12.0)
        _, _, _, _, most = footprint(uu, uv, vv, width, height)
        edges[i] = 1.0 / math.sqrt(most) if most > 0.0 else np.inf
