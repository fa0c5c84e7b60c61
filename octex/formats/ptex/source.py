"""The texels of a .ptx file as the source of a surface."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s
from octex.channels import ALPHA, BASE_COLOR, CHANNELS, ONE, ChannelFormat, decode
from octex.checks import as_choice
from octex.errors import ModelError
from octex.formats.ptex.field import TexelField
from octex.formats.ptex.patches import check_fit, patches_of
from octex.formats.ptex.reader import PtexFile
from octex.source.base import Placeable, Source
from octex.source.materials import light_format
from octex.source.mesh import Mesh

#: Metadata key of octex's JSON that names the channels of a texel's components.
CHANNELS_KEY = "octex:channels"


class Ptex(Placeable):
    """The texels of a .ptx file, for the mesh that it was painted on.

    A file that octex wrote names its channels. Otherwise one component per texel is a grey ``base_color``,
    three are RGB; a declared alpha, or the last of two or four, is ``alpha``. Integers are sRGB for colours;
    floats are linear light. Between texels, quads use a Catmull–Rom spline that continues across edges;
    triangles are linear between centres and corners of texels, and continuous across edges.

    Use it for one channel, ``{"base_color": ptex}``, or for all, ``sources``. Raises ModelError as
    ``PtexFile`` does, and for a file of other channels.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = PtexFile(path)
        self._forms = _forms_of(self._file)

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
        source = self._shared(mesh, lambda: _PtexSource(self._file, self._forms, mesh))
        return source, {f"source_{form.name}": self._file.path.name}


def _forms_of(file: PtexFile) -> list[tuple[ChannelFormat, list[int]]]:
    """Return the channels of a file, each with its components of a texel."""
    names = file.metadata.get(CHANNELS_KEY)
    if isinstance(names, str):
        return _named_forms(file, names)
    alpha = file.alpha_channel
    if alpha is None and file.n_channels in (2, 4):
        alpha = file.n_channels - 1
    others = [channel for channel in range(file.n_channels) if channel != alpha]
    if len(others) not in (1, 3):
        raise ModelError(
            f"{file.path.name} has {file.n_channels} components per texel; octex reads 1 to 4: "
            "colour and alpha"
        )
    lanes = others if len(others) == 3 else others * 3
    forms = [(BASE_COLOR, lanes)]
    return forms if alpha is None else [*forms, (ALPHA, [alpha])]


def _named_forms(file: PtexFile, text: str) -> list[tuple[ChannelFormat, list[int]]]:
    try:
        rows = json.loads(text)
        forms, first = [], 0
        for name, components, space in rows:
            form = CHANNELS[name]
            if components != form.components:
                raise ValueError(name)
            forms.append((form._replace(space=space), list(range(first, first + components))))
            first += components
        if first != file.n_channels or not forms:
            raise ValueError("components")
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ModelError(
            f"{file.path.name} is damaged: its {CHANNELS_KEY} do not name channels; write it again"
        ) from None
    return forms


class _PtexSource(Source):
    """Texels on the mesh that they were painted on."""

    def __init__(self, file: PtexFile, forms: Sequence[tuple[ChannelFormat, list[int]]], mesh: Mesh) -> None:
        self._patches = patches_of(mesh, file.mesh_type)
        check_fit(mesh, self._patches, file.faces, file.path.name)
        texels, log2 = file.all_texels()
        columns, light_forms = [], []
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
            light_forms.append(form)
        self._channels = tuple(light_forms)
        values = np.concatenate(columns, axis=1, dtype=np.float32)
        self._field = TexelField(
            values, file.faces._replace(log2=log2), light_forms, mesh, self._patches, file.border_modes
        )

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components) at points of triangles, averaged over widths in rest units."""
        return self._field.read(triangles, barycentric, widths)

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edge of a texel on triangles (n,), in rest units."""
        faces = self._patches.first_faces[self._patches.polygons[triangles]]
        return self._field.texel_edges(faces)

    def with_rest(self, rest: Float64s) -> _PtexSource:
        """Return the same texels with widths measured on other rest positions (n, 3)."""
        return self._changed(_field=self._field.measured_on(rest))
