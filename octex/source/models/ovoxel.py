"""Read voxels as a surface: O-Voxel's dual grid, or a mesh in the same file.

Each voxel of a dual grid has a vertex, and flags for whether the surface crosses three of its edges: those
along x, y and z that end at its highest corner. The four voxels around such an edge make a quad (Ju et al.,
"Dual Contouring of Hermite Data", 2002; Xiang et al., "Native and Compact Structured Latents", 2025).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octex.arrays import Array, Bools, Float32s, Float64s, Int32s, Int64s
from octex.channels import decode
from octex.errors import ModelError
from octex.jit import kernel
from octex.nearest.points import Points
from octex.source.base import Source, in_order
from octex.source.corners import Corners, area_vectors
from octex.source.mesh import as_positions, as_triangles
from octex.source.models.reading import Options
from octex.source.surface import Surface
from octex.source.vectors import cross_product, dot_product, minus, row_of
from octex.source.voxels import Voxels, voxel_arrays, voxels_of
from octex.source.welding import paired_sides

_X, _Y, _Z = np.eye(3, dtype=np.int64)
#: The four voxels around the edge of a voxel along x, y and z, in order around it.
_AROUND = np.array([[0 * u, u, u + v, v] for u, v in ((_Z, _Y), (_X, _Z), (_Y, _X))])
_AXES = 3
#: Least share of a mesh's vertices in or next to a voxel.
_LEAST_NEAR = 0.5
#: Most bits of coords.
_BITS = 21


class VertexValues(Source):
    """Values of vertices (n, columns), linear and interpolated."""

    def __init__(self, voxels: Voxels, values: Float32s, triangles: Int32s, names: list[str]) -> None:
        self._channels = tuple(voxels.values[name].form for name in names)
        self._corners = Corners(values, triangles)

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:  # noqa: ARG002
        """Return values (n, components) at points of triangles; widths do not count."""
        return self._corners.at(triangles, barycentric).astype(np.float32)


def load_voxel_surface(path: Path, options: Options) -> Surface:
    """Read a .vxz or .npz file of voxels as a surface with their channels.

    The mesh is that of ``vertices`` and ``faces``, or else of ``dual_vertices`` and ``intersected``. Raises
    ModelError for a file without either, or if mesh and voxels do not lie on each other.
    """
    arrays = voxel_arrays(path)
    voxels = voxels_of(arrays, path.name)
    edges = np.ldexp(voxels.size, -voxels.depths.astype(np.int32))[:, None]
    origin = np.array(voxels.origin)
    is_meshed = {"vertices", "faces"} <= arrays.keys()
    if is_meshed:
        vertices = as_positions(arrays["vertices"], f"{path.name}: vertices")
        triangles = as_triangles(arrays["faces"], len(vertices), path.name)
    elif {"dual_vertices", "intersected"} <= arrays.keys():
        within = _within(arrays["dual_vertices"], len(voxels), path.name)
        vertices = (voxels.coords + within) * edges + origin
        triangles = _dual_mesh(voxels.coords, vertices, arrays, path.name)
    else:
        raise ModelError(
            f"{path.name} has no mesh: octex needs the arrays dual_vertices and intersected, or vertices and "
            "faces; use the mesh of another file"
        )
    names = in_order([name for name in voxels.values if options.wants(name)])
    missing = [name for name in options.channels or () if name not in voxels.values]
    if missing and options.materials:
        listing = ", ".join(in_order(list(voxels.values)))
        raise ModelError(f"{path.name} has no channel {', '.join(missing)}; it has {listing}")
    columns = [np.empty((len(voxels), 0), np.float32)]
    for form, rows in map(voxels.values.__getitem__, names):
        columns.append(decode(rows, form.space) if rows.dtype.kind == "u" else rows.astype(np.float32))
    values = np.concatenate(columns, axis=1)
    if is_meshed:
        centres = (voxels.coords + 0.5) * edges + origin
        values, is_near = Points.of(centres, values).around(
            vertices, np.zeros(len(vertices)), nearest=2.0 * float(edges.max())
        )
        if is_near.mean() < _LEAST_NEAR:
            raise ModelError(
                f"{path.name}: mesh and voxels do not lie on each other: {100 * is_near.mean():.3g} % of the "
                "vertices are near a voxel; save origin and voxel_size too"
            )
    return Surface(vertices, triangles, VertexValues(voxels, values, triangles, names), name=path.name)


def _within(dual: Array, count: int, name: str) -> Float64s:
    """Return the vertices' positions within their voxels (n, 3), 0 to 1: bytes are in 1/255."""
    if dual.shape != (count, _AXES) or (dual.dtype != np.uint8 and dual.dtype.kind != "f"):
        kind = f"{dual.dtype} {dual.shape}"
        raise ModelError(f"{name}: dual_vertices must be bytes or floats of shape ({count}, 3), not {kind}")
    within = dual / 255.0 if dual.dtype == np.uint8 else dual.astype(np.float64)
    if not ((within >= -1e-6) & (within <= 1.0 + 1e-6)).all():
        raise ModelError(f"{name}: dual_vertices must lie within their voxels, from 0 to 1")
    return np.clip(within, 0.0, 1.0)


