"""Paint without an image: one value over a region of the surface, or over the leaves of one colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s, Int64s
from octex.channels import BASE_COLOR, ChannelFormat, linear_to_srgb
from octex.checks import answer, as_choice, as_depth, as_number, as_points, as_positive, as_reals
from octex.editing.draft import Change
from octex.errors import ArgumentError
from octex.painting.image import BLENDS, Blend
from octex.painting.layer import Depths, PaintSource, empty_texture, leaves_by_level
from octex.painting.merge import Merging, merged
from octex.painting.paint import check_inside, format_of, value_of
from octex.painting.steps import layer_from, rasterize_surface
from octex.painting.surface import Job, PaintedSurface, triangles_of
from octex.parallel import Progress, Run, as_run, workers
from octex.source.corners import at_corners
from octex.source.parts import join
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.tree.edit import locate
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement, on_grid
from octex.view.shading import face_normals

#: Returns the coverage (n,), 0 … 1, of a region at rest positions (n, 3).
RegionFunction: TypeAlias = Callable[[Float64s], npt.ArrayLike]

_DEPTH = 10
#: Number of cells that a region may always have, and the cost of surface that it does not cover, as a share.
_FEW, _UNCOVERED = 1 << 18, 1 / 16
_FARTHEST = 1e100


class Sphere(NamedTuple):
    """A ball, in rest positions. Coverage fades out over the last ``soft`` inside its radius."""

    center: tuple[float, float, float]
    radius: float
    soft: float = 0.0

    def checked(self) -> Sphere:
        """Return the region with its numbers as floats, or raise ArgumentError."""
        x, y, z = as_reals(self.center, "center", (3,), most=_FARTHEST).tolist()
        radius = as_number(as_positive(self.radius, "radius"), "radius", 0.0, _FARTHEST)
        return Sphere((x, y, z), radius, as_number(self.soft, "soft", 0.0, np.inf))

    def covers(self, points: Float64s) -> Float64s:
        """Return the coverage (n,), 0 … 1, at rest positions (n, 3)."""
        offsets = as_points(points) - np.asarray(self.center, np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # of points that are not finite, or nearly
            return _falling_off(self.radius - np.linalg.norm(offsets, axis=1), self.soft)

    def bounds(self) -> Float64s:
        """Return the lowest and highest corner (2, 3)."""
        center = np.asarray(self.center, np.float64)
        return np.stack([center - self.radius, center + self.radius])


class Box(NamedTuple):
    """A box between two corners, at rest. Coverage fades out over the last ``soft`` inside its faces."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    soft: float = 0.0

    def checked(self) -> Box:
        """Return the region with its numbers as floats, or raise ArgumentError."""
        low, high = (
            as_reals(corner, name, (3,), most=_FARTHEST)
            for corner, name in ((self.low, "low"), (self.high, "high"))
        )
        if (low > high).any():
            raise ArgumentError(f"{self!r} is not a box: low must not exceed high")
        (x, y, z), (u, v, w) = low.tolist(), high.tolist()
        return Box((x, y, z), (u, v, w), as_number(self.soft, "soft", 0.0, np.inf))

    def covers(self, points: Float64s) -> Float64s:
        """Return the coverage (n,), 0 … 1, at rest positions (n, 3)."""
        low, high = self.bounds()
        points = as_points(points).astype(np.float64, copy=False)
        with np.errstate(over="ignore", invalid="ignore"):
            return _falling_off(np.minimum(points - low, high - points).min(axis=1), self.soft)

    def bounds(self) -> Float64s:
        """Return the lowest and highest corner (2, 3)."""
        return np.stack([np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)])


def _falling_off(inside: Float64s, soft: float) -> Float64s:
    if soft > 0.0:
        return np.clip(inside / soft, 0.0, 1.0)
    return (inside >= 0.0).astype(np.float64)


Region: TypeAlias = Sphere | Box | RegionFunction | npt.ArrayLike


