"""What cameras see of a surface, and the pictures that they took of it."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from itertools import islice
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s
from octex.cameras.camera import Camera
from octex.cameras.lens import is_bent
from octex.channels import ChannelFormat
from octex.conversion import large
from octex.jit import kernel
from octex.painting.picture import Mips, Projection, Window, window_of
from octex.painting.resume import NOT_STORED, Stages
from octex.parallel import start
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
#: Of a single picture the part within so many pixels of its paint is decoded, a power of two.
AROUND = 64


class Shot(NamedTuple):
    """A picture and what its camera sees, as kernels read them."""

    camera: View  # without distortion
    K: Float64s  # (3, 3)   of the picture
    lens: Float64s  # (14,)   see octex.cameras.lens.lens_numbers
    mips: Mips
    seen: Visibility
    margins: Float32s  # (height, width)   pixels to where the surface ends; at most so far
    gains: Float32s  # (3,)   factors of its components
    weight: float  # how much it counts beside others


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
        K = shift @ self.camera.K
        camera = self.camera._replace(K=K, inverse_k=np.linalg.inv(K).astype(np.float64))
        corner = self.seen.corner + np.array([window.left, window.top])
        seen = self.seen._replace(rows=np.ascontiguousarray(window.of(self.seen.rows)), corner=corner)
        margins = np.ascontiguousarray(window.of(self.margins))
        return Sight(camera, shift @ self.K, self.lens, seen, margins)

    def shot(self, mips: Mips) -> Shot:
        """Put a picture before what its camera sees."""
        return Shot(
            self.camera, self.K, self.lens, mips, self.seen, self.margins, np.ones(3, np.float32), 1.0
        )


def sight_of(
    vertices: Float64s,
    triangles: Int32s,
    camera: Camera,
    feather: float,
    executor: Executor,
    stages: Stages = NOT_STORED,
    *,
    hidden: bool = False,
) -> Sight:
    """Find what a camera sees of triangles (m, 3) of vertices (n, 3).

    With ``hidden``, where no pixel hides anything, all of them see the first triangle.
    """
    pinhole = straight(camera)
    view = view_of(pinhole)

    def seen() -> dict[str, Array]:
        if hidden:
            size = pinhole.height, pinhole.width
            none = np.zeros(1, np.int32), np.zeros((1, 3)), np.zeros(2, np.int64)
            found = Visibility(np.zeros(size, np.int32), *none)
        else:
            found = visibility_of(vertices, triangles, pinhole, executor)
        return {**found._asdict(), "margins": distances_to_edges(found, view, max(feather, TRUSTED) + 1.0)}

    def is_sound(arrays: Mapping[str, Array]) -> bool:
        rows, seen = arrays["rows"], arrays["triangles"]
        is_in = rows.min() >= -1 and rows.max() < len(seen) == len(arrays["planes"])
        return bool(is_in and ((seen >= 0) & (seen < len(triangles))).all())

    own = stages.of(lambda: [(pinhole.height, pinhole.width), *view, feather, hidden])
    found = own.arrays("sight", seen, is_sound)
    visibility = Visibility(*(found[name] for name in Visibility._fields))
    sight = Sight(view, camera.K, camera.lens, visibility, found["margins"])
    return stages.placed(sight)


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
    stages: Stages = NOT_STORED,
) -> Iterator[Shot]:
    """Decode pictures, some ahead, alpha times ``scales``; ``around`` their paint if no lens bends them."""
    decoded = (
        start(executor, _decoded, each, form, scale, around, stages)
        for each, scale in zip(projections, scales, strict=True)
    )
    queue = deque(islice(decoded, most_ahead()))
    for sight in sights:
        mips, window = queue.popleft().result()
        yield sight.within(window).shot(stages.placed(mips))
        queue.extend(islice(decoded, 1))


def _decoded(
    projection: Projection, form: ChannelFormat, scale: float, around: int | None, stages: Stages
) -> tuple[Mips, Window]:
    is_straight = isinstance(projection.camera, Camera) and not is_bent(projection.camera.lens)
    return window_of(projection, form, scale, around if is_straight else None, stages)


def in_fixed_order(shots: Sequence[Shot]) -> list[Shot]:
    """Sort shots by content: sums and fits are then the same to the bit, in whatever order they came."""
    if len(shots) < 2:
        return list(shots)
    return sorted(shots, key=lambda shot: order_key(shot.camera, shot.K, shot.lens, shot.mips))


def order_key(camera: View, K: Float64s, lens: Float64s, mips: Mips) -> bytes:
    """Return what `in_fixed_order` sorts shots by: a digest of a camera and a picture."""
    made = hashlib.sha256(bytes([camera.is_pinhole]))
    for array in (camera.world_to_camera, camera.K, K, lens, mips.pixels):
        made.update(np.ascontiguousarray(array).data)
    return made.digest()


def near_paint(shot: Shot, reach: int) -> Shot:
    """Return a shot that sees nothing where its picture is transparent; as it is if a lens bends that."""
    painted = has_paint(shot)
    if is_bent(shot.lens) or painted.all():
        return shot
    rows = np.where(_spread(painted, reach), shot.seen.rows, np.int32(-1))
    return shot._replace(seen=shot.seen._replace(rows=large.moved(rows)))


def has_paint(shot: Shot) -> Bools:
    """Say which pixels (height, width) of a shot's picture are not transparent."""
    width, height = shot.mips.sizes[0, 1:]
    painted: Bools = shot.mips.pixels[: width * height, 3].reshape(height, width) > 0
    return painted


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
