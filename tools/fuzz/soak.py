#!/usr/bin/env python
"""Run random tests for an hour: seed after seed, each kind that there is, in processes of their own.

usage: soak.py [edits] [lookups] [damage] … [--minutes 60] [--jobs 2] [--seed N] [--seeds N]
                     [--limit 60] [--memory 4]

A kind is a module random_KIND.py of tests/properties or of this folder, whose check(seed) raises where
something fails; words that it returns are counted. Without a kind, all run in turn.
A process that crashes, takes longer than --limit seconds for a seed, or more than --memory gigabytes, counts
as a failure of that seed, and another goes on. Failures are grouped by where they were raised and by what was
said, numbers aside; each group is printed once, when it is first met, with the line that repeats it. At the
end all groups are listed, with their seeds. Exit code 1 if anything failed.
Linux only.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import resource
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PREFIX = "random_"
FOLDERS = ROOT / "tests" / "properties", ROOT / "tools" / "fuzz"
#: Seeds after which a process is replaced: what it has leaked counts against its memory.
MOST_SEEDS = 2000
#: Seeds of a group that are listed.
MOST_LISTED = 20


class Failure(NamedTuple):
    """What went wrong with a seed."""

    group: str  # where, and what was said without its numbers
    message: str  # all that was said


def kinds() -> list[str]:
    """Return the kinds of random tests that there are."""
    paths = [path for folder in FOLDERS for path in folder.glob(f"{PREFIX}*.py")]
    return sorted(path.stem.removeprefix(PREFIX) for path in paths)


def failure_of(error: BaseException) -> Failure:
    """Say what an error is, and group it with those of the same place and words.

    An AssertionError that was raised from another error is of that error's group.
    """
    message = "".join(traceback.format_exception_only(error)).strip()
    cause = error.__cause__ if isinstance(error, AssertionError) and error.__cause__ else error
    frames = traceback.extract_tb(cause.__traceback__)
    inside = [frame for frame in frames if frame.filename.startswith(str(ROOT / "octex"))] or frames
    where = f"{Path(inside[-1].filename).name}:{inside[-1].name}" if inside else "nowhere"
    said = (str(cause).splitlines() or [""])[0]
    said = re.sub(r"[-+]?\.?\d[-+.e\d]*", "#", said)[:60]
    return Failure(f"{type(cause).__name__} in {where}: {said}", message)


def work(kind: str, memory: int, pipe: Connection, said: str) -> None:
    """Check the seeds that come through a pipe, and answer each; ``said`` is the file of what tests print."""
    with Path(said).open("w", encoding="utf-8") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    sys.path[:0] = [str(ROOT), str(FOLDERS[1])]
    package = "tests.properties." if (FOLDERS[0] / f"{PREFIX}{kind}.py").exists() else ""
    module = importlib.import_module(f"{package}{PREFIX}{kind}")
    memory = min(memory, getattr(module, "MEMORY", memory))
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + memory
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("error")  # as the tests have it
    with suppress(EOFError):  # the tool has ended
        while True:
            seed = pipe.recv()
            try:
                answer = module.check(seed) or ""
            except Exception as error:
                answer = failure_of(error)
            pipe.send(answer)


class Worker:
    """A process that checks seeds of one kind."""

    def __init__(self, kind: str, memory: int) -> None:
        self.kind, self.seed, self.began, self.done = kind, -1, 0.0, 0
        self._said = NamedTemporaryFile()  # noqa: SIM115 - open as long as the process runs
        self.pipe, other = Pipe()
        arguments = kind, memory, other, self._said.name
        self._process = get_context("spawn").Process(target=work, args=arguments, daemon=True)
        self._process.start()
        other.close()

    def start(self, seed: int) -> None:
        """Have it check a seed."""
        self.seed, self.began = seed, time.monotonic()
        with suppress(BrokenPipeError):  # it has died; its answers have ended
            self.pipe.send(seed)

    def answer(self) -> Failure | str:
        """Return the words or the failure of its seed; how it ended if it says nothing."""
        try:
            answer: Failure | str = self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self._process.join()
            status = self._process.exitcode or 0
            how = signal.Signals(-status).name if status < 0 else f"exit code {status}"
            said = Path(self._said.name).read_text("utf-8", errors="replace").strip().splitlines()[-1:]
            return Failure(f"CRASH: {how}", " ".join([f"the process ended with {how}", *said]))
        self.done += 1
        return answer

    def end(self) -> None:
        """End it, whatever it is at."""
        self._process.kill()
        self._process.join()
        self.pipe.close()
        self._said.close()


class Report:
    """What was found, printed as it comes."""

    def __init__(self) -> None:
        self.ran: Counter[str] = Counter()
        self.words: dict[str, Counter[str]] = {}
        self.failures: dict[tuple[str, str], list[int]] = {}

    def add(self, kind: str, seed: int, failure: Failure | str) -> None:
        """Count a seed, and print what is new of it."""
        self.ran[kind] += 1
        if isinstance(failure, str):
            self.words.setdefault(kind, Counter())[failure] += bool(failure)
            return
        key = kind, failure.group
        if key not in self.failures:
            print(f"{kind}: {failure.group}\n{failure.message}\n    {repeated(kind, seed)}\n", flush=True)
        self.failures.setdefault(key, []).append(seed)

    def rows(self) -> Iterator[str]:
        """Yield the lines of the summary."""
        for kind, ran in sorted(self.ran.items()):
            own = {group: seeds for (each, group), seeds in self.failures.items() if each == kind}
            failed = sum(map(len, own.values()))
            yield f"{kind}: {ran:,} seeds, {failed} failed in {len(own)} ways"
            for group, seeds in sorted(own.items(), key=lambda pair: -len(pair[1])):
                listed = ", ".join(map(str, seeds[:MOST_LISTED])) + (" …" if len(seeds) > MOST_LISTED else "")
                yield f"  {len(seeds):5}  {group}\n         seeds {listed}"
            for word, times in sorted((+self.words.get(kind, Counter())).items()):
                yield f"  {times:5}  {word}"


def repeated(kind: str, seed: int) -> str:
    """Return the command that repeats a seed."""
    return f"python tools/fuzz/soak.py {kind} --seed {seed} --seeds 1"


def soak(
    chosen: list[str], seconds: float, jobs: int, first: int, most: int | None, limit: float, memory: int
) -> Report:
    """Check growing seeds of kinds in turn, until the time is over or ``most`` seeds of each are done."""
    report = Report()
    rounds = count(first) if most is None else range(first, first + most)
    waiting = ((kind, seed) for seed in rounds for kind in chosen)
    ends = time.monotonic() + seconds
    running: list[Worker] = []
    idle: list[Worker] = []

    def begin() -> bool:
        job = next(waiting, None) if time.monotonic() < ends else None
        if job is None:
            return False
        kind, seed = job
        worker = next((each for each in idle if each.kind == kind), None)
        if worker is None:
            worker = Worker(kind, memory)
        else:
            idle.remove(worker)
        worker.start(seed)
        running.append(worker)
        return True

    def finish(worker: Worker, failure: Failure | str, *, is_fit: bool) -> None:
        running.remove(worker)
        report.add(worker.kind, worker.seed, failure)
        if is_fit and worker.done < MOST_SEEDS:
            idle.append(worker)
        else:
            worker.end()

    try:
        while True:
            while len(running) < jobs and begin():
                pass
            if not running:
                return report
            answered = wait([worker.pipe for worker in running], 0.5)
            for worker in [*running]:
                if worker.pipe in answered:
                    done = worker.done
                    failure = worker.answer()
                    finish(worker, failure, is_fit=worker.done > done)
                elif time.monotonic() - worker.began > limit:
                    said = f"took longer than {limit:g} s"
                    finish(worker, Failure(f"HANG: {said}", said), is_fit=False)
    except KeyboardInterrupt:
        return report
    finally:
        for worker in [*running, *idle]:
            worker.end()


def main(arguments: list[str] | None = None) -> int:
    lines = (__doc__ or "").splitlines()
    parser = argparse.ArgumentParser(
        description=lines[0],
        epilog="\n".join(lines[5:]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(kinds())}; all by default")
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no seed is begun (60)")
    parser.add_argument("--jobs", type=int, default=2, help="seeds at a time (2)")
    parser.add_argument("--seed", type=int, default=0, help="the first (0)")
    parser.add_argument("--seeds", type=int, help="how many of each kind, at most")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for a seed (60)")
    parser.add_argument("--memory", type=float, default=4.0, help="gigabytes for a process (4)")
    options = parser.parse_args(arguments)
    for kind in options.kinds:
        if kind not in kinds():
            parser.error(f"there is no {PREFIX}{kind}.py; there are {', '.join(kinds())}")
    chosen = list(dict.fromkeys(options.kinds)) or kinds()
    jobs, memory = max(options.jobs, 1), int(options.memory * 2**30)
    report = soak(chosen, 60 * options.minutes, jobs, options.seed, options.seeds, options.limit, memory)
    print("\n".join(report.rows()))
    return int(bool(report.failures))


if __name__ == "__main__":
    sys.exit(main())
