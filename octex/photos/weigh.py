"""Several photographs made one source of paint: balanced, masked, weighed, or chosen from."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.channels import ChannelFormat
from octex.painting.layer import PaintSource
from octex.painting.multigrid import graph_of
from octex.painting.options import PaintOptions
from octex.painting.project import Projected
from octex.painting.resume import Stages
from octex.painting.sheets import Sheets, sheets_of
from octex.photos.agreement import agreeing
from octex.photos.balance import balanced, without_overexposed
from octex.photos.labels import costs_of, exposed, feathered, labelled, levelling
from octex.photos.sharpness import weighed_by_sharpness
from octex.source.surface import Surface
from octex.tree.layout import MAX_DEPTH
from octex.tree.placement import Placement
from octex.view.shading import face_normals
from octex.voxelize.fragments import Blocks

#: Pictures are chosen for cells so many levels above the finest; at most for so many by their own number.
_ABOVE, _MOST_VIEWS = 1, 1 << 22
#: Pixels up to so many cells wide count alike in a mean.
_ENOUGH = 2.0


@dataclass(eq=False)
class BestPaint(PaintSource):
    """Paint from the pictures that sheets have shares of, levelled; from all where these see nothing."""

    source: Projected
    sheets: Sheets
    shares: Float32s  # (sheets, shots)   of 1
    exposures: Float32s  # (sheets, shots, 3)   see `exposed`

    @property
    def form(self) -> ChannelFormat:  # type: ignore[override]
        """The channel that is painted."""
        return self.source.form

    def touched(self) -> Int32s:
        """Return the triangles that own a pixel of a shot."""
        return self.source.touched()

    def near(self, triangles: Int32s) -> BestPaint:
        """Return the same paint, with the normals of some triangles alone."""
        return replace(self, source=self.source.near(triangles))

    def reaches(self, blocks: Blocks, placement: Placement, rest: Float64s) -> Bools:
        """Say of which blocks a shot may see something."""
        return self.source.reaches(blocks, placement, rest)

    def widths(self, triangles: Int32s, barycentric: Float64s) -> Float32s:
        """Return how wide the finest pixel is at points."""
        return self.source.widths(triangles, barycentric)

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros where there is none."""
        sheets = self.sheets.at(triangles, barycentric)
        found = self.source.evaluate(triangles, barycentric, widths)
        components = found.shape[1] - 1
        is_seen = (found[:, -1] > 0) & (sheets >= 0)  # no sheet: from all pictures
        shares = np.where(is_seen[:, None], self.shares[sheets], np.float32(0))
        sums, totals = np.zeros((len(found), components), np.float32), np.zeros(len(found), np.float32)
        for number, shot in enumerate(self.source.shots):
            own = np.flatnonzero(shares[:, number] > 0)
            if not own.size:
                continue
            where = triangles[own], barycentric[own], widths[own]
            paint, weights = self.source.with_shots([shot]).each(*where)
            share = np.where(weights[0] > 0, shares[own, number], np.float32(0))
            light = exposed(paint[0], self.exposures[sheets[own], number])
            sums[own] += share[:, None] * light[:, :components]
            totals[own] += share
        some = totals > 0
        found[some, :components] = sums[some] / totals[some, None]
        return found


def best(
    source: Projected, surface: Surface, placement: Placement, depth: int, executor: Executor
) -> BestPaint:
    """Return the same paint, from one picture for each patch of the surface."""
    most = _MOST_VIEWS // len(source.shots)
    area = face_normals(surface.rest, surface.triangles)[1].sum() / placement.size**2
    expected = np.log(most / max(area, 1e-30)) / np.log(4.0)  # the level that has so many cells
    level = min(max(depth - _ABOVE, 0), int(np.clip(expected, 0, MAX_DEPTH)))
    sheets = sheets_of(surface, placement, level, executor)
    where = sheets.triangles, sheets.barycentric
    widths = (np.sqrt(np.minimum(sheets.areas, 1.0)) * placement.size / 2**level).astype(np.float32)
    paint, weights = source.each(*where, widths)
    graph = graph_of(sheets.pairs, sheets.ties, sheets.codes.size)
    labels = labelled(graph, sheets.codes, sheets.areas, costs_of(paint, weights, sheets.areas))
    exposures = levelling(sheets, labels, paint, weights)
    shares, feathers = feathered(graph, labels, exposures, weights)
    return BestPaint(source, sheets, shares, feathers)


def weighed(
    source: Projected,
    surface: Surface,
    options: PaintOptions,
    reference: int | None,
    placement: Placement,
    depth: int,
    executor: Executor,
    stages: Stages,
) -> PaintSource:
    """Return the paint of several shots as ``octex.paint`` is told to combine them."""
    balance, pictures = options.balance, options.pictures
    if balance is not None:
        evened = balanced(source, surface, balance, reference, executor)
        source = without_overexposed(source, evened, executor)
    if pictures in ("robust", "best") or (pictures is None and len(source.shots) > 2):
        source = agreeing(source, surface, executor, stages)
        if balance is not None:  # again, without what only one of them saw
            source = balanced(source, surface, balance, reference, executor)
    source = weighed_by_sharpness(source, surface)
    if pictures == "best":
        return best(source, surface, placement, depth, executor)
    return replace(source, terms=source.terms._replace(enough=_ENOUGH * placement.size / 2**depth))
