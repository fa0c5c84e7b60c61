"""Pictures of surfaces and of leaves: what each sample sees, how it is lit, and how samples become pixels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Floats, Int32s, Int64s
from octex.errors import ArgumentError
from octex.preview.shaders import Appearance, Bump, Hits, Shader, Shown, bent, field_slopes
from octex.source.corners import Corners, Frames
from octex.source.tangents import carried
from octex.tree.morton import decode_cells
from octex.tree.normals import estimate_normals
from octex.tree.walk import walk_leaves
from octex.view.camera import Camera
from octex.view.cubes import CubeBuffers, rasterize_cubes
from octex.view.reflection import Material, reflected
from octex.view.shading import background, corner_normals, face_normals
from octex.view.shading import light as soft_light
from octex.view.zbuffer import Buffers, z_buffer

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture
    from octex.view.environment import Environment

#: Samples are coloured this many at a time, so that a large picture needs little memory.
_BLOCK = 1 << 18
#: So many layers are drawn where things are transparent ...
_LAYERS = 64
#: ... until no more than this shines through: a quarter of a code of sRGB's darkest light.
_OPAQUE = 2.0**-12
#: Of the faces of cubes, so much along each side is drawn as their edges.
_EDGE = 0.05


def render(
    surface: Surface, camera: Camera, look: Shader, supersample: int = 3, light: Environment | None = None
) -> Float32s:
    """Picture a surface; return linear light (height, width, 3).

    supersample    samples along each side of a pixel; they are averaged in linear light
    light          what lights it from all around; None: soft light from beside the camera, in which colours
                   are matte

    Where the look has coverage, what is behind shows through: layers by depth, up to 64, then the background.
    """
    return film_surface(surface, camera, [look], supersample, light)[0].picture()


def film_surface(
    surface: Surface,
    camera: Camera,
    looks: list[Shader],
    supersample: int,
    light: Environment | None = None,
) -> list[Film]:
    """Expose a film to a surface for each look, layer by layer where one of them lets light through."""
    faces, _ = face_normals(surface.vertices, surface.triangles)
    smooth = corner_normals(surface.vertices, surface.triangles)
    resting = rest_normals(surface) if _is_posed(surface) else smooth
    films = [Film(camera, supersample) for _ in looks]
    fine, layer = camera.scaled(supersample), None
    for _ in range(_LAYERS):
        layer = z_buffer(surface.vertices, surface.triangles, fine, behind=layer)
        opened = np.zeros(layer.triangle.shape, np.bool_)
        for samples, hits in visible_hits(surface, fine, resting, layer):
            points = _between(hits.barycentric, surface.vertices[surface.triangles[hits.triangles]])
            normals = _between(hits.barycentric, smooth[hits.triangles])
            for film, look in zip(films, looks, strict=True):
                appearance = look(hits)
                others = posed_normals(surface, hits.triangles, appearance.normals)
                seen = lit(appearance, light, camera, points, faces[hits.triangles], normals, others)
                opened.ravel()[samples] |= film.add(samples, seen)
        if not opened.any():
            break
        layer.triangle[~opened] = -1
    return films


def lit(
    appearance: Appearance,
    light: Environment | None,
    camera: Camera,
    points: Floats,
    faces: Floats,
    normals: Floats,
    others: Floats | None = None,
) -> Appearance:
    """Return what points look like in a light: all of it reflected toward the camera.

    ``points``, ``faces`` and ``normals`` (n, 3) as for ``shading.light``; ``others`` are normals instead.
    """
    if appearance.reflected is None:
        return appearance
    normals = normals if others is None else others
    if light is None:
        shade = soft_light(camera, points, faces, normals)
        return appearance._replace(reflected=appearance.reflected * shade[:, None])
    material = Material(
        appearance.reflected, appearance.metallic, appearance.roughness, appearance.occlusion,
        appearance.specular,
    )  # fmt: skip
    return appearance._replace(reflected=reflected(light, camera, points, faces, normals, material))


def posed_normals(surface: Surface, triangles: Int32s, normals: Floats | None) -> Floats | None:
    """Return what normals at rest (n, 3), on triangles (n,), are on the posed surface."""
    if normals is None or not _is_posed(surface):
        return normals
    rows = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
    corners = surface.triangles[triangles]
    resting, posed = surface.rest[corners].reshape(-1, 3), surface.vertices[corners].reshape(-1, 3)
    each = Corners(np.repeat(normals, 3, axis=0).astype(np.float32), rows)
    tangents = Corners(np.tile(np.array([1, 0, 0, 1], np.float32), (1, 1)), np.zeros_like(rows))
    return carried(Frames(each, tangents), rows, resting, posed).normals.values[::3]


def rest_normals(surface: Surface) -> Float32s:
    """Return smooth normals (m, 3, 3) at the corners of triangles at rest."""
    return corner_normals(surface.rest, surface.triangles)


def _is_posed(surface: Surface) -> bool:
    return not np.array_equal(surface.rest, surface.vertices)


def visible_hits(
    surface: Surface, camera: Camera, normals: Float32s, buffers: Buffers | None = None
) -> Iterator[tuple[Int64s, Hits]]:
    """Yield what the camera's pixels see, some at a time, with their numbers row by row.

    ``normals`` are the surface's ``rest_normals``; ``buffers`` say what is seen, by default the nearest.
    """
    if buffers is None:
        buffers = z_buffer(surface.vertices, surface.triangles, camera)
    # What is one wide on the posed model is so wide at rest.
    faces, posed_areas = face_normals(surface.vertices, surface.triangles)
    _, rest_areas = face_normals(surface.rest, surface.triangles)
    stretch = np.sqrt(rest_areas / np.maximum(posed_areas, 1e-300))
    is_posed = _is_posed(surface)
    seen = np.flatnonzero(buffers.triangle >= 0)
    for first in range(0, len(seen), _BLOCK):
        pixels = seen[first : first + _BLOCK]
        triangles = buffers.triangle.ravel()[pixels]
        barycentric = buffers.barycentric.reshape(-1, 3)[pixels].astype(np.float64)
        width = camera.pixel_width(buffers.depth.ravel()[pixels]) * stretch[triangles]
        rest = _between(barycentric, surface.rest[surface.triangles[triangles]])
        posed = _between(barycentric, surface.vertices[surface.triangles[triangles]])
        right, down = camera.differentials(posed, faces[triangles])
        if is_posed:
            right, down = _at_rest(surface, triangles, right, down)
        facing = _between(barycentric, normals[triangles])
        yield pixels, Hits(triangles, barycentric, rest, width.astype(np.float32), right, down, facing)


def _at_rest(surface: Surface, triangles: Int32s, *steps: Float64s) -> Iterator[Float64s]:
    """Yield what steps (n, 3) on posed triangles (n,) are at rest."""
    used, places = np.unique(triangles, return_inverse=True)
    posed, rest = (
        np.diff(positions[surface.triangles[used]], axis=1) for positions in (surface.vertices, surface.rest)
    )
    maps = np.einsum("mki,mjk->mij", rest, np.linalg.pinv(posed))
    return (np.einsum("nij,nj->ni", maps[places], step) for step in steps)


class Film:
    """Gathers samples into pixels, those in front before those behind them."""

    def __init__(self, camera: Camera, supersample: int) -> None:
        self._shape = camera.height, camera.width
        self._supersample = supersample
        self._sums = np.zeros((4, camera.height * camera.width))
        # What each sample lets through of what is behind.
        self._passed = np.ones(camera.height * camera.width * supersample**2, np.float32)

    def add(self, samples: Int64s, appearance: Appearance) -> Bools:
        """Add samples, numbered row by row in the supersampled picture, as they look in the light.

        Returns whether more is seen behind each (n,).
        """
        row, column = np.divmod(samples, self._shape[1] * self._supersample)
        pixel = row // self._supersample * self._shape[1] + column // self._supersample
        passed = self._passed[samples]
        own = np.float32(1.0) if appearance.coverage is None else appearance.coverage
        coverage, left = passed * own, passed * (1.0 - own)
        self._passed[samples] = left
        for colors in (appearance.reflected, appearance.emitted):
            if colors is not None:
                for total, color in zip(self._sums[:3], colors.T, strict=True):
                    total += np.bincount(pixel, color * coverage, len(total))
        self._sums[3] += np.bincount(pixel, coverage, self._sums.shape[1])
        return np.asarray(left > _OPAQUE)

    def exposure(self) -> tuple[Float64s, Float64s]:
        """Return the pixels' sums (height, width, 3), already multiplied by their coverage, and that."""
        *color, coverage = (self._sums / self._supersample**2).reshape(4, *self._shape)
        return np.stack(color, axis=-1), coverage[..., None]

    def picture(self) -> Float32s:
        """Return linear light (height, width, 3) over the backdrop."""
        color, coverage = self.exposure()
        return (color + (1.0 - coverage) * background(*self._shape)).astype(np.float32)


