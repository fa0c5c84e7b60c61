"""The samples of cells that a field is fitted to."""

import numpy as np

from octex.arrays import bit_counts
from octex.channels import ALPHA, METALLIC, ROUGHNESS
from octex.conversion.samples import POSITION_STEPS, SHARE_STEPS, sample_points
from octex.source.base import Combined
from octex.source.surface import Surface
from octex.tree.morton import decode_cells
from tests.conversion.test_fit import HALVES, SQUARE, painted, sampled, tiles, waves
from tests.make.small_surfaces import FACES, TETRAHEDRON, FaceSource, tetrahedron


def test_every_cell_has_a_sample_for_each_way_its_surface_faces():
    full, _, samples, placement = sampled(tetrahedron(), 4)
    flags = np.concatenate([part.flags for part in full.levels[4]]) & 63
    counts = np.diff(samples.firsts)
    facings = bit_counts(flags)
    assert (counts >= facings).all()
    assert (counts <= 2 * facings).all()
    shares = np.add.reduceat(samples.shares.astype(int), samples.firsts[:-1])
    assert (np.abs(shares - SHARE_STEPS) <= counts).all()
    chosen = np.arange(len(samples.shares))
    points = placement.to_rest(sample_points(samples, chosen))
    cells = np.repeat(decode_cells(samples.codes), counts, axis=0)
    assert np.array_equal(np.floor(placement.to_texture_space(points) * 16), cells)
    assert np.array_equal(placement.to_rest(sample_points(samples, chosen[::-1].copy())), points[::-1])
    # They lie on the faces, and hold what the faces show there.
    apart = np.stack([_distances(points, TETRAHEDRON[face]) for face in FACES])
    assert apart.min(axis=0).max() < placement.size / 16 / POSITION_STEPS
    weights = np.linalg.solve(
        np.vstack([TETRAHEDRON.T, np.ones(4)]), np.vstack([points.T, np.ones(len(points))])
    )
    colors = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7], [0.5, 0.5, 0.1]])
    assert np.abs(weights.T @ colors - samples.values).max() < 2e-3


def _distances(points, face):
    normal = np.cross(face[1] - face[0], face[2] - face[0])
    return np.asarray(np.abs((points - face[0]) @ normal) / np.linalg.norm(normal))


def test_two_pieces_that_face_alike_are_two_samples_unless_one_is_small():
    _, _, samples, _ = sampled(Surface.from_arrays(SQUARE, HALVES, colors=SQUARE), 4)
    counts = np.diff(samples.firsts)
    i, j, _ = decode_cells(samples.codes).T
    assert (counts[i == j] == 2).any()  # on the diagonal
    assert (counts[np.abs(i - j) > 1] == 1).all()
    shares = samples.shares[np.repeat(counts == 2, counts)].reshape(-1, 2).astype(int)
    assert (np.abs(shares.sum(axis=1) - SHARE_STEPS) <= 1).all()
    assert shares.min() >= 0.09 * SHARE_STEPS


def test_samples_of_a_cell_have_its_mean_and_its_middle_however_many_pieces_it_has():
    surface = tiles(40)
    rows = np.random.default_rng(2).random((len(surface.triangles), 2))
    source = FaceSource((ROUGHNESS._replace(dtype="float32"), ALPHA._replace(dtype="float32")), rows)
    surface = Surface(surface.rest, surface.triangles, source)
    full, _, samples, placement = sampled(surface, 3)
    firsts = samples.firsts[:-1]
    roughness, alpha = samples.values.T
    shares = samples.shares.astype(float)

    def mean(values, weights):
        return np.asarray(np.add.reduceat(values * weights, firsts) / np.add.reduceat(weights, firsts))

    means = [np.concatenate([part.values[n] for part in full.levels[3]])[:, 0] for n in (0, 1)]
    assert np.abs(mean(alpha, shares) - means[1]).max() < 0.02
    assert np.abs(mean(roughness, shares * alpha) - means[0]).max() < 0.02
    points = placement.to_rest(sample_points(samples, np.arange(len(shares))))
    middles = np.stack([mean(points[:, axis], shares) for axis in range(3)], axis=1)
    scattered = surface.scatter(200_000, seed=0).rest
    cells = np.floor(placement.to_texture_space(scattered) * 8).astype(np.int64)
    for cell, middle in zip(decode_cells(samples.codes), middles, strict=True):
        inside = (cells == cell).all(axis=1)
        if inside.sum() > 1000:
            assert np.abs(scattered[inside].mean(axis=0) - middle).max() < 0.03 * placement.size / 8


def test_samples_of_fine_types_are_fine():
    for dtype, kept in (("uint8", np.float16), ("float16", np.float16), ("uint16", np.float32)):
        form = METALLIC._replace(dtype=dtype)
        surface = Surface(TETRAHEDRON, FACES, FaceSource((form,), [[0.1]] * 4))
        assert sampled(surface, 2)[2].values.dtype == kept


def test_a_source_says_how_fine_it_is():
    triangles = np.array([0, 1, 1], np.int32)
    image = painted(waves(16)).source
    posed = Surface.from_arrays(SQUARE * [1, 1, 0], HALVES, uv=SQUARE[:, :2], image=waves(16)).source
    assert np.allclose(posed.texel_edges(triangles), 1 / 16)
    assert (image.texel_edges(triangles) > 1 / 16).all()  # it is slanted
    plain = Surface.from_arrays(SQUARE, HALVES).source
    assert np.isinf(plain.texel_edges(triangles)).all()
    unknown = FaceSource((METALLIC,), [[0.5], [0.5]])
    assert (unknown.texel_edges(triangles) == 0).all()
    both = Combined({"base_color": posed, "metallic": unknown})
    assert (both.texel_edges(triangles) == 0).all()
