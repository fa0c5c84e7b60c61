"""The main job: a textured model in, an octree texture out."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ChannelFormat
from octex.checks import (
    as_depth,
    as_entries,
    as_flag,
    as_memory,
    as_names,
    as_number,
    as_path,
    as_positive,
    is_path,
    is_several,
)
from octex.conversion import large
from octex.conversion.adapt import adapted, as_max_error
from octex.conversion.detail import STRETCH, DetailFunction, Wanted, wanted_levels
from octex.conversion.levels import assemble, cell_levels, memory_needed, without_opaque
from octex.conversion.points import convert_points, convert_voxels
from octex.editing.split import refaced
from octex.errors import ArgumentError, ModelError, OutputError
from octex.parallel import Progress, Run, as_run, folder_of, shares_memory, workers
from octex.source.cloud import PointCloud, is_cloud
from octex.source.load import at_rest, load_surface
from octex.source.parts import Overlaps
from octex.source.surface import Surface, as_surface
from octex.source.voxels import Voxels, is_voxels
from octex.texture import Channel, OctreeTexture, open_texture
from octex.texture.channel import Dtypes, formats_as
from octex.texture.file import ENDING
from octex.tree.placement import Placement

DEFAULT_DEPTH = 10
#: Parts this many cells apart share none, and no lookup at the finest level reads both: the widest filter
#: reads two cells to each side.
CELLS_APART = 3.0
_RANGE_APART = (1.0, 1e6)
# Surfaces n cells apart along no axis may be √3 times as far from each other.
_DIAGONAL = math.sqrt(3.0)
# With a margin of this many times the surface's extent, cells grow as fast as the margin.
_LARGEST_MARGIN = 4.0
#: A conversion's peak memory, as a multiple of `memory_needed`: 3 to 6 were measured.
_PEAK = 6


def convert(
    model: str
    | os.PathLike[str]
    | Surface
    | PointCloud
    | Voxels
    | Sequence[str | os.PathLike[str] | Surface],
    depth: int | None = None,
    *,
    cell: float | None = None,
    rest: str | os.PathLike[str] | npt.ArrayLike | None = None,
    channels: Sequence[str] | None = None,
    sources: Mapping[str, object] | None = None,
    dtype: Dtypes = None,
    filter: str | None = None,
    fit: bool = True,
    max_error: float | None = None,
    detail: DetailFunction | str | None = None,
    separate: float | bool | None = None,
    path: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> OctreeTexture:
    """Convert a model into an octree texture.

    model      a model file or a Surface; several of them, which share the texture; or a PointCloud, Voxels,
               or a file of these
    depth      levels below the root, 0 to 21: the finest cells are 2⁻ᵈᵉᵖᵗʰ as wide as the root cell (default
               10)
    cell       width of the finest cells in the model's units, instead of ``depth``
    rest       rest positions, as for ``load_surface``
    channels   names of the channels to convert (default: all that the model has)
    sources    replacements for channels, as for ``Surface.with_sources``
    dtype      stored type: "uint8", "uint16", "float16" or "float32", one for all or a dict by channel.
               Default: uint8, and float16 for light above 1. Floats store linear light
    filter     of images over cells: "nearest", "bilinear", "bicubic", "trilinear" or "ewa" (default)
    fit        choose leaf values so that "quadratic" lookups match the source; False stores plain averages
    max_error  merge leaves while no lookup changes by more than this many 1/255 of the encoded range
    detail     local depth: a function of rest positions (n, 3) that returns depths (n,); the name of a
               one-component channel, where 1 means full depth and 1/2 one level less; or "stretch", which
               evens out the resolution of the posed surface
    separate   move parts apart at rest that come nearer than this many finest cells (True: 3). Lookups then
               take ``Surface.rest_positions``
    path       save the texture here as NAME.octex, and return it memory-mapped
    run        how to work (octex.Run). With ``path``, an executor's workers exchange files next to it

    A leaf is stored for exactly the cells that the surface meets at rest. A node stores the average of the
    source over the surface inside it, weighted by area and alpha, in linear light (Benson & Davis 2002, 3.1,
    3.5 and 5). Directions average as vectors. A cell in which front and back differ by more than 1/255 of the
    encoded range stores a value for each facing.

    PointCloud accepts only ``depth``, ``cell``, ``channels``, ``dtype`` and ``progress``; Voxels neither
    ``depth`` nor ``cell``.

    Raises ModelError and ImageError for a model that cannot be used, OutputError if ``path`` cannot be
    written, and ArgumentError for any other argument out of range.
    """
    run = as_run(run, threads, progress, "memory", "folder")
    report = run.report
    target = None if path is None else _as_target(path)
    if run.memory is not None and target is None:
        raise ArgumentError("memory needs a path: where the texture is written, NAME.octex")
    most = None if max_error is None else as_max_error(max_error)
    depth, cell = as_fineness(depth, cell)
    fit = as_flag(fit, "fit")
    if isinstance(separate, (bool, np.bool_)):
        separate = CELLS_APART if separate else None
    margin = None if separate is None else as_number(separate, "separate", *_RANGE_APART)
    if is_path(model):
        path_of_model = as_path(model, "model")
        if is_voxels(path_of_model):
            model = Voxels.load(path_of_model)
        elif is_cloud(path_of_model):
            model = PointCloud.load(path_of_model)
    if isinstance(model, (PointCloud, Voxels)):
        options = {
            "rest": rest, "sources": sources, "filter": filter, "max_error": most, "detail": detail,
            "separate": margin, "threads": run.threads, "executor": run.executor,
            "fit": None if fit else fit, "memory": run.memory, "path": path,
        }  # fmt: skip
        for name, option in options.items():
            if option is not None:
                raise ArgumentError(f"{name} needs a surface, which {model.name} is not; leave it out")
        if isinstance(model, PointCloud):
            return convert_points(model, depth, cell=cell, channels=channels, dtype=dtype, report=report)
        if depth is not None or cell is not None:
            raise ArgumentError(f"{model.name}: voxels have their own depth; leave depth and cell out")
        return convert_voxels(model, channels=channels, dtype=dtype, report=report)
    names = None if channels is None else as_names(channels, "channels")
    read = with_detail(names, detail)
    whole = surface = surface_of(model, rest, read, sources, filter, report)
    if names is not None and read != names:
        surface = whole.with_channels(names)
    surface, placement, finest = placed(surface, depth, cell, margin)
    plan = Plan(
        surface, formats_as(surface.channels, dtype), placement, finest, cell, fit, most, margin, detail,
        None if detail is None else wanted_levels(detail, whole, finest),
    )  # fmt: skip
    with ExitStack() as stack:
        pool = stack.enter_context(workers(run))
        if target is not None and _is_mapped(plan, run):
            folder = stack.enter_context(large.scratch(folder_of(run, target.parent)))
            pool = large.Tasks(pool, folder, is_here=shares_memory(pool))
        texture = _converted(plan, pool, report)
        if target is None:
            return texture
        texture.save(target)
        del texture
    return open_texture(target)


class Plan(NamedTuple):
    """A surface, and the options of its conversion."""

    surface: Surface
    stored: tuple[ChannelFormat, ...]
    placement: Placement
    depth: int
    cell: float | None
    fit: bool
    max_error: float | None
    margin: float | None  # between parts, in cells
    detail: DetailFunction | str | None
    wanted: Wanted | None

    @property
    def has_samples(self) -> bool:
        """Whether the conversion takes samples of the surface."""
        return self.fit or self.max_error is not None


def _converted(plan: Plan, pool: Executor, report: Progress) -> OctreeTexture:
    """Voxelize the surface, build the tree, fit its leaves, split them by facing, merge them."""
    surface, placement = plan.surface, plan.placement
    cells = cell_levels(
        surface, surface.source, plan.stored, placement, plan.depth, pool, report,
        has_samples=plan.has_samples, wanted=plan.wanted,
    )  # fmt: skip
    if not cells.n_leaves:
        raise ModelError(
            f"{surface.name}: its source has no value anywhere on it: it is too far away, or faces another "
            "way; allow more distance, or a larger angle"
        )
    degenerate, empty = cells.degenerate, cells.gaps.size
    report("build", 0, 1)
    filled = assemble(cells)
    report("build", 1, 1)
    del cells  # a second copy of all values
    tree, channels = adapted(filled, fit=plan.fit, max_error=plan.max_error, executor=pool, progress=report)
    if surface.source.alpha_is_coverage and not empty:
        channels = without_opaque(channels)
    metadata = _metadata(plan, channels, degenerate, empty)
    texture = OctreeTexture(tree, channels, placement, surface.bounds, metadata)
    return refaced(texture) if empty else texture


def _is_mapped(plan: Plan, run: Run) -> bool:
    """Say whether large arrays go to files; raises ArgumentError where they cannot."""
    if run.executor is None:
        if run.memory is None:
            return False
        needed = memory_needed(
            plan.surface, plan.stored, plan.placement, plan.depth, has_samples=plan.has_samples
        )
        return needed * _PEAK > as_memory(run.memory)
    if not shares_memory(run.executor) and (plan.max_error is not None or plan.wanted is not None):
        raise ArgumentError(
            f"{plan.surface.name}: max_error and detail run on one machine only; leave out path or the "
            "executor"
        )
    return True


def _metadata(plan: Plan, channels: Mapping[str, Channel], degenerate: int, empty: int) -> dict[str, str]:
    """Return the texture's record of its conversion."""
    detail = plan.detail if isinstance(plan.detail, str) else "function"
    options = {
        **({"depth": plan.depth} if plan.cell is None else {"cell": float(plan.cell)}),
        "fit": plan.fit,
        **({} if plan.max_error is None else {"max_error": plan.max_error}),
        **({} if plan.detail is None else {"detail": detail}),
        "channels": {name: channel.format.dtype for name, channel in channels.items()},
        **({} if plan.margin is None else {"separate": float(plan.margin)}),
        "triangles": len(plan.surface.triangles),
        "degenerate": degenerate,
        **({"empty": empty} if empty else {}),
    }
    return {**plan.surface.provenance, "octex": octex.__version__, "convert": json.dumps(options)}


