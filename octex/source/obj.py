"""Wavefront OBJ models and their MTL materials.

Read here and not by trimesh, which takes relative indices as counted from the end of the file, cuts concave
polygons into overlapping fans, and loses which face had which material.

Where the MTL specification leaves open what a number means, the field's practice is followed: Kd and the
colours that some programs append to vertices are sRGB values, as they look on a screen; Kd multiplies map_Kd,
except that black Kd beside a map means nothing (exporters write it for "unset"); the alpha of a colour map is
not opacity, d and Tr are.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import srgb_to_linear
from octex.errors import ImageError, ModelError
from octex.jit import kernel
from octex.source.images import decode_image
from octex.source.materials import Corners, Material, MaterialSource, Texture
from octex.source.polygons import triangulate
from octex.source.pyramid import CLAMP, REPEAT
from octex.source.surface import Surface, flip_v, screen_colors
from octex.source.text import parse_numbers

# How many words follow an option of a texture map; up to three numbers follow the last four.
_OPTION_WORDS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2,
    "-texres": 1, "-type": 1, "-o": 3, "-s": 3, "-t": 3, "-mf": 1,
}  # fmt: skip


def load_obj(path: Path, materials: bool = True) -> Surface:
    """Read an OBJ model with its materials; without them if ``materials`` is false.

    Lines, points, curves, groups and normals are left out. Raises ModelError or ImageError.
    """
    text = _Text(path)
    name = path.name
    vertices = _numbers(text.vertices, 3, name, "v")
    positions = np.ascontiguousarray(vertices[:, :3])
    indices, coordinate_indices, sizes = _faces(text, len(positions), name)
    corners, polygons = triangulate(positions, indices, sizes)
    triangles = indices[corners].astype(np.int32)
    if len(triangles) == 0:
        raise ModelError(f"{name} has no triangles; octex needs a surface, not points or lines")
    colors = None
    if vertices.shape[1] >= 6:
        colors = Corners(_vertex_colors(vertices[:, 3:6]), triangles)
    numbers = np.zeros(len(triangles), np.int32)
    known = [_Described()]
    if materials and text.uses:
        known, numbers = _bind(text, path, polygons, len(sizes))
    coordinates = None
    if any(each.material.texture is not None for each in known):
        coordinates = _coordinates(text, known, numbers, coordinate_indices[corners], name)
    source = MaterialSource(
        [each.material for each in known],
        numbers,
        positions,
        triangles,
        colors=colors,
        coordinates=coordinates,
        name=name,
    )
    return Surface(positions, triangles, source, name=name)


def _vertex_colors(given: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return linear colours of values in 0 … 1, or 0 … 255 if any is above 1; white where there are none."""
    largest = float(np.nanmax(given, initial=0.0))
    return screen_colors(np.nan_to_num(given / (255.0 if largest > 1.0 else 1.0), nan=1.0))


class _Described(NamedTuple):
    """A material, and the change of coordinates that its map asks for: scale, then offset; v up."""

    material: Material = Material()
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


class _Text:
    """An OBJ file cut into its lines by kind."""

    def __init__(self, path: Path) -> None:
        self.vertices: list[str] = []
        self.coordinates: list[str] = []
        self.faces: list[str] = []
        # Numbers of faces, vertices and coordinates read where faces begin to follow other lines: what
        # relative indices count from.
        self.runs: list[tuple[int, int, int]] = []
        self.uses: list[tuple[int, str]] = []  # first face, material
        self.libraries: list[str] = []
        moved = True
        for line in _lines(path):
            key, _, rest = line.partition(" ")
            if key == "v":
                self.vertices.append(rest)
                moved = True
            elif key == "f":
                if moved:
                    self.runs.append((len(self.faces), len(self.vertices), len(self.coordinates)))
                    moved = False
                self.faces.append(rest)
            elif key == "vt":
                self.coordinates.append(rest)
                moved = True
            elif key == "usemtl":
                self.uses.append((len(self.faces), rest.strip()))
            elif key == "mtllib":
                self.libraries.append(rest.strip())


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file without comments, with single blanks after their first word."""
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16", errors="replace")
    else:
        text = data.decode("utf-8-sig", errors="replace")
    if "\0" in text:
        raise ModelError(f"{path.name} is not a text file, so not an {path.suffix[1:].upper()} file")
    if "\\" in text:
        text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    if "\t" in text:
        text = text.replace("\t", " ")
    for line in text.splitlines():
        line = line.strip()
        if "#" in line and not line.startswith(("usemtl", "newmtl", "mtllib", "map_")):
            line = line.partition("#")[0]
        if line:
            yield line


def _numbers(rows: list[str], least: int, name: str, key: str) -> npt.NDArray[np.float64]:
    """Parse rows of numbers; rows that are shorter than others end in NaN. At least ``least`` a row."""
    if not rows:
        return np.empty((0, least), np.float64)
    columns = len(rows[0].split())
    values = parse_numbers(" ".join(rows))
    if values is None or values.size != columns * len(rows) or columns < least:
        counts = np.array([len(row.split()) for row in rows])
        if counts.min() < least:
            short = rows[int(counts.argmin())]
            raise ModelError(
                f"{name}: a line '{key} {short[:40]}' has too few numbers; export the model again"
            )
        if values is None or values.size != counts.sum():
            broken = next(row for row in rows if parse_numbers(row) is None)
            raise ModelError(f"{name}: a line '{key} {broken[:40]}' is not numbers; export the model again")
        columns = int(counts.max())
        ragged = np.full((len(rows), columns), np.nan)
        ragged[np.arange(columns) < counts[:, None]] = values
        return ragged
    return values.reshape(-1, columns)


def _faces(
    text: _Text, vertices: int, name: str
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the vertex and the coordinates (−1 for none) of each corner, and the corners of each face."""
    joined = np.frombuffer("\n".join([*text.faces, ""]).encode(), np.uint8)
    runs = np.array(text.runs, np.int64).reshape(-1, 3)
    bases = np.repeat(runs[:, 1:], np.diff(np.append(runs[:, 0], len(text.faces))), axis=0)
    most = len(joined) // 2 + 1
    corners, sizes = np.empty((most, 2), np.int64), np.empty(len(text.faces), np.int64)
    count = _parse_corners(joined, bases, corners, sizes)
    if count < 0:
        line = text.faces[-1 - count]
        raise ModelError(f"{name}: a line 'f {line[:40]}' is not a face; export the model again")
    corners = corners[:count]
    for column, what, limit in ((0, "vertex", vertices), (1, "texture coordinate", len(text.coordinates))):
        used = corners[:, column]
        lowest = 0 if column == 0 else -1
        if count and not lowest <= used.min() <= used.max() < limit:
            raise ModelError(f"{name}: a face uses a {what} that is not among the {limit}; export it again")
    return np.ascontiguousarray(corners[:, 0]), np.ascontiguousarray(corners[:, 1]), sizes


