"""A surface: triangles at posed and rest positions, and the source of its values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from types import NoneType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.channels import ALPHA, NORMAL, ONE, ChannelFormat
from octex.checks import (
    as_choice,
    as_entries,
    as_items,
    as_names,
    as_number,
    as_reals,
    as_text,
    as_whole,
    locked,
)
from octex.errors import ArgumentError, ModelError
from octex.source.base import Combined, Source, by_channel
from octex.source.colors import linear_colors
from octex.source.corners import Corners, Frames
from octex.source.given import given_source
from octex.source.images.decode import as_texels
from octex.source.images.filters import FILTERS
from octex.source.images.pyramid import as_wraps
from octex.source.implicit import ImplicitFunction, level_set
from octex.source.joined import FaceNormals, Joined, Part
from octex.source.materials import ALPHA_MODES, AlphaMode, Input, Material, MaterialSource, Texture
from octex.source.parts import Overlaps, overlapping_parts, parts_of, weld
from octex.source.picked import part_of
from octex.source.separation import SEPARATION, placed_as, separated
from octex.source.tangents import carried

if TYPE_CHECKING:
    from octex.texture import OctreeTexture

# Farther positions would overflow widths in single precision.
_FARTHEST = 1e30


class Samples(NamedTuple):
    """Points of a surface."""

    points: npt.NDArray[np.float64]  # (n, 3)   posed positions
    rest: npt.NDArray[np.float64]  # (n, 3)   rest positions, the texture coordinates
    normals: npt.NDArray[np.float64]  # (n, 3)   unit normals of the posed triangles
    triangles: npt.NDArray[np.int32]  # (n,)
    barycentric: npt.NDArray[np.float64]  # (n, 3)
    rest_normals: npt.NDArray[
        np.float64
    ]  # (n, 3)   unit normals of the triangles at rest; zeros without area


class Surface:
    """Triangles with a source of values.

    ``vertices`` (n, 3) posed positions, ``triangles`` (m, 3) rows of vertices, counter-clockwise seen from
    outside, ``rest`` (n, 3) rest positions (the vertices themselves if None), all in the model's units.
    ``uv`` are texture coordinates at corners, v running down, and ``frames`` the shading normals and tangents
    there, at rest, for images of one's own. Arrays are copied, and those of the surface are read-only.

    Raises ModelError for positions that are not finite, triangles that use vertices that are not there, no
    triangles, or rest positions of another shape.
    """

    def __init__(
        self,
        vertices: npt.NDArray[np.float64],
        triangles: npt.NDArray[np.int32],
        source: Source,
        *,
        rest: npt.NDArray[np.float64] | None = None,
        uv: Corners | None = None,
        frames: Frames | None = None,
        name: str = "surface",
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        self.vertices = _positions(vertices, f"{name}: vertices")
        self.triangles = _triangles(triangles, len(self.vertices), name)
        self.rest = self.vertices if rest is None else _positions(rest, f"{name}: rest positions")
        if len(self.rest) != len(self.vertices):
            raise ModelError(
                f"{name}: {len(self.rest)} rest positions for {len(self.vertices)} vertices; give one each"
            )
        if not isinstance(source, Source):
            raise ArgumentError(f"{name}: source must be a Source, not {source!r}")
        if not isinstance(uv, (Corners, NoneType)) or not isinstance(frames, (Frames, NoneType)):
            raise ArgumentError(f"{name}: uv must be Corners, and frames must be Frames, or None")
        self.source = source
        self.uv = None if uv is None else _locked_corners(uv)
        self.frames = None if frames is None else _locked_frames(frames)
        self.name = name
        self.provenance = {} if provenance is None else as_entries(provenance, "provenance")
        self._single: dict[str, Source] = {}
        used = np.zeros(len(self.rest), bool)
        used[self.triangles] = True
        self.bounds: npt.NDArray[np.float64] = locked(
            np.array([self.rest[used].min(axis=0), self.rest[used].max(axis=0)])
        )

    @classmethod
    def from_arrays(
        cls,
        vertices: npt.ArrayLike,
        triangles: npt.ArrayLike,
        *,
        colors: npt.ArrayLike | None = None,
        face_colors: npt.ArrayLike | None = None,
        uv: npt.ArrayLike | None = None,
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

        ``colors`` (n, 3 or 4) per vertex or ``face_colors`` (m, 3 or 4) per triangle: unsigned integers are
        sRGB codes, floats are linear light in 0 … 1; a fourth column is alpha. ``factor``, linear light and
        alpha, multiplies them. ``alpha`` says whether alpha counts: "opaque", "mask" (with ``cutoff``) or
        "blend"; None means "blend" if any is below 1.

        ``image`` multiplies too: a Pillow image, or sRGB codes, uint8 or uint16, of shape (height, width) or
        (height, width, 1 to 4). It needs ``uv``, per vertex (n, 2) or per corner (m, 3, 2), with v running
        *up* from the image's last row, as in OBJ files; ``wrap``, "repeat", "mirror" or "clamp", or one for u
        and one for v; and ``mag_filter``, "linear" or "nearest": how texels meet. ``filter``, one of
        filters.FILTERS, is how the image is averaged over footprints.

        Raises ModelError as the class does, ArgumentError for another shape or name, ImageError for an image
        that cannot be used.
        """
        positions = _positions(vertices, f"{name}: vertices")
        placed = positions if rest is None else _positions(rest, f"{name}: rest positions")
        as_text(name, "name")
        faces = _triangles(triangles, len(positions), name)
        if colors is not None and face_colors is not None:
            raise ArgumentError("give colors per vertex or face_colors per triangle, not both")
        corners = None
        if colors is not None:
            corners = Corners(linear_colors(colors, len(positions), "colors"), faces)
        elif face_colors is not None:
            rows = np.repeat(np.arange(len(faces), dtype=np.int32), 3).reshape(-1, 3)
            corners = Corners(linear_colors(face_colors, len(faces), "face_colors"), rows)
        most = float(np.finfo(np.float32).max)
        parts = as_reals(factor, "factor", (3,), (4,), most=most).tolist()
        full = (parts[0], parts[1], parts[2], parts[3] if len(parts) > 3 else 1.0)
        cutoff = as_number(cutoff, "cutoff", -most, most)
        texture = coordinates = None
        if image is not None:
            if uv is None:
                raise ArgumentError("an image needs uv")
            wraps = as_wraps(wrap)
            nearest = as_choice(mag_filter, ("linear", "nearest"), "mag_filter") == "nearest"
            texture = Texture(as_texels(image), *wraps, nearest)
        if uv is not None:
            coordinates = _corner_coordinates(uv, faces, len(positions))
        if alpha is None:
            translucent = full[3] < 1 or (corners is not None and bool((corners.values[:, 3] < 1).any()))
            if texture is not None:
                opaque = ONE[texture.texels.dtype.name]
                translucent = translucent or bool((texture.texels[..., 3] < opaque).any())
            alpha = "blend" if translucent else "opaque"
        as_choice(alpha, ALPHA_MODES, "alpha")
        inputs = {"base_color": Input(full[:3], texture), "alpha": Input(full[3:], texture, (3,))}
        material = Material(inputs, alpha, cutoff)
        source = MaterialSource(
            [material],
            np.zeros(len(faces), np.int32),
            placed,
            faces,
            colors=corners,
            coordinates=[] if coordinates is None else [coordinates],
            name=name,
            filter=filter,
        )
        return cls(positions, faces, source, rest=placed, uv=coordinates, name=name)

    @classmethod
    def joined(cls, surfaces: Sequence[Surface]) -> Surface:
        """Return several surfaces as one, to share a texture (Benson & Davis 2002, 5).

        It has the channels that any of them has; where one does not state a channel, that is what materials
        give that do not: 1, no light, and the faces' own normals. Its triangles and vertices are theirs in
        order. It has no texture coordinates. Raises ArgumentError for none.
        """
        surfaces = as_items(surfaces, Surface, "surface to join")
        vertices = np.cumsum([0, *(len(each.vertices) for each in surfaces)]).tolist()
        triangles = np.cumsum([0, *(len(each.triangles) for each in surfaces)]).tolist()
        parts = [
            Part(each.source, slice(*vertices[n : n + 2]), slice(*triangles[n : n + 2]))
            for n, each in enumerate(surfaces)
        ]
        rest = np.concatenate([each.rest for each in surfaces])
        faces = np.concatenate(
            [each.triangles + np.int32(first) for each, first in zip(surfaces, vertices, strict=False)]
        )
        name = " + ".join(each.name for each in surfaces)
        sources = [each.provenance.get("source", each.name) for each in surfaces]
        return cls(
            np.concatenate([each.vertices for each in surfaces]),
            faces,
            Joined(parts, FaceNormals((NORMAL,), rest, faces)),
            rest=None if all(each.rest is each.vertices for each in surfaces) else rest,
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
        """Build the surface on which a function of position has the value ``level``.

        ``f`` takes positions (n, 3), float64, and returns values (n,); what it returns below ``level`` is
        inside, as with signed distances. It is called with many positions at a time, some of them up to an
        edge outside ``bounds``, the lowest and highest corner (2, 3); where these cut the shape it is closed
        flatly. ``sources`` gives channels, as for ``with_sources``; ``base_color`` is a middle grey else.

        Triangles have edges of about ``edge_length``, and vertices that lie on the surface as exactly as
        Newton's method finds it (those of the flat ends do not move). In between a triangle is off by up to
        edge_length² / 4r, where r is the radius of curvature: half the edge, a quarter of the error, and four
        times the triangles. An octree has the cells of the true surface where that is less than the surface
        misses the corners and edges of cells by: for spheres, edges as long as cells were enough at depths
        5 and 6. What is thinner than an edge may be lost. (Benson & Davis 2002, 1 and 5; the grid is
        manifold3d's.)

        Raises ArgumentError for a function that raises, or returns NaN or another shape, for bounds and
        lengths that are not finite or out of range, and ModelError where there is no surface.
        """
        vertices, triangles = level_set(f, bounds, edge_length, level)
        surface = cls.from_arrays(vertices, triangles, factor=(0.5, 0.5, 0.5), name=name)
        return surface if sources is None else surface.with_sources(sources)

    def __repr__(self) -> str:
        names = ", ".join(channel.name for channel in self.channels)
        return f"<Surface {self.name!r} of {len(self.triangles):,} triangles with {names}>"

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """What the source gives, in the order of the columns of ``evaluate_all``."""
        return self.source.channels

    def with_rest(self, rest: npt.ArrayLike) -> Surface:
        """Return the same surface at other rest positions (n, 3).

        Raises ModelError for another number of them, or if they are not finite.
        """
        positions = _positions(rest, f"{self.name}: rest positions")
        surface = self._with(self.source.with_rest(positions), positions)
        surface.provenance.pop(SEPARATION, None)
        return surface

    def with_channels(self, channels: Sequence[str]) -> Surface:
        """Return the same surface with these of its channels alone, and ``alpha`` if their sources have gaps.

        Raises ArgumentError for one that it lacks, and for none at all.
        """
        channels = as_names(channels, "channels")
        if not channels:
            raise ArgumentError("channels must name one at least")
        for channel in channels:
            as_choice(channel, [form.name for form in self.channels], "channel")
        return self._with(self.source.only(channels))

    @property
    def coverage(self) -> Surface:
        """The same surface with ``alpha`` alone: 0 in the gaps that its source has, else 1."""
        return self._with(self.source.only([]))

    def with_filter(self, filter: str) -> Surface:
        """Return the same surface with its images read by another filter, one of filters.FILTERS.

        Raises ArgumentError for an unknown name.
        """
        as_choice(filter, FILTERS, "filter")
        surface = self._with(self.source.with_filter(filter))
        surface.provenance["filter"] = filter
        return surface

    def with_sources(self, sources: Mapping[str, object], filter: str | None = None) -> Surface:
        """Return the same surface with some channels from elsewhere.

        ``sources`` gives, by the channel's name, a Source that has it; something Placeable, like MappedImage;
        an image (a file, a Pillow image or an array, as for ``from_arrays``), read at the surface's first
        texture coordinates with ``filter``, by default the model's; a function of rest positions, or of them
        and face normals (see function.FunctionSource); or a value, linear light for colours: a number, or one
        for each component.
        Images of ``normal`` are in the tangent's frame; triangles are flat below them unless
        the surface has ``frames``, which ``load_surface`` keeps if it is given these sources or asked for
        ``normals``. Vertex colours do not multiply what is given here. Where the source of any channel leaves
        a gap, ``alpha`` is 0, whatever gives it, and nothing is converted.

        Raises ArgumentError for an unknown channel or another kind of value, ImageError for an image that
        cannot be used, ModelError where the surface has no texture coordinates for it.
        """
        sources = as_entries(sources, "sources")
        given_filter = self.provenance.get("filter", "ewa") if filter is None else filter
        filter = as_choice(given_filter, FILTERS, "filter")
        replaced = {*sources, *(["alpha"] if self.source.alpha_is_coverage else [])}
        remaining = [form.name for form in self.channels if form.name not in replaced]
        parts: dict[str, Source] = dict.fromkeys(remaining, self.source.only(remaining))
        made = self._with(self.source)
        for channel, given in sources.items():
            if isinstance(given, Source):
                as_choice(channel, [form.name for form in given.channels], "channel of the given source")
                parts[channel] = given
                made.provenance[f"source_{channel}"] = type(given).__name__
            else:
                parts[channel], names = given_source(self, channel, given, filter)
                made.provenance |= names
        made.source = Combined(parts).only(list(parts))
        return made

    def completed(
        self, sources: Mapping[str, object], channels: Sequence[str] | None, filter: str | None = None
    ) -> Surface:
        """Return the surface with ``sources`` (as for ``with_sources``), and with ``channels`` alone.

        Sources of channels that are not wanted are left out.
        """
        names = None if channels is None else as_names(channels, "channels")
        sources = as_entries(sources, "sources")
        given = {name: each for name, each in sources.items() if names is None or name in names}
        surface = self.with_sources(given, filter) if given else self
        return surface if names is None else surface.with_channels(names)

    def _with(self, source: Source, rest: npt.NDArray[np.float64] | None = None) -> Surface:
        frames = self.frames
        if frames is not None and rest is not None:
            frames = carried(frames, self.triangles, self.rest, rest)
        return Surface(
            self.vertices,
            self.triangles,
            source,
            rest=self.rest if rest is None else rest,
            uv=self.uv,
            frames=frames,
            name=self.name,
            provenance=self.provenance,
        )

    def part(self, triangles: npt.ArrayLike, source: Source | None = None) -> Surface:
        """Return some triangles (k,) of the surface, in that order, with the vertices that they use.

        ``source`` is one of these triangles; by default they keep the whole's. Raises ArgumentError for
        numbers of triangles that are not there, ModelError for none.
        """
        return part_of(self, triangles, source)

    @cached_property
    def parts(self) -> npt.NDArray[np.int32]:
        """The part of each triangle (m,), numbered by their first triangles, as ``overlapping_parts`` does.

        Parts are what hangs together at rest, vertices at the same position being one.
        """
        return parts_of(self.triangles, weld(self.rest))

    def overlapping_parts(self, margin: float = 0.0) -> Overlaps:
        """Find the parts that intersect at rest, or come nearer than ``margin`` (in the model's units).

        In an octree texture such parts share cells, and their colours run together (Benson & Davis 2002,
        4.3.1 and 6.2). Parts are what hangs together, vertices at the same position being one. For each pair
        there is the smallest distance of their surfaces and, for two solids, the volume that both fill, by an
        exact boolean (solids are turned outside out first). Parts that are no solids are named in
        ``unchecked``: what lies inside them is not known. A part that intersects itself is not found.

        Raises ArgumentError for a negative margin.
        """
        return overlapping_parts(self.rest, self.triangles, margin)

    def separated(self, margin: float, found: Overlaps | None = None) -> Surface:
        """Return the same surface with parts moved apart that are nearer than ``margin`` at rest.

        The largest stay, as does what is near to nothing; others come to lie beside the whole, so that its
        longest side grows as little as may be: where cells are a part of that, they grow with it. Sources
        give the same values as before. Provenance remembers what was moved, and so does a texture made of it:
        see ``placed_in``. A part that intersects itself stays as it is. Without such parts the surface itself
        is returned. ``found`` is what ``overlapping_parts`` found with this margin or a larger one.

        Raises ArgumentError for a margin not above zero, and a surface that is separated already.
        """
        return separated(self, margin, found)

    def placed_in(self, texture: OctreeTexture) -> Surface:
        """Return the same surface with its rest positions where a texture has them.

        This is the surface itself, unless the texture was made of one that was ``separated``. Raises
        ArgumentError if the parts are not those of the texture's surface.
        """
        metadata = getattr(texture, "metadata", None)  # whatever a texture is, its provenance says it
        if not isinstance(metadata, Mapping):
            raise ArgumentError(f"texture must be an octex.OctreeTexture, not {texture!r}")
        return placed_as(self, metadata)

    def rest_positions(self, texture: OctreeTexture) -> npt.NDArray[np.float64]:
        """Return where a texture has the vertices (n, 3): what lookups on the surface take.

        These are ``rest``, unless parts were moved apart. Raises ArgumentError as ``placed_in`` does.
        """
        return self.placed_in(texture).rest

    def areas(self) -> npt.NDArray[np.float64]:
        """Return the posed area of each triangle (m,), in square model units."""
        areas: npt.NDArray[np.float64] = np.linalg.norm(_crosses(self.vertices, self.triangles), axis=1) / 2
        return areas

    def scatter(self, n: int, seed: int = 0) -> Samples:
        """Draw ``n`` points, uniform by posed area; the same for the same seed.

        Raises ModelError if the surface has no area, ArgumentError for a negative ``n``.
        """
        n = as_whole(n, "n, the number of points,", 0, 2**32)
        seed = as_whole(seed, "seed", 0, 2**128)
        crosses = _crosses(self.vertices, self.triangles)
        norms = np.linalg.norm(crosses, axis=1)
        cumulative = np.cumsum(norms)
        if not cumulative[-1] > 0:
            raise ModelError(
                f"{self.name}: all triangles are degenerate, there is no area to scatter points on"
            )
        random = np.random.default_rng(seed).random((n, 3))
        chosen = np.searchsorted(cumulative, random[:, 0] * cumulative[-1], side="right")
        root = np.sqrt(random[:, 1])
        barycentric = np.stack([1 - root, root * (1 - random[:, 2]), root * random[:, 2]], axis=1)
        corners = self.triangles[chosen]
        normals = rest_normals = crosses[chosen] / norms[chosen, None]
        if self.rest is not self.vertices:
            rest_normals = _crosses(self.rest, corners)
            lengths = np.linalg.norm(rest_normals, axis=1, keepdims=True)
            rest_normals /= np.where(lengths > 0, lengths, 1)
        return Samples(
            points=np.einsum("nc,ncx->nx", barycentric, self.vertices[corners]),
            rest=np.einsum("nc,ncx->nx", barycentric, self.rest[corners]),
            normals=normals,
            triangles=chosen.astype(np.int32),
            barycentric=barycentric,
            rest_normals=rest_normals,
        )

    def evaluate(
        self, samples: Samples, channel: str = "base_color", width: float | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the source's own values (n, components) of one channel at samples; colours in linear light.

        ``width``, in rest units, averages over a square of that side; None or 0 reads at the points.
        Colours are not multiplied by alpha; averaged directions are shorter than 1. Raises ArgumentError for
        a channel that is not there or samples of another surface.
        """
        as_choice(channel, [form.name for form in self.channels], "channel")
        if not isinstance(samples, Samples):
            raise ArgumentError(f"samples must be what scatter returns, not {samples!r}")
        triangles = np.asarray(samples.triangles)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(self.triangles):
            raise ArgumentError(f"samples name triangles that {self.name} does not have")
        if not (np.abs(samples.barycentric) <= _FARTHEST).all():
            raise ArgumentError(f"samples have barycentric coordinates that are not below {_FARTHEST:g}")
        side = 0.0 if width is None else as_number(width, "width", 0.0, np.finfo(np.float64).max)
        widths = np.full(len(triangles), min(side, _FARTHEST), np.float32)
        source = self._only(channel)
        found = source.evaluate(
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(samples.barycentric, np.float64),
            widths,
        )
        return by_channel(source.channels, found)[channel]

    def _only(self, channel: str) -> Source:
        """Return a source of one channel, kept ready for the next time."""
        if channel not in self._single:
            needs_all = channel == ALPHA.name and self.source.has_gaps
            self._single[channel] = self.source if needs_all else self.source.only([channel])
        return self._single[channel]

    def evaluate_all(
        self,
        triangles: npt.NDArray[np.int32],
        barycentric: npt.NDArray[np.float64],
        widths: npt.NDArray[np.float32],
    ) -> npt.NDArray[np.float32]:
        """Return every channel's values (n, all components), in the order of ``channels``; checks nothing.

        ``triangles`` (n,), ``barycentric`` (n, 3), ``widths`` (n,) in rest units, 0 to read at the points.
        Runs without the GIL, from any number of threads.
        """
        return self.source.evaluate(
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(barycentric, np.float64),
            np.ascontiguousarray(widths, np.float32),
        )


def _crosses(positions: npt.NDArray[np.float64], triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
    """Return normals of triangles (m, 3), each twice its area long."""
    corners = positions[triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _corner_coordinates(uv: npt.ArrayLike, triangles: npt.NDArray[np.int32], vertices: int) -> Corners:
    """Bind coordinates with v up, per vertex or per corner."""
    array = as_reals(uv, "uv", (vertices, 2), (len(triangles), 3, 2))
    rows = triangles
    if array.ndim == 3:
        rows = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
    return Corners(flip_v(array.reshape(-1, 2)), rows)


def flip_v(uv: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """Return coordinates (n, 2) with v down of such with v up."""
    flipped = np.empty(uv.shape, np.float32)
    with np.errstate(over="ignore"):  # what becomes infinite is refused where it is used
        flipped[:, 0] = uv[:, 0]
        flipped[:, 1] = 1.0 - uv[:, 1].astype(np.float64)
    return flipped


def _positions(positions: npt.ArrayLike, what: str) -> npt.NDArray[np.float64]:
    try:
        array = np.asarray(positions)
    except ValueError:  # rows of unequal lengths
        array = np.empty(0, np.void)
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{what} must be numbers of shape (n, 3)")
    array = _owned(array, np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ModelError(f"{what} must have shape (n, 3), not {array.shape}")
    usable = (np.abs(array) <= _FARTHEST).all(axis=1)
    if not usable.all():
        first = int(np.argmin(usable))
        x, y, z = array[first].tolist()
        raise ModelError(
            f"{what} are not all finite (and below {_FARTHEST:g}): number {first} is {x:g}, {y:g}, {z:g}; "
            "repair the model"
        )
    return array


def _triangles(given: npt.ArrayLike, vertices: int, name: str) -> npt.NDArray[np.int32]:
    try:
        triangles = np.asarray(given)
    except ValueError:  # rows of unequal lengths
        triangles = np.empty(0, np.void)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ModelError(f"{name}: triangles must be whole numbers of shape (m, 3), not {triangles.shape}")
    if len(triangles) == 0:
        raise ModelError(f"{name} has no triangles; octex needs a surface, not points or lines")
    low, high = int(triangles.min()), int(triangles.max())
    if low < 0 or high >= vertices:
        worst = low if low < 0 else high
        raise ModelError(f"{name}: a triangle uses vertex {worst}, but there are {vertices}; export it again")
    return _owned(triangles, np.int32)


def _owned(given: npt.ArrayLike, dtype: type) -> npt.NDArray[Any]:
    """Return a read-only array of one's own: a copy, unless it is one already."""
    if isinstance(given, np.ndarray) and given.base is None and not given.flags.writeable:
        return np.asarray(given, dtype, order="C")
    array: npt.NDArray[Any] = np.array(given, dtype, order="C")
    array.flags.writeable = False
    return array


def _locked_frames(frames: Frames) -> Frames:
    normals, tangents = map(_locked_corners, frames)
    is_locked = normals is frames.normals and tangents is frames.tangents
    return frames if is_locked else Frames(normals, tangents)


def _locked_corners(corners: Corners) -> Corners:
    if not any(array.flags.writeable for array in corners):
        return corners
    return Corners(locked(corners.values), locked(corners.rows))


def as_surface(surface: Surface, name: str = "surface") -> Surface:
    """Return a surface, or raise ArgumentError for anything else."""
    if not isinstance(surface, Surface):
        raise ArgumentError(f"{name} must be an octex.Surface, not {surface!r}")
    return surface
