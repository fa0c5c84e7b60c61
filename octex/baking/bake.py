"""Bakes an octree texture to images at the texture coordinates of a surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s, in_runs
from octex.baking.blocks import TexelBlocks
from octex.baking.coordinates import cell_of
from octex.baking.directions import in_tangent_space, rotated
from octex.baking.gutters import Borders, fill_up, gutter_of
from octex.baking.layout import LAYOUTS, Layout, Layouts, doubled_areas, neighbours_of_mesh, steps_between
from octex.baking.maps import BITS, Bits, MapValues, alpha_mode, average, inputs_of, lacking
from octex.baking.sheets import Sheet, coordinates_of, sheets_of
from octex.baking.texels import Drawing, TexelPoints, TexelRows, texel_points
from octex.channels import ALPHA, MATERIAL_CHANNELS, NORMAL
from octex.checks import as_choice, as_names, as_number, as_whole
from octex.errors import ArgumentError, ModelError
from octex.nearest.triangles import Nearest, Triangles
from octex.parallel import Progress, Run, as_run, ordered_map, sharing, workers
from octex.source.corners import Corners, across, area_vectors, at_corners, unit, unit_normals
from octex.source.images.pyramid import CLAMP, REPEAT
from octex.source.materials import AlphaMode, Material, MaterialSource
from octex.source.surface import Surface, as_surface
from octex.source.tangents import corner_frames
from octex.texture import OctreeTexture, as_texture
from octex.tree.search import put_rows
from octex.view.shading import corner_normals

#: The smallest and the largest side of maps in texels, and the step between sizes.
_SMALLEST, _MOST, _STEP = 64, 16384, 8
#: Most lookups along a side of a texel.
_MOST_LOOKUPS = 8
#: Rows of texels in one task.
_BAND = 32
#: Reach of gutters in paddings: charts are two paddings apart, so every texel between is nearer than 1.5.
_REACH = 1.5
#: Texels whose sizes differ by at most this part share their lookups.
_ALIKE = 0.25
#: Texels of gutters in one task.
_GUTTER = 1 << 16
#: Largest doubled area, in texels, of triangles flat in the map, as on the palettes of low-poly models.
_FLAT = 1e-9
#: Least cosine between the normals of a triangle and of a near point that it shows.
_SAME_SIDE = 0.5
#: Points on a flat triangle, more per texel of its length, and most points on all of them beyond the first.
_POINTS, _ALONG, _MOST_POINTS = 16, 4, 1 << 22


def bake(
    texture: OctreeTexture,
    surface: Surface,
    *,
    source: Surface | None = None,
    max_distance: float | None = None,
    uv: Layouts = "auto",
    texture_size: int | None = None,
    padding: int | None = None,
    channels: Sequence[str] | None = None,
    bits: Bits = 8,
    supersample: int = 1,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> Surface:
    """Bake a texture to images, and return the surface with them, for ``write_model``.

    source         the surface that the texture was made of, if ``surface`` is another mesh of the same
                   object: each texel takes the nearest point of ``source``, at rest, that faces the same way.
                   Normals are then baked too: those of the texture, or else of ``source``
    max_distance   how far away that point may be, in the model's units (None: any distance). Other texels are
                   filled from their neighbours
    uv             "keep": the surface's texture coordinates, with maps for each material; "atlas": new ones
                   for the whole surface; "xatlas": new ones with charts by xatlas; "auto": keep, unless in
                   some material more than 1 % overlaps with different colours or has too coarse texels
    texture_size   width of the square maps in texels, 64 to 16384. Default: the least power of two, up to
                   8192, whose texels have on average the area of a leaf; doubled, at most twice, until
                   bilinear reading is within 3/255 (RMS) of the texture where the texture varies. An atlas is
                   doubled once if the shading normals of ``source`` are finer
    padding        texels around each chart of an atlas, 0 to 64 (default 8, fewer if there is little room)
    channels       names of the channels to bake (default: all that materials have)
    bits           of each number: 8; 16; or 32, floats in linear light, with directions as (x + 1) / 2
    supersample    average this many lookups along each side of a texel, 1 to 8
    run            how to work (octex.Run)

    Each texel is one lookup of each channel, averaged over the texel's area on the surface, on the side that
    the surface faces. Texels are fitted to bilinear filtering. Around charts the maps continue with the
    colours across the chart's edge on the surface, so smaller mip levels show no seam. Normals are in tangent
    space, as in glTF.

    Materials keep their names, double-sidedness and alpha modes; an atlas joins those with the same last two.
    If all are opaque and the texture has alpha below 1, they become masked, or blended if many texels have
    alpha between 0 and 1. Constant channels become factors.

    Raises ArgumentError for numbers out of range and for channels that the texture or the materials lack.
    Raises ModelError for texture coordinates that cannot be kept, for an atlas without room, and if
    ``source`` is too far away everywhere. (Benson & Davis 2002, 6.3.)
    """
    as_texture(texture)
    as_surface(surface)
    as_choice(uv, LAYOUTS, "uv")
    if padding is not None:
        padding = as_whole(padding, "padding", 0, 64)
    names = _channels_of(texture, channels, has_normals=source is not None)
    if as_whole(bits, "bits", min(BITS), max(BITS)) not in BITS:
        raise ArgumentError(f"bits must be 8, 16 or 32, not {bits!r}")
    supersample = as_whole(supersample, "supersample", 1, _MOST_LOOKUPS)
    if texture_size is not None:
        texture_size = as_whole(texture_size, "texture_size", _SMALLEST, _MOST)
        if texture_size % _STEP:
            raise ArgumentError(f"texture_size must be a multiple of {_STEP}, not {texture_size}")
    distance = np.inf if max_distance is None else as_number(max_distance, "max_distance", 0.0, np.inf)
    if source is None and max_distance is not None:
        raise ArgumentError("max_distance limits the distance to source; give source too")
    run = as_run(run, threads, progress)
    original = None
    if source is None:
        surface = surface.placed_on(texture)
    else:
        original = _Original.of(as_surface(source, "source"), texture, distance)
    with workers(run) as executor, sharing(executor) as pool:
        run.report("unwrap", 0, 1)
        stored = [name for name in names if name in texture.channels]
        detail = np.inf if original is None or len(stored) == len(names) else original.detail()
        probed = stored or [*texture.channels]
        sheets = sheets_of(texture, surface, probed, uv, texture_size, padding, pool, detail)
        coordinates = coordinates_of(sheets, len(surface.triangles))
        run.report("unwrap", 1, 1)
        lookups = _TexelLookups(texture, surface, original, sheets, coordinates, names, bits, supersample)
        first, rows = 0, sum(sheet.layout.height for sheet in sheets)
        materials: list[Material] = []
        shows_any = False
        owners = np.empty(len(surface.triangles), np.int32)
        for sheet in sheets:
            owners[sheet.triangles] = len(materials) + sheet.owners

            def advance(stage: str, done: int, total: int, before: int = first) -> None:  # noqa: ARG001
                run.report(stage, min(before + done * _BAND, rows), rows)

            baked_materials, shows = _bake_sheet(lookups, sheet, pool, advance)
            materials += baked_materials
            shows_any |= shows
            first += sheet.layout.height
    if source is not None and not shows_any:
        raise ModelError(
            f"{source.name} has no surface near {surface.name} that faces the same way; give a larger "
            "max_distance, or another source"
        )
    baked = MaterialSource(
        materials, owners, surface.rest, surface.triangles,
        coordinates=[coordinates], frames=lookups.frames, name=surface.name,
    )  # fmt: skip
    return Surface(
        surface.vertices, surface.triangles, baked, rest=surface.rest, uv=coordinates,
        frames=lookups.frames or surface.frames, name=surface.name, provenance=surface.provenance,
    )  # fmt: skip


def _bake_sheet(
    lookups: _TexelLookups, sheet: Sheet, pool: Executor, progress: Progress
) -> tuple[list[Material], bool]:
    """Return the materials of a sheet with its maps, and whether the maps show anything."""
    layout = sheet.layout._replace(faces=sheet.triangles[sheet.layout.faces])
    maps = MapValues.of(lookups.names, layout.height, layout.width)
    is_drawn = np.zeros(maps.areas.shape, np.bool_)
    ends = [*range(0, layout.height, _BAND), layout.height]
    drawing = Drawing.of(layout.sized(lookups.supersample * layout.width))
    tasks = [(lookups, drawing, slice(*band), maps, is_drawn) for band in pairwise(ends)]
    for _ in ordered_map(pool, _bake_band, tasks, stage="bake", progress=progress):
        pass
    is_flat = np.abs(doubled_areas(layout.corners)) <= _FLAT
    if is_flat.any():
        _bake_flat(lookups, layout.of(is_flat), is_drawn, maps)
    if layout.padding and not is_drawn.all():
        charts = layout.of(~is_flat)
        parts = Borders.of(charts, is_drawn, math.ceil(_REACH * layout.padding)).parts(_GUTTER)
        list(ordered_map(pool, lambda borders: _bake_gutter(lookups, charts, borders, maps), parts))
    shows_any = bool(maps.areas.any())
    if not maps.areas.all():
        fill_up(maps.values, (maps.areas > 0).astype(np.float32))
    uv = layout.uv.values[layout.uv.rows]
    wrap = REPEAT if (uv < 0.0).any() or (uv > 1.0).any() else CLAMP
    inputs = inputs_of(maps, lookups.bits, lacking(lookups.supersample, _blur(lookups, layout)), wrap, pool)
    modes: list[AlphaMode] = ["opaque"] * len(sheet.materials)
    if ALPHA.name in maps.lanes:
        measured = alpha_mode(maps.channel(ALPHA.name))
        modes = [old.alpha_mode if lookups.has_modes else measured for old in sheet.materials]
    materials = [
        Material(inputs, mode, name=old.name, double_sided=old.double_sided)
        for old, mode in zip(sheet.materials, modes, strict=True)
    ]
    return materials, shows_any


def _channels_of(texture: OctreeTexture, channels: Sequence[str] | None, has_normals: bool) -> list[str]:
    known = list(dict.fromkeys([*texture.channels, *([NORMAL.name] if has_normals else [])]))
    if channels is None:
        names = [name for name in known if name in MATERIAL_CHANNELS]
    else:
        names = as_names(channels, "channels", known, "channel of the texture")
        as_names(names, "channels", MATERIAL_CHANNELS, "channel of materials")
    if not names:
        raise ArgumentError(
            f"no channel to bake: baking to a material needs one of {', '.join(MATERIAL_CHANNELS)}"
        )
    return names


class _Original(NamedTuple):
    """The surface that the texture was made from, where another mesh of the same object is baked."""

    surface: Surface  # with the texture's rest positions
    nearest: Triangles  # with the baked surface's rest positions
    normals: Float64s  # (m, 3)   of its triangles, in the texture's space
    shading: Corners  # its shading normals, in the baked surface's space
    distance: float  # the largest to the baked surface

    @classmethod
    def of(cls, surface: Surface, texture: OctreeTexture, distance: float) -> _Original:
        """Prepare a surface."""
        nearest = Triangles.of(surface.rest, surface.triangles, surface.name)
        if surface.frames is None:
            normals = corner_normals(surface.rest, surface.triangles).reshape(-1, 3)
            shading = Corners(normals, np.arange(len(normals), dtype=np.int32).reshape(-1, 3))
        else:
            shading = surface.frames.normals
        placed = surface.placed_on(texture)
        return cls(placed, nearest, unit_normals(placed.rest[placed.triangles]), shading, distance)

    def detail(self) -> float:
        """Return half the edge of a typical triangle: texels this wide hold its shading normals."""
        return float(np.sqrt(2.0 * self.surface.areas().mean()) / 2.0)

    def facing(self, points: Float64s, normals: Float64s, squares: Float64s) -> Nearest:
        """Return the nearest points on the same side of creases; on any side if farther than ``squares``."""
        nearest = self.nearest.nearest(points, normals, distance=self.distance, least_cosine=_SAME_SIDE)
        far = np.flatnonzero(nearest.squares > squares)
        if far.size:
            anywhere = self.nearest.nearest(
                points[far], normals[far], distance=self.distance, least_cosine=0.0
            )
            nearest.triangles[far], nearest.barycentric[far], nearest.squares[far] = anywhere
        return nearest


class _TexelLookups:
    """The lookups of all texels, and the data that they share."""

    def __init__(
        self, texture: OctreeTexture, surface: Surface, original: _Original | None, sheets: list[Sheet],
        coordinates: Corners, names: list[str], bits: int, supersample: int,
    ) -> None:  # fmt: skip
        self.texture, self.surface, self.original, self.names = texture, surface, original, names
        self.bits = bits
        self.supersample = supersample  # lookups along each side of a texel
        self.has_modes = any(each.alpha_mode != "opaque" for sheet in sheets for each in sheet.materials)
        #: (m, 3)   the triangle beyond each side, and the number of the side there
        self.neighbours, self.sides = neighbours_of_mesh(surface)
        rest, flat = surface.rest[surface.triangles], coordinates.values[coordinates.rows].astype(np.float64)
        for sheet in sheets:
            flat[sheet.triangles] *= supersample * sheet.layout.width, supersample * sheet.layout.height
        #: (m, 3)   the steps of rest positions from a lookup to the next one right and below
        self.dPdx, self.dPdy = steps_between(rest, flat)
        leaf = cell_of(texture)
        #: (m,)   whether a lookup averages over no more than a leaf
        self.is_fine = (self.dPdx**2).sum(axis=1) + (self.dPdy**2).sum(axis=1) <= leaf**2
        self.sizes = supersample * np.linalg.norm(np.cross(self.dPdx, self.dPdy), axis=1) ** 0.5  # of texels
        crosses = area_vectors(rest)
        self.normals, self.areas = unit(crosses), np.linalg.norm(crosses, axis=1) / 2.0
        self.blocks = None
        if original is None:
            self.blocks = TexelBlocks.of(texture, names, self.normals, self.dPdx, self.dPdy)
        self.frames = None
        if NORMAL.name in names:
            normals = None if surface.frames is None else surface.frames.normals
            self.frames = corner_frames(surface.rest, surface.triangles, normals, None, coordinates)

    def sampled(
        self, triangles: Int32s, rest: Float64s, derivatives: tuple[Float64s, Float64s] | None
    ) -> tuple[Float32s, Bools | None]:
        """Return the channels side by side at points of triangles (n,), and which points have any."""
        normals, has_values = self.normals[triangles], None
        barycentric = np.empty((0, 3))
        if self.original is not None:
            nearest = self.original.facing(rest, normals, self.areas[triangles])
            has_values = nearest.triangles >= 0
            triangles, barycentric = nearest.triangles[has_values], nearest.barycentric[has_values]
            rest = self.original.surface.rest_at(triangles, barycentric)
            normals = self.original.normals[triangles]
            derivatives = derivatives and (derivatives[0][has_values], derivatives[1][has_values])
        dPdx, dPdy = derivatives or (None, None)
        names = [name for name in self.names if name in self.texture.channels]
        values = self.texture.sample(rest, names, dPdx=dPdx, dPdy=dPdy, normals=normals, threads=1)
        if len(names) < len(self.names):
            assert self.original is not None
            shading = unit(self.original.shading.at(triangles, barycentric)).astype(np.float32)
            values[NORMAL.name] = shading
        return np.concatenate([values[name] for name in self.names], axis=1), has_values

    def write(
        self, texels: Int32s, triangles: Int32s, rest: Float64s,
        derivatives: tuple[Float64s, Float64s] | None, values: Float32s, areas: Float32s,
    ) -> None:  # fmt: skip
        """Write the channels at points to texels ``texels`` (n,); texels without any get area 0."""
        samples, has_values = self.sampled(triangles, rest, derivatives)
        if has_values is not None:
            areas[texels[~has_values]] = 0.0
            texels = texels[has_values]
        put_rows(samples, texels, values)


def _blur(lookups: _TexelLookups, layout: Layout) -> float:
    """Return the part of a mean's variance in lookups; those up to a leaf wide return the field itself."""
    areas = np.abs(doubled_areas(layout.corners))
    leaf = lookups.supersample * cell_of(lookups.texture)
    blur = 1.0 - np.minimum(leaf / np.maximum(lookups.sizes[layout.faces], leaf), 1.0) ** 2
    return float((areas * blur).sum() / max(float(areas.sum()), 1e-300))


