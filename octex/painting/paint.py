"""Painting: pictures, cameras and a surface in; the texture with their paint out (paper 4)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import groupby
from typing import Literal, NamedTuple, TypedDict, cast, get_args

import numpy as np

from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ChannelFormat
from octex.checks import as_choice, as_depth, as_flag, as_number, as_whole
from octex.editing.draft import Change
from octex.errors import ArgumentError
from octex.painting.holes import HOLES, Holes, begun, with_coverage
from octex.painting.layer import CELLS, FINEST_CELLS, rasterize_paint, wanted_levels
from octex.painting.merge import merged
from octex.painting.picture import Projection, check_projections, content_of, room_for
from octex.painting.project import Projected, terms_of
from octex.painting.resume import Kept, kept_in
from octex.painting.sight import AROUND, Shot, in_fixed_order, take_shots
from octex.painting.source import PaintSource
from octex.painting.surface import Ground, key_of, laid_flat
from octex.parallel import Progress, as_progress, workers
from octex.photos.agreement import agreeing
from octex.photos.balance import BALANCES, Balance, balanced
from octex.photos.best import best
from octex.photos.overexposed import without_overexposed
from octex.photos.sharpness import weighed_by_sharpness
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.tree.placement import Placement
from octex.view.camera import Camera

#: What becomes of several pictures that see a place.
Pictures = Literal["average", "best", "robust"]
PICTURES: tuple[Pictures, ...] = get_args(Pictures)

#: Degrees from which on there is no paint: photographs blur what is seen so flatly, drawings do not.
TAKEN_ANGLE, DRAWN_ANGLE = 75.0, 85.0
#: Pictures get no deeper than this on their own: cells of a 16,000th of the model.
_DEEPEST = 14
#: Cells of half a pixel are painted by pixels so far from them at most.
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
    holes: Holes | None = None,
    coverage: bool = False,
    fit: bool = True,
    memory: int | str | None = None,
    folder: str | os.PathLike[str] | None = None,
    resume: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Paint pictures through their cameras onto a surface, and return the painted texture.

    texture       the texture to paint on; it does not change. None begins a new one
    surface       the model: cameras see its posed positions, paint lands at its rest positions
    projections   pictures with cameras. Consecutive ones with the same blend mode form one layer: each cell
                  averages them, weighted by the fourth power of their resolution, and is blended once
    channel       the channel to paint
    max_depth     the deepest level of paint. Default: cells half as wide to as wide as a pixel, at most level
                  14
    max_angle     degrees between the surface's normal and the direction to the camera beyond which nothing is
                  painted; paint fades over the last 10. Default: 75; 85 if every picture was drawn on a view
    edge_feather  pixels over which paint fades toward the picture's border and toward edges in depth
    pictures      how pictures combine: "average"; "robust" leaves out what only one of at least three shows;
                  "best" takes one picture per patch (Lempitsky & Ivanov 2007). Default: "robust" for three or
                  more
    balance       "gain" multiplies pictures so that they agree; "full" does so for each component, and
                  removes vignetting. Overexposed pixels are ignored where another picture is darker
    reference     number of the picture that ``balance`` does not change. Default: the median gain is 1
    back_faces    also paint surface that faces away
    holes         what a new texture has where no picture sees: "smooth" (default) continues the colours
                  harmonically over the surface; "leave" stores no cells
    coverage      also store how much of each cell the pictures cover, 0 … 1, as channel "coverage"
    fit           choose leaf values so that lookups match the pictures; False stores plain averages
    memory        bytes, or a text like "4GB": keep what exceeds it in files of ``folder``. Pictures take 64
                  bytes a pixel, merging some 700 MB
    folder        for these files (default: the folder of temporary files)
    resume        a folder that stores finished stages. A later call with the same folder reuses what has not
                  changed. It holds 41 bytes a pixel; you may delete it
    threads, executor   who works in parallel: a number of threads, or a concurrent.futures.Executor
    progress      called with a stage's name, the units done and the units in all

    Only surface that the camera sees is painted: not hidden, and not facing away. Neither ``memory``,
    ``resume`` nor the workers change the result. Where nothing is painted the texture itself is returned.

    Raises ArgumentError for a channel that the texture does not have, a surface outside of its root cell,
    numbers out of range and pictures that do not fit their cameras; ImageError for files that are no
    pictures. (Benson & Davis 2002, 4.1 and 4.2.)
    """
    as_surface(surface)
    ground = Ground(surface if texture is None else surface.placed_in(as_texture(texture)))
    options: Options = {
        "channel": channel, "max_depth": max_depth, "max_angle": max_angle, "edge_feather": edge_feather,
        "pictures": pictures, "balance": balance, "reference": reference, "back_faces": back_faces,
        "fit": fit,
    }  # fmt: skip
    if holes is not None:
        as_choice(holes, HOLES, "holes")
    layers: list[OctreeTexture] | None = [] if as_flag(coverage, "coverage") else None
    given = check_projections(projections)
    with workers(threads, executor) as pool, room_for(given, memory, folder):
        steps = painted(
            texture, ground, given, pool, as_progress(progress), options, holes, layers, kept_in(resume)
        )
        for made, _ in steps:
            texture = made
    assert texture is not None
    return with_coverage(texture, layers) if layers else texture


