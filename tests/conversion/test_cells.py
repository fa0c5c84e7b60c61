"""The cells that a surface meets, and the pieces in them, against rational arithmetic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells
from octex.voxelize.fragments import BlockRange, cut, divided, most_fragments, whole
from tests.conftest import needs_jit
from tests.make.small_surfaces import turned
from tests.make.solids import sphere
from tests.oracles import naive_cells


def cut_all(triangles, depth):
    grid = np.array(triangles, np.int32).reshape(-1, 3)
    indices = np.arange(len(grid), dtype=np.int32).reshape(-1, 3)
    blocks = divided(whole(grid, indices, depth))
    return cut_blocks(blocks, 0, len(blocks.codes))


def cut_blocks(blocks, first, last):
    most = int(most_fragments(blocks)[first:last].sum())
    return cut(blocks, BlockRange(first, last, most))


def check(triangles, depth):
    pieces = cut_all(triangles, depth)
    expected = naive_cells.sums_of(triangles, 1 << (GRID_BITS - depth))
    cells = [tuple(cell) for cell in decode_cells(pieces.codes).tolist()]
    assert set(cells) == set(expected)
    assert (np.diff(pieces.codes) > 0).all()
    areas = np.bincount(pieces.entries, pieces.areas, minlength=1)
    entry = 0
    for cell, flags in zip(cells, pieces.flags.tolist(), strict=True):
        facings = [facing for facing in range(6) if flags >> facing & 1]
        assert facings == sorted(expected[cell])
        for facing in facings:
            assert areas[entry] == pytest.approx(expected[cell][facing], rel=1e-9, abs=1e-9)
            entry += 1


def corners(low, high, step):
    """Corners on a coarse lattice, so that edges, planes and corners of cells are met exactly, and off it."""
    on_lattice = st.integers(low // step, high // step).map(lambda i: i * step)
    near = st.builds(lambda i, d: min(max(i + d, low), high), on_lattice, st.integers(-1, 1))
    coordinate = st.one_of(on_lattice, near, st.integers(low, high))
    return st.tuples(coordinate, coordinate, coordinate)


CELL = 1 << (GRID_BITS - 4)


@given(st.lists(corners(0, 4 * CELL - 1, CELL // 2), min_size=3, max_size=3))
def test_a_triangle_meets_exactly_the_cells_of_rational_arithmetic(triangle):
    check([triangle], 4)


@given(st.lists(corners(7 << 25, (7 << 25) + (1 << 12), 1 << 8), min_size=3, max_size=3))
def test_the_deepest_level_is_as_exact(triangle):
    check([triangle], 21)


@settings(max_examples=20)
@given(st.lists(st.lists(corners(3 * CELL, 7 * CELL, CELL), min_size=3, max_size=3), min_size=2, max_size=4))
def test_triangles_that_share_cells_add_up_by_facing(triangles):
    check(triangles, 5)


def test_a_triangle_that_rises_by_parts_of_a_millionth_has_no_area_above_its_highest_edge():
    low, high = 3 * CELL, 4 * CELL
    check([[(low, low + 1, high), (high, low, high - 19), (high, 5 * CELL, high)]], 5)


def test_blocks_do_not_show_in_triangles_of_several():
    cell = 1 << GRID_BITS - 6
    corners = [(28, 29, 30), (36, 31, 33), (31, 36, 34)]  # blocks meet at 32
    check([[tuple(cell * step + 7 for step in corner) for corner in corners]], 6)


def test_a_triangle_in_a_cell_plane_belongs_to_the_cell_above_it():
    low, high = 2 * CELL, 3 * CELL
    pieces = cut_all([[(low, low, high), (high - 1, low, high), (low, high - 1, high)]], 4)
    assert decode_cells(pieces.codes).tolist() == [[2, 2, 3]]


def test_degenerate_triangles_meet_nothing():
    pieces = cut_all([[(5, 5, 5), (9, 9, 9), (13, 13, 13)], [(7, 7, 7)] * 3], 4)
    assert pieces.codes.size == 0


def test_a_contact_takes_its_value_from_the_triangle():
    # The corner (0, 0) of the triangle touches the cell at the origin's corner only.
    pieces = cut_all([[(CELL, CELL, CELL), (2 * CELL, CELL, 2 * CELL), (CELL, 2 * CELL, 2 * CELL)]], 4)
    assert (pieces.areas > 0).all()
    assert (pieces.barycentric >= 0).all()
    assert np.allclose(pieces.barycentric.sum(axis=1), 1)


def test_centroids_lie_where_the_piece_is():
    triangle = [(0, 3 * CELL // 2, 7), (3 * CELL, 0, CELL), (CELL // 3, 3 * CELL, 2 * CELL + 5)]
    pieces = cut_all([triangle], 4)
    expected = naive_cells.cells_of(triangle, CELL)
    order = {tuple(cell): i for i, cell in enumerate(decode_cells(pieces.codes).tolist())}
    points = pieces.barycentric @ np.array(triangle, np.float64)
    rows = {int(entry): row for row, entry in enumerate(pieces.entries)}
    for cell, (area, center) in expected.items():
        if area > 1e-6:
            assert center is not None
            assert np.allclose(points[rows[order[cell]]], np.array(center, float), atol=1e-6 * CELL)


@needs_jit
@pytest.mark.parametrize("depth", range(22))
def test_blocks_are_of_32_cells_and_hold_the_triangles_that_meet_them(depth):
    grid, triangles = tilted_ball(12)
    triangles = triangles[:3] if depth > 14 else triangles
    grid = grid >> max(depth - 14, 0)  # small enough to have few cells
    blocks = divided(whole(grid, triangles, depth))
    assert (blocks.level, blocks.bits) == (max(depth - 5, 0), min(depth, 5))
    assert (np.diff(blocks.codes) > 0).all()
    owners = np.repeat(decode_cells(blocks.codes), np.diff(blocks.starts), axis=0) << GRID_BITS - blocks.level
    corners = grid[triangles[blocks.members]]
    assert (corners.min(axis=1) < owners + (1 << GRID_BITS - blocks.level)).all()
    assert (corners.max(axis=1) >= owners).all()
    if depth < 8:
        assert set(cut_blocks(blocks, 0, len(blocks.codes)).codes >> 3 * blocks.bits) == set(blocks.codes)


@needs_jit
def test_pieces_tile_a_closed_surface():
    grid, triangles = tilted_ball(60)
    blocks = divided(whole(grid, triangles, 9))
    pieces = cut_blocks(blocks, 0, len(blocks.codes))
    corners = grid[triangles].astype(np.float64) / 2.0 ** (GRID_BITS - 9)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert np.allclose(np.bincount(pieces.triangles, pieces.areas, len(triangles)), areas, rtol=1e-9)


@needs_jit
def test_the_cut_does_not_depend_on_how_blocks_are_grouped():
    grid, triangles = tilted_ball(60)
    blocks = divided(whole(grid, triangles, 8))
    every = cut_blocks(blocks, 0, len(blocks.codes))
    middle = len(blocks.codes) // 3
    first = cut_blocks(blocks, 0, middle)
    second = cut_blocks(blocks, middle, len(blocks.codes))
    for name in ("codes", "flags", "areas", "barycentric", "triangles"):
        assert np.array_equal(
            np.concatenate([getattr(first, name), getattr(second, name)]), getattr(every, name)
        )


def tilted_ball(segments):
    """The vertices on the grid, and the triangles, of a closed surface that no plane of cells halves."""
    points, triangles = sphere((0, 0, 0), 0.4, segments)
    return np.rint((points @ turned(3).T * [1, 0.9, 1.1] + 0.5) * 2**GRID_BITS).astype(np.int32), triangles
