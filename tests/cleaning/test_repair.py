"""Repairs against what is known of a shape beforehand: copies, slivers, cracks, and parts inside others."""

import json

import numpy as np
import pytest
import trimesh

import octex
from octex.errors import ArgumentError, ModelError

#: A cell of depth 10 of a model that is 2 wide.
CELL = 2.0 / 1021


def ball(radius=1.0, centre=(0, 0, 0), fineness=3):
    made = trimesh.creation.icosphere(fineness)
    return made.vertices * radius + centre, made.faces


def box(low, high):
    made = trimesh.creation.box(bounds=[low, high])
    return np.asarray(made.vertices), np.asarray(made.faces)


def joined(*parts):
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + first for (_, faces), first in zip(parts, firsts, strict=False)]
    return octex.Surface.from_arrays(
        np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)
    )


def n_open(surface):
    """The number of edges that one triangle alone has, by the positions of their ends."""
    seen = {}
    for corners in surface.rest[surface.triangles]:
        for i in range(3):
            edge = tuple(sorted([tuple(corners[i]), tuple(corners[(i + 1) % 3])]))
            seen[edge] = seen.get(edge, 0) + 1
    return sum(count == 1 for count in seen.values())


def test_copies_and_slivers_are_left_out_and_the_others_keep_what_they_have():
    vertices, faces = ball(fineness=2)
    sliver = [[0, 0, 5], [7, 9, 7], [1, 2, len(vertices)]]  # the last one: three points on a line
    vertices = np.concatenate([vertices, [(vertices[1] + vertices[2]) / 2]])
    copies = np.stack([faces[5], np.roll(faces[8], 1), faces[9][::-1]])  # the last one winds the other way
    every = np.concatenate([sliver, faces, copies])
    colors = np.random.default_rng(0).random((len(every), 3))
    uv = np.random.default_rng(1).random((len(every), 3, 2))
    surface = octex.Surface.from_arrays(vertices, every, face_colors=colors, uv=uv)
    found, counts = octex.repair(surface)
    assert counts == (0, 3, 2, 0, 0)
    assert str(counts) == "left out triangles: 3 without area, 2 duplicate"
    assert json.loads(found.provenance["repair"]) == counts._asdict()
    kept = np.delete(np.arange(len(every)), [0, 1, 2, len(every) - 3, len(every) - 2])
    np.testing.assert_array_equal(found.vertices[found.triangles], surface.vertices[surface.triangles[kept]])
    np.testing.assert_array_equal(found.uv.values[found.uv.rows], surface.uv.values[surface.uv.rows[kept]])
    middles = np.full((len(kept), 3), 1 / 3)
    values = found.evaluate_all(np.arange(len(kept)), middles, np.zeros(len(kept)))
    np.testing.assert_allclose(values[:, :3], colors[kept], atol=1e-6)
    again, nothing = octex.repair(found)
    assert nothing == (0, 0, 0, 0, 0)
    assert str(nothing) == "left out no triangle"
    np.testing.assert_array_equal(again.triangles, found.triangles)


def test_what_lies_inside_is_left_out_by_the_spheres_formula():
    """Shells, one thinner than a cell away, and a ball that pokes out of another."""
    parts = [((0, 0, 0), 1.0), ((0, 0, 0), 0.995), ((0.1, 0, 0), 0.4), ((1, 0.1, 0), 0.3)]
    surface = joined(*(ball(radius, centre, 4) for centre, radius in parts))
    numbers = np.repeat(np.arange(4), 5120)
    found, counts = octex.repair(surface)
    left = {tuple(each) for each in found.rest[found.triangles].reshape(-1, 9)}
    is_kept = np.array([tuple(each) in left for each in surface.rest[surface.triangles].reshape(-1, 9)])
    assert counts.inner == (~is_kept).sum()
    corners = surface.rest[surface.triangles]
    is_free, is_deep = np.ones(len(corners), np.bool_), np.zeros(len(corners), np.bool_)
    for part, (centre, radius) in enumerate(parts):
        away = np.linalg.norm(corners - centre, axis=2)
        is_free &= (numbers == part) | (away.min(axis=1) > radius)
        is_deep |= (numbers != part) & (away.max(axis=1) < radius * 0.998)  # facets lie inside of their ball
    assert is_deep[numbers == 1].all()
    assert is_deep[numbers == 2].all()
    assert is_kept[is_free].all()
    assert not is_kept[is_deep].any()
    same, _ = octex.repair(surface)
    np.testing.assert_array_equal(same.triangles, found.triangles)
    assert octex.repair(surface, inner=False)[1] == (0, 0, 0, 0, 0)


