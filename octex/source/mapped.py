"""Images laid on surfaces without texture coordinates: from a plane, a box, a cylinder or a sphere."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ChannelFormat
from octex.checks import as_choice, as_number, as_reals
from octex.errors import ArgumentError
from octex.source.base import Source
from octex.source.corners import Frames
from octex.source.images.decode import read_image
from octex.source.images.filters import FILTERS, LEVELS_OF, told
from octex.source.images.pyramid import WRAPS, Picture, as_wraps, store
from octex.source.mapping import BOX, KINDS, SPHERICAL, Mapping, mapped_edges, read_mapped
from octex.source.materials import light_format, unit_directions
from octex.source.mesh import Mesh
from octex.source.spatial import Placeable, SpatialSource
from octex.source.tangents import carried

_X, _Y, _Z = np.eye(3)
#: What is to the right and up for one who looks at the origin from along each axis.
FRAMES = {"x": (-_Z, _Y), "-x": (_Z, _Y), "y": (_X, -_Z), "-y": (_X, _Z), "z": (_X, _Y), "-z": (-_X, _Y)}
_FARTHEST = 1e30


class MappedImage(Placeable):
    """An image that a surface gets by its rest positions: it needs no texture coordinates.

    ``image`` is a file, a Pillow image or an array, as for ``Surface.with_sources``. From outside it is not
    mirrored. ``kind`` is one of

    planar        along the axis, through the whole surface: what faces away is mirrored. The picture's top is
                  towards +y; along y it is towards −z, along −y towards +z
    box           six sides, each point's by the largest component of its face's normal (of equal ones the
                  axis first, then front and back). Upright on the four around the axis, its top towards it;
                  those across unfold from the front like a cross
    cylindrical   once around the axis, its top towards it, its middle in front. Faces whose normal is within
                  45° of the axis see the picture as on a box: a round cap has the circle inscribed in it
    spherical     longitude and latitude: once around the axis, its middle in front, its top row at the pole
                  that the axis points to

    ``axis`` is x, y, z, -x, -y or -z. The front is towards −y, about y towards +z, about −y towards −z.
    ``center`` (x, y, z) is where the picture's middle is, or what it goes around: by default the middle of
    the surface's bounds at rest. ``size`` is what one copy of the picture spans along x, y and z, in the
    model's units, or one number for all: by default the bounds, and for a box their largest extent. A sphere
    has none, and around a cylinder there is one copy always.

    ``wrap``, "repeat", "mirror" or "clamp", or one for u and one for v, is how copies meet; what goes around
    an axis always repeats. ``mag_filter``, "linear" or "nearest", is how texels meet. Footprints follow the
    mapping at each point; near a pole, where they are far longer than wide, trilinear blurs them. Images of
    ``normal`` are in the frame of the mapping's u and of the surface's shading normals; triangles are flat
    below them unless the surface has ``frames``.

    Raises ArgumentError for a name or number that is none of these.
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
            raise ArgumentError("a spherical picture goes once around and from pole to pole: no size")
        self._size = None if size is None else _three(size, "size", 1.0 / _FARTHEST)
        self._wraps = as_wraps(wrap)
        self._is_flat = as_choice(mag_filter, ("linear", "nearest"), "mag_filter") == "nearest"

    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:
        """Return the image laid on a surface by its rest positions, and what provenance says of it.

        Raises ImageError for an image that cannot be used.
        """
        texels, origin = read_image(self._image)
        least, most = mesh.bounds
        center = (least + most) / 2 if self._center is None else self._center
        size = self._size
        if size is None:
            extents = most - least
            largest = float(extents.max()) or 1.0
            # A picture is not squeezed where there is nothing to spread it over.
            is_squeezed = (extents <= 1e-9 * largest) | (self._kind == BOX)
            size = np.where(is_squeezed, largest, extents)
        right, up = FRAMES[self._axis]
        frame = np.stack([right, up, np.cross(right, up)])
        mapping = Mapping(self._kind, *self._wraps, frame, center, np.abs(frame) @ size)
        if form.space == "direction":
            texels = unit_directions(texels, (1.0, 1.0, 1.0))
        elif form.space == "srgb" and texels.dtype == np.float32:
            form = light_format(form, float(texels[..., : form.components].max()))
        source = MappedSource(
            form,
            mapping,
            # As its codes are meant, whatever it is stored as.
            Picture(texels, form.space in ("srgb", "linear")),
            self._is_flat,
            filter,
            mesh.rest,
            mesh.triangles,
            mesh.frames if form.space == "direction" else None,
        )
        said = {
            **origin,
            "mapping": KINDS[self._kind],
            "axis": self._axis,
            "center": center.tolist(),
            "size": None if self._kind == SPHERICAL else size.tolist(),
            "wrap": [WRAPS[wrap] for wrap in self._wraps],
            "mag_filter": "nearest" if self._is_flat else "linear",
        }
        return source, {f"source_{form.name}": json.dumps(said)}


class MappedSource(SpatialSource):
    """One channel from an image by a mapping; ``frames`` are what directions of normal maps stand on."""

    def __init__(
        self,
        form: ChannelFormat,
        mapping: Mapping,
        picture: Picture,
        flat: bool,
        filter: str,
        rest: Float64s,
        triangles: Int32s,
        frames: Frames | None = None,
    ) -> None:
        super().__init__([form], rest, triangles)
        self._mapping = mapping
        self._picture = picture
        self._flat = flat
        self._frames = frames
        self._filter = FILTERS.index(filter)
        self._images = store([picture], LEVELS_OF[self._filter]).images

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        points, normals = self.placed(triangles, barycentric)
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
        is_direction = form.space == "direction"
        read_mapped(
            self._mapping,
            self._images,
            told(self._filter),
            self._flat,
            is_direction,
            points,
            normals,
            shading,
            widths,
            values,
        )
        return values

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the shorter edge of a texel in the middle of triangles (n,), in rest units."""
        points, normals = self.placed(triangles, np.full((len(triangles), 3), 1 / 3))
        height, width = self._picture.texels.shape[:2]
        edges = np.empty(len(triangles), np.float32)
        mapped_edges(self._mapping, width, height, points, normals, edges)
        return edges

    def with_rest(self, rest: Float64s) -> MappedSource:
        """Return the same mapping of space on other rest positions (n, 3)."""
        other = copy.copy(self)
        other._rest = rest
        if self._frames is not None:
            other._frames = carried(self._frames, self._triangles, self._rest, rest)
        return other

    def with_filter(self, name: str) -> MappedSource:
        """Return the same source with its image read by another filter."""
        other = copy.copy(self)
        other._filter = FILTERS.index(as_choice(name, FILTERS, "filter"))
        if LEVELS_OF[other._filter] != LEVELS_OF[self._filter]:
            other._images = store([self._picture], LEVELS_OF[other._filter]).images
        return other


def _three(given: float | Sequence[float], name: str, least: float) -> Float64s:
    """Return a number for each direction."""
    numbers = np.broadcast_to(as_reals(given, name, (3,), *([()] if name == "size" else [])), 3)
    return np.array([as_number(number, name, least, _FARTHEST) for number in numbers])
