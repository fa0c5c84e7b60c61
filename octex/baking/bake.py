"""Bakes an octree texture to images at the texture coordinates of a surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.baking.blocks import TexelBlocks
from octex.baking.coordinates import cell_of
from octex.baking.directions import in_tangent_space, turned
from octex.baking.gutters import Borders, fill_up, gutter_of
from octex.baking.layout import LAYOUTS, Layout, Layouts, doubled_areas, neighbors, steps_between
from octex.baking.maps import BITS, Bits, Values, alpha_mode, average, inputs_of, lacking
from octex.baking.sheets import Sheet, coordinates_of, sheets_of
from octex.baking.texels import Drawing, Drawn, Shown, texel_points
from octex.channels import ALPHA, MATERIAL_CHANNELS, NORMAL
from octex.checks import as_choice, as_names, as_number, as_whole
from octex.errors import ArgumentError, ModelError
from octex.nearest.triangles import Nearest, Triangles
from octex.parallel import Progress, Run, as_run, ordered_map, sharing, workers
from octex.source.corners import Corners, across, area_vectors, at_corners, unit
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

    Raises ArgumentError for numbers out of range and for channels that the texture or the materials lack,
    ModelError for texture coordinates that cannot be kept, for an atlas without room, and if ``source`` is
    too far away everywhere. (Benson & Davis 2002, 6.3.)
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
    other = None
    if source is None:
        surface = surface.placed_on(texture)
    else:
        other = _Other.of(as_surface(source, "source"), texture, distance)
    with workers(run) as given, sharing(given) as pool:
        run.report("unwrap", 0, 1)
        stored = [name for name in names if name in texture.channels]
        detail = np.inf if other is None or len(stored) == len(names) else other.detail()
        shown = stored or [*texture.channels]
        sheets = sheets_of(texture, surface, shown, uv, texture_size, padding, pool, detail)
        coordinates = coordinates_of(sheets, len(surface.triangles))
        run.report("unwrap", 1, 1)
        job = _Job(texture, surface, other, sheets, coordinates, names, bits, supersample)
        first, rows = 0, sum(sheet.layout.height for sheet in sheets)
        materials: list[Material] = []
        shows_any = False
        owners = np.empty(len(surface.triangles), np.int32)
        for sheet in sheets:
            owners[sheet.triangles] = len(materials) + sheet.owners

            def advance(stage: str, done: int, total: int, before: int = first) -> None:  # noqa: ARG001
                run.report(stage, min(before + done * _BAND, rows), rows)

            made, shows = _bake_sheet(job, sheet, pool, advance)
            materials += made
            shows_any |= shows
            first += sheet.layout.height
    if source is not None and not shows_any:
        raise ModelError(
            f"{source.name} has no surface near {surface.name} that faces the same way; give a larger "
            "max_distance, or another source"
        )
    baked = MaterialSource(
        materials, owners, surface.rest, surface.triangles,
        coordinates=[coordinates], frames=job.frames, name=surface.name,
    )  # fmt: skip
    return Surface(
        surface.vertices, surface.triangles, baked, rest=surface.rest, uv=coordinates,
        frames=job.frames or surface.frames, name=surface.name, provenance=surface.provenance,
    )  # fmt: skip


def _bake_sheet(job: _Job, sheet: Sheet, pool: Executor, progress: Progress) -> tuple[list[Material], bool]:
    """Return the materials of a sheet with its maps, and whether the maps show anything."""
    layout = sheet.layout
    shown = layout._replace(faces=sheet.triangles[layout.faces])
    maps = Values.of(job.names, layout.height, layout.width)
    drawn = np.zeros(maps.areas.shape, np.bool_)
    ends = [*range(0, layout.height, _BAND), layout.height]
    drawing = Drawing.of(shown.sized(job.supersample * layout.width))
    tasks = [(job, drawing, slice(*each), maps, drawn) for each in pairwise(ends)]
    for _ in ordered_map(pool, _bake_band, tasks, stage="bake", progress=progress):
        pass
    is_flat = np.abs(doubled_areas(shown.corners)) <= _FLAT
    if is_flat.any():
        _bake_flat(job, shown.of(is_flat), drawn, maps)
    if layout.padding and not drawn.all():
        charts = shown.of(~is_flat)
        parts = Borders.of(charts, drawn, math.ceil(_REACH * layout.padding)).parts(_GUTTER)
        list(ordered_map(pool, lambda borders: _bake_gutter(job, charts, borders, maps), parts))
    shows_any = bool(maps.areas.any())
    if not maps.areas.all():
        fill_up(maps.values, (maps.areas > 0).astype(np.float32))
    used = layout.uv.values[layout.uv.rows]
    repeats = bool((used < 0.0).any() or (used > 1.0).any())
    part = lacking(job.supersample, _blur(job, shown))
    inputs = inputs_of(maps, job.bits, part, REPEAT if repeats else CLAMP, pool)
    known = sheet.materials
    modes: list[AlphaMode] = ["opaque"] * len(known)
    if ALPHA.name in maps.lanes:
        measured = alpha_mode(maps.channel(ALPHA.name))
        modes = [each.alpha_mode if job.has_modes else measured for each in known]
    made = [
        Material(inputs, mode, name=each.name, double_sided=each.double_sided)
        for each, mode in zip(known, modes, strict=True)
    ]
    return made, shows_any


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


class _Other(NamedTuple):
    """Another surface of the same object, from which the texture was made."""

    surface: Surface  # with the texture's rest positions
    nearest: Triangles  # with the baked surface's rest positions
    normals: Float64s  # (m, 3)   of its triangles, in the texture's space
    shading: Corners  # its shading normals, in the baked surface's space
    distance: float

    @classmethod
    def of(cls, surface: Surface, texture: OctreeTexture, distance: float) -> _Other:
        """Prepare a surface."""
        nearest = Triangles.of(surface.rest, surface.triangles, surface.name)
        if surface.frames is None:
            normals = corner_normals(surface.rest, surface.triangles).reshape(-1, 3)
            shading = Corners(normals, np.arange(len(normals), dtype=np.int32).reshape(-1, 3))
        else:
            shading = surface.frames.normals
        placed = surface.placed_on(texture)
        flat = unit(area_vectors(placed.rest[placed.triangles]))
        return cls(placed, nearest, flat, shading, distance)

    def detail(self) -> float:
        """Return half the edge of a typical triangle: texels this wide hold its shading normals."""
        return float(np.sqrt(2.0 * self.surface.areas().mean()) / 2.0)

    def facing(self, points: Float64s, normals: Float64s, squares: Float64s) -> Nearest:
        """Return the nearest points on the same side of creases; on any side if farther than ``squares``."""
        found = self.nearest.nearest(points, normals, distance=self.distance, least_cosine=_SAME_SIDE)
        far = np.flatnonzero(found.squares > squares)
        if far.size:
            anywhere = self.nearest.nearest(
                points[far], normals[far], distance=self.distance, least_cosine=0.0
            )
            found.triangles[far], found.barycentric[far], found.squares[far] = anywhere
        return found


class _Job:
    """The data that all texels share, and the lookups."""

    def __init__(
        self, texture: OctreeTexture, surface: Surface, other: _Other | None, sheets: list[Sheet],
        coordinates: Corners, names: list[str], bits: int, supersample: int,
    ) -> None:  # fmt: skip
        self.texture, self.surface, self.other, self.names = texture, surface, other, names
        self.bits = bits
        self.supersample = supersample  # lookups along each side of a texel
        self.has_modes = any(each.alpha_mode != "opaque" for sheet in sheets for each in sheet.materials)
        #: (m, 3)   the triangle beyond each side, and the number of the side there
        self.others, self.sides = neighbors(surface)
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
        if other is None:
            self.blocks = TexelBlocks.of(texture, names, self.normals, self.dPdx, self.dPdy)
        self.frames = None
        if NORMAL.name in names:
            normals = None if surface.frames is None else surface.frames.normals
            self.frames = corner_frames(surface.rest, surface.triangles, normals, None, coordinates)

    def sampled(
        self, triangles: Int32s, rest: Float64s, derivatives: tuple[Float64s, Float64s] | None
    ) -> tuple[Float32s, Bools | None]:
        """Return the channels side by side at points of triangles (n,), and which points have any."""
        normals, there = self.normals[triangles], None
        barycentric = np.empty((0, 3))
        if self.other is not None:
            nearest = self.other.facing(rest, normals, self.areas[triangles])
            there = nearest.triangles >= 0
            triangles, barycentric = nearest.triangles[there], nearest.barycentric[there]
            rest = self.other.surface.rest_at(triangles, barycentric)
            normals = self.other.normals[triangles]
            derivatives = derivatives and (derivatives[0][there], derivatives[1][there])
        dPdx, dPdy = derivatives or (None, None)
        names = [name for name in self.names if name in self.texture.channels]
        values = self.texture.sample(rest, names, dPdx=dPdx, dPdy=dPdy, normals=normals, threads=1)
        if len(names) < len(self.names):
            assert self.other is not None
            shading = unit(self.other.shading.at(triangles, barycentric)).astype(np.float32)
            values[NORMAL.name] = shading
        return np.concatenate([values[name] for name in self.names], axis=1), there

    def write(
        self, texels: Int32s, triangles: Int32s, rest: Float64s,
        derivatives: tuple[Float64s, Float64s] | None, values: Float32s, areas: Float32s,
    ) -> None:  # fmt: skip
        """Write the channels at points to texels ``texels`` (n,); texels without any get area 0."""
        found, there = self.sampled(triangles, rest, derivatives)
        if there is not None:
            areas[texels[~there]] = 0.0
            texels = texels[there]
        put_rows(found, texels, values)


def _blur(job: _Job, shown: Layout) -> float:
    """Return the part of a mean's variance in lookups; those up to a leaf wide return the field itself."""
    corners = shown.corners
    areas = np.abs(doubled_areas(corners))
    leaf = job.supersample * cell_of(job.texture)
    blur = 1.0 - np.minimum(leaf / np.maximum(job.sizes[shown.faces], leaf), 1.0) ** 2
    return float((areas * blur).sum() / max(float(areas.sum()), 1e-300))


