"""The texels of a .ptx file as the source of a surface."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ONE, ChannelFormat, decode
from octex.checks import as_choice
from octex.errors import ModelError
from octex.formats.ptex.layout import BORDER_MODES
from octex.formats.ptex.patches import Patches, check_fit, locate, patches_of, stretches
from octex.formats.ptex.pyramid import Pyramid, fill_rims, pyramid_of
from octex.formats.ptex.reader import PtexFile, all_texels
from octex.formats.ptex.triangles import add_triangle, fill_corners
from octex.jit import inlined, kernel
from octex.source.base import Source
from octex.source.images.cubic import catmull_rom
from octex.source.materials import light_format
from octex.source.mesh import Mesh
from octex.source.spatial import Placeable
from octex.source.welding import first_equal

#: The metadata in which octex notes the channels that the numbers of a texel are, as JSON.
CHANNELS_KEY = "octex:channels"
#: A box as wide as w texels varies as much as linear reading among texels of w / √3.
_FINER = 3.0


class Ptex(Placeable):
    """The texels of a .ptx file, for the mesh that they were painted on.

    Its channels are those that octex noted, if it wrote the file; else one number a texel is a grey
    ``base_color``, three are its components, and what the file calls alpha, or the last of two or four, is
    ``alpha``. Whole numbers are sRGB codes for colours; floats are linear light. Between the texels of quads
    lies a spline (Catmull and Rom) that goes on across their edges, by a texel beyond each; triangles are
    linear between the centres and the corners of texels, and continuous across their edges, too.

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
        self._pyramid = pyramid_of(values, log2, self._patches.is_triangle)
        faces = file.faces
        if self._patches.is_triangle:
            vertices = first_equal(mesh.rest)[self._patches.corners].reshape(-1, 3)
            fill_corners(self._pyramid, faces.neighbors, faces.edges, vertices)
        else:
            fill_rims(self._pyramid, faces.neighbors, faces.edges, faces.subfaces, modes)
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


@kernel
def _evaluate(
    patches: Patches,
    pyramid: Pyramid,
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
    pyramid: Pyramid,
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
        add_triangle(pyramid.pixels, first, across, u * across, v * across, share, to)
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
