"""Charts of an atlas: noise does not tear them apart, nothing folds or overlaps, and little is stretched."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import octex
from octex.baking import atlas
from octex.baking.charts import _merged, laid_flat
from octex.baking.layout import doubled_areas, neighbours_of
from octex.baking.texels import draw_texels
from octex.baking.unfold import SIDE, ChartMesh
from octex.errors import ModelError
from octex.source.corners import area_vectors, unit
from octex.source.mesh import Mesh
from tests.make.painted import halved_quads
from tests.make.solids import sphere
from tests.make.vxz import dual_grid

#: The corners of a square, counterclockwise.
RING = ((0, 0), (1, 0), (1, 1), (0, 1))


def noisy(subdivisions, noise):
    """A ball of radius 1 whose vertices are moved in and out."""
    made = trimesh.creation.icosphere(subdivisions)
    radii = 1.0 + noise * np.random.default_rng(0).standard_normal((len(made.vertices), 1))
    return Mesh(made.vertices * radii, np.asarray(made.faces))


def stretched(mesh, flat):
    """Return the L2 stretch of Sander et al. (2001): 1 for a map that keeps all lengths."""
    low, high = mesh.bounds
    corners = SIDE * ((mesh.rest - low) / (high - low).max())[mesh.triangles]
    e, f = (np.moveaxis(each[:, 1:] - each[:, :1], 1, 0) for each in (corners, flat))
    area = f[0, :, 0] * f[1, :, 1] - f[1, :, 0] * f[0, :, 1]
    along = (e[0] * f[1, :, 1:] - e[1] * f[0, :, 1:]) / area[:, None]
    down = (e[1] * f[0, :, :1] - e[0] * f[1, :, :1]) / area[:, None]
    spread = np.linalg.norm(np.cross(*e), axis=1)
    squares = ((along**2).sum(axis=1) + (down**2).sum(axis=1)) / 2.0
    return float(np.sqrt((squares * spread).sum() / spread.sum() * np.abs(area).sum() / spread.sum()))


def overlapping(flat, charts):
    """Return the charts of which more than a fiftieth lies on itself."""
    found = []
    for chart in np.unique(charts).tolist():
        corners = flat[charts == chart]
        corners = corners - corners.min(axis=(0, 1))
        corners *= 200.0 / max(float(corners.max()), 1e-9)
        every = np.ones((len(corners), 3), np.bool_)
        drawn = draw_texels(corners, np.zeros(len(corners), np.int32), every, 201, 0, 201)
        area = float(drawn.areas.sum())
        if np.abs(doubled_areas(corners)).sum() / 2.0 > 1.02 * area + 0.5:
            found.append(chart)
    return found


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.006])
def test_noise_does_not_tear_charts_apart(noise):
    mesh = noisy(5, noise)
    flat, charts, _ = laid_flat(mesh)
    assert charts.max() < 20
    assert stretched(mesh, flat) < 1.06
    assert (doubled_areas(flat) < 0.0).all()
    assert overlapping(flat, charts) == []
    sizes = np.bincount(charts, np.abs(doubled_areas(flat)) / 2.0)
    assert sizes.min() > 1000.0


def blobs(points):
    """Two balls, and a thin disc with a hole: about the distance to their surface."""
    x, y, z = (points - 0.5).T
    balls = np.minimum(np.hypot(np.hypot(x, y), z) - 0.2, np.hypot(np.hypot(x - 0.2, y - 0.15), z) - 0.13)
    around = np.hypot(x, y)
    disc = np.maximum(np.abs(z) - 0.03, np.abs(around - 0.32) - 0.1)
    return np.asarray(np.minimum(balls, disc))


def test_few_charts_of_a_generated_mesh_are_tiny(tmp_path):
    side, size = 24, 512
    coords, dual, crossed = dual_grid(blobs, side)
    dual = np.clip(dual + 0.1 * np.random.default_rng(0).standard_normal(dual.shape), 0.0, 1.0)
    colors = np.full((len(coords), 3), 99, np.uint8)
    np.savez(tmp_path / "grid.npz", coords=coords, base_color=colors, dual_vertices=dual, intersected=crossed)
    layout = atlas.atlas_layout(octex.load_surface(tmp_path / "grid.npz"), [size], None, 1e-9)
    areas = np.bincount(layout.charts, np.abs(doubled_areas(layout.corners)) / 2.0)
    assert (areas < 8.0).mean() < 0.05
    assert areas.sum() > 0.55 * size**2
    assert areas.size < 80


def test_an_atlas_is_the_same_each_time_and_on_more_threads():
    mesh = noisy(4, 0.01)
    surface = octex.Surface.from_arrays(mesh.rest, mesh.triangles)
    source = surface.with_sources({"base_color": lambda rest: 0.5 + 0.3 * np.sin(9 * rest)})
    texture = octex.convert(source, 5)
    first, *others = (
        octex.bake(texture, surface, uv="atlas", texture_size=256, threads=threads) for threads in (1, 1, 2)
    )
    for other in others:
        np.testing.assert_array_equal(other.uv.values, first.uv.values)
        np.testing.assert_array_equal(other.uv.rows, first.uv.rows)
        points = first.scatter(1000)
        np.testing.assert_array_equal(other.evaluate(points), first.evaluate(points))


@pytest.mark.parametrize("seed", range(10))
def test_charts_with_borders_of_one_length_are_merged(seed):
    """A flat cone of three charts: each border is as long as the others, but for the order of its sum."""
    sectors, rings, per_sector = 3, 9, 4
    turns = np.arange(sectors * per_sector) * 2.0 * np.pi / (sectors * per_sector)
    radii = np.sort(np.random.default_rng(seed).random(rings)) + 0.1
    x, y = radii[:, None] * np.cos(turns), radii[:, None] * np.sin(turns)
    points = np.stack([x, y, np.broadcast_to(0.1 * radii[:, None], x.shape)], axis=2).reshape(-1, 3)
    points = np.concatenate([points, np.zeros((1, 3))])
    corners = np.arange(rings * turns.size).reshape(rings, -1)
    ahead = np.roll(corners, -1, axis=1)
    inner, outer = slice(0, -1), slice(1, None)
    triangles = np.concatenate(
        [
            np.stack([corners[0], ahead[0], np.full(turns.size, len(points) - 1)], axis=1),
            np.stack([corners[inner], corners[outer], ahead[outer]], axis=2).reshape(-1, 3),
            np.stack([corners[inner], ahead[outer], ahead[inner]], axis=2).reshape(-1, 3),
        ]
    )
    charts = np.tile(np.arange(turns.size) // per_sector, 2 * rings - 1)
    shuffled = np.random.default_rng(seed).permutation(len(triangles))
    triangles, charts = triangles[shuffled], charts[shuffled]
    crosses = area_vectors(points[triangles])
    normals = unit(crosses)
    areas = np.linalg.norm(crosses, axis=1)
    others, _ = neighbours_of(triangles)
    pieces = ChartMesh(points[triangles], others, areas, normals, normals)
    assert not _merged(pieces, charts.astype(np.int64)).any()


def test_what_is_flat_is_one_chart_that_keeps_its_lengths_and_a_box_has_one_for_each_face():
    across = np.linspace(0.0, 1.0, 9)
    points = np.stack(np.meshgrid(across, across, indexing="ij"), axis=-1).reshape(-1, 2)
    mesh = Mesh(np.column_stack([points, 0.3 * points[:, 0]]), halved_quads(9, 9))
    flat, charts, _ = laid_flat(mesh)
    assert charts.max() == 0
    np.testing.assert_allclose(stretched(mesh, flat), 1.0, atol=1e-9)
    box = trimesh.creation.box()
    mesh = Mesh(box.vertices, np.asarray(box.faces))
    assert laid_flat(mesh).charts.max() == 5


def test_a_sheet_that_lies_over_itself_is_cut():
    turns, steps = np.linspace(0.0, 6.0 * np.pi, 200), np.arange(200)
    ring = np.stack([np.cos(turns), np.sin(turns), 0.1 * turns], axis=1)
    points = np.concatenate([ring, ring * (2.0, 2.0, 1.0)])
    quads = np.stack([steps[:-1], steps[:-1] + 200, steps[1:] + 200, steps[1:]], axis=1)
    mesh = Mesh(points, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    flat, charts, _ = laid_flat(mesh)
    assert 3 <= charts.max() + 1 <= 12
    assert overlapping(flat, charts) == []


def test_a_strip_over_a_part_of_a_large_sheet_is_cut():
    numbers = np.arange(17 * 17).reshape(17, 17)
    points = [[i, j, 0.0] for i in range(17) for j in range(17)]
    quads = [[numbers[i + x, j + y] for x, y in RING] for i in range(16) for j in range(16)]
    known = {(16, 6): numbers[16, 6], (16, 7): numbers[16, 7]}  # where the strip begins
    for i, j in ((16, 6), (17, 6), (17, 7), (17, 8), (16, 8), (15, 8), (14, 8)):
        for x, y in RING:
            if (i + x, j + y) not in known:
                known[i + x, j + y] = len(points)
                points.append([i + x, j + y, 0.06 * len(known)])
        quads.append([known[i + x, j + y] for x, y in RING])
    triangles = np.array(quads)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    charts = laid_flat(Mesh(np.array(points), triangles)).charts
    assert charts[-1] != charts[2 * (14 * 16 + 8)]  # they are one above the other


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_any_triangles_are_laid_flat_without_folds(seed):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 4, (int(rng.integers(3, 30)), 3)).astype(np.float64)
    triangles = rng.integers(0, len(points), (int(rng.integers(1, 60)), 3))
    mesh = Mesh(points + (0.0, 0.0, 1.0) * (np.arange(len(points)) == 0)[:, None], triangles)
    flat, charts, _ = laid_flat(mesh)
    assert np.isfinite(flat).all()
    areas = np.linalg.norm(
        np.cross(*np.moveaxis(mesh.rest[triangles][:, 1:] - mesh.rest[triangles][:, :1], 1, 0)), axis=1
    )
    assert (doubled_areas(flat)[areas > 0.0] < 0.0).all()
    assert overlapping(flat, charts) == []
    if seed % 4 == 0:  # tries dozens of scales
        atlas.atlas_layout(mesh, [128], None, 1e-9)


def test_hundreds_of_parts_have_room():
    points, triangles = sphere([0.0, 0.0, 0.0], 0.3, 4)
    places = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    every = (points + places[:, None]).reshape(-1, 3)
    rows = (triangles + len(points) * np.arange(len(places))[:, None, None]).reshape(-1, 3)
    layout = atlas.atlas_layout(Mesh(every, rows), [1536], None, 1e-9)
    assert len(places) <= layout.charts.max() + 1 <= 8 * len(places)


def test_xatlas_is_ended_with_a_word(monkeypatch):
    pytest.importorskip("xatlas", reason="the extra octex[atlas] is not installed")
    monkeypatch.setattr(atlas, "_PATIENCE", 0.0)
    monkeypatch.setattr(atlas, "_PIECE", 100)
    mesh = noisy(2, 0.01)
    surface = octex.Surface.from_arrays(mesh.rest, mesh.triangles)
    with pytest.raises(ModelError, match=r'xatlas would take about .* choose uv="atlas"'):
        octex.bake(octex.convert(surface, 3), surface, uv="xatlas")
