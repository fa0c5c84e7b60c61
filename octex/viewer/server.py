"""Serves the page to this machine only: on 127.0.0.1, to requests with the secret token."""

from __future__ import annotations

import base64
import copy
import hmac
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from octex.editing.draft import joined_change
from octex.errors import OctexError, OutputError
from octex.formats.streams import deflated
from octex.formats.web import Prepared, prepared
from octex.viewer.answers import ADDRESS, Handler, Server
from octex.viewer.changes import change_between, change_of, is_like, touched_by, with_new_channels
from octex.viewer.maps import maps_of
from octex.viewer.pack import Packed, PagePart, packed_page, parts_of

if TYPE_CHECKING:
    from pathlib import Path

    from octex.editing.draft import Change
    from octex.session.painting import Session
    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture, TextureSet
    from octex.viewer.downloads import Downloads

#: Seconds between heartbeats, and seconds without any page until the server ends.
_BEAT, _ALONE = 1.0, 30.0
#: Factor of that time for the first page: browsers may start slowly.
_FIRST = 20
#: Deflate's level for changes: packing takes longer than sending on one machine.
_QUICK = 0
#: Deflate's level for new channels, which mostly hold one value.
_SMALL = 1
#: Limits on stored changes: their number, and bytes of all but the last. Pages that are further behind load
#: everything again.
_MOST_CHANGES, _MOST_BYTES = 32, 32 << 20
#: Ports for fixed addresses: below the range that systems assign to programs.
_PORTS = range(20_000, 32_768)
#: Largest number of different refusals in the log.
_MOST_REFUSALS = 1000


class _State(NamedTuple):
    """A version of the content; in memory, since files may be overwritten."""

    version: str
    parts: list[PagePart]
    prepared: list[Prepared]
    session: dict[str, Any] | None  # the session's status
    before: OctreeTexture | None  # the session's texture in the version before
    changes: tuple[Change, ...]  # since that version


class Viewer:
    """Serves a texture or a set, its mesh and motion, to pages on this machine.

    ``open_texture`` reads the texture, again whenever ``path``, its file or folder, has changed, and after
    ``changed``. Pages then get the cells that differ. To show a session of painting, make
    ``Viewer(painter.texture, path, surface)`` and call ``changed`` after each stroke. It calls ``log`` with a
    line for each refusal. ``session`` paints the commands of pages, on the texture shown. ``port`` 0 is any
    free port. With a ``key`` (`key.user_key`) a viewer of the same path has the same address each time,
    unless its port is taken: pages of the earlier viewer then reconnect. Raises OutputError if ``port`` is
    taken, and ArgumentError for a surface that is not the texture's.
    """

    def __init__(
        self,
        open_texture: Callable[[], OctreeTexture | TextureSet],
        path: Path,
        surface: Surface | None,
        *,
        motion: Motion | None = None,
        session: Session | None = None,
        port: int = 0,
        key: bytes = b"",
        log: Callable[[str], None] = print,
    ) -> None:
        self._open, self._path, self._surface, self._log = open_texture, path, surface, log
        self._motion, self.session = motion, session
        self.downloads: Downloads | None = None
        if session is not None:
            from octex.viewer.downloads import Downloads

            assert surface is not None
            session.changed = self.changed
            self.downloads = Downloads(session, surface, motion, path.name)
        self._lock = threading.RLock()
        self._run_id = secrets.token_hex(4)  # in versions: the next viewer may have another texture
        self._calls = 0  # number of calls of ``changed``
        self._refused: set[str] = set()
        self._on_change = threading.Condition()
        self._state = self._read(self._stamp())
        is_single = len(self._state.parts) == 1
        self._maps = maps_of(surface) if surface is not None and is_single else None
        self._packed = "", Packed({}, {})
        self._changes: deque[tuple[str, Packed]] = deque(maxlen=_MOST_CHANGES)
        self.packed()
        self._pages, self._had_page = 0, False
        self._closed_at = time.monotonic()
        self._ended = threading.Event()
        name = os.fsencode(path.resolve())
        secret = hmac.digest(key, name, "sha256") if key else secrets.token_bytes(32)
        self.token = base64.urlsafe_b64encode(secret[:16]).decode().rstrip("=")
        usual = _PORTS[int.from_bytes(secret[16:], "big") % len(_PORTS)]
        for candidate in [port] if port else [usual, 0] if key else [0]:  # the first free one
            try:
                self._server = Server((ADDRESS, candidate), type("Handler", (Handler,), {"viewer": self}))
                break
            except OSError as error:
                why = error
        else:
            raise OutputError(
                f"port {candidate} of {ADDRESS}: {why.strerror or why}; choose another"
            ) from why
        self.port = self._server.server_address[1]

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{ADDRESS}:{self.port}/{self.token}/"

    def proof(self, asked: str) -> str:
        """Return the answer to a page's challenge, which only the holder of the token can compute."""
        return hmac.digest(self.token.encode(), asked.encode(), "sha256").hex()

    def run(self, alone: float = _ALONE) -> None:
        """Serve until SIGTERM, or until no page is open for ``alone`` seconds (20 times that at first)."""
        thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        thread.start()
        self._closed_at = time.monotonic()
        try:
            while self._pages or time.monotonic() < self._closed_at + alone * (
                1 if self._had_page else _FIRST
            ):
                time.sleep(0.1)
        finally:
            self._ended.set()
            self._server.shutdown()
            self._server.server_close()
            if self.downloads is not None:
                self.downloads.close()

    def refuse(self, line: str) -> None:
        """Log the reason of a refusal, equal ones only once, and a limited number."""
        if line not in self._refused and len(self._refused) < _MOST_REFUSALS:
            self._refused.add(line)
            self._log(f"refused: {line}")

    def changed(self) -> None:
        """Read the texture again and send pages the changes; may be called from any thread."""
        with self._lock:
            self._calls += 1
            if self.session is not None:
                self._current()  # computes the changes since the last call
        with self._on_change:
            self._on_change.notify_all()

    def _is_after(self, calls: int) -> bool:
        return self._calls != calls

    def packed(self) -> Packed:
        """Return the packed content: read again if its file has changed and is readable."""
        with self._lock:
            state = self._current()
            if self._packed[0] != state.version:
                shown: dict[str, Any] = {"motion": self._motion, "maps": self._maps}
                paints = state.session is not None
                packed = packed_page(state.parts, title=self._path.name, paints=paints, **shown)
                packed.header.update(version=state.version, session=state.session)
                self._packed = state.version, packed
            return self._packed[1]

    def of_version(self, version: str) -> tuple[Packed, Packed]:
        """Return a version's content, and its change to the next version; empty if not stored."""
        none = Packed({}, {})
        with self._lock:
            change = next((change for since, change in self._changes if since == version), none)
            return (self._packed[1] if self._packed[0] == version else none), change

    def version(self) -> tuple[str, str]:
        """Return the current version, and the error of reading the file, if any."""
        try:
            with self._lock:
                version = self._current().version
            if self.session is not None:
                self.session.look()
            return version, ""
        except OctexError as error:
            return self._state.version, str(error)

    def _current(self) -> _State:
        """Return the current state; after a change, first read the texture and pack its changes for pages."""
        stamp = self._stamp()
        if stamp != self._state.version:
            before, self._state = self._state, self._read(stamp)
            change = _change(before, self._state)
            if change is None:
                self._changes.clear()
            else:
                self._changes.append((before.version, change))
                sizes = [sum(map(len, each.streams.values())) for _, each in self._changes]
                while len(sizes) > 1 and sum(sizes) > _MOST_BYTES:
                    self._changes.popleft()
                    del sizes[0]
        return self._state

    def _read(self, stamp: str) -> _State:
        status: dict[str, Any] | None
        if self.session is not None:
            texture, status, before, changes, _ = self.session.shown
            parts = parts_of(texture, self._surface)
        else:
            status, before, changes = None, None, ()
            parts = [
                part._replace(texture=copy.deepcopy(part.texture))
                for part in parts_of(self._open(), self._surface)
            ]
        return _State(stamp, parts, [prepared(part.texture) for part in parts], status, before, changes)

    def _stamp(self) -> str:
        file = "" if self.session is not None else self._file_stamp()
        return f"{self._calls}-{self._run_id}{file}"

    def _file_stamp(self) -> str:
        """Return a fingerprint that changes with the file or folder."""
        try:
            paths = [self._path, *sorted(self._path.iterdir())] if self._path.is_dir() else [self._path]
            stats = [path.stat() for path in paths]
            latest = max(status.st_mtime_ns for status in stats)
            size = sum(status.st_size for status in stats)
            return f"-{latest}-{size}"
        except OSError:
            return "-gone"

    def follow(self, send: Callable[[str], None]) -> None:
        """Send a page all changes until it closes."""
        with self._lock:
            self._pages += 1
            self._had_page = True
        sent = "", ""
        try:
            while not self._ended.is_set():
                calls, now = self._calls, self.version()
                if now != sent:
                    send(f"event: version\ndata: {now[0]}\n\n")
                    if now[1]:
                        send(f"event: changing\ndata: {' '.join(now[1].split())}\n\n")
                    sent = now
                else:
                    send(": alive\n\n")
                with self._on_change:
                    self._on_change.wait_for(partial(self._is_after, calls), _BEAT)
        except OSError:
            pass
        finally:
            with self._lock:
                self._pages -= 1
                self._closed_at = time.monotonic()


def _change(before: _State, after: _State) -> Packed | None:
    """Return the packed change between two states; None if pages must load everything again."""
    if [part.name for part in before.parts] != [part.name for part in after.parts]:
        return None
    header: dict[str, Any] = {"version": after.version, "session": after.session, "parts": []}
    streams = {}
    for number, (was, now) in enumerate(zip(before.prepared, after.prepared, strict=True)):
        old_texture, is_other = was.texture, not is_like(was.header, now.header)
        if is_other:
            like, added = with_new_channels(was.texture, now.texture)
            if like is None:
                return None
            old_texture = like
            streams[f"added-{number}"] = deflated(added, _SMALL)
        is_whole = now.texture is after.parts[number].texture and was.texture is after.before
        touched = touched_by(after.changes) if is_whole else None
        if is_whole and after.changes and not is_other:
            change = joined_change(after.changes, was.texture, now.texture)
            counts, stream = change_of(change, was.texture, now.texture)
        else:
            counts, stream = change_between(old_texture, now.texture)
        streams[f"change-{number}"] = deflated(stream, _QUICK)
        fields = {name: value for name, value in now.header.items() if name != "notes"}
        entries = {"header": fields, "counts": counts, "touched": touched, "hasNewChannels": is_other}
        header["parts"].append(entries)
    return Packed(header, streams)
