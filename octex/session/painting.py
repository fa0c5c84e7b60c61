"""A painting session in the browser: writes each command of a page to a journal, then runs it."""

from __future__ import annotations

import copy
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from octex.arrays import Array
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR
from octex.editing.draft import Change
from octex.errors import ArgumentError, ModelError, OctexError, OutputError
from octex.nearest.triangles import Triangles
from octex.painting.composites import Stacked
from octex.painting.image import Blend, Projection
from octex.painting.layers import Layers
from octex.painting.paint import format_of
from octex.painting.painter import Painter
from octex.painting.region import alike
from octex.painting.unwrap import Patch
from octex.session.commands import (
    PageCommand,
    Where,
    command_of,
    fields_of,
    file_of,
    fill_of,
    layer_of,
    moment_of,
    replaces_of,
    spot_of,
    stroke_of,
    target_of,
)
from octex.session.journal import Journal, layers_file
from octex.session.material import images_of, paint_of, with_channel
from octex.session.outside import put_aside, stamp_of, texture_of
from octex.session.poses import Poses, mirrored_spot
from octex.source.corners import at_corners
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.texture import OctreeTexture

#: Largest number of waiting commands; a page queues further ones itself.
_MOST_WAITING = 64
#: Makes pages hear of changed files.
_LOOK = PageCommand("", 0, "look", {}, b"")
#: Largest number of pages whose last command number is remembered.
_MOST_PAGES = 1000


class BusyError(OctexError):
    """The queue is full: the page must send the command again later."""


class OrderError(OctexError):
    """A page started before this session: it must count commands from 1, under another name."""


class _Step(NamedTuple):
    """A unit of undo."""

    name: str
    strokes: int  # number of the Painter's strokes
    number: int  # running number of all steps ever made


class Shown(NamedTuple):
    """The texture after a command, and the session's status for pages."""

    texture: OctreeTexture
    status: dict[str, Any]
    before: OctreeTexture | None  # the texture before that command
    changes: tuple[Change, ...]  # made by that command
    stacked: Stacked  # the layers and the texture below them


