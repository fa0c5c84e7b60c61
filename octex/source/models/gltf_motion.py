"""The motion of glTF models: animations, skins and morph targets (glTF 2.0, 3.7, 3.11 and appendix C)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Array, Bools, Float64s, Int32s, Int64s
from octex.errors import ArgumentError, ModelError, damaged
from octex.gltf import Document, Json, as_object, scene_nodes
from octex.source.models.reading import warn
from octex.source.motion import Animation, Links, Motion

_COMPONENTS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
#: Rounding of the sum of four weights in bytes.
_ROUNDING = 2 / 255
#: Frames are a multiple of this plus one, so that every second and every fourth include the first and last.
_MULTIPLE = 4
#: Most matrices of an animation's frames; longer animations have fewer frames a second.
_MOST_MATRICES = 1 << 20


class Sampler(NamedTuple):
    """Values at keys in time, and their interpolation."""

    times: Float64s  # (keys,)   ascending
    values: Float64s  # (keys, components), or of CUBICSPLINE (keys, 3, components): tangent, value, tangent
    interpolation: str
    is_rotation: bool  # whether values are quaternions

    def at(self, time: float) -> Float64s:
        """Return the value (components,) at a time, constant before the first key and after the last."""
        value = self._at(time)
        return _unit(value) if self.is_rotation else value

    def _at(self, time: float) -> Float64s:
        times, is_cubic = self.times, self.interpolation == "CUBICSPLINE"
        if not times[0] < time < times[-1]:
            end: Float64s = self.values[0 if time <= times[0] else -1]
            return end[1] if is_cubic else end
        after = int(np.searchsorted(times, time, side="right"))
        a, b = self.values[after - 1], self.values[after]
        step = times[after] - times[after - 1]
        t = (time - times[after - 1]) / step
        if self.interpolation == "STEP":
            return np.asarray(a)
        if is_cubic:  # (C.4)
            shares = 2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, -2 * t**3 + 3 * t**2, t**3 - t**2
            return np.asarray(
                shares[0] * a[1] + shares[1] * step * a[2] + shares[2] * b[1] + shares[3] * step * b[0]
            )
        if not self.is_rotation:
            return np.asarray((1 - t) * a + t * b)
        a, b = _unit(a), _unit(b)  # along the shorter arc, at constant speed (C.3)
        dot = float(a @ b)
        if dot < 0:
            b, dot = -b, -dot
        angle = float(np.arctan2(np.linalg.norm(b - dot * a), dot))
        if angle < 1e-6:  # where both weights are 0 / 0
            return np.asarray((1 - t) * a + t * b)
        return np.asarray(np.sin((1 - t) * angle) * a + np.sin(t * angle) * b)


def _unit(value: Float64s) -> Float64s:
    """Return a quaternion of length 1; zeros stay."""
    return value / (float(np.linalg.norm(value)) or 1.0)


class NodeAnimation:
    """The fields of nodes that an animation changes over time. Raises ModelError for a broken animation."""

    def __init__(self, document: Document, number: int) -> None:
        animation = document.item("animations", number)
        what = f"{document.name}: animations[{number}]"
        samplers: dict[int, Sampler] = {}
        self._channels: dict[tuple[int, str], Sampler] = {}  # by nodes and their fields
        for index, channel in enumerate(animation["channels"]):
            target = as_object(channel["target"], f"{what}.channels[{index}].target")
            path = target["path"]
            if "node" not in target or path not in _COMPONENTS:  # of an extension
                continue
            node, sampler = target["node"], channel["sampler"]
            if "matrix" in document.item("nodes", node) and path != "weights":
                raise damaged(f"{what} moves nodes[{node}], which has a matrix")
            if (node, path) in self._channels:
                raise damaged(f"{what} gives nodes[{node}] its {path} twice")
            if not isinstance(sampler, int) or not 0 <= sampler < len(animation["samplers"]):
                raise damaged(f"{what} refers to samplers[{sampler}], which it does not have")
            if sampler not in samplers:
                name = f"{what}.samplers[{sampler}]"
                entry = as_object(animation["samplers"][sampler], name)
                samplers[sampler] = _sampler(document, entry, path, name)
            self._channels[node, path] = samplers[sampler]
        #: In seconds.
        self.length = max((float(each.times[-1]) for each in self._channels.values()), default=0.0)

    def fields_at(self, time: float) -> dict[int, Json]:
        """Return the fields of animated nodes, by number: translation, rotation, scale and weights."""
        fields: dict[int, Json] = {}
        for (node, path), sampler in self._channels.items():
            fields.setdefault(node, {})[path] = sampler.at(time).tolist()
        return fields


def _sampler(document: Document, entry: Json, path: str, what: str) -> Sampler:
    times = document.accessor(entry["input"], (1,))[:, 0].astype(np.float64)
    values = document.accessor(entry["output"], (_COMPONENTS[path],)).astype(np.float64)
    interpolation = entry.get("interpolation", "LINEAR")
    if interpolation not in _INTERPOLATIONS:
        raise damaged(f"{what} interpolates by {interpolation!r}, which is not one of glTF's")
    if not len(times) or not np.isfinite(times).all() or times[0] < 0 or not (np.diff(times) > 0).all():
        raise damaged(f"{what} has times that do not ascend from 0 on")
    a_key = 3 if interpolation == "CUBICSPLINE" else 1
    width = len(values) // (a_key * len(times)) if path == "weights" else 1
    if not width or len(values) != width * a_key * len(times):
        raise damaged(f"{what} has {len(values)} values for {len(times)} times")
    if not np.isfinite(values).all():
        raise damaged(f"{what} has values that are not finite")
    parts = (a_key, -1) if a_key > 1 else (-1,)
    return Sampler(times, values.reshape(len(times), *parts), interpolation, path == "rotation")


def _names(document: Document) -> list[str]:
    animations = document.items("animations")
    return [str(as_object(each, document.name).get("name", n)) for n, each in enumerate(animations)]


def pose_of(document: Document, pose: str) -> Pose:
    """Return the pose NAME@SECONDS, or raise ArgumentError; NAME may be the animation's number."""
    names = _names(document)
    name, at, seconds = pose.rpartition("@")
    if not names:
        raise ArgumentError(f"{document.name} has no animations; leave the pose {pose!r} out")
    number = int(name) if name.isdecimal() and int(name) < len(names) else None
    number = names.index(name) if name in names else number
    if not at:
        fault = f" cannot be posed as {pose!r}: give NAME@SECONDS"
    elif number is None:
        fault = f" has no animation {name!r}"
    else:
        moves = NodeAnimation(document, number)
        try:
            time = float(np.float32(seconds))  # the files' precision
        except ValueError:
            time = np.nan
        if 0.0 <= time <= moves.length:
            return Pose(document, moves.fields_at(time))
        last = np.float32(moves.length)
        fault = f": animation {name!r} has no time {seconds!r}: seconds from 0 to {last}"
    lengths = {each: np.float32(NodeAnimation(document, n).length) for n, each in enumerate(names)}
    listing = ", ".join(f"{each} (0 to {length} s)" for each, length in lengths.items())
    raise ArgumentError(f"{document.name}{fault}; it has {listing}")


