"""Channels, the border checks, the compile policy, parallel work and the errors: what all rooms stand on."""

import importlib
import math
import os
import pkgutil
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

import octex
from octex import channels, checks, errors, jit, parallel
from octex.channels import decode, encode, linear_to_srgb, srgb_to_linear
from octex.errors import ArgumentError, ExitCode
from octex.jit import cache
from octex.parallel import Run
from octex.tree import normals
from octex.tree.layout import MAX_DEPTH
from tests.conftest import needs_jit

# --- channels


@pytest.mark.parametrize("space", channels.COLOR_SPACES)
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_every_code_survives_decoding_and_encoding(dtype, space):
    codes = np.arange(int(channels.ONE[dtype]) + 1).astype(dtype)
    np.testing.assert_array_equal(encode(decode(codes, space), dtype, space), codes)


@pytest.mark.parametrize("space", channels.COLOR_SPACES)
@pytest.mark.parametrize(("dtype", "precision"), [("float16", 2e-3), ("float32", 1e-6)])
def test_floats_survive_encoding_beyond_one_too(dtype, precision, space):
    values = np.array([[-0.25, 0.0, 1e-3], [0.18, 1.0, 6.5]])
    stored = encode(values, dtype, space)
    assert stored.dtype == dtype
    decoded = decode(stored, space)
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(decoded, values, rtol=3 * precision)


