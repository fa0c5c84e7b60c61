"""How a model moves: bones that carry its vertices, targets that these go to before, and both over time."""

from __future__ import annotations

from typing import NamedTuple

from octex.arrays import Float64s, Int64s


class Links(NamedTuple):
    """What moves the vertices: of vertex v the entries from ``first[v]`` to ``first[v + 1]``."""

    first: Int64s  # (n + 1,)
    numbers: Int64s  # (entries,)   of bones, or of targets
    shares: Float64s  # (entries,) of bones, which sum to 1; or (entries, 3), what targets add to positions


class Animation(NamedTuple):
    """Bones and targets at frames, which are evenly spaced from 0 to the last."""

    name: str
    length: float  # seconds
    bones: Float64s  # (frames, bones, 3, 4)   from the model's vertices to where they are then
    weights: Float64s  # (frames, targets)


class Motion(NamedTuple):
    """The animations of a model, in the scene's coordinates.

    At a frame, vertex v is at Σ share · bone · (position + Σ weight · what the target adds).
    """

    positions: Float64s  # (n, 3)   as modelled: without animations, skins and targets
    bones: Links
    targets: Links
    turns: Float64s  # (entries, 3)   of targets: what they add to the vertices' unit normals
    animations: list[Animation]
    faults: list[str]  # of animations that are broken, a line each