def _bake_band(task: tuple[_TexelLookups, Drawing, slice, MapValues, Bools]) -> None:
    """Write the channels at the texels of a band of rows, and the covered part of each texel."""
    lookups, drawing, band, maps, is_drawn = task
    n, lanes = lookups.supersample, maps.values.shape[2]
    drawn = drawing.rows(n * band.start, n * band.stop)
    is_drawn[band] = (drawn.triangles >= 0).reshape(-1, n, maps.areas.shape[1], n).any(axis=(1, 3))
    values, areas = maps.values[band], maps.areas[band]
    if n == 1:
        areas[:] = drawn.areas
        _bake_drawn(lookups, drawing.layout, drawn, band.start, maps.lanes, values.reshape(-1, lanes), areas)
        return
    fine = np.zeros((drawn.areas.size, lanes), np.float32)
    _bake_drawn(lookups, drawing.layout, drawn, n * band.start, maps.lanes, fine, drawn.areas)
    average(fine.reshape(*drawn.areas.shape, lanes), drawn.areas, n, values, areas)
    if NORMAL.name in maps.lanes:
        normals = values[..., maps.lanes[NORMAL.name]]
        normals[:] = unit(normals.reshape(-1, 3).astype(np.float64)).reshape(normals.shape)


def _bake_drawn(
    lookups: _TexelLookups, layout: Layout, drawn: TexelRows, first: int, lanes: Mapping[str, slice],
    values: Float32s, areas: Float32s,
) -> None:  # fmt: skip
    """Write the channels of rows from ``first`` on; texels without a value get area 0."""
    surface = lookups.surface
    points = texel_points(layout.corners, layout.faces, drawn, first, surface.rest, surface.triangles)
    if not points.texels.size:
        return
    missed = np.arange(points.texels.size)
    if lookups.blocks is not None:
        missed = lookups.blocks.look_up(points, values)
    triangles = points.triangle_of_each()
    if missed.size:
        owners, derivatives = triangles[missed], None
        if not lookups.is_fine[owners].all():
            derivatives = lookups.dPdx[owners], lookups.dPdy[owners]
        texels, rest = points.texels[missed], points.rest[missed]
        lookups.write(texels, owners, rest, derivatives, values, areas.reshape(-1))
    if lookups.frames is not None:
        lane = lanes[NORMAL.name]
        directions = np.take(values[:, lane], points.texels, axis=0)
        normals = in_tangent_space(directions, lookups.frames, triangles, points.barycentric)
        values[points.texels, lane] = normals


