"""Charts of an atlas: noise does not tear them apart, nothing folds or overlaps, and little is stretched."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.baking import atlas
from octex.baking.charts import laid_flat
from octex.baking.layout import doubled_areas
from octex.baking.texels import draw_texels
from octex.baking.unfold import SIDE
from octex.errors import ModelError
from octex.source.mesh import Mesh
from tests.make.solids import sphere

Floats = npt.NDArray[np.float64]


def noisy(subdivisions: int, noise: float) -> Mesh:
    """A ball of radius 1 whose vertices are moved in and out."""
    made = trimesh.creation.icosphere(subdivisions)
    radii = 1.0 + noise * np.random.default_rng(0).standard_normal((len(made.vertices), 1))
    return Mesh(made.vertices * radii, np.asarray(made.faces))


def stretched(mesh: Mesh, flat: Floats) -> float:
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


def overlapping(flat: Floats, charts: npt.NDArray[np.int32]) -> list[int]:
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
def test_noise_does_not_tear_charts_apart(noise: float) -> None:
    mesh = noisy(5, noise)
    flat, charts, _ = laid_flat(mesh)
    assert charts.max() < 20
    assert stretched(mesh, flat) < 1.06
    assert (doubled_areas(flat) < 0.0).all()
    assert overlapping(flat, charts) == []
    sizes = np.bincount(charts, np.abs(doubled_areas(flat)) / 2.0)
    assert sizes.min() > 1000.0


def test_what_is_flat_is_one_chart_and_keeps_its_lengths() -> None:
    across = np.linspace(0.0, 1.0, 9)
    points = np.stack(np.meshgrid(across, across, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = np.arange(81).reshape(9, 9)
    quads = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], axis=-1)
    triangles = quads.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    mesh = Mesh(np.column_stack([points, 0.3 * points[:, 0]]), triangles)
    flat, charts, _ = laid_flat(mesh)
    assert charts.max() == 0
    np.testing.assert_allclose(stretched(mesh, flat), 1.0, atol=1e-9)


def test_a_box_has_a_chart_for_each_face() -> None:
    box = trimesh.creation.box()
    mesh = Mesh(box.vertices, np.asarray(box.faces))
    assert laid_flat(mesh).charts.max() == 5


def test_a_sheet_that_lies_over_itself_is_cut() -> None:
    turns, steps = np.linspace(0.0, 6.0 * np.pi, 200), np.arange(200)
    ring = np.stack([np.cos(turns), np.sin(turns), 0.1 * turns], axis=1)
    points = np.concatenate([ring, ring * (2.0, 2.0, 1.0)])
    quads = np.stack([steps[:-1], steps[:-1] + 200, steps[1:] + 200, steps[1:]], axis=1)
    mesh = Mesh(points, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    flat, charts, _ = laid_flat(mesh)
    assert 3 <= charts.max() + 1 <= 12
    assert overlapping(flat, charts) == []


@given(st.integers(0, 10_000))
def test_any_triangles_are_laid_flat_without_folds(seed: int) -> None:
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
    atlas.atlas_layout(mesh, [128], None, 1e-9)


def test_a_thousand_parts_have_room() -> None:
    points, triangles = sphere([0.0, 0.0, 0.0], 0.3, 4)
    places = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3)
    every = (points + places[:, None]).reshape(-1, 3)
    rows = (triangles + len(points) * np.arange(len(places))[:, None, None]).reshape(-1, 3)
    layout = atlas.atlas_layout(Mesh(every, rows), [2048], None, 1e-9)
    assert len(places) <= layout.charts.max() + 1 <= 8 * len(places)


def test_xatlas_is_ended_with_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xatlas", reason="the extra octex[atlas] is not installed")
    monkeypatch.setattr(atlas, "_PATIENCE", 0.0)
    monkeypatch.setattr(atlas, "_PIECE", 100)
    mesh = noisy(2, 0.01)
    surface = octex.Surface.from_arrays(mesh.rest, mesh.triangles)
    with pytest.raises(ModelError, match=r'xatlas would take about .* choose uv="atlas"'):
        octex.bake(octex.convert(surface, 3), surface, uv="xatlas")
