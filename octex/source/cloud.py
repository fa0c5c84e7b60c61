"""Coloured points: a source for a surface, or a texture of their own."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Float64s
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat
from octex.checks import as_number, as_path, as_reals, as_text, locked
from octex.errors import ArgumentError, ModelError
from octex.files import open_file, read_bytes, reading
from octex.nearest.points import Points
from octex.source.base import Placeable, Source, SpatialSource, least_cosine
from octex.source.colors import linear_colors, screen_colors
from octex.source.mesh import Mesh
from octex.source.models.ply import Ply
from octex.source.models.reading import npz_arrays, parse_numbers

#: The endings of files of points; .ply too, if it has no faces.
CLOUD_ENDINGS = (".xyz", ".npz", ".ply")
_LEAST_POINTS = 3
# A mean of more points takes too long.
_MOST_AROUND = 30_000
_HEADER = 1 << 16
_FARTHEST = 1e100
_NAMES = {
    "points": ("points", "positions", "xyz"),
    "colors": ("colors", "rgb", "base_color"),
    "normals": ("normals",),
}


class PointCloud(Placeable):
    """Points with colours, to lay on a surface or to convert by themselves.

    points     (n, 3), n ≥ 3, in the model's units, at rest
    colors     (n, 3 or 4): uint8 or uint16 sRGB, or floats in linear light, 0 … 1; a fourth column is alpha
    normals    (n, 3) of any length, or None; a zero normal matches every angle
    radius     average all points within this distance, in the model's units, weighted (1 − d²/r²)²; surface
               without any stays empty. At least the width of the footprint. None: that width, or the nearest
               point
    distance   without ``radius``: how far the nearest point may be; surface farther away stays empty
    max_angle  largest angle in degrees between the surface's normal and a point's

    Arrays are copied and read-only. Raises ArgumentError for arrays of another shape, type or length;
    ModelError for points that are not finite or fewer than three, and for colours out of range.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        colors: npt.ArrayLike,
        normals: npt.ArrayLike | None = None,
        *,
        radius: float | None = None,
        distance: float | None = None,
        max_angle: float = 90.0,
        name: str = "points",
    ) -> None:
        self.name = as_text(name, "name")
        self.points = locked(_rows(points, f"{name}: points"))
        if len(self.points) < _LEAST_POINTS:
            raise ModelError(f"{name} has {len(self.points)} points; a cloud needs at least three")
        self.colors = locked(linear_colors(colors, len(self.points), f"{name}: colors"))
        self.normals = None
        if normals is not None:
            vectors = _rows(normals, f"{name}: normals")
            if len(vectors) != len(self.points):
                raise ArgumentError(f"{name}: {len(vectors)} normals for {len(self.points)} points")
            lengths = np.sqrt(np.einsum("nk,nk->n", vectors, vectors))[:, None]
            self.normals = locked(np.divide(vectors, lengths, where=lengths > 0, out=np.zeros_like(vectors)))
        if radius is not None and distance is not None:
            raise ArgumentError("give radius or distance, not both: with a radius nothing farther counts")
        self.radius = None if radius is None else as_number(radius, "radius", 0.0, np.inf)
        self.distance = None if distance is None else as_number(distance, "distance", 0.0, np.inf)
        self.max_angle = as_number(max_angle, "max_angle", 0.0, 180.0)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        radius: float | None = None,
        distance: float | None = None,
        max_angle: float = 90.0,
    ) -> PointCloud:
        """Read points from a file.

        ``.ply``: vertices with colours, and normals ``nx ny nz`` if there are any; faces are ignored.
        ``.xyz``: a line for each point, ``x y z r g b`` or ``x y z nx ny nz r g b``; colours up to 255 if one
        is above 1, else up to 1, sRGB both. ``.npz``: arrays ``points``, ``colors`` (or ``base_color``), and
        perhaps ``normals``, as the class takes them.

        Raises ModelError, with the file's name, for a file that is missing, damaged or has other contents.
        """
        path = as_path(path)
        reader = _READERS.get(path.suffix.lower())
        if reader is None:
            raise ModelError(
                f"{path.name} is not a point cloud that octex reads; it reads {', '.join(CLOUD_ENDINGS)}"
            )
        with reading(path):
            arrays = reader(path)
        try:
            return cls(*arrays, radius=radius, distance=distance, max_angle=max_angle, name=path.name)
        except ArgumentError as error:
            raise ModelError(str(error)) from None

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"<PointCloud {self.name!r} of {len(self):,} points>"

    @property
    def is_translucent(self) -> bool:
        """Whether any point's alpha is below 1."""
        return bool((self.colors[:, 3] < 1).any())

    @property
    def sources(self) -> dict[str, PointCloud]:
        """The cloud for each of its channels, as ``Surface.with_sources`` takes it."""
        return dict.fromkeys(["base_color", "alpha"] if self.is_translucent else ["base_color"], self)

    @cached_property
    def _search(self) -> Points:
        normals = None if self.normals is None else self.normals.astype(np.float32)
        premultiplied = self.colors.copy()
        premultiplied[:, :3] *= premultiplied[:, 3:]
        return Points.of(self.points, premultiplied, normals)

    @property
    def spacing(self) -> float:
        """The distance within which 19 of 20 points have a neighbour, in the model's units."""
        return self._search.spacing()

    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:  # noqa: ARG002
        """Return the source of a channel. Both channels share it on the same mesh.

        Raises ArgumentError for channels other than ``base_color`` and ``alpha``, and for a radius that holds
        tens of thousands of points.
        """
        if form.name not in ("base_color", "alpha"):
            raise ArgumentError(f"{self.name}: points have colours and alpha, but not {form.name}")
        if self.radius is not None and (spacing := self.spacing) > 0.0:
            count = min(np.pi * (self.radius / spacing) ** 2, len(self))
            if count > _MOST_AROUND:
                most = spacing * np.sqrt(_MOST_AROUND / np.pi)
                raise ArgumentError(
                    f"{self.name}: a radius of {self.radius:g} holds about {count:,.0f} points; give one "
                    f"below {most:.3g}"
                )
        source = self._shared(mesh, lambda: _CloudSource(self, mesh))
        return source, {f"source_{form.name}": f"points of {self.name}"}


