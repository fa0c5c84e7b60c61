"""Pictures for people: a model as its source colours it, and beside it as its octree does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from octex.channels import decode, encode, linear_to_srgb
from octex.checks import as_choice
from octex.container import replacing
from octex.errors import ArgumentError
from octex.tree.morton import decode_cells
from octex.tree.normals import estimate_normals
from octex.tree.walk import walk_leaves
from octex.view.camera import Camera
from octex.view.cubes import rasterize_cubes
from octex.view.rasterize import rasterize
from octex.view.shading import background, corner_normals, face_normals, light

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

Floats = npt.NDArray[np.floating]

#: Samples are coloured this many at a time, so that a large picture needs little memory.
_BLOCK = 1 << 18
#: From the model toward the camera: from the front (glTF's +z), a little from the right and from above.
_THREE_QUARTER = np.array([0.56, 0.42, 1.0]) / np.linalg.norm([0.56, 0.42, 1.0])
#: A model is flat if this part of its squared normals is along one axis; it is seen this much from the side.
_FLAT, _SLANT = 0.85, 0.45
#: Another side is shown than the usual one if it has so many times its detail.
_CLEARLY = 1.1


class Hits(NamedTuple):
    """Points of a surface that a picture's samples see."""

    triangles: npt.NDArray[np.int32]  # (n,)
    barycentric: npt.NDArray[np.float64]  # (n, 3)
    rest: npt.NDArray[np.float64]  # (n, 3)   rest positions
    width: npt.NDArray[np.float32]  # (n,)   what a sample covers there, in rest units


#: Gives hits their colours: linear light (n, 3), or with coverage (n, 4), not multiplied by it.
Look = Callable[[Hits], Floats]


def source_look(surface: Surface) -> Look:
    """Colour a surface by its source, averaged over what each sample covers.

    Raises ArgumentError if the source has no base colour.
    """
    names = [channel.name for channel in surface.channels]
    wanted = _color_channels(names)
    ends = np.cumsum([channel.components for channel in surface.channels])
    columns = [np.arange(end - c.components, end) for end, c in zip(ends, surface.channels, strict=True)]
    chosen = np.concatenate([columns[names.index(name)] for name in wanted])

    def look(hits: Hits) -> Floats:
        return surface.evaluate_all(hits.triangles, hits.barycentric, hits.width)[:, chosen]

    return look


def texture_look(texture: OctreeTexture) -> Look:
    """Colour a surface by the nearest cells of a texture, of the level that suits what each sample covers.

    Raises ArgumentError if the texture has no base colour.
    """
    names = _color_channels(list(texture.channels))
    level_of = cache(texture.level)

    def look(hits: Hits) -> Floats:
        # The first level whose cells are no larger than what the sample covers.
        levels = np.ceil(np.log2(texture.placement.size / np.maximum(hits.width, 1e-30)))
        levels = np.clip(levels, 0, texture.tree.max_depth).astype(np.int64)
        colors = np.empty((len(levels), 4 if "alpha" in names else 3), np.float32)
        for level in np.unique(levels):
            at = levels == level
            values = level_of(int(level)).sample(hits.rest[at], names)
            colors[at] = np.hstack([values[name] for name in names])
        return colors

    return look


def _color_channels(names: list[str]) -> list[str]:
    as_choice("base_color", names, "channel")
    return ["base_color", "alpha"] if "alpha" in names else ["base_color"]


def render(surface: Surface, camera: Camera, look: Look, supersample: int = 3) -> npt.NDArray[np.float32]:
    """Picture a surface in studio light; return linear light (height, width, 3).

    supersample    samples along each side of a pixel; they are averaged in linear light

    Where the look has coverage, only the nearest layer is drawn, over the background.
    """
    return _render(surface, camera, [look], supersample)[0]


def _render(
    surface: Surface, camera: Camera, looks: list[Look], supersample: int
) -> list[npt.NDArray[np.float32]]:
    faces, _ = face_normals(surface.vertices, surface.triangles)
    smooth = corner_normals(surface.vertices, surface.triangles)
    films = [_Film(camera, supersample) for _ in looks]
    for samples, hits in _hits(surface, camera.scaled(supersample)):
        points = _between(hits.barycentric, surface.vertices[surface.triangles[hits.triangles]])
        lit = light(camera, points, faces[hits.triangles], _between(hits.barycentric, smooth[hits.triangles]))
        for film, look in zip(films, looks, strict=True):
            film.add(samples, look(hits), lit)
    return [film.picture() for film in films]


