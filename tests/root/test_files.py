"""Files are read if they are files, and replaced whole or not at all, at whatever moment a signal comes."""

import gc
import os
import signal
import sys
from pathlib import Path

import pytest

from octex import files
from octex.cli.common import run
from octex.errors import ExitCode, OutputError
from tests.make.command import python

posix = pytest.mark.skipif(sys.platform == "win32", reason="pipes and signals of POSIX")
HAS_NAMELESS = hasattr(os, "O_TMPFILE") and Path("/proc/self/fd").is_dir()


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


# --- reading


@posix
def test_links_are_read_but_no_pipes_devices_folders_and_pointers(tmp_path):
    (tmp_path / "lfs").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 7\n")
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    assert files.read_bytes(tmp_path / "link") == b"content"
    for path, message in (
        (tmp_path / "lfs", "it is a Git LFS pointer, not the file; run 'git lfs pull'"),
        (tmp_path / "pipe", "it is a pipe or a device, not a file"),
        ("/dev/zero", "it is a pipe or a device, not a file"),
        ("a\0b", "is not a valid file name"),
        (tmp_path, "Is a directory"),
    ):
        with pytest.raises(OSError, match=message):
            files.read_bytes(path)


def test_absolute_paths_of_any_system_are_not_followed():
    for name in ("/etc/passwd", "C:\\a.png", "c:a.png", "\\a.png", "\\\\server\\a.png", "//a/b"):
        with pytest.raises(OSError, match="absolute paths are not followed"):
            files.referred(Path("folder"), name)
    for name in ("a.png", "maps/a.png", "../a.png", "a b/c.png"):
        assert files.referred(Path("folder"), name) == Path("folder") / name


# --- writing


@pytest.fixture(params=["nameless", "named"])
def _way_to_write(request, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # which takes most of the time
    if request.param == "named":
        monkeypatch.setattr(files, "_nameless_file", lambda _: None)


def interrupted_at(moment, number, body):
    """Run a body as a command does, with a signal before an instruction of octex.files or contextlib.

    Return the exit code, and whether it came to that.
    """
    count = 0

    def trace(frame, _event, _argument):
        if not frame.f_code.co_filename.endswith(("octex/files.py", "contextlib.py")):
            return None
        frame.f_trace_opcodes = True
        return at_instruction

    def at_instruction(_frame, event, _argument):
        nonlocal count
        count += event in ("line", "opcode")
        if count == moment:
            sys.settrace(None)
            signal.raise_signal(number)
        return at_instruction

    def traced():
        sys.settrace(trace)
        try:
            body()
        finally:
            sys.settrace(None)
        return ExitCode.DONE

    before = sys.gettrace()
    handler = signal.signal(
        number, signal.SIG_DFL if number == signal.SIGTERM else signal.default_int_handler
    )
    gc.disable()  # what earlier interruptions left open must not be closed, and interrupted, here
    try:
        return run("octree-x", traced), count >= moment
    finally:
        signal.signal(number, handler)
        sys.settrace(before)
        gc.enable()


# A file that is open, but not yet in its block, is closed by Python, which warns.
unclosed = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)


@posix
@unclosed
@pytest.mark.usefixtures("_way_to_write")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, ExitCode.TERMINATED), (signal.SIGINT, ExitCode.INTERRUPTED)]
)
def test_a_signal_at_any_moment_of_a_save_leaves_the_old_file_or_the_new(tmp_path, number, code):
    path = tmp_path / "a"

    def save():
        with files.replacing(path) as file:
            file.write(b"new")

    endings, moment, came = set(), 0, True
    while came:
        moment += 1
        path.write_bytes(b"old")
        ended, came = interrupted_at(moment, number, save)
        assert names_in(tmp_path) == ["a"], moment
        endings.add((ended, path.read_bytes()))
    assert moment > 50
    assert endings == {(code, b"old"), (code, b"new"), (ExitCode.DONE, b"new")}


