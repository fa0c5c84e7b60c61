"""Baking: an octree texture and a surface in; the surface with images at texture coordinates out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.baking.atlas import atlas_layout
from octex.baking.gutters import Gutter, fill_up, gutter_of
from octex.baking.layout import (
    ALIGNMENT,
    LAYOUTS,
    Layout,
    Layouts,
    borders,
    kept_layout,
    neighbors,
    unit_area,
)
from octex.baking.maps import Points, in_tangent_space, material_of, sampled, turned, unit
from octex.baking.texels import Texels, draw_texels, texel_points
from octex.channels import CHANNELS, NORMAL
from octex.checks import as_choice, as_names, as_whole
from octex.errors import ArgumentError, ModelError
from octex.parallel import Progress, as_progress, ordered_map, workers
from octex.source.corners import Frames
from octex.source.images.pyramid import CLAMP, REPEAT
from octex.source.materials import MaterialSource
from octex.source.surface import Surface, as_surface
from octex.source.tangents import corner_frames
from octex.texture import OctreeTexture, as_texture

#: The sizes of maps that are chosen by themselves, and the largest at all.
_SMALLEST, _LARGEST, _MOST = 64, 8192, 16384
#: Texels are about as large as cells if they are at most so much wider.
_ABOUT = 1.15
#: Rows of texels in one task.
_BAND = 32
#: Texels of gutters in one task.
_GUTTER = 1 << 16
#: Coordinates of which so much is covered twice are not kept unless that is asked for.
_OVERLAPPING = 0.01


def bake(
    texture: OctreeTexture,
    surface: Surface,
    *,
    uv: Layouts = "auto",
    texture_size: int | None = None,
    padding: int = 8,
    channels: Sequence[str] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Bake a texture to images; return the surface with them, for ``write_model`` or whatever reads surfaces.

    Each texel is one lookup of each channel, averaged over the texel as the surface shows it, on the side
    that the surface faces, at the centroid of what its chart covers. Normals are in the tangent's frame, as
    glTF has it. Around the charts the maps go on with what lies across their edges on the surface, for
    ``padding`` texels, and smoothly from there, so that no smaller level of the maps shows a seam.

    uv           "keep": the surface's own texture coordinates; "atlas": new ones (of the extra ``atlas``,
                 xatlas, where it is installed); "auto": its own if they hardly overlap,
                 else new ones
    texture_size  texels a side of the square maps, 64 to 16384; by default the power of two, up to 8192,
                 whose texels are about as large as the texture's finest cells, or smaller
    padding      texels between charts, 0 to 64
    channels     those that are baked, by name; by default all that materials have

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError for numbers out of range and channels that are not there or that no material has,
    ModelError for coordinates that cannot be kept, and for a map in which an atlas has no room.
    (Benson & Davis 2002, 6.3.)
    """
    as_texture(texture)
    as_surface(surface)
    as_choice(uv, LAYOUTS, "uv")
    padding = as_whole(padding, "padding", 0, 64)
    names = _channels_of(texture, channels)
    if texture_size is not None:
        texture_size = as_whole(texture_size, "texture_size", _SMALLEST, _MOST)
        if texture_size % ALIGNMENT:
            raise ArgumentError(f"texture_size must be a multiple of {ALIGNMENT}, not {texture_size}")
    report = as_progress(progress)
    surface = surface.placed_in(texture)
    with workers(threads, executor) as pool:
        report("unwrap", 0, 1)
        layout = _layout(texture, surface, uv, texture_size, padding)
        report("unwrap", 1, 1)
        job = _job(texture, surface, layout, names)
        drawn = _draw(layout, pool)
        maps = {name: _new_map(layout, name) for name in names}
        ends = [*range(0, layout.height, _BAND), layout.height]
        bands = [slice(*each) for each in pairwise(ends)]
        tasks = [(job, drawn, band, maps) for band in bands]
        for _ in ordered_map(pool, _bake_band, tasks, stage="bake", progress=report):
            pass
        if padding:
            _bake_gutter(job, drawn, padding, maps, pool)
        weights = (drawn.areas > 0).astype(np.float32)
        list(ordered_map(pool, lambda each: fill_up(each, weights), list(maps.values())))
        used = layout.uv.values[layout.uv.rows]
        repeats = bool((used < 0.0).any() or (used > 1.0).any())
        material = material_of(maps, REPEAT if repeats else CLAMP, pool)
    source = MaterialSource(
        [material], np.zeros(len(surface.triangles), np.int32), surface.rest, surface.triangles,
        coordinates=[layout.uv], frames=job.frames, name=surface.name,
    )  # fmt: skip
    return Surface(
        surface.vertices, surface.triangles, source, rest=surface.rest, uv=layout.uv,
        frames=job.frames or surface.frames, name=surface.name, provenance=surface.provenance,
    )  # fmt: skip


