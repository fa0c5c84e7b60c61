# SPDX-License-Identifier: GPL-3.0-or-later
"""Work of octex, in a process of its own: Blender's window never waits for it."""

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_WORK = Path(__file__).with_name("work.py")
#: Seconds between looks at a job that a script waits for.
_PAUSE = 0.02
#: Seconds that Blender waits for a thread when it ends.
_LONGEST = 5.0


_threads: set[threading.Thread] = set()  # of jobs whose files are still there


class JobError(Exception):
    """octex refuses a job; says why."""


class Read(NamedTuple):
    """Values that only the window's thread can read, into memory which another thread has touched."""

    count: int
    dtype: type
    into: Callable[[np.ndarray], None]


def environment() -> dict[str, str]:
    """Return the environment in which a process finds the packages that Blender's Python does."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(each for each in sys.path if each)}


class Job:
    """A task of work.py: its progress, its end. Without a task it only does what it is ``after``."""

    def __init__(self, task: str = "", **job: Any) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="octex-", ignore_cleanup_errors=True)
        self.folder = Path(self._folder.name)
        self.stage, self.share = "", 0.0
        self.warnings: list[str] = []
        self._task, self.fields = task, job
        self.reads: dict[str, Read] = {}  # by files of the folder: values that `poll` reads
        self.calls: list[tuple[list[str], dict[str, str] | None]] = []  # commands with their variables
        self._process: subprocess.Popen | None = None
        self._is_closed = False
        self._lines: queue.SimpleQueue = queue.SimpleQueue()
        self._turns: queue.SimpleQueue = queue.SimpleQueue()  # values were read, or the job is closed
        self._answer: dict[str, Any] | None = None

    def reading(self, reads: Mapping[str, Read]) -> "Job":
        """Return this job with more values to be read."""
        self.reads |= reads
        return self

    def start(self) -> None:
        """Begin, in a thread that waits for the processes."""
        job = {"task": self._task, "folder": str(self.folder), **self.fields}
        (self.folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        if self._task:
            self.calls.append(([sys.executable, str(_WORK), str(self.folder / "job.json")], environment()))
        else:
            self._answer = {}
        thread = threading.Thread(target=self._run, daemon=True)
        _threads.add(thread)
        thread.start()

    def _run(self) -> None:
        errors: list[str] = []
        try:
            for name, read in self.reads.items():
                if not self._is_closed:
                    self._store(name, read)
            for call, variables in self.calls:
                if not errors and not self._is_closed:
                    errors = self._called(call, variables)
        except (OSError, MemoryError) as error:
            errors = [str(error) or "there is not enough memory"]
        self._lines.put(errors[-1:])
        while not self._is_closed:
            self._turns.get()
        self._folder.cleanup()
        _threads.discard(threading.current_thread())

    def _store(self, name: str, read: Read) -> None:
        """Have the window's thread read values into memory, and store them."""
        values = np.empty(read.count, read.dtype)
        values.fill(0)  # the first touch of memory takes ten times as long as the read
        self._lines.put((read, values))
        self._turns.get()
        if not self._is_closed:
            values.tofile(self.folder / name)

    def _called(self, call: list[str], variables: dict[str, str] | None) -> list[str]:
        """Run a command, pass what it says on, and return its complaints if it fails."""
        with (self.folder / "errors.txt").open("w+", encoding="utf-8", errors="replace") as errors:
            self._process = process = subprocess.Popen(
                call, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors,
                text=True, encoding="utf-8", errors="replace",
            )  # fmt: skip
            if self._is_closed:
                process.terminate()
            for line in process.stdout:
                if line.startswith("{"):  # others are Blender's
                    self._lines.put(line)
            if not process.wait():
                return []
            errors.seek(0)
            return errors.read().strip().splitlines() or ["it ended without an answer"]

    def poll(self) -> dict[str, Any] | None:
        """Take what has arrived, read what the job waits for, and return the answer once there is one.

        Raises JobError, or ObjectError if values cannot be read.
        """
        while not self._lines.empty():
            line = self._lines.get()
            if isinstance(line, tuple):
                read, values = line
                read.into(values)
                self._turns.put(None)
                return None
            if isinstance(line, list):  # the process has ended
                if self._answer is None:
                    raise JobError(line[0] if line else "octex has ended without an answer")
                if "error" in self._answer:
                    raise JobError(self._answer["error"])
                return self._answer
            told = json.loads(line)
            if "stage" in told:
                self.stage, self.share = told["stage"], told["share"]
            elif "warning" in told:
                self.warnings.append(told["warning"])
            else:
                self._answer = told
        return None

    def wait(self) -> dict[str, Any]:
        """Wait for the answer."""
        while (answer := self.poll()) is None:
            time.sleep(_PAUSE)
        return answer

    def array(self, name: str) -> np.ndarray:
        """Return an array that the task has stored, unread: that would double the time to take it over."""
        return np.load(self.folder / f"{name}.npy", mmap_mode="r")

    def close(self) -> None:
        """End the process if it works; the thread then removes the files."""
        self._is_closed = True
        self._turns.put(None)
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()


def unregister() -> None:
    """Wait for the threads of jobs, which are all closed: Blender may end, and they with it."""
    for thread in list(_threads):
        thread.join(_LONGEST)
