"""Compiling ahead: the list of what to compile, and processes that do it and leave nothing behind."""

import inspect
import subprocess
import sys
import time

import numba
import pytest

from octex import ahead
from octex.ahead import types_text
from octex.cli.main import main
from tests.conftest import needs_jit


@pytest.fixture
def helpers(monkeypatch):
    """The helpers started, on a machine of four processors; each waits for the end of its input."""
    started = []

    def popen(*arguments, **settings):
        started.append(start(*arguments, **settings))
        return started[-1]

    start = subprocess.Popen
    monkeypatch.setattr(ahead, "_CALL", ("-c", "import sys; sys.stdin.read(); print('over', sys.argv[1:])"))
    monkeypatch.setattr(ahead, "cpu_count", lambda: 4)
    monkeypatch.setattr("octex.ahead.subprocess.Popen", popen)
    return started


def miss():
    """Have numba compile something."""
    numba.njit(lambda number: number + number)(1.5)


@needs_jit
def test_helpers_start_once_where_a_kernel_is_missing_and_end_with_the_work(helpers, capfd):
    miss()
    assert not helpers
    with pytest.raises(ZeroDivisionError), ahead.ahead("convert", "preview"):
        assert not helpers
        miss()
        miss()
        assert [helper.args[-4:] for helper in helpers] == [
            [str(number), "3", "convert", "preview"] for number in range(3)
        ]
        assert [helper.poll() for helper in helpers] == [None] * 3
        _ = 1 / 0
    assert [helper.returncode for helper in helpers] == [0, 0, 0]
    miss()
    assert len(helpers) == 3
    assert capfd.readouterr() == ("", "")


@needs_jit
@pytest.mark.parametrize("reason", ["one processor", "nothing to start", "python inside a program"])
def test_without_processors_or_a_python_to_start_no_helper_starts(reason, helpers, monkeypatch):
    if reason == "one processor":
        monkeypatch.setattr(ahead, "cpu_count", lambda: 1)
    else:
        monkeypatch.setattr(sys, "executable", "" if reason == "nothing to start" else "/usr/bin/blender")
    with ahead.ahead("convert"):
        miss()
    assert not helpers


@needs_jit
def test_a_helper_that_cannot_be_started_or_fails_is_no_matter(helpers, monkeypatch, tmp_path):
    with monkeypatch.context() as changed, ahead.ahead("convert"):
        changed.setattr(sys, "executable", str(tmp_path / "python"))
        miss()
    assert not helpers
    monkeypatch.setattr(ahead, "_CALL", ("-c", "raise SystemExit(3)"))
    with ahead.ahead("convert"):
        miss()
        for helper in helpers:
            helper.wait()
    assert [helper.returncode for helper in helpers] == [3, 3, 3]


@needs_jit
def test_commands_ask_for_helpers_unless_threads_are_counted(helpers, monkeypatch, tmp_path):
    def read(*_given):
        miss()
        raise ZeroDivisionError

    monkeypatch.setattr("octex.cli.convert.read_model", read)
    call = ["convert", "model.obj", str(tmp_path / "model.octex"), "--preview", str(tmp_path / "model.png")]
    main([*call, "--threads", "3"])
    assert not helpers
    main(call)
    assert helpers[0].args[-2:] == ["convert", "preview"]


@needs_jit
def test_a_helper_ends_when_its_command_is_killed(tmp_path):
    over = tmp_path / "over"
    helper = f"import sys, pathlib; sys.stdin.read(); pathlib.Path({str(over)!r}).touch()"
    code = f"""
import os
import numba
from octex import ahead
ahead._CALL, ahead.cpu_count = ("-c", {helper!r}), lambda: 2
with ahead.ahead("convert"):
    numba.njit(lambda number: number + number)(1.5)
    os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    for _ in range(1200):
        if over.exists():
            break
        time.sleep(0.05)
    assert over.exists()


def test_a_helper_watches_for_the_end_of_its_input_while_it_compiles():
    code = """
import threading, time
from octex import ahead
from octex.jit.cache import WRITING
threading.Thread(target=ahead._watch, args=[WRITING]).start()
time.sleep(60)
print("late")
"""
    done = subprocess.run([sys.executable, "-c", code], input=b"", stdout=subprocess.PIPE, check=True)
    assert done.stdout == b""


@needs_jit
def test_a_helper_compiles_what_is_listed_and_passes_over_what_does_not_fit(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    listed = tmp_path / "list.txt"
    listed.write_text(
        "# what\n[some]\noctex.tree.normals:_facing_sum int64\noctex.tree.normals:gone int64\n"
        "octex.gone:_facing_sum int64\noctex.tree.normals:_facing_sum int64, int64\n"
        "octex.tree.normals:_facing_sum gone\nnonsense\n\n[other]\n"
        "octex.tree.normals:_facing_sum int32\n"
    )
    code = f"from octex import ahead; ahead.LIST = ahead.Path({str(listed)!r}); ahead.main()"
    call = [sys.executable, "-c", code, "0", "1", "some"]
    with subprocess.Popen(
        call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as helper:
        assert helper.wait() == 0
        assert helper.stdout is not None
        assert helper.stdout.read() == b""
    (kept,) = (tmp_path / "cache").rglob("*.nbc")
    assert kept.name.startswith("normals._facing_sum-")


@needs_jit
@pytest.mark.parametrize("section", ahead.SECTIONS)
def test_what_is_listed_are_kernels_and_types_of_their_arguments(section):
    # Where this fails, `python tools/release/signatures.py` lists anew. Some lines may be
    # behind: they do no harm.
    listed, fitting = ahead.lines(section), 0
    for line in listed:
        try:
            kernel, arguments = ahead.read(line)
        except (AttributeError, ImportError, ValueError):
            continue
        assert types_text(arguments) == line.split(" ", 1)[1]
        fitting += len(inspect.signature(kernel.py_func).parameters) == len(arguments)
    assert len(listed) > 10
    assert fitting > 0.8 * len(listed)


def test_sections_are_listed_in_their_order_and_each_line_once():
    both = ahead.lines("convert", "preview")
    assert both[: len(ahead.lines("convert"))] == ahead.lines("convert")
    assert len(set(both)) == len(both)
    assert ahead.lines("unknown") == []
