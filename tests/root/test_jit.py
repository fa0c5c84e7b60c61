"""Compiled kernels on disk: they fit the source, are checked when read, and many processes write them."""

import gc
import multiprocessing
import os
import shutil
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numba
import pytest
from numba.core import event

from octex import jit
from octex.ahead import read_types, types_text
from octex.jit import cache
from tests.conftest import needs_jit

pytestmark = needs_jit

_MODULE = """
from numba.core import event
from octex import jit

@jit.inlined
def square(a):
    return a * a

@jit.kernel
def whole(a, b):
    return square(a) + square(b) * square(a + b)

class Counter(event.Listener):
    names = []
    def on_start(self, told):
        Counter.names.append(told.data["dispatcher"].py_func.__name__)
    def on_end(self, told):
        pass

event.register("numba:compile", Counter())
"""


@pytest.fixture
def room(tmp_path):
    """A folder with a module ``slow`` that has a kernel, a part, and the names of what is compiled."""
    (tmp_path / "slow.py").write_text(_MODULE, encoding="utf-8")
    return tmp_path


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Such a folder whose module is compiled."""
    room = tmp_path_factory.mktemp("compiled") / "room"
    room.mkdir()
    (room / "slow.py").write_text(_MODULE, encoding="utf-8")
    assert said(room) == "square whole"
    assert len(code_files(room)) == 4
    return room


@pytest.fixture
def compiled_room(compiled, tmp_path):
    return Path(shutil.copytree(compiled, tmp_path / "copy"))


_METHODS = multiprocessing.get_all_start_methods()
_CONTEXT = multiprocessing.get_context("forkserver" if "forkserver" in _METHODS else "spawn")
_CONTEXT.set_forkserver_preload([__name__])  # each process has numba then


class Started:
    """A new process that runs code with the module within reach, and a cache beside it."""

    def __init__(self, room, code):
        self._told, telling = _CONTEXT.Pipe(duplex=False)
        self._process = _CONTEXT.Process(target=_run, args=(room, code, telling))
        self._process.start()
        telling.close()

    def words(self):
        """Return what it prints."""
        try:
            return str(self._told.recv())
        finally:
            self._process.join()
            assert self._process.exitcode == 0


def _run(room, code, telling):
    os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = str(room / "cache")
    sys.path.insert(0, str(room))
    with redirect_stdout(StringIO()) as words:
        exec(code, {})
    telling.send(words.getvalue().strip())


def said(room, code="assert slow.whole(1, 2) == 37"):
    """Return what code prints after the module's import, and then what has been compiled."""
    return Started(room, f"import slow\n{code}\nprint(*sorted(slow.Counter.names))").words()


def code_files(room):
    return sorted((room / "cache").rglob("*.nb[ci]"))


def test_a_kernel_is_compiled_once(compiled):
    assert said(compiled) == ""


@pytest.mark.parametrize("damages", [("a page of zeros", "cut off"), ("empty", "empty"), ("", "")])
def test_damaged_code_is_compiled_anew(damages, compiled_room):
    room = compiled_room
    for path in code_files(room):
        content = path.read_bytes()
        middle = len(content) // 2
        damage = damages["whole" in path.name]
        if damage == "a page of zeros":
            path.write_bytes(content[:middle] + bytes(256) + content[middle + 256 :])
        elif damage:
            path.write_bytes(content[: middle if damage == "cut off" else 0])
        else:
            (path.parent / "checksums").unlink(missing_ok=True)
    assert said(room) == "square whole"
    assert said(room) == ""


def test_processes_that_add_versions_at_once_keep_all(room):
    # They begin together, and each adds versions of the same two functions.
    code = """
import numpy as np, slow
for kind in {kinds}:
    assert slow.whole(kind(1), kind(2)) == 37
"""
    kinds = (
        "np.int16, np.uint16, np.int32",
        "np.float32, np.uint32, np.float64",
        "np.int64, np.uint64, np.int16",
    )
    processes = [Started(room, code.format(kinds=f"({each})")) for each in kinds]
    assert [process.words() for process in processes] == ["", "", ""]
    together = code.format(kinds=f"({', '.join(kinds)})").replace(
        "import numpy as np, slow", "import numpy as np"
    )
    assert said(room, together) == ""


def test_changed_source_is_compiled_anew(compiled_room):
    before = cache.digest_behind("octex.tree.morton")
    behind = cache.modules_behind("octex.tree.morton")
    assert {"octex.tree.morton", "octex.jit", "octex.jit.instructions"} <= behind
    assert cache.digest_behind("octex.jit.instructions") != before
    changed = _MODULE.replace("return a * a", "return a * a * 1")
    (compiled_room / "slow.py").write_text(changed, encoding="utf-8")
    assert said(compiled_room) == "square whole"


def test_code_of_another_place_is_taken_over(compiled_room):
    moved = compiled_room.rename(compiled_room.with_name("moved"))
    assert said(moved) == ""


def test_without_a_folder_to_write_to_kernels_are_compiled_in_each_process(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "file" / "none"))
    cache._folder_of.cache_clear()

    @jit.kernel
    def double(number):
        return number + number

    cache._folder_of.cache_clear()
    assert double(1.5) == 3.0
    assert double.compiled.stats.cache_path is None
    assert str(numba.config.CACHE_DIR) == str(tmp_path / "file" / "none")


def test_types_are_read_as_they_are_written():
    text = "uint8:2C, float64:1A, bool, int64, octex.field.tile_taps.WindowTables(uint64:1C, uint16:1C)"
    assert types_text(read_types(text)) == text
    for wrong in (
        "gone",
        "octex.field.tile_taps.Gone(int64)",
        "octex.field.tile_taps.WindowTables(int64)",
        "int64:C",
    ):
        with pytest.raises((AttributeError, ImportError, ValueError)):
            read_types(wrong)


def test_garbage_is_collected_less_while_numba_compiles():
    before = gc.get_threshold()
    seen = []

    class Listener(event.Listener):
        def on_start(self, _event):
            seen.append(gc.get_threshold()[0])

        on_end = on_start

    double = numba.njit(lambda number: number + number)
    with event.install_listener("numba:compile", Listener()):
        assert double(1.5) == 3.0
    assert set(seen) == {cache.MANY_OBJECTS}
    assert gc.get_threshold() == before
