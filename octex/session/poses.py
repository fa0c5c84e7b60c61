"""The surface as animations pose it, or unwrapped around a point, to paint on."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from octex.cameras.camera import Camera
from octex.errors import ArgumentError
from octex.painting.image import Projection
from octex.painting.unwrap import Patch, unwrap
from octex.session.commands import Moment, Spot, moment_of, object_of, spot_of
from octex.source.motion import Motion
from octex.source.surface import Surface

#: Number of cached patches: the current one, and its mirror image.
_MOST_PATCHES = 2


class Poses:
    """Poses a surface by its animations, and unwraps it; caches the last results for the next strokes."""

    def __init__(self, surface: Surface, motion: Motion | None) -> None:
        is_moved = motion is not None and motion.start_on(surface.vertices, surface.rest) is not None
        self._surface, self._motion = surface, motion if is_moved else None
        self._last: tuple[Moment, Surface] | None = None
        self._patches: tuple[tuple[tuple[Moment | None, Spot], Patch], ...] = ()

    def at(self, moment: Moment | None) -> Surface | None:
        """Return the surface at an animation's time, as the page draws it; None for the model as loaded.

        Raises ArgumentError for an unknown animation.
        """
        if moment is None:
            return None
        count = 0 if self._motion is None else len(self._motion.animations)
        if self._motion is None or moment.animation >= count:
            raise ArgumentError(f"there is no animation {moment.animation}; {self._surface.name} has {count}")
        last = self._last
        if last is None or last[0] != moment:
            self._last = last = moment, self._surface.with_pose(self._motion.positions_at(*moment))
        return last[1]

    def patch(self, moment: Moment | None, spot: Spot) -> Patch:
        """Return the unwrapped surface. Raises ArgumentError and ModelError as ``octex.unwrap`` does."""
        key, known = (moment, spot), self._patches
        flat = next((patch for known_key, patch in known if known_key == key), None)
        if flat is None:
            flat = unwrap(self.at(moment) or self._surface, spot.center, spot.radius, up=spot.up)
            self._patches = ((key, flat), *known)[:_MOST_PATCHES]
        return flat

    def flat(self, projection: Projection, moment: Moment | None, spot: Spot) -> Projection:
        """Project an image from a patch into the projection's camera."""
        camera = cast(Camera, projection.camera)
        return replace(projection, camera=replace(self.patch(moment, spot), camera=camera))

    def asked(self, asked: str) -> Patch:
        """Return the patch for JSON with the fields of a stroke; raises as ``patch`` does."""
        fields = object_of(asked, "a request for a patch")
        spot = spot_of(fields)
        if spot is None:
            raise ArgumentError("patch is missing")
        return self.patch(moment_of(fields), spot)


def mirrored_spot(spot: Spot, axis: int, middle: float) -> Spot:
    """Return the spot in a mirror across an axis; its view is the original mirrored across x."""
    center, up = list(spot.center), list(spot.up)
    center[axis], up[axis] = 2 * middle - center[axis], -up[axis]
    return Spot((center[0], center[1], center[2]), spot.radius, (up[0], up[1], up[2]))