@kernel
def _parse_corners(
    text: npt.NDArray[np.uint8],
    bases: npt.NDArray[np.int64],
    corners: npt.NDArray[np.int64],
    sizes: npt.NDArray[np.int64],
) -> int:
    """Parse ``vertex[/[coordinates][/[normal]]]`` words; return how many, or −1 − the first bad line.

    Indices count from 1; negative ones back from ``bases``, what had been read at the face. −1 stands for no
    coordinates, −2 for an index that cannot be.
    """
    count = line = size = at = 0
    while at < len(text):
        letter = text[at]
        if letter == 32 or letter == 13:
            at += 1
            continue
        if letter == 10:
            sizes[line] = size
            line, size, at = line + 1, 0, at + 1
            continue
        corners[count, 1] = -1
        for part in range(3):
            negative = text[at] == 45
            if negative:
                at += 1
            digits, value = 0, 0
            while 48 <= text[at] <= 57 and digits < 18:
                value = value * 10 + int(text[at]) - 48
                digits += 1
                at += 1
            if digits == 0 and (part == 0 or negative):
                return -1 - line
            if part < 2 and digits > 0:
                index = bases[line, part] - value if negative else value - 1
                corners[count, part] = index if index >= 0 and value > 0 else -2
            if text[at] != 47:
                break
            at += 1
        if text[at] != 32 and text[at] != 10 and text[at] != 13:
            return -1 - line
        count += 1
        size += 1
    return count


def _bind(
    text: _Text, path: Path, polygons: npt.NDArray[np.int64], faces: int
) -> tuple[list[_Described], npt.NDArray[np.int32]]:
    """Return the materials in use, and the number of each triangle's."""
    library: dict[str, _Described] = {}
    if text.libraries:
        wanted = {material for _, material in text.uses}
        for each in text.libraries:
            library |= _load_library(path, each, wanted)
    names: list[str] = []
    numbers = np.zeros(faces, np.int32)
    starts = [first for first, _ in text.uses]
    known = [_Described()]
    for first, end, material in zip(starts, [*starts[1:], faces], (m for _, m in text.uses), strict=True):
        if first == end or not text.libraries:  # no faces, or no materials promised
            continue
        if material not in library:
            raise ModelError(
                f"{path.name} uses the material {material}, which {', '.join(text.libraries)} does not "
                "define; add it there, or remove the usemtl line"
            )
        if material not in names:
            names.append(material)
            known.append(library[material])
        numbers[first:end] = 1 + names.index(material)
    return known, numbers[polygons]


def _load_library(path: Path, line: str, wanted: set[str]) -> dict[str, _Described]:
    """Read the materials of a mtllib line: one file whose name may hold blanks, or several."""
    found = _beside(path.parent, line)
    files = [found] if found is not None else [_beside(path.parent, word) for word in line.split()]
    materials: dict[str, _Described] = {}
    for each in files:
        if each is None:
            raise ModelError(
                f"{path.name}: the material file {line} is missing; put it beside the model, or remove the "
                "mtllib line to do without colours"
            )
        materials |= _parse_library(each, wanted)
    return materials


