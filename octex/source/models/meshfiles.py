"""PLY, OFF and STL models.

PLY is read here and not by trimesh, which knows no binary faces of mixed sizes and drops what colours faces.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octex.arrays import Array, Float32s, Float64s, Int32s, Int64s, Uint8s
from octex.channels import ONE
from octex.errors import ImageError, ModelError, ModelWarning
from octex.files import read_bytes, referred
from octex.jit import kernel
from octex.source.colors import screen_colors
from octex.source.corners import Corners, Polygons
from octex.source.images.decode import decode_image, global_settings
from octex.source.images.pyramid import Texels
from octex.source.materials import AlphaMode, Input, Material, MaterialSource, Texture
from octex.source.models.polygons import cut_polygons, triangulate
from octex.source.models.reading import Options, parse_numbers, whole_numbers
from octex.source.surface import Surface, flip_v

# Keeps traces of damaged normals off the screen where no program asks for logs.
_quiet = logging.NullHandler()

_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8", "bool": "u1",
}  # fmt: skip
_PLY_CODES = {"u1": 255.0, "u2": 65535.0}
_PLY_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_PLY_COLORS = (("red", "green", "blue", "alpha"), ("diffuse_red", "diffuse_green", "diffuse_blue", "alpha"),
               ("r", "g", "b", "a"))  # fmt: skip


def load_ply(path: Path, options: Options) -> Surface:
    """Read a PLY model: colours of vertices, or else of faces, and the images of its TextureFile comments.

    Faces are polygons, or strips of triangles where there are none, as range scans have them.
    Colours are sRGB values; texture coordinates, of vertices or of faces, have v up.
    Raises ModelError or ImageError.
    """
    return _Ply(path).surface(options)


def ply_points(
    path: Path,
) -> tuple[Float64s, Float32s, Float64s | None]:
    """Read the vertices of a PLY file as points (n, 3), linear colours and alpha (n, 4), and normals (n, 3).

    Raises ModelError for a file without vertices or without their colours.
    """
    return _Ply(path).points()


def load_off(path: Path, options: Options) -> Surface:
    """Read an OFF model: colours of vertices, or else of faces, are sRGB values. Raises ModelError."""
    return _Off(path).surface(options)


def load_stl(path: Path, options: Options) -> Surface:
    """Read an STL model, through trimesh; it is white. Raises ModelError."""
    import trimesh  # takes a third of a second

    logging.getLogger("trimesh").addHandler(_quiet)
    data = read_bytes(path)
    if len(data) != 84 + 50 * int.from_bytes(data[80:84], "little"):  # not of the binary kind
        if b"endsolid" not in data.lower():
            raise ModelError(f"{path.name} is truncated, or not an STL file; export it again")
        # For text that is not UTF-8 trimesh asks a package that need not be there.
        data = data.decode("latin-1").encode()
    with global_settings():
        warnings.simplefilter("ignore")
        # Else trimesh leaves out all that follows the first word that is no number.
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
        try:
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
        except (DeprecationWarning, ValueError):
            raise ModelError(
                f"{path.name}: a facet's vertices are not three times three numbers; export it again"
            ) from None
    faces = np.array(mesh.faces, np.int64)
    shape = cut_shape(path.name, np.array(mesh.vertices, np.float64), faces.ravel(), np.full(len(faces), 3))
    return colored_surface(path.name, options, shape, None)


class _Shape(NamedTuple):
    """Polygons, cut into triangles."""

    positions: Float64s
    triangles: Int32s
    corners: Int64s  # (triangles, 3)   which of all corners of polygons each corner is
    numbers: Int64s  # (triangles,)     the polygon of each
    polygons: Polygons | None

    def colors(self, of_vertices: Float32s | None, of_polygons: Float32s | None) -> Corners | None:
        """Bind the colours of vertices, or else of polygons."""
        if of_vertices is not None:
            return Corners(of_vertices, self.triangles)
        if of_polygons is not None:
            return Corners(of_polygons, np.repeat(self.numbers.astype(np.int32), 3).reshape(-1, 3))
        return None


def cut_shape(
    name: str,
    positions: Float64s,
    indices: Int64s,
    sizes: Int64s,
) -> _Shape:
    """Cut polygons, of so many of the vertices ``indices`` each, into triangles."""
    if len(indices) and not 0 <= indices.min() <= indices.max() < len(positions):
        raise ModelError(f"{name}: a face uses a vertex that is not among the {len(positions)}")
    corners, numbers = triangulate(positions, indices, sizes)
    if len(corners) == 0:
        raise ModelError(f"{name} has no triangles; octex needs a surface, not points or lines")
    triangles = indices[corners].astype(np.int32)
    return _Shape(positions, triangles, corners, numbers, cut_polygons(corners, numbers, sizes))


def colored_surface(
    name: str,
    options: Options,
    shape: _Shape,
    colors: Corners | None,
    textures: Sequence[Texture | None] = (None,),
    numbers: Int32s | None = None,
    coordinates: Corners | None = None,
) -> Surface:
    """Build a surface of colours and textures alone; alpha of colours counts unless it is 0 everywhere."""
    if colors is not None and not colors.values[colors.rows, 3].any():
        colors = colors._replace(values=_opaque(colors.values, name))
    translucent = colors is not None and bool((colors.values[:, 3] < 1).any())
    mode: AlphaMode = "blend" if translucent else "opaque"
    materials = [
        Material({"base_color": Input((1.0, 1.0, 1.0), each), "alpha": Input((1.0,), each, (3,))}, mode)
        for each in textures
    ]
    if numbers is None:
        numbers = np.zeros(len(shape.triangles), np.int32)
    source = MaterialSource(
        materials,
        numbers,
        shape.positions,
        shape.triangles,
        colors=colors,
        coordinates=[] if coordinates is None else [coordinates],
        name=name,
        filter=options.filter,
        channels=options.channels,
    )
    return Surface(
        shape.positions, shape.triangles, source, uv=coordinates, polygons=shape.polygons, name=name
    )


class _Property(NamedTuple):
    """A property of a PLY element: its values' type, and for a list the type of its length."""

    name: str
    type: str
    count_type: str | None


