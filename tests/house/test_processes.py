"""What travels to other processes: textures, and the work of every function that takes a run."""

import copy
import inspect
import pickle
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR
from octex.errors import ArgumentError
from octex.field.field import Field
from octex.jit import kernel
from octex.parallel import sharing, start, workers
from octex.texture import Channel, OctreeTexture, TextureSet, lookup
from octex.tree.octree import Octree
from octex.voxelize import fragments
from tests.conftest import needs_jit
from tests.make.painted import ball, image_of
from tests.make.same import assert_equal
from tests.make.small_surfaces import bent
from tests.make.small_textures import UNIT, UNIT_BOUNDS, shell
from tests.make.strategies import with_random_data
from tests.make.taps import taps_of

POINTS = np.random.default_rng(0).random((40, 3))


def adaptive(seed):
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


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_textures_and_sets_and_fields_are_copied_and_pickled(copied, tmp_path):
    texture = adaptive(1)
    texture.sample(POINTS, width=0.2)  # builds what need not travel
    texture.save(tmp_path / "file.octex")
    for each in (texture, octex.open(tmp_path / "file.octex")):
        made = copied(each)
        assert isinstance(made, OctreeTexture)
        assert_equal(made, each)
        assert np.array_equal(made.sample(POINTS, width=0.2), texture.sample(POINTS, width=0.2))
        made.validate()
    parts = TextureSet({"a": texture, "b": shell(2)}, {"source": "two"})
    parts.save(tmp_path / "set")
    for each in (parts, TextureSet.open(tmp_path / "set")):
        made = copied(each)
        assert isinstance(made, TextureSet)
        assert (made.names, dict(made.metadata)) == (("a", "b"), {"source": "two"})
        for name in parts:
            assert_equal(made[name], parts[name])
    field = copied(Field(shell(2).tree))
    assert isinstance(field, Field)
    assert np.array_equal(taps_of(field, POINTS, UNIT).rows, taps_of(Field(shell(2).tree), POINTS, UNIT).rows)


def test_what_a_file_has_besides_travels_too(tmp_path):
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


def painter(run, fills, kind=octex.Painter):
    """Return what a stroke of a painter makes, or of one with layers in its highest."""
    made = kind(painted(), SURFACE)
    if isinstance(made, octex.Layers):
        made.add_layer()
    if fills:
        made.fill(SPHERE, (1, 0, 0), max_depth=5, run=run)
    else:
        made.paint(shots()[0], run=run)
    return made.texture()


def shots(count=1):
    """Images of a ball, all around; in every other one stands something."""
    found = []
    for number in range(count):
        turn = 2 * np.pi * number / max(count, 5)
        camera = octex.Camera.fitted(SURFACE.vertices, (np.sin(turn), 0.2, np.cos(turn)), size=(48, 48))
        image = image_of(SURFACE, camera)
        image[20:30, 20:30, :3] += 0 if number % 2 else 40
        found.append(octex.Projection(image, camera))
    return found


@cache
def painted():
    return octex.convert(SURFACE, 4)