def _as_target(path: str | os.PathLike[str]) -> Path:
    target = as_path(path)
    if target.suffix.lower() != ENDING:
        raise ArgumentError(f"{target}: a texture is converted to NAME{ENDING}")
    if not os.path.isdir(target.parent):  # noqa: PTH112  # False, and no error, for a name that is too long
        raise OutputError(f"{target}: there is no folder {target.parent}; make it first")
    return target


def as_fineness(depth: int | None, cell: float | None) -> tuple[int | None, float | None]:
    """Return ``depth`` and ``cell`` as numbers, one at most, or raise ArgumentError."""
    if depth is not None and cell is not None:
        raise ArgumentError("give depth or cell, not both")
    return None if depth is None else as_depth(depth), None if cell is None else as_positive(cell, "cell")


def with_detail(names: list[str] | None, detail: DetailFunction | str | None) -> list[str] | None:
    """Return the channels to read: ``names``, and the channel that ``detail`` names."""
    if names is None or not isinstance(detail, str) or detail == STRETCH or detail in names:
        return names
    return [*names, detail]


def placed(
    surface: Surface, depth: int | None, cell: float | None, margin: float | None = None
) -> tuple[Surface, Placement, int]:
    """Return a surface, its parts ``margin`` cells apart, with its root cell and finest level."""
    if margin is not None:
        surface = separate(surface, margin, depth=depth, cell=cell).surface
    if cell is not None:
        return surface, *Placement.with_cell(surface.bounds, cell)
    depth = DEFAULT_DEPTH if depth is None else depth
    return surface, Placement.around(surface.bounds, depth), depth


