"""The benchmarks still run, on sizes whose times say nothing."""

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

import octex
from tests.conftest import needs_jit

ROOT = Path(__file__).parents[2]
pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="they measure as Linux counts")]

#: A figure beside its target.
VERDICT = re.compile(
    r"^ {9}(?P<what>.*?) {2,}(?P<value>\S+) .*? target (?P<relation>[≥≤]) (?P<target>\S+)$", re.M
)
#: Figures that no clock has a part in: they meet their targets at small sizes too.
EXACT = (
    "paper: structure + colour beside the maps",
    "torus: peak memory of the process",
    "filters: EWA's error beside trilinear's, pink noise, 4 : 1",
    "adaptive: torus, root mean square",
    "adaptive: leaves of a flat body with a decal",
    "far: painted, 256², round: the picture's mean",
)


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
    *parts, targets = done.stdout.split("\n== ")[1:]
    figures = {}
    for part in parts:
        title, *lines = part.splitlines()
        kept = [line for line in lines if "left out" not in line and re.search(r"\d", line)]
        figures.setdefault(title.split(":")[0], []).extend(kept)
    names = listed_names.split(", ")
    without = {name for name in names if f"  {name}: left out without" in done.stdout}
    assert without >= {"materials", "mixed"}
    for name in names:
        assert figures.get(name) or name in without, name
    assert "  left out: Open3D (--peer-python)\n" in done.stdout
    assert not re.search(r"\b(nan|inf)\b", done.stdout)
    listed = list(VERDICT.finditer("\n".join(parts)))
    assert len(listed) > 60
    assert [found.groups() for found in VERDICT.finditer(targets)] == [found.groups() for found in listed]
    assert all(math.isfinite(float(found["value"])) for found in listed)
    verdicts = {found["what"]: found for found in listed}
    for what in EXACT:
        value, target = float(verdicts[what]["value"]), float(verdicts[what]["target"])
        assert value >= target if verdicts[what]["relation"] == "≥" else value <= target, what
    leaves = octex.convert(ROOT / "samples" / "droid.glb", 5).tree.n_leaves
    assert any(line.split()[:2] == ["5", f"{leaves:,}"] for line in figures["paper"])
