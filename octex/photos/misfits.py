"""Finds photographs that cannot be right, on small copies of them, before anything is painted.

All photographs are read at points of the surface. Whatever their exposure, their detail there is alike. A
photograph with other detail shows another scene, or is turned.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple, cast

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR
from octex.errors import ImageError
from octex.painting.image import Projection, content_of, mips_of, texels_of
from octex.painting.project import Projected
from octex.painting.surface import PaintedSurface, key_of
from octex.parallel import ordered_map, sharing
from octex.source.surface import Surface

#: Side of the small copies in pixels, at most; points at which they are compared.
_PIXELS, _POINTS = 256, 8000
#: Least numbers of other photographs and of shared points for a comparison; least range of light there.
_OTHERS, _SHARED, _PLAIN = 2, 200, 1e-3
#: Detail is the light in footprints of the first width in pixels, less that in footprints of the second.
#: Light alone does not separate scenes: in most the sky is bright, and above.
_FINE, _BROAD = 2.0, 16.0
#: A photograph agrees above the first correlation, and shows another scene below the second. Ten of a castle
#: and 23 of a tree have 0.48 to 0.9; photographs with a wrong camera or of another scene 0.0, of 330 the
#: largest 0.38.
_AGREES, _STRANGE = 0.4, 0.25
#: Below this mean correlation other units and axes are tried. They are reported if the mean reaches it, and
#: grows by _GAIN: a castle has 0.85 in the right ones, and up to 0.42 on a mesh that fits nowhere.
_FITS, _GAIN = 0.6, 0.15
#: Ratios of units that meshes come in: metres, millimetres, inches, feet.
_FACTORS = (1.0, 0.001, 0.01, 0.1, 10.0, 100.0, 1000.0, 0.0254, 1 / 0.0254, 0.3048, 1 / 0.3048)
#: How well a mesh fills photographs: points, and boxes along each side; below _FILLED they do not show it.
_FILLING, _BOXES, _FILLED = 1000, 8, 0.1
#: Other placements of the mesh are compared in so many photographs; of those that fill at least _PART of what
#: the best one fills, so many at most.
_COMPARED, _TRIED, _PART = 20, 48, 0.5

#: The fault of a mesh at whose points images show different things, and that no placing mends.
_UNLIKE = (
    "images show different things at the same points of it; give the mesh that was made with these "
    "cameras, in the same coordinates"
)
#: The fault of a mesh of which the images see little, and nothing in common.
_UNSEEN = "they see little of it, and share nothing; compare the units and axes of both"


def misfits(
    surface: Surface, projections: Sequence[Projection], executor: Executor
) -> tuple[dict[int, str], str | None]:
    """Return the numbers of images that should not be painted, with reasons; and a better fit of the mesh.

    Reasons: a damaged file, a duplicate (also with another camera), a camera that sees nothing of the
    surface, a turned image, another scene.
    """
    reasons: dict[int, str] = {}
    first: dict[bytes, int] = {}
    contents = [content_of(each) for each in projections]
    for number, each in enumerate(projections):
        before = first.setdefault(contents[number] + key_of(cast(Camera, each.camera)), number)
        if before != number:
            reasons[number] = f"the same image and camera as {projections[before].name}"
    rest = [number for number in range(len(projections)) if number not in reasons]
    with sharing(executor) as pool:
        read = list(ordered_map(pool, _small, [projections[number] for number in rest]))
    for number, copy in zip(rest, read, strict=True):
        if isinstance(copy, ImageError):
            reasons[number] = str(copy)
    rest = [number for number in rest if number not in reasons]
    small = [copy for copy in read if isinstance(copy, Projection)]
    if not small:
        return {}, None  # painting reports the error
    source = _projected(surface, small, executor)
    is_blind = [bool((shot.seen.rows < 0).all()) for shot in source.shots]
    if all(is_blind):
        return reasons, better_placed(surface, small, 0.0, executor)
    samples = read_points(source, surface)
    agreed = samples.agreements()
    now = float(np.nan_to_num(agreed).mean())
    # Images of a misplaced mesh may share no point: then their agreement is unknown.
    if now < _FITS and (len(small) > _OTHERS or _filling_of(surface, small) < _FILLED):
        better = better_placed(surface, small, now, executor)
        if better is not None:
            return reasons, better
    reasons |= {
        n: "its camera sees nothing of the model" for n, blind in zip(rest, is_blind, strict=True) if blind
    }
    if not _agree(agreed):
        if not np.isfinite(agreed).any():
            return reasons, _UNSEEN if _filling_of(surface, small) < _FILLED else None
        light = read_points(source, surface, has_shades=True).agreements()
        is_unlike = np.isfinite(agreed).sum() >= _OTHERS and not _agree(light)
        return reasons, _UNLIKE if is_unlike else None
    for index, turn in _strange(source, samples, small).items():
        reasons[rest[index]] = (
            f"it fits its camera only when turned by {turn} degrees clockwise; turn the file, paint again"
            if turn
            else "it differs from all others there: another scene, or the camera of another image"
        )
    best: dict[bytes, int] = {}  # of equal images the one that agrees best
    for index in np.argsort(-agreed, kind="stable").tolist():  # unknown agreements come last
        number = rest[index]
        before = best.setdefault(contents[number], number)
        if before != number and np.isfinite(agreed[index]):
            reasons[number] = f"the same image as {projections[before].name}, whose camera it fits better"
    return reasons, None


def _small(projection: Projection) -> Projection | ImageError:
    """Return a small copy of an image with its camera, or the error of reading it."""
    camera = cast(Camera, projection.camera)
    try:
        texels = texels_of(projection.image, "the image", (camera.width, camera.height))
    except ImageError as error:
        return error
    step = -(-max(camera.width, camera.height) // _PIXELS)
    rows, columns = max(camera.height // step, 1), max(camera.width // step, 1)
    high, wide = min(rows * step, camera.height), min(columns * step, camera.width)
    blocks = texels[:high, :wide].reshape(rows, high // rows, columns, wide // columns, 4)
    means = blocks.mean(axis=1, dtype=np.float32).mean(axis=2).astype(texels.dtype)  # 5 × as fast as at once
    return Projection(means, camera.resized((columns, rows)), key=projection.key)


def _projected(surface: Surface, small: Sequence[Projection], executor: Executor) -> Projected:
    """Project images onto a surface."""
    cameras = [cast(Camera, each.camera) for each in small]
    images = (mips_of(each, BASE_COLOR) for each in small)
    return PaintedSurface(surface).comparable(cameras, images, 0.0, executor)


class LightSamples(NamedTuple):
    """Points of a surface, and the images' light there."""

    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    widths: Float32s  # (n,)   of the finest pixel
    light: Float32s  # (images, n)   detail of square roots
    seen: Bools  # (images, n)

    def of(self, source: Projected) -> Float32s:
        """Return the detail of another source's first image at the points (n,)."""
        detail: Float32s = _detail(source, self.triangles, self.barycentric, self.widths)[0][0]
        return detail

    def agreement(self, number: int, light: Float32s) -> float:
        """Return the correlation of light (n,) with the others' median; NaN if few points are shared."""
        return self._correlation(number, light, next(self._medians([number])))

    def agreements(self) -> Float64s:
        """Return the agreement of each image with the others (images,)."""
        medians = enumerate(self._medians(range(len(self.light))))
        return np.array([self._correlation(number, self.light[number], middle) for number, middle in medians])

    def _correlation(self, number: int, light: Float32s, middle: Float32s) -> float:
        shared = self.seen[number] & np.isfinite(middle)
        if shared.sum() < _SHARED:
            return np.nan
        here, there = light[shared], middle[shared]
        if min(np.ptp(here), np.ptp(there)) < _PLAIN:
            return np.nan
        return float(np.corrcoef(here, there)[0, 1])

    def _medians(self, numbers: Iterable[int]) -> Iterator[Float32s]:
        """Yield for each image the median (n,) of the others that see a point; NaN for too few of them."""
        order = np.argsort(np.where(self.seen, self.light, np.inf), axis=0, kind="stable")
        ranks = np.argsort(order, axis=0, kind="stable")
        ordered = np.take_along_axis(self.light, order, axis=0)
        counts, points = self.seen.sum(axis=0), np.arange(self.seen.shape[1])
        for number in numbers:
            others = counts - self.seen[number]
            is_known = others >= _OTHERS
            middles = (others - 1) // 2, others // 2
            rows = (np.where(is_known, rank + (rank >= ranks[number]), 0) for rank in middles)
            low, high = (ordered[row, points] for row in rows)
            yield np.where(is_known, (low + high) / 2, np.float32(np.nan))


