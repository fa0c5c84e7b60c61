"""Cameras of glTF scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import (
    BrokenError,
    Frame,
    Json,
    Lens,
    choice_field,
    focal_per_size,
    intrinsics_of,
    object_field,
    positive_field,
    text_field,
    view_of_pose,
    within,
)
from octex.source.models.gltf_file import Document, scene_nodes


def read_gltf(path: Path, document: Document) -> list[Frame]:
    """Read the cameras of a scene's nodes."""
    frames: list[Frame] = []
    names: set[str] = set()
    for number, node, to_world in scene_nodes(document):
        if "camera" not in node:
            continue
        camera = document.item("cameras", node["camera"])
        with within(f"nodes[{number}]"):
            if "rotation" in node and not any(node["rotation"]):
                raise BrokenError("rotation must not be zero")
            name = _gltf_name(node, camera, names)
        with within(f"frame {name!r}"):
            lens, projection = _gltf_lens(camera)
            frames.append(Frame(name, None, None, path, lens, _gltf_view(to_world), projection))
    return frames


def _gltf_name(node: Json, camera: Json, names: set[str]) -> str:
    """Return a name that is not in ``names`` yet, and put it there."""
    wanted = next(
        (text_field(record, "name") for record in (node, camera) if record.get("name")),
        f"camera_{node['camera']}",
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

    def lens(width: int, height: int) -> Float64s:
        across, down = width / (2 * x), height / (2 * y)
        if abs(across - down) > 0.01 * down:
            raise BrokenError(
                f"xmag {x:g} and ymag {y:g} are not of the shape of a picture of {width}×{height} pixels; "
                "give one of their shape"
            )
        return _centred(down, width, height)

    return lens, "orthographic"


def _centred(focal: float, width: int, height: int) -> Float64s:
    return intrinsics_of(focal, focal, width / 2, height / 2)


def _gltf_view(to_world: Float64s) -> Float64s:
    pose = to_world.copy()
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and (lengths > 0.0).all() and np.isfinite(lengths).all()):
        raise BrokenError("its node, with the nodes above it, must not scale to nothing or to infinity")
    pose[:3, :3] /= lengths
    return view_of_pose(pose, "opengl")
