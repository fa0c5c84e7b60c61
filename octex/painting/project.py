"""Images projected onto a surface, which a source of paint reads, and the surface that cameras see."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple, Self, cast

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s
from octex.cameras.camera import Camera
from octex.cameras.lens import is_bent
from octex.channels import ChannelFormat
from octex.conversion import large
from octex.conversion.large import NOT_STORED, Stages
from octex.conversion.levels import SMALL_BITS
from octex.jit import inlined, kernel
from octex.painting.image import Mips, Projection, Window, window_of
from octex.painting.layer import PaintSource
from octex.painting.reading import (
    TRUSTED,
    Shot,
    Terms,
    add_paint,
    box_in,
    corners_in,
    finish,
    is_turned_away,
    narrow,
    weighted,
)
from octex.parallel import built_once, start
from octex.source.corners import at_corners
from octex.source.vectors import Vector
from octex.tree.morton import decode
from octex.tree.placement import Placement
from octex.view.shading import face_normals
from octex.view.visibility import (
    View,
    Visibility,
    distances_to_edges,
    plane_through,
    straight,
    view_of,
    visibility_of,
)
from octex.voxelize.fragments import Blocks

#: A single image is decoded up to this many pixels around its paint; a power of two.
AROUND = 64


class Sight(NamedTuple):
    """The surface visible to a camera; see Shot."""

    camera: View
    K: Float64s
    lens: Float64s
    seen: Visibility
    margins: Float32s

    def shot(self, mips: Mips, window: Window | None = None) -> Shot:
        """Return the shot of an image, or of its part in a window, with pixels counted from its corner."""
        camera, K, lens, seen, margins = self
        if window is not None and (window.bottom - window.top, window.right - window.left) != margins.shape:
            shift = np.array([[1.0, 0.0, -window.left], [0.0, 1.0, -window.top], [0.0, 0.0, 1.0]])
            inner = shift @ camera.K
            camera = camera._replace(K=inner, inverse_k=np.linalg.inv(inner).astype(np.float64))
            corner = seen.corner + np.array([window.left, window.top])
            seen = seen._replace(rows=np.ascontiguousarray(window.of(seen.rows)), corner=corner)
            K, margins = shift @ K, np.ascontiguousarray(window.of(margins))
        return Shot(camera, K, lens, mips, seen, margins, np.ones(3, np.float32), np.zeros(2), 1.0)


def sight_of(
    vertices: Float64s,
    triangles: Int32s,
    camera: Camera,
    feather: float,
    executor: Executor,
    stages: Stages = NOT_STORED,
    *,
    hidden: bool = False,
) -> Sight:
    """Find which triangles (m, 3) of vertices (n, 3) a camera sees.

    With ``hidden`` nothing hides anything: all pixels refer to the first triangle.
    """
    pinhole = straight(camera)
    view = view_of(pinhole)

    def visible() -> dict[str, Array]:
        if hidden:
            size = pinhole.height, pinhole.width
            none = np.zeros(1, np.int32), np.zeros((1, 3)), np.zeros(2, np.int64)
            visibility = Visibility(np.zeros(size, np.int32), *none)
        else:
            visibility = visibility_of(vertices, triangles, pinhole, executor)
        margins = distances_to_edges(visibility, view, max(feather, TRUSTED) + 1.0)
        return {**visibility._asdict(), "margins": margins}

    def is_sound(arrays: Mapping[str, Array]) -> bool:
        rows, numbers = arrays["rows"], arrays["triangles"]
        is_in = rows.min() >= -1 and rows.max() < len(numbers) == len(arrays["planes"])
        return bool(is_in and ((numbers >= 0) & (numbers < len(triangles))).all())

    stage = stages.of(lambda: [(pinhole.height, pinhole.width), *view, feather, hidden])
    stored = stage.arrays("sight", visible, is_sound)
    visibility = Visibility(*(stored[name] for name in Visibility._fields))
    return stages.placed(Sight(view, camera.K, camera.lens, visibility, stored["margins"]))


def most_ahead() -> int:
    """Return how many images are decoded ahead: few where memory is scarce."""
    return 2 if large.is_mapped() else 64


def take_shots(
    projections: Sequence[Projection],
    form: ChannelFormat,
    scales: Sequence[float],
    sights: Iterable[Sight],
    executor: Executor,
    *,
    around: int | None = None,
    stages: Stages = NOT_STORED,
) -> Iterator[Shot]:
    """Decode images, several ahead, with alpha times ``scales``; see `window_of` for ``around``."""
    decoded = (
        start(executor, window_of, each, form, scale, around, stages)
        for each, scale in zip(projections, scales, strict=True)
    )
    queue = deque(islice(decoded, most_ahead()))
    for sight in sights:
        mips, window = queue.popleft().result()
        yield sight.shot(stages.placed(mips), window)
        queue.extend(islice(decoded, 1))


def in_fixed_order(shots: Sequence[Shot]) -> list[Shot]:
    """Sort shots by content, so that sums and fits do not depend on their order."""
    return sorted(shots, key=lambda shot: order_key(shot.camera, shot.K, shot.lens, shot.mips))


def order_key(camera: View, K: Float64s, lens: Float64s, mips: Mips) -> bytes:
    """Return a digest of a camera and an image, by which `in_fixed_order` sorts."""
    digest = hashlib.sha256(bytes([camera.is_pinhole]))
    smaller = mips.pixels[mips.sizes[min(1, len(mips.sizes) - 1), 0] :]  # its first mip has all that differs
    for array in (camera.world_to_camera, camera.K, K, lens, smaller):
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def spread(marked: Bools, reach: int) -> Bools:
    """Mark all places within ``reach`` of marked ones along each axis."""
    marked = marked.copy()
    for axis in range(marked.ndim):
        along, reached = np.moveaxis(marked, axis, 0), 0
        while reached < reach:
            step = min(reached + 1, reach - reached)  # wider steps would leave gaps
            before = along.copy("K")
            along[step:] |= before[:-step]
            along[:-step] |= before[step:]
            reached += step
    return marked


#: Pixels that are tried for triangles whose corners and centroid no image shows.
_PIXELS = 256
#: Gives normals (k, 3, 3), of any length, at the corners of triangles (k,).
Shading = Callable[[Int32s], Float32s]


@dataclass(eq=False)
class Projected(PaintSource):
    """Paint from shots of a posed surface."""

    shots: list[Shot]
    form: ChannelFormat
    terms: Terms
    vertices: Float64s  # (n, 3)   posed
    triangles: Int32s  # (m, 3)
    stretches: Float32s  # (m,)   length at rest of a length of 1 on the posed triangle
    shading: Shading
    chosen: Bools | None = None  # (m,)   the triangles to paint; None for all
    normals: Float32s | None = None  # (m, 3, 3)   cached results of `shading`

    @property
    def color(self) -> Float32s | None:
        """The value of all pixels with paint, if gains do not change it; None for several values."""
        ends = np.concatenate([shot.mips.range for shot in self.shots])
        is_one = (ends == ends[0]).all() and all(
            (shot.gains == 1.0).all() and not shot.falloff.any() for shot in self.shots
        )
        return ends[0, : self.form.components] if is_one else None

    def with_shots(self, shots: Sequence[Shot]) -> Projected:
        """Return the paint of other shots."""
        return replace(self, shots=list(shots))

    def near_paint(self, reach: int) -> Projected:
        """Return this paint, from pixels within ``reach`` of paint only; all of images with distortion."""
        shots = []
        for shot in self.shots:
            width, height = shot.mips.sizes[0, 1:]
            has_paint = shot.mips.pixels[: width * height, 3].reshape(height, width) > 0
            if not is_bent(shot.lens) and not has_paint.all():
                rows = np.where(spread(has_paint, reach), shot.seen.rows, np.int32(-1))
                shot = shot._replace(seen=shot.seen._replace(rows=large.moved(rows)))
            shots.append(shot)
        return self.with_shots(shots)

    @built_once
    def _normals(self) -> Float32s:
        triangles = np.arange(len(self.triangles), dtype=np.int32)
        return self.shading(triangles) if self.normals is None else self.normals

    def touched(self) -> Int32s:
        """Return the triangles that a shot sees, or that it may paint though they are hidden."""
        is_seen = np.zeros(len(self.triangles), np.bool_)
        for shot in self.shots:
            is_seen |= self._counts(shot) > 0
        return np.flatnonzero(is_seen).astype(np.int32)

    def _counts(self, shot: Shot) -> Int32s:
        """Return the pixels of a shot that see triangles (m,); upper bounds where hidden ones are painted."""
        if self.terms.hidden:
            return _pixels_under(shot.camera, _summed(shot.seen.rows), self.vertices, self.triangles)
        counts = np.zeros(len(self.triangles), np.int32)
        counts[shot.seen.triangles] = np.bincount(
            shot.seen.rows.reshape(-1) + 1, minlength=len(shot.seen.triangles) + 1
        )[1:]
        return counts

    def prepared(self, triangles: Int32s) -> Self:
        """Return this paint, with the normals of these triangles only."""
        normals = np.zeros((len(self.triangles), 3, 3), np.float32)  # untouched memory costs nothing
        normals[triangles] = self.shading(triangles)
        return replace(self, normals=normals)

    def reaches(self, blocks: Blocks, placement: Placement, rest: Float64s) -> Bools:
        """Return which blocks a shot may see."""
        is_reached, edge = np.zeros(blocks.codes.size, np.bool_), placement.size / 2**blocks.level
        mesh, origin = (self.vertices, self.triangles, rest), np.array(placement.origin)
        back_faces = self.terms.back_faces or blocks.bits > SMALL_BITS  # larger blocks count for cells above
        for shot in self.shots:
            seen = _summed(shot.seen.rows)
            _mark_seen(shot.camera, seen, *mesh, back_faces, blocks, origin, edge, is_reached)
        return is_reached

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros without paint."""
        where = triangles, barycentric
        sums, clear = self._sums(self.shots, *where, widths, self._finest(*where))
        values = np.zeros((len(triangles), self.form.components + 1), np.float32)
        finish(self.terms, sums, clear, values)
        return values

    def each(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> tuple[Float32s, Float32s]:
        """Return each shot's paint (shots, n, 3), and its weight (shots, n), the largest of a point 1."""
        paint = np.zeros((len(self.shots), len(triangles), 3), np.float32)
        weights = np.zeros((len(self.shots), len(triangles)))
        finest = self._finest(triangles, barycentric)
        for number, shot in enumerate(self.shots):
            sums, _ = self._sums([shot], triangles, barycentric, widths, finest)
            weights[number] = sums[:, 3]
            paint[number] = sums[:, :3] / np.maximum(sums[:, 3:], 1e-300)
        if self.terms.is_light:
            np.square(paint, out=paint)
        weights /= np.maximum(weights.max(axis=0), 1e-300)
        return paint, weights.astype(np.float32)

    def _finest(self, triangles: Int32s, barycentric: Float64s) -> Float32s:
        """Return the widths (n,) of the finest pixels at points, if weights depend on them."""
        return self.widths(triangles, barycentric) if self.terms.enough > 0.0 else np.empty(0, np.float32)

    def _sums(
        self,
        shots: Sequence[Shot],
        triangles: Int32s,
        barycentric: Float64s,
        widths: Float32s,
        finest: Float32s,
    ) -> tuple[Float64s, Float64s]:
        """Return weighted sums (n, 4) of the paint of shots, and the transparency (n,) they leave."""
        sums, clear = np.zeros((len(triangles), 4)), np.ones(len(triangles))
        mesh = self.vertices, self.triangles, self.stretches, self._normals
        for shot in shots:
            add_paint(shot, self.terms, *mesh, triangles, barycentric, widths, finest, sums, clear)
        if self.chosen is not None:
            unchosen = ~self.chosen[triangles]
            sums[unchosen], clear[unchosen] = 0.0, 1.0
        return sums, clear

    def positions(self, triangles: Int32s, barycentric: Float64s) -> Float64s:
        """Return the positions of points on the posed surface (n, 3)."""
        return at_corners(self.vertices, self.triangles[triangles], barycentric)

    def footprints(self) -> tuple[Float32s, Float64s]:
        """Return the widths of the finest pixels, ascending, and the visible areas that they stand for.

        They are taken at corners and centroids of triangles; of a large triangle with none of these in an
        image, at its pixels.
        """
        touched = self.touched()
        if self.chosen is not None:
            touched = touched[self.chosen[touched]]
        points = np.concatenate([np.eye(3), np.full((1, 3), 1 / 3)])
        widths = np.stack([self.widths(touched, np.tile(point, (len(touched), 1))) for point in points])
        outside = np.isinf(widths).all(axis=0)
        _, areas = face_normals(self.vertices, self.triangles[touched])
        seen_areas = np.zeros(len(touched))  # by the pixels at the centroids
        flat = replace(self, stretches=np.ones(len(self.triangles), np.float32))
        for shot in self.shots:
            counts = self._counts(shot)[touched]
            edges = flat.with_shots([shot]).texel_edges(touched)
            least = max((shot.seen.rows >= 0).sum() / (2 * _PIXELS), 1)
            large_ones = np.flatnonzero(outside & (counts >= least))
            if large_ones.size:
                triangles = touched[large_ones]
                inner = self._inner_points(shot, triangles)
                edges[large_ones] = flat.with_shots([shot]).widths(triangles, inner)
                inner_widths = self.with_shots([shot]).widths(triangles, inner)
                widths[:, large_ones] = np.minimum(widths[:, large_ones], inner_widths)
            edges[counts == 0] = 0.0
            seen_areas += counts * edges.astype(np.float64) ** 2
        areas, widths = np.minimum(areas, seen_areas), widths.ravel()
        # Numbers from 0 sort as their bits do: a fifth of the time of an argsort.
        keys = widths.view(np.uint32).astype(np.uint64) << np.uint64(32)
        keys |= np.arange(widths.size, dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
        return widths[order], np.tile(areas / len(points), len(points))[order]

    def _inner_points(self, shot: Shot, triangles: Int32s) -> Float64s:
        """Return barycentric coordinates (n, 3) of the nearest points that some pixels of the shot see."""
        rows, columns = np.nonzero(shot.seen.rows >= 0)
        step = slice(None, None, max(rows.size // _PIXELS, 1))
        pixels = np.stack([columns[step] + 0.5, rows[step] + 0.5, np.ones_like(rows[step])])
        rays = shot.camera.inverse_k @ pixels
        axes, offset = shot.camera.world_to_camera[:3, :3], shot.camera.world_to_camera[:3, 3]
        corners = self.vertices[self.triangles[triangles]] @ axes.T + offset
        if not shot.camera.is_pinhole:
            corners[..., 2] = 1.0
        # A ray meets the plane of a, b, c at shares in proportion to (b × c, c × a, a × b) · ray.
        across = np.cross(np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1))
        shares = across @ rays
        sums = shares.sum(axis=1)
        volumes = np.einsum("nc,nc->n", across[:, 0], corners[:, 0])[:, None]
        is_on = ((shares * np.sign(volumes)[..., None]).min(axis=1) >= 0.0) & (sums * volumes > 0.0)
        nearest = np.where(is_on, np.abs(sums), 0.0).argmax(axis=1)[:, None]
        inner = np.take_along_axis(shares, nearest[..., None], axis=2)[..., 0]
        sums = np.take_along_axis(np.where(is_on, sums, np.inf), nearest, axis=1)
        return cast(Float64s, np.where(np.isfinite(sums), inner / sums, 1 / 3))

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the width of the finest pixel on triangles (n,), at rest; infinity for none."""
        return self.widths(triangles, np.full((len(triangles), 3), 1 / 3))

    def widths(self, triangles: Int32s, barycentric: Float64s) -> Float32s:
        """Return the width of the finest pixel at points (n,), at rest; infinity without a camera."""
        widths = np.full(len(triangles), np.inf, np.float32)
        mesh = self.vertices, self.triangles, self.stretches
        for shot in self.shots:
            narrow(shot, *mesh, self.terms.back_faces, triangles, barycentric, widths)
        return widths


@kernel
def _summed(rows: Int32s) -> Int32s:
    """Return the summed-area table (height + 1, width + 1) of the pixels that see a triangle."""
    height, width = rows.shape
    counts = np.zeros((height + 1, width + 1), np.int32)
    for row in range(height):
        total = 0
        for column in range(width):
            total += rows[row, column] >= 0
            counts[row + 1, column + 1] = counts[row, column + 1] + total
    return counts


@inlined
def _count_in(counts: Int32s, left: float, top: float, right: float, bottom: float) -> int:
    """Return how many pixels within two of a box are counted in a summed-area table."""
    height, width = counts.shape[0] - 1, counts.shape[1] - 1
    i, j = int(min(max(left - 2.0, 0.0), width)), int(min(max(top - 2.0, 0.0), height))
    k, m = int(min(max(right + 3.0, i), width)), int(min(max(bottom + 3.0, j), height))
    return int(counts[m, k] - counts[j, k] - counts[m, i] + counts[j, i])


@kernel
def _pixels_under(view: View, counts: Int32s, vertices: Float64s, faces: Int32s) -> Int32s:
    """Return upper bounds of the pixels that see triangles (m,) or surface that hides them."""
    bounds = np.empty(faces.shape[0], np.int32)
    for triangle in range(faces.shape[0]):
        left, top, right, bottom, behind = box_in(view, corners_in(view, vertices, faces, triangle))
        if behind:
            bounds[triangle] = 0 if behind == 3 else counts[-1, -1]
        else:
            bounds[triangle] = _count_in(counts, left, top, right, bottom)
    return bounds


@kernel
def _mark_seen(
    view: View,
    counts: Int32s,
    vertices: Float64s,
    faces: Int32s,
    rest: Float64s,
    back_faces: bool,
    blocks: Blocks,
    origin: Float64s,
    edge: float,
    marks: Bools,
) -> None:
    """Mark the blocks with triangles that a view may see and that face it, unless ``back_faces`` count.

    ``origin`` is the root's lowest corner, ``edge`` a block's edge, both at rest. A triangle's part in a
    block lies in a rectangle. One of the four pixels around a painted point sees it.
    """
    for block in range(marks.size):
        place = decode(blocks.codes[block])
        for row in range(blocks.starts[block], blocks.starts[block + 1]):
            if marks[block]:
                break
            triangle = blocks.members[row]
            a, b, c = corners_in(view, vertices, faces, triangle)
            if is_turned_away(view, plane_through(a, b, c), back_faces):
                continue
            p, q, r = rest[faces[triangle, 0]], rest[faces[triangle, 1]], rest[faces[triangle, 2]]
            axis, area = 0, 0.0  # the largest of the projections along an axis, at rest
            for each in range(3):
                u, v = (each + 1) % 3, (each + 2) % 3
                seen = (q[u] - p[u]) * (r[v] - p[v]) - (q[v] - p[v]) * (r[u] - p[u])
                if abs(seen) > abs(area):
                    axis, area = each, seen
            if area == 0.0:
                marks[block] = True
                break
            u, v = (axis + 1) % 3, (axis + 2) % 3
            low_u, high_u = _overlap(place[u] * edge + origin[u], edge, p[u], q[u], r[u])
            low_v, high_v = _overlap(place[v] * edge + origin[v], edge, p[v], q[v], r[v])
            part = (
                _posed(low_u - p[u], low_v - p[v], p, q, r, u, v, area, a, b, c),
                _posed(low_u - p[u], high_v - p[v], p, q, r, u, v, area, a, b, c),
                _posed(high_u - p[u], low_v - p[v], p, q, r, u, v, area, a, b, c),
                _posed(high_u - p[u], high_v - p[v], p, q, r, u, v, area, a, b, c),
            )
            left, top, right, bottom, behind = box_in(view, part)
            is_near = left > -1e9 and right < 1e9 and top > -1e9 and bottom < 1e9
            is_known = is_near and (behind == 0 or not view.is_pinhole)
            marks[block] = not is_known or _count_in(counts, left, top, right, bottom) > 0


@inlined
def _posed(
    x: float, y: float, p: Float64s, q: Float64s, r: Float64s, u: int, v: int, area: float,
    a: Vector, b: Vector, c: Vector,
) -> Vector:  # fmt: skip
    """Return a point of a triangle a, b, c from its place along axes u and v at rest, counted from p."""
    second = (x * (r[v] - p[v]) - y * (r[u] - p[u])) / area
    third = (y * (q[u] - p[u]) - x * (q[v] - p[v])) / area
    return weighted(a, b, c, 1.0 - second - third, second, third)


@inlined
def _overlap(low: float, edge: float, a: float, b: float, c: float) -> tuple[float, float]:
    """Return the ends of the interval from ``low`` on, limited to that of three numbers."""
    least, most = min(a, b, c), max(a, b, c)
    return min(max(low, least), most), min(max(low + edge, least), most)
