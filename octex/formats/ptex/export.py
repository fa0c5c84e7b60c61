"""Samples a texture at the texels of faces, and writes them as a .ptx file."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import product
from typing import NamedTuple

import numpy as np

from octex.arrays import Float32s, Float64s, Int8s, Int32s, Int64s
from octex.channels import ALPHA, BASE_COLOR, ChannelFormat, ColorSpace, encode
from octex.checks import as_choice, as_flag, as_names, as_path, as_whole
from octex.errors import ArgumentError, ModelError
from octex.formats.ptex.field import TexelField
from octex.formats.ptex.layout import DTYPES, LONGEST_LOG2, MESH_TYPES, QUAD, TRIANGLE, Faces
from octex.formats.ptex.patches import Patches, faces_of, patches_of, place, stretches
from octex.formats.ptex.source import CHANNELS_KEY
from octex.formats.ptex.writer import PtexContents, write_contents
from octex.parallel import Progress, Run, as_run, workers
from octex.source.corners import area_vectors
from octex.source.subdivided import subdivide
from octex.source.surface import Surface, as_surface
from octex.texture import OctreeTexture, as_texture
from octex.tree.search import Positions, nearest_cells

ENDING = ".ptx"
#: Texels that are sampled at once.
_TOGETHER = 1 << 19
#: Positions on a face, along u and v, where the octree's cells are measured.
_PROBED = (0.02, 0.25, 0.5, 0.75, 0.98)
_MOST_TEXELS = 2**34
#: Positions of samples along a texel's sides: the centre of a quad; of a triangle the thirds on which it is
#: linear (`triangles`), to which it is then fitted ...
_CENTRE = np.full((1, 2), 1 / 2)
_THIRDS = np.array([[4, 4], [4, 1], [1, 4]]) / 9
#: ... in this many rounds: with noise 3.5 dB better, as by least squares. Quads would gain 0.3 dB.
_ROUNDS = 2
#: Texels at least this many cells wide hold averages. Others hold the field at their centres, which a spline
#: between them matches better.
_WIDE = 2.0


def write_ptex(
    texture: OctreeTexture,
    surface: Surface,
    path: str | os.PathLike[str],
    *,
    channels: Sequence[str] | None = None,
    dtype: str | None = None,
    texels: int | None = None,
    limit: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
    run: Run | None = None,
) -> None:
    """Write a texture as a .ptx file for the polygons of its surface.

    channels  names of the channels to write (default: ``base_color`` and ``alpha``, if present); the file
              stores the names
    dtype     uint8, uint16, float16 or float32 (default: as stored). Integers are sRGB for colours, floats
              linear light
    texels    largest total number of texels; all faces get coarser or finer by the same factor
    limit     measure stretch on the Catmull–Clark limit surface of the polygons
    run       how to work (octex.Run)

    A mesh of triangles becomes triangular faces. In others quads stay quads, and other polygons become a face
    for each corner, as Ptex requires. Along u and v, a face gets the power of two of texels that fits the
    octree's finest cells on it. The place where it is stretched most decides. Neighbours share an edge at
    rest, in opposite directions; other edges are borders.

    Raises ArgumentError for missing channels, another type or ending, and too few texels; ModelError for a
    surface without area; OutputError if the file cannot be written. (Burley & Lacewell, EGSR 2008.)
    """
    as_texture(texture)
    surface = as_surface(surface).placed_on(texture)
    path = as_path(path)
    if path.suffix.lower() != ENDING:
        raise ArgumentError(f"{path.name} must end in {ENDING}")
    names = _names(texture, channels)
    stored = max((texture.channels[name].format.dtype for name in names), key=DTYPES.index)
    kind = stored if dtype is None else as_choice(dtype, DTYPES, "dtype")
    run = as_run(run, threads, progress)
    patches = patches_of(surface)
    on_limit = as_flag(limit, "limit")
    lengths = _limit_lengths(surface, patches) if on_limit else stretches(patches, surface.rest)
    log2 = _sizes(texture, surface, patches, lengths, texels)
    faces = faces_of(surface, patches, log2)
    forms = [texture.channels[name].format for name in names]
    ends = np.cumsum([form.components for form in forms])
    is_float = kind.startswith("float")
    spaces: list[ColorSpace] = [
        "linear" if form.space == "srgb" and is_float else form.space for form in forms
    ]
    notes = [(form.name, form.components, space) for form, space in zip(forms, spaces, strict=True)]
    with workers(run) as pool:
        samples = _TexelSamples(surface, patches, faces)
        sampled_values = _sampled(texture, samples, names, pool, run.report)
        columns = np.split(_fitted(sampled_values, samples, forms, run.report), ends[:-1], axis=1)
        codes = [encode(column, kind, space) for column, space in zip(columns, spaces, strict=True)]
        contents = PtexContents(
            MESH_TYPES[TRIANGLE if patches.is_triangle else QUAD],
            faces,
            np.concatenate(codes, axis=1),
            int(ends[names.index(ALPHA.name)]) - 1 if ALPHA.name in names else None,
            metadata={CHANNELS_KEY: json.dumps(notes)},
        )
        write_contents(contents, path, pool)
    run.report("write", len(log2), len(log2))


def _names(texture: OctreeTexture, channels: Sequence[str] | None) -> list[str]:
    if channels is None:
        names = [name for name in (BASE_COLOR.name, ALPHA.name) if name in texture.channels]
        if not names:
            raise ArgumentError(f"the texture has no {BASE_COLOR.name}; name the channels to write")
        return names
    names = as_names(channels, "channels", texture.channels, "channel of the texture")
    if not names:
        raise ArgumentError("channels must name at least one channel")
    return names


def _limit_lengths(surface: Surface, patches: Patches) -> Float64s:
    """Return the greatest derivatives (faces, 2) on the limit surface, from chords of ¼ of a side."""
    if patches.is_triangle:
        return stretches(patches, surface.vertices)
    divided = subdivide(surface, 2)
    _, _, vertices = divided.loops()
    corners = divided.vertices[vertices].reshape(-1, 4, 3)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    along = np.maximum(sides[:, :2], sides[:, 2:])
    # A level has a face per corner of the previous one, which is its first; u and v of quads alternate.
    number = np.arange(len(along))
    corner = number // 4
    polygon = np.searchsorted(patches.first_corners, corner, side="right") - 1
    within = corner - patches.first_corners[polygon]
    is_whole = np.diff(patches.first_faces)[polygon] == 1
    is_turned = (number % 2 == 1) != (is_whole & (within % 2 == 1))
    along[is_turned] = along[is_turned, ::-1]
    lengths = np.zeros((patches.n_faces, 2))
    faces = patches.first_faces[polygon] + np.where(is_whole, 0, within)
    np.maximum.at(lengths, faces, along * np.where(is_whole, 4.0, 2.0)[:, None])
    return lengths


def _sizes(
    texture: OctreeTexture, surface: Surface, patches: Patches, lengths: Float64s, texels: int | None
) -> Int8s:
    """Return log2 of the faces' texels along u and v (faces, 2), from derivatives ``lengths``."""
    finest = np.full(patches.n_faces, np.inf)
    numbers = np.arange(patches.n_faces, dtype=np.int32)
    for v, u in product(_PROBED, repeat=2):
        if patches.is_triangle and u + v > 1.0:
            continue
        triangles, barycentric = place(patches, numbers, np.tile([u, v], (patches.n_faces, 1)))
        placed = np.flatnonzero(triangles >= 0)
        rest = surface.rest_at(triangles[placed], barycentric[placed])
        finest[placed] = np.minimum(finest[placed], _cell_edges(texture, rest))
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = np.nan_to_num(np.log2(lengths / finest[:, None]), nan=-60.0, neginf=-60.0, posinf=60.0)

    def rounded(shift: float) -> Int8s:
        log2: Int8s = np.clip(np.rint(exact + shift), 0, LONGEST_LOG2).astype(np.int8)
        return log2

    def total(shift: float) -> float:
        return float(np.exp2(rounded(shift).sum(axis=1, dtype=np.float64)).sum())

    most = _MOST_TEXELS if texels is None else as_whole(texels, "texels", 1, _MOST_TEXELS)
    if total(-60.0) > most:
        raise ArgumentError(f"texels must be at least {patches.n_faces}, one for each face, not {most}")
    if texels is None:
        if total(0.0) > most:
            raise ModelError(f"{surface.name} would have {total(0.0):.3g} texels; limit them by texels=N")
        return rounded(0.0)
    low, high = -60.0, 60.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if total(middle) <= most else (low, middle)
    return rounded(low)