class Primitive(NamedTuple):
    """The triangles of a mesh primitive, and references to its other data in the file."""

    document: Document
    name: str  # in errors
    positions: Float64s  # (n, 3)
    triangles: Int32s
    material: int | None
    attributes: Json
    decoded: dict[str, Array]  # the attributes that an extension stores
    targets: list[Any]  # morph targets

    def attribute(self, name: str, components: tuple[int, ...]) -> Float64s | None:
        """Return a vertex attribute with this number of components; None if it is missing."""
        if name not in self.attributes:
            return None
        rows = self.document.accessor(self.attributes[name], components, self.decoded.get(name))
        with np.errstate(invalid="ignore"):
            rows = rows.astype(np.float64)
        if len(rows) != len(self.positions):
            raise damaged(f"{self.name} {name} has {len(rows)} rows for {len(self.positions)} vertices")
        return rows

    def offsets(self, attribute: str) -> Iterator[Array | None]:
        """Yield each target's offsets of a vertex attribute (n, 3), or None."""
        for number, target in enumerate(self.targets):
            offsets = None
            if attribute in target:
                offsets, count = self.document.accessor(target[attribute], (3,)), len(self.positions)
                if len(offsets) != count:
                    raise damaged(f"{self.name}: targets[{number}] moves {len(offsets)} of {count} vertices")
            yield offsets


