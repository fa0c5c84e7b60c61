"""Unwraps a disc of a surface: the discrete exponential map around a point.

Distances and directions from the centre propagate over triangles (Novotni and Klein 2002). Two corners place
the centre in a triangle's plane; that gives the third corner's distance, and its direction lies between
theirs. Schmidt, Grimm and Wyvill (2006) paint with such maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
import numpy.typing as npt

from octex.arrays import Complex128s, Float64s, Int32s, Int64s, Integers
from octex.cameras.camera import Camera
from octex.checks import as_choice, as_positive, as_reals, as_whole
from octex.errors import ModelError
from octex.jit import inlined, kernel
from octex.nearest.triangles import Triangles
from octex.painting.multigrid import conjugate_gradients
from octex.source.parts import edges_of
from octex.source.surface import Surface, as_surface
from octex.source.welding import first_equal

#: Largest angle in degrees between normals around the centre for surface that counts as flat there.
_FLAT = 25.0
#: Factor of the radius up to which distances propagate, so that triangles across the rim have all corners.
_BEYOND = 1.5
METHODS = ("exponential", "conformal")
#: Distance of folded triangles behind the others, as a part of the radius.
_BEHIND = 1e-3
#: Reduction of the gradient at which the solver ends.
_LEFT = 1e-7
_MOST_STEPS = 5000
#: Part of the mean area below which a triangle's angles are ignored.
_SLIVER = 1e-10


@dataclass(frozen=True, eq=False)
class Patch:
    """A disc of a surface, laid flat by ``octex.unwrap``; a Projection accepts it as its camera.

    camera        sees the flat disc from the front, within the image
    surface       the surface with the disc laid flat and everything else shrunk to nothing; at rest as it was
    center        (3,) the disc's centre on the posed surface
    radius        of the disc, along the surface, in the model's units
    coordinates   (n, 2) the flat positions of ``surface``'s vertices; NaN outside of the disc
    triangles     (k,) the triangles that the disc meets
    folded        (j,) those of them that lie upside down and are not painted
    meets_border  whether the surface ends within the disc
    """

    camera: Camera
    surface: Surface
    center: Float64s
    radius: float
    coordinates: Float64s
    triangles: Int32s
    folded: Int32s
    meets_border: bool

    @property
    def width(self) -> int:
        """Size of the image in pixels."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Size of the image in pixels."""
        return self.camera.height

    @property
    def faults(self) -> list[str]:
        """Sentences on the disc's faults, folds and borders; empty for none."""
        faults = []
        if self.folded.size:
            faults.append(f"{self.folded.size:,} of its {self.triangles.size:,} triangles fold over")
        if self.meets_border:
            faults.append("the surface ends within it")
        return faults

    def __repr__(self) -> str:
        faults = "".join(f"; {each}" for each in self.faults)
        return f"<Patch of radius {self.radius:g} with {self.triangles.size:,} triangles{faults}>"


