"""Painting: images, cameras and a surface in; the texture with their paint out (paper 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple
from itertools import groupby
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s
from octex.cameras.camera import Camera
from octex.channels import ALPHA, CHANNELS, ChannelFormat, color_in_light
from octex.checks import as_choice, as_flag, as_reals
from octex.conversion.large import Stages, stages_in
from octex.editing.draft import Change
from octex.errors import ArgumentError
from octex.painting.first import FILLS, Fill, started, with_coverage
from octex.painting.image import Projection, check_projections, content_of, room_for
from octex.painting.layer import CELLS, FINEST_CELLS, PaintSource, wanted_depths
from octex.painting.merge import Merging, merged
from octex.painting.project import AROUND, in_fixed_order, take_shots
from octex.painting.reading import Shot
from octex.painting.steps import Raster, layer_from, rasterize_surface
from octex.painting.surface import (
    Balance,
    Job,
    PaintedSurface,
    PaintOptions,
    Pictures,
    key_of,
    laid_flat,
    terms_of,
)
from octex.parallel import Progress, Run, as_run, workers
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.tree.placement import Placement

#: Contents of a new texture where no image sees the surface: cells or none, or a value of the channel.
Holes: TypeAlias = Fill | npt.ArrayLike

#: Deepest level without ``max_depth``: cells of a 16,000th of the model.
_DEEPEST = 14
#: Pixels from the centre to the end of the footprint of cells half a pixel wide.
_REACH = 4


def paint(
    texture: OctreeTexture | None,
    surface: Surface,
    projections: Projection | Sequence[Projection],
    *,
    channel: str = "base_color",
    max_depth: int | None = None,
    max_angle: float | None = None,
    edge_feather: float = 0.0,
    pictures: Pictures | None = None,
    balance: Balance | None = None,
    reference: int | None = None,
    back_faces: bool = False,
    hidden: bool = False,
    region: npt.ArrayLike | None = None,
    holes: Holes = "smooth",
    coverage: bool = False,
    fit: bool = True,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Paint images through their cameras onto a surface, and return the painted texture.

    texture       the texture to paint on; it does not change. None begins a new one
    surface       the model: cameras see its posed positions, paint lands at its rest positions
    projections   images with cameras. Consecutive ones with the same blend mode form one layer: each cell
                  averages them (square roots of light), and is blended once; pixels more than twice as wide
                  as cells, and as the finest pixel there, count for less
    channel       the channel to paint
    max_depth     cells are a quarter to half a pixel wide, but no finer than this level: paint can be finer
                  than by default. Default: half a pixel to one pixel, no finer than level 14
    max_angle     degrees between the surface's normal and the direction to the camera beyond which nothing is
                  painted; paint fades over the last 10. Default: 75; 85 if every image was drawn on a view
    edge_feather  pixels over which paint fades toward the image's border and toward edges in depth
    pictures      how images combine: "average"; "robust" leaves out what only one of at least three shows;
                  "best" takes one image per patch (Lempitsky & Ivanov 2007). Default: "robust" for three or
                  more
    balance       "gain" multiplies images so that they agree; "full" does so for each component, and
                  removes vignetting. Overexposed pixels are ignored where a darker exposure exists
    reference     number of the image that ``balance`` does not change. Default: the median gain is 1
    back_faces    also paint surface that faces away
    hidden        also paint surface that other surface hides from the camera
    region        triangles to paint, as numbers or one bool each; others still hide. Default: all
    holes         how to fill unseen surface of a new texture: "smooth" (default) continues the colours
                  harmonically; "leave" stores no cells; a colour as in ``octex.fill`` is stored there
    coverage      also store the part of each cell that images cover, 0 … 1, as channel "coverage"
    fit           choose leaf values so that lookups match the images; False stores plain averages
    run           how to work (octex.Run)

    By default only surface that the camera sees is painted: not hidden, and not facing away. Where nothing
    is painted the texture itself is returned.

    Raises ArgumentError for a channel that the texture does not have, a surface outside of its root cell,
    numbers out of range, a region that is no triangles, hidden with images that must be compared, and
    images that do not fit their cameras; ImageError for files that are no images. (Benson & Davis 2002,
    4.1 and 4.2.)
    """
    run = as_run(run, threads, progress, "memory", "folder", "resume")
    options = PaintOptions(
        channel, max_depth, max_angle, edge_feather, pictures, balance, reference, back_faces, fit, hidden,
        region,
    )  # fmt: skip
    return painted_by(texture, surface, projections, options, run, holes, coverage=coverage)


