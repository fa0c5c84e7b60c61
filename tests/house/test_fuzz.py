"""Damaged files are refused, or answer; `tools/fuzz/soak.py damage` tries many more."""

import sys
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.conftest import needs_jit

TOOLS = Path(__file__).parents[2] / "tools" / "fuzz"
#: Files with which something was wrong once.
DAMAGED = sorted((Path(__file__).parents[1] / "damaged").iterdir())

pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="the fuzzer forks")]


@pytest.fixture
def fuzz(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    import random_damage

    return random_damage


@pytest.mark.parametrize("kind", [".octex", ".octz", "points", "voxels", "cameras"])
def test_files_that_are_sound_answer_in_every_way(kind, tmp_path, fuzz):
    for number in range(4):
        parts = fuzz.files(number)[kind]
        path = tmp_path / f"good{parts.ending}"
        path.write_bytes(parts.content)
        for seed in range(60):
            word = fuzz.use(path, kind, Random(seed))
            assert word == "sound" or kind == "points"  # of which a cloud needs three


def test_damaged_files_of_many_seeds_are_refused_or_answer(tmp_path, fuzz):
    outcomes = [fuzz.attempt(seed, tmp_path) for seed in range(400)]
    words = Counter(word for word, _ in outcomes)
    assert min(words[word] for word in ("refused", "unsound", "sound")) > 5  # it reaches both ends
    assert {what.split(":")[0] for _, what in outcomes} == set(fuzz.KINDS)


@pytest.mark.parametrize("damaged", DAMAGED, ids=lambda path: path.stem)
def test_what_was_wrong_with_a_file_once_is_mended(damaged, tmp_path, fuzz):
    kind = damaged.stem.partition("_")[0] if damaged.suffix == ".npz" else damaged.suffix
    path = tmp_path / damaged.name
    path.write_bytes(damaged.read_bytes())
    words = {fuzz.use(path, kind, Random(seed)) for seed in range(60)}
    assert len(words) == 1
    assert words <= {"refused", "unsound"}


def test_an_archive_that_opens_although_bytes_were_changed_is_a_finding(tmp_path, fuzz, monkeypatch):
    monkeypatch.setattr(fuzz, "KINDS", (".octz",))
    monkeypatch.setattr(fuzz, "damaged", lambda parts, _chance: (parts.content, "blind", True))
    with pytest.raises(AssertionError, match="bytes were changed"):
        fuzz.attempt(0, tmp_path)
    assert (tmp_path / "damaged.octz").exists()
