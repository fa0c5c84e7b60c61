"""Photographs that cannot be right: found on small copies of them, before anything is painted.

Points of the surface are read in all pictures that see them. Whatever their exposure, light changes from
point to point much the same in all. A picture in which it does not shows something else, or lies the wrong
way round.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple, cast

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR
from octex.errors import ImageError
from octex.painting.picture import Projection, content_of, mips_of, texels_of
from octex.painting.project import Projected
from octex.painting.reading import terms_of
from octex.painting.surface import PaintedSurface, key_of
from octex.parallel import ordered_map, sharing
from octex.source.surface import Surface

#: Small copies have no more pixels each way, and are compared at so many points.
_PIXELS, _POINTS = 256, 8000
#: What is seen at such an angle to the surface's normal, in degrees, or more, is not compared.
_MAX_ANGLE = 75.0
#: Pictures are compared with two others or more, at so many points or more, unless light differs less.
_OTHERS, _SHARED, _PLAIN = 2, 200, 1e-3
#: Pictures agree from the first correlation on; one below the second shows something else. Ten of a castle
#: have 0.69 to 0.96; one turned, or of another scene, -0.1 to 0.14.
_AGREES, _STRANGE = 0.5, 0.2
#: Below this mean of all, another unit and other axes are tried; they are told if the mean grows by so much.
_FITS, _GAIN = 0.8, 0.15
#: Meshes may be in such units of others' (metres, millimetres, inches, feet).
_FACTORS = (1.0, 0.001, 0.01, 0.1, 10.0, 100.0, 1000.0, 0.0254, 1 / 0.0254, 0.3048, 1 / 0.3048)
#: So many points, in boxes each way of a picture, tell how a mesh fills it; so many pictures are asked, and
#: so many placings tried. Less than such a part of points times boxes is no view of it.
_FILLING, _BOXES, _FEW, _TRIED, _FILLED = 1000, 8, 8, 8, 0.05


def misfits(
    surface: Surface, projections: Sequence[Projection], executor: Executor
) -> tuple[dict[int, str], str | None]:
    """Return the numbers of pictures that should not be painted, and why; and how the mesh would fit better.

    These are files that are damaged, pictures given twice, also with another camera, those whose cameras see
    nothing of the surface, those that are turned, and those that show something else than most others do.
    """
    found: dict[int, str] = {}
    first: dict[bytes, int] = {}
    contents = [content_of(each) for each in projections]
    for number, each in enumerate(projections):
        before = first.setdefault(contents[number] + key_of(cast(Camera, each.camera)), number)
        if before != number:
            found[number] = f"the same picture and camera as {projections[before].name}"
    rest = [number for number in range(len(projections)) if number not in found]
    with sharing(executor) as pool:
        read = list(ordered_map(pool, _small, [projections[number] for number in rest]))
    for number, copy in zip(rest, read, strict=True):
        if isinstance(copy, ImageError):
            found[number] = str(copy)
    rest = [number for number in rest if number not in found]
    small = [copy for copy in read if isinstance(copy, Projection)]
    if not small:
        return {}, None  # painting says what is wrong
    source = _seen_on(surface, small, executor)
    is_blind = [bool((shot.seen.rows < 0).all()) for shot in source.shots]
    if all(is_blind):
        return found, better_placed(surface, small, 0.0, executor)
    found |= {
        n: "its camera sees nothing of the model" for n, blind in zip(rest, is_blind, strict=True) if blind
    }
    samples = read_points(source, surface)
    agreed = samples.agreements()
    now = float(np.nan_to_num(agreed).mean())
    # Pictures of a mesh that lies otherwise may share nothing of it: how they agree is not known then.
    if now < _FITS and (len(small) > _OTHERS or _filled_by(surface, small) < _FILLED):
        better = better_placed(surface, small, now, executor)
        if better is not None:
            return found, better
    known = agreed[np.isfinite(agreed)]
    if known.size < 2 or np.median(known) < _AGREES:
        return found, None
    for index, turn in _strange(source, samples, small).items():
        found[rest[index]] = (
            f"it fits its camera only when turned by {turn} degrees clockwise; turn the file, paint again"
            if turn
            else "it differs from all others there: another scene, or the camera of another picture"
        )
    best: dict[bytes, int] = {}  # of those that are the same picture, the one that agrees best
    for index in np.argsort(-agreed, kind="stable").tolist():  # what is not known comes last
        number = rest[index]
        before = best.setdefault(contents[number], number)
        if before != number and number not in found and np.isfinite(agreed[index]):
            found[number] = f"the same picture as {projections[before].name}, whose camera it fits better"
    return found, None


def _small(projection: Projection) -> Projection | ImageError:
    """Return a small copy of a picture, with its camera; or why it cannot be read."""
    camera = cast(Camera, projection.camera)
    try:
        texels = texels_of(projection.image, "the image", (camera.width, camera.height))
    except ImageError as error:
        return error
    step = -(-max(camera.width, camera.height) // _PIXELS)
    rows, columns = max(camera.height // step, 1), max(camera.width // step, 1)
    high, wide = min(rows * step, camera.height), min(columns * step, camera.width)
    blocks = texels[:high, :wide].reshape(rows, high // rows, columns, wide // columns, 4)
    means = blocks.mean(axis=(1, 3), dtype=np.float32).astype(texels.dtype)
    return Projection(means, camera.resized((columns, rows)), key=projection.key)


def _seen_on(surface: Surface, small: Sequence[Projection], executor: Executor) -> Projected:
    """Return pictures projected onto a surface."""
    painted = PaintedSurface(surface)
    sights = painted.sights([cast(Camera, each.camera) for each in small], 0.0, executor)
    shots = [sight.shot(mips_of(each, BASE_COLOR)) for sight, each in zip(sights, small, strict=True)]
    return painted.projected(shots, BASE_COLOR, terms_of(_MAX_ANGLE, 0.0, False))


class Samples(NamedTuple):
    """Points of a surface, and the light that pictures have there."""

    triangles: Int32s  # (n,)
    barycentric: Float64s  # (n, 3)
    widths: Float32s  # (n,)   of the finest pixel
    light: Float32s  # (pictures, n)   square roots
    seen: Bools  # (pictures, n)

    def of(self, source: Projected) -> Float32s:
        """Return the light of the first picture of another source at the points (n,)."""
        paint, _ = source.each(self.triangles, self.barycentric, self.widths)
        return _light(paint[0])

    def agreement(self, number: int, own: Float32s) -> float:
        """Return the correlation of light (n,) with the others' median; NaN where few share points."""
        others = self.seen.copy()
        others[number] = False
        shared = self.seen[number] & (others.sum(axis=0) >= _OTHERS)
        if shared.sum() < _SHARED:
            return np.nan
        theirs = np.where(others[:, shared], self.light[:, shared], np.nan)[others[:, shared].any(axis=1)]
        middle, here = np.nanmedian(theirs, axis=0), own[shared]
        if min(np.ptp(here), np.ptp(middle)) < _PLAIN:
            return np.nan
        return float(np.corrcoef(here, middle)[0, 1])

    def agreements(self) -> Float64s:
        """Return the agreement of each picture with the others (pictures,)."""
        return np.array([self.agreement(number, own) for number, own in enumerate(self.light)])


