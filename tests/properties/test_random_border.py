"""The border, called with odd arguments."""

import inspect
import os

import numpy as np
import pytest

import octex
from octex import jit
from tests.properties import random_border

SEEDS = range(300 if jit.DISABLED else 1500)


@pytest.mark.parametrize("part", range(10))
def test_odd_arguments_give_a_result_or_an_error_of_octex(part):
    for seed in SEEDS[part::10]:
        random_border.check(seed)


def test_all_that_octex_exports_is_called():
    called = {call.name for call in random_border.calls()}
    for name in {*octex.__all__, "map", "open"} - {"__version__", "OctexError"}:
        exported = getattr(octex, name)
        if exported is octex.Transfer or exported is octex.MappedImage or not inspect.isclass(exported):
            assert exported.__qualname__ in called
            continue
        methods = {
            f"{name}.{own}"
            for own, each in vars(exported).items()
            if not own.startswith("_") and (inspect.isfunction(each) or isinstance(each, classmethod))
        }
        # The first two and the last check nothing, and surfaces call the others.
        assert methods | {name} <= called | {
            *("Surface.evaluate_all", "Creases", "PointCloud.on", "Ptex.on", "Environment")
        }


def test_a_fault_is_told_with_its_arguments(monkeypatch):
    def faulty(depth):
        raise KeyError(depth)

    monkeypatch.setattr(random_border, "calls", lambda: [random_border.Call(faulty, {"depth": 2})])
    with pytest.raises(AssertionError, match=r"faulty\(depth=.*\): KeyError"):
        for seed in range(20):
            random_border.check(seed)


REFUSED = [
    (octex.convert, {"sources": 5}, "sources must be a dict with names as keys, not 5"),
    (octex.convert, {"depth": 2.0}, "depth must be a whole number from 0 to 21, not 2.0"),
    (octex.convert, {"fit": "no"}, "fit must be True or False, not 'no'"),
    (octex.convert, {"model": "a\0.glb"}, "'a.*00.glb' is not a valid file name"),
    (octex.Run, {"executor": 4}, r"executor must be a concurrent\.futures\.Executor, not 4"),
    (octex.convert, {"progress": True}, "progress must be a function"),
    (octex.convert, {"run": 4}, r"run must be an octex\.Run, not 4"),
    (octex.open, {"path": 3}, "path must be a path, not 3"),
    (octex.open, {"path": b"\0"}, "b'.*00' is not a valid file name"),
    (octex.blur, {"texture": None}, r"texture must be an octex\.OctreeTexture, not None"),
    (octex.fill, {"surface": "a.glb"}, r"surface must be an octex\.Surface, not 'a\.glb'"),
    (octex.map, {"f": 2}, "f must be a function of values, not 2"),
]


@pytest.mark.parametrize(("function", "odd", "message"), REFUSED)
def test_what_is_odd_is_named_in_the_refusal(function, odd, message):
    call = next(each for each in random_border.calls() if each.function is function)
    with pytest.raises(octex.OctexError, match=message):
        function(**{**call.arguments, **odd})


def test_numbers_of_numpy_and_paths_of_any_kind_are_taken(tmp_path):
    surface = random_border.world().surface
    one = octex.convert(surface, np.int64(2), fit=np.bool_(False), separate=np.bool_(False))
    one.save(os.fsencode(tmp_path / "one.octex"))
    octex.convert(surface, 2, fit=False).save(tmp_path / "other.octex")
    assert (tmp_path / "one.octex").read_bytes() == (tmp_path / "other.octex").read_bytes()
    for path in (tmp_path / "one.octex", str(tmp_path / "one.octex"), os.fsencode(tmp_path / "one.octex")):
        assert octex.open(path).info() == one.info()
    finer = octex.convert(surface, cell=np.float32(0.5), fit=False, max_error=np.float64(2))
    assert finer.metadata["convert"].startswith('{"cell": 0.5, "fit": false, "max_error": 2.0')
    assert octex.resize(one, np.uint8(1)).tree.max_depth == 1
    octex.TextureSet({"a": one}).save(os.fsencode(tmp_path / "set"))
    assert octex.TextureSet.open(os.fsencode(tmp_path / "set")).names == ("a",)
