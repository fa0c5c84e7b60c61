"""Admits or refuses requests of pages, and answers them."""

from __future__ import annotations

import hmac
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

from octex.checks import as_whole
from octex.errors import OctexError, OutputError
from octex.formats.streams import deflated
from octex.painting.composites import composite_after
from octex.viewer.export import FILES, page_text
from octex.viewer.mesh import packed_mesh
from octex.viewer.pack import pack

if TYPE_CHECKING:
    from pathlib import Path

    from octex.session.painting import Session
    from octex.viewer.downloads import Downloads
    from octex.viewer.server import Viewer

ADDRESS = "127.0.0.1"
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
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
#: Seconds for a request to arrive.
_PATIENCE = 10.0
#: Longest pause of a browser during a download, in seconds, and bytes sent at once.
_PAUSE, _PIECE = 600.0, 1 << 20


#: Deflate's level: the data stays on this machine.
_QUICK = 1


def packed_patch(session: Session, asked: str) -> bytes:
    """Return an unwrapped patch of the surface: a line of JSON, and the mesh's stream.

    ``asked`` is JSON with the fields of a stroke. Raises ArgumentError and ModelError.
    """
    patch = session.patch(asked)
    texture = session.shown.texture
    header, stream = packed_mesh(texture, patch.surface.placed_in(texture).part(patch.triangles))
    line = json.dumps({"mesh": header, "faults": patch.faults}).encode()
    return line + b"\n" + deflated(stream, _QUICK)


def packed_composite(session: Session, asked: str) -> bytes:
    """Return the composite that full strokes in a layer lead to: a line of JSON, and streams.

    ``asked`` is JSON with the layer and the kind of stroke (see `octex.painting.composites`). Raises
    ArgumentError for anything else.
    """
    from octex.session.commands import object_of

    fields = object_of(asked, "a request for a composite")
    layer = fields.get("layer")
    number = None if layer is None else as_whole(layer, "layer", 1, 2**53)
    texture = composite_after(session.shown.stacked, number, fields.get("stroke"))  # type: ignore[arg-type]
    if texture is None:
        return b"null\n"
    header, streams = pack(texture, None, level=_QUICK)
    return b"\n".join([json.dumps(header).encode(), b"".join(streams.values())])


#: Answers of a session, by the path of a request.
_ANSWERS = {"patch": packed_patch, "composite": packed_composite}


