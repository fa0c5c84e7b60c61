"""A session of painting in the browser: commands of pages, each in a journal before it is done."""

from __future__ import annotations

import json
import queue
import re
import threading
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array
from octex.cameras.camera import Camera
from octex.channels import decode
from octex.checks import as_number, as_reals, as_whole
from octex.editing.draft import Change
from octex.errors import ArgumentError, OctexError
from octex.painting.options import DRAWN_ANGLE, PaintOptions
from octex.painting.painter import Painter
from octex.painting.picture import Projection
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.viewer.journal import Journal

#: Bytes of a command, and pixels along a side of the view that a stroke is painted on.
MOST_BYTES, MOST_PIXELS = 32 << 20, 4096
#: Commands that wait for their turn; a page keeps more of them itself.
_MOST_WAITING = 64
#: Pages whose last number is known.
_MOST_PAGES = 1000
_LONGEST_NAME = 40
_MOST_NUMBER = 2**53 - 1
_KINDS = "stroke", "fill", "undo", "redo", "save"


class BusyError(OctexError):
    """So many commands wait that a page must send this one again later."""


class OrderError(OctexError):
    """A page's commands have begun before this session: it must count them from 1, under another name."""


class Command(NamedTuple):
    """What a page asks for; pages count their commands from 1."""

    page: str
    number: int
    kind: str
    given: dict[str, Any]
    content: bytes


class Shown(NamedTuple):
    """The texture at a time, and what pages are told of the session."""

    texture: OctreeTexture
    told: dict[str, Any]
    changes: tuple[Change, ...]  # since the time before


class Session:
    """Paints what pages send with a `Painter`, in the order in which it came, on a thread of its own.

    ``take`` returns as soon as the journal has a command, so the next one never waits for paint.
    ``changed`` is called after each.
    Raises OutputError for a journal with commands that nobody has repeated, unless ``recover``: then they are
    repeated first. Raises what `Painter` raises.
    """

    def __init__(
        self, texture: OctreeTexture, surface: Surface, output: Path, *, recover: bool = False
    ) -> None:
        self._painter = Painter(texture, surface)
        self._output = output
        self._queue: queue.Queue[Command | None] = queue.Queue()
        self._lock = threading.Lock()  # of what is known of commands that wait
        self._numbers: dict[str, int] = {}  # of each page, the last one that is in the journal
        self._baked: dict[str, int] = {}  # and that is done
        self._steps: list[str] = []
        self._undone: list[str] = []
        self._is_saved, self._fault, self._is_ending = True, "", False
        self._changes: tuple[Change, ...] = ()  # of the command that is done
        self.changed: Callable[[], None] = lambda: None
        self.repeated = 0
        self._journal = Journal(output, texture, surface)
        with self._journal.undone_on_failure():
            for body in self._journal.begin(recover):
                command = command_of(body)
                self._numbers[command.page] = command.number
                if command.kind != "save":
                    self._do(command)
                    self.repeated += 1
        self._is_saved = not self._numbers
        self.shown = self._shown()
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def take(self, body: bytes) -> int:
        """Take a command of a page and return its number; one that was taken before is not done again.

        Raises ArgumentError for what is no command, OrderError, BusyError, and OutputError for a full disk.
        """
        command = command_of(body)
        with self._lock:
            last = self._numbers.get(command.page, 0)
            if command.number <= last:
                return command.number
            if command.number != last + 1:
                raise OrderError(f"number is {command.number}; the next one is {last + 1}")
            if self._queue.qsize() >= _MOST_WAITING:
                raise BusyError("too many strokes wait; send it again")
            if not last and len(self._numbers) >= _MOST_PAGES:
                raise ArgumentError("too many pages have painted; start octex view again")
            self._journal.append(body)
            self._numbers[command.page] = command.number
            self._is_saved = False
            self._queue.put(command)
        return command.number

    def wait(self) -> None:
        """Wait until all that was taken is done."""
        self._queue.join()

    def close(self) -> str:
        """End, without what still waits; return what is not saved, in a sentence, or nothing."""
        self._is_ending = True
        self._queue.put(None)
        self._worker.join()
        steps, is_saved = len(self._steps), self._is_saved
        self._journal.close(remove=is_saved)
        if is_saved:
            return ""
        what, again = ("step is", "it") if steps == 1 else ("steps are", "them")
        return (
            f"{steps} painted {what} not saved: the same command with --recover paints {again} again, "
            f"from {self._journal.path}"
        )

    def _work(self) -> None:
        while (command := self._queue.get()) is not None:
            if not self._is_ending:
                self._do(command)
                self.shown = self._shown()
                with suppress(Exception):  # pages ask for the change again, and are told what is wrong
                    self.changed()
            self._queue.task_done()
        self._queue.task_done()

    def _shown(self) -> Shown:
        told = {
            "steps": [*self._steps, *self._undone[::-1]],
            "done": len(self._steps),
            "baked": dict(self._baked),
            "output": self._output.name,
            "isSaved": self._is_saved,
            "fault": self._fault,
        }
        return Shown(self._painter.texture(), told, self._changes)

    def _do(self, command: Command) -> None:
        """Do a command; what fails changes nothing, and is told."""
        self._fault, self._changes = "", ()
        try:
            getattr(self, f"_do_{command.kind}")(command)
        except (OctexError, MemoryError) as error:
            self._fault = str(error) or "out of memory"
        except Exception as error:  # a defect must not end the session
            self._fault = f"this is a defect of octex: {type(error).__name__}: {error}"
        self._baked[command.page] = command.number

    def _do_stroke(self, command: Command) -> None:
        projection, options = stroke_of(command)
        self._did(command, self._painter.paint(projection, **options))

    def _do_fill(self, command: Command) -> None:
        color, opacity = _color_of(command), _opacity_of(command)
        self._did(command, self._painter.fill(_everywhere, color, opacity=opacity))

    def _did(self, command: Command, changes: tuple[Change, ...]) -> None:
        self._changes = changes
        if changes:
            self._steps.append(command.given.get("name", command.kind))
            self._undone.clear()

    def _do_undo(self, command: Command) -> None:  # noqa: ARG002
        strokes = self._painter.strokes
        if self._painter.undo():
            self._changes = tuple(change.inverted() for change in reversed(strokes[-1]))
            self._undone.append(self._steps.pop())

    def _do_redo(self, command: Command) -> None:  # noqa: ARG002
        if self._painter.redo():
            self._changes = self._painter.strokes[-1]
            self._steps.append(self._undone.pop())

    def _do_save(self, command: Command) -> None:
        self._painter.texture().save(self._output)
        with self._lock:
            self._is_saved = self._numbers[command.page] == command.number and self._queue.empty()


