"""What the benchmarks share: processes pinned to a core, time taken in turns, memory, and the report.

Times are those of the processor, which other programs on the machine disturb least; what the clock on the
wall says stands beside them. Linux only.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import linear_to_srgb

HERE = Path(__file__).parent
#: Programs that measure the other libraries.
PEERS = HERE / "peers"
DROID = HERE.parents[1] / "samples" / "droid.glb"


class Spent(NamedTuple):
    """Seconds that a piece of work took."""

    cpu: float
    wall: float

    def __str__(self) -> str:
        return f"{self.cpu:.3f} s (wall {self.wall:.3f} s)"


class Setup(NamedTuple):
    """What the benchmarks are run with."""

    quick: bool
    repeats: int
    core: int
    folder: Path  # for temporary files
    peer_python: str | None
    models: Path | None
    worker: Worker | None  # for all tasks of a quick run


class Verdict(NamedTuple):
    """A figure beside its target."""

    what: str
    value: float
    relation: str  # "≥" or "≤"
    target: float
    unit: str
    strict: bool  # False where sizes are too small for the target to mean anything

    @property
    def met(self) -> bool:
        """Whether the target is reached."""
        return self.value >= self.target if self.relation == "≥" else self.value <= self.target

    def __str__(self) -> str:
        word = ("met   " if self.met else "MISSED") if self.strict else "      "
        return (
            f"{word} {self.what:64} {self.value:10.4g} {self.unit:12} target {self.relation} {self.target:g}"
        )


class Report:
    """Prints figures as they come, and all verdicts at the end."""

    def __init__(self, quick: bool) -> None:
        self.quick = quick
        self.verdicts: list[Verdict] = []

    def title(self, text: str) -> None:
        """Begin a benchmark."""
        print(f"\n== {text}", flush=True)

    def line(self, what: str, figure: object) -> None:
        """Print one figure."""
        print(f"  {what:54} {figure}", flush=True)

    def note(self, text: str) -> None:
        """Print words."""
        print(f"  {text}", flush=True)

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print rows under heads; figures stand to the right."""
        texts = [[str(cell) for cell in row] for row in [heads, *rows]]
        widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
        for row in texts:
            first, *others = (
                cell.ljust(width) if i == 0 else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(row, widths, strict=True))
            )
            print("  " + "  ".join([first, *others]), flush=True)

    def at_least(self, what: str, value: float, target: float, unit: str = "×") -> None:
        """Print a figure beside the least that it should be."""
        self._judge(Verdict(what, value, "≥", target, unit, not self.quick))

    def at_most(self, what: str, value: float, target: float, unit: str = "") -> None:
        """Print a figure beside the most that it should be."""
        self._judge(Verdict(what, value, "≤", target, unit, not self.quick))

    def _judge(self, verdict: Verdict) -> None:
        self.verdicts.append(verdict)
        print(f"  {verdict}", flush=True)

    def summary(self) -> None:
        """Print all verdicts."""
        self.title("targets" + (" (sizes too small to mean anything)" if self.quick else ""))
        for verdict in self.verdicts:
            print(f"  {verdict}")


@contextmanager
def pinned(cores: set[int]) -> Iterator[None]:
    """Keep this thread, and those that it starts, on some cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def timed(work: Callable[[], Any]) -> tuple[Spent, Any]:
    """Run some work of this process."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return Spent(time.process_time() - cpu, time.perf_counter() - wall), result


def in_turns(contestants: Mapping[str, Callable[[], Spent]], repeats: int) -> dict[str, Spent]:
    """Run all contestants in turns; return the median of each."""
    runs: dict[str, list[Spent]] = {name: [] for name in contestants}
    for _ in range(repeats):
        for name, work in contestants.items():
            runs[name].append(work())
    return {
        name: Spent(median(r.cpu for r in rounds), median(r.wall for r in rounds))
        for name, rounds in runs.items()
    }


def clocked(
    setup: Setup, works: Mapping[str, Callable[[], object]], core: int | None = None
) -> dict[str, Spent]:
    """Run all works once, and then in turns, on a core or on all; return the medians of what each takes."""
    contestants = {name: lambda work=work: timed(work)[0] for name, work in works.items()}
    with nullcontext() if core is None else pinned({core}):
        for work in works.values():
            work()
        return in_turns(contestants, setup.repeats)


class Worker:
    """A process on one core that does the same work whenever it is told, and answers with a line of JSON.

    Its standard input is closed at the end, which it takes as the word to leave.
    """

    def __init__(self, command: Sequence[str], core: int | None = None) -> None:
        def pin() -> None:
            if core is not None:
                os.sched_setaffinity(0, {core})

        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=pin
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def run(self, words: str = "") -> dict[str, Any]:
        """Have the work done once, on a line of words; return the answer."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(f"{words}\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith("{"):
                answer: dict[str, Any] = json.loads(line)
                return answer
        raise RuntimeError(f"{self._process.args!r} ended without an answer")

    def spent(self, words: str = "") -> Spent:
        """Have the work done once; return the time it took by its own account."""
        answer = self.run(words)
        return Spent(answer["cpu"], answer["wall"])


def octex_worker(core: int | None = None) -> Worker:
    """Start ``worker.py``."""
    return Worker([sys.executable, str(HERE / "worker.py")], core)


class Task(NamedTuple):
    """A task of ``worker.py``."""

    worker: Worker
    words: str

    def run(self) -> dict[str, Any]:
        """Do it once; return the answer."""
        return self.worker.run(self.words)

    def spent(self) -> Spent:
        """Do it once; return the time it took by its own account."""
        return self.worker.spent(self.words)


@contextmanager
def task(setup: Setup, name: str, *, pin: bool = True, **arguments: object) -> Iterator[Task]:
    """Start a process for a task of ``worker.py``; in a quick run one process has them all."""
    own = octex_worker(setup.core if pin else None) if setup.worker is None else nullcontext(setup.worker)
    with own as worker:
        yield Task(worker, json.dumps([name, arguments]))


@contextmanager
def open3d(
    setup: Setup, report: Report, *words: object, core: int | None = None
) -> Iterator[dict[str, Callable[[], Spent]]]:
    """Start a task of ``open3d_peer.py``, and do it once; yield it by its name, or none without a Python."""
    if not setup.peer_python:
        report.note("left out: Open3D (--peer-python)")
        yield {}
        return
    with Worker([setup.peer_python, str(PEERS / "open3d_peer.py"), *map(str, words)], core) as worker:
        worker.run()
        yield {"Open3D": worker.spent}


def memory(field: str) -> int:
    """Bytes of this process: ``VmHWM`` at its highest, ``VmRSS`` now."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def millions(number: float) -> str:
    return f"{number / 1e6:.2f} M"


def codes(linear: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return sRGB codes, 0 … 255, of linear light."""
    return 255 * linear_to_srgb(np.clip(linear, 0, 1))


def decibels(errors: npt.NDArray[Any]) -> float:
    """Return the PSNR of differences between codes."""
    return float(20 * np.log10(255 / np.sqrt((errors**2).mean())))


def megabytes(number: float) -> str:
    return f"{number / 2**20:.1f} MB"
