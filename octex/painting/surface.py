"""The surface that is painted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s, Int32s
from octex.cameras.camera import Camera
from octex.channels import ChannelFormat
from octex.errors import ArgumentError
from octex.painting.options import triangles_of
from octex.painting.picture import Projection
from octex.painting.project import Projected, Shading
from octex.painting.reading import Terms
from octex.painting.resume import NOT_STORED, Stages, digest_of
from octex.painting.sight import Shot, Sight, sight_of
from octex.painting.unwrap import Patch
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.placement import Placement, on_grid
from octex.view.shading import corner_normals, corner_normals_of, face_normals
from octex.voxelize.fragments import Blocks, divided, whole

#: The level of the coarse cells.
_COARSE = 7


class PaintedSurface:
    """A surface, and what painting reads of it; in a session normals and last sights are cached."""

    def __init__(
        self, surface: Surface, *, in_session: bool = False, other: PaintedSurface | None = None
    ) -> None:
        self.surface = surface
        self._in_session = in_session
        self._other = other  # the same surface in another pose
        self._blocks: tuple[Placement, Blocks] | None = None
        self._sights: dict[bytes, Sight] = {}
        self._flat: tuple[Surface, PaintedSurface] | None = None  # the last one

    def posed(self, surface: Surface) -> PaintedSurface:
        """Return another pose of the surface, which shares what is known of it at rest.

        Raises ArgumentError for a surface with other triangles or rest positions.
        """
        mine = self.surface
        for name in "triangles", "rest":
            if not np.array_equal(getattr(surface, name), getattr(mine, name)):
                raise ArgumentError(f"{surface.name} is no pose of {mine.name}: it has other {name}")
        return PaintedSurface(surface, in_session=self._in_session, other=self)

    def flat(self, patch: Patch, texture: OctreeTexture | None) -> PaintedSurface:
        """Return the surface laid flat, which shares what is known of it at rest."""
        if self._flat is None or self._flat[0] is not patch.surface or not self._in_session:
            flat = patch.surface if texture is None else patch.surface.placed_in(texture)
            self._flat = patch.surface, PaintedSurface(flat, in_session=self._in_session, other=self)
        return self._flat[1]

    def blocks(self, placement: Placement) -> Blocks:
        """Return the cells of a coarse level in a root cell, with the triangles in them."""
        if self._other is not None:
            return self._other.blocks(placement)
        if self._blocks is None or self._blocks[0] != placement:
            root = whole(on_grid(self.surface.rest, placement), self.surface.triangles, _COARSE)
            self._blocks = placement, divided(root, 0)
        return self._blocks[1]

    @cached_property
    def stretches(self) -> Float32s:
        """How long on each triangle (m,) at rest is what is 1 long on the posed one, by their areas."""
        vertices, rest, triangles = self.surface.vertices, self.surface.rest, self.surface.triangles
        if rest is vertices:
            return np.ones(len(triangles), np.float32)
        (_, posed), (_, resting) = face_normals(vertices, triangles), face_normals(rest, triangles)
        with np.errstate(divide="ignore", invalid="ignore"):
            stretches = np.sqrt(resting / posed)
        return np.nan_to_num(stretches, nan=1.0, posinf=1e6).astype(np.float32)

    @cached_property
    def shading(self) -> Shading:
        """The normals that angles to cameras are measured to: the surface's own, or `corner_normals`."""
        mesh = self.surface.vertices, self.surface.triangles
        if self.surface.frames is not None:
            return partial(_normals_of_frames, self.surface)
        if self._in_session:
            return corner_normals(*mesh).__getitem__
        return partial(corner_normals_of, positions=mesh[0], triangles=mesh[1])

    @cached_property
    def content(self) -> bytes:
        """A digest of where it is, at rest and posed, and of how it shades."""
        surface = self.surface
        frames = () if surface.frames is None else (*surface.frames.normals, *surface.frames.tangents)
        return digest_of(surface.vertices, surface.rest, surface.triangles, frames)

    def projected(
        self, shots: Sequence[Shot], form: ChannelFormat, terms: Terms, region: npt.ArrayLike | None = None
    ) -> Projected:
        """Return the paint of shots of it, or of some of its triangles."""
        mesh = self.surface.vertices, self.surface.triangles
        count = len(self.surface.triangles)
        chosen = None if region is None else triangles_of(region, count)
        if region is not None and chosen is None:
            raise ArgumentError(
                f"region must be triangles of the surface: numbers from 0 to {count - 1}, or {count} bools"
            )
        return Projected(list(shots), form, terms, *mesh, self.stretches, self.shading, chosen)

    def sights(
        self,
        cameras: Sequence[Camera],
        feather: float,
        executor: Executor,
        stages: Stages = NOT_STORED,
        *,
        hidden: bool = False,
    ) -> Iterator[Sight]:
        """Yield what cameras see of it; see `sight_of`."""
        mesh = self.surface.vertices, self.surface.triangles
        own = stages.of(lambda: [self.content])
        before, self._sights = self._sights, {}
        for camera in cameras:
            key = key_of(camera) + np.float64(feather).tobytes() + bytes([hidden])
            sight = before.get(key) or self._sights.get(key)
            if sight is None:
                sight = sight_of(*mesh, camera, feather, executor, own, hidden=hidden)
            if self._in_session:
                self._sights[key] = sight
            yield sight


def laid_flat(
    surface: PaintedSurface, projections: list[Projection], texture: OctreeTexture | None
) -> tuple[PaintedSurface, list[Projection]]:
    """Return the surface, laid flat if pictures are through a patch, and the pictures with cameras."""
    patch = next((each.camera for each in projections if isinstance(each.camera, Patch)), None)
    if patch is None:
        return surface, projections
    if any(each.camera is not patch for each in projections):
        raise ArgumentError("paint the pictures of each patch in a call of their own")
    if len(patch.surface.triangles) != len(surface.surface.triangles):
        raise ArgumentError(f"the patch is not of {surface.surface.name}; unwrap that")
    flat = surface.flat(patch, texture)
    return flat, [replace(each, camera=patch.camera) for each in projections]


def key_of(camera: Camera) -> bytes:
    """Return what tells one camera from another."""
    numbers = camera.width, camera.height, camera.projection == "pinhole"
    parts = camera.world_to_camera, camera.K, camera.lens, numbers
    return b"".join(np.asarray(part, np.float64).tobytes() for part in parts)


def _normals_of_frames(surface: Surface, chosen: Int32s) -> Float32s:
    frames = surface.posed_frames(chosen)
    assert frames is not None
    return frames.normals.values[frames.normals.rows]
