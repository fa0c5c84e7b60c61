"""What octex changes of numba: which code it keeps on disk, for whom, and what of numba it must find."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba import types
from numba.core import caching, codegen, compiler, dispatcher, event, ir, lowering, postproc
from numba.core.types import functions

from octex import jit
from octex.field.sources import Group, Tables
from octex.jit import cache, compilers, decorators, shortcuts
from tests.conftest import needs_jit

#: Files one version after the other beside the same work of another process, each in step with it.
_WRITER = """
import mmap, sys, time
from octex.jit import low_bits

own, names = int(sys.argv[2]), sys.argv[3:]
files = low_bits._cache._cache_file
with open(sys.argv[1], "r+b") as shared:
    rounds = mmap.mmap(shared.fileno(), 2)
    for number, name in enumerate(names):
        rounds[own] = number + 1
        while rounds[1 - own] < number + 1:
            time.sleep(0)
        files.save(((name,), ("machine", "processor", "+feature"), ("bytecode",)), name)
"""


def of(name: str) -> tuple[Any, ...]:
    """A key like numba's."""
    return (name,), ("machine", "processor", "+feature"), ("bytecode",)


@needs_jit
def test_processes_that_add_versions_at_once_keep_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    shared = tmp_path / "rounds"
    shared.write_bytes(bytes(2))
    names = [[f"{process}.{number}" for number in range(100)] for process in range(2)]
    writers = [
        subprocess.Popen([sys.executable, "-c", _WRITER, shared, str(process), *names[process]])
        for process in range(2)
    ]
    assert [writer.wait() for writer in writers] == [0, 0]
    folder = next((tmp_path / "cache").iterdir())
    code = f"""
from octex.jit import low_bits
load = low_bits._cache._cache_file.load
print([key for key in {[of(name) for name in names[0] + names[1]]} if load(key) != key[0][0]])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert len(list(folder.iterdir())) == 200


@needs_jit
@pytest.mark.skipif(sys.platform == "win32", reason="without locks, each compiles for itself")
def test_of_processes_that_miss_the_same_one_compiles_it_and_the_others_wait(tmp_path: Path) -> None:
    module = tmp_path / "slow.py"
    module.write_text(
        "import sys, time\n"
        "from numba.core import event\n"
        "from octex import jit\n"
        "@jit.inlined\n"
        "def part(a):\n    return a * a\n"
        "@jit.kernel\n"
        "def whole(a, b):\n    return part(a) + part(b) * part(a + b)\n"
        "class Counter(event.Listener):\n"
        "    count = 0\n"
        "    def on_start(self, _):\n        Counter.count += 1\n        time.sleep(0.3)\n"
        "    def on_end(self, _):\n        pass\n"
        "event.register('numba:compile', Counter())\n"
        "assert whole(1, 2) == 37 and whole(1.0, 2.0) == 37\n"
        "print(Counter.count)\n",
        encoding="utf-8",
    )
    call = [sys.executable, "-c", "import slow"]
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    variables["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *sys.path])
    processes = [subprocess.Popen(call, stdout=subprocess.PIPE, text=True, env=variables) for _ in range(3)]
    counts = [int(process.communicate()[0]) for process in processes]
    assert sum(counts) == 4
    assert all(path.suffix == ".nbc" for path in (tmp_path / "cache").glob("*/*"))


def test_what_is_kept_serves_this_numba_this_source_and_this_key_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def files() -> cache.CodeFiles:
        return cache.CodeFiles(str(tmp_path), test_processes_that_add_versions_at_once_keep_all)

    files().save(of("this"), [1, 2])
    assert files().load(of("this")) == [1, 2]
    assert files().load(of("other")) is None
    with monkeypatch.context() as changed:
        changed.setattr("numba.__version__", "0.1")
        assert files().load(of("this")) is None
        files().save(of("this"), [3])  # takes the other's place
    assert files().load(of("this")) is None
    function = test_processes_that_add_versions_at_once_keep_all
    assert cache.CodeFiles(str(tmp_path), function, "of another file").load(of("this")) is None
    monkeypatch.setattr(cache, "digest_behind", lambda _module: "changed")
    files().save(of("this"), [4])
    assert files().load(of("this")) == [4]
    assert len(list(tmp_path.iterdir())) == 1
    files().flush()
    assert not list(tmp_path.iterdir())


def test_what_is_not_whole_or_cannot_be_written_is_as_if_it_were_not_there(tmp_path: Path) -> None:
    files = cache.CodeFiles(str(tmp_path), cache.key_text)
    files.save(of("this"), [1, 2])
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for size in (0, 10, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert files.load(of("this")) is None
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 64]) + whole[at + 1 :])
        assert files.load(of("this")) is None, at
    path.unlink()
    path.mkdir()  # nothing can be put there
    files.save(of("this"), [1])
    assert files.load(of("this")) is None
    assert list(tmp_path.iterdir()) == [path]
    cache.CodeFiles(str(tmp_path / "nowhere"), cache.key_text).save(of("this"), [1])


def test_functions_of_one_name_have_files_of_their_own(tmp_path: Path) -> None:
    def made(number: int) -> cache.CodeFiles:
        if number:

            def number_of() -> int:
                return 1

        else:

            def number_of() -> int:
                return 2

        return cache.CodeFiles(str(tmp_path), number_of)

    made(0).save(of("this"), "two")
    made(1).save(of("this"), "one")
    assert [made(number).load(of("this")) for number in range(2)] == ["two", "one"]


def test_code_that_is_shipped_serves_processors_with_all_that_it_may_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, features = cache.PORTABLE

    def on(triple: str, *features: str) -> tuple[Any, ...]:
        return ("this",), (triple, "processor", ",".join(features)), ("bytecode",)

    cache.CodeFiles(str(tmp_path), cache.key_text).save(
        (("this",), ("x86_64-linux", *cache.PORTABLE), ("bytecode",)), [1, 2]
    )
    monkeypatch.setattr(cache, "SHIPPED", tmp_path)
    monkeypatch.setattr("numba.config.BOUNDSCHECK", None)
    load = cache.CodeFiles(str(tmp_path / "own"), cache.key_text).load
    enough = ["+64bit", *features.split(","), "-avx512f"]
    assert load(on("x86_64-linux", *enough)) == [1, 2]
    assert load(on("x86_64-windows", *enough)) is None
    for feature in features.split(","):
        fewer = [f"-{each[1:]}" if each == feature else each for each in enough]
        assert load(on("x86_64-linux", *fewer)) is None
    assert load(on("x86_64-linux")) is None
    monkeypatch.setattr("numba.config.BOUNDSCHECK", 1)
    assert load(on("x86_64-linux", *enough)) is None
    assert name == "x86-64-v3"


def test_types_of_one_name_are_told_apart_by_their_modules() -> None:
    other = type("Tables", (tuple,), {"_fields": Tables._fields, "__module__": "elsewhere"})
    arrays = [types.Array(types.uint64, 1, "C"), types.Array(types.uint16, 1, "C")]
    own, others = (cache.type_text(types.NamedTuple(arrays, kind)) for kind in (Tables, other))
    assert own == "octex.field.sources:Tables(array(uint64, 1d, C), array(uint16, 1d, C))"
    assert others == own.replace("octex.field.sources", "elsewhere")
    assert Group.__name__ not in own


@needs_jit
@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (dispatcher.Dispatcher, "_compile_for_args"),
        (dispatcher.Dispatcher, "add_overload"),
        (dispatcher.Dispatcher, "get_call_template"),
        (dispatcher.Dispatcher, "typeof_pyval"),
        (caching.IndexDataCacheFile, "load"),
        (caching.IndexDataCacheFile, "save"),
        (caching.Cache, "cache_path"),
        (codegen.JITCodeLibrary, "_finalize_final_module"),
        (codegen.JITCodeLibrary, "_optimize_functions"),
        (codegen.CPUCodegen, "_pass_builder"),
        (ir.Inst, "_rec_list_vars"),
        (compiler.Compiler, "_compile_core"),
        (lowering.Lower, "_find_singly_assigned_variable"),
        (postproc.PostProcessor, "run"),
    ],
)
def test_a_numba_without_what_octex_uses_is_named_and_nothing_is_kept(
    owner: type, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = next(kind for kind in owner.__mro__ if name in vars(kind))
    monkeypatch.delattr(home, name)
    if home is caching.Cache:
        monkeypatch.setattr(home, "__abstractmethods__", frozenset())
        monkeypatch.setattr(caching.FunctionCache, "__abstractmethods__", frozenset())
        monkeypatch.delattr(caching._Cache, name)
    with pytest.warns(
        RuntimeWarning, match=rf"numba \S+ has no (.* and no )?(\w+\.)*{name}\b.*: low_bits is"
    ):
        compiled: Any = jit.kernel(jit.low_bits.py_func)  # type: ignore[attr-defined]
    assert isinstance(compiled._cache, caching.NullCache)


@needs_jit
@pytest.mark.parametrize("is_known", [True, False])
def test_what_only_kernels_call_is_kept_without_machine_code(
    is_known: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compilers, "IS_KNOWN", is_known)

    def made() -> tuple[Any, Any]:
        @jit.part
        def reversed_of(numbers: Any) -> Any:
            found = np.empty(numbers.size)
            for n in range(numbers.size):
                found[numbers.size - 1 - n] = numbers[n]
            return found

        @jit.kernel
        def reverse(numbers: Any, factor: float) -> Any:
            return reversed_of(numbers * factor)

        return reversed_of, reverse

    part, reverse = made()
    assert reverse(np.arange(3.0), 1).tolist() == [2, 1, 0]
    (code,) = part.overloads.values()
    again, reverse = made()
    assert reverse(np.arange(3.0), 1.5).tolist() == [3, 1.5, 0]  # another kernel, of the part that was kept
    (kept,) = again.overloads.values()
    assert code.library.get_pointer_to_function(code.fndesc.llvm_func_name) == 0
    assert type(kept.library) is type(code.library)
    assert kept.metadata is None  # read, not compiled
    with pytest.raises(TypeError, match="in kernels only"):
        again(np.arange(3.0))


def _mixed(numbers: Any, counts: Any, factor: float) -> Any:
    """Do something of most kinds, with arrays as wholes and one by one."""
    total, pair = 0.0, (1, 2.5)
    for n in range(len(numbers)):
        if counts[n] > 1 and not numbers[n] < -factor:
            total += numbers[n] ** 2 / (counts[n] + pair[1]) - counts[n] % 3
        counts[n] = (counts[n] << 1) ^ np.uint8(n)
    return numbers * factor + total, counts[::2], total


@needs_jit
@pytest.mark.parametrize(
    ("kind", "count_kind", "is_known"), [("f4", "u1", True), ("i8", "i4", True), ("f8", "u2", False)]
)
def test_kernels_are_typed_and_compute_as_numbas_own_functions(
    kind: str, count_kind: str, is_known: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compilers, "IS_KNOWN", is_known)
    numbers: Any = np.arange(-3, 4).astype(kind)
    counts: Any = np.arange(7).astype(count_kind)
    found = jit.kernel(_mixed)(numbers, counts.copy(), 1.5)
    expected = numba.njit(error_model="numpy")(_mixed)(numbers, counts.copy(), 1.5)
    for one, other in zip(found, expected, strict=True):
        assert np.asarray(one).dtype == np.asarray(other).dtype
        assert np.array_equal(one, other)


class _Pair(NamedTuple):
    whole: Any
    part: Any


def _read_and_written(pair: _Pair, grid: Any, flags: Any, first: int, count: Any) -> Any:
    """Read and write numbers of arrays in all ways, in loops and branches that share variables."""
    whole, some = pair.whole, pair.part
    total, last = 0.0, whole[-1]
    for n in range(grid.shape[0]):
        row = grid[n]
        for m in range(grid.shape[1]):
            if flags[n, m] and first:
                last = min(last, grid[n, -1 - m])
                some[np.uint8(m)] += row[m]
            else:
                grid[n, m] = max(int(last), n)
                flags[-1 - n, m] = not flags[n, m]
        total += max(some[n], last) - min(count, n) + int(some[-1] * 2.6) + int(flags[n, 0])
        some = whole if n == 1 else some
    kept = np.empty(3)
    kept[:] = total
    return kept, total, last, min(whole[0], np.nan), max(np.nan, whole[0]), max(count, first), pair.whole


@needs_jit
@pytest.mark.parametrize(("kind", "step"), [("f4", 1), ("f8", 2), ("i4", 1), ("u1", 3)])
def test_numbers_in_arrays_and_the_least_of_two_are_as_numbas_own(
    kind: str, step: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    def given() -> tuple[Any, ...]:
        numbers: Any = np.arange(60).astype(kind)
        grid: Any = (np.arange(60).reshape(5, 12) * 7 % 31).astype(kind)[:, ::step]
        flags = np.arange(grid.size).reshape(grid.shape) % 3 > 0
        return _Pair(numbers[5:20], numbers[:20:step][:20]), grid, flags, 1, np.int32(3)

    own, others = given(), given()
    found = jit.kernel(_read_and_written)(*own)
    expected = numba.njit(error_model="numpy")(_read_and_written)(*others)
    for one, other in zip((*found, *own[0], *own[1:]), (*expected, *others[0], *others[1:]), strict=True):
        assert np.asarray(one).dtype == np.asarray(other).dtype
        assert np.array_equal(one, other, equal_nan=True)
    assert sys.getrefcount(own[1]) == sys.getrefcount(others[1])


@needs_jit
def test_what_is_found_once_is_what_numba_finds() -> None:
    jit.low_bits(3)
    assert shortcuts._signatures
    for (context, function, arguments), signature in shortcuts._signatures.items():
        assert shortcuts._find_signature(function, context, arguments, {}) == signature
    lines = [line for block in compiler.run_frontend(_mixed).blocks.values() for line in block.body]
    before = [line.list_vars() for line in lines]
    with shortcuts.found_once():
        assert [line.list_vars() for line in lines] == before
        assert ir.Inst._rec_list_vars is not shortcuts._find_variables
    assert ir.Inst._rec_list_vars is shortcuts._find_variables
    assert functions.BaseFunction.get_call_type is shortcuts._find_signature
    assert sum(map(len, before)) > 50


@needs_jit
def test_garbage_is_sought_as_before_after_compiling() -> None:
    before = gc.get_threshold()
    seen = []

    @jit.kernel
    def double(number: float) -> float:
        return number + number

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, _event: Any) -> None:
            seen.append(gc.get_threshold()[0])

        on_end = on_start

    double._cache.flush()  # what earlier tests kept
    with event.install_listener("numba:compile", Listener()):
        assert double(1.5) == 3.0
    assert set(seen) == {decorators.MANY_OBJECTS}
    assert gc.get_threshold() == before
