"""Renders a model or leaves through one camera, and views to paint on."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from octex.arrays import Uint8s
from octex.cameras.camera import Camera
from octex.channels import encode
from octex.checks import as_depth, as_flag, as_path, as_text
from octex.drawing.directions import as_viewpoint, camera_of
from octex.drawing.environment import Environment, as_light
from octex.drawing.hits import Hits, visible_hits
from octex.drawing.panels import write_png
from octex.drawing.rasters import (
    as_image_size,
    as_supersample,
    film_surface,
    render_leaves,
    render_surface,
)
from octex.drawing.shaders import Appearance, Bump, Shader, as_bump, source_shader, texture_shader
from octex.errors import ArgumentError
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture


def render(
    texture: OctreeTexture | None,
    surface: Surface | None = None,
    camera: Camera | None = None,
    *,
    path: str | Path | None = None,
    size: tuple[int, int] = (1024, 1024),
    direction: npt.ArrayLike | None = None,
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    zoom: float = 1.0,
    channel: str | None = None,
    level: int | None = None,
    cubes: bool = False,
    light: Environment | None = None,
    bump: Bump | None = None,
    supersample: int = 3,
) -> Uint8s:
    """Draw a model with a texture's colours, or the texture's leaves.

    texture        colours the model; None: use the model's own images
    surface        the model; None: draw the leaves
    camera         without distortion; default: sees all, with ``size`` and ``direction`` of ``write_preview``
    path           also write the image to this PNG file
    channel        default: base colour in the light, or else the channel that is most like a colour
    level          read this level of the texture; default for leaves: the deepest that a pixel shows
    cubes          draw the leaves as cubes, even with a surface
    light          for metal, roughness, occlusion and normal maps; None: soft light on base colour
    bump           (channel, height): bend normals as if the surface rose by the channel times height
    supersample    samples along each side of a pixel, averaged in linear light

    Returns an sRGB image (height, width, 3) over a grey backdrop, uint8. Transparent surface shows the
    surface behind it. Raises ArgumentError for neither a texture nor a surface, without leaves or channels to
    draw, and for an unknown channel. Also for ``level`` or ``cubes`` without a texture and for ``bump`` on
    cubes. Raises OutputError if the file cannot be written.
    """
    if texture is None and surface is None:
        raise ArgumentError("an image needs a texture, a surface or both")
    texture = None if texture is None else as_texture(texture)
    surface = None if surface is None else as_surface(surface)
    size, view = as_image_size(size), as_viewpoint(direction, up, zoom)
    channel = None if channel is None else as_text(channel, "channel")
    light, bump, supersample = as_light(light), as_bump(bump), as_supersample(supersample)
    if camera is not None and not isinstance(camera, Camera):
        raise ArgumentError(f"camera must be an octex.Camera, not {camera!r}")
    if camera is not None and camera.is_distorted:
        raise ArgumentError(
            "the camera has lens distortion, which render cannot draw; give camera.undistorted"
        )
    level, cubes = None if level is None else as_depth(level, "level"), as_flag(cubes, "cubes")
    if texture is None and (cubes or level is not None):
        raise ArgumentError("level and cubes are for a texture; give one, or leave them out")
    if cubes and bump is not None:
        raise ArgumentError("cubes have flat sides; leave bump or cubes out")
    path = None if path is None else as_path(path)
    if camera is None:
        camera = camera_of(texture, surface, size, view, channel)
    if surface is not None and not cubes:
        materials = light is not None
        if texture is None:
            look = source_shader(surface, channel, materials=materials, bump=bump)
        else:
            surface = surface.placed_on(texture)
            shown = texture if level is None else texture.level(level)
            look = texture_shader(shown, channel, materials=materials, bump=bump)
        image = render_surface(surface, camera, look, supersample, light)
    else:
        assert texture is not None
        image = render_leaves(
            texture, camera, level=level, cubes=cubes, supersample=supersample, channel=channel, light=light,
            bump=bump,
        )  # fmt: skip
    codes = encode(image, "uint8", "srgb")
    if path is not None:
        write_png(path, codes)
    return codes


def draw_paintable(
    texture: OctreeTexture | None,
    surface: Surface,
    camera: Camera,
    channel: str,
    *,
    lit: bool = False,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> Uint8s:
    """Draw a channel at pixel centres, to paint on: sRGB codes and alpha (height, width, 4).

    Alpha is the texture's, and 0 off the model; colours are not multiplied by it. Unless ``lit``, only the
    nearest layer is drawn, without light. Without a texture the model is grey.
    """

    def grey(hits: Hits) -> Appearance:
        return Appearance(np.full((len(hits.width), 3), 0.5))

    look: Shader = grey
    if texture is not None:
        surface = surface.placed_on(texture)
        look = texture_shader(texture, channel, materials=light is not None, bump=bump)
    codes = np.zeros((camera.height, camera.width, 4), np.uint8)
    if lit:
        color, coverage = film_surface(surface, camera, [look], 1, light)[0].exposure()
        codes[..., :3] = encode(color / np.maximum(coverage, 1e-9), "uint8", "srgb")
        codes[..., 3:] = encode(coverage, "uint8", "data")
    else:
        flat = codes.reshape(-1, 4)
        for seen, hits in visible_hits(surface, camera):
            appearance = look(hits)
            flat[seen, :3] = encode(appearance.unlit(), "uint8", "srgb")
            cover = appearance.coverage
            flat[seen, 3] = 255 if cover is None else encode(cover, "uint8", "data")
    codes[codes[..., 3] == 0] = 0
    return codes


def as_png(codes: Uint8s) -> bytes:
    """Return codes (height, width, 3 or 4) as the content of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(codes).save(file, "PNG")
    return file.getvalue()
