"""The texels of a .ptx file as the source of a surface."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int8s, Int32s, Int64s, Uint8s
from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ONE, ChannelFormat, decode
from octex.checks import as_choice
from octex.errors import ModelError
from octex.formats.ptex.layout import BORDER_MODES, Faces
from octex.formats.ptex.patches import Patches, check_fit, locate, patches_of, stretches
from octex.formats.ptex.reader import PtexFile, all_texels
from octex.jit import inlined, kernel
from octex.source.base import Source
from octex.source.images.cubic import catmull_rom
from octex.source.materials import light_format
from octex.source.mesh import Mesh
from octex.source.spatial import Placeable

#: The metadata in which octex notes the channels that the numbers of a texel are, as JSON.
CHANNELS_KEY = "octex:channels"
#: A box as wide as w texels varies as much as linear reading among texels of w / √3.
_FINER = 3.0
_BLACK, _PERIODIC = BORDER_MODES.index("black"), BORDER_MODES.index("periodic")


class Ptex(Placeable):
    """The texels of a .ptx file, for the mesh that they were painted on.

    Its channels are those that octex noted, if it wrote the file; else one number a texel is a grey
    ``base_color``, three are its components, and what the file calls alpha, or the last of two or four, is
    ``alpha``. Whole numbers are sRGB codes for colours; floats are linear light. Between the texels of quads
    lies a spline (Catmull and Rom) that goes on across their edges, by a texel beyond each; triangles are
    linear between the centres and the corners of texels, and continuous within a face.

    Use it for one channel, ``{"base_color": ptex}``, or for all that there are, ``sources``. Raises
    ModelError as ``PtexFile`` does, and for a file of other channels.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = PtexFile(path)
        self._forms = _forms_of(self._file)
        self._latest: _PtexSource | None = None

    def __repr__(self) -> str:
        return f"<Ptex of {self._file!r}>"

    @property
    def sources(self) -> dict[str, Ptex]:
        """The file for each of its channels, as ``Surface.with_sources`` takes it."""
        return {form.name: self for form, _ in self._forms}

    def on(self, mesh: Mesh, form: ChannelFormat, filter: str) -> tuple[Source, dict[str, str]]:  # noqa: ARG002
        """Return the source of a channel, the same for all channels on the same mesh.

        Raises ArgumentError for a channel that the file lacks, ModelError for a mesh that it does not fit.
        """
        as_choice(form.name, self.sources, f"channel of {self._file.path.name}:")
        latest = self._latest
        if latest is None or not latest.is_on(mesh):
            latest = self._latest = _PtexSource(self._file, self._forms, mesh)
        return latest, {f"source_{form.name}": self._file.path.name}


def _forms_of(file: PtexFile) -> list[tuple[ChannelFormat, list[int]]]:
    """Return the channels of a file, and which numbers of a texel they are."""
    noted = file.metadata.get(CHANNELS_KEY)
    if isinstance(noted, str):
        return _noted(file, noted)
    alpha = file.alpha_channel
    if alpha is None and file.n_channels in (2, 4):
        alpha = file.n_channels - 1
    others = [channel for channel in range(file.n_channels) if channel != alpha]
    if len(others) not in (1, 3):
        raise ModelError(
            f"{file.path.name} has {file.n_channels} numbers a texel; octex knows 1 to 4: colour and alpha"
        )
    lanes = others if len(others) == 3 else others * 3
    made = [(BASE_COLOR, lanes)]
    return made if alpha is None else [*made, (ALPHA, [alpha])]


def _noted(file: PtexFile, noted: str) -> list[tuple[ChannelFormat, list[int]]]:
    try:
        rows = json.loads(noted)
        made, first = [], 0
        for name, components, space in rows:
            known = CHANNELS[name]
            if components != known.components:
                raise ValueError(name)
            made.append((known._replace(space=space), list(range(first, first + components))))
            first += components
        if first != file.n_channels or not made:
            raise ValueError("components")
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ModelError(
            f"{file.path.name} is damaged: its {CHANNELS_KEY} do not name channels; write it again"
        ) from None
    return made


class _Pyramid(NamedTuple):
    """Texels of all faces at all levels, each face with a rim of what lies across its edges.

    Level i has both sides halved i times, as far as they can be.
    """

    pixels: Float32s  # (texels, columns)
    firsts: Int64s  # (levels, faces)   the first texel of the rim's first row
    log2: Int8s  # (levels, faces, 2)
    faces: Int32s  # (faces,)   the level from which on a face is one texel


