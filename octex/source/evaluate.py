"""Kernels that evaluate materials at points of a surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Uint8s
from octex.jit import inlined, kernel
from octex.source.corners import Corners, Frames
from octex.source.images.filters import MOST_VARIANCE, find_taps, footprint
from octex.source.images.pyramid import Images
from octex.source.images.taps import MOST_TAPS, Footprint, gather
from octex.source.tangents import axes_at
from octex.source.vectors import Vector, between, cross_product, dot_product, edges_from, length_of, unit

OPAQUE, MASK, BLEND = 0, 1, 2


class MaterialTables(NamedTuple):
    """Materials, and the attributes of triangles that they read.

    A *stack* is a set of images of one size that a material reads at the same coordinates with the same
    wraps. The *lanes* of a material are a 1, then four components of each image, stack by stack.
    """

    materials: Int32s  # (triangles,)
    first_stacks: Int32s  # (materials + 1,)
    stacks: Int32s  # (stacks, 6)   layout, slot, wraps of u and v, flat texels, first image
    images: Int32s  # (images of all stacks, in order, and one more,)
    lanes: Int32s  # (materials, columns)
    gains: Float32s  # (materials, columns)
    offsets: Float32s  # (materials, columns)
    alpha_modes: Uint8s  # (materials,)
    alpha_factors: Float32s  # (materials,)
    cutoffs: Float32s  # (materials,)
    colors: Corners  # linear light and alpha; no rows: no vertex colours
    coordinates: Float32s  # (rows, 2)   v down
    coordinate_rows: Int32s  # (slots, triangles, 3)
    frames: Frames  # at rest; no rows if no channel is a direction
    # The first columns of the channels that need more than offset + gain × lane; −1 if missing.
    base_color: int
    alpha: int
    normal: int


@kernel
def measure(
    coordinates: Float32s, rows: Int32s, rest: Float64s, triangles: Int32s, footprints: Float64s
) -> None:
    """Fill in the covariance (slots, triangles, 3), in images, of a unit box on each triangle.

    It is JJᵀ / 12 as (uu, uv, vv), where J is the Jacobian of coordinates by rest positions; 0 without area.
    """
    for triangle in range(triangles.shape[0]):
        e, f = edges_from(rest, triangles, triangle)
        base = length_of(e)
        if not base > 0.0:
            continue
        shift, rise = dot_product(e, f) / base, length_of(cross_product(e, f)) / base
        if not rise > 1e-12 * base:
            continue
        for slot in range(rows.shape[0]):
            a, b, c = rows[slot, triangle, 0], rows[slot, triangle, 1], rows[slot, triangle, 2]
            u0, v0 = np.float64(coordinates[a, 0]), np.float64(coordinates[a, 1])
            # The Jacobian's columns are coordinates per unit along the base and across it.
            ux, vx = (coordinates[b, 0] - u0) / base, (coordinates[b, 1] - v0) / base
            uy = (coordinates[c, 0] - u0 - ux * shift) / rise
            vy = (coordinates[c, 1] - v0 - vx * shift) / rise
            uu, uv, vv = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
            if uu + vv < 1e120:
                footprints[slot, triangle, 0] = uu / 12.0
                footprints[slot, triangle, 1] = uv / 12.0
                footprints[slot, triangle, 2] = vv / 12.0


def texel_edges(tables: MaterialTables, images: Images, footprints: Float64s) -> Float32s:
    """Return the root of the area of the finest image's texel (triangles,), in rest units, or infinity."""
    finest = np.zeros((len(footprints), tables.first_stacks.size - 1))
    for material in range(finest.shape[1]):
        for stack in tables.stacks[tables.first_stacks[material] : tables.first_stacks[material + 1]]:
            _, width, height = images.levels[images.layouts[stack[0], 0]][:3]
            finest[stack[1], material] = max(finest[stack[1], material], width * height)
    uu, uv, vv = np.moveaxis(footprints, 2, 0)
    areas = 12.0 * np.sqrt(np.maximum(uu * vv - uv * uv, 0.0)) * finest[:, tables.materials]
    with np.errstate(divide="ignore"):
        edges = 1.0 / np.sqrt(np.max(areas, axis=0, initial=0.0))
    return np.asarray(edges, np.float32)


@kernel
def evaluate(
    tables: MaterialTables, images: Images, footprints: Float64s, filter: int | None, triangles: Int32s,
    barycentric: Float64s, widths: Float32s, values: Float32s,
) -> None:  # fmt: skip
    """Fill in the values (n, columns) at points of triangles; ``filter`` is a `filters.kernel_code`."""
    indices = np.empty(MOST_TAPS, np.int64)
    weights = np.empty(MOST_TAPS, np.float64)
    most_stacks = most_images = 0
    for material in range(tables.first_stacks.size - 1):
        first, end = tables.first_stacks[material], tables.first_stacks[material + 1]
        most_stacks = max(most_stacks, end - first)
        if end > first:
            most_images = max(most_images, tables.stacks[end, 5] - tables.stacks[first, 5])
    lanes = np.empty(1 + 4 * most_images, np.float32)
    for lane in range(lanes.size):
        lanes[lane] = np.float32(1.0)
    # Consecutive points of one triangle share its data: this saves a quarter of the time.
    shared = np.empty((most_stacks, 11), np.float64)
    last = -1
    material = first = end = mode = 0
    widest = np.inf
    has_colors = tables.colors.values.shape[0] > 0
    for i in range(triangles.size):
        triangle = int(triangles[i])
        if triangle != last:
            last = triangle
            material = int(tables.materials[triangle])
            mode = int(tables.alpha_modes[material])
            first, end = int(tables.first_stacks[material]), int(tables.first_stacks[material + 1])
            widest = np.inf
            for stack in range(first, end):
                # The coordinates of the triangle's corners, and a footprint of width 1 in the stack's images.
                slot, row = tables.stacks[stack, 1], stack - first
                for corner in range(3):
                    at = tables.coordinate_rows[slot, triangle, corner]
                    shared[row, 2 * corner] = tables.coordinates[at, 0]
                    shared[row, 2 * corner + 1] = tables.coordinates[at, 1]
                level = images.layouts[tables.stacks[stack, 0], 0]
                shared[row, 6], shared[row, 7], shared[row, 8], shared[row, 9], shared[row, 10] = footprint(
                    footprints[slot, triangle, 0],
                    footprints[slot, triangle, 1],
                    footprints[slot, triangle, 2],
                    images.levels[level, 1],
                    images.levels[level, 2],
                )
                widest = min(widest, MOST_VARIANCE / max(shared[stack - first, 10], 1e-200))
        b0, b1, b2 = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        shares = (b0, b1, b2)
        red = green = blue = 1.0
        alpha = float(tables.alpha_factors[material])
        if has_colors:
            colors, rows = tables.colors
            red, green, blue = between(colors, rows, triangle, shares)
            c0, c1, c2 = rows[triangle, 0], rows[triangle, 1], rows[triangle, 2]
            alpha *= b0 * colors[c0, 3] + b1 * colors[c1, 3] + b2 * colors[c2, 3]
        threshold = -1.0
        if mode == MASK:
            threshold = tables.cutoffs[material] / alpha if alpha > 0.0 else np.inf
        width = np.float64(widths[i])
        square = min(width * width, widest)
        at = 1
        thresholded = False
        for stack in range(first, end):
            row = stack - first
            layout = int(tables.stacks[stack, 0])
            stacks = tables.stacks
            foot = Footprint(
                b0 * shared[row, 0] + b1 * shared[row, 2] + b2 * shared[row, 4],
                b0 * shared[row, 1] + b1 * shared[row, 3] + b2 * shared[row, 5],
                square * shared[row, 6],
                square * shared[row, 7],
                square * shared[row, 8],
                square * shared[row, 9],
                square * shared[row, 10],
                int(stacks[stack, 2]),
                int(stacks[stack, 3]),
                stacks[stack, 4] != 0,
            )
            count, cut, scale = find_taps(images, layout, filter, foot, indices, weights)
            for image in range(tables.stacks[stack, 5], tables.stacks[stack + 1, 5]):
                number = int(tables.images[image])
                gather(images, number, layout, indices, weights, count, cut, scale, threshold, lanes, at)
                thresholded |= images.covered[number]
                at += 4
        for column in range(values.shape[1]):
            lane = lanes[tables.lanes[material, column]]
            values[i, column] = tables.offsets[material, column] + tables.gains[material, column] * lane
        if tables.base_color >= 0 and has_colors:
            values[i, tables.base_color] *= np.float32(red)
            values[i, tables.base_color + 1] *= np.float32(green)
            values[i, tables.base_color + 2] *= np.float32(blue)
        if tables.alpha >= 0:
            coverage = float(lanes[tables.lanes[material, tables.alpha]])
            if mode == OPAQUE:
                coverage = 1.0
            elif mode == BLEND:
                coverage *= alpha
            elif not thresholded:
                coverage = 1.0 if coverage >= threshold else 0.0
            values[i, tables.alpha] = coverage
        if tables.normal >= 0:
            _turn(tables, triangle, shares, width == 0.0, values, i, tables.normal)


@inlined
def _turn(
    tables: MaterialTables,
    triangle: int,
    shares: Vector,
    is_point: bool,
    values: Float32s,
    i: int,
    column: int,
) -> None:
    """Transform a direction from tangent space to rest space; at a point, normalize it."""
    tangent, other, normal, hand = axes_at(tables.frames, triangle, shares)
    x, y, z = values[i, column], values[i, column + 1], values[i, column + 2]
    direction: Vector = np.float64(x), np.float64(y), np.float64(z)
    if is_point:
        direction = unit(direction)
    across, up, out = direction[0], direction[1] * hand, direction[2]
    for k in range(3):
        values[i, column + k] = across * tangent[k] + up * other[k] + out * normal[k]
