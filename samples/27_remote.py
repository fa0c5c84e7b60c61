"""A texture on a server: the blocks that lookups need come over the wire, coarse levels first.

A server in this process, which counts what it sends, stands for https://… or s3://…
    python samples/27_remote.py [FOLDER]      writes FOLDER/droid.octex (default: out)
"""

import os
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import octex

DEPTH = int(os.environ.get("OCTEX_SAMPLE_DEPTH", "9"))
CONTENT, SENT = bytearray(), [0]


class Server(BaseHTTPRequestHandler):
    """Serves one file, and parts of it."""

    def do_GET(self) -> None:  # noqa: D102
        part = self.headers["Range"] or f"bytes=0-{len(CONTENT) - 1}"
        first, last = map(int, part.removeprefix("bytes=").split("-"))
        self.send_response(206 if self.headers["Range"] else 200)
        self.send_header("Content-Length", str(last + 1 - first))
        self.end_headers()
        if self.command == "GET":
            SENT[0] += self.wfile.write(CONTENT[first : last + 1])

    do_HEAD = do_GET  # noqa: N815
    log_message = lambda *_: None  # noqa: E731


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    surface = octex.load_surface(Path(__file__).parent / "droid.glb")
    octex.convert(surface, DEPTH).save(folder / "droid.octex")
    CONTENT[:] = (folder / "droid.octex").read_bytes()
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        texture = octex.open(f"http://127.0.0.1:{server.server_port}/droid.octex")
        for width in (texture.placement.size / 16, texture.placement.size / 64, None):
            texture.sample(surface.scatter(100), width=width)
            print(f"width {width}: {SENT[0]:,} of {len(CONTENT):,} bytes came")
        server.shutdown()


if __name__ == "__main__":
    main(Path(*sys.argv[1:2] or ["out"]))
