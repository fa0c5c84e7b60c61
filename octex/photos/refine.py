"""Refines cameras that are slightly off, until their images agree on the surface.

All images are read at points of the surface, from coarse to fine. Each camera turns, moves and zooms
a little (Gauss-Newton steps), so that images differ least from the consensus at each point. Outliers weigh
less; what only one image saw is masked once the coarsest level agrees (Zhou & Koltun, "Color Map
Optimization", 2014, for all cameras at once, undoing steps that make it worse). A camera stays if its image
has too little detail.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s, Int64s
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR
from octex.checks import as_choice, as_whole
from octex.conversion.large import Stages, stages_in
from octex.errors import ArgumentError
from octex.jit import kernel
from octex.painting.image import (
    Mips,
    Projection,
    check_projections,
    content_of,
    falloff_at,
    mips_of,
    room_for,
)
from octex.painting.project import Projected, most_ahead, order_key
from octex.painting.reading import Shot
from octex.painting.surface import BALANCES, Balance, PaintedSurface, key_of
from octex.parallel import Progress, Run, as_run, ordered_map, workers
from octex.photos.agreement import agreeing
from octex.photos.balance import balanced
from octex.photos.consensus import agreed_step, consensus, few_at, robust_weights
from octex.source.surface import Surface, as_surface
from octex.view.visibility import straight, view_of

#: Numbers of a camera that change: turns about three axes, moves along them, zoom.
NUMBERS = 7
#: Step in pixels of the numerical derivatives.
_TRIAL = 1e-3
#: Points of the surface. The coarsest level compares _COARSE of them. Finer levels, and the final check, use
#: those where an image has the most detail: _TELLING per image, _MOST in all.
_POINTS, _COARSE, _TELLING, _MOST = 240_000, 10_000, 3_200, 80_000
#: More images than this use fewer points, in inverse proportion, but at least this part.
_FEW, _LEAST = 12, 0.25
#: Mip levels, coarse to fine, and tries on each.
_LEVELS, _TRIES = (2, 1, 0), 24
#: A level ends with a step in which no number changes by this many pixels.
_STILL = 0.005
#: Difference of square roots of light from which an image weighs less: at the finest level, and more at
#: each coarser one, where misplaced images differ most at the edges that show it.
_FAR = 0.1
#: Within this many pixels of the surface's end images mix with the background.
_RIM = 2.0
#: Expected error of cameras in pixels, of square roots of light, and the part of points that are informative.
_OFF, _NOISE, _OWN = 4.0, 0.02, 0.01
#: Relative damping of a step, and its factors after a good and a bad step.
_DAMPING, _RIGHT, _WRONG = 1e-4, 0.2, 10.0
#: A camera changes if its image's difference from the others, 0 to 1, falls to this part and by this much.
_BETTER, _BY = 0.7, 0.002


def refine_cameras(
    surface: Surface,
    projections: Projection | Sequence[Projection],
    *,
    balance: Balance | None = "gain",
    reference: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> list[Camera]:
    """Turn, move and zoom cameras by a few pixels until their images agree, and return the new cameras.

    surface      the model; cameras see its posed positions
    projections  images with cameras, in any order and exposure
    balance      how exposures are matched before images are compared, as for ``paint``
    reference    number of the image whose camera does not change. Default: the one that overlaps most with
                 others
    run          how to work (octex.Run)

    A camera stays unchanged unless its image then agrees clearly better with the others.

    Raises ArgumentError and ImageError as ``paint`` does.
    """
    shown = check_projections(projections)
    if balance is not None:
        as_choice(balance, BALANCES, "balance")
    if reference is not None:
        reference = as_whole(reference, "reference", 0, len(shown) - 1)
    cameras = [each.camera for each in shown if isinstance(each.camera, Camera)]
    if len(cameras) < len(shown):
        raise ArgumentError("a patch cannot be refined; give images with cameras")
    painted = PaintedSurface(as_surface(surface))
    run = as_run(run, threads, progress, "memory", "folder", "resume")
    if len(shown) == 1:
        return cameras
    stages = stages_in(run.resume)
    stored = stages.of(
        lambda: [painted.content, [*map(content_of, shown), *map(key_of, cameras)], balance, reference]
    )
    with workers(run) as pool, room_for(shown, run):

        def refined() -> dict[str, Array]:
            refined_cameras = _refined(painted, shown, cameras, balance, reference, pool, run.report, stages)
            return {
                "world_to_camera": np.stack([each.world_to_camera for each in refined_cameras]),
                "K": np.stack([each.K for each in refined_cameras]),
            }

        arrays = stored.arrays("cameras", refined)
        return [
            replace(camera, world_to_camera=matrix, K=K)
            for camera, matrix, K in zip(cameras, arrays["world_to_camera"], arrays["K"], strict=True)
        ]


def _refined(
    painted: PaintedSurface,
    shown: Sequence[Projection],
    cameras: list[Camera],
    balance: Balance | None,
    reference: int | None,
    pool: Executor,
    report: Progress,
    stages: Stages,
) -> list[Camera]:
    """Refine cameras as `refine_cameras` does, of checked arguments."""
    surface = painted.surface
    decode = partial(mips_of, form=BASE_COLOR, stages=stages)
    mips = [stages.placed(each) for each in ordered_map(pool, decode, shown, window=most_ahead())]
    keys = [
        order_key(view_of(straight(camera)), camera.K, camera.lens, each)
        for camera, each in zip(cameras, mips, strict=True)
    ]
    order = sorted(range(len(shown)), key=keys.__getitem__)
    fixed = None if reference is None else order.index(reference)
    began, mips = [cameras[n] for n in order], [mips[n] for n in order]
    samples = surface.scatter(int(_share(len(order)) * _POINTS))
    scales = [pixel_at(camera, samples.points) for camera in began]
    cameras, numbers = list(began), np.zeros((len(order), NUMBERS))
    stays = np.zeros(len(order), np.bool_) if reference is None else np.array(order) == reference

    def lit(cameras: list[Camera], balance: Balance | None) -> Projected:
        source = painted.comparable(cameras, mips, _RIM * 2 ** max(_LEVELS), pool)
        return source if balance is None else balanced(source, surface, balance, fixed)

    def observed(cameras: list[Camera], level: int, balance: Balance | None) -> Observations:
        source = lit(cameras, balance)
        weights = _weights_at(source, samples.triangles, samples.barycentric, _RIM * 2**level)
        images = [shot.mips for shot in source.shots]
        lights = [(shot.gains, shot.falloff) for shot in source.shots]
        return Observations(began, scales, samples.points, images, level, lights, weights)

    for done, level in enumerate(_LEVELS):
        report("refine", done, len(_LEVELS))
        seen = observed(cameras, level, balance)
        if not stays.any():
            stays[np.argmax((seen.weights * (seen.weights > 0).sum(axis=0)).sum(axis=1))] = True
        far = _FAR * (level + 1)
        every = np.arange(0, len(samples.points), len(samples.points) // _COARSE)
        chosen = _telling(seen, numbers, far) if done else every
        numbers = _agreeing(seen.at(chosen), numbers, stays, far)
        cameras = [adjusted(*each) for each in zip(began, scales, numbers, strict=True)]
        if done == 0:  # only now images lie well enough on each other to mask what one of them saw
            mips = [shot.mips for shot in agreeing(lit(cameras, balance), surface, pool).shots]
    light: Balance | None = balance and "full"
    before, after = observed(began, 0, light), observed(cameras, 0, light)
    chosen = np.union1d(_telling(before, 0 * numbers, _FAR), _telling(after, numbers, _FAR))
    is_better = _better(before.at(chosen), after.at(chosen), numbers) & ~stays
    cameras = [each[1 if moves else 0] for *each, moves in zip(began, cameras, is_better, strict=True)]
    report("refine", len(_LEVELS), len(_LEVELS))
    by_number = dict(zip(order, cameras, strict=True))
    return [by_number[number] for number in range(len(shown))]


def _share(images: int) -> float:
    """Return the part of the points that this many images are compared at."""
    return max(min(_FEW / images, 1.0), _LEAST)


def _telling(observed: Observations, numbers: Float64s, far: float) -> Int64s:
    """Return the points that tell most about the cameras, equally many for each image that agrees."""
    values, steep = np.full((2, *observed.weights.shape, 3), np.nan)
    for n, sees in enumerate(observed.weights > 0):
        values[n, sees], slopes = observed.seen_by(n, numbers[n])
        steep[n, sees] = (slopes**2).sum(axis=2)
    weights = np.repeat(observed.weights, 3, axis=1) * np.isfinite(values).reshape(len(values), -1)
    robust = _robust(np.nan_to_num(values).reshape(weights.shape), weights, far)
    tells = (robust.reshape(values.shape) * np.nan_to_num(steep)).sum(axis=2)
    each = max(int(_share(len(tells)) * min(_TELLING, _MOST / len(tells))), 1)
    order = np.argsort(-tells, axis=1, kind="stable")[:, :each]
    is_chosen = np.zeros(tells.shape, np.bool_)
    np.put_along_axis(is_chosen, order, np.take_along_axis(tells, order, axis=1) > 0, axis=1)
    return np.flatnonzero(is_chosen.any(axis=0))


def _agreeing(observed: Observations, numbers: Float64s, stays: Bools, far: float) -> Float64s:
    """Return the cameras' numbers for which images agree best (Levenberg-Marquardt)."""
    values, slopes = observed.seen(numbers)
    weights = np.repeat(observed.weights, 3, axis=1) * np.isfinite(values)
    _, far = robust_weights(np.nan_to_num(values), weights, far)
    held = np.full(numbers.shape, (_NOISE / _OFF) ** 2 / _OWN)

    def cost(values: Float64s, numbers: Float64s) -> float:
        off = float((weights * _apart(values, weights, far)).sum())
        return far**2 * off + float((held * numbers**2).sum())

    least, damping = cost(values, numbers), _DAMPING
    for _ in range(_TRIES):
        known = np.nan_to_num(values)
        robust = _robust(known, weights * np.isfinite(values), far)
        ridge = held + damping * np.einsum("in,inp->ip", robust, slopes**2).max(axis=1, keepdims=True)
        ridge[stays] = np.inf
        step = agreed_step(slopes, known, robust, ridge, held * numbers)
        tried = observed.seen(numbers + step)
        now = cost(tried[0], numbers + step)
        if now < least:
            least, numbers, (values, slopes), damping = now, numbers + step, tried, damping * _RIGHT
        else:
            damping *= _WRONG
        if np.abs(step).max() < _STILL:
            break
    return numbers


