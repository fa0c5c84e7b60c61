"""Several photographs made one source of paint: balanced, masked, weighed, or chosen from."""

from __future__ import annotations

from concurrent.futures import Executor

from octex.painting.layer import PaintSource
from octex.painting.options import PaintOptions
from octex.painting.project import Projected
from octex.painting.resume import Stages
from octex.photos.agreement import agreeing
from octex.photos.balance import balanced
from octex.photos.best import best
from octex.photos.overexposed import without_overexposed
from octex.photos.sharpness import weighed_by_sharpness
from octex.source.surface import Surface
from octex.tree.placement import Placement


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
    """Return the paint of several shots as ``octex.paint`` is told to combine them.

    The shot ``reference`` keeps its gain; ``stages`` are those of what was made from all that the source is.
    """
    balance, pictures = options.balance, options.pictures
    if balance is not None:
        evened = balanced(source, surface, balance, reference, executor)
        source = without_overexposed(source, evened, executor)
    if pictures in ("robust", "best") or (pictures is None and len(source.shots) > 2):
        source = agreeing(source, executor, stages)
        if balance is not None:  # again, without what only one of them saw
            source = balanced(source, surface, balance, reference, executor)
    source = weighed_by_sharpness(source, surface)
    return best(source, surface, placement, depth, executor) if pictures == "best" else source
