"""Pictures, projected onto a surface: a source of paint and of how opaque it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, ChannelFormat
from octex.jit import inlined, kernel
from octex.painting.pictures import Levels, Projection, levels_of, read_paint
from octex.source.base import Source
from octex.view.shading import face_normals
from octex.view.visibility import (
    Seen,
    View,
    distances_to_edges,
    look,
    nearness,
    plane_through,
    seen_part,
    straight,
    tolerance,
    transformed,
    view_of,
)

Floats = npt.NDArray[np.float64]
Int32s = npt.NDArray[np.int32]

#: By how many degrees before the largest angle paint begins to fade.
FADE = 10.0
#: Of the four pixels around a point, what part must see it (by their weights), and from what part on they
#: are trusted wholly: beside an edge pixels mix what is before it with what is behind.
_LEAST_SEEN, _WELL_SEEN = 0.5, 1.0
#: Beside an edge pictures are blurred with what is behind it: within so many pixels others count for more.
_TRUSTED = 4.0
#: How strongly the finer of two pictures outweighs the other: by this power of their pixels on the surface.
_FINER = 2.0
#: Coverage is kept in 16 bits: 8 would change a wash by up to half a step.
COVERAGE = ALPHA._replace(dtype="uint16")


class Shot(NamedTuple):
    """A picture and what its camera sees, as kernels read them."""

    camera: View  # without distortion
    lens: npt.NDArray[np.float64]  # (13,)   K (9) of the picture, then k1, k2, p1, p2
    levels: Levels
    seen: Seen
    margins: npt.NDArray[np.float32]  # (height, width)   to where the surface ends, in pixels; at most so far
    centres: npt.NDArray[np.float32]  # (height, width, 3)   barycentric coordinates of the pixels' centres


class Terms(NamedTuple):
    """Under which terms paint is put."""

    fading: float  # cosine of the angle from which on paint fades
    vanishing: float  # and where it has vanished
    feather: float  # pixels over which it fades towards edges
    back_faces: bool


def take_shot(
    projection: Projection,
    form: ChannelFormat,
    vertices: Floats,
    triangles: Int32s,
    feather: float,
    scale: float,
) -> Shot:
    """Decode a picture, its alpha times ``scale``, and find what its camera sees.

    Raises as `levels_of` does.
    """
    levels = levels_of(projection, form, scale)
    camera = projection.camera
    pinhole = straight(camera)
    seen, centres = look(vertices, triangles, pinhole)
    view = view_of(pinhole)
    margins = distances_to_edges(seen, view, max(feather, _TRUSTED) + 1.0)
    lens = np.concatenate([camera.K.ravel(), camera.distortion])
    return Shot(view, lens, levels, seen, margins, centres)


def terms_of(max_angle: float, feather: float, back_faces: bool) -> Terms:
    """Return terms for angles in degrees between the surface's normal and what looks at it."""
    vanishing, fading = np.radians(max_angle), np.radians(max(max_angle - FADE, 0.0))
    whole = max_angle >= 90.0  # all that faces the camera, in full
    return Terms(
        -1.0 if whole else float(np.cos(fading)),
        -2.0 if whole else float(np.cos(vanishing)),
        feather,
        back_faces,
    )