class Session:
    """Runs the commands of pages with a `Painter`, in order of arrival, on a thread of its own.

    ``take`` returns as soon as the command is in the journal; it does not wait for paint. The session calls
    ``changed`` after each command. ``motion`` animates the surface, to paint on its poses. ``opened`` is the
    texture's file: if another program changes it, pages ask which version to keep. Raises OutputError for a
    journal with commands of an earlier session, unless ``recover``: then it repeats them first. Raises the
    errors of `Painter`, and ArgumentError for a texture without base colour.
    """

    def __init__(
        self,
        texture: OctreeTexture,
        surface: Surface,
        output: Path,
        *,
        motion: Motion | None = None,
        opened: Path | None = None,
        recover: bool = False,
    ) -> None:
        format_of(texture, BASE_COLOR.name)
        texture = copy.deepcopy(texture)  # in memory, since its file may be overwritten
        self._painter = Layers(texture, surface)
        self._surface = surface.placed_in(texture)
        self._poses = Poses(surface, motion)
        self.output = output
        self._queue: queue.Queue[PageCommand | None] = queue.Queue()
        self._lock = threading.Lock()  # guards _numbers
        self._numbers: dict[str, int] = {}  # by page: the last command in the journal
        self._finished: dict[str, int] = {}  # by page: the last finished command
        self._steps: list[_Step] = []
        self._undone: list[_Step] = []
        self._error, self._is_ending, self._count = "", False, 0
        self._question = ""  # why the last save asks before replacing OUTPUT
        self._notice = ""  # of the last command
        self._taken: tuple[int, Any] = 0, None  # the last step that took OUTPUT's version, and its stamp
        self._files = {"output": output} if opened is None else {"output": output, "opened": opened}
        # Of files as this session last read or wrote them.
        self._stamps = {path: stamp_of(path) for path in (*self._files.values(), layers_file(output))}
        self._saved: list[int] | None = []  # the steps saved in OUTPUT; []: the input texture; None: unknown
        self._has_layers_file = False  # True once this session saved one
        self._before: OctreeTexture | None = None  # before the last command
        self._changes: tuple[Change, ...] = ()  # of the last command
        self.changed: Callable[[], None] = lambda: None
        self.repeated = 0
        self._journal = Journal(output, texture, surface, motion)
        with self._journal.undone_on_failure():
            for body in self._journal.begin(recover):
                command = command_of(body)
                self._numbers[command.page] = command.number
                if command.kind != "save":
                    self._do(command)
                    self._store()
                    self.repeated += 1
        if self.repeated:
            self._saved = None  # the saved steps are unknown
        self.shown = self._shown()
        self._worker = threading.Thread(target=self._work, args=(texture, surface), daemon=True)
        self._worker.start()

    def take(self, body: bytes) -> int:
        """Take a page's command and return its number; a repeated command is ignored.

        Raises ArgumentError for an invalid command, OrderError, BusyError, and OutputError for a full disk.
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
            if command.kind == "take":
                command = command._replace(content=self._content_of(file_of(command)))
                body = body.partition(b"\n")[0] + b"\n" + command.content
            self._journal.append(body)
            self._numbers[command.page] = command.number
            self._queue.put(command)
        return command.number

    def patch(self, asked: str) -> Patch:
        """Return the unwrapped surface for JSON with the fields of a stroke.

        Raises ArgumentError and ModelError.
        """
        return self._poses.asked(asked)

    def look(self) -> None:
        """Tell pages soon if another program has changed the file of the opened texture."""
        if self._opened_question() != self.shown.status["questions"]["opened"]:
            self._queue.put(_LOOK)

    def _opened_question(self) -> str:
        path = self._files.get("opened")
        if path is None or not self._has_changed(path):
            return ""
        return f"Another program has changed {path.name}. Which version do you want to paint on?"

    def _has_changed(self, path: Path) -> bool:
        """Return whether a file is there that another program has written."""
        return stamp_of(path) not in (None, self._stamps[path])

    def _content_of(self, file: str) -> bytes:
        try:
            return self._files[file].read_bytes()
        except KeyError:
            raise ArgumentError("the model was opened without a texture") from None
        except OSError as error:
            raise ArgumentError(f"{self._files[file]}: {error.strerror or error}") from None

    def wait(self) -> None:
        """Wait until all commands are done."""
        self._queue.join()

    def close(self) -> str:
        """End the session and drop waiting commands; return a sentence about unsaved work, or ""."""
        self._is_ending = True
        self._queue.put(None)
        self._worker.join()
        steps, is_saved = len(self._steps), self._is_saved and self._numbers == self._finished
        self._journal.close(remove=is_saved)
        if is_saved:
            return ""
        noun, pronoun = ("step is", "it") if steps == 1 else ("steps are", "them")
        return (
            f"{steps} painted {noun} not saved: the same command with --recover paints {pronoun} again, "
            f"from {self._journal.path}"
        )

    @property
    def _is_saved(self) -> bool:
        return [step.number for step in self._steps] == self._saved

    def _work(self, *warmed: Any) -> None:
        with suppress(Exception):
            warm_up(*warmed)
        while (command := self._queue.get()) is not None:
            if not self._is_ending:
                if command is _LOOK:
                    self._before, self._changes = self._painter.texture(), ()
                else:
                    self._do(command)
                self.shown = self._shown()
                with suppress(Exception):  # pages then ask for the change, and get the error
                    self.changed()
                self._store()
            self._queue.task_done()
        self._queue.task_done()

    def _store(self) -> None:
        """Move all but the last few strokes from memory to disk."""
        with suppress(OutputError):  # a full disk: the strokes stay in memory
            self._painter.store(self.output.parent, waits=False)

    def _shown(self) -> Shown:
        status = {
            "steps": [step.name for step in (*self._steps, *self._undone[::-1])],
            "done": len(self._steps),
            "finished": dict(self._finished),
            "output": self.output.name,
            "isSaved": self._is_saved,
            "layers": [fields_of(layer) for layer in self._painter.layers],
            "error": self._error,
            "told": self._notice,
            "questions": {"output": self._question, "opened": self._opened_question()},
        }
        return Shown(self._painter.texture(), status, self._before, self._changes, self._painter.stacked)

    def _do(self, command: PageCommand) -> None:
        """Run a command; one that fails changes nothing, and sets the error."""
        self._error, self._notice, self._before, self._changes = "", "", self._painter.texture(), ()
        try:
            layer, in_mask = target_of(command)
            self._painter.choose(layer, mask=in_mask)
            getattr(self, f"_do_{command.kind}")(command)
        except (OctexError, MemoryError) as error:
            self._error = str(error) or "out of memory"
        except Exception as error:  # a defect must not end the session
            self._error = f"this is a defect of octex: {type(error).__name__}: {error}"
        while self._painter.count > sum(step.strokes for step in self._steps):
            self._painter.undo()  # a part of the failed command
            self._undone.clear()
        self._finished[command.page] = command.number

    def _do_stroke(self, command: PageCommand) -> None:
        projection, options, where = stroke_of(command)
        moment, spot = moment_of(command.fields), spot_of(command.fields)
        pose = self._poses.at(moment)
        images = [projection if spot is None else self._poses.flat(projection, moment, spot)]
        if where.axis is not None:
            middle = self._mirror(where, (pose or self._surface).vertices)
            if spot is None:
                images.append(mirrored(projection, where.axis, middle))
            else:
                flipped, spot = mirrored(projection, 0, 0.0), mirrored_spot(spot, where.axis, middle)
                with suppress(ModelError):  # no surface at the mirrored spot
                    images.append(self._poses.flat(flipped, moment, spot))
        regions: list[Any] = [None, None]
        if where.point is not None:
            regions = [self._surface.parts == self._part_at(point) for point in self._points(where)]
        texture, strokes = self._painter.texture(), []
        covered = self._painter.covered(erases=projection.blend == "erase")
        for image, region in zip(images, regions, strict=False):
            of_channels = [(name, image) for name in covered or ()] or images_of(command, image, texture)
            for name, each in of_channels:
                strokes.append(self._painter.paint(each, pose=pose, channel=name, region=region, **options))
        self._did(command, strokes)

    def _do_fill(self, command: PageCommand) -> None:
        options, where, color_limits = fill_of(command)
        regions: list[Any] = [_everywhere]
        texture = self._painter.texture()
        if color_limits is not None:
            nearest = self._nearest.nearest(np.stack(self._points(where)))
            corners = self._surface.triangles[nearest.triangles]
            points = at_corners(self._surface.rest, corners, nearest.barycentric)
            regions = [alike(texture, each, **color_limits) for each in points]
        elif where.point is not None:
            parts = {self._part_at(point) for point in self._points(where)}
            regions = [self._surface.parts == number for number in sorted(parts)]
        covered = self._painter.covered(erases=options["blend"] == "erase")
        values = {value.form.name: value.light for value in paint_of(command, texture)}
        if covered is not None:
            values = {name: np.zeros(texture.channels[name].format.components) for name in covered}
        strokes = [
            self._painter.fill(region, value, channel=name, **options)
            for region in regions
            for name, value in values.items()
        ]
        self._did(command, strokes)

    def _do_channel(self, command: PageCommand) -> None:
        texture = self._painter.texture()
        change = Change(None, texture, with_channel(command, texture))
        self._did(command, [self._painter.put(change)])

    def _mirror(self, where: Where, vertices: Array) -> float:
        """Return the mirror's position on its axis."""
        used = vertices[np.unique(self._surface.triangles)][:, where.axis]
        return float((used.min() + used.max()) / 2) + where.offset

    def _points(self, where: Where) -> list[Array]:
        """Return the point of a command, and its mirror image if there is a mirror."""
        assert where.point is not None
        if where.axis is None:
            return [where.point]
        mirrored_point = where.point.copy()
        mirrored_point[where.axis] = 2 * self._mirror(where, self._surface.rest) - mirrored_point[where.axis]
        return [where.point, mirrored_point]

    @cached_property
    def _nearest(self) -> Triangles:
        return Triangles.of(self._surface.rest, self._surface.triangles)

    def _part_at(self, point: Array) -> int:
        return int(self._surface.parts[self._nearest.nearest(point[None]).triangles[0]])

    def _did(self, command: PageCommand, strokes: list[tuple[Change, ...]]) -> None:
        self._changes = tuple(change for stroke in strokes for change in stroke)
        n_strokes = self._painter.count - sum(step.strokes for step in self._steps)
        if n_strokes:
            self._count += 1
            self._steps.append(_Step(command.fields.get("name", command.kind), n_strokes, self._count))
            self._undone.clear()

    def _do_layer(self, command: PageCommand) -> None:
        action, arguments = layer_of(command)
        number, _ = target_of(command)
        act = getattr(self._painter, f"{action}_layer")
        act(*([] if action == "add" else [number]), **arguments)
        self._did(command, [self._painter.changes])

    def _do_undo(self, command: PageCommand) -> None:  # noqa: ARG002
        self._move(self._steps, self._undone, self._painter.undo)

    def _do_redo(self, command: PageCommand) -> None:  # noqa: ARG002
        self._move(self._undone, self._steps, self._painter.redo)

    def _move(self, source: list[_Step], target: list[_Step], act: Callable[[], Any]) -> None:
        """Undo or redo the last of the steps, if any."""
        if not source:
            return
        step = source.pop()
        for _ in range(step.strokes):
            act()
            self._changes += self._painter.changes
        target.append(step)

    def _do_save(self, command: PageCommand) -> None:
        paths = [self.output]
        if self._painter.layers or self._has_layers_file:
            paths.append(layers_file(self.output))
        changed = [path for path in paths if self._has_changed(path) and not self._has_taken(path)]
        self._question = ""
        if changed and not replaces_of(command):
            names = " and ".join(path.name for path in changed)
            self._question = f"Another program has changed {names}. Which version do you want to keep?"
            return
        with put_aside(changed) as asides:
            self._painter.texture().save(self.output)
            if self._painter.layers:
                self._painter.save(paths[1])
        self._has_layers_file = bool(self._painter.layers)
        if len(paths) > 1 and not self._has_layers_file:
            paths[1].unlink(missing_ok=True)
        self._stamps |= {path: stamp_of(path) for path in paths}
        self._saved = [step.number for step in self._steps]
        if asides:
            self._notice = f"The other version is kept as {' and '.join(path.name for path in asides)}."

    def _do_take(self, command: PageCommand) -> None:
        path = self._files.get(file_of(command), self.output)
        try:
            texture = texture_of(command.content, path)
            format_of(texture, BASE_COLOR.name)
            self._painter.replace(texture)
        except OctexError as error:
            raise ArgumentError(f"{path.name} cannot be taken: {error}") from None
        self._did(command, [self._painter.changes])
        stamp = stamp_of(path)
        if path == self.output:
            self._question = ""
        if stamp is None or path.read_bytes() != command.content:
            return  # it has changed again
        if path == self.output:
            self._taken = self._count, stamp
        else:
            self._stamps[path] = stamp

    def _has_taken(self, path: Path) -> bool:
        """Return whether the texture is made from the file's version: then saving loses nothing."""
        number, stamp = self._taken
        is_here = any(step.number == number for step in self._steps)
        return path == self.output and is_here and stamp_of(path) == stamp

    def _do_keep(self, command: PageCommand) -> None:  # noqa: ARG002
        if "opened" in self._files:
            self._stamps[self._files["opened"]] = stamp_of(self._files["opened"])


