"""A mesh's polygons as Ptex has them: its faces, their neighbours, and where points of them lie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float64s, Int8s, Int32s, Int64s, Uint8s
from octex.errors import ModelError
from octex.formats.ptex.layout import MESH_TYPES, QUAD, TRIANGLE, Faces
from octex.jit import inlined, kernel
from octex.source.corners import Polygons
from octex.source.mesh import Mesh
from octex.source.welding import first_equal


class Patches(NamedTuple):
    """The faces that Ptex makes of a mesh, as kernels read them.

    A polygon's *plane* is two of the three axes: those that its area vector is not the longest along. On it
    faces are bilinear, and the triangles that a polygon was cut into lie where they do at rest.
    """

    is_triangle: bool  # the mesh type; else faces are quads
    first_corners: Int64s  # (polygons + 1,)
    corners: Int32s  # (corners,)      vertices
    plane: Float64s  # (corners, 2)    where they are on the polygon's plane
    first_faces: Int64s  # (polygons + 1,)
    owners: Int32s  # (faces,)         the polygon of each face
    polygons: Int32s  # (triangles,)   the polygon of each triangle
    cut: Int32s  # (triangles, 3)      the corners of the polygon that it has
    first_cut: Int64s  # (polygons + 1,)
    triangles: Int32s  # (triangles,)  those of each polygon

    @property
    def n_faces(self) -> int:
        """How many faces there are."""
        return int(self.first_faces[-1])


def patches_of(mesh: Mesh, mesh_type: str | None = None) -> Patches:
    """Return the faces of a mesh at rest.

    ``mesh_type`` None is that of a mesh of triangles, or else of quads, among which a polygon of n corners is
    n faces. Raises ModelError for polygons that are no triangles, if these are wanted.
    """
    known, counts, vertices = mesh.loops()
    sizes = np.full(int(known[-1]) + 1, 4, np.int64)  # of those that have no triangles
    sizes[known] = counts
    if mesh_type is None:
        mesh_type = MESH_TYPES[TRIANGLE if (counts == 3).all() else QUAD]
    is_triangle = mesh_type == MESH_TYPES[TRIANGLE]
    if is_triangle and (counts != 3).any():
        raise ModelError(
            f"{mesh.name} has polygons of {int(counts.max())} corners, and the .ptx is for a mesh of "
            "triangles; give the mesh that it was painted on"
        )
    has = np.zeros(len(sizes), np.bool_)
    has[known] = True
    ends = np.cumsum(np.where(has, sizes, 0))
    first_corners = np.concatenate([[0], ends])
    per = np.where(sizes == 4, 1, sizes)
    if is_triangle:
        per = np.ones_like(sizes)
    first_faces = np.concatenate([[0], np.cumsum(per)])
    numbers, cut = mesh.polygons or Polygons.of_triangles(len(mesh.triangles))
    order = np.argsort(numbers, kind="stable").astype(np.int32)
    first_cut = np.searchsorted(numbers[order], np.arange(len(sizes) + 1))
    return Patches(
        is_triangle,
        first_corners,
        vertices,
        _planes(mesh.rest[vertices], first_corners),
        first_faces,
        np.repeat(np.arange(len(sizes), dtype=np.int32), per),
        numbers,
        np.ascontiguousarray(cut),
        first_cut,
        order,
    )


@kernel
def _planes(positions: Float64s, first: Int64s) -> Float64s:
    """Return where corners lie on the planes of their polygons (n, 2)."""
    plane = np.empty((positions.shape[0], 2))
    for polygon in range(first.size - 1):
        begin, end = first[polygon], first[polygon + 1]
        x = y = z = 0.0
        for i in range(begin, end):
            j = i + 1 if i + 1 < end else begin
            x += (positions[i, 1] - positions[j, 1]) * (
                positions[i, 2] + positions[j, 2] - 2 * positions[begin, 2]
            )
            y += (positions[i, 2] - positions[j, 2]) * (
                positions[i, 0] + positions[j, 0] - 2 * positions[begin, 0]
            )
            z += (positions[i, 0] - positions[j, 0]) * (
                positions[i, 1] + positions[j, 1] - 2 * positions[begin, 1]
            )
        axis = 2
        if abs(x) >= abs(y) and abs(x) >= abs(z):
            axis = 0
        elif abs(y) >= abs(z):
            axis = 1
        for i in range(begin, end):
            plane[i, 0], plane[i, 1] = positions[i, (axis + 1) % 3], positions[i, (axis + 2) % 3]
    return plane


def neighbors_of(mesh: Mesh, patches: Patches) -> tuple[Int32s, Uint8s]:
    """Return the face across each edge of each face (faces, 4), −1 for none, and which edge that is there.

    Vertices at one place at rest are one. An edge that other than two polygons share, or that two go along
    the same way, is a border: no neighbour turns it over.
    """
    place = first_equal(mesh.rest)[patches.corners]
    first, sizes = patches.first_corners, np.diff(patches.first_corners)
    corners = np.arange(len(place))
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    within = corners - first[polygon]
    after = first[polygon] + (within + 1) % sizes[polygon]
    a, b = place, place[after]
    key = np.minimum(a, b) << 32 | np.maximum(a, b)
    order = np.argsort(key, kind="stable")
    ranked = key[order]
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    lengths = np.diff(np.append(starts, len(ranked)))
    pairs = starts[lengths == 2]
    one, two = order[pairs], order[pairs + 1]
    is_sound = (a[one] == b[two]) & (a[one] != b[one])
    one, two = one[is_sound], two[is_sound]
    across = np.full(len(place), -1, np.int64)
    across[one], across[two] = two, one

    is_whole = sizes == 4
    if patches.is_triangle:
        is_whole = np.ones_like(is_whole)
    neighbors = np.full((patches.n_faces, 4), -1, np.int32)
    edges = np.zeros((patches.n_faces, 4), np.uint8)
    base = patches.first_faces[polygon]
    whole = is_whole[polygon]
    # What another polygon meets first along an edge, going the other way: the face, or the subface there.
    met_face = np.where(whole, base, base + (within + 1) % sizes[polygon])
    met_edge = np.where(whole, within, 3)
    crossed = np.flatnonzero(across >= 0)
    there = across[crossed]
    own = whole[crossed]
    face, edge = base[crossed[own]], within[crossed[own]]
    neighbors[face, edge], edges[face, edge] = met_face[there[own]], met_edge[there[own]]
    # Of an edge of another polygon the first half is edge 0 of a subface, the second edge 3 of the next.
    halves, there = crossed[~own], there[~own]
    start = base[halves] + within[halves]
    end = base[halves] + (within[halves] + 1) % sizes[polygon[halves]]
    neighbors[start, 0], edges[start, 0] = met_face[there], met_edge[there]
    neighbors[end, 3] = np.where(whole[there], base[there], base[there] + within[there])
    edges[end, 3] = np.where(whole[there], within[there], 0)
    inside = np.flatnonzero(~whole)
    here = base[inside] + within[inside]
    following = base[inside] + (within[inside] + 1) % sizes[polygon[inside]]
    neighbors[here, 1], edges[here, 1] = following, 2
    neighbors[following, 2], edges[following, 2] = here, 1
    return neighbors, edges


def faces_of(mesh: Mesh, patches: Patches, log2: Int8s) -> Faces:
    """Return the faces of a mesh with so many texels (faces, 2), as powers of two."""
    return Faces(log2, *neighbors_of(mesh, patches), subfaces_of(patches))


def subfaces_of(patches: Patches) -> Bools:
    """Say which faces are parts of polygons (faces,)."""
    per = np.diff(patches.first_faces)
    subfaces: Bools = (per > 1)[patches.owners]
    return subfaces


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
def _corner(patches: Patches, polygon: int, face: int, corner: int) -> tuple[float, float]:
    """Return where a corner of a face is on its polygon's plane."""
    begin, end = patches.first_corners[polygon], patches.first_corners[polygon + 1]
    size = end - begin
    if patches.first_faces[polygon + 1] - patches.first_faces[polygon] == 1:
        at = begin + corner
        return patches.plane[at, 0], patches.plane[at, 1]
    own = begin + face - patches.first_faces[polygon]
    x, y = patches.plane[own, 0], patches.plane[own, 1]
    if corner == 0:
        return x, y
    if corner == 2:
        x = y = 0.0
        for i in range(begin, end):
            x += patches.plane[i, 0]
            y += patches.plane[i, 1]
        return x / size, y / size
    step = 1 if corner == 1 else size - 1
    other = begin + (own - begin + step) % size
    return 0.5 * (x + patches.plane[other, 0]), 0.5 * (y + patches.plane[other, 1])


