"""Paint of which each patch comes from one picture."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.conversion.levels import on_grid
from octex.conversion.pieces import Blocks
from octex.painting.holes import level_within
from octex.painting.labels import exposed, labelled, levelling, views_of
from octex.painting.multigrid import graph_of
from octex.painting.projected import Projected
from octex.painting.sheets import Sheets, sheets_of
from octex.painting.source import PaintSource
from octex.source.surface import Surface
from octex.tree.placement import Placement

#: Pictures are chosen for cells so many levels above the finest; at most for so many by their own number.
_ABOVE, _MOST_VIEWS = 1, 1 << 22


class Patches(PaintSource):
    """Paint from the picture of each sheet, levelled; from all of them where that one sees nothing.

    labels     (sheets,) numbers of shots; exposures (sheets, 3), see `exposed`
    mesh       vertices on the grid and triangles, as `Sheets.at` takes them
    own        (m,) the numbers of the triangles that are painted in that mesh
    """

    def __init__(
        self,
        source: Projected,
        sheets: Sheets,
        labels: Int32s,
        exposures: Float64s,
        mesh: tuple[Int32s, Int32s],
        own: Int32s,
    ) -> None:
        super().__init__(source.channels[0])
        self._source = source
        self._sheets = sheets
        self._labels = labels
        self._exposures = exposures
        self._mesh = mesh
        self._own = own

    def touched(self) -> Int32s:
        """Return the triangles that own a pixel of a shot."""
        return self._source.touched()

    def on(self, chosen: Int32s) -> Patches:
        """Return the same paint for some of the triangles, among them all that own a pixel."""
        source = self._source.on(chosen)
        return Patches(source, self._sheets, self._labels, self._exposures, self._mesh, self._own[chosen])

    def reaches(self, blocks: Blocks, corners: Float64s, edge: float, rest: Float64s) -> Bools:
        """Say of which blocks a shot may see something."""
        return self._source.reaches(blocks, corners, edge, rest)

    def widths(self, triangles: Int32s, barycentric: Float64s) -> Float32s:
        """Return how wide the finest pixel is at points."""
        return self._source.widths(triangles, barycentric)

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return paint, linear for colours, and coverage (n, components + 1); zeros where there is none."""
        sheets = self._sheets.at(*self._mesh, self._own[triangles], barycentric)
        found = self._source.evaluate(triangles, barycentric, widths)
        labels = self._labels[sheets]
        components = found.shape[1] - 1
        for number, shot in enumerate(self._source.shots):
            own = np.flatnonzero((labels == number) & (found[:, -1] > 0))
            if not own.size:
                continue
            alone = self._source.with_shots([shot], [number])
            paint, weights = alone.each(triangles[own], barycentric[own], widths[own])
            own, paint = own[weights[0] > 0], paint[0][weights[0] > 0]
            found[own, :components] = exposed(paint, self._exposures[sheets[own]])[:, :components]
        return found


def best(
    source: Projected, surface: Surface, placement: Placement, depth: int, executor: Executor
) -> Patches:
    """Return the same paint, from one picture for each patch of the surface."""
    most = _MOST_VIEWS // len(source.shots)
    level = min(max(depth - _ABOVE, 0), level_within(surface, placement, most))
    sheets = sheets_of(surface, placement, level, executor)
    where = sheets.triangles, sheets.barycentric
    widths = (np.sqrt(np.minimum(sheets.areas, 1.0)) * placement.size / 2**level).astype(np.float32)
    paint, weights = source.each(*where, widths)
    graph = graph_of(sheets.pairs, sheets.ties, sheets.codes.size)
    labels = labelled(graph, sheets.codes, sheets.areas, views_of(paint, weights, sheets.areas))
    exposures = levelling(sheets.pairs, sheets.ties, sheets.codes, level, labels, paint, weights)
    mesh = on_grid(surface.rest, placement), surface.triangles
    own = np.arange(len(surface.triangles), dtype=np.int32)
    return Patches(source, sheets, labels, exposures, mesh, own)
