"""One image for each patch: labels of least energy, borders that are levelled, and what that looks like."""

import numpy as np

import octex
from octex.channels import BASE_COLOR
from octex.painting.multigrid import graph_of
from octex.painting.surface import terms_of
from octex.photos import labels as labelling
from octex.photos.weigh import BestPaint
from tests.conftest import needs_jit
from tests.make.painted import ball, codes
from tests.make.photographs import projections, ring
from tests.oracles import naive_labels
from tests.painting.test_holes import cut, places


def grid(rows, columns):
    numbers = np.arange(rows * columns).reshape(rows, columns)
    pairs = [np.column_stack([numbers[:, :-1].ravel(), numbers[:, 1:].ravel()])]
    pairs.append(np.column_stack([numbers[:-1].ravel(), numbers[1:].ravel()]))
    return np.concatenate(pairs)


def said(count, images, random):
    paint = random.uniform(0, 0.3, (images, count, 3)).astype(np.float32)
    weights = (random.uniform(0, 1, (images, count)) ** 2).astype(np.float32)
    weights[random.random((images, count)) < 0.3] = 0
    weights[:, random.integers(count)] = 0
    return labelling.costs_of(paint, weights, random.uniform(2, 6, count))


def test_labels_of_small_graphs_cost_little_more_than_the_best():
    random = np.random.default_rng(0)
    ratios = []
    for _ in range(25):
        rows, columns = (3, 3) if random.random() < 0.5 else (2, 4)
        pairs, count = grid(rows, columns), rows * columns
        ties = random.uniform(0.2, 1.0, len(pairs))
        views = said(count, 3, random)
        graph = graph_of(pairs, ties, count)
        found = labelling.passed(graph, views)
        unseen = ~np.isfinite(views.costs).any(axis=1)
        np.testing.assert_array_equal(found < 0, unseen)
        own = labelling.energy(graph, views, found)
        np.testing.assert_allclose(own, naive_labels.energy(pairs, ties, *views, found.tolist()), rtol=1e-5)
        least = naive_labels.least(pairs, ties, *views)
        assert own >= least - 1e-4
        ratios.append(own / least)
    assert np.mean(np.array(ratios) < 1 + 1e-4) > 0.8
    assert max(ratios) < 1.1


def test_moves_only_lower_the_energy():
    random = np.random.default_rng(1)
    pairs = grid(12, 12)
    graph, views = graph_of(pairs, np.ones(len(pairs)), 144), said(144, 4, random)
    labels = np.argmin(views.costs, axis=1).astype(np.int32)
    labels[~np.isfinite(views.costs).any(axis=1)] = -1
    energies = [labelling.energy(graph, views, labels)]
    while labelling._move(graph, views, labels):
        energies.append(labelling.energy(graph, views, labels))
    assert len(energies) > 2
    assert (np.diff(energies) < 0).all()
    assert labelling.energy(graph, views, labelling.passed(graph, views)) < energies[-1]


def labelled(random):
    """Sheets of a ball, how many, and a label of each."""
    sheets, _ = cut(ball(rings=6), 3)
    count = len(sheets.codes)
    return sheets, count, random.integers(-1, 3, count).astype(np.int32)


def test_what_levels_borders_is_that_of_least_squares():
    random = np.random.default_rng(2)
    sheets, count, labels = labelled(random)
    paint = random.random((3, count, 3)).astype(np.float32)
    weights = (random.random((3, count)) < 0.7).astype(np.float32)
    found = labelling.levelling(sheets, labels, paint, weights)
    expected = naive_labels.levelling(sheets.pairs, sheets.ties, labels, paint, weights, 1e-3)
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_labels_fade_into_those_beside_them():
    random = np.random.default_rng(5)
    sheets, count, labels = labelled(random)
    exposures = random.normal(size=(count, 3))
    weights = (random.random((3, count)) < 0.7).astype(np.float32)
    graph = graph_of(sheets.pairs, sheets.ties, count)
    shares, means = labelling.feathered(graph, labels, exposures, weights)
    naive = naive_labels.feathered(
        sheets.pairs, sheets.ties, labels, exposures, weights > 0, labelling._FEATHER
    )
    np.testing.assert_allclose(shares, naive[0], atol=1e-6)
    np.testing.assert_allclose(means[shares > 0], naive[1][shares > 0], atol=1e-5)


