"""Conversion: from a surface to what is stored of it."""

import json
from functools import partial

import numpy as np
import pytest

import octex
from octex.channels import BASE_COLOR, ChannelFormat, linear_to_srgb
from octex.conversion import levels
from octex.errors import ArgumentError, ModelError, ModelWarning
from octex.source.surface import Surface
from octex.tree.layout import AREA_ONE, AREA_STEPS, GRID_BITS, SPLIT
from octex.tree.morton import decode_cells
from octex.tree.placement import on_grid
from tests.conftest import needs_jit
from tests.make.fixtures import obj_lines
from tests.make.painted import ball
from tests.make.small_surfaces import FACES, TETRAHEDRON, FaceSource, tetrahedron
from tests.make.solids import cube
from tests.oracles import naive_cells

convert_means = partial(octex.convert, fit=False)


def box(size):
    points, triangles = cube((0, 0, 0))
    return Surface.from_arrays(points * size, triangles, colors=points * size / max(size))


def leaf_means(surface, texture):
    """Linear colour and area of each leaf, from rational clipping and vertex colours."""
    depth = texture.tree.max_depth
    grid = on_grid(surface.rest, texture.placement)
    colors = surface.evaluate_all(
        np.arange(len(surface.triangles), dtype=np.int32).repeat(3),
        np.tile(np.eye(3), (len(surface.triangles), 1)),
        np.zeros(3 * len(surface.triangles), np.float32),
    ).reshape(-1, 3, 3)
    sums = {}
    for corners, values in zip(grid[surface.triangles], colors, strict=True):
        triangle = [tuple(corner) for corner in corners.tolist()]
        for cell, (area, center) in naive_cells.cells_of(triangle, 1 << (GRID_BITS - depth)).items():
            total = sums.setdefault(cell, np.zeros(4))
            if center is not None:
                weights = np.linalg.lstsq(
                    np.vstack([corners.T, np.ones(3)]).astype(float),
                    np.array([*map(float, center), 1.0]),
                    rcond=None,
                )[0]
                total += area * np.append(weights @ values, 1.0)
    return sums


@pytest.mark.parametrize("depth", [0, 1, 2, 4])
def test_a_leaf_holds_the_area_weighted_mean_of_the_surface_inside(depth):
    surface = tetrahedron()
    texture = convert_means(surface, depth=depth)
    texture.validate()
    expected = leaf_means(surface, texture)
    cells = [tuple(cell) for cell in decode_cells(texture.tree.level_codes(depth)).tolist()]
    assert cells == sorted(expected, key=cells.index)
    values = texture.channels["base_color"].values[texture.tree.arrays.level_cells[depth] :]
    areas = texture.tree.arrays.areas[texture.tree.arrays.level_cells[depth] :]
    for cell, value, area in zip(cells, values, areas, strict=True):
        total = expected[cell]
        if total[3] > 1e-6:
            assert np.abs(linear_to_srgb(total[:3] / total[3]) * 255 - value).max() <= 0.51
            assert abs(AREA_STEPS * np.log2(total[3]) + AREA_ONE - area) <= 0.56


@needs_jit
def test_a_node_averages_the_surface_below_it_in_linear_light():
    texture = convert_means(ball(), depth=7)
    texture.validate()
    points = ball().scatter(200_000)
    values = ball().evaluate(points)
    for level in (0, 1, 2, 3):
        coarse = texture.level(level)
        cells = np.floor(texture.placement.to_texture_space(points.rest) * 2**level).astype(int)
        _, which = np.unique(cells, axis=0, return_inverse=True)
        counts = np.bincount(which)
        means = np.stack([np.bincount(which, values[:, i]) / counts for i in range(3)], axis=1)[which]
        often = (counts > 1000)[which]
        difference = linear_to_srgb(means) - linear_to_srgb(coarse.sample(points.rest, filter="nearest"))
        assert often.any()
        assert np.abs(difference[often]).max() < 0.02


@needs_jit
@pytest.mark.parametrize(
    "surface",
    [ball(), box((1, 1, 1)), box((4, 2, 1)), box((1, 1e-3, 0.25))],
    ids=["sphere", "cube", "box", "slab"],
)
@pytest.mark.parametrize("options", [{"depth": 5}, {"depth": 8}, {"cell": 1 / 64}], ids=str)
def test_no_surface_point_falls_outside_the_stored_cells(surface, options):
    texture = octex.convert(surface, **options)
    points = surface.scatter(50_000, seed=3).rest
    assert texture.contains(points).all()
    assert texture.contains(surface.rest).all()