def _hits(surface: Surface, camera: Camera) -> Iterator[tuple[npt.NDArray[np.int64], Hits]]:
    """Yield what the camera's pixels see, some at a time, with their numbers row by row."""
    buffers = rasterize(surface.vertices, surface.triangles, camera)
    # What is one wide on the posed model is so wide at rest.
    _, posed_areas = face_normals(surface.vertices, surface.triangles)
    _, rest_areas = face_normals(surface.rest, surface.triangles)
    stretch = np.sqrt(rest_areas / np.maximum(posed_areas, 1e-300))
    seen = np.flatnonzero(buffers.triangle >= 0)
    for first in range(0, len(seen), _BLOCK):
        pixels = seen[first : first + _BLOCK]
        triangles = buffers.triangle.ravel()[pixels]
        barycentric = buffers.barycentric.reshape(-1, 3)[pixels].astype(np.float64)
        width = camera.pixel_width(buffers.depth.ravel()[pixels]) * stretch[triangles]
        rest = _between(barycentric, surface.rest[surface.triangles[triangles]])
        yield pixels, Hits(triangles, barycentric, rest, width.astype(np.float32))


class _Film:
    """Gathers coloured samples into a picture over the backdrop."""

    def __init__(self, camera: Camera, supersample: int) -> None:
        self._shape = camera.height, camera.width
        self._supersample = supersample
        self._sums = np.zeros((4, camera.height * camera.width))

    def add(self, samples: npt.NDArray[np.int64], colors: Floats, lit: Floats) -> None:
        """Add samples, numbered row by row in the supersampled picture."""
        row, column = np.divmod(samples, self._shape[1] * self._supersample)
        pixel = row // self._supersample * self._shape[1] + column // self._supersample
        coverage = colors[:, 3] if colors.shape[1] == 4 else np.ones(len(colors))
        for total, color in zip(self._sums, colors.T[:3], strict=False):
            total += np.bincount(pixel, color * lit * coverage, len(total))
        self._sums[3] += np.bincount(pixel, coverage, self._sums.shape[1])

    def picture(self) -> npt.NDArray[np.float32]:
        """Return linear light (height, width, 3)."""
        *color, coverage = (self._sums / self._supersample**2).reshape(4, *self._shape)
        uncovered = (1.0 - coverage)[..., None]
        return (np.stack(color, axis=-1) + uncovered * background(*self._shape)).astype(np.float32)


def _between(barycentric: Floats, corners: Floats) -> npt.NDArray[np.float64]:
    """Interpolate corners (n, 3, 3) of triangles at barycentric coordinates (n, 3)."""
    return cast("npt.NDArray[np.float64]", np.einsum("nk,nkc->nc", barycentric, corners))


def render_leaves(
    texture: OctreeTexture,
    camera: Camera,
    *,
    level: int | None = None,
    cubes: bool = False,
    supersample: int = 3,
) -> npt.NDArray[np.float32]:
    """Picture the leaves of a texture as cubes; return linear light (height, width, 3).

    level    the finest to draw; default: the deepest whose cells are no smaller than a pixel
    cubes    light the faces of the cubes, instead of the surface that the leaves lie on
    """
    finest = _visible_level(texture, camera) if level is None else level
    leaves = _Leaves.of(texture.level(min(finest, texture.tree.max_depth)))
    seen, axis, border, _ = rasterize_cubes(leaves.corners, leaves.edges, camera.scaled(supersample))
    film = _Film(camera, supersample)
    drawn = np.flatnonzero(seen >= 0)
    for first in range(0, len(drawn), _BLOCK):
        samples = drawn[first : first + _BLOCK]
        leaf = seen.ravel()[samples]
        normals = np.eye(3)[axis.ravel()[samples]] if cubes else leaves.normals[leaf]
        lit = light(camera, leaves.corners[leaf], normals, normals)
        if cubes:  # with their edges drawn, so that they can be told apart
            lit = lit * np.where(border.ravel()[samples] < 0.05, np.float32(0.75), np.float32(1.0))
        film.add(samples, leaves.colors[leaf], lit)
    return film.picture()


