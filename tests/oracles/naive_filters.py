"""Image filters in the open: weights of an image's texels, in double precision, from an endless line of them.

Everything but EWA's ellipse is a product of one direction's weights and the other's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from octex.source.images import filters  # for the figures of EWA's levels

Weights = npt.NDArray[np.float64]
Read = Callable[[float], Weights]


def texel_of(index: int, size: int, wrap: str) -> int:
    """The texel that stands for one anywhere on an endless line of images."""
    if wrap == "clamp":
        return min(max(index, 0), size - 1)
    turn, place = divmod(index, size)
    return size - 1 - place if wrap == "mirror" and turn % 2 else place


def halved(size: int) -> list[int]:
    """The sizes of all levels."""
    sizes = [size]
    while sizes[-1] > 1:
        sizes.append(sizes[-1] // 2)
    return sizes


def reduction(size: int, smaller: int) -> Weights:
    """The share of each texel (smaller, size) in the mean over each larger one's extent."""
    shares = np.zeros((smaller, size))
    for large in range(smaller):
        low, high = large * size / smaller, (large + 1) * size / smaller
        for small in range(size):
            shares[large, small] = max(min(high, small + 1) - max(low, small), 0.0)
    return shares * smaller / size


class Axis:
    """One direction of an image. Reads give the weight (size,) of each of its texels."""

    def __init__(self, size: int, wrap: str) -> None:
        self.wrap = wrap
        self.sizes = halved(size)
        self.levels = [np.eye(size)]
        for larger, smaller in pairwise(self.sizes):
            self.levels.append(reduction(larger, smaller) @ self.levels[-1])

    def texel(self, index: int, level: int = 0) -> Weights:
        """A texel of a level, anywhere: beyond a clamped image's border lies the border's own texel."""
        level = min(level, len(self.sizes) - 1)
        size = self.sizes[level]
        if self.wrap == "clamp" and not 0 <= index < size:
            return self.levels[0][0 if index < 0 else -1]
        return self.levels[level][texel_of(index, size, self.wrap)]

    def place(self, coordinate: float, level: int = 0) -> float:
        return coordinate * self.sizes[min(level, len(self.sizes) - 1)]

    def nearest(self, coordinate: float) -> Weights:
        return self.texel(math.floor(self.place(coordinate)))

    def linear(self, coordinate: float, level: int = 0) -> Weights:
        x = self.place(coordinate, level) - 0.5
        left = math.floor(x)
        return (left + 1 - x) * self.texel(left, level) + (x - left) * self.texel(left + 1, level)

    def cubic(self, coordinate: float) -> Weights:
        """Catmull and Rom's spline through four values (E. Catmull, R. Rom 1974), in Horner-free form."""
        x = self.place(coordinate) - 0.5
        left = math.floor(x)
        t = x - left
        a, b, c, d = (self.texel(left + step) for step in (-1, 0, 1, 2))
        return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * (b - c) + d - a) * t**3)

    def mean(self, read: Read, coordinate: float, width: float) -> Weights:
        """The mean of reads over a width in texels. They are linear between half texels."""
        size = self.sizes[0]
        low, high = self.place(coordinate) - width / 2, self.place(coordinate) + width / 2
        between = np.arange(math.floor(2 * low) + 1, math.ceil(2 * high)) / 2
        cuts = [low, *between.tolist(), high]
        if high <= low:
            return read(coordinate)
        total = np.zeros(size)
        for start, end in pairwise(cuts):
            total += (end - start) * read((start + end) / 2 / size)
        return total / (high - low)


def level_of(variance: float, flat: bool, levels: int) -> tuple[int, float]:
    """The finer of two levels that mixed have a footprint's and the image's variance, and the coarser's part.

    A texel of level l, read bilinearly, has (4ˡ − 1) / 12 + 4ˡ / 6.
    """
    wanted = variance + (1 / 12 if flat else 1 / 6)
    own = [(4**level - 1) / 12 + 4**level / 6 for level in range(levels)]
    if wanted <= own[0]:
        return 0, 0.0
    for level in range(levels - 1):
        if wanted < own[level + 1]:
            return level, (wanted - own[level]) / (own[level + 1] - own[level])
    return levels - 1, 0.0


def covariance_of(jacobian: Weights) -> Weights:
    """That of a unit square as it looks in the image, in texels²; at most 16 times as long as wide."""
    squares, directions = np.linalg.eigh(jacobian @ jacobian.T / 12)
    squares = np.maximum(squares, squares[-1] / 16**2)
    return np.asarray(directions * squares @ directions.T)


def weights(
    name: str, across: Axis, down: Axis, uv: npt.ArrayLike, jacobian: Weights, flat: bool = False
) -> Weights:
    """The weights (height, width) of an image's texels under a footprint.

    ``jacobian`` holds the texels that the footprint's two sides run through, one side in each column.
    """
    u, v = map(float, np.asarray(uv))
    covariance = covariance_of(jacobian)
    if name == "nearest" or (name == "bilinear" and flat):
        return np.outer(down.nearest(v), across.nearest(u))
    if name == "bilinear":
        return np.outer(down.linear(v), across.linear(u))
    if name == "bicubic":
        return np.outer(down.cubic(v), across.cubic(u))
    if name == "trilinear":
        longest = float(np.linalg.eigvalsh(covariance)[-1])
        level, part = level_of(longest, flat, max(len(across.sizes), len(down.sizes)))
        if flat and level == 0 and part == 0:
            return box(across, down, u, v, math.sqrt(12 * longest), math.sqrt(12 * longest), flat)
        finer = np.outer(down.linear(v, level), across.linear(u, level))
        coarser = np.outer(down.linear(v, level + 1), across.linear(u, level + 1))
        return (1 - part) * finer + part * coarser
    return ewa(across, down, u, v, covariance, flat)


def box(across: Axis, down: Axis, u: float, v: float, wide: float, high: float, flat: bool) -> Weights:
    """The exact mean over a box, its sides in texels."""
    read_x, read_y = (across.nearest, down.nearest) if flat else (across.linear, down.linear)
    return np.outer(down.mean(read_y, v, high), across.mean(read_x, u, wide))


def ewa(across: Axis, down: Axis, u: float, v: float, covariance: Weights, flat: bool) -> Weights:
    """Exact boxes under small footprints that are not skewed; else the texels of an ellipse, by 1 − q."""
    wide, high = np.sqrt(12 * covariance.diagonal())
    if max(wide, high) <= (1 if flat else 2) and (flat or covariance[0, 1] == 0):
        return box(across, down, u, v, wide, high, flat)
    # The footprint's variance, the image's, and a twelfth that the texels of every level have already.
    spread = covariance + np.eye(2) * (1 / 6 if flat else 1 / 4)
    narrow, long = np.linalg.eigvalsh(spread).tolist()
    least = filters.LEAST + 1 / 12
    level = 0
    while level < max(len(across.sizes), len(down.sizes)) - 1 and (
        narrow >= 4 * least or max(narrow, least) * long > filters.LARGEST
    ):
        narrow, long, level = narrow / 4, long / 4, level + 1
    scale = np.diag([axis.place(1, level) / axis.place(1) for axis in (across, down)])
    kernel = scale @ spread @ scale + np.eye(2) * (max(least - narrow, 0) - 1 / 12)
    kernel[np.diag_indices(2)] = np.maximum(kernel.diagonal(), filters.LEAST)
    inverse = np.linalg.inv(6 * kernel)
    centre = np.array([across.place(u, level) - 0.5, down.place(v, level) - 0.5])
    reach = np.sqrt(6 * kernel.diagonal())
    (i0, j0), (i1, j1) = np.ceil(centre - reach).astype(int), np.floor(centre + reach).astype(int)
    columns, rows = np.arange(i0, i1 + 1), np.arange(j0, j1 + 1)
    x, y = np.meshgrid(columns - centre[0], rows - centre[1])
    square = inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y
    shares = np.maximum(1 - square, 0)
    in_x = np.array([across.texel(int(i), level) for i in columns])
    in_y = np.array([down.texel(int(j), level) for j in rows])
    return np.asarray(in_y.T @ shares @ in_x / shares.sum())


def filtered(
    values: npt.NDArray[np.float64], shares: Weights, covered: bool = False
) -> npt.NDArray[np.float64]:
    """The mean of values (height, width, k) by weights, and, if ``covered``, by the last of them, alpha."""
    if not covered:
        return np.einsum("yx,yxk->k", shares, values)
    alpha = float((shares * values[..., -1]).sum())
    colors = np.einsum("yx,yxk->k", shares * values[..., -1], values[..., :-1])
    return np.array([*(colors / alpha if alpha else colors), alpha])


def dense_reads(
    values: npt.NDArray[np.float64], wraps: tuple[str, str], uv: npt.NDArray[np.float64], flat: bool = False
) -> npt.NDArray[np.float64]:
    """Values (n, k) of an image (height, width, k) at many points, bilinear or of flat texels."""
    height, width = values.shape[:2]
    places = uv * [width, height] - (0.0 if flat else 0.5)
    first = np.floor(places).astype(int)
    part = np.zeros_like(places) if flat else places - first
    result = np.zeros((len(uv), values.shape[2]))
    for step_x in (0, 1):
        for step_y in (0, 1):
            columns = wrapped(first[:, 0] + step_x, width, wraps[0])
            rows = wrapped(first[:, 1] + step_y, height, wraps[1])
            share = np.abs(1 - step_x - part[:, 0]) * np.abs(1 - step_y - part[:, 1])
            result += share[:, None] * values[rows, columns]
    return result


def wrapped(indices: npt.NDArray[np.int64], size: int, wrap: str) -> npt.NDArray[np.int64]:
    """Many indices as ``texel_of`` one."""
    if wrap == "clamp":
        return indices.clip(0, size - 1)
    turns, places = np.divmod(indices, size)
    return np.where((turns % 2 == 1) & (wrap == "mirror"), size - 1 - places, places)
