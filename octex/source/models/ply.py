"""PLY models and points.

trimesh does not serve: it reads no binary faces of mixed sizes, and drops the colours of faces.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Int64s, Uint8s, in_runs
from octex.channels import ONE
from octex.errors import ImageError, ModelError, damaged
from octex.files import read_bytes, referred
from octex.jit import kernel
from octex.source.colors import screen_colors
from octex.source.corners import Corners
from octex.source.images.decode import decode_image
from octex.source.images.pyramid import Texels
from octex.source.materials import Texture
from octex.source.mesh import check_below
from octex.source.models.mtl import find_beside
from octex.source.models.reading import (
    Options,
    colored_surface,
    cut_part,
    opaque,
    parse_numbers,
    warn,
    whole_numbers,
)  # fmt: skip
from octex.source.surface import Surface, flip_v

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8", "bool": "u1",
}  # fmt: skip
_CODES = {"u1": 255.0, "u2": 65535.0}
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLORS = (("red", "green", "blue", "alpha"), ("diffuse_red", "diffuse_green", "diffuse_blue", "alpha"),
               ("r", "g", "b", "a"))  # fmt: skip


class _Property(NamedTuple):
    """A property of a PLY element; ``count_type`` is the type of a list's length, None for single values."""

    name: str
    type: str
    count_type: str | None


class _PropertyValues(NamedTuple):
    """A property of all elements: values, and the lengths of lists."""

    values: Array
    sizes: Int64s | None
    type: str


