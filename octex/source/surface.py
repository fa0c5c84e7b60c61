"""A surface: triangles at posed and rest positions, and the source of its values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.arrays import Float32s, Float64s, Floats, Int32s
from octex.channels import ALPHA, ChannelFormat
from octex.checks import as_choice, as_entries, as_items, as_names, as_number, as_reals, as_text
from octex.errors import ArgumentError
from octex.source.base import Combined, Joined, PartSource, Source, by_channel
from octex.source.colors import linear_colors
from octex.source.corners import Corners, Creases, Frames, Polygons, frames_of, unit
from octex.source.images.decode import as_texels, is_translucent
from octex.source.images.filters import FILTERS
from octex.source.images.pyramid import as_wraps
from octex.source.implicit import ImplicitFunction, level_set
from octex.source.materials import ALPHA_MODES, AlphaMode, Input, Material, MaterialSource, Texture
from octex.source.mesh import FARTHEST, Mesh, SurfaceSamples, as_positions, as_triangles
from octex.source.misplaced import check_place
from octex.source.overrides import override_source
from octex.source.parts import SEPARATION, Overlaps, separated_rest, separation_of

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

#: The entry of provenance that counts the triangles left out because their vertices are not finite.
NOT_FINITE = "not_finite"


class Surface(Mesh):
    """A triangle mesh with a source of values: materials, images, functions.

    ``source`` gives values at points of triangles; ``uv`` and ``frames`` are for images that you add.
    ``provenance`` is stored in textures of the surface. Raises ModelError as ``Mesh`` does.
    """

    def __init__(
        self,
        vertices: Float64s,
        triangles: Int32s,
        source: Source,
        *,
        rest: Float64s | None = None,
        uv: Corners | None = None,
        frames: Frames | None = None,
        polygons: Polygons | None = None,
        creases: Creases | None = None,
        name: str = "surface",
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(
            vertices, triangles, rest=rest, uv=uv, frames=frames, polygons=polygons, creases=creases,
            name=name,
        )  # fmt: skip
        if not isinstance(source, Source):
            raise ArgumentError(f"{name}: source must be a Source, not {source!r}")
        self.source = source
        self.provenance = {} if provenance is None else as_entries(provenance, "provenance")
        self._single: dict[str, Source] = {}

    @classmethod
    def _on(cls, mesh: Mesh, source: Source, provenance: Mapping[str, str]) -> Surface:
        surface = cls.__new__(cls)  # the mesh has checked its arrays
        vars(surface).update(vars(mesh), source=source, provenance=dict(provenance), _single={})
        return surface

    @classmethod
    def from_arrays(
        cls,
        vertices: npt.ArrayLike,
        triangles: npt.ArrayLike,
        *,
        colors: npt.ArrayLike | None = None,
        face_colors: npt.ArrayLike | None = None,
        uv: npt.ArrayLike | None = None,
        normals: npt.ArrayLike | None = None,
        image: npt.ArrayLike | PIL.Image.Image | None = None,
        wrap: str | tuple[str, str] = "repeat",
        mag_filter: str = "linear",
        filter: str = "ewa",
        factor: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
        alpha: AlphaMode | None = None,
        cutoff: float = 0.5,
        rest: npt.ArrayLike | None = None,
        name: str = "surface",
    ) -> Surface:
        """Build a surface with one material from arrays.

        colors, face_colors  (n or m, 3 or 4) per vertex or per triangle: unsigned integers are sRGB,
                             floats linear light in 0 … 1; a fourth column is alpha
        factor               linear light and alpha, which multiply them
        alpha, cutoff        "opaque", "mask" (covered from the cutoff on) or "blend"; None: "blend" if any
                             alpha is below 1
        image                multiplies too: a Pillow image, or sRGB values (height, width) or (height, width,
                             1 to 4), uint8 or uint16
        uv                   of the image, per vertex (n, 2) or per corner (m, 3, 2), v *up* from its last row
        normals              shading normals at rest, per vertex (n, 3) or per corner (m, 3, 3); of any length
        wrap, mag_filter     "repeat", "mirror" or "clamp", or one for u and one for v; "linear" or "nearest"
        filter               of the image over footprints, as for ``load_surface``

        Raises ModelError as the class does, ArgumentError for another shape or name, ImageError for an image
        that cannot be used.
        """
        positions = as_positions(vertices, f"{name}: vertices")
        at_rest = positions if rest is None else as_positions(rest, f"{name}: rest positions")
        as_text(name, "name")
        faces = as_triangles(triangles, len(positions), name)
        if colors is not None and face_colors is not None:
            raise ArgumentError("give colors per vertex or face_colors per triangle, not both")
        corners = None
        if colors is not None:
            corners = Corners(linear_colors(colors, len(positions), "colors"), faces)
        elif face_colors is not None:
            light = linear_colors(face_colors, len(faces), "face_colors")
            corners = Corners.of_triangles(light, np.arange(len(faces)))
        most = float(np.finfo(np.float32).max)
        full = (*as_reals(factor, "factor", (3,), (4,), most=most).tolist(), 1.0)[:4]
        cutoff = as_number(cutoff, "cutoff", -most, most)
        texture = coordinates = None
        if image is not None:
            if uv is None:
                raise ArgumentError("an image needs uv")
            wraps = as_wraps(wrap)
            nearest = as_choice(mag_filter, ("linear", "nearest"), "mag_filter") == "nearest"
            texture = Texture(as_texels(image), *wraps, nearest)
        if uv is not None:
            listed = as_reals(uv, "uv", (len(positions), 2), (len(faces), 3, 2))
            coordinates = Corners(flip_v(listed.reshape(-1, 2)), _rows_of(listed, faces))
        frames = None
        if normals is not None:
            shading = as_reals(normals, "normals", (len(positions), 3), (len(faces), 3, 3))
            directions = unit(shading.reshape(-1, 3))
            if not directions.any(axis=1).all():
                raise ArgumentError("normals must not have length 0")
            frames = frames_of(directions, _rows_of(shading, faces))
        if alpha is None:
            translucent = full[3] < 1 or (corners is not None and bool((corners.values[:, 3] < 1).any()))
            translucent |= texture is not None and is_translucent(texture.texels)
            alpha = "blend" if translucent else "opaque"
        as_choice(alpha, ALPHA_MODES, "alpha")
        inputs = {"base_color": Input(full[:3], texture), "alpha": Input(full[3:], texture, (3,))}
        material = Material(inputs, alpha, cutoff)
        source = MaterialSource(
            [material], np.zeros(len(faces), np.int32), at_rest, faces, colors=corners,
            coordinates=[] if coordinates is None else [coordinates], name=name, filter=filter,
        )  # fmt: skip
        return cls(positions, faces, source, rest=at_rest, uv=coordinates, frames=frames, name=name)

    @classmethod
    def joined(cls, surfaces: Sequence[Surface]) -> Surface:
        """Return several surfaces as one, to share a texture (Benson & Davis 2002, 5).

        Triangles, vertices and polygons follow in the order of the surfaces. The result has all channels that
        any of them has; surfaces without one get its default (1, no emission, the faces' normals). It has no
        texture coordinates. Raises ArgumentError for an empty list.
        """
        surfaces = as_items(surfaces, Surface, "surface to join")
        vertices = np.cumsum([0, *(len(each.vertices) for each in surfaces)]).tolist()
        triangles = np.cumsum([0, *(len(each.triangles) for each in surfaces)]).tolist()
        rest = np.concatenate([each.rest for each in surfaces])
        faces = np.concatenate(
            [each.triangles + np.int32(first) for each, first in zip(surfaces, vertices, strict=False)]
        )
        name = " + ".join(each.name for each in surfaces)
        sources = [each.provenance.get("source", each.name) for each in surfaces]
        return cls(
            np.concatenate([each.vertices for each in surfaces]),
            faces,
            Joined([each.source for each in surfaces], vertices, triangles, rest, faces),
            rest=None if all(each.rest is each.vertices for each in surfaces) else rest,
            polygons=Polygons.joined([(each.polygons, len(each.triangles)) for each in surfaces]),
            name=name,
            provenance={"source": name, "sources": json.dumps(sources)},
        )

    @classmethod
    def from_function(
        cls,
        f: ImplicitFunction,
        bounds: npt.ArrayLike,
        edge_length: float,
        *,
        level: float = 0.0,
        sources: Mapping[str, object] | None = None,
        name: str = "surface",
    ) -> Surface:
        """Build the surface where a function of position has the value ``level``.

        f            takes positions (n, 3), float64, and returns (n,), below ``level`` inside, as signed
                     distances do. Some positions lie up to ``edge_length`` outside ``bounds``
        bounds       lowest and highest corner (2, 3); they close the shape where they cut it
        edge_length  of the triangles, about. Vertices lie on the surface (Newton's method); a triangle is off
                     by up to edge_length² / 4r, r the radius of curvature. Thinner shapes may be lost
        sources      channels, as for ``with_sources`` (default: mid-grey)

        The library manifold3d makes the triangles. Raises ArgumentError for a function that raises an error
        or returns NaN or another shape, and for bounds and lengths out of range; ModelError if there
        is no surface.
        """
        vertices, triangles = level_set(f, bounds, edge_length, level)
        surface = cls.from_arrays(vertices, triangles, factor=(0.5, 0.5, 0.5), name=name)
        return surface if sources is None else surface.with_sources(sources)

    def __repr__(self) -> str:
        names = ", ".join(self.source.channel_names)
        return f"<Surface {self.name!r} of {len(self.triangles):,} triangles with {names}>"

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channels of the source, in the order of the columns of ``evaluate_all``."""
        return self.source.channels

    def with_rest(self, rest: npt.ArrayLike) -> Surface:
        """Return the same surface at other rest positions (n, 3).

        Raises ModelError for a wrong number of positions, or if they are not finite.
        """
        mesh = super().with_rest(rest)
        surface = self._with(self.source.with_rest(mesh.rest), mesh)
        surface.provenance.pop(SEPARATION, None)
        return surface

    def with_pose(self, vertices: npt.ArrayLike) -> Surface:
        """Return the same surface at other posed positions (n, 3); it rests where it does, with its values.

        Raises ModelError for a wrong number of positions, or if they are not finite.
        """
        return self._with(self.source, super().with_pose(vertices))

    def with_channels(self, channels: Sequence[str]) -> Surface:
        """Return the same surface with only these channels, and ``alpha`` if their sources have gaps.

        Raises ArgumentError for a channel that it lacks, and for an empty list.
        """
        channels = as_names(channels, "channels", self.source.channel_names)
        if not channels:
            raise ArgumentError("channels must name at least one channel")
        return self._with(self.source.only(channels))

    def with_filter(self, filter: str) -> Surface:
        """Return the same surface with its images read by another filter, as for ``load_surface``.

        Raises ArgumentError for an unknown name.
        """
        as_choice(filter, FILTERS, "filter")
        surface = self._with(self.source.with_filter(filter))
        surface.provenance["filter"] = filter
        return surface

    def with_sources(self, sources: Mapping[str, object], filter: str | None = None) -> Surface:
        """Return the same surface with other sources for some channels.

        ``sources`` maps a channel's name to one of
            a Source, or something Placeable, like MappedImage
            an image (a file, a Pillow image or an array, as for ``from_arrays``), read at the surface's first
            texture coordinates with ``filter``, by default the model's
            a function of rest positions, or of them and face normals: see overrides.FunctionSource
            a value, linear light for colours: a number, or one for each component
        Images of ``normal`` are in tangent space; without ``frames`` (``load_surface`` with ``normals``) the
        triangles are flat. Vertex colours do not multiply these values. A conversion stores no cells
        where any source has a gap.

        Raises ArgumentError for an unknown channel or another kind of value, ImageError for an image that
        cannot be used, ModelError if the surface lacks the texture coordinates for it.
        """
        sources = as_entries(sources, "sources")
        if filter is None:
            filter = self.provenance.get("filter", "ewa")
        as_choice(filter, FILTERS, "filter")
        replaced = {*sources, *(["alpha"] if self.source.alpha_is_coverage else [])}
        remaining = [name for name in self.source.channel_names if name not in replaced]
        by_name: dict[str, Source] = dict.fromkeys(remaining, self.source.only(remaining))
        surface = self._with(self.source)
        for channel, value in sources.items():
            if isinstance(value, Source):
                as_choice(channel, value.channel_names, "channel of the given source")
                by_name[channel] = value
                surface.provenance[f"source_{channel}"] = type(value).__name__
            else:
                by_name[channel], entries = override_source(self, channel, value, filter)
                surface.provenance |= entries
        surface.source = Combined(by_name).only(list(by_name))
        return surface

    def completed(
        self, sources: Mapping[str, object], channels: Sequence[str] | None, filter: str | None = None
    ) -> Surface:
        """Return the surface with ``sources`` (as for ``with_sources``), and only with ``channels``.

        Sources of other channels are ignored.
        """
        names = None if channels is None else as_names(channels, "channels")
        sources = as_entries(sources, "sources")
        used = {name: value for name, value in sources.items() if names is None or name in names}
        surface = self.with_sources(used, filter) if used else self
        return surface if names is None else surface.with_channels(names)

    def _with(self, source: Source, mesh: Mesh | None = None) -> Surface:
        return Surface._on(mesh or self, source, self.provenance)

    def part(self, triangles: npt.ArrayLike) -> Surface:
        """Return chosen triangles (k,) of the surface, in that order, with only their vertices.

        Raises ArgumentError for unknown triangles, ModelError for an empty list.
        """
        mesh, numbers, vertices = self.picked(triangles)
        return self._with(PartSource(self.source, numbers, vertices, self.rest), mesh)

    def separated(self, margin: float, overlaps: Overlaps | None = None) -> Surface:
        """Return the same surface, with parts that are nearer than ``margin`` at rest moved apart.

        The largest parts stay; the others are placed next to the model, so that the root cell grows as little
        as possible. Values do not change. The surface and its textures store the moves: see ``placed_in``. A
        part that intersects itself stays as it is. If no parts are that near, the surface itself is returned.
        ``overlaps`` is an earlier result of ``overlapping_parts`` with this margin or a larger one.

        Raises ArgumentError for a margin that is not above zero, and for a surface that is separated already.
        """
        if SEPARATION in self.provenance:
            raise ArgumentError(f"{self.name} is separated already; separate the surface that it was made of")
        return self._separated(separation_of(self, margin, overlaps))

    def placed_in(self, texture: OctreeTexture) -> Surface:
        """Return the same surface with the rest positions that a texture was made with.

        This is the surface itself, unless the texture was made from a ``separated`` surface. Raises
        ArgumentError if the parts are not those of the texture's surface.
        """
        # This room does not know the class of textures; sets of them have no levels.
        metadata, has_levels = getattr(texture, "metadata", None), hasattr(texture, "level")
        if not (isinstance(metadata, Mapping) and has_levels):
            raise ArgumentError(f"texture must be an octex.OctreeTexture, not {texture!r}")
        separation = metadata.get(SEPARATION)
        moves = self.provenance.get(SEPARATION)
        if moves == separation:
            return self
        if separation is None or moves is not None:
            raise ArgumentError(
                f"{self.name} is separated otherwise than the texture; use the surface that the texture was "
                "made from"
            )
        return self._separated(separation)

    def placed_on(self, texture: OctreeTexture) -> Surface:
        """Return the surface ``placed_in`` a texture, or raise ArgumentError if it is not the texture's.

        Warns with ModelWarning if less than half of the surface lies in the texture.
        """
        placed = self.placed_in(texture)
        check_place(placed, texture)
        return placed

    def rest_positions(self, texture: OctreeTexture) -> Float64s:
        """Return the vertices' positions (n, 3) in a texture: the texture coordinates for lookups.

        These are ``rest``, unless parts were moved apart. Raises ArgumentError as ``placed_in`` does.
        """
        return self.placed_in(texture).rest

    def _separated(self, separation: str | None) -> Surface:
        """Return the surface with its parts moved by an entry of provenance; values do not change."""
        if separation is None:
            return self
        mesh = self.with_positions(self.vertices, separated_rest(self, separation))
        surface = self._with(self.source, mesh)
        surface.provenance[SEPARATION] = separation
        return surface

    def evaluate(
        self, samples: SurfaceSamples, channel: str = "base_color", width: float | None = None
    ) -> Float32s:
        """Return the source's values (n, components) of one channel at samples; colours in linear light.

        ``width``, in rest units, averages over a square of that side; None or 0 reads at the points.
        Colours are not multiplied by alpha; averaged directions are shorter than 1. Raises ArgumentError for
        a channel that is not there or samples of another surface.
        """
        as_choice(channel, self.source.channel_names, "channel")
        if not isinstance(samples, SurfaceSamples):
            raise ArgumentError(f"samples must be the result of scatter, not {samples!r}")
        triangles = np.asarray(samples.triangles)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(self.triangles):
            raise ArgumentError(f"samples name triangles that {self.name} does not have")
        if not (np.abs(samples.barycentric) <= FARTHEST).all():
            raise ArgumentError(f"samples have barycentric coordinates that are not below {FARTHEST:g}")
        side = 0.0 if width is None else as_number(width, "width", 0.0, np.finfo(np.float64).max)
        widths = np.full(len(triangles), min(side, FARTHEST), np.float32)
        if channel not in self._single:
            needs_all = channel == ALPHA.name and self.source.has_gaps
            self._single[channel] = self.source if needs_all else self.source.only([channel])
        source = self._single[channel]
        values = source.evaluate(
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(samples.barycentric, np.float64),
            widths,
        )
        return by_channel(source.channels, values)[channel]

    def evaluate_all(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return every channel's values (n, all components), in the order of ``channels``; checks nothing.

        ``triangles`` (n,), ``barycentric`` (n, 3), ``widths`` (n,) in rest units, 0 to read at the points.
        Runs without the GIL, from any number of threads.
        """
        return self.source.evaluate(
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(barycentric, np.float64),
            np.ascontiguousarray(widths, np.float32),
        )


def _rows_of(values: Floats, faces: Int32s) -> Int32s:
    """Return the rows of an attribute, by vertex or by corner, at corners of triangles (m, 3)."""
    return faces if values.ndim == 2 else np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


def flip_v(uv: Floats) -> Float32s:
    """Turn coordinates (n, 2) with v up into coordinates with v down, or back."""
    flipped = np.empty(uv.shape, np.float32)
    with np.errstate(over="ignore"):  # infinite coordinates are refused where they are used
        flipped[:, 0] = uv[:, 0]
        flipped[:, 1] = 1.0 - uv[:, 1].astype(np.float64)
    return flipped


def as_surface(surface: Surface, name: str = "surface") -> Surface:
    """Return a surface, or raise ArgumentError for anything else."""
    if not isinstance(surface, Surface):
        raise ArgumentError(f"{name} must be an octex.Surface, not {surface!r}")
    return surface