@inlined
def _inverse(patches: Patches, polygon: int, face: int, x: float, y: float) -> tuple[float, float]:
    """Return (u, v) of a point on the plane of a quad: what bilinear interpolation makes it of."""
    ax, ay = _corner(patches, polygon, face, 0)
    bx, by = _corner(patches, polygon, face, 1)
    cx, cy = _corner(patches, polygon, face, 2)
    dx, dy = _corner(patches, polygon, face, 3)
    ex, ey, fx, fy = bx - ax, by - ay, dx - ax, dy - ay
    gx, gy, hx, hy = ax - bx + cx - dx, ay - by + cy - dy, x - ax, y - ay
    # h = u·e + v·f + u·v·g: without u that is a quadratic in v.
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
def locate(patches: Patches, triangle: int, p: float, q: float, r: float) -> tuple[int, float, float]:
    """Return the face of a point of a triangle, by its barycentric coordinates, and (u, v) there."""
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
    begin = patches.first_corners[polygon]
    a, b, c = (
        begin + patches.cut[triangle, 0],
        begin + patches.cut[triangle, 1],
        begin + patches.cut[triangle, 2],
    )
    x = p * patches.plane[a, 0] + q * patches.plane[b, 0] + r * patches.plane[c, 0]
    y = p * patches.plane[a, 1] + q * patches.plane[b, 1] + r * patches.plane[c, 1]
    found, best_u, best_v, least = face, 0.5, 0.5, np.inf
    for each in range(face, patches.first_faces[polygon + 1]):
        u, v = _inverse(patches, polygon, each, x, y)
        outside = max(max(-u, u - 1.0), max(-v, v - 1.0))
        if outside < least:
            found, best_u, best_v, least = each, u, v, outside
            if outside <= 0.0:
                break
    return found, min(max(best_u, 0.0), 1.0), min(max(best_v, 0.0), 1.0)


