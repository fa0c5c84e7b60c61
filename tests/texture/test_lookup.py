"""The border of lookups: what points are taken, where answers go, and what is refused."""

from __future__ import annotations

import copy
import tracemalloc
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import octex
from octex import parallel
from octex.errors import ArgumentError
from octex.texture import FILTERS, TextureSet, lookup
from octex.texture.lookup import in_space
from tests.conftest import needs_jit
from tests.make.small_textures import eight_colors, shell

POINTS = np.array([[0.1, 0.1, 0.1], [0.9, 0.1, 0.9], [0.4, 0.6, 0.6]])


def two_channels():
    """The eight colours, and their first component as data."""
    texture = eight_colors()
    color = texture.channels["base_color"]
    form = color.format._replace(name="height", components=1, space="data")
    values = np.ascontiguousarray(color.values[:, :1])
    height = color._replace(format=form, values=values, split_values=values[:0], kept_values=values[:0])
    return eight_colors(channels={"base_color": color, "height": height})


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(lookup, "BLOCK", 4)


class Elsewhere(Executor):
    """Works on copies, like an executor whose workers are other processes."""

    def submit(self, function, /, *args, **_):
        future = Future()
        future.set_result(function(*copy.deepcopy(args)))
        return future


# --- points


LAID_OUT = {
    "list": POINTS.tolist(),
    "whole": POINTS.round().astype(np.int64),
    "half": POINTS.astype(np.float16),
    "big-endian": POINTS.astype(">f4"),
    "long": POINTS.astype(np.longdouble),
    "fortran": np.asfortranarray(POINTS),
    "strided": np.repeat(POINTS, 2, axis=0)[::2],
    "columns": np.column_stack([POINTS, POINTS])[:, :3],
    "read-only": np.lib.stride_tricks.as_strided(POINTS, writeable=False),
    "misaligned": np.frombuffer(b"?" + POINTS.tobytes(), np.float64, offset=1).reshape(-1, 3),
}


@pytest.mark.parametrize("points", LAID_OUT.values(), ids=LAID_OUT)
def test_points_of_every_real_type_and_order_are_taken(points):
    texture = shell(3)
    assert np.array_equal(texture.sample(points), texture.sample(np.array(points, np.float64)))
    assert np.array_equal(texture.contains(points), texture.contains(np.array(points, np.float64)))


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("keep", [0.0, 0.3])
def test_few_points_have_the_values_that_they_have_among_many(keep, filter):
    texture = shell(3, keep)
    points = np.random.default_rng(3).uniform(-0.1, 1.1, (200, 3)).astype(np.float32)
    expected = texture.sample(points, filter=filter, threads=2)
    for rows in (slice(0, 1), slice(1, 65), slice(65, 67), slice(67, 200)):
        for given in (points[rows], points[rows].astype(np.float64)):
            np.testing.assert_allclose(texture.sample(given, filter=filter), expected[rows], atol=2e-6)


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("count", [1, 64])
def test_channels_in_a_list_have_the_values_that_each_has_alone(count, filter):
    texture = two_channels()
    points = np.random.default_rng(4).uniform(-0.1, 1.1, (count, 3))
    for names in (["height"], ["base_color", "height"], ("height", "base_color"), ["height", "height"]):
        found = texture.sample(points, names, filter)
        assert list(found) == list(dict.fromkeys(names))
        for name, values in found.items():
            np.testing.assert_array_equal(values, texture.sample(points, name, filter))
            np.testing.assert_array_equal(values, texture.sample(points, names, filter, threads=1)[name])
    assert texture.sample(points, [], filter) == {}
    for wrong in (["height", "no"], ["no"], ["height", 3]):
        with pytest.raises(ArgumentError, match="unknown channel"):
            texture.sample(points, wrong, filter)


