#!/usr/bin/env python
"""Paint random strokes in sessions that end at any moment, or that go on for long; see that none is lost.

usage: soak.py sessions                        kill the server (SIGKILL) at random moments
       random_sessions.py closes 50            close a page at so many random moments
       random_sessions.py strokes 1000         paint, undo all and redo all, and say what memory that takes

The server is octex view in a process of its own. What it has painted must be, bit for bit, what the same
calls of the library paint. Closing pages and page memory need a browser (playwright). Linux only.
"""

from __future__ import annotations

import itertools
import math
import re
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

import octex  # noqa: E402
from octex.session.commands import command_of, stroke_of  # noqa: E402
from octex.session.journal import _records  # noqa: E402
from octex.texture import OctreeTexture  # noqa: E402
from tests.make.paint_server import PAGE, PaintServer, command, disc  # noqa: E402
from tests.make.same import assert_same  # noqa: E402

_SIZE = 400, 300
#: Strokes after which memory is measured first, and the most that it may have grown then.
_FIRST, _MOST_GROWTH = 100, 1.5


class Studio(PaintServer):
    """The droid, and the server that paints it."""

    def __init__(self, folder: Path, depth: int) -> None:
        model, path, self.output = (
            ROOT / "samples" / "droid.glb",
            folder / "droid.octex",
            folder / "out.octex",
        )
        self.surface = octex.load_surface(model, channels=["base_color"], normals=True)
        octex.convert(self.surface, depth).save(path)
        self.texture = octex.open(path)
        super().__init__(path, model, self.output)

    def saved(self, number: int) -> OctreeTexture:
        """Return what the server saves, by a command of a number."""
        assert self.send(command("save", number))
        self.wait(number)
        return octex.open(self.output)

    def painted(self, bodies: list[bytes]) -> OctreeTexture:
        """Return what calls of the library paint."""
        painter = octex.Painter(self.texture, self.surface)
        for body in bodies:
            projection, options, *_ = stroke_of(command_of(body))
            painter.paint(projection, **options)
            painter.store()
        return painter.texture()

    def stroke(self, number: int, random: np.random.Generator, most: float = 60) -> bytes:
        """Return a disc on the model, seen from anywhere."""
        toward = random.normal(size=3)
        camera = octex.Camera.fitted(self.surface.vertices, tuple(toward.tolist()), size=_SIZE)
        point = self.surface.vertices[self.surface.triangles[random.integers(len(self.surface.triangles)), 0]]
        color = random.integers(0, 256, 3).tolist()
        return disc(number, camera, camera.project(point[None])[0][0], random.uniform(3, most), color)


def _memory_of(process: int) -> float:
    status = Path(f"/proc/{process}/status").read_text("utf-8")
    found = re.search(r"VmRSS:\s*(\d+)", status)
    return int(found[1]) / 1024 if found else 0.0


def check(seed: int) -> None:
    """Kill a server a few times, while strokes are sent; what it has answered must be there, once."""
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        studio, taken = Studio(Path(folder), 7), list[bytes]()

        def stroke() -> bytes:
            return studio.stroke(len(taken) + 1, np.random.default_rng([seed, len(taken)]), 12)

        for _ in range(3):
            killer = threading.Timer(random.uniform(0.0, 0.6), studio.process.kill)
            killer.start()
            while studio.send(body := stroke()):
                taken.append(body)
                time.sleep(random.uniform(0.0, 0.1))
            # What is not answered is sent again, as pages do.
            killer.join()
            studio.end()
            studio.start()
        taken.append(stroke())
        assert studio.send(taken[-1])
        studio.wait(len(taken))
        assert_same(studio.saved(len(taken) + 1), studio.painted(taken))
        studio.end()


