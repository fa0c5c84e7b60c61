"""Damaged files are refused, or answer; tools/fuzz/damaged_files.py tries many more."""

from __future__ import annotations

import os
import sys
from collections import Counter
from pathlib import Path
from random import Random
from types import ModuleType

import pytest

from tests.conftest import needs_jit

TOOLS = Path(__file__).parents[2] / "tools" / "fuzz"
#: Files with which something was wrong once.
DAMAGED = sorted((Path(__file__).parents[1] / "damaged").iterdir())

pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="the fuzzer forks")]


@pytest.fixture
def fuzz(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    import damaged_files

    return damaged_files


@pytest.mark.parametrize("kind", [".octex", ".octz", "points", "voxels", "cameras"])
def test_files_that_are_sound_answer_in_every_way(kind: str, tmp_path: Path, fuzz: ModuleType) -> None:
    for number in range(4):
        parts = fuzz.files(number, tmp_path)[kind]
        path = tmp_path / f"good{parts.ending}"
        path.write_bytes(parts.content)
        for seed in range(60):
            word = fuzz.use(path, kind, Random(seed))
            assert word == "sound" or kind == "points"  # of which a cloud needs three


def test_damaged_files_of_many_seeds_are_refused_or_answer(tmp_path: Path, fuzz: ModuleType) -> None:
    outcomes = [fuzz.attempt(seed, tmp_path) for seed in range(400)]
    assert [what for word, what in outcomes if word == "FOUND"] == []
    words = Counter(word for word, _ in outcomes)
    assert min(words[word] for word in ("refused", "unsound", "sound")) > 5  # it reaches both ends
    assert {what.split(":")[0] for _, what in outcomes} == set(fuzz.KINDS)


@pytest.mark.parametrize("damaged", DAMAGED, ids=lambda path: path.stem)
def test_what_was_wrong_with_a_file_once_is_mended(damaged: Path, tmp_path: Path, fuzz: ModuleType) -> None:
    kind = damaged.stem.partition("_")[0] if damaged.suffix == ".npz" else damaged.suffix
    path = tmp_path / damaged.name
    path.write_bytes(damaged.read_bytes())
    words = {fuzz.use(path, kind, Random(seed)) for seed in range(60)}
    assert len(words) == 1
    assert words <= {"refused", "unsound"}


def test_an_archive_that_opens_although_bytes_were_changed_is_a_finding(
    tmp_path: Path, fuzz: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "KINDS", (".octz",))
    monkeypatch.setattr(fuzz, "damaged", lambda parts, _chance: (parts.content, "blind", True))
    word, what = fuzz.attempt(0, tmp_path, tmp_path)
    assert word == "FOUND"
    assert "bytes of it were changed" in what
    assert (tmp_path / "0.octz").exists()


def test_a_file_that_ends_its_process_is_a_finding(
    tmp_path: Path, fuzz: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(seed: int, _folder: Path, _keep: Path | None) -> tuple[str, str]:
        if seed == 2:
            os._exit(3)
        return "refused", ""

    monkeypatch.setattr(fuzz, "attempt", fail)
    done, told, ended = fuzz._batch(0, 5, tmp_path)
    assert (done, told, ended) == (2, [("refused", "")] * 2, "exit code 3")


def test_a_log_goes_on_where_it_ended_and_sums_up(
    tmp_path: Path, fuzz: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def attempt(seed: int, _folder: Path, _keep: Path | None) -> tuple[str, str]:
        if seed == 5:
            return "FOUND", "seed 5 is odd"
        return ("refused", ".octz: blind") if seed % 2 else ("sound", ".octex: array tree/flags")

    monkeypatch.setattr(fuzz, "attempt", attempt)
    monkeypatch.setattr(fuzz, "warm_up", lambda _folder: None)
    for count, code in (("3", 0), ("4", 1)):
        log = str(tmp_path / "log.jsonl")
        monkeypatch.setattr(sys, "argv", ["damaged_files.py", "--count", count, "--batch", "2", "--log", log])
        assert fuzz.main() == code
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "the next seed is 7"
    assert "1 findings" in lines
    table = {line.split(maxsplit=4)[-1]: line.split()[:4] for line in lines if line.strip()[:1].isdigit()}
    assert table[".octz: blind"] == ["2", "2", "0", "0"]
    assert table["all"] == ["6", "2", "0", "4"]