class _Values(NamedTuple):
    """A property of all elements: values, and for a list how many belong to each."""

    values: Array
    sizes: Int64s | None
    type: str


def _opaque(colors: Float32s, name: str) -> Float32s:
    """Return colours with alpha 1: such as some programs write with 0 throughout, and show all the same."""
    text = f"{name}: all its colours have alpha 0, which would show nothing, so it is left out"
    warnings.warn(text + "; export them with 255", ModelWarning, stacklevel=2)
    made = colors.copy()
    made[:, 3] = 1.0
    return made


class _Ply:
    """A PLY file: its header and the elements that are read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.name
        self.images: list[str] = []
        self._elements: list[tuple[str, int, list[_Property]]] = []
        data = read_bytes(path)
        head = re.match(rb"ply\s(.*?)\bend_header[^\S\n]*(\r\n|\n|\r)?", data, re.DOTALL)
        if head is None:
            raise ModelError(f"{self.name} is not a PLY file, or its header is truncated")
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
                    properties.append(_Property(words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
                elif words[0] == "property":
                    self._elements[-1][2].append(_Property(words[2], _PLY_TYPES[words[1]], None))
                elif words[0] == "comment" and len(words) > 2 and words[1].lower() == "texturefile":
                    self.images.append(line.split(None, 2)[2].strip())
            except (IndexError, KeyError, ValueError):
                raise ModelError(
                    f"{self.name}: the header has a line '{line[:60]}' that is not PLY"
                ) from None
        if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise ModelError(f"{self.name}: its format '{encoding}' is not one of PLY's")
        self._ascii = encoding == "ascii"
        self._order = ">" if encoding == "binary_big_endian" else "<"

    def _read(self) -> dict[str, dict[str, _Values]]:
        """Read the properties of all elements up to the faces."""
        if self._ascii:
            parsed = parse_numbers(self._body.decode("latin-1"))
            if parsed is None:
                raise ModelError(f"{self.name}: its data are not all numbers; export it again")
            numbers = parsed
            available = len(numbers)
        else:
            numbers = np.empty(0, np.float64)
            available = len(self._body)
        raw = np.frombuffer(self._body, np.uint8)
        found: dict[str, dict[str, _Values]] = {}
        at = 0
        for element, count, properties in self._elements:
            if not properties:  # however many there are, they take no place
                continue
            # In an ASCII file every number takes one place, whatever its type.
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
            found[element] = {
                p.name: self._values(p, numbers, raw, starts[:, i], sizes[:, i])
                for i, p in enumerate(properties)
            }
            if element == "face":
                break
        return found

    def _truncated(self, element: str) -> ModelError:
        return ModelError(f"{self.name} is truncated: data of '{element}' elements are missing")

    def _values(
        self,
        kind: _Property,
        numbers: Float64s,
        raw: Uint8s,
        starts: Int64s,
        sizes: Int64s,
    ) -> _Values:
        dtype = np.dtype(self._order + kind.type)
        width = 1 if self._ascii else dtype.itemsize
        is_list = kind.count_type is not None
        if is_list:
            within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
            starts = np.repeat(starts, sizes) + within * width
        if self._ascii:
            values: Array = numbers[starts]
        else:
            values = raw[starts[:, None] + np.arange(width)].view(dtype)[:, 0].astype(kind.type)
        return _Values(values, sizes if is_list else None, kind.type)

    def _numbers(self, element: str) -> dict[str, _Values]:
        """Return the properties of an element that are a number each, not a list."""
        return {name: each for name, each in self.data.get(element, {}).items() if each.sizes is None}

    def _positions(self) -> Float64s:
        vertex = self._numbers("vertex")
        if not all(axis in vertex for axis in "xyz"):
            raise ModelError(f"{self.name} has no vertices with x, y and z")
        return np.stack([vertex[axis].values for axis in "xyz"], axis=1).astype(np.float64)

    def points(
        self,
    ) -> tuple[Float64s, Float32s, Float64s | None]:
        positions, vertex = self._positions(), self._numbers("vertex")
        colors = _ply_colors(vertex)
        if colors is None:
            raise ModelError(f"{self.name} has points without colours; export them with red, green and blue")
        if len(colors) and not colors[:, 3].any():
            colors = _opaque(colors, self.name)
        normals = None
        if all(axis in vertex for axis in ("nx", "ny", "nz")):
            normals = np.stack([vertex[axis].values for axis in ("nx", "ny", "nz")], axis=1)
        return positions, colors, None if normals is None else normals.astype(np.float64)

    def surface(self, options: Options) -> Surface:
        vertex, face = self._numbers("vertex"), self._numbers("face")
        lists = self.data.get("face", {})
        positions = self._positions()
        listed = lists.get("vertex_indices", lists.get("vertex_index"))
        indices = sizes = np.empty(0, np.int64)
        if listed is not None and listed.sizes is not None:
            indices, sizes = whole_numbers(listed.values), listed.sizes
        strips = self.data.get("tristrips", {})
        listed = strips.get("vertex_indices", strips.get("vertex_index"))
        if not len(sizes) and listed is not None and listed.sizes is not None:
            indices = _of_strips(whole_numbers(listed.values), listed.sizes)
            sizes = np.full(len(indices) // 3, 3)
        shape = cut_shape(self.name, positions, indices, sizes)
        colors = shape.colors(_ply_colors(vertex), _ply_colors(face))
        coordinates = self._coordinates(vertex, lists.get("texcoord"), shape, sizes)
        if not options.wants("base_color") or not self.images:
            return colored_surface(self.name, options, shape, colors, coordinates=coordinates)
        if coordinates is None:
            text = (
                f"{self.name} names the image {self.images[0]} but has no texture coordinates to read it at"
            )
            warnings.warn(text + ", so it is left out; give it some", ModelWarning, stacklevel=2)
            return colored_surface(self.name, options, shape, colors)
        textures = [Texture(self._image(image)) for image in self.images]
        numbers = None
        if "texnumber" in face:
            chosen = whole_numbers(face["texnumber"].values)
            if not 0 <= chosen.min() <= chosen.max() < len(textures):
                raise ModelError(
                    f"{self.name}: a face's texnumber is not among its {len(textures)} TextureFiles"
                )
            numbers = chosen[shape.numbers].astype(np.int32)
        return colored_surface(self.name, options, shape, colors, textures, numbers, coordinates)

    def _coordinates(
        self,
        vertex: dict[str, _Values],
        listed: _Values | None,
        shape: _Shape,
        sizes: Int64s,
    ) -> Corners | None:
        if listed is not None and listed.sizes is not None and np.array_equal(listed.sizes, 2 * sizes):
            return Corners(flip_v(listed.values.reshape(-1, 2)), shape.corners.astype(np.int32))
        for u, v in _PLY_COORDINATES:
            if u in vertex and v in vertex:
                return Corners(
                    flip_v(np.stack([vertex[u].values, vertex[v].values], axis=1)), shape.triangles
                )
        return None

    def _image(self, image: str) -> Texels:
        what = f"{self.name}: {image}"
        try:
            data = read_bytes(referred(self.path.parent, image))
        except OSError as error:
            raise ImageError(
                f"{what} cannot be read: {error.strerror or error}; put it beside the model"
            ) from None
        texels = decode_image(data, what)
        texels[..., 3] = ONE[texels.dtype.name]
        return texels


def _ply_colors(element: dict[str, _Values]) -> Float32s | None:
    """Return the linear colours of an element's rows; integers are codes, floats in 0 … 1, or 0 … 255."""
    for names in _PLY_COLORS:
        if not all(name in element for name in names[:3]):
            continue
        columns = []
        for each in (element[name] for name in names if name in element):
            largest = _PLY_CODES.get(each.type)
            if largest is None:
                largest = 255.0 if each.values.max(initial=0.0) > 1.0 else 1.0
            columns.append(each.values / largest)
        return screen_colors(np.stack(columns, axis=1))
    return None


