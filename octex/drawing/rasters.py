"""Renders surfaces and leaves: finds the visible points, lights them, and averages samples into pixels."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Floats, Int64s
from octex.cameras.camera import Camera, as_size
from octex.checks import as_whole
from octex.drawing.hits import CameraView, Hits
from octex.drawing.reflection import reflected, tone_mapped
from octex.drawing.shaders import Appearance, Bump, Shader, ShownChannels, field_slopes
from octex.drawing.soft_light import background
from octex.drawing.soft_light import light as soft_light
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.parallel import cpu_count, ordered_map, workers
from octex.source.corners import Corners, Frames
from octex.source.tangents import carried
from octex.tree.morton import decode_cells
from octex.tree.normals import estimate_normals
from octex.tree.octree import walk_leaves
from octex.view.cubes import CubeBuffers, rasterize_cubes
from octex.view.zbuffer import Buffers, z_buffer

if TYPE_CHECKING:
    from octex.drawing.environment import Environment
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: Samples a batch, which bounds the memory for large images.
_BLOCK = 1 << 18
#: Largest number of transparent layers ...
_LAYERS = 64
#: ... of which drawing stops at this transmittance: a quarter of a code of sRGB's darkest light.
_OPAQUE = 2.0**-12
#: Width of the drawn cube edges, as a part of the face.
_EDGE = 0.05
_MOST_SAMPLES = 64
_MOST_PIXELS = 1 << 28


def as_image_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return a checked width and height in pixels, or raise ArgumentError."""
    width, height = as_size(size)
    if width * height > _MOST_PIXELS:
        raise ArgumentError(f"an image has at most {_MOST_PIXELS:,} pixels, not {width} × {height}")
    return width, height


def as_supersample(supersample: int) -> int:
    """Return a checked number of samples along each side of a pixel, or raise ArgumentError."""
    return as_whole(supersample, "supersample", 1, _MOST_SAMPLES)


def render_surface(
    surface: Surface, camera: Camera, shader: Shader, supersample: int = 3, light: Environment | None = None
) -> Float32s:
    """Draw a surface with a shader; return linear light (height, width, 3).

    supersample    samples along each side of a pixel, averaged in linear light
    light          environment; None: soft light from near the camera, in which colours are matte

    Transparent samples show up to 64 layers behind them, then the background.
    """
    return film_surface(surface, camera, [shader], supersample, light)[0].image()


def film_surface(
    surface: Surface,
    camera: Camera,
    shaders: list[Shader],
    supersample: int,
    light: Environment | None = None,
) -> list[Film]:
    """Render a surface to one film a shader, layer by layer where a shader is transparent."""
    films = [Film(camera, supersample) for _ in shaders]
    view = CameraView(surface, camera.scaled(supersample))
    layer: Buffers | None = None

    def appear(layer: Buffers, pixels: Int64s) -> list[Appearance]:
        hits, points = view.hits(pixels, layer)
        normals = view.normals(hits)
        return [
            lit(_with_posed_normals(shader(hits), view, hits), light, camera, points, *normals)
            for shader in shaders
        ]

    with workers() as executor:
        for _ in range(_LAYERS):
            layer = z_buffer(surface.vertices, surface.triangles, view.camera, executor, behind=layer)
            translucent = np.zeros(layer.triangle.shape, np.bool_)
            blocks = view.blocks(layer)
            shaded = ordered_map(executor, partial(appear, layer), blocks, window=2 * cpu_count())
            for pixels, appearances in zip(blocks, shaded, strict=True):
                for film, appearance in zip(films, appearances, strict=True):
                    translucent.ravel()[pixels] |= film.add(pixels, appearance)
            if not translucent.any():
                break
            layer.triangle[~translucent] = -1
    return films


def _with_posed_normals(appearance: Appearance, view: CameraView, hits: Hits) -> Appearance:
    """Return an appearance whose normals, if it has any, are turned to the posed surface."""
    if appearance.normals is None or not view.is_posed:
        return appearance
    surface, rows = view.surface, np.arange(3 * len(hits.triangles), dtype=np.int32).reshape(-1, 3)
    corners = surface.triangles[hits.triangles]
    resting, posed = surface.rest[corners].reshape(-1, 3), surface.vertices[corners].reshape(-1, 3)
    normals = Corners(np.repeat(appearance.normals, 3, axis=0).astype(np.float32), rows)
    tangents = Corners(np.tile(np.array([1, 0, 0, 1], np.float32), (1, 1)), np.zeros_like(rows))
    rotated = carried(Frames(normals, tangents), rows, resting, posed).normals.values[::3]
    return appearance._replace(normals=rotated)


