"""Painter: strokes on one texture, and the history that undoes them."""

from __future__ import annotations

import pickle
import tempfile
import weakref
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy.typing as npt

from octex.channels import BASE_COLOR
from octex.checks import as_path
from octex.editing.draft import Change, as_change
from octex.errors import OutputError
from octex.painting.image import Blend, Projection, check_projections
from octex.painting.merge import Merging, merged
from octex.painting.paint import painted
from octex.painting.region import Region, filled
from octex.painting.surface import Balance, Job, PaintedSurface, PaintOptions, Pictures
from octex.parallel import Progress, Run, as_run, workers
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture

#: The changes of a call, one for each layer, in order.
Stroke = tuple[Change, ...]

#: Strokes that stay in memory, and more that may wait to be compressed.
_IN_MEMORY, _MOST_WAITING = 4, 4
#: Compresses strokes, so that the next one need not wait.
_PACKER = ThreadPoolExecutor(1, thread_name_prefix="octex undo")


class History:
    """A stack of strokes: the last ones in memory, earlier ones in a file once they are stored."""

    def __init__(self) -> None:
        self._strokes: list[Any] = []  # in memory; `Layers` adds changes of its stack
        self._ends: list[int] = [0]  # the ends of the earlier ones in the file
        self._file: IO[bytes] | None = None
        self._packed: Future[bytes] | None = None  # the oldest stroke in memory

    def __len__(self) -> int:
        return len(self._ends) - 1 + len(self._strokes)

    def __iter__(self) -> Iterator[Any]:
        yield from (self._stored(number) for number in range(len(self._ends) - 1))
        yield from self._strokes

    @property
    def last(self) -> Any:
        """The last stroke; an empty one for none."""
        if self._strokes:
            return self._strokes[-1]
        return self._stored(len(self._ends) - 2) if len(self._ends) > 1 else ()

    def append(self, stroke: Any) -> None:
        """Put a stroke on the stack."""
        self._strokes.append(stroke)

    def pop(self) -> Any:
        """Take the last stroke from the stack."""
        stroke = self.last
        (self._strokes or self._ends).pop()
        if not self._strokes:
            self._packed = None
        return stroke

    def clear(self) -> None:
        """Take all strokes from the stack."""
        self._strokes.clear()
        self._packed = None
        del self._ends[1:]

    def store(self, folder: Path | None, *, waits: bool) -> None:
        """Move all strokes but the last few to a temporary file. Raises OSError, and then keeps the rest."""
        while len(self._strokes) > _IN_MEMORY:
            if self._packed is None:
                self._packed = _PACKER.submit(_packed, self._strokes[0])
            is_late = len(self._strokes) > _IN_MEMORY + _MOST_WAITING
            if not (waits or is_late or self._packed.done()):
                return
            packed = self._packed.result()
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.seek(self._ends[-1])
            self._file.write(packed)
            self._file.flush()
            self._ends.append(self._file.tell())
            self._file.truncate()
            del self._strokes[0]
            self._packed = None

    def _stored(self, number: int) -> Any:
        assert self._file is not None
        begin, end = self._ends[number : number + 2]
        self._file.seek(begin)
        return pickle.loads(zlib.decompress(self._file.read(end - begin)))


def _packed(stroke: Any) -> bytes:
    return zlib.compress(pickle.dumps(stroke, 5), 1)


