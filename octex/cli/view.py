"""octex view: shows a texture in the browser, or writes a page that opens offline."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import octex
from octex.cli.common import Reporter, check_outputs, report_file, say
from octex.cli.inputs import kind_of, open_texture, refuse, shaped_model
from octex.cli.parser import Options
from octex.cli.values import PAGE_ENDING, TEXTURE_ENDINGS, WEB_ENDING
from octex.errors import ArgumentError, ExitCode, OctexError

if TYPE_CHECKING:
    from octex.session.painting import Session
    from octex.source.motion import Motion
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture, TextureSet

_DEPTH = 9


def view(options: Options, program: str) -> int:
    """Run octex view."""
    path, model, page = options.TEXTURE, options.MODEL, options.PAGE
    is_set = path is not None and path.is_dir()
    _check(options, is_set)
    notes: list[str] = []
    with Reporter(program, options.quiet) as progress:
        note = progress.note if page is None else notes.append
        surface = motion = None
        if model is not None:
            with progress.stage("read"):
                surface = shaped_model(model, options, normals=path is not None)
                if not is_set:  # a set has the vertices of the whole model
                    motion = _motion_of(model, options, note)
        if surface is not None and options.part is not None:
            number = _set_of(options).names.index(options.part)
            if number > surface.parts.max():
                raise ArgumentError(
                    f"{surface.name} has {surface.parts.max() + 1} parts, but {path} has others"
                )
            surface = surface.part((surface.parts == number).nonzero()[0])
        read = _reader(options, surface, progress)
        if page is None:
            from octex.viewer import Viewer
            from octex.viewer.key import user_key

            session = None if options.paint is None else _session(options, read(), surface, motion, progress)
            try:
                viewer = Viewer(
                    read,
                    path or model,
                    surface,
                    motion=motion,
                    session=session,
                    port=options.port,
                    key=user_key(),
                    log=progress.note,
                )
            except OctexError:
                if session is not None:
                    session.close()
                raise
        else:
            from octex.viewer import write_page

            title, size = (path or model).name, options.max_size
            notes += write_page(
                read(), page, surface, motion=motion, title=title, max_size=size, progress=progress
            )
    if page is None:
        say(viewer.url)
        if not options.no_browser:
            webbrowser.open(viewer.url)
        with suppress(KeyboardInterrupt):
            viewer.run()
        if viewer.session is not None and (unsaved := viewer.session.close()):
            say(unsaved)
        return ExitCode.DONE
    return report_file(options, "", {"notes": notes}, *notes, path=page)


def _session(
    options: Options,
    texture: OctreeTexture | TextureSet,
    surface: Surface | None,
    motion: Motion | None,
    progress: Reporter,
) -> Session:
    from octex.painting.stack import settled
    from octex.session.painting import Session

    assert surface is not None and not isinstance(texture, octex.TextureSet)
    try:
        if options.keep is not None:
            texture = settled(texture, options.keep)
        opened, recover = options.TEXTURE, options.recover
        session = Session(texture, surface, options.paint, motion=motion, opened=opened, recover=recover)
    except ArgumentError as error:
        raise ArgumentError(f"{options.TEXTURE or options.MODEL}: {error}") from None
    if session.repeated:
        commands = "command is" if session.repeated == 1 else "commands are"
        progress.note(f"{session.repeated} {commands} painted again; Ctrl-S in the page saves")
    return session


def _reader(
    options: Options, surface: Surface | None, progress: Reporter
) -> Callable[[], OctreeTexture | TextureSet]:
    """Return a function that reads the texture, or that converts the model once and returns its texture."""
    path = options.TEXTURE
    if path is None:
        assert surface is not None
        depth = _DEPTH if options.depth is None else options.depth
        texture = octex.convert(surface, depth=depth, progress=progress)
        return lambda: texture

    def opened() -> OctreeTexture | TextureSet:
        if not path.is_dir():
            return open_texture(path)
        textures = _set_of(options)
        chosen = textures if options.part is None else textures[options.part]
        chosen.validate()
        return chosen

    return opened


def _set_of(options: Options) -> TextureSet:
    """Open a folder of parts; refuse a --part that it lacks."""
    from octex.checks import as_choice

    textures = octex.TextureSet.open(options.TEXTURE)
    if options.part is not None:
        as_choice(options.part, textures.names, f"part of {options.TEXTURE}:")
    return textures


def _check(options: Options, is_set: bool) -> None:
    path, model, page = options.TEXTURE, options.MODEL, options.PAGE
    if path is None and model is None:
        if page is not None and page.exists():
            raise ArgumentError(f"{page}: is a page already; open it in a browser")
        raise ArgumentError("TEXTURE is missing; see octex view --help")
    if path is None and kind_of(model) == "cloud":
        raise ArgumentError(f"{model}: has no surface; convert it with octex convert first")
    if not is_set:
        refuse(options, ["--part"], f"needs a folder of parts; {path or model} is not one")
    if path is not None:
        refuse(options, ["--depth"], f"is for models; choose the level of {path} in the page")
    if options.paint is not None:
        _check_painting(options, is_set)
    else:
        refuse(options, ["--recover", "--keep"], "needs --paint")
    if model is None:
        refuse(options, ["--rest", "--pose", "--subdiv"], "needs a MODEL")
    if page is None:
        refuse(options, ["--max-size", "--json"], f"is for pages, NAME{PAGE_ENDING}")
        if options.paint is None:
            refuse(options, ["--force"], f"is for pages, NAME{PAGE_ENDING}, and --paint")
    else:
        refuse(options, ["--port", "--no-browser", "--paint"], "cannot be used when a page is written")
        inputs = path, model, options.rest
        check_outputs([(page, (PAGE_ENDING, WEB_ENDING), "PAGE")], inputs, force=options.force)


def _check_painting(options: Options, is_set: bool) -> None:
    from octex.session.journal import layers_file

    if options.MODEL is None:
        raise ArgumentError("--paint needs a MODEL")
    if is_set:
        raise ArgumentError(f"--paint: {options.TEXTURE} is a folder; open the texture of one part")
    inputs = options.TEXTURE, options.MODEL, options.rest
    # An earlier session may have saved OUTPUT.
    is_forced = options.force or options.recover
    layers = layers_file(options.paint)
    outputs = [(options.paint, "--paint"), (layers, "the file of layers beside --paint")]
    check_outputs([(path, TEXTURE_ENDINGS, word) for path, word in outputs], inputs, force=is_forced)


def _motion_of(path: Path, options: Options, note: Callable[[str], None]) -> Motion | None:
    """Return the animations of a model if the page can show them; otherwise note why not."""
    from octex.source.load import load_motion

    try:
        motion = load_motion(path)
    except OctexError as error:
        note(f"no animations: {error}")
        return None
    if motion is not None and options.subdiv is not None:
        note("no animations: they do not move subdivided models")
        return None
    return motion
