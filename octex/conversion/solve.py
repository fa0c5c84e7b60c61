"""The least-squares problem of a brick: the leaf values that fit the samples best, in the type's range.

It minimizes Σ wₛ (F(xₛ) − bₛ)² + λ Σ dᵢ (cᵢ − meanᵢ)², dᵢ = Σ wₛ aₛᵢ², by coordinate descent: the best value
of one leaf with all others fixed, clamped, then the next leaf. A step updates the residuals of the samples
that the leaf weighs in. Clamping in each step finds the minimum inside the range; clamping afterwards misses
it by up to 3 dB. In the last sweeps values are rounded to *stored* numbers, and the next leaves make up for a
leaf's rounding (5 dB in 8 bits, where the source is smooth).
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int32s, Int64s, Uint8s
from octex.channels import ColorSpace, decode_table
from octex.jit import add_to_rows, inlined, kernel, part, weighted_rows
from octex.jit.vectors import eight, eight_at, lanes

#: λ: keeps leaves that hardly weigh in the samples near their means.
SHRINK = np.float32(0.01)
#: Leaves can show their samples below the first share of remaining variance; they cannot above the second.
_SHOWN, _HIDDEN = np.float32(0.05), np.float32(0.15)
#: Steps ignore smaller weights, the first residuals do not: 6 of 13 weights a sample remain, with 99.7 % of
#: the squares.
LEAST_WEIGHT = np.float32(0.03)
#: sRGB's curve is nearly √(light + 0.0015): the slopes at 0 are equal, at 1 they are 0.50 and 0.44.
_DARK = np.float32(0.0015)
#: Samples of a leaf count as equal below this difference relative to the largest: two steps of float16.
_SAME = np.float32(2.0**-10)
_BINS = 4096
_ZERO = np.float32(0)


class Equations(NamedTuple):
    """The samples that each unknown leaf weighs in, and its weights there."""

    starts: Int64s  # (unknowns + 1,)
    samples: Int32s
    weights: Float32s


class Rounding(NamedTuple):
    """The stored numbers that the last sweeps round to."""

    values: Float32s  # (256,)   decoded, rising; none: values are not rounded
    middles: Float32s  # (256,)   between each and the next, infinity at the end
    guesses: Uint8s  # (bins + 1,)   the first of at most two codes in each bin of the range

    @classmethod
    @cache
    def of_bytes(cls, space: ColorSpace) -> Rounding:
        """Return the values of 8 bits in a colour space."""
        values = decode_table("uint8", space)
        middles = np.append((values[:-1] + values[1:]) / 2, np.inf).astype(np.float32)
        edges = values[0] + np.arange(_BINS + 1) * ((values[-1] - values[0]) / np.float32(_BINS))
        return cls(values, middles, np.searchsorted(middles, edges, side="right").astype(np.uint8))


#: Leaves values as they are.
NO_ROUNDING = Rounding(np.empty(0, np.float32), np.empty(0, np.float32), np.empty(0, np.uint8))


@kernel
def transpose(starts: Int64s, leaves: Int32s, weights: Float32s, unknowns: int) -> Equations:
    """List taps by unknown instead of by sample, without small weights and leaves that are not unknowns."""
    large_starts = np.zeros(starts.size, np.int64)
    large_leaves = np.empty(leaves.size, np.int32)
    large_weights = np.empty(leaves.size, np.float32)
    count = 0
    for sample in range(starts.size - 1):
        for i in range(starts[sample], starts[sample + 1]):
            large_leaves[count] = leaves[i]
            large_weights[count] = weights[i]
            count += (leaves[i] < unknowns) & (weights[i] >= LEAST_WEIGHT)
        large_starts[sample + 1] = count
    return by_unknown(large_starts, large_leaves[:count], large_weights[:count], unknowns)


@part
def by_unknown(starts: Int64s, leaves: Int32s, weights: Float32s, unknowns: int) -> Equations:
    """List taps by unknown, in the samples' order, instead of by sample."""
    firsts = np.zeros(unknowns + 2, np.int64)
    for i in range(leaves.size):
        firsts[np.uint64(leaves[np.uint64(i)]) + np.uint64(2)] += 1
    for i in range(unknowns):
        firsts[i + 2] += firsts[i + 1]
    samples = np.empty(leaves.size, np.int32)
    sorted_weights = np.empty(leaves.size, np.float32)
    for sample in range(starts.size - 1):
        for i in range(np.uint64(starts[sample]), np.uint64(starts[sample + 1])):
            after = np.uint64(leaves[i]) + np.uint64(1)
            row = np.uint64(firsts[after])
            firsts[after] += 1
            samples[row] = sample
            sorted_weights[row] = weights[i]
    return Equations(firsts[: unknowns + 1], samples, sorted_weights)


