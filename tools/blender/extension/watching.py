# SPDX-License-Identifier: GPL-3.0-or-later
"""Painting in the browser: its processes, and the objects that show what is saved there."""

import itertools
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from . import objects
from .jobs import Job, JobError, environment

#: Seconds between looks at the files that are painted.
_PAUSE = 0.5
#: The file of what a page's process complains of, in its folder.
_ERRORS = "errors.txt"
#: Writes the model by the first command, then shows it.
_PROGRAM = """
import json, os, subprocess, sys
own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # that is Blender's
written = subprocess.run(json.loads(sys.argv.pop(1)), stdout=subprocess.DEVNULL, env=own)
written.returncode and sys.exit(written.returncode)
from octex.cli.start import octex
sys.exit(octex())
"""


class _Painted(NamedTuple):
    """An object that is painted in the browser."""

    process: subprocess.Popen
    folder: tempfile.TemporaryDirectory  # the model's
    output: Path  # where the page saves
    saved: int = 0  # when the file was saved that is shown, in nanoseconds
    job: Job | None = None  # that looks up colours


_painted: dict[str, _Painted] = {}  # by the object's name
#: Why the page of an object ended, or why the object does not show what was saved; the panel shows it.
failures: dict[str, str] = {}


def paint(chosen: bpy.types.Object) -> Path:
    """Open the painting page for an object; return the new file that it saves. Raises ObjectError."""
    texture = objects.texture_path(chosen)
    before = _painted.get(chosen.name)
    if before is not None and before.process.poll() is None:
        raise objects.ObjectError(f"The painting page of {chosen.name} is open already")
    output = _next(texture)
    layers = texture.with_suffix(".layers.octex")
    folder = tempfile.TemporaryDirectory(prefix="octex-")
    model = Path(folder.name) / "model.glb"
    form = "model"
    try:
        objects.check_images(chosen)
    except objects.ObjectError:  # the page then shows no source
        form = "without images"
    export, pixels = objects.hand_over(chosen, Path(folder.name), form)
    for name, values in pixels.items():
        np.save(Path(folder.name) / f"{name}.npy", values)
    command = ["view", layers if layers.exists() else texture, model, "--paint", output, "--quiet"]
    if output.with_name(f"{output.name}.strokes").exists():  # Blender or the page ended before it was saved
        command.append("--recover")
    with (Path(folder.name) / _ERRORS).open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, json.dumps(export), *command],
            env=environment(),
            stdin=subprocess.DEVNULL,
            stderr=errors,
        )
    failures.pop(chosen.name, None)
    _painted[chosen.name] = _Painted(process, folder, output)
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
    for name, each in list(_painted.items()):
        chosen = bpy.data.objects.get(name)
        _painted[name] = each = each if chosen is None else _looked(chosen, each)
        if chosen is None or (each.process.poll() is not None and each.job is None):
            if each.process.poll():
                text = (Path(each.folder.name) / _ERRORS).read_text("utf-8", errors="replace").strip()
                reason = text.splitlines()[-1] if text else f"the page ended with {each.process.poll()}"
                _fail(name, reason.replace("model.glb", name))
            _ended(_painted.pop(name))
    return _PAUSE if _painted else None


def _looked(chosen: bpy.types.Object, each: _Painted) -> _Painted:
    """Begin to look colours up where something was saved, or take them over."""
    from .operators import colors_job, take_colors

    try:
        if each.job is None:
            saved = each.output.stat().st_mtime_ns if each.output.exists() else 0
            if saved == each.saved:
                return each
            chosen.octex.path = bpy.path.relpath(str(each.output)) if bpy.data.filepath else str(each.output)
            job = colors_job(chosen)
            job.start()
            return each._replace(saved=saved, job=job)
        if each.job.poll() is None:
            return each
        take_colors(chosen, each.job)
        if not objects.shows_colors(chosen):
            objects.show(chosen)
        failures.pop(chosen.name, None)
    except (JobError, objects.ObjectError, OSError) as error:
        _fail(chosen.name, str(error))
    if each.job is not None:
        each.job.close()
    return each._replace(job=None)


def _fail(name: str, reason: str) -> None:
    """Have the panel show why the page of an object failed."""
    failures[name] = reason
    redraw()


def redraw() -> None:
    """Have Blender draw the panel again, but not the 3D view: that may take long."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if area.type == "VIEW_3D" and region.type == "UI":
                    region.tag_redraw()


def _ended(each: _Painted) -> None:
    if each.process.poll() is None:  # strokes that are not saved stay in its journal
        each.process.terminate()
        each.process.wait()
    if each.job is not None:
        each.job.close()
    each.folder.cleanup()


def register() -> None:
    """Nothing is painted at first."""


def unregister() -> None:
    while _painted:
        _ended(_painted.popitem()[1])
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
