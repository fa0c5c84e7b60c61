"""A mesh's polygons as Ptex faces: their neighbours, and the points on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Float64s, Int8s, Int32s, Int64s, Uint8s
from octex.errors import ModelError
from octex.formats.ptex.layout import MESH_TYPES, QUAD, TRIANGLE, Faces
from octex.jit import inlined, kernel
from octex.source.corners import Polygons
from octex.source.mesh import Mesh
from octex.source.welding import first_equal, sides_across


class Patches(NamedTuple):
    """The Ptex faces of a mesh, in the form that kernels read.

    A polygon's *plane* is spanned by two axes, without the one along which its area vector is longest. In it
    faces are bilinear, and the polygon's triangles lie as at rest.
    """

    is_triangle: bool  # the mesh type; else faces are quads
    first_corners: Int64s  # (polygons + 1,)
    corners: Int32s  # (corners,)      vertices
    plane: Float64s  # (corners, 2)    their positions in the polygon's plane
    quads: Float64s  # (faces, 4, 2)   positions of faces' corners in that plane
    first_faces: Int64s  # (polygons + 1,)
    owners: Int32s  # (faces,)         the polygon of each face
    polygons: Int32s  # (triangles,)   the polygon of each triangle
    cut: Int32s  # (triangles, 3)      the polygon's corners of each triangle
    first_cut: Int64s  # (polygons + 1,)
    triangles: Int32s  # (triangles,)  sorted by polygon

    @property
    def n_faces(self) -> int:
        """The number of faces."""
        return int(self.first_faces[-1])


def patches_of(mesh: Mesh, mesh_type: str | None = None) -> Patches:
    """Return the Ptex faces of a mesh at rest.

    ``mesh_type`` None means triangles if all polygons are, else quads, where every other polygon becomes a
    face per corner. Raises ModelError if a triangle mesh is wanted and there are other polygons.
    """
    used, counts, vertices = mesh.loops()
    sizes = np.full(int(used[-1]) + 1, 4, np.int64)  # for polygons without triangles
    sizes[used] = counts
    if mesh_type is None:
        mesh_type = MESH_TYPES[TRIANGLE if (counts == 3).all() else QUAD]
    is_triangle = mesh_type == MESH_TYPES[TRIANGLE]
    if is_triangle and (counts != 3).any():
        raise ModelError(
            f"{mesh.name} has polygons of {int(counts.max())} corners, and the .ptx is for a mesh of "
            "triangles; give the mesh that it was painted on"
        )
    corner_counts = np.zeros_like(sizes)
    corner_counts[used] = counts
    first_corners = np.concatenate([[0], np.cumsum(corner_counts)])
    face_counts = np.ones_like(sizes) if is_triangle else np.where(sizes == 4, 1, sizes)
    first_faces = np.concatenate([[0], np.cumsum(face_counts)])
    numbers, cut = mesh.polygons or Polygons.of_triangles(len(mesh.triangles))
    order = np.argsort(numbers, kind="stable").astype(np.int32)
    first_cut = np.searchsorted(numbers[order], np.arange(len(sizes) + 1))
    plane = _planes(mesh.rest[vertices], first_corners)
    owners = np.repeat(np.arange(len(sizes), dtype=np.int32), face_counts)
    return Patches(
        is_triangle,
        first_corners,
        vertices,
        plane,
        _at_corners(plane, first_corners, first_faces, owners),
        first_faces,
        owners,
        numbers,
        np.ascontiguousarray(cut),
        first_cut,
        order,
    )


def _at_corners(values: Float64s, first_corners: Int64s, first_faces: Int64s, owners: Int32s) -> Float64s:
    """Return values at the corners of faces (faces, 4, k), from those at the corners of polygons."""
    sizes, within = np.diff(first_corners), np.arange(len(owners)) - first_faces[owners]
    polygons = np.repeat(np.arange(len(sizes)), sizes)
    sums = np.stack([np.bincount(polygons, column, len(sizes)) for column in values.T], axis=1)
    at_faces = np.zeros((len(owners), 4, values.shape[1]))
    face_counts = np.diff(first_faces)[owners]
    is_whole = (face_counts == 1) & (sizes > 0)[owners]
    first, count = first_corners[owners[is_whole]], sizes[owners[is_whole]]
    for corner in range(4):
        at_faces[is_whole, corner] = values[first + np.minimum(corner, count - 1)]
    subfaces = np.flatnonzero(face_counts > 1)
    first, count, corner_number = first_corners[owners[subfaces]], sizes[owners[subfaces]], within[subfaces]
    at_corner = values[first + corner_number]
    at_faces[subfaces, 0], at_faces[subfaces, 2] = at_corner, sums[owners[subfaces]] / count[:, None]
    for corner, step in ((1, 1), (3, count - 1)):
        at_faces[subfaces, corner] = 0.5 * (at_corner + values[first + (corner_number + step) % count])
    return at_faces


def _sides(first_corners: Int64s) -> tuple[Int64s, Int64s, Int64s]:
    """Return each corner's polygon (n,), its number there, and the number of the next corner."""
    sizes = np.diff(first_corners)
    polygons = np.repeat(np.arange(len(sizes)), sizes)
    within = np.arange(len(polygons)) - first_corners[polygons]
    return polygons, within, (within + 1) % sizes[polygons]