def _bake_flat(lookups: _TexelLookups, layout: Layout, is_drawn: Bools, maps: MapValues) -> None:
    """Write the channels of flat triangles to the texels that they read and no other triangle covers."""
    rows, barycentric = _points_on(layout)
    triangles = layout.faces[rows]
    rest = lookups.surface.rest_at(triangles, barycentric)
    values, has_values = lookups.sampled(triangles, rest, None)
    if has_values is not None:
        rows, barycentric, triangles = rows[has_values], barycentric[has_values], triangles[has_values]
    if lookups.frames is not None:
        lane = maps.lanes[NORMAL.name]
        values[:, lane] = in_tangent_space(values[:, lane], lookups.frames, triangles, barycentric)
    areas = 2.0 * lookups.areas[layout.faces]
    texels, means = _means_at_texels(layout, rows, barycentric, values, areas)
    is_free = ~is_drawn.reshape(-1)[texels]
    put_rows(means[is_free], texels[is_free], maps.values.reshape(-1, means.shape[1]))
    maps.areas.reshape(-1)[texels[is_free]] = 1.0
    is_drawn.reshape(-1)[texels] = True


def _points_on(layout: Layout) -> tuple[Int64s, Float64s]:
    """Return evenly spread points on flat triangles: the triangle of each, and barycentric coordinates."""
    lengths = np.ptp(layout.corners, axis=1).max(axis=1)
    along = _ALONG * lengths * min(1.0, _MOST_POINTS / max(_ALONG * float(lengths.sum()), 1.0))
    counts = _POINTS + along.astype(np.int64)
    rows = np.repeat(np.arange(counts.size), counts)
    number = in_runs(np.zeros(counts.size, np.int64), counts)
    # The sequence R2: whole multiples of two powers of the plastic number's inverse.
    root, part = np.sqrt(number * 0.7548776662466927 % 1.0), number * 0.5698402909980532 % 1.0
    return rows, np.stack([1.0 - root, root * (1.0 - part), root * part], axis=1)


