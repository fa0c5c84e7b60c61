"""octex view: a texture in the browser; and what octree-convert writes as a page."""

from __future__ import annotations

import argparse
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.cli.addresses import TEXTURE_ENDING, TEXTURE_ENDINGS, file_here, texture_file
from octex.cli.arguments import port_number, whole_number
from octex.cli.common import Reporter, bytes_text, check_outputs, limited, run, say, tell
from octex.cli.models import kind_of, open_sound
from octex.cli.parser import RUNNING, Command, Parser, option, words_given
from octex.cli.shape_options import SHAPE_OPTIONS, SHAPE_WORDS, check_subdivision, shaped_model
from octex.errors import ArgumentError, ExitCode, OctexError

if TYPE_CHECKING:
    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture, TextureSet

PAGE_ENDING = ".html"
_DEFAULT_DEPTH = 9

VIEW = Command(
    "Show a texture in the browser, until you close the page or press Ctrl-C.",
    [
        option(
            "TEXTURE",
            "an .octex file, a folder of parts, or a model, which is converted first",
            type=texture_file,
        )
    ],
    [
        option(
            "--mesh",
            "the model of the texture; without it, the page shows the cells",
            metavar="MODEL",
            type=file_here,
        ),
        option("--part", "show only this part of a folder (default: all)", metavar="NAME"),
        option(
            "--rest",
            "the undeformed model, with the same vertices and triangles",
            metavar="MODEL",
            type=file_here,
        ),
        *SHAPE_OPTIONS,
        option(
            "--depth",
            f"number of levels, if a model is converted (default {_DEFAULT_DEPTH})",
            metavar="N",
            type=whole_number,
        ),
        option(
            "--port", "the server's port on 127.0.0.1 (default: any free one)", metavar="N", type=port_number
        ),
        option("--no-browser", "print the page's address, and do not open a browser", action="store_true"),
        *(each for each in RUNNING if each.word in ("--threads", "--quiet")),
    ],
    ["droid.octex --mesh droid.glb", "droid.glb --depth 10"],
)


def main(arguments: Sequence[str] | None, program: str) -> int:
    """Run octex view, and return its exit code (octex.errors.ExitCode)."""
    return run(program, lambda: _view(Parser(program, VIEW).parsed(arguments), program))


def _view(options: argparse.Namespace, program: str) -> int:
    is_set = options.TEXTURE.is_dir()
    is_texture = is_set or options.TEXTURE.suffix.lower() in TEXTURE_ENDINGS
    if options.part is not None and not is_set:
        raise ArgumentError(f"{options.TEXTURE}: is no folder of parts, so --part has no meaning")
    if is_texture and options.depth is not None:
        raise ArgumentError(f"{options.TEXTURE}: --depth is for models; the level is chosen in the page")
    if is_texture and options.mesh is None:
        for word in words_given(options):
            if word in SHAPE_WORDS | {"--rest"}:
                raise ArgumentError(f"{word} has no meaning without --mesh")
    check_subdivision(options)
    if not is_texture and options.mesh is not None:
        raise ArgumentError(f"{options.TEXTURE}: is no {TEXTURE_ENDING} file, so --mesh has no meaning")
    if not is_texture and kind_of(options.TEXTURE) != "model":
        raise ArgumentError(f"{options.TEXTURE}: has no surface; octex convert makes a texture of it")
    with limited(options.threads), Reporter(program, options.quiet) as progress:
        surface = motion = None
        if is_texture:
            if options.mesh is not None:
                with progress.stage("read"):
                    surface = shaped_model(options.mesh, options, normals=True)
                    motion = motion_of(options.mesh, options, progress.note)
            if is_set:
                motion = None  # its vertices are the whole model's
                if options.part is not None and surface is not None:
                    surface = _surface_of(options.TEXTURE, options.part, surface)

            def read() -> OctreeTexture | TextureSet:
                return _opened(options.TEXTURE, options.part) if is_set else open_sound(options.TEXTURE)
        else:
            with progress.stage("read"):
                surface = shaped_model(options.TEXTURE, options)
                motion = motion_of(options.TEXTURE, options, progress.note)
            depth = _DEFAULT_DEPTH if options.depth is None else options.depth
            texture = octex.convert(surface, depth=depth, progress=progress)

            def read() -> OctreeTexture | TextureSet:
                return texture

        from octex.viewer import Viewer

        port = options.port or 0
        viewer = Viewer(read, options.TEXTURE, surface, motion=motion, port=port, log=progress.note)
    say(viewer.url)
    if not options.no_browser:
        webbrowser.open(viewer.url)
    with suppress(KeyboardInterrupt):
        viewer.run()
    return ExitCode.DONE


