"""octex.Run: its fields, the shortcuts beside it, and the functions that take it."""

import inspect
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

import octex
from octex.errors import ArgumentError
from octex.parallel import as_run, silent
from tests.make.small_surfaces import tetrahedron

WRONG = [
    *[({"threads": each}, "threads must be a whole number from 1") for each in (0, -1, 1.5, "2", True)],
    ({"executor": 4}, r"executor must be a concurrent\.futures\.Executor, not 4"),
    ({"memory": "2 elephants"}, "memory: '2 elephants' is not a size"),
    ({"memory": 0}, "memory must be"),
    ({"folder": "."}, "folder needs memory"),
    ({"folder": 3, "memory": 1}, "folder must be a path, not 3"),
    ({"resume": 3}, "resume must be a path, not 3"),
    ({"progress": "loud"}, r"progress must be a function \(stage, done, total\), not 'loud'"),
]


@pytest.mark.parametrize(("fields", "message"), WRONG)
def test_a_field_that_cannot_be_used_is_named(fields, message):
    with pytest.raises(ArgumentError, match=message):
        octex.Run(**fields)


def test_shortcuts_set_the_fields_that_a_run_leaves_open(tmp_path):
    run = octex.Run(memory="1kB", folder=tmp_path)
    assert as_run(run, 3, print, "memory", "folder") == replace(run, threads=3, progress=print)
    assert as_run(None, 3, print) == octex.Run(threads=3, progress=print)
    assert as_run(None) == octex.Run()
    assert as_run(run, None, None, "memory", "folder") is run
    assert octex.Run().report is silent
    assert octex.Run(progress=print).report is print
    with ThreadPoolExecutor(1) as pool:
        for given, message in (
            ((octex.Run(executor=pool), 2), "threads or an executor, not"),
            ((octex.Run(threads=2), 2), "give threads or a run with threads, not both"),
            ((run, 0, None, "memory", "folder"), "threads must be a whole number from 1"),
            ((octex.Run(progress=print), None, print), "give progress or a run with progress, not both"),
        ):
            with pytest.raises(ArgumentError, match=message):
                as_run(*given)
        with pytest.raises(ArgumentError, match="threads or an executor, not"):
            octex.Run(threads=2, executor=pool)


def test_what_a_function_cannot_do_with_a_run_is_refused(tmp_path):
    nowhere = octex.Run(memory=1, folder="no/such")
    for options, message in (
        ({"run": octex.Run(resume="a")}, "resume of run is not used here"),
        ({"run": octex.Run(memory=1)}, "memory needs a path"),
        ({"run": nowhere, "path": tmp_path / "a.octex"}, "folder: no/such is not a folder; name an existing"),
        ({"run": 2}, r"run must be an octex\.Run, not 2"),
    ):
        with pytest.raises(ArgumentError, match=message):
            octex.convert(tetrahedron(), 2, **options)


def functions_with(names):
    """Return the public functions and methods that have parameters of some names."""
    homes = [octex, octex.OctreeTexture, octex.TextureSet, octex.Surface, octex.Painter]
    known = {
        f"{home.__name__}.{name}": getattr(home, name)
        for home in homes
        for name in dir(home)
        if name[:2] != "__"
    }
    return {
        name: each
        for name, each in known.items()
        if inspect.isfunction(each) and names & set(inspect.signature(each).parameters)
    }


def test_all_that_works_in_parallel_takes_a_run_and_threads_and_says_so():
    assert not functions_with({"executor", "memory", "resume"})
    functions = functions_with({"run", "threads"})
    assert len(functions) > 20
    for name, function in functions.items():
        parameters = inspect.signature(function).parameters
        for each in ("run", "threads"):
            assert parameters[each].default is None, name
            assert parameters[each].kind is inspect.Parameter.KEYWORD_ONLY, name
        words = " ".join((function.__doc__ or "").split())
        assert any(each in words for each in ("octex.Run", "arguments are those of", "as ``octex.")), name
