"""Wavefront OBJ models.

trimesh does not serve: it counts relative indices from the end of the file, cuts concave polygons into
overlapping fans, and loses the faces' materials. Colours appended to vertices are sRGB values.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from octex.arrays import Float64s, Int32s, Int64s, Uint8s
from octex.errors import damaged
from octex.files import read_bytes
from octex.jit import kernel
from octex.source.colors import guessed_colors
from octex.source.corners import Corners, Creases
from octex.source.models.mtl import load_materials, wavefront_lines
from octex.source.models.reading import (
    LoadedMaterial,
    Options,
    PlacedMesh,
    assembled,
    check_among,
    cut_part,
    parse_numbers,
    slot_coordinates,
    warn,
    with_frames,
)  # fmt: skip
from octex.source.surface import Surface, flip_v

_LISTED = 5


def load_obj(path: Path, options: Options) -> Surface:
    """Read an OBJ model, without lines, points, curves and groups; missing materials are white."""
    text = _Text(path)
    name = path.name
    vertices = _numbers(text.vertices, 3, name, "v")
    positions = np.ascontiguousarray(vertices[:, :3])
    indices, sizes = _faces(text, name)
    colors = guessed_colors(vertices[:, 3:6]) if vertices.shape[1] >= 6 else None
    part, corners, polygons = cut_part(name, positions, np.ascontiguousarray(indices[:, 0]), sizes, colors)
    materials = [LoadedMaterial()]
    files: dict[str, str] = {}
    if options.materials and text.uses:
        materials, numbers, files = _bind(text, path, polygons, len(sizes), options)
        part = part._replace(materials=numbers)
        part = _white_below_images(part, materials)
    rows = indices[corners, 1]
    by_number, uv = dict(enumerate(materials)), None
    if options.materials and (any(each.slots for each in materials) or (rows >= 0).all()):
        upright, of_corners = _coordinates(text, materials, part.materials, rows, name)
        uv = Corners(flip_v(upright), of_corners)
        coordinates = slot_coordinates(by_number, part.materials, lambda _: (upright, of_corners))
        part = part._replace(coordinates=coordinates, uv=uv if (rows >= 0).all() else None)
    is_mapped = uv is not None and any(each.material.normal_slot is not None for each in materials)
    normals = _normals(text, indices[corners, 2], name) if is_mapped or options.normals else None
    if is_mapped or normals is not None:
        part = with_frames(part, by_number, normals, uv)
    return assembled(
        [part],
        [each.material for each in materials],
        options,
        name,
        provenance={"files": json.dumps(files, sort_keys=True)} if files else {},
        creases=_creases(text.tags, len(positions), name),
    )


class _Text:
    """The lines of an OBJ file by their first word, without it."""

    def __init__(self, path: Path) -> None:
        lines: dict[str, list[str]] = {key: [] for key in ("f", "v", "vt", "vn", "mtllib", "t")}
        self.faces, self.vertices, self.coordinates, self.normals, self.libraries, self.tags = lines.values()
        # The numbers of faces, vertices, coordinates and normals before each run of faces: relative indices
        # count from them.
        self.runs: list[list[int]] = []
        self.uses: list[tuple[int, str]] = []  # first face, material
        is_new_run = True
        for line in wavefront_lines(read_bytes(path), path):
            key, _, rest = line.partition(" ")
            if key == "f":
                if is_new_run:
                    self.runs.append([len(lines[word]) for word in ("f", "v", "vt", "vn")])
                    is_new_run = False
                self.faces.append(rest)
            elif key in lines:
                lines[key].append(rest)
                is_new_run = True
            elif key == "usemtl":
                self.uses.append((len(self.faces), rest.strip()))


def _creases(tags: list[str], vertices: int, name: str) -> Creases | None:
    """Return the sharp edges and vertices, counted from 0, of OpenSubdiv's tags; None without any.

    A tag has its kind, its counts of whole numbers, fractions and words, like 2/1/0, and these.
    """
    edges: list[tuple[list[int], float]] = []  # vertices, and their sharpness
    points: list[tuple[list[int], float]] = []
    for tag in tags:
        kind, *words = tag.split() or [""]
        if kind not in ("crease", "corner"):
            continue
        try:
            wholes, fractions, _ = (int(count) for count in words[0].split("/"))
            numbers = [int(word) for word in words[1 : 1 + wholes]]
            (sharp,) = [float(word) for word in words[1 + wholes : 1 + wholes + fractions]]
            is_sound = len(numbers) == (2 if kind == "crease" else 1) and 0 <= sharp < np.inf
            if not is_sound or not all(0 <= number < vertices for number in numbers):
                raise ValueError
            (edges if kind == "crease" else points).append((numbers, sharp))
        except (IndexError, ValueError):
            raise damaged(f"{name}: a line 't {tag[:40]}' is not a crease tag") from None
    if not edges and not points:
        return None
    return Creases(
        np.array([ends for ends, _ in edges], np.int32).reshape(-1, 2),
        np.array([sharp for _, sharp in edges], np.float32),
        np.array([vertex for vertex, _ in points], np.int32).reshape(-1),
        np.array([sharp for _, sharp in points], np.float32),
    )


def _numbers(rows: list[str], least: int, name: str, key: str) -> Float64s:
    """Parse rows of at least ``least`` numbers; shorter rows are filled with NaN."""
    if not rows:
        return np.empty((0, least), np.float64)
    columns = len(rows[0].split())
    values = parse_numbers(" ".join(rows))
    if values is not None and values.size == columns * len(rows) and columns >= least:
        return values.reshape(-1, columns)
    counts = np.array([len(row.split()) for row in rows])
    if counts.min() < least:
        short = rows[int(counts.argmin())]
        raise damaged(f"{name}: a line '{key} {short[:40]}' has too few numbers")
    if values is None or values.size != counts.sum():
        broken = next(row for row in rows if parse_numbers(row) is None)
        raise damaged(f"{name}: a line '{key} {broken[:40]}' is not numbers")
    ragged = np.full((len(rows), int(counts.max())), np.nan)
    ragged[np.arange(ragged.shape[1]) < counts[:, None]] = values
    return ragged


def _faces(text: _Text, name: str) -> tuple[Int64s, Int64s]:
    """Return the vertex, the coordinates and the normal (−1 for none) of each corner; each face's corners."""
    joined = np.frombuffer("\n".join([*text.faces, ""]).encode(), np.uint8)
    runs = np.array(text.runs, np.int64).reshape(-1, 4)
    bases = np.repeat(runs[:, 1:], np.diff(np.append(runs[:, 0], len(text.faces))), axis=0)
    most = len(joined) // 2 + 1
    corners, sizes = np.empty((most, 3), np.int64), np.empty(len(text.faces), np.int64)
    count = _parse_corners(joined, bases, corners, sizes)
    if count < 0:
        line = text.faces[-1 - count]
        raise damaged(f"{name}: a line 'f {line[:40]}' is not a face")
    corners = corners[:count]
    for column, listed in ((1, text.coordinates), (2, text.normals)):
        if not listed:  # several exporters refer to coordinates or normals that they do not write
            corners[:, column] = -1
    what = f"{name}: a face uses a texture coordinate"
    check_among(corners[:, 1], len(text.coordinates), what, least=-1)
    return corners, sizes