def test_cell_sets_the_edge_of_the_leaves():
    texture = octex.convert(tetrahedron(), cell=0.1)
    assert texture.placement.size / 2**texture.tree.max_depth == pytest.approx(0.1, rel=1e-12)
    assert texture.tree.max_depth == 4
    longest = (tetrahedron().bounds[1] - tetrahedron().bounds[0]).max()
    with pytest.warns(ModelWarning, match=f"cell 5 is larger than the model, .* side is {longest:.4g}; the"):
        assert octex.convert(tetrahedron(), cell=5).tree.n_leaves > 0
    octex.convert(tetrahedron(), cell=longest)


def test_a_sheet_keeps_a_value_for_each_side():
    # Two squares back to back, a tenth of a cell apart: red faces up, blue faces down.
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = np.vstack([square + np.array([0, 0, 0.002]), square])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], np.int32)
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 4, axis=0)
    texture = convert_means(Surface.from_arrays(vertices, triangles, colors=colors), depth=4)
    texture.validate()
    split = texture.tree.split
    assert (texture.tree.arrays.flags & SPLIT).all()
    assert np.array_equal(split.cells, np.arange(texture.tree.n_cells))
    assert (split.facings == 0b110000).all()
    values = texture.channels["base_color"].split_values
    assert (values[0::2] == [255, 0, 0]).all()
    assert (values[1::2] == [0, 0, 255]).all()
    # Halfway in linear light is code 188.
    assert (texture.channels["base_color"].values == [188, 0, 188]).all()


def test_a_sheet_of_one_colour_pays_nothing_for_its_sides():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]], np.int32)
    texture = octex.convert(Surface.from_arrays(square, triangles, colors=square), depth=4)
    texture.validate()
    assert (texture.tree.arrays.flags == 0b110000).all()
    assert texture.tree.split.cells.size == 0


def test_where_nothing_covers_the_colour_is_still_the_sources():
    surface = Surface.from_arrays(TETRAHEDRON, FACES, face_colors=np.tile([0.25, 0.5, 1.0, 0.0], (4, 1)))
    texture = octex.convert(surface, depth=3)
    assert np.abs(texture.sample(TETRAHEDRON) - [0.25, 0.5, 1.0]).max() < 0.01
    assert (texture.channels["alpha"].values == 0).all()


@needs_jit
def test_a_fine_image_does_not_alias_in_coarse_cells():
    # A checkerboard of single texels, black and white: grey, code 188, in every cell that holds many of them.
    checkers = np.indices((1024, 1024)).sum(axis=0).astype(np.uint8) % 2 * 255
    square = np.array([[0.0, 0, 0], [1, 0, 0.2], [1, 1, 0.3], [0, 1, 0.1]])
    surface = Surface.from_arrays(
        square, np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv=square[:, :2], image=checkers
    )
    for depth in (3, 5, 6):
        texture = convert_means(surface, depth=depth)
        leaves = texture.channels["base_color"].values[texture.tree.leaf_cells()].astype(int)
        areas = texture.tree.arrays.areas[texture.tree.leaf_cells()]
        assert np.abs(leaves[areas > AREA_ONE - 16] - 188).max() <= 3


@pytest.mark.parametrize("size", [1.0, 0.1, 1.3])
@pytest.mark.parametrize("cells", [2, 4, 5, 20])
def test_samples_of_faces_in_cell_planes_are_in_leaves(size, cells):
    # The bounds' centre lies a third of a cell above a plane: so these cells put faces on planes, or nearly.
    points, triangles = cube((-17.77, -17.77, -17.77), size)
    surface = Surface.from_arrays(points, triangles)
    texture = octex.convert(surface, cell=1.5 * size / cells)
    assert texture.contains(surface.scatter(300).rest).all()


def test_degenerate_triangles_are_skipped_and_counted():
    triangles = np.vstack([FACES, [[0, 0, 1], [2, 2, 2]]]).astype(np.int32)
    surface = Surface.from_arrays(TETRAHEDRON, triangles, colors=np.full((4, 3), 0.5))
    texture = octex.convert(surface, depth=4)
    assert json.loads(texture.metadata["convert"])["degenerate"] == 2
    clean = octex.convert(Surface.from_arrays(TETRAHEDRON, FACES, colors=np.full((4, 3), 0.5)), depth=4)
    assert np.array_equal(texture.tree.arrays.areas, clean.tree.arrays.areas)


