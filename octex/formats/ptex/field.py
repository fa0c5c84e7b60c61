"""Interpolates texels of faces, by position on their mesh."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Int64s
from octex.channels import ALPHA, ChannelFormat
from octex.formats.ptex.layout import BORDER_MODES, Faces
from octex.formats.ptex.patches import Patches, locate, stretches
from octex.formats.ptex.pyramid import Pyramid, fill_rims, pyramid_of
from octex.formats.ptex.triangles import add_triangle, fill_corners
from octex.jit import inlined, kernel
from octex.source.images.taps import catmull_rom
from octex.source.mesh import Mesh
from octex.source.welding import first_equal

#: A box w texels wide has the variance of linear interpolation between texels w / √3 wide.
_FINER = 3.0
#: Least alpha by which colours are multiplied.
_LEAST = 2.0**-20


class TexelField:
    """Texels (n, components) of a mesh's faces, and the values between them.

    Quads use a spline (Catmull and Rom) that continues across edges; triangles are linear between the centres
    and the corners of texels. If a channel is alpha, it weighs the averages of the others.
    """

    def __init__(
        self,
        values: Float32s,
        faces: Faces,
        forms: Sequence[ChannelFormat],
        mesh: Mesh,
        patches: Patches,
        border_modes: tuple[str, str],
    ) -> None:
        ends = np.cumsum([0, *(form.components for form in forms)])
        spans = list(zip(forms, ends.tolist(), ends.tolist()[1:], strict=False))
        alpha = [a for form, a, _ in spans if form.name == ALPHA.name]
        # Colours are stored times coverage, which weighs their averages.
        self._alpha = alpha[0] if alpha else -1
        self._weighted = np.zeros(values.shape[1], np.bool_)
        if alpha:
            values = values.copy()
            values[:, self._alpha] = np.clip(values[:, self._alpha], 0.0, 1.0)
            for form, a, b in spans:
                self._weighted[a:b] = form.name != ALPHA.name
            values[:, self._weighted] *= np.maximum(values[:, self._alpha, None], _LEAST)
        self._range = values.min(axis=0), values.max(axis=0)  # the spline may overshoot it
        self._patches = patches
        self._pyramid = pyramid_of(values, faces.log2, patches.is_triangle)
        if patches.is_triangle:
            vertices = first_equal(mesh.rest)[patches.corners].reshape(-1, 3)
            fill_corners(self._pyramid, faces.neighbors, faces.edges, vertices)
        else:
            modes = np.array([BORDER_MODES.index(mode) for mode in border_modes])
            fill_rims(self._pyramid, faces.neighbors, faces.edges, faces.subfaces, modes)
        self._lengths = stretches(patches, mesh.rest)

    def read(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        values = np.zeros((len(triangles), self._pyramid.pixels.shape[1]), np.float32)
        _evaluate(self._patches, self._pyramid, self._lengths, triangles, barycentric, widths, values)
        np.clip(values, *self._range, out=values)
        if self._alpha >= 0:
            values[:, self._weighted] /= np.maximum(values[:, self._alpha, None], np.float32(_LEAST))
        return values

    def texel_edges(self, faces: Int64s) -> Float32s:
        """Return the edge of a texel of faces (n,), in rest units."""
        edges = self._lengths[faces] / np.exp2(self._pyramid.log2[0, faces])
        finest: Float32s = edges.min(axis=1).astype(np.float32)
        return finest

    def measured_on(self, rest: Float64s) -> TexelField:
        """Return the same texels, with widths measured at other rest positions (n, 3)."""
        other = copy.copy(self)
        other._lengths = stretches(self._patches, rest)
        return other


@kernel
def _evaluate(
    patches: Patches, pyramid: Pyramid, lengths: Float64s, triangles: Int32s, barycentric: Float64s,
    widths: Float32s, values: Float32s,
) -> None:  # fmt: skip
    for n in range(triangles.size):
        face, u, v = locate(
            patches, int(triangles[n]), barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        )
        texels_u = widths[n] * (1 << pyramid.log2[0, face, 0]) / max(lengths[face, 0], 1e-300)
        texels_v = widths[n] * (1 << pyramid.log2[0, face, 1]) / max(lengths[face, 1], 1e-300)
        level = min(0.5 * np.log2(max(texels_u * texels_v / _FINER, 1.0)), float(pyramid.faces[face]))
        low = min(int(level), int(pyramid.faces[face]))
        share = np.float32(level - low)
        _add(pyramid, patches.is_triangle, face, low, u, v, np.float32(1.0) - share, values[n])
        if share > 0.0:
            _add(pyramid, patches.is_triangle, face, low + 1, u, v, share, values[n])


@inlined
def _add(
    pyramid: Pyramid, is_triangle: bool, face: int, level: int, u: float, v: float, share: np.float32,
    sums: Float32s,
) -> None:  # fmt: skip
    across, down = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
    first, width = pyramid.firsts[level, face], across + 2
    if is_triangle:
        add_triangle(pyramid.pixels, first, across, u * across, v * across, share, sums)
        return
    x, y = u * across + 0.5, v * down + 0.5
    i, j = min(int(x), across), min(int(y), down)
    of_x, of_y = catmull_rom(np.float32(x - i)), catmull_rom(np.float32(y - j))
    for row in range(4):
        start = first + min(max(j + row - 1, 0), down + 1) * width
        for column in range(4):
            at = start + min(max(i + column - 1, 0), across + 1)
            weight = share * of_y[row] * of_x[column]
            for k in range(sums.size):
                sums[k] += weight * pyramid.pixels[at, k]