class Projected(Source):
    """Paint from shots of a posed surface: a channel's components, and their coverage.

    vertices (n, 3) posed positions; rest (n, 3); triangles (m, 3)
    """

    def __init__(
        self,
        shots: Sequence[Shot],
        form: ChannelFormat,
        terms: Terms,
        vertices: Floats,
        rest: Floats,
        triangles: Int32s,
        gains: npt.NDArray[np.float32] | None = None,
    ) -> None:
        self._shots = list(shots)
        self._channels = (form, COVERAGE)
        self._terms = terms
        self._mesh = vertices, triangles
        _, posed_areas = face_normals(vertices, triangles)
        _, rest_areas = (None, posed_areas) if rest is vertices else face_normals(rest, triangles)
        with np.errstate(divide="ignore", invalid="ignore"):
            stretches = np.sqrt(rest_areas / posed_areas)
        #: What is 1 long on the posed triangle is so long at rest.
        self._stretches = np.nan_to_num(stretches, nan=1.0, posinf=1e6).astype(np.float32)
        self._gains = np.ones((len(self._shots), 3), np.float32) if gains is None else gains

    @property
    def channels(self) -> tuple[ChannelFormat, ...]:
        """The channel that is painted, and its coverage, ``alpha``."""
        return self._channels

    def evaluate(
        self, triangles: Int32s, barycentric: Floats, widths: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros where there is none."""
        sums, clear = np.zeros((len(triangles), 4)), np.ones(len(triangles))
        for shot, gains in zip(self._shots, self._gains, strict=True):
            _add(
                shot,
                self._terms,
                *self._mesh,
                self._stretches,
                gains,
                triangles,
                barycentric,
                widths,
                sums,
                clear,
            )
        found = np.zeros((len(triangles), self._channels[0].components + 1), np.float32)
        _finish(sums, clear, found)
        return found

    def each(
        self, triangles: Int32s, barycentric: Floats, widths: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return what each shot paints (shots, n, 3), and its weight (shots, n)."""
        paint = np.zeros((len(self._shots), len(triangles), 3), np.float32)
        weights = np.zeros((len(self._shots), len(triangles)), np.float32)
        for number, shot in enumerate(self._shots):
            sums, clear = np.zeros((len(triangles), 4)), np.ones(len(triangles))
            gains = self._gains[number]
            _add(
                shot,
                self._terms,
                *self._mesh,
                self._stretches,
                gains,
                triangles,
                barycentric,
                widths,
                sums,
                clear,
            )
            weights[number] = sums[:, 3]
            paint[number] = sums[:, :3] / np.maximum(sums[:, 3:], 1e-300)
        return paint, weights

    def texel_edges(self, triangles: Int32s) -> npt.NDArray[np.float32]:
        """Return the edge of the finest pixel on triangles (n,), in rest units; infinity where none is."""
        middles = np.full((len(triangles), 3), 1 / 3)
        return self.pixel_widths(triangles, middles)

    def pixel_widths(self, triangles: Int32s, barycentric: Floats) -> npt.NDArray[np.float32]:
        """Return how wide the finest pixel that looks toward points is there, across the view, in rest units.

        Infinity for points that no camera has before it.
        """
        widths = np.full(len(triangles), np.inf, np.float32)
        for shot in self._shots:
            _narrow(
                shot, *self._mesh, self._stretches, self._terms.back_faces, triangles, barycentric, widths
            )
        return widths


@inlined
def _smooth(t: float) -> float:
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@inlined
def _in_picture(shot: Shot, view: View, x: float, y: float, z: float) -> tuple[float, float]:
    """Return where the lens puts a point of camera axes in the picture."""
    lens = shot.lens
    if view.is_pinhole:
        x, y = x / z, y / z
        k1, k2, p1, p2 = lens[9], lens[10], lens[11], lens[12]
        square = x * x + y * y
        if 1.0 + square * (3.0 * k1 + 5.0 * k2 * square) <= 0.0:  # would be folded back
            return -1e9, -1e9
        radial = 1.0 + square * (k1 + square * k2)
        x, y = (
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    return lens[0] * x + lens[1] * y + lens[2], lens[4] * y + lens[5]


@inlined
def _point(
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    c: tuple[float, float, float],
    barycentric: Floats,
    n: int,
) -> tuple[float, float, float]:
    p, q, r = barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
    return (
        p * a[0] + q * b[0] + r * c[0],
        p * a[1] + q * b[1] + r * c[1],
        p * a[2] + q * b[2] + r * c[2],
    )


@inlined
def _facing(view: View, plane: tuple[float, float, float, float], x: float, y: float, z: float) -> float:
    """Return the cosine between a plane's normal and the way to the camera."""
    length = np.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
    if not length > 0.0:
        return 0.0
    if not view.is_pinhole:
        return float(-plane[2] / length)
    return float(-plane[3] / (length * np.sqrt(x * x + y * y + z * z)))


@inlined
def _pixel(view: View, z: float) -> float:
    """Return how wide a pixel is across the view."""
    return float((z if view.is_pinhole else 1.0) / np.sqrt(view.K[0, 0] * view.K[1, 1]))


@kernel
def _add(
    shot: Shot,
    terms: Terms,
    vertices: Floats,
    faces: Int32s,
    stretches: npt.NDArray[np.float32],
    gains: npt.NDArray[np.float32],
    triangles: Int32s,
    barycentric: Floats,
    widths: npt.NDArray[np.float32],
    sums: Floats,
    clear: Floats,
) -> None:
    """Add a shot's paint to weighted sums (n, 4), and take its coverage from what is ``clear`` (n,)."""
    view = shot.camera
    height, width = shot.seen.triangle.shape
    columns, rows = shot.levels.sizes[0, 1], shot.levels.sizes[0, 2]
    last = -1
    a = b = c = (0.0, 0.0, 0.0)
    plane = (0.0, 0.0, 0.0, 0.0)
    base = right = down = size = 0.0
    for n in range(triangles.size):
        triangle = int(triangles[n])
        if triangle != last:
            last = triangle
            a = transformed(view, vertices, faces[triangle, 0])
            b = transformed(view, vertices, faces[triangle, 1])
            c = transformed(view, vertices, faces[triangle, 2])
            plane = plane_through(a, b, c)
            base, right, down = nearness(view, plane)
        x, y, z = _point(a, b, c, barycentric, n)
        if not z > 0.0:
            continue
        cosine = _facing(view, plane, x, y, z)
        if cosine < 0.0 and terms.back_faces:
            cosine = -cosine
        if not cosine > max(terms.vanishing, 0.0):
            continue
        u, v = _in_picture(shot, view, x, y, z)
        if not (0.0 <= u < columns and 0.0 <= v < rows):
            continue
        px = view.K[0, 0] * x + view.K[0, 1] * y
        py = view.K[1, 1] * y
        if view.is_pinhole:
            px, py = px / z, py / z
        px, py = px + view.K[0, 2], py + view.K[1, 2]
        if not (0.0 <= px < width and 0.0 <= py < height):
            continue
        pixel = _pixel(view, z)
        area = np.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
        size = 0.5 * area * cosine / (pixel * pixel)
        near = base + right * px + down * py
        slack = tolerance(view, near, right, down, size)
        part = seen_part(shot.seen, triangle, px, py, near, right, down, slack)
        coverage = _smooth((part - _LEAST_SEEN) / (_WELL_SEEN - _LEAST_SEEN))
        if terms.vanishing > -1.0:
            coverage *= _smooth((cosine - terms.vanishing) / (terms.fading - terms.vanishing))
        margin = min(min(u, columns - u), min(v, rows - v))
        margin = min(margin, np.float64(shot.margins[int(py), int(px)]))
        if terms.feather > 0.0:
            coverage *= _smooth(margin / terms.feather)
        if not coverage > 0.0:
            continue
        wide = np.float64(widths[n]) / max(np.float64(stretches[triangle]), 1e-30) * np.sqrt(cosine) / pixel
        red, green, blue, alpha = read_paint(shot.levels, u, v, wide)
        if not alpha > 0.0:
            continue
        density = cosine / (pixel * pixel)
        trust = 0.01 + min(margin / _TRUSTED, 1.0)
        weight = coverage * trust * density**_FINER  # of what is multiplied by alpha already
        sums[n, 0] += weight * red * gains[0]
        sums[n, 1] += weight * green * gains[1]
        sums[n, 2] += weight * blue * gains[2]
        sums[n, 3] += weight * alpha
        clear[n] *= 1.0 - min(coverage * alpha, 1.0)


@kernel
def _finish(sums: Floats, clear: Floats, found: npt.NDArray[np.float32]) -> None:
    components = found.shape[1] - 1
    for n in range(clear.size):
        if sums[n, 3] > 0.0:
            for component in range(components):
                found[n, component] = sums[n, min(component, 2)] / sums[n, 3]
            found[n, components] = 1.0 - clear[n]


@kernel
def _narrow(
    shot: Shot,
    vertices: Floats,
    faces: Int32s,
    stretches: npt.NDArray[np.float32],
    back_faces: bool,
    triangles: Int32s,
    barycentric: Floats,
    widths: npt.NDArray[np.float32],
) -> None:
    """Lower ``widths`` (n,) to that of a shot's pixels, where it looks toward the points."""
    view = shot.camera
    columns, rows = shot.levels.sizes[0, 1], shot.levels.sizes[0, 2]
    last = -1
    a = b = c = (0.0, 0.0, 0.0)
    plane = (0.0, 0.0, 0.0, 0.0)
    for n in range(triangles.size):
        triangle = int(triangles[n])
        if triangle != last:
            last = triangle
            a = transformed(view, vertices, faces[triangle, 0])
            b = transformed(view, vertices, faces[triangle, 1])
            c = transformed(view, vertices, faces[triangle, 2])
            plane = plane_through(a, b, c)
        x, y, z = _point(a, b, c, barycentric, n)
        if not z > 0.0 or (not back_faces and not _facing(view, plane, x, y, z) > 0.0):
            continue
        u, v = _in_picture(shot, view, x, y, z)
        if 0.0 <= u < columns and 0.0 <= v < rows:
            wide = np.float32(_pixel(view, z) * stretches[triangle])
            widths[n] = min(widths[n], wide)