@posix
@unclosed
def test_a_signal_at_any_moment_leaves_no_scratch_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(files.tempfile, "gettempdir", lambda: str(tmp_path))

    def work():
        with files.scratch_folder() as folder:
            (folder / "file").write_bytes(b"content")

    moment, came = 0, True
    while came:
        moment += 1
        _, came = interrupted_at(moment, signal.SIGTERM, work)
        assert names_in(tmp_path) == [], moment
    assert moment > 20


KILLED_AT_WORK = """
import os, signal, sys
from pathlib import Path
from octex import files
with files.scratch_folder(Path(sys.argv[1])) as folder:
    (folder / "file").write_bytes(bytes(1000))
    os.kill(os.getpid(), signal.SIGKILL)
"""


@posix
def test_the_scratch_folder_of_a_killed_process_is_removed_and_one_in_use_is_not(tmp_path):
    with files.scratch_folder(tmp_path) as used:
        (used / "file").write_bytes(b"content")
        assert python(KILLED_AT_WORK, str(tmp_path)).returncode == -signal.SIGKILL
        left = names_in(tmp_path)
        assert len(left) == 2
        with files.scratch_folder(tmp_path) as other:
            assert names_in(tmp_path) == sorted([used.name, other.name])
        assert (used / "file").read_bytes() == b"content"
    assert names_in(tmp_path) == []


STUBBORN = """
import os, signal, sys
from octex import files
from octex.cli.common import run
files._nameless_file = lambda folder: None

def body():
    with files.replacing(sys.argv[1]) as file:
        file.write(bytes(1000))
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:  # as code does that lets nothing through
            os.kill(os.getpid(), signal.SIGTERM)
    return 0

sys.exit(run("octree-x", body))
"""


@posix
def test_a_second_signal_ends_the_process_and_leaves_nothing(tmp_path):
    done = python(STUBBORN, str(tmp_path / "a"))
    assert done.returncode == ExitCode.TERMINATED, done.stderr
    assert names_in(tmp_path) == []


KILLED = """
import os, signal, sys
from octex import files
signal.signal(signal.SIGTERM, signal.SIG_DFL)
if sys.argv[3] == "named":
    files._nameless_file = lambda folder: None
with files.replacing(sys.argv[1]) as file:
    file.write(bytes(100000))
    os.kill(os.getpid(), getattr(signal, sys.argv[2]))
"""


without_name = pytest.mark.skipif(not HAS_NAMELESS, reason="this system has no files without a name")


@posix
@pytest.mark.parametrize(
    ("name", "way"),
    [("SIGTERM", "named"), ("SIGTERM", "nameless"), pytest.param("SIGKILL", "nameless", marks=without_name)],
)
def test_a_process_that_a_signal_ends_leaves_nothing(tmp_path, name, way):
    done = python(KILLED, str(tmp_path / "a"), name, way)
    assert done.returncode == -getattr(signal, name)
    assert names_in(tmp_path) == []


IGNORING = """
import os, signal, sys
from octex.cli.common import run

def body():
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGINT)
    return 0

signal.signal(signal.SIGTERM, signal.SIG_IGN)
signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.exit(run("octree-x", body))
"""


@posix
def test_signals_that_are_ignored_stay_so():
    assert python(IGNORING).returncode == ExitCode.DONE


def test_handlers_are_set_back():
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    run("octree-x", lambda: ExitCode.DONE)
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


@pytest.mark.usefixtures("_way_to_write")
def test_a_new_file_has_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    with files.replacing(tmp_path / "a") as file:
        file.write(b"new")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode
    assert (tmp_path / "a").read_bytes() == b"new"


@pytest.mark.usefixtures("_way_to_write")
def test_an_error_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), files.replacing(tmp_path / "a") as file:
        file.write(b"new")
        raise ZeroDivisionError
    assert names_in(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


def test_a_name_that_no_file_can_have_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match="is not a valid file name"), files.replacing(tmp_path / "a\0b"):
        pass
