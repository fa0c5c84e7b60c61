"""Solids with a skin each, joined by booleans into one watertight surface.

A part is modelled in a local frame (turned parts along z) and placed in the world. manifold3d remembers
through every boolean which part a triangle came from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold, Mesh64, OpType

Array = np.ndarray
Vector = Sequence[float] | Array
Profile = list[tuple[float, float]]  # (radius, height), rising


@dataclass(frozen=True)
class Skin:
    """How the surface of a part is unwrapped, painted and shaded."""

    name: str
    map: str | None  # the texture map; None: a material without one
    finish: str  # its paint; the material's name where there is no map
    frame: Array  # (3, 4) world from local
    unwrap: str = "box"  # or "turned", around z; or "swept", around a line in the plane x = 0
    share: str | None = None  # parts that share a name lie on the same texels
    profile: Array | None = None  # turned: (n, 2) radius and height; swept: (n, 3) the line
    radius: float = 0.0  # turned and swept: where a texel is as wide as it is high
    crease: float = 50.0  # degrees: a sharper bend is shaded as an edge

    def to_local(self, points: Array) -> Array:
        """Take world points (n, 3) into the part's own frame."""
        return (points - self.frame[:, 3]) @ self.frame[:, :3]

    def turn_local(self, vectors: Array) -> Array:
        """Take world directions (n, 3) into the part's own frame."""
        return vectors @ self.frame[:, :3]


@dataclass(frozen=True)
class Model:
    """A watertight surface: vertices (n, 3), triangles (m, 3), and each triangle's skin by number (m,)."""

    skins: list[Skin]
    vertices: Array
    triangles: Array
    skin: Array

    @property
    def corners(self) -> Array:
        """The positions (m, 3, 3) of the triangles' corners."""
        return self.vertices[self.triangles]

    @property
    def crosses(self) -> Array:
        """Outward normals (m, 3) as long as twice the triangles' areas."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @property
    def normals(self) -> Array:
        """Outward unit normals (m, 3)."""
        crosses = self.crosses
        return crosses / np.maximum(np.linalg.norm(crosses, axis=1), 1e-30)[:, None]

    def of(self, attribute: str) -> Array:
        """Return an attribute of each triangle's skin, (m,)."""
        return np.array([getattr(skin, attribute) for skin in self.skins])[self.skin]


# ---------------------------------------------------------------------------------------- frames, curves


def place(origin: Vector = (0, 0, 0), axis: Vector = (0, 0, 1), side: Vector = (1, 0, 0)) -> Array:
    """Return the frame (3, 4) whose z points along ``axis``, and x as near to ``side`` as can be."""
    z = np.asarray(axis, float) / np.linalg.norm(axis)
    x = np.asarray(side, float) - z * (z @ np.asarray(side, float))
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z, np.asarray(origin, float)])


def inside(outer: Array, inner: Array) -> Array:
    """Return in the world a frame that is given in the frame ``outer``."""
    return np.column_stack([outer[:, :3] @ inner[:, :3], outer[:, :3] @ inner[:, 3] + outer[:, 3]])


def smooth_curve(knots: Sequence[Sequence[float]], at: Array) -> Array:
    """Interpolate knots (parameter, values…) by cubic Hermite pieces; return (n, values)."""
    k = np.asarray(knots, float)
    t, v = k[:, 0], k[:, 1:]
    slope = np.gradient(v, t, axis=0)
    i = np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2)
    h = t[i + 1] - t[i]
    s, h = ((at - t[i]) / h)[:, None], h[:, None]
    ends = (1 + 2 * s) * (1 - s) ** 2 * v[i] + s * s * (3 - 2 * s) * v[i + 1]
    return ends + s * (1 - s) ** 2 * h * slope[i] + s * s * (s - 1) * h * slope[i + 1]


# ---------------------------------------------------------------------------------------- primitives


def stack(rings: Array) -> Manifold:
    """Close a solid around rings (n, m, 3), counter-clockwise about the way from first to last."""
    n, m, _ = rings.shape
    points = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    a = np.arange(n * m).reshape(n, m)
    b = np.roll(a, -1, axis=1)
    faces = [
        np.stack([a[:-1], b[:-1], b[1:]], -1),
        np.stack([a[:-1], b[1:], a[1:]], -1),
        np.stack([b[0], a[0], np.full(m, n * m)], -1),
        np.stack([a[-1], b[-1], np.full(m, n * m + 1)], -1),
    ]
    return Manifold(Mesh64(points, np.concatenate([f.reshape(-1, 3) for f in faces]).astype(np.uint64)))