def lit(
    appearance: Appearance,
    light: Environment | None,
    camera: Camera,
    points: Floats,
    faces: Floats,
    normals: Floats,
) -> Appearance:
    """Return the lit appearance of points; arrays (n, 3) as for ``soft_light.light``."""
    if appearance.reflected is None:
        return appearance
    if appearance.normals is not None:
        normals = appearance.normals
    if light is None:
        shade = soft_light(camera, points, faces, normals)
        return appearance._replace(reflected=appearance.reflected * shade[:, None])
    light_reflected = reflected(light, camera, points, faces, normals, appearance)
    if not light.tone_mapped:
        return appearance._replace(reflected=light_reflected)
    total: Floats = light_reflected if appearance.emitted is None else light_reflected + appearance.emitted
    return appearance._replace(reflected=tone_mapped(total), emitted=None)


class Film:
    """Composites samples into pixels, front to back."""

    def __init__(self, camera: Camera, supersample: int) -> None:
        self._shape = camera.height, camera.width
        self._supersample = supersample
        self._sums = np.zeros((camera.height * camera.width, 4))
        # Transmittance of each sample.
        self._transmittance = np.ones(camera.height * camera.width * supersample**2, np.float32)

    def add(self, samples: Int64s, appearance: Appearance) -> Bools:
        """Add lit samples, numbered row by row; return which ones are still transparent (n,)."""
        is_translucent = np.empty(len(samples), np.bool_)
        columns = ((appearance.reflected, (0, 3)), (appearance.emitted, (0, 3)), (appearance.coverage, 0))
        reflected, emitted, coverage = (
            np.ascontiguousarray(np.empty(shape) if part is None else part, np.float32)
            for part, shape in columns
        )
        _expose(
            samples, self._shape[1], self._supersample, reflected, emitted, coverage,
            self._transmittance, self._sums, is_translucent,
        )  # fmt: skip
        return is_translucent

    def exposure(self) -> tuple[Float64s, Float64s]:
        """Return the pixels' light (height, width, 3), multiplied by coverage, and their coverage."""
        sums = (self._sums / self._supersample**2).reshape(*self._shape, 4)
        return sums[..., :3], sums[..., 3:]

    def image(self) -> Float32s:
        """Return linear light (height, width, 3) over the backdrop."""
        color, coverage = self.exposure()
        return (color + (1.0 - coverage) * background(*self._shape)).astype(np.float32)


@kernel
def _expose(
    samples: Int64s, width: int, supersample: int, reflected: Float32s, emitted: Float32s, coverage: Float32s,
    transmittance: Float32s, sums: Float64s, is_translucent: Bools,
) -> None:  # fmt: skip
    """Add samples to pixels, ``width`` in a row. Empty light arrays mean none; empty coverage means 1."""
    for n in range(len(samples)):
        row, column = divmod(samples[n], width * supersample)
        pixel = row // supersample * width + column // supersample
        arriving = transmittance[samples[n]]
        opacity = coverage[n] if len(coverage) else np.float32(1.0)
        part, remaining = arriving * opacity, arriving * (np.float32(1.0) - opacity)
        for lane in range(3):
            if len(reflected):
                sums[pixel, lane] += float(reflected[n, lane]) * part
            if len(emitted):
                sums[pixel, lane] += float(emitted[n, lane]) * part
        sums[pixel, 3] += part
        transmittance[samples[n]] = remaining
        is_translucent[n] = remaining > _OPAQUE