class Painter:
    """A painting session: strokes on a texture of a surface, with undo and redo.

    It caches data about the surface, so strokes are fast. ``texture()`` equals, bit for bit, the result of
    the same calls of ``octex.paint`` and ``octex.fill``.

    Each stroke returns its changes: the tiles that it touched, before and after, as two small textures. A
    change can be pickled, applied to an equal texture and inverted.

    Raises ArgumentError for a texture or surface that ``paint`` does not accept.
    """

    def __init__(self, texture: OctreeTexture, surface: Surface) -> None:
        as_surface(surface)
        self._texture = as_texture(texture)
        self._shared = self._texture  # callers may have it, so its arrays are never written to
        self._surface = surface
        self._merging: Merging = merged
        self._painted = PaintedSurface(surface.placed_in(texture), in_session=True)
        self._pose: tuple[Surface, PaintedSurface] | None = None  # the last pose
        self._done, self._undone = History(), History()

    def texture(self) -> OctreeTexture:
        """Return the texture as it is now. Textures are immutable: later strokes do not change it."""
        self._shared = self._texture
        return self._texture

    @property
    def strokes(self) -> tuple[Stroke, ...]:
        """The changes of all calls in effect, oldest first."""
        return tuple(self._done)

    @property
    def last(self) -> Stroke:
        """The changes of the last call in effect; empty for none."""
        stroke: Stroke = self._done.last
        return stroke

    @property
    def count(self) -> int:
        """The number of calls in effect."""
        return len(self._done)

    def store(self, folder: str | PathLike[str] | None = None, *, waits: bool = True) -> None:
        """Move all strokes but the last few from memory to a temporary file; they can still be undone.

        ``folder`` holds the file, by default that of temporary files. Without ``waits``, strokes are
        compressed on a thread, and a later call writes them; a few more are then in memory. Raises
        OutputError for a full disk; the strokes then stay in memory.
        """
        path = None if folder is None else as_path(folder, "folder")
        try:
            for history in (self._done, self._undone):
                history.store(path, waits=waits)
        except OSError as error:
            raise OutputError(f"strokes cannot be stored: {error}") from None

    def paint(
        self,
        projections: Projection | Sequence[Projection],
        *,
        pose: Surface | None = None,
        channel: str = BASE_COLOR.name,
        max_depth: int | None = None,
        max_angle: float | None = None,
        edge_feather: float = 0.0,
        pictures: Pictures | None = None,
        balance: Balance | None = None,
        reference: int | None = None,
        back_faces: bool = False,
        hidden: bool = False,
        region: npt.ArrayLike | None = None,
        fit: bool = True,
        threads: int | None = None,
        progress: Progress | None = None,
        run: Run | None = None,
    ) -> Stroke:
        """Paint images as ``octex.paint`` does, with its options; return the changes.

        ``pose`` is the surface in another pose (``Surface.with_pose``), which the cameras see instead. The
        changes are empty if nothing is painted; else undone strokes can no longer be redone. Raises the
        errors of ``octex.paint``; the texture then stays as it was.
        """
        options = PaintOptions(
            channel, max_depth, max_angle, edge_feather, pictures, balance, reference, back_faces, fit,
            hidden, region,
        )  # fmt: skip
        changes: list[Change | None] = []
        run = as_run(run, threads, progress)
        with workers(run) as pool:
            painted_surface = self._painted if pose is None else self._posed(pose)
            job, images = Job(painted_surface, pool, run.report), check_projections(projections)
            try:
                for texture, change in painted(
                    job, self._texture, images, options, merge=self._merging, put=self._put
                ):
                    self._texture = texture
                    changes.append(change)
            except BaseException:
                for change in reversed(changes):
                    if change is not None:
                        self._texture = self._put(change.inverted(), self._texture)
                raise
        return self._did(changes)

    def fill(
        self,
        region: Region,
        color: npt.ArrayLike | str,
        *,
        channel: str = BASE_COLOR.name,
        opacity: float = 1.0,
        blend: Blend = "over",
        max_depth: int | None = None,
        threads: int | None = None,
        progress: Progress | None = None,
        run: Run | None = None,
    ) -> Stroke:
        """Fill a region as ``octex.fill`` does; return the changes, as ``paint`` does."""
        run = as_run(run, threads, progress)
        with workers(run) as pool:
            job = Job(self._painted, pool, run.report)
            paint = region, color, channel, opacity, blend, max_depth, self._merging
            _, change = filled(job, self._texture, self._surface, *paint)
        if change is not None:
            self._texture = self._put(change, self._texture)
        return self._did([change])

    def put(self, change: Change) -> Stroke:
        """Apply a change of the current texture, made by other code, as a stroke; return it."""
        self._texture = self._put(as_change(change), self._texture)
        return self._did([change])

    def undo(self) -> bool:
        """Undo the last call in effect; return whether there was one."""
        return self._moved(self._done, self._undone)

    def redo(self) -> bool:
        """Redo the last undone call; return whether there was one."""
        return self._moved(self._undone, self._done)

    def _moved(self, source: History, target: History) -> bool:
        """Undo or redo the last stroke of one history, and move it to the other."""
        if not len(source):
            return False
        stroke, undoes = source.pop(), source is self._done
        for change in reversed(stroke) if undoes else stroke:
            self._texture = self._put(change.inverted() if undoes else change, self._texture)
        target.append(stroke)
        return True

    def _posed(self, pose: Surface) -> PaintedSurface:
        if self._pose is None or self._pose[0] is not pose:
            surface = as_surface(pose, "pose").placed_in(self._texture)
            self._pose = pose, self._painted.posed(surface)
        return self._pose[1]

    def _put(self, change: Change, texture: OctreeTexture) -> OctreeTexture:
        changed = change.put_into(texture, self._shared)
        if change.tiles is None:  # the change and the Painter share the texture
            self._shared = changed
        return changed

    def _did(self, changes: Sequence[Change | None]) -> Stroke:
        stroke = tuple(change for change in changes if change is not None)
        if stroke:
            self._done.append(stroke)
            self._undone.clear()
        return stroke
