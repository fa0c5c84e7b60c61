"""Makes an atlas for any surface: cuts it into charts, flattens and packs them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Floats, Int32s, Int64s
from octex.baking.charts import Flattened, laid_flat
from octex.baking.layout import Layout, charts_of, doubled_areas
from octex.baking.unfold import SIDE
from octex.errors import ModelError
from octex.jit import kernel, part
from octex.source.corners import Corners
from octex.source.mesh import Mesh
from octex.source.welding import distinct_rows, first_equal

#: Triangles that xatlas gets at once: with ten times as many, each takes about four times as long.
_PIECE = 4_000
#: Charts sorted by size fit at the final scale, and do not at one this much larger.
_CLOSE = 1.02
#: Then shuffled orders, with sizes times a random factor, are tried at slightly larger scales: as often as
#: _TRIED charts fit into maps of _TRIED_BLOCKS blocks a side, at most _MOST_TRIED times.
_CLOSER, _SHUFFLED = 1.005, (0.7, 1.4)
_TRIED, _TRIED_BLOCKS, _MOST_TRIED = 2_000, 256, 30
#: The largest charts, this many, are placed in the best of four rotations.
_MOST_TURNED = 100
#: Part of a map that charts fill at best, typically, and at least where the padding is chosen.
_FULL, _USUAL, _ENOUGH = 0.92, 0.6, 0.25
#: Largest part of a map for padding, where charts fill the typical part.
_GUTTERS = 0.2
#: Paddings to choose from, widest first: in the last size, and where the map may still grow.
_PADDINGS, _WIDE_PADDINGS = (8, 4, 2, 1, 0), (8, 4, 2)
#: Charts start at multiples of these texels. With 8, texels of the next three mips never mix two charts.
_ALIGNMENTS = (8, 4, 2, 1)
#: Most blocks of texels along a side of a map, where charts start at multiples below 8.
_MOST_BLOCKS = 1024
#: Rotations by quarter turns.
_QUARTERS = np.array([[[c, s], [0.0 - s, c]] for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))])
#: Seconds that xatlas may take.
_PATIENCE = 60.0


def atlas_layout(
    mesh: Mesh, sizes: Sequence[int], padding: int | None, texel: float, *, by_xatlas: bool = False
) -> Layout:
    """Lay a surface out in a square map of charts with ``padding`` texels around each.

    Charts are those of `charts.laid_flat`, or of xatlas. The map gets the first of ``sizes`` whose texels are
    at most ``texel`` wide, in rest units, or the last one. Without ``padding`` it is the widest,
    8 to 2, that keeps texels this small; in the last size the widest, 8 to 0, that takes at most a fifth.
    Raises ModelError if the charts do not fit.
    """
    flat, charts, edges = _by_xatlas(mesh) if by_xatlas else laid_flat(mesh)
    outlines = _outlines(flat, charts, edges)
    area = float(outlines.areas.sum())
    low, high = mesh.bounds
    needed_scale = float((high - low).max()) / (SIDE * texel)
    for size in sizes:
        is_last = size == sizes[-1]
        least = 1.0 if is_last else needed_scale
        spacings = _spacings(size, padding, is_last)
        if padding is None and is_last:
            spacings = [
                each for each in spacings if each[0] <= 2 or _gutters(outlines, size, each[0]) <= _GUTTERS
            ]
        for spacing in spacings:
            if is_last and area > 0.0:
                least = size * (_ENOUGH / area) ** 0.5 if spacing != spacings[-1] else area**-0.5
            packing, margin = _fitted(outlines, size, spacing, least), spacing[0]
            if packing is not None:
                break
        if packing is not None:
            scale, shifts, turns = packing
            map_corners = scale * (flat @ turns[charts]) + shifts[charts][:, None]
            faces = np.arange(len(charts), dtype=np.int32)
            values, rows = distinct_rows((map_corners / size).reshape(-1, 2).astype(np.float32))
            uv = Corners(values, rows.reshape(-1, 3).astype(np.int32))
            return Layout(uv, map_corners, faces, charts, edges, size, size, margin)
    raise ModelError(
        f"{mesh.name}: {int(charts.max()) + 1:,} charts do not fit in a map of {size} × {size} texels; "
        f"make it larger{', or the padding smaller' if padding else ''}"
    )


def _spacings(size: int, padding: int | None, is_last: bool) -> list[tuple[int, int]]:
    """Return paddings, widest first, each with the multiples of texels at which charts start."""
    least = min(1 << ((size - 1) // _MOST_BLOCKS).bit_length(), _ALIGNMENTS[0])
    if padding is not None:
        return [(padding, each) for each in _ALIGNMENTS if each >= least]
    return [(each, max(each, least)) for each in (_PADDINGS if is_last else _WIDE_PADDINGS)]


def _gutters(outlines: _Outlines, size: int, padding: int) -> float:
    """Estimate the part of a map that padding takes, where charts fill the typical part."""
    area = max(float(outlines.areas.sum()), 1e-300)
    area_per_texel = 2.0 * float(outlines.reaches.sum()) * size * np.sqrt(_USUAL / area)
    return float(area_per_texel * padding + 4.0 * padding**2 * len(outlines.areas)) / size**2


def _fitted(
    outlines: _Outlines, size: int, spacing: tuple[int, int], least: float
) -> tuple[float, Float64s, Float64s] | None:
    """Pack charts in a square map at nearly the largest scale that fits; None if below the ``least`` scale.

    Returns the scale, the shift of each chart (n, 2), and the rotation before that (n, 2, 2).
    """
    area = float(outlines.areas.sum())
    sizes = outlines.reaches.max(axis=1)
    order = np.argsort(-sizes, kind="stable")
    too_large = size * np.sqrt(_FULL / area) if area > 0.0 else least
    scale, placed = too_large, _packed(outlines, order, too_large, size, *spacing)
    while placed is None:
        if scale <= least:
            return None
        too_large, scale = scale, max(scale / 2.0, least)
        placed = _packed(outlines, order, scale, size, *spacing)
    while too_large > scale * _CLOSE:
        middle = np.sqrt(scale * too_large)
        denser = _packed(outlines, order, middle, size, *spacing)
        if denser is None:
            too_large = middle
        else:
            scale, placed = middle, denser
    random = np.random.default_rng(0)
    count = int(_TRIED / len(sizes) * (_TRIED_BLOCKS * spacing[1] / size) ** 3)
    for _ in range(min(count, _MOST_TRIED)):
        shuffled = np.argsort(-sizes * random.uniform(*_SHUFFLED, sizes.size), kind="stable")
        denser = _packed(outlines, shuffled, scale * _CLOSER, size, *spacing)
        if denser is not None:
            scale, placed = scale * _CLOSER, denser
    return scale, *placed


def _by_xatlas(mesh: Mesh) -> Flattened:
    """Flatten a mesh by xatlas; its longest side becomes `SIDE`.

    Raises ModelError without the extra, and for a mesh that would take long.
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
    corners, right, flattened = np.empty((len(triangles), 3, 2)), 0.0, 0
    began = time.perf_counter()
    for piece in _pieces(positions[triangles].mean(axis=1), np.arange(len(triangles))):
        used, faces = np.unique(triangles[piece], return_inverse=True)
        atlas = xatlas.Atlas()
        atlas.add_mesh(positions[used], faces.reshape(-1, 3).astype(np.uint32))
        atlas.generate(xatlas.ChartOptions(), options)
        _, rows, coordinates = atlas[0]
        corners[piece] = coordinates[rows].astype(np.float64) * (atlas.width, atlas.height) + (right, 0.0)
        right, flattened = right + atlas.width + 1.0, flattened + len(piece)
        seconds = (time.perf_counter() - began) * len(triangles) / flattened
        if seconds > _PATIENCE and flattened < len(triangles):
            raise ModelError(f'{mesh.name}: xatlas would take about {seconds:.0f} seconds; choose uv="atlas"')
    return Flattened(corners, *charts_of(mesh, corners))


