"""What cameras see of a surface, as a paint octree at rest (paper 4.1, step 1)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np
import numpy.typing as npt

from octex.channels import ChannelFormat
from octex.conversion.adapt import adapted
from octex.conversion.facings import separated
from octex.conversion.fill import assemble, fill, on_grid
from octex.conversion.fit import fitted
from octex.conversion.samples import PLACE_STEPS, SHARE_STEPS, Samples
from octex.painting.projected import COVERAGE, Projected, Shot, Terms
from octex.parallel import Progress
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.texture.channel import Channel
from octex.texture.split import refaced
from octex.tree.edit import cull
from octex.tree.layout import GRID_BITS, MAX_DEPTH
from octex.tree.morton import decode_cells, encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement

Int32s = npt.NDArray[np.int32]

#: Cells in a pixel's width: so many that a picture loses nothing.
CELLS_A_PIXEL = 2.0
#: Widths of pixels vary over a picture; the finest part of them alone does not make the whole deeper.
_FINEST_PART = 0.001
#: Levels by which paint may fall short of what its pixels ask for.
_SLACK = 0.1
#: How many times as much as other samples of a cell the centre of a pixel in it counts for the fit.
_PIXELS_OUTWEIGH = 16
#: Where paint is, is first found in cells of this level.
_COARSE = 7


def wanted_depth(shots: Sequence[Shot], source: Projected, size: float) -> int:
    """Return the level whose cells are about half as wide as the finest pixels; 0 if no surface is seen.

    ``size`` is the root cell's edge.
    """
    finest = [np.empty(0, np.float32)]
    for shot in shots:
        triangles = np.unique(shot.seen.triangle)
        triangles = triangles[triangles >= 0]
        finest.append(source.texel_edges(triangles))
    widths = np.concatenate(finest)
    widths = np.sort(widths[np.isfinite(widths) & (widths > 0.0)])
    if not widths.size:
        return 0
    width = widths[int(_FINEST_PART * widths.size)]
    return int(np.clip(np.ceil(np.log2(CELLS_A_PIXEL * size / width) - _SLACK), 0, MAX_DEPTH))


def around(surface: Surface, chosen: Int32s, placement: Placement, reach: int) -> Int32s:
    """Return the triangles that share coarse cells, or cells beside them, with ``chosen`` ones.

    ``reach`` is the level of the coarsest cells that must be found beside them.
    """
    level = min(_COARSE, reach)
    low, high = _boxes(surface, placement, level)
    marked = np.zeros((1 << level,) * 3, np.bool_)
    _mark(marked, low[chosen], high[chosen])
    for axis in range(3):
        wide = marked.copy()
        before, after = (np.s_[:],) * axis + (np.s_[:-1],), (np.s_[:],) * axis + (np.s_[1:],)
        wide[after] |= marked[before]
        wide[before] |= marked[after]
        marked = wide
    return _reaching(marked, low, high)


def touching(
    surface: Surface, cells: Sequence[tuple[int, npt.NDArray[np.int64]]], placement: Placement
) -> Int32s:
    """Return the triangles that may meet cells, given as levels and Morton codes."""
    marked = np.zeros((1 << _COARSE,) * 3, np.bool_)
    for level, codes in cells:
        places = decode_cells(codes)
        shift = level - _COARSE
        low = places >> shift if shift > 0 else places << -shift
        high = low if shift > 0 else low + (1 << -shift) - 1
        _mark(marked, low, high)
    return _reaching(marked, *_boxes(surface, placement, _COARSE))


def _boxes(surface: Surface, placement: Placement, level: int) -> tuple[Int32s, Int32s]:
    """Return the lowest and highest cells of a level that each triangle reaches (m, 3)."""
    grid = on_grid(surface.rest, placement) >> (GRID_BITS - level)
    corners = grid[surface.triangles]
    return corners.min(axis=1), corners.max(axis=1)


def _reaching(marked: npt.NDArray[np.bool_], low: Int32s, high: Int32s) -> Int32s:
    """Return the boxes that reach a marked cell."""
    # How many marked cells lie before each: of a box, eight looks.
    counts = np.zeros(tuple(n + 1 for n in marked.shape), np.int32)
    counts[1:, 1:, 1:] = marked.cumsum(0, np.int32).cumsum(1, np.int32).cumsum(2, np.int32)
    x0, y0, z0 = low.T
    x1, y1, z1 = (high + 1).T
    inside = (
        counts[x1, y1, z1] - counts[x0, y1, z1] - counts[x1, y0, z1] - counts[x1, y1, z0]
        + counts[x0, y0, z1] + counts[x0, y1, z0] + counts[x1, y0, z0] - counts[x0, y0, z0]
    )  # fmt: skip
    return np.flatnonzero(inside > 0).astype(np.int32)


def _mark(marked: npt.NDArray[np.bool_], low: Int32s, high: Int32s) -> None:
    """Mark the cells that boxes (n, 3) reach."""
    small = (low == high).all(axis=1)
    marked[tuple(low[small].T)] = True
    for first, last in zip(low[~small].tolist(), high[~small].tolist(), strict=True):
        marked[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True


def rasterize_paint(
    surface: Surface,
    shots: Sequence[Shot],
    form: ChannelFormat,
    terms: Terms,
    placement: Placement,
    depth: int,
    *,
    gains: npt.NDArray[np.float32] | None = None,
    fit: bool,
    executor: Executor,
    progress: Progress,
) -> OctreeTexture:
    """Return the paint octree: a texture of the painted channel and its coverage ``alpha``.

    Its leaves lie at rest positions, have about half the width of the pixels that see them, no less than at
    ``depth``, and hold the mean of the paint on the surface inside, weighted by area and coverage. What no
    paint is on has no cells. With ``fit`` leaves hold what brings the field nearest to the paint, as in a
    conversion.
    """
    seen = np.unique(np.concatenate([shot.seen.triangle.ravel() for shot in shots]))
    seen = seen[seen >= 0]
    if not seen.size:
        return empty_texture([form, COVERAGE], placement, surface.bounds)
    chosen = around(surface, seen, placement, depth)
    faces = np.ascontiguousarray(surface.triangles[chosen])
    own = np.full(len(surface.triangles), -1, np.int32)
    own[chosen] = np.arange(len(chosen), dtype=np.int32)
    here = [
        shot._replace(seen=shot.seen._replace(triangle=_renamed(shot.seen.triangle, own))) for shot in shots
    ]
    source = Projected(here, form, terms, surface.vertices, surface.rest, faces, gains)
    part = Surface(surface.vertices, faces, source, rest=surface.rest, name=surface.name)
    filled = fill(
        part, source.channels, placement, depth, executor, progress,
        has_samples=fit, wanted=partial(_wanted, source, placement.size, depth),
    )  # fmt: skip
    tree, values = assemble(source.channels, filled)
    edited = cull(tree, values["alpha"].values[:, 0] > 0)
    painted = (
        edited.old[edited.tree.arrays.level_cells[depth] :] - tree.arrays.level_cells[depth]
        if (edited.tree.max_depth == depth)
        else np.empty(0, np.int64)
    )
    if not painted.size:
        return empty_texture([form, COVERAGE], placement, surface.bounds)
    wanted = None if filled.wanted is None else filled.wanted[painted]
    values = {name: _carried(channel, edited.old, edited.split_rows) for name, channel in values.items()}
    fitting = None
    if filled.samples is not None:
        samples = _with_pixels(_of_cells(filled.samples, painted), here, source, part, placement)
        fitting = partial(fitted, samples=samples, placement=placement, executor=executor, progress=progress)
    tree, means, values = adapted(
        edited.tree, values, None,
        max_error=None, wanted=wanted, fit=fitting, executor=executor, progress=progress,
    )  # fmt: skip
    if fitting is not None:
        values["alpha"] = means["alpha"]  # opaque paint stays opaque
        tree, values = separated(tree, means, values)
    return refaced(OctreeTexture(tree, values, placement, surface.bounds))


def empty_texture(
    forms: Sequence[ChannelFormat], placement: Placement, bounds: npt.ArrayLike
) -> OctreeTexture:
    """Return a texture without leaves."""
    channels = {}
    for form in forms:
        none = np.empty((0, form.components), form.dtype)
        channels[form.name] = Channel(form, np.zeros((1, form.components), form.dtype), none, none)
    return OctreeTexture(Octree.from_leaves(np.empty(0, np.int64), 0), channels, placement, bounds)


def _renamed(triangles: Int32s, names: Int32s) -> Int32s:
    return np.where(triangles >= 0, names[np.maximum(triangles, 0)], np.int32(-1))


def _wanted(
    source: Projected,
    size: float,
    depth: int,
    triangles: Int32s,
    barycentric: npt.NDArray[np.float64],
    _widths: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    widths = source.pixel_widths(triangles, barycentric).astype(np.float64)
    with np.errstate(divide="ignore"):
        levels = np.log2(CELLS_A_PIXEL * size / widths) - _SLACK
    return np.clip(levels, 0.0, depth)


def _carried(channel: Channel, cells: npt.NDArray[np.int64], rows: npt.NDArray[np.bool_]) -> Channel:
    return channel._replace(values=channel.values[cells], split_values=channel.split_values[rows])


def _with_pixels(
    samples: Samples, shots: Sequence[Shot], source: Projected, surface: Surface, placement: Placement
) -> Samples:
    """Add the pixels' centres to samples, where cells are no larger than pixels.

    There the field shall show the picture as it is; between them, near to its bilinear surface.
    """
    edge = placement.size / 2**samples.depth
    grid = on_grid(surface.rest, placement)
    for shot in shots:
        pixels = np.flatnonzero(shot.seen.triangle.ravel() >= 0)
        triangles = shot.seen.triangle.ravel()[pixels]
        barycentric = shot.centres.reshape(-1, 3)[pixels].astype(np.float64)
        fine = source.pixel_widths(triangles, barycentric) >= edge
        triangles, barycentric = triangles[fine], barycentric[fine]
        steps = np.einsum("nc,ncx->nx", barycentric, grid[surface.triangles[triangles]].astype(np.float64))
        places = steps / (1 << (GRID_BITS - samples.depth))
        cells = np.floor(places).astype(np.int64)
        codes = encode_cells(np.clip(cells, 0, (1 << samples.depth) - 1))
        at = np.minimum(np.searchsorted(samples.codes, codes), samples.codes.size - 1)
        there = np.flatnonzero(samples.codes[at] == codes)
        values = source.evaluate(triangles[there], barycentric[there], np.zeros(there.size, np.float32))
        opaque = values[:, -1] > 0
        there, values = there[opaque], values[opaque]
        order = np.argsort(at[there], kind="stable")
        there, values = there[order], values[order]
        own = at[there]
        within = (places[there] - cells[there]) * PLACE_STEPS
        counts = np.bincount(own, minlength=samples.codes.size)
        shares = samples.shares.copy()
        faint = np.repeat(counts > 0, np.diff(samples.firsts))
        shares[faint] = np.maximum(shares[faint] // _PIXELS_OUTWEIGH, 1)
        ends = samples.firsts[own + 1]
        samples = samples._replace(
            firsts=samples.firsts + np.concatenate([[0], np.cumsum(counts)]),
            places=np.insert(
                samples.places, ends, np.clip(within, 0, PLACE_STEPS - 1).astype(np.uint16), axis=0
            ),
            shares=np.insert(shares, ends, np.uint8(SHARE_STEPS)),
            values=np.insert(samples.values, ends, values.astype(samples.values.dtype), axis=0),
        )
    return samples


def _of_cells(samples: Samples, cells: npt.NDArray[np.int64]) -> Samples:
    """Return the samples of some cells, in order."""
    counts = np.diff(samples.firsts)[cells]
    firsts = np.concatenate([[0], np.cumsum(counts)])
    rows = np.repeat(samples.firsts[cells] - firsts[:-1], counts) + np.arange(firsts[-1])
    return samples._replace(
        codes=samples.codes[cells],
        firsts=firsts,
        places=samples.places[rows],
        shares=samples.shares[rows],
        values=samples.values[rows],
    )