class PlacedPrimitive(NamedTuple):
    """A mesh primitive of a node of the scene."""

    node: int
    copy: Float64s  # (4, 4)   of an instance to the node (EXT_mesh_gpu_instancing)
    matrix: Float64s  # (4, 4)   to the world, at rest
    primitive: Primitive

    def rest_positions(self) -> Float64s:
        """Return the vertices (n, 3) as modelled, in the world."""
        return np.asarray(self.primitive.positions @ self.matrix[:3, :3].T + self.matrix[:3, 3])


class Pose:
    """The nodes of a scene in a pose; ``fields`` are those of animated nodes."""

    def __init__(self, document: Document, fields: Mapping[int, Json]) -> None:
        self._document = document
        self._nodes: dict[int, Json] = {}
        self._matrices: dict[int, Float64s] = {}
        for number, node, matrix in scene_nodes(document, fields):
            self._nodes[number], self._matrices[number] = node, matrix
        self._joints: dict[int, Float64s] = {}

    def positions(self, placed: PlacedPrimitive) -> Float64s:
        """Return the vertices (n, 3), moved by targets, then by a skin or the node."""
        bones = self.bones(placed)
        moved = placed.primitive.positions
        for weight, offsets in zip(self.weights(placed), placed.primitive.offsets("POSITION"), strict=True):
            if offsets is not None:
                moved = moved + weight * offsets
        with np.errstate(over="ignore", invalid="ignore"):  # the surface refuses what is not finite
            if self.skin(placed) is None:
                return moved @ bones[0, :3, :3].T + bones[0, :3, 3]
            sums = np.zeros_like(moved)
            joints, weights = influences(placed.primitive, len(bones))
            for numbers, shares in zip(joints.T, weights.T, strict=True):
                matrices = bones[numbers]
                turned = np.einsum("nij,nj->ni", matrices[:, :3, :3], moved) + matrices[:, :3, 3]
                sums += shares[:, None] * turned
            return sums

    def skin(self, placed: PlacedPrimitive) -> int | None:
        """Return the skin that moves a primitive; None if only its node moves it."""
        return self._nodes[placed.node].get("skin")

    def bones(self, placed: PlacedPrimitive) -> Float64s:
        """Return the matrices (b, 4, 4), of joints or of the node, that move vertices to the scene."""
        skin = self.skin(placed)
        with np.errstate(over="ignore", invalid="ignore"):
            if skin is None:
                return (self._matrices[placed.node] @ placed.copy)[None]
            # A skinned mesh is placed by its joints, not by its node (3.7.3.3).
            return np.asarray(placed.copy @ self._joints_of(skin))

    def weights(self, placed: PlacedPrimitive) -> list[float]:
        """Return the weights of a primitive's morph targets. Raises ModelError for another count."""
        record, count = self._nodes[placed.node], len(placed.primitive.targets)
        mesh = self._document.item("meshes", record["mesh"])
        weights: list[float] = (record if "weights" in record else mesh).get("weights", [0.0] * count)
        if len(weights) != count:
            raise damaged(
                f"{placed.primitive.name} has {count} morph targets, and nodes[{placed.node}] weights of "
                f"{len(weights)}"
            )
        return weights

    def _joints_of(self, number: int) -> Float64s:
        """Return the matrices of a skin's joints (j, 4, 4), from vertices at rest to the scene."""
        if number not in self._joints:
            skin = self._document.item("skins", number)
            what = f"{self._document.name}: skins[{number}]"
            nodes = skin["joints"]
            missing = [each for each in nodes if each not in self._matrices]
            if missing:
                raise damaged(f"{what} has joint nodes[{missing[0]}], which the scene does not show")
            if not nodes:
                raise damaged(f"{what} has no joints")
            inverses = np.broadcast_to(np.eye(4), (len(nodes), 4, 4))
            if "inverseBindMatrices" in skin:
                rows = self._document.accessor(skin["inverseBindMatrices"], (16,)).astype(np.float64)
                if len(rows) < len(nodes):
                    raise damaged(f"{what} has {len(rows)} inverse bind matrices for {len(nodes)} joints")
                inverses = rows[: len(nodes)].reshape(-1, 4, 4).transpose(0, 2, 1)
            self._joints[number] = np.stack([self._matrices[each] for each in nodes]) @ inverses
        return self._joints[number]


