"""Cameras that are a little off, improved until their pictures agree on the surface.

Points of the surface are read in all pictures that see them, from coarse to fine. Each camera turns, moves
and zooms a little (Gauss-Newton steps), so that pictures differ least from what all say of a point; what is
far off counts for less (Zhou & Koltun, "Color Map Optimization", 2014, solved for all cameras at once).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import BASE_COLOR
from octex.checks import as_choice, as_whole
from octex.errors import ArgumentError
from octex.painting.balance import BALANCES, Balance, balanced
from octex.painting.consensus import agreed_step, robust_weights
from octex.painting.ground import Ground
from octex.painting.pictures import Levels, Projection, check_projections, levels_of
from octex.painting.projected import Projected, Shot, in_fixed_order, shot_of, terms_of
from octex.parallel import Progress, as_progress, workers
from octex.source.surface import Surface, as_surface
from octex.view.camera import Camera

#: Points of the surface that are compared.
_POINTS = 10_000
#: Levels of pictures, each twice as coarse, that are read one after the other, and steps on each.
_LEVELS, _STEPS = (3, 2, 1, 0), 8
#: A step in which no camera moves by so many pixels is the last of its level.
_STILL = 0.005
#: From what difference of square roots of light on a picture may count for less: at the finest level, and so
#: much more at each coarser one, where pictures that are off differ most at the edges that tell of it.
_FAR = 0.04
#: How strongly, of what there is, cameras are held where they are: what pictures do not tell stays.
_HOLD = 1e-4
#: What is seen at such an angle to the surface's normal, in degrees, or more, is not compared.
_MAX_ANGLE = 75.0
#: Numbers of a camera that change: turns about three axes, moves along them, zoom.
_NUMBERS = 7
#: By how many pixels cameras are moved to see what changes.
_TRIAL = 1e-3


def refine_cameras(
    surface: Surface,
    projections: Projection | Sequence[Projection],
    *,
    balance: Balance | None = "full",
    reference: int | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Camera]:
    """Return the cameras of pictures, turned, moved and zoomed a little so that the pictures agree best.

    For cameras that are a few pixels off, not for such that look elsewhere. The pictures' own light, masks
    and order do not matter.

    surface      what the cameras see, at its posed positions
    balance      how pictures are made to agree in light before they are compared, as for ``paint``
    reference    the picture, by its number, whose camera stays as it is; default: the one that shares most of
                 what it sees with others

    Who works in parallel: ``threads``, so many, by default all processors for large batches and the calling
    thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor. The result
    is the same.

    Raises ArgumentError and ImageError as ``paint`` does.
    """
    given = check_projections(projections)
    if balance is not None:
        as_choice(balance, BALANCES, "balance")
    if reference is not None:
        reference = as_whole(reference, "reference", 0, len(given) - 1)
    cameras = [each.camera for each in given if isinstance(each.camera, Camera)]
    if len(cameras) < len(given):
        raise ArgumentError("patches are where they were laid; only cameras are refined")
    ground, report = Ground(as_surface(surface)), as_progress(progress)
    if len(given) == 1:
        return cameras
    with workers(threads, executor) as pool:
        levels = list(pool.map(lambda each: levels_of(each, BASE_COLOR), given))
        order, stays = _ordered(ground, cameras, levels, reference, pool)
        cameras, levels = [cameras[n] for n in order], [levels[n] for n in order]
        for done, level in enumerate(_LEVELS):
            report("refine", done, len(_LEVELS))
            source = _source(ground, cameras, levels, pool)
            if balance is not None:
                source = balanced(source, surface, balance, stays)
            cameras = _agreeing(source, surface, cameras, level, stays)
        report("refine", len(_LEVELS), len(_LEVELS))
    found = dict(zip(order, cameras, strict=True))
    return [found[number] for number in range(len(given))]


def _ordered(
    ground: Ground,
    cameras: list[Camera],
    levels: list[Levels],
    reference: int | None,
    executor: Executor,
) -> tuple[list[int], int | None]:
    """Return the pictures' numbers in an order by what they hold, and which of these is the reference."""
    shots = _source(ground, cameras, levels, executor).shots
    order = [next(n for n, shot in enumerate(shots) if shot is each) for each in in_fixed_order(shots)]
    return order, None if reference is None else order.index(reference)


def _source(
    ground: Ground, cameras: Sequence[Camera], levels: Sequence[Levels], executor: Executor
) -> Projected:
    sights = ground.sights(list(cameras), 0.0, executor)
    shots = [shot_of(sight, own) for sight, own in zip(sights, levels, strict=True)]
    surface = ground.surface
    return Projected(
        shots, BASE_COLOR, terms_of(_MAX_ANGLE, 0.0, False), surface.vertices, surface.triangles,
        ground.stretches, shading=ground.shading,
    )  # fmt: skip


