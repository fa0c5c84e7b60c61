"""Materials of models: channels made of factors, images and vertex colours (glTF 2.0, 3.9.2 to 3.9.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Self

import numpy as np

from octex.arrays import Float32s, Float64s, Int32s, Uint16s
from octex.channels import CHANNELS, ONE, ChannelFormat
from octex.errors import ModelError
from octex.jit import kernel
from octex.parallel import built_once
from octex.source.base import DEFAULTS, Source, in_order
from octex.source.corners import Corners, Frames, stacked
from octex.source.evaluate import MaterialTables, evaluate, measure, texel_edges
from octex.source.images.decode import is_translucent
from octex.source.images.filters import kernel_code, reads_mips
from octex.source.images.pyramid import REPEAT, Images, ImageTexels, Texels, store
from octex.source.tangents import carried

#: Alpha modes of glTF: alpha is ignored, compared with a cutoff, or used as coverage.
AlphaMode = Literal["opaque", "mask", "blend"]
ALPHA_MODES: tuple[AlphaMode, ...] = ("opaque", "mask", "blend")


class Texture(NamedTuple):
    """An image, its wraps, its magnification filter and its set of texture coordinates."""

    texels: Texels  # (height, width, 4)   as images.decode_image
    wrap_u: int = REPEAT
    wrap_v: int = REPEAT
    nearest: bool = False  # magnified without interpolation
    slot: int = 0  # the number of its set of texture coordinates


class Input(NamedTuple):
    """One channel of a material. Each component is offset + factor × texel."""

    factor: tuple[float, ...]  # linear light for colours
    texture: Texture | None = None  # None: the texel is 1
    lanes: tuple[int, ...] = (0, 1, 2)  # the texel's components, 0 red … 3 alpha
    offset: tuple[float, ...] = ()  # (): zeros


class Material(NamedTuple):
    """A material of a model file: an input for each channel that it defines.

    Texels of ``normal`` are scaled by the factor and normalized before they are averaged.
    """

    inputs: Mapping[str, Input] = {}
    alpha_mode: AlphaMode = "opaque"
    cutoff: float = 0.5  # of "mask": the least alpha that covers
    name: str = ""
    double_sided: bool = False

    @property
    def textures(self) -> list[Texture]:
        """The images of all inputs."""
        return [entry.texture for entry in self.inputs.values() if entry.texture is not None]

    @property
    def alpha_factor(self) -> float:
        """The factor of its alpha."""
        return self.inputs["alpha"].factor[0] if "alpha" in self.inputs else 1.0

    @property
    def is_covered(self) -> bool:
        """Whether the alpha of the base colour's image is its coverage."""
        color, alpha = self.inputs.get("base_color", Input(())), self.inputs.get("alpha", Input(()))
        if self.alpha_mode == "opaque" or alpha.lanes[0] != 3 or color.texture is None:
            return False
        texels = color.texture.texels
        return alpha.texture is not None and alpha.texture.texels is texels and is_translucent(texels)

    @property
    def normal_slot(self) -> int | None:
        """The number of its normal map's set of texture coordinates; None without a normal map."""
        entry = self.inputs.get("normal")
        return None if entry is None or entry.texture is None else entry.texture.slot


#: The largest number that a half-precision float holds.
MOST_IN_FLOAT16 = 65504.0


