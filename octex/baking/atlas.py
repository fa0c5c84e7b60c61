"""An atlas for any surface: cut into charts, flattened, packed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from octex.arrays import Bools, Float64s, Floats, Int64s
from octex.baking.charts import SIDE, laid_flat
from octex.baking.layout import Layout, charts_of, doubled_areas
from octex.errors import ModelError
from octex.jit import kernel
from octex.source.corners import Corners
from octex.source.mesh import Mesh
from octex.source.welding import first_equal, welded

#: Triangles that xatlas cuts into charts at once: of ten times as many each takes some four times as long.
_PIECE = 4_000
#: Charts fit at their scale, and not at one that is more than so much larger: few charts, and more than a
#: thousand, whose packing takes long.
_CLOSE, _CLOSE_OF_MANY, _MANY = 1.01, 1.05, 1000
#: Of so many of the largest charts the best of four ways to lie is taken.
_MOST_TURNED = 100
#: How much of a map charts fill at best, and how much at least where padding is chosen.
_FULL, _ENOUGH = 0.92, 0.25
#: Paddings to choose from, the widest first: in the last size, and where the map can be larger instead.
_PADDINGS, _WIDE_PADDINGS = (8, 4, 2, 1, 0), (8, 4, 2)
#: Charts start at multiples of so many texels. With 8 no texel of three smaller levels has parts of two.
_ALIGNMENTS = (8, 4, 2, 1)
#: Blocks of texels along a side of a map, at most, where charts start at multiples of less than 8.
_MOST_BLOCKS = 1024
#: Seconds that xatlas may take.
_PATIENCE = 60.0


def atlas_layout(
    mesh: Mesh, sizes: Sequence[int], padding: int | None, texel: float, *, by_xatlas: bool = False
) -> Layout:
    """Lay a surface out in a square map of charts with ``padding`` texels around each.

    Charts are those of `charts.laid_flat`, or of xatlas. The map has the first of ``sizes`` whose texels are
    at most ``texel`` wide, in rest units, or the last. Without a ``padding`` it is the widest, 8 to 2, with
    which texels are that small; in the last size the widest, 8 to 0, with which charts fill a quarter of the
    map. Raises ModelError if that size is too small for so many charts.
    """
    flat = _by_xatlas(mesh) if by_xatlas else laid_flat(mesh)
    charts, edges = charts_of(mesh, flat)
    order = np.argsort(charts, kind="stable")
    starts = np.flatnonzero(np.diff(charts[order], prepend=-1))  # in that order, chart by chart
    flat = _upright(flat[order], edges[order], starts)
    area = _area(flat)
    low, high = mesh.bounds
    wanted = float((high - low).max()) / (SIDE * texel)
    for size in sizes:
        is_last = size == sizes[-1]
        least = 1.0 if is_last else wanted
        spacings = _spacings(size, padding, is_last)
        for spacing in spacings:
            if is_last and area > 0.0:
                least = size * (_ENOUGH / area) ** 0.5 if spacing != spacings[-1] else area**-0.5
            best, around = _fitted(flat, starts, area, size, spacing, least), spacing[0]
            if best is not None:
                break
        if best is not None:
            placed = np.empty_like(best)
            placed[order] = best
            faces = np.arange(len(charts), dtype=np.int32)
            points = (placed / size).reshape(-1, 2).astype(np.float32)
            rows = welded(points)
            values = np.empty((int(rows.max()) + 1, 2), np.float32)
            values[rows] = points
            uv = Corners(values, rows.reshape(-1, 3))
            return Layout(uv, placed, faces, charts, edges, size, size, around)
    raise ModelError(
        f"{mesh.name}: {int(charts.max()) + 1:,} charts do not fit in a map of {size} × {size} texels; "
        f"make it larger{', or the padding smaller' if padding else ''}"
    )


def _spacings(size: int, padding: int | None, is_last: bool) -> list[tuple[int, int]]:
    """Return paddings, and the multiples of texels that charts start at with each, the widest first."""
    least = min(1 << ((size - 1) // _MOST_BLOCKS).bit_length(), _ALIGNMENTS[0])
    if padding is not None:
        return [(padding, each) for each in _ALIGNMENTS if each >= least]
    return [(each, max(each, least)) for each in (_PADDINGS if is_last else _WIDE_PADDINGS)]


def _fitted(
    flat: Float64s, starts: Int64s, area: float, size: int, spacing: tuple[int, int], least: float
) -> Float64s | None:
    """Place charts in a square map, about as large as they fit; None if not at the ``least`` scale."""
    most = size * np.sqrt(_FULL / area) if area > 0.0 else least
    low, placed = most, _packed(flat * most, starts, size, *spacing)
    while placed is None:
        if low <= least:
            return None
        most, low = low, max(low / 2.0, least)
        placed = _packed(flat * low, starts, size, *spacing)
    close = _CLOSE if len(starts) <= _MANY else _CLOSE_OF_MANY
    while most > low * close:
        middle = np.sqrt(low * most)
        tried = _packed(flat * middle, starts, size, *spacing)
        if tried is None:
            most = middle
        else:
            low, placed = middle, tried
    return placed


def _by_xatlas(mesh: Mesh) -> Float64s:
    """Return flattened corners (m, 3, 2) by xatlas, `SIDE` for the longest side; charts lie apart.

    Raises ModelError without the extra, and where it would take long.
    """
    try:
        import xatlas
    except ImportError:
        raise ModelError('uv="xatlas" needs xatlas: pip install "octex[atlas]"; or choose "atlas"') from None
    low, high = mesh.bounds
    positions = ((mesh.rest - low) / (float((high - low).max()) or 1.0)).astype(np.float32)
    triangles = first_equal(mesh.rest)[mesh.triangles]
    options = xatlas.PackOptions()
    options.texels_per_unit, options.bruteForce = SIDE, False
    corners, right, done = np.empty((len(triangles), 3, 2)), 0.0, 0
    began = time.perf_counter()
    for piece in _pieces(positions[triangles].mean(axis=1), np.arange(len(triangles))):
        used, faces = np.unique(triangles[piece], return_inverse=True)
        atlas = xatlas.Atlas()
        atlas.add_mesh(positions[used], faces.reshape(-1, 3).astype(np.uint32))
        atlas.generate(xatlas.ChartOptions(), options)
        _, rows, coordinates = atlas[0]
        corners[piece] = coordinates[rows].astype(np.float64) * (atlas.width, atlas.height) + (right, 0.0)
        right, done = right + atlas.width + 1.0, done + len(piece)
        needs = (time.perf_counter() - began) * len(triangles) / done
        if needs > _PATIENCE and done < len(triangles):
            raise ModelError(f'{mesh.name}: xatlas would take about {needs:.0f} seconds; choose uv="atlas"')
    return corners


def _pieces(middles: Floats, some: Int64s) -> list[Int64s]:
    """Cut triangles, by their middles (m, 3), into pieces that xatlas is quick with: halves of halves."""
    if some.size <= _PIECE:
        return [some]
    axis = int(np.argmax(np.ptp(middles[some], axis=0)))
    order = some[np.argsort(middles[some, axis], kind="stable")]
    return [
        *_pieces(middles, np.sort(order[: some.size // 2])),
        *_pieces(middles, np.sort(order[some.size // 2 :])),
    ]


def _area(flat: Float64s) -> float:
    return float(np.abs(doubled_areas(flat)).sum() / 2)


def _upright(flat: Float64s, edges: Bools, starts: Int64s) -> Float64s:
    """Turn charts until their boxes are small and wide; ``starts`` are their first triangles."""
    turns = np.array([_turn(angle) for angle in np.radians(np.arange(0.0, 180.0, 5.0))])
    least = np.full(len(starts), np.inf)
    best = np.zeros(len(starts), np.int64)
    sizes = np.diff(starts, append=len(flat))
    is_closed = ~np.logical_or.reduceat(edges.any(axis=1), starts)
    edges = edges | np.repeat(is_closed, sizes)[:, None]  # without area
    border = flat[edges]
    firsts = np.searchsorted(np.nonzero(edges)[0], starts)
    quarter = len(turns) // 2  # where sides change places
    for n, turn in enumerate(turns[:quarter]):
        points = border @ turn
        width, height = (np.maximum.reduceat(points, firsts) - np.minimum.reduceat(points, firsts)).T
        found = width * height < least
        least[found] = (width * height)[found]
        best[found] = np.where(width < height, n + quarter, n)[found]
    turned = flat @ turns[np.repeat(best, sizes)]
    low, _ = _boxes(turned, starts)
    upright: Float64s = turned - np.repeat(low, sizes, axis=0)[:, None]
    return upright


def _boxes(flat: Float64s, starts: Int64s) -> tuple[Float64s, Float64s]:
    """Return the least and the largest coordinates (n, 2) of charts."""
    a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)


def _turn(angle: float) -> Float64s:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def _packed(flat: Float64s, starts: Int64s, size: int, padding: int, block: int) -> Float64s | None:
    """Place charts (m, 3, 2), in texels, in a square map by blocks of texels; return None without room."""
    blocks = size // block
    _, reaches = _boxes(flat, starts)
    areas = np.add.reduceat(np.abs(doubled_areas(flat)) / 2.0, starts)
    # Padding adds at least as much to a chart as to a disc of its area (Brunn and Minkowski).
    needed = (np.sqrt(areas) + np.sqrt(np.pi) * padding) ** 2
    if (reaches + 2 * padding > size).any() or needed.sum() > size**2:
        return None
    groups = [slice(*ends) for ends in pairwise([*starts.tolist(), len(flat)])]
    free, longest = np.ones((blocks, blocks), np.bool_), np.full(blocks, blocks, np.int64)
    tried: dict[tuple[int, ...], tuple[int, Bools]] = {}  # where masks are that were placed last, by shape
    placed = np.empty_like(flat)
    for n, group in enumerate(np.argsort(-reaches.max(axis=1), kind="stable").tolist()):
        own = groups[group]
        best: tuple[int, ...] = ()
        for turn in range(4 if n < _MOST_TURNED else 1):
            corners = _turned(flat[own], reaches[group], turn)
            across, down = (corners.max(axis=(0, 1)) + 2 * padding) // block + 1
            if max(across, down) > blocks:
                continue
            mask = np.zeros((int(down), int(across)), np.bool_)
            _mark((corners + padding) / block, padding / block, mask)
            last, before = tried.get(mask.shape, (-1, mask))
            at = _place(free, longest, mask, last + 1 if mask[before].all() else 0)
            if at >= 0 and (not best or (at // blocks + len(mask), at % blocks) < best):
                row, column = divmod(at, blocks)
                best, chosen = (row + len(mask), column), mask
                placed[own] = np.array([column, row]) * block + padding + corners
        if not best:
            return None
        row = best[0] - len(chosen)
        tried[chosen.shape] = row * blocks + best[1], chosen
        _take(free[row : best[0]], longest[row : best[0]], chosen, best[1])
    return placed


def _turned(corners: Float64s, reach: Float64s, quarters: int) -> Float64s:
    """Turn a chart by quarters; it reaches from 0 to ``reach`` (2,)."""
    for _ in range(quarters):
        corners = np.stack([reach[1] - corners[..., 1], corners[..., 0]], axis=-1)
        reach = reach[::-1]
    return corners


@kernel
def _mark(corners: Float64s, around: float, mask: Bools) -> None:
    """Mark the blocks that triangles (m, 3, 2), in blocks, reach, and what is so near ``around`` them."""
    for triangle in range(corners.shape[0]):
        a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
        x0 = max(int(np.floor(min(a[0], min(b[0], c[0])) - around)), 0)
        x1 = min(int(np.floor(max(a[0], max(b[0], c[0])) + around)), mask.shape[1] - 1)
        y0 = max(int(np.floor(min(a[1], min(b[1], c[1])) - around)), 0)
        y1 = min(int(np.floor(max(a[1], max(b[1], c[1])) + around)), mask.shape[0] - 1)
        doubled = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        sign = 1.0 if doubled >= 0.0 else -1.0
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                apart = False
                for k in range(3):
                    p, q = corners[triangle, k], corners[triangle, (k + 1) % 3]
                    across, down = sign * (p[1] - q[1]), sign * (q[0] - p[0])
                    length = np.sqrt(across * across + down * down)
                    most = across * (x - p[0]) + down * (y - p[1]) + max(across, 0.0) + max(down, 0.0)
                    apart |= most < -around * length * 1.5
                if not apart:
                    mask[y, x] = True


@kernel
def _place(free: Bools, longest: Int64s, mask: Bools, start: int) -> int:
    """Put a mask into the first free blocks from ``start`` on; ``longest`` are rows' free runs."""
    height, width = mask.shape
    blocks = free.shape[0]
    runs = np.zeros((height, width), np.int64)  # how many blocks of a run there are up to each
    for y in range(height):
        for x in range(width):
            if mask[y, x]:
                runs[y, x] = runs[y, x - 1] + 1 if x else 1
    row, column = start // blocks, start % blocks
    while row + height <= blocks:
        for y in range(height):
            if longest[row + y] < runs[y].max():
                column = blocks
                break
        while column + width <= blocks:
            step = np.int64(0)
            for y in range(height):
                x = width - 1
                while x >= 0 and (runs[y, x] == 0 or free[row + y, column + x]):
                    x -= 1
                if x >= 0:
                    step = runs[y, x]
                    break
            if step == 0:
                return int(row * blocks + column)
            column += step
        row, column = row + 1, 0
    return -1


@kernel
def _take(free: Bools, longest: Int64s, mask: Bools, column: int) -> None:
    """Take a mask's blocks from rows, and find the longest runs of what is free in these anew."""
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                free[y, column + x] = False
        run = longest[y] = 0
        for x in range(free.shape[1]):
            run = run + 1 if free[y, x] else 0
            longest[y] = max(longest[y], run)