def _cell_edges(texture: OctreeTexture, rest: Float64s) -> Float64s:
    """Return the edge of the cell at, or nearest to, rest positions (n,), in rest units."""
    cells, held = np.empty(len(rest), np.int64), np.empty(len(rest), np.bool_)
    placement, arrays = texture.placement, texture.tree.arrays
    nearest_cells(arrays, Positions.of(rest), placement.origin, placement.size, cells, held)
    depths = np.searchsorted(arrays.level_cells, cells, side="right") - 1
    edges: Float64s = placement.size * np.exp2(-depths.astype(np.float64))
    return edges


class _TexelSamples(NamedTuple):
    """The samples of texels on their faces."""

    surface: Surface
    patches: Patches
    faces: Faces

    @property
    def per_texel(self) -> Float64s:
        """Positions of a texel's samples along its sides (k, 2)."""
        return _THIRDS if self.patches.is_triangle else _CENTRE

    def points(self, begin: int, end: int) -> tuple[Int32s, Int32s, Float64s]:
        """Return the faces, triangles and barycentric coordinates of texels' samples, texel by texel."""
        counts, log2 = self.faces.counts, self.faces.log2
        ends = np.cumsum(counts)
        first, last = np.searchsorted(ends, [begin, end - 1], side="right")
        faces = np.repeat(np.arange(first, last + 1, dtype=np.int32), counts[first : last + 1])
        faces = faces[begin - (ends[first] - counts[first]) :][: end - begin]
        uv = _at(self.patches, log2[faces], np.arange(begin, end) - (ends - counts)[faces], self.per_texel)
        faces = np.repeat(faces, len(self.per_texel))
        return faces, *place(self.patches, faces, uv.reshape(-1, 2))


