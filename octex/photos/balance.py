"""Pictures that overlap made to agree: gains, white balance and vignetting of each."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s
from octex.cameras.lens import distort
from octex.jit import kernel
from octex.painting.options import Balance
from octex.painting.picture import Mips
from octex.painting.project import Projected
from octex.painting.sight import Shot
from octex.photos.consensus import agreed_step, robust_weights
from octex.source.surface import Surface

#: Points of the surface that pictures are compared at.
_POINTS = 10_000
#: Over how many pixels they are read there: what is a pixel out of place matters less.
_WIDTH = 6.0
#: Values that tell of no gain: too dark, or cut off.
_DARKEST, _LIGHTEST = 0.004, 0.97
#: Rounds of least squares, and from what difference of logarithms on a picture may count for less.
_ROUNDS, _FAR = 10, 0.02
#: No lens makes corners darker, or brighter, by more than three stops: that much is what the pictures show.
_MOST = np.log(8.0)
#: How strongly, for each point, vignetting is held at none, and gains at one.
_HOLD, _HOLD_GAIN = 1e-4, 1e-9


def balanced(
    source: Projected, surface: Surface, balance: Balance, reference: int | None, executor: Executor
) -> Projected:
    """Return the same paint with pictures that agree best where more than one sees the surface.

    Robust least squares of logarithms of light, on top of the gains that there are already. The shot
    ``reference`` keeps its gain; without one the median of the gains is 1. Pictures that overlap no other
    keep theirs.
    """
    numbers = exposures(source, surface, balance, reference)
    gains = np.stack([shot.gains for shot in source.shots]) * np.exp(numbers[:, :3]).astype(np.float32)

    def lit(number: int) -> Mips:
        mips, vignetting = source.shots[number].mips, numbers[number, 3:]
        return evened(mips, vignetting) if vignetting.any() else mips

    pairs = zip(source.with_mips(lit, executor).shots, gains, strict=True)
    return source.with_shots([shot._replace(gains=own) for shot, own in pairs])


def exposures(source: Projected, surface: Surface, balance: Balance, reference: int | None) -> Float64s:
    """Return what to add to the logarithms of pictures (pictures, 5): three components; times r², and r⁴.

    r is the distance from the picture's middle, 1 in its corners.
    """
    samples = surface.scatter(_POINTS)
    where = samples.triangles, samples.barycentric
    widths = source.widths(*where)
    widths = np.where(np.isfinite(widths), widths * np.float32(_WIDTH), np.float32(0))
    paint, weights = source.each(*where, widths)
    seen = np.flatnonzero((weights > 0).sum(axis=0) > 1)
    paint, weights = paint[:, seen], weights[:, seen]
    points = source.positions(samples.triangles[seen], samples.barycentric[seen])
    squares = np.stack([_radii(shot.mips, _pixels_of(shot, points)) for shot in source.shots]) ** 2
    usable = (weights > 0)[..., None] & (paint > _DARKEST) & (paint < _LIGHTEST)
    logs = np.log(np.where(usable, paint, 1.0)).astype(np.float64).reshape(len(paint), -1)
    counted = usable.reshape(logs.shape).astype(np.float64)
    slopes = _slopes(np.repeat(squares, 3, axis=1), balance)
    hold = np.full((len(paint), slopes.shape[2]), _HOLD_GAIN)
    hold[:, 3:] = _HOLD
    found = _agreed(logs, counted, slopes, hold)
    while balance == "full" and (no_lens := _strongest(found[:, 3:]) > _MOST).any():
        hold[no_lens, 3:] = np.inf
        found = _agreed(logs, counted, slopes, hold)
    if balance == "gain":
        found = np.concatenate([np.repeat(found, 3, axis=1), np.zeros((len(found), 2))], axis=1)
    lone = counted.sum(axis=1) == 0
    if reference is not None:
        found[:, :3] -= found[reference, :3]
    elif not lone.all():
        found[:, :3] -= np.median(found[~lone, :3], axis=0)
    found[lone] = 0.0
    return found


def _agreed(logs: Float64s, counted: Float64s, slopes: Float64s, hold: Float64s) -> Float64s:
    """Return the numbers by which logarithms of pictures agree best; those held infinitely are 0."""
    found = np.zeros_like(hold)
    for _ in range(_ROUNDS):
        values = logs + (slopes @ found[:, :, None])[..., 0]
        counts, _ = robust_weights(values, counted, _FAR)
        found += agreed_step(slopes, values, counts, hold * max(counts.sum() / len(counts), 1.0))
    return found


def _strongest(vignetting: Float64s) -> Float64s:
    """Return the most by which vignetting (n, 2) changes logarithms of light anywhere in a picture."""
    squares = np.linspace(0, 1, 33)
    found: Float64s = np.abs(vignetting @ np.stack([squares, squares**2])).max(axis=1)
    return found


def _slopes(squares: Float64s, balance: Balance) -> Float64s:
    """Return how logarithms (pictures, points · 3) change with each number."""
    if balance == "gain":
        return np.ones((*squares.shape, 1))
    component = np.arange(squares.shape[1]) % 3
    found = np.zeros((*squares.shape, 5))
    found[:, np.arange(squares.shape[1]), component] = 1.0
    found[..., 3], found[..., 4] = squares, squares**2
    return found


def _pixels_of(shot: Shot, points: Float64s) -> Float64s:
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


def _radii(mips: Mips, pixels: Float64s) -> Float64s:
    """Return how far pixel coordinates (n, 2) are from a picture's middle, 1 in its corners."""
    half = mips.sizes[0, 1:] / 2
    found: Float64s = np.linalg.norm(np.nan_to_num(pixels) - half, axis=1) / np.linalg.norm(half)
    return np.minimum(found, 1.0)


def evened(mips: Mips, vignetting: Float64s) -> Mips:
    """Return a picture times exp(a·r² + b·r⁴)."""
    pixels = np.empty_like(mips.pixels)
    a, b = vignetting.tolist()
    factors = _even(mips.pixels, mips.sizes, a, b, pixels)
    low, high = mips.range * factors[0], mips.range * factors[1]
    ends: Float32s = np.stack([np.minimum(low[0], high[0]), np.maximum(low[1], high[1])])
    return mips._replace(pixels=pixels, range=ends)


@kernel
def _even(given: Float32s, sizes: Int64s, a: float, b: float, found: Float32s) -> Float32s:
    """Write pixels times exp(a·r² + b·r⁴); return the least and the largest of these factors."""
    ends = np.array([np.inf, -np.inf], np.float32)
    corner = 0.25 * (sizes[0, 1] ** 2 + sizes[0, 2] ** 2)
    for level in range(len(sizes)):
        first, across, down = sizes[level, 0], sizes[level, 1], sizes[level, 2]
        for i in range(down):
            y = (i + 0.5 - down / 2) * sizes[0, 2] / down
            for j in range(across):
                x = (j + 0.5 - across / 2) * sizes[0, 1] / across
                square = (x * x + y * y) / corner
                factor = np.float32(np.exp(square * (a + b * square)))
                at = first + i * across + j
                for component in range(3):
                    found[at, component] = given[at, component] * factor
                found[at, 3] = given[at, 3]
                ends[0], ends[1] = min(ends[0], factor), max(ends[1], factor)
    return ends