def influences(primitive: Primitive, n_joints: int) -> tuple[Int64s, Float64s]:
    """Return the joints (n, k) that move vertices, of all sets of four, and their weights (n, k).

    Weights are scaled to sum 1, as viewers do; if all are 0, the first joint gets 1.
    """
    what = primitive.name
    sets: list[tuple[Float64s, Float64s]] = []
    while (joints := primitive.attribute(f"JOINTS_{len(sets)}", (4,))) is not None:
        weights = primitive.attribute(f"WEIGHTS_{len(sets)}", (4,))
        if weights is None:
            raise damaged(f"{what} has JOINTS_{len(sets)} without weights")
        sets.append((joints, weights))
    if not sets:
        raise damaged(f"{what} has a skin but no JOINTS_0")
    joints, weights = (np.concatenate(columns, axis=1) for columns in zip(*sets, strict=True))
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
        count = f"{off:,} of {len(sums):,}"
        warn(f"{what}: the weights of {count} vertices do not sum to 1; octex normalizes them")
        weights[sums == 0, 0] = 1.0
        sums[sums == 0] = 1.0
    if not (joints < n_joints).all():
        first = int(np.argmax((joints >= n_joints).any(axis=1)))
        raise damaged(
            f"{what}: vertex {first} is moved by joint {int(joints[first].max())}, but its skin has "
            f"{n_joints}"
        )
    return joints.astype(np.int64), weights / sums[:, None]


