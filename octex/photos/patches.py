"""Patches: squares of an image's pixels, each represented by the point of the surface at its centre."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s, Int64s
from octex.cameras.lens import is_bent, undistort
from octex.jit import kernel
from octex.painting.image import Mips
from octex.painting.project import Projected
from octex.painting.reading import Shot

#: Points read at once, summed over images.
_POINTS = 1 << 18
#: Side of a patch in pixels; it doubles until an image has at most _MOST patches.
_PATCH, _MOST = 4, 1 << 17


def patch_of(shot: Shot) -> int:
    """Return the side of an image's patches in pixels, a power of two."""
    width, height = shot.mips.sizes[0, 1:].tolist()
    patch = _PATCH
    while width * height > _MOST * patch**2:
        patch *= 2
    return patch


def patches_of(shot: Shot) -> tuple[int, int]:
    """Return the rows and columns of an image's patches."""
    width, height = shot.mips.sizes[0, 1:].tolist()
    patch = patch_of(shot)
    return -(-height // patch), -(-width // patch)


def colors_of(shot: Shot) -> Float32s:
    """Return the mean colour, times alpha, and alpha of an image's patches (rows, columns, 4)."""
    rows, columns = patches_of(shot)
    level = min(patch_of(shot).bit_length(), len(shot.mips.sizes)) - 1
    first, width, height = shot.mips.sizes[level].tolist()
    pixels = shot.mips.pixels[first : first + width * height].reshape(height, width, 4)
    i, j = np.minimum(np.arange(rows), height - 1), np.minimum(np.arange(columns), width - 1)
    colors: Float32s = pixels[i[:, None], j]
    return colors


def widths_of(source: Projected, triangles: Int32s, barycentric: Float64s) -> Float32s:
    """Return the width, at rest, of the patches of a source's only image at points of the surface."""
    widths = source.widths(triangles, barycentric)
    patch = patch_of(source.shots[0])
    return np.where(np.isfinite(widths), patch * widths, np.float32(0)).astype(np.float32)


def seen_at(source: Projected, shot: Shot, chosen: Bools) -> tuple[Int64s, Int32s, Float64s]:
    """Return the ``chosen`` patches (rows, columns) whose centres see the surface, and the points seen."""
    patches = np.flatnonzero(chosen)
    y, x = np.divmod(patches, chosen.shape[1])
    places = np.column_stack([x + 0.5, y + 0.5]) * patch_of(shot)
    places = np.minimum(places, shot.mips.sizes[0, 1:] - 0.5)
    if is_bent(shot.lens):
        bent = np.linalg.solve(shot.K, np.column_stack([places, np.ones(len(places))]).T)[:2].T
        slopes = np.empty_like(bent)
        undistort(shot.lens, np.ascontiguousarray(bent), slopes)
        places = slopes @ shot.camera.K[:2, :2].T + shot.camera.K[:2, 2]
    high, wide = shot.seen.rows.shape
    inside = np.asarray(np.logical_and(places >= 0, places < [wide, high]).all(axis=1))
    i, j = np.where(inside[:, None], places, 0.0).astype(np.int64).T
    triangles = shot.seen.triangle(shot.seen.rows[j, i])
    visible = np.flatnonzero(np.where(inside, triangles, -1) >= 0)
    visible = visible[np.argsort(triangles[visible], kind="stable")]
    seen = triangles[visible]
    middles = np.column_stack([i[visible], j[visible]]) + 0.5
    return patches[visible], seen, _barycentric_at(source, shot, seen, middles)


def _barycentric_at(source: Projected, shot: Shot, triangles: Int32s, pixels: Float64s) -> Float64s:
    """Return the points of triangles (n,) that a shot's undistorted camera sees at pixels (n, 2)."""
    view = shot.camera
    corners = source.vertices[source.triangles[triangles]] @ view.world_to_camera[:3, :3].T
    corners += view.world_to_camera[:3, 3]
    if not view.is_pinhole:
        corners[..., 2] = 1.0
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ view.inverse_k.T
    sides = np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    parts = np.einsum("nck,nk->nc", sides, rays) * np.sign(np.linalg.det(corners))[:, None]
    parts = np.maximum(parts, 0.0)
    totals = parts.sum(axis=1, keepdims=True)
    barycentric: Float64s = np.where(totals > 0.0, parts / np.maximum(totals, 1e-300), 1.0 / 3.0)
    return barycentric


def batches(count: int, images: int) -> Iterator[slice]:
    """Yield slices of points, small enough to read all images there at once."""
    step = max(_POINTS // images, 1)
    for first in range(0, count, step):
        yield slice(first, first + step)


def grown(chosen: Bools) -> Bools:
    """Return the chosen patches and their eight neighbours."""
    return sums_around(chosen.astype(np.float32)) > 0


def sums_around(values: Float32s, reach: int = 1) -> Float32s:
    """Return the sums over squares of patches that reach ``reach`` patches each way."""
    rows, columns = values.shape
    wide = np.pad(values, reach)
    steps = range(2 * reach + 1)
    sums = reduce(np.add, [wide[i : i + rows] for i in steps])
    totals: Float32s = reduce(np.add, [sums[:, j : j + columns] for j in steps])
    return totals


def put_mask(mips: Mips, mask: Float32s) -> None:
    """Multiply an image's alpha, in place, by a mask of any size, 0 … 1, bilinear in between.

    Only masked pixels are written: the others of a mapped image stay in its file.
    """
    if not (mask == 1.0).all():
        _mask_mips(mips.pixels, mips.sizes, mask)


@kernel
def _mask_mips(pixels: Float32s, sizes: Int64s, mask: Float32s) -> None:
    rows, columns = mask.shape
    width, height = sizes[0, 1], sizes[0, 2]
    step = max((height + rows - 1) // rows, (width + columns - 1) // columns)
    lefts, parts = np.empty(width, np.int64), np.empty(width, np.float32)
    for level in range(len(sizes)):
        first, across, down = sizes[level, 0], sizes[level, 1], sizes[level, 2]
        for j in range(across):
            x = min(max((j + 0.5) * width / (across * step) - 0.5, 0.0), columns - 1.0)
            lefts[j] = int(x)
            parts[j] = x - lefts[j]
        for i in range(down):
            y = min(max((i + 0.5) * height / (down * step) - 0.5, 0.0), rows - 1.0)
            above = int(y)
            below, low = min(above + 1, rows - 1), np.float32(y - above)
            for j in range(across):
                left, part = lefts[j], parts[j]
                right = min(left + 1, columns - 1)
                upper = mask[above, left] + (mask[above, right] - mask[above, left]) * part
                lower = mask[below, left] + (mask[below, right] - mask[below, left]) * part
                factor = upper + (lower - upper) * low
                at = first + i * across + j
                for component in range(4 if factor != 1.0 else 0):
                    pixels[at, component] *= factor
