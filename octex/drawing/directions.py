"""Cameras that see a whole model: three-quarter, unless another side shows more detail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s, Floats
from octex.cameras.camera import Camera, as_vector
from octex.cameras.files import Frame
from octex.channels import linear_to_srgb
from octex.checks import as_positive
from octex.drawing.hits import rest_normals, visible_hits
from octex.drawing.rasters import DrawnLeaves
from octex.drawing.shaders import Shader, source_shader, texture_shader
from octex.errors import ArgumentError
from octex.tree.octree import distinct
from octex.view.shading import face_normals

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

#: From the model toward the camera: the front (glTF's +z), a little from the right and from above.
_THREE_QUARTER = np.array([0.56, 0.42, 1.0]) / np.linalg.norm([0.56, 0.42, 1.0])
#: Flat models have this part of their squared normals along one axis. Their view is tilted by _SLANT.
_FLAT, _SLANT = 0.85, 0.45
#: Factor of detail by which another side must exceed an earlier one.
_CLEARLY = 1.1
#: Smaller steps between pixels, of values 0 … 1, count as rounding.
_SEEN = 1 / 512
#: Below this length of their mean, unit vectors count as pointing all around.
_ALIKE = 0.5


class Viewpoint(NamedTuple):
    """Where a camera views from."""

    direction: npt.ArrayLike | None = None  # toward the camera; None: the side with most detail
    up: npt.ArrayLike = (0.0, 1.0, 0.0)
    zoom: float = 1.0  # 1: the whole model
    frame: Frame | None = None  # a camera of a file, instead of a direction

    def camera(
        self,
        points: Floats,
        parts: Callable[[], tuple[Floats, Floats]],
        unlit: Callable[[Camera], Floats],
        size: tuple[int, int],
        room: int,
    ) -> Camera:
        """Return a camera that sees points (n, 3) above ``room`` pixels at the bottom of the image.

        ``parts`` returns normals and areas for ``view_directions``; ``unlit`` renders without light. A frame
        of another shape is scaled to fit.
        """
        if size[0] < 1 or size[1] <= room:
            raise ArgumentError(
                f"size must be larger: a panel of {size[0]} × {size[1]} pixels has no room above its caption "
                f"of {room} pixels"
            )
        size = size[0], size[1] - room
        if self.frame is None:
            direction = self.direction
            if direction is None:
                direction = best_direction(view_directions(*parts()), points, unlit)
            camera = Camera.fitted(points, direction, size=size, up=self.up)
        else:
            if self.frame.size is not None:
                scale = min(size[0] / self.frame.size[0], size[1] / self.frame.size[1])
                size = round(self.frame.size[0] * scale), round(self.frame.size[1] * scale)
            camera = self.frame.camera(size).undistorted
        camera = camera if self.zoom == 1.0 else camera.zoomed(self.zoom)
        return replace(camera, height=camera.height + room)


DEFAULT_VIEW = Viewpoint()


def as_viewpoint(direction: npt.ArrayLike | None, up: npt.ArrayLike, zoom: float) -> Viewpoint:
    """Return a checked viewpoint, or raise ArgumentError."""
    direction = None if direction is None else as_vector(direction, "direction")
    return Viewpoint(direction, as_vector(up, "up"), as_positive(zoom, "zoom"))


def viewpoint_among(cameras: Sequence[Camera]) -> Viewpoint:
    """Return the mean direction and up of cameras; those of the first if the cameras look from all around."""
    rotations = [camera.world_to_camera[:3, :3] for camera in cameras]
    means = []
    for axis in (2, 1):
        vectors = np.array([-rotation[axis] for rotation in rotations])
        mean = vectors.mean(axis=0)
        means.append(mean if np.linalg.norm(mean) >= _ALIKE else vectors[0])
    return Viewpoint(*means)


def view_directions(normals: Floats, areas: Floats) -> Float64s:
    """Return unit vectors (k, 3) toward the camera to try, the usual first, from face normals and areas."""
    weights = areas / max(float(areas.sum()), 1e-300)
    strengths, axes = np.linalg.eigh(np.einsum("n,nc,nd->cd", weights, normals, normals))
    if strengths[2] < _FLAT:
        sides = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, -1.0]])
        return cast("Float64s", sides * _THREE_QUARTER)
    # Flat: look along the normal, slightly tilted, at the side that most area faces, or else at both.
    normal = axes[:, 2] * (1.0 if axes[:, 2] @ _THREE_QUARTER >= 0.0 else -1.0)
    facing = normals @ normal
    excess = float((weights * facing * np.abs(facing)).sum())
    normals = np.array([normal, -normal] if abs(excess) < 0.1 else [np.sign(excess) * normal])
    slants = _THREE_QUARTER - (normals @ _THREE_QUARTER)[:, None] * normals
    directions = normals + _SLANT * slants / np.maximum(np.linalg.norm(slants, axis=1, keepdims=True), 1e-3)
    return cast("Float64s", directions / np.linalg.norm(directions, axis=1, keepdims=True))


def best_direction(directions: Floats, points: Floats, unlit: Callable[[Camera], Floats]) -> Float64s:
    """Return the direction (3,) whose small ``unlit`` rendering of points (n, 3) has most detail."""
    details = [0.0] * len(directions)
    for number, direction in enumerate(directions if len(directions) > 1 else ()):
        image = unlit(Camera.fitted(points, direction, size=(96, 96)))
        steps = [np.abs(np.diff(image, axis=axis)) for axis in (0, 1)]
        details[number] = sum(float(step[step > _SEEN].sum()) for step in steps)
    best: Float64s = directions[int(np.argmax(np.array(details) * _CLEARLY >= max(details)))]
    return best


def camera_of(
    texture: OctreeTexture | None,
    surface: Surface | None,
    size: tuple[int, int],
    view: Viewpoint,
    channel: str | None = None,
) -> Camera:
    """Return a camera that sees a model, or without a model the leaves of a texture."""
    if surface is not None:
        look = source_shader(surface, channel) if texture is None else texture_shader(texture, channel)
        placed = surface if texture is None else surface.placed_in(texture)
        return surface_camera(placed, look, size, view=view)
    assert texture is not None
    return leaf_camera([texture], channel, size, view=view)


def surface_camera(
    surface: Surface, look: Shader, size: tuple[int, int], room: int = 0, view: Viewpoint = DEFAULT_VIEW
) -> Camera:
    """Return a camera that sees a model above ``room`` pixels, by default from the side with most detail."""
    normals = rest_normals(surface)

    def unlit(camera: Camera) -> Floats:
        image = np.full((camera.height * camera.width, 3), np.nan)
        for pixels, hits in visible_hits(surface, camera, normals):
            image[pixels] = linear_to_srgb(look(hits).unlit())
        return image.reshape(camera.height, camera.width, 3)

    points = surface.vertices[distinct(surface.triangles.ravel())]
    return view.camera(points, lambda: face_normals(surface.vertices, surface.triangles), unlit, size, room)


def leaf_camera(
    textures: Sequence[OctreeTexture],
    channel: str | None,
    size: tuple[int, int],
    room: int = 0,
    view: Viewpoint = DEFAULT_VIEW,
) -> Camera:
    """Return a camera that sees textures, by default from the side where the first has most detail."""
    # Coarse cells suffice to find the bounds and the best side.
    coarse = [texture.level(min(7, texture.tree.max_depth)) for texture in textures]
    sets = [DrawnLeaves.of(texture) for texture in coarse]
    first, colors = sets[0], sets[0].appearance(coarse[0], channel).unlit()

    def unlit(camera: Camera) -> Floats:
        cubes = first.seen(camera).cube
        image = np.full((*cubes.shape, 3), np.nan)
        image[cubes >= 0] = linear_to_srgb(colors[cubes[cubes >= 0]])
        return image

    corners = np.array(list(np.ndindex(2, 2, 2)))
    points = np.concatenate(
        [leaves.corners + corner * leaves.edges[:, None] for leaves in sets for corner in corners]
    )
    return view.camera(points, lambda: (first.normals, first.edges**2), unlit, size, room)
