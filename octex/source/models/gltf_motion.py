"""All animations of a glTF file, at frames: what moves its vertices, and how."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Float64s, Int64s
from octex.errors import ModelError
from octex.source.models.gltf_animation import Moves, animation_names
from octex.source.models.gltf_file import Document
from octex.source.models.gltf_pose import Pose, Reader, influences
from octex.source.motion import Animation, Links, Motion

#: Frames are a multiple of this, and one, so that every second and every fourth of them begin and end alike.
_MULTIPLE = 4
#: Matrices of all frames of an animation; a longer one has fewer frames a second.
_MOST_MATRICES = 1 << 20


class Placed(NamedTuple):
    """A mesh primitive as a node of the scene shows it."""

    node: int
    copy: Float64s  # (4, 4)   of the mesh below the node
    matrix: Float64s  # (4, 4)   to the world, as it rests
    positions: Float64s  # (n, 3)   of the primitive's own
    targets: Sequence[Any]
    read: Reader
    name: str


def motion_of(document: Document, placed: Sequence[Placed], rate: float) -> Motion | None:
    """Return how the vertices of primitives move, one after another; None if the file has no animations.

    ``rate`` is how many frames a second has at least. Raises ModelError for skins and targets that are
    broken; of animations that are, the motion has ``faults``.
    """
    names = animation_names(document)
    if not names:
        return None
    bones = _Bones(document, placed)
    made: list[Animation] = []
    faults: list[str] = []
    for number, name in enumerate(names):
        try:
            moves = Moves(document, number)
            steps = min(moves.length * rate, _MOST_MATRICES / bones.count)
            frames = math.ceil(steps / _MULTIPLE) * _MULTIPLE + 1
            found = [bones.at(moves, time) for time in np.linspace(0.0, moves.length, frames)]
        except (ModelError, KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            faults.append(f"animation {name}: {error if isinstance(error, ModelError) else 'is malformed'}")
            continue
        made.append(Animation(name, moves.length, *map(np.stack, zip(*found, strict=True))))
    positions = np.concatenate(
        [each.positions @ each.matrix[:3, :3].T + each.matrix[:3, 3] for each in placed]
    )
    return Motion(positions, bones.links(), *bones.targets(), made, faults)


class _Bones:
    """The bones and targets that move primitives: those of a skin are shared by whatever rests alike."""

    def __init__(self, document: Document, placed: Sequence[Placed]) -> None:
        self._document, self._placed = document, placed
        rest = Pose(document, {})
        self._first: list[int] = []  # the first bone of each primitive
        self._owners: dict[tuple[object, bytes, bytes], tuple[int, Placed]] = {}
        self._weights: dict[int, tuple[int, int]] = {}  # the first target of each node, and how many
        self._skins: list[int] = []  # how many bones each primitive has
        self.count, self._targets = 0, 0
        for each in placed:
            n_bones = len(rest.bones(each.node, each.copy))
            is_skinned = rest.is_skinned(each.node)
            skin: object = document.item("nodes", each.node)["skin"] if is_skinned else ("node", each.node)
            key = skin, each.copy.tobytes(), each.matrix.tobytes()
            if key not in self._owners:
                self._owners[key] = self.count, each
                self.count += n_bones
            self._first.append(self._owners[key][0])
            self._skins.append(n_bones if is_skinned else 0)
            if each.node not in self._weights:
                self._weights[each.node] = self._targets, len(each.targets)
                self._targets += len(each.targets)

    def at(self, moves: Moves, time: float) -> tuple[Float64s, Float64s]:
        """Return all bones (b, 3, 4) and the weights of all targets (t,) at a time."""
        pose = Pose(self._document, moves.fields_at(time))
        bones = [
            pose.bones(each.node, each.copy) @ np.linalg.pinv(each.matrix)
            for _, each in self._owners.values()
        ]
        name = self._document.name
        weights = [
            pose.weights(node, count, f"{name}: the mesh of nodes[{node}]")
            for node, (_, count) in self._weights.items()
        ]
        found = np.concatenate(bones)[:, :3], np.array([each for row in weights for each in row], np.float64)
        if not (np.isfinite(found[0]).all() and np.isfinite(found[1]).all()):
            raise ModelError("moves vertices beyond all numbers; export it again")
        return found

    def links(self) -> Links:
        """Return what bones move the vertices."""
        counts, numbers, shares = [], [], []
        for each, first, n_bones in zip(self._placed, self._first, self._skins, strict=True):
            joints, weights = np.zeros((len(each.positions), 1), np.int64), np.ones((len(each.positions), 1))
            if n_bones:
                joints, weights = influences(each.read, n_bones, f"{self._document.name}: {each.name}")
            chosen = weights > 0
            counts.append(chosen.sum(axis=1))
            numbers.append(joints[chosen] + first)
            shares.append(weights[chosen])
        return Links(_firsts(counts), np.concatenate(numbers), np.concatenate(shares))

    def targets(self) -> tuple[Links, Float64s]:
        """Return what targets add to the vertices and to their normals, where they add anything."""
        counts, numbers, shares, turns = [], [], [], []
        for each in self._placed:
            offsets = self._offsets(each, "POSITION") @ each.matrix[:3, :3].T
            turned = np.zeros_like(offsets)
            normals = each.read("NORMAL", (3,))
            if normals is not None:
                upright = np.linalg.pinv(each.matrix[:3, :3])
                sizes = np.linalg.norm(normals @ upright, axis=1)[:, None, None]
                turned = self._offsets(each, "NORMAL") @ upright / np.where(sizes > 0, sizes, np.inf)
            if not (np.isfinite(offsets).all() and np.isfinite(turned).all()):
                name = f"{self._document.name}: {each.name}"
                raise ModelError(f"{name} has targets that are not finite; export it again")
            chosen = (offsets != 0).any(axis=2) | (turned != 0).any(axis=2)
            counts.append(chosen.sum(axis=1))
            numbers.append(np.nonzero(chosen)[1] + self._weights[each.node][0])
            shares.append(offsets[chosen])
            turns.append(turned[chosen])
        links = Links(_firsts(counts), np.concatenate(numbers), np.concatenate(shares))
        return links, np.concatenate(turns)

    def _offsets(self, each: Placed, attribute: str) -> Float64s:
        """Return what the targets of a primitive add to its vertices' attribute (n, targets, 3)."""
        count = len(each.positions)
        what = f"{self._document.name}: {each.name}"
        found = Pose(self._document, {}).offsets(each.targets, count, what, attribute)
        rows = [np.zeros((count, 3)) if offsets is None else offsets for offsets in found]
        return np.stack(rows, axis=1).astype(np.float64) if rows else np.zeros((count, 0, 3))


def _firsts(counts: Sequence[Int64s]) -> Int64s:
    return np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