def test_the_transfer_curve_has_the_standards_values_and_an_inverse():
    # IEC 61966-2-1: code 128 is 21.586 % linear light, code 10 lies on the straight part.
    np.testing.assert_allclose(srgb_to_linear(128 / 255), 0.2158605, rtol=1e-6)
    np.testing.assert_allclose(srgb_to_linear(10 / 255), 10 / 255 / 12.92, rtol=1e-12)
    values = np.append(np.linspace(0, 1, 10_001), [0.04045, 0.0031308, 1e-12])
    for there, back in ((srgb_to_linear, linear_to_srgb), (linear_to_srgb, srgb_to_linear)):
        np.testing.assert_allclose(back(there(values)), values, rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_integers_of_srgb_are_the_codes_nearest_on_the_curve(dtype):
    # All bins of the encoders, and both sides of every place where one code gives way to the next.
    one = int(channels.ONE[dtype])
    edges = srgb_to_linear((np.arange(one) + 0.5) / one)
    values = np.concatenate([np.linspace(0, 1, 2001), edges])
    nearest = np.floor(linear_to_srgb(values) * one + 0.5)
    found = encode(values, dtype, "srgb").astype(np.float64)
    differing = found != nearest
    # Where the direct formula lies within rounding of a half, either code is the nearest.
    assert np.all(np.abs(linear_to_srgb(values[differing]) * one % 1 - 0.5) < 1e-9)
    np.testing.assert_array_equal(encode(edges * (1 - 1e-11), dtype, "srgb"), np.arange(one))
    np.testing.assert_array_equal(encode(edges * (1 + 1e-11), dtype, "srgb"), np.arange(1, one + 1))


def plainly_encoded(values, dtype, space):
    """Encode by the formulas, step by step."""
    if dtype.startswith("float"):
        largest = np.finfo(dtype).max
        return np.clip(linear_to_srgb(values) if space == "srgb" else values, -largest, largest).astype(dtype)
    unit = np.clip(values, 0, 1)
    if space == "direction":
        unit = (np.clip(values, -1, 1) + 1) / 2
    return np.rint((linear_to_srgb(unit) if space == "srgb" else unit) * channels.ONE[dtype]).astype(dtype)


@pytest.mark.parametrize("space", channels.COLOR_SPACES)
@pytest.mark.parametrize("dtype", channels.ONE)
def test_encoding_follows_the_plain_formulas(dtype, space):
    random, count = np.random.default_rng(3), 500 if jit.DISABLED else 50_000
    steps = [0.0, -0.0, 1.0, -1.0, 2.0**-14, 2.0**-25, 3 * 2.0**-25, 65519.0, 65520.0]
    small_and_large = random.normal(size=count) * 10.0 ** random.integers(-9, 7, count)
    values = np.concatenate([random.random(count), random.normal(size=count), small_and_large, steps])
    np.testing.assert_array_equal(encode(values, dtype, space), plainly_encoded(values, dtype, space))


def test_directions_are_stored_about_the_middle_of_integers():
    np.testing.assert_array_equal(encode(np.array([-1.0, 0.0, 1.0]), "uint8", "direction"), [0, 128, 255])
    for dtype, codes, expected in (
        ("uint8", [0, 255], [-1.0, 1.0]),
        ("uint16", [0, 65535], [-1.0, 1.0]),
        ("float16", [-0.5], [-0.5]),
    ):
        np.testing.assert_array_equal(decode(np.array(codes, dtype), "direction"), expected)


@pytest.mark.parametrize("space", channels.COLOR_SPACES)
@pytest.mark.parametrize("dtype", channels.ONE)
def test_what_is_not_finite_is_clamped_and_nan_is_zero(dtype, space):
    values = np.array([1e300, np.inf, -1e300, -np.inf, np.nan, -np.nan])
    least, most = (0, channels.ONE[dtype]) if dtype[0] == "u" else (np.finfo(dtype).min, np.finfo(dtype).max)
    np.testing.assert_array_equal(encode(values, dtype, space), [most, most, least, least, 0, 0])


def test_encoding_takes_any_memory_layout_and_keeps_the_shape():
    values = np.random.default_rng(1).random((6, 4, 3)).astype(np.float32)
    for view in (values[::2], values.transpose(1, 0, 2), values[:, :, :1], values[:0]):
        expected = np.rint(linear_to_srgb(view) * 255)
        found = encode(view, "uint8", "srgb")
        assert found.shape == view.shape
        np.testing.assert_array_equal(found, expected)


def test_decoding_is_done_by_a_table_that_is_made_once():
    assert channels.decode_table("uint8", "srgb") is channels.decode_table("uint8", "srgb")
    assert channels.decode_table("uint16", "data")[-1] == 1.0


# --- checks


def test_points_become_contiguous_native_floats_and_are_not_copied_if_they_are():
    for points, dtype in (
        (np.zeros((4, 6), np.float32)[:, ::2], np.float32),
        (np.zeros((3, 4)).T, np.float64),
        (np.zeros((4, 3), np.float16), np.float64),
        (np.zeros((4, 3), ">f4"), np.float64),
        (np.zeros((4, 3), np.int32), np.float64),
        ([(0, 0, 0)], np.float64),
        (np.zeros((0, 3)), np.float64),
    ):
        array = checks.as_points(points)
        assert array.dtype == dtype
        assert array.dtype.isnative
        assert array.flags.c_contiguous
        assert array.shape == np.shape(points)
        assert checks.as_points(array) is array


def test_a_depth_is_a_python_integer_in_its_range():
    for depth in (0, MAX_DEPTH, np.int64(7)):
        assert type(checks.as_depth(depth)) is int
        assert checks.as_depth(depth) == depth
    for depth in (-1, MAX_DEPTH + 1, 3.0, "3", None, True):
        with pytest.raises(ArgumentError, match=r"^level must be a whole number from 0 to 21, not "):
            checks.as_depth(depth, "level")


def test_a_choice_is_one_of_the_known_ones():
    assert checks.as_choice("b", "abc", "filter") == "b"
    with pytest.raises(ArgumentError, match=r"^unknown filter 'z'; there are: a, b$"):
        checks.as_choice("z", iter(["a", "b"]), "filter")
    with pytest.raises(ArgumentError, match=r"^unknown channel 'z'; there are: none$"):
        checks.as_choice("z", [], "channel")


def test_a_positive_number_is_finite_and_above_zero():
    assert checks.as_positive(np.float32(0.5), "cell") == 0.5
    for value in (0, -1.0, np.inf, np.nan):
        with pytest.raises(ArgumentError, match=r"^cell must be finite and above zero, not "):
            checks.as_positive(value, "cell")
    for value in (None, "wide"):
        with pytest.raises(ArgumentError, match=r"^cell must be a number, not "):
            checks.as_positive(value, "cell")


# --- jit


@pytest.mark.parametrize("bits", [1, 0b1000, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF, 0xF0F0_0000_0001_0000])
def test_bit_counts_agree_with_python(bits):
    assert _bit_counts(np.uint64(bits)) == (bits.bit_count(), (bits & -bits).bit_length() - 1)


@jit.kernel
def _bit_counts(bits):
    return jit.popcount(bits), jit.trailing_zeros(bits)


@needs_jit
def test_code_whose_types_are_gone_is_compiled_anew(tmp_path):
    call = [sys.executable, "-c", "from octex.tree import normals; print(normals._facing_sum(33))"]
    options = {"env": os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}, "capture_output": True}
    assert subprocess.run(call, **options, check=True).stdout == b"(1.0, 0.0, -1.0)\n"
    (kept,) = tmp_path.rglob("*normals._facing_sum-*.nbc")
    gone = kept.read_bytes()[:32] + b"coctex.a_module_that_was\nIts_type\n."
    kept.write_bytes(gone)
    assert subprocess.run(call, **options, check=True).stdout == b"(1.0, 0.0, -1.0)\n"
    assert kept.read_bytes() != gone