@inlined
def _bilinear(patches: Patches, polygon: int, face: int, u: float, v: float) -> tuple[float, float]:
    ax, ay = _corner(patches, polygon, face, 0)
    bx, by = _corner(patches, polygon, face, 1)
    cx, cy = _corner(patches, polygon, face, 2)
    dx, dy = _corner(patches, polygon, face, 3)
    s, t = 1.0 - u, 1.0 - v
    return (
        s * t * ax + u * t * bx + u * v * cx + s * v * dx,
        s * t * ay + u * t * by + u * v * cy + s * v * dy,
    )


@kernel
def place(patches: Patches, faces: Int32s, uv: Float64s, triangles: Int32s, barycentric: Float64s) -> None:
    """Fill in which points of triangles (n,) are those of faces (n,) at (u, v) (n, 2); −1 for none.

    They are found on the polygons' planes, and never outside of a triangle.
    """
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
        begin = patches.first_corners[polygon]
        best = -np.inf
        x = y = 0.0
        if patches.first_cut[polygon] < patches.first_cut[polygon + 1]:
            x, y = _bilinear(patches, polygon, face, u, v)
        for at in range(patches.first_cut[polygon], patches.first_cut[polygon + 1]):
            triangle = patches.triangles[at]
            a, b, c = (
                begin + patches.cut[triangle, 0],
                begin + patches.cut[triangle, 1],
                begin + patches.cut[triangle, 2],
            )
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


@kernel
def stretches(patches: Patches, positions: Float64s) -> Float64s:
    """Return the greatest lengths (faces, 2) of a face's derivatives along u and v, of vertices (n, 3).

    A face is bilinear: those are along its edges.
    """
    found = np.zeros((patches.owners.size, 2))
    here = np.empty((4, 3))
    for face in range(patches.owners.size):
        polygon = int(patches.owners[face])
        begin, end = patches.first_corners[polygon], patches.first_corners[polygon + 1]
        size = end - begin
        if size == 0:
            continue
        is_whole = patches.first_faces[polygon + 1] - patches.first_faces[polygon] == 1
        own = face - patches.first_faces[polygon]
        for axis in range(3):
            if is_whole:
                for corner in range(4):
                    here[corner, axis] = positions[patches.corners[begin + min(corner, size - 1)], axis]
                continue
            middle = 0.0
            for i in range(begin, end):
                middle += positions[patches.corners[i], axis]
            at = positions[patches.corners[begin + own], axis]
            here[0, axis], here[2, axis] = at, middle / size
            here[1, axis] = 0.5 * (at + positions[patches.corners[begin + (own + 1) % size], axis])
            here[3, axis] = 0.5 * (at + positions[patches.corners[begin + (own + size - 1) % size], axis])
        a = b = c = d = 0.0
        for axis in range(3):
            a += (here[1, axis] - here[0, axis]) ** 2
            b += (here[2, axis] - here[3, axis]) ** 2
            c += (here[3, axis] - here[0, axis]) ** 2
            d += (here[2, axis] - here[1, axis]) ** 2
        if patches.is_triangle:  # as wide as its longest edge, both ways
            found[face] = np.sqrt(max(a, max(c, d)))
        else:
            found[face, 0], found[face, 1] = np.sqrt(max(a, b)), np.sqrt(max(c, d))
    return found
