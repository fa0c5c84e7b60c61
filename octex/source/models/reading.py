"""Shared by the readers of models: options, numbers in text, texture coordinates, and joining parts."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Container, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s, Int64s
from octex.errors import ModelError, ModelWarning, damaged
from octex.files import open_file
from octex.jit import inlined, kernel
from octex.npz import read_npz
from octex.source.corners import Corners, Creases, Frames, Polygons
from octex.source.images.decode import global_settings
from octex.source.materials import AlphaMode, Input, Material, MaterialSource, Texture
from octex.source.mesh import FARTHEST
from octex.source.surface import NOT_FINITE, Surface, flip_v
from octex.source.tangents import corner_frames, transformed
from octex.source.vectors import Vector, cross_product, dot_product, minus, row_of


class Options(NamedTuple):
    """What to read of a model, and how to filter its images."""

    materials: bool = True  # False: the surface is white, and no image is read
    channels: tuple[str, ...] | None = None  # None: every channel of the materials
    filter: str = "ewa"
    overridden: tuple[str, ...] = ()  # channels whose images are not read: others replace them
    normals: bool = False  # keep shading normals even without a normal map
    pose: str | None = None  # NAME@SECONDS of an animation; None: at rest
    finite: bool = False  # leave out triangles with vertices that are not finite, instead of refusing them

    def wants(self, channel: str) -> bool:
        """Say whether a channel is to be read."""
        is_named = self.channels is None or channel in self.channels
        return self.materials and is_named and channel not in self.overridden

    def wants_image(self, channel: str) -> bool:
        """Say whether to read a channel's image: colour and alpha together, since alpha weighs colour."""
        pair = ("base_color", "alpha")
        return any(map(self.wants, pair)) if channel in pair else self.wants(channel)


def warn(text: str) -> None:
    """Warn about missing or repaired content of a model."""
    warnings.warn(text, ModelWarning, stacklevel=3)


def parse_numbers(text: str) -> Float64s | None:
    """Return the numbers of a text, separated by white space; None if it has anything else."""
    with global_settings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            return None


def npz_arrays(path: Path, names: Container[str] | None = None) -> dict[str, Array]:
    """Return the arrays of an .npz file, or only those with ``names``. Raises ModelError."""
    with open_file(path) as file:
        try:
            return read_npz(file, names)
        except ValueError as error:
            raise ModelError(f"{path.name} is not an .npz file of arrays ({error}); save it again") from None


def whole_numbers(values: Array) -> Int64s:
    """Return values as indices; −1 for values that are no whole numbers."""
    numbers = values.astype(np.float64)
    return np.where((np.abs(numbers) < 2**31) & (numbers == np.floor(numbers)), numbers, -1).astype(np.int64)


class Slot(NamedTuple):
    """A set of texture coordinates, and its transform."""

    name: str = ""  # "" for models with one set
    scale: tuple[float, ...] = (1.0, 1.0)
    rotation: float = 0.0  # radians, counter-clockwise on an image with v down
    offset: tuple[float, ...] = (0.0, 0.0)
    tiles: tuple[int, int] = (1, 1)  # columns and rows of UDIM tiles in the image

    def applied(self, coordinates: Array) -> Array:
        """Return coordinates (n, 2) scaled, rotated, then translated, as parts of the image's tiles."""
        if self == Slot(self.name):
            return coordinates
        scaled = coordinates * np.array(self.scale)
        if self.rotation:
            cos, sin = math.cos(self.rotation), math.sin(self.rotation)
            scaled = scaled @ np.array([[cos, -sin], [sin, cos]])
        return np.asarray((scaled + np.array(self.offset)) / np.array(self.tiles))


class LoadedMaterial(NamedTuple):
    """A material, and the sets of coordinates of its textures' slots."""

    material: Material = Material({"base_color": Input((1.0, 1.0, 1.0))})
    slots: tuple[Slot, ...] = ()
    assumed: frozenset[str] = frozenset()  # MTL: channels that only Ks or Ns implies
    reads_color: bool = False  # USD: vertex colours, and their alpha
    reads_opacity: bool = False


