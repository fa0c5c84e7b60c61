"""octex draw: renders a texture, a model or both, from any side and in any light."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import octex
from octex.ahead import ahead
from octex.cli.common import Reporter, check_outputs, report_file
from octex.cli.inputs import bare_model, is_texture, only, open_texture, refuse, shaped_model
from octex.cli.options import DEFAULT_CHANNEL
from octex.cli.parser import Options
from octex.cli.shots import patch_of
from octex.errors import ArgumentError, CameraError
from octex.files import replacing

if TYPE_CHECKING:
    from octex.arrays import Uint8s
    from octex.cameras.camera import Camera
    from octex.cameras.files import Frame
    from octex.drawing import Environment

_SIZE = 1024, 1024  # of a view
_DIRECTION = 0.4, 0.3, 1.0  # of an image to paint on
#: The options that each kind of image refuses.
_OF_VIEWS = "--camera-out", "--unwrap", "--empty-layer"
_REFUSED = {
    "view": ("--empty-layer",),
    "panels": _OF_VIEWS,
    "cells": ("--bump", *_OF_VIEWS),
    "difference": ("--light", "--exposure", "--bump", *_OF_VIEWS),
}


def draw(options: Options, program: str) -> int:
    """Run octex draw."""
    kind = vars(options)["as"]
    _check(options, kind)
    with ahead("view") if kind == "paint" and options.threads is None else nullcontext():
        width, height = _draw(options, kind, program)
    others = {
        "layer": (options.empty_layer, "an empty layer of its size"),
        "camera": (options.camera_out, "its camera"),
    }
    facts = {"size": [width, height]}
    return report_file(options, f"{width}×{height} pixels", facts, others=others)


def _check(options: Options, kind: str) -> None:
    texture, model = options.TEXTURE, options.MODEL
    refuse(options, _REFUSED.get(kind, ()), f"cannot be used with --as {kind}")
    if texture is None and (model is None or kind in ("cells", "difference")):
        raise ArgumentError(f"--as {kind} needs a TEXTURE; see octex draw --help")
    if model is None and (kind in ("paint", "difference") or options.unwrap is not None):
        raise ArgumentError(f"--as {kind} needs a MODEL; see octex draw --help")
    if model is not None and is_texture(model) and kind != "difference":
        raise ArgumentError(f"{model}: is a texture too; --as difference draws how two differ")
    if texture is None:
        refuse(options, ["--level"], "is a level of a TEXTURE")
    if options.camera is not None:
        refuse(options, ["--direction", "--up"], "cannot be used with --camera; give one of them")
    if options.unwrap is not None:
        words = "--camera", "--camera-out", "--direction", "--up", "--zoom"
        refuse(options, words, "cannot be used with --unwrap, which sets the view")
    elif kind == "paint" and options.camera is None and options.camera_out is None:
        raise ArgumentError(
            "--as paint without --camera needs --camera-out: only with its camera can you paint it back"
        )
    if options.light is None:
        refuse(options, ["--exposure"], "needs --light")
        if kind == "paint":
            refuse(options, ["--bump"], "needs --light")
    outputs = (
        (options.OUTPUT, (".png",), "OUTPUT"),
        (options.empty_layer, (".png",), "--empty-layer"),
        (options.camera_out, (".json",), "--camera-out"),
    )
    inputs = [texture, model, options.rest, options.camera and options.camera[0]]
    check_outputs(outputs, inputs, force=options.force)
    if options.empty_layer is not None and options.empty_layer.name == options.OUTPUT.name:
        raise ArgumentError(
            f"--empty-layer has the name of OUTPUT, {options.OUTPUT.name}, but cameras are found by file "
            "name; give it another"
        )


def _draw(options: Options, kind: str, program: str) -> tuple[int, int]:
    frame = _frame(options, kind)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = None if options.TEXTURE is None else open_texture(options.TEXTURE)
            if texture is not None and options.level is not None and kind != "cells":
                texture = texture.level(options.level)
            model = _model(options, kind)
        if texture is None and kind == "paint":
            progress.note("without a texture the model is drawn grey, with soft shading")
        camera: Camera | None = None
        if options.unwrap is not None:
            patch = patch_of(options, model, options.size or _SIZE, progress)
            model, camera = patch.surface, patch.camera
        elif kind not in ("panels", "difference"):
            camera = _camera(options, kind, texture, model, frame)
        if camera is not None and camera.is_distorted:
            progress.note(
                "the camera has lens distortion; the image is drawn without it, and fits the camera that "
                "--camera-out writes"
            )
            camera = camera.undistorted
        with progress.stage("draw"):
            codes = _codes(options, kind, texture, model, camera, frame)
        with progress.stage("write"):
            _write(options, codes, camera)
    return codes.shape[1], codes.shape[0]


def _model(options: Options, kind: str) -> Any:
    """Read MODEL: a surface or another texture; None if absent."""
    if options.MODEL is None:
        return None
    if is_texture(options.MODEL):
        return open_texture(options.MODEL)
    if kind == "paint" or (kind == "view" and options.TEXTURE is not None):
        return bare_model(options.MODEL, options)
    return shaped_model(options.MODEL, options, normals=True)


def _codes(
    options: Options, kind: str, texture: Any, model: Any, camera: Camera | None, frame: Frame | None
) -> Uint8s:
    from octex import drawing

    channel, light, bump = options.channel, _light(options), options.bump
    size = {} if options.size is None else {"size": options.size}
    view = drawing.Viewpoint(options.direction, options.up, options.zoom, frame)
    if kind == "difference":
        differences = octex.difference(texture, model, channels=None if channel is None else [channel])
        names = options.TEXTURE.name, options.MODEL.name
        return drawing.draw_difference(texture, model, differences, names, view=view, **size)
    if kind == "panels":
        return drawing.draw_preview(
            texture, model, **size, view=view, channel=channel, light=light, bump=bump
        )
    if kind == "paint":
        assert camera is not None
        channel, is_lit = channel or DEFAULT_CHANNEL, texture is None or options.light is not None
        shown = texture if is_lit else only(texture, channel)
        return drawing.draw_paintable(shown, model, camera, channel, lit=is_lit, light=light, bump=bump)
    cells = {"level": options.level, "cubes": True} if kind == "cells" else {}
    return octex.render(texture, model, camera, channel=channel, light=light, bump=bump, **cells)


def _write(options: Options, codes: Uint8s, camera: Camera | None) -> None:
    """Write the image and the other requested files, all at the end."""
    from octex.drawing import as_png

    images = {options.OUTPUT: as_png(codes)}
    if options.empty_layer is not None:
        images[options.empty_layer] = as_png(codes * 0)
    if options.camera_out is not None:  # a layer has no unedited view: all of it is paint
        assert camera is not None
        cameras = dict.fromkeys((path.name for path in images), camera)
        octex.write_cameras(options.camera_out, cameras, {options.OUTPUT.name: images[options.OUTPUT]})
    for path, png in images.items():
        with replacing(path) as file:
            file.write(png)


def _frame(options: Options, kind: str) -> Frame | None:
    """Return the camera of --camera: the only one, the named one, or the one of OUTPUT's name."""
    if options.camera is None:
        return None
    from octex.cameras.files import find_frame, read_cameras

    file, name = options.camera
    frames = read_cameras(file)
    frame = frames[0]
    if name is not None or len(frames) > 1:
        try:
            frame = find_frame(frames, options.OUTPUT.name if name is None else name, file)
        except CameraError as error:
            raise error if name else CameraError(f"{error}; choose one with --camera {file}#NAME") from None
    if frame.size is None or options.size is None or kind in ("panels", "difference"):
        return frame
    if not frame.fits(options.size):
        width, height = frame.size
        raise ArgumentError(
            f"--size has another aspect ratio than frame {frame.name!r} of {file}, {width},{height}; "
            "leave --size out"
        )
    return frame


def _camera(options: Options, kind: str, texture: Any, model: Any, frame: Frame | None) -> Camera:
    """Return the camera of a frame, or one that sees the whole model."""
    size = options.size or _SIZE
    if frame is not None:
        camera = frame.camera(options.size or (None if frame.size is not None else _SIZE))
    elif kind == "paint":  # the same for every texture
        camera = octex.Camera.fitted(
            model.vertices, options.direction or _DIRECTION, size=size, up=options.up
        )
    else:
        from octex.drawing import Viewpoint, camera_of

        view = Viewpoint(options.direction, options.up, options.zoom)
        return camera_of(texture, model, size, view, options.channel)
    return camera if options.zoom == 1.0 else camera.zoomed(options.zoom)


def _light(options: Options) -> Environment | None:
    """Return the environment of --light; None for soft and no light."""
    if options.light in (None, "soft"):
        return None
    from octex.drawing import Environment

    if options.light == "studio":
        return Environment.studio(options.exposure)
    return Environment.of(options.light, options.exposure, options.up)
