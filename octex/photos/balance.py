"""Makes overlapping images agree: gains, white balance, vignetting; masks where an image is clipped."""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int32s
from octex.cameras.lens import distort
from octex.painting.image import Mips
from octex.painting.project import Projected
from octex.painting.reading import Shot
from octex.painting.surface import Balance
from octex.parallel import ordered_map, sharing
from octex.photos.agreement import as_codes
from octex.photos.consensus import agreed_step, few_at, medians, robust_weights
from octex.photos.patches import batches, colors_of, grown, patches_of, put_mask, seen_at, widths_of
from octex.source.surface import Surface

#: Points of the surface at which images are compared.
_POINTS = 10_000
#: Width of the samples in pixels: a displacement of a pixel then matters less.
_WIDTH = 6.0
#: Values below and above say nothing about gains: too dark, or clipped.
_DARKEST, _LIGHTEST = 0.004, 0.97
#: Rounds of least squares; difference of logarithms from which an image counts for less.
_ROUNDS, _FAR = 10, 0.02
#: No lens changes the corners by more than three stops: more belongs to the scene.
_MOST = np.log(8.0)
#: Weights, per point, that hold vignetting at zero and gains at one.
_HOLD, _HOLD_GAIN = 1e-4, 1e-9
#: Light from which an image may be clipped: 250/255.
_CUT = 0.955
#: Others must be lighter by this much, in 1/255.
_LIGHTER = 2.0


def balanced(source: Projected, surface: Surface, balance: Balance, reference: int | None) -> Projected:
    """Return the same paint with gains for which images agree: robust least squares of log light.

    The shot ``reference``, and images that overlap no other, do not change; else the median gain is 1.
    """
    changes = exposures(source, surface, balance, reference)
    gains = np.exp(changes[:, :3]).astype(np.float32)
    return source.with_shots(
        [
            shot._replace(gains=shot.gains * gain, falloff=shot.falloff + numbers[3:])
            for shot, gain, numbers in zip(source.shots, gains, changes, strict=True)
        ]
    )


def exposures(source: Projected, surface: Surface, balance: Balance, reference: int | None) -> Float64s:
    """Return the changes of log light (images, 5): components; times r², r⁴ with r = 1 in the corners."""
    samples = surface.scatter(_POINTS)
    where = samples.triangles, samples.barycentric
    widths = source.widths(*where)
    widths = np.where(np.isfinite(widths), widths * np.float32(_WIDTH), np.float32(0))
    paint, weights = source.each(*where, widths)
    seen = np.flatnonzero((weights > 0).sum(axis=0) > 1)
    paint, compared = paint[:, seen], few_at(weights[:, seen].astype(np.float64)) > 0
    points = source.positions(samples.triangles[seen], samples.barycentric[seen])
    radii = []  # from the images' centres, 1 in the corners
    for shot in source.shots:
        half = shot.mips.sizes[0, 1:] / 2
        radii.append(
            np.linalg.norm(np.nan_to_num(_pixels_of(shot, points)) - half, axis=1) / np.linalg.norm(half)
        )
    squares = np.minimum(np.stack(radii), 1.0) ** 2
    usable = compared[..., None] & (paint > _DARKEST) & (paint < _LIGHTEST)
    logs = np.log(np.where(usable, paint, 1.0)).astype(np.float64).reshape(len(paint), -1)
    counted = usable.reshape(logs.shape).astype(np.float64)
    slopes = _slopes(np.repeat(squares, 3, axis=1), balance)
    hold = np.full((len(paint), slopes.shape[2]), _HOLD_GAIN)
    hold[:, 3:] = _HOLD
    changes = _agreed(logs, counted, slopes, hold)
    places = np.linspace(0, 1, 33)
    powers = np.stack([places, places**2])
    while balance == "full" and (no_lens := np.abs(changes[:, 3:] @ powers).max(axis=1) > _MOST).any():
        hold[no_lens, 3:] = np.inf
        changes = _agreed(logs, counted, slopes, hold)
    if balance == "gain":
        changes = np.concatenate([np.repeat(changes, 3, axis=1), np.zeros((len(changes), 2))], axis=1)
    lone = counted.sum(axis=1) == 0
    if reference is not None:
        changes[:, :3] -= changes[reference, :3]
    elif not lone.all():
        changes[:, :3] -= np.median(changes[~lone, :3], axis=0)
    changes[lone] = 0.0
    return changes


