"""Paint as an octree at rest (paper 4.1, step 1)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.channels import ALPHA, ChannelFormat
from octex.conversion.adapt import adapted
from octex.conversion.gaps import without_gaps
from octex.conversion.levels import assemble, cell_levels
from octex.conversion.pieces import Blocks
from octex.conversion.sides import fitters
from octex.editing.split import refaced
from octex.painting.centres import with_centres
from octex.painting.ground import Ground
from octex.painting.source import PaintSource
from octex.parallel import Progress
from octex.source.separation import SEPARATION
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.layout import MAX_DEPTH
from octex.tree.morton import decode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

#: Cells in the width of the finest detail, a pixel: at least so many, and fewer than twice that. With one,
#: pictures come back in a fourth of the leaves, with 1.3 to 3 times the error (RMS), than with two.
CELLS, FINEST_CELLS = 1.0, 2.0
#: Pixels vary in width over a picture; so small a part of them alone does not make the whole deeper.
_FINEST_PART = 0.001
#: Levels by which paint may fall short of what its detail asks for.
_SLACK = 0.1


def wanted_depth(source: PaintSource, size: float, cells: float) -> int:
    """Return the level of ``cells`` in the width of the finest detail, or more; 0 where there is none.

    ``size`` is the root cell's edge.
    """
    widths = source.texel_edges(source.touched())
    widths = np.sort(widths[np.isfinite(widths) & (widths > 0.0)])
    if not widths.size:
        return 0
    width = widths[int(_FINEST_PART * widths.size)]
    return int(np.clip(np.ceil(np.log2(cells * size / width) - _SLACK), 0, MAX_DEPTH))


def rasterize_paint(
    ground: Ground,
    source: PaintSource,
    placement: Placement,
    depth: int,
    *,
    fit: bool,
    cells: float = CELLS,
    executor: Executor,
    progress: Progress,
) -> OctreeTexture:
    """Return the paint octree: a texture of the painted channel and its coverage ``alpha``.

    Its leaves lie at rest positions, ``cells`` or more in the width of the paint's detail, but no deeper than
    ``depth``, and hold the mean of the paint on the surface inside, weighted by area and coverage. What no
    paint is on has no cells. With ``fit`` leaves hold what brings the field nearest to the paint, as in a
    conversion.
    """
    surface = ground.surface
    nothing = empty_texture(source.channels, placement, surface.bounds)
    touched = source.touched()
    if not touched.size:
        return nothing
    chosen = ground.near(placement).around(touched, depth)
    here = source.on(chosen)
    part = surface.part(chosen, here)
    filled = cell_levels(
        part, here.channels, placement, depth, executor, progress,
        has_samples=fit, has_gaps=True, wanted=partial(_wanted, here, placement.size, cells, depth),
        reached=partial(_reached, here, surface.rest, placement),
    )  # fmt: skip
    tree, values = assemble(here.channels, filled)
    covered = without_gaps(tree, values, filled, placement)
    if not covered.tree.n_leaves:
        return nothing
    fitting = splitting = None
    if covered.samples is not None:
        samples = with_centres(covered.samples, here, part, placement)
        # Opaque paint stays opaque.
        fitting, splitting = fitters(samples, placement, executor, progress, unfitted=(ALPHA.name,))
    tree, values = adapted(
        covered.tree, covered.channels, None,
        max_error=None, wanted=covered.wanted, fit=fitting, split=splitting, executor=executor,
        progress=progress,
    )  # fmt: skip
    return refaced(OctreeTexture(tree, values, placement, surface.bounds))


def empty_texture(
    forms: Sequence[ChannelFormat],
    placement: Placement,
    bounds: npt.ArrayLike,
    surface: Surface | None = None,
) -> OctreeTexture:
    """Return a texture without leaves, which remembers how far a surface's parts were moved apart."""
    provenance = {} if surface is None else surface.provenance
    metadata = {name: text for name, text in provenance.items() if name == SEPARATION}
    channels = {}
    for form in forms:
        none = np.empty((0, form.components), form.dtype)
        channels[form.name] = Channel(form, np.zeros((1, form.components), form.dtype), none, none)
    return OctreeTexture(Octree.from_leaves(np.empty(0, np.int64), 0), channels, placement, bounds, metadata)


def _reached(source: PaintSource, rest: Float64s, placement: Placement, blocks: Blocks, level: int) -> Bools:
    """Say which blocks of a level paint may lie in."""
    corners = placement.to_rest(decode_cells(blocks.codes) / 2**level)
    return source.reaches(blocks, corners, placement.size / 2**level, rest)


def _wanted(
    source: PaintSource,
    size: float,
    cells: float,
    depth: int,
    triangles: Int32s,
    barycentric: Float64s,
    _widths: Float32s,
) -> Float64s:
    widths = source.widths(triangles, barycentric).astype(np.float64)
    with np.errstate(divide="ignore"):
        levels = np.log2(cells * size / widths) - _SLACK
    clipped: Float64s = np.clip(levels, 0.0, depth)
    return clipped
