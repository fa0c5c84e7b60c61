"""The animations of a glTF file: what their nodes' fields are at a time (glTF 2.0, 3.11 and appendix C)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from octex.arrays import Float64s
from octex.errors import ArgumentError, ModelError
from octex.source.models.gltf_file import Document, as_object

Json = dict[str, Any]

_COMPONENTS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


class Sampler(NamedTuple):
    """Values at keys in time, and what lies between them."""

    times: Float64s  # (keys,)   ascending
    values: Float64s  # (keys, components), or of CUBICSPLINE (keys, 3, components): tangent, value, tangent
    interpolation: str
    turns: bool  # whether values are quaternions

    def at(self, time: float) -> Float64s:
        """Return the value (components,) at a time; before the first key and after the last it stays."""
        times = self.times
        is_cubic = self.interpolation == "CUBICSPLINE"
        if not times[0] < time < times[-1]:
            end = self.values[0 if time <= times[0] else -1]
            return _unit(end[1] if is_cubic else end, self.turns)
        after = int(np.searchsorted(times, time, side="right"))
        a, b = self.values[after - 1], self.values[after]
        if self.interpolation == "STEP":
            return _unit(a, self.turns)
        step = times[after] - times[after - 1]
        t = (time - times[after - 1]) / step
        if is_cubic:
            c, d = a[1:], b[:2]
            mixed = (
                (2 * t**3 - 3 * t**2 + 1) * c[0]
                + step * (t**3 - 2 * t**2 + t) * c[1]
                + (-2 * t**3 + 3 * t**2) * d[1]
                + step * (t**3 - t**2) * d[0]
            )
            return _unit(mixed, self.turns)
        return _slerp(a, b, t) if self.turns else (1 - t) * a + t * b


def fields_at(document: Document, pose: str) -> dict[int, Json]:
    """Return the fields of animated nodes by their numbers: translation, rotation, scale and weights.

    ``pose`` is NAME@SECONDS; the name of an animation, or its number. Raises ArgumentError for an animation
    or a time that the file lacks, ModelError for a broken animation.
    """
    names = animation_names(document)
    name, at, seconds = pose.rpartition("@")
    number = names.index(name) if name in names else None
    if name.isdecimal() and int(name) < len(names) and number is None:
        number = int(name)
    if not names:
        raise ArgumentError(f"{document.name} has no animations; leave the pose {pose!r} out")
    if not at or number is None:
        what = f"has no animation {name!r}" if at else f"cannot be posed as {pose!r}: give NAME@SECONDS"
        raise ArgumentError(f"{document.name} {what}; it has {_listed(document)}")
    moves = Moves(document, number)
    length = moves.length
    try:
        time = float(np.float32(seconds))  # in which files keep times
    except ValueError:
        time = np.nan
    if not 0.0 <= time <= length:
        raise ArgumentError(
            f"{document.name}: animation {name!r} has no time {seconds!r}: seconds from 0 to "
            f"{_seconds(length)}; it has {_listed(document)}"
        )
    return moves.fields_at(time)


class Moves:
    """What an animation changes over time. Raises ModelError for a broken one."""

    def __init__(self, document: Document, number: int) -> None:
        self._channels = _channels(document, number)

    @property
    def length(self) -> float:
        """How long it takes, in seconds."""
        return max((float(sampler.times[-1]) for _, _, sampler in self._channels), default=0.0)

    def fields_at(self, time: float) -> dict[int, Json]:
        """Return the fields of animated nodes by their numbers, as the function of that name does."""
        fields: dict[int, Json] = {}
        for node, path, sampler in self._channels:
            fields.setdefault(node, {})[path] = sampler.at(time).tolist()
        return fields


def lengths_of(document: Document) -> dict[str, float]:
    """Return how long each animation takes, in seconds, by its name, or its number if it has none.

    Raises ModelError for a broken one.
    """
    return {name: Moves(document, n).length for n, name in enumerate(animation_names(document))}


def animation_names(document: Document) -> list[str]:
    """Return the names of all animations, numbers for those without."""
    animations = document.items("animations")
    return [str(as_object(each, document.name).get("name", n)) for n, each in enumerate(animations)]


def _listed(document: Document) -> str:
    """Return what animations there are, and how long they take."""
    lengths = lengths_of(document)
    return ", ".join(f"{name} (0 to {_seconds(length)} s)" for name, length in lengths.items())


def _seconds(time: float) -> str:
    return str(np.float32(time))


def _channels(document: Document, number: int) -> list[tuple[int, str, Sampler]]:
    """Return what an animation changes: nodes, their fields, and the values of these."""
    animation = document.item("animations", number)
    what = f"{document.name}: animations[{number}]"
    samplers: dict[int, Sampler] = {}
    found: dict[tuple[int, str], Sampler] = {}
    for index, given in enumerate(animation["channels"]):
        target = as_object(given["target"], f"{what}.channels[{index}].target")
        path = target["path"]
        if "node" not in target or path not in _COMPONENTS:  # as extensions have them
            continue
        node = document.item("nodes", target["node"])
        if "matrix" in node and path != "weights":
            raise ModelError(f"{what} moves nodes[{target['node']}], which has a matrix; export it again")
        if (target["node"], path) in found:
            raise ModelError(f"{what} gives nodes[{target['node']}] its {path} twice; export it again")
        chosen = given["sampler"]
        if not isinstance(chosen, int) or not 0 <= chosen < len(animation["samplers"]):
            raise ModelError(f"{what} refers to samplers[{chosen}], which it does not have; export it again")
        if chosen not in samplers:
            entry = as_object(animation["samplers"][chosen], f"{what}.samplers[{chosen}]")
            samplers[chosen] = _sampler(document, entry, path, f"{what}.samplers[{chosen}]")
        found[target["node"], path] = samplers[chosen]
    return [(node, path, sampler) for (node, path), sampler in found.items()]


def _sampler(document: Document, entry: Json, path: str, what: str) -> Sampler:
    times = document.accessor(entry["input"], (1,))[:, 0].astype(np.float64)
    values = document.accessor(entry["output"], (_COMPONENTS[path],)).astype(np.float64)
    interpolation = entry.get("interpolation", "LINEAR")
    if interpolation not in _INTERPOLATIONS:
        raise ModelError(f"{what} interpolates by {interpolation!r}, which is not one of glTF's")
    if not len(times) or not np.isfinite(times).all() or times[0] < 0 or not (np.diff(times) > 0).all():
        raise ModelError(f"{what} has times that do not ascend from 0 on; export it again")
    a_key = 3 if interpolation == "CUBICSPLINE" else 1
    width = len(values) // (a_key * len(times)) if path == "weights" else 1
    if not width or len(values) != width * a_key * len(times):
        raise ModelError(f"{what} has {len(values)} values for {len(times)} times; export it again")
    if not np.isfinite(values).all():
        raise ModelError(f"{what} has values that are not finite; export it again")
    parts = (a_key, -1) if a_key > 1 else (-1,)
    return Sampler(times, values.reshape(len(times), *parts), interpolation, path == "rotation")


def _unit(values: Float64s, turns: bool) -> Float64s:
    """Return quaternions at length 1, other values as they are."""
    length = float(np.linalg.norm(values))
    return values / length if turns and length else values


def _slerp(a: Float64s, b: Float64s, t: float) -> Float64s:
    """Return the rotation between two, the shorter way round, at an even speed (C.3)."""
    a, b = _unit(a, True), _unit(b, True)
    dot = float(a @ b)
    if dot < 0:
        b, dot = -b, -dot
    angle = float(np.arctan2(np.linalg.norm(b - dot * a), dot))
    if angle < 1e-6:  # where both weights are 0 / 0
        return _unit((1 - t) * a + t * b, True)
    return np.asarray((np.sin((1 - t) * angle) * a + np.sin(t * angle) * b) / np.sin(angle))
