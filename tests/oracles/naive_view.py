"""Rays against triangles, one triangle after the other: slow and obvious."""

import numpy as np


def trace(origins, directions, positions, triangles):
    """Nearest triangle of each ray: numbers (n,), barycentric (n, 3), distances (n,); else −1, 0, inf."""
    best = np.full(len(origins), -1), np.zeros((len(origins), 3)), np.full(len(origins), np.inf)
    for number, (a, b, c) in enumerate(np.asarray(positions, np.float64)[triangles]):
        # origin + t · direction = a + v · (b − a) + w · (c − a); not a number along the triangle's plane
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t = (a - origins) @ normal / (directions @ normal)
            inside = (origins - a + t[:, None] * directions) / (normal @ normal)
            v, w = inside @ np.cross(c - a, normal), inside @ np.cross(normal, b - a)
        hit = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (t > 0.0) & (t < best[2])
        best[0][hit] = number
        best[1][hit] = np.column_stack([1.0 - v - w, v, w])[hit]
        best[2][hit] = t[hit]
    return best


def pixel_centers(camera):
    """Pixel coordinates of all centres (height · width, 2), row by row."""
    return np.array([(i + 0.5, j + 0.5) for j in range(camera.height) for i in range(camera.width)])


def render(positions, triangles, camera):
    """What rasterize finds, by tracing a ray for every pixel: triangle, barycentric, depth."""
    shape = camera.height, camera.width
    origins, directions = camera.rays(pixel_centers(camera))
    number, barycentric, distance = trace(origins, directions, positions, triangles)
    depth = distance * (directions @ camera.world_to_camera[2, :3])
    return number.reshape(shape), barycentric.reshape(*shape, 3), depth.reshape(shape)


def signed_coverage(screen, triangles, shape):
    """How often each pixel centre is covered, counter-clockwise triangles as +1, others as −1.

    Where the centre lies on an edge it counts as moved right by ε and down by ε².
    """
    total = np.zeros(shape, int)
    for corners in np.asarray(screen)[triangles]:
        (ax, ay), (bx, by), (cx, cy) = corners
        side = np.sign((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
        for row, column in np.ndindex(shape):
            x, y = column + 0.5, row + 0.5
            inside = side != 0
            for (px, py), (qx, qy) in (
                (corners[0], corners[1]),
                (corners[1], corners[2]),
                (corners[2], corners[0]),
            ):
                # Value, and how it changes to the right and downward.
                terms = side * np.array([(qx - px) * (y - py) - (qy - py) * (x - px), py - qy, qx - px])
                inside &= next((term for term in terms if term != 0), -1.0) > 0
            total[row, column] += side * inside
    return total
