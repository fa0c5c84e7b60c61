"""A surface that is painted, with what of it stays the same from stroke to stroke."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property

import numpy as np

from octex.arrays import Float32s
from octex.errors import ArgumentError
from octex.painting.picture import Projection
from octex.painting.project import Shading, shading_of, stretches_of
from octex.painting.resume import Kept, digest_of
from octex.painting.sight import Sight, sight_of
from octex.painting.triangle_grid import Near
from octex.painting.unwrap import Patch
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.placement import Placement
from octex.view.camera import Camera
from octex.view.shading import corner_normals


class Ground:
    """A surface, and what strokes read of it: where its triangles lie, how it shades, what cameras see.

    With ``keeps`` that is kept for the next stroke: the normals of all triangles, and what the cameras of the
    last call see.
    """

    def __init__(self, surface: Surface, *, keeps: bool = False) -> None:
        self.surface = surface
        self._keeps = keeps
        self._near: tuple[Placement, Near] | None = None
        self._sights: dict[bytes, Sight] = {}

    def near(self, placement: Placement) -> Near:
        """Return where the triangles lie in a root cell."""
        if self._near is None or self._near[0] != placement:
            self._near = placement, Near(self.surface, placement)
        return self._near[1]

    @cached_property
    def stretches(self) -> Float32s:
        """How long on each triangle (m,) at rest is what is 1 long on the posed one."""
        return stretches_of(self.surface.vertices, self.surface.rest, self.surface.triangles)

    @cached_property
    def shading(self) -> Shading:
        """The normals that angles to cameras are measured to."""
        if not self._keeps or self.surface.frames is not None:
            return shading_of(self.surface)
        normals = corner_normals(self.surface.vertices, self.surface.triangles)
        return normals.__getitem__

    @cached_property
    def content(self) -> bytes:
        """A digest of where it is, at rest and posed, and of how it shades."""
        surface = self.surface
        frames = () if surface.frames is None else (*surface.frames.normals, *surface.frames.tangents)
        return digest_of(surface.vertices, surface.rest, surface.triangles, frames)

    def sights(
        self, cameras: Sequence[Camera], feather: float, executor: Executor, kept: Kept | None = None
    ) -> Iterator[Sight]:
        """Yield what cameras see of it."""
        mesh = self.surface.vertices, self.surface.triangles
        own = kept and kept.of(self.content)
        known, self._sights = self._sights, {}
        for camera in cameras:
            key = key_of(camera) + np.float64(feather).tobytes()
            sight = known.get(key) or self._sights.get(key)
            if sight is None:
                sight = sight_of(*mesh, camera, feather, executor, own)
            if self._keeps:
                self._sights[key] = sight
            yield sight


def laid_flat(
    ground: Ground, given: list[Projection], texture: OctreeTexture | None
) -> tuple[Ground, list[Projection]]:
    """Return the ground, and pictures with cameras, for pictures through a patch: the surface lies flat.

    Raises ArgumentError for a patch beside another one or a camera, and for one of another surface.
    """
    patch = next((each.camera for each in given if isinstance(each.camera, Patch)), None)
    if patch is None:
        return ground, given
    if any(each.camera is not patch for each in given):
        raise ArgumentError("pictures through a patch are painted by themselves, those of each in a call")
    if len(patch.surface.triangles) != len(ground.surface.triangles):
        raise ArgumentError(f"the patch is not of {ground.surface.name}; unwrap that")
    surface = patch.surface if texture is None else patch.surface.placed_in(texture)
    return Ground(surface), [replace(each, camera=patch.camera) for each in given]


def key_of(camera: Camera) -> bytes:
    """Return what tells one camera from another."""
    numbers = camera.width, camera.height, camera.projection == "pinhole"
    parts = camera.world_to_camera, camera.K, camera.lens, numbers
    return b"".join(np.asarray(part, np.float64).tobytes() for part in parts)
