"""Cameras of Agisoft Metashape's .xml export (Metashape user manual, appendix "Camera models").

Poses are relative to a chunk's component. The transform of the component, or of the chunk, maps them to the
local coordinates in which Metashape exports models.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from octex.arrays import Float64s
from octex.cameras.camera import FLIP_YZ
from octex.cameras.fields import BrokenError, Record, within
from octex.cameras.frames import Frame, Optics, view_matrix
from octex.cameras.lens import DistortionModel

#: WKT names of coordinate systems that are not local.
_ON_EARTH = "GEOGCS", "GEOCCS", "PROJCS", "COMPD_CS", "GEOGCRS", "GEODCRS", "PROJCRS", "COMPOUNDCRS"


def read(path: Path, content: bytes) -> list[Frame]:
    """Read the aligned cameras of all chunks."""
    if b"<!DOCTYPE" in content:
        raise BrokenError("has a document type, unlike exports of Metashape; export the cameras again")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BrokenError(f"is not XML ({error}); export the cameras again") from None
    chunks = list(root.iter("chunk"))
    if root.tag != "document" or not chunks:
        raise BrokenError("is not a camera file; export the cameras from Metashape as Agisoft XML")
    return [frame for chunk in chunks for frame in _frames(path, chunk)]


def _frames(path: Path, chunk: Element) -> list[Frame]:
    sensors = {each.get("id"): each for each in chunk.iter("sensor")}
    components = {each.get("id"): each for each in chunk.iter("component")}
    frames = []
    for camera in chunk.iter("camera"):
        name = camera.get("label")
        if camera.find("transform") is None or name is None:
            continue  # not aligned
        if camera.get("enabled") in ("false", "0"):
            continue  # Metashape does not texture with it either
        with within(f"frame {name!r}"):
            sensor = sensors.get(camera.get("sensor_id"))
            if sensor is None:
                raise BrokenError(f"sensor_id {camera.get('sensor_id')!r} names no sensor of the file")
            pose = _numbers(camera).numbers("transform", 16).reshape(4, 4)
            for owner in (components.get(camera.get("component_id")), chunk):
                transform = None if owner is None else owner.find("transform")
                if transform is not None and len(transform):
                    if chunk.findtext("reference", "").strip().startswith(_ON_EARTH):
                        raise BrokenError(
                            "the chunk has geographic coordinates, in which models and cameras do not match; "
                            "set its reference to local coordinates, then export both again"
                        )
                    with within("the component's transform"):
                        pose = _transformed(_numbers(transform), pose)
                    break
            with within("transform"):
                view = view_matrix(pose @ FLIP_YZ, "opengl")  # Metashape's cameras look along z, with y down
            with within(f"sensor {sensor.get('label')!r}"):
                frames.append(Frame(name, path, _optics(sensor), view))
    return frames


def _numbers(element: Element) -> Record:
    """Return the child elements as lists of numbers."""
    return Record({each.tag: (each.text or "").split() for each in reversed(element)}, are_texts=True)


def _transformed(transform: Record, pose: Float64s) -> Float64s:
    """Apply a similarity to a pose (camera to world)."""
    rotation = transform.numbers("rotation", 9).reshape(3, 3) if "rotation" in transform else np.eye(3)
    factor = float(transform.numbers("scale", 1)[0]) if "scale" in transform else 1.0
    transformed = pose.copy()
    transformed[:3, :3] = rotation @ pose[:3, :3]
    transformed[:3, 3] = factor * rotation @ pose[:3, 3]
    if "translation" in transform:
        transformed[:3, 3] += transform.numbers("translation", 3)
    return transformed


def _optics(sensor: Element) -> Optics:
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise BrokenError(f"type {kind!r} is not known; octex knows frame and fisheye")
    calibrations = {each.get("class", ""): each for each in reversed(sensor.findall("calibration"))}
    calibration = calibrations.get("adjusted", next(iter(calibrations.values()), None))
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None:
        raise BrokenError("calibration or resolution is missing; align the photos, then export again")
    width, height = size = Record({"width": "", "height": "", **resolution.attrib}, are_texts=True).size()
    record = Record({each.tag: each.text or "" for each in reversed(calibration)}, are_texts=True)
    focal, b1, b2, cx, cy = (record.number(field, 0.0) for field in ("f", "b1", "b2", "cx", "cy"))
    if not focal > 0.0:
        raise BrokenError(f"f must be above zero, not {focal:g}")
    for field in ("p3", "p4", *(["k4"] if kind == "frame" else [])):
        if record.number(field, 0.0):
            raise BrokenError(f"{field} must be zero: octex has no such number; undistort the photos")
    K = np.array([[focal + b1, b2, width / 2 + cx], [0.0, focal, height / 2 + cy], [0.0, 0.0, 1.0]])
    # Metashape's p1 multiplies x², as OpenCV's p2 does.
    numbers = [record.number(field, 0.0) for field in ("k1", "k2", "p2", "p1", "k3", "k4")]
    model: DistortionModel = "fisheye" if kind == "fisheye" else "opencv"
    return Optics(size, K).bent(model, "k1 k2 p1 p2 k3 k4", numbers)
