"""Combines several photographs into one source of paint: balanced, masked, weighed, or chosen from."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.conversion.large import Stages
from octex.painting.multigrid import graph_of
from octex.painting.project import Projected
from octex.painting.sheets import Sheets, sheets_of
from octex.painting.surface import PaintOptions
from octex.photos.agreement import agreeing
from octex.photos.balance import balanced, without_overexposed
from octex.photos.labels import costs_of, exposed, feathered, labelled, levelling
from octex.photos.sharpness import weighed_by_sharpness
from octex.source.surface import Surface
from octex.tree.layout import MAX_DEPTH
from octex.tree.placement import Placement
from octex.view.shading import face_normals

#: Images are chosen this many levels above the finest, for at most this many pairs of cell and image.
_ABOVE, _MOST_VIEWS = 1, 1 << 22
#: Pixels up to this many cells wide weigh alike in a mean, and those up to twice as wide as the finest.
_ENOUGH = 2.0


@dataclass(eq=False)
class BestPaint(Projected):
    """Paint from the images chosen for each sheet, levelled; from all images where these see nothing."""

    sheets: Sheets = field(kw_only=True)
    shares: Float32s = field(kw_only=True)  # (sheets, shots)   sum 1
    exposures: Float32s = field(kw_only=True)  # (sheets, shots, 3)   see `exposed`

    @property
    def color(self) -> None:
        """Levelled paint may have several values."""

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros where there is none."""
        sheets = self.sheets.at(triangles, barycentric)
        values = super().evaluate(triangles, barycentric, widths)
        components = values.shape[1] - 1
        is_seen = (values[:, -1] > 0) & (sheets >= 0)  # points on no sheet take all images
        shares = np.where(is_seen[:, None], self.shares[sheets], np.float32(0))
        sums, totals = np.zeros((len(values), components), np.float32), np.zeros(len(values), np.float32)
        for number, shot in enumerate(self.shots):
            rows = np.flatnonzero(shares[:, number] > 0)
            if not rows.size:
                continue
            paint, weights = self.with_shots([shot]).each(triangles[rows], barycentric[rows], widths[rows])
            share = np.where(weights[0] > 0, shares[rows, number], np.float32(0))
            light = exposed(paint[0], self.exposures[sheets[rows], number])
            sums[rows] += share[:, None] * light[:, :components]
            totals[rows] += share
        is_chosen = totals > 0
        values[is_chosen, :components] = sums[is_chosen] / totals[is_chosen, None]
        return values


def best(
    source: Projected, surface: Surface, placement: Placement, depth: int, executor: Executor
) -> BestPaint:
    """Return the same paint, from one image for each patch of the surface."""
    most = _MOST_VIEWS // len(source.shots)
    area = face_normals(surface.rest, surface.triangles)[1].sum() / placement.size**2
    expected = np.log(most / max(area, 1e-30)) / np.log(4.0)  # the level with that many cells
    level = min(max(depth - _ABOVE, 0), int(np.clip(expected, 0, MAX_DEPTH)))
    sheets = sheets_of(surface, placement, level, executor)
    where = sheets.triangles, sheets.barycentric
    widths = (np.sqrt(np.minimum(sheets.areas, 1.0)) * placement.size / 2**level).astype(np.float32)
    paint, weights = source.each(*where, widths)
    graph = graph_of(sheets.pairs, sheets.ties, sheets.codes.size)
    labels = labelled(graph, sheets.codes, sheets.areas, costs_of(paint, weights, sheets.areas))
    exposures = levelling(sheets, labels, paint, weights)
    shares, feathers = feathered(graph, labels, exposures, weights)
    taken = {each.name: getattr(source, each.name) for each in fields(source)}
    return BestPaint(**taken, sheets=sheets, shares=shares, exposures=feathers)


def weighed(
    source: Projected,
    surface: Surface,
    options: PaintOptions,
    reference: int | None,
    placement: Placement,
    depth: int,
    executor: Executor,
    stages: Stages,
) -> Projected:
    """Combine the paint of several shots as the options say."""
    balance, mode = options.balance, options.pictures
    if balance is not None:
        evened = balanced(source, surface, balance, reference)
        source = without_overexposed(source, evened, executor)
    if mode in ("robust", "best") or (mode is None and len(source.shots) > 2):
        source = agreeing(source, surface, executor, stages)
        if balance is not None:  # again, without what only one image saw
            source = balanced(source, surface, balance, reference)
    source = weighed_by_sharpness(source, surface, executor)
    if mode == "best":
        return best(source, surface, placement, depth, executor)
    enough = _ENOUGH * placement.size / 2**depth
    is_light = source.form.space in ("srgb", "linear")
    return replace(source, terms=source.terms._replace(enough=enough, is_light=is_light))