@kernel
def _parse_corners(text: Uint8s, bases: Int64s, corners: Int64s, sizes: Int64s) -> int:
    """Parse ``vertex[/[coordinates][/[normal]]]`` words; return their number, or −1 − the first bad line.

    Negative indices count back from ``bases``. −1 means none, −2 an impossible index.
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
        corners[count, 1] = corners[count, 2] = -1
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
            if digits > 0:
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
    text: _Text, path: Path, polygons: Int64s, faces: int, options: Options
) -> tuple[list[LoadedMaterial], Int32s, dict[str, str]]:
    """Return the materials in use, the number of each triangle's, and the digests of the files read."""
    ends = [*(first for first, _ in text.uses[1:]), faces]
    uses = [(first, end, name) for (first, name), end in zip(text.uses, ends, strict=True) if first < end]
    numbers = np.zeros(faces, np.int32)
    if not text.libraries:
        return [LoadedMaterial()], numbers[polygons], {}
    names = list(dict.fromkeys(material for _, _, material in uses))
    libraries = [line.strip() for line in text.libraries]
    by_name, files, missing_files = load_materials(path, libraries, set(names), options)
    missing = [name for name in names if name not in by_name]
    if missing:
        more = f" and {len(missing) - _LISTED} more" if len(missing) > _LISTED else ""
        listing = ", ".join(name or "without a name" for name in missing[:_LISTED]) + more
        what, are = (f"material {listing}", "is") if len(missing) == 1 else (f"materials {listing}", "are")
        fault = f"{', '.join(libraries)} does not define the {what}, which {are} white; add what is missing"
        if missing_files:
            lie, them = ("are", "them") if len(missing_files) > 1 else ("is", "it")
            lost = " and ".join(missing_files)
            fault = f"{lost} {lie} missing, so the {what} {are} white; put {them} next to the model"
        warn(f"{path.name}: {fault}")
    materials = [LoadedMaterial(), *(by_name.get(name, LoadedMaterial()) for name in names)]
    for first, end, material in uses:
        numbers[first:end] = 1 + names.index(material)
    return materials, numbers[polygons], files