@pytest.mark.parametrize("points", [[], np.empty((0, 3)), np.empty((0, 3), np.float32)])
def test_no_points_give_empty_answers(points):
    texture = two_channels()
    assert texture.sample(points).shape == (0, 3)
    assert texture.sample(points).dtype == np.float32
    assert {name: found.shape for name, found in texture.sample(points, ["height"]).items()} == {
        "height": (0, 1)
    }
    with ThreadPoolExecutor(1) as pool:
        assert texture.sample(points, run=octex.Run(executor=pool)).shape == (0, 3)
    assert texture.contains(points).shape == (0,)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([0.0, 0.0, 0.0], r"^points must have shape \(n, 3\), not \(3,\)$"),
        (0.5, r"shape \(n, 3\), not \(\)$"),
        (np.zeros((2, 2)), r"^points must have shape \(n, 3\), not \(2, 2\)$"),
        (np.zeros((2, 3, 1)), r"shape \(n, 3\), not \(2, 3, 1\)$"),
        (np.zeros((3, 0)), r"shape \(n, 3\), not \(3, 0\)$"),
        ([[0, 0, 0], [0, 0]], r"^points must have shape \(n, 3\)$"),
        ([["0", "0", "0"]], "^points must be real numbers, not <U1$"),
        ([[0j, 0, 0]], "^points must be real numbers, not complex128$"),
        ([[True, False, True]], "^points must be real numbers, not bool$"),
        ([[None, 0, 0]], "^points must be real numbers, not object$"),
        (None, "^points must be real numbers, not object$"),
    ],
)
def test_what_is_no_batch_of_positions_is_refused(points, message):
    for look_up in (eight_colors().sample, eight_colors().contains):
        with pytest.raises(ArgumentError, match=message):
            look_up(points)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 6])
def test_positions_that_are_not_finite_are_refused_by_their_first_row(row, value):
    points = np.full((19, 3), 0.5, np.float32)
    points[[row, 7, 18], [0, 1, 2]] = value
    with ThreadPoolExecutor(2) as pool:
        for executor in (None, pool):
            for look_up in (eight_colors().sample, eight_colors().contains):
                with pytest.raises(ArgumentError, match=rf"points\[{row}\] is \[{value}, 0.5, 0.5\]"):
                    look_up(points, run=octex.Run(executor=executor))


def test_unknown_channels_and_filters_are_refused_with_the_choices():
    for options, message in (
        ({"channel": "normal"}, "unknown channel 'normal'; there are: base_color, height"),
        ({"channel": ["base_color", "normal"]}, "unknown channel 'normal'; there are: base_color, height"),
        ({"channel": 3}, "unknown channel 3; there are: base_color, height"),
        ({"filter": "cubic"}, "unknown filter 'cubic'; there are: nearest, linear, quadratic, quartic"),
        ({"filter": None}, "unknown filter None"),
        ({"filter": "nearest", "gradient": True}, "nearest has no gradient; linear, quadratic, quartic have"),
    ):
        with pytest.raises(ArgumentError, match=message):
            two_channels().sample(POINTS, **options)


def test_the_filter_is_quadratic_unless_told_otherwise():
    assert np.array_equal(shell(3).sample(POINTS), shell(3).sample(POINTS, "base_color", "quadratic"))


# --- answers


@pytest.mark.usefixtures("small_blocks")
def test_answers_are_written_where_the_caller_wants_them():
    texture, points = two_channels(), np.repeat(POINTS, 3, axis=0)
    rows = np.full((11, 3), -1.0, np.float32)
    assert np.shares_memory(texture.sample(points, out=rows[1:10]), rows)
    assert np.array_equal(rows[1:10], texture.sample(points))
    assert (rows[[0, 10]] == -1).all()
    out = {"height": np.empty((9, 1), np.float32), "base_color": np.empty((9, 3), np.float32)}
    found = texture.sample(points, ["base_color", "height"], out=out)
    assert list(found) == ["base_color", "height"]
    for name, values in found.items():
        assert values is out[name]
        assert np.allclose(values, texture.sample(points, name), rtol=0, atol=1e-6)


def test_gradients_are_written_beside_the_values():
    texture = two_channels()
    values, gradients = texture.sample(POINTS, gradient=True)
    assert (values.shape, gradients.shape, gradients.dtype) == ((3, 3), (3, 3, 3), np.float32)
    assert np.allclose(values, texture.sample(POINTS), rtol=0, atol=1e-6)
    out = np.empty((3, 3), np.float32), np.empty((3, 3, 3), np.float32)
    found = texture.sample(POINTS, gradient=True, out=out)
    assert found[0] is out[0] and found[1] is out[1]
    assert np.array_equal(out[0], values) and np.array_equal(out[1], gradients)
    both = texture.sample(POINTS, ["height", "base_color"], gradient=True)
    assert [list(each) for each in both] == [["height", "base_color"]] * 2
    assert np.array_equal(both[1]["base_color"], gradients)
    assert texture.sample([], gradient=True)[1].shape == (0, 3, 3)


