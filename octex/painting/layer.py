"""Paint to rasterize: what gives it, how deep it goes, and a layer without any."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s
from octex.channels import ALPHA, ChannelFormat, decode, encode
from octex.source.base import Source
from octex.source.parts import SEPARATION
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.tree.layout import MAX_DEPTH
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.voxelize.fragments import Blocks

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


#: Coverage is kept in 16 bits: 8 would change a wash by up to half a step.
COVERAGE = ALPHA._replace(dtype="uint16")


class PaintSource(Source):
    """Gives a channel's components, and their coverage as ``alpha``, to points of a surface."""

    form: ChannelFormat  # of what is painted

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """What is painted, and its coverage."""
        return self.form, COVERAGE

    @property
    def has_gaps(self) -> bool:
        """Where there is no paint."""
        return True

    @property
    def alpha_is_coverage(self) -> bool:
        """Where ``alpha`` is 0 there is no paint."""
        return True

    @property
    def color(self) -> Float32s | None:
        """The value (components,) that all of the paint has, decoded; None if it may have several."""
        return None

    @abstractmethod
    def touched(self) -> Int32s:
        """Return triangles, ascending, in whose neighbourhood all paint lies."""

    def near(self, triangles: Int32s) -> PaintSource:  # noqa: ARG002
        """Return the same paint, made ready for what is near some triangles."""
        return self

    def reaches(self, blocks: Blocks, placement: Placement, rest: Float64s) -> Bools:  # noqa: ARG002
        """Say in which of blocks in a root cell paint may lie, for a surface at ``rest`` (n, 3)."""
        return np.ones(blocks.codes.size, np.bool_)

    def widths(
        self,
        triangles: Int32s,
        barycentric: Float64s,  # noqa: ARG002
    ) -> Float32s:
        """Return how wide the finest detail of the paint is at points (n,), in rest units; 0: any."""
        return np.zeros(len(triangles), np.float32)


class Depths(NamedTuple):
    """How deep paint goes."""

    most: int  # most of the surface
    deepest: int
    is_even: bool = True  # hardly anything goes less deep than the deepest

    def levels(self, widths: Floats, size: float, cells: float) -> Float64s:
        """Return the levels (n,) of ``cells`` in the width of details (n,), in a root cell of such a size."""
        levels = _levels(widths, size, cells)
        levels[(levels > self.most - _COARSER) & (levels <= self.most + _FINER)] = self.most
        clipped: Float64s = np.clip(levels, 0.0, self.deepest)
        return clipped


def wanted_depths(
    widths: Floats,
    areas: Floats,
    size: float,
    cells: float,
    depth: int = MAX_DEPTH,
    *,
    is_single: bool = False,
) -> Depths:
    """Return how deep paint goes whose details are ``widths`` (n,) wide on so much of the surface (n,).

    Most of the surface, or of one picture all but the finest hundredth, has ``cells`` or more in that width,
    in a root cell of ``size``; none is deeper than ``depth``.
    """
    own = np.isfinite(widths) & (widths > 0.0) & (areas > 0.0)
    if not own.all():
        widths, areas = widths[own], areas[own]
    if not widths.size:
        return Depths(0, 0)
    if (widths[1:] < widths[:-1]).any():
        order = np.argsort(widths, kind="stable")
        widths, areas = widths[order], areas[order]
    parts = np.cumsum(areas)
    parts /= parts[-1]
    middle = widths[np.searchsorted(parts, _FINEST_PART if is_single else _FINER_PART)]
    most = int(np.clip(np.ceil(_levels(middle, size, cells)), 0, depth))

    def level(at: int) -> int:
        return int(np.ceil(Depths(most, depth).levels(widths[at : at + 1], size, cells)[0]))

    deepest = level(int(np.searchsorted(parts, _FINEST_PART)))
    first = bisect_left(range(widths.size), 1 - deepest, key=lambda at: -level(at))  # that is less deep
    return Depths(most, deepest, bool(1.0 - (parts[first - 1] if first else 0.0) <= _UNEVEN_PART))


def _levels(widths: Floats, size: float, cells: float) -> Float64s:
    with np.errstate(divide="ignore"):
        levels: Float64s = np.log2(cells * size / np.asarray(widths, np.float64)) - _SLACK
    return levels


def is_plain(source: PaintSource) -> bool:
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
    tree = Octree.from_leaves(np.empty(0, np.int64), 0)
    channels = {form.name: Channel.full(form, tree) for form in forms}
    return OctreeTexture(tree, channels, placement, bounds, metadata)
