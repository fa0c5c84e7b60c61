"""The main job: a textured model in, an octree texture out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ALPHA
from octex.checks import (
    as_bytes,
    as_depth,
    as_entries,
    as_flag,
    as_names,
    as_number,
    as_path,
    as_positive,
    as_real,
    is_path,
    is_several,
)
from octex.conversion import apart, large
from octex.conversion.adapt import adapted, as_max_error
from octex.conversion.detail import DetailFunction, channel_of, wanted_levels
from octex.conversion.formats import Dtypes, formats_as
from octex.conversion.gaps import without_gaps, without_opaque
from octex.conversion.levels import assemble, cell_levels, memory_needed
from octex.conversion.points import convert_points
from octex.conversion.sides import fitters
from octex.conversion.voxels import convert_voxels
from octex.editing.split import refaced
from octex.errors import ArgumentError, ModelError, OutputError
from octex.parallel import Progress, as_progress, shares_memory, workers
from octex.source.cloud import PointCloud, is_cloud
from octex.source.load import at_rest, load_surface
from octex.source.surface import Surface
from octex.source.voxels import Voxels, is_voxels
from octex.texture import OctreeTexture, open_texture
from octex.texture.file import ENDING
from octex.tree.placement import Placement

DEFAULT_DEPTH = 10
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
    memory: int | str | None = None,
    path: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> OctreeTexture:
    """Convert a model into an octree texture.

    ``model`` is a file or a Surface; or several, which share the texture (Benson & Davis 2002, 5; see
    ``Surface.joined``); or a PointCloud or Voxels, or a file of these: see ``convert_points`` and
    ``convert_voxels``. The finest cells are 2⁻ᵈᵉᵖᵗʰ of the root cell (10 by default), or have the edge
    ``cell`` in model units. ``rest`` gives rest positions, as for ``load_surface``. ``progress`` is called
    with the stage's name, the units done and the units in all.

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    ``channels`` names those to convert, by default all that the model has; ``sources`` gives some from
    elsewhere, as for ``Surface.with_sources``; ``filter`` is how images are averaged over cells, as for
    ``load_surface``. ``dtype``, "uint8", "uint16", "float16" or "float32", is the stored type of all channels
    or of each by its name; the default is the source's: uint8, or float16 for light above 1. Floats store
    linear light.

    A leaf is stored for exactly the cells that the surface meets at rest. The value of every node is the
    area-weighted mean of the source over the surface inside it, taken in linear light, all channels weighted
    by alpha too if it is among them (Benson & Davis 2002, 3.1, 3.5 and 5). Directions are averaged as
    vectors: the less they agree, the shorter is the mean. A cell in which the surface shows both ways along
    an axis keeps a mean for each facing too, if one differs from the whole by more than 1/255 of the encoded
    range; light stored as floats is compared on sRGB's curve, and above 1 by ratio (0.9 %). Leaves
    hold the values with which the field, read with the filter "quadratic", comes nearest to the source;
    without ``fit`` their means, as nodes do. Beside others that face the other way, fitted leaves keep a
    value for each facing, too, if the one with which lookups with normals come nearest differs as much.

    Leaves are as deep as the finest cells unless ``max_error`` or ``detail`` say otherwise. ``max_error``, in
    8-bit codes of what is encoded, merges leaves wherever the field, looked up with normals or without, then
    stays that near to the one without it: see ``adapt.adapted``. ``detail`` says how deep to go where: a
    function of rest positions (n, 3) that returns levels (n,), the name of a channel of one component that
    holds the resolution relative to the finest, or "stretch", which evens out the resolution of the posed
    surface: see ``detail.wanted_levels``. A channel that only steers is not stored if ``channels`` do not
    name it.

    With ``path`` the texture is saved there, NAME.octex, and returned as opened from there. If the conversion
    would take more than ``memory``, bytes or a text like "2GB", what is large lies in a folder beside that
    file meanwhile, of whose pages the system keeps what memory has room for; the surface, its images and some
    bytes a cell stay in memory: see `octex help files`. With an ``executor`` it lies there always, and is
    passed to workers and back as names of files: they must see the folder under the same name, and a worker
    that is lost is done without. The texture is the same, bit for bit. Neither goes with sources with gaps;
    ``max_error`` and ``detail`` go with ``memory`` alone, and some 90 bytes a finest cell then stay there.

    Points know only ``depth``, ``cell``, ``channels``, ``dtype`` and ``progress``; voxels of these neither
    ``depth`` nor ``cell``.

    ``separate`` moves parts apart at rest that come nearer to each other than so many finest cells (True: 3),
    so that they share none: see ``apart.separate``. Lookups then take ``Surface.rest_positions``.

    Raises OutputError if ``path`` cannot be written, ModelError and ImageError for a model that cannot be
    used, ArgumentError for what is no model, a depth out of range, a cell too small, more cells than can be
    numbered, unknown names, and an integer type for a channel that goes above 1, for a ``max_error`` that is
    no number or negative, a ``detail`` that cannot be used, a ``memory`` without a ``path``, and a ``path``
    that does not end in .octex.
    """
    report = as_progress(progress)
    target = None if path is None else _as_target(path)
    if memory is not None and target is None:
        raise ArgumentError("memory needs a path: where the texture is written, NAME.octex")
    most_memory = None if memory is None else as_bytes(memory, "memory")
    most = None
    if max_error is not None:
        most = as_max_error(as_real(max_error, "max_error", "a number of 8-bit codes"))
    depth, cell = as_fineness(depth, cell)
    fit = as_flag(fit, "fit")
    cells = None
    if isinstance(separate, (bool, np.bool_)):
        cells = apart.CELLS if separate else None
    elif separate is not None:
        cells = as_number(separate, "separate", *apart.RANGE)
    if is_path(model) and is_voxels(as_path(model, "model")):
        model = Voxels.load(model)
    elif is_path(model) and is_cloud(as_path(model, "model")):
        model = PointCloud.load(model)
    if isinstance(model, (PointCloud, Voxels)):
        of_surfaces = {
            "rest": rest, "sources": sources, "filter": filter, "max_error": max_error, "detail": detail,
            "separate": cells, "threads": threads, "executor": executor, "fit": None if fit else fit,
            "memory": memory, "path": path,
        }  # fmt: skip
        for name, given in of_surfaces.items():
            if given is not None:
                raise ArgumentError(f"{name} needs a surface, which {model.name} is not; leave it out")
        if isinstance(model, Voxels):
            if depth is not None or cell is not None:
                raise ArgumentError(f"{model.name}: voxels have their own depth; leave depth and cell out")
            return convert_voxels(model, channels=channels, dtype=dtype, progress=report)
        return convert_points(model, depth, cell=cell, channels=channels, dtype=dtype, progress=report)
    names = None if channels is None else as_names(channels, "channels")
    steering = channel_of(detail)
    if names is None or steering is None or steering in names:
        whole = surface = surface_of(model, rest, names, sources, filter, report)
    else:
        whole = surface_of(model, rest, [*names, steering], sources, filter, report)
        surface = whole.with_channels(names)
    if cells is not None:
        surface = apart.separate(surface, cells, depth=depth, cell=cell).surface
    stored = formats_as(surface.channels, dtype)
    placement, depth = placed(surface, depth, cell)
    wanted = None if detail is None else wanted_levels(detail, whole, depth)
    has_samples = fit or most is not None
    is_mapped = target is not None and executor is not None
    must_stay = surface.source.has_gaps or surface.source.alpha_is_coverage
    if most_memory is not None and not is_mapped:
        needed = memory_needed(surface, stored, placement, depth, has_samples=has_samples)
        is_mapped = needed * (1 if must_stay else _MOST_TAKEN) > most_memory
    with ExitStack() as stack:
        pool = stack.enter_context(workers(threads, executor))
        if target is not None and is_mapped:
            is_here = executor is None or shares_memory(executor)
            if must_stay:
                raise ArgumentError(
                    f"{surface.name}: sources with gaps need all of it in memory; leave out memory, and path "
                    "if there is an executor"
                )
            if not is_here and (most is not None or detail is not None):
                raise ArgumentError(
                    f"{surface.name}: max_error and detail need all of it on one machine; leave out path or "
                    "the executor"
                )
            folder = stack.enter_context(large.scratch(target.parent))
            pool = large.Tasks(pool, folder, is_here=is_here)
        filled = cell_levels(
            surface, stored, placement, depth, pool, report, has_samples=has_samples, wanted=wanted
        )
        report("build", 0, 1)
        tree, values = assemble(stored, filled)
        report("build", 1, 1)
        samples, degenerate, deepest, empty = filled.samples, filled.degenerate, filled.wanted, 0
        if surface.source.has_gaps:
            coverage = None
            if not surface.source.alpha_is_coverage:
                known = surface.coverage
                coverage = cell_levels(
                    known, known.channels, placement, depth, pool, report, has_samples=False
                )
            tree, values, samples, deepest, empty = without_gaps(tree, values, filled, placement, coverage)
            if not tree.n_leaves:
                raise ModelError(
                    f"{surface.name}: its source is too far from all of it, or faces another way; allow more "
                    "distance, or a larger angle"
                )
        del filled  # holds all values once more
        fitting = splitting = None
        if samples is not None and fit:
            # With a fitted alpha, what is covered would not seem to be beside gaps.
            unfitted = (ALPHA.name,) if surface.source.has_gaps else ()
            fitting, splitting = fitters(samples, placement, pool, report, unfitted)
        tree, values = adapted(
            tree, values, samples,
            max_error=most, wanted=deepest, fit=fitting, split=splitting, executor=pool, progress=report,
        )  # fmt: skip
        if surface.source.alpha_is_coverage and not empty:
            values = without_opaque(values)
        options = {
            **({"depth": depth} if cell is None else {"cell": float(cell)}),
            "fit": fit,
            **({} if most is None else {"max_error": most}),
            **({} if detail is None else {"detail": detail if isinstance(detail, str) else "function"}),
            "channels": {name: channel.format.dtype for name, channel in values.items()},
            **({} if cells is None else {"separate": float(cells)}),
            "triangles": len(surface.triangles),
            "degenerate": degenerate,
            **({"empty": empty} if empty else {}),
        }
        metadata = {**surface.provenance, "octex": octex.__version__, "convert": json.dumps(options)}
        texture = OctreeTexture(tree, values, placement, surface.bounds, metadata)
        texture = refaced(texture) if empty else texture
        if target is None:
            return texture
        texture.save(target)
        del texture, tree, values, samples
    return open_texture(target)


def _as_target(path: str | os.PathLike[str]) -> Path:
    """Return where a texture is to be written, or raise ArgumentError, or OutputError where it cannot be."""
    target = as_path(path)
    if target.suffix.lower() != ENDING:
        raise ArgumentError(f"{target}: a texture is converted to NAME{ENDING}")
    if not os.path.isdir(target.parent):  # noqa: PTH112  # a name too long is none, and no error
        raise OutputError(f"{target}: there is no folder {target.parent}; make it first")
    return target


def as_fineness(depth: int | None, cell: float | None) -> tuple[int | None, float | None]:
    """Return ``depth`` and ``cell`` as numbers, one at most, or raise ArgumentError."""
    if depth is not None and cell is not None:
        raise ArgumentError("give depth or cell, not both")
    return None if depth is None else as_depth(depth), None if cell is None else as_positive(cell, "cell")


def placed(surface: Surface, depth: int | None, cell: float | None) -> tuple[Placement, int]:
    """Return the root cell of a surface and the finest level, for ``depth`` or ``cell`` as in ``convert``."""
    if cell is not None:
        return Placement.with_cell(surface.bounds, cell)
    depth = DEFAULT_DEPTH if depth is None else depth
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