def surface_of(
    model: str | os.PathLike[str] | Surface | Sequence[str | os.PathLike[str] | Surface],
    rest: str | os.PathLike[str] | npt.ArrayLike | None,
    channels: Sequence[str] | None,
    sources: Mapping[str, object] | None,
    filter: str | None,
    report: Progress,
) -> Surface:
    """Return the surface to convert, with only ``channels``."""
    sources = {} if sources is None else as_entries(sources, "sources")
    if is_path(model):
        report("read", 0, 1)
        surface = load_surface(
            as_path(model, "model"),
            rest,
            channels=channels,
            sources=sources,
            filter="ewa" if filter is None else filter,
        )
        report("read", 1, 1)
        return surface
    if not isinstance(model, Surface):
        models = list(model) if is_several(model) else [model]
        for each in models:
            if not is_path(each) and not isinstance(each, Surface):
                raise ArgumentError(
                    "a model must be a file, a Surface, a PointCloud or Voxels, or a list of files and "
                    f"Surfaces; not {'a list with ' if is_several(model) else ''}{each!r}"
                )
        model = Surface.joined(
            [each if isinstance(each, Surface) else load_surface(as_path(each)) for each in models]
        )
    surface = model if rest is None else at_rest(model, rest)
    surface = surface.completed(sources, channels)
    return surface if filter is None else surface.with_filter(filter)


class Separated(NamedTuple):
    """A surface with its parts moved apart, and the overlaps that it had before."""

    surface: Surface
    found: Overlaps


def separate(
    surface: Surface, cells: float = CELLS_APART, *, depth: int | None = None, cell: float | None = None
) -> Separated:
    """Move parts of a surface apart that come nearer to each other than ``cells`` finest cells.

    ``depth`` or ``cell`` is the texture's resolution, as for ``convert``. Afterwards at least ``cells`` empty
    cells lie between such parts along some axis. Coarse levels still mix parts, over twice the distance with
    every level. See ``Surface.separated``.

    Raises ArgumentError for numbers out of range, and for a depth with too few cells for all parts.
    """
    as_surface(surface)
    cells = as_number(cells, "cells", *_RANGE_APART)
    depth, cell = as_fineness(depth, cell)
    depth = DEFAULT_DEPTH if depth is None else depth

    def margin_in(placed: Surface) -> float:
        edge = Placement.around(placed.bounds, depth).size / 2**depth if cell is None else cell
        return _DIAGONAL * cells * edge

    margin = margin_in(surface)
    most = max(margin, _LARGEST_MARGIN * float((surface.bounds[1] - surface.bounds[0]).max()))
    overlaps = surface.overlapping_parts(margin)
    while margin <= most:
        if overlaps.margin < margin:
            overlaps = surface.overlapping_parts(2.0 * margin)
        separated = surface.separated(margin, overlaps)
        # The whole has grown, and with it the cells.
        if margin_in(separated) <= margin * (1.0 + 1e-9):
            return Separated(separated, overlaps)
        margin = 1.01 * margin_in(separated)
    raise ArgumentError(
        f"{surface.name}: {overlaps.n_parts} parts do not fit {cells:g} cells apart into depth {depth}; "
        "use a larger depth"
    )
