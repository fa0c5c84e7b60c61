"""Triangles laid flat so that angles change least: least-squares conformal maps (Lévy et al. 2002)."""

from __future__ import annotations

import numpy as np

from octex.arrays import Complex128s, Float64s, Int64s
from octex.painting.multigrid import conjugate_gradients

#: The solver ends where what is left of the gradient is so much of the first.
_LEFT = 1e-7
_MOST_STEPS = 5000
#: Triangles of less than this part of the mean area say nothing about angles.
_SLIVER = 1e-10


def conformal(vertices: Float64s, faces: Int64s, flat: Float64s, start: int) -> Float64s:
    """Return where vertices (n, 2) of triangles (m, 3) lie in the map that changes angles least.

    ``flat`` (n, 2) is the map to begin with. The result lies as that does around triangle ``start``, turned
    and moved alike, and has the surface's area in all. Two vertices far from each other are held, which of
    all conformal maps chooses one; conjugate gradients find the others.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    lengths = np.linalg.norm(b - a, axis=1)
    along = (b - a) / np.maximum(lengths, 1e-300)[:, None]
    x = np.einsum("nc,nc->n", c - a, along)
    y = np.linalg.norm(c - a - x[:, None] * along, axis=1)
    doubled = lengths * y
    scale = np.where(doubled > _SLIVER * doubled.mean(), 1 / np.sqrt(np.maximum(doubled, 1e-300)), 0.0)
    # A map is conformal on a triangle whose corners z it takes to w if these sum up to 0.
    weights = np.stack([x - lengths + 1j * y, -x - 1j * y, lengths + 0j], axis=1) * scale[:, None]
    found = _solved(weights, faces, flat[:, 0] + 1j * flat[:, 1], _held(flat))
    one, two, three = found[faces].T
    spread = np.abs(np.imag(np.conj(two - one) * (three - one))).sum()
    own = flat[faces[start], 0] + 1j * flat[faces[start], 1]
    here = found[faces[start]]
    turn = np.vdot(here - here.mean(), own - own.mean())
    turn /= max(abs(turn), 1e-300)
    found = (found - here.mean()) * turn * np.sqrt(doubled.sum() / max(spread, 1e-300)) + own.mean()
    return np.stack([found.real, found.imag], axis=1)


def _held(flat: Float64s) -> Int64s:
    """Return two vertices that are far from each other."""
    first = int(np.argmax((flat * flat).sum(axis=1)))
    away = flat - flat[first]
    return np.array([first, np.argmax((away * away).sum(axis=1))])


def _solved(weights: Complex128s, faces: Int64s, begun: Complex128s, held: Int64s) -> Complex128s:
    """Return the vertices (n,) that make the sums of weighted corners least, but for those that are held."""
    count, rows = len(begun), faces.ravel()

    def gradient(values: Complex128s) -> Complex128s:
        sums = (weights * values[faces]).sum(axis=1)
        parts = (np.conj(weights) * sums[:, None]).ravel()
        made = np.bincount(rows, parts.real, count) + 1j * np.bincount(rows, parts.imag, count)
        made[held] = 0.0
        return made

    diagonal = np.bincount(rows, (np.abs(weights) ** 2).ravel(), count)
    inverse = 1 / np.where(diagonal > 0, diagonal, 1.0)
    found: Complex128s = begun + conjugate_gradients(
        gradient, -gradient(begun), lambda left: inverse * left, _LEFT, _MOST_STEPS
    )
    return found