def _robust(values: Float64s, weights: Float64s, far: float) -> Float64s:
    """Return weights that fall with the distance from the consensus (Geman & McClure)."""
    return weights / (1.0 + ((values - _middle(values, weights, far)) / far) ** 2) ** 2


def _middle(values: Float64s, weights: Float64s, far: float) -> Float64s:
    """Return the robust consensus of points (n,)."""
    robust, _ = robust_weights(values, weights, far)
    return consensus(values, robust)


def _apart(values: Float64s, weights: Float64s, far: float) -> Float64s:
    """Return the distances from the consensus, 0 to 1 (images, n); 1 outside the image."""
    known = np.isfinite(values)
    values = np.where(known, values, 0.0)
    apart = ((values - _middle(values, weights * known, far)) / far) ** 2
    return np.where(known, apart / (1.0 + apart), 1.0)


def _better(before: Observations, after: Observations, numbers: Float64s) -> Bools:
    """Return which images agree clearly better with the others after refinement than before.

    A point weighs by the derivative of its colour. First come cameras that improve among refined others and
    on the state before; then those that improve among these.
    """
    (old, old_slopes), (new, new_slopes) = before.seen(np.zeros_like(numbers)), after.seen(numbers)
    weights = np.repeat(np.minimum(before.weights, after.weights), 3, axis=1) * np.isfinite(old)
    weights *= (weights > 0).sum(axis=0) > 1
    tells = weights * np.sqrt((old_slopes**2 + new_slopes**2).sum(axis=2))

    def apart(values: Float64s, number: int) -> float:
        return float((tells[number] * _apart(values, weights, _FAR)[number]).sum())

    is_better = np.zeros(len(numbers), np.bool_)
    others = np.ones_like(is_better)  # cameras taken as refined
    while True:
        better = is_better.copy()
        for n in np.flatnonzero(~is_better).tolist():
            values = np.where((others | is_better)[:, None], new, old)
            refined = values.copy()
            values[n], refined[n] = old[n], new[n]
            least = apart(values, n) if is_better.any() else min(apart(values, n), apart(old, n))
            better[n] = apart(refined, n) < min(_BETTER * least, least - _BY * float(tells[n].sum()))
        if (better == is_better).all():
            return is_better
        is_better, others = better, np.zeros_like(is_better)


