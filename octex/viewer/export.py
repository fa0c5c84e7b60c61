"""Writes one file: an HTML page with its modules and data, or a web file for three.js."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from importlib.resources import files
from typing import TYPE_CHECKING

from octex.errors import ArgumentError
from octex.files import bytes_text, replacing
from octex.formats.streams import deflated
from octex.formats.web import web_file
from octex.parallel import Progress, silent
from octex.viewer.maps import maps_of
from octex.viewer.pack import Packed, packed_page, parts_of

if TYPE_CHECKING:
    from pathlib import Path

    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture, TextureSet

#: Modules of all pages, each after those that it imports; files contain no others.
_NAMES = """
elements reload octree data change mesh motion camera controls legend connection source part walk programs gpu
player divider pick frames viewer
"""
MODULES = [f"{name}.js" for name in _NAMES.split()]
_PAGE = files(__name__.rpartition(".")[0]) / "page"
_SHADERS = sorted(path.name for path in (_PAGE / "shaders").iterdir())
_PAINTING_SHADERS = "stroke.frag", "dabs.frag", "retouch.frag", "outline.frag"
#: All files of the page.
FILES = [path.name for path in _PAGE.iterdir() if path.is_file()] + [f"shaders/{name}" for name in _SHADERS]
#: The ending of web files.
WEB_ENDING = ".octw"
#: Deflate's level for files, which are packed once.
_SMALLEST = 9
#: The share of a page's size for animations, and for images, before base64.
_SHARE = 0.25 * 3 / 4
#: Where nothing more can be left out, the error names the page's size times this, which rounding needs.
_ROOMY = 1.02


def page_text(name: str) -> str:
    """Return the text of one of the page's files."""
    return (_PAGE / name).read_text("utf-8")


def write_page(
    textures: OctreeTexture | TextureSet,
    path: Path,
    surface: Surface | None = None,
    *,
    motion: Motion | None = None,
    title: str = "octex",
    max_size: int | None = None,
    progress: Progress = silent,
) -> list[str]:
    """Write a page of a texture on its surface, or of a set on its model; without a surface, of the cells.

    A ``path`` that ends in .octw gets a web file instead, for three.js: without motion and source images.
    ``motion`` animates the surface. ``max_size``, in bytes, leaves out the finest levels until the file fits;
    animations take at most a quarter of it, and source images too. If it does not fit without any level, it
    gets no images, and then no animations. Returns notes on how the page differs from the textures.
    Raises ArgumentError if it does not fit then either, for a surface that is not the textures', and for sets
    of more than 255 parts; OutputError if the file cannot be written.
    """
    parts = parts_of(textures, surface)
    level = deepest = max(part.texture.tree.max_depth for part in parts)
    room = None if max_size is None else int(_SHARE * max_size)
    is_page = path.suffix.lower() != WEB_ENDING
    maps = None
    if is_page and surface is not None and len(parts) == 1:
        maps = maps_of(surface, small=True, room=room)
    motion = motion if is_page else None
    progress("pack", 0, 1)
    left_out: list[str] = []
    while True:
        cut = [
            part._replace(texture=part.texture.level(min(level, part.texture.tree.max_depth)))
            for part in parts
        ]
        packed = packed_page(cut, title=title, motion=motion, maps=maps, level=_SMALLEST, room=room)
        if level < deepest:
            note = f"depth {level} of {deepest}, to fit {max_size:,} bytes"
            packed.header["parts"][0]["notes"].insert(0, note)
        packed.header["parts"][0]["notes"] += left_out
        if is_page:
            page = _inlined(packed).encode()
        else:
            streams = {name: stream for name, stream in packed.streams.items() if name != "studio"}
            page = web_file(packed.header["title"], packed.header["parts"], streams)
        if max_size is None or len(page) <= max_size:
            break
        level = _level_within(packed, len(page) - max_size)
        if level >= 0:
            continue
        level = deepest
        if maps is not None:
            maps, left_out = None, ["source: no images, for the page to fit"]
        elif motion is not None and room:
            room = 0
        else:
            raise ArgumentError(
                f"the page takes {bytes_text(len(page))} even without any level; allow "
                f"{bytes_text(int(_ROOMY * len(page)))}"
            )
    with replacing(path) as file:
        file.write(page)
    progress("pack", 1, 1)
    return packed.notes


def _level_within(packed: Packed, excess: int) -> int:
    """Return the deepest level without whose finer levels ``excess`` bytes may be saved; −1 for none."""
    headers = packed.header["parts"]
    level = deepest = max(int(header["depth"]) for header in headers)
    # Rows that are shared by all levels do not count: few of them may remain.
    chunks = [chunk for header in headers for chunk in header["chunks"] if chunk["levels"] is not None]
    for chunk in sorted(chunks, key=lambda chunk: -chunk["levels"][0]):
        if excess <= 0:
            break
        first = chunk["levels"][0]
        level = min(level, first - 1 if first else level - 1)
        excess -= chunk["bytes"] * 4 // 3  # base64
    return min(level, deepest - 1)


def _inlined(packed: Packed) -> str:
    """Return the page with everything inlined, and a policy that forbids loading."""
    # Modules without imports and exports share one scope.
    modules = "".join(_bare(page_text(name)) for name in MODULES)
    script = re.sub(r"^(?:import .*\n|export )", "", modules, flags=re.MULTILINE)
    style = page_text("style.css")
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        "img-src blob: data:; base-uri 'none'; form-action 'none'"
    )
    names = [name for name in _SHADERS if name not in _PAINTING_SHADERS]
    shaders = json.dumps({name: _bare(page_text(f"shaders/{name}")) for name in names})
    streams = {"shaders": deflated(shaders.encode(), _SMALLEST), **packed.streams}
    data = {"header": json.dumps(packed.header).replace("<", "\\u003c")}
    data |= {name: base64.b64encode(stream).decode() for name, stream in streams.items()}
    blocks = [f'<script type="text/plain" id="data-{name}">{text}</script>' for name, text in data.items()]
    html = page_text("index.html")
    html = html.replace(
        "<title>", f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<title>', 1
    )
    html = html.replace('<link rel="stylesheet" href="style.css">', f"<style>{style}</style>")
    program = "\n".join([*blocks, f'<script type="module">{script}</script>'])
    return html.replace('<script type="module" src="viewer.js"></script>', program)


def _bare(text: str) -> str:
    """Return code without indentation, empty lines and comment lines."""
    return re.sub(r"^[ \t]*(?://.*)?\n|^[ \t]+", "", text, flags=re.MULTILINE)


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
