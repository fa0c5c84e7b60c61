"""The fit as a dense least squares between bounds, solved to the end."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def objective(
    lookups: Floats, weights: Floats, targets: Floats, means: Floats, shrink: float, values: Floats
) -> float:
    """Σ w (F − b)² + λ Σ d (c − mean)² with d = Σ w a²; ``lookups`` (samples, leaves) are the a."""
    held = shrink * (lookups**2 * weights[:, None]).sum(axis=0)
    return float(
        (weights[:, None] * (lookups @ values - targets) ** 2).sum()
        + (held[:, None] * (values - means) ** 2).sum()
    )


def fitted(
    lookups: Floats,
    weights: Floats,
    targets: Floats,
    means: Floats,
    shrink: float,
    low: float,
    high: float,
    steps: int = 5000,
) -> Floats:
    """Return the values (leaves, components) of the least objective between the bounds.

    Projected gradient steps of a length that cannot overshoot.
    """
    held = shrink * (lookups**2 * weights[:, None]).sum(axis=0)
    matrix = lookups.T @ (weights[:, None] * lookups) + np.diag(held)
    wanted = lookups.T @ (weights[:, None] * targets) + held[:, None] * means
    length = 1.0 / np.linalg.eigvalsh(matrix)[-1]
    values = means.copy()
    for _ in range(steps):
        values = np.clip(values - length * (matrix @ values - wanted), low, high)
    return values
