"""How a model moves: bones, morph targets, and their animations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s


class Links(NamedTuple):
    """The bones, or morph targets, of vertices; vertex v has entries ``first[v]`` to ``first[v + 1]``."""

    first: Int64s  # (n + 1,)
    numbers: Int64s  # (entries,)   of bones, or of targets
    shares: Float64s  # (entries,) weights of bones, which sum to 1; or (entries, 3) offsets of targets

    @property
    def owners(self) -> Int64s:
        """The vertex of each entry (entries,)."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))


class Animation(NamedTuple):
    """Bones and weights of targets at frames, evenly spaced in time from 0 on."""

    name: str
    length: float  # seconds
    bones: Float64s  # (frames, bones, 3, 4)   from modelled positions to those at the frame
    weights: Float64s  # (frames, targets)


class Motion(NamedTuple):
    """The animations of a model, in the scene's coordinates.

    At a frame, vertex v is at Σ share · bone · (position + Σ weight · offset).
    """

    positions: Float64s  # (n, 3)   as modelled, without animations, skins and targets
    bones: Links
    targets: Links
    turns: Float64s  # (entries, 3)   offsets of the vertices' unit normals by targets
    animations: list[Animation]
    faults: list[str]  # a line for each broken animation

    def start_on(self, vertices: Float64s, rest: Float64s) -> str | None:
        """Say which positions of a surface the bones move: "rest" or "position"; None for neither."""
        edge = float(np.ptp(self.positions, axis=0).max())
        for name, positions in (("position", vertices), ("rest", rest)):
            if positions.shape == self.positions.shape and np.allclose(
                positions, self.positions, rtol=0.0, atol=1e-6 * edge
            ):
                return name
        return None

    def positions_at(self, animation: int, time: float) -> Float64s:
        """Return the positions of the vertices (n, 3) at a time in seconds, linear between frames.

        Times before the first frame or after the last use that frame.
        """
        _, length, bones, weights = self.animations[animation]
        last = len(bones) - 1
        frame = min(max(time / length, 0.0), 1.0) * last if length > 0 else 0.0
        before = min(int(frame), max(last - 1, 0))
        after, share = min(before + 1, last), frame - before
        bones, weights = ((1.0 - share) * keys[before] + share * keys[after] for keys in (bones, weights))
        shape = self.positions.copy()
        np.add.at(shape, self.targets.owners, weights[self.targets.numbers, None] * self.targets.shares)
        moves = np.zeros((len(shape), 3, 4))
        np.add.at(moves, self.bones.owners, self.bones.shares[:, None, None] * bones[self.bones.numbers])
        return np.asarray(np.einsum("nij,nj->ni", moves[..., :3], shape) + moves[..., 3])