def revolve(profile: Profile, segments: int) -> Manifold:
    """Turn a profile about z."""
    outline = [(0.0, profile[0][1]), *profile, (0.0, profile[-1][1])]
    return Manifold.revolve(CrossSection([np.asarray(outline, float)]), segments)


def box(size: Vector, bevel: float) -> Manifold:
    """Make a box about the origin with all its edges bevelled."""
    half = np.asarray(size) / 2
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return Manifold.hull_points(
        np.concatenate([signs * (half - bevel * (np.arange(3) != k)) for k in range(3)])
    )


def prism(outline: Vector, height: float, bevel: float = 0.0) -> Manifold:
    """Raise a convex outline (n, 2) about z = 0, with bevelled rims."""
    flat = np.asarray(outline, float)
    small = flat * (1 - bevel / np.linalg.norm(flat, axis=1).max())
    layers = [(flat, height / 2 - bevel), (small, height / 2)]
    sheets = [np.column_stack([p, np.full(len(p), sign * z)]) for p, z in layers for sign in (-1, 1)]
    return Manifold.hull_points(np.concatenate(sheets))


def tube(line: Array, radius: float, sides: int) -> Manifold:
    """Make a round tube along a polyline (n, 3) that nowhere runs along x."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    x = [1.0, 0.0, 0.0] - tangent * tangent[:, :1]
    x /= np.linalg.norm(x, axis=1)[:, None]
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    y = np.cross(tangent, x)
    return stack(line[:, None] + radius * (np.cos(angle) * x[:, None] + np.sin(angle) * y[:, None]))


# ---------------------------------------------------------------------------------------- assembly


def union(solids: Sequence[Manifold]) -> Manifold:
    """Join solids."""
    return Manifold.batch_boolean(solids, OpType.Add)


class Assembly:
    """Solids to add and to cut, and the skin of each."""

    def __init__(self) -> None:
        self.skins: dict[int, Skin] = {}
        self.added: list[Manifold] = []
        self.cuts: list[Manifold] = []
        self.added_after: list[Manifold] = []

    def solid(
        self, shape: Manifold, name: str, map: str | None, finish: str, frame: Array, **more: Any
    ) -> Manifold:
        """Place a local solid in the world and remember its skin."""
        placed = shape.transform(frame).as_original()
        self.skins[placed.original_id()] = Skin(name, map, finish, frame, **more)
        return placed

    def turned(
        self,
        profile: Profile,
        segments: int,
        name: str,
        map: str | None,
        finish: str,
        frame: Array,
        **more: Any,
    ) -> Manifold:
        """Place a turned solid, unwrapped around its axis."""
        p = np.asarray(profile, float)
        more = {"unwrap": "turned", "profile": p, "radius": float(p[:, 0].max()), **more}
        return self.solid(revolve(profile, segments), name, map, finish, frame, **more)

    def add(self, solid: Manifold) -> None:
        """Join a solid to the whole."""
        self.added.append(solid)

    def cut(self, solid: Manifold) -> None:
        """Take a solid away from all that ``add`` joins."""
        self.cuts.append(solid)

    def add_after(self, solid: Manifold) -> None:
        """Join a solid after the cuts."""
        self.added_after.append(solid)

    def finish(self) -> Model:
        """Return the surface of the whole: nothing that lies inside is left."""
        whole = union([union(self.added) - union(self.cuts), *self.added_after]).simplify(2e-4)
        whole = max(
            whole.decompose(), key=Manifold.volume
        )  # parts that share a face can leave flakes without volume
        mesh = whole.to_mesh64()
        vertex = np.arange(len(mesh.vert_properties))
        vertex[np.asarray(mesh.merge_from_vert, np.int64)] = np.asarray(mesh.merge_to_vert, np.int64)
        used, triangles = np.unique(vertex[np.asarray(mesh.tri_verts, np.int64)], return_inverse=True)
        number = {original: i for i, original in enumerate(self.skins)}
        runs = np.diff(np.asarray(mesh.run_index, np.int64)) // 3
        skin = np.repeat([number[original] for original in mesh.run_original_id], runs)
        vertices = np.asarray(mesh.vert_properties)[used, :3]
        return Model(list(self.skins.values()), vertices, triangles.reshape(-1, 3), skin)