def painted_by(
    texture: OctreeTexture | None,
    surface: Surface,
    projections: Projection | Sequence[Projection],
    options: PaintOptions,
    run: Run,
    holes: Holes = "smooth",
    *,
    coverage: bool = False,
    layers: list[OctreeTexture] | None = None,
) -> OctreeTexture:
    """Paint as `paint` does; the layers of paint are appended to ``layers``."""
    as_surface(surface)
    fill = fill_of(holes, format_of(texture, options.channel))
    is_covered, images = as_flag(coverage, "coverage"), check_projections(projections)
    if is_covered and layers is None:
        layers = []
    model = PaintedSurface(surface if texture is None else surface.placed_in(as_texture(texture)))
    with workers(run) as pool, room_for(images, run):
        job = Job(model, pool, run.report, stages_in(run.resume))
        for painted_texture, _ in painted(job, texture, images, options, fill, layers):
            texture = painted_texture
    assert texture is not None
    return with_coverage(texture, layers) if is_covered and layers else texture


def painted(
    job: Job,
    texture: OctreeTexture | None,
    projections: list[Projection],
    options: PaintOptions,
    fill: Fill | Float32s = "smooth",
    layers: list[OctreeTexture] | None = None,
    merge: Merging = merged,
    put: Callable[[Change, OctreeTexture], OctreeTexture] = Change.put_into,
) -> Iterator[tuple[OctreeTexture, Change | None]]:
    """Paint; yield the texture with each layer, and the change. Layers are appended to ``layers``."""
    job, projections = laid_flat(job, projections, texture)
    for blend, group in groupby(projections, key=lambda projection: projection.blend):
        images = list(group)
        layer = layer_of(job, images, texture, options)
        opacity = max(image.opacity for image in images)
        if layers is not None:
            layers.append(layer)
        if texture is None:
            texture, is_in = started(job, layer, fill, blend)
            if is_in:
                yield texture, None
                continue
        change = merge(job, texture, layer, opacity, blend)
        texture = texture if change is None else put(change, texture)
        yield texture, change