def slot_coordinates(
    materials: Mapping[int, LoadedMaterial], numbers: Int32s, read: Callable[[str], tuple[Array, Int32s]]
) -> list[Corners]:
    """Return coordinates slot by slot, v down, for triangles with materials of these ``numbers`` (m,).

    ``read`` returns a set of coordinates (n, 2), v up, by its name, and the row of each corner (m, 3).
    """
    by_slot = []
    for index in range(max(len(each.slots) for each in materials.values())):
        values, rows, first = [np.zeros((1, 2), np.float32)], np.zeros((len(numbers), 3), np.int32), 1
        slot_of = {n: each.slots[index] for n, each in materials.items() if index < len(each.slots)}
        for slot in dict.fromkeys(slot_of.values()):
            is_reader = np.isin(numbers, [n for n, other in slot_of.items() if other == slot])
            if is_reader.any():
                coordinates, of_corners = read(slot.name)
                values.append(flip_v(slot.applied(coordinates)))
                np.add(of_corners, np.int32(first), out=rows, where=is_reader[:, None])
                first += len(coordinates)
        by_slot.append(Corners(np.concatenate(values), rows))
    return by_slot


class PlacedMesh(NamedTuple):
    """A mesh in local coordinates, the attributes of its corners, and its matrix in a scene."""

    positions: Float64s
    triangles: Int32s
    materials: Int32s  # (m,)   the number of each triangle's material
    colors: Corners | None = None
    coordinates: Sequence[Corners] = ()  # by slot
    uv: Corners | None = None
    frames: Frames | None = None
    is_smooth: bool = False  # whether the file has normals
    polygons: Polygons | None = None
    matrix: Float64s | None = None  # to the world

    def placed(self) -> PlacedMesh:
        """Return the part in the world."""
        if self.matrix is None:
            return self
        linear, rows = self.matrix[:3, :3], self.triangles
        with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses infinite positions
            positions = self.positions @ linear.T + self.matrix[:3, 3]
            order = winding(linear)
        triangles = self.triangles[:, order]

        def ordered(corners: Corners) -> Corners:
            return corners._replace(rows=triangles if corners.rows is rows else corners.rows[:, order])

        return self._replace(
            positions=positions,
            triangles=triangles,
            colors=self.colors and ordered(self.colors),
            coordinates=list(map(ordered, self.coordinates)),
            uv=self.uv and ordered(self.uv),
            frames=self.frames and Frames(*map(ordered, transformed(self.frames, linear))),
            polygons=self.polygons and self.polygons._replace(corners=self.polygons.corners[:, order]),
        )


def with_frames(
    part: PlacedMesh,
    materials: Mapping[int, LoadedMaterial],
    normals: Corners | None,
    default: Corners | None,
) -> PlacedMesh:
    """Return a part with frames along the coordinates of normal maps, or of ``default`` without a map."""
    slots = np.full(max(materials) + 1, -1)
    for number, (material, *_) in materials.items():
        slots[number] = -1 if material.normal_slot is None else material.normal_slot
    coordinates = None
    if default is not None and (slots >= 0).any():
        coordinates = Corners.chosen([*part.coordinates, default], slots[part.materials])
    frames = corner_frames(part.positions, part.triangles, normals, None, coordinates)
    return part._replace(frames=frames, is_smooth=normals is not None)


def winding(linear: Float64s) -> slice:
    """Return the order of corners under a transform (3, 3): reversed by one that mirrors."""
    return slice(None, None, -1 if np.linalg.det(linear) < 0 else 1)


def assembled(
    parts: Sequence[PlacedMesh],
    materials: Sequence[Material],
    options: Options,
    name: str,
    *,
    provenance: dict[str, str] | None = None,
    posed: Float64s | None = None,
    creases: Creases | None = None,
) -> Surface:
    """Return the parts of a scene as one surface; ``posed`` are its posed positions (n, 3), if they differ.

    If only other parts have colours or coordinates, a part is white, and reads images at (0, 0).
    """
    parts = [part.placed() for part in parts]
    firsts = np.cumsum([0, *(len(part.positions) for part in parts)])
    positions = np.concatenate([part.positions for part in parts])
    triangles = np.concatenate(
        [part.triangles + np.int32(first) for part, first in zip(parts, firsts, strict=False)]
    )

    is_lost = np.zeros(len(triangles), np.bool_)
    if options.finite:
        is_far = ~(np.abs(positions) <= FARTHEST).all(axis=1)
        positions[is_far] = 0.0
        is_lost = is_far[triangles].any(axis=1)

    def joined(attributes: Sequence[Corners | None], default: float) -> Corners | None:
        width = next((each.values.shape[1] for each in attributes if each is not None), None)
        if width is None:
            return None
        row = np.full((1, width), default, np.float32)
        filled = [
            attribute or Corners(row, np.zeros_like(part.triangles))
            for part, attribute in zip(parts, attributes, strict=True)
        ]
        if all(each.rows is part.triangles for part, each in zip(parts, filled, strict=True)):
            return Corners(np.concatenate([values for values, _ in filled]), triangles)
        return Corners.joined(filled)

    is_smooth = any(part.is_smooth for part in parts)
    is_mapped = any(each.normal_slot is not None for each in materials)
    shaded = [part.frames for part in parts if part.frames is not None and (is_smooth or is_mapped)]
    frames = Frames(*(Corners.joined(each) for each in zip(*shaded, strict=True))) if shaded else None
    source = MaterialSource(
        materials,
        np.concatenate([part.materials for part in parts]),
        positions,
        triangles,
        colors=joined([part.colors for part in parts], 1.0),
        coordinates=[
            each
            for slot in zip_longest(*(part.coordinates for part in parts))
            if (each := joined(slot, 0.0)) is not None
        ],
        frames=frames,
        name=name,
        filter=options.filter,
        channels=options.channels,
    )
    uvs = [part.uv for part in parts]
    surface = Surface(
        positions if posed is None else posed,
        triangles,
        source,
        rest=None if posed is None else positions,
        uv=None if any(each is None for each in uvs) else joined(uvs, 0.0),
        frames=frames if is_smooth else None,
        polygons=Polygons.joined([(part.polygons, len(part.triangles)) for part in parts]),
        creases=creases,
        name=name,
        provenance=provenance,
    )
    if not is_lost.any():
        return surface
    surface = surface.part(np.flatnonzero(~is_lost))
    surface.provenance[NOT_FINITE] = str(int(is_lost.sum()))
    return surface