def _weights_at(source: Projected, triangles: Int32s, barycentric: Float64s, rim: float) -> Float64s:
    """Return how well images see points (images, n), 0 to 1; 0 within ``rim`` of the surface's end.

    Only few images see a point: see `few_at`.
    """
    _, seen = source.each(triangles, barycentric, source.widths(triangles, barycentric))
    points = source.positions(triangles, barycentric)
    for shot, weights in zip(source.shots, seen, strict=True):
        weights *= _margins(shot, points) >= rim
    share = seen / np.maximum(seen.max(axis=0), 1e-30)
    return few_at(np.where((seen > 0).sum(axis=0) > 1, share.astype(np.float64), 0.0))


def _margins(shot: Shot, points: Float64s) -> Float64s:
    """Return the distances in pixels of points (n, 3) from the surface's end."""
    height, width = shot.margins.shape
    x, y, z = shot.camera.world_to_camera[:3, :3] @ points.T + shot.camera.world_to_camera[:3, 3:]
    if not shot.camera.is_pinhole:
        z = np.ones_like(z)
    with np.errstate(all="ignore"):
        places = (np.linalg.inv(shot.camera.inverse_k) @ np.stack([x / z, y / z, np.ones_like(z)]))[:2]
    ends = np.array([[width - 1], [height - 1]])
    j, i = np.clip(np.nan_to_num(places), 0, ends).astype(np.int64)
    margins: Float64s = shot.margins[i, j].astype(np.float64)
    return margins