def project(
    surface: Surface,
    projections: Projection | Sequence[Projection],
    *,
    like: OctreeTexture | None = None,
    channel: str = "base_color",
    max_depth: int | None = None,
    max_angle: float | None = None,
    edge_feather: float = 0.0,
    pictures: Pictures | None = None,
    balance: Balance | None = None,
    reference: int | None = None,
    back_faces: bool = False,
    hidden: bool = False,
    region: npt.ArrayLike | None = None,
    fit: bool = True,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Project images onto a surface, and return the paint as a layer for ``octex.merge``.

    A layer is a texture with the painted channel and ``alpha``, the coverage of each cell. Its opacities are
    relative to the largest one; ``merge`` applies opacity and blend mode. ``like`` is the
    texture that the layer will be merged into, or None for a new one. All other arguments are those of
    ``paint``.
    """
    run = as_run(run, threads, progress, "memory", "folder", "resume")
    as_surface(surface)
    options = PaintOptions(
        channel, max_depth, max_angle, edge_feather, pictures, balance, reference, back_faces, fit, hidden,
        region,
    )  # fmt: skip
    images = check_projections(projections)
    model = PaintedSurface(surface if like is None else surface.placed_in(like))
    with workers(run) as pool, room_for(images, run):
        job, images = laid_flat(Job(model, pool, run.report, stages_in(run.resume)), images, like)
        return layer_of(job, images, like, options)


def layer_of(
    job: Job, images: Sequence[Projection], like: OctreeTexture | None, options: PaintOptions
) -> OctreeTexture:
    """Project images of one layer as `project` does, or return the stored layer."""
    options = options.of(images)
    form = format_of(like, options.channel)
    largest = max(each.opacity for each in images) or 1.0
    scales = [each.opacity / largest for each in images]

    def parts() -> list[Any]:
        cameras = [key_of(cast(Camera, each.camera)) for each in images]
        shown = [*zip(map(content_of, images), cameras, scales, strict=True)]
        return [job.surface.content, like and like.placement, form, shown, *astuple(options)]

    stages = job.stages.of(parts)
    return stages.texture(
        "layer", lambda: layer_from(job, _raster_of(job, images, scales, like, form, options, stages))
    )


def _raster_of(
    job: Job,
    images: Sequence[Projection],
    scales: Sequence[float],
    like: OctreeTexture | None,
    form: ChannelFormat,
    options: PaintOptions,
    stages: Stages,
) -> Raster:
    """Project images; ``stages`` are those of all these images.

    ``scales`` multiply their alpha.
    """
    surface = job.surface.surface
    is_single = len(images) == 1
    around = AROUND if is_single and options.edge_feather < AROUND else None
    shots = _shots_of(job, form, images, scales, options, around)
    reference = None if options.reference is None else shots[options.reference]
    if not is_single:
        shots = in_fixed_order(shots)
    angle = cast(float, options.max_angle)
    terms = terms_of(angle, options.edge_feather, options.back_faces, options.hidden)
    source = job.surface.projected(shots, form, terms, options.region)
    cropped = source.near_paint(_REACH)
    size = float(np.ptp(surface.bounds, axis=0).max()) if like is None else like.placement.size
    cells, most = CELLS, _DEEPEST
    if options.max_depth is not None:
        cells, most = FINEST_CELLS, options.max_depth
    footprints = cropped.footprints()
    if not np.isfinite(footprints[0]).any():  # all visible surface faces away
        nowhere = Placement.around(surface.bounds, 0) if like is None else like.placement
        return Raster(tuple(source.channels), nowhere, surface.bounds, None)
    finest = wanted_depths(*footprints, size, FINEST_CELLS, is_single=is_single).deepest
    depths = wanted_depths(*footprints, size, cells, most, is_single=is_single)
    depth = depths.deepest
    # Footprints of larger cells reach farther.
    reach = _REACH << max(finest - depth, 0)
    if around is not None and reach > around:
        source = source.with_shots(_shots_of(job, form, images, scales, options, None))
    source = cropped if finest <= depth else source.near_paint(reach)
    placement = Placement.around(surface.bounds, depth) if like is None else like.placement
    if like is not None:
        check_inside(surface, placement)
    paint: PaintSource = source
    number = None if reference is None else [shot is reference for shot in shots].index(True)
    del shots, cropped, reference  # they hold copies of the visible surface
    if not is_single:
        from octex.photos.weigh import weighed  # a single image does not load it

        paint = weighed(source, surface, options, number, placement, depth, job.executor, stages)
    return rasterize_surface(job, paint, placement, depths, fit=options.fit, cells=cells)


def _shots_of(
    job: Job,
    form: ChannelFormat,
    images: Sequence[Projection],
    scales: Sequence[float],
    options: PaintOptions,
    around: int | None,
) -> list[Shot]:
    """Return the shots of images, or their parts within ``around`` pixels of paint."""
    cameras = [cast(Camera, each.camera) for each in images]
    sights = job.surface.sights(
        cameras, options.edge_feather, job.executor, job.stages, hidden=options.hidden
    )
    shots = []
    job.progress("look", 0, len(images))
    for shot in take_shots(images, form, scales, sights, job.executor, around=around, stages=job.stages):
        shots.append(shot)
        job.progress("look", len(shots), len(images))
    return shots


def check_inside(surface: Surface, placement: Placement) -> None:
    """Raise ArgumentError for a surface that exceeds a root cell."""
    low, high = placement.to_texture_space(surface.bounds)
    if (low < 0).any() or (high > 1).any():
        raise ArgumentError(
            f"{surface.name} at rest reaches from {surface.bounds[0].round(6).tolist()} to "
            f"{surface.bounds[1].round(6).tolist()}, out of the texture's root cell at {placement.origin} of "
            f"size {placement.size:g}: the texture belongs to another model, or to other rest positions"
        )


def format_of(texture: OctreeTexture | None, channel: str) -> ChannelFormat:
    """Return the format of a channel, in a texture or in a new one."""
    if texture is not None:
        as_choice(channel, as_texture(texture).channels, "channel of the texture")
        form = texture.channels[channel].format
    else:
        form = CHANNELS[as_choice(channel, CHANNELS, "channel")]
    if channel == ALPHA.name:
        raise ArgumentError('alpha is painted with blend="erase", or as the alpha of images')
    if form.components > 3:
        raise ArgumentError(f"channel {channel!r} has {form.components} components; images have three")
    return form


def value_of(color: npt.ArrayLike | str, form: ChannelFormat) -> Float32s:
    """Return a colour as a channel's values (components,), or raise ArgumentError."""
    if isinstance(color, str):
        return color_in_light(color, form)
    shapes = [(form.components,), *([()] if form.components == 1 else [])]
    most = float(np.finfo(np.float32).max)
    value = np.atleast_1d(as_reals(color, f"color of {form.name!r}", *shapes, most=most))
    least = -1.0 if form.space == "direction" else 0.0
    if form.dtype.startswith("u") and not ((value >= least) & (value <= 1.0)).all():
        example = ', or write "#rrggbb"' if form.space == "srgb" else ""
        raise ArgumentError(
            f"color of {form.name!r} must be from {least:g} to 1, not {color!r}; divide numbers up to 255 by "
            f"255{example}"
        )
    return value.astype(np.float32)


def fill_of(holes: Holes, form: ChannelFormat) -> Fill | Float32s:
    """Return how to fill unseen surface, checked; a colour as a channel's values (components,)."""
    if isinstance(holes, str) and not holes.startswith("#"):
        return cast(Fill, as_choice(holes, FILLS, "holes"))
    return value_of(holes, form)