def _pieces(middles: Floats, rows: Int64s) -> list[Int64s]:
    """Split triangles, by their centres (m, 3), into halves until xatlas is fast on each."""
    if rows.size <= _PIECE:
        return [rows]
    axis = int(np.argmax(np.ptp(middles[rows], axis=0)))
    order = rows[np.argsort(middles[rows, axis], kind="stable")]
    return [
        *_pieces(middles, np.sort(order[: rows.size // 2])),
        *_pieces(middles, np.sort(order[rows.size // 2 :])),
    ]


class _Outlines(NamedTuple):
    """The borders of charts, rotated until their boxes are small and wide; each starts at 0."""

    sides: Float64s  # (k, 2, 2)   from a point to the next, chart by chart
    starts: Int64s  # (n + 1,)   the first side of each chart
    turns: Float64s  # (n, 2, 2)   the rotation of each chart
    lows: Float64s  # (n, 2)   subtracted after the rotation
    reaches: Float64s  # (n, 2)   the largest coordinates
    areas: Float64s  # (n,)


def _outlines(flat: Float64s, charts: Int32s, edges: Bools) -> _Outlines:
    areas = np.bincount(charts, np.abs(doubled_areas(flat)) / 2.0).astype(np.float64)
    is_closed = np.bincount(charts, edges.any(axis=1)) == 0
    triangles, sides = np.nonzero(edges | is_closed[charts][:, None])  # closed charts have no area
    order = np.argsort(charts[triangles], kind="stable")
    triangles, sides = triangles[order], sides[order]
    borders = np.stack([flat[triangles, sides], flat[triangles, (sides + 1) % 3]], axis=1)
    starts = np.append(np.flatnonzero(np.diff(charts[triangles], prepend=-1)), len(triangles))
    angles = np.radians(np.arange(0.0, 180.0, 5.0))
    turns = np.array([[[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] for a in angles])
    least, best_turn = np.full(len(areas), np.inf), np.zeros(len(areas), np.int64)
    half = len(turns) // 2  # a turn that swaps width and height
    for n, turn in enumerate(turns[:half]):
        points = borders[:, 0] @ turn
        low, high = np.minimum.reduceat(points, starts[:-1]), np.maximum.reduceat(points, starts[:-1])
        width, height = (high - low).T
        is_better = width * height < least
        least[is_better] = (width * height)[is_better]
        best_turn[is_better] = np.where(width < height, n + half, n)[is_better]
    counts = np.diff(starts)
    borders = borders @ turns[np.repeat(best_turn, counts)]
    lows = np.minimum.reduceat(borders.min(axis=1), starts[:-1])
    borders -= np.repeat(lows, counts, axis=0)[:, None]
    reaches = np.maximum.reduceat(borders.max(axis=1), starts[:-1])
    return _Outlines(borders, starts, turns[best_turn], lows, reaches, areas)


def _packed(
    outlines: _Outlines, order: Int64s, scale: float, size: int, padding: int, block: int
) -> tuple[Float64s, Float64s] | None:
    """Place charts in a square map in the order given, on a grid of blocks; return None if they do not fit.

    Returns the shift of each chart (n, 2), after it was rotated (n, 2, 2) and scaled.
    """
    sides, starts, turns, lows, reaches, areas = outlines
    blocks = size // block
    # Padding enlarges a chart at least as much as a disc of its area (Brunn and Minkowski).
    needed = (scale * np.sqrt(areas) + np.sqrt(np.pi) * padding) ** 2
    if (scale * reaches + 2 * padding > size).any() or needed.sum() > size**2:
        return None
    free, longest = np.ones((blocks, blocks), np.bool_), np.full(blocks, blocks, np.int64)
    last_places: dict[tuple[int, ...], tuple[int, Bools]] = {}  # position of the last mask of each shape
    shifts, turned = np.empty((len(areas), 2)), turns.copy()
    for n, chart in enumerate(order.tolist()):
        outline = scale * sides[starts[chart] : starts[chart + 1]]
        best_end: tuple[int, ...] = ()
        for quarter_turn in _QUARTERS if n < _MOST_TURNED else _QUARTERS[:1]:
            reach = scale * reaches[chart] @ quarter_turn
            begin = np.minimum(reach, 0.0) - padding
            across, down = ((np.abs(reach) + 2 * padding) // block + 1).astype(np.int64)
            if max(across, down) > blocks:
                continue
            mask = np.zeros((int(down), int(across)), np.bool_)
            _mark((outline @ quarter_turn - begin) / block, padding / block, mask)
            last, last_mask = last_places.get(mask.shape, (-1, mask))
            block_number = _place(free, longest, mask, last + 1 if mask[last_mask].all() else 0)
            row, column = divmod(block_number, blocks)
            end = row + len(mask), column
            if block_number >= 0 and (not best_end or end < best_end):
                best_end, chosen = end, mask
                turned[chart] = turns[chart] @ quarter_turn
                shifts[chart] = np.array([column, row]) * block - begin - scale * lows[chart] @ quarter_turn
        if not best_end:
            return None
        row = best_end[0] - len(chosen)
        last_places[chosen.shape] = row * blocks + best_end[1], chosen
        _occupy(free[row : best_end[0]], longest[row : best_end[0]], chosen, best_end[1])
    return shifts, turned


@kernel
def _mark(sides: Float64s, margin: float, mask: Bools) -> None:
    """Mark the blocks inside an outline (k, 2, 2), in blocks, and those within ``margin`` of it."""
    height, width = mask.shape
    winding = np.zeros((height, width + 1), np.int32)
    for n in range(sides.shape[0]):
        x, y = sides[n, 0, 0], sides[n, 0, 1]
        right, down = sides[n, 1, 0] - x, sides[n, 1, 1] - y
        for row in range(int(np.ceil(min(y, y + down) - 0.5)), int(np.ceil(max(y, y + down) - 0.5))):
            x_of_row = x + right * (row + 0.5 - y) / down
            winding[row, int(np.ceil(x_of_row - 0.5))] += 1 if down > 0.0 else -1
        squared = right * right + down * down
        first, last = max(int(min(x, x + right) - margin), 0), int(max(x, x + right) + margin)
        for row in range(
            max(int(min(y, y + down) - margin), 0), min(int(max(y, y + down) + margin), height - 1) + 1
        ):
            for column in range(first, min(last, width - 1) + 1):
                mask[row, column] |= _is_near(x - column, y - row, right, down, squared, margin)
    for row in range(height):
        turns = 0
        for column in range(width):
            turns += winding[row, column]
            mask[row, column] |= turns != 0


@part
def _is_near(x: float, y: float, right: float, down: float, squared: float, margin: float) -> bool:
    """Return whether a side comes within ``margin`` of the unit square; x, y is its start."""
    first, last = 0.0, 1.0  # the part of the side within the square
    for at, step in ((x, right), (y, down)):
        if step == 0.0:
            if at < 0.0 or at > 1.0:
                last = -1.0
        else:
            one, two = -at / step, (1.0 - at) / step
            first, last = max(first, min(one, two)), min(last, max(one, two))
    if first <= last:
        return True
    reach = margin * margin
    for _ in range(2):
        across, beyond = max(-x, max(x - 1.0, 0.0)), max(-y, max(y - 1.0, 0.0))
        if across * across + beyond * beyond <= reach:
            return True
        x, y = x + right, y + down
    x, y = x - 2.0 * right, y - 2.0 * down
    for n in range(4):
        across, beyond = n % 2 - x, n // 2 - y
        along = min(max((across * right + beyond * down) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
        if (across - along * right) ** 2 + (beyond - along * down) ** 2 <= reach:
            return True
    return False


@kernel
def _place(free: Bools, longest: Int64s, mask: Bools, start: int) -> int:
    """Put a mask into the first free blocks from ``start`` on; ``longest`` are the rows' free runs."""
    height, width = mask.shape
    blocks = free.shape[0]
    runs = np.zeros((height, width), np.int64)  # length of the mask's run that ends at each block
    needed = np.zeros(height, np.int64)  # the longest of each row
    for y in range(height):
        for x in range(width):
            if mask[y, x]:
                runs[y, x] = runs[y, x - 1] + 1 if x else 1
                needed[y] = max(needed[y], runs[y, x])
    row, column = start // blocks, start % blocks
    while row + height <= blocks:
        for y in range(height):
            if longest[row + y] < needed[y]:
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
def _occupy(free: Bools, longest: Int64s, mask: Bools, column: int) -> None:
    """Occupy a mask's blocks of rows, and update the rows' longest free runs."""
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                free[y, column + x] = False
        run = longest[y] = 0
        for x in range(free.shape[1]):
            run = run + 1 if free[y, x] else 0
            longest[y] = max(longest[y], run)