def read_points(source: Projected, surface: Surface) -> Samples:
    """Read all pictures at points of the surface."""
    points = surface.scatter(_POINTS)
    where = points.triangles, points.barycentric
    widths = source.widths(*where)
    widths[~np.isfinite(widths)] = 0.0
    paint, weights = source.each(*where, widths)
    return Samples(*where, widths, _light(paint), weights > 0)


def _light(paint: Float32s) -> Float32s:
    found: Float32s = np.sqrt(np.maximum(paint.mean(axis=-1), 0.0))
    return found


def _strange(source: Projected, samples: Samples, small: Sequence[Projection]) -> dict[int, int]:
    """Return pictures that do not agree with the others, and by how many degrees they then do; 0 for none."""
    found: dict[int, int] = {}
    while True:
        agreed = samples.agreements()
        if not np.isfinite(agreed).any() or np.nanmin(agreed) >= _STRANGE:
            return found
        worst = int(np.nanargmin(agreed))
        camera, image = cast(Camera, small[worst].camera), cast(Array, small[worst].image)
        found[worst] = 0
        for turn in (180, 90, 270) if camera.width == camera.height else (180,):
            turned = replace(small[worst], image=np.ascontiguousarray(np.rot90(image, -turn // 90)))
            shot = source.shots[worst]._replace(mips=mips_of(turned, BASE_COLOR))
            if samples.agreement(worst, samples.of(source.with_shots([shot]))) >= _AGREES:
                found[worst] = turn
                break
        samples.seen[worst] = False


def better_placed(
    surface: Surface, small: Sequence[Projection], now: float, executor: Executor
) -> str | None:
    """Return the factor and the turn of a mesh by which pictures agree, in words; None if there is none.

    Tried are units of length and turns of the axes: those that fill the pictures best, one after the other.
    """
    some = small[:: -(-len(small) // _FEW)]
    cameras = [cast(Camera, each.camera) for each in some]
    points = surface.scatter(_FILLING).points
    turns = [turn for turn in _turns() if np.linalg.det(turn) > 0]
    placings = [(factor, turn) for factor in _FACTORS for turn in turns]
    filled = [_filling(cameras, factor * points @ turn.T) for factor, turn in placings]
    ranked = sorted(range(len(placings)), key=lambda number: -filled[number])[:_TRIED]
    agreed = []
    for number in ranked:
        factor, turn = placings[number]
        moved = Surface.from_arrays(factor * surface.vertices @ turn.T, surface.triangles)
        found = read_points(_seen_on(moved, some, executor), moved).agreements()
        agreed.append(float(np.nan_to_num(found).mean()))
    if max(agreed) >= max(_AGREES, now + _GAIN):
        return f"pictures agree if {_in_words(*placings[ranked[int(np.argmax(agreed))]])}"
    is_seen = filled[0] > 0 or not filled[ranked[0]] > _FILLED  # the first is the mesh as it is
    return None if is_seen else f"the cameras see the model if {_in_words(*placings[ranked[0]])}"


def _filled_by(surface: Surface, small: Sequence[Projection]) -> float:
    """Return how well a surface as it is fills pictures; see `_filling`."""
    return _filling([cast(Camera, each.camera) for each in small], surface.scatter(_FILLING).points)


def _turns() -> Iterator[Float64s]:
    """Yield axes permuted and mirrored: those as they are first."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield np.eye(3)[list(order)] * np.array(signs)[:, None]


def _in_words(factor: float, turn: Float64s) -> str:
    names = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in turn]
    turned = "" if (turn == np.eye(3)).all() else f"(x, y, z) becomes ({', '.join(names)})"
    scaled = "" if factor == 1 else f"it is scaled by {factor:g}"
    return "in the mesh " + " and ".join(each for each in (scaled, turned) if each)


def _filling(cameras: Sequence[Camera], points: Float64s) -> float:
    """Return how well pictures hold points, and points fill them: the mean of both parts' product."""
    total = 0.0
    for camera in cameras:
        pixels, depths = camera.project(points)
        size = np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            inside = (depths > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
        boxes = (pixels[inside] / size * _BOXES).astype(np.int64)
        total += inside.mean() * len(np.unique(boxes @ [_BOXES, 1])) / _BOXES**2
    return total / len(cameras)
