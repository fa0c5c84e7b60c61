"""Draws where two textures, or a texture and a model, differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from octex.arrays import Bools, Float32s, Float64s, Uint8s
from octex.channels import srgb_to_linear
from octex.drawing.compare import (
    PEAKS,
    Difference,
    Differences,
    Points,
    Side,
    degrees_between,
    in_common,
    inside_cells,
    placed,
    readers_of,
)
from octex.drawing.directions import USUAL, Viewpoint, leaf_camera, surface_camera
from octex.drawing.hits import rest_normals, visible_hits
from octex.drawing.panels import caption_height, captioned, named, source_caption, texture_facts
from octex.drawing.rasters import Film, Leaves, film_leaves, film_surface, visible_level
from octex.drawing.shaders import Appearance, Shader, source_shader, texture_shader
from octex.drawing.soft_light import background
from octex.source.surface import Surface
from octex.texture import OctreeTexture

# Inferno, by Nathaniel Smith and Stéfan van der Walt (CC0), a perceptually uniform colour map.
_SCALE = np.array(
    [
        [0, 0, 4], [33, 12, 74], [87, 16, 110], [138, 34, 106], [188, 55, 84],
        [228, 90, 49], [249, 142, 9], [249, 203, 53], [252, 255, 164],
    ]
)  # fmt: skip
#: Colour where only one side has a surface.
_ALONE = np.array([0, 190, 255])

#: The size of a panel, the height of its caption, and where the camera views from.
_Panel = tuple[tuple[int, int], int, Viewpoint]
#: The images of both sides; the difference in red, and surface of one side only in green; and the pixel
#: coordinates of the maximum, if it is visible.
_Row = tuple[list[Float32s], Film, tuple[float, float] | None]


def draw_difference(
    a: Side,
    b: Side,
    differences: Differences,
    names: tuple[str, str] = ("A", "B"),
    size: tuple[int, int] = (1800, 640),
    supersample: int = 3,
    view: Viewpoint = USUAL,
) -> Uint8s:
    """Draw both and their difference side by side, one row a channel, as sRGB codes (height, width, 3).

    A model is the first panel, as in previews; of two textures, a is.

    differences    the result of ``octex.difference``
    names          captions of a and b
    size           (width, height) of a row in pixels
    supersample    samples along each side of a pixel
    view           where the camera views from

    The third panel shows the component that differs most (of directions the angle), averaged over each pixel.
    The scale runs from black to yellow and reaches at least the 99th percentile and a tenth of the maximum. A
    ring marks the maximum if it is visible. Blue marks surface of only one side.

    With a model, both are drawn on it. Otherwise leaves are drawn, no smaller than half a pixel; the
    difference is drawn on the finer of the two textures. Alpha and emitted light are drawn if both have them.
    """

    def caption(side: Side, channel: str) -> str:
        if isinstance(side, Surface):
            return source_caption(side, channel)[1]
        return f"{named(channel)}octree, depth {side.tree.max_depth}, {texture_facts(side)}"

    whole = placed(a, b)
    room = round(1.6 * caption_height(size[1]))
    draw = _drawn_on_model if any(isinstance(side, Surface) for side in whole) else _drawn_leaves
    panel = (size[0] // 3, size[1]), room, view
    drawn = draw(in_common(*whole), differences, panel, supersample)
    rows = []
    for (channel, result), (images, film, ring) in zip(differences.items(), drawn, strict=True):
        panels = [
            captioned(image, name, caption(side, channel), room)
            for image, name, side in zip(images, names, whole, strict=True)
        ]
        if isinstance(whole[1], Surface):
            panels.reverse()
        panels.append(_difference_panel(film, ring, channel, result.angle or result, room))
        rows.append(np.hstack([np.asarray(panel) for panel in panels]))
    return np.vstack(rows)


def _drawn_on_model(
    sides: tuple[Side, Side], differences: Differences, panel: _Panel, supersample: int
) -> Iterator[_Row]:
    """Draw a model coloured by itself and by a texture, channel by channel."""
    (model,) = (side for side in sides if isinstance(side, Surface))
    (texture,) = (side for side in sides if isinstance(side, OctreeTexture))
    camera = surface_camera(model, _look(sides[0], next(iter(differences))), *panel)
    covers = inside_cells(texture)
    for channel, result in differences.items():
        looks = [_look(side, channel) for side in sides]
        looks.append(_difference_look(sides, channel, differences, covers))
        *films, film = film_surface(model, camera, looks, supersample)
        where = np.array((result.angle or result).where)
        nearest, ring = np.inf, None
        for pixels, hits in visible_hits(model, camera, rest_normals(model)):
            distances = np.linalg.norm(hits.rest - where, axis=1)
            n = int(distances.argmin())
            if distances[n] < min(nearest, 3 * hits.width[n]):
                nearest, pixel = distances[n], int(pixels[n])
                ring = pixel % camera.width + 0.5, pixel // camera.width + 0.5
        yield [each.image() for each in films], film, ring


def _look(side: Side, channel: str) -> Shader:
    return source_shader(side, channel) if isinstance(side, Surface) else texture_shader(side, channel)


def _difference_look(
    sides: tuple[Side, Side], channel: str, differences: Differences, covers: Callable[..., Bools]
) -> Shader:
    apart = _difference_of(sides, channel, differences)
    return lambda hits: apart(Points(hits.rest, hits.triangles, hits.barycentric), covers(hits.rest))


def _drawn_leaves(
    sides: tuple[Side, Side], differences: Differences, panel: _Panel, supersample: int
) -> Iterator[_Row]:
    """Draw the leaves of two textures, no smaller than half a pixel, channel by channel."""
    whole = [side for side in sides if isinstance(side, OctreeTexture)]
    camera = leaf_camera(whole, next(iter(differences)), *panel)
    a, b = (texture.level(visible_level(texture, camera, pixels=0.5)) for texture in whole)
    textures, both = (a, b), (Leaves.of(a), Leaves.of(b))
    # Draw the difference on the finer texture's leaves, and on the other's where the finer has none.
    order = (0, 1) if both[0].edges.min() <= both[1].edges.min() else (1, 0)
    fine, coarse = (both[n] for n in order)
    meets_coarse, meets_fine = (inside_cells(textures[n]) for n in reversed(order))
    alone = ~meets_fine(coarse.centres, coarse.edges)
    covered = np.concatenate([meets_coarse(fine.centres, fine.edges), np.zeros(int(alone.sum()), np.bool_)])
    differing = Leaves.joined(fine, coarse.only(alone))
    drawn = *both, differing
    seen = [leaves.seen(camera.scaled(supersample)) for leaves in drawn]
    for channel, result in differences.items():
        appearances = [
            leaves.appearance(texture, channel) for leaves, texture in zip(both, textures, strict=True)
        ]
        appearances.append(_difference_of(textures, channel, differences)(Points(differing.centres), covered))
        *films, film = (
            film_leaves(leaves, appearance, buffers, camera, supersample)
            for leaves, appearance, buffers in zip(drawn, appearances, seen, strict=True)
        )
        # Leaves that contain the maximum, or the centre of a leaf that does.
        where = np.array((result.angle or result).where)
        holding = np.abs(differing.centres - where).max(axis=1) <= 1.001 * differing.edges
        cubes = seen[2].cube
        at = (np.argwhere((cubes >= 0) & holding[cubes]) + 0.5) / supersample
        ring = (float(at[:, 1].mean()), float(at[:, 0].mean())) if len(at) else None
        yield [each.image() for each in films], film, ring


def _difference_of(
    sides: tuple[Side, Side], channel: str, differences: Differences
) -> Callable[[Points, Bools], Appearance]:
    """Return a function that encodes the difference as emitted red, surface of one side only as green."""
    spaces, readers = readers_of(sides, [channel], differences.width or 0.0, differences.filter)
    is_direction = spaces[channel] == "direction"

    def appearance(points: Points, covered: Bools) -> Appearance:
        a, b = (read(points)[channel] for read in readers)
        apart = degrees_between(a, b) if is_direction else np.abs(b - a).max(axis=1)
        emitted = np.zeros((len(apart), 3))
        emitted[:, 0] = np.where(covered, apart, 0.0)
        emitted[:, 1] = ~covered
        return Appearance(emitted=emitted)

    return appearance


def _difference_panel(
    film: Film, ring: tuple[float, float] | None, channel: str, shown: Difference, room: int
) -> Image.Image:
    top = _scale_top(shown)
    exposed, coverage = film.exposure()
    apart, alone = exposed[..., 0] / top, exposed[..., 1:2]
    within = np.maximum(coverage - alone, 1e-9)
    colors = (
        srgb_to_linear(_scale_codes(apart / within[..., 0]) / 255) * within
        + srgb_to_linear(_ALONE / 255) * alone
    )
    image = (colors + (1.0 - coverage) * background(*apart.shape)).astype(np.float32)
    title = f"{channel}: {_text(PEAKS[shown.measure] / top)} times the difference"
    subtitle = "they do not differ"
    if shown.maximum > 0:
        rms, maximum = (_amount(number, shown.measure) for number in (shown.rms, shown.maximum))
        subtitle = f"RMS {rms}, maximum {maximum}, {'in the ring' if ring else 'out of sight'}"
    panel = captioned(image, title, subtitle, room)
    if ring and shown.maximum > 0:
        draw = ImageDraw.Draw(panel)
        radius = max(panel.height / 40, 4.0)
        draw.circle(ring, radius + 2, outline=(0, 0, 0), width=2)
        draw.circle(ring, radius, outline=(255, 255, 255), width=2)
    _draw_legend(panel, top, shown.measure, room, alone=bool(alone.any()))
    return panel


def _draw_legend(panel: Image.Image, top: float, measure: str, room: int, *, alone: bool) -> None:
    """Draw the scale, with the values of its ends, at the bottom of a panel."""
    draw = ImageDraw.Draw(panel)
    strip = caption_height(panel.height)
    font = ImageFont.load_default(strip * 0.26)
    left, right = panel.width // 4, panel.width * 5 // 8
    y = panel.height - room + round(strip * 1.08)
    height = round(strip * 0.26)
    codes = _scale_codes(np.linspace(0.0, 1.0, right - left))
    bar = np.broadcast_to(np.rint(codes).astype(np.uint8), (height, right - left, 3))
    panel.paste(Image.fromarray(np.ascontiguousarray(bar)), (left, y))
    middle = y + height / 2
    draw.text((left - strip * 0.15, middle), "0", (80, 80, 84), font, "rm")
    draw.text((right + strip * 0.15, middle), _amount(top, measure), (80, 80, 84), font, "lm")
    if alone:
        draw.rectangle((strip * 0.3, y, strip * 0.3 + height, y + height), tuple(_ALONE))
        draw.text((strip * 0.4 + height, middle), "only in one", (80, 80, 84), font, "lm")


def _scale_top(shown: Difference) -> float:
    """Return the least of 1, 2, 5, 10, 20, … that reaches the 99th percentile and a tenth of the maximum."""
    reach = max(shown.p99, shown.maximum / 10)
    if not 0 < reach < np.inf:
        return PEAKS[shown.measure]
    tens = 10.0 ** np.floor(np.log10(reach))
    return float(next(step * tens for step in (1, 2, 5, 10) if step * tens >= reach * (1 - 1e-9)))


def _scale_codes(values: Float64s) -> Float64s:
    """Return the scale's sRGB codes (…, 3) of values 0 … 1; larger values get the last colour."""
    stops = np.linspace(0.0, 1.0, len(_SCALE))
    return np.stack([np.interp(values, stops, column) for column in _SCALE.T], axis=-1)


def _amount(number: float, measure: str) -> str:
    """Format a difference with its unit; colours are out of 255, data have no unit."""
    return _text(number) + {"sRGB, 1/255": "/255", "degrees": "°"}.get(measure, "")


def _text(number: float) -> str:
    """Format a number with three digits, or as a whole number if large."""
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"
