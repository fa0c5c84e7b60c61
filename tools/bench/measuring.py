"""What the benchmarks share: processes pinned to a core, time taken in turns, memory, and what is printed.

Times are those of the processor, which other programs disturb least, and of the clock on the wall.
Linux only.
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

import octex

HERE = Path(__file__).parent
sys.path.append(str(HERE.parents[1]))
#: Programs that measure the other libraries.
PEERS = HERE / "peers"
#: Real models, by their paths in a folder, with the depths whose cells are half a texel to three wide.
MODELS = {
    "Avocado/Avocado.gltf": 10,
    "BoomBoxWithAxes/BoomBoxWithAxes.gltf": 10,
    "Suzanne/Suzanne.gltf": 10,
    "spot-triangulated/spot.obj": 9,
}

Answer = dict[str, Any]


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
    folder_of_models: Path | None
    worker: Worker | None  # for all tasks of a quick run

    def models(self) -> Iterator[tuple[str, Path, int]]:
        """Yield names, paths and depths of the sample and of real models."""
        yield "droid", HERE.parents[1] / "samples" / "droid.glb", 5 if self.quick else 10
        if self.folder_of_models is None:
            note("left out: real models (--models)")
            return
        for path, depth in MODELS.items():
            if (self.folder_of_models / path).is_file():
                yield Path(path).stem, self.folder_of_models / path, depth
            else:
                note(f"left out: there is no {path}")


def title(text: str) -> None:
    """Begin a benchmark."""
    print(f"\n== {text}", flush=True)


def line(what: str, figure: object) -> None:
    """Print a figure."""
    print(f"  {what:54} {figure}", flush=True)


def note(text: str) -> None:
    """Print words."""
    print(f"  {text}", flush=True)


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print rows under heads; figures stand to the right."""
    texts = [[str(cell) for cell in row] for row in [heads, *rows]]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    for first, *others in texts:
        cells = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        print("  " + "  ".join([first.ljust(widths[0]), *cells]), flush=True)


@contextmanager
def pinned(core: int) -> Iterator[None]:
    """Keep this thread, and those that it starts, on a core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def timed(work: Callable[[], Any]) -> tuple[Spent, Any]:
    """Run some work of this process."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return Spent(time.process_time() - cpu, time.perf_counter() - wall), result


def in_turns(contestants: Mapping[Any, Callable[[], Spent]], repeats: int) -> dict[Any, Spent]:
    """Run all contestants in turns; return the median of each."""
    rounds = [[work() for work in contestants.values()] for _ in range(repeats)]
    runs = zip(contestants, zip(*rounds, strict=True), strict=True)
    return {name: Spent(median(r.cpu for r in each), median(r.wall for r in each)) for name, each in runs}


def clocked(
    setup: Setup, works: Mapping[Any, Callable[[], object]], core: int | None = None
) -> dict[Any, Spent]:
    """Run all works once, and then in turns, on a core or on all; return the medians of what each takes.

    A quick run leaves the first round out.
    """
    contestants = {name: lambda work=work: timed(work)[0] for name, work in works.items()}
    with nullcontext() if core is None else pinned(core):
        for work in () if setup.quick else works.values():
            work()
        return in_turns(contestants, setup.repeats)


def rates(
    setup: Setup, works: Mapping[Any, Callable[[], object]], count: int, *, pin: bool = True
) -> dict[Any, float]:
    """Return how many millions of so many lookups each work makes in a second of a processor."""
    spent = clocked(setup, works, setup.core if pin else None)
    return {name: count / each.cpu / 1e6 for name, each in spent.items()}


class Worker:
    """A process on one core that does work whenever it reads a line, and answers with a line of JSON.

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

    def run(self, words: str = "") -> Answer:
        """Have the work done once, on a line of words; return the answer."""
        assert self._process.stdin and self._process.stdout
        print(words, file=self._process.stdin, flush=True)
        found = next((said for said in self._process.stdout if said.startswith("{")), None)
        if found is None:
            raise RuntimeError(f"{self._process.args!r} ended without an answer")
        return dict(json.loads(found))

    def spent(self) -> Spent:
        """Have the work done once; return the time it took by its own account."""
        answer = self.run()
        return Spent(answer["cpu"], answer["wall"])


def octex_worker(core: int | None = None) -> Worker:
    """Start ``worker.py``."""
    return Worker([sys.executable, str(HERE / "worker.py")], core)


@contextmanager
def task(setup: Setup, name: str, *, pin: bool = True, **arguments: object) -> Iterator[Callable[[], Answer]]:
    """Start a process for a task of ``worker.py``; in a quick run one process has them all."""
    own = octex_worker(setup.core if pin else None) if setup.worker is None else nullcontext(setup.worker)
    with own as worker:
        yield lambda: worker.run(json.dumps([name, arguments]))


@contextmanager
def open3d(
    setup: Setup, name: str, *words: object, core: int | None = None, **arrays: object
) -> Iterator[dict[str, Callable[[], Spent]]]:
    """Start a task of ``open3d_peer.py``, and do it once; yield it by its name, or none without a Python."""
    if not setup.peer_python:
        note("left out: Open3D (--peer-python)")
        yield {}
        return
    path = setup.folder / f"{name}.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]
    command = [setup.peer_python, PEERS / "open3d_peer.py", name, path, *words]
    with Worker([str(word) for word in command], core) as worker:
        worker.run()
        yield {"Open3D": worker.spent}


def memory(field: str) -> int:
    """Bytes of this process: ``VmHWM`` at its highest, ``VmRSS`` now."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition(f"{field}:")[2].split()[0]) * 1024


def decibels(errors: npt.NDArray[Any]) -> float:
    """Return the PSNR of differences between codes."""
    return float(20 * np.log10(255 / np.sqrt((errors**2).mean())))


def colors_of(path: Path) -> octex.Surface:
    """Return a model with its base colour alone."""
    return octex.load_surface(path, channels=["base_color"])
