"""The painted surface, with cached views of it, a grid that finds its triangles near paint, and the options.

`PaintOptions` checks all options of a call once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from octex.arrays import Bools, Float32s, Int32s, Int64s, Uint8s
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR, ChannelFormat
from octex.checks import as_array, as_choice, as_depth, as_flag, as_number, as_whole
from octex.conversion.large import NOT_STORED, Stages, digest_of
from octex.errors import ArgumentError
from octex.jit import inlined, kernel
from octex.painting.image import Mips, Projection
from octex.painting.project import Projected, Shading, Sight, sight_of, spread
from octex.painting.reading import Shot, Terms
from octex.painting.unwrap import Patch
from octex.parallel import Progress
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.layout import GRID_BITS
from octex.tree.morton import decode_cells
from octex.tree.placement import Placement, on_grid
from octex.view.shading import corner_normals, corner_normals_of, face_normals
from octex.voxelize.fragments import Blocks, whole

#: Ways to combine images that see the same point.
Pictures = Literal["average", "best", "robust"]
PICTURES: tuple[Pictures, ...] = get_args(Pictures)
#: Ways to match exposures: by one gain per image; or per component, with vignetting removed.
Balance = Literal["gain", "full"]
BALANCES: tuple[Balance, ...] = get_args(Balance)

#: Largest angles in degrees: photographs blur surface at grazing angles, drawings do not.
TAKEN_ANGLE, DRAWN_ANGLE = 75.0, 85.0
#: Degrees before the largest angle from which paint fades.
_FADE = 10.0
#: Surfaces tilted from the camera by this many degrees or more are not compared.
_COMPARED_ANGLE = 75.0
#: The level of the coarse cells: 128³, whose coordinates fit a byte.
_COARSE = 7


class PaintedSurface:
    """A surface to paint on; a session caches its normals and its last views."""

    def __init__(
        self, surface: Surface, *, in_session: bool = False, grid_of: PaintedSurface | None = None
    ) -> None:
        self.surface = surface
        self._in_session = in_session
        self._grid_of = grid_of  # the same surface in another pose
        self._grid: tuple[Placement, TriangleGrid] | None = None
        self._sights: dict[bytes, Sight] = {}
        self._flat: tuple[Surface, PaintedSurface] | None = None  # the last patch

    def posed(self, surface: Surface) -> PaintedSurface:
        """Return another pose of the surface, which shares the grid at rest.

        Raises ArgumentError for a surface with other triangles or rest positions.
        """
        for name in "triangles", "rest":
            if not np.array_equal(getattr(surface, name), getattr(self.surface, name)):
                raise ArgumentError(f"{surface.name} is no pose of {self.surface.name}: it has other {name}")
        return PaintedSurface(surface, in_session=self._in_session, grid_of=self)

    def flat(self, patch: Patch, texture: OctreeTexture | None) -> PaintedSurface:
        """Return the surface laid flat, which shares the grid at rest."""
        if self._flat is None or self._flat[0] is not patch.surface or not self._in_session:
            flat = patch.surface if texture is None else patch.surface.placed_in(texture)
            self._flat = patch.surface, PaintedSurface(flat, in_session=self._in_session, grid_of=self)
        return self._flat[1]

    def grid(self, placement: Placement) -> TriangleGrid:
        """Return the grid of the triangles in a root cell."""
        if self._grid_of is not None:
            return self._grid_of.grid(placement)
        if self._grid is None or self._grid[0] != placement:
            self._grid = placement, TriangleGrid(self.surface, placement)
        return self._grid[1]

    @cached_property
    def stretches(self) -> Float32s:
        """Each triangle's (m,) length at rest of a length of 1 on the posed one, by their areas."""
        vertices, rest, triangles = self.surface.vertices, self.surface.rest, self.surface.triangles
        if rest is vertices:
            return np.ones(len(triangles), np.float32)
        (_, posed), (_, resting) = face_normals(vertices, triangles), face_normals(rest, triangles)
        with np.errstate(divide="ignore", invalid="ignore"):
            stretches = np.sqrt(resting / posed)
        return np.nan_to_num(stretches, nan=1.0, posinf=1e6).astype(np.float32)

    @cached_property
    def shading(self) -> Shading:
        """The normals for angles to cameras: the surface's frames, or `corner_normals`."""
        mesh = self.surface.vertices, self.surface.triangles
        if self.surface.frames is not None:
            return partial(_normals_of_frames, self.surface)
        if self._in_session:
            return corner_normals(*mesh).__getitem__
        return partial(corner_normals_of, positions=mesh[0], triangles=mesh[1])

    @cached_property
    def content(self) -> bytes:
        """A digest of its positions, at rest and posed, and of its normals."""
        surface = self.surface
        frames = () if surface.frames is None else (*surface.frames.normals, *surface.frames.tangents)
        return digest_of(surface.vertices, surface.rest, surface.triangles, frames)

    def projected(
        self, shots: Sequence[Shot], form: ChannelFormat, terms: Terms, region: npt.ArrayLike | None = None
    ) -> Projected:
        """Return the paint of shots of it, or of the triangles of a region."""
        mesh = self.surface.vertices, self.surface.triangles
        chosen = None if region is None else triangles_of(region, len(mesh[1]))
        return Projected(list(shots), form, terms, *mesh, self.stretches, self.shading, chosen)

    def comparable(
        self, cameras: Sequence[Camera], images: Iterable[Mips], rim: float, executor: Executor
    ) -> Projected:
        """Return the base colour of images on surface that cameras see well, to compare images."""
        sights = self.sights(cameras, rim, executor)
        shots = [sight.shot(mips) for sight, mips in zip(sights, images, strict=True)]
        return self.projected(shots, BASE_COLOR, terms_of(_COMPARED_ANGLE, 0.0, back_faces=False))

    def sights(
        self,
        cameras: Sequence[Camera],
        feather: float,
        executor: Executor,
        stages: Stages = NOT_STORED,
        *,
        hidden: bool = False,
    ) -> Iterator[Sight]:
        """Yield the surface visible to each camera; see `sight_of`."""
        mesh = self.surface.vertices, self.surface.triangles
        stages = stages.of(lambda: [self.content])
        before, self._sights = self._sights, {}
        for camera in cameras:
            key = key_of(camera) + np.float64(feather).tobytes() + bytes([hidden])
            sight = before.get(key) or self._sights.get(key)
            if sight is None:
                sight = sight_of(*mesh, camera, feather, executor, stages, hidden=hidden)
            if self._in_session:
                self._sights[key] = sight
            yield sight


