"""The benchmarks still run, on sizes that say nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import needs_jit

ROOT = Path(__file__).parent.parent
pytestmark = [needs_jit, pytest.mark.skipif(sys.platform != "linux", reason="they measure as Linux counts")]


def bench(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "tools" / "bench.py"), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_every_benchmark_runs_without_peers_and_says_what_it_leaves_out() -> None:
    done = bench("--quick")
    assert done.returncode == 0, done.stderr
    for figure in (
        "OpenVDB (--peers)",
        "torus: peak memory",
        "boombox: a core",
        "filters: EWA's time",
        "materials: left out without --models",
        "large: opening",
        "psnr: points",
    ):
        assert figure in done.stdout
    assert "inside stored cells" not in done.stdout


def test_a_benchmark_that_is_not_there_is_refused_by_name() -> None:
    done = bench("speed")
    assert done.returncode == 2
    assert "no benchmark speed" in done.stderr
