"""Where vertices of an animated glTF file are at a time, one by one.

Written from the text of glTF 2.0 (3.7.2.2, 3.7.3, 3.11 and appendix C), not from octex.
"""

from __future__ import annotations

from math import acos, sin
from pathlib import Path
from typing import Any

import numpy as np

from tests.oracles.naive_gltf import Document, Floats, Json


def posed(path: Path, animation: int, time: float) -> Floats:
    """Positions (n, 3) of the vertices of all primitives, nodes depth first."""
    file = File(path)
    fields = {number: dict(node) for number, node in enumerate(file.json["nodes"])}
    for channel in file.json["animations"][animation]["channels"]:
        target = channel["target"]
        sampler = file.json["animations"][animation]["samplers"][channel["sampler"]]
        fields[target["node"]][target["path"]] = value(file, sampler, target["path"], time)
    worlds: dict[int, Floats] = {}
    order = []

    def visit(number: int, parent: Floats) -> None:
        worlds[number] = parent @ local(fields[number])
        order.append(number)
        for child in fields[number].get("children", []):
            visit(child, worlds[number])

    for root in file.json["scenes"][0]["nodes"]:
        visit(root, np.eye(4))
    found = []
    for number in order:
        node = fields[number]
        if "mesh" not in node:
            continue
        mesh = file.json["meshes"][node["mesh"]]
        for primitive in mesh["primitives"]:
            at = {name: file.array(each) for name, each in primitive["attributes"].items()}
            targets = [file.array(each["POSITION"]) for each in primitive.get("targets", [])]
            weights = node.get("weights", mesh.get("weights", [0.0] * len(targets)))
            for vertex, position in enumerate(at["POSITION"]):
                moved = position + sum(w * each[vertex] for w, each in zip(weights, targets, strict=True))
                matrix = worlds[number]
                if "skin" in node:
                    matrix = blended(file, node["skin"], worlds, at, vertex)
                found.append((matrix @ [*moved, 1])[:3])
    return np.array(found)


class File(Document):
    """A file whose matrices are read, too."""

    def matrix(self, accessor: int, number: int) -> Floats:
        entry = dict(self.json["accessors"][accessor])
        view = self.json["bufferViews"][entry["bufferView"]]
        data = self.binary[view.get("byteOffset", 0) + entry.get("byteOffset", 0) + 64 * number :][:64]
        return np.frombuffer(data, np.float32).reshape(4, 4).T.astype(np.float64)  # by columns


def blended(file: File, skin: int, worlds: dict[int, Floats], at: dict[str, Floats], vertex: int) -> Floats:
    entry = file.json["skins"][skin]
    sets = [n for n in range(2) if f"JOINTS_{n}" in at]
    joints = [joint for n in sets for joint in at[f"JOINTS_{n}"][vertex]]
    weights = [weight for n in sets for weight in at[f"WEIGHTS_{n}"][vertex]]
    if not any(weights):
        weights[0] = 1.0
    matrix = np.zeros((4, 4))
    for joint, weight in zip(joints, weights, strict=True):
        inverse = np.eye(4)
        if "inverseBindMatrices" in entry:
            inverse = file.matrix(entry["inverseBindMatrices"], int(joint))
        matrix += weight / sum(weights) * worlds[entry["joints"][int(joint)]] @ inverse
    return matrix


def local(node: Json) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = np.eye(4)
    for axis, scale in enumerate(node.get("scale", (1, 1, 1))):
        e = np.eye(3)[axis]
        u = np.array([x, y, z], np.float64)  # q e q*
        turned = e + 2 * np.cross(u, np.cross(u, e) + w * e)
        matrix[:3, axis] = scale * turned
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def value(file: File, sampler: Json, path: str, time: float) -> list[float]:
    times = file.array(sampler["input"])[:, 0]
    mode = sampler.get("interpolation", "LINEAR")
    rows = file.array(sampler["output"])
    a_key = len(rows) // len(times)
    keys: list[Any] = [rows[k * a_key : (k + 1) * a_key] for k in range(len(times))]
    if path != "weights":
        keys = [key if mode == "CUBICSPLINE" else key[0] for key in keys]
    elif mode == "CUBICSPLINE":
        keys = [key.reshape(3, -1) for key in keys]
    else:
        keys = [key[:, 0] for key in keys]
    values = [key[1] if mode == "CUBICSPLINE" else key for key in keys]
    if time <= times[0]:
        found = values[0]
    elif time >= times[-1]:
        found = values[-1]
    else:
        k = max(n for n in range(len(times)) if times[n] <= time)
        step = times[k + 1] - times[k]
        t = (time - times[k]) / step
        if mode == "STEP":
            found = values[k]
        elif mode == "CUBICSPLINE":  # C.4
            found = (
                (2 * t**3 - 3 * t**2 + 1) * values[k]
                + step * (t**3 - 2 * t**2 + t) * keys[k][2]
                + (-2 * t**3 + 3 * t**2) * values[k + 1]
                + step * (t**3 - t**2) * keys[k + 1][0]
            )
        elif path == "rotation":  # C.3
            d = float(values[k] @ values[k + 1])
            a, s = acos(min(abs(d), 1.0)), 1.0 if d >= 0 else -1.0
            if a < 1e-9:
                found = values[k]
            else:
                found = sin(a * (1 - t)) / sin(a) * values[k] + s * sin(a * t) / sin(a) * values[k + 1]
        else:
            found = (1 - t) * values[k] + t * values[k + 1]
    if path == "rotation":
        found = found / np.linalg.norm(found)
    return [float(each) for each in found]
