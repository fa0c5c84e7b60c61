#!/usr/bin/env python
"""Say on paper how long a conversion takes on a cluster, from the tasks of one that is run here.

    python tools/simulate_cluster.py samples/droid.glb --depths 9 10 --leaves 3e9 --workers 1 10 100

The model is converted at two depths with an executor that does each task at once, as a worker would: what is
called and what comes back go through files. Of each stage that gives the tasks, their processor time and the
bytes that they bring back, and the time of the process that hands them out and joins what comes. Tasks are
pieces of the surface of about the same size: there are as many more of them as there are more leaves. Joining
and what workers are sent are taken to grow with the leaves as they do from the first depth to the second.

On paper a worker takes the next task of a stage when it is free; a stage begins when the one before is
joined. A task's result goes to the storage and from there to the process that joins, whose own work on it is
not divided. Of what workers are sent each reads the part that does not grow, the model, and its share of the
rest. Storage gives each machine ``--network`` bytes a second, and all together ``--storage``.
"""

from __future__ import annotations

import argparse
import heapq
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import octex
from octex.parallel import at_most
from octex.tree.layout import MAX_CELLS


@dataclass
class Stage:
    """What was measured of a stage: seconds of processor time, and bytes."""

    tasks: list[float] = field(default_factory=list)
    back: list[int] = field(default_factory=list)
    joining: float = 0.0  # of the process that hands tasks out


class Measured(Executor):
    """Does each task at once, and notes how long it took and what it brought back."""

    def __init__(self) -> None:
        self.stages: dict[str, Stage] = {}
        self.leaves = self.cells = 0
        self._sent: dict[str, int] = {}  # bytes of the files that say what tasks call
        self._now = Stage()
        self._since = time.process_time()

    def progress(self, stage: str, _done: int, _total: int) -> None:
        """Hear from the conversion which stage it is in: that of what it did since it was heard before."""
        self.note()
        here = self.stages.setdefault(stage, Stage())
        here.tasks += self._now.tasks
        here.back += self._now.back
        here.joining += self._now.joining
        self._now = Stage()

    def note(self) -> None:
        """Add the time since the latest note to what joins."""
        now = time.process_time()
        self._now.joining += now - self._since
        self._since = now

    @property
    def sent(self) -> int:
        """Bytes that every worker has at hand."""
        return sum(self._sent.values())

    def submit(self, function: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Do a task."""
        self.note()
        future: Future[Any] = Future()
        try:
            future.set_result(function(*given, **named))
            place = Path(future.result()[0])
            size = place.stat().st_size if place.exists() else 0
        except BaseException as error:
            future.set_exception(error)
            size = 0
        now = time.process_time()
        self._now.tasks.append(now - self._since)
        self._now.back.append(size)
        self._since = now
        if isinstance(given[0], str):
            self._sent[given[0]] = Path(given[0]).stat().st_size
        return future


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("MODEL", type=Path)
    parser.add_argument("--depths", type=int, nargs=2, default=[8, 9])
    parser.add_argument("--leaves", type=float, default=3e9)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 10, 100])
    parser.add_argument("--network", type=float, default=1e9, help="bytes a second of a machine")
    parser.add_argument("--storage", type=float, default=5e9, help="bytes a second of all machines together")
    options = parser.parse_args()
    with at_most(1):
        less, more = (run(options.MODEL, depth) for depth in sorted(options.depths))
    for measured in (less, more):
        print(f"{measured.leaves:,} leaves, {measured.cells:,} cells; {measured.sent / 1e6:.1f} MB are sent")
        for name, stage in measured.stages.items():
            count, each = len(stage.tasks), 1e9 / measured.leaves
            print(
                f"  {name:8} {count:4} tasks of {1e3 * sum(stage.tasks) / max(count, 1):6.1f} ms, "
                f"{each * sum(stage.tasks):7.1f} ns a leaf; back {sum(stage.back) / measured.leaves:5.1f} "
                f"bytes; joining {each * stage.joining:6.1f} ns a leaf"
            )
    times = options.leaves / more.leaves
    print(
        f"{options.leaves:.3g} leaves, {times:.0f} times as many, in {times * more.cells:.3g} cells: "
        f"{times * more.cells / MAX_CELLS:.0%} of what 32 bits number"
    )
    alone = 0.0
    for workers in options.workers:
        total, parts = on_paper(less, more, options.leaves, workers, options.network, options.storage)
        alone = alone or total * workers
        shown = ", ".join(f"{name} {a:.0f} + {b:.0f}" for name, (a, b) in parts.items() if a + b >= 1)
        print(
            f"  {workers:4} workers: {total / 3600:6.2f} h, {alone / total:5.1f} times as fast as one; "
            f"seconds of tasks + joining: {shown}"
        )


def run(model: Path, depth: int) -> Measured:
    """Convert a model, first a coarse one for what is compiled; return what was measured."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.octex"
        octex.convert(model, min(depth, 6), path=path, run=octex.Run(executor=Measured()))
        measured = Measured()
        tree = octex.convert(
            model, depth, path=path, run=octex.Run(executor=measured, progress=measured.progress)
        ).tree
        measured.progress("open", 1, 1)
        measured.leaves, measured.cells = tree.n_leaves, tree.n_cells
        return measured


def on_paper(
    less: Measured, more: Measured, leaves: float, workers: int, network: float, storage: float
) -> tuple[float, dict[str, tuple[float, float]]]:
    """Return the seconds that a conversion takes: all, and of each stage its tasks, and what joins after."""

    def grown(a: float, b: float) -> tuple[float, float]:
        """Return what does not grow with the leaves, and what does, for what was measured of both."""
        slope = max(b - a, 0.0) / (more.leaves - less.leaves)
        return b - slope * more.leaves, slope * leaves

    model, rest = grown(less.sent, more.sent)
    total = max(model / network, workers * model / storage) + rest / min(workers * network, storage)
    parts = {}
    rate = min(network, storage / workers)
    for name, stage in more.stages.items():
        free = [0.0] * workers
        measured = list(zip(stage.tasks, stage.back, strict=True))
        count = round(len(measured) * leaves / more.leaves)
        for seconds, size in islice(cycle(measured), count):
            heapq.heapreplace(free, free[0] + seconds + size / rate)
        reading = sum(stage.back) * leaves / more.leaves / network  # while tasks go on
        joining = sum(grown(less.stages[name].joining if name in less.stages else 0.0, stage.joining))
        parts[name] = max(free), max(joining, 0.0) + max(reading - max(free), 0.0)
    return total + sum(map(sum, parts.values())), parts


if __name__ == "__main__":
    main()
