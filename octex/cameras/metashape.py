"""Cameras of Agisoft Metashape, as it exports them to .xml (Metashape user manual, appendix "Camera models").

A chunk's cameras stand in the axes of its component, whose transform, or the chunk's, brings them to where
models are exported in local coordinates.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from octex.arrays import Float64s
from octex.cameras.fields import (
    BrokenError,
    Frame,
    Optics,
    number_of,
    size_of,
    view_of_pose,
    within,
)

#: What other coordinates than local ones are called in WKT.
_ON_EARTH = "GEOGCS", "GEOCCS", "PROJCS", "COMPD_CS", "GEOGCRS", "GEODCRS", "PROJCRS", "COMPOUNDCRS"
#: Its cameras look along z, and y points down.
_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: Numbers of a calibration that octex has none for.
_UNKNOWN = "p3", "p4"


def read_metashape(path: Path, content: bytes) -> list[Frame]:
    """Read the cameras of all chunks that are aligned."""
    if b"<!DOCTYPE" in content:
        raise BrokenError("has a document type, which no export of Metashape has")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BrokenError(f"is not XML ({error}); export the cameras again") from None
    chunks = list(root.iter("chunk"))
    if root.tag != "document" or not chunks:
        raise BrokenError("is no file of cameras; export them from Metashape as Agisoft XML")
    return [frame for chunk in chunks for frame in _frames(path, chunk)]


def _frames(path: Path, chunk: Element) -> list[Frame]:
    sensors = {each.get("id"): each for each in chunk.iter("sensor")}
    components = {each.get("id"): each for each in chunk.iter("component")}
    frames = []
    for camera in chunk.iter("camera"):
        given, name = camera.find("transform"), camera.get("label")
        if given is None or name is None:
            continue  # not aligned
        with within(f"frame {name!r}"):
            sensor = sensors.get(camera.get("sensor_id"))
            if sensor is None:
                raise BrokenError(f"sensor_id {camera.get('sensor_id')!r} names no sensor of the file")
            pose = _numbers(given, 16).reshape(4, 4)
            component = components.get(camera.get("component_id"))
            for owner in (component, chunk):
                transform = None if owner is None else owner.find("transform")
                if transform is not None and len(transform):
                    _check_reference(chunk)
                    pose = _placed(transform, pose)
                    break
            with within("transform"):
                view = view_of_pose(pose @ _TO_OPENGL, "opengl")
            with within(f"sensor {sensor.get('label')!r}"):
                frames.append(_optics(sensor).frame(name, path, view))
    return frames


def _check_reference(chunk: Element) -> None:
    reference = chunk.findtext("reference", "").strip()
    if reference.startswith(_ON_EARTH):
        raise BrokenError(
            "the chunk's coordinates are on the earth, where models are exported in others than cameras; set "
            "its reference to local coordinates, then export both again"
        )


def _placed(transform: Element, pose: Float64s) -> Float64s:
    """Return where a similarity brings a pose (camera to world)."""
    with within("the component's transform"):
        turn, shift, scale = (transform.find(each) for each in ("rotation", "translation", "scale"))
        rotation = np.eye(3) if turn is None else _numbers(turn, 9).reshape(3, 3)
        factor = 1.0 if scale is None else float(_numbers(scale, 1)[0])
        placed = pose.copy()
        placed[:3, :3] = rotation @ pose[:3, :3]
        placed[:3, 3] = factor * rotation @ pose[:3, 3]
        if shift is not None:
            placed[:3, 3] += _numbers(shift, 3)
    return placed


def _optics(sensor: Element) -> Optics:
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise BrokenError(f"type {kind!r} is not known; octex knows frame and fisheye")
    found = {each.get("class", ""): each for each in reversed(sensor.findall("calibration"))}
    calibration = found.get("adjusted", next(iter(found.values()), None))
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None:
        raise BrokenError("calibration or resolution is missing; align the photos, then export again")
    size = size_of(*(number_of(resolution.get(each, ""), each) for each in ("width", "height")))

    def number(field: str) -> float:
        text = calibration.findtext(field)
        return 0.0 if text is None else number_of(text, field)

    focal = number("f")
    if not focal > 0.0:
        raise BrokenError(f"f must be above zero, not {focal:g}")
    unknown = [*_UNKNOWN, "k4"] if kind == "frame" else _UNKNOWN
    for field in unknown:
        if number(field):
            raise BrokenError(f"{field} must be zero: octex has no such number; undistort the photos")
    K = np.array(
        [
            [focal + number("b1"), number("b2"), size[0] / 2 + number("cx")],
            [0.0, focal, size[1] / 2 + number("cy")],
            [0.0, 0.0, 1.0],
        ]
    )
    # Metashape's p1 goes with x², which is OpenCV's second.
    k1, k2, p1, p2, k3, k4 = map(number, ("k1", "k2", "p2", "p1", "k3", "k4"))
    if kind == "fisheye":
        return Optics(size, K, (k1, k2, p1, p2, k3, k4, 0.0, 0.0), "fisheye")
    return Optics(size, K, (k1, k2, p1, p2, k3), "opencv")


def _numbers(element: Element, count: int) -> Float64s:
    texts = (element.text or "").split()
    if len(texts) != count:
        raise BrokenError(f"{element.tag} must be {count} numbers, not {len(texts)}")
    return np.array([number_of(each, element.tag) for each in texts])