def _agree(agreements: Float64s) -> bool:
    """Return whether images agree, by the median; False if that is unknown."""
    known = agreements[np.isfinite(agreements)]
    return known.size >= _OTHERS and bool(np.median(known) >= _AGREES)


def read_points(source: Projected, surface: Surface, *, has_shades: bool = False) -> LightSamples:
    """Read the detail of all images at points of the surface; with ``has_shades`` all of their light."""
    points = surface.scatter(_POINTS)
    where = points.triangles, points.barycentric
    widths = source.widths(*where)
    widths[~np.isfinite(widths)] = 0.0
    return LightSamples(*where, widths, *_detail(source, *where, widths, has_shades=has_shades))


def _detail(
    source: Projected,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
    *,
    has_shades: bool = False,
) -> tuple[Float32s, Bools]:
    """Return the detail of images at points (images, n), and which they see."""
    fine, broad = (
        source.each(triangles, barycentric, np.float32(width) * widths) for width in (_FINE, _BROAD)
    )
    light = [np.sqrt(np.maximum(paint.mean(axis=-1), 0.0)) for paint, _ in (fine, broad)]
    detail: Float32s = light[0] if has_shades else light[0] - light[1]
    return detail, fine[1] > 0


def _strange(source: Projected, samples: LightSamples, small: Sequence[Projection]) -> dict[int, int]:
    """Return images that disagree with the others, and the degrees of a turn that mends it; 0 for none."""
    turns: dict[int, int] = {}
    while True:
        agreed = samples.agreements()
        if not np.isfinite(agreed).any() or np.nanmin(agreed) >= _STRANGE:
            return turns
        worst = int(np.nanargmin(agreed))
        camera, image = cast(Camera, small[worst].camera), cast(Array, small[worst].image)
        turns[worst] = 0
        for turn in (180, 90, 270) if camera.width == camera.height else (180,):
            turned = replace(small[worst], image=np.ascontiguousarray(np.rot90(image, -turn // 90)))
            shot = source.shots[worst]._replace(mips=mips_of(turned, BASE_COLOR))
            if samples.agreement(worst, samples.of(source.with_shots([shot]))) >= _AGREES:
                turns[worst] = turn
                break
        samples.seen[worst] = False


class Placing(NamedTuple):
    """A change of the mesh or of all cameras."""

    factor: float  # of lengths of the mesh
    turn: Float64s  # (3, 3)   of its axes
    is_reversed: bool  # whether the cameras' y and z axes change their signs

    def of(self, camera: Camera) -> Camera:
        """Return the camera that sees the mesh as this one would see it changed."""
        view = camera.world_to_camera.copy()
        if self.is_reversed:
            view[1:3] *= -1.0
        view[:3, :3] = view[:3, :3] @ self.turn
        view[:3, 3] /= self.factor
        return replace(camera, world_to_camera=view)

    def words(self) -> str:
        """Say what to change."""
        signed = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in self.turn]
        is_turned = (self.turn != np.eye(3)).any()
        turned = f"turned so that (x, y, z) becomes ({', '.join(signed)})" if is_turned else ""
        scaled = "" if self.factor == 1 else f"scaled by {self.factor:g}"
        moved = " and ".join(each for each in (scaled, turned) if each)
        mesh = f"the mesh is {moved}" if moved else ""
        cameras = "the cameras' y and z axes are reversed (OpenCV or OpenGL)" if self.is_reversed else ""
        return " and ".join(each for each in (mesh, cameras) if each)


def better_placed(
    surface: Surface, small: Sequence[Projection], now: float, executor: Executor
) -> str | None:
    """Return the change of the mesh or the cameras by which images agree, in words; None if there is none.

    It tries units of length and reversed cameras, then turns of the axes too. Of these it compares those that
    fill the images.
    """
    few = small[:: -(-len(small) // _COMPARED)]
    cameras = [cast(Camera, each.camera) for each in few]
    points = surface.scatter(_FILLING).points
    turns = [turn for turn in _turns() if np.linalg.det(turn) > 0]
    placings = [Placing(*each) for each in product(_FACTORS, turns, (False, True))]
    filled = np.array([_filling([placing.of(each) for each in cameras], points) for placing in placings])
    is_turned = np.array([(each.turn != np.eye(3)).any() for each in placings])
    ranked = np.lexsort((-filled, is_turned)).tolist()
    ranked = [number for number in ranked if filled[number] >= _PART * filled.max()][:_TRIED]
    best, most, is_known = placings[int(filled.argmax())], 0.0, False
    for number in ranked:
        if is_turned[number] and not is_turned[ranked[0]] and most >= max(_FITS, now + _GAIN):
            break
        moved = [replace(each, camera=placings[number].of(cast(Camera, each.camera))) for each in few]
        agreements = read_points(_projected(surface, moved, executor), surface).agreements()
        agreed = float(np.nan_to_num(agreements).mean())
        is_known |= bool(np.isfinite(agreements).any())
        if number and agreed > most:  # 0 is the mesh as it is
            best, most = placings[number], agreed
    advice = "; change that, and paint again"
    if most >= max(_FITS, now + _GAIN):
        return f"images agree if {best.words()}{advice}"
    is_seen = filled[0] > 0 or not filled.max() > _FILLED
    if is_seen or is_known:  # images that can be compared somewhere do not agree there
        return None
    return f"the cameras see the model if {best.words()}{advice}"


def _filling_of(surface: Surface, small: Sequence[Projection]) -> float:
    return _filling([cast(Camera, each.camera) for each in small], surface.scatter(_FILLING).points)


def _turns() -> Iterator[Float64s]:
    """Yield all permutations and reflections of the axes, the identity first."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield np.eye(3)[list(order)] * np.array(signs)[:, None]


def _filling(cameras: Sequence[Camera], points: Float64s) -> float:
    """Return, averaged over images, the part of the points inside times the part of the image filled."""
    total = 0.0
    for camera in cameras:
        pixels, depths = camera.project(points)
        size = np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            inside = (depths > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
        boxes = (pixels[inside] / size * _BOXES).astype(np.int64)
        total += inside.mean() * len(np.unique(boxes @ [_BOXES, 1])) / _BOXES**2
    return total / len(cameras)
