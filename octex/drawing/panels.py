"""What a preview consists of: panels side by side, from the side that shows most, with captions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from octex.arrays import Float32s, Floats, Uint8s
from octex.channels import encode, linear_to_srgb
from octex.drawing.directions import USUAL, Viewpoint, best_direction, view_directions
from octex.drawing.hits import rest_normals, visible_hits
from octex.drawing.pictures import Leaves, film_surface, render_leaves, visible_level
from octex.drawing.shaders import Bump, Shader, Shown, source_shader, texture_shader
from octex.errors import ArgumentError
from octex.files import replacing
from octex.tree.octree import distinct
from octex.view.camera import Camera
from octex.view.shading import background, face_normals

if TYPE_CHECKING:
    from octex.drawing.environment import Environment
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture


def write_preview(
    path: str | Path,
    surface: Surface | None,
    texture: OctreeTexture | None = None,
    size: tuple[int, int] = (1600, 880),
    supersample: int = 3,
    view: Viewpoint = USUAL,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> None:
    """Write what ``draw_preview`` draws as a PNG file.

    What stood at ``path`` before is replaced when all is drawn, or not at all. Raises OutputError if the file
    cannot be written, and ArgumentError as ``draw_preview`` does.
    """
    picture = Image.fromarray(
        draw_preview(surface, texture, size, supersample, view=view, light=light, bump=bump)
    )
    with replacing(path) as file:
        picture.save(file, "PNG")


def draw_preview(
    surface: Surface | None,
    texture: OctreeTexture | None = None,
    size: tuple[int, int] = (1600, 880),
    supersample: int = 3,
    note: str = "",
    view: Viewpoint = USUAL,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> Uint8s:
    """Draw a picture, sRGB codes (height, width, 3), that shows at once whether a texture is right.

    With a surface and a texture: the model coloured by its source and, beside it, by the octree. With a
    surface alone: the model. With a texture alone: its leaves, and the cubes of a coarser level. Base colour
    is shown in the light, with what is emitted; without it the channel most like a colour, as it is.

    size           (width, height) in pixels
    supersample    samples along each side of a pixel
    note           what else the caption should say of the octree
    view           from where to look
    light          from all around, reflected by metal, roughness, occlusion and normal maps; None: soft light
                   from beside the camera on base colours alone, which look the same from model to model
    bump           bends the normals, not those of cubes

    Raises ArgumentError for neither a surface nor a texture, if there is no leaf or no channel to show, and
    for a bump of a channel that is not there.
    """
    shown = _Showing(size, supersample, note, view, light, bump)
    if surface is not None:
        if texture is not None:
            surface = surface.placed_in(texture)
        panels = _model_panels(surface, texture, shown)
    elif texture is not None:
        panels = _leaf_panels(texture, shown)
    else:
        raise ArgumentError("a preview needs a surface, or a texture, or both")
    room = caption_height(size[1])
    for panel in panels:  # zoomed in, a model reaches below
        panel.picture[-room:] = background(*panel.picture.shape[:2])[-room:]
    return np.hstack([np.asarray(captioned(panel)) for panel in panels])


class Panel(NamedTuple):
    """A picture with its caption."""

    picture: Float32s  # (height, width, 3)   linear light
    title: str
    subtitle: str


class _Showing(NamedTuple):
    """How panels are drawn, as ``draw_preview`` takes it."""

    size: tuple[int, int]
    supersample: int
    note: str
    view: Viewpoint
    light: Environment | None
    bump: Bump | None


def _model_panels(surface: Surface, texture: OctreeTexture | None, how: _Showing) -> list[Panel]:
    size = how.size
    stored = None if texture is None else texture.channels
    channel = Shown.of(
        form for form in surface.channels if stored is None or form.name in stored
    ).channel.name
    materials = how.light is not None
    own = how.bump
    if (
        own is not None
        and texture is not None
        and own.channel not in [form.name for form in surface.channels]
    ):
        own = None  # a model without the channel is drawn smooth beside the texture that has it
    looks = [source_shader(surface, channel, materials=materials, bump=own)]
    captions = [source_caption(surface, channel)]
    if texture is not None:
        looks.append(texture_shader(texture, channel, materials=materials, bump=how.bump))
        captions.append(texture_caption(texture, channel, how.note))
    camera = surface_camera(
        surface,
        source_shader(surface, channel),
        (size[0] // len(looks), size[1]),
        caption_height(size[1]),
        how.view,
    )
    films = film_surface(surface, camera, looks, how.supersample, how.light)
    return [Panel(film.picture(), *caption) for film, caption in zip(films, captions, strict=True)]


def _leaf_panels(texture: OctreeTexture, how: _Showing) -> list[Panel]:
    channel = Shown.of(stored.format for stored in texture.channels.values()).channel.name
    width, height = how.size
    camera = leaf_camera([texture], channel, (width // 2, height), caption_height(height), how.view)
    level = visible_level(texture, camera, pixels=10.0)
    samples, light = how.supersample, how.light
    fine = render_leaves(texture, camera, supersample=samples, light=light, bump=how.bump)
    coarse = render_leaves(texture, camera, level=level, cubes=True, supersample=samples, light=light)
    cells = count_text(texture.level(level).tree.n_leaves, "cell")
    return [Panel(fine, *texture_caption(texture, channel, how.note)), Panel(coarse, f"level {level}", cells)]


def surface_camera(
    surface: Surface, look: Shader, size: tuple[int, int], room: int, view: Viewpoint = USUAL
) -> Camera:
    """Make a camera that sees a model, from the side that shows most, above ``room`` for a caption."""
    normals = rest_normals(surface)

    def unlit(camera: Camera) -> Floats:
        picture = np.full((camera.height * camera.width, 3), np.nan)
        for pixels, hits in visible_hits(surface, camera, normals):
            picture[pixels] = linear_to_srgb(look(hits).unlit())
        return picture.reshape(camera.height, camera.width, 3)

    points = surface.vertices[distinct(surface.triangles.ravel())]

    def usual() -> Floats:
        directions = view_directions(*face_normals(surface.vertices, surface.triangles))
        return best_direction(directions, points, unlit)

    return replace(view.camera(points, usual, (size[0], size[1] - room)), height=size[1])


def leaf_camera(
    textures: Sequence[OctreeTexture], channel: str, size: tuple[int, int], room: int, view: Viewpoint = USUAL
) -> Camera:
    """Make a camera that sees textures from the side on which the first shows most, as ``surface_camera``."""
    # Coarse cells are enough to find out where the model is and from where to look at it.
    coarse = [texture.level(min(7, texture.tree.max_depth)) for texture in textures]
    every = [Leaves.of(texture) for texture in coarse]
    first, colors = every[0], every[0].appearance(coarse[0], channel).unlit()

    def unlit(camera: Camera) -> Floats:
        seen = first.seen(camera).cube
        picture = np.full((*seen.shape, 3), np.nan)
        picture[seen >= 0] = linear_to_srgb(colors[seen[seen >= 0]])
        return picture

    points = np.concatenate(
        [leaves.corners + far for leaves in every for far in (0.0, leaves.edges[:, None])]
    )

    def usual() -> Floats:
        return best_direction(view_directions(first.normals, first.edges**2), points, unlit)

    return replace(view.camera(points, usual, (size[0], size[1] - room)), height=size[1])


def source_caption(surface: Surface, channel: str) -> tuple[str, str]:
    """Return a title and a subtitle for a picture of a model."""
    return surface.name, f"{named(channel)}source, {count_text(len(surface.triangles), 'triangle')}"


def texture_caption(texture: OctreeTexture, channel: str, note: str = "") -> tuple[str, str]:
    """Return a title and a subtitle for a picture of a texture."""
    facts = texture_facts(texture) + (f", {note}" if note else "")
    return f"octree, depth {texture.tree.max_depth}", named(channel) + facts


def texture_facts(texture: OctreeTexture) -> str:
    """Return how large a texture is."""
    return f"{count_text(texture.tree.n_leaves, 'leaf', 'leaves')}, {texture.nbytes / 1e6:.3g} MB"


def named(channel: str) -> str:
    """Return what to begin a caption with, if it is not about base colour."""
    return "" if channel == "base_color" else f"{channel}: "


def count_text(number: int, one: str, many: str = "") -> str:
    """Return so many of something, in words."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def caption_height(height: int) -> int:
    """Return the height of a caption at the bottom of a picture so high."""
    return max(height // 11, 24)


def captioned(panel: Panel, room: int | None = None) -> Image.Image:
    """Return a panel with its caption at the top of the ``room`` at its bottom."""
    picture = Image.fromarray(encode(panel.picture, "uint8", "srgb"))
    strip = caption_height(picture.height)
    title, subtitle = ImageFont.load_default(strip * 0.36), ImageFont.load_default(strip * 0.28)
    draw = ImageDraw.Draw(picture)
    middle, top = picture.width // 2, picture.height - (room or strip)
    draw.text((middle, top + strip * 0.05), panel.title, (12, 12, 14), title, "ma")
    draw.text((middle, top + strip * 0.50), panel.subtitle, (40, 40, 44), subtitle, "ma")
    return picture
