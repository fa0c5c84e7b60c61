"""Pictures projected onto a surface: a source of paint, and of how opaque it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.cameras.lens import is_bent
from octex.channels import ChannelFormat
from octex.conversion import large
from octex.painting.layer import PaintSource
from octex.painting.picture import Mips
from octex.painting.reading import Terms, add_paint, finish, mark_seen_blocks, narrow, pixels_under
from octex.painting.sight import Shot, has_paint, most_ahead, near_paint
from octex.parallel import built_once, ordered_map, sharing
from octex.source.corners import at_corners
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement
from octex.view.shading import face_normals
from octex.voxelize.fragments import Blocks
from octex.voxelize.grid import BLOCK_BITS

#: Rows and columns of the pixels that are tried for a triangle whose corners and middle no picture shows.
_STEPS = 16
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
    stretches: Float32s  # (m,)   what is 1 long on a posed triangle is so long at rest
    shading: Shading
    chosen: Bools | None = None  # (m,)   the triangles that are painted; None for all
    normals: Float32s | None = None  # (m, 3, 3)   what `shading` gives; None: not asked for yet

    @property
    def color(self) -> Float32s | None:
        """The value that all pixels with paint have, before and after gains; None for several."""
        ends = np.concatenate([shot.mips.range for shot in self.shots])
        is_one = (ends == ends[0]).all() and all((shot.gains == 1.0).all() for shot in self.shots)
        return ends[0, : self.form.components] if is_one else None

    def with_shots(self, shots: Sequence[Shot]) -> Projected:
        """Return paint from other shots."""
        return replace(self, shots=list(shots))

    def with_mips(self, make: Callable[[int], Mips], executor: Executor) -> Projected:
        """Return paint from other pictures, made from the numbers of the shots."""
        with sharing(executor) as pool:
            every = ordered_map(pool, make, range(len(self.shots)), window=most_ahead())
            return self.with_shots(
                [
                    shot if mips is shot.mips else shot._replace(mips=large.moved(mips))
                    for shot, mips in zip(self.shots, every, strict=True)
                ]
            )

    def near_paint(self, reach: int) -> Projected:
        """Return the same paint; pixels without any as far around as ``reach`` see nothing."""
        return self.with_shots([near_paint(shot, reach) for shot in self.shots])

    @built_once
    def _normals(self) -> Float32s:
        every = np.arange(len(self.triangles), dtype=np.int32)
        return self.shading(every) if self.normals is None else self.normals

    def touched(self) -> Int32s:
        """Return the triangles that own a pixel of a shot, or that may be painted though they are hidden."""
        is_seen = np.zeros(len(self.triangles), np.bool_)
        for shot in self.shots:
            is_seen |= self._counts(shot) > 0
        return np.flatnonzero(is_seen).astype(np.int32)

    def _counts(self, shot: Shot) -> Int32s:
        """Return how many pixels of a shot triangles (m,) own; or at most, where hidden ones are painted."""
        if self.terms.hidden:
            return pixels_under(shot.camera, _summed(shot), self.vertices, self.triangles)
        counts, seen = np.zeros(len(self.triangles), np.int32), shot.seen
        pixels = np.bincount(seen.rows.ravel() + 1, minlength=len(seen.triangles) + 1)[1:]
        counts[seen.triangles[pixels > 0]] = pixels[pixels > 0]
        return counts

    def near(self, triangles: Int32s) -> Projected:
        """Return the same paint, with the normals of some triangles alone."""
        # Memory that is not touched costs nothing.
        normals = np.zeros((len(self.triangles), 3, 3), np.float32)
        normals[triangles] = self.shading(triangles)
        return replace(self, normals=normals)

    def reaches(self, blocks: Blocks, placement: Placement, rest: Float64s) -> Bools:
        """Say of which blocks a shot may see something: what is not seen is not painted."""
        found, edge = np.zeros(blocks.codes.size, np.bool_), placement.size / 2**blocks.level
        corners = placement.to_rest(decode_cells(blocks.codes) / 2**blocks.level)
        for shot in self.shots:
            seen = _summed(shot)
            # Large blocks that are left out count for no average: those that are seen do.
            is_coarse = blocks.bits >= BLOCK_BITS or is_bent(shot.lens)
            painted = seen if is_coarse else _sums_of(has_paint(shot))
            mark_seen_blocks(
                shot.camera, seen, painted, self.vertices, self.triangles, rest, blocks, corners, edge, found
            )
        return found

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros where there is none."""
        sums, clear = self._sums(self.shots, triangles, barycentric, widths)
        found = np.zeros((len(triangles), self.form.components + 1), np.float32)
        finish(sums, clear, found)
        return found

    def each(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> tuple[Float32s, Float32s]:
        """Return what each shot paints (shots, n, 3), and its weight (shots, n), the largest of a point 1."""
        paint = np.zeros((len(self.shots), len(triangles), 3), np.float32)
        weights = np.zeros((len(self.shots), len(triangles)))
        for number, shot in enumerate(self.shots):
            sums, _ = self._sums([shot], triangles, barycentric, widths)
            weights[number] = sums[:, 3]
            paint[number] = sums[:, :3] / np.maximum(sums[:, 3:], 1e-300)
        weights /= np.maximum(weights.max(axis=0), 1e-300)
        return paint, weights.astype(np.float32)

    def _sums(
        self, shots: Sequence[Shot], triangles: Int32s, barycentric: Float64s, widths: Float32s
    ) -> tuple[Float64s, Float64s]:
        """Return weighted sums (n, 4) of what shots paint, and how clear they leave each point (n,)."""
        sums, clear = np.zeros((len(triangles), 4)), np.ones(len(triangles))
        mesh = self.vertices, self.triangles, self.stretches, self._normals
        for shot in shots:
            add_paint(shot, self.terms, *mesh, triangles, barycentric, widths, sums, clear)
        if self.chosen is not None:
            others = ~self.chosen[triangles]
            sums[others], clear[others] = 0.0, 1.0
        return sums, clear

    def positions(self, triangles: Int32s, barycentric: Float64s) -> Float64s:
        """Return where points are on the posed surface (n, 3)."""
        return at_corners(self.vertices, self.triangles[triangles], barycentric)

    def footprints(self) -> tuple[Float32s, Float64s]:
        """Return the finest pixels' edges, ascending, at corners and middles of triangles, and seen areas.

        Of a large triangle that has none of them in a picture, they are taken at its pixels.
        """
        touched = self.touched()
        if self.chosen is not None:
            touched = touched[self.chosen[touched]]
        places = np.concatenate([np.eye(3), np.full((1, 3), 1 / 3)])
        every = [self.widths(touched, np.tile(place, (len(touched), 1))) for place in places]
        widths = np.stack(every)
        outside = np.isinf(widths).all(axis=0)
        _, areas = face_normals(self.vertices, self.triangles[touched])
        seen_areas = np.zeros(len(touched))  # by the pixels in the triangles' middles
        flat = replace(self, stretches=np.ones(len(self.triangles), np.float32))
        for shot in self.shots:
            counts = self._counts(shot)[touched]
            edges = flat.with_shots([shot]).texel_edges(touched)
            some = np.flatnonzero(outside & (counts >= shot.seen.rows.size / (2 * _STEPS**2)))
            if some.size:
                inner = self._inner_places(shot, touched[some])
                edges[some] = flat.with_shots([shot]).widths(touched[some], inner)
                inner_widths = self.with_shots([shot]).widths(touched[some], inner)
                widths[:, some] = np.minimum(widths[:, some], inner_widths)
            edges[counts == 0] = 0.0
            seen_areas += counts * edges.astype(np.float64) ** 2
        areas, widths = np.minimum(areas, seen_areas), widths.ravel()
        # Numbers that are not negative are in the order of their bits: a fifth of the time of an argsort.
        keys = widths.view(np.uint32).astype(np.uint64) << np.uint64(32)
        keys |= np.arange(widths.size, dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
        return widths[order], np.tile(areas / len(places), len(places))[order]

    def _inner_places(self, shot: Shot, triangles: Int32s) -> Float64s:
        """Return barycentric coordinates (n, 3) of the nearest points that some of a shot's pixels see."""
        height, width = shot.seen.rows.shape
        steps = (np.arange(_STEPS) + 0.5) / _STEPS
        pixels = np.stack([*np.meshgrid(width * steps, height * steps), np.ones((_STEPS, _STEPS))])
        rays = shot.camera.inverse_k @ pixels.reshape(3, -1)
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
        found = np.take_along_axis(shares, nearest[..., None], axis=2)[..., 0]
        sums = np.take_along_axis(np.where(is_on, sums, np.inf), nearest, axis=1)
        return cast(Float64s, np.where(np.isfinite(sums), found / sums, 1 / 3))

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of the finest pixel on triangles (n,), at rest; infinity where none is."""
        return self.widths(triangles, np.full((len(triangles), 3), 1 / 3))

    def widths(self, triangles: Int32s, barycentric: Float64s) -> Float32s:
        """Return the edge of the finest pixel at points (n,), at rest; infinity where no camera looks."""
        widths = np.full(len(triangles), np.inf, np.float32)
        mesh = self.vertices, self.triangles, self.stretches
        for shot in self.shots:
            narrow(shot, *mesh, self.terms.back_faces, triangles, barycentric, widths)
        return widths


def _summed(shot: Shot) -> Int32s:
    """Return how many pixels that see something are above and left of others (height + 1, width + 1)."""
    return _sums_of(shot.seen.rows >= 0)


def _sums_of(chosen: Bools) -> Int32s:
    counts = np.zeros(np.add(chosen.shape, 1), np.int32)
    np.cumsum(np.cumsum(chosen, 0, np.int32), 1, out=counts[1:, 1:])
    return counts
