"""Where the vertices of a glTF model are in a pose: morph targets, then skins or nodes (glTF 2.0, 3.7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from octex.arrays import Array, Float64s
from octex.errors import ModelError
from octex.source.models.gltf_file import Document
from octex.source.models.gltf_scene import scene_nodes

Json = dict[str, Any]

#: By how much weights may miss 1 together: four of them, rounded to bytes.
_ROUNDING = 2 / 255

#: Reads an attribute of vertices by its name, with so many components; None where there is none.
Reader = Callable[[str, tuple[int, ...]], Float64s | None]


class Pose:
    """The nodes of a scene in a pose. ``fields`` are those of animated nodes: see ``fields_at``."""

    def __init__(self, document: Document, fields: Mapping[int, Json]) -> None:
        self._document = document
        self._nodes: dict[int, Json] = {}
        self._matrices: dict[int, Float64s] = {}
        for number, node, matrix in scene_nodes(document, fields):
            self._nodes[number], self._matrices[number] = node, matrix
        self._joints: dict[int, Float64s] = {}

    def positions(
        self, node: int, instance: Float64s, positions: Float64s, targets: Sequence[Json], read: Reader,
        name: str,
    ) -> Float64s:  # fmt: skip
        """Return where a node's vertices (n, 3) of a mesh primitive are in the scene.

        ``instance`` (4, 4) is that of EXT_mesh_gpu_instancing, ``targets`` are the primitive's, and ``read``
        reads its attributes. Raises ModelError for weights and joints that do not fit.
        """
        moved = self._morphed(node, positions, targets, name)
        joints = None if "skin" not in self._nodes[node] else self._joints_of(self._nodes[node]["skin"])
        with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
            if joints is None:
                matrix = self._matrices[node] @ instance
                return moved @ matrix[:3, :3].T + matrix[:3, 3]
            # What a skin moves stands where its joints are, wherever its own node is (3.7.3.3).
            skinned = _skinned(moved, joints, read, f"{self._document.name}: {name}")
            return skinned @ instance[:3, :3].T + instance[:3, 3]

    def _morphed(self, node: int, positions: Float64s, targets: Sequence[Json], name: str) -> Float64s:
        record = self._nodes[node]
        mesh = self._document.item("meshes", record["mesh"])
        weights = record.get("weights", mesh.get("weights", [0.0] * len(targets)))
        what = f"{self._document.name}: {name}"
        if len(weights) != len(targets):
            raise ModelError(
                f"{what} has {len(targets)} morph targets, and nodes[{node}] weights of {len(weights)}; "
                "export it again"
            )
        moved = positions
        for number, (weight, target) in enumerate(zip(weights, targets, strict=True)):
            if "POSITION" not in target:
                continue
            offsets = self._document.accessor(target["POSITION"], (3,))
            if len(offsets) != len(positions):
                raise ModelError(
                    f"{what}: targets[{number}] moves {len(offsets)} of {len(positions)} vertices; "
                    "export it again"
                )
            moved = moved + weight * offsets
        return moved

    def _joints_of(self, number: int) -> Float64s:
        """Return what takes vertices at rest to where a skin's joints (j, 4, 4) have them."""
        if number not in self._joints:
            document = self._document
            skin = document.item("skins", number)
            what = f"{document.name}: skins[{number}]"
            nodes = skin["joints"]
            lacking = [each for each in nodes if each not in self._matrices]
            if lacking or not nodes:
                which = (
                    f"joint nodes[{lacking[0]}], which the scene does not show" if lacking else "no joints"
                )
                raise ModelError(f"{what} has {which}; export it again")
            inverses = np.broadcast_to(np.eye(4), (len(nodes), 4, 4))
            if "inverseBindMatrices" in skin:
                rows = document.accessor(skin["inverseBindMatrices"], (16,)).astype(np.float64)
                if len(rows) < len(nodes):
                    raise ModelError(
                        f"{what} has {len(rows)} inverse bind matrices for {len(nodes)} joints; "
                        "export it again"
                    )
                inverses = rows[: len(nodes)].reshape(-1, 4, 4).transpose(0, 2, 1)
            self._joints[number] = np.stack([self._matrices[each] for each in nodes]) @ inverses
        return self._joints[number]


def _skinned(positions: Float64s, joints: Float64s, read: Reader, what: str) -> Float64s:
    """Return vertices (n, 3) moved by joints (j, 4, 4), as their attributes weigh these."""
    numbers, weights = _influences(read, what)
    sums = weights.sum(axis=1)
    bad = ~((np.abs(sums - 1) <= _ROUNDING) & (weights >= 0).all(axis=1))
    if bad.any():
        first = int(np.argmax(bad))
        raise ModelError(
            f"{what}: the weights of vertex {first} are {weights[first].tolist()}, which do not sum to 1; "
            "export it with normalized weights"
        )
    if not (numbers < len(joints)).all():
        first = int(np.argmax((numbers >= len(joints)).any(axis=1)))
        raise ModelError(
            f"{what}: vertex {first} is moved by joint {int(numbers[first].max())}, but its skin has "
            f"{len(joints)}; export it again"
        )
    weights = weights / sums[:, None]
    moved = np.zeros_like(positions)
    for number, weight in zip(numbers.astype(np.int64).T, weights.T, strict=True):
        matrices = joints[number]
        turned = np.einsum("nij,nj->ni", matrices[:, :3, :3], positions) + matrices[:, :3, 3]
        moved += weight[:, None] * turned
    return moved


def _influences(read: Reader, what: str) -> tuple[Array, Float64s]:
    """Return the joints (n, k) that move vertices, and their weights (n, k), of all sets of four."""
    numbers: list[Array] = []
    weights: list[Float64s] = []
    while (given := read(f"JOINTS_{len(numbers)}", (4,))) is not None:
        weight = read(f"WEIGHTS_{len(numbers)}", (4,))
        if weight is None:
            raise ModelError(f"{what} has JOINTS_{len(numbers)} without weights; export it again")
        numbers.append(given)
        weights.append(weight)
    if not numbers:
        raise ModelError(f"{what} has a skin but no JOINTS_0; export it again")
    return np.concatenate(numbers, axis=1), np.concatenate(weights, axis=1)
