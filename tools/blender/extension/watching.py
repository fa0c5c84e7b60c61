# SPDX-License-Identifier: GPL-3.0-or-later
"""Painting in the browser: its processes, and the objects that show what is saved there."""

import itertools
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import bpy

from . import handover, objects
from .jobs import Job, JobError, environment

#: Seconds between looks at the files that are painted.
_PAUSE = 0.5
#: The file of what a page's process complains of, in its folder.
_ERRORS = "errors.txt"
_PROGRAM = "import sys; from octex.cli.start import octex; sys.exit(octex())"


class _Painted(NamedTuple):
    """An object that is painted in the browser."""

    name: str
    export: Job  # that writes the model
    command: list[str | Path]  # of the page
    output: Path  # where the page saves
    process: subprocess.Popen | None = None  # the page's, once there is a model
    saved: int = 0  # when the file was saved that is shown, in nanoseconds
    job: Job | None = None  # that looks up colours


_painted: dict[int, _Painted] = {}  # by the object's session_uid, as below
#: Why the page of an object ended, or why the object does not show what was saved; the panel shows it.
failures: dict[int, str] = {}


def paint(chosen: bpy.types.Object) -> Path:
    """Open the painting page for an object; return the new file that it saves. Raises ObjectError."""
    texture = objects.texture_path(chosen)
    before = _painted.get(chosen.session_uid)
    if before is not None and (before.process is None or before.process.poll() is None):
        raise objects.ObjectError(f"The painting page of {chosen.name} is open already")
    output = _next(texture)
    form = "model"
    try:
        objects.check_images(chosen)
    except objects.ObjectError:  # the page then shows no source
        form = "without images"
    export = Job()
    handover.hand_over(chosen, export, form)
    export.start()
    layers = texture.with_suffix(".layers.octex")
    command = ["view", layers if layers.exists() else texture, export.folder / "model.glb"]
    command += ["--paint", output, "--quiet"]
    if output.with_name(f"{output.name}.strokes").exists():  # Blender or the page ended before it was saved
        command.append("--recover")
    failures.pop(chosen.session_uid, None)
    _painted[chosen.session_uid] = _Painted(chosen.name, export, command, output)
    if not bpy.app.timers.is_registered(look):
        bpy.app.timers.register(look, first_interval=_PAUSE, persistent=True)
    return output


def _next(texture: Path) -> Path:
    """Return the first free name of NAME-2.octex, NAME-3.octex and so on."""
    stem = re.sub(r"-\d+$", "", texture.stem)
    if not texture.with_name(f"{stem}.octex").exists():  # the number belongs to the object's name
        stem = texture.stem
    numbers = itertools.count(2)
    return next(path for n in numbers if not (path := texture.with_name(f"{stem}-{n}.octex")).exists())


def look() -> float | None:
    """Show what was saved since the last look; return when to look again."""
    for uid, each in list(_painted.items()):
        chosen = objects.found(each.name, uid)
        step = _served if each.process is None else _looked
        after = None if chosen is None else step(chosen, each)
        del _painted[uid]
        if after is None:
            _ended(each)
        else:
            _painted[chosen.session_uid] = after._replace(name=chosen.name)
    return _PAUSE if _painted else None


def _served(chosen: bpy.types.Object, each: _Painted) -> _Painted | None:
    """Start the page if its model is written; return None if there is none."""
    try:
        if each.export.poll() is None:
            return each
    except (JobError, objects.ObjectError) as error:
        _fail(chosen, str(error))
        return None
    with (each.export.folder / _ERRORS).open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *each.command],
            env=environment(),
            stdin=subprocess.DEVNULL,
            stderr=errors,
        )
    return each._replace(process=process)


def _looked(chosen: bpy.types.Object, each: _Painted) -> _Painted | None:
    """Begin to look colours up where something was saved, or take them over; return None after the page."""
    from .operators import colors_job, take_colors

    code = each.process.poll()
    try:
        if each.job is None:
            saved = each.output.stat().st_mtime_ns if each.output.exists() else 0
            if saved == each.saved:
                if code:
                    text = (each.export.folder / _ERRORS).read_text("utf-8", errors="replace").strip()
                    reason = text.splitlines()[-1] if text else f"the page ended with {code}"
                    _fail(chosen, reason.replace("model.glb", chosen.name))
                return each if code is None else None
            chosen.octex.path = bpy.path.relpath(str(each.output)) if bpy.data.filepath else str(each.output)
            each = each._replace(saved=saved)
            job = colors_job(chosen)
            job.start()
            return each._replace(job=job)
        if each.job.poll() is None:
            return each
        take_colors(chosen, each.job)
        if not objects.shows_colors(chosen):
            objects.show(chosen)
        failures.pop(chosen.session_uid, None)
    except (JobError, objects.ObjectError, OSError) as error:
        _fail(chosen, str(error))
    if each.job is not None:
        each.job.close()
    return each._replace(job=None)


def _fail(chosen: bpy.types.Object, reason: str) -> None:
    """Have the panel show why the page of an object failed."""
    failures[chosen.session_uid] = reason
    redraw()


def redraw() -> None:
    """Have Blender draw the panel again, but not the 3D view: that may take long."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if area.type == "VIEW_3D" and region.type == "UI":
                    region.tag_redraw()


def _ended(each: _Painted) -> None:
    if each.process is not None and each.process.poll() is None:
        each.process.terminate()  # strokes that are not saved stay in its journal
        each.process.wait()
    if each.job is not None:
        each.job.close()
    each.export.close()


def unregister() -> None:
    while _painted:
        _ended(_painted.popitem()[1])
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
