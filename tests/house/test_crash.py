"""However a save ends, the old file stands or the new one, and nothing else stays."""

import random
import runpy
import sys
from pathlib import Path

import pytest

import octex
from octex import files
from tests.make.command import python
from tests.make.small_textures import eight_colors
from tests.texture.test_archive import hilly

ROOT = Path(__file__).parents[2]
linux = pytest.mark.skipif(sys.platform != "linux", reason="processes are killed as Linux does it")
LEFT, LEFT_FOLDER = ".octex-0123456789abcdef", ".octex-fedcba9876543210"


@linux
def test_a_killed_save_leaves_the_old_file_or_the_new_one(tmp_path):
    killed = runpy.run_path(str(ROOT / "tools" / "fuzz" / "random_kills.py"))["killed"]
    made = [hilly(4), eight_colors()]
    for texture in made:
        texture.save(tmp_path / "compile.octz")
    assert killed(made, tmp_path, 20, random.Random(1)) == []


FULL = """
import resource, sys
import octex
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
texture = octex.open(sys.argv[1])
for name in sys.argv[2:]:
    try:
        texture.save(name)
        print("saved")
    except octex.OctexError as error:
        print(type(error).__name__)
"""


@linux
def test_a_full_disk_leaves_the_old_file(tmp_path):
    paths = [tmp_path / name for name in ("a.octex", "b.octex", "b.octz")]
    for path, texture in zip(paths, (hilly(6), eight_colors(), eight_colors()), strict=True):
        texture.save(path)
    before = {path.name: path.read_bytes() for path in paths}
    done = python(FULL, *map(str, paths), cwd=ROOT)
    assert done.stdout.split() == ["OutputError", "OutputError"], done.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@linux
@pytest.mark.parametrize("named", [False, True])
def test_what_a_killed_process_left_is_removed_and_what_another_one_writes_is_not(
    named, tmp_path, monkeypatch
):
    if named:
        monkeypatch.setattr(files, "_nameless_file", lambda _folder: None)
    (tmp_path / LEFT).write_bytes(b"half")
    (tmp_path / LEFT_FOLDER / "in").mkdir(parents=True)
    (tmp_path / LEFT_FOLDER / "in" / "a").write_bytes(b"an array")
    (tmp_path / ".octex-mine").write_bytes(b"not a save's")
    with files.replacing(tmp_path / "a") as first:
        first.write(b"first")
        with files.replacing(tmp_path / "b") as second:
            second.write(b"second")
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", ".octex-mine"}
    assert (tmp_path / "a").read_bytes() == b"first"


def test_two_writers_of_one_file_leave_one_of_the_two(tmp_path):
    path = tmp_path / "a.octex"
    with files.replacing(path) as outer:
        outer.write(b"outer")
        eight_colors().save(path)
        assert octex.open(path).tree.n_leaves == 8
    assert path.read_bytes() == b"outer"
    assert [each.name for each in tmp_path.iterdir()] == ["a.octex"]
