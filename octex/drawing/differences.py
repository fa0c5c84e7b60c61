"""Draws where two textures, or a texture and a model, differ."""

from __future__ import annotations

from typing import NamedTuple

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
from octex.drawing.hits import Hits, rest_normals, visible_hits
from octex.drawing.panels import (
    caption_height,
    captioned,
    leaf_camera,
    named,
    source_caption,
    surface_camera,
    texture_facts,
)
from octex.drawing.pictures import Film, Leaves, film_leaves, film_surface, visible_level
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
#: Leaves are drawn no smaller than this many pixels.
_LEAF_PIXELS = 0.5


class _Row(NamedTuple):
    """One channel of both sides, and its difference."""

    pictures: list[Float32s]
    film: Film  # the difference in red, and surface of one side only in green
    ring: tuple[float, float] | None  # pixel coordinates of the maximum, if visible


def draw_difference(
    a: Side,
    b: Side,
    differences: Differences,
    names: tuple[str, str] = ("A", "B"),
    size: tuple[int, int] = (1800, 640),
    supersample: int = 3,
) -> Uint8s:
    """Draw a, b and their difference side by side, one row a channel, as sRGB codes (height, width, 3).

    found          the result of ``octex.difference``
    names          captions of a and b
    size           (width, height) of a row in pixels
    supersample    samples along each side of a pixel

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
    has_model = any(isinstance(side, Surface) for side in whole)
    kind = _OnModel if has_model else _TwoTrees
    sides = kind(in_common(*whole), differences, (size[0] // 3, size[1]), room, supersample)
    rows = []
    for channel, result in differences.items():
        row = sides.row(channel)
        panels = [
            captioned(picture, name, caption(side, channel), room)
            for picture, name, side in zip(row.pictures, names, whole, strict=True)
        ]
        panels.append(_difference_panel(row, channel, result.angle or result, room))
        rows.append(np.hstack([np.asarray(panel) for panel in panels]))
    return np.vstack(rows)


class _OnModel:
    """Draws a model coloured by itself and by a texture."""

    def __init__(
        self,
        sides: tuple[Side, Side],
        differences: Differences,
        size: tuple[int, int],
        room: int,
        supersample: int,
    ) -> None:
        self._sides, self._found, self._supersample = sides, differences, supersample
        (self._model,) = (side for side in sides if isinstance(side, Surface))
        (texture,) = (side for side in sides if isinstance(side, OctreeTexture))
        self._covers = inside_cells(texture)
        self._camera = surface_camera(self._model, self._look(sides[0], next(iter(differences))), size, room)

    @staticmethod
    def _look(side: Side, channel: str) -> Shader:
        return source_shader(side, channel) if isinstance(side, Surface) else texture_shader(side, channel)

    def row(self, channel: str) -> _Row:
        """Draw a channel."""
        apart = _Apart(self._sides, channel, self._found)

        def difference(hits: Hits) -> Appearance:
            points = Points(hits.rest, hits.triangles, hits.barycentric)
            return apart.appearance(points, self._covers(hits.rest))

        looks = [*(self._look(side, channel) for side in self._sides), difference]
        *films, film = film_surface(self._model, self._camera, looks, self._supersample)
        where = np.array((self._found[channel].angle or self._found[channel]).where)
        nearest, ring = np.inf, None
        for pixels, hits in visible_hits(self._model, self._camera, rest_normals(self._model)):
            distances = np.linalg.norm(hits.rest - where, axis=1)
            n = int(distances.argmin())
            if distances[n] < min(nearest, 3 * hits.width[n]):
                nearest, pixel = distances[n], int(pixels[n])
                ring = pixel % self._camera.width + 0.5, pixel // self._camera.width + 0.5
        return _Row([each.picture() for each in films], film, ring)


class _TwoTrees:
    """Draws the leaves of two textures, no smaller than half a pixel."""

    def __init__(
        self,
        sides: tuple[Side, Side],
        differences: Differences,
        size: tuple[int, int],
        room: int,
        supersample: int,
    ) -> None:
        whole = [side for side in sides if isinstance(side, OctreeTexture)]
        self._found, self._supersample = differences, supersample
        self._camera = leaf_camera(whole, next(iter(differences)), size, room)
        a, b = (texture.level(visible_level(texture, self._camera, _LEAF_PIXELS)) for texture in whole)
        self._textures = a, b
        both = Leaves.of(a), Leaves.of(b)
        # Draw the difference on the finer texture's leaves, and on the other's where the finer has none.
        order = (0, 1) if both[0].edges.min() <= both[1].edges.min() else (1, 0)
        fine, coarse = (both[n] for n in order)
        meets_coarse, meets_fine = (inside_cells(self._textures[n]) for n in reversed(order))
        alone = ~meets_fine(coarse.centres, coarse.edges)
        covered = meets_coarse(fine.centres, fine.edges)
        self._covered = np.concatenate([covered, np.zeros(int(alone.sum()), np.bool_)])
        self._leaves = (
            *both,
            Leaves.joined(fine, Leaves(coarse.corners[alone], coarse.edges[alone], coarse.normals[alone])),
        )
        self._seen = [leaves.seen(self._camera.scaled(supersample)) for leaves in self._leaves]

    def row(self, channel: str) -> _Row:
        """Draw a channel."""
        differing = self._leaves[2]
        apart = _Apart(self._textures, channel, self._found)
        appearances = [
            leaves.appearance(texture, channel)
            for leaves, texture in zip(self._leaves[:2], self._textures, strict=True)
        ]
        appearances.append(apart.appearance(Points(differing.centres), self._covered))
        a, b, film = (
            film_leaves(leaves, appearance, seen, self._camera, self._supersample)
            for leaves, appearance, seen in zip(self._leaves, appearances, self._seen, strict=True)
        )
        # Leaves that contain the maximum, or the centre of a leaf that does.
        where = np.array((self._found[channel].angle or self._found[channel]).where)
        holding = np.abs(differing.centres - where).max(axis=1) <= 1.001 * differing.edges
        seen = self._seen[2].cube
        at = (np.argwhere((seen >= 0) & holding[seen]) + 0.5) / self._supersample
        ring = (float(at[:, 1].mean()), float(at[:, 0].mean())) if len(at) else None
        return _Row([a.picture(), b.picture()], film, ring)


class _Apart:
    """Encodes the difference of two sides as emitted red, and surface of one side only as green."""

    def __init__(self, sides: tuple[Side, Side], channel: str, differences: Differences) -> None:
        self._channel = channel
        self._readers = readers_of(sides, [channel], differences.width or 0.0, differences.filter)

    def appearance(self, points: Points, covered: Bools) -> Appearance:
        a, b = (reader.read(points)[self._channel] for reader in self._readers)
        is_direction = self._readers[0].spaces[self._channel] == "direction"
        apart = degrees_between(a, b) if is_direction else np.abs(b - a).max(axis=1)
        emitted = np.zeros((len(apart), 3))
        emitted[:, 0] = np.where(covered, apart, 0.0)
        emitted[:, 1] = ~covered
        return Appearance(emitted=emitted)


def _difference_panel(row: _Row, channel: str, shown: Difference, room: int) -> Image.Image:
    top = _scale_top(shown)
    exposed, coverage = row.film.exposure()
    apart, alone = exposed[..., 0] / top, exposed[..., 1:2]
    within = np.maximum(coverage - alone, 1e-9)
    colors = (
        srgb_to_linear(_scale_codes(apart / within[..., 0]) / 255) * within
        + srgb_to_linear(_ALONE / 255) * alone
    )
    picture = (colors + (1.0 - coverage) * background(*apart.shape)).astype(np.float32)
    ring = row.ring if shown.maximum > 0 else None
    place = "in the ring" if ring else "out of sight"
    most = f"maximum {_amount(shown.maximum, shown.measure)}, {place}"
    title = f"{channel}: {_text(PEAKS[shown.measure] / top)} times the difference"
    subtitle = (
        f"RMS {_amount(shown.rms, shown.measure)}, {most}" if shown.maximum > 0 else "they do not differ"
    )
    panel = captioned(picture, title, subtitle, room)
    draw = ImageDraw.Draw(panel)
    if ring:
        x, y = ring
        radius = max(panel.height / 40, 4.0)
        for grow, color in ((2, (0, 0, 0)), (0, (255, 255, 255))):
            size = radius + grow
            draw.ellipse((x - size, y - size, x + size, y + size), outline=color, width=2)
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
    return _text(number) + {"sRGB codes": "/255", "degrees": "°"}.get(measure, "")


def _text(number: float) -> str:
    """Format a number with three digits, or as a whole number if large."""
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"
