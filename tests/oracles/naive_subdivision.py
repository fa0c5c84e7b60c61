"""One level of a subdivision surface, by dictionaries; from the rules of OpenSubdiv's documentation.

Sharpness is 0 to 10, 10 for good. Faces are tuples of vertices; edges sorted pairs.
"""

from __future__ import annotations

from math import cos, pi

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Edge = tuple[int, int]
Mesh = tuple[list[Floats], list[tuple[int, ...]], dict[Edge, float], dict[int, float]]


def edge(a: int, b: int) -> Edge:
    return min(a, b), max(a, b)


def base(
    points: Floats, faces: list[tuple[int, ...]], creases: dict[Edge, float], spikes: dict[int, float]
) -> Mesh:
    """Sharpen boundaries, and corners of one face."""
    uses: dict[Edge, int] = {}
    for face in faces:
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            uses[edge(a, b)] = uses.get(edge(a, b), 0) + 1
    sharp = {each: 10.0 if count != 2 else creases.get(each, 0.0) for each, count in uses.items()}
    spiky = dict(spikes)
    for v in range(len(points)):
        if sum(v in face for face in faces) == 1:
            spiky[v] = 10.0
    return list(points), faces, sharp, spiky


def next_level(mesh: Mesh, loop: bool) -> Mesh:
    points, faces, sharp, spikes = mesh
    made = [np.zeros(3) for _ in points]
    at: dict[Edge, int] = {}
    opposite: dict[Edge, list[Floats]] = {each: [] for each in sharp}
    centres = [sum(points[v] for v in face) / len(face) for face in faces]
    for face, centre in zip(faces, centres, strict=True):
        for k, a in enumerate(face):
            b = face[(k + 1) % len(face)]
            opposite[edge(a, b)].append(points[face[k - 1]] if loop else centre)
    for (a, b), s in sharp.items():
        middle = (points[a] + points[b]) / 2
        smooth = middle
        if len(opposite[a, b]) == 2:
            others = sum(opposite[a, b])
            smooth = 0.75 * middle + others / 8 if loop else (2 * middle + others) / 4
        w = min(s, 1.0)
        at[a, b] = len(made)
        made.append(w * middle + (1 - w) * smooth)
    softer = {each: s if s >= 10 else max(s - 1, 0.0) for each, s in sharp.items()}
    blunter = {v: s if s >= 10 else max(s - 1, 0.0) for v, s in spikes.items()}
    for v, point in enumerate(points):
        around = [each for each in sharp if v in each]
        others = [points[a + b - v] for a, b in around]
        n = len(around)
        if loop:
            beta = (5 / 8 - (3 / 8 + cos(2 * pi / n) / 4) ** 2) / n
            smooth = (1 - n * beta) * point + beta * sum(others)
        else:
            near = [centre for face, centre in zip(faces, centres, strict=True) if v in face]
            smooth = (n - 2) / n * point + sum(others) / n**2 + sum(near) / n**2
        results = []
        for edges, tips in ((sharp, spikes), (softer, blunter)):
            lines = [points[a + b - v] for a, b in around if edges[a, b] > 0]
            if tips.get(v, 0.0) > 0 or len(lines) > 2:
                results.append(("corner", point))
            elif len(lines) == 2:
                results.append(("crease", 0.75 * point + sum(lines) / 8))
            else:
                results.append(("smooth", smooth))
        ending = [sharp[each] for each in around if sharp[each] > 0 and softer[each] == 0]
        if spikes.get(v, 0.0) > 0 and blunter[v] == 0:
            ending.append(spikes[v])
        share = min(float(np.mean(ending)), 1.0) if ending else 0.0
        made[v] = results[0][1]
        if results[0][0] != results[1][0]:
            made[v] = share * results[0][1] + (1 - share) * results[1][1]
    finer: list[tuple[int, ...]] = []
    edges = {}
    for each, s in softer.items():
        for v in each:
            edges[edge(v, at[each])] = s
    for face, centre in zip(faces, centres, strict=True):
        sides = [at[edge(a, b)] for a, b in zip(face, face[1:] + face[:1], strict=True)]
        if loop:
            finer += [(v, sides[k], sides[k - 1]) for k, v in enumerate(face)] + [
                (sides[0], sides[1], sides[2])
            ]
            edges |= {edge(sides[k], sides[k - 1]): 0.0 for k in range(3)}
        else:
            finer += [(v, sides[k], len(made), sides[k - 1]) for k, v in enumerate(face)]
            edges |= {edge(side, len(made)): 0.0 for side in sides}
            made.append(centre)
    return made, finer, edges, blunter