class DrawnLeaves(NamedTuple):
    """All leaves of a texture, in rest units."""

    corners: Float64s  # (n, 3)   smallest coordinates
    edges: Float64s  # (n,)
    normals: Float32s  # (n, 3)

    @classmethod
    def of(cls, texture: OctreeTexture) -> DrawnLeaves:
        """Return a texture's leaves; raises ArgumentError if it has none."""
        blocks = []
        for cells, codes, depths in walk_leaves(texture.tree.arrays):
            edges = np.ldexp(1.0, -depths.astype(np.int32))
            corners = texture.placement.to_rest(decode_cells(codes) * edges[:, None])
            normals = estimate_normals(texture.tree.arrays, cells, codes, depths)
            blocks.append(cls(corners, edges * texture.placement.size, normals))
        if not blocks:
            raise ArgumentError("the texture has no leaves to draw")
        return cls.joined(*blocks)

    @classmethod
    def joined(cls, *parts: DrawnLeaves) -> DrawnLeaves:
        """Return the leaves of several sets as one."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def only(self, chosen: Bools) -> DrawnLeaves:
        """Return the leaves that a mask selects."""
        return DrawnLeaves(self.corners[chosen], self.edges[chosen], self.normals[chosen])

    def seen(self, camera: Camera) -> CubeBuffers:
        """Return the z-buffer of the leaves' cubes."""
        return rasterize_cubes(self.corners, self.edges, camera)

    @property
    def centres(self) -> Float64s:
        """Centres (n, 3)."""
        return self.corners + self.edges[:, None] / 2

    def appearance(
        self,
        texture: OctreeTexture,
        channel: str | None,
        materials: bool = False,
        bump: Bump | None = None,
        filter: str = "quadratic",
    ) -> Appearance:
        """Return a texture's appearance at the leaf centres; see ``texture_shader``."""
        formats = (channel_data.format for channel_data in texture.channels.values())
        shown = ShownChannels.of(formats, channel, materials=materials)
        appearance = shown.appearance(texture.sample(self.centres, shown.names, filter=filter))
        if bump is None:
            return appearance
        return appearance.bent(self.normals, field_slopes(texture, bump, self.centres, self.normals))


def render_leaves(
    texture: OctreeTexture,
    camera: Camera,
    *,
    level: int | None = None,
    cubes: bool = False,
    supersample: int = 3,
    channel: str | None = None,
    light: Environment | None = None,
    bump: Bump | None = None,
) -> Float32s:
    """Draw the leaves of a texture as cubes; return linear light (height, width, 3).

    level    default: the deepest level whose cells are no smaller than a pixel
    cubes    show the stored values of leaves, with lit cube faces; otherwise light the surface in the leaves

    ``channel`` and ``bump`` as for ``texture_shader``, ``light`` as for ``render_surface``.
    """
    texture = texture.level(visible_level(texture, camera) if level is None else level)
    leaves = DrawnLeaves.of(texture)
    filter = "nearest" if cubes else "quadratic"
    appearance = leaves.appearance(texture, channel, light is not None, bump, filter)
    if cubes:
        appearance = appearance._replace(normals=None)
    buffers = leaves.seen(camera.scaled(supersample))
    return film_leaves(leaves, appearance, buffers, camera, supersample, light, cubes=cubes).image()


def film_leaves(
    leaves: DrawnLeaves,
    appearance: Appearance,
    buffers: CubeBuffers,
    camera: Camera,
    supersample: int,
    light: Environment | None = None,
    *,
    cubes: bool = False,
) -> Film:
    """Render leaves, or their ``cubes``, to a film; ``buffers`` is their z-buffer."""
    film = Film(camera, supersample)
    for _ in range(_LAYERS):
        translucent = np.zeros(buffers.cube.shape, np.bool_)
        visible = np.flatnonzero(buffers.cube >= 0)
        for first in range(0, len(visible), _BLOCK):
            samples = visible[first : first + _BLOCK]
            leaf = buffers.cube.ravel()[samples]
            normals = np.eye(3)[buffers.axis.ravel()[samples]] if cubes else leaves.normals[leaf]
            shaded = Appearance(*(None if part is None else part[leaf] for part in appearance))
            shaded = lit(shaded, light, camera, leaves.corners[leaf], normals, normals)
            if cubes:  # draw the edges that separate them
                on_edge = buffers.border.ravel()[samples, None] < _EDGE
                dimmed = np.where(on_edge, np.float32(0.75), np.float32(1.0))
                reflected, emitted = (None if part is None else part * dimmed for part in shaded[:2])
                shaded = shaded._replace(reflected=reflected, emitted=emitted)
            translucent.ravel()[samples] = film.add(samples, shaded)
        if not translucent.any():
            break
        behind = buffers._replace(cube=np.where(translucent, buffers.cube, np.int32(-1)))
        buffers = rasterize_cubes(leaves.corners, leaves.edges, camera.scaled(supersample), behind)
    return film


def visible_level(texture: OctreeTexture, camera: Camera, pixels: float = 1.0) -> int:
    """Return the deepest level whose cells span at least ``pixels`` at the middle of the bounds."""
    _, depth = camera.project(texture.bounds.mean(axis=0)[None])
    width = max(pixels * float(camera.pixel_width(depth[0])), 1e-300)  # the middle may be behind the camera
    return int(np.clip(np.floor(np.log2(texture.placement.size / width)), 0, texture.tree.max_depth))