@inlined
def _secant(target: np.float32, value: np.float32) -> np.float32:
    """Weight with which (value − target)² has the gradient of the square on sRGB's curve.

    It is the curve's slope at the value, times the slope of the secant to the target; less from 1 on, where
    the curve becomes a logarithm. (Slopes at the target alone misjudge a hard edge by up to 8 dB.)
    """
    target, value = np.float32(max(target, _ZERO)), np.float32(max(value, _ZERO))
    root = np.sqrt(value + _DARK)
    slopes = np.float32(0.5) / (root * (root + np.sqrt(target + _DARK)))
    return np.float32(slopes * min(np.float32(1), np.float32(4) * slopes))


@inlined
def write_residual(
    value: tuple[np.float32, np.float32, np.float32],
    targets: Float32s,
    weight: np.float32,
    components: int,
    is_light: int,
    sample: int,
    rows: Float32s,
) -> None:
    """Write a sample's row of `residuals`; ``weight`` is its share."""
    x, y, z = value
    a, b, c = targets[sample, 0], targets[sample, 1], targets[sample, 2]
    if is_light:
        slope = _secant(x, x)
        if components > 1:
            slope += _secant(y, y)
        if components > 2:
            slope += _secant(z, z)
        weight *= slope
    rows[sample, 0] = weight * (x - a)
    rows[sample, 1] = weight * (y - b)
    rows[sample, 2] = weight * (z - c)
    rows[sample, 3] = weight


@kernel
def residuals(
    starts: Int64s,
    leaves: Int32s,
    weights: Float32s,
    values: Float32s,
    targets: Float32s,
    shares: Float32s,
    components: int,
    is_light: int,
) -> Float32s:
    """Return (samples, 4): the weighted residuals of up to three components, and the weight.

    ``values`` (leaves, 4) and ``targets`` (samples, 4) have zeros where there is no component. The weight is
    the sample's share, times the squared slope of sRGB's curve at the field's value if ``is_light``.
    """
    rows = np.empty((starts.size - 1, 4), np.float32)
    for sample in range(starts.size - 1):
        x, y, z, _ = weighted_rows(values, leaves, weights, starts[sample], starts[sample + 1])
        write_residual((x, y, z), targets, shares[sample], components, is_light, sample, rows)
    return rows


@kernel
def weigh(equations: Equations, rows: Float32s, targets: Float32s, shares: Float32s, components: int) -> None:
    """Weigh light as on sRGB's curve, in the ``rows`` of residuals whose weights are its slope's square.

    A sample that the leaves around it can show weighs by the curve between it and the field. Detail that they
    cannot show must keep its mean light: there dark and bright samples get equal weights, the mean weight
    around these leaves. The share of the samples' variance that remains decides between the two.
    """
    starts, samples, weights = equations
    inputs = np.empty((shares.size, 8), np.float32)  # weight, share; share times missed, square, light
    sums = np.empty((shares.size, 4), np.float32)  # of mean weights, of remaining parts, of leaf weights; 1
    for n in range(shares.size):
        share, weight = shares[n], rows[n, 3]
        inverse = np.float32(1) / weight if weight > _ZERO else _ZERO
        missed = square = _ZERO
        for column in range(3):
            target = targets[n, column]
            square += target * target
            missed += rows[n, column] * rows[n, column]
            inputs[n, 4 + column] = share * target
            sums[n, column] = _ZERO
        missed *= inverse * inverse
        inputs[n, 0], inputs[n, 1], inputs[n, 7] = weight, share, _ZERO
        inputs[n, 2], inputs[n, 3] = share * missed, share * square
        sums[n, 3] = np.float32(1)
    for leaf in range(starts.size - 1):
        first, end = starts[leaf], starts[leaf + 1]
        total = eight(_ZERO)
        for i in range(first, end):
            total = total + eight(weights[i]) * eight_at(inputs, np.int64(samples[i]) << 3)
        weight, share, missed, square, x, y, z, _ = lanes(total)
        if share > _ZERO:
            variance = square - (x * x + y * y + z * z) / share
            part = missed / variance if variance > missed else np.float32(1)
            add_to_rows(sums, samples, weights, first, end, (weight / share, part, np.float32(1), _ZERO))
    for n in range(shares.size):
        weight, total = rows[n, 3], sums[n, 2]
        if not (weight > _ZERO and total > _ZERO):
            continue
        part = (sums[n, 1] / total - _SHOWN) / (_HIDDEN - _SHOWN)
        part = min(max(part, _ZERO), np.float32(1))
        slope = _ZERO
        for column in range(components):
            target = targets[n, column]
            slope += _secant(target, target + rows[n, column] / weight)
        factor = shares[n] * (slope + part * (sums[n, 0] / total - slope)) / weight
        for column in range(4):
            rows[n, column] *= factor


