"""Visible surface points of an image's samples, at rest, with their derivatives by image position."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.cameras.camera import Camera
from octex.cameras.differentials import differential
from octex.jit import kernel
from octex.parallel import built_once
from octex.source.corners import Frames
from octex.source.vectors import row_of
from octex.view.shading import corner_normals, face_normals
from octex.view.zbuffer import Buffers, z_buffer

if TYPE_CHECKING:
    from octex.source.surface import Surface

#: Samples a batch, which bounds the memory for large images.
_BLOCK = 1 << 16


class Hits(NamedTuple):
    """Surface points that the samples of an image see."""

    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    rest: Float64s  # (n, 3)   rest positions
    width: Float32s  # (n,)   footprint of a sample, in rest units
    dPdx: Float64s  # (n, 3)   change of the rest position to the next sample at the right
    dPdy: Float64s  # (n, 3)   and to the next sample below
    normals: Float64s  # (n, 3)   smooth normals at rest


class CameraView:
    """A surface in front of a camera."""

    def __init__(self, surface: Surface, camera: Camera, normals: Float32s | None = None) -> None:
        """Prepare; ``normals`` (m, 3, 3) are the surface's ``rest_normals`` if already computed."""
        self.surface, self.camera = surface, camera
        self.is_posed = not np.array_equal(surface.rest, surface.vertices)
        self._resting = rest_normals(surface) if normals is None else normals
        self._vertices, self._rest = (
            np.ascontiguousarray(positions, np.float64) for positions in (surface.vertices, surface.rest)
        )
        # The ratio of rest length to posed length.
        self._faces, posed_areas = face_normals(surface.vertices, surface.triangles)
        _, rest_areas = face_normals(surface.rest, surface.triangles)
        self._stretch = np.sqrt(rest_areas / np.maximum(posed_areas, 1e-300))

    @built_once
    def _smooth(self) -> Float32s:
        frames = self.surface.posed_frames()
        return smooth_normals(frames, self.surface.vertices, self.surface.triangles)

    def normals(self, hits: Hits) -> tuple[Float64s, Float64s]:
        """Return face normals and smooth normals (n, 3) on the posed surface."""
        smooth = hits.normals
        if self.is_posed:
            smooth = np.einsum("nk,nkc->nc", hits.barycentric, self._smooth[hits.triangles])
        return self._faces[hits.triangles], smooth

    def blocks(self, buffers: Buffers) -> list[Int64s]:
        """Return batches of the pixels that see a surface, numbered row by row."""
        visible = np.flatnonzero(buffers.triangle >= 0)
        return [visible[first : first + _BLOCK] for first in range(0, len(visible), _BLOCK)]

    def hits(self, pixels: Int64s, buffers: Buffers) -> tuple[Hits, Float64s]:
        """Return the hits of pixels (n,), and their positions on the posed surface (n, 3)."""
        triangles = buffers.triangle.ravel()[pixels]
        width = self.camera.pixel_width(buffers.depth.ravel()[pixels]) * self._stretch[triangles]
        weights, points, rest, right, down, normals = np.empty((6, len(pixels), 3))
        _hit(
            self.camera.eye, self.camera.projection == "pinhole", self._vertices, self._rest, self.is_posed,
            np.ascontiguousarray(self.surface.triangles, np.int32), self._faces, self._resting,
            triangles, buffers.barycentric.reshape(-1, 3)[pixels],
            weights, points, rest, right, down, normals,
        )  # fmt: skip
        return Hits(triangles, weights, rest, width.astype(np.float32), right, down, normals), points


def visible_hits(
    surface: Surface, camera: Camera, normals: Float32s | None = None
) -> Iterator[tuple[Int64s, Hits]]:
    """Yield batches of pixel numbers and their hits; ``normals`` as for `CameraView`."""
    buffers = z_buffer(surface.vertices, surface.triangles, camera)
    view = CameraView(surface, camera, normals)
    for pixels in view.blocks(buffers):
        yield pixels, view.hits(pixels, buffers)[0]


def rest_normals(surface: Surface) -> Float32s:
    """Return smooth normals (m, 3, 3) at the corners of triangles at rest: the surface's own, if any."""
    return smooth_normals(surface.frames, surface.rest, surface.triangles)


def smooth_normals(frames: Frames | None, positions: Float64s, triangles: Int32s) -> Float32s:
    """Return the normals (m, 3, 3) of frames, or without frames those computed from positions."""
    if frames is None:
        return corner_normals(positions, triangles)
    return np.ascontiguousarray(frames.normals.values[frames.normals.rows], np.float32)


@kernel
def _hit(
    eye: Float64s, perspective: bool, vertices: Float64s, resting: Float64s, is_posed: bool,
    triangles: Int32s, faces: Float64s, corner_normals: Float32s, hit_triangles: Int32s,
    barycentric: Float32s, weights: Float64s, points: Float64s, rest: Float64s, right: Float64s,
    down: Float64s, normals: Float64s,
) -> None:  # fmt: skip
    """Write the hits at ``barycentric`` (n, 3) of ``hit_triangles`` (n,)."""
    for n in range(len(hit_triangles)):
        triangle = hit_triangles[n]
        a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        u, v, w = float(barycentric[n, 0]), float(barycentric[n, 1]), float(barycentric[n, 2])
        weights[n, 0], weights[n, 1], weights[n, 2] = u, v, w
        for axis in range(3):
            points[n, axis] = u * vertices[a, axis] + v * vertices[b, axis] + w * vertices[c, axis]
            rest[n, axis] = u * resting[a, axis] + v * resting[b, axis] + w * resting[c, axis]
            normals[n, axis] = (
                u * corner_normals[triangle, 0, axis]
                + v * corner_normals[triangle, 1, axis]
                + w * corner_normals[triangle, 2, axis]
            )
        right[n], down[n] = differential(eye, perspective, row_of(points, n), row_of(faces, triangle))
        if not is_posed:
            continue
        # Express steps along the posed triangle by its edges; the same combination of rest edges is the rest
        # step.
        ee = ff = ef = re = rf = de = df = 0.0
        for axis in range(3):
            e, f = vertices[b, axis] - vertices[a, axis], vertices[c, axis] - vertices[a, axis]
            ee, ff, ef = ee + e * e, ff + f * f, ef + e * f
            re, rf = re + right[n, axis] * e, rf + right[n, axis] * f
            de, df = de + down[n, axis] * e, df + down[n, axis] * f
        square = ee * ff - ef * ef
        scale = 1.0 / square if square > 0.0 else 0.0
        for axis in range(3):
            e, f = resting[b, axis] - resting[a, axis], resting[c, axis] - resting[a, axis]
            right[n, axis] = ((re * ff - rf * ef) * e + (rf * ee - re * ef) * f) * scale
            down[n, axis] = ((de * ff - df * ef) * e + (df * ee - de * ef) * f) * scale
