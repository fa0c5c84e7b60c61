"""Previews: captioned panels side by side, from the side with most detail."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from octex.arrays import Float32s, Uint8s
from octex.channels import encode
from octex.checks import as_path, as_text
from octex.drawing.directions import DEFAULT_VIEW, Viewpoint, as_viewpoint, leaf_camera, surface_camera
from octex.drawing.environment import Environment, as_light
from octex.drawing.rasters import as_image_size, as_supersample, film_surface, render_leaves, visible_level
from octex.drawing.shaders import Bump, ShownChannels, as_bump, source_shader, texture_shader
from octex.drawing.soft_light import background
from octex.errors import ArgumentError
from octex.files import bytes_text, count_text, replacing
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture


def write_preview(
    path: str | Path,
    texture: OctreeTexture | None,
    surface: Surface | None = None,
    *,
    size: tuple[int, int] = (1600, 880),
    direction: npt.ArrayLike | None = None,
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    zoom: float = 1.0,
    channel: str | None = None,
    light: Environment | None = None,
    bump: Bump | None = None,
    supersample: int = 3,
) -> None:
    """Draw a model next to its octree texture, as a PNG file.

    texture        colours the right panel; None: draw the model alone
    surface        the model; None: draw the texture's leaves, and the cubes of a coarser level
    size           (width, height) in pixels
    direction      (3,) from the model to the camera; None: the side with most detail
    up             (3,) direction that points up in the image
    zoom           enlarges; 1 shows the whole model
    channel        default: base colour in the light, or else the channel that is most like a colour
    light          for metal, roughness, occlusion and normal maps; None: soft light on base colour
    bump           (channel, height): bend normals as if the surface rose by the channel times height
    supersample    samples along each side of a pixel

    A file at ``path`` is replaced once the image is complete. Raises OutputError if the file cannot be
    written. Raises ArgumentError for neither a surface nor a texture, without leaves or channels to draw, and
    for an unknown channel.
    """
    path = as_path(path)
    codes = draw_preview(
        None if texture is None else as_texture(texture),
        None if surface is None else as_surface(surface),
        as_image_size(size),
        as_supersample(supersample),
        view=as_viewpoint(direction, up, zoom),
        channel=None if channel is None else as_text(channel, "channel"),
        light=as_light(light),
        bump=as_bump(bump),
    )
    write_png(path, codes)


def draw_preview(
    texture: OctreeTexture | None,
    surface: Surface | None = None,
    size: tuple[int, int] = (1600, 880),
    supersample: int = 3,
    *,
    view: Viewpoint = DEFAULT_VIEW,
    channel: str | None = None,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> Uint8s:
    """Return the image of ``write_preview``."""
    room = caption_height(size[1])
    if surface is not None:
        placed = surface if texture is None else surface.placed_on(texture)
        names = [form.name for form in placed.channels]
        shared = [form for form in placed.channels if texture is None or form.name in texture.channels]
        channel, materials = ShownChannels.of(shared, channel).channel.name, light is not None
        # Next to a texture that has the channel of the bump, a model without it is drawn without the bump.
        model_bump = None if texture is not None and bump is not None and bump[0] not in names else bump
        shaders = [source_shader(placed, channel, materials=materials, bump=model_bump)]
        captions = [source_caption(placed, channel)]
        if texture is not None:
            shaders.append(texture_shader(texture, channel, materials=materials, bump=bump))
            captions.append(texture_caption(texture, channel))
        panel_size = size[0] // len(shaders), size[1]
        camera = surface_camera(placed, source_shader(placed, channel), panel_size, room, view)
        films = film_surface(placed, camera, shaders, supersample, light)
        images = [film.image() for film in films]
    elif texture is not None:
        channel = ShownChannels.of((each.format for each in texture.channels.values()), channel).channel.name
        camera = leaf_camera([texture], channel, (size[0] // 2, size[1]), room, view)
        level = visible_level(texture, camera, pixels=10.0)
        draw = partial(render_leaves, texture, camera, supersample=supersample, channel=channel, light=light)
        images = [draw(bump=bump), draw(level=level, cubes=True)]
        cells = count_text(texture.level(level).tree.n_leaves, "cell")
        captions = [texture_caption(texture, channel), (f"level {level}", cells)]
    else:
        raise ArgumentError("a preview needs a surface, a texture or both")
    for image in images:  # a zoomed model reaches below the caption
        image[-room:] = background(*image.shape[:2])[-room:]
    panels = [captioned(image, *caption) for image, caption in zip(images, captions, strict=True)]
    return np.hstack([np.asarray(panel) for panel in panels])


def write_png(path: str | Path, codes: Uint8s) -> None:
    """Write sRGB codes (height, width, 3 or 4) as a PNG file, complete or not at all; raises OutputError."""
    with replacing(path) as file:
        Image.fromarray(codes).save(file, "PNG")


def source_caption(surface: Surface, channel: str) -> tuple[str, str]:
    """Return title and subtitle for an image of a model."""
    return surface.name, f"{named(channel)}model, {count_text(len(surface.triangles), 'triangle')}"


def texture_caption(texture: OctreeTexture, channel: str) -> tuple[str, str]:
    """Return title and subtitle for an image of a texture."""
    return f"octree, depth {texture.tree.max_depth}", named(channel) + texture_facts(texture)


def texture_facts(texture: OctreeTexture) -> str:
    """Return a line with the size of a texture."""
    return f"{count_text(texture.tree.n_leaves, 'leaf', 'leaves')}, {bytes_text(texture.nbytes)}"


def named(channel: str) -> str:
    """Return the prefix of a caption: the channel's name unless it is base colour."""
    return "" if channel == "base_color" else f"{channel}: "


def caption_height(height: int) -> int:
    """Return the height of the caption in an image of this height."""
    return max(height // 11, 24)


def captioned(image: Float32s, title: str, subtitle: str, room: int | None = None) -> Image.Image:
    """Return linear light (height, width, 3) as an image, with a caption in ``room`` pixels at its bottom."""
    panel = Image.fromarray(encode(image, "uint8", "srgb"))
    strip = caption_height(panel.height)
    draw = ImageDraw.Draw(panel)
    middle, top = panel.width // 2, panel.height - (room or strip)
    for text, down, color, size in (
        (title, 0.05, (12, 12, 14), 0.36),
        (subtitle, 0.50, (40, 40, 44), 0.28),
    ):
        font = ImageFont.load_default(strip * size)
        draw.text((middle, top + strip * down), text, color, font, "ma")
    return panel