def closes(count: int, seed: int = 0) -> None:
    """Close pages while they send strokes; all that was answered must be there."""
    from tests.make.browser import driven, opened, started

    random, lost = np.random.default_rng(seed), 0
    with tempfile.TemporaryDirectory() as folder, driven() as driver, started(driver) as browser:
        studio, answered = Studio(Path(folder), 8), dict[str, int]()
        for _ in range(count):
            page = opened(browser, studio.url, (800, 400))
            page.wait_for_function("viewer.painting && viewer.isDrawn")
            name = page.evaluate("viewer.painting.commands.page")
            answered[name] = 0

            def heard(answer: Any, name: str = name) -> None:
                if answer.url.endswith("/session") and answer.status == 200:
                    answered[name] += 1

            page.on("response", heard)
            box, end = page.locator("#image").bounding_box(), math.inf
            while time.monotonic() < end:
                x, y = (box["width"] / 2 + random.uniform(-9, 9), box["height"] / 2 + random.uniform(-60, 60))
                page.mouse.move(x, y)
                page.mouse.down()
                page.mouse.move(x + 4, y + 4)
                page.mouse.up()
                page.wait_for_timeout(random.uniform(0, 100))
                if end == math.inf and answered[name]:  # all is compiled
                    end = time.monotonic() + random.uniform(0.0, 1.5)
            page.close(run_before_unload=False)
        for name, number in answered.items():
            told = studio.wait(number, name) if number else {}
            lost += max(number - told.get("finished", {}).get(name, 0), 0)
        _, *bodies = _records(studio.output.with_name("out.octex.strokes").read_bytes())
        assert not lost, f"{lost} strokes are lost"
        assert_same(studio.saved(1), studio.painted(bodies))
        studio.end()
    total = sum(answered.values())
    print(f"{count} pages closed, {total} strokes answered, {len(bodies)} painted: none is lost")


def strokes(count: int, seed: int = 0) -> None:
    """Paint, undo all and redo all, with a page that follows; see what is left, and what memory it takes.

    The page's octree must be the one that a page has which loads it anew.
    """
    from tests.make.browser import UNLIKE, driven, opened, started

    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder, driven() as driver, started(driver) as browser:
        studio = Studio(Path(folder), 10)
        page = opened(browser, studio.url, (400, 300))
        page.evaluate("viewer.frame = () => {}")  # without the software GPU's drawing
        devtools = page.context.new_cdp_session(page)
        first = [0.0, 0.0]

        def measure(what: str) -> None:
            devtools.send("HeapProfiler.collectGarbage")
            arrays = "viewer.parts[0].stores.flatMap(({ read }) => read())"
            held = f"{arrays}.reduce((sum, {{ buffer }}) => sum + buffer.byteLength, 0)"
            heap, octree = devtools.send("Runtime.getHeapUsage"), page.evaluate(held) / 2**20
            used = (heap["usedSize"] + heap.get("backingStorageSize", 0)) / 2**20
            now = [_memory_of(studio.process.pid), used - octree]  # finer strokes have more cells
            print(
                f"{what}: server {now[0]:.0f} MB, page {now[1]:.1f} MB and its octree {octree:.0f} MB",
                flush=True,
            )
            if what == f"{_FIRST} strokes":
                first[:] = now
            for name, mine, before in zip(("server", "page"), now, first, strict=True):
                if before:
                    assert mine <= _MOST_GROWTH * before, f"the {name}'s memory has grown"

        def follow(number: int) -> dict[str, Any]:
            told = studio.wait(number)
            page.wait_for_function(
                f"(n) => viewer.painting.status.finished['{PAGE}'] === n",
                arg=number,
                timeout=60_000,
                polling=50,
            )
            return told

        def check_page() -> None:
            assert page.evaluate(UNLIKE) == [], "the page's octree is not the server's"

        began, bodies = time.monotonic(), list[bytes]()
        for number in range(1, count + 1):
            bodies.append(studio.stroke(number, random))
            assert studio.send(bodies[-1])
            if number % 10 == 0:
                follow(number)
            if number == _FIRST or number % 250 == 0:
                measure(f"{number} strokes")
                check_page()
        print(f"{time.monotonic() - began:.0f} s", flush=True)
        numbers, steps = itertools.count(count + 1), follow(count)["done"]
        for kind in ("undo", "redo"):
            began = time.monotonic()
            for step in range(steps):
                number = next(numbers)
                assert studio.send(command(kind, number))
                if step % 10 == 0:
                    follow(number)
            follow(number)
            print(f"{steps} × {kind}: {time.monotonic() - began:.0f} s", flush=True)
            measure(f"after {kind} of all")
            check_page()
            if kind == "undo":
                assert_same(studio.saved(next(numbers)), studio.texture)
        assert_same(studio.saved(next(numbers)), studio.painted(bodies))
        assert page.complaints == []
        page.close()
        studio.end()
    print("undone is the original, redone is what the library paints")


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in ("closes", "strokes") or not sys.argv[2].isdecimal():
        sys.exit(__doc__)
    globals()[sys.argv[1]](int(sys.argv[2]))