class MaterialSource(Source):
    """The channels of a model with materials.

    ``triangle_materials`` (m,) is the material of each triangle. ``colors`` at corners, linear light and
    alpha (rows, 4), multiply ``base_color`` and ``alpha``. ``coordinates`` (rows, 2), by slot, have v down.
    The channels, as far as they are in ``channels``, are ``base_color``, ``alpha`` if a material uses it, and
    all others that a material in use defines. Without ``frames``, in the space of ``rest``, there is no
    ``normal``. An averaged mask compares texels times the material's mean vertex alpha with the cutoff; a
    point uses its vertex alpha.

    Raises ModelError for colours, or texture coordinates in use, that are not finite, and unknown channels.
    """

    def __init__(
        self,
        materials: Sequence[Material],
        triangle_materials: Int32s,
        rest: Float64s,
        triangles: Int32s,
        *,
        colors: Corners | None = None,
        coordinates: Sequence[Corners] = (),
        frames: Frames | None = None,
        name: str = "surface",
        filter: str = "ewa",
        channels: Sequence[str] | None = None,
    ) -> None:
        self.materials = list(materials)
        self.triangle_materials = triangle_materials
        self._used = [self.materials[number] for number in np.unique(triangle_materials)]
        self._rest = rest
        self._triangles = triangles
        self.colors = colors
        self.coordinates = list(coordinates)
        self._frames = frames
        self._name = name
        self._filter = kernel_code(filter)

        self._check()
        names = {"base_color"}.union(*(material.inputs for material in self._used)) - {"alpha"}
        if any(material.alpha_mode != "opaque" for material in self._used):
            names.add("alpha")
        defined = in_order(list(names))
        if channels is not None:
            lacking = [channel for channel in channels if channel not in defined]
            if lacking:
                raise ModelError(f"{name} has no channel {', '.join(lacking)}; it has {', '.join(defined)}")
            defined = [channel for channel in defined if channel in channels]
        if frames is None and "normal" in defined:
            defined.remove("normal")
        self._channels = tuple(map(self._format, defined))

    def evaluate(self, triangles: Int32s, barycentric: Float64s, widths: Float32s) -> Float32s:
        """Return values (n, components): light not multiplied by alpha, fractions, mean directions."""
        (tables, images), (footprints, _) = self._tables, self._footprints
        values = np.empty((len(triangles), tables.gains.shape[1]), np.float32)
        evaluate(tables, images, footprints, self._filter, triangles, barycentric, widths, values)
        return values

    def texel_edges(self, triangles: Int32s) -> Float32s:
        """Return the edges of texels, of the finest image on each triangle; infinity without images."""
        edges: Float32s = self._footprints[1][triangles]
        return edges

    def prepared(self, triangles: Int32s) -> Self:  # noqa: ARG002
        """Return this source with its images and their mip levels built."""
        _ = self._footprints
        return self

    def with_rest(self, rest: Float64s) -> MaterialSource:
        """Return the same source with widths and directions measured on other rest positions (n, 3)."""
        if self._frames is None:
            return self._changed("_footprints", _rest=rest)
        frames = carried(self._frames, self._triangles, self._rest, rest)
        return self._changed("_tables", "_footprints", _rest=rest, _frames=frames)

    def with_filter(self, name: str) -> MaterialSource:
        """Return the same source with its images read by another filter."""
        code = kernel_code(name)
        stale = [] if reads_mips(code) == reads_mips(self._filter) else ["_tables"]
        return self._changed(*stale, _filter=code)

    def only(self, names: Sequence[str]) -> MaterialSource:
        """Return the same source with only these channels, and only their images."""
        forms = tuple(form for form in self._channels if form.name in names)
        return self if forms == self._channels else self._changed("_tables", "_footprints", _channels=forms)

    def _format(self, name: str) -> ChannelFormat:
        form = CHANNELS[name]
        if form.space != "srgb":
            return form
        most = max(
            (_brightest(material.inputs[name]) for material in self._used if name in material.inputs),
            default=1.0,
        )
        if name == "base_color" and self.colors is not None and len(self.colors.values):
            most *= float(self.colors.values[:, :3].max())
        return light_format(form, most)

    def _check(self) -> None:
        """Refuse missing coordinates, and colours and coordinates in use that are not finite."""
        inputs = [entry for material in self.materials for entry in material.inputs.values()]
        are_finite = all(np.isfinite((*entry.factor, *entry.offset)).all() for entry in inputs)
        if not are_finite or (self.colors is not None and not np.isfinite(self.colors.values).all()):
            raise ModelError(f"{self._name}: colours are not all finite; repair the model")
        last = max((texture.slot for material in self._used for texture in material.textures), default=-1)
        if last >= len(self.coordinates):
            raise ModelError(
                f"{self._name}: an image reads set {last} of texture coordinates, which is missing"
            )
        for slot, corners in enumerate(self.coordinates):
            if np.isfinite(corners.values).all():
                continue
            is_reader = [any(t.slot == slot for t in material.textures) for material in self.materials]
            reading = np.array(is_reader, np.bool_)[self.triangle_materials]
            if not np.isfinite(corners.values[corners.rows[reading]]).all():
                raise ModelError(f"{self._name}: texture coordinates are not all finite; repair the model")

    @built_once
    def _footprints(self) -> tuple[Float64s, Float32s]:
        """Return the footprints of width 1 (slots, triangles, 3), and the texels' edges on triangles."""
        tables, images = self._tables
        footprints = np.zeros((*tables.coordinate_rows.shape[:2], 3))
        measure(tables.coordinates, tables.coordinate_rows, self._rest, self._triangles, footprints)
        return footprints, texel_edges(tables, images, footprints)

    @built_once
    def _tables(self) -> tuple[MaterialTables, Images]:
        sizes = [form.components for form in self._channels]
        ends = np.cumsum([0, *sizes]).tolist()
        first_column = {form.name: end for form, end in zip(self._channels, ends, strict=False)}
        count = len(self.materials)
        lanes = np.zeros((count, ends[-1]), np.int32)
        gains = np.ones((count, ends[-1]), np.float32)
        offsets = np.zeros((count, ends[-1]), np.float32)
        stacks, used = _Stacks(), set(np.unique(self.triangle_materials).tolist())
        for number, material in enumerate(self.materials):
            names = list(first_column) if number in used else []  # others may lack coordinates
            lane_of = stacks.add(material, names, self._threshold(number))
            for form, first in zip(self._channels, ends, strict=False):
                columns = slice(first, first + form.components)
                entry = material.inputs.get(form.name)
                if form.space == "direction":
                    has_map = entry is not None and entry.texture is not None
                    gains[number, columns] = 2.0 if has_map else 0.0
                    offsets[number, columns] = -1.0 if has_map else (0.0, 0.0, 1.0)
                elif entry is None:
                    gains[number, columns] = DEFAULTS.get(form.name, 1.0)
                else:
                    # The kernel multiplies alpha by its factor and by vertex colours before thresholds.
                    gains[number, columns] = 1.0 if form.name == "alpha" else entry.factor
                    offsets[number, columns] = entry.offset or 0.0
                if entry is not None and form.name in lane_of:
                    lanes[number, columns] = lane_of[form.name] + np.array(entry.lanes[: form.components])
        images, layout_of = store(stacks.texels, reads_mips(self._filter))
        rows_of_stacks = [(layout_of[image], *rest) for image, *rest in stacks.rows]
        rows_of_stacks.append((0, 0, 0, 0, 0, len(stacks.images)))
        no_colors = Corners(np.empty((0, 4), np.float32), np.empty((0, 3), np.int32))
        no_slot = Corners(np.empty((0, 2), np.float32), np.empty((len(self._triangles), 3), np.int32))
        coordinates, rows = stacked([no_slot, *self.coordinates])
        tables = MaterialTables(
            materials=self.triangle_materials,
            first_stacks=np.array(stacks.first_rows, np.int32),
            stacks=np.array(rows_of_stacks, np.int32),
            images=np.array([*stacks.images, 0], np.int32),
            lanes=lanes,
            gains=gains,
            offsets=offsets,
            alpha_modes=np.array([ALPHA_MODES.index(m.alpha_mode) for m in self.materials], np.uint8),
            alpha_factors=np.array([m.alpha_factor for m in self.materials], np.float32),
            cutoffs=np.array([m.cutoff for m in self.materials], np.float32),
            colors=self.colors or no_colors,
            coordinates=coordinates,
            coordinate_rows=np.stack(rows)[1:],
            frames=self._frames or Frames(no_colors, no_colors),
            **{name: first_column.get(name, -1) for name in ("base_color", "alpha", "normal")},
        )
        return tables, images

    def _threshold(self, number: int) -> float:
        """Return the least texel alpha that passes a mask, at the mean vertex alpha; −1 without a mask."""
        material = self.materials[number]
        if material.alpha_mode != "mask":
            return -1.0
        factor = material.alpha_factor
        if self.colors is not None:
            rows = self.colors.rows[self.triangle_materials == number]
            factor *= float(self.colors.values[rows, 3].mean()) if rows.size else 1.0
        return material.cutoff / factor if factor > 0 else np.inf