def _bake_band(task: tuple[_Job, Drawing, slice, Values, Bools]) -> None:
    """Write the channels at the texels of a band of rows, and the covered part of each texel."""
    job, drawing, band, maps, is_drawn = task
    n, lanes = job.supersample, maps.values.shape[2]
    drawn = drawing.rows(n * band.start, n * band.stop)
    is_drawn[band] = (drawn.triangles >= 0).reshape(-1, n, maps.areas.shape[1], n).any(axis=(1, 3))
    values, areas = maps.values[band], maps.areas[band]
    if n == 1:
        areas[:] = drawn.areas
        _bake_drawn(job, drawing.layout, drawn, band.start, maps.lanes, values.reshape(-1, lanes), areas)
        return
    fine = np.zeros((drawn.areas.size, lanes), np.float32)
    _bake_drawn(job, drawing.layout, drawn, n * band.start, maps.lanes, fine, drawn.areas)
    average(fine.reshape(*drawn.areas.shape, lanes), drawn.areas, n, values, areas)
    if NORMAL.name in maps.lanes:
        normals = values[..., maps.lanes[NORMAL.name]]
        normals[:] = unit(normals.reshape(-1, 3).astype(np.float64)).reshape(normals.shape)


def _bake_drawn(
    job: _Job, layout: Layout, drawn: Drawn, first: int, lanes: Mapping[str, slice], values: Float32s,
    areas: Float32s,
) -> None:  # fmt: skip
    """Write the channels of rows from ``first`` on; texels without a value get area 0."""
    surface = job.surface
    shown = texel_points(layout.corners, layout.faces, drawn, first, surface.rest, surface.triangles)
    if not shown.texels.size:
        return
    missed = np.arange(shown.texels.size)
    if job.blocks is not None:
        missed = job.blocks.look_up(shown, values)
    triangles = shown.each()
    if missed.size:
        on, derivatives = triangles[missed], None
        if not job.is_fine[on].all():
            derivatives = job.dPdx[on], job.dPdy[on]
        job.write(shown.texels[missed], on, shown.rest[missed], derivatives, values, areas.reshape(-1))
    if job.frames is not None:
        normals = lanes[NORMAL.name]
        directions = np.take(values[:, normals], shown.texels, axis=0)
        values[shown.texels, normals] = in_tangent_space(directions, job.frames, triangles, shown.barycentric)