def _sampled(
    texture: OctreeTexture, samples: _TexelSamples, names: Sequence[str], executor: Executor, report: Progress
) -> Float32s:
    """Sample the texture for all texels (texels, samples, components)."""
    surface, log2 = samples.surface, samples.faces.log2
    components = [texture.channels[name].format.components for name in names]
    count, per_texel = int(samples.faces.counts.sum()), len(samples.per_texel)
    values = np.zeros((count * per_texel, sum(components)), np.float32)
    lengths = stretches(samples.patches, surface.rest)
    for begin in range(0, count, _TOGETHER):
        report("sample", begin, count)
        faces, triangles, barycentric = samples.points(begin, min(begin + _TOGETHER, count))
        placed = np.flatnonzero(triangles >= 0)
        if not placed.size:
            continue
        rest = surface.rest_at(triangles[placed], barycentric[placed])
        edges = (lengths[faces[placed]] / np.exp2(log2[faces[placed]])).prod(axis=1) ** 0.5 / per_texel**0.5
        widths = np.where(edges > _WIDE * _cell_edges(texture, rest), edges, 0.0)
        normals = area_vectors(surface.rest[surface.triangles[triangles[placed]]])
        run = Run(executor=executor)
        sampled = texture.sample(rest, list(names), normals=normals, width=widths, run=run)
        columns = [sampled[name].reshape(len(placed), -1) for name in names]
        values[begin * per_texel + placed] = np.concatenate(columns, axis=1)
    return values.reshape(count, per_texel, -1)


def _fitted(
    sampled_values: Float32s, samples: _TexelSamples, forms: Sequence[ChannelFormat], report: Progress
) -> Float32s:
    """Return texels (texels, components) that reproduce the values ``sampled_values`` at their samples.

    With one sample that is the value. Otherwise texels start as means; each round adds the mean error of the
    field over the texel (Van Cittert's iteration), with colours weighted by coverage.
    """
    if sampled_values.shape[1] == 1:
        return sampled_values[:, 0]
    weights = np.ones((len(sampled_values), sampled_values.shape[1], 1), np.float32)
    is_alpha = np.array([form.name == ALPHA.name for form in forms for _ in range(form.components)])
    if is_alpha.any():
        weights = np.where(is_alpha, np.float32(1.0), sampled_values[..., is_alpha])
    totals = np.maximum(weights.sum(axis=1), np.float32(2.0**-20))
    texels: Float32s = (sampled_values * weights).sum(axis=1) / totals
    for _ in range(_ROUNDS):
        field = TexelField(texels, samples.faces, forms, samples.surface, samples.patches, ("clamp", "clamp"))
        for begin in range(0, len(texels), _TOGETHER):
            report("fit", begin, len(texels))
            part = sampled_values[begin : begin + _TOGETHER]
            _, triangles, barycentric = samples.points(begin, begin + len(part))
            placed = np.flatnonzero(triangles >= 0)
            errors = np.zeros((len(triangles), texels.shape[1]), np.float32)
            values = field.read(triangles[placed], barycentric[placed], np.zeros(len(placed), np.float32))
            errors[placed] = part.reshape(errors.shape)[placed] - values
            errors = errors.reshape(part.shape) * weights[begin : begin + _TOGETHER]
            texels[begin : begin + _TOGETHER] += errors.sum(axis=1) / totals[begin : begin + _TOGETHER]
    return texels


def _at(patches: Patches, log2: Int8s, within: Int64s, shares: Float64s) -> Float64s:
    """Return (u, v) of samples (n, k, 2), at ``shares`` (k, 2) of the sides of texels ``within`` faces."""
    across = log2[:, 0].astype(np.int64)
    row, column = within >> across, within & (np.int64(1) << across) - 1
    sides = np.exp2(log2)[:, None]
    if not patches.is_triangle:
        return (np.stack([column, row], axis=1)[:, None] + shares) / sides
    last = (np.int64(1) << across) - 1
    is_tip = column + row > last
    cells = np.stack([np.where(is_tip, last - row, column), np.where(is_tip, last - column, row)], axis=1)
    return (cells[:, None] + np.where(is_tip[:, None, None], 1.0 - shares, shares)) / sides