def _of_strips(indices: Int64s, sizes: Int64s) -> Int64s:
    """Return the triangles, vertex after vertex, of strips of so many indices, which −1 also ends."""
    strip = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(indices < 0)
    begins = np.ones(len(indices), np.bool_)
    begins[1:] = (strip[1:] != strip[:-1]) | (indices[:-1] < 0)
    place = np.arange(len(indices))
    place -= np.maximum.accumulate(np.where(begins, place, 0))
    first = np.flatnonzero((place >= 2) & (indices >= 0)) - 2
    # Every other triangle of a strip is listed the other way round.
    odd = place[first] % 2
    triangles = np.stack([indices[first + odd], indices[first + 1 - odd], indices[first + 2]], axis=1)
    whole: Int64s = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    return whole.ravel()


@kernel
def _walk(
    numbers: Float64s,
    raw: Uint8s,
    at: int,
    available: int,
    layout: Int64s,
    big_endian: bool,
    ascii: bool,
    starts: Int64s,
    sizes: Int64s,
) -> int:
    """Find where each property of each row starts, and the sizes of lists; return where the last row ends.

    ``layout`` holds the width of a value and of a list's length, 0 if it is no list. −1: the data end before.
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


class _Off:
    """An OFF file: vertices, with colours if it says so, and faces, with colours after their corners."""

    def __init__(self, path: Path) -> None:
        self.name = path.name
        lines = read_bytes(path).decode("latin-1").splitlines()
        lines = [line.partition("#")[0] if "#" in line else line for line in lines]
        lines = [line for line in lines if line and not line.isspace()]
        first = lines.pop(0).split() if lines else [""]
        head = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF", first[0])
        if head is None:
            raise ModelError(f"{self.name} is not an OFF file: its first word is not OFF")
        if head[4] or head[5] or "BINARY" in first:
            raise ModelError(f"{self.name} is a kind of OFF file that octex does not read; convert it to PLY")
        self._skip = 6 if head[3] else 3  # numbers before a vertex's colour
        self._tail = 2 if head[1] else 0
        counts = first[1:] or (lines.pop(0).split() if lines else [])
        try:
            vertices, faces = int(counts[0]), int(counts[1])
        except (IndexError, ValueError):
            raise ModelError(f"{self.name}: the numbers of vertices and faces are missing") from None
        if vertices < 0 or faces < 0 or vertices + faces > len(lines):
            raise ModelError(f"{self.name} is truncated: it has fewer lines than vertices and faces")
        self._vertices = self._rows(lines[:vertices])
        self._faces = self._rows(_whole_faces(lines[vertices:], faces))

    def _rows(self, lines: list[str]) -> _Rows:
        counts = np.array([len(line.split()) for line in lines], np.int64)
        values = parse_numbers(" ".join(lines))
        if values is None or values.size != counts.sum():
            raise ModelError(f"{self.name}: a vertex or a face is not numbers; export it again")
        return _Rows(values, np.cumsum(counts) - counts, counts)

    def surface(self, options: Options) -> Surface:
        vertices, faces = self._vertices, self._faces
        if len(vertices.counts) and vertices.counts.min() < 3:
            raise ModelError(f"{self.name}: a vertex has less than three numbers; export it again")
        positions = vertices.values[vertices.starts[:, None] + np.arange(3)]
        sizes = whole_numbers(faces.values[faces.starts])
        if not ((sizes >= 0) & (sizes < faces.counts)).all():
            raise ModelError(f"{self.name}: a face has fewer corners than it says; export it again")
        within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        indices = whole_numbers(faces.values[np.repeat(faces.starts + 1, sizes) + within])
        shape = cut_shape(self.name, positions, indices, sizes)
        of_vertices = _off_colors(vertices, np.full(len(positions), self._skip), self._tail)
        of_faces = _off_colors(faces, sizes + 1, 0)
        return colored_surface(self.name, options, shape, shape.colors(of_vertices, of_faces))


def _whole_faces(lines: list[str], count: int) -> list[str]:
    """Return a line a face; of a file that goes on to the next line within a face, joined ones."""
    if all(len(line.split()) > int(line.split()[0]) for line in lines[:count] if line.split()[0].isdigit()):
        return lines[:count]
    words = iter(" ".join(lines).split())
    faces = [[word, *islice(words, int(word))] for word in islice(words, count) if word.isdigit()]
    return [" ".join(face) for face in faces]


class _Rows(NamedTuple):
    """Numbers by lines."""

    values: Float64s
    starts: Int64s
    counts: Int64s


def _off_colors(rows: _Rows, skip: Int64s, tail: int) -> Float32s | None:
    """Return the linear colours after ``skip`` numbers of each row; white where less than three are left.

    Values are 0 … 255 if any is above 1, else 0 … 1. One number alone is a place in a colour map that the
    file does not hold. None if no row has a colour.
    """
    left = rows.counts - skip - tail
    colored = left >= 3
    if not colored.any():
        return None
    colors = np.full((len(left), 4), np.nan)
    for column in range(4):
        given = colored & (left > column)
        colors[given, column] = rows.values[(rows.starts + skip)[given] + column]
    if np.nanmax(colors) > 1.0:
        colors /= 255.0
    return screen_colors(np.where(np.isnan(colors), 1.0, colors))
