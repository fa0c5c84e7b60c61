"""The surface as animations pose it, to be painted there."""

from __future__ import annotations

from octex.errors import ArgumentError
from octex.source.motion import Motion
from octex.source.surface import Surface
from octex.viewer.moves import start_of


class Poses:
    """A surface at moments of its animations; the last one is kept, as strokes follow on each other in it."""

    def __init__(self, surface: Surface, motion: Motion | None) -> None:
        is_moved = motion is not None and start_of(motion, surface) is not None
        self._surface, self._motion = surface, motion if is_moved else None
        self._last: tuple[tuple[int, float], Surface] | None = None

    def at(self, moment: tuple[int, float] | None) -> Surface | None:
        """Return the surface at an animation's second as the page draws it; None as it stands.

        Raises ArgumentError for an animation that it does not have.
        """
        if moment is None:
            return None
        count = 0 if self._motion is None else len(self._motion.animations)
        if self._motion is None or moment[0] >= count:
            raise ArgumentError(f"there is no animation {moment[0]}; {self._surface.name} has {count}")
        if self._last is None or self._last[0] != moment:
            self._last = moment, self._surface.with_pose(self._motion.positions_at(*moment))
        return self._last[1]