class Options(TypedDict, total=False):
    """What `paint` and `project` may be told; see there."""

    channel: str
    max_depth: int | None
    max_angle: float | None
    edge_feather: float
    pictures: Pictures | None
    balance: Balance | None
    reference: int | None
    back_faces: bool
    fit: bool


def painted(
    texture: OctreeTexture | None,
    ground: Ground,
    projections: Projection | Sequence[Projection],
    executor: Executor,
    progress: Progress,
    options: Options,
    holes: Holes | None = None,
    layers: list[OctreeTexture] | None = None,
    kept: Kept | None = None,
) -> Iterator[tuple[OctreeTexture, Change | None]]:
    """Paint as `paint` does; yield what has become of the texture with each layer, and what has changed.

    The layers are appended to ``layers`` if that is given.
    """
    ground, given = laid_flat(ground, check_projections(projections), texture)
    for blend, group in groupby(given, key=lambda projection: projection.blend):
        pictures = list(group)
        opacity = max(picture.opacity for picture in pictures)
        layer = projected(ground, pictures, texture, executor, progress, options, kept)
        if texture is None:
            texture = begun(layer, ground.surface, holes or "smooth", executor, progress)
            blend = "erase" if blend == "erase" else "over"  # there is nothing to multiply
        if layers is not None:
            layers.append(layer)
        change = merged(
            texture, layer, ground, opacity=opacity, blend=blend, executor=executor, progress=progress
        )
        texture = texture if change is None else change.put_into(texture)
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
    fit: bool = True,
    memory: int | str | None = None,
    folder: str | os.PathLike[str] | None = None,
    resume: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Project pictures onto a surface, and return the paint as a layer for ``octex.merge``.

    A layer is a texture with the painted channel and ``alpha``, how much of each cell the paint covers. It
    stores opacities relative to the largest one; ``merge`` applies opacity and blend mode. ``like`` is the
    texture that the layer will be merged into, or None for a new one. All other arguments are those of
    ``paint``.
    """
    as_surface(surface)
    given = check_projections(projections)
    options: Options = {
        "channel": channel, "max_depth": max_depth, "max_angle": max_angle, "edge_feather": edge_feather,
        "pictures": pictures, "balance": balance, "reference": reference, "back_faces": back_faces,
        "fit": fit,
    }  # fmt: skip
    ground, given = laid_flat(Ground(surface if like is None else surface.placed_in(like)), given, like)
    with workers(threads, executor) as pool, room_for(given, memory, folder):
        return projected(ground, given, like, pool, as_progress(progress), options, kept_in(resume))


def projected(
    ground: Ground,
    given: Sequence[Projection],
    like: OctreeTexture | None,
    executor: Executor,
    report: Progress,
    options: Options,
    kept: Kept | None = None,
) -> OctreeTexture:
    """Project pictures as `project` does, onto a surface that was prepared."""
    wanted = _checked(_Wanted(**options), given)
    form = format_of(like, wanted.channel)
    task = ground, given, like, form, wanted, executor, report
    if kept is None:
        return _projected(*task)
    shown = [(content_of(each), key_of(cast(Camera, each.camera)), each.opacity) for each in given]
    own = kept.of(ground.content, like and like.placement, form, shown, *wanted)
    return own.texture("layer", partial(_projected, *task, kept, own))


class _Wanted(NamedTuple):
    """What is asked of paint, as `paint` takes it; once checked ``max_angle`` is a number."""

    channel: str = BASE_COLOR.name
    max_depth: int | None = None
    max_angle: float | None = None
    edge_feather: float = 0.0
    pictures: Pictures | None = None
    balance: Balance | None = None
    reference: int | None = None
    back_faces: bool = False
    fit: bool = True


def _checked(wanted: _Wanted, given: Sequence[Projection]) -> _Wanted:
    """Return what is asked of paint by these pictures, in range."""
    _, max_depth, max_angle, edge_feather, pictures, balance, reference, back_faces, fit = wanted
    usual = DRAWN_ANGLE if all(each.since is not None for each in given) else TAKEN_ANGLE
    return wanted._replace(
        max_depth=None if max_depth is None else as_depth(max_depth, "max_depth"),
        max_angle=as_number(usual if max_angle is None else max_angle, "max_angle", 0.0, 180.0),
        edge_feather=as_number(edge_feather, "edge_feather", 0.0, 1e6),
        pictures=None if pictures is None else as_choice(pictures, PICTURES, "pictures"),
        balance=None if balance is None else as_choice(balance, BALANCES, "balance"),
        reference=None if reference is None else as_whole(reference, "reference", 0, len(given) - 1),
        back_faces=as_flag(back_faces, "back_faces"),
        fit=as_flag(fit, "fit"),
    )


def _projected(
    ground: Ground,
    given: Sequence[Projection],
    like: OctreeTexture | None,
    form: ChannelFormat,
    wanted: _Wanted,
    executor: Executor,
    report: Progress,
    kept: Kept | None = None,
    own: Kept | None = None,
) -> OctreeTexture:
    """Project pictures; ``own`` is what is ``kept`` of them all."""
    surface, pictures, balance, reference = ground.surface, wanted.pictures, wanted.balance, wanted.reference
    deepest = _DEEPEST if wanted.max_depth is None else wanted.max_depth
    terms = terms_of(cast(float, wanted.max_angle), wanted.edge_feather, wanted.back_faces)
    largest = max(projection.opacity for projection in given) or 1.0
    report("look", 0, len(given))
    scales = [projection.opacity / largest for projection in given]
    is_alone = len(given) == 1
    around = AROUND if is_alone and wanted.edge_feather < AROUND else None
    taken = partial(_taken, ground, given, form, scales, wanted.edge_feather, executor, report, kept)
    shots = taken(around)
    chosen = None if reference is None else shots[reference]
    shots = in_fixed_order(shots)
    mesh = surface.vertices, surface.triangles
    source = Projected(shots, form, terms, *mesh, ground.stretches, shading=ground.shading)
    extent = float(np.ptp(surface.bounds, axis=0).max())
    size = like.placement.size if like is not None else extent
    cells = CELLS if wanted.max_depth is None else FINEST_CELLS
    near = source.near_paint(_REACH)
    footprints = near.footprints()
    finest = wanted_levels(*footprints, size, FINEST_CELLS, is_alone=is_alone).deepest
    depths = wanted_levels(*footprints, size, cells, deepest, is_alone=is_alone)
    depth = depths.deepest
    # Larger cells look farther around: by as many pixels as they are wide, and those of the level read.
    reach = _REACH << max(finest - depth, 0)
    if around is not None and reach > around:
        source = source.with_shots(taken(None))
    source = near if finest <= depth else source.near_paint(reach)
    placement = Placement.around(surface.bounds, depth) if like is None else like.placement
    if like is not None:
        check_inside(surface, placement)
    number = next((number for number, shot in enumerate(shots) if shot is chosen), None)
    if balance is not None and len(shots) > 1:
        evened = balanced(source, surface, balance, number, executor)
        source = without_overexposed(source, evened, executor)
    if pictures in ("robust", "best") or (pictures is None and len(shots) > 2):
        source = agreeing(source, executor, own)
        if balance is not None and len(shots) > 1:  # again, without what only one of them saw
            source = balanced(source, surface, balance, number, executor)
    source = weighed_by_sharpness(source, surface)
    paint: PaintSource = source
    if pictures == "best" and len(shots) > 1:
        paint = best(source, surface, placement, depth, executor)
    return rasterize_paint(
        ground, paint, placement, depths, fit=wanted.fit, cells=cells, executor=executor, progress=report
    )


def _taken(
    ground: Ground,
    given: Sequence[Projection],
    form: ChannelFormat,
    scales: Sequence[float],
    feather: float,
    executor: Executor,
    report: Progress,
    kept: Kept | None,
    around: int | None,
) -> list[Shot]:
    """Return pictures and what their cameras see, or of that what is within ``around`` pixels of paint."""
    sights = ground.sights([cast(Camera, each.camera) for each in given], feather, executor, kept)
    shots = []
    for shot in take_shots(given, form, scales, sights, executor, around=around, kept=kept):
        shots.append(shot)
        report("look", len(shots), len(given))
    return shots


def format_of(texture: OctreeTexture | None, channel: str) -> ChannelFormat:
    """Return how a channel is stored, in a texture or in a new one."""
    if texture is not None:
        as_texture(texture)
        as_choice(channel, texture.channels, "channel of the texture")
        form = texture.channels[channel].format
    else:
        form = CHANNELS[as_choice(channel, CHANNELS, "channel")]
    if channel == ALPHA.name:
        raise ArgumentError('alpha is painted with blend="erase", or as the alpha of pictures')
    if form.components > 3:
        raise ArgumentError(f"channel {channel!r} has {form.components} components; pictures have three")
    return form


def check_inside(surface: Surface, placement: Placement) -> None:
    """Raise ArgumentError for a surface that reaches out of a root cell."""
    low, high = placement.to_texture_space(surface.bounds)
    if (low < 0).any() or (high > 1).any():
        raise ArgumentError(
            f"{surface.name} at rest reaches from {surface.bounds[0].round(6).tolist()} to "
            f"{surface.bounds[1].round(6).tolist()}, out of the texture's root cell at {placement.origin} of "
            f"size {placement.size:g}: the texture belongs to another model, or to other rest positions"
        )