# --- parallel


class Eager(Executor):
    """Runs at once, and counts."""

    submitted = 0

    def submit(self, fn, /, *args, **kwargs):
        self.submitted += 1
        future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def test_results_come_in_the_order_of_the_items_whatever_finishes_first():
    second_is_done = threading.Event()

    def work(item):
        if item == 0:
            assert second_is_done.wait(60)
        if item == 1:
            second_is_done.set()
        return item * item

    with ThreadPoolExecutor(3) as pool:
        found = list(parallel.ordered_map(pool, work, range(9), window=4))
    assert found == [i * i for i in range(9)]


def test_no_more_than_the_window_is_in_flight():
    executor = Eager()
    results = parallel.ordered_map(executor, str, range(10), window=3)
    for taken in range(10):
        assert next(results) == str(taken)
        assert executor.submitted <= min(10, taken + 3)


def test_progress_counts_every_item_once():
    calls = []
    told = {"stage": "cells", "progress": lambda *call: calls.append(call), "window": 2}
    list(parallel.ordered_map(Eager(), abs, [3, 2, 1], **told))
    assert calls == [("cells", 1, 3), ("cells", 2, 3), ("cells", 3, 3)]
    assert list(parallel.ordered_map(Eager(), abs, [])) == []


@pytest.mark.parametrize("fails", [True, False])
def test_an_error_in_the_map_and_leaving_it_early_cancel_the_rest(fails):
    release = threading.Event()
    begun = []

    def work(item):
        begun.append(item)
        if item:
            release.wait(60)
        elif fails:
            raise ZeroDivisionError
        return item

    with ThreadPoolExecutor(1) as executor:
        results = parallel.ordered_map(executor, work, range(20))
        with pytest.raises(ZeroDivisionError) if fails else nullcontext():
            assert next(results) == 0
        if not fails:
            results.close()
        release.set()
    assert set(begun) <= {0, 1}


def test_an_error_in_the_block_drops_the_work_that_has_not_begun():
    release = threading.Event()
    futures = []
    with pytest.raises(KeyboardInterrupt), parallel.pool_of(1) as executor:
        futures += [executor.submit(release.wait, 10) for _ in range(5)]
        futures[-1].add_done_callback(lambda _: release.set())  # the first ends once the last is cancelled
        raise KeyboardInterrupt
    assert futures[-1].cancelled()


def test_workers_are_the_callers_executor_or_threads_over_all_processors(monkeypatch):
    executor = Eager()
    with parallel.workers(Run(executor=executor)) as given_back:
        assert given_back is executor
    monkeypatch.setattr(parallel, "cpu_count", lambda: 3)
    for threads, tasks, expected in ((None, None, 3), (None, 2, 2), (5, None, 5), (5, 4, 4)):
        with parallel.workers(Run(threads=threads), tasks) as own:
            assert own._max_workers == expected
        with pytest.raises(RuntimeError):
            own.submit(print)
    with parallel.at_most(2), parallel.workers(Run(threads=5)) as own:
        assert own._max_workers == 2


