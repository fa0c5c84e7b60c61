"""Make blocks of wood and marble: colours as functions of position, from Perlin's gradient noise."""

import itertools

import numpy as np

from octex.channels import srgb_to_linear

EARLY, LATE, KNOT = srgb_to_linear(np.array([[222, 176, 118], [150, 88, 44], [92, 50, 26]]) / 255)
WHITE, CLOUD, VEIN = srgb_to_linear(np.array([[244, 241, 236], [186, 188, 194], [70, 72, 80]]) / 255)

_GRADIENTS = np.random.default_rng(0).normal(size=(4096, 3))
_GRADIENTS *= 1.5 / np.linalg.norm(_GRADIENTS, axis=1, keepdims=True)
_GRADIENTS = _GRADIENTS.astype(np.float32)
_PRIMES = (73856093, 19349663, 83492791)


def wood(points: np.ndarray) -> np.ndarray:
    """Return linear light (n, 3) at points (n, 3): rings that bend around a knot, where a branch was."""
    along, x, y = points.T  # the trunk runs along the first axis, below, and rises a little
    x, y = x + 0.2 + 0.08 * noise(points * [0.8, 1.2, 1.2]), y + 1.5 - 0.1 * along
    radius = np.hypot(x, y) + 0.04 * noise(points * [0.6, 2, 2]) + 0.005 * noise(points * 9)
    branch = np.hypot(along - 0.2, x + 0.15 * y - 0.6) / (0.1 + 0.02 * y)
    knot = np.exp(-(branch**2) / 2)
    ring = 12 * radius + 2.2 * knot + 0.12 * noise(points * [2, 8, 8])
    part = ring - np.floor(ring)
    late = part**2 * np.clip((1 - part) / 0.1, 0, 1)  # dark until the next spring
    fibres = 0.5 * noise(points * [3, 60, 60]) + 0.4 * noise(points * [6, 120, 120])
    color = EARLY + (late * (0.9 + 0.4 * fibres))[:, None] * (LATE - EARLY)
    color = color * (1 + 0.2 * fibres + 0.15 * noise(points * [0.5, 2, 2]))[:, None]
    return np.clip(color + (0.9 * np.exp(-(branch**4)))[:, None] * (KNOT - color), 0, 1)


def marble(points: np.ndarray) -> np.ndarray:
    """Return linear light (n, 3) at points (n, 3): clouds, and veins where noise passes through zero."""
    bent = points * 1.3 + 0.45 * np.stack([turbulence(points * 2 + i * 31.0) for i in range(3)], axis=1)
    clouds = np.clip(0.35 + 0.6 * turbulence(bent * 1.5 + 5), 0, 1)[:, None]
    color = WHITE + 0.8 * clouds * (CLOUD - WHITE)
    for scale, width, depth in ((1.0, 0.035, 0.85), (2.3, 0.03, 0.5)):
        near = np.exp(-np.abs(noise(bent * scale + 9 * scale)) / width)
        color = color + (depth * near)[:, None] * (VEIN - color)
    return np.clip(color, 0, 1)


def noise(points: np.ndarray) -> np.ndarray:
    """Return smooth noise (n,) about 0, mostly in −1 … 1, of waves about as long as 1, at points (n, 3)."""
    found = np.empty(len(points))
    for first in range(0, len(points), 1 << 14):  # what is at hand at once fits the cache
        found[first : first + (1 << 14)] = _noise(points[first : first + (1 << 14)])
    return found


def _noise(points: np.ndarray) -> np.ndarray:
    hashes, offsets, weights = [], [], []
    for x, prime in zip(points.T, _PRIMES, strict=True):
        cell = np.floor(x)
        part = (x - cell).astype(np.float32)
        hashes.append([(hashed := cell.astype(np.int64) * prime), hashed + prime])
        offsets.append([part, part - 1])
        weights.append([1 - (fade := part**3 * (part * (6 * part - 15) + 10)), fade])
    total = 0.0
    for i, j, k in itertools.product((0, 1), repeat=3):
        mixed = hashes[0][i] ^ hashes[1][j] ^ hashes[2][k]
        x, y, z = _GRADIENTS[(mixed ^ mixed >> 13) & 4095].T
        slope = x * offsets[0][i] + y * offsets[1][j] + z * offsets[2][k]
        total = total + weights[0][i] * weights[1][j] * weights[2][k] * slope
    return total


def turbulence(points: np.ndarray, octaves: int = 4) -> np.ndarray:
    """Return noise (n,) of several octaves, each half as high and half as long as the one before."""
    return sum(noise(points * 2**i + 17.0 * i) / 2**i for i in range(octaves))