@kernel
def diagonal(equations: Equations, rows: Float32s, targets: Float32s) -> tuple[Float32s, Bools]:
    """Return dᵢ of each unknown, and whether all its samples are equal."""
    starts, samples, weights = equations
    sums = np.empty(starts.size - 1, np.float32)
    is_flat = np.empty(starts.size - 1, np.bool_)
    for leaf in range(starts.size - 1):
        total = np.float32(0)
        low_x = low_y = low_z = np.float32(np.inf)
        high_x = high_y = high_z = np.float32(-np.inf)
        for i in range(starts[leaf], starts[leaf + 1]):
            sample, weight = np.uint64(samples[i]), weights[i]
            total += weight * weight * rows[sample, 3]
            x, y, z = targets[sample, 0], targets[sample, 1], targets[sample, 2]
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            low_z, high_z = min(low_z, z), max(high_z, z)
        sums[leaf] = total
        is_flat[leaf] = (
            high_x - low_x <= _SAME * max(abs(low_x), abs(high_x))
            and high_y - low_y <= _SAME * max(abs(low_y), abs(high_y))
            and high_z - low_z <= _SAME * max(abs(low_z), abs(high_z))
        )
    return sums, is_flat


@kernel
def approach(equations: Equations, rows: Float32s, values: Float32s) -> None:
    """Move each unknown's ``values`` (leaves, 4) by its samples' mean residual.

    This removes the rounding of stored means at once. Sweeps that start with this error in every leaf
    overshoot first, and need several more sweeps to settle.
    """
    starts, samples, weights = equations
    for leaf in range(starts.size - 1):
        x, y, z, total = weighted_rows(rows, samples, weights, starts[leaf], starts[leaf + 1])
        if total > _ZERO:
            values[leaf, 0] -= x / total
            values[leaf, 1] -= y / total
            values[leaf, 2] -= z / total


@inlined
def _rounded(
    value: np.float32, mean: np.float32, codes: Rounding, scale: np.float32, is_flat: bool
) -> np.float32:
    values = codes.values
    guess = int(codes.guesses[int((value - values[0]) * scale)])
    code = guess + (value >= codes.middles[guess])
    if is_flat and values[max(code - 1, 0)] <= mean <= values[min(code + 1, values.size - 1)]:
        return mean
    return np.float32(values[code])


@kernel
def sweep(
    equations: Equations,
    rows: Float32s,
    sums: Float32s,
    is_flat: Bools,
    means: Float32s,
    components: int,
    low: float,
    high: float,
    codes: Rounding,
    is_backward: int,
    values: Float32s,
) -> None:
    """Improve each unknown's ``values`` (leaves, 4) in turn, and ``rows`` with them.

    With ``codes`` they become stored numbers. Then leaves with equal samples stay at their means if these are
    less than two codes away: other leaves' rounding must not disturb them.
    """
    starts, samples, weights = equations
    is_rounding = codes.values.size > 0
    least, most, zero = np.float32(low), np.float32(high), _ZERO
    scale = np.float32(_BINS / (high - low))
    last = starts.size - 2
    for n in range(starts.size - 1):
        leaf = last - n if is_backward else n
        first, end = starts[leaf], starts[leaf + 1]
        if not sums[leaf] > zero:
            continue
        a, b, c = values[leaf, 0], values[leaf, 1], values[leaf, 2]
        x, y, z = a, b, c
        if not (is_rounding and is_flat[leaf]):
            u, v, w, _ = weighted_rows(rows, samples, weights, first, end)
            pull = SHRINK * sums[leaf]
            inverse = np.float32(1) / (sums[leaf] + pull)
            x -= (u + pull * (a - means[leaf, 0])) * inverse
            y -= (v + pull * (b - means[leaf, 1])) * inverse
            z -= (w + pull * (c - means[leaf, 2])) * inverse
        x = min(max(x, least), most)
        y = min(max(y, least), most)
        z = min(max(z, least), most)
        if is_rounding:
            x = _rounded(x, means[leaf, 0], codes, scale, is_flat[leaf])
            y = _rounded(y, means[leaf, 1], codes, scale, is_flat[leaf])
            z = _rounded(z, means[leaf, 2], codes, scale, is_flat[leaf])
        y = y if components > 1 else zero
        z = z if components > 2 else zero
        if x == a and y == b and z == c:
            continue
        values[leaf, 0], values[leaf, 1], values[leaf, 2] = x, y, z
        add_to_rows(rows, samples, weights, first, end, (x - a, y - b, z - c, zero))


@kernel
def covered(starts: Int64s, leaves: Int32s, weights: Float32s, coverage: Float32s) -> Float32s:
    """Return the weights times the leaves' coverage, scaled to sum 1 for each sample with coverage."""
    scaled = np.empty(weights.size, np.float32)
    for sample in range(starts.size - 1):
        total = np.float32(0)
        for i in range(starts[sample], starts[sample + 1]):
            scaled[i] = weights[i] * coverage[leaves[i]]
            total += scaled[i]
        for i in range(starts[sample], starts[sample + 1]):
            scaled[i] = scaled[i] / total if total > np.float32(0) else weights[i]
    return scaled
