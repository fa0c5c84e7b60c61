"""Parts of a model converted into a texture each (Benson & Davis 2002, 4.3.1)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.channels import check_range, encode
from octex.checks import as_entries, as_names, as_path, is_path
from octex.conversion.convert import as_fineness, convert, placed, surface_of, with_detail
from octex.conversion.detail import DetailFunction
from octex.errors import ArgumentError, ModelError
from octex.parallel import Progress, Run, as_run, workers
from octex.source.base import by_channel
from octex.source.cloud import PointCloud, is_cloud
from octex.source.surface import Surface
from octex.source.voxels import Voxels, is_voxels
from octex.texture import Channel, OctreeTexture, TextureSet
from octex.texture.channel import Dtypes, formats_as
from octex.tree.octree import Octree
from octex.tree.placement import Placement, on_grid
from octex.voxelize.grid import count_degenerate


def convert_set(
    parts: str | os.PathLike[str] | Surface | Mapping[str, str | os.PathLike[str] | Surface | PointCloud],
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
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> TextureSet:
    """Convert each part of a model into its own texture, so that nothing bleeds between parts.

    parts   models by name; or one model file or Surface. Its parts are those of ``Surface.parts``, named
            part-0, part-1 …; triangle t belongs to texture ``surface.parts[t]``
    depth   levels of each part (default 10): small parts get small cells
    cell    width of the finest cells of all parts, instead of ``depth``
    rest    rest positions, for a single model only

    All other arguments are those of ``convert``. ``sources`` are applied before the model is divided. A part
    without area gets one cell with the average of its source at its triangles' centres. ``progress`` counts
    parts.

    Raises ArgumentError, ModelError and ImageError as ``convert`` does.
    """
    depth, cell = as_fineness(depth, cell)
    run = as_run(run, threads, progress)
    names = None if channels is None else as_names(channels, "channels")
    models: dict[str, str | os.PathLike[str] | Surface | PointCloud] = {}
    metadata: dict[str, str] = {}
    textures: dict[str, OctreeTexture] = {}
    if isinstance(parts, Mapping):
        if rest is not None:
            raise ArgumentError(
                "rest is for one model; load each part with its own rest positions (load_surface)"
            )
        models |= as_entries(parts, "parts")
    else:
        if isinstance(parts, PointCloud):
            raise ArgumentError(f"{parts.name} is points, which have no parts; convert takes it")
        surface = surface_of(parts, rest, with_detail(names, detail), sources, filter, run.report)
        sources = filter = None  # the surface has them
        metadata |= surface.provenance
        for name, part in _parts_of(surface):
            models[name] = part
            _, placement, _ = placed(part, depth, cell)
            count, _ = count_degenerate(on_grid(part.rest, placement), part.triangles)
            if count == len(part.triangles):
                textures[name] = _single_cell(part, placement, names, dtype)
        if len(textures) == len(models):
            raise ModelError(f"{surface.name}: none of its parts has an area; there is nothing to convert")
    run.report("convert", len(textures), len(models))
    with workers(run) as pool:
        points = [name for name, model in models.items() if _is_points(model)]
        # Next to surfaces, points ignore the options that only surfaces have.
        is_mixed = len(points) < len(models)
        for name in [name for name in models if name not in textures]:
            options: dict[str, Any] = {"filter": filter, "fit": fit, "run": Run(executor=pool)}
            if name in points:
                options = {} if is_mixed else options | {"run": replace(run, progress=None)}
            textures[name] = convert(
                models[name], depth,
                cell=cell, channels=names, sources=sources, dtype=dtype, max_error=max_error, detail=detail,
                **options,
            )  # fmt: skip
            run.report("convert", len(textures), len(models))
    return TextureSet({name: textures[name] for name in models}, metadata)


def _is_points(model: object) -> bool:
    if is_path(model):
        return is_cloud(as_path(model)) or is_voxels(as_path(model))
    return isinstance(model, (PointCloud, Voxels))


def _parts_of(surface: Surface) -> Iterator[tuple[str, Surface]]:
    order = np.argsort(surface.parts, kind="stable")
    starts = np.flatnonzero(np.diff(surface.parts[order])) + 1
    for number, triangles in enumerate(np.split(order, starts)):
        name = f"part-{number}"
        part = surface.part(triangles)
        part.name = f"{surface.name} ({name})"
        part.provenance["part"] = name
        yield name, part


def _single_cell(
    surface: Surface, placement: Placement, channels: Sequence[str] | None, dtype: Dtypes
) -> OctreeTexture:
    """Return a texture of one cell, with the mean over the centres of all triangles."""
    surface = surface.completed({}, channels)
    count = len(surface.triangles)
    thirds = np.full((count, 3), 1 / 3)
    rows = surface.evaluate_all(np.arange(count, dtype=np.int32), thirds, np.zeros(count, np.float32))
    means = by_channel(surface.channels, rows.mean(axis=0, keepdims=True))
    by_name = {}
    for known, form in zip(surface.channels, formats_as(surface.channels, dtype), strict=True):
        check_range(means[form.name], known, form.dtype, surface.name)
        values = encode(means[form.name], form.dtype, form.space)
        by_name[form.name] = Channel(form, values, values[:0], values[:0])
    return OctreeTexture(Octree.from_leaves([0], 0), by_name, placement, surface.bounds, surface.provenance)