SURFACE, SPHERE = ball(rings=12), octex.Sphere((0.0, 0.0, 1.0), 0.6)
#: What every function that takes a run does, by its name and that of a case.
FUNCTIONS = {
    "OctreeTexture.sample": lambda run, _: adaptive(1).sample(POINTS, run=run),
    "OctreeTexture.sample, footprints": lambda run, _: adaptive(1).sample(POINTS, width=0.3, run=run),
    "OctreeTexture.taps": lambda run, _: adaptive(1).taps(POINTS, width=0.3, run=run),
    "OctreeTexture.contains": lambda run, _: adaptive(1).contains(POINTS, run=run),
    "Layers.fill": lambda run, _: painter(run, True, octex.Layers),
    "Layers.paint": lambda run, _: painter(run, False, octex.Layers),
    "Painter.fill": lambda run, _: painter(run, True),
    "Painter.paint": lambda run, _: painter(run, False),
    "TextureSet.sample": lambda run, _: TextureSet({"a": adaptive(1), "b": adaptive(2)}).sample(
        POINTS, np.arange(len(POINTS)) % 2, run=run
    ),
    "TextureSet.contains": lambda run, _: TextureSet({"a": adaptive(1)}).contains(POINTS, "a", run=run),
    "bake": lambda run, _: octex.bake(painted(), SURFACE, texture_size=256, run=run),
    "blur": lambda run, _: octex.blur(adaptive(1), 0.3, run=run),
    "combine": lambda run, _: octex.combine(adaptive(1), adaptive(2), run=run),
    "combine, over": lambda run, _: octex.combine(adaptive(1), adaptive(2), over=True, run=run),
    "convert": lambda run, _: octex.convert(SURFACE, 5, run=run),
    "convert, max_error": lambda run, _: octex.convert(SURFACE, 5, max_error=8, run=run),
    "convert, path": lambda run, folder: octex.convert(SURFACE, 5, path=folder / "a.octex", run=run),
    "convert, thin": lambda run, _: octex.convert(bent(0.03), 5, run=run),
    "convert_set": lambda run, _: octex.convert_set({"a": SURFACE, "b": bent(0.03)}, 4, run=run),
    "fill": lambda run, _: octex.fill(None, SURFACE, SPHERE, (1, 0, 0), max_depth=7, run=run),
    "finish": lambda run, _: octex.finish(SURFACE, painted(), texture_size=64, run=run),
    "fill, finer": lambda run, _: octex.fill(painted(), SURFACE, SPHERE, (1, 0, 0), max_depth=6, run=run),
    "merge": lambda run, _: octex.merge(
        painted(), octex.project(SURFACE, shots(1), like=painted()), SURFACE, run=run
    ),
    "mix": lambda run, _: octex.mix(adaptive(1), adaptive(2), 0.4, run=run),
    "mix, texture": lambda run, _: octex.mix(
        adaptive(1), adaptive(2), octex.cast(adaptive(3), channels=["alpha"]), run=run
    ),
    "paint": lambda run, _: octex.paint(None, SURFACE, shots(1), run=run),
    "paint, best": lambda run, _: octex.paint(
        None, SURFACE, shots(5), pictures="best", balance="full", run=run
    ),
    "paint, robust": lambda run, folder: octex.paint(
        painted(), SURFACE, shots(5), balance="gain", run=replace(run, memory=1, resume=folder / "a")
    ),
    "project": lambda run, _: octex.project(SURFACE, shots(2), run=run),
    "refine_cameras": lambda run, _: octex.refine_cameras(SURFACE, shots(3), run=run),
    "resize": lambda run, _: octex.resize(adaptive(1), 4, run=run),
    "write_ptex": lambda run, folder: (
        octex.write_ptex(painted(), SURFACE, folder / "a.ptx", run=run),
        (folder / "a.ptx").read_bytes(),
    ),
}  # fmt: skip


def numbers_in(made):
    """Return all numbers of what a function returns."""
    if isinstance(made, OctreeTexture):
        values = [array for channel in made.channels.values() for array in channel[1:]]
        return [*made.tree.arrays, *made.tree.split, *made.tree.kept, made.bounds, *values]
    if isinstance(made, octex.Camera):
        return [made.K, made.world_to_camera]
    if isinstance(made, octex.Surface):
        assert made.uv is not None
        inputs = [each for material in made.source.materials for each in material.inputs.values()]
        return [made.uv.values, made.uv.rows, *(each.texture.texels for each in inputs if each.texture)]
    if isinstance(made, Mapping):
        return [array for each in made.values() for array in numbers_in(each)]
    if isinstance(made, (list, tuple)):
        return [array for each in made for array in numbers_in(each)]
    return [np.frombuffer(made, np.uint8) if isinstance(made, bytes) else np.asarray(made)]