def _planes(positions: Float64s, first_corners: Int64s) -> Float64s:
    """Return the positions of corners in the planes of their polygons (n, 2)."""
    polygons, _, after = _sides(first_corners)
    first = first_corners[polygons]
    steps = positions - positions[first + after]
    sums = positions + positions[first + after] - 2 * positions[first]
    products = steps[:, [1, 2, 0]] * sums[:, [2, 0, 1]]
    count = len(first_corners) - 1
    areas = np.abs(np.stack([np.bincount(polygons, each, count) for each in products.T], axis=1))
    axis = np.argmax(areas, axis=1)[polygons, None]
    return np.take_along_axis(positions, (axis + np.array([1, 2])) % 3, axis=1)


def neighbors_of(mesh: Mesh, patches: Patches) -> tuple[Int32s, Uint8s]:
    """Return the face across each edge of each face (faces, 4), −1 for none, and the edge's number there.

    Vertices at one rest position are one. An edge of one polygon, of more than two, or of two that run along
    it in the same direction is a border.
    """
    vertex = first_equal(mesh.rest)[patches.corners]
    polygon, within, after = _sides(patches.first_corners)
    first_face = patches.first_faces[polygon]
    across = sides_across(vertex, vertex[patches.first_corners[polygon] + after])
    is_whole = np.diff(patches.first_faces)[polygon] == 1
    neighbors = np.full((patches.n_faces, 4), -1, np.int32)
    edges = np.zeros((patches.n_faces, 4), np.uint8)
    # The face and its edge along the first half of a polygon's side, and along the second half.
    halves = (
        (np.where(is_whole, first_face, first_face + within), np.where(is_whole, within, 0)),
        (np.where(is_whole, first_face, first_face + after), np.where(is_whole, within, 3)),
    )
    sides = np.flatnonzero(across >= 0)
    opposite = across[sides]
    for half in (1, 0):  # last the first half, which is the neighbour of a face along the whole side
        (face, edge), (other, beyond) = halves[half], halves[1 - half]
        neighbors[face[sides], edge[sides]] = other[opposite]
        edges[face[sides], edge[sides]] = beyond[opposite]
    subfaces, following = (first_face + within)[~is_whole], (first_face + after)[~is_whole]
    neighbors[subfaces, 1], edges[subfaces, 1] = following, 2
    neighbors[following, 2], edges[following, 2] = subfaces, 1
    return neighbors, edges


def faces_of(mesh: Mesh, patches: Patches, log2: Int8s) -> Faces:
    """Return the faces of a mesh with log2 texels (faces, 2)."""
    subfaces = (np.diff(patches.first_faces) > 1)[patches.owners]
    return Faces(log2, *neighbors_of(mesh, patches), subfaces)