ROWS, CUBES = np.empty((3, 3), np.float32), np.empty((3, 3, 3), np.float32)
#: Arrays for values that do not fit, for values and gradients, and for two channels; and what is said.
UNFIT = [
    (np.empty((3, 3)), r"out for 'base_color' must be a float32 array of shape \(3, 3\), not float64"),
    (np.empty((3, 3), ">f4"), "float32 array"),
    (np.empty((2, 3), np.float32), r"of shape \(3, 3\), not float32 \(2, 3\)"),
    (np.empty((3, 1), np.float32), r"of shape \(3, 3\), not float32 \(3, 1\)"),
    (ROWS.tolist(), "float32 array of shape .* not <class 'list'>"),
    ({"base_color": ROWS}, "not <class 'dict'>"),
    (np.empty((3, 3), np.float32, order="F"), "C-ordered, aligned and writable"),
    (np.broadcast_to(np.float32(0), (3, 3)), "C-ordered, aligned and writable"),
    (np.frombuffer(bytes(36), np.float32).reshape(3, 3), "C-ordered, aligned and writable"),
    (np.ndarray((3, 3), np.float32, bytearray(37), 1), "C-ordered, aligned and writable"),
]
UNFIT_PAIRS = [
    (ROWS, "out must be a pair, for values and for gradients"),
    ((ROWS,), "out must be a pair"),
    ((ROWS, ROWS), r"the gradients' out for 'base_color' must be .* \(3, 3, 3\)"),
    ((CUBES, CUBES), r"^out for 'base_color' must be a float32 array of shape \(3, 3\), not .* \(3, 3, 3\)"),
]
BOTH = ["base_color", "height"]
UNFIT_DICTS = [ROWS, {}, {"base_color": None}, {"base_color": None, "hight": None}]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"out": out}, message) for out, message in UNFIT),
        *(({"out": out, "gradient": True}, message) for out, message in UNFIT_PAIRS),
        *(({"out": out, "channel": BOTH}, "a dict of arrays for: base_color, height") for out in UNFIT_DICTS),
    ],
)
def test_arrays_that_answers_do_not_fit_are_refused(options, message):
    with pytest.raises(ArgumentError, match=message):
        two_channels().sample(POINTS, **options)


def test_answers_over_the_points_or_over_each_other_are_refused():
    points = POINTS.astype(np.float32)
    with pytest.raises(ArgumentError, match="must not share memory"):
        eight_colors().sample(points, out=points)
    both = np.empty(12, np.float32)
    out = {"base_color": both[:9].reshape(3, 3), "height": both[8:11].reshape(3, 1)}
    with pytest.raises(ArgumentError, match="must not share memory"):
        two_channels().sample(points, list(out), out=out)
    out["height"] = both[9:].reshape(3, 1)
    two_channels().sample(points, list(out), out=out)


# --- blocks


@needs_jit
def test_many_points_are_looked_up_in_blocks_alike():
    texture = shell(5)
    points = np.random.default_rng(0).random((40_000, 3))
    pieces = np.array_split(points, 7)
    assert np.array_equal(texture.contains(points), np.concatenate(list(map(texture.contains, pieces))))
    for name in FILTERS:
        found = np.concatenate([texture.sample(piece, filter=name) for piece in pieces])
        assert np.array_equal(texture.sample(points, filter=name), found)


@pytest.mark.parametrize("given", [[], ["normals"], ["width"]])
def test_points_of_many_leaves_are_looked_up_in_the_order_of_space(given, monkeypatch):
    texture, random = shell(4, keep=0.0), np.random.default_rng(0)
    points = random.random((300, 3))
    options = {"normals": random.normal(size=(300, 3)), "width": random.random(300) * 0.2}
    expected = texture.sample(points, **{name: options[name] for name in given})
    in_order = []

    def watched(*task):
        in_order.append(len(task[0]["points"]))
        in_space(*task)

    monkeypatch.setattr(lookup, "BLOCK", 40)
    monkeypatch.setattr("octex.texture.texture.in_space", watched)
    for most, calls in ((texture.tree.n_leaves + 1, []), (texture.tree.n_leaves, [300])):
        monkeypatch.setattr("octex.texture.texture._MANY_LEAVES", most)
        found = texture.sample(points, **{name: options[name] for name in given})
        assert np.array_equal(found, expected)
        assert in_order == calls


