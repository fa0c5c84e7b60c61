"""The mesh that a page shows, as one stream.

A triangle follows one that it shares an edge with. Its new vertex is predicted by the parallelogram of the
other (Touma & Gotsman, *Triangle Mesh Compression*, 1998). A triangle without such a neighbour starts anew:
its vertices are predicted by the vertex before them.

    corners   of each corner that no shared edge gives: 0 is a new vertex, n the one n before that
    edges     a byte for each edge of a triangle, the latest first: 1 if a new triangle lies beyond
    columns   of each new vertex, minus what is predicted: positions in the root cell, in 2⁻ᵇ of its edge;
              normals on an unfolded octahedron; if posed, positions in 2⁻ᵇ of another cube's edge; of a mesh
              that moves, the surface's vertices, and if it is posed the normals at rest; of one with maps,
              coordinates in them, and colours (``maps``); of one that is painted, parts

Numbers of columns and corners are planes of bytes, the lowest first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from octex.arrays import Array, Float64s, Int32s, Int64s, Uint8s
from octex.drawing.hits import rest_normals, smooth_normals
from octex.formats.streams import planes, zigzag
from octex.jit import kernel
from octex.source.materials import MaterialSource
from octex.source.welding import distinct_rows, sides_across
from octex.texture import OctreeTexture
from octex.tree.octree import distinct
from octex.viewer.maps import Maps

if TYPE_CHECKING:
    from octex.source.surface import Surface

#: Positions are whole numbers of so many bits at least and at most; in a cell there are 2⁷ of them.
_LEAST_BITS, _MOST_BITS, _CELL_BITS = 16, 24, 7


def packed_mesh(
    texture: OctreeTexture,
    surface: Surface,
    moves: bool = False,
    maps: Maps | None = None,
    paints: bool = False,
) -> tuple[dict[str, Any], bytes]:
    """Return a mesh's header and its stream.

    With ``moves`` the stream has each vertex's owner, a vertex of the surface; with ``paints`` its part.
    """
    materials = np.zeros(len(surface.triangles), np.int64) if maps is None else maps.materials
    order = np.argsort(materials, kind="stable")
    faces = surface.triangles[order]
    is_posed = surface.rest is not surface.vertices
    normals = smooth_normals(surface.posed_frames(), surface.vertices, surface.triangles)[order]
    bits = min(max(_LEAST_BITS, texture.tree.max_depth + _CELL_BITS), _MOST_BITS)
    rest = texture.placement.to_texture_space(surface.rest)
    steps = np.rint(np.clip(rest, 0.0, 1.0) * (1 << bits)).astype(np.int32)
    columns = [steps[faces.ravel()], _octahedral(normals.reshape(-1, 3))]
    low, edge = np.array(texture.placement.origin), texture.placement.size
    if is_posed:
        used = surface.vertices[distinct(faces.ravel())]
        low, edge = used.min(axis=0), float(np.ptp(used, axis=0).max()) or 1.0
        posed = np.rint((surface.vertices - low) / edge * (1 << bits)).astype(np.int32)
        columns.append(posed[faces.ravel()])
    if moves:
        columns.append(faces.reshape(-1, 1))
    if moves and is_posed:
        columns.append(_octahedral(rest_normals(surface)[order].reshape(-1, 3)))
    if maps is not None:
        columns.append(maps.columns[order].reshape(3 * len(faces), -1))
    has_parts = paints and bool(surface.parts.max() > 0)
    if has_parts:
        columns.append(np.repeat(surface.parts[order], 3)[:, None])
    rows, row_numbers = distinct_rows(np.concatenate(columns, axis=1))
    triangles = row_numbers.reshape(-1, 3)
    across = sides_across(triangles.ravel(), np.roll(triangles, -1, axis=1).ravel())
    groups = np.repeat(materials[order], 3)
    across[groups[across] != groups] = -1
    corners, edges = np.empty(triangles.size, np.int64), np.empty(triangles.size + 3, np.uint8)
    vertices = np.zeros((len(rows), 4), np.int64)  # new; an edge's ends, and the vertex opposite
    n_corners, n_edges = _follow(triangles.ravel(), across, vertices, corners, edges)
    corners, edges = corners[:n_corners], edges[:n_edges]
    of, left, right, opposite = vertices.T
    differences = rows[of] - (rows[left] + rows[right] - rows[opposite])
    differences[0] = rows[of[0]]
    differences = differences.astype(np.int32)  # modulo 2³², as readers add them
    source = surface.source
    has_coordinates = isinstance(source, MaterialSource) and bool(source.coordinates)
    parts = [planes(zigzag(differences[:, column])) for column in range(rows.shape[1])]
    header = {
        "vertices": len(rows),
        "triangles": len(faces),
        "corners": n_corners,
        "edges": n_edges,
        "bits": bits,
        "posed": is_posed,
        "coordinates": surface.uv is not None or has_coordinates,
        "moves": moves,
        "parts": has_parts,
        "low": low.tolist(),
        "edge": edge,
    }
    return header, b"".join([planes(corners), edges.tobytes(), *parts])


@kernel
def _follow(
    triangles: Int64s, across: Int64s, vertices: Int64s, corners: Int64s, edges: Uint8s
) -> tuple[int, int]:
    """Visit all triangles, each after one that adjoins it if any does; count corners and edges."""
    ranks = np.full(len(vertices), -1, np.int64)
    is_done = np.zeros(triangles.size // 3, np.bool_)
    waiting = np.empty(triangles.size, np.int64)  # edges of visited triangles, the next one last
    new = n_corners = n_edges = 0
    for start in range(is_done.size):
        if is_done[start]:
            continue
        is_done[start] = True
        for side in range(3):
            vertex = triangles[3 * start + side]
            corners[n_corners] = 0 if ranks[vertex] < 0 else new - ranks[vertex]
            n_corners += 1
            if ranks[vertex] < 0:
                before = triangles[3 * start + side - 1] if side else vertices[max(new - 1, 0), 0]
                vertices[new] = vertex, before, before, before
                ranks[vertex] = new
                new += 1
            waiting[side] = 3 * start + side
        count = 3
        while count:
            count -= 1
            edge = waiting[count]
            beyond = across[edge]
            is_new = beyond >= 0 and not is_done[beyond // 3]
            edges[n_edges] = is_new
            n_edges += 1
            if not is_new:
                continue
            first = beyond - beyond % 3
            is_done[beyond // 3] = True
            vertex = triangles[first + (beyond + 2) % 3]
            corners[n_corners] = 0 if ranks[vertex] < 0 else new - ranks[vertex]
            n_corners += 1
            if ranks[vertex] < 0:
                opposite = triangles[edge - edge % 3 + (edge + 2) % 3]
                vertices[new] = vertex, triangles[beyond], triangles[first + (beyond + 1) % 3], opposite
                ranks[vertex] = new
                new += 1
            waiting[count] = first + (beyond + 2) % 3
            waiting[count + 1] = first + (beyond + 1) % 3
            count += 2
    return n_corners, n_edges


def _octahedral(normals: Array) -> Int32s:
    """Return unit vectors (n, 3) as whole numbers −1023 … 1023 (n, 2) on an unfolded octahedron."""
    vectors = np.asarray(normals, np.float64)
    sums = np.abs(vectors).sum(axis=1, keepdims=True)
    flat: Float64s = vectors / np.where(sums > 0, sums, 1.0)
    signs = np.where(flat[:, :2] < 0, -1.0, 1.0)
    folded = (1 - np.abs(flat[:, 1::-1])) * signs
    return np.asarray(np.rint(np.where(flat[:, 2:] < 0, folded, flat[:, :2]) * 1023), np.int32)