def check_among(numbers: Int64s, count: int, what: str, least: int = 0) -> None:
    """Raise ModelError, which begins with ``what``, unless ``least`` ≤ numbers < ``count``."""
    if numbers.size and not least <= numbers.min() <= numbers.max() < count:
        raise damaged(f"{what} that is not among the {count}")


def cut_part(
    name: str,
    positions: Float64s,
    indices: Int64s,
    sizes: Int64s,
    of_vertices: Float32s | None = None,
    of_polygons: Float32s | None = None,
) -> tuple[PlacedMesh, Int64s, Int64s]:
    """Cut polygons of ``sizes`` vertices, concatenated in ``indices``, into triangles of one material.

    The part has the colours of its vertices, or else of its polygons. Also returns each corner's row of
    ``indices`` (m, 3), and each triangle's polygon (m,).
    """
    check_among(indices, len(positions), f"{name}: a face uses a vertex")
    corners, numbers = triangulate(positions, indices, sizes)
    if len(corners) == 0:
        raise ModelError(f"{name} has no triangles; octex needs a surface, not points or lines")
    triangles, colors = indices[corners].astype(np.int32), None
    if of_vertices is not None:
        colors = Corners(of_vertices, triangles)
    elif of_polygons is not None:
        colors = Corners.of_triangles(of_polygons, numbers)
    materials, polygons = np.zeros(len(corners), np.int32), cut_polygons(corners, numbers, sizes)
    return PlacedMesh(positions, triangles, materials, colors, polygons=polygons), corners, numbers


def colored_surface(
    name: str, options: Options, part: PlacedMesh, textures: Sequence[Texture | None] = (None,)
) -> Surface:
    """Build a surface of colours and textures alone; alpha of colours counts unless it is 0 everywhere."""
    colors = part.colors
    if colors is not None and not colors.values[colors.rows, 3].any():
        colors = colors._replace(values=opaque(colors.values, name))
    is_translucent = colors is not None and (colors.values[:, 3] < 1).any()
    mode: AlphaMode = "blend" if is_translucent else "opaque"
    materials = [
        Material({"base_color": Input((1.0, 1.0, 1.0), image), "alpha": Input((1.0,), image, (3,))}, mode)
        for image in textures
    ]
    part = part._replace(colors=colors, coordinates=() if part.uv is None else (part.uv,))
    return assembled([part], materials, options, name)


def opaque(colors: Float32s, name: str) -> Float32s:
    """Return colours with alpha 1, and warn: several programs write 0 throughout but ignore it."""
    what = f"{name}: all its colours have alpha 0, which would show nothing"
    warn(f"{what}, so it is left out; export them with 255")
    return np.insert(colors[:, :3], 3, np.float32(1.0), axis=1)


