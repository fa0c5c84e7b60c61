"""Shots: pictures, decoded, before what their cameras see of a surface."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s
from octex.channels import ChannelFormat
from octex.conversion import large
from octex.jit import kernel
from octex.painting.picture import Levels, Projection, Window, window_of
from octex.painting.resume import Kept, fits
from octex.parallel import start
from octex.view.camera import Camera
from octex.view.lens import distort, is_bent
from octex.view.visibility import (
    View,
    Visibility,
    distances_to_edges,
    straight,
    view_of,
    visibility_of,
)

#: Beside an edge pictures are blurred with what is behind it: within so many pixels others count for more.
TRUSTED = 4.0
#: Of a picture alone what is within so many pixels of its paint is looked at, a power of two.
AROUND = 64


class Shot(NamedTuple):
    """A picture and what its camera sees, as kernels read them."""

    camera: View  # without distortion
    K: Float64s  # (3, 3)   of the picture
    lens: Float64s  # (14,)   see octex.view.lens.lens_numbers
    levels: Levels
    seen: Visibility
    margins: Float32s  # (height, width)   to where the surface ends, in pixels; at most so far


class Sight(NamedTuple):
    """What a camera sees of a surface; see Shot."""

    camera: View
    K: Float64s
    lens: Float64s
    seen: Visibility
    margins: Float32s

    def within(self, window: Window) -> Sight:
        """Return what a part of the picture sees, whose pixels are counted from its corner."""
        if (window.bottom - window.top, window.right - window.left) == self.margins.shape:
            return self
        shift = np.array([[1.0, 0.0, -window.left], [0.0, 1.0, -window.top], [0.0, 0.0, 1.0]])
        own = shift @ self.camera.K
        camera = self.camera._replace(K=own, inverse_k=np.linalg.inv(own).astype(np.float64))
        seen = Visibility(*(np.ascontiguousarray(window.of(each)) for each in self.seen))
        margins = np.ascontiguousarray(window.of(self.margins))
        return Sight(camera, shift @ self.K, self.lens, seen, margins)


def most_ahead() -> int:
    """Return how many pictures are decoded ahead: few where memory has no room for them."""
    return 2 if large.is_mapped() else 64


def take_shots(
    projections: Sequence[Projection],
    form: ChannelFormat,
    scales: Sequence[float],
    sights: Iterable[Sight],
    executor: Executor,
    *,
    around: int | None = None,
    kept: Kept | None = None,
) -> Iterator[Shot]:
    """Decode pictures, their alpha times ``scales``, some ahead, and put them before what cameras see.

    What is not within ``around`` pixels of their paint is left out, but for pictures through lenses. Raises
    as `levels_of` does.
    """
    given = [(each, form, scale, around, kept) for each, scale in zip(projections, scales, strict=True)]
    decoded = (start(executor, _decoded, *each) for each in given)
    queue = deque(islice(decoded, most_ahead()))
    for sight in sights:
        levels, window = queue.popleft().result()
        yield shot_of(sight.within(window), levels if kept else large.moved(levels))
        queue.extend(islice(decoded, 1))


def _decoded(
    projection: Projection, form: ChannelFormat, scale: float, around: int | None, kept: Kept | None
) -> tuple[Levels, Window]:
    is_straight = isinstance(projection.camera, Camera) and not is_bent(projection.camera.lens)
    return window_of(projection, form, scale, around if is_straight else None, kept)


def sight_of(
    vertices: Float64s,
    triangles: Int32s,
    camera: Camera,
    feather: float,
    executor: Executor,
    kept: Kept | None = None,
) -> Sight:
    """Find what a camera sees of triangles (m, 3) of vertices (n, 3), or in what is ``kept`` of these."""
    pinhole = straight(camera)
    view = view_of(pinhole)

    def seen() -> tuple[Visibility, Float32s]:
        found = visibility_of(vertices, triangles, pinhole, executor)
        return found, distances_to_edges(found, view, max(feather, TRUSTED) + 1.0)

    def made() -> dict[str, Array]:
        found, margins = seen()
        return {**found._asdict(), "margins": margins}

    if kept is None:
        found: Sight = large.moved(Sight(view, camera.K, camera.lens, *seen()))
        return found
    where = kept.of((pinhole.height, pinhole.width), *view, feather)
    as_found = partial(_as_kept, (pinhole.height, pinhole.width), len(triangles))
    return Sight(view, camera.K, camera.lens, *where.arrays("sight", made, as_found))


def _as_kept(
    size: tuple[int, int], triangles: int, arrays: Mapping[str, Array]
) -> tuple[Visibility, Float32s] | None:
    """Return what is kept of what pixels (height, width) see; None for what cannot be that."""
    expected = {"triangle": ("i4", size), "planes": ("f4", (*size, 3)), "margins": ("f4", size)}
    if not fits(arrays, expected):
        return None
    triangle = arrays["triangle"]
    if not -1 <= triangle.min() <= triangle.max() < triangles:
        return None
    return Visibility(triangle, arrays["planes"]), arrays["margins"]


def shot_of(sight: Sight, levels: Levels) -> Shot:
    """Put a picture before what its camera sees."""
    return Shot(sight.camera, sight.K, sight.lens, levels, sight.seen, sight.margins)


def in_fixed_order(shots: Sequence[Shot]) -> list[Shot]:
    """Sort shots by what they hold: sums over them are then the same to the bit, in whatever order they came.

    Samples are taken in that order too, and the fit counts no more than a few of each leaf.
    """

    def digest(shot: Shot) -> bytes:
        made = hashlib.sha256(bytes([shot.camera.is_pinhole]))
        for array in (shot.camera.world_to_camera, shot.camera.K, shot.K, shot.lens, shot.levels.pixels):
            made.update(np.ascontiguousarray(array).data)
        return made.digest()

    return sorted(shots, key=digest) if len(shots) > 1 else list(shots)


def near_paint(shot: Shot, reach: int) -> Shot:
    """Return a shot that sees nothing where its picture is transparent; as it is if a lens bends that."""
    width, height = shot.levels.sizes[0, 1:]
    has_paint = shot.levels.pixels[: width * height, 3].reshape(height, width) > 0
    if is_bent(shot.lens) or has_paint.all():
        return shot
    return renamed(shot, np.where(_spread(has_paint, reach), shot.seen.triangle, np.int32(-1)))


@kernel
def _spread(some: Bools, reach: int) -> Bools:
    """Say of each pixel whether there are some in the square that goes as far as ``reach`` around it."""
    height, width = some.shape
    beside, found = np.zeros((height, width), np.bool_), np.zeros((height, width), np.bool_)
    for row in range(height):
        for turn in range(2):
            last = -1 - reach
            for step in range(width):
                column = width - 1 - step if turn else step
                if some[row, column]:
                    last = step
                beside[row, column] |= step - last <= reach
    lasts = np.empty(width, np.int64)
    for turn in range(2):
        lasts[:] = -1 - reach
        for step in range(height):
            row = height - 1 - step if turn else step
            for column in range(width):
                if beside[row, column]:
                    lasts[column] = step
                found[row, column] |= step - lasts[column] <= reach
    return found


def renamed(shot: Shot, triangle: Int32s) -> Shot:
    """Return a shot whose pixels see other triangles (height, width); −1 for none."""
    return shot._replace(seen=shot.seen._replace(triangle=large.moved(triangle)))


def pixels_of_points(shot: Shot, points: Float64s) -> Float64s:
    """Return the pixel coordinates (n, 2) of posed points in a shot's picture; NaN where it has none."""
    x, y, z = shot.camera.world_to_camera[:3, :3] @ points.T + shot.camera.world_to_camera[:3, 3:]
    if shot.camera.is_pinhole:
        with np.errstate(all="ignore"):
            slopes = np.column_stack([x, y]) / np.where(z > 0.0, z, np.nan)[:, None]
        places = np.empty_like(slopes)
        distort(shot.lens, np.ascontiguousarray(slopes), places)
    else:
        places = np.column_stack([x, y])
    return places @ shot.K[:2, :2].T + shot.K[:2, 2]
