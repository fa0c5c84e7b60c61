# SPDX-License-Identifier: GPL-3.0-or-later
"""Work of octex, in a process of its own: Blender's window never waits for it."""

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

_WORK = Path(__file__).with_name("work.py")


class JobError(Exception):
    """octex refuses a job; says why."""


def environment() -> dict[str, str]:
    """Return the environment in which a process finds the packages that Blender's Python does."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(each for each in sys.path if each)}


class Job:
    """A task of work.py: its progress, its end."""

    def __init__(self, task: str, **job: Any) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="octex-")
        self.folder = Path(self._folder.name)
        self.stage, self.share = "", 0.0
        self.warnings: list[str] = []
        self._task, self._job = task, job
        self._arrays: dict[str, np.ndarray] = {}
        self._calls: list[tuple[list[str], dict[str, str] | None]] = []
        self._process: subprocess.Popen | None = None
        self._reader: threading.Thread | None = None
        self._is_closed = False
        self._lines: queue.SimpleQueue = queue.SimpleQueue()
        self._answer: dict[str, Any] | None = None

    def given(self, **job: Any) -> "Job":
        """Return this job with more fields."""
        self._job.update(job)
        return self

    def after(self, call: list[str], arrays: dict[str, np.ndarray]) -> "Job":
        """Return this job to be done after a command, for which arrays are stored in its folder."""
        self._calls.append((call, None))
        self._arrays |= arrays
        return self

    def start(self) -> None:
        """Begin, in a thread that waits for the processes."""
        job = {"task": self._task, "folder": str(self.folder), **self._job}
        (self.folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        self._calls.append(([sys.executable, str(_WORK), str(self.folder / "job.json")], environment()))
        self._reader = threading.Thread(target=self._run, daemon=True)
        self._reader.start()

    def _run(self) -> None:
        errors: list[str] = []
        try:
            for name, values in self._arrays.items():
                np.save(self.folder / f"{name}.npy", values)
            for call, variables in self._calls:
                if not errors and not self._is_closed:
                    errors = self._called(call, variables)
        except OSError as error:
            errors = [str(error)]
        self._lines.put(errors[-1:])

    def _called(self, call: list[str], variables: dict[str, str] | None) -> list[str]:
        """Run a command, pass what it says on, and return its complaints if it fails."""
        self._process = process = subprocess.Popen(
            call, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, encoding="utf-8", errors="replace",
        )  # fmt: skip
        if self._is_closed:
            process.terminate()
        errors: list[str] = []
        drain = threading.Thread(target=lambda: errors.append(process.stderr.read()), daemon=True)
        drain.start()
        for line in process.stdout:
            if line.startswith("{"):  # others are Blender's
                self._lines.put(line)
        drain.join()
        return (
            ("".join(errors).strip().splitlines() or ["it ended without an answer"]) if process.wait() else []
        )

    def poll(self) -> dict[str, Any] | None:
        """Take what has arrived; return the answer once there is one. Raises JobError."""
        while not self._lines.empty():
            line = self._lines.get()
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
        while True:
            self._reader.join()
            answer = self.poll()
            if answer is not None:
                return answer

    def close(self) -> None:
        """End the process if it works, and remove its files."""
        self._is_closed = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        if self._reader is not None:
            self._reader.join()
        self._folder.cleanup()