def _bake_flat(job: _Job, layout: Layout, is_drawn: Bools, maps: Values) -> None:
    """Write the channels of flat triangles to the texels that they read and no other triangle covers."""
    rows, barycentric = _points_on(layout)
    triangles = layout.faces[rows]
    values, there = job.sampled(triangles, job.surface.rest_at(triangles, barycentric), None)
    if there is not None:
        rows, barycentric, triangles = rows[there], barycentric[there], triangles[there]
    if job.frames is not None:
        normals = maps.lanes[NORMAL.name]
        values[:, normals] = in_tangent_space(values[:, normals], job.frames, triangles, barycentric)
    corners = job.surface.rest[job.surface.triangles[layout.faces]]
    areas = np.linalg.norm(area_vectors(corners), axis=1)
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
    number = np.arange(rows.size) - np.repeat(np.cumsum(counts) - counts, counts)
    # The sequence R2: whole multiples of two powers of the plastic number's inverse.
    root, part = np.sqrt(number * 0.7548776662466927 % 1.0), number * 0.5698402909980532 % 1.0
    return rows, np.stack([1.0 - root, root * (1.0 - part), root * part], axis=1)


def _means_at_texels(
    layout: Layout, triangles: Int64s, barycentric: Float64s, values: Float32s, areas: Float64s
) -> tuple[Int32s, Float32s]:
    """Return the texels that points (n,) read bilinearly, and the means there, by area (t, lanes)."""
    corners = layout.corners.reshape(-1, 2)
    rows = 3 * triangles[:, None] + np.arange(3)
    columns, lines = np.floor(at_corners(corners, rows, barycentric) - 0.5).astype(np.int64).T
    read = [
        np.clip(lines + down, 0, layout.height - 1) * layout.width
        + np.clip(columns + right, 0, layout.width - 1)
        for down, right in np.ndindex(2, 2)
    ]
    texels, which = np.unique(np.concatenate(read), return_inverse=True)
    weights = np.tile((areas / np.maximum(np.bincount(triangles, minlength=areas.size), 1))[triangles], 4)
    totals = np.maximum(np.bincount(which, weights), 1e-300)
    lanes = [np.bincount(which, weights * np.tile(lane, 4)) / totals for lane in values.T]
    return texels.astype(np.int32), np.stack(lanes, axis=1).astype(np.float32)