def _between(barycentric: Floats, corners: Floats) -> Float64s:
    """Interpolate corners (n, 3, 3) of triangles at barycentric coordinates (n, 3)."""
    return cast("Float64s", np.einsum("nk,nkc->nc", barycentric, corners))


class Leaves(NamedTuple):
    """All leaves of a texture, in rest units."""

    corners: Float64s  # (n, 3)   least coordinates
    edges: Float64s  # (n,)
    normals: Float32s  # (n, 3)

    @classmethod
    def of(cls, texture: OctreeTexture) -> Leaves:
        """Gather them; raises ArgumentError if there are none."""
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
    def joined(cls, *parts: Leaves) -> Leaves:
        """Return all leaves of some parts."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def only(self, chosen: Bools) -> Leaves:
        """Return some of them."""
        return Leaves(self.corners[chosen], self.edges[chosen], self.normals[chosen])

    def seen(self, camera: Camera) -> CubeBuffers:
        """Return which of them a camera sees."""
        return rasterize_cubes(self.corners, self.edges, camera)

    @property
    def centres(self) -> Float64s:
        """Where their middles are (n, 3)."""
        return self.corners + self.edges[:, None] / 2

    def appearance(
        self,
        texture: OctreeTexture,
        channel: str | None = None,
        *,
        materials: bool = False,
        bump: Bump | None = None,
    ) -> Appearance:
        """Return what a texture shows in their middles; as for ``texture_shader``."""
        formats = (stored.format for stored in texture.channels.values())
        shown = Shown.of(formats, channel, materials=materials)
        appearance = shown.appearance(texture.sample(self.centres, shown.names))
        if bump is None:
            return appearance
        normals = self.normals if appearance.normals is None else appearance.normals
        slopes = field_slopes(texture, bump, self.centres, self.normals)
        return appearance._replace(normals=bent(normals, slopes))


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
    """Picture the leaves of a texture as cubes; return linear light (height, width, 3).

    level      the finest to draw; default: the deepest whose cells are no smaller than a pixel
    cubes      light the faces of the cubes, instead of the surface that the leaves lie on
    channel    what to show, as for ``source_shader``
    light      as for ``render``
    bump       as for ``texture_shader``
    """
    texture = texture.level(visible_level(texture, camera) if level is None else level)
    leaves = Leaves.of(texture)
    appearance = leaves.appearance(texture, channel, materials=light is not None, bump=bump)
    buffers = leaves.seen(camera.scaled(supersample))
    return film_leaves(leaves, appearance, buffers, camera, supersample, light, cubes=cubes).picture()


def film_leaves(
    leaves: Leaves,
    appearance: Appearance,
    buffers: CubeBuffers,
    camera: Camera,
    supersample: int,
    light: Environment | None = None,
    *,
    cubes: bool = False,
) -> Film:
    """Expose a film to leaves as they appear, or to their ``cubes``; ``buffers`` say what samples see."""
    film = Film(camera, supersample)
    for _ in range(_LAYERS):
        opened = np.zeros(buffers.cube.shape, np.bool_)
        drawn = np.flatnonzero(buffers.cube >= 0)
        for first in range(0, len(drawn), _BLOCK):
            samples = drawn[first : first + _BLOCK]
            leaf = buffers.cube.ravel()[samples]
            normals = np.eye(3)[buffers.axis.ravel()[samples]] if cubes else leaves.normals[leaf]
            here = Appearance(*(None if part is None else part[leaf] for part in appearance))
            others = None if cubes else here.normals
            here = lit(here, light, camera, leaves.corners[leaf], normals, normals, others)
            if cubes:  # with their edges drawn, so that they can be told apart
                on_edge = buffers.border.ravel()[samples, None] < _EDGE
                dimmed = np.where(on_edge, np.float32(0.75), np.float32(1.0))
                colors = (None if part is None else part * dimmed for part in (here.reflected, here.emitted))
                here = here._replace(**dict(zip(("reflected", "emitted"), colors, strict=True)))
            opened.ravel()[samples] = film.add(samples, here)
        if not opened.any():
            break
        behind = buffers._replace(cube=np.where(opened, buffers.cube, np.int32(-1)))
        buffers = rasterize_cubes(leaves.corners, leaves.edges, camera.scaled(supersample), behind)
    return film


def visible_level(texture: OctreeTexture, camera: Camera, pixels: float = 1.0) -> int:
    """Return the deepest level whose cells are no smaller than ``pixels`` in the middle of the bounds."""
    _, depth = camera.project(texture.bounds.mean(axis=0)[None])
    level = np.floor(np.log2(texture.placement.size / (pixels * camera.pixel_width(depth[0]))))
    return int(np.clip(level, 0, texture.tree.max_depth))