def _channels_of(texture: OctreeTexture, channels: Sequence[str] | None) -> list[str]:
    baked = [name for name in CHANNELS if name != "detail"]
    if channels is None:
        names = [name for name in texture.channels if name in baked]
    else:
        names = as_names(channels, "channels")
        for name in names:
            as_choice(name, texture.channels, "channel of the texture")
            as_choice(name, baked, "channel of materials")
    if not names:
        raise ArgumentError(f"no channel to bake: materials have {', '.join(baked)}")
    return names


class _Job(NamedTuple):
    """What is the same for all texels."""

    texture: OctreeTexture
    surface: Surface
    layout: Layout
    faces: Int32s  # (k, 3)   of what is drawn
    names: list[str]
    dPdx: Float64s  # (m, 3)
    dPdy: Float64s  # (m, 3)
    normals: Float64s  # (m, 3)
    frames: Frames | None


def _layout(texture: OctreeTexture, surface: Surface, uv: Layouts, size: int | None, padding: int) -> Layout:
    """Lay the surface out in maps of a size, or of one that keeps the texture's cells."""
    if uv != "atlas":
        try:
            kept = kept_layout(surface, size or 1024)
        except ModelError:
            if uv == "keep":
                raise
        else:
            shared = _shared(kept)
            if uv == "keep" and shared > _OVERLAPPING:
                raise ModelError(
                    f"{surface.name}: {100 * shared:.3g} % of its texture coordinates overlap, so that one "
                    "texel would show several places; have an atlas made"
                )
            if shared <= _OVERLAPPING:
                if size is not None:
                    return kept
                return kept.sized(_size_for(texture, surface, unit_area(kept)))
    if size is not None:
        return atlas_layout(surface, [size], padding, _cell(texture))
    first = _size_for(texture, surface, 0.6)
    sizes = [2**n for n in range(first.bit_length() - 1, _LARGEST.bit_length())]
    return atlas_layout(surface, sizes, padding, _ABOUT * _cell(texture))


def _shared(layout: Layout) -> float:
    """Return how much of what triangles cover in a map others cover too, as a part."""
    whole = unit_area(layout)
    drawn = draw_texels(layout.corners, np.zeros_like(layout.charts), layout.width, 0, layout.height)
    covered = float(drawn.areas.sum(dtype=np.float64)) / (layout.width * layout.height)
    return max(whole - covered, 0.0) / whole if whole > 0.0 else 0.0


def _size_for(texture: OctreeTexture, surface: Surface, part: float) -> int:
    """Return the size of maps of which a ``part`` shows the surface with texels about as large as cells."""
    corners = surface.rest[surface.triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(crosses, axis=1).sum() / 2)
    side = np.sqrt(area / max(part, 1e-6)) / (_ABOUT * _cell(texture))
    return int(np.clip(2 ** np.ceil(np.log2(max(side, 1.0))), _SMALLEST, _LARGEST))


def _cell(texture: OctreeTexture) -> float:
    """Return the width of a texture's finest cells."""
    return float(texture.placement.size / 2**texture.tree.max_depth)