class _Leaves(NamedTuple):
    """All leaves of a texture, in rest units."""

    corners: npt.NDArray[np.float64]  # (n, 3)   least coordinates
    edges: npt.NDArray[np.float64]  # (n,)
    normals: npt.NDArray[np.float32]  # (n, 3)
    colors: npt.NDArray[np.float32]  # (n, 3 or 4)   linear light, and coverage

    @classmethod
    def of(cls, texture: OctreeTexture) -> _Leaves:
        channels = [texture.channels[name] for name in _color_channels(list(texture.channels))]
        blocks = []
        for cells, codes, depths in walk_leaves(texture.tree.arrays):
            edges = np.ldexp(1.0, -depths.astype(np.int32))
            corners = texture.placement.to_rest(decode_cells(codes) * edges[:, None])
            normals = estimate_normals(texture.tree.arrays, cells, codes, depths)
            colors = np.hstack([decode(channel.values[cells], channel.format.space) for channel in channels])
            blocks.append((corners, edges * texture.placement.size, normals, colors))
        if not blocks:
            raise ArgumentError("the texture has no leaves to draw")
        return cls(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _visible_level(texture: OctreeTexture, camera: Camera, pixels: float = 1.0) -> int:
    """Return the deepest level whose cells are no smaller than ``pixels`` in the middle of the bounds."""
    _, depth = camera.project(texture.bounds.mean(axis=0)[None])
    level = np.floor(np.log2(texture.placement.size / (pixels * camera.pixel_width(depth[0]))))
    return int(np.clip(level, 0, texture.tree.max_depth))


def view_directions(normals: Floats, areas: Floats) -> npt.NDArray[np.float64]:
    """Return directions (k, 3) to look at a model from, unit vectors toward the camera; the usual one first.

    normals    (n, 3) unit normals of its parts, and
    areas      (n,) their areas
    """
    weights = areas / max(float(areas.sum()), 1e-300)
    strengths, axes = np.linalg.eigh(np.einsum("n,nc,nd->cd", weights, normals, normals))
    if strengths[2] < _FLAT:
        sides = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, -1.0]])
        return cast("npt.NDArray[np.float64]", sides * _THREE_QUARTER)
    # Flat: along the normal and a little aslant, from the side that more of it faces, or else from either.
    normal = axes[:, 2] * (1.0 if axes[:, 2] @ _THREE_QUARTER >= 0.0 else -1.0)
    facing = normals @ normal
    excess = float((weights * facing * np.abs(facing)).sum())
    normals = np.array([normal, -normal] if abs(excess) < 0.1 else [np.sign(excess) * normal])
    slants = _THREE_QUARTER - (normals @ _THREE_QUARTER)[:, None] * normals
    directions = normals + _SLANT * slants / np.maximum(np.linalg.norm(slants, axis=1, keepdims=True), 1e-3)
    return cast("npt.NDArray[np.float64]", directions / np.linalg.norm(directions, axis=1, keepdims=True))


def best_direction(
    directions: Floats, points: Floats, unlit: Callable[[Camera], Floats]
) -> npt.NDArray[np.float64]:
    """Choose the direction (3,) from which a model shows most detail; not the first only if clearly so.

    points    (n, 3) of the model
    unlit     makes its picture (height, width, 3) without light: sRGB values, NaN where it is not
    """
    details = []
    for direction in directions if len(directions) > 1 else ():
        picture = unlit(Camera.fitted(points, direction, size=(96, 96)))
        details.append(sum(float(np.nansum(np.abs(np.diff(picture, axis=axis)))) for axis in (0, 1)))
    clearly = [detail > _CLEARLY * details[0] for detail in details]
    best: npt.NDArray[np.float64] = directions[int(np.argmax(details)) if any(clearly) else 0]
    return best


def _unlit_surface(surface: Surface, look: Look, camera: Camera) -> Floats:
    picture = np.full((camera.height * camera.width, 3), np.nan)
    for pixels, hits in _hits(surface, camera):
        picture[pixels] = linear_to_srgb(look(hits)[:, :3])
    return picture.reshape(camera.height, camera.width, 3)


def _unlit_leaves(leaves: _Leaves, camera: Camera) -> Floats:
    seen = rasterize_cubes(leaves.corners, leaves.edges, camera).cube
    picture = np.full((*seen.shape, 3), np.nan)
    picture[seen >= 0] = linear_to_srgb(leaves.colors[seen[seen >= 0], :3])
    return picture


def write_preview(
    path: str | Path,
    surface: Surface | None,
    texture: OctreeTexture | None = None,
    size: tuple[int, int] = (1600, 880),
    supersample: int = 3,
) -> None:
    """Write what ``draw_preview`` draws as a PNG file.

    What stood at ``path`` before is replaced when all is drawn, or not at all. Raises OutputError if the file
    cannot be written, and ArgumentError as ``draw_preview`` does.
    """
    picture = Image.fromarray(draw_preview(surface, texture, size, supersample))
    with replacing(path) as file:
        picture.save(file, "PNG")