def _dual_mesh(coords: Int64s, vertices: Float64s, arrays: dict[str, Array], name: str) -> Int32s:
    """Return the triangles (m, 3) of a dual grid, consistently wound in each part."""
    crossed = _crossed(arrays["intersected"], len(coords), name)
    keys = _keys(coords)
    order = np.argsort(keys)
    if (np.diff(keys[order]) == 0).any():
        raise ModelError(f"{name}: voxels overlap; keep one at each position")
    voxel, axis = np.nonzero(crossed)
    around = _keys((coords[voxel, None] + _AROUND[axis]).reshape(-1, 3))
    corners = order[np.minimum(np.searchsorted(keys, around, sorter=order), len(keys) - 1)]
    quads = corners.reshape(-1, 4)[(keys[corners] == around).reshape(-1, 4).all(axis=1)]
    if not len(quads):
        raise ModelError(f"{name} has no surface: no edge that is crossed has a voxel on all sides")
    # From corner 0 to corner 2, as O-Voxel cuts quads, unless the first triangle has no area.
    is_cut = np.asarray(area_vectors(vertices[quads[:, :3]]).any(axis=1))
    if "split_weight" in arrays:
        weights = arrays["split_weight"]
        if weights.size != len(coords) or weights.dtype.kind not in "fui":
            raise ModelError(f"{name}: split_weight must be numbers of shape ({len(coords)}, 1)")
        of_corners = weights.reshape(-1).astype(np.float64)[quads]
        is_cut = of_corners[:, 0] * of_corners[:, 2] > of_corners[:, 1] * of_corners[:, 3]
    opposite = np.full(quads.size, -1, np.int64)
    a, b = paired_sides(quads.reshape(-1), np.roll(quads, -1, axis=1).reshape(-1))
    opposite[a], opposite[b] = b, a
    _turn(opposite, vertices, quads)
    cuts = np.where(is_cut[:, None], [0, 1, 2, 0, 2, 3], [0, 1, 3, 3, 1, 2])
    return np.take_along_axis(quads, cuts, axis=1).reshape(-1, 3).astype(np.int32)


def _crossed(intersected: Array, count: int, name: str) -> Bools:
    """Return whether the surface crosses voxels' edges (n, 3), from flags or from bits of a byte."""
    flags = intersected[:, None] if intersected.ndim == 1 else intersected
    if flags.shape not in ((count, 1), (count, _AXES)) or flags.dtype.kind not in "bui":
        raise ModelError(
            f"{name}: intersected must be whole numbers of shape ({count}, 1) or ({count}, 3), not "
            f"{intersected.dtype} {intersected.shape}"
        )
    if flags.shape[1] == 1:
        flags = flags.astype(np.int64) >> np.arange(_AXES) & 1
    return np.asarray(flags != 0)


def _keys(coords: Int64s) -> Int64s:
    """Return a number for each cell; −1 beyond any grid."""
    keys = (coords[:, 0] << _BITS | coords[:, 1]) << _BITS | coords[:, 2]
    return np.where((coords >> _BITS != 0).any(axis=1), -1, keys)


@kernel
def _turn(others: Int64s, vertices: Float64s, quads: Int64s) -> None:
    """Turn quads so that neighbours wind the same way, and each part has a positive volume.

    ``others`` (n · 4,) has for each side the one other side of its edge, −1 for none or several.
    """
    part = np.full(len(quads), -1, np.int64)
    is_turned = np.zeros(len(quads), np.bool_)
    members = np.empty(len(quads), np.int64)
    for seed in range(len(quads)):
        if part[seed] >= 0:
            continue
        part[seed] = seed
        members[0] = seed
        count, done = 1, 0
        origin = row_of(vertices, quads[seed, 0])
        volume = 0.0
        while done < count:
            quad = members[done]
            done += 1
            a = minus(row_of(vertices, quads[quad, 0]), origin)
            for i in range(1, 3):
                b = minus(row_of(vertices, quads[quad, i]), origin)
                c = minus(row_of(vertices, quads[quad, i + 1]), origin)
                inside = dot_product(a, cross_product(b, c))
                volume += -inside if is_turned[quad] else inside
            for side in range(4 * quad, 4 * quad + 4):
                other = others[side] // 4
                if others[side] >= 0 and part[other] < 0:
                    part[other] = seed
                    is_same = quads[quad, side & 3] == quads[other, others[side] & 3]
                    is_turned[other] = is_turned[quad] != is_same
                    members[count] = other
                    count += 1
        for row in range(count):
            quad = members[row]
            if is_turned[quad] == (volume >= 0.0):
                quads[quad, 1], quads[quad, 3] = quads[quad, 3], quads[quad, 1]