def _agreed(logs: Float64s, counted: Float64s, slopes: Float64s, hold: Float64s) -> Float64s:
    """Return the numbers for which the images' logarithms agree best; those held infinitely are 0."""
    changes = np.zeros_like(hold)
    for _ in range(_ROUNDS):
        values = logs + (slopes @ changes[:, :, None])[..., 0]
        counts, _ = robust_weights(values, counted, _FAR)
        changes += agreed_step(slopes, values, counts, hold * max(counts.sum() / len(counts), 1.0))
    return changes


def _slopes(squares: Float64s, balance: Balance) -> Float64s:
    """Return the derivatives of logarithms (images, points · 3) by each number."""
    if balance == "gain":
        return np.ones((*squares.shape, 1))
    component = np.arange(squares.shape[1]) % 3
    slopes = np.zeros((*squares.shape, 5))
    slopes[:, np.arange(squares.shape[1]), component] = 1.0
    slopes[..., 3], slopes[..., 4] = squares, squares**2
    return slopes


def _pixels_of(shot: Shot, points: Float64s) -> Float64s:
    """Return the pixel coordinates (n, 2) of posed points in a shot's image; NaN where it has none."""
    x, y, z = shot.camera.world_to_camera[:3, :3] @ points.T + shot.camera.world_to_camera[:3, 3:]
    if shot.camera.is_pinhole:
        with np.errstate(all="ignore"):
            slopes = np.column_stack([x, y]) / np.where(z > 0.0, z, np.nan)[:, None]
        places = np.empty_like(slopes)
        distort(shot.lens, np.ascontiguousarray(slopes), places)
    else:
        places = np.column_stack([x, y])
    return places @ shot.K[:2, :2].T + shot.K[:2, 2]


def without_overexposed(before: Projected, evened: Projected, executor: Executor) -> Projected:
    """Mask ``evened`` images where clipped in ``before`` and lighter in others; return their paint."""
    with sharing(executor) as pool:
        masks = list(ordered_map(pool, partial(_mask, before, evened), range(len(before.shots))))
    for shot, mask in zip(evened.shots, masks, strict=True):
        put_mask(shot.mips, mask)
    return evened


def _mask(before: Projected, evened: Projected, number: int) -> Float32s:
    """Return 0 where an image is clipped, and next to that, if others see the surface; else 1."""
    shot = before.shots[number]
    if not _is_limited(shot.mips):
        return np.ones((1, 1), np.float32)
    rows, columns = patches_of(shot)
    colors = colors_of(shot)
    is_clipped = colors[..., :3].max(axis=2) > _CUT * colors[..., 3]
    patches, triangles, barycentric = seen_at(before, shot, grown(is_clipped))
    widths = widths_of(before.with_shots([shot]), triangles, barycentric)
    is_wrong = np.zeros(rows * columns, np.bool_)
    others_see = np.ones(rows * columns, np.bool_)  # also where no centre sees the surface
    for batch in batches(len(patches), len(before.shots)):
        where = triangles[batch], barycentric[batch], widths[batch]
        is_wrong[patches[batch]], others_see[patches[batch]] = _compared(before, evened, number, *where)
    mask = ~grown(is_wrong.reshape(rows, columns)) | ~others_see.reshape(rows, columns)
    return mask.astype(np.float32)


def _compared(
    before: Projected,
    evened: Projected,
    number: int,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
) -> tuple[Bools, Bools]:
    """Say where (n,) an image is clipped and others are lighter, and where the others are not clipped."""
    where = triangles, barycentric, widths
    dark, (after, weights) = before.each(*where)[0], evened.each(*where)
    limited = np.array([_is_limited(shot.mips) for shot in before.shots])
    is_cut = limited[:, None, None] & (dark > _CUT)
    tells = (weights > 0)[..., None] & ~is_cut
    tells[number] = False
    codes = as_codes(after).astype(np.float64)
    rows = len(codes), codes[0].size
    others = medians(codes.reshape(rows), tells.reshape(rows).astype(np.float64)).reshape(codes[0].shape)
    tell = tells.any(axis=0)
    is_lighter = tell & (others > codes[number] + _LIGHTER)
    wrong: Bools = (is_lighter & is_cut[number]).any(axis=1)
    return wrong, np.all(tell, axis=1)


def _is_limited(mips: Mips) -> bool:
    """Return whether an image may be clipped; one with light above 1 is not."""
    return bool((mips.range[1] <= 1.0).all() and (mips.range[1] > _CUT).any())