class Ply:
    """A PLY file: its header and the elements that are read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.name
        self.images: list[str] = []
        self._elements: list[tuple[str, int, list[_Property]]] = []
        data = read_bytes(path)
        head = re.match(rb"ply(\s.*?[\r\n])[^\S\n]*end_header[^\S\n]*(\r\n|\n|\r)?", data, re.DOTALL)
        if head is None:
            raise damaged(f"{self.name} is not a PLY file, or its header is truncated")
        self._header(head[1].decode("latin-1"))
        self._body = data[head.end() :]
        self.data = self._read()

    def _header(self, text: str) -> None:
        encoding = ""
        for line in text.splitlines():
            words = line.split()
            try:
                if not words or words[0] == "obj_info":
                    continue
                if words[0] == "format":
                    encoding = words[1]
                elif words[0] == "element":
                    self._elements.append((words[1], int(words[2]), []))
                elif words[0] == "property" and words[1] == "list":
                    properties = self._elements[-1][2]
                    properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
                elif words[0] == "property":
                    self._elements[-1][2].append(_Property(words[2], _TYPES[words[1]], None))
                elif words[0] == "comment" and len(words) > 2 and words[1].lower() == "texturefile":
                    # MeshLab writes <this> for the file's own name without its ending.
                    self.images.append(line.split(None, 2)[2].strip().replace("<this>", self.path.stem))
            except (IndexError, KeyError, ValueError):
                raise damaged(f"{self.name}: the header has a line '{line[:60]}' that is not PLY") from None
        if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise damaged(f"{self.name}: its format '{encoding}' is not one of PLY's")
        self._ascii = encoding == "ascii"
        self._order = ">" if encoding == "binary_big_endian" else "<"

    def _read(self) -> dict[str, dict[str, _PropertyValues]]:
        numbers = parse_numbers(self._body.decode("latin-1") if self._ascii else "")
        if numbers is None:
            raise damaged(f"{self.name}: its data are not all numbers")
        available = len(numbers) if self._ascii else len(self._body)
        raw = np.frombuffer(self._body, np.uint8)
        elements: dict[str, dict[str, _PropertyValues]] = {}
        at = 0
        for element, count, properties in self._elements:
            if not properties:  # such elements take no bytes
                continue
            # In an ASCII file every number has width 1.
            widths = [1 if self._ascii else np.dtype(p.type).itemsize for p in properties]
            kinds = [np.dtype(p.count_type) if p.count_type else None for p in properties]
            heads = [0 if k is None else 1 if self._ascii else k.itemsize for k in kinds]
            least = sum(head if head else width for head, width in zip(heads, widths, strict=True))
            if not 0 <= count * least <= available - at:
                raise self._truncated(element)
            starts = np.empty((count, len(properties)), np.int64)
            sizes = np.ones((count, len(properties)), np.int64)
            layout = np.array([widths, heads], np.int64).reshape(2, -1)
            at = _walk(numbers, raw, at, available, layout, self._order == ">", self._ascii, starts, sizes)
            if at < 0:
                raise self._truncated(element)
            elements[element] = {
                p.name: self._values(p, numbers, raw, starts[:, i], sizes[:, i])
                for i, p in enumerate(properties)
            }
            if element == "face" and count:
                break
        return elements

    def _truncated(self, element: str) -> ModelError:
        return damaged(f"{self.name} is truncated: data of '{element}' elements are missing")

    def _values(
        self, kind: _Property, numbers: Float64s, raw: Uint8s, starts: Int64s, sizes: Int64s
    ) -> _PropertyValues:
        dtype = np.dtype(self._order + kind.type)
        width = 1 if self._ascii else dtype.itemsize
        is_list = kind.count_type is not None
        if is_list:
            starts = np.repeat(starts, sizes) + in_runs(np.zeros_like(sizes), sizes) * width
        if self._ascii:
            values: Array = numbers[starts]
        else:
            values = raw[starts[:, None] + np.arange(width)].view(dtype)[:, 0].astype(kind.type)
        return _PropertyValues(values, sizes if is_list else None, kind.type)

    def _numbers(self, element: str) -> dict[str, _PropertyValues]:
        """Return the properties of an element that are single numbers."""
        return {name: each for name, each in self.data.get(element, {}).items() if each.sizes is None}

    def _positions(self) -> Float64s:
        vertex = self._numbers("vertex")
        if not all(axis in vertex for axis in "xyz"):
            raise damaged(f"{self.name} has no vertices with x, y and z")
        return np.stack([vertex[axis].values for axis in "xyz"], axis=1).astype(np.float64)

    def points(self) -> tuple[Float64s, Float32s, Float64s | None]:
        """Return points (n, 3), linear colours and alpha (n, 4), and normals (n, 3)."""
        positions, vertex = self._positions(), self._numbers("vertex")
        if not len(positions):
            raise damaged(f"{self.name} has no points")
        colors = _element_colors(vertex)
        if colors is None:
            raise ModelError(f"{self.name} has points without colours; export them with red, green and blue")
        if len(colors) and not colors[:, 3].any():
            colors = opaque(colors, self.name)
        normals = None
        if all(axis in vertex for axis in ("nx", "ny", "nz")):
            normals = np.stack([vertex[axis].values for axis in ("nx", "ny", "nz")], axis=1, dtype=np.float64)
        return positions, colors, normals

    def surface(self, options: Options) -> Surface:
        """Return the polygons, or strips, with images, or else colours of vertices, or else of faces."""
        vertex, face = self._numbers("vertex"), self._numbers("face")
        positions = self._positions()
        indices, sizes = self._indices("face")
        if not len(sizes):
            indices = _of_strips(*self._indices("tristrips"))
            sizes = np.full(len(indices) // 3, 3)
        colors = _element_colors(vertex), _element_colors(face)
        part, corners, numbers = cut_part(self.name, positions, indices, sizes, *colors)
        lists = self.data.get("face", {}).get("texcoord")
        if lists is not None and lists.sizes is not None and np.array_equal(lists.sizes, 2 * sizes):
            uv = Corners(flip_v(lists.values.reshape(-1, 2)), corners.astype(np.int32))
            part = part._replace(uv=uv)
        elif names := [names for names in _COORDINATES if vertex.keys() >= set(names)]:
            coordinates = np.stack([vertex[name].values for name in names[0]], axis=1)
            part = part._replace(uv=Corners(flip_v(coordinates), part.triangles))
        if not options.wants("base_color") or not self.images:
            return colored_surface(self.name, options, part)
        if part.uv is None:
            what = f"{self.name} names the image {self.images[0]} but has no texture coordinates"
            warn(f"{what} to read it at, so it is left out; give it some")
            return colored_surface(self.name, options, part)
        # Next to an image, programs repeat its colours or write a meaningless grey.
        part = part._replace(colors=None)
        textures = [Texture(self._image(image)) for image in self.images]
        if "texnumber" in face:
            materials = whole_numbers(face["texnumber"].values)
            check_below(materials, len(textures), f"{self.name}: a face names TextureFile")
            part = part._replace(materials=materials[numbers].astype(np.int32))
        return colored_surface(self.name, options, part, textures)

    def _indices(self, element: str) -> tuple[Int64s, Int64s]:
        """Return the vertices of all faces or strips, and the number of each one's vertices."""
        properties = self.data.get(element, {})
        lists = properties.get("vertex_indices", properties.get("vertex_index"))
        if lists is None or lists.sizes is None:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        return whole_numbers(lists.values), lists.sizes

    def _image(self, image: str) -> Texels:
        what, folder = f"{self.name}: {image}", self.path.parent
        try:
            data = read_bytes(find_beside(folder, image) or referred(folder, image))
        except OSError as error:
            raise ImageError(
                f"{what} cannot be read: {error.strerror or error}; put it next to the model"
            ) from None
        texels = decode_image(data, what)
        texels[..., 3] = ONE[texels.dtype.name]
        return texels


