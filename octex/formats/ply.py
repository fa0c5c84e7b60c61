"""Writes PLY: a texture as coloured points, one per leaf; a surface with coloured vertices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.arrays import Float32s, Float64s
from octex.channels import ColorSpace, encode
from octex.errors import TextureFileError
from octex.files import replacing
from octex.formats.models import Target, Written, codes_of, needed_colors
from octex.parallel import Progress, silent
from octex.tree.morton import decode_cells
from octex.tree.normals import estimate_normals
from octex.tree.octree import Leaves, walk_leaves

if TYPE_CHECKING:
    from octex.source.surface import Surface
    from octex.texture import OctreeTexture

_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar"}
#: Channels that are written, and the names of their components.
_SHOWN = {"base_color": ("red", "green", "blue"), "alpha": ("alpha",)}
# Positions are float32 if that moves none by more than this part of a finest cell.
_PRECISION = 1 / 64


def write_points(texture: OctreeTexture, path: str | Path, progress: Progress = silent) -> None:
    """Write a texture as a binary PLY point cloud: one vertex per leaf, in Morton order.

    ``x y z``: the leaf's centre, in rest units; float, or double where float would move it by more than 1/64
    of a finest cell. ``nx ny nz``: the surface's normal, float, estimated from the tree (octex.tree.normals).
    ``red green blue``, ``alpha``: base colour as ``sample`` gives it, in sRGB, and coverage, 0 … 255.

    Raises OutputError if the file cannot be written, and TextureFileError if the tree is damaged.
    """
    vertex = _vertex_type(texture)
    lines = [
        "comment octex: a point a leaf of an octree texture",
        "comment units: those of the model; colours: sRGB",
    ]
    with replacing(path) as file:
        file.write(_header([*lines, *_vertex_lines(texture.tree.n_leaves, vertex)]))
        for points in leaf_points(texture, path, progress):
            file.write(_vertices(texture, points, vertex).tobytes())


class LeafPoints(NamedTuple):
    """Leaves of a texture as points of its surface."""

    leaves: Leaves
    centres: Float64s  # (n, 3)   in rest units
    normals: Float32s  # (n, 3)   estimated from the tree


def leaf_points(texture: OctreeTexture, path: str | Path, progress: Progress) -> Iterator[LeafPoints]:
    """Yield a texture's leaves in Morton order; raises TextureFileError for missing ones."""
    tree, done = texture.tree, 0
    progress("write", 0, tree.n_leaves)
    for leaves in walk_leaves(tree.arrays):
        edges = np.ldexp(1.0, -leaves.depths.astype(np.int32))[:, None]
        centres = texture.placement.to_rest((decode_cells(leaves.codes) + 0.5) * edges)
        yield LeafPoints(leaves, centres, estimate_normals(tree.arrays, *leaves))
        done += len(leaves.cells)
        progress("write", done, tree.n_leaves)
    if done != tree.n_leaves:
        raise TextureFileError(
            f"{path}: not written: the octree is damaged, with {done} of {tree.n_leaves} leaves"
        )


def write(surface: Surface, target: Target) -> Written:
    """Write a surface with vertex colours as a binary PLY mesh; raises ModelError for one with images.

    ``x y z`` are posed positions, double; ``nx ny nz`` shading normals, float, if the surface has them;
    ``red green blue alpha`` are sRGB and coverage, 0 … 255.
    """
    colors = needed_colors(surface, ".ply")
    frames = surface.posed_frames()
    columns = [*surface.vertices.T]
    fields = [(axis, "<f8") for axis in "xyz"]
    if frames is not None:  # a vertex gets the mean of its corners' normals
        sums = np.zeros(surface.vertices.shape)
        for corner in range(3):
            shading = frames.normals.values[frames.normals.rows[:, corner]]
            np.add.at(sums, surface.triangles[:, corner], shading)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        columns += [*(sums / np.where(lengths > 0.0, lengths, 1.0)).T]
        fields += [(f"n{axis}", "<f4") for axis in "xyz"]
    columns += [*codes_of(colors).T]
    fields += [(name, "u1") for names in _SHOWN.values() for name in names]
    vertices = np.empty(len(surface.vertices), np.dtype(fields))
    for name, column in zip(vertices.dtype.names or (), columns, strict=True):
        vertices[name] = column
    faces = np.empty(len(surface.triangles), np.dtype([("count", "u1"), ("vertices", "<i4", 3)]))
    faces["count"], faces["vertices"] = 3, surface.triangles
    header = _header(
        [
            "comment octex: vertex colours, sRGB",
            *_vertex_lines(len(vertices), vertices.dtype),
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
        ]
    )
    with replacing(target.path) as file:
        file.write(header)
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
    return Written([target.path], 0)


def _header(lines: Sequence[str]) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode("ascii")


def _vertex_lines(count: int, form: np.dtype[np.void]) -> list[str]:
    fields = [f"property {_PLY_TYPES[form[field].str[1:]]} {field}" for field in form.names or ()]
    return [f"element vertex {count}", *fields]


def _vertex_type(texture: OctreeTexture) -> np.dtype[np.void]:
    """Return the data type of one vertex in the file."""
    placement = texture.placement
    finest = placement.size / 2**texture.tree.max_depth
    farthest = max(abs(corner) + placement.size for corner in placement.origin)
    position = "<f4" if farthest * 2.0**-24 <= _PRECISION * finest else "<f8"
    fields = [(axis, position) for axis in "xyz"] + [(f"n{axis}", "<f4") for axis in "xyz"]
    fields += [(name, "u1") for channel in _SHOWN if channel in texture.channels for name in _SHOWN[channel]]
    return np.dtype(fields)


def _vertices(texture: OctreeTexture, points: LeafPoints, vertex: np.dtype[np.void]) -> npt.NDArray[np.void]:
    vertices = np.empty(len(points.centres), vertex)
    for axis, name in enumerate("xyz"):
        vertices[name] = points.centres[:, axis]
        vertices[f"n{name}"] = points.normals[:, axis]
    shown = [name for name in _SHOWN if name in texture.channels]
    for name, values in texture.sample(points.centres, shown).items():
        space: ColorSpace = "data" if texture.channels[name].format.space == "data" else "srgb"
        codes = encode(values, "uint8", space)
        for component, field in enumerate(_SHOWN[name]):
            vertices[field] = codes[:, component]
    return vertices
