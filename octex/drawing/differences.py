"""Draws where two textures, or a texture and a model, differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from octex.arrays import Bools, Float32s, Float64s, Uint8s
from octex.channels import srgb_to_linear
from octex.drawing.compare import (
    PEAKS,
    ComparedPoints,
    Difference,
    Differences,
    Side,
    degrees_between,
    in_common,
    inside_cells,
    placed,
    readers_of,
)
from octex.drawing.directions import DEFAULT_VIEW, Viewpoint, leaf_camera, surface_camera
from octex.drawing.hits import visible_hits
from octex.drawing.panels import caption_height, captioned, named, source_caption, texture_facts
from octex.drawing.rasters import DrawnLeaves, Film, film_leaves, film_surface, visible_level
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
    view: Viewpoint = DEFAULT_VIEW,
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

    sides = placed(a, b)
    room = round(1.6 * caption_height(size[1]))
    draw = _drawn_on_model if any(isinstance(side, Surface) for side in sides) else _drawn_leaves
    panel = (size[0] // 3, size[1]), room, view
    drawn = draw(in_common(*sides), differences, panel, supersample)
    rows = []
    for (channel, result), (images, film, ring) in zip(differences.items(), drawn, strict=True):
        panels = [
            captioned(image, name, caption(side, channel), room)
            for image, name, side in zip(images, names, sides, strict=True)
        ]
        if isinstance(sides[1], Surface):
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
    camera = surface_camera(model, _shader_of(sides[0], next(iter(differences))), *panel)
    covers = inside_cells(texture)
    for channel, result in differences.items():
        shaders = [_shader_of(side, channel) for side in sides]
        shaders.append(_difference_shader(sides, channel, differences, covers))
        *films, film = film_surface(model, camera, shaders, supersample)
        where = np.array((result.angle or result).where)
        nearest, ring = np.inf, None
        for pixels, hits in visible_hits(model, camera):
            distances = np.linalg.norm(hits.rest - where, axis=1)
            n = int(distances.argmin())
            if distances[n] < min(nearest, 3 * hits.width[n]):
                nearest, pixel = distances[n], int(pixels[n])
                ring = pixel % camera.width + 0.5, pixel // camera.width + 0.5
        yield [each.image() for each in films], film, ring


def _shader_of(side: Side, channel: str) -> Shader:
    return source_shader(side, channel) if isinstance(side, Surface) else texture_shader(side, channel)


def _difference_shader(
    sides: tuple[Side, Side], channel: str, differences: Differences, covers: Callable[..., Bools]
) -> Shader:
    appearance_of = _difference_of(sides, channel, differences)
    return lambda hits: appearance_of(
        ComparedPoints(hits.rest, hits.triangles, hits.barycentric), covers(hits.rest)
    )


def _drawn_leaves(
    sides: tuple[Side, Side], differences: Differences, panel: _Panel, supersample: int
) -> Iterator[_Row]:
    """Draw the leaves of two textures, no smaller than half a pixel, channel by channel."""
    originals = [side for side in sides if isinstance(side, OctreeTexture)]
    camera = leaf_camera(originals, next(iter(differences)), *panel)
    a, b = (texture.level(visible_level(texture, camera, pixels=0.5)) for texture in originals)
    textures, pair = (a, b), (DrawnLeaves.of(a), DrawnLeaves.of(b))
    # Draw the difference on the finer texture's leaves, and on the other's where the finer has none.
    order = (0, 1) if pair[0].edges.min() <= pair[1].edges.min() else (1, 0)
    fine, coarse = (pair[n] for n in order)
    meets_coarse, meets_fine = (inside_cells(textures[n]) for n in reversed(order))
    is_alone = ~meets_fine(coarse.centres, coarse.edges)
    added = coarse.only(is_alone)
    covered = np.append(meets_coarse(fine.centres, fine.edges), np.zeros(len(added.edges), np.bool_))
    differing = DrawnLeaves.joined(fine, added)
    leaf_sets = *pair, differing
    z_buffers = [leaves.seen(camera.scaled(supersample)) for leaves in leaf_sets]
    for channel, result in differences.items():
        appearances = [
            leaves.appearance(texture, channel) for leaves, texture in zip(pair, textures, strict=True)
        ]
        appearances.append(
            _difference_of(textures, channel, differences)(ComparedPoints(differing.centres), covered)
        )
        *films, film = (
            film_leaves(leaves, appearance, buffers, camera, supersample)
            for leaves, appearance, buffers in zip(leaf_sets, appearances, z_buffers, strict=True)
        )
        # Leaves that contain the maximum, or the centre of a leaf that does.
        where = np.array((result.angle or result).where)
        holding = np.abs(differing.centres - where).max(axis=1) <= 1.001 * differing.edges
        cubes = z_buffers[2].cube
        at = (np.argwhere((cubes >= 0) & holding[cubes]) + 0.5) / supersample
        ring = (float(at[:, 1].mean()), float(at[:, 0].mean())) if len(at) else None
        yield [each.image() for each in films], film, ring


def _difference_of(
    sides: tuple[Side, Side], channel: str, differences: Differences
) -> Callable[[ComparedPoints, Bools], Appearance]:
    """Return a function that encodes the difference as emitted red, surface of one side only as green."""
    spaces, readers = readers_of(sides, [channel], differences.width or 0.0, differences.filter)
    is_direction = spaces[channel] == "direction"

    def appearance(points: ComparedPoints, covered: Bools) -> Appearance:
        a, b = (read(points)[channel] for read in readers)
        amounts = degrees_between(a, b) if is_direction else np.abs(b - a).max(axis=1)
        emitted = np.zeros((len(amounts), 3))
        emitted[:, 0] = np.where(covered, amounts, 0.0)
        emitted[:, 1] = ~covered
        return Appearance(emitted=emitted)

    return appearance


def _difference_panel(
    film: Film, ring: tuple[float, float] | None, channel: str, result: Difference, room: int
) -> Image.Image:
    top = _scale_top(result)
    exposed, coverage = film.exposure()
    ratios, only_one = exposed[..., 0] / top, exposed[..., 1:2]
    within = np.maximum(coverage - only_one, 1e-9)
    colors = (
        srgb_to_linear(_scale_codes(ratios / within[..., 0]) / 255) * within
        + srgb_to_linear(_ALONE / 255) * only_one
    )
    image = (colors + (1.0 - coverage) * background(*ratios.shape)).astype(np.float32)
    title = f"{channel}: {_text(PEAKS[result.measure] / top)} times the difference"
    subtitle = "they do not differ"
    if result.maximum > 0:
        rms, maximum = (_amount(number, result.measure) for number in (result.rms, result.maximum))
        subtitle = f"RMS {rms}, maximum {maximum}, {'in the ring' if ring else 'out of sight'}"
    panel = captioned(image, title, subtitle, room)
    if ring and result.maximum > 0:
        draw = ImageDraw.Draw(panel)
        radius = max(panel.height / 40, 4.0)
        draw.circle(ring, radius + 2, outline=(0, 0, 0), width=2)
        draw.circle(ring, radius, outline=(255, 255, 255), width=2)
    _draw_legend(panel, top, result.measure, room, alone=bool(only_one.any()))
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


def _scale_top(result: Difference) -> float:
    """Return the least of 1, 2, 5, 10, 20, … that reaches the 99th percentile and a tenth of the maximum."""
    reach = max(result.p99, result.maximum / 10)
    if not 0 < reach < np.inf:
        return PEAKS[result.measure]
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
