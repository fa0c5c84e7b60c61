"""The tool that tries broken files tells them apart, and finds nothing bad among the real ones."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import needs_jit
from tests.make.fixtures import OBJ_SQUARE, obj, png, random_image, textured_square

TOOL = Path(__file__).parents[2] / "tools" / "fuzz" / "fragile.py"
pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="it forks, and counts as Linux")]


def fragile(*arguments):
    done = subprocess.run(
        [sys.executable, str(TOOL), *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    return done.returncode, done.stdout


def by_file(text):
    return {trial["file"]: trial for trial in json.loads(text)}


@pytest.fixture(scope="module")
def tool():
    specification = importlib.util.spec_from_file_location("fragile", TOOL)
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """What the tool says of a folder of good and broken files and of damaged copies."""
    folder = tmp_path_factory.mktemp("files")
    image = png(random_image(8, 8))
    (folder / "whole.png").write_bytes(image)
    (folder / "cut.png").write_bytes(image[:-30])
    (folder / "notes.txt").write_text("neither a model nor an image")
    textured_square(folder / "square.glb", image)
    report = {"issues": {"messages": [{"code": "ODD", "severity": 0}, {"code": "MEH", "severity": 1}]}}
    (folder / "square.glb.report.json").write_text(json.dumps(report))
    (folder / "inner").mkdir()
    (folder / "inner" / "cut.glb").write_bytes((folder / "square.glb").read_bytes()[:100])
    obj(folder / "inner" / "lost.obj", OBJ_SQUARE + "f 1 2 9\n")
    return fragile(folder, "--depth", "3", "--damage", "2", "--json")


def test_good_and_broken_files_are_told_apart(report):
    code, text = report
    trials = {name: trial for name, trial in by_file(text).items() if " damaged " not in name}
    assert code == 0
    assert {name: trial["result"] for name, trial in trials.items()} == {
        "whole.png": "converted", "cut.png": "refused", "square.glb": "converted",
        "inner/cut.glb": "refused", "inner/lost.obj": "refused",
    }  # fmt: skip
    assert trials["square.glb"]["validator"] == ["ODD"]
    assert "cut.glb" in trials["inner/cut.glb"]["message"]
    assert trials["whole.png"]["message"] == ""
    assert all(trial["limit"] == 256 << 20 and trial["bytes"] > 0 for trial in trials.values())


def test_the_table_ends_with_a_count_of_each_result(tool, report, tmp_path, monkeypatch, capsys):
    trials = [tool.Trial(**trial) for trial in json.loads(report[1])]
    monkeypatch.setattr(tool, "tried", lambda *_: trials)
    assert tool.main([str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    for trial, line in zip(trials, lines, strict=False):
        assert line.startswith(f"{trial.result} ")
        assert f"  {trial.file}" in line
    results = [trial.result for trial in trials]
    assert lines[-2].startswith(f"{len(trials)} files: ")
    for result in ("converted", "refused"):
        assert f"{results.count(result)} {result}" in lines[-2]
    assert lines[-1] == "1 converted although the validator found errors"


def test_damaged_copies_are_tried_too_and_are_the_same_each_time(tool, tmp_path, report):
    data = png(random_image(8, 8))
    (tmp_path / "a.png").write_bytes(data)
    obj(tmp_path / "a.obj", OBJ_SQUARE)
    textured_square(tmp_path / "a.glb", data)

    def copies(name):
        return [path.read_bytes() for _, path in tool.damaged(name, tmp_path / name, tmp_path, 5)]

    assert copies("a.obj") == []
    assert copies("a.png") == copies("a.png")
    assert len({*copies("a.png"), data}) == 6
    whole = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(whole[12:16], "little")
    assert {copy[: 20 + length] for copy in copies("a.glb")} == {whole[: 20 + length]}
    code, text = report
    copied = {name for name in by_file(text) if " damaged " in name}
    assert code == 0
    assert copied == {
        f"{name} damaged {n}" for name in ("whole.png", "cut.png", "square.glb") for n in (0, 1)
    }


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    arguments = [sys.executable, str(TOOL), str(tmp_path / "nowhere")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "there is no folder" in done.stderr


WAYS_TO_END = [
    ("0", "converted", ""),
    ("print('octree-convert: error: cannot be', file=sys.stderr) or 2", "refused", "cannot be"),
    ("1 / 0", "TRACEBACK", "ZeroDivisionError"),
    ("time.sleep(100)", "HANG", ""),
    ("os.kill(os.getpid(), signal.SIGSEGV)", "CRASH", "SIGSEGV"),
    ("print('well\\nwell', file=sys.stderr) or 2", "CRASH", "well | well"),
    ("print('a warning', file=sys.stderr) or 0", "CRASH", "a warning"),
    ("1", "CRASH", "exit code 1"),
    ("len(bytearray(b'1') * (300 << 20)) and 0", "MEMORY", "are allowed"),
    ("len(bytearray(4 << 30))", "TRACEBACK", "MemoryError"),
    ("print('error: out of memory', file=sys.stderr) or 2", "MEMORY", "out of memory"),
]


@pytest.fixture(scope="module")
def endings(tool, tmp_path_factory):
    """How those end, forked from a process smaller than this one."""
    works = ", ".join(f"(lambda: {work}, {1 if end == 'HANG' else 100})" for work, end, _ in WAYS_TO_END)
    code = (
        "import importlib.util, json, os, signal, sys, time\nfrom pathlib import Path\n"
        f"specification = importlib.util.spec_from_file_location('fragile', {str(TOOL)!r})\n"
        "tool = importlib.util.module_from_spec(specification)\nspecification.loader.exec_module(tool)\n"
        f"folder = Path({str(tmp_path_factory.mktemp('scratch'))!r})\n"
        f"print(json.dumps([tool.forked(work, folder, seconds, 1 << 30) for work, seconds in [{works}]]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [tool.Ended(*each) for each in json.loads(done.stdout)]


@pytest.mark.parametrize("number", range(len(WAYS_TO_END)))
def test_every_way_to_end_has_its_name(tool, endings, number):
    _, expected, message = WAYS_TO_END[number]
    result, said = tool.judged(endings[number], endings[number].peak, 300 << 20)
    assert result == expected
    assert message in said


def test_what_a_model_refers_to_counts_as_its_size(tool, tmp_path):
    (tmp_path / "unused.png").write_bytes(bytes(5000))
    path = obj(
        tmp_path / "square.obj",
        OBJ_SQUARE,
        "newmtl a\nmap_Kd a/b.png\n",
        {"a/b.png": png(random_image(8, 8))},
    )
    named = (path, tmp_path / "square.mtl", tmp_path / "a" / "b.png")
    assert tool.bytes_with_references(path) == sum(file.stat().st_size for file in named)
    assert tool.bytes_with_references(tmp_path / "unused.png") == 5000


def test_nothing_bad_happens_with_the_real_fragile_files(models):
    folder = models / "fragile"
    if not folder.is_dir():
        pytest.skip("no folder of fragile models")
    code, text = fragile(folder, "--json", "--depth", "3")
    trials = by_file(text)
    bad = {name: trial for name, trial in trials.items() if trial["result"] not in ("converted", "refused")}
    assert bad == {}
    assert code == 0
    corrupt = [name for name in trials if Path(name).name.startswith("x") and "png-suite" in name]
    assert corrupt
    assert {name for name in corrupt if trials[name]["result"] != "refused"} == set()
