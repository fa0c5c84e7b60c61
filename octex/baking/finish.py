"""Makes a light mesh with images from any coloured mesh: repair, convert, simplify, bake."""

from __future__ import annotations

import math
import os
from typing import Any

from octex.baking.bake import bake
from octex.baking.simplify import check_simplifier, simplify
from octex.checks import as_flag, as_path, as_whole, is_path
from octex.cleaning.repair import repair as repaired
from octex.conversion.convert import convert
from octex.parallel import Progress, Run, as_run
from octex.source.load import load_surface
from octex.source.surface import Surface, as_surface
from octex.source.voxels import is_voxels
from octex.texture import OctreeTexture, as_texture
from octex.tree.placement import Placement

#: Default depth, and its bounds if the size of the images decides.
_DEPTH, _LEAST, _LARGEST = 10, 4, 12
#: Typical part of an atlas that charts cover.
_COVERED = 0.6


def finish(
    model: str | os.PathLike[str] | Surface,
    texture: OctreeTexture | None = None,
    *,
    triangles: int | None = None,
    depth: int | None = None,
    texture_size: int | None = None,
    repair: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> Surface:
    """Return a light mesh with images from any mesh with colours, for ``write_model``.

    model         a model file, a .vxz or .npz file of voxels, or a Surface
    texture       its octree texture. None: convert the model's colours
    triangles     largest number in the result (``simplify``), with a normal map of the lost detail. None: all
    depth         of the octree (default: cells are about as wide as texels, or 10). Voxels define it
    texture_size  width of the images in texels, as for ``bake``
    repair        first remove copies and inner triangles, and close cracks (``octex.repair``)
    run           how to work (octex.Run)

    A mesh with fewer triangles gets a new atlas; otherwise ``bake`` chooses the texture coordinates.

    Raises what ``load_surface``, ``repair``, ``convert``, ``simplify`` and ``bake`` raise.
    """
    run = as_run(run, threads, progress)
    as_flag(repair, "repair")
    if triangles is not None:
        triangles = as_whole(triangles, "triangles", 4, 2**31 - 1)
        check_simplifier()
    if texture is not None:
        as_texture(texture)
    run.report("read", 0, 1)
    has_voxels = False
    if is_path(model):
        has_voxels = is_voxels(as_path(model, "model"))
        surface = load_surface(model, normals=True, finite=repair)
    else:
        surface = as_surface(model, "model")  # type: ignore[arg-type]
    if repair:
        surface, _ = repaired(surface)
    run.report("read", 1, 1)
    if texture is None:
        texture = own_texture(model if has_voxels else surface, surface, depth, texture_size, run)
    low = surface
    if triangles is not None and len(surface.triangles) > triangles:
        run.report("simplify", 0, 1)
        low = simplify(surface, triangles)
        run.report("simplify", 1, 1)
    if low is surface:
        return bake(texture, surface, texture_size=texture_size, run=run)
    return bake(texture, low, source=surface, uv="atlas", texture_size=texture_size, run=run)


def own_texture(
    model: Any, surface: Surface, depth: int | None, texture_size: int | None, run: Run
) -> OctreeTexture:
    """Convert the colours of a model: a file of voxels, or a surface.

    By default a surface's cells are about as wide as the texels of an atlas of ``texture_size``.
    """
    if model is not surface:
        return convert(model, run=run)
    if depth is None and texture_size is not None:
        texel = math.sqrt(max(float(surface.areas().sum()), 1e-300) / _COVERED) / texture_size
        size = Placement.around(surface.bounds, _DEPTH).size
        depth = min(max(math.ceil(math.log2(size / texel)), _LEAST), _LARGEST)
    return convert(surface, depth, run=run)
