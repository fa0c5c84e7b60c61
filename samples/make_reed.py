"""A reed that bends: a glTF file with a skin of four joints and an animation."""

import base64
import json
from pathlib import Path

import numpy as np

ROWS, AROUND, HEIGHT = 48, 24, 2.0


def write_reed(path: Path) -> None:
    """Write a .gltf whose animation "Bend" takes two seconds."""
    up, turn = np.mgrid[: ROWS + 1, : AROUND + 1] / [[[ROWS]], [[AROUND]]]
    radius = 0.22 - 0.12 * up
    round_about = radius * np.sin(2 * np.pi * turn), radius * np.cos(2 * np.pi * turn)
    positions = np.stack([round_about[0], HEIGHT * up, round_about[1]], axis=-1).reshape(-1, 3)
    at = np.arange(ROWS)[:, None] * (AROUND + 1) + np.arange(AROUND)
    cells = np.stack([at, at + 1, at + AROUND + 2, at + AROUND + 1], axis=-1).reshape(-1, 4)
    triangles = cells[:, [[0, 1, 2], [0, 2, 3]]]
    share = 4 * up.reshape(-1)[:, None] - np.arange(4) - 0.5  # of each joint, which stands for a quarter
    weights = np.clip(1.0 - np.abs(share), 0.0, None)
    weights[:, 0][share[:, 0] < 0], weights[:, 3][share[:, 3] > 0] = 1.0, 1.0
    inverses = np.tile(np.eye(4), (4, 1, 1))
    inverses[:, 3, 1] = -HEIGHT / 4 * np.arange(4)  # columns one after the other
    times = np.linspace(0, 2, 9)
    angles = 0.35 * np.sin(np.pi * times) / 2
    turns = np.stack([0 * angles, 0 * angles, np.sin(angles), np.cos(angles)], axis=1)
    gltf = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
    data = b""
    every = [
        *((positions, "f4", "VEC3"), (np.tile(np.arange(4), (len(positions), 1)), "u1", "VEC4")),
        *((weights, "f4", "VEC4"), (triangles.reshape(-1, 1), "u4", "SCALAR")),
        *((inverses.reshape(4, 16), "f4", "MAT4"), (times[:, None], "f4", "SCALAR"), (turns, "f4", "VEC4")),
    ]
    for number, (rows, dtype, kind) in enumerate(every):
        part = rows.astype(f"<{dtype}").tobytes()
        gltf["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part)})
        component = {"f4": 5126, "u1": 5121, "u4": 5125}[dtype]
        fields = {"bufferView": number, "componentType": component, "count": len(rows), "type": kind}
        gltf["accessors"].append(fields)
        data += part
    gltf["buffers"] = [{"uri": f"data:;base64,{base64.b64encode(data).decode()}", "byteLength": len(data)}]
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    gltf["meshes"] = [{"primitives": [{"attributes": attributes, "indices": 3}]}]
    gltf["nodes"] = [{"mesh": 0, "skin": 0}, {"children": [2]}]
    gltf["nodes"] += [{"children": [n + 1], "translation": [0, HEIGHT / 4, 0]} for n in (2, 3)]
    gltf["nodes"].append({"translation": [0, HEIGHT / 4, 0]})
    gltf["skins"] = [{"joints": [1, 2, 3, 4], "inverseBindMatrices": 4}]
    channels = [{"sampler": 0, "target": {"node": n, "path": "rotation"}} for n in (2, 3, 4)]
    samplers = [{"input": 5, "output": 6}]
    gltf["animations"] = [{"name": "Bend", "channels": channels, "samplers": samplers}]
    gltf |= {"scene": 0, "scenes": [{"nodes": [0, 1]}]}
    path.write_text(json.dumps(gltf), encoding="utf-8")
