"""Cameras of glTF scenes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from octex.view.camera_records import (
    BrokenError,
    Floats,
    Frame,
    Json,
    Lens,
    as_index,
    choice_field,
    field_of,
    focal_per_size,
    index_field,
    intrinsics_of,
    numbers_field,
    object_field,
    objects_field,
    positive_field,
    rotation_of,
    text_field,
    view_of_pose,
    within,
)


def json_chunk(content: bytes) -> bytes:
    """Return the JSON of a binary glTF."""
    if len(content) < 20:
        raise BrokenError("ends in its header; copy or export it again")
    version, _, length, kind = struct.unpack_from("<IIII", content, 4)
    if version != 2:
        raise BrokenError(f"is glTF {version}; octex reads glTF 2, export it as that")
    if kind != 0x4E4F534A:
        raise BrokenError("does not begin with a JSON chunk; export it again")
    if length > len(content) - 20:
        raise BrokenError("ends in its JSON chunk; copy or export it again")
    return content[20 : 20 + length]


def read_gltf(path: Path, document: Json) -> list[Frame]:
    """Read the cameras of a scene's nodes."""
    nodes = objects_field(document, "nodes") if "nodes" in document else []
    cameras = objects_field(document, "cameras") if "cameras" in document else []
    frames: list[Frame] = []
    names: set[str] = set()
    for number, to_world in _scene_nodes(document, nodes):
        if "camera" not in nodes[number]:
            continue
        with within(f"node {number}"):
            index = index_field(nodes[number], "camera", cameras)
            name = _gltf_name(nodes[number], cameras[index], index, names)
        with within(f"frame {name!r}"):
            lens, projection = _gltf_lens(cameras[index])
            frames.append(Frame(name, None, None, path, lens, _gltf_view(to_world), projection))
    return frames


def _scene_nodes(document: Json, nodes: list[Json]) -> Iterator[tuple[int, Floats]]:
    """Yield the scene's nodes, and the matrices (4, 4) that take them to the world, parents first."""
    roots = list(range(len(nodes)))
    children = [_links(node, f"node {number}", "children", nodes) for number, node in enumerate(nodes)]
    if document.get("scenes"):
        scenes = objects_field(document, "scenes")
        number = index_field(document, "scene", scenes) if "scene" in document else 0
        roots = _links(scenes[number], f"scene {number}", "nodes", nodes)
    else:
        roots = sorted(set(roots).difference(*children))
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while pending:
        number, parent = pending.pop()
        if number in seen:
            raise BrokenError(f"node {number} stands twice in the scene; a node must have one parent")
        seen.add(number)
        with within(f"node {number}"):
            to_world = parent @ _local(nodes[number])
        yield number, to_world
        pending.extend((child, to_world) for child in reversed(children[number]))


def _links(record: Json, place: str, field: str, nodes: list[Json]) -> list[int]:
    if field not in record:
        return []
    with within(place):
        return [as_index(value, field, nodes) for value in field_of(record, field, list, "a list of indices")]


def _local(node: Json) -> Floats:
    if "matrix" in node:
        return numbers_field(node, "matrix", 16).reshape(4, 4).T
    local = np.eye(4)
    if "rotation" in node:
        x, y, z, w = numbers_field(node, "rotation", 4)
        local[:3, :3] = rotation_of(np.array([w, x, y, z]), "rotation")
    if "scale" in node:
        local[:3, :3] *= numbers_field(node, "scale", 3)
    if "translation" in node:
        local[:3, 3] = numbers_field(node, "translation", 3)
    return local


def _gltf_name(node: Json, camera: Json, index: int, names: set[str]) -> str:
    """Return a name that is not in ``names`` yet, and put it there."""
    wanted = next(
        (text_field(record, "name") for record in (node, camera) if record.get("name")), f"camera_{index}"
    )
    name, count = wanted, 1
    while name in names:
        count += 1
        name = f"{wanted}_{count}"
    names.add(name)
    return name


def _gltf_lens(camera: Json) -> tuple[Lens, Literal["pinhole", "orthographic"]]:
    if choice_field(camera, "type", ("perspective", "orthographic")) == "perspective":
        fields = object_field(camera, "perspective")
        with within("perspective"):
            focal = focal_per_size(fields, "yfov")
        return lambda width, height: _centred(focal * height, width, height), "pinhole"
    fields = object_field(camera, "orthographic")
    with within("orthographic"):
        x, y = positive_field(fields, "xmag"), positive_field(fields, "ymag")

    def lens(width: int, height: int) -> Floats:
        across, down = width / (2 * x), height / (2 * y)
        if abs(across - down) > 0.01 * down:
            raise BrokenError(
                f"xmag {x:g} and ymag {y:g} are not of the shape of a picture of {width}×{height} pixels; "
                "give one of their shape"
            )
        return _centred(down, width, height)

    return lens, "orthographic"


def _centred(focal: float, width: int, height: int) -> Floats:
    return intrinsics_of(focal, focal, width / 2, height / 2)


def _gltf_view(to_world: Floats) -> Floats:
    pose = to_world.copy()
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and (lengths > 0.0).all() and np.isfinite(lengths).all()):
        raise BrokenError("its node, with the nodes above it, must not scale to nothing or to infinity")
    pose[:3, :3] /= lengths
    return view_of_pose(pose, "opengl")


# COLMAP
