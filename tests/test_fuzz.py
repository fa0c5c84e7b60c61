"""Damaged files are refused, or answer; tools/fuzz_files.py tries many more."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.conftest import needs_jit

#: Seeds that found something once.
FOUND = (2461, 2794)

TOOLS = Path(__file__).parent.parent / "tools"

pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="the fuzzer forks")]


def test_damaged_files_of_many_seeds_are_refused_or_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    import fuzz_files

    outcomes = [fuzz_files.attempt(seed, tmp_path) for seed in (*range(150), *FOUND)]
    assert [what for word, what in outcomes if word == "FOUND"] == []
    words = [word for word, _ in outcomes]
    assert min(words.count("refused"), words.count("sound")) > 5  # it reaches both ends


def test_a_file_that_ends_its_process_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    import fuzz_files

    def fail(seed: int, _folder: Path, _keep: Path | None) -> tuple[str, str]:
        if seed == 2:
            os._exit(3)
        return "refused", ""

    monkeypatch.setattr(fuzz_files, "attempt", fail)
    done, told, ended = fuzz_files._batch(0, 5, tmp_path)
    assert (done, told, ended) == (2, [("refused", "")] * 2, "exit code 3")
