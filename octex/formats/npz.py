"""Writes the leaves of a texture as NumPy arrays, .npz."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from octex.arrays import Array
from octex.errors import ArgumentError
from octex.files import replacing
from octex.formats.ply import LeafPoints, leaf_points
from octex.parallel import Progress, silent
from octex.tree.areas import AREAS
from octex.tree.morton import decode_cells
from octex.tree.octree import Leaves

if TYPE_CHECKING:
    from octex.texture import OctreeTexture


def write_arrays(texture: OctreeTexture, path: str | Path, progress: Progress = silent) -> None:
    """Write the leaves of a texture, in Morton order, as arrays that ``numpy.load`` reads.

    coords      (n, 3) int32     the leaf's cell at its depth, along x, y and z, from 0
    depths      (n,) uint8       a cell's edge is 2⁻ᵈ of the root cell's
    points      (n, 3) float64   the leaf's centre, in rest units
    normals     (n, 3) float32   of the surface, estimated from the tree (octex.tree.normals)
    areas       (n,) float32     area of the surface in the leaf, rest units squared, to 5 %
    origin      (3,) float64     the root cell's lowest corner, in rest units
    size        () float64       the root cell's edge
    NAME        (n, components) float32   for each channel the value of ``sample`` at the centre; linear light

    ``octex.PointCloud.load`` reads such a file. Raises OutputError if it cannot be written, ArgumentError for
    a channel that has the name of another array, and TextureFileError if the tree is damaged.
    """
    no_leaves = Leaves(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.uint8))
    no_points = LeafPoints(no_leaves, np.empty((0, 3)), np.empty((0, 3), np.float32))
    blocks = [no_points, *leaf_points(texture, path, progress)]  # an empty texture yields none
    columns = zip(*(each.leaves for each in blocks), strict=True)
    leaves = Leaves(*(np.concatenate(column) for column in columns))
    points = np.concatenate([each.centres for each in blocks])
    codes = texture.tree.arrays.areas[leaves.cells]
    faces = np.ldexp(texture.placement.size, -leaves.depths.astype(np.int32)) ** 2
    arrays: dict[str, Array] = {
        "coords": decode_cells(leaves.codes).astype(np.int32),
        "depths": leaves.depths,
        "points": points,
        "normals": np.concatenate([each.normals for each in blocks]),
        "areas": np.where(codes > 0, AREAS[codes] * faces, 0.0).astype(np.float32),
        "origin": np.array(texture.placement.origin, np.float64),
        "size": np.array(texture.placement.size, np.float64),
    }
    # The last two are numpy's parameters.
    taken = {*arrays, "file", "allow_pickle"} & texture.channels.keys()
    if taken:
        raise ArgumentError(
            f"{path}: a .npz file uses the name {min(taken)!r} itself; leave that channel out "
            "(octex edit --channels)"
        )
    arrays |= texture.sample(points, list(texture.channels))
    with replacing(path) as file:
        np.savez(file, allow_pickle=False, **arrays)
