"""Paint as an octree at rest (paper 4.1, step 1)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.conversion.adapt import adapted
from octex.conversion.gaps import without_gaps
from octex.conversion.levels import assemble, cell_levels
from octex.conversion.pieces import Blocks
from octex.conversion.sides import fitters
from octex.editing.split import refaced
from octex.painting.source import PaintSource
from octex.painting.surface import Ground
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
#: So small a part of the surface alone, where pixels are the finest, does not make the whole deeper.
_FINEST_PART = 0.01
#: What part of the surface may have finer pixels than the one whose level most of it gets: of many pictures
#: half; of one next to none, so that what it draws keeps its edges.
_FINER_PART = 0.5
#: Levels by which paint may fall short of what its detail asks for.
_SLACK = 0.1
#: Where pixels want cells that are less than so many levels coarser, or so much finer, than most of the
#: surface has, they get those: a tree of even depth is fitted in half of the time for a leaf.
_COARSER, _FINER = 2.0, 0.5
#: If no more of the surface wants coarser cells, it gets the finest.
_UNEVEN_PART = 0.1


class Levels(NamedTuple):
    """How deep paint goes."""

    most: int  # most of the surface
    deepest: int
    is_even: bool = True  # hardly anything goes less deep than the deepest

    def wanted(self, widths: Floats, size: float, cells: float) -> Float64s:
        """Return the levels (n,) of ``cells`` in the width of details (n,), in a root cell of such a size."""
        levels = _levels(widths, size, cells)
        levels[(levels > self.most - _COARSER) & (levels <= self.most + _FINER)] = self.most
        clipped: Float64s = np.clip(levels, 0.0, self.deepest)
        return clipped


def wanted_levels(
    widths: Floats,
    areas: Floats,
    size: float,
    cells: float,
    depth: int = MAX_DEPTH,
    *,
    is_alone: bool = False,
) -> Levels:
    """Return how deep paint goes whose details are ``widths`` (n,) wide on so much of the surface (n,).

    ``size`` is the root cell's edge; most of the surface has ``cells`` in the width of details, or more; if
    the paint ``is_alone``, of one picture, all but the finest hundredth has. None goes deeper than ``depth``.
    """
    own = np.isfinite(widths) & (widths > 0.0) & (areas > 0.0)
    if not own.all():
        widths, areas = widths[own], areas[own]
    if not widths.size:
        return Levels(0, 0)
    if (widths[1:] < widths[:-1]).any():
        order = np.argsort(widths, kind="stable")
        widths, areas = widths[order], areas[order]
    parts = np.cumsum(areas)
    parts /= parts[-1]
    middle = widths[np.searchsorted(parts, _FINEST_PART if is_alone else _FINER_PART)]
    most = int(np.clip(np.ceil(_levels(middle, size, cells)), 0, depth))

    def level(at: int) -> int:
        return int(np.ceil(Levels(most, depth).wanted(widths[at : at + 1], size, cells)[0]))

    deepest = level(int(np.searchsorted(parts, _FINEST_PART)))
    first = bisect_left(range(widths.size), 1 - deepest, key=lambda at: -level(at))  # that is less deep
    return Levels(most, deepest, bool(1.0 - (parts[first - 1] if first else 0.0) <= _UNEVEN_PART))


def _levels(widths: Floats, size: float, cells: float) -> Float64s:
    with np.errstate(divide="ignore"):
        levels: Float64s = np.log2(cells * size / np.asarray(widths, np.float64)) - _SLACK
    return levels


def rasterize_paint(
    ground: Ground,
    source: PaintSource,
    placement: Placement,
    levels: Levels,
    *,
    fit: bool,
    cells: float = CELLS,
    executor: Executor,
    progress: Progress,
) -> OctreeTexture:
    """Return the paint octree: a texture of the painted channel and its coverage ``alpha``.

    Its leaves lie at rest positions, ``cells`` or more in the width of the paint's detail, but as even as
    ``levels`` say, and hold the mean of the paint on the surface inside, weighted by area and coverage. What
    no paint is on has no cells. With ``fit`` leaves hold what brings the field nearest to the paint, as in a
    conversion; of paint of one colour these are the means.
    """
    surface, depth = ground.surface, levels.deepest
    fit = fit and not _is_plain(source)
    nothing = empty_texture(source.channels, placement, surface.bounds)
    touched = source.touched()
    if not touched.size:
        return nothing
    chosen = ground.near(placement).around(touched, depth)
    here = source.on(chosen)
    part = surface.part(chosen, here)
    filled = cell_levels(
        part, here.channels, placement, depth, executor, progress,
        has_samples=fit, has_gaps=True,
        wanted=None if levels.is_even else partial(_wanted, here, placement.size, cells, levels),
        reached=partial(_reached, here, surface.rest, placement),
    )  # fmt: skip
    if not filled.codes.size:
        return nothing
    tree, values = assemble(here.channels, filled)
    covered = without_gaps(tree, values, filled, placement)
    if not covered.tree.n_leaves:
        return nothing
    fitting = splitting = None
    if covered.samples is not None:
        # Opaque paint stays opaque.
        fitting, splitting = fitters(covered.samples, placement, executor, progress, unfitted=(ALPHA.name,))
    tree, values = adapted(
        covered.tree, covered.channels, None,
        max_error=None, wanted=covered.wanted, fit=fitting, split=splitting, executor=executor,
        progress=progress,
    )  # fmt: skip
    return refaced(OctreeTexture(tree, values, placement, surface.bounds))


def _is_plain(source: PaintSource) -> bool:
    """Say whether all paint has one value, and it is stored without rounding."""
    if source.color is None:
        return False
    form = source.channels[0]
    stored = decode(encode(source.color, form.dtype, form.space), form.space)
    return bool(np.allclose(stored, source.color, rtol=1e-6, atol=1e-7))


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
    levels: Levels,
    triangles: Int32s,
    barycentric: Float64s,
    _widths: Float32s,
) -> Float64s:
    return levels.wanted(source.widths(triangles, barycentric), size, cells)