def check_fit(mesh: Mesh, patches: Patches, faces: Faces, name: str) -> None:
    """Raise ModelError for a mesh whose faces are not those of a .ptx file, or are in another order."""
    if patches.n_faces != len(faces.log2):
        raise ModelError(
            f"{mesh.name} has {patches.n_faces:,} faces, and {name} has {len(faces.log2):,}: the mesh is not "
            "the one that it was painted on; give that, with its polygons as they were"
        )
    neighbors, _ = neighbors_of(mesh, patches)
    both = (neighbors >= 0) & (faces.neighbors >= 0)
    if both.any() and (neighbors == faces.neighbors)[both].mean() < 0.5:
        raise ModelError(
            f"{mesh.name} has as many faces as {name}, but in another order: other faces are neighbours "
            "there; give the mesh that it was painted on"
        )


@inlined
def _inverse(patches: Patches, face: int, x: float, y: float) -> tuple[float, float]:
    """Return (u, v) of a point in the plane of a quad: the inverse of bilinear interpolation."""
    ax, ay = patches.quads[face, 0, 0], patches.quads[face, 0, 1]
    bx, by = patches.quads[face, 1, 0], patches.quads[face, 1, 1]
    cx, cy = patches.quads[face, 2, 0], patches.quads[face, 2, 1]
    dx, dy = patches.quads[face, 3, 0], patches.quads[face, 3, 1]
    ex, ey, fx, fy = bx - ax, by - ay, dx - ax, dy - ay
    gx, gy, hx, hy = ax - bx + cx - dx, ay - by + cy - dy, x - ax, y - ay
    # h = u·e + v·f + u·v·g; eliminating u leaves a quadratic in v.
    k2 = gx * fy - gy * fx
    k1 = ex * fy - ey * fx + hx * gy - hy * gx
    k0 = hx * ey - hy * ex
    v = 0.5
    if abs(k2) <= 1e-12 * abs(k1):
        v = -k0 / k1 if k1 != 0.0 else 0.5
    else:
        root = np.sqrt(max(k1 * k1 - 4.0 * k0 * k2, 0.0))
        q = -0.5 * (k1 + (root if k1 >= 0.0 else -root))
        one = q / k2
        two = k0 / q if q != 0.0 else one
        v = one if abs(one - 0.5) < abs(two - 0.5) else two
    px, py = ex + gx * v, ey + gy * v
    length = px * px + py * py
    u = ((hx - fx * v) * px + (hy - fy * v) * py) / length if length > 0.0 else 0.5
    return u, v


@inlined
def _corners_of(patches: Patches, triangle: int) -> tuple[int, int, int]:
    """Return the corners, of all polygons, at the corners of a triangle."""
    first, cut = patches.first_corners[patches.polygons[triangle]], patches.cut
    return first + cut[triangle, 0], first + cut[triangle, 1], first + cut[triangle, 2]


@inlined
def locate(patches: Patches, triangle: int, p: float, q: float, r: float) -> tuple[int, float, float]:
    """Return the face of a point of a triangle, by barycentric coordinates, and (u, v) there."""
    polygon = int(patches.polygons[triangle])
    face = int(patches.first_faces[polygon])
    if patches.is_triangle:
        u = v = 0.0
        for corner in range(3):
            share = p if corner == 0 else (q if corner == 1 else r)
            if patches.cut[triangle, corner] == 1:
                u = share
            elif patches.cut[triangle, corner] == 2:
                v = share
        return face, min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    a, b, c = _corners_of(patches, triangle)
    x = p * patches.plane[a, 0] + q * patches.plane[b, 0] + r * patches.plane[c, 0]
    y = p * patches.plane[a, 1] + q * patches.plane[b, 1] + r * patches.plane[c, 1]
    nearest, best_u, best_v, outside_least = face, 0.5, 0.5, np.inf
    for candidate in range(face, patches.first_faces[polygon + 1]):
        u, v = _inverse(patches, candidate, x, y)
        outside = max(max(-u, u - 1.0), max(-v, v - 1.0))
        if outside < outside_least:
            nearest, best_u, best_v, outside_least = candidate, u, v, outside
            if outside <= 0.0:
                break
    return nearest, min(max(best_u, 0.0), 1.0), min(max(best_v, 0.0), 1.0)


