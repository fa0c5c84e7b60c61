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

    def __init__(self, task: str, arrays: dict[str, np.ndarray] | None = None, **job: Any) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="octex-")
        self.folder = Path(self._folder.name)
        self.stage, self.share = "", 0.0
        self.warnings: list[str] = []
        self._task, self._job, self._arrays = task, job, arrays
        self._process: subprocess.Popen | None = None
        self._lines: queue.SimpleQueue = queue.SimpleQueue()
        self._answer: dict[str, Any] | None = None

    def given(self, **job: Any) -> "Job":
        """Return this job with more fields."""
        self._job.update(job)
        return self

    def start(self) -> None:
        """Start the process."""
        if self._arrays is not None:
            np.savez(self.folder / "mesh.npz", **self._arrays)
        job = {"task": self._task, "folder": str(self.folder), **self._job}
        (self.folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        self._process = subprocess.Popen(
            [sys.executable, str(_WORK), str(self.folder / "job.json")], env=environment(),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            encoding="utf-8",
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process is not None
        errors: list[str] = []
        drain = threading.Thread(target=lambda: errors.append(self._process.stderr.read()), daemon=True)
        drain.start()
        for line in self._process.stdout:
            self._lines.put(line)
        drain.join()
        self._process.wait()
        self._lines.put("".join(errors).strip().splitlines()[-1:])

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
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._reader.join()
        self._folder.cleanup()