def _beside(folder: Path, name: str) -> Path | None:
    """Find a file by a path relative to a folder, or by its name there if the path leads nowhere."""
    windows = PureWindowsPath(name)
    for candidate in (folder / name, folder / windows.as_posix(), folder / windows.name):
        try:
            if candidate.is_file():
                return candidate
        except (OSError, ValueError):
            continue
    return None


def _parse_library(path: Path, wanted: set[str]) -> dict[str, _Described]:
    """Read the wanted materials of an MTL file."""
    materials: dict[str, _Described] = {}
    current: dict[str, str] = {}
    images: dict[Path, npt.NDArray[np.uint16]] = {}
    name = None
    for line in [*_lines(path), "newmtl"]:
        key, _, rest = line.partition(" ")
        if key == "newmtl":
            if name is not None and name in wanted:
                materials[name] = _describe(current, name, path, images)
            name, current = rest.strip(), {}
        else:
            current[key.lower()] = rest.strip()
    return materials


def _describe(
    entries: dict[str, str], name: str, path: Path, images: dict[Path, npt.NDArray[np.uint16]]
) -> _Described:
    """Turn the lines of one material into what is read from it."""
    where = f"{path.name}: material {name}"
    color = _floats(entries.get("kd", "1 1 1"), 3, f"{where}: Kd")
    if len(color) < 3:
        color = [color[0]] * 3
    if "d" in entries:
        alpha = _floats(entries["d"].replace("-halo", ""), 1, f"{where}: d")[0]
    else:
        alpha = 1.0 - _floats(entries.get("tr", "0"), 1, f"{where}: Tr")[0]
    texture, scale, offset = None, (1.0, 1.0), (0.0, 0.0)
    if "map_kd" in entries:
        file, options = _map(entries["map_kd"])
        found = _beside(path.parent, file)
        if found is None:
            raise ImageError(f"{where}: the image {file} is missing; put it beside {path.name}")
        if found not in images:
            images[found] = decode_image(found.read_bytes(), f"{where}: {file}")
            images[found][..., 3] = 65535
        wrap = CLAMP if options.get("-clamp", ["off"])[0] == "on" else REPEAT
        texture = Texture(images[found], wrap, wrap)
        scale = _pair(options.get("-s", []), 1.0, f"{where}: -s")
        offset = _pair(options.get("-o", []), 0.0, f"{where}: -o")
        if max(color) == 0.0:
            color = [1.0, 1.0, 1.0]
    red, green, blue = srgb_to_linear(np.clip(color, 0.0, 1.0)).tolist()
    material = Material((red, green, blue, alpha), texture, "blend" if alpha < 1.0 else "opaque")
    return _Described(material, scale, offset)


def _floats(text: str, most: int, what: str) -> list[float]:
    values = parse_numbers(text)
    if values is None or values.size == 0 or not np.isfinite(values).all():
        raise ModelError(f"{what} is '{text[:40]}', not numbers; octex reads RGB values")
    return [float(value) for value in values[:most]]


def _pair(words: list[str], default: float, what: str) -> tuple[float, float]:
    values = [*_floats(" ".join(words), 2, what), default] if words else [default, default]
    return values[0], values[1]


def _map(text: str) -> tuple[str, dict[str, list[str]]]:
    """Split a texture map's line into the file, whose name may hold blanks, and the options before it."""
    options: dict[str, list[str]] = {}
    rest = text.strip()
    while rest.split(" ", 1)[0].lower() in _OPTION_WORDS:
        option, _, rest = rest.partition(" ")
        words: list[str] = []
        for _ in range(_OPTION_WORDS[option.lower()]):
            word, _, after = rest.lstrip().partition(" ")
            if option.lower() in ("-o", "-s", "-t") and parse_numbers(word) is None:
                break
            words.append(word)
            rest = after
        options[option.lower()] = words
        rest = rest.lstrip()
    return rest, options


def _coordinates(
    text: _Text,
    known: list[_Described],
    numbers: npt.NDArray[np.int32],
    rows: npt.NDArray[np.int64],
    name: str,
) -> Corners:
    """Bind texture coordinates, changed as each material's map asks for."""
    textured = np.array([each.material.texture is not None for each in known])[numbers]
    if (rows[textured] < 0).any():
        raise ModelError(
            f"{name} has textured faces without texture coordinates; give them some, or remove the texture"
        )
    plain = _numbers(text.coordinates, 1, name, "vt")
    if plain.shape[1] == 1:
        plain = np.append(plain, np.zeros_like(plain), axis=1)
    plain = np.where(np.isnan(plain), 0.0, plain)[:, :2]
    values, bound = [flip_v(plain)], np.maximum(rows, 0)
    for number, each in enumerate(known):
        if each.scale != (1.0, 1.0) or each.offset != (0.0, 0.0):
            bound[numbers == number] += len(plain) * len(values)
            values.append(flip_v(plain * each.scale + each.offset))
    return Corners(np.concatenate(values), bound.astype(np.int32))