class _Stacks:
    """The stacks of images (see `MaterialTables`) of all materials, and their images, without duplicates."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[object, ...], int] = {}
        self.texels: list[ImageTexels] = []
        self.first_rows = [0]
        # The first image, whose size all have; slot, wraps of u and v, flat texels; first row of `images`.
        self.rows: list[tuple[int, int, int, int, int, int]] = []
        self.images: list[int] = []

    def add(self, material: Material, names: Sequence[str], threshold: float) -> dict[str, int]:
        """Add a material's images of these channels; return the first lane of each channel's image."""
        stacks: dict[tuple[object, int, int, bool, int], dict[int, list[str]]] = {}
        for name in names:
            entry = material.inputs.get(name)
            if entry is None or entry.texture is None:
                continue
            texels, wrap_u, wrap_v, nearest, slot = entry.texture
            is_direction = CHANNELS[name].space == "direction"
            is_covered = name in ("base_color", "alpha") and material.is_covered
            is_light = CHANNELS[name].space == "srgb" or is_covered
            cut = threshold if is_covered else -1.0
            key = id(texels), is_light, is_covered, cut, entry.factor if is_direction else None
            if key not in self._numbers:
                self._numbers[key] = len(self.texels)
                texels = unit_directions(texels, entry.factor) if is_direction else texels
                self.texels.append(ImageTexels(texels, is_light, is_covered, cut))
            stack = texels.shape[:2], wrap_u, wrap_v, nearest, slot
            stacks.setdefault(stack, {}).setdefault(self._numbers[key], []).append(name)
        lane_of: dict[str, int] = {}
        lane = 1
        for (_, wrap_u, wrap_v, nearest, slot), readers in stacks.items():
            self.rows.append((next(iter(readers)), slot, wrap_u, wrap_v, int(nearest), len(self.images)))
            for image, channels in readers.items():
                self.images.append(image)
                lane_of |= dict.fromkeys(channels, lane)
                lane += 4
        self.first_rows.append(len(self.rows))
        return lane_of


def light_format(form: ChannelFormat, most: float) -> ChannelFormat:
    """Return the storage format of light up to ``most``: floats if that exceeds 1."""
    if most <= 1.0 + 1e-6:
        return form
    return form._replace(space="linear", dtype="float16" if most <= MOST_IN_FLOAT16 else "float32")


def _brightest(entry: Input) -> float:
    texel = 1.0
    if entry.texture is not None and entry.texture.texels.dtype == np.float32:
        texel = float(entry.texture.texels[..., list(entry.lanes)].max())
    return max(entry.factor) * texel + max(entry.offset, default=0.0)


def unit_directions(texels: Texels, scale: tuple[float, ...]) -> Uint16s:
    """Return a normal map's texels, scaled along x, y and z and normalized, as integers."""
    directions = np.empty(texels.shape, np.uint16)
    _make_unit(texels, 2.0 / ONE[texels.dtype.name], np.array(scale, np.float64), directions)
    return directions


@kernel
def _make_unit(texels: Texels, unit: float, scale: Float64s, directions: Uint16s) -> None:
    for row in range(texels.shape[0]):
        for column in range(texels.shape[1]):
            x = (float(texels[row, column, 0]) * unit - 1.0) * scale[0]
            y = (float(texels[row, column, 1]) * unit - 1.0) * scale[1]
            z = (float(texels[row, column, 2]) * unit - 1.0) * scale[2]
            length = math.sqrt(x * x + y * y + z * z)
            # A zero vector becomes the surface's normal.
            inverse, upward = (1.0 / length, 0.0) if length > 0.0 else (0.0, 1.0)
            directions[row, column, 0] = int((x * inverse + 1.0) * 32767.5 + 0.5)
            directions[row, column, 1] = int((y * inverse + 1.0) * 32767.5 + 0.5)
            directions[row, column, 2] = int((z * inverse + upward + 1.0) * 32767.5 + 0.5)
            directions[row, column, 3] = 65535
