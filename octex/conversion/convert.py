"""The main job: a textured model in, an octree texture out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy.typing as npt

import octex
from octex.channels import ChannelFormat
from octex.checks import (
    as_entries,
    as_flag,
    as_memory,
    as_names,
    as_path,
    is_path,
    is_several,
)
from octex.conversion import apart, large
from octex.conversion.adapt import adapted, as_max_error
from octex.conversion.detail import DetailFunction, Wanted, channel_of, wanted_levels
from octex.conversion.gaps import without_opaque
from octex.conversion.levels import assemble, cell_levels, memory_needed
from octex.conversion.points import convert_points
from octex.conversion.voxels import convert_voxels
from octex.editing.split import refaced
from octex.errors import ArgumentError, ModelError, OutputError
from octex.parallel import Progress, Run, as_run, folder_of, shares_memory, workers
from octex.source.cloud import PointCloud, is_cloud
from octex.source.load import at_rest, load_surface
from octex.source.surface import Surface
from octex.source.voxels import Voxels, is_voxels
from octex.texture import Channel, OctreeTexture, open_texture
from octex.texture.channel import Dtypes, formats_as
from octex.texture.file import ENDING
from octex.tree.placement import Placement

DEFAULT_FILTER = "ewa"
#: How many times the least that a conversion needs it takes at its peak: 3 to 6 times were measured.
_MOST_TAKEN = 6


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
    filter     how images are averaged over cells: one of ``filters.FILTERS`` (default "ewa")
    fit        choose leaf values so that "quadratic" lookups match the source; False stores plain averages
    max_error  merge leaves while no lookup changes by more than this many 1/255 of the encoded range
    detail     the depth in places: a function of rest positions (n, 3) that returns levels (n,); the name of
               a one-component channel, where 1 means full depth and 1/2 a level less; or "stretch", which
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
    depth, cell = apart.as_fineness(depth, cell)
    fit = as_flag(fit, "fit")
    margin = apart.as_margin(separate)
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
        return convert_voxels(model, channels=channels, dtype=dtype, progress=report)
    names = None if channels is None else as_names(channels, "channels")
    steering = channel_of(detail)
    if names is None or steering is None or steering in names:
        whole = surface = surface_of(model, rest, names, sources, filter, report)
    else:
        whole = surface_of(model, rest, [*names, steering], sources, filter, report)
        surface = whole.with_channels(names)
    if margin is not None:
        surface = apart.separate(surface, margin, depth=depth, cell=cell).surface
    placement, finest = placed(surface, depth, cell)
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
    """What is converted, and how."""

    surface: Surface
    stored: tuple[ChannelFormat, ...]
    placement: Placement
    depth: int
    cell: float | None
    fit: bool
    max_error: float | None
    margin: float | None  # cells that parts are kept apart by
    detail: DetailFunction | str | None
    wanted: Wanted | None

    @property
    def has_samples(self) -> bool:
        """Say whether samples of the surface are taken."""
        return self.fit or self.max_error is not None


def _converted(plan: Plan, pool: Executor, report: Progress) -> OctreeTexture:
    """Voxelize a surface, build the tree, fit its leaves, give them sides, merge them."""
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
    del cells  # they hold all values once more
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
        if needed * _MOST_TAKEN <= as_memory(run.memory):
            return False
    is_here = run.executor is None or shares_memory(run.executor)
    if not is_here and (plan.max_error is not None or plan.wanted is not None):
        raise ArgumentError(
            f"{plan.surface.name}: max_error and detail run on one machine only; leave out path or the "
            "executor"
        )
    return True


def _metadata(plan: Plan, channels: Mapping[str, Channel], degenerate: int, empty: int) -> dict[str, str]:
    """Return what a texture remembers of its conversion."""
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
    """Return where a texture is to be written, or raise ArgumentError, or OutputError where it cannot be."""
    target = as_path(path)
    if target.suffix.lower() != ENDING:
        raise ArgumentError(f"{target}: a texture is converted to NAME{ENDING}")
    if not os.path.isdir(target.parent):  # noqa: PTH112  # a name too long is none, and no error
        raise OutputError(f"{target}: there is no folder {target.parent}; make it first")
    return target


def placed(surface: Surface, depth: int | None, cell: float | None) -> tuple[Placement, int]:
    """Return the root cell of a surface and the finest level, for ``depth`` or ``cell`` as in ``convert``."""
    if cell is not None:
        return Placement.with_cell(surface.bounds, cell)
    depth = apart.DEFAULT_DEPTH if depth is None else depth
    return Placement.around(surface.bounds, depth), depth


def surface_of(
    model: str | os.PathLike[str] | Surface | Sequence[str | os.PathLike[str] | Surface],
    rest: str | os.PathLike[str] | npt.ArrayLike | None,
    channels: Sequence[str] | None,
    sources: Mapping[str, object] | None,
    filter: str | None,
    report: Progress,
) -> Surface:
    """Return what is to be converted, with the wanted channels alone."""
    sources = {} if sources is None else as_entries(sources, "sources")
    if not is_path(model) and not isinstance(model, Surface):
        given = list(model) if is_several(model) else [model]
        for each in given:
            if not is_path(each) and not isinstance(each, Surface):
                raise ArgumentError(
                    "a model must be a file, a Surface, a PointCloud or Voxels, or a list of files and "
                    f"Surfaces; not {'a list with ' if is_several(model) else ''}{each!r}"
                )
        surfaces = [each if isinstance(each, Surface) else load_surface(as_path(each)) for each in given]
        model = Surface.joined(surfaces)
    if not isinstance(model, Surface):
        report("read", 0, 1)
        surface = load_surface(
            as_path(model, "model"),
            rest,
            channels=channels,
            sources=sources,
            filter=DEFAULT_FILTER if filter is None else filter,
        )
        report("read", 1, 1)
        return surface
    surface = model if rest is None else at_rest(model, rest)
    surface = surface.completed(sources, channels)
    return surface if filter is None else surface.with_filter(filter)