def _agreeing(
    source: Projected, surface: Surface, cameras: list[Camera], level: int, stays: int | None
) -> list[Camera]:
    """Return cameras by which what pictures hold at a level agrees best."""
    samples = surface.scatter(_POINTS)
    where = samples.triangles, samples.barycentric
    points = source.positions(*where)
    says = _says(source, *where)
    fixed = int(np.argmax((says * (says > 0).sum(axis=0)).sum(axis=1))) if stays is None else stays
    pictures = [_read(shot, level) for shot in source.shots]
    for _ in range(_STEPS):
        values, slopes = [], []
        for picture, camera, gains, say in zip(pictures, cameras, source.gains, says, strict=True):
            value, slope = np.zeros((len(points), 3)), np.zeros((len(points), 3, _NUMBERS))
            value[say > 0], slope[say > 0] = _seen(picture, camera, points[say > 0], gains)
            values.append(value.ravel())
            slopes.append(slope.reshape(-1, _NUMBERS))
        value, slope = np.stack(values), np.stack(slopes)
        weights = np.repeat(says, 3, axis=1) * np.isfinite(value)
        value, slope = np.nan_to_num(value), np.nan_to_num(slope)
        weights, _ = robust_weights(value, weights, _FAR * (level + 1))
        strength = np.einsum("in,inp->ip", weights, slope**2).max(axis=1, keepdims=True)
        ridge = np.broadcast_to(np.maximum(_HOLD * strength, 1e-12), (len(cameras), _NUMBERS)).copy()
        ridge[fixed] = np.inf
        step = agreed_step(slope, value, weights, ridge)
        cameras = [_moved(each, own, points) for each, own in zip(cameras, step, strict=True)]
        if np.abs(step).max() < _STILL * 2**level:
            break
    return cameras


def _says(source: Projected, triangles: Int32s, barycentric: Float64s) -> Float64s:
    """Return how much pictures say of points (pictures, n): the better they see them, to 1; at least two."""
    _, weights = source.each(triangles, barycentric, source.widths(triangles, barycentric))
    share = weights / np.maximum(weights.max(axis=0), 1e-30)
    says: Float64s = np.where((weights > 0).sum(axis=0) > 1, share.astype(np.float64) ** 0.25, 0.0)
    return says


def _read(shot: Shot, level: int) -> Float32s:
    """Return square roots of a picture's light at a level, and their slopes (height, width, 9); NaN: none."""
    first, width, height = shot.levels.sizes[min(level, len(shot.levels.sizes) - 1)].tolist()
    pixels = shot.levels.pixels[first : first + width * height].reshape(height, width, 4)
    with np.errstate(all="ignore"):
        light = np.sqrt(np.maximum(pixels[..., :3] / pixels[..., 3:], 0))
    light[pixels[..., 3] < 0.5] = np.nan
    wide = np.pad(light, ((1, 1), (1, 1), (0, 0)), mode="edge")
    right, down = (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2
    return np.concatenate([light, right, down], axis=2)


def _seen(picture: Float32s, camera: Camera, points: Float64s, gains: Float32s) -> tuple[Float64s, Float64s]:
    """Return what a picture shows of points (n, 3), and how that changes with the camera's numbers."""
    height, width = picture.shape[:2]
    pixels, _ = camera.project(points)
    places = pixels * [width / camera.width, height / camera.height] - 0.5
    inside = ((places >= 0) & (places <= [width - 1, height - 1])).all(axis=1)
    i, j = np.where(inside[:, None], np.floor(np.nan_to_num(places)), 0).astype(np.int64).T
    i, j = np.minimum(i, max(width - 2, 0)), np.minimum(j, max(height - 2, 0))
    u, v = np.where(inside[:, None], places - np.column_stack([i, j]), 0.0).T[..., None]
    k, m = np.minimum(i + 1, width - 1), np.minimum(j + 1, height - 1)
    read = (picture[j, i] * (1 - u) + picture[j, k] * u) * (1 - v)
    read = read + (picture[m, i] * (1 - u) + picture[m, k] * u) * v
    read = np.where(inside[:, None], read, np.nan) * np.tile(np.sqrt(gains), 3)
    slopes = np.empty((len(points), 3, _NUMBERS))
    for number in range(_NUMBERS):
        step = np.zeros(_NUMBERS)
        step[number] = _TRIAL
        there, _ = _moved(camera, step, points).project(points)
        moved = (there - pixels) * [width / camera.width, height / camera.height] / _TRIAL
        slopes[..., number] = read[:, 3:6] * moved[:, :1] + read[:, 6:] * moved[:, 1:]
    return read[:, :3], slopes


def _moved(camera: Camera, numbers: Float64s, points: Float64s) -> Camera:
    """Return a camera turned and moved so that points shift by so many pixels, and zoomed likewise."""
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    view = camera.world_to_camera.copy()
    depth = float(np.median(points @ view[2, :3] + view[2, 3]))
    is_pinhole = camera.projection == "pinhole"
    pixel = abs(depth) / focal if is_pinhole else 1.0 / focal
    turn = _rotation(numbers[:3] / (focal if is_pinhole else max(camera.width, camera.height)))
    view[:3] = turn @ view[:3]
    view[:3, 3] += numbers[3:6] * pixel
    K = camera.K.copy()
    K[:2, :2] *= np.exp(numbers[6] / (max(camera.width, camera.height) / 2))
    return replace(camera, world_to_camera=view, K=K)


def _rotation(angles: Float64s) -> Float64s:
    """Return the matrix (3, 3) of a rotation about a vector, by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(angles))
    x, y, z = angles / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    found: Float64s = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return found