@dataclass(frozen=True)
class PaintOptions:
    """The options of ``octex.paint`` and ``octex.project``; raises ArgumentError for values out of range."""

    channel: str = BASE_COLOR.name
    max_depth: int | None = None
    max_angle: float | None = None
    edge_feather: float = 0.0
    pictures: Pictures | None = None
    balance: Balance | None = None
    reference: int | None = None
    back_faces: bool = False
    fit: bool = True
    hidden: bool = False
    region: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        """Check the options; `of` checks the reference and sets the angle."""
        angle, depth = self.max_angle, self.max_depth
        checked = {
            "max_depth": None if depth is None else as_depth(depth, "max_depth"),
            "max_angle": None if angle is None else as_number(angle, "max_angle", 0.0, 180.0),
            "edge_feather": as_number(self.edge_feather, "edge_feather", 0.0, 1e6),
            "pictures": None if self.pictures is None else as_choice(self.pictures, PICTURES, "pictures"),
            "balance": None if self.balance is None else as_choice(self.balance, BALANCES, "balance"),
            "back_faces": as_flag(self.back_faces, "back_faces"),
            "fit": as_flag(self.fit, "fit"),
            "hidden": as_flag(self.hidden, "hidden"),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.hidden and (self.balance is not None or self.pictures in ("robust", "best")):
            raise ArgumentError(
                "hidden cannot be used with balance, or with images that are robust or best: these compare "
                "what cameras see"
            )

    def of(self, images: Sequence[Projection]) -> PaintOptions:
        """Return the options for these images; raise ArgumentError for a reference that is none of them."""
        usual = DRAWN_ANGLE if all(each.since is not None for each in images) else TAKEN_ANGLE
        if self.reference is not None:
            as_whole(self.reference, "reference", 0, len(images) - 1)
        angle = usual if self.max_angle is None else self.max_angle
        return replace(self, max_angle=angle, pictures="average" if self.hidden else self.pictures)


class Job(NamedTuple):
    """What a call paints on, and how it works."""

    surface: PaintedSurface
    executor: Executor
    progress: Progress
    stages: Stages = NOT_STORED


def laid_flat(
    job: Job, projections: list[Projection], texture: OctreeTexture | None
) -> tuple[Job, list[Projection]]:
    """Return a job with its surface laid flat, if images have a patch for a camera; and with cameras."""
    patch = next((each.camera for each in projections if isinstance(each.camera, Patch)), None)
    if patch is None:
        return job, projections
    if any(each.camera is not patch for each in projections):
        raise ArgumentError("paint the images of each patch in a call of their own")
    if len(patch.surface.triangles) != len(job.surface.surface.triangles):
        raise ArgumentError(f"the patch is not of {job.surface.surface.name}; unwrap that")
    job = job._replace(surface=job.surface.flat(patch, texture))
    return job, [replace(each, camera=patch.camera) for each in projections]


def triangles_of(region: npt.ArrayLike, count: int, kinds: str = "") -> Bools:
    """Return a region, of numbers or bools, as bools (count,).

    Raises ArgumentError for any other region; the message names the other allowed ``kinds``.
    """
    part = as_array(region)
    if part.dtype == np.bool_ and part.shape == (count,):
        return part
    is_whole = part.ndim == 1 and part.dtype.kind in "iu"
    if not is_whole or (part.size and not 0 <= part.min() <= part.max() < count):
        raise ArgumentError(
            f"region must be {kinds}triangles of the surface: numbers from 0 to {count - 1}, or {count} bools"
        )
    chosen = np.zeros(count, np.bool_)
    chosen[part] = True
    return chosen


def terms_of(max_angle: float, feather: float, back_faces: bool, hidden: bool = False) -> Terms:
    """Return terms; ``max_angle`` is in degrees between the surface's normal and the camera."""
    vanishing, fading = np.radians(max_angle), np.radians(max(max_angle - _FADE, 0.0))
    whole = max_angle >= 90.0  # no fading
    return Terms(
        -1.0 if whole else float(np.cos(fading)),
        -2.0 if whole else float(np.cos(vanishing)),
        feather,
        back_faces,
        hidden,
    )


def key_of(camera: Camera) -> bytes:
    """Return bytes that identify a camera."""
    numbers = camera.width, camera.height, camera.projection == "pinhole"
    parts = camera.world_to_camera, camera.K, camera.lens, numbers
    return b"".join(np.asarray(part, np.float64).tobytes() for part in parts)


def _normals_of_frames(surface: Surface, chosen: Int32s) -> Float32s:
    frames = surface.posed_frames(chosen)
    assert frames is not None
    return frames.normals.values[frames.normals.rows]


class TriangleGrid:
    """The coarse cells of a root cell that the boxes of a surface's triangles reach."""

    def __init__(self, surface: Surface, placement: Placement) -> None:
        self._grid, self._faces = on_grid(surface.rest, placement), surface.triangles
        self._boxes = _boxes(self._grid, self._faces, GRID_BITS - _COARSE)

    def around(self, chosen: Int32s, depth: int) -> Blocks:
        """Return the triangles in or next to the coarse cells of ``chosen`` ones, of ``depth`` at most."""
        shift = max(_COARSE - depth, 0)
        triangles = self._sharing(self._boxes[chosen] >> np.uint8(shift), shift, 1)
        return whole(self._grid, self._faces, depth, triangles)

    def touching(self, cells: Sequence[tuple[int, Int64s]], depth: int) -> Blocks:
        """Return the triangles that may meet cells, listed as levels and Morton codes."""
        boxes = []
        for level, codes in cells:
            first = last = decode_cells(codes) >> max(level - _COARSE, 0)
            if level < _COARSE:
                first, last = first << (_COARSE - level), ((first + 1) << (_COARSE - level)) - 1
            boxes.append(np.concatenate([first, last], axis=1).astype(np.uint8))
        has_any = any(map(len, boxes))
        triangles = self._sharing(np.concatenate(boxes), 0, 0) if has_any else np.empty(0, np.int32)
        return whole(self._grid, self._faces, depth, triangles)

    def _sharing(self, boxes: Uint8s, shift: int, reach: int) -> Int32s:
        """Return the triangles that share coarse cells with boxes (n, 6), widened by ``reach`` cells."""
        first, last = boxes[:, :3].min(axis=0).astype(np.int64), boxes[:, 3:].max(axis=0).astype(np.int64)
        first = np.maximum(first - reach, 0)
        last = np.minimum(last + reach, (1 << (_COARSE - shift)) - 1)
        marked = np.zeros(last - first + 1, np.bool_)
        _mark(boxes, first, marked)
        return _reaching(self._boxes, shift, first, spread(marked, reach))


@kernel
def _boxes(grid: Int32s, triangles: Int32s, shift: int) -> Uint8s:
    """Return the first and last coarse cell of triangles along each axis (m, 6)."""
    boxes = np.empty((triangles.shape[0], 6), np.uint8)
    for triangle in range(triangles.shape[0]):
        for axis in range(3):
            a = grid[triangles[triangle, 0], axis]
            b = grid[triangles[triangle, 1], axis]
            c = grid[triangles[triangle, 2], axis]
            boxes[triangle, axis] = min(a, min(b, c)) >> shift
            boxes[triangle, 3 + axis] = max(a, max(b, c)) >> shift
    return boxes


@kernel
def _mark(boxes: Uint8s, first: Int64s, marked: Bools) -> None:
    """Mark the coarse cells of boxes; ``marked`` begins at cell ``first``."""
    for n in range(boxes.shape[0]):
        for x in range(np.int64(boxes[n, 0]) - first[0], np.int64(boxes[n, 3]) - first[0] + 1):
            for y in range(np.int64(boxes[n, 1]) - first[1], np.int64(boxes[n, 4]) - first[1] + 1):
                for z in range(np.int64(boxes[n, 2]) - first[2], np.int64(boxes[n, 5]) - first[2] + 1):
                    marked[x, y, z] = True


@kernel
def _reaching(boxes: Uint8s, shift: int, first: Int64s, marked: Bools) -> Int32s:
    """Return the triangles whose boxes reach a marked coarse cell; ``marked`` begins at cell ``first``."""
    reaching = np.empty(boxes.shape[0], np.int32)
    count = 0
    for triangle in range(boxes.shape[0]):
        reaching[count] = triangle
        count += _meets(boxes[triangle], shift, first, marked)
    return reaching[:count].copy()


@inlined
def _meets(box: Uint8s, shift: int, first: Int64s, marked: Bools) -> bool:
    """Return whether a box reaches a marked coarse cell."""
    for x in _within(box, 0, shift, first, marked.shape):
        for y in _within(box, 1, shift, first, marked.shape):
            for z in _within(box, 2, shift, first, marked.shape):
                if marked[x, y, z]:
                    return True
    return False


@inlined
def _within(box: Uint8s, axis: int, shift: int, first: Int64s, shape: tuple[int, int, int]) -> range:
    """Return the marked cells along an axis between which a box lies; none if it lies outside."""
    low, high = (np.int64(box[axis]) >> shift) - first[axis], (np.int64(box[3 + axis]) >> shift) - first[axis]
    return range(max(low, 0), min(high + 1, shape[axis]))
