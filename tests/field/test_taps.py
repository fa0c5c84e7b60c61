"""What lookups blend, as rows and weights; and which bytes of a file they read."""

import numpy as np
import pytest

import octex
from octex import jit
from octex.errors import ArgumentError
from octex.texture import FILTERS
from tests.make.small_textures import eight_colors, shell
from tests.properties.random_lookups import random_points, random_texture, random_views

SEEDS = range(4 if jit.DISABLED else 25)


def blended(texture, points, name, filter, **views):
    """The blend of a channel's rows."""
    taps = texture.taps(points, name, filter, **views)
    values = texture.rows(name).astype(np.float64)
    owners = np.repeat(np.arange(len(points)), np.diff(taps.starts))
    assert taps.starts[0] == 0 and taps.starts[-1] == taps.rows.size == taps.weights.size
    assert len(np.unique(np.stack([owners, taps.rows]), axis=1).T) == taps.rows.size  # none twice
    found = np.zeros((len(points), values.shape[1]))
    np.add.at(found, owners, values[taps.rows] * taps.weights[:, None])
    return found


@pytest.mark.parametrize("seed", SEEDS)
def test_taps_blend_to_what_sample_answers(seed):
    random = np.random.default_rng(seed)
    texture = random_texture(random)
    points, _ = random_points(texture, random, 8)
    for filter in FILTERS:
        views = random_views(random, len(points), texture.placement.size)
        for name in texture.channels:
            expected = texture.sample(points, name, filter, normalize=False, **views)
            scale = np.abs(texture.rows(name)).max()
            found = blended(texture, points, name, filter, **views)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * max(scale, 1), err_msg=str(views))


def test_taps_of_sharpened_footprints_sum_to_one_though_some_are_negative():
    texture = shell(4)
    points = np.random.default_rng(1).random((50, 3))
    taps = texture.taps(points, width=0.2, sharpness=1.0)
    assert (taps.weights < 0).any()
    np.testing.assert_allclose(np.add.reduceat(taps.weights, taps.starts[:-1]), 1, atol=1e-5)
    expected = texture.sample(points, width=0.2, sharpness=1.0)
    np.testing.assert_allclose(
        blended(texture, points, "base_color", "quadratic", width=0.2, sharpness=1.0), expected, atol=2e-6
    )


def test_taps_go_over_blocks_of_points_and_are_alike_on_any_threads(monkeypatch):
    texture, points = shell(3), np.random.default_rng(2).random((40, 3))
    whole = texture.taps(points)
    monkeypatch.setattr("octex.texture.lookup.BLOCK", 7)
    for found in zip(whole, texture.taps(points), strict=True):
        np.testing.assert_array_equal(*found)
    assert [len(each) for each in texture.taps(points[:0])] == [1, 0, 0]


def test_a_blend_as_a_matrix_of_scipy_is_what_sample_answers():
    sparse = pytest.importorskip("scipy.sparse")
    texture, points = shell(3), np.random.default_rng(3).random((30, 3))
    taps, values = texture.taps(points), texture.rows("base_color")
    blend = sparse.csr_array((taps.weights, taps.rows, taps.starts), (len(points), len(values)))
    np.testing.assert_allclose(blend @ values, texture.sample(points), atol=1e-6)


def test_rows_are_of_cells_then_kept_nodes_then_facings_and_can_be_asked_for_one_by_one():
    texture = random_texture(np.random.default_rng(10))
    assert texture.tree.split.cells.size and texture.tree.kept.cells.size
    name = next(iter(texture.channels))
    rows = texture.rows(name)
    tree = texture.tree
    assert len(rows) == tree.n_cells + tree.kept.cells.size + tree.split.areas.size
    numbers = np.random.default_rng(0).integers(0, len(rows), 50)
    np.testing.assert_array_equal(texture.rows(name, numbers), rows[numbers])
    assert texture.rows(name, []).shape == (0, rows.shape[1])
    for wrong, message in (
        ([len(rows)], "there is no row"),
        ([-1], "there is no row -1"),
        ([0.5], "whole numbers"),
        ([[1]], "whole numbers"),
        ([[1], [1, 2]], "whole numbers"),
    ):
        with pytest.raises(ArgumentError, match=message):
            texture.rows(name, wrong)


def test_taps_refuse_what_sample_refuses():
    texture, points = eight_colors(), np.full((3, 3), 0.5)
    for options, message in (
        ({"points": [[0, 0, 0], [0, np.nan, 0]]}, r"points must be finite, but points\[1\]"),
        ({"points": [[0, 0, 0], [0, np.inf, 0]], "width": 0.1}, r"points must be finite, but points\[1\]"),
        ({"normals": np.full((3, 3), np.nan)}, r"normals must be finite, but normals\[0\]"),
        ({"channel": "gloss"}, "unknown channel 'gloss'"),
        ({"filter": "cubic"}, "unknown filter"),
    ):
        with pytest.raises(ArgumentError, match=message):
            texture.taps(**{"points": points, **options})


@pytest.mark.parametrize("seed", SEEDS)
def test_a_file_with_the_listed_blocks_alone_answers_likewise(seed, tmp_path):
    random = np.random.default_rng(seed)
    random_texture(random).save(tmp_path / "whole.octex")
    content = (tmp_path / "whole.octex").read_bytes()
    size = int(random.choice([1, 64, 4096]))
    for filter in FILTERS:
        texture = octex.open(tmp_path / "whole.octex")
        points, _ = random_points(texture, random, 2)
        views = random_views(random, len(points), texture.placement.size)
        names = list(texture.channels)
        ranges = texture.blocks(points, names, filter, block_size=size, **views)
        assert (ranges[:, 0] < ranges[:, 1]).all() and (ranges[1:, 0] > ranges[:-1, 1]).all()
        assert not (ranges[:, 0] % size).any() and ranges[-1, 1] <= len(content)
        part = bytearray(len(content))
        for begin, end in ranges.tolist():
            part[begin:end] = content[begin:end]
        path = tmp_path / f"{filter}.octex"
        path.write_bytes(part)
        found = octex.open(path).sample(points, names, filter, **views)
        for name, expected in texture.sample(points, names, filter, **views).items():
            np.testing.assert_array_equal(found[name], expected, err_msg=f"{name}, {filter}, {views}")


def test_a_few_lookups_need_little_of_a_file(tmp_path):
    shell(6, keep=0).save(tmp_path / "shell.octex")
    texture = octex.open(tmp_path / "shell.octex")
    total = (tmp_path / "shell.octex").stat().st_size
    needed = [
        int(np.diff(texture.blocks([[0.5, 0.05, 0.5]], block_size=512, **views)).sum())
        for views in ({}, {"width": 0.3, "normals": [[0, -1, 0]]})
    ]
    assert needed[0] < total / 2
    assert needed[1] < needed[0]


def test_blocks_are_of_files_only():
    with pytest.raises(ArgumentError, match="has no file: save it and open that"):
        eight_colors().blocks([[0.5, 0.5, 0.5]])
