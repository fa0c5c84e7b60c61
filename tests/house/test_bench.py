"""The benchmarks still run, on sizes whose times say nothing."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import octex
from tests.conftest import needs_jit

ROOT = Path(__file__).parents[2]
pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="they measure as Linux counts")]


def bench(*arguments):
    command = [sys.executable, str(ROOT / "tools" / "bench"), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_every_benchmark_runs_without_peers_and_says_what_it_leaves_out():
    refused = bench("speed")
    assert refused.returncode == 2
    said, _, listed_names = refused.stderr.rstrip("\n").partition("; there are ")
    assert said.endswith("no benchmark speed")
    done = bench("--quick")
    assert done.returncode == 0, done.stderr
    figures = {}
    for part in done.stdout.split("\n== ")[1:]:
        title, *lines = part.splitlines()
        kept = [line for line in lines if "left out" not in line and re.search(r"\d", line)]
        figures.setdefault(title.split(":")[0], []).extend(kept)
    assert set(figures) == set(listed_names.split(", "))
    for name, lines in figures.items():
        assert lines or f"{name}: left out without" in done.stdout, name
    assert "  left out: Open3D (--peer-python)\n" in done.stdout
    assert not re.search(r"\b(nan|inf)\b", done.stdout)
    leaves = octex.convert(ROOT / "samples" / "droid.glb", 5).tree.n_leaves
    assert any(line.split()[:2] == ["5", f"{leaves:,}"] for line in figures["paper"])