def fill(
    texture: OctreeTexture | None,
    surface: Surface,
    region: Region,
    color: npt.ArrayLike | str,
    *,
    channel: str = "base_color",
    opacity: float = 1.0,
    blend: Blend = "over",
    max_depth: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Fill a region of the surface with one value, and return the texture with it.

    texture    the texture to paint on; it does not change. None begins a new one
    region     at rest: a Sphere; a Box; triangles, as numbers or one bool each; or a function that takes rest
               positions (n, 3) and returns coverage (n,), 0 … 1, called in batches from several threads
    color      a number for each component of the channel, 0 … 1, linear light for colours; or an sRGB colour
               "#rrggbb". Float channels take numbers beyond 1, directions are from −1 to 1
    channel    the channel to fill
    opacity    0 … 1
    blend      how the value combines with the texture: one of BLENDS
    max_depth  the resolution of the region's border. Default: the texture's, or a coarser one if only a small
               part of the texture is so fine; 10 for a new one
    run        how to work (octex.Run)

    Raises ArgumentError for another kind of region, for a function whose result has another shape, is NaN or
    lies outside of 0 … 1, for a colour outside of the channel's range, and as ``paint`` does.
    """
    as_surface(surface)
    run = as_run(run, threads, progress)
    painted = PaintedSurface(surface if texture is None else surface.placed_in(as_texture(texture)))
    with workers(run) as pool:
        job, paint = Job(painted, pool, run.report), (region, color, channel, opacity, blend, max_depth)
        base, change = filled(job, texture, surface, *paint)
    return base if change is None else change.put_into(base)


def filled(
    job: Job,
    texture: OctreeTexture | None,
    surface: Surface,
    region: Region,
    color: npt.ArrayLike | str,
    channel: str,
    opacity: float,
    blend: Blend,
    max_depth: int | None,
    merge: Merging = merged,
) -> tuple[OctreeTexture, Change | None]:
    """Return the texture, a new one for None, and the change of a fill; see `fill`."""
    painted, opacity = job.surface, as_number(opacity, "opacity", 0.0, 1.0)
    as_choice(blend, BLENDS, "blend")
    form = format_of(texture, channel)
    value = value_of(color, form)
    source = RegionSource(form, value, surface.rest, surface.triangles, *_coverage(region, surface))
    if max_depth is not None:
        depth = as_depth(max_depth, "max_depth")
    else:
        depth = _DEPTH if texture is None or not texture.tree.n_leaves else _depth_of(source, texture)
    placement = Placement.around(surface.bounds, depth) if texture is None else texture.placement
    check_inside(painted.surface, placement)
    layer = layer_from(job, rasterize_surface(job, source, placement, Depths(depth, depth), fit=False))
    base = texture or empty_texture([form], placement, painted.surface.bounds, painted.surface)
    return base, merge(job, base, layer, opacity, blend)


@dataclass(eq=False)
class RegionSource(PaintSource):
    """One value over a region."""

    form: ChannelFormat
    value: Float32s  # (components,)
    rest: Float64s  # (n, 3)
    triangles: Int32s  # (m, 3)
    chosen: Bools  # (m,)   triangles that it may cover
    covers: RegionFunction

    def touched(self) -> Int32s:
        """Return the triangles that the region may cover."""
        return np.flatnonzero(self.chosen).astype(np.int32)

    def evaluate(
        self,
        triangles: Int32s,
        barycentric: Float64s,
        widths: Float32s,  # noqa: ARG002
    ) -> Float32s:
        """Return the value and its coverage (n, components + 1)."""
        values = np.zeros((len(triangles), len(self.value) + 1), np.float32)
        values[:, :-1] = self.value
        rows = np.flatnonzero(self.chosen[triangles])
        if rows.size:
            points = at_corners(self.rest, self.triangles[triangles[rows]], barycentric[rows])
            shape = (len(points),)
            values[rows, -1] = answer(
                self.covers, [points], [shape], "region", points.__getitem__, least=0.0, most=1.0
            )
        return values


def _depth_of(source: RegionSource, texture: OctreeTexture) -> int:
    """Return the depth of a region's border in a texture: that of most cells on as much surface.

    Paint from close up makes a texture deeper in a few places. All of a region so deep would take minutes.
    """
    touched = source.touched()
    areas = face_normals(source.rest, source.triangles[touched])[1] / texture.placement.size**2
    middles, widths = np.full((touched.size, 3), 1 / 3), np.zeros(touched.size, np.float32)
    covered = areas * source.evaluate(touched, middles, widths)[:, -1]
    area = max(covered.sum(), _UNCOVERED * areas.sum())
    levels = enumerate(np.diff(texture.tree.arrays.level_cells).tolist())
    return max((level for level, cells in levels if area * 4**level <= max(_FEW, 2 * cells)), default=0)


def _coverage(region: Region, surface: Surface) -> tuple[Bools, RegionFunction]:
    """Return the triangles that a region may cover, and its coverage of positions."""
    n_triangles = len(surface.triangles)
    if isinstance(region, (Sphere, Box)):
        region = region.checked()
        low, high = region.bounds()
        corners = surface.rest[surface.triangles]
        meets = (corners.min(axis=1) <= high).all(axis=1) & (corners.max(axis=1) >= low).all(axis=1)
        return meets, region.covers
    if callable(region):
        return np.ones(n_triangles, np.bool_), region
    return triangles_of(region, n_triangles, "a Sphere, a Box, a function, or "), _everywhere


def _everywhere(points: Float64s) -> npt.ArrayLike:
    return np.ones(len(points))


def alike(
    texture: OctreeTexture, point: Array, tolerance: float, *, connected: bool = True
) -> RegionFunction:
    """Return the region of the leaves whose base colour is nearly that of a point at rest.

    A leaf's colour is a lookup in its centre. ``tolerance`` is the largest difference of a component in 1/255
    of sRGB, 0 … 255. ``connected`` limits the region to leaves that connect to the point's through faces. It
    is empty if the point is in no leaf.

    Raises ArgumentError for numbers out of range.
    """
    where = as_reals(point, "point", (3,), most=_FARTHEST)[None]
    most = as_number(tolerance, "tolerance", 0.0, 255.0)
    tree = texture.tree
    first = _leaf_at(texture, where)[0]
    is_chosen = np.zeros(tree.n_cells, np.bool_)
    if first >= 0:
        wanted = _codes(texture, where)
        for level, cells, codes in leaves_by_level(texture.tree):
            middles = texture.placement.to_rest((decode_cells(codes) + 0.5) / 2**level)
            is_chosen[cells] = np.abs(_codes(texture, middles) - wanted).max(axis=1) <= most
        is_chosen[first] = True
        if connected:
            is_chosen = _connected(texture, is_chosen, first)

    def covers(points: Float64s) -> Bools:
        cells = _leaf_at(texture, points)
        return is_chosen[cells] & (cells >= 0)

    return covers


def _codes(texture: OctreeTexture, points: Array) -> Array:
    """Return base colours of points (n, 3) in 1/255 of sRGB, not rounded."""
    return 255.0 * linear_to_srgb(np.clip(texture.sample(points, BASE_COLOR.name), 0.0, 1.0))


def _leaf_at(texture: OctreeTexture, points: Array) -> Int64s:
    """Return the leaf that each point at rest (n, 3) is in; −1 for none."""
    depth = texture.tree.max_depth
    positions = texture.placement.to_texture_space(points)
    is_inside = np.asarray(((positions >= 0) & (positions <= 1)).all(axis=1))
    codes = encode_cells(on_grid(points, texture.placement) >> (GRID_BITS - depth))
    return _leaf_of(texture.tree, codes, depth, is_inside)


def _leaf_of(tree: Octree, codes: Int64s, level: int, among: Bools) -> Int64s:
    """Return the leaf that is, or contains, each cell (n,) of a level; −1 for none and outside ``among``."""
    where = locate(tree, codes, level)
    return np.where(where.is_leaf & among & (tree.n_leaves > 0), where.cells, -1)


def _connected(texture: OctreeTexture, is_chosen: Bools, first: int) -> Bools:
    """Return the chosen leaves that connect to the first one through faces."""
    pairs = []
    for level, cells, codes in leaves_by_level(texture.tree):
        is_here = is_chosen[cells]
        cells, positions = cells[is_here], decode_cells(codes[is_here])
        for axis in range(3):
            for step in (-1, 1):  # the smaller of two leaves finds the other
                neighbours = positions.copy()
                neighbours[:, axis] += step
                is_inside = (neighbours[:, axis] >= 0) & (neighbours[:, axis] < 2**level)
                neighbours[~is_inside] = 0
                neighbour_leaves = _leaf_of(texture.tree, encode_cells(neighbours), level, is_inside)
                is_pair = (neighbour_leaves >= 0) & is_chosen[neighbour_leaves]
                pairs.append(np.stack([cells[is_pair], neighbour_leaves[is_pair]]))
    parents = np.arange(len(is_chosen))
    join(parents, *np.concatenate(pairs, axis=1))
    connected: Bools = is_chosen & (parents == parents[first])
    return connected