def triangulate(positions: Float64s, corners: Int64s, sizes: Int64s) -> tuple[Int64s, Int64s]:
    """Cut polygons, of ``sizes`` corners each, into triangles.

    ``corners`` are rows of ``positions``. Returns triangles (m, 3), indices into ``corners``, and the polygon
    of each (m,): n − 2 for one of n corners. Convex ones become fans from their first corner.
    """
    if len(sizes) and (sizes == 3).all():
        return np.arange(len(corners)).reshape(-1, 3), np.arange(len(sizes))
    counts = np.maximum(sizes - 2, 0)
    triangles = np.empty((int(counts.sum()), 3), np.int64)
    is_hard = np.zeros(len(sizes), np.bool_)
    _fans(positions, corners, sizes, triangles, is_hard)
    firsts, ends = np.cumsum(sizes) - sizes, np.cumsum(counts)
    for polygon in np.flatnonzero(is_hard).tolist():
        first, size, end = firsts[polygon], sizes[polygon], ends[polygon]
        cut = _ears(positions[corners[first : first + size]])
        if len(cut) == size - 2:
            triangles[end - size + 2 : end] = first + cut
    return triangles, np.repeat(np.arange(len(sizes)), counts)


def cut_polygons(corners: Int64s, polygons: Int64s, sizes: Int64s) -> Polygons | None:
    """Return the polygons of triangles from ``triangulate``; None if each polygon was a triangle."""
    if (sizes == 3).all():
        return None
    within = corners - (np.cumsum(sizes) - sizes)[polygons, None]
    return Polygons(polygons.astype(np.int32), within.astype(np.int32))


def _ears(outline: Float64s) -> Int64s:
    """Cut a polygon (n, 3) into triangles (m, 3), projected along its area vector; none without extent."""
    from manifold3d import triangulate  # takes 6 ms

    low = outline.min(axis=0)
    with np.errstate(all="ignore"):
        outline = (outline - low) / (outline - low).max()
        after = np.roll(outline, -1, axis=0)
        normal = np.cross(outline, after).sum(axis=0)
    if not np.isfinite(outline).all():
        return np.empty((0, 3), np.int64)
    # Dropping an axis leaves coordinates exact: equal corners stay equal.
    axis = int(np.abs(normal).argmax())
    across, up = (axis + 1) % 3, (axis + 2) % 3
    plane = [across, up] if normal[axis] >= 0 else [up, across]
    return np.asarray(triangulate([np.ascontiguousarray(outline[:, plane])]), np.int64).reshape(-1, 3)


@kernel
def _fans(positions: Float64s, corners: Int64s, sizes: Int64s, triangles: Int64s, is_hard: Bools) -> None:
    """Cut each polygon into a fan; ``is_hard`` marks polygons that a fan may exceed.

    A polygon with one reflex corner is the union of two convex ones that share it: a fan from there is right.
    """
    first = 0
    done = 0
    for polygon in range(len(sizes)):
        size = sizes[polygon]
        apex = 0
        if size > 3:
            apex = _apex(positions, corners, first, size)
            is_hard[polygon] = apex < 0
            apex = max(apex, 0)
        for i in range(size - 2):
            triangles[done + i, 0] = first + apex
            triangles[done + i, 1] = first + (apex + i + 1) % size
            triangles[done + i, 2] = first + (apex + i + 2) % size
        done += max(size - 2, 0)
        first += size


@kernel
def _apex(positions: Float64s, corners: Int64s, first: int, size: int) -> int:
    """Return the reflex corner of a polygon, 0 if it has none, −1 if it has several or turns right back."""
    normal = (0.0, 0.0, 0.0)  # twice the area vector, by Newell's method
    for i in range(size):
        a = row_of(positions, corners[first + i])
        b = row_of(positions, corners[first + (i + 1) % size])
        normal = (
            normal[0] + (a[1] - b[1]) * (a[2] + b[2]),
            normal[1] + (a[2] - b[2]) * (a[0] + b[0]),
            normal[2] + (a[0] - b[0]) * (a[1] + b[1]),
        )
    last = size - 1
    edge = _edge(positions, corners, first, size, last)
    while last > 0 and edge[0] == edge[1] == edge[2] == 0.0:
        last -= 1
        edge = _edge(positions, corners, first, size, last)
    apex = 0
    reflex = 0
    for i in range(size):
        to = _edge(positions, corners, first, size, i)
        if to[0] == to[1] == to[2] == 0.0:  # equal corners count once
            continue
        turn = dot_product(cross_product(edge, to), normal)
        if turn < 0.0:
            apex = i
            reflex += 1
        elif turn == 0.0 and dot_product(edge, to) < 0.0:
            return -1
        edge = to
    return apex if reflex <= 1 or size == 4 else -1


@inlined
def _edge(positions: Float64s, corners: Int64s, first: int, size: int, i: int) -> Vector:
    """Return the edge from a corner of a polygon to the next."""
    next_one = row_of(positions, corners[first + (i + 1) % size])
    return minus(next_one, row_of(positions, corners[first + i]))