def _bake_gutter(job: _Job, layout: Layout, borders: Borders, maps: Values) -> None:
    """Write the channels of gutter texels, as large as the chart's texels, in the plane of their triangle."""
    mesh = job.surface
    gutter = gutter_of(borders, layout, mesh.rest, mesh.triangles, job.others, job.sides)
    texels = gutter.texels
    values, areas = maps.values.reshape(-1, maps.values.shape[2]), maps.areas.reshape(-1)
    rest = mesh.rest_at(gutter.triangles, gutter.barycentric)
    areas[texels] = 1.0
    left = np.arange(texels.size)
    if job.blocks is not None and job.supersample == 1:
        starts = np.flatnonzero(np.diff(gutter.triangles, prepend=-1)).astype(np.int32)
        ends = np.append(starts, np.int32(texels.size))
        shown = Shown(texels, rest, gutter.barycentric, ends, gutter.triangles[starts])
        sizes = job.sizes[gutter.beside] / np.maximum(job.sizes[gutter.triangles], 1e-300)
        is_unlike = np.abs(sizes - 1.0) > _ALIKE
        is_unlike[job.blocks.look_up(shown, values)] = True
        left = np.flatnonzero(is_unlike)
    if left.size:
        on, size = gutter.triangles[left], job.sizes[gutter.beside[left]]
        wide = across(job.normals[on]) * size[:, None]
        job.write(texels[left], on, rest[left], (wide, np.cross(job.normals[on], wide)), values, areas)
    if job.frames is not None:
        both = ((gutter.triangles, gutter.barycentric), (gutter.beside, gutter.edges))
        shading = [unit(job.frames.normals.at(*each)) for each in both]
        normals = maps.lanes[NORMAL.name]
        directions = turned(values[texels, normals], *shading)
        values[texels, normals] = in_tangent_space(directions, job.frames, gutter.beside, gutter.edges)