def _opened(folder: Path, part: str | None = None) -> OctreeTexture | TextureSet:
    """Open a set, or one part of it, whose content is proved."""
    textures = octex.TextureSet.open(folder)
    found = textures if part is None else textures[textures.names[_number_of(textures, folder, part)]]
    found.validate()
    return found


def _number_of(textures: TextureSet, folder: Path, part: str) -> int:
    from octex.checks import as_choice

    return textures.names.index(as_choice(part, textures.names, f"part of {folder}:"))


def _surface_of(folder: Path, part: str, surface: Surface) -> Surface:
    """Return the triangles of a part of a set."""
    number = _number_of(octex.TextureSet.open(folder), folder, part)
    if number > surface.parts.max():
        raise ArgumentError(f"{surface.name} has {surface.parts.max() + 1} parts, and {folder} others")
    return surface.part((surface.parts == number).nonzero()[0])


def write_mesh_page(options: argparse.Namespace, program: str) -> int:
    """Write the page of a texture on its model, as octree-convert --mesh asks for it."""
    began = time.perf_counter()
    is_set = options.INPUT.is_dir()
    if not is_set and options.INPUT.suffix.lower() not in TEXTURE_ENDINGS:
        raise ArgumentError(f"{options.INPUT}: is no {TEXTURE_ENDING} file; leave --mesh out for a model")
    if options.channels is not None:
        raise ArgumentError(f"--channels has no meaning for {options.OUTPUT}: edit the texture first")
    inputs = options.INPUT, options.mesh, options.rest
    check_outputs([(options.OUTPUT, (PAGE_ENDING,), "OUTPUT")], inputs, force=options.force)
    with limited(options.threads), Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            textures = _opened(options.INPUT) if is_set else open_sound(options.INPUT)
            surface = shaped_model(options.mesh, options, normals=True)
        notes = write_page(textures, surface, options, progress, options.mesh)
    made = {
        "output": str(options.OUTPUT),
        "bytes": options.OUTPUT.stat().st_size,
        "notes": notes,
        "seconds": round(time.perf_counter() - began, 3),
    }
    size = bytes_text(options.OUTPUT.stat().st_size)
    tell(options, made, f"{options.OUTPUT}: {size}, {made['seconds']:.1f} s", *notes)
    return ExitCode.DONE


def write_page(
    textures: OctreeTexture | TextureSet,
    surface: Surface | None,
    options: argparse.Namespace,
    progress: Reporter,
    model: Path | None = None,
) -> list[str]:
    """Write OUTPUT as a page; return what it shows otherwise than the textures have it.

    ``model`` is the surface's file, by default INPUT. What moves of a set's model stands still.
    """
    from octex.viewer import write_page

    notes: list[str] = []
    motion = None
    if surface is not None and not options.INPUT.is_dir():
        motion = motion_of(model or options.INPUT, options, notes.append)
    title = options.INPUT.name
    return notes + write_page(
        textures,
        options.OUTPUT,
        surface,
        motion=motion,
        title=title,
        max_size=options.max_size,
        progress=progress,
    )


def motion_of(path: Path, options: argparse.Namespace, tell: Callable[[str], None]) -> Motion | None:
    """Return how a model moves, if the page can show that; else tell why not, if it does move."""
    from octex.source.load import load_motion

    if getattr(options, "also", None):
        return None
    try:
        motion = load_motion(path)
    except OctexError as error:
        tell(f"no animations: {error}")
        return None
    if motion is not None and options.subdiv_levels is not None:
        tell("no animations: they do not move subdivided models")
        return None
    return motion


def check_page_options(options: argparse.Namespace) -> None:
    """Refuse what is for pages alone where none is written."""
    is_page = options.OUTPUT is not None and options.OUTPUT.suffix.lower() == PAGE_ENDING
    if not is_page and "--max-size" in words_given(options):
        raise ArgumentError(f"--max-size is for pages, NAME{PAGE_ENDING}")