def test_a_rest_mesh_gives_the_texture_coordinates():
    posed = tetrahedron().with_rest(TETRAHEDRON * [2, 1, 1] + 5)
    texture = octex.convert(posed, depth=5)
    samples = posed.scatter(300)
    assert texture.contains(samples.rest).all()
    assert not texture.contains(samples.points).any()
    same = octex.convert(tetrahedron(), depth=5, rest=TETRAHEDRON * [2, 1, 1] + 5)
    assert np.array_equal(same.sample(samples.rest), texture.sample(samples.rest))


def test_a_rest_mesh_of_a_surface_may_be_a_file(tmp_path):
    (tmp_path / "rest.obj").write_text(obj_lines(TETRAHEDRON + 5, FACES))
    texture = octex.convert(tetrahedron(), depth=4, rest=tmp_path / "rest.obj")
    assert texture.contains(tetrahedron().scatter(100).rest + 5).all()
    assert texture.metadata["rest"] == "rest.obj"


def test_progress_counts_every_stage_to_its_end():
    calls = []
    octex.convert(tetrahedron(), depth=5, progress=lambda *call: calls.append(call))
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert stages == ["sort", "convert", "build", "fit"]
    for stage in stages:
        done, total = [(done, total) for name, done, total in calls if name == stage][-1]
        assert done == total


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"depth": depth}, "from 0 to 21") for depth in (-1, 22, 2.5, True)),
        ({"depth": 5, "cell": 0.1}, "depth or cell, not both"),
        ({"depth": 14}, "more than fit into memory"),
        ({"depth": 20}, "smaller depth or a larger cell"),
    ],
)
def test_depths_that_cannot_be_are_refused_before_the_work(options, message, monkeypatch):
    monkeypatch.setattr(levels, "memory_size", lambda: 2e9)
    with pytest.raises(ArgumentError, match=message):
        octex.convert(tetrahedron(), **options)
    line = Surface.from_arrays(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(ModelError, match="all 1 triangles are degenerate"):
        octex.convert(line, depth=4)


def test_more_leaves_than_fit_into_memory_are_refused_as_soon_as_they_are_counted(monkeypatch, tmp_path):
    surface = tetrahedron()
    n_leaves = octex.convert(surface, depth=7).tree.n_leaves
    monkeypatch.setattr(levels, "memory_size", lambda: 100 * n_leaves)  # the area alone asks for less
    with pytest.raises(ArgumentError, match="files instead of memory"):
        octex.convert(surface, depth=7)
    in_files = octex.convert(surface, depth=7, path=tmp_path / "a.octex", run=octex.Run(memory=1))
    assert in_files.tree.n_leaves == n_leaves


class HeightSource(FaceSource):
    """A colour, and a height that varies over a triangle."""

    def __init__(self):
        channels = (BASE_COLOR._replace(dtype="float16"), ChannelFormat("height", 1, "data", "uint16"))
        super().__init__(channels, [[0.5, 0.25, 0.125, 0.0]] * len(FACES))

    def vary(self, values, barycentric):
        values[:, 3] = barycentric[:, 1]


def test_a_source_of_ones_own_may_have_any_channels_and_types():
    texture = octex.convert(Surface(TETRAHEDRON, FACES, HeightSource()), depth=4)
    values = texture.sample(TETRAHEDRON, channel=["base_color", "height"])
    assert np.allclose(values["base_color"], [0.5, 0.25, 0.125], atol=1e-3)
    assert values["height"].shape == (4, 1)
    assert texture.channels["height"].values.dtype == np.uint16


@needs_jit
def test_real_models_keep_every_surface_point(models):
    tried = 0
    for path in sorted(models.glob("*/*.gltf")) + sorted(models.glob("*/*.obj")):
        try:
            surface = octex.load_surface(path)
        except octex.OctexError:
            continue
        texture = octex.convert(surface, depth=8)
        texture.validate()
        samples = surface.scatter(20_000)
        assert texture.contains(samples.rest).all(), path.name
        tried += 1
    assert tried
