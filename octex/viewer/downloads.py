"""Makes files that a page downloads: the painted texture, or the model with it, for other programs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import parse_qsl

from octex.baking.bake import bake
from octex.baking.layout import LAYOUTS
from octex.baking.vertices import bake_vertices
from octex.checks import as_choice
from octex.errors import OctexError
from octex.files import scratch_folder
from octex.formats.models import write_model
from octex.parallel import Progress
from octex.viewer.export import write_page

if TYPE_CHECKING:
    from octex.session.painting import Session
    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: File formats by ending.
_ENDINGS = {
    "octex": ".octex",
    "octz": ".octz",
    "glb": ".glb",
    "vertices": "-vertices.glb",
    "ply": "-vertices.ply",
    "html": ".html",
}
_SIZES = "auto", "512", "1024", "2048", "4096", "8192"
_DEFAULTS = {"kind": "", "uv": "auto", "size": "auto", "divide": "no"}
#: Seconds between progress messages.
_BEAT = 0.2


class Wanted(NamedTuple):
    """A page's request for a file."""

    kind: str
    uv: str  # of images: `octex.bake`'s uv
    size: int | None  # of images, in pixels
    divide: bool  # add vertices where colours need them

    @classmethod
    def of(cls, query: str) -> Wanted:
        """Parse a query; raises ArgumentError for an invalid one."""
        pairs = parse_qsl(query, keep_blank_values=True)
        for name, _ in pairs:
            as_choice(name, tuple(_DEFAULTS), "field of the download")
        kind, uv, size, divide = {**_DEFAULTS, **dict(pairs)}.values()
        as_choice(kind, tuple(_ENDINGS), "kind")
        as_choice(uv, LAYOUTS, "uv")
        as_choice(size, _SIZES, "size")
        as_choice(divide, ("yes", "no"), "divide")
        return cls(kind, uv, None if size == "auto" else int(size), divide == "yes")


class Downloads:
    """Makes files of a session's texture, one at a time, in a hidden folder next to its OUTPUT.

    Painting continues: the file has the texture from when its making began. Only the last file remains.
    """

    def __init__(self, session: Session, surface: Surface, motion: Motion | None, title: str) -> None:
        self._session, self._surface, self._motion, self._title = session, surface, motion, title
        self._lock = threading.Lock()  # held while a file is made
        self._held = ExitStack()  # the last file's folder
        self._number = 0
        self._latest: tuple[str, Path] | None = None

    def make(self, query: str, tell: Callable[[str, dict[str, Any]], None]) -> None:
        """Make a file; ``tell`` gets progress, then the file's address or the error.

        ``tell`` may raise an exception to stop the work.
        """
        if not self._lock.acquire(blocking=False):
            tell("fault", {"why": "another export is under way; wait until it is done"})
            return
        try:
            wanted = Wanted.of(query)
            self._drop()
            folder = self._held.enter_context(scratch_folder(self._session.output.parent))
            path = folder / (self._session.output.stem + _ENDINGS[wanted.kind])
            self._write(wanted, self._session.shown.texture, path, _seldom(tell))
            self._number += 1
            self._latest = str(self._number), path
            tell("done", {"number": self._number, "name": path.name, "bytes": path.stat().st_size})
        except (OctexError, MemoryError) as error:
            tell("fault", {"why": " ".join(str(error).split()) or "out of memory"})
        except OSError as error:
            where = self._session.output.parent
            tell("fault", {"why": f"{where}: cannot be written: {error.strerror or error}"})
        finally:
            if self._latest is None:
                self._drop()
            self._lock.release()

    def file(self, number: str) -> Path | None:
        """Return the file of this number, or None if it was removed."""
        latest = self._latest
        return latest[1] if latest is not None and latest[0] == number else None

    def close(self) -> None:
        """Remove the last file; one in progress is removed when its work stops."""
        if self._lock.acquire(blocking=False):
            self._drop()
            self._lock.release()

    def _drop(self) -> None:
        self._latest = None
        self._held.close()

    def _write(self, wanted: Wanted, texture: OctreeTexture, path: Path, progress: Progress) -> None:
        surface = self._surface
        progress("write", 0, 1)
        if wanted.kind in ("octex", "octz"):
            texture.save(path)
        elif wanted.kind == "html":
            write_page(texture, path, surface, motion=self._motion, title=self._title, progress=progress)
        elif wanted.kind == "glb":
            uv: Any = wanted.uv
            baked = bake(texture, surface, uv=uv, texture_size=wanted.size, progress=progress)
            write_model(baked, path)
        else:
            write_model(bake_vertices(texture, surface, subdivide="auto" if wanted.divide else None), path)


def _seldom(tell: Callable[[str, dict[str, Any]], None]) -> Progress:
    """Return a progress callback that reports each new stage at once, and otherwise at intervals."""
    last: tuple[str, float] = "", 0.0

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if stage != last[0] or now - last[1] >= _BEAT:
            last = stage, now
            tell("progress", {"stage": stage, "share": done / max(total, 1)})

    return progress