class _PtexSource(Source):
    """Texels on the mesh that they were painted on."""

    def __init__(self, file: PtexFile, forms: Sequence[tuple[ChannelFormat, list[int]]], mesh: Mesh) -> None:
        self._rest, self._triangles = mesh.rest, mesh.triangles
        self._patches = patches_of(mesh, file.mesh_type)
        check_fit(mesh, self._patches, file.faces, file.path.name)
        texels, log2 = all_texels(file)
        columns, made = [], []
        for form, lanes in forms:
            space = form.space if texels.dtype.kind == "u" or form.space != "srgb" else "linear"
            values = decode(texels[:, lanes], space)
            if texels.dtype.kind == "f":
                if not np.isfinite(values).all():
                    raise ModelError(f"{file.path.name} has texels that are not finite; repair it")
                values = np.maximum(values, -1.0 if form.space == "direction" else 0.0)
                form = light_format(form, float(values.max(initial=0.0))) if form.space == "srgb" else form
            elif form.dtype in ONE and texels.dtype.itemsize > 1:
                form = form._replace(dtype="uint16")
            columns.append(values)
            made.append(form)
        self._channels = tuple(made)
        values = np.concatenate(columns, axis=1, dtype=np.float32)
        ends = np.cumsum([0, *(form.components for form in made)])
        spans = list(zip(made, ends.tolist(), ends.tolist()[1:], strict=False))
        colors = [slice(a, b) for form, a, b in spans if form.name != ALPHA.name]
        alpha = [a for form, a, _ in spans if form.name == ALPHA.name]
        # Colours are averaged by coverage: what is stored is that times them.
        self._alpha = alpha[0] if alpha else -1
        self._weighted = np.zeros(values.shape[1], np.bool_)
        if alpha:
            values[:, self._alpha] = np.clip(values[:, self._alpha], 0.0, 1.0)
            for part in colors:
                self._weighted[part] = True
            values[:, self._weighted] *= np.maximum(values[:, self._alpha, None], 2.0**-20)
        self._range = values.min(axis=0), values.max(axis=0)  # which the spline may leave
        modes = np.array([BORDER_MODES.index(mode) for mode in file.border_modes])
        self._pyramid = _pyramid(values, log2, file.faces, modes, self._patches.is_triangle)
        self._lengths = stretches(self._patches, mesh.rest)

    def is_on(self, mesh: Mesh) -> bool:
        """Say whether it was laid on this mesh."""
        return self._rest is mesh.rest and self._triangles is mesh.triangles

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        found = np.zeros((len(triangles), self._pyramid.pixels.shape[1]), np.float32)
        _evaluate(self._patches, self._pyramid, self._lengths, triangles, barycentric, widths, found)
        np.clip(found, *self._range, out=found)
        if self._alpha >= 0:
            found[:, self._weighted] /= np.maximum(found[:, self._alpha, None], np.float32(2.0**-20))
        return found

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        faces = self._patches.first_faces[self._patches.polygons[triangles]]
        edges = self._lengths[faces] / np.exp2(self._pyramid.log2[0, faces])
        finest: Float32s = edges.min(axis=1).astype(np.float32)
        return finest

    def with_rest(self, rest: Float64s) -> _PtexSource:
        """Return the same texels with widths measured on other rest positions (n, 3)."""
        other = copy.copy(self)
        other._rest, other._lengths = rest, stretches(self._patches, rest)
        return other


def _pyramid(values: Float32s, log2: Int8s, faces: Faces, modes: Int64s, is_triangle: bool) -> _Pyramid:
    levels = int(log2.max()) + 1
    sides = np.maximum(log2[None] - np.arange(levels)[:, None, None], 0).astype(np.int8)
    counts = ((np.int64(1) << sides.astype(np.int64)) + 2).prod(axis=2)
    lasts = log2.max(axis=1).astype(np.int32)
    counts[np.arange(levels)[:, None] > lasts] = 0  # once it is one texel, a face stays that
    firsts = (np.cumsum(counts) - counts.ravel()).reshape(counts.shape)
    pixels = np.zeros((int(counts.sum()), values.shape[1]), np.float32)
    made = _Pyramid(pixels, firsts, sides, lasts)
    starts = np.cumsum(np.int64(1) << log2.sum(axis=1, dtype=np.int64))
    _fill(values, np.concatenate([[0], starts[:-1]]), made, is_triangle)
    if not is_triangle:
        _fill_rims(made, faces.neighbors, faces.edges, faces.subfaces, modes)
    return made