def _element_colors(element: dict[str, _PropertyValues]) -> Float32s | None:
    """Return the linear colours of an element's rows; integers are codes, floats in 0 … 1, or 0 … 255."""
    for names in _COLORS:
        if not all(name in element for name in names[:3]):
            continue
        columns = []
        for values, _, kind in (element[name] for name in names if name in element):
            largest = _CODES.get(kind) or (255.0 if values.max(initial=0.0) > 1.0 else 1.0)
            columns.append(values / largest)
        return screen_colors(np.stack(columns, axis=1))
    return None


def _of_strips(indices: Int64s, sizes: Int64s) -> Int64s:
    """Return the triangles, vertex after vertex, of strips of these sizes; an index −1 ends a strip too."""
    strip = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(indices < 0)
    begins = np.ones(len(indices), np.bool_)
    begins[1:] = (strip[1:] != strip[:-1]) | (indices[:-1] < 0)
    within = np.arange(len(indices))
    within -= np.maximum.accumulate(np.where(begins, within, 0))
    first = np.flatnonzero((within >= 2) & (indices >= 0)) - 2
    # Every other triangle of a strip is listed in reverse order.
    odd = within[first] % 2
    triangles = np.stack([indices[first + odd], indices[first + 1 - odd], indices[first + 2]], axis=1)
    whole: Int64s = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    return whole.ravel()


@kernel
def _walk(
    numbers: Float64s, raw: Uint8s, at: int, available: int, layout: Int64s, big_endian: bool, ascii: bool,
    starts: Int64s, sizes: Int64s,
) -> int:  # fmt: skip
    """Find the start of each row's properties, and the sizes of lists; return the end, −1 for missing data.

    ``layout`` has the widths of values, and of the lengths of lists, 0 for single values.
    """
    for row in range(starts.shape[0]):
        for column in range(starts.shape[1]):
            width, head = layout[0, column], layout[1, column]
            size = 1
            if head > 0:
                if at + head > available:
                    return -1
                size = 0
                if ascii:
                    size = int(min(max(numbers[at], -1.0), 1e9))
                else:
                    for i in range(head):
                        byte = int(raw[at + i]) if big_endian else int(raw[at + head - 1 - i])
                        size = (size << 8) | byte
                at += head
                sizes[row, column] = size
            starts[row, column] = at
            if size < 0 or size > available or at + size * width > available:
                return -1
            at += size * width
    return at
