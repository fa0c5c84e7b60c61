"""octree-paint --view: a picture of the model to be painted on, and the camera to send it back with."""

from __future__ import annotations

import argparse
import io
import time
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import Reporter, bytes_text, check_outputs, tell
from octex.cli.models import DEFAULT_CHANNEL, new_texture, only, posed_inputs, read_posed, texture_of
from octex.cli.shots import frame_of, patch_of
from octex.cli.view_options import bump_of, light_of
from octex.errors import ArgumentError, ExitCode
from octex.files import replacing

if TYPE_CHECKING:
    from octex.arrays import Uint8s
    from octex.drawing import Bump
    from octex.drawing.environment import Environment
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture
    from octex.view.camera import Camera
    from octex.view.camera_files import Frame

DEFAULT_SIZE = (1024, 1024)
_DIRECTION = (0.4, 0.3, 1.0)  # to the camera, where none is given


def view(command: str, options: argparse.Namespace) -> int:
    """Draw what a camera sees, and write that camera if asked to."""
    began = time.perf_counter()
    outputs = (
        (options.view, (".png",), "--view"),
        (options.empty_layer, (".png",), "--empty-layer"),
        (options.camera_out, (".json",), "--camera-out"),
    )
    check_outputs(outputs, [*posed_inputs(options), options.TEXTURE], force=options.force)
    frame = _frame(options)
    with Reporter(command, options.quiet) as progress:
        texture = texture_of(options)
        if texture is not None and (options.light is None and options.bump is None):
            texture = only(texture, options.channel or DEFAULT_CHANNEL)
        elif texture is None:
            progress.note(f"{new_texture(options)}: the model is drawn grey, in some light")
        with progress.stage("read"):
            surface = read_posed(options)
        if options.unwrap is not None:
            patch = patch_of(options, surface, options.size or DEFAULT_SIZE, progress)
            surface, camera = patch.surface, patch.camera
        else:
            camera = _view_camera(options, surface, frame)
        if camera.is_distorted:
            progress.note(
                "the camera's lens distorts; the picture is drawn without that, and fits the camera that "
                "--camera-out writes"
            )
            camera = camera.undistorted
        with progress.stage("draw"):
            shaded = options.shaded or texture is None or options.light is not None
            channel = options.channel or DEFAULT_CHANNEL
            codes = drawn(texture, surface, camera, channel, shaded, light_of(options), bump_of(options))
        with progress.stage("write"):
            pictures = {options.view: as_png(codes)}
            if options.empty_layer is not None:
                pictures[options.empty_layer] = as_png(codes * 0)
            if options.camera_out is not None:  # of a layer no view is kept: all of it is paint
                cameras = dict.fromkeys((path.name for path in pictures), camera)
                octex.write_cameras(options.camera_out, cameras, {options.view.name: pictures[options.view]})
            for path, png in pictures.items():
                with replacing(path) as file:
                    file.write(png)
    _tell_what_was_drawn(options, camera, time.perf_counter() - began)
    return ExitCode.DONE


def _frame(options: argparse.Namespace) -> Frame | None:
    """Return the frame that is asked for; None for a camera from the front."""
    from octex.view.camera_files import read_cameras

    if options.camera is None and options.frame is None:
        return None
    file, name = options.camera or (options.MODEL, None)
    for word in ("direction", "up"):
        if getattr(options, word) is not None:
            raise ArgumentError(f"--{word} and --camera both say where the camera is; give one of them")
    if name is not None and options.frame is not None:
        raise ArgumentError(f"--camera names the frame {name!r}; leave --frame out")
    name = options.frame if name is None else name
    frames = read_cameras(file)
    frame = frames[0]
    if name is not None or len(frames) > 1:
        frame = frame_of(frames, options.view.name if name is None else name, file)
    if frame.size is not None and options.size is not None and not frame.fits(options.size):
        width, height = frame.size
        raise ArgumentError(
            f"--size has not the shape of frame {frame.name!r} of {file}, {width},{height}; leave --size out"
        )
    return frame


def _view_camera(options: argparse.Namespace, surface: Surface, frame: Frame | None) -> Camera:
    """Return the camera of a frame, or one from the front that sees the whole model."""
    if frame is None:
        direction, up = options.direction or _DIRECTION, options.up or (0.0, 1.0, 0.0)
        size = options.size or DEFAULT_SIZE
        return octex.Camera.fitted(surface.vertices, direction, size=size, up=up).zoomed(options.zoom or 1.0)
    size = options.size or (None if frame.size is not None else DEFAULT_SIZE)
    camera = frame.camera(size)
    return camera.zoomed(options.zoom) if options.zoom is not None else camera


def drawn(
    texture: OctreeTexture | None,
    surface: Surface,
    camera: Camera,
    channel: str,
    shaded: bool,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> Uint8s:
    """Draw a channel, or grey, at the pixels' centres, ``shaded`` or not: codes (height, width, 4).

    ``light`` and ``bump`` are as for ``preview.draw_preview``.

    Alpha is the texture's, 0 beside the model; colours are not multiplied by it. Of what is not ``shaded``,
    to be painted on, only the nearest layer is drawn; else what is behind shows through.
    """
    import numpy as np

    from octex.channels import encode
    from octex.drawing.hits import Hits, rest_normals, visible_hits
    from octex.drawing.pictures import film_surface
    from octex.drawing.shaders import Appearance, Shader, texture_shader

    def grey(hits: Hits) -> Appearance:
        return Appearance(np.full((len(hits.width), 3), 0.5))

    look: Shader = grey
    if texture is not None:
        surface = surface.placed_in(texture)
        look = texture_shader(texture, channel, materials=light is not None, bump=bump)
    codes = np.zeros((camera.height, camera.width, 4), np.uint8)
    if shaded:
        color, coverage = film_surface(surface, camera, [look], 1, light)[0].exposure()
        codes[..., :3] = encode(color / np.maximum(coverage, 1e-9), "uint8", "srgb")
        codes[..., 3:] = encode(coverage, "uint8", "data")
    else:
        flat = codes.reshape(-1, 4)
        for seen, hits in visible_hits(surface, camera, rest_normals(surface)):
            appearance = look(hits)
            flat[seen, :3] = encode(appearance.unlit(), "uint8", "srgb")
            cover = appearance.coverage
            flat[seen, 3] = 255 if cover is None else encode(cover, "uint8", "data")
    codes[codes[..., 3] == 0] = 0
    return codes


def as_png(codes: Uint8s) -> bytes:
    """Return codes (height, width, 4) as a file."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(codes).save(file, "PNG")
    return file.getvalue()


def _tell_what_was_drawn(options: argparse.Namespace, camera: Camera, seconds: float) -> None:
    made: dict[str, Any] = {
        "output": str(options.view),
        "size": [camera.width, camera.height],
        "bytes": options.view.stat().st_size,
        "seconds": round(seconds, 3),
    }
    pixels = f"{camera.width}×{camera.height} pixels"
    lines = [f"{options.view}: {pixels}, {bytes_text(made['bytes'])}, {seconds:.1f} s"]
    if options.empty_layer is not None:
        made["layer"] = str(options.empty_layer)
        lines.append(f"{options.empty_layer}: an empty layer of its size")
    if options.camera_out is not None:
        made["camera"] = str(options.camera_out)
        lines.append(f"{options.camera_out}: its camera")
    tell(options, made, *lines)
