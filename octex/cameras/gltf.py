"""Cameras of glTF scenes."""

from __future__ import annotations

from itertools import chain, count
from pathlib import Path

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, centred, view_matrix
from octex.cameras.transforms import focal_of_angle
from octex.gltf import Document, scene_nodes


def read(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of a scene's nodes."""
    document = Document(path, content)
    frames: dict[str, Frame] = {}
    for number, node, to_world in scene_nodes(document):
        if "camera" not in node:
            continue
        camera = Record(document.item("cameras", node["camera"]))
        with within(f"nodes[{number}]"):
            if "rotation" in node and not any(node["rotation"]):
                raise BrokenError("rotation must not be zero")
            named = next((record for record in (Record(node), camera) if record.find("name")), None)
            base = named.text("name") if named else f"camera_{node['camera']}"
            names = chain([base], (f"{base}_{copy}" for copy in count(2)))
            name = next(name for name in names if name not in frames)
        with within(f"frame {name!r}"):
            frames[name] = Frame(name, path, _optics(camera), _view(to_world))
    return list(frames.values())


def _optics(camera: Record) -> Optics:
    kind = camera.choice("type", ("perspective", "orthographic"))
    fields = camera.record(kind)
    with within(kind):
        if kind == "perspective":
            focal = focal_of_angle(fields, "yfov")
            return Optics(None, lambda width, height: centred(focal * height, width, height))
        x, y = fields.positive("xmag"), fields.positive("ymag")

    def scaled(width: int, height: int) -> Float64s:
        across, down = width / (2 * x), height / (2 * y)
        if abs(across - down) > 0.01 * down:
            raise BrokenError(
                f"xmag {x:g} and ymag {y:g} do not have the aspect ratio of an image of {width}×{height} "
                "pixels; give one that does"
            )
        return centred(down, width, height)

    return Optics(None, scaled, projection="orthographic")


def _view(to_world: Float64s) -> Float64s:
    pose = to_world.copy()
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and (lengths > 0.0).all() and np.isfinite(lengths).all()):
        raise BrokenError("its node, with the nodes above it, must not scale to nothing or to infinity")
    pose[:3, :3] /= lengths
    return view_matrix(pose, "opengl")