def unwrap(
    surface: Surface,
    center: npt.ArrayLike,
    radius: float,
    *,
    up: npt.ArrayLike | None = None,
    size: int = 1024,
    method: str = "exponential",
) -> Patch:
    """Lay a disc of a posed surface flat, to paint on it in an image (Benson & Davis 2002, 6.1).

    center   (3,) the disc's centre: the nearest point of the surface
    radius   of the disc, along the surface, in the model's units
    up       what points up in the image; default: y, or z where the surface faces y
    size     width and height of the image in pixels
    method   "exponential": each point lies at its distance from the centre, in its direction (the exponential
             map). "conformal": angles change least (Lévy et al. 2002); ears, horns and limbs, which otherwise
             fold, lie open, and their tips shrink

    Vertices at one position are merged. Where the disc folds over or the surface ends, the patch goes as far
    as it can, and ``Patch.faults`` says so. Around a limb or a handle the disc meets itself; folded triangles
    lie behind the others and are not painted. Distances follow the mesh: on a sphere with 96 sides they are
    within radius/100 of the sphere's own.

    Raises ModelError for a centre farther than the radius from the surface, ArgumentError for numbers out of
    range.
    """
    surface = as_surface(surface)
    middle = as_reals(center, "center", (3,), most=1e30)
    radius = as_positive(radius, "radius")
    size = as_whole(size, "size", 1, 100_000)
    as_choice(method, METHODS, "method")
    wanted = None if up is None else as_reals(up, "up", (3,), most=1e30)
    nearest = Triangles.of(surface.vertices, surface.triangles, surface.name).nearest(middle[None])
    start = int(nearest.triangles[0])
    if start < 0:
        raise ModelError(f"{surface.name} has no point near {middle.tolist()}")
    origin = surface.points_at(nearest.triangles, nearest.barycentric)[0]
    if np.linalg.norm(origin - middle) > radius:
        raise ModelError(
            f"the centre {middle.tolist()} is farther than the radius {radius:g} from {surface.name}; its "
            f"nearest point is {origin.round(6).tolist()}"
        )
    rest = [] if surface.rest is surface.vertices else [surface.rest]
    weld = first_equal(np.concatenate([surface.vertices, *rest], axis=1))
    faces, edges = weld[surface.triangles], edges_of(surface.triangles, weld)[0].reshape(3, -1).T
    flat = _spread(surface.vertices, faces, start, nearest.barycentric[0], origin, radius, wanted)
    reach = np.linalg.norm(flat, axis=1)
    triangles = _within(faces, edges, flat, radius, start)
    half = radius
    if method == "conformal":
        used = np.unique(faces[triangles])
        inner = np.searchsorted(used, faces[triangles])
        first = int(np.searchsorted(triangles, start))
        flat[used] = _conformal(surface.vertices[used], inner, flat[used], first)
        half = float(np.abs(flat[used]).max())
    a, b, c = np.moveaxis(flat[faces[triangles]], 1, 0)
    e, f = b - a, c - a
    folded = triangles[e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0] < 0]
    posed, coordinates = _flat_surface(surface, triangles, folded, flat[weld], _BEHIND * half)
    pose = np.eye(4)
    pose[2, 3] = half
    camera = Camera.orthographic(
        (size, size), pose=pose, convention="opengl", pixels_per_unit=size / (2 * half)
    )
    keys, counts = np.unique(edges, return_counts=True)
    rim = keys[counts == 1]  # edges of one triangle
    ends = np.zeros(len(weld), np.bool_)
    ends[rim // len(weld)] = ends[rim % len(weld)] = True
    ends &= reach < radius
    meets = bool(ends[faces[triangles]].any())
    return Patch(camera, posed, origin, radius, coordinates, triangles, folded.astype(np.int32), meets)


def _spread(
    vertices: Float64s,
    faces: Int64s,
    start: int,
    barycentric: Float64s,
    origin: Float64s,
    radius: float,
    up: Float64s | None,
) -> Float64s:
    """Return flat positions of vertices (n, 2); NaN for unreached ones."""
    flat = np.full((len(vertices), 2), np.nan)
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    units = normals / np.where(lengths > 0, lengths, 1)
    ring = np.flatnonzero(np.isin(faces, faces[start]).any(axis=1) & (lengths[:, 0] > 0))
    normal = units[start]
    is_flat = bool((units[ring] @ normal > np.cos(np.radians(_FLAT))).all())
    if is_flat:  # interpolate the corners' normals
        corners = [normals[ring[(faces[ring] == each).any(axis=1)]].sum(axis=0) for each in faces[start]]
        normal = sum(w * each / np.linalg.norm(each) for w, each in zip(barycentric, corners, strict=True))
        normal /= np.linalg.norm(normal)
    if not normal.any():
        raise ModelError("the surface has no area at the centre; choose another")
    if up is None or not np.linalg.norm(np.cross(up, normal)) > 1e-9 * np.linalg.norm(up):
        up = np.array([0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [0.0, 0.0, 1.0])
    right = np.cross(up, normal)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(normal, right)])
    known = np.unique(faces[ring]) if is_flat else np.unique(faces[start])
    away = vertices[known] - origin
    on_plane = away @ axes.T
    spans = np.linalg.norm(on_plane, axis=1, keepdims=True)
    flat[known] = on_plane * np.linalg.norm(away, axis=1, keepdims=True) / np.where(spans > 0, spans, 1)
    order = np.argsort(faces.ravel(), kind="stable")
    first = np.searchsorted(faces.ravel()[order], np.arange(len(vertices) + 1))
    distances = np.full(len(vertices), np.inf)
    distances[known] = np.linalg.norm(flat[known], axis=1)
    angles = np.zeros(len(vertices))
    angles[known] = np.arctan2(flat[known, 1], flat[known, 0])
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    reach = _BEYOND * radius + float(np.sqrt((sides * sides).sum(axis=2).max()))
    _propagate(vertices, faces, first, order // 3, known, reach, distances, angles)
    reached = np.isfinite(distances)
    flat[reached] = distances[reached, None] * np.stack(
        [np.cos(angles[reached]), np.sin(angles[reached])], axis=1
    )
    return flat


@kernel
def _propagate(
    vertices: Float64s,
    faces: Int64s,
    first: Int64s,
    around: Int64s,
    known: Int64s,
    reach: float,
    distances: Float64s,
    angles: Float64s,
) -> None:
    """Propagate distances and angles from ``known`` vertices, nearest first; nearer values replace others."""
    is_fixed = np.zeros(distances.size, np.bool_)
    waiting = [(distances[known[0]], known[0])]
    for k in range(known.size):
        is_fixed[known[k]] = True
        if k:
            heappush(waiting, (distances[known[k]], known[k]))
    while waiting:
        distance, vertex = heappop(waiting)
        if distance > reach:
            break
        if distance > distances[vertex]:  # outdated
            continue
        for at in range(first[vertex], first[vertex + 1]):
            face = around[at]
            for corner in range(3):
                other = faces[face, corner]
                if other == vertex or is_fixed[other]:
                    continue
                third = faces[face, 0] + faces[face, 1] + faces[face, 2] - vertex - other
                if third == vertex or third == other:  # noqa: SIM109  (kernels have no such tuples)
                    continue
                has_two = distances[third] < np.inf
                half = -np.pi if faces[face, (corner + 1) % 3] == vertex else np.pi
                distance, angle = _stepped(vertices, vertex, third, other, distances, angles, has_two, half)
                if distance < distances[other] * (1.0 - 1e-12):
                    distances[other], angles[other] = distance, angle
                    heappush(waiting, (distance, other))


@inlined
def _stepped(
    vertices: Float64s,
    a: int,
    b: int,
    c: int,
    distances: Float64s,
    angles: Float64s,
    has_two: bool,
    half: float,
) -> tuple[float, float]:
    """Return the distance and the angle of a triangle's third corner, c, from those of a, or of a and b.

    ``half`` is the turn from a to b, π or −π, where the centre lies between them.
    """
    ab = ac = bc = dot = 0.0
    for axis in range(3):
        e, f = vertices[b, axis] - vertices[a, axis], vertices[c, axis] - vertices[a, axis]
        ab += e * e
        ac += f * f
        bc += (f - e) * (f - e)
        dot += e * f
    best, angle = distances[a] + np.sqrt(ac), angles[a]
    if not has_two or ab <= 0.0:
        return best, angle
    if distances[b] + np.sqrt(bc) < best:
        best, angle = distances[b] + np.sqrt(bc), angles[b]
    base = np.sqrt(ab)
    # In the triangle's plane a is at (0, 0), b at (base, 0), c above them, and the centre below at (s, −q).
    x = dot / base
    y = np.sqrt(max(ac - x * x, 0.0))
    s = (distances[a] ** 2 - distances[b] ** 2 + ab) / (2.0 * base)
    q = np.sqrt(max(distances[a] ** 2 - s * s, 0.0))
    if y + q <= 0.0:
        return best, angle
    crossing = s + (x - s) * q / (y + q)
    if crossing < -1e-9 * base or crossing > (1.0 + 1e-9) * base:
        return best, angle
    turn = angles[b] - angles[a]
    turn -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    if abs(turn) > np.pi - 1e-9:
        turn = half
    low, high, angle_of_c = np.arctan2(-s, q), np.arctan2(base - s, q), np.arctan2(x - s, y + q)
    share = (angle_of_c - low) / (high - low) if high > low else crossing / base
    return np.sqrt((x - s) ** 2 + (y + q) ** 2), angles[a] + turn * share


def _within(faces: Int64s, edges: Int64s, flat: Float64s, radius: float, start: int) -> Int32s:
    """Return the triangles, connected with ``start``, that a disc around the origin meets."""
    known = np.flatnonzero(np.isfinite(flat[:, 0])[faces].all(axis=1))
    corners = flat[faces[known]]
    sides = np.roll(corners, -1, axis=1) - corners
    along = -(corners * sides).sum(axis=2) / np.maximum((sides * sides).sum(axis=2), 1e-300)
    nearest = corners + np.clip(along, 0.0, 1.0)[..., None] * sides
    crossed = np.linalg.norm(nearest, axis=2) < radius
    edges = np.unique(edges[known], return_inverse=True)[1].reshape(crossed.shape)
    reached, count = known == start, 0
    while count < (count := int(reached.sum())):
        is_open = np.zeros(edges.max() + 1, np.bool_)
        is_open[edges[reached[:, None] & crossed]] = True
        reached |= (is_open[edges] & crossed).any(axis=1)
    triangles: Int32s = known[reached].astype(np.int32)
    return triangles


def _flat_surface(
    surface: Surface, triangles: Int32s, folded: Int32s, flat: Float64s, behind: float
) -> tuple[Surface, Float64s]:
    """Return the surface with a disc posed flat, folds ``behind``, the rest shrunk; and flat coordinates."""
    count = len(surface.vertices)
    flat_triangles = surface.triangles.copy()
    copies: list[Integers] = [np.arange(count)]
    depths = [np.full(count, -1.0)]
    for chosen, depth in ((np.setdiff1d(triangles, folded), 0.0), (folded, -behind)):
        used = np.unique(surface.triangles[chosen])
        flat_triangles[chosen] = np.searchsorted(used, surface.triangles[chosen]) + sum(map(len, copies))
        copies.append(used)
        depths.append(np.full(len(used), depth))
    vertices = np.concatenate(copies)
    coordinates = flat[vertices]
    coordinates[:count] = np.nan
    positions = np.column_stack([np.nan_to_num(coordinates), np.concatenate(depths)])
    rest = surface.rest[vertices]
    posed = Surface(
        positions, flat_triangles, surface.source, rest=rest, uv=surface.uv, polygons=surface.polygons,
        name=surface.name, provenance=surface.provenance,
    )  # fmt: skip
    return posed, coordinates


def _conformal(vertices: Float64s, faces: Int64s, flat: Float64s, start: int) -> Float64s:
    """Return the vertices (n, 2) of triangles (m, 3) in the map that changes angles least.

    It begins with the map ``flat`` (n, 2), keeps the surface's area, and agrees with ``flat`` around triangle
    ``start``. Two far vertices stay fixed, which selects one of all conformal maps.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    lengths = np.linalg.norm(b - a, axis=1)
    along = (b - a) / np.maximum(lengths, 1e-300)[:, None]
    x = np.einsum("nc,nc->n", c - a, along)
    y = np.linalg.norm(c - a - x[:, None] * along, axis=1)
    doubled = lengths * y
    scale = np.where(doubled > _SLIVER * doubled.mean(), 1 / np.sqrt(np.maximum(doubled, 1e-300)), 0.0)
    # A map is conformal on a triangle if its weighted corners sum to 0.
    weights = np.stack([x - lengths + 1j * y, -x - 1j * y, lengths + 0j], axis=1) * scale[:, None]
    first = int(np.argmax((flat * flat).sum(axis=1)))
    away = flat - flat[first]
    held = np.array([first, np.argmax((away * away).sum(axis=1))])
    mapped = _solved(weights, faces, flat[:, 0] + 1j * flat[:, 1], held)
    p, q, r = mapped[faces].T
    spread = np.abs(np.imag(np.conj(q - p) * (r - p))).sum()
    begun = flat[faces[start], 0] + 1j * flat[faces[start], 1]
    start_corners = mapped[faces[start]]
    turn = np.vdot(start_corners - start_corners.mean(), begun - begun.mean())
    turn /= max(abs(turn), 1e-300)
    mapped = (mapped - start_corners.mean()) * turn * np.sqrt(
        doubled.sum() / max(spread, 1e-300)
    ) + begun.mean()
    return np.stack([mapped.real, mapped.imag], axis=1)


def _solved(weights: Complex128s, faces: Int64s, begun: Complex128s, held: Int64s) -> Complex128s:
    """Return the vertices (n,) that minimize the sums of weighted corners; ``held`` ones stay fixed."""
    count, rows = len(begun), faces.ravel()

    def gradient(values: Complex128s) -> Complex128s:
        sums = (weights * values[faces]).sum(axis=1)
        parts = (np.conj(weights) * sums[:, None]).ravel()
        gradients = np.bincount(rows, parts.real, count) + 1j * np.bincount(rows, parts.imag, count)
        gradients[held] = 0.0
        return gradients

    diagonal = np.bincount(rows, (np.abs(weights) ** 2).ravel(), count)
    inverse = 1 / np.where(diagonal > 0, diagonal, 1.0)
    solution: Complex128s = begun + conjugate_gradients(
        gradient, -gradient(begun), lambda left: inverse * left, _LEFT, _MOST_STEPS
    )
    return solution