def _white_below_images(part: PlacedMesh, materials: list[LoadedMaterial]) -> PlacedMesh:
    """Drop vertex colours under images of colour: programs repeat these, or write a meaningless grey."""
    textured = np.array([each.material.inputs["base_color"].texture is not None for each in materials])
    is_white = textured[part.materials]
    if part.colors is None or not is_white.any():
        return part
    values = np.append(part.colors.values, np.ones((1, 4), np.float32), axis=0)
    rows = np.where(is_white[:, None], np.int32(len(values) - 1), part.colors.rows)
    return part._replace(colors=Corners(values, rows))


def _coordinates(
    text: _Text, materials: list[LoadedMaterial], numbers: Int32s, rows: Int64s, name: str
) -> tuple[Float64s, Int32s]:
    """Return texture coordinates (k, 2), v up, and the row of each corner (m, 3)."""
    is_textured = np.array([bool(each.slots) for each in materials])[numbers]
    missing = int((rows[is_textured] < 0).any(axis=1).sum())
    if missing:
        what = f"{name} has {missing} textured triangles without texture coordinates"
        warn(f"{what}: they read one texel; give them some")
    coordinates = _numbers(text.coordinates, 1, name, "vt")
    if coordinates.shape[1] == 1:
        coordinates = np.append(coordinates, np.zeros_like(coordinates), axis=1)
    coordinates = np.where(np.isnan(coordinates), 0.0, coordinates)[:, :2]
    if missing:  # they read at (0, 0)
        coordinates = np.append(coordinates, np.zeros((1, 2)), axis=0)
    return coordinates, np.where(rows < 0, max(len(coordinates) - 1, 0), rows).astype(np.int32)


def _normals(text: _Text, rows: Int64s, name: str) -> Corners | None:
    """Return the normals at corners, NaN where there are none."""
    check_among(rows, len(text.normals), f"{name}: a face uses a normal", least=-1)
    normals = _numbers(text.normals, 3, name, "vn")[:, :3]
    is_missing = (rows < 0).any(axis=1)
    if is_missing.all():
        return None
    count = int(is_missing.sum())
    of_corners = rows.astype(np.int32)
    of_corners[is_missing] = len(normals) + np.arange(count, dtype=np.int32)[:, None]
    return Corners(np.concatenate([normals, np.full((count, 3), np.nan)]).astype(np.float32), of_corners)
