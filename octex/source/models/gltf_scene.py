"""The nodes of a glTF scene, and where they stand in the world (glTF 2.0, 3.5)."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s
from octex.errors import ModelError
from octex.source.models.gltf_file import Document

Json = dict[str, Any]

_LIMIT = float(np.finfo(np.float64).max)
_COUNTS = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


def scene_nodes(
    document: Document, posed: Mapping[int, Json] | None = None
) -> Iterator[tuple[int, Json, Float64s]]:
    """Yield the scene's nodes, depth first: number, node, and the matrix (4, 4) that takes it to the world.

    A file without scenes shows all its nodes. ``posed`` has fields of nodes by their numbers, instead of
    those in the file. Raises ModelError for nodes that form no tree.
    """
    if document.items("scenes"):
        number = document.json.get("scene", 0)
        roots = _links(document, document.item("scenes", number), "nodes", f"scenes[{number}]")
    else:
        numbers = range(len(document.items("nodes")))
        children = {child for each in numbers for child in _children(document, each)}
        roots = [each for each in numbers if each not in children]
    seen: set[int] = set()
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        number, parent = stack.pop()
        if number in seen:
            raise ModelError(f"{document.name}: nodes[{number}] is reached twice; nodes must form a tree")
        seen.add(number)
        node = document.item("nodes", number)
        if posed:
            node = {**node, **posed.get(number, {})}
        for field, count in _COUNTS.items():
            if field in node:
                _check_numbers(node[field], count, f"{document.name}: nodes[{number}]: {field}")
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ local_matrix(node)
        yield number, node, matrix
        stack.extend((child, matrix) for child in reversed(_children(document, number)))


def _children(document: Document, number: int) -> list[int]:
    return _links(document, document.item("nodes", number), "children", f"nodes[{number}]")


def _links(document: Document, record: Json, field: str, place: str) -> list[int]:
    """Return the numbers of nodes that a record lists, all of which are there."""
    found = record.get(field, [])
    if not isinstance(found, list):
        raise ModelError(f"{document.name}: {place}: {field} must be a list of indices; export it again")
    for each in found:
        document.item("nodes", each)
    return found


def _check_numbers(given: object, count: int, what: str) -> None:
    """Refuse what is not so many numbers of double precision."""
    numbers = given if isinstance(given, list) else []
    if len(numbers) != count or not all(isinstance(n, (int, float)) and abs(n) < _LIMIT for n in numbers):
        raise ModelError(f"{what} must be {count} numbers, not {reprlib.repr(given)}; export it again")


def local_matrix(fields: Mapping[str, npt.ArrayLike]) -> Float64s:
    """Return a node's matrix (column-major in the file), or translation · rotation · scale (3.6.2)."""
    if "matrix" in fields:
        return np.array(fields["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(fields.get("rotation", (0, 0, 0, 1)), np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(w, x, y, z) * np.array(fields.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = fields.get("translation", (0, 0, 0))
    return matrix


def rotation_matrix(w: float, x: float, y: float, z: float) -> Float64s:
    """Return the matrix (3, 3) of a quaternion of any length; no turn for one of length 0."""
    length = w * w + x * x + y * y + z * z
    s = 2 / length if length else 0.0
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )
