"""The page for this machine alone: a server on 127.0.0.1 that answers to whoever has its token."""

from __future__ import annotations

import base64
import copy
import hmac
import json
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, NamedTuple

from octex.editing.draft import joined_change
from octex.errors import OctexError, OutputError
from octex.viewer.changes import change_between, change_of, is_like, touched_by
from octex.viewer.export import MODULES, PAINTING, PAINTING_SHADERS, SHADERS, page_text
from octex.viewer.maps import maps_of
from octex.viewer.pack import Packed, Part, Prepared, packed_page, parts_of, prepared
from octex.viewer.streams import deflated

if TYPE_CHECKING:
    from pathlib import Path

    from octex.editing.draft import Change
    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture, TextureSet
    from octex.viewer.session import Session

_ADDRESS = "127.0.0.1"
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
_FILES = {"": "index.html", "style.css": "style.css"}
_FILES |= {name: name for name in [*MODULES, *PAINTING]}
_FILES |= {f"shaders/{name}": f"shaders/{name}" for name in [*SHADERS, *PAINTING_SHADERS]}
_PROOF = "/proof"
_COMMAND = "application/octet-stream"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
#: Seconds for a request to arrive, between signs of life to a page, and without any page until the end.
_PATIENCE, _BEAT, _ALONE = 10.0, 1.0, 30.0
#: By how much longer the first page is waited for: browsers may take long to start.
_FIRST = 20
#: Deflate's level for changes: they stay on this machine, and packing them takes longer than sending them.
_QUICK = 0
#: Changes that are kept for pages that do not have them yet, and bytes of all but the last; pages further
#: behind load all anew.
_MOST_CHANGES, _MOST_BYTES = 32, 32 << 20
#: The ports of which one is a path's: below those that systems lend to anybody.
_PORTS = range(20_000, 32_768)
#: Different refusals that are logged.
_MOST_REFUSALS = 1000


class _State(NamedTuple):
    """What is shown at a time, by its version; in memory, as files may be overwritten."""

    version: str
    parts: list[Part]
    prepared: list[Prepared]
    session: dict[str, Any] | None  # what is told of one
    before: OctreeTexture | None  # the session's texture at the time before
    changes: tuple[Change, ...]  # since then


class Viewer:
    """Serves a texture or a set, the mesh that it is of and how that moves, to pages of this machine.

    ``open_texture`` reads the texture: anew when ``path``, its file or folder, has changed, and after
    ``changed``. Pages are then sent the cells that differ: a session of painting is shown by
    ``Viewer(painter.texture, path, surface)`` and a call of ``changed`` after each stroke. ``log`` is called
    with a line for each refusal. ``session`` paints what pages send, from the texture that it shows.
    ``port`` 0 is any that is free. With a ``key`` (`key.user_key`) a viewer of
    the same path has the same address each time, unless its port is taken: pages of the one before go on.
    Raises OutputError if the given port is taken, and ArgumentError for a surface that is not the texture's.
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
        if session is not None:
            session.changed = self.changed
        self._lock = threading.RLock()
        self._own = secrets.token_hex(4)  # in versions: the next viewer may show another texture of this path
        self._calls = 0  # of ``changed``
        self._refused: set[str] = set()
        self._news = threading.Condition()
        self._state = self._read(self._stamp())
        is_alone = surface is not None and len(self._state.parts) == 1
        self._maps = maps_of(surface) if surface is not None and is_alone else None
        self._packed = "", Packed({}, {})
        self._changes: deque[tuple[str, Packed]] = deque(maxlen=_MOST_CHANGES)
        self.packed()
        self._pages, self._had_page = 0, False
        self._left = time.monotonic()
        self._ended = threading.Event()
        name = os.fsencode(path.resolve())
        secret = hmac.digest(key, name, "sha256") if key else secrets.token_bytes(32)
        self.token = base64.urlsafe_b64encode(secret[:16]).decode().rstrip("=")
        usual = _PORTS[int.from_bytes(secret[16:], "big") % len(_PORTS)]
        for candidate in [port] if port else [usual, 0] if key else [0]:  # the first that is free
            try:
                self._server = _Server((_ADDRESS, candidate), type("Handler", (_Handler,), {"viewer": self}))
                break
            except OSError as error:
                why = error
        else:
            raise OutputError(
                f"port {candidate} of {_ADDRESS}: {why.strerror or why}; choose another"
            ) from why
        self.port = self._server.server_address[1]

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{_ADDRESS}:{self.port}/{self.token}/"

    def proof(self, asked: str) -> str:
        """Return what only who has the token can say to a page that asks."""
        return hmac.digest(self.token.encode(), asked.encode(), "sha256").hex()

    def run(self, alone: float = _ALONE) -> None:
        """Serve until no page is there for some seconds, 20 times as long for the first, or SIGTERM."""
        thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        thread.start()
        self._left = time.monotonic()
        try:
            while self._pages or time.monotonic() - self._left < alone * (1 if self._had_page else _FIRST):
                time.sleep(0.1)
        finally:
            self._ended.set()
            self._server.shutdown()
            self._server.server_close()

    def refuse(self, line: str) -> None:
        """Log why a request is refused, once for those that are alike; of very many only the first."""
        if line not in self._refused and len(self._refused) < _MOST_REFUSALS:
            self._refused.add(line)
            self._log(f"refused: {line}")

    def changed(self) -> None:
        """Read the texture anew and send pages what has changed; may be called from any thread."""
        with self._lock:
            self._calls += 1
            if self.session is not None:
                self._now()  # its changes are from one call to the next
        with self._news:
            self._news.notify_all()

    def _is_after(self, calls: int) -> bool:
        return self._calls != calls

    def packed(self) -> Packed:
        """Return all that is shown: read anew if its file has changed and can be read."""
        with self._lock:
            state = self._now()
            if self._packed[0] != state.version:
                shown: dict[str, Any] = {"motion": self._motion, "maps": self._maps}
                paints = state.session is not None
                packed = packed_page(state.parts, title=self._path.name, paints=paints, **shown)
                packed.header.update(version=state.version, session=state.session)
                self._packed = state.version, packed
            return self._packed[1]

    def of_version(self, version: str) -> tuple[Packed, Packed]:
        """Return what there is of a version: all of it, and the change to the next one; else nothing."""
        none = Packed({}, {})
        with self._lock:
            change = next((change for since, change in self._changes if since == version), none)
            return (self._packed[1] if self._packed[0] == version else none), change

    def version(self) -> tuple[str, str]:
        """Return the version that is shown, and what is wrong with the file, if anything is."""
        try:
            with self._lock:
                return self._now().version, ""
        except OctexError as error:
            return self._state.version, str(error)

    def _now(self) -> _State:
        """Return what is shown; if that has changed, read it anew and keep what pages are sent of that."""
        stamp = self._stamp()
        if stamp != self._state.version:
            before, self._state = self._state, self._read(stamp)
            change = _change(before, self._state)
            if change is None:
                self._changes.clear()
            else:
                self._changes.append((before.version, change))
                while len(self._changes) > 1 and sum(map(_size_of, self._changes)) > _MOST_BYTES:
                    self._changes.popleft()
        return self._state

    def _read(self, stamp: str) -> _State:
        told: dict[str, Any] | None
        if self.session is not None:
            texture, told, before, changes = self.session.shown
            parts = parts_of(texture, self._surface)
        else:
            told, before, changes = None, None, ()
            parts = [
                part._replace(texture=copy.deepcopy(part.texture))
                for part in parts_of(self._open(), self._surface)
            ]
        return _State(stamp, parts, [prepared(part.texture) for part in parts], told, before, changes)

    def _stamp(self) -> str:
        if self.session is not None:
            return f"{self._calls}-{self._own}"
        try:
            paths = [self._path, *sorted(self._path.iterdir())] if self._path.is_dir() else [self._path]
            found = [path.stat() for path in paths]
            latest = max(status.st_mtime_ns for status in found)
            size = sum(status.st_size for status in found)
            return f"{self._calls}-{self._own}-{latest}-{size}"
        except OSError:
            return f"{self._calls}-{self._own}-gone"

    def follow(self, send: Callable[[str], None]) -> None:
        """Tell a page of changes until it is gone."""
        with self._lock:
            self._pages += 1
            self._had_page = True
        told = "", ""
        try:
            while not self._ended.is_set():
                calls, now = self._calls, self.version()
                if now != told:
                    name, text = ("changing", now[1]) if now[1] else ("version", now[0])
                    send(f"event: {name}\ndata: {' '.join(text.split())}\n\n")
                    told = now
                else:
                    send(": alive\n\n")
                with self._news:
                    self._news.wait_for(partial(self._is_after, calls), _BEAT)
        except OSError:
            pass
        finally:
            with self._lock:
                self._pages -= 1
                self._left = time.monotonic()


def _change(before: _State, after: _State) -> Packed | None:
    """Return what pages are sent of a change; None if they must load all anew."""
    if [part.name for part in before.parts] != [part.name for part in after.parts]:
        return None
    header: dict[str, Any] = {"version": after.version, "session": after.session, "parts": []}
    streams = {}
    for number, (was, now) in enumerate(zip(before.prepared, after.prepared, strict=True)):
        if not is_like(was.header, now.header):
            return None
        is_whole = now.texture is after.parts[number].texture and was.texture is after.before
        touched = touched_by(after.changes) if is_whole else None
        if is_whole and after.changes:
            change = joined_change(after.changes, was.texture, now.texture)
            counts, stream = change_of(change, was.texture, now.texture)
        else:
            counts, stream = change_between(was.texture, now.texture)
        streams[f"change-{number}"] = deflated(stream, _QUICK)
        own = {name: value for name, value in now.header.items() if name != "notes"}
        header["parts"].append({"header": own, "counts": counts, "touched": touched})
    return Packed(header, streams)


def _size_of(change: tuple[str, Packed]) -> int:
    return sum(map(len, change[1].streams.values()))


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # A port whose server has ended is free at once; elsewhere this would let two servers share it.
    allow_reuse_address = os.name == "posix"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Let a page go away in the middle of an answer."""


class _Handler(BaseHTTPRequestHandler):
    viewer: Viewer
    protocol_version = "HTTP/1.1"
    server_version = "octex"
    sys_version = ""
    timeout = _PATIENCE
    disable_nagle_algorithm = True  # else a body waits up to 40 ms until the page has confirmed its headers

    def log_message(self, format: str, *args: Any) -> None:
        """Log what http.server itself refuses, and requests of which no more comes; others need no line."""
        is_half = format.startswith("Request timed out") and bool(getattr(self, "raw_requestline", b""))
        if is_half or format.startswith("code "):
            self.viewer.refuse(_printable(format % args))

    def do_GET(self) -> None:
        """Answer with a file of the page, its data, the line of events, or a proof of the token."""
        path = self._admitted()
        if path is None:
            return
        if path == _PROOF:
            self._answer(self.viewer.proof(self.path.partition("?")[2]).encode(), "text/plain")
        elif path in _FILES:
            name = _FILES[path]
            self._answer(page_text(name).encode(), _TYPES.get(name.rpartition(".")[2], "text/plain"))
        elif path == "events":
            self._follow()
        elif path.startswith("data/"):
            self._data(path.removeprefix("data/"))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")

    def do_POST(self) -> None:
        """Take a command of a page that paints, and answer with its number."""
        session, length = self.viewer.session, self.headers.get("Content-Length", "")
        if session is None:
            self.send_error(HTTPStatus.NOT_IMPLEMENTED, "Unsupported method ('POST')")
            return
        from octex.viewer.commands import MOST_BYTES
        from octex.viewer.session import BusyError, OrderError

        path = self._admitted(has_body=True)
        if path is None:
            return
        if path != "session":
            self._refuse(HTTPStatus.NOT_FOUND, "commands are sent to session")
        elif self.headers.get("Content-Type") != _COMMAND:
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"a command is {_COMMAND}")
        elif not length.isdecimal() or len(length) > 12:
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "its length is missing")
        elif int(length) > MOST_BYTES:
            self._refuse(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"{int(length):,} bytes; at most {MOST_BYTES:,}"
            )
        else:
            body = self.rfile.read(int(length))
            if len(body) < int(length):
                self._refuse(HTTPStatus.BAD_REQUEST, f"{len(body):,} bytes of {int(length):,} have come")
                return
            try:
                self._json({"number": session.take(body)})
            except BusyError as error:
                self._refuse(HTTPStatus.TOO_MANY_REQUESTS, str(error))
            except OrderError as error:
                self._refuse(HTTPStatus.CONFLICT, str(error))
            except OutputError as error:
                self._refuse(HTTPStatus.INSUFFICIENT_STORAGE, str(error))
            except OctexError as error:
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))

    def _admitted(self, *, has_body: bool = False) -> str | None:
        """Return what a request asks for, below the token; refuse what comes from elsewhere.

        A page that has lost its server asks for a proof without the token: it may be another server by now.
        """
        token, slash, path = self.path.partition("?")[0].removeprefix("/").partition("/")
        own = {f"{_ADDRESS}:{self.viewer.port}", f"localhost:{self.viewer.port}"}
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        why, status = "", HTTPStatus.FORBIDDEN
        if host not in own:
            why = f"the host is {host!r}"
        elif origin is not None and origin.removeprefix("http://") not in own:
            why = f"the origin is {origin!r}"
        elif self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            why = "another site asks"
        elif "Transfer-Encoding" in self.headers or not (
            has_body or self.headers.get("Content-Length", "0") == "0"
        ):
            why, status = "it has a body", HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        elif self.path.startswith(f"{_PROOF}?"):
            return _PROOF
        elif not slash or not hmac.compare_digest(token.encode(), self.viewer.token.encode()):
            why = "the token is missing or wrong"
        if why:
            self._refuse(status, why)
        return None if why else path

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.viewer.refuse(_printable(f"{self.command} {self.path}: {why}"))
        self.close_connection = True
        self._answer(f"{why}\n".encode(), "text/plain", status)

    def _answer(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._begin(kind, status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
        self.raw_requestline = b""  # what is waited for next is another request, or none

    def _begin(self, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8" if kind.startswith("text/") else kind)
        for header, value in _HEADERS.items():
            self.send_header(header, value)
        if self.close_connection:
            self.send_header("Connection", "close")

    def _data(self, name: str) -> None:
        """Answer with the header, or of data/VERSION with streams or the change to the next version."""
        if name == "header":
            try:
                self._json(self.viewer.packed().header)
            except OctexError as error:
                self._answer(str(error).encode(), "text/plain", HTTPStatus.SERVICE_UNAVAILABLE)
            return
        version, _, name = name.partition("/")
        packed, change = self.viewer.of_version(version)
        streams = packed.streams | change.streams
        if name == "change" and change.header:
            self._json(change.header)
        elif name in streams:
            self._answer(streams[name], "application/octet-stream")
        elif version.partition("-")[0].isdigit() and (not packed.header or name == "change"):
            # The page then loads what is shown now.
            self._answer(b"that version is no longer there", "text/plain", HTTPStatus.GONE)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such data")

    def _json(self, header: dict[str, Any]) -> None:
        self._answer(json.dumps(header).encode(), "application/json")

    def _follow(self) -> None:
        self.close_connection = True
        self._begin("text/event-stream")
        self.end_headers()

        def send(text: str) -> None:
            self.wfile.write(text.encode())
            self.wfile.flush()

        self.viewer.follow(send)


def _printable(text: str) -> str:
    """Return text as one line of at most 200 characters without anything that a terminal obeys."""
    return "".join(each if each.isprintable() else "�" for each in text)[:200]
