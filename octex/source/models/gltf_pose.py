"""Where the vertices of a glTF model are in a pose: morph targets, then skins or nodes (glTF 2.0, 3.7)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from octex.arrays import Array, Float64s, Int64s
from octex.errors import ModelError, ModelWarning
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
        what = f"{self._document.name}: {name}"
        bones, weights = self.bones(node, instance), self.weights(node, len(targets), what)
        moved = positions
        for weight, offsets in zip(weights, self.offsets(targets, len(positions), what), strict=True):
            if offsets is not None:
                moved = moved + weight * offsets
        with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
            if not self.is_skinned(node):
                return moved @ bones[0, :3, :3].T + bones[0, :3, 3]
            return _skinned(moved, bones, *influences(read, len(bones), what))

    def is_skinned(self, node: int) -> bool:
        """Say whether a skin moves a node's mesh; else the node alone does."""
        return "skin" in self._nodes[node]

    def bones(self, node: int, instance: Float64s) -> Float64s:
        """Return what takes a node's vertices to the scene (b, 4, 4): its skin's joints, or itself."""
        with np.errstate(over="ignore", invalid="ignore"):
            if not self.is_skinned(node):
                return (self._matrices[node] @ instance)[None]
            # What a skin moves stands where its joints are, wherever its own node is (3.7.3.3).
            return np.asarray(instance @ self._joints_of(self._nodes[node]["skin"]))

    def weights(self, node: int, count: int, what: str) -> list[float]:
        """Return the weights of a node's ``count`` morph targets. Raises ModelError for another count."""
        record = self._nodes[node]
        mesh = self._document.item("meshes", record["mesh"])
        weights: list[float] = record.get("weights", mesh.get("weights", [0.0] * count))
        if len(weights) != count:
            raise ModelError(
                f"{what} has {count} morph targets, and nodes[{node}] weights of {len(weights)}; "
                "export it again"
            )
        return weights

    def offsets(
        self, targets: Sequence[Json], count: int, what: str, attribute: str = "POSITION"
    ) -> Iterator[Float64s | None]:
        """Yield what each of a primitive's targets adds to its vertices' attribute (count, 3), or None."""
        for number, target in enumerate(targets):
            if attribute not in target:
                yield None
                continue
            offsets = self._document.accessor(target[attribute], (3,))
            if len(offsets) != count:
                raise ModelError(
                    f"{what}: targets[{number}] moves {len(offsets)} of {count} vertices; export it again"
                )
            yield offsets

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


def _skinned(positions: Float64s, joints: Float64s, numbers: Int64s, weights: Float64s) -> Float64s:
    """Return vertices (n, 3) moved by joints (j, 4, 4), as ``numbers`` and ``weights`` (n, k) blend them."""
    moved = np.zeros_like(positions)
    for number, weight in zip(numbers.T, weights.T, strict=True):
        matrices = joints[number]
        turned = np.einsum("nij,nj->ni", matrices[:, :3, :3], positions) + matrices[:, :3, 3]
        moved += weight[:, None] * turned
    return moved


def influences(read: Reader, n_joints: int, what: str) -> tuple[Int64s, Float64s]:
    """Return the joints (n, k) that move vertices, and their weights (n, k), whose sums are 1.

    Weights with another sum are normalized, as viewers do, with ModelWarning; where all are 0 the first joint
    alone moves the vertex. Raises ModelError for weights that are no such numbers, and joints that are not
    there.
    """
    numbers, weights = _influences(read, what)
    sums = weights.sum(axis=1)
    bad = ~((weights >= 0).all(axis=1) & np.isfinite(sums))
    if bad.any():
        first = int(np.argmax(bad))
        raise ModelError(
            f"{what}: the weights of vertex {first} are {weights[first].tolist()}, which must be finite and "
            "not below 0; export it with normalized weights"
        )
    off = np.count_nonzero(np.abs(sums - 1) > _ROUNDING)
    if off:
        text = f"{what}: the weights of {off:,} of {len(sums):,} vertices do not sum to 1; "
        warnings.warn(text + "octex normalizes them", ModelWarning, stacklevel=2)
        weights[sums == 0, 0] = 1.0
        sums[sums == 0] = 1.0
    if not (numbers < n_joints).all():
        first = int(np.argmax((numbers >= n_joints).any(axis=1)))
        raise ModelError(
            f"{what}: vertex {first} is moved by joint {int(numbers[first].max())}, but its skin has "
            f"{n_joints}; export it again"
        )
    return numbers.astype(np.int64), weights / sums[:, None]


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