def test_every_public_function_that_takes_a_run_is_tried_here():
    found = set()
    for name in [*octex.__all__, "map", "open"]:
        given = getattr(octex, name)
        if inspect.isclass(given):
            members = inspect.getmembers(given, inspect.isroutine)
            each = {f"{name}.{own}": one for own, one in members if not own.startswith("_")}
        else:
            each = {name: given}
        for full, one in each.items():
            with suppress(TypeError, ValueError):  # numbers, and what Python is made of
                if "run" in inspect.signature(one).parameters:
                    found.add(full)
    assert found == {name.partition(",")[0] for name in FUNCTIONS}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse_what_is_no_run_and_what_they_have_no_use_for(name, tmp_path):
    does, function = FUNCTIONS[name], name.partition(",")[0]
    if name != "paint, robust":  # which changes its run
        with pytest.raises(ArgumentError, match=r"run must be an octex\.Run, not 4"):
            does(4, tmp_path)
    if function not in ("paint", "project", "refine_cameras"):
        with pytest.raises(ArgumentError, match="resume of run is not used here; leave it out"):
            does(octex.Run(resume=tmp_path), tmp_path)
        if function != "convert":
            with pytest.raises(ArgumentError, match="memory of run is not used here; leave it out"):
                does(octex.Run(memory=1), tmp_path)


@needs_jit
@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_do_the_same_in_threads_and_in_other_processes(name, processes, tmp_path, monkeypatch):
    monkeypatch.setattr(lookup, "BLOCK", 16)
    made = []
    with ThreadPoolExecutor(2) as threads:
        for number, pool in enumerate((None, threads, processes)):
            folder = tmp_path / str(number)
            folder.mkdir()
            made.append(numbers_in(FUNCTIONS[name](octex.Run(executor=pool), folder)))
    assert sum(array.size for array in made[0])
    for other in made[1:]:
        for one, same_one in zip(made[0], other, strict=True):
            assert one.dtype == same_one.dtype
            np.testing.assert_array_equal(one, same_one)


@needs_jit
def test_a_conversion_in_many_tasks_makes_the_same_bytes_in_other_processes(processes, tmp_path, monkeypatch):
    octex.convert(SURFACE, 8, threads=1).save(tmp_path / "alone.octex")
    monkeypatch.setattr(fragments, "TASK_FRAGMENTS", 5_000)
    octex.convert(SURFACE, 8, run=octex.Run(executor=processes)).save(tmp_path / "many.octex")
    assert (tmp_path / "alone.octex").read_bytes() == (tmp_path / "many.octex").read_bytes()


def by_numpy(numbers):
    numbers[0] = 1


@kernel
def _write(numbers):
    numbers[0] = 1


def by_kernel(numbers):
    _write(numbers)


def test_who_writes_to_arrays_that_are_not_shared_gets_an_error(processes):
    with workers(octex.Run(executor=processes)) as pool:
        for numbers in (np.zeros(4), np.zeros(8)[::2]):
            with pytest.raises(ValueError, match="read-only"):
                start(pool, by_numpy, numbers).result()
            with pytest.raises(RuntimeError, match=r"by_kernel.* writes to arrays that are not shared"):
                start(pool, by_kernel, numbers).result()
        with pytest.raises(octex.OctexError, match=r"executor: .*define functions in a module"):
            start(pool, lambda: 1)
        with sharing(pool) as here:
            numbers = np.zeros(4)
            start(here, by_kernel, numbers).result()
            assert numbers[0] == 1


def test_a_point_that_is_not_finite_is_named_by_another_process(processes, monkeypatch):
    monkeypatch.setattr(lookup, "BLOCK", 16)
    points = POINTS.copy()
    points[33, 1] = np.nan
    with pytest.raises(octex.OctexError, match=r"points must be finite, but points\[33\]"):
        adaptive(1).sample(points, run=octex.Run(executor=processes))