def draw_preview(
    surface: Surface | None,
    texture: OctreeTexture | None = None,
    size: tuple[int, int] = (1600, 880),
    supersample: int = 3,
    note: str = "",
) -> npt.NDArray[np.uint8]:
    """Draw a picture, sRGB codes (height, width, 3), that shows at once whether a texture is right.

    With a surface and a texture: the model coloured by its source and, beside it, by the octree. With a
    surface alone: the model. With a texture alone: its leaves, and the cubes of a coarser level.

    size           (width, height) in pixels
    supersample    samples along each side of a pixel
    note           what else the caption should say of the octree

    Raises ArgumentError for neither a surface nor a texture, or if there is no leaf or base colour to show.
    """
    if surface is not None:
        panels = _model_panels(surface, texture, size, supersample, note)
    elif texture is not None:
        panels = _leaf_panels(texture, size, supersample, note)
    else:
        raise ArgumentError("a preview needs a surface, or a texture, or both")
    return np.hstack([_captioned(panel) for panel in panels])


class _Panel(NamedTuple):
    picture: npt.NDArray[np.float32]  # (height, width, 3)   linear light
    title: str
    subtitle: str


def _model_panels(
    surface: Surface, texture: OctreeTexture | None, size: tuple[int, int], supersample: int, note: str
) -> list[_Panel]:
    looks = [source_look(surface)]
    captions = [(surface.name, f"source, {_count(len(surface.triangles), 'triangle')}")]
    if texture is not None:
        looks.append(texture_look(texture))
        captions.append(_texture_caption(texture, note))
    points = surface.vertices[np.unique(surface.triangles)]
    directions = view_directions(*face_normals(surface.vertices, surface.triangles))
    direction = best_direction(directions, points, partial(_unlit_surface, surface, looks[0]))
    camera = _panel_camera(points, direction, size, len(looks))
    pictures = _render(surface, camera, looks, supersample)
    return [_Panel(picture, *caption) for picture, caption in zip(pictures, captions, strict=True)]


def _leaf_panels(texture: OctreeTexture, size: tuple[int, int], supersample: int, note: str) -> list[_Panel]:
    # Coarse cells are enough to find out where the model is and from where to look at it.
    coarse = _Leaves.of(texture.level(min(7, texture.tree.max_depth)))
    points = np.concatenate([coarse.corners, coarse.corners + coarse.edges[:, None]])
    directions = view_directions(coarse.normals, coarse.edges**2)
    direction = best_direction(directions, points, partial(_unlit_leaves, coarse))
    camera = _panel_camera(points, direction, size, 2)
    level = _visible_level(texture, camera, pixels=10.0)
    title, subtitle = _texture_caption(texture, note)
    return [
        _Panel(render_leaves(texture, camera, supersample=supersample), title, subtitle),
        _Panel(
            render_leaves(texture, camera, level=level, cubes=True, supersample=supersample),
            f"level {level}",
            _count(texture.level(level).tree.n_leaves, "cell"),
        ),
    ]


def _panel_camera(points: Floats, direction: Floats, size: tuple[int, int], panels: int) -> Camera:
    """Make the camera of one of some panels side by side, with room for a caption below the model."""
    width, height = size[0] // panels, size[1]
    camera = Camera.fitted(points, direction, size=(width, height - _caption_height(height)))
    return replace(camera, height=height)


def _texture_caption(texture: OctreeTexture, note: str) -> tuple[str, str]:
    tree = texture.tree
    facts = [
        _count(tree.n_leaves, "leaf", "leaves"),
        f"{texture.nbytes / 1e6:.3g} MB",
        *([note] if note else []),
    ]
    return f"octree, depth {tree.max_depth}", ", ".join(facts)


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _caption_height(height: int) -> int:
    return max(height // 11, 24)


def _captioned(panel: _Panel) -> npt.NDArray[np.uint8]:
    """Return a panel as sRGB codes (height, width, 3), with its caption at the bottom."""
    picture = Image.fromarray(encode(panel.picture, "uint8", "srgb"))
    strip = _caption_height(picture.height)
    title, subtitle = ImageFont.load_default(strip * 0.36), ImageFont.load_default(strip * 0.28)
    draw = ImageDraw.Draw(picture)
    middle, top = picture.width // 2, picture.height - strip
    draw.text((middle, top + strip * 0.05), panel.title, (30, 30, 32), title, "ma")
    draw.text((middle, top + strip * 0.50), panel.subtitle, (80, 80, 84), subtitle, "ma")
    return np.asarray(picture)
