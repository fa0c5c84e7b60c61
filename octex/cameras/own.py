"""octex's own cameras: JSON with a list of cameras, each with the fields of `_written`."""

from __future__ import annotations

import json
import reprlib
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from octex.cameras.camera import Camera
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, view_of
from octex.cameras.lens import COUNTS, DISTORTION_MODELS, DistortionModel

#: The field that tells octex's own files, with the version of their layout.
MARK = "octex_cameras"
_VERSION = 1


def written(cameras: Mapping[str, Camera], views: Mapping[str, bytes]) -> bytes:
    """Return a file of cameras by name; ``views`` are PNG files of what they see, by the same names."""
    lines = [
        json.dumps(_written(name, each, views.get(name)), allow_nan=False) for name, each in cameras.items()
    ]
    head = f'{{"{MARK}": {_VERSION}, "cameras": ['
    return (head + ",".join("\n" + line for line in lines) + "\n]}\n").encode("ascii")


def _written(name: str, camera: Camera, view: bytes | None) -> dict[str, Any]:
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "projection": camera.projection,
        "K": camera.K.tolist(),
        "pose": camera.world_to_camera.tolist(),
        "convention": "opencv",
        "distortion": list(camera.distortion),
        **({} if camera.distortion_model == "opencv" else {"distortion_model": camera.distortion_model}),
        **({} if view is None else {"view": b64encode(view).decode("ascii")}),
    }


def read(path: Path, document: dict[str, Any]) -> list[Frame]:
    """Read a file that `written` made."""
    version = document[MARK]
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise BrokenError(f"{MARK} must be the number {_VERSION}, not {reprlib.repr(version)}")
    if version > _VERSION:
        newer = reprlib.repr(version)
        raise BrokenError(f"{MARK} is {newer}, from a newer octex; this one reads {_VERSION}, update it")
    frames = []
    for number, record in enumerate(Record(document).records("cameras")):
        with within(f"camera {number}"):
            name = record.text("name")
        with within(f"frame {name!r}"):
            frame = frame_of(path, name, record, record.size())
            view = _decoded(record.text("view")) if "view" in record else None
            frames.append(frame._replace(view=view))
    return frames


def frame_of(
    path: Path,
    name: str,
    record: Record,
    size: tuple[int, int] | None,
    K: str = "K",
    pose: str = "pose",
    shapes: Sequence[tuple[int, int]] = ((4, 4),),
) -> Frame:
    """Return the camera that a record describes; ``K`` and ``pose`` are the names of its matrices."""
    projection = record.choice("projection", ("pinhole", "orthographic"))
    convention = record.choice("convention", ("opencv", "opengl"))
    matrix, placed = record.matrix(K, (3, 3)), record.matrix(pose, *shapes)
    model: DistortionModel = record.choice("distortion_model", DISTORTION_MODELS, DISTORTION_MODELS[0])
    distortion = record.numbers("distortion", *COUNTS[model]) if "distortion" in record else None
    if projection == "orthographic" and (model != "opencv" or (distortion is not None and distortion.any())):
        raise BrokenError("distortion must be zeros for an orthographic camera")
    with within(K):
        camera = Camera.pinhole(
            size or (1, 1), pose=np.eye(4), convention="opencv", K=matrix, distortion_model=model,
            distortion=None if distortion is None else distortion.tolist(),
        )  # fmt: skip
    with within(pose):
        view = view_of(placed, convention)
    return Frame(name, path, Optics(size, matrix, camera.distortion, model, projection), view)


def _decoded(text: str) -> bytes:
    try:
        return b64decode(text, validate=True)
    except ValueError as error:
        raise BrokenError(f"view is no picture in base64 ({error}); draw the view again") from None