def test_what_a_hole_or_a_narrow_slit_shows_stays():
    cup = joined(box((-1, -1, -1), (1, 1, 1)), box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)))
    assert octex.repair(cup)[1].inner == 12
    faces = cup.triangles[cup.rest[cup.triangles][:, :, 2].min(axis=1) < 1]  # without its top
    open_cup = octex.Surface.from_arrays(cup.rest, faces)
    assert octex.repair(open_cup)[1].inner == 0
    width = 1.5 * 2 / 1021  # of the slit, half of a cell of those that are looked through
    slit = joined(box((-1, -1, -1), (-width / 2, 1, 1)), box((width / 2, -1, -1), (1, 1, 1)))
    vertices, triangles = trimesh.remesh.subdivide_to_size(slit.rest, slit.triangles, 0.05)
    fine = octex.Surface.from_arrays(vertices, triangles)
    found, _ = octex.repair(fine)
    middles = found.rest[found.triangles].mean(axis=1)
    walls = fine.rest[fine.triangles].mean(axis=1)
    near = (np.abs(walls[:, 0]) <= width) & (np.abs(walls[:, 1:]).max(axis=1) > 0.99)
    assert (
        (np.abs(middles[:, 0]) <= width) & (np.abs(middles[:, 1:]).max(axis=1) > 0.99)
    ).sum() == near.sum()


@pytest.mark.parametrize("part", [0.0, 0.3])
def test_cracks_are_closed_and_nothing_moves_farther_than_they_are_wide(part):
    vertices, faces = ball(fineness=3)
    soup = vertices[faces].reshape(-1, 3)  # no two triangles share a vertex
    moved = soup + np.random.default_rng(0).uniform(-part, part, soup.shape) * CELL / 2
    surface = octex.Surface.from_arrays(moved, np.arange(len(soup)).reshape(-1, 3))
    found, counts = octex.repair(surface)
    assert n_open(surface) == (3 * len(faces) if part else 0)
    assert n_open(found) == 0
    assert counts == (0, 0, 0, 0, len(soup) if part else 0)
    assert np.abs(found.rest[found.triangles] - moved.reshape(-1, 3, 3)).max() <= CELL
    posed = surface.with_pose(moved * 2.0)
    again, _ = octex.repair(posed)
    np.testing.assert_allclose(again.vertices, again.rest * 2.0, atol=1e-12)
    np.testing.assert_array_equal(again.rest, found.rest)


def test_wider_cracks_thin_strips_and_borders_stay():
    steps = np.arange(50) * 0.02
    rows = [np.c_[steps, np.full(50, y), np.zeros(50)] for y in (-0.5, 0.0, 0.0015, 0.5)]
    i = np.arange(49)

    def strip(first, second):
        a, b = 50 * first + i, 50 * second + i
        return np.concatenate([np.c_[a, a + 1, b], np.c_[a + 1, b + 1, b]])

    sheets = octex.Surface.from_arrays(np.concatenate(rows), np.concatenate([strip(0, 1), strip(2, 3)]))
    assert octex.repair(sheets, cell=0.001)[1].moved == 0
    found, counts = octex.repair(sheets, cell=0.002)
    assert counts == (0, 0, 0, 0, 100)
    assert n_open(sheets) - n_open(found) == 98
    thin = octex.Surface.from_arrays(np.concatenate(rows), strip(1, 2))  # narrower than a cell
    assert octex.repair(thin, cell=0.002)[1] == (0, 0, 0, 0, 0)
    dense = np.c_[np.arange(400) / 8000, np.zeros((400, 2))]  # a border whose vertices lie near each other
    fan = octex.Surface.from_arrays(
        np.concatenate([dense, [[0, 1, 0]]]), np.c_[np.arange(399), np.arange(1, 400), np.full(399, 400)]
    )
    assert octex.repair(fan, cell=0.002)[1] == (0, 0, 0, 0, 0)


def test_a_dense_part_far_from_the_others_stays_as_it_is_and_takes_no_hours():
    random = np.random.default_rng(0)
    middles = np.repeat(random.random((15_000, 3)), 3, axis=0)
    dense = (middles + 0.02 * random.standard_normal(middles.shape)) * 1e-4, np.arange(45_000).reshape(-1, 3)
    apart = np.array([[1.0, 1, 1], [1.1, 1, 1], [1, 1.1, 1]]), np.array([[0, 1, 2]])
    made, counts = octex.repair(joined(dense, apart))
    assert counts == (0, 0, 0, 0, 0)
    assert len(made.triangles) == 15_001


def test_what_cannot_be_repaired_is_refused():
    vertices, faces = ball(fineness=1)
    surface = octex.Surface.from_arrays(vertices, faces)
    with pytest.raises(ArgumentError, match=r"must be an octex\.Surface"):
        octex.repair(vertices)
    for cell in (0.0, -1.0, np.inf):
        with pytest.raises(ArgumentError, match="cell must be finite and above zero"):
            octex.repair(surface, cell=cell)
    with pytest.raises(ArgumentError, match="inner must be True or False"):
        octex.repair(surface, inner=1)
    flat = octex.Surface.from_arrays(vertices, np.repeat(faces[:, :1], 3, axis=1))
    with pytest.raises(ModelError, match="no triangle has an area"):
        octex.repair(flat)
