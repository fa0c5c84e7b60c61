"""A ball of thin walls, blue on one side and orange on the other: as a surface, and for rays to march in."""

import numpy as np
from numba import njit

import octex

BLUE, ORANGE = (0.1, 0.3, 0.8), (0.9, 0.5, 0.1)


@njit
def waves(x, y, z):
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


@njit
def walls(x, y, z):
    """Say about how far positions are from the walls, below zero in them."""
    ball = np.sqrt(x * x + y * y + z * z) - 1
    return np.maximum(ball, np.abs(waves(4 * x, 4 * y, 4 * z)) / 7 - 0.02)


@njit
def march(at, way):
    """Say how far a ray goes before it hits a wall, infinitely if it does not."""
    t = step = 0.01
    while step > 1e-4:
        step = walls(at[0] + t * way[0], at[1] + t * way[1], at[2] + t * way[2])
        t += step
        if t > 9:
            return np.inf
    return t


@njit
def unit(vector):
    return vector / np.sqrt((vector**2).sum())


@njit
def normal_at(at):
    x, y, z = at[0], at[1], at[2]
    return unit(
        np.array([walls(x + 1e-4, y, z), walls(x, y + 1e-4, z), walls(x, y, z + 1e-4)]) - walls(x, y, z)
    )


def surface() -> octex.Surface:
    def sides(points):
        return np.where(waves(*4 * points.T)[:, None] > 0, BLUE, ORANGE)

    def distances(points):
        return walls(*points.T)

    corners = [[-1.05] * 3, [1.05] * 3]
    return octex.Surface.from_function(distances, corners, 0.02, sources={"base_color": sides})