def test_little_work_and_work_inside_work_stays_in_the_calling_thread():
    def who():
        with parallel.workers() as inner:
            return inner.submit(threading.current_thread).result(), threading.current_thread()

    for threads, tasks in ((1, None), (None, 1), (7, 1), (None, 0)):
        with parallel.workers(Run(threads=threads), tasks) as here:
            assert here.submit(threading.current_thread).result() is threading.current_thread()
    with parallel.workers(Run(threads=2)) as pool:
        inner, outer = pool.submit(who).result()
        assert inner is outer is not threading.current_thread()


def test_what_is_built_once_is_built_by_one_of_the_threads_that_want_it():
    class Slow:
        built = 0

        @parallel.built_once
        def value(self):
            self.built += 1
            time.sleep(0.01)
            return object()

    slow = Slow()
    with ThreadPoolExecutor(4) as pool:
        values = list(pool.map(lambda _: slow.value, range(8)))
    assert slow.built == 1
    assert all(value is values[0] for value in values)


def test_who_builds_one_object_waits_for_nobody_who_builds_another():
    class Slow:
        def __init__(self):
            self.begun, self.may_end = threading.Event(), threading.Event()

        @parallel.built_once
        def value(self):
            self.begun.set()
            assert self.may_end.wait(10)
            return 1

    first, second = Slow(), Slow()
    with ThreadPoolExecutor(2) as pool:
        try:
            found = pool.submit(lambda: first.value)
            assert first.begun.wait(10)
            second.may_end.set()
            assert pool.submit(lambda: second.value).result(5) == 1
        finally:
            first.may_end.set()
        assert found.result() == 1


def test_processors_are_counted_where_affinity_is_unknown(monkeypatch):
    assert parallel.cpu_count() >= 1
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert parallel.cpu_count() == 1


def test_memory_is_that_of_the_machine_or_of_a_smaller_container(monkeypatch):
    assert parallel.memory_size() > 1e8
    monkeypatch.setattr(Path, "read_text", lambda *_: "3000000\n")
    assert parallel.memory_size() == 3e6
    monkeypatch.setattr(Path, "read_text", lambda *_: "max\n")
    monkeypatch.delattr(os, "sysconf", raising=False)
    assert parallel.memory_size() == math.inf


# --- errors


def test_every_error_is_an_octex_error_of_its_kind():
    kinds = {
        errors.InputError: [ArgumentError, errors.ModelError, errors.ImageError, errors.TextureFileError],
        octex.OctexError: [errors.InputError, errors.OutputError, errors.MissingExtraError],
        ValueError: [ArgumentError],
        ImportError: [errors.MissingExtraError],
    }
    for parent, children in kinds.items():
        assert all(issubclass(kind, parent) for kind in children)


def test_exit_codes_are_the_shells_and_say_what_they_mean():
    assert {code.name: int(code) for code in ExitCode} == {
        "DONE": 0, "INVALID": 1, "REFUSED": 2, "NOTHING_PAINTED": 3, "CRASHED": 70, "INTERRUPTED": 130,
        "TERMINATED": 143,
    }  # fmt: skip
    assert all(code.meaning for code in ExitCode)
    assert ExitCode(2) is ExitCode.REFUSED


@needs_jit
def test_compiled_code_on_disk_is_of_this_state_of_all_that_it_is_compiled_from():
    # numba alone looks at the kernel's own file, and keeps callers of a function that has changed elsewhere.
    folder = Path(normals._facing_sum.compiled.stats.cache_path).parent
    assert folder == cache._folder_of("octex.tree.normals")
    others = {cache.digest_behind(f"octex.{name}") for name in ("channels", "checks")}
    assert cache.digest_behind("octex.tree.normals") not in others


@needs_jit
def test_what_kernels_call_is_in_a_module_behind_theirs():
    calls = 0
    for found in pkgutil.walk_packages(octex.__path__, "octex."):
        module = importlib.import_module(found.name)
        behind = cache.modules_behind(module.__name__)
        for kernel in [each for each in vars(module).values() if hasattr(each, "py_func")]:
            if kernel.__module__ != module.__name__:
                continue
            for name in kernel.py_func.__code__.co_names:
                home = getattr(kernel.py_func.__globals__.get(name), "__module__", None) or ""
                assert not home.startswith("octex.") or home in behind, (kernel, name)
                calls += home.startswith("octex.")
    assert calls > 100