class _CloudSource(SpatialSource):
    def __init__(self, cloud: PointCloud, mesh: Mesh) -> None:
        super().__init__((BASE_COLOR, ALPHA), mesh.rest, mesh.triangles)
        self._search = cloud._search
        self._radius = cloud.radius or 0.0
        self._distance = np.inf if cloud.radius is None and cloud.distance is None else cloud.distance
        self._is_faced = cloud.normals is not None and cloud.max_angle < 180.0
        self._least_cosine = least_cosine(cloud.max_angle)
        self._is_translucent = cloud.is_translucent

    @property
    def has_gaps(self) -> bool:
        """Whether parts of the surface may be too far from all points of the cloud."""
        return self._is_faced or self._distance is None or bool(np.isfinite(self._distance))

    @property
    def alpha_is_coverage(self) -> bool:
        """Whether all points are opaque."""
        return self.has_gaps and not self._is_translucent

    def at(self, points: Float64s, normals: Float64s, widths: Float32s) -> Float32s:
        """Return mean colours and alpha (n, 4) of the points around positions (n, 3)."""
        values, _ = self._search.around(
            points,
            np.maximum(widths.astype(np.float64), self._radius),
            normals if self._is_faced else None,
            nearest=self._distance,
            least_cosine=self._least_cosine,
        )
        alpha = values[:, 3:]
        np.divide(values[:, :3], alpha, where=alpha > 0, out=values[:, :3])
        return values


def is_cloud(path: Path) -> bool:
    """Return whether a file holds points: ``.xyz``, ``.npz``, or a ``.ply`` whose header has no faces."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in CLOUD_ENDINGS
    try:
        with open_file(path) as file:
            head = file.read(_HEADER).partition(b"end_header")[0]
    except OSError:
        return False
    faces = re.search(rb"^\s*element\s+(face|tristrips)\s+0*[1-9]", head, re.MULTILINE)
    return faces is None and b"element" in head


def _rows(array: npt.ArrayLike, what: str) -> Float64s:
    """Return a copy of finite rows of three, or raise ArgumentError or ModelError."""
    rows = as_reals(array, what, (-1, 3))
    is_usable = (np.abs(rows) <= _FARTHEST).all(axis=1)
    if not is_usable.all():
        raise ModelError(f"{what} are not all finite: number {int(np.argmin(is_usable))} is not")
    return rows


#: Points, colours, and normals if there are any.
_Arrays = tuple[Array, Array, Array | None]


def _read_npz(path: Path) -> _Arrays:
    arrays = npz_arrays(path, {name for names in _NAMES.values() for name in names})
    keys = {kind: next(filter(arrays.__contains__, names), "") for kind, names in _NAMES.items()}
    for kind in ("points", "colors"):
        if not keys[kind]:
            raise ModelError(f"{path.name} has no array {kind!r}; save it with np.savez(…, {kind}=…)")
    return arrays[keys["points"]], arrays[keys["colors"]], arrays.get(keys["normals"])


def _read_xyz(path: Path) -> _Arrays:
    text = read_bytes(path).decode("latin-1").replace(",", " ")
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if not lines:
        raise ModelError(f"{path.name} has no points; a line is x y z r g b")
    columns, numbers = len(lines[0].split()), parse_numbers("\n".join(lines))
    if numbers is None or numbers.size % columns:
        raise ModelError(f"{path.name}: its lines are not all {columns} numbers; a line is x y z r g b")
    if columns not in (6, 7, 9, 10):
        raise ModelError(
            f"{path.name}: its lines have {columns} numbers and no colours; a line is x y z r g b, or "
            "x y z nx ny nz r g b"
        )
    rows = numbers.reshape(-1, columns)
    normals = rows[:, 3:6] if columns >= 9 else None
    colors = rows[:, 3 if normals is None else 6 :]
    most = 255.0 if colors[:, :3].max(initial=0.0) > 1.0 else 1.0
    return rows[:, :3], screen_colors(colors / most), normals


_READERS: dict[str, Callable[[Path], _Arrays]] = {
    ".ply": lambda path: Ply(path).points(),
    ".xyz": _read_xyz,
    ".npz": _read_npz,
}