@kernel
def _fill(values: Float32s, starts: Int64s, pyramid: _Pyramid, is_triangle: bool) -> None:
    """Fill in the texels of all levels, each from the one before."""
    columns = values.shape[1]
    for face in range(starts.size):
        for level in range(pyramid.faces[face] + 1):
            u, v = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
            first = pyramid.firsts[level, face] + u + 3
            across = down = 1
            before, above = 0, 0
            if level > 0:
                above = (1 << pyramid.log2[level - 1, face, 0]) + 2
                before = pyramid.firsts[level - 1, face] + above + 1
                across = 1 << (pyramid.log2[level - 1, face, 0] - pyramid.log2[level, face, 0])
                down = 1 << (pyramid.log2[level - 1, face, 1] - pyramid.log2[level, face, 1])
            for row in range(v):
                for column in range(u):
                    to = first + row * (u + 2) + column
                    for k in range(columns):
                        if level == 0:
                            pyramid.pixels[to, k] = values[starts[face] + row * u + column, k]
                            continue
                        total = np.float32(0.0)
                        for j in range(down):
                            for i in range(across):
                                y, x = row * down + j, column * across + i
                                if is_triangle and i == 1 and j == 1:
                                    y, x = 2 * u - 1 - 2 * column, 2 * u - 1 - 2 * row
                                total += pyramid.pixels[before + y * above + x, k]
                        pyramid.pixels[to, k] = total / np.float32(across * down)