def motion_of(document: Document, placed: Sequence[PlacedPrimitive], rate: float) -> Motion | None:
    """Return the motion of the vertices of all primitives in turn; None if the file has no animations.

    A second has at least ``rate`` frames. ``faults`` lists broken animations.
    """
    names = _names(document)
    if not names:
        return None
    bones = _Bones(document, placed)
    animations: list[Animation] = []
    faults: list[str] = []
    for number, name in enumerate(names):
        try:
            moves = NodeAnimation(document, number)
            steps = min(moves.length * rate, _MOST_MATRICES / bones.count)
            frames = math.ceil(steps / _MULTIPLE) * _MULTIPLE + 1
            poses = [bones.at(moves, time) for time in np.linspace(0.0, moves.length, frames)]
        except (ModelError, KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            faults.append(f"animation {name}: {error if isinstance(error, ModelError) else 'is malformed'}")
            continue
        animations.append(Animation(name, moves.length, *map(np.stack, zip(*poses, strict=True))))
    positions = np.concatenate([each.rest_positions() for each in placed])
    return Motion(positions, *bones.links(), animations, faults)


class _Bones:
    """The bones and targets that move primitives; primitives with one skin and rest matrix share bones."""

    def __init__(self, document: Document, placed: Sequence[PlacedPrimitive]) -> None:
        self._document, self._placed = document, placed
        self._rest = Pose(document, {})
        self._first: list[int] = []  # the first bone of each primitive
        self._owners: dict[tuple[object, bytes, bytes], tuple[int, PlacedPrimitive]] = {}
        self._weights: dict[int, tuple[int, PlacedPrimitive]] = {}  # the first target of each node
        self._skins: list[int] = []  # each primitive's number of bones, 0 without a skin
        self.count, n_targets = 0, 0
        for each in placed:
            n_bones, skin = len(self._rest.bones(each)), self._rest.skin(each)
            moved_by = ("node", each.node) if skin is None else skin
            key = moved_by, each.copy.tobytes(), each.matrix.tobytes()
            if key not in self._owners:
                self._owners[key] = self.count, each
                self.count += n_bones
            self._first.append(self._owners[key][0])
            self._skins.append(0 if skin is None else n_bones)
            if each.node not in self._weights:
                self._weights[each.node] = n_targets, each
                n_targets += len(each.primitive.targets)

    def at(self, moves: NodeAnimation, time: float) -> tuple[Float64s, Float64s]:
        """Return all bones (b, 3, 4) and the weights of all targets (t,) at a time."""
        pose = Pose(self._document, moves.fields_at(time))
        bones = np.concatenate(
            [pose.bones(each) @ np.linalg.pinv(each.matrix) for _, each in self._owners.values()]
        )[:, :3]
        weights = np.array([w for _, each in self._weights.values() for w in pose.weights(each)], np.float64)
        if not (np.isfinite(bones).all() and np.isfinite(weights).all()):
            raise damaged("moves vertices to infinity")
        return bones, weights

    def links(self) -> tuple[Links, Links, Float64s]:
        """Return the vertices' links to bones and to targets, and the targets' offsets of normals."""
        joints, targets, turns = [], [], []
        for each, first, n_bones in zip(self._placed, self._first, self._skins, strict=True):
            primitive = each.primitive
            count = len(primitive.positions)
            numbers, weights = np.zeros((count, 1), np.int64), np.ones((count, 1))
            if n_bones:
                numbers, weights = influences(primitive, n_bones)
            joints.append(_entries(weights > 0, numbers + first, weights))
            offsets = _offsets(primitive, "POSITION") @ each.matrix[:3, :3].T
            turned = np.zeros_like(offsets)
            normals = primitive.attribute("NORMAL", (3,))
            if normals is not None:
                upright = np.linalg.pinv(each.matrix[:3, :3])
                sizes = np.linalg.norm(normals @ upright, axis=1)[:, None, None]
                turned = _offsets(primitive, "NORMAL") @ upright / np.where(sizes > 0, sizes, np.inf)
            if not (np.isfinite(offsets).all() and np.isfinite(turned).all()):
                raise damaged(f"{primitive.name} has targets that are not finite")
            moves = (offsets != 0).any(axis=2) | (turned != 0).any(axis=2)
            numbers = self._weights[each.node][0] + np.arange(moves.shape[1])
            targets.append(_entries(moves, np.broadcast_to(numbers, moves.shape), offsets))
            turns.append(turned[moves])
        return _links(joints), _links(targets), np.concatenate(turns)


def _entries(chosen: Bools, numbers: Int64s, shares: Float64s) -> tuple[Int64s, Int64s, Float64s]:
    """Return each vertex's number of entries (n,), and the chosen entries' numbers and shares."""
    return chosen.sum(axis=1), numbers[chosen], shares[chosen]


def _links(parts: Sequence[tuple[Int64s, Int64s, Float64s]]) -> Links:
    counts, numbers, shares = map(np.concatenate, zip(*parts, strict=True))
    return Links(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), numbers, shares)


def _offsets(primitive: Primitive, attribute: str) -> Float64s:
    offsets = np.zeros((len(primitive.positions), len(primitive.targets), 3))
    for number, added in enumerate(primitive.offsets(attribute)):
        if added is not None:
            offsets[:, number] = added
    return offsets