class Server(ThreadingHTTPServer):
    """Answers each request on a thread of its own."""

    daemon_threads = True
    request_queue_size = 128  # largest number of connections that wait for acceptance
    # On POSIX this frees the port of a closed server at once. On Windows it would let two servers share the
    # port.
    allow_reuse_address = os.name == "posix"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of a page that closes during an answer."""


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of a viewer's pages."""

    viewer: Viewer
    protocol_version = "HTTP/1.1"
    server_version = "octex"
    sys_version = ""
    timeout = _PATIENCE
    disable_nagle_algorithm = True  # else a body waits up to 40 ms for the page to acknowledge its headers

    def log_message(self, format: str, *args: Any) -> None:
        """Log only refusals by http.server itself and incomplete requests."""
        is_half = format.startswith("Request timed out") and bool(getattr(self, "raw_requestline", b""))
        if is_half or format.startswith("code "):
            self.viewer.refuse(_printable(format % args))

    def do_GET(self) -> None:
        """Answer with a file of the page, its data, the event stream, or a proof of the token."""
        path = self._admitted()
        if path is None:
            return
        if path == _PROOF:
            self._answer(self.viewer.proof(self.path.partition("?")[2]).encode(), "text/plain")
        elif (name := path or "index.html") in FILES:
            self._answer(page_text(name).encode(), _TYPES.get(name.rpartition(".")[2], "text/plain"))
        elif path == "events":
            self.viewer.follow(self._events())
        elif path.startswith("data/"):
            self._data(path.removeprefix("data/"))
        elif path in _ANSWERS and self.viewer.session is not None:
            self._answer_session(_ANSWERS[path], self.viewer.session)
        elif path == "export" and self.viewer.downloads is not None:
            self._export(self.viewer.downloads)
        elif path.startswith("export/") and self.viewer.downloads is not None:
            self._download(self.viewer.downloads.file(path.removeprefix("export/")))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")

    def do_POST(self) -> None:
        """Take a command of a painting page, and answer with its number."""
        session, length = self.viewer.session, self.headers.get("Content-Length", "")
        if session is None:
            self.send_error(HTTPStatus.NOT_IMPLEMENTED, "Unsupported method ('POST')")
            return
        from octex.session.commands import MOST_BYTES
        from octex.session.painting import BusyError, OrderError

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
                self._refuse(HTTPStatus.BAD_REQUEST, f"{len(body):,} bytes of {int(length):,} arrived")
                return
            statuses: dict[type[OctexError], HTTPStatus] = {
                BusyError: HTTPStatus.TOO_MANY_REQUESTS,
                OrderError: HTTPStatus.CONFLICT,
                OutputError: HTTPStatus.INSUFFICIENT_STORAGE,
            }
            try:
                self._json({"number": session.take(body)})
            except OctexError as error:
                self._refuse(statuses.get(type(error), HTTPStatus.BAD_REQUEST), str(error))

    def _admitted(self, *, has_body: bool = False) -> str | None:
        """Return the path of a request below the token; refuse requests from elsewhere.

        A page that lost its server asks for a proof without the token, since another server may answer now.
        """
        token, slash, path = self.path.partition("?")[0].removeprefix("/").partition("/")
        hosts = {f"{ADDRESS}:{self.viewer.port}", f"localhost:{self.viewer.port}"}
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        why, status = "", HTTPStatus.FORBIDDEN
        if host not in hosts:
            why = f"the host is {host!r}"
        elif origin is not None and origin.removeprefix("http://") not in hosts:
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
        self.raw_requestline = b""  # the connection then waits for the next request

    def _begin(self, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8" if kind.startswith("text/") else kind)
        for header, value in _HEADERS.items():
            self.send_header(header, value)
        if self.close_connection:
            self.send_header("Connection", "close")

    def _data(self, name: str) -> None:
        """Answer with the header, or with streams or changes of data/VERSION."""
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
            # The page then loads the current version.
            self._answer(b"that version is no longer there", "text/plain", HTTPStatus.GONE)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such data")

    def _json(self, header: dict[str, Any]) -> None:
        self._answer(json.dumps(header).encode(), "application/json")

    def _events(self) -> Callable[[str], None]:
        """Begin an event stream; return the function that sends an event."""
        self.close_connection = True
        self._begin("text/event-stream")
        self.end_headers()

        def send(text: str) -> None:
            self.wfile.write(text.encode())
            self.wfile.flush()

        return send

    def _answer_session(self, make: Callable[[Session, str], bytes], session: Session) -> None:
        """Answer a question of a page: with a line of JSON, and streams."""
        try:
            body = make(session, unquote(self.path.partition("?")[2]))
        except OctexError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._answer(body, "application/octet-stream")

    def _export(self, downloads: Downloads) -> None:
        """Make a file for a page and report progress; a closed page stops the work."""
        send = self._events()

        def tell(name: str, message: dict[str, Any]) -> None:
            try:
                send(f"event: {name}\ndata: {json.dumps(message)}\n\n")
            except OSError:
                raise _GoneError from None

        with suppress(_GoneError):
            downloads.make(self.path.partition("?")[2], tell)

    def _download(self, path: Path | None) -> None:
        """Answer with a file to download, in pieces."""
        try:
            if path is None:
                raise FileNotFoundError
            file = path.open("rb")
        except OSError:
            self._refuse(HTTPStatus.NOT_FOUND, "that file is no longer there; export it again")
            return
        with file, suppress(OSError):
            self.close_connection = True
            self.connection.settimeout(_PAUSE)
            self._begin("application/octet-stream")
            self.send_header("Content-Length", str(os.fstat(file.fileno()).st_size))
            self.send_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(path.name)}")
            self.end_headers()
            shutil.copyfileobj(file, self.wfile, _PIECE)


class _GoneError(Exception):
    """The page that waits for a file has closed."""


def _printable(text: str) -> str:
    """Return text as one printable line of at most 200 characters, without terminal escapes."""
    return "".join(each if each.isprintable() else "�" for each in text)[:200]