class Observations(NamedTuple):
    """Images at a mip level, and which points each sees."""

    cameras: Sequence[Camera]  # unrefined
    scales: Sequence[float]  # see `pixel_at`
    points: Float64s  # (n, 3)
    images: Sequence[Mips]
    level: int
    lights: Sequence[tuple[Float32s, Float64s]]  # gains and falloff, as in Shot
    weights: Float64s  # (images, n)   how well an image sees a point

    def at(self, chosen: Int64s) -> Observations:
        """Keep only the chosen points."""
        return self._replace(points=self.points[chosen], weights=self.weights[:, chosen])

    def seen_by(self, n: int, numbers: Float64s) -> tuple[Float64s, Float64s]:
        """Return an image's values at the points that it sees (k, 3), and their derivatives by numbers."""
        image, camera, (gains, falloff) = self.images[n], self.cameras[n], self.lights[n]
        points = self.points[self.weights[n] > 0]
        level = min(self.level, len(image.sizes) - 1)
        size = image.sizes[level, 1:] / [camera.width, camera.height]
        pixels, _ = adjusted(camera, self.scales[n], numbers).project(points)
        read = np.empty((len(points), 9))
        _read(image.pixels, image.sizes[level], falloff, pixels * size, read)
        read *= np.tile(np.sqrt(gains), 3)
        slopes = np.empty((len(points), 3, NUMBERS))
        for number in range(NUMBERS):
            step = numbers.copy()
            step[number] += _TRIAL
            there, _ = adjusted(camera, self.scales[n], step).project(points)
            shift = (there - pixels) * size / _TRIAL
            slopes[..., number] = read[:, 3:6] * shift[:, :1] + read[:, 6:] * shift[:, 1:]
        return read[:, :3], slopes

    def seen(self, numbers: Float64s) -> tuple[Float64s, Float64s]:
        """Return the images' values (images, n · 3), and their derivatives by the cameras' numbers."""
        values = np.full((*self.weights.shape, 3), np.nan)
        slopes = np.zeros((*values.shape, NUMBERS))
        for n, sees in enumerate(self.weights > 0):
            values[n, sees], slopes[n, sees] = self.seen_by(n, numbers[n])
        return values.reshape(len(values), -1), np.nan_to_num(slopes).reshape(len(slopes), -1, NUMBERS)


