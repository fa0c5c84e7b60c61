"""A model and its maps as one glTF 2.0 binary file."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .solids import Array, Model
from .unwrap import Unwrap

PLAIN = {  # materials without a map: linear base colour, roughness
    "gasket": ([0.012, 0.012, 0.014, 1.0], 0.8),
    "cable": ([0.150, 0.010, 0.007, 1.0], 0.5),
    "lens": ([1.0, 1.0, 1.0, 1.0], 0.1),  # has vertex colours
}
LENS_RADIUS = 0.0142
IRIS = [  # share of the lens' radius, linear colour
    (0.00, (0.004, 0.010, 0.018)),
    (0.36, (0.006, 0.030, 0.050)),
    (0.42, (0.020, 0.360, 0.520)),
    (0.74, (0.008, 0.130, 0.240)),
    (1.00, (0.002, 0.006, 0.010)),
]
VERTICES, INDICES = 34962, 34963  # bufferView targets
COMPONENT = {"f4": 5126, "u2": 5123, "u1": 5121}


def smooth_normals(model: Model) -> Array:
    """Return unit normals (3 m, 3) of the corners: means over faces of one finish that bend little."""
    vertex = model.triangles.ravel()
    order = np.argsort(vertex, kind="stable")
    valence = np.bincount(vertex)
    first = np.cumsum(valence) - valence
    # Pairs of corners at one vertex: every corner with each of its vertex' corners in turn.
    one = np.repeat(np.arange(len(vertex)), valence[vertex])
    turn = np.arange(len(one)) - np.repeat(np.cumsum(valence[vertex]) - valence[vertex], valence[vertex])
    other = order[first[vertex[one]] + turn]
    f, g = one // 3, other // 3
    normals, finish, bend = model.normals, model.of("finish"), np.cos(np.radians(model.of("crease")))
    near = ((normals[f] * normals[g]).sum(1) > bend[f]) & (finish[f] == finish[g])
    total = np.repeat(normals * 1e-12, 3, axis=0)
    np.add.at(total, one[near], model.crosses[g[near]])
    return total / np.linalg.norm(total, axis=1)[:, None]


def iris(model: Model, corners: Array) -> Array:
    """Return vertex colours (n, 4), normalized bytes, of corners of lenses."""
    points, skin = model.corners.reshape(-1, 3)[corners], model.skin[corners // 3]
    radius = np.zeros(len(corners))
    for number in np.unique(skin):
        mine = skin == number
        radius[mine] = np.hypot(*model.skins[number].to_local(points[mine])[:, :2].T) / LENS_RADIUS
    stops, colors = zip(*IRIS, strict=True)
    channels = [np.interp(radius, stops, channel) for channel in zip(*colors, strict=True)]
    return np.rint(np.stack([*channels, np.ones(len(corners))], -1) * 255).astype(np.uint8)


class Writer:
    """The binary chunk of a .glb, and the JSON that describes it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, **more: int) -> int:
        """Append bytes, aligned to four; return the bufferView's number."""
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **more})
        self.data += content
        return len(self.views) - 1

    def accessor(self, array: Array, kind: str, target: int = VERTICES, **more: Any) -> int:
        """Append an array; return the accessor's number."""
        view = self.view(array.tobytes(), target=target)
        component = COMPONENT[array.dtype.str[1:]]
        entry = {"bufferView": view, "componentType": component, "count": len(array), "type": kind, **more}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def save(self, path: Path, document: dict[str, Any]) -> None:
        """Write the file."""
        self.data += bytes(-len(self.data) % 4)
        parts = {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(document | parts, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with path.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(self.data)))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(self.data), b"BIN\0") + self.data)


def write_primitive(
    w: Writer, model: Model, normals: Array, uv: Array | None, corners: Array, colored: bool
) -> Any:
    """Write the triangles of some corners, equal corners shared."""
    positions = model.corners.reshape(-1, 3)[corners].astype("<f4")
    columns = [positions, normals[corners].astype("<f4")]
    if uv is not None:
        columns.append(np.rint(uv[corners] * 65535))
    _, first, index = np.unique(np.hstack(columns), axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))  # vertices in the order in which triangles need them
    first, index = np.sort(first), rank[index.ravel()].astype("<u2")
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    attributes = {
        "POSITION": w.accessor(columns[0][first], "VEC3", **bounds),
        "NORMAL": w.accessor(columns[1][first], "VEC3"),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = w.accessor(columns[2][first].astype("<u2"), "VEC2", normalized=True)
    if colored:
        attributes["COLOR_0"] = w.accessor(iris(model, corners[first]), "VEC4", normalized=True)
    return {"attributes": attributes, "indices": w.accessor(index, "SCALAR", INDICES)}


def write(path: Path, model: Model, unwrapped: Unwrap, images: dict[str, Image.Image]) -> None:
    """Write the file; the same model and images give the same bytes."""
    w = Writer()
    normals = np.round(smooth_normals(model), 5)
    uv = np.clip(unwrapped.uv.reshape(-1, 2), 0, 1)
    material = np.array([skin.map or skin.finish for skin in model.skins])[model.skin]
    primitives, materials, stored = [], [], []
    for number, name in enumerate([*images, *PLAIN]):
        corners = np.flatnonzero(np.repeat(material == name, 3))
        mapped = uv if name in images else None
        primitive = write_primitive(w, model, normals, mapped, corners, name == "lens")
        primitives.append({**primitive, "material": number})
        if name in images:
            look: dict[str, Any] = {"baseColorTexture": {"index": number}, "roughnessFactor": 0.55}
        else:
            look = dict(zip(("baseColorFactor", "roughnessFactor"), PLAIN[name], strict=True))
        materials.append({"name": name, "pbrMetallicRoughness": {**look, "metallicFactor": 0.0}})
    for name, image in images.items():
        png = io.BytesIO()
        image.save(png, "PNG", optimize=True)
        stored.append({"bufferView": w.view(png.getvalue()), "mimeType": "image/png", "name": name})
    document = {
        "asset": {"version": "2.0", "generator": "samples/make_droid.py"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "OX-8"}],
        "meshes": [{"name": "OX-8", "primitives": primitives}],
        "materials": materials,
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "images": stored,
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
    }
    w.save(path, document)
