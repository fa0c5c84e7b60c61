"""Straight lines on polyhedra: each triangle unfolded into the plane of the one before."""

import numpy as np


def straight(vertices, triangles, start, point, direction, lengths):
    """Walk from a point of triangle ``start`` straight on; return where one is after ``lengths``, (k, 3).

    Over an edge one goes on in the next triangle's plane at the same angle to the edge, which is the shortest
    way between points that are near enough. NaN from where the surface ends.
    """
    beside = {}
    for number, (a, b, c) in enumerate(triangles.tolist()):
        for p, q in ((a, b), (b, c), (c, a)):
            beside.setdefault((min(p, q), max(p, q)), []).append(number)
    found, walked = np.full((len(lengths), 3), np.nan), 0.0
    triangle, came = start, None
    direction = direction / np.linalg.norm(direction)
    while True:
        corners = triangles[triangle]
        normal = _normal(vertices[corners])
        best, over = np.inf, None
        for k in range(3):
            p, q = corners[k], corners[(k + 1) % 3]
            if {int(p), int(q)} == came:
                continue
            outward = np.cross(vertices[q] - vertices[p], normal)
            speed = direction @ outward
            if speed > 1e-14 and (vertices[p] - point) @ outward / speed < best:
                best, over = max((vertices[p] - point) @ outward / speed, 0.0), (int(p), int(q))
        here = (lengths >= walked) & (lengths <= walked + best)
        found[here] = point + (lengths[here, None] - walked) * direction
        walked += best
        others = [] if over is None else [n for n in beside[min(over), max(over)] if n != triangle]
        if walked >= lengths[-1] or not others:
            return found
        point, came, triangle = point + best * direction, set(over), others[0]
        along = vertices[over[1]] - vertices[over[0]]
        along /= np.linalg.norm(along)
        across = np.cross(_normal(vertices[triangles[triangle]]), along)
        inside = vertices[triangles[triangle]].mean(axis=0) - point
        across *= np.sign(across @ inside)
        share = direction @ along
        direction = share * along + np.sqrt(max(1 - share**2, 0.0)) * across


def _normal(corners):
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    return normal / np.linalg.norm(normal)