def warm_up(texture: OctreeTexture, surface: Surface) -> None:
    """Paint small strokes and discard them, so that compiled code is loaded before the first stroke.

    The first one is coarser than the texture, the others are finer and overlap.
    """
    image = np.zeros((64, 64, 4), np.uint8)
    image[24:40, 24:40, 3] = 255
    painter, toward = Painter(texture, surface), (0.0, 0.0, 1.0)
    painter.paint(Projection(image, Camera.fitted(surface.vertices, toward, size=(64, 64))))
    top = surface.vertices[surface.vertices[:, 2].argmax()]
    width = 40.0 * texture.placement.size / 2**texture.tree.max_depth
    close_up = Camera.fitted([top, top + np.array([width, width, 0.0])], toward, size=(64, 64))
    for blend in cast(tuple[Blend, ...], ("over", "erase")):
        painter.paint(Projection(image, close_up, opacity=0.5, blend=blend))


def mirrored(projection: Projection, axis: int, middle: float) -> Projection:
    """Return an image, and its camera, reflected at the plane across an axis."""
    camera = cast(Camera, projection.camera)
    mirror = np.eye(4)
    mirror[axis, axis], mirror[axis, 3] = -1.0, 2.0 * middle
    K = camera.K.copy()
    K[0, 2] = camera.width - K[0, 2]
    K[0, 1] = -K[0, 1]
    pose = np.diag([-1.0, 1.0, 1.0, 1.0]) @ camera.world_to_camera @ mirror
    seen_by = Camera.pinhole((camera.width, camera.height), pose=pose, convention="opencv", K=K)
    return replace(projection, image=cast(Array, projection.image)[:, ::-1], camera=seen_by)


def _everywhere(points: Array) -> Array:
    return np.ones(len(points))