def command_of(body: bytes) -> Command:
    """Return what a page sent: a line of JSON, and what follows. Raises ArgumentError for anything else."""
    line, _, content = body.partition(b"\n")
    try:
        given = json.loads(line)
    except (ValueError, RecursionError):
        raise ArgumentError("the command is no line of JSON") from None
    if not isinstance(given, dict):
        raise ArgumentError("the command is no JSON object")
    page, kind, name = given.get("page"), given.get("kind"), given.get("name", "")
    if not isinstance(page, str) or not re.fullmatch(r"[0-9a-f-]{8,40}", page):
        raise ArgumentError("page must be hexadecimal digits")
    number = as_whole(given.get("number"), "number", 1, _MOST_NUMBER)  # type: ignore[arg-type]
    if kind not in _KINDS:
        raise ArgumentError(f"kind must be one of {', '.join(_KINDS)}")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME or not (name.isprintable()):
        raise ArgumentError(f"name must be a line of at most {_LONGEST_NAME} characters")
    command = Command(page, number, kind, given, content)
    if kind == "stroke":
        stroke_of(command)
    elif content:
        raise ArgumentError(f"a command of the kind {kind} has no content")
    elif kind == "fill":
        _color_of(command)
        _opacity_of(command)
    return command


def stroke_of(command: Command) -> tuple[Projection, dict[str, Any]]:
    """Return the picture of a stroke, and the options to paint it with. Raises ArgumentError."""
    given = command.given
    camera = given.get("camera")
    if not isinstance(camera, dict):
        raise ArgumentError("camera must be an object")
    width, height = (as_whole(camera.get(name), name, 1, MOST_PIXELS) for name in ("width", "height"))  # type: ignore[arg-type]
    pose, K = (_numbers(camera, name, shape) for name, shape in (("pose", (4, 4)), ("K", (3, 3))))
    seen_by = Camera.pinhole((width, height), pose=pose, convention="opencv", K=K)
    left, top, right, bottom = box = _numbers(given, "box", (4,)).tolist()
    if not (0 <= left < right <= width and 0 <= top < bottom <= height and all(n == int(n) for n in box)):
        raise ArgumentError(f"box must be a part of {width}×{height} pixels")
    left, top, right, bottom = map(int, box)
    size = (right - left) * (bottom - top)
    unpacker = zlib.decompressobj(-15)
    try:
        coverage = unpacker.decompress(command.content, size + 1)
    except zlib.error:
        coverage = b""
    if len(coverage) != size or not unpacker.eof or unpacker.unused_data:
        raise ArgumentError(f"the content is no deflated coverage of {size:,} pixels")
    image = np.zeros((height, width, 4), np.uint8)
    image[..., :3] = np.rint(_numbers(given, "color", (3,), 255.0))
    image[top:bottom, left:right, 3] = np.frombuffer(coverage, np.uint8).reshape(bottom - top, right - left)
    options = {"max_angle": given.get("maxAngle", DRAWN_ANGLE), "back_faces": given.get("backFaces", False)}
    PaintOptions(**options)
    return Projection(image, seen_by, opacity=_opacity_of(command)), options


def _opacity_of(command: Command) -> float:
    return as_number(command.given.get("opacity", 1.0), "opacity", 0.0, 1.0)


def _color_of(command: Command) -> Array:
    """Return a colour in linear light."""
    codes = np.rint(_numbers(command.given, "color", (3,), 255.0)).astype(np.uint8)
    return decode(codes, "srgb")


def _numbers(given: dict[str, Any], name: str, shape: tuple[int, ...], most: float = 1e12) -> Array:
    found = as_reals(given.get(name), name, shape, most=most)  # type: ignore[arg-type]
    if most == 255.0 and (found < 0).any():
        raise ArgumentError(f"{name} must be codes of 0 to 255")
    return found


def _everywhere(points: Array) -> Array:
    return np.ones(len(points))
