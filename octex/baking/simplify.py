"""Simplifies meshes by quadric errors (Garland & Heckbert 1997)."""

from __future__ import annotations

import warnings
from importlib.util import find_spec

import numpy as np

from octex.arrays import Float64s, Int32s
from octex.checks import as_whole
from octex.errors import MissingExtraError, ModelError, ModelWarning
from octex.source.corners import has_area, unit_normals
from octex.source.parts import parts_of
from octex.source.surface import Surface, as_surface
from octex.source.welding import distinct_rows
from octex.view.shading import corner_normals

#: Aggressiveness of the collapses, and whether borders stay: mild first, so that hardly a triangle flips.
_ROUNDS = (3.0, True), (7.0, True), (3.0, False), (5.0, False), (7.0, False), (9.0, False)
#: A result may have this multiple of the requested triangles.
_ENOUGH = 1.02
#: Least triangles of each loose part.
_LEAST = 12
#: Largest angle in degrees at a smooth edge: normal maps hold the sharp ones.
_SMOOTH = 180.0


def simplify(surface: Surface, triangles: int) -> Surface:
    """Return a mesh of fewer triangles near a surface at rest, without colours, for ``bake``.

    triangles  their number in the result, at least 4; a surface with no more is only welded

    Vertices at one position are welded, and triangles without area are removed. Edges whose collapse changes
    the surface least go first; borders stay as far as the number allows. Shading normals are smooth
    everywhere: ``bake`` with ``source`` makes a normal map of the lost detail. Each loose part keeps a few
    triangles, so a model of very many parts may stay above ``triangles``; a ModelWarning reports that.

    Raises ArgumentError for a number out of range, MissingExtraError without the extra ``simplify``, and
    ModelError if no triangle has an area.
    """
    check_simplifier()
    as_surface(surface)
    count = as_whole(triangles, "triangles", 4, 2**31 - 1)
    vertices, numbers = distinct_rows(surface.rest)
    welded_faces = numbers[surface.triangles].astype(np.int32)
    welded_faces = welded_faces[has_area(vertices[welded_faces])]
    if not len(welded_faces):
        raise ModelError(f"{surface.name}: no triangle has an area")
    middle, scale = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    points, faces = _parts_collapsed((vertices - middle) / scale, welded_faces, count)
    if len(faces) > _ENOUGH * count:
        note = f"{len(faces):,} triangles are left, not {count:,}: its loose parts and borders need them"
        warnings.warn(f"{surface.name}: {note}", ModelWarning, stacklevel=2)
    vertices = points * scale + middle
    normals = np.empty_like(vertices)
    normals[faces] = corner_normals(vertices, faces, _SMOOTH)
    is_none = ~normals.any(axis=1)[faces]  # where triangles lie back to back
    rows, corners = np.nonzero(is_none)
    normals[faces[rows, corners]] = unit_normals(vertices[faces[rows]])
    return Surface.from_arrays(vertices, faces, normals=normals, name=surface.name)


def check_simplifier() -> None:
    """Raise MissingExtraError without the extra ``simplify``."""
    if not find_spec("fast_simplification"):
        what = "to make a mesh of fewer triangles"
        raise MissingExtraError.needed(what, "fast-simplification", "simplify")


def _parts_collapsed(points: Float64s, faces: Int32s, count: int) -> tuple[Float64s, Int32s]:
    """Collapse edges until about ``count`` triangles are left, a few of them in each loose part."""
    parts = parts_of(faces, np.arange(len(points)))
    is_small = (np.bincount(parts) * (count / len(faces)) < _LEAST)[parts]
    rows = np.flatnonzero(is_small)
    rows = rows[np.argsort(parts[rows], kind="stable")]
    small_parts = np.split(faces[rows], np.flatnonzero(np.diff(parts[rows])) + 1) if rows.size else []
    collapsed = [_collapsed(points, each, _LEAST) for each in small_parts]
    if not is_small.all():
        large = faces[~is_small]
        remaining = count - sum(len(each) for _, each in collapsed)
        share = round(count * len(large) / len(faces))
        collapsed.append(_collapsed(points, large, max(remaining, share, _LEAST)))
    firsts = np.cumsum([0, *(len(each) for each, _ in collapsed)])
    numbered = [each + first for (_, each), first in zip(collapsed, firsts, strict=False)]
    return np.concatenate([each for each, _ in collapsed]), np.concatenate(numbered).astype(np.int32)


def _collapsed(points: Float64s, faces: Int32s, count: int) -> tuple[Float64s, Int32s]:
    """Collapse edges until about ``count`` triangles are left; return these and their points."""
    from fast_simplification import simplify as collapse_edges

    points, faces = _used(points, faces)
    for boldness, keeps_borders in _ROUNDS:
        if len(faces) <= _ENOUGH * count:
            break
        settings = {"target_count": count, "agg": boldness, "preserve_border": keeps_borders}
        new_points, new_faces = collapse_edges(points, faces, **settings)
        new_faces = new_faces[has_area(new_points[new_faces])]
        if len(new_faces) >= min(count, _LEAST) // 2:  # else a part would vanish
            points, faces = _used(new_points, new_faces)
    return points, faces


def _used(points: Float64s, faces: Int32s) -> tuple[Float64s, Int32s]:
    """Return the points that triangles use, and the triangles on these."""
    used, numbers = np.unique(faces, return_inverse=True)
    return np.asarray(points[used], np.float64), numbers.reshape(-1, 3).astype(np.int32)