@pytest.mark.usefixtures("small_blocks")
def test_an_executor_gives_the_same_answers():
    texture = shell(3)
    points = np.random.default_rng(0).random((61, 3))
    expected = texture.sample(points, gradient=True)
    with ThreadPoolExecutor(3) as pool:
        for executor in (pool, Elsewhere()):
            assert np.array_equal(
                texture.contains(points, run=octex.Run(executor=executor)), texture.contains(points)
            )
            for name in FILTERS:
                out = np.empty((61, 3), np.float32)
                assert texture.sample(points, filter=name, out=out, run=octex.Run(executor=executor)) is out
                assert np.array_equal(out, texture.sample(points, filter=name))
            for ours, theirs in zip(
                texture.sample(points, gradient=True, run=octex.Run(executor=executor)), expected, strict=True
            ):
                assert np.array_equal(ours, theirs)


@needs_jit
@pytest.mark.parametrize("filter", ["nearest", "quadratic"])
def test_memory_does_not_grow_with_the_points(filter):
    texture = shell(3, keep=0.0)
    count = 2_000_000
    points = np.broadcast_to(np.array([0.5, 0.5, 0.05]), (count, 3))
    out = np.empty((count, 3), np.float32)
    texture.sample(points[:1], filter=filter, out=out[:1])
    tracemalloc.start()
    try:
        texture.sample(points, filter=filter, out=out, threads=1)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (out == out[0]).all()
    assert peak < 4_000_000  # an int32 each would be 8


# --- points of a surface


class Hits(NamedTuple):
    rest: Any
    normals: Any
    rest_normals: Any


def test_points_of_a_surface_are_looked_up_where_they_rest_toward_their_normals_there():
    texture, random = shell(3), np.random.default_rng(5)
    points, normals, posed = random.random((20, 3)), random.normal(size=(20, 3)), random.normal(size=(20, 3))
    expected = texture.sample(points, normals=normals)
    assert not np.array_equal(texture.sample(points), expected)
    records = Hits(points, posed, normals), SimpleNamespace(rest=points, normals=normals)
    for hits in records:
        assert np.array_equal(texture.sample(hits), expected)
        assert np.array_equal(TextureSet({"a": texture}).sample(hits, "a"), expected)
        assert np.array_equal(texture.contains(hits), texture.contains(points))
        assert np.array_equal(texture.taps(hits).rows, texture.taps(points, normals=normals).rows)
        given = texture.sample(hits, normals=posed)
        assert np.array_equal(given, texture.sample(points, normals=posed))
    assert np.array_equal(texture.sample(SimpleNamespace(rest=points)), texture.sample(points))
    with pytest.raises(ArgumentError, match=r"points' rest must have shape \(n, 3\)"):
        texture.sample(SimpleNamespace(rest=points[:, :2]))


def test_a_scatter_over_a_sheet_shows_the_side_that_it_is_on():
    sheet = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    both = octex.Surface.from_arrays(
        sheet, [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]],
        face_colors=np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]]),
    )  # fmt: skip
    texture, points = octex.convert(both, 4, fit=False), both.scatter(50)
    np.testing.assert_allclose(texture.sample(points), both.evaluate(points), atol=1e-3)
    assert np.abs(texture.sample(points.rest) - both.evaluate(points)).max(axis=1).min() > 0.4


@pytest.mark.usefixtures("small_blocks")
def test_many_points_are_looked_up_on_as_many_threads_as_are_asked_for(monkeypatch):
    pools = []

    def pool_of(count):
        pools.append(count)
        return whole_pool(count)

    whole_pool = parallel.pool_of
    monkeypatch.setattr(parallel, "pool_of", pool_of)
    monkeypatch.setattr(parallel, "cpu_count", lambda: 3)
    texture, points = shell(3), np.random.default_rng(0).random((61, 3))
    alone = texture.sample(points, threads=1)
    assert not pools
    for threads, expected in ((None, 3), (5, 5)):
        assert np.array_equal(texture.sample(points, threads=threads), alone)
        texture.contains(points, threads=threads)
        texture.taps(points, threads=threads)
        assert pools == [expected] * 3
        pools.clear()
    texture.sample(points[:4])
    assert not pools