@inlined
def _bilinear(patches: Patches, face: int, u: float, v: float) -> tuple[float, float]:
    ax, ay = patches.quads[face, 0, 0], patches.quads[face, 0, 1]
    bx, by = patches.quads[face, 1, 0], patches.quads[face, 1, 1]
    cx, cy = patches.quads[face, 2, 0], patches.quads[face, 2, 1]
    dx, dy = patches.quads[face, 3, 0], patches.quads[face, 3, 1]
    s, t = 1.0 - u, 1.0 - v
    return (
        s * t * ax + u * t * bx + u * v * cx + s * v * dx,
        s * t * ay + u * t * by + u * v * cy + s * v * dy,
    )


@kernel
def place(patches: Patches, faces: Int32s, uv: Float64s) -> tuple[Int32s, Float64s]:
    """Return the triangles (n,), −1 for none, and barycentric points of faces (n,) at (u, v) (n, 2)."""
    triangles, barycentric = np.empty(faces.size, np.int32), np.empty((faces.size, 3))
    for n in range(faces.size):
        face = int(faces[n])
        polygon = int(patches.owners[face])
        u, v = uv[n, 0], uv[n, 1]
        triangles[n] = -1
        barycentric[n] = 0.0
        if patches.is_triangle:
            if patches.first_cut[polygon] == patches.first_cut[polygon + 1]:
                continue
            triangle = patches.triangles[patches.first_cut[polygon]]
            triangles[n] = triangle
            for corner in range(3):
                which = patches.cut[triangle, corner]
                barycentric[n, corner] = 1.0 - u - v if which == 0 else (u if which == 1 else v)
            continue
        best = -np.inf
        x = y = 0.0
        if patches.first_cut[polygon] < patches.first_cut[polygon + 1]:
            x, y = _bilinear(patches, face, u, v)
        for row in range(patches.first_cut[polygon], patches.first_cut[polygon + 1]):
            triangle = patches.triangles[row]
            a, b, c = _corners_of(patches, triangle)
            ax, ay = patches.plane[a, 0], patches.plane[a, 1]
            ex, ey = patches.plane[b, 0] - ax, patches.plane[b, 1] - ay
            fx, fy = patches.plane[c, 0] - ax, patches.plane[c, 1] - ay
            area = ex * fy - ey * fx
            q = r = 1.0 / 3.0
            least = -1e300
            if area != 0.0:
                q = ((x - ax) * fy - (y - ay) * fx) / area
                r = (ex * (y - ay) - ey * (x - ax)) / area
                least = min(1.0 - q - r, min(q, r))
            if least > best:
                best = least
                q, r = max(q, 0.0), max(r, 0.0)
                p = max(1.0 - q - r, 0.0)
                total = p + q + r
                triangles[n] = triangle
                barycentric[n, 0], barycentric[n, 1], barycentric[n, 2] = p / total, q / total, r / total
    return triangles, barycentric


def stretches(patches: Patches, positions: Float64s) -> Float64s:
    """Return the faces' longest edges along u and v (faces, 2); for triangles the longest, twice."""
    first_corners, first_faces, owners = patches.first_corners, patches.first_faces, patches.owners
    corners = _at_corners(positions[patches.corners], first_corners, first_faces, owners)
    steps = (corners[:, [1, 2, 3, 2]] - corners[:, [0, 3, 0, 1]]) ** 2
    lengths = np.sqrt(steps[..., 0] + steps[..., 1] + steps[..., 2])
    if patches.is_triangle:
        return np.repeat(lengths.max(axis=1, keepdims=True), 2, axis=1)
    return np.asarray(lengths.reshape(-1, 2, 2).max(axis=2))