def _job(texture: OctreeTexture, surface: Surface, layout: Layout, names: list[str]) -> _Job:
    rest, flat = surface.rest[surface.triangles], layout.uv.values[layout.uv.rows].astype(np.float64)
    flat *= layout.width, layout.height
    first, second = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
    one, two = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    doubled = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    scale = np.where(doubled != 0, 1.0 / np.where(doubled != 0, doubled, 1.0), 0.0)[:, None]
    crosses = np.cross(first, second)
    lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
    frames = None
    if NORMAL.name in names:
        normals = None if surface.frames is None else surface.frames.normals
        frames = corner_frames(surface.rest, surface.triangles, normals, None, layout.uv)
    return _Job(
        texture, surface, layout, surface.triangles[layout.faces], names,
        dPdx=(first * two[:, 1:] - second * one[:, 1:]) * scale,
        dPdy=(second * one[:, :1] - first * two[:, :1]) * scale,
        normals=crosses / np.where(lengths > 0, lengths, 1.0),
        frames=frames,
    )  # fmt: skip


def _draw(layout: Layout, pool: Executor) -> Texels:
    ends = [*range(0, layout.height, 4 * _BAND), layout.height]
    parts = list(
        ordered_map(
            pool,
            lambda rows: draw_texels(layout.corners, layout.charts, layout.width, *rows),
            list(pairwise(ends)),
        )
    )
    return Texels(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _new_map(layout: Layout, name: str) -> Float32s:
    return np.zeros((layout.height, layout.width, CHANNELS[name].components), np.float32)


def _bake_band(task: tuple[_Job, Texels, slice, dict[str, Float32s]]) -> None:
    """Write the channels at the texels of some rows."""
    job, whole, band, maps = task
    layout, surface = job.layout, job.surface
    drawn = Texels(whole.triangles[band], whole.centroids[band], whole.areas[band])
    rows, columns, barycentric, rest = texel_points(
        layout.corners, drawn, band.start, surface.rest, job.faces
    )
    if not rows.size:
        return
    triangles = layout.faces[whole.triangles[rows, columns]]
    points = Points(rest, job.dPdx[triangles], job.dPdy[triangles], job.normals[triangles])
    found = sampled(job.texture, job.names, points)
    if job.frames is not None:
        found[NORMAL.name] = in_tangent_space(found[NORMAL.name], job.frames, triangles, barycentric)
    for name, values in found.items():
        maps[name][rows, columns] = values


def _bake_gutter(job: _Job, drawn: Texels, padding: int, maps: dict[str, Float32s], pool: Executor) -> None:
    """Write the channels around the charts, and count these texels as covered, in place."""
    others, sides = neighbors(job.surface)
    gutter = gutter_of(
        job.layout, borders(job.layout, others, sides), job.surface.rest, job.surface.triangles,
        others, sides, drawn.areas > 0, padding,
    )  # fmt: skip
    sizes = np.linalg.norm(np.cross(job.dPdx, job.dPdy), axis=1) ** 0.5
    firsts = range(0, gutter.rows.size, _GUTTER)
    parts = [gutter.part(first, first + _GUTTER) for first in firsts]
    list(ordered_map(pool, lambda some: _bake_beside(job, sizes, some, maps), parts))
    drawn.areas[gutter.rows, gutter.columns] = 1.0


def _bake_beside(job: _Job, sizes: Float64s, gutter: Gutter, maps: dict[str, Float32s]) -> None:
    """Write the channels at some texels of gutters; ``sizes`` (m,) are the edges of texels on triangles.

    They are as large as the texels of the chart beside them, in the plane of the triangle that they show.
    """
    normals = job.normals[gutter.triangles]
    helper = np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wide = unit(np.cross(normals, helper)) * sizes[gutter.beside][:, None]
    rest = job.surface.rest_at(gutter.triangles, gutter.barycentric)
    found = sampled(job.texture, job.names, Points(rest, wide, np.cross(normals, wide), normals))
    if job.frames is not None:
        ends = ((gutter.triangles, gutter.barycentric), (gutter.beside, gutter.edges))
        shading = [unit(job.frames.normals.at(*each)) for each in ends]
        directions = turned(found[NORMAL.name], *shading)
        found[NORMAL.name] = in_tangent_space(directions, job.frames, gutter.beside, gutter.edges)
    for name, values in found.items():
        maps[name][gutter.rows, gutter.columns] = values
