"""octex view in a process of its own, and what pages send it."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

import octex
from tests.make.strokes import camera_sent, deflated, plain

PAGE = "0123abcd-0123"
_ROOT = Path(__file__).resolve().parents[2]
_PROGRAM = "import sys; from octex.cli.start import octex; sys.exit(octex())"


def command(kind: str, number: int, **given: Any) -> bytes:
    """Return a command without content."""
    return plain(kind, number, PAGE, **given)


def disc(number: int, camera: octex.Camera, middle: npt.ArrayLike, radius: float, color: list[int]) -> bytes:
    """Return a stroke: a disc of paint around a place of a view, in pixels."""
    (x, y), width, height = np.asarray(middle, np.float64), camera.width, camera.height
    left, right = int(max(x - radius, 0)), int(min(x + radius + 1, width))
    top, bottom = int(max(y - radius, 0)), int(min(y + radius + 1, height))
    rows, columns = np.mgrid[top:bottom, left:right] + 0.5
    coverage = np.clip(128 * (radius - np.hypot(columns - x, rows - y)), 0, 255).astype(np.uint8)
    fields = {"camera": camera_sent(camera), "box": [left, top, right, bottom], "color": color}
    return command("stroke", number, **fields, opacity=0.6) + deflated(coverage.tobytes())


class PaintServer:
    """octex view --paint, and --recover if it has ended before."""

    def __init__(self, texture: Path, model: Path, output: Path) -> None:
        self._words = [sys.executable, "-c", _PROGRAM, "view", str(texture), str(model)]
        self._words += ["--paint", str(output), "--force", "--recover", "--no-browser", "--quiet"]
        self.start()

    def start(self) -> None:
        """Start it."""
        self.process = subprocess.Popen(self._words, cwd=_ROOT, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        lines = (re.search(r"http://\S+/", line) for line in self.process.stdout)
        found = next(filter(None, lines), None)
        assert found, "octex view does not start"
        self.url, self.version, self.told = found.group(), "", dict[str, Any]()

    def end(self) -> None:
        """End it, or be there when it has ended."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def ask(self, name: str, body: bytes | None = None) -> bytes | int:
        """Ask for data, or send a command; return the answer, or the status of what is refused.

        Raises OSError or HTTPException if the server is gone.
        """
        parts = urlsplit(self.url)
        connection = HTTPConnection(parts.netloc, timeout=60)
        headers = {} if body is None else {"Content-Type": "application/octet-stream"}
        try:
            connection.request("GET" if body is None else "POST", parts.path + name, body, headers)
            answer = connection.getresponse()
            content = answer.read()
        finally:
            connection.close()
        return content if answer.status == 200 else answer.status

    def send(self, body: bytes) -> bool:
        """Send a command; say whether it is taken, False for a server that is killed meanwhile."""
        try:
            while (answer := self.ask("session", body)) == 429:
                time.sleep(0.05)
        except (OSError, HTTPException):
            return False
        assert isinstance(answer, bytes), f"the server answers {answer}"
        return True

    def wait(self, number: int, page: str = PAGE) -> dict[str, Any]:
        """Read changes until a command of a page is done; return what is told of the session."""
        if not self.version:
            self._heard(self.ask("data/header"))
        while self.told["finished"].get(page, 0) < number:
            answer = self.ask(f"data/{self.version}/change")
            if isinstance(answer, bytes):
                self.ask(f"data/{self.version}/change-0")
                self._heard(answer)
            else:
                time.sleep(0.002)
        return self.told

    def _heard(self, answer: bytes | int) -> None:
        assert isinstance(answer, bytes)
        header = json.loads(answer)
        self.version, self.told = header["version"], header["session"]
        assert not self.told["error"], self.told["error"]
