"""OFF and STL models: shapes, perhaps with colours.

trimesh reads STL. It drops the colours of OFF files and 3MF packages, and needs lxml and networkx for 3MF.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from itertools import islice
from pathlib import Path

import numpy as np

from octex.arrays import Float32s, Float64s, Int64s, Uint8s, in_runs
from octex.errors import ModelError, damaged
from octex.files import read_bytes
from octex.source.colors import guessed_colors, screen_colors
from octex.source.images.decode import global_settings
from octex.source.models.reading import Options, colored_surface, cut_part, parse_numbers, whole_numbers
from octex.source.surface import Surface

#: A solid's name in STL text: up to the end of the line, or to its first facet.
_NAME = re.compile(r"((?:^|[\r\n])[ \t]*(?:end)?solid\b)(?:(?!\bfacet\b)[^\r\n])*", re.IGNORECASE)
# Keeps trimesh's messages about damaged normals off the screen.
_quiet = logging.NullHandler()


def load_stl(path: Path, options: Options) -> Surface:
    """Read an STL model, through trimesh, with the colours that binary files may have. Raises ModelError."""
    import trimesh  # takes a third of a second

    logging.getLogger("trimesh").addHandler(_quiet)
    data = read_bytes(path)
    colors, end = None, 84 + 50 * int.from_bytes(data[80:84], "little")
    if end <= len(data) < end + 50:  # some programs write a few bytes after the facets
        data = data[:end]
        colors = _stl_colors(data[:80], np.frombuffer(data, np.uint8, offset=84).reshape(-1, 50))
    else:
        if b"endsolid" not in data.lower():
            raise damaged(f"{path.name} is truncated, or not an STL file")
        # trimesh takes words of names for those of facets, and needs a package for text that is not UTF-8.
        # It also splits lines at \n alone.
        data = _NAME.sub(r"\1", data.decode("latin-1")).replace("\r", "\n").encode()
    with global_settings():
        warnings.simplefilter("ignore")
        # Without this trimesh drops everything after the first word that is no number.
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
        try:
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
        except (DeprecationWarning, ValueError):
            raise damaged(f"{path.name}: a facet's vertices are not three times three numbers") from None
    faces, positions = np.array(mesh.faces, np.int64), np.array(mesh.vertices, np.float64)
    part, _, _ = cut_part(path.name, positions, faces.ravel(), np.full(len(faces), 3), None, colors)
    return colored_surface(path.name, options, part)


def _stl_colors(head: bytes, facets: Uint8s) -> Float32s | None:
    """Return the linear colours of a binary STL file's facets, 5 bits a component; None without colours.

    In Magics' files facets with bit 15 have the header's colour, and red is the lowest component. In VisCAM's
    files bit 15 marks facets with a colour, and red is the highest component.
    """
    words = facets[:, 48:].copy().view("<u2")
    is_marked = words >= 1 << 15
    codes = (words >> np.array([0, 5, 10]) & 31) / 31.0
    _, magics, rest = head.partition(b"COLOR=")
    if magics and len(rest) >= 3:
        shared = np.frombuffer(rest, np.uint8, 3) / 255.0
        return screen_colors(np.where(is_marked | ~words.any(), shared, codes))
    return screen_colors(np.where(is_marked, codes[:, ::-1], 1.0)) if is_marked.any() else None


def load_off(path: Path, options: Options) -> Surface:
    """Read an OFF model; its colours, of vertices or else of faces, are sRGB values."""
    name = path.name
    lines = read_bytes(path).decode("latin-1").splitlines()
    lines = [line.partition("#")[0] if "#" in line else line for line in lines]
    lines = [line for line in lines if line and not line.isspace()]
    first = lines.pop(0).split() if lines else [""]
    head = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF(\d*)", first[0])
    if head is None:
        raise damaged(f"{name} is not an OFF file: its first word is not OFF")
    if head[4] or head[5] or "BINARY" in first:
        raise ModelError(f"{name} is a kind of OFF file that octex does not read; convert it to PLY")
    # A blank may be missing after the first word.
    words = [head[6], *first[1:]][not head[6] :] or (lines.pop(0).split() if lines else [])
    try:
        n_vertices, n_faces = int(words[0]), int(words[1])
    except (IndexError, ValueError):
        raise damaged(f"{name}: the numbers of vertices and faces are missing") from None
    if n_vertices < 0 or n_faces < 0 or n_vertices + n_faces > len(lines):
        raise damaged(f"{name} is truncated: it has fewer lines than vertices and faces")
    values, starts, counts = _rows(lines[:n_vertices], name)
    if len(counts) and counts.min() < 3:
        raise damaged(f"{name}: a vertex has less than three numbers")
    positions, skip = values[starts[:, None] + np.arange(3)], 6 if head[3] else 3
    of_vertices = _off_colors(values, starts + skip, counts - skip - (2 if head[1] else 0))
    values, starts, counts = _rows(_whole_faces(lines[n_vertices:], n_faces), name)
    sizes = whole_numbers(values[starts])
    if not ((sizes >= 0) & (sizes < counts)).all():
        raise damaged(f"{name}: a face has fewer corners than it says")
    indices = whole_numbers(values[in_runs(starts + 1, sizes)])
    of_faces = _off_colors(values, starts + 1 + sizes, counts - 1 - sizes)
    part, _, _ = cut_part(name, positions, indices, sizes, of_vertices, of_faces)
    return colored_surface(name, options, part)


def _whole_faces(lines: list[str], count: int) -> list[str]:
    """Return one line for each face; lines are joined if faces run over several."""
    if all(len(line.split()) > int(line.split()[0]) for line in lines[:count] if line.split()[0].isdigit()):
        return lines[:count]
    words = iter(" ".join(lines).split())
    faces = [[word, *islice(words, int(word))] for word in islice(words, count) if word.isdigit()]
    return [" ".join(face) for face in faces]


def _rows(lines: list[str], name: str) -> tuple[Float64s, Int64s, Int64s]:
    """Return the numbers of all lines, and each line's first index and count."""
    counts = np.array([len(line.split()) for line in lines], np.int64)
    values = parse_numbers(" ".join(lines))
    if values is None or values.size != counts.sum():
        raise damaged(f"{name}: a vertex or a face is not numbers")
    return values, np.cumsum(counts) - counts, counts


def _off_colors(values: Float64s, starts: Int64s, counts: Int64s) -> Float32s | None:
    """Return linear colours of ``counts`` numbers each, white for fewer than three; None without colours."""
    is_colored = counts >= 3
    if not is_colored.any():
        return None
    colors = np.full((len(counts), 4), np.nan)
    for column in range(4):
        has_column = is_colored & (counts > column)
        colors[has_column, column] = values[starts[has_column] + column]
    return guessed_colors(colors)
