"""What travels to other processes: textures, and the work of every function that takes an executor."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR
from octex.field.field import Field
from octex.texture import Channel, OctreeTexture, TextureSet, lookup
from octex.tree.octree import Octree
from tests.small_textures import UNIT, UNIT_BOUNDS, shell
from tests.strategies import with_random_data

POINTS = np.random.default_rng(0).random((40, 3))


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    """One pool for all tests: its processes take a second to start."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


def adaptive(seed: int) -> OctreeTexture:
    """Leaves of two depths, colours and alpha at random."""
    random = np.random.default_rng(seed)
    codes = np.sort(random.choice(64, 40, replace=False))
    parts = [([code], [2]) if code % 3 else (range(8 * code, 8 * code + 5), [3] * 5) for code in codes]
    leaves, depths = ([each for part in parts for each in part[which]] for which in (0, 1))
    tree = with_random_data(Octree.from_leaves(leaves, depths), seed)
    rows = tree.n_cells, tree.split.areas.size, tree.kept.cells.size
    channels = {
        form.name: Channel(
            form, *(random.integers(1, 256, (count, form.components), dtype=np.uint8) for count in rows)
        )
        for form in (BASE_COLOR, ALPHA)
    }
    return OctreeTexture(tree, channels, UNIT, UNIT_BOUNDS, {"source": "random"})


def same(one: OctreeTexture, other: OctreeTexture) -> bool:
    assert (one.metadata, one.placement) == (other.metadata, other.placement)
    assert np.array_equal(one.bounds, other.bounds)
    assert list(one.channels) == list(other.channels)
    for own, others in (
        *zip(
            (*one.tree.arrays, *one.tree.split, *one.tree.kept),
            (*other.tree.arrays, *other.tree.split, *other.tree.kept),
            strict=True,
        ),
        *(
            (a, b)
            for name in one.channels
            for a, b in zip(one.channels[name][1:], other.channels[name][1:], strict=True)
        ),
    ):
        assert own.dtype == others.dtype
        assert np.array_equal(own, others)
    return True


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_textures_and_sets_and_fields_are_copied_and_pickled(
    copied: Callable[[object], object], tmp_path: Path
) -> None:
    texture = adaptive(1)
    texture.sample(POINTS, width=0.2)  # builds what need not travel
    texture.save(tmp_path / "file.octex")
    for each in (texture, octex.open(tmp_path / "file.octex")):
        made = copied(each)
        assert isinstance(made, OctreeTexture)
        assert same(made, each)
        assert np.array_equal(made.sample(POINTS, width=0.2), texture.sample(POINTS, width=0.2))
        made.validate()
    parts = TextureSet({"a": texture, "b": shell(2)}, {"source": "two"})
    parts.save(tmp_path / "set")
    for each in (parts, TextureSet.open(tmp_path / "set")):
        made = copied(each)
        assert isinstance(made, TextureSet)
        assert (made.names, dict(made.metadata)) == (("a", "b"), {"source": "two"})
        assert all(same(made[name], parts[name]) for name in parts)
    field = copied(Field(shell(2).tree))
    assert isinstance(field, Field)
    assert np.array_equal(field.taps(POINTS, UNIT).rows, Field(shell(2).tree).taps(POINTS, UNIT).rows)


def test_what_a_file_has_besides_travels_too(tmp_path: Path) -> None:
    from octex import container

    path, other = tmp_path / "file.octex", tmp_path / "other.octex"
    shell(1).save(path)
    contents = container.read(path)
    container.write(path, {**contents.tensors, "mesh": np.arange(6.0)}, {**contents.metadata, "by": "others"})
    texture = octex.open(path)
    made = pickle.loads(pickle.dumps(texture))
    path.unlink()
    made.save(other)
    texture.save(path)
    assert other.read_bytes() == path.read_bytes()
    assert container.read(other).metadata["by"] == "others"


FUNCTIONS: dict[str, Callable[[Executor | None], object]] = {
    "sample": lambda pool: adaptive(1).sample(POINTS, executor=pool),
    "sample with footprints": lambda pool: adaptive(1).sample(POINTS, width=0.3, executor=pool),
    "taps": lambda pool: np.concatenate(adaptive(1).taps(POINTS, width=0.3, executor=pool)),
    "contains": lambda pool: adaptive(1).contains(POINTS, executor=pool),
    "sample a set": lambda pool: TextureSet({"a": adaptive(1), "b": adaptive(2)}).sample(
        POINTS, np.arange(len(POINTS)) % 2, executor=pool
    ),
    "a set contains": lambda pool: TextureSet({"a": adaptive(1)}).contains(POINTS, "a", executor=pool),
    "blur": lambda pool: octex.blur(adaptive(1), 0.3, executor=pool),
    "mix": lambda pool: octex.mix(adaptive(1), adaptive(2), 0.4, executor=pool),
    "mix by a texture": lambda pool: octex.mix(
        adaptive(1), adaptive(2), octex.cast(adaptive(3), channels=["alpha"]), executor=pool
    ),
    "combine": lambda pool: octex.combine(adaptive(1), adaptive(2), executor=pool),
    "combine over": lambda pool: octex.combine(adaptive(1), adaptive(2), over=True, executor=pool),
    "resize": lambda pool: octex.resize(adaptive(1), 4, executor=pool),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_do_the_same_in_other_processes(
    name: str, processes: Executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "BLOCK", 16)
    expected, found = FUNCTIONS[name](None), FUNCTIONS[name](processes)
    if isinstance(expected, OctreeTexture):
        assert isinstance(found, OctreeTexture)
        assert same(found, expected)
    else:
        assert np.array_equal(found, expected)  # type: ignore[arg-type]


def test_a_point_that_is_not_finite_is_named_by_another_process(
    processes: Executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "BLOCK", 16)
    points = POINTS.copy()
    points[33, 1] = np.nan
    with pytest.raises(octex.OctexError, match=r"points must be finite, but points\[33\]"):
        adaptive(1).sample(points, executor=processes)