def _means_at_texels(
    layout: Layout, triangles: Int64s, barycentric: Float64s, values: Float32s, areas: Float64s
) -> tuple[Int32s, Float32s]:
    """Return the texels that points (n,) read bilinearly, and the means there, by area (t, lanes)."""
    corners = layout.corners.reshape(-1, 2)
    corner_rows = 3 * triangles[:, None] + np.arange(3)
    columns, rows = np.floor(at_corners(corners, corner_rows, barycentric) - 0.5).astype(np.int64).T
    taps = [
        np.clip(rows + down, 0, layout.height - 1) * layout.width
        + np.clip(columns + right, 0, layout.width - 1)
        for down, right in np.ndindex(2, 2)
    ]
    texels, texel_of = np.unique(np.concatenate(taps), return_inverse=True)
    weights = np.tile((areas / np.maximum(np.bincount(triangles, minlength=areas.size), 1))[triangles], 4)
    totals = np.maximum(np.bincount(texel_of, weights), 1e-300)
    lanes = [np.bincount(texel_of, weights * np.tile(lane, 4)) / totals for lane in values.T]
    return texels.astype(np.int32), np.stack(lanes, axis=1).astype(np.float32)


def _bake_gutter(lookups: _TexelLookups, layout: Layout, borders: Borders, maps: MapValues) -> None:
    """Write the channels of gutter texels, as large as the chart's texels, in the plane of their triangle."""
    mesh = lookups.surface
    gutter = gutter_of(borders, layout, mesh.rest, mesh.triangles, lookups.neighbours, lookups.sides)
    texels = gutter.texels
    values, areas = maps.values.reshape(-1, maps.values.shape[2]), maps.areas.reshape(-1)
    rest = mesh.rest_at(gutter.triangles, gutter.barycentric)
    areas[texels] = 1.0
    missed = np.arange(texels.size)
    if lookups.blocks is not None and lookups.supersample == 1:
        starts = np.flatnonzero(np.diff(gutter.triangles, prepend=-1)).astype(np.int32)
        ends = np.append(starts, np.int32(texels.size))
        points = TexelPoints(texels, rest, gutter.barycentric, ends, gutter.triangles[starts])
        ratios = lookups.sizes[gutter.beside] / np.maximum(lookups.sizes[gutter.triangles], 1e-300)
        is_missed = np.abs(ratios - 1.0) > _ALIKE
        is_missed[lookups.blocks.look_up(points, values)] = True
        missed = np.flatnonzero(is_missed)
    if missed.size:
        owners, size = gutter.triangles[missed], lookups.sizes[gutter.beside[missed]]
        normals = lookups.normals[owners]
        dPdx = across(normals) * size[:, None]
        derivatives = dPdx, np.cross(normals, dPdx)
        lookups.write(texels[missed], owners, rest[missed], derivatives, values, areas)
    if lookups.frames is not None:
        ends_of_path = ((gutter.triangles, gutter.barycentric), (gutter.beside, gutter.edges))
        before, after = (unit(lookups.frames.normals.at(*end)) for end in ends_of_path)
        lane = maps.lanes[NORMAL.name]
        directions = rotated(values[texels, lane], before, after)
        values[texels, lane] = in_tangent_space(directions, lookups.frames, gutter.beside, gutter.edges)