@kernel
def _read(pixels: Float32s, size: Int64s, falloff: Float64s, places: Float64s, values: Float64s) -> None:
    """Write square roots of light at places (n, 2), bilinear, and slopes (n, 9); NaN outside or unpainted."""
    first, width, height = size[0], size[1], size[2]
    light = np.empty((4, 4, 3))
    for n in range(len(places)):
        values[n] = np.nan
        x, y = places[n, 0] - 0.5, places[n, 1] - 0.5
        if not (0.0 <= x <= width - 1 and 0.0 <= y <= height - 1):
            continue
        left, top = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        for i in range(4):
            row = first + min(max(top + i - 1, 0), height - 1) * width
            for j in range(4):
                pixel = pixels[row + min(max(left + j - 1, 0), width - 1)]
                for k in range(3):
                    light[i, j, k] = np.nan
                    if pixel[3] >= np.float32(0.5):
                        light[i, j, k] = np.sqrt(max(pixel[k] / pixel[3], np.float32(0.0)))
        u, v = x - left, y - top
        factor = np.sqrt(falloff_at(falloff, width, height, x + 0.5, y + 0.5))
        for k in range(9):
            values[n, k] = 0.0
        for i in range(1, 3):
            for j in range(1, 3):
                weight = (u if j == 2 else 1.0 - u) * (v if i == 2 else 1.0 - v) * factor
                for k in range(3):
                    values[n, k] += weight * light[i, j, k]
                    values[n, k + 3] += weight * 0.5 * (light[i, j + 1, k] - light[i, j - 1, k])
                    values[n, k + 6] += weight * 0.5 * (light[i + 1, j, k] - light[i - 1, j, k])


def pixel_at(camera: Camera, points: Float64s) -> float:
    """Return the width of a camera's pixel at the median depth of points (n, 3)."""
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    depths = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    return (abs(float(np.median(depths))) if camera.projection == "pinhole" else 1.0) / focal


def adjusted(camera: Camera, scale: float, numbers: Float64s) -> Camera:
    """Turn, move and zoom a camera so that points shift by ``numbers`` pixels of width ``scale``."""
    size = max(camera.width, camera.height)
    view = camera.world_to_camera.copy()
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])) if camera.projection == "pinhole" else size
    view[:3] = _rotation(numbers[:3] / focal) @ view[:3]
    view[:3, 3] += numbers[3:6] * scale
    K = camera.K.copy()
    K[:2, :2] *= np.exp(numbers[6] / (size / 2))
    return replace(camera, world_to_camera=view, K=K)


def _rotation(angles: Float64s) -> Float64s:
    """Return the matrix (3, 3) of a rotation about a vector whose length is its angle (Rodrigues)."""
    angle = float(np.linalg.norm(angles))
    x, y, z = angles / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64s = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation
