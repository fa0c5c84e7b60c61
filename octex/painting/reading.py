"""Reads one image at points of a surface that its camera sees: kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.cameras.lens import distorted
from octex.jit import inlined, kernel
from octex.painting.image import Mips, clipped, falloff_at, read_paint
from octex.source.images.taps import catmull_rom
from octex.source.vectors import Vector
from octex.view.visibility import (
    View,
    Visibility,
    nearness,
    parts,
    plane_through,
    tolerance,
    transformed,
    visible_part,
)

#: Pixels from an edge within which an image counts for less: edges blur with the background.
TRUSTED = 4.0
#: Least share, by weight, of the four pixels around a point that must see it, and the share for full weight:
#: pixels at an edge mix foreground and background.
_LEAST_SEEN, _WELL_SEEN = 0.5, 1.0
#: Pixels from an edge within which a footprint may reach beyond it.
_NEAR_EDGE = 3.0
#: Weight of pixels at an edge, which may be mixed with the background.
_MIXED = np.float32(0.15)
#: Least cosine for surface that faces the camera but shades as if it did not.
_LEAST_COSINE = 1e-3


class Shot(NamedTuple):
    """An image and the surface visible to its camera, as kernels read them."""

    camera: View  # without distortion
    K: Float64s  # (3, 3)   of the image
    lens: Float64s  # (14,)   see octex.cameras.lens.lens_numbers
    mips: Mips
    seen: Visibility
    margins: Float32s  # (height, width)   pixels to the nearest edge of the surface, limited
    gains: Float32s  # (3,)   factors of its components
    falloff: Float64s  # (2,)   factors toward its corners, see `falloff_at`
    weight: float  # among several images


class Terms(NamedTuple):
    """Options of painting, for kernels."""

    fading: float  # cosine of the angle from which paint fades
    vanishing: float  # cosine of the angle beyond which there is none
    feather: float  # pixels over which it fades towards edges
    back_faces: bool
    hidden: bool
    enough: float = 0.0  # width at rest below which finer pixels count no more; 0: none
    is_light: bool = False  # average the square roots of values


@inlined
def _smooth(t: float) -> float:
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@inlined
def _slopes(view: View, x: float, y: float, z: float) -> tuple[float, float]:
    """Project a point in camera axes, without K and distortion."""
    return (x / z, y / z) if view.is_pinhole else (x, y)


@inlined
def _in_image(shot: Shot, x: float, y: float) -> tuple[float, float]:
    """Return pixel coordinates of `_slopes`, with distortion."""
    K = shot.K
    if shot.camera.is_pinhole:
        x, y = distorted(shot.lens, x, y)
    return K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]


@inlined
def weighted(a: Vector, b: Vector, c: Vector, p: float, q: float, r: float) -> Vector:
    """Return p · a + q · b + r · c."""
    return (
        p * a[0] + q * b[0] + r * c[0],
        p * a[1] + q * b[1] + r * c[1],
        p * a[2] + q * b[2] + r * c[2],
    )


@inlined
def _pixels(view: View, z: float) -> float:
    """Return the pixels across a width of 1 that faces the camera at a depth."""
    return float(view.focal / z if view.is_pinhole else view.focal)


@inlined
def _length_of(plane: tuple[float, float, float, float]) -> float:
    return float(np.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]))


@inlined
def _facing(view: View, plane: tuple[float, float, float, float], area: float, far: float) -> float:
    """Return the cosine between a plane's normal, of length ``area``, and the camera, at distance ``far``."""
    if not area > 0.0:
        return 0.0
    return float(-plane[3] / (area * far) if view.is_pinhole else -plane[2] / area)


@inlined
def is_turned_away(view: View, plane: tuple[float, float, float, float], back_faces: bool) -> bool:
    """Return whether a camera sees no paintable side of a plane."""
    toward = -plane[3] if view.is_pinhole else -plane[2]
    return not (abs(toward) if back_faces else toward) > 0.0


@inlined
def _turned(view: View, normals: Float32s, triangle: int, corner: int) -> Vector:
    """Return a normal in camera axes."""
    M = view.world_to_camera
    a, b, c = normals[triangle, corner, 0], normals[triangle, corner, 1], normals[triangle, corner, 2]
    return (
        M[0, 0] * a + M[0, 1] * b + M[0, 2] * c,
        M[1, 0] * a + M[1, 1] * b + M[1, 2] * c,
        M[2, 0] * a + M[2, 1] * b + M[2, 2] * c,
    )


@inlined
def _shaded(
    view: View,
    plane: tuple[float, float, float, float],
    normal: Vector,
    point: Vector,
    far: float,
    cosine: float,
) -> float:
    """Return the cosine between a point's shading normal and the camera, at distance ``far``."""
    (u, v, w), (x, y, z) = normal, point
    length = np.sqrt(u * u + v * v + w * w)
    if not length > 0.0:
        return cosine
    if u * plane[0] + v * plane[1] + w * plane[2] < 0.0:
        length = -length
    return float(-(u * x + v * y + w * z) / (length * far) if view.is_pinhole else -w / length)


@inlined
def _read_near_edge(
    shot: Shot,
    triangle: int,
    position: tuple[float, float],
    pixel: tuple[float, float],
    plane: Vector,
    slack: float,
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return paint at a position as `read_paint` does, but only from pixels that see the same surface.

    Their mean, weighted by nearness, replaces others. ``pixel`` is the position before distortion.
    """
    (u, v), (x, y) = position, pixel
    columns, rows = shot.mips.sizes[0, 1], shot.mips.sizes[0, 2]
    height, width = shot.seen.rows.shape
    left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    of_x, of_y = catmull_rom(np.float32(u - 0.5 - left)), catmull_rom(np.float32(v - 0.5 - top))
    none = np.float32(0.0)
    a = b = c = d = e = f = g = h = none
    share = total = none
    for n in range(16):
        row, column = top + n // 4 - 1, left + n % 4 - 1
        if not (0 <= row < rows and 0 <= column < columns):
            continue
        dx, dy = column + 0.5 - u, row + 0.5 - v
        i, j = int(np.floor(y + dy)), int(np.floor(x + dx))
        if not (0 <= i < height and 0 <= j < width):
            continue
        seen_row = shot.seen.rows[i, j]
        if seen_row < 0 or (
            shot.seen.triangles[seen_row] != triangle and parts(shot.seen, i, j, pixel, plane, slack)
        ):
            continue
        weight, far = of_y[n // 4] * of_x[n % 4], np.float32(dx * dx + dy * dy + 0.1)
        nearness_weight = np.float32(1.0) / (far * far)
        if shot.margins[i, j] < np.float32(1.0) and not _is_cut_out(shot, row, column, i, j):
            weight, nearness_weight = weight * _MIXED, nearness_weight * _MIXED * _MIXED
        p, w = shot.mips.pixels[row * columns + column], nearness_weight
        a, b, c, d = a + weight * p[0], b + weight * p[1], c + weight * p[2], d + weight * p[3]
        e, f, g, h = e + w * p[0], f + w * p[1], g + w * p[2], h + w * p[3]
        share += weight
        total += w
    if not total > none:
        return read_paint(shot.mips, u, v, 1.0)
    rest = (np.float32(1.0) - share) / total
    return clipped(shot.mips, a + rest * e, b + rest * f, c + rest * g, d + rest * h)


@inlined
def _is_cut_out(shot: Shot, row: int, column: int, i: int, j: int) -> bool:
    """Return whether the image is transparent in the background next to a pixel, of view pixel (i, j)."""
    columns, rows = shot.mips.sizes[0, 1], shot.mips.sizes[0, 2]
    height, width = shot.seen.rows.shape
    for side in range(4):
        down, right = (side & 1) * (side - 2), (1 - (side & 1)) * (side - 1)
        inside = 0 <= row + down < rows and 0 <= column + right < columns
        inside = inside and 0 <= i + down < height and 0 <= j + right < width
        at = (row + down) * columns + column + right
        if inside and shot.seen.rows[i + down, j + right] < 0 and shot.mips.pixels[at, 3] == 0.0:
            return True
    return False


@inlined
def corners_in(view: View, vertices: Float64s, faces: Int32s, triangle: int) -> tuple[Vector, Vector, Vector]:
    """Return a triangle's corners in camera axes."""
    a, b, c = faces[triangle, 0], faces[triangle, 1], faces[triangle, 2]
    return transformed(view, vertices, a), transformed(view, vertices, b), transformed(view, vertices, c)


@inlined
def box_in(view: View, corners: tuple[Vector, ...]) -> tuple[float, float, float, float, int]:
    """Return left, top, right and bottom of corners in a view, and how many of them lie behind it."""
    left, top, right, bottom, behind = np.inf, np.inf, -np.inf, -np.inf, 0
    for x, y, z in corners:
        behind += not z > 0.0
        slope_x, slope_y = _slopes(view, x, y, z if z > 0.0 else 1.0)
        x = view.K[0, 0] * slope_x + view.K[0, 1] * slope_y + view.K[0, 2]
        y = view.K[1, 1] * slope_y + view.K[1, 2]
        left, right = min(left, x), max(right, x)
        top, bottom = min(top, y), max(bottom, y)
    return left, top, right, bottom, behind


@inlined
def _summand(terms: Terms, value: float, alpha: np.float32) -> float:
    """Return a value, times alpha, or its square root, times alpha.

    Means of roots are nearer to photographs than means of light, in which highlights count most.
    """
    return float(np.sqrt(max(value, 0.0) * alpha)) if terms.is_light else float(value)


@kernel
def add_paint(
    shot: Shot,
    terms: Terms,
    vertices: Float64s,
    faces: Int32s,
    stretches: Float32s,
    normals: Float32s,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
    finest: Float32s,
    sums: Float64s,
    clear: Float64s,
) -> None:
    """Add a shot's paint to weighted sums (n, 4), of roots as `Terms` say; times ``clear`` 1 − coverage."""
    view = shot.camera
    height, width = shot.seen.rows.shape
    columns, rows = shot.mips.sizes[0, 1], shot.mips.sizes[0, 2]
    last = -1
    a = b = c = of_a = of_b = of_c = (0.0, 0.0, 0.0)
    plane = (0.0, 0.0, 0.0, 0.0)
    base = right = down = area = stretch = 0.0
    is_unseen = False
    for n in range(triangles.size):
        triangle = int(triangles[n])
        if triangle != last:
            last = triangle
            a, b, c = corners_in(view, vertices, faces, triangle)
            plane = plane_through(a, b, c)
            left, top, right, bottom, behind = box_in(view, (a, b, c))
            is_outside = right < -1.0 or left > width + 1.0 or bottom < -1.0 or top > height + 1.0
            is_unseen = is_turned_away(view, plane, terms.back_faces)
            is_unseen = is_unseen or behind == 3 or (behind == 0 and is_outside)
            if not is_unseen:
                of_a = _turned(view, normals, triangle, 0)
                of_b = _turned(view, normals, triangle, 1)
                of_c = _turned(view, normals, triangle, 2)
                area = _length_of(plane)
                stretch = max(np.float64(stretches[triangle]), 1e-30)
                base, right, down = nearness(view, plane)
        if is_unseen:
            continue
        p, q, r = barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        x, y, z = weighted(a, b, c, p, q, r)
        if not z > 0.0:
            continue
        far = np.sqrt(x * x + y * y + z * z)
        cosine = _facing(view, plane, area, far)
        cosine = abs(cosine) if terms.back_faces else cosine
        if not cosine > 0.0:
            continue
        shaded = _shaded(view, plane, weighted(of_a, of_b, of_c, p, q, r), (x, y, z), far, cosine)
        shaded = min(abs(shaded) if terms.back_faces else shaded, 1.0)
        if not shaded > terms.vanishing:
            continue
        slope_x, slope_y = _slopes(view, x, y, z)
        u, v = _in_image(shot, slope_x, slope_y)
        if not (0.0 <= u < columns and 0.0 <= v < rows):
            continue
        px = view.K[0, 0] * slope_x + view.K[0, 1] * slope_y + view.K[0, 2]
        py = view.K[1, 1] * slope_y + view.K[1, 2]
        if not (0.0 <= px < width and 0.0 <= py < height):
            continue
        fine = _pixels(view, z)
        inverse_depth = base + right * px + down * py
        slack = tolerance(view, inverse_depth, right, down, 0.5 * area * cosine * fine * fine)
        coverage = 1.0
        if not terms.hidden:
            part = visible_part(shot.seen, triangle, (px, py), (inverse_depth, right, down), slack)
            coverage = _smooth((part - _LEAST_SEEN) / (_WELL_SEEN - _LEAST_SEEN))
        if terms.vanishing > -1.0:
            coverage *= _smooth((shaded - terms.vanishing) / (terms.fading - terms.vanishing))
        inside = min(min(u, columns - u), min(v, rows - v))
        margin = float(min(inside, np.float64(shot.margins[int(py), int(px)])))
        if terms.feather > 0.0:
            coverage *= _smooth(margin / terms.feather)
        if not coverage > 0.0:
            continue
        footprint = np.float64(widths[n]) / stretch * np.sqrt(cosine) * fine
        if margin < _NEAR_EDGE and footprint < 2.0 and not terms.hidden:
            red, green, blue, alpha = _read_near_edge(
                shot, triangle, (u, v), (px, py), (inverse_depth, right, down), slack
            )
        else:
            red, green, blue, alpha = read_paint(shot.mips, u, v, footprint)
        if not alpha > 0.0:
            continue
        # Pixels up to twice as wide as the finest count alike, since cameras and meshes are off by a pixel.
        density = max(shaded, _LEAST_COSINE)
        if terms.enough > 0.0:
            density *= min(fine * max(terms.enough, 2.0 * finest[n]) / stretch, 1.0) ** 8
        else:
            density *= fine * fine
        trust = 0.01 + min(margin / TRUSTED, 1.0)
        weight = shot.weight * coverage * trust * density
        factor = falloff_at(shot.falloff, columns, rows, u, v)
        sums[n, 0] += weight * _summand(terms, factor * red * shot.gains[0], alpha)
        sums[n, 1] += weight * _summand(terms, factor * green * shot.gains[1], alpha)
        sums[n, 2] += weight * _summand(terms, factor * blue * shot.gains[2], alpha)
        sums[n, 3] += weight * alpha
        clear[n] *= max(1.0 - coverage * np.float64(alpha), 0.0)


@kernel
def finish(terms: Terms, sums: Float64s, clear: Float64s, values: Float32s) -> None:
    """Write the means of weighted sums, and coverage."""
    components = values.shape[1] - 1
    for n in range(clear.size):
        if sums[n, 3] > 0.0:
            for component in range(components):
                mean = sums[n, min(component, 2)] / sums[n, 3]
                values[n, component] = mean * mean if terms.is_light else mean
            values[n, components] = 1.0 - clear[n]


@kernel
def narrow(
    shot: Shot,
    vertices: Float64s,
    faces: Int32s,
    stretches: Float32s,
    back_faces: bool,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
) -> None:
    """Lower ``widths`` (n,) of points to those of a shot's pixels, where its camera faces them."""
    view = shot.camera
    columns, rows = shot.mips.sizes[0, 1], shot.mips.sizes[0, 2]
    last = -1
    a = b = c = (0.0, 0.0, 0.0)
    plane = (0.0, 0.0, 0.0, 0.0)
    area = stretch = 0.0
    for n in range(triangles.size):
        triangle = int(triangles[n])
        if triangle != last:
            last = triangle
            a, b, c = corners_in(view, vertices, faces, triangle)
            plane = plane_through(a, b, c)
            area = _length_of(plane)
            stretch = stretches[triangle] / view.focal * (1.0 - 1e-6)  # a lower bound, rounded down
        p, q, r = barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        x, y, z = weighted(a, b, c, p, q, r)
        if not z > 0.0 or stretch * (z if view.is_pinhole else 1.0) > widths[n]:
            continue
        cosine = _facing(view, plane, area, np.sqrt(x * x + y * y + z * z))
        if back_faces:
            cosine = abs(cosine)
        if not cosine > 0.0:
            continue
        cosine = max(cosine, _LEAST_COSINE)
        width = np.float32(stretches[triangle] / (_pixels(view, z) * np.sqrt(cosine)))
        if not width < widths[n]:
            continue
        u, v = _in_image(shot, *_slopes(view, x, y, z))
        if 0.0 <= u < columns and 0.0 <= v < rows:
            widths[n] = width