@kernel
def _fill_rims(pyramid: _Pyramid, neighbors: Int32s, edges: Uint8s, subfaces: Bools, modes: Int64s) -> None:
    """Fill in what lies across the edges of quads; a rim's corners are the mean of what is beside them."""
    for face in range(neighbors.shape[0]):
        for level in range(pyramid.faces[face] + 1):
            u, v = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
            first, width = pyramid.firsts[level, face], u + 2
            for edge in range(4):
                length = u if edge % 2 == 0 else v
                for i in range(length):
                    to = first + _rim(edge, i, u, v, width, 0)
                    source = _across(
                        pyramid, neighbors, edges, subfaces, face, level, edge, (i + 0.5) / length
                    )
                    if source < 0:
                        mode = modes[0] if edge % 2 == 1 else modes[1]
                        if mode == _BLACK:
                            continue
                        source = first + _rim(edge, i, u, v, width, 1)
                        if mode == _PERIODIC:
                            source = first + _rim((edge + 2) % 4, length - 1 - i, u, v, width, 1)
                    pyramid.pixels[to] = pyramid.pixels[source]
            for corner in range(4):
                column, row = (0, width - 1)[corner % 2], (0, v + 1)[corner // 2]
                beside = 1 if column == 0 else -1
                upward = 1 if row == 0 else -1
                at = first + row * width + column
                for k in range(pyramid.pixels.shape[1]):
                    pyramid.pixels[at, k] = np.float32(0.5) * (
                        pyramid.pixels[at + beside, k] + pyramid.pixels[at + upward * width, k]
                    )


@inlined
def _rim(edge: int, i: int, u: int, v: int, width: int, inside: int) -> int:
    """Return the i-th texel of the rim along an edge, or with ``inside`` 1 the face's own beside it."""
    if edge == 0:
        return inside * width + 1 + i
    if edge == 1:
        return (1 + i) * width + u + 1 - inside
    if edge == 2:
        return (v + 1 - inside) * width + u - i
    return (v - i) * width + inside


@inlined
def _across(
    pyramid: _Pyramid,
    neighbors: Int32s,
    edges: Uint8s,
    subfaces: Bools,
    face: int,
    level: int,
    edge: int,
    along: float,
) -> int:
    """Return the texel across an edge at a part of its length, −1 if nothing is there."""
    other, there = int(neighbors[face, edge]), int(edges[face, edge])
    if other < 0:
        return -1
    if subfaces[other] and not subfaces[face]:
        if along >= 0.5:  # beside the second of two subfaces
            turn = (there + 3) % 4
            second = int(neighbors[other, turn])
            if second < 0:
                return -1
            there, other = (int(edges[other, turn]) + 3) % 4, second
            along -= 0.5
        along *= 2.0
    elif subfaces[face] and not subfaces[other] and (edge == 0 or edge == 3):
        along = 0.5 * along if edge == 0 else 0.5 + 0.5 * along
    level = min(level, int(pyramid.faces[other]))
    u, v = 1 << pyramid.log2[level, other, 0], 1 << pyramid.log2[level, other, 1]
    length = u if there % 2 == 0 else v
    i = min(int((1.0 - along) * length), length - 1)
    return int(pyramid.firsts[level, other]) + _rim(there, i, u, v, u + 2, 1)


@kernel
def _evaluate(
    patches: Patches,
    pyramid: _Pyramid,
    lengths: Float64s,
    triangles: Int32s,
    barycentric: Float64s,
    widths: Float32s,
    found: Float32s,
) -> None:
    for n in range(triangles.size):
        face, u, v = locate(
            patches, int(triangles[n]), barycentric[n, 0], barycentric[n, 1], barycentric[n, 2]
        )
        wide = widths[n] * (1 << pyramid.log2[0, face, 0]) / max(lengths[face, 0], 1e-300)
        high = widths[n] * (1 << pyramid.log2[0, face, 1]) / max(lengths[face, 1], 1e-300)
        level = min(0.5 * np.log2(max(wide * high / _FINER, 1.0)), float(pyramid.faces[face]))
        low = min(int(level), int(pyramid.faces[face]))
        share = np.float32(level - low)
        _add(pyramid, patches.is_triangle, face, low, u, v, np.float32(1.0) - share, found[n])
        if share > 0.0:
            _add(pyramid, patches.is_triangle, face, low + 1, u, v, share, found[n])


@inlined
def _add(
    pyramid: _Pyramid,
    is_triangle: bool,
    face: int,
    level: int,
    u: float,
    v: float,
    share: np.float32,
    to: Float32s,
) -> None:
    across, down = 1 << pyramid.log2[level, face, 0], 1 << pyramid.log2[level, face, 1]
    first, width = pyramid.firsts[level, face], across + 2
    if is_triangle:
        _add_triangle(pyramid.pixels, first + width + 1, width, across, u * across, v * across, share, to)
        return
    x, y = u * across + 0.5, v * down + 0.5
    i, j = min(int(x), across), min(int(y), down)
    of_x, of_y = catmull_rom(np.float32(x - i)), catmull_rom(np.float32(y - j))
    for row in range(4):
        start = first + min(max(j + row - 1, 0), down + 1) * width
        for column in range(4):
            at = start + min(max(i + column - 1, 0), across + 1)
            weight = share * of_y[row] * of_x[column]
            for k in range(to.size):
                to[k] += weight * pyramid.pixels[at, k]


@inlined
def _triangle_texel(side: int, i: int, j: int, is_tip: bool) -> tuple[int, int]:
    """Return the column and the row of a texel of a triangle's cell."""
    if is_tip:
        return side - 1 - j, side - 1 - i
    return i, j


@inlined
def _add_triangle(
    pixels: Float32s, first: int, width: int, side: int, x: float, y: float, share: np.float32, to: Float32s
) -> None:
    """Add what lies at (x, y), in cells of a triangle: linear between a texel's centre and its corners.

    At a corner that is the mean of the texels around it.
    """
    i, j = min(int(x), side - 1), min(int(y), side - 1)
    if i + j > side - 1:  # beyond the slanted edge by rounding
        i = side - 1 - j
    f, g = min(max(x - i, 0.0), 1.0), min(max(y - j, 0.0), 1.0)
    is_tip = f + g > 1.0 and i + j < side - 1
    if f + g > 1.0 and not is_tip:
        f, g = f / (f + g), g / (f + g)
    # Barycentric in the texel; the least says which corner is not of the third that holds the point.
    p, q, r = 1.0 - f - g, f, g
    if is_tip:
        p, q, r = f + g - 1.0, 1.0 - f, 1.0 - g
    least = min(p, min(q, r))
    column, row = _triangle_texel(side, i, j, is_tip)
    own = share * np.float32(3.0 * least)
    at = first + row * width + column
    for k in range(to.size):
        to[k] += own * pixels[at, k]
    for corner in range(3):
        weight = (p if corner == 0 else (q if corner == 1 else r)) - least
        if weight <= 0.0:
            continue
        a, b = i, j
        if is_tip:
            a += 1 if corner != 1 else 0
            b += 1 if corner != 2 else 0
        else:
            a += 1 if corner == 1 else 0
            b += 1 if corner == 2 else 0
        count = 0
        for each in range(6):
            if _around(side, a, b, each)[0] >= 0:
                count += 1
        part = share * np.float32(weight / count)
        for each in range(6):
            column, row = _around(side, a, b, each)
            if column >= 0:
                at = first + row * width + column
                for k in range(to.size):
                    to[k] += part * pixels[at, k]


@inlined
def _around(side: int, a: int, b: int, each: int) -> tuple[int, int]:
    """Return the column and row of one of six texels around a corner of cells, −1 if it is not there."""
    i, j, is_tip = a, b, False
    if each == 1:
        i = a - 1
    elif each == 2:
        j = b - 1
    elif each == 3:
        i, is_tip = a - 1, True
    elif each == 4:
        j, is_tip = b - 1, True
    elif each == 5:
        i, j, is_tip = a - 1, b - 1, True
    if i < 0 or j < 0 or i + j > side - (2 if is_tip else 1):
        return -1, -1
    return _triangle_texel(side, i, j, is_tip)