def test_borders_of_other_exposures_are_levelled():
    random = np.random.default_rng(4)
    surface = ball(rings=24)
    sheets, _ = cut(surface, 5)
    points = places(surface, sheets)
    labels = ((points > 0) @ [1, 2, 4]).astype(np.int32)
    light = 0.4 + 0.3 * np.sin(3 * points)
    gains = random.uniform(0.85, 1.15, (8, 1, 3))
    paint = (gains * light).astype(np.float32)
    weights = np.ones((8, len(points)), np.float32)
    pairs = sheets.pairs
    found = labelling.levelling(sheets, labels, paint, weights)
    one, other = pairs[labels[pairs[:, 0]] != labels[pairs[:, 1]]].T
    own = np.take_along_axis(paint, labels[None, :, None], axis=0)[0]
    made = labelling.exposed(own, found) / light
    before, after = (np.abs(each[one] - each[other]).mean() for each in (own / light, made))
    assert after < 0.3 * before
    assert np.abs(made - 1).mean() < 1.1 * np.abs(own / light - 1).mean()


@needs_jit
def test_each_patch_comes_from_one_image_and_no_border_shows():
    """A smooth ball seen by six images of other colour casts: what is out of place shows in an average."""
    surface, cameras, images = ring(6)
    shots = projections(images, cameras)
    samples = surface.scatter(5000)
    truth = codes(surface.evaluate(samples))

    def painted(projections_, mode):
        texture = octex.paint(None, surface, projections_, max_depth=6, holes="leave", pictures=mode)
        texture.validate()
        return codes(texture.sample(samples.rest)), texture.contains(samples.rest)

    average, seen = painted(shots, "average")
    found, also = painted(shots, "best")
    np.testing.assert_array_equal(seen, also)
    rms = [float(np.sqrt(((each - truth)[seen] ** 2).mean())) for each in (average, found)]
    assert rms[1] < rms[0] + 0.5
    np.testing.assert_array_equal(painted(shots[::-1], "best")[0], found)
    casts = np.random.default_rng(3).uniform(0.9, 1.1, (6, 3)).astype(np.float32)
    changed = [image * np.append(cast, np.float32(1)) for image, cast in zip(images, casts, strict=True)]
    found, _ = painted(projections(changed, cameras), "best")
    assert np.sqrt(((found - truth)[seen] ** 2).mean()) < 10


class _TwoImages(BestPaint):
    """Paint from shots that stand for their light: each of them covers all points alike."""

    def _sums(self, shots, triangles, *_):
        sums = np.tile([*3 * [sum(shots)], float(len(shots))], (len(triangles), 1))
        return sums, np.zeros(len(triangles))


class _Sheets:
    """Says for each point its triangle's number as the sheet; −1 for triangle 2."""

    def at(self, triangles, barycentric):  # noqa: ARG002
        return np.where(triangles == 2, -1, triangles)


def test_points_on_no_sheet_are_painted_from_all_images():
    shares = np.array([[1, 0], [0, 1]], np.float32)
    sheets = _Sheets()
    none = None
    terms = terms_of(75.0, 0.0, back_faces=False)
    own = np.arange(3, dtype=np.int32)
    shots = [0.2, 0.8]
    exposures = np.zeros((2, 2, 3), np.float32)
    paint = _TwoImages(
        shots, BASE_COLOR, terms, *4 * [none], sheets=sheets, shares=shares, exposures=exposures
    )
    found = paint.evaluate(own, np.zeros((3, 3)), np.zeros(3, np.float32))
    np.testing.assert_allclose(found[2], [0.5, 0.5, 0.5, 1.0])
    assert (found[0, :3] < 0.4).all() and (found[1, :3] > 0.6).all()
