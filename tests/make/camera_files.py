"""Files of cameras of every kind, written by hand from known poses."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from trimesh.transformations import quaternion_from_matrix

from octex.cameras.camera import Camera
from octex.cameras.files import read_cameras, write_cameras
from octex.errors import CameraError
from tests.oracles.naive_lens import through

Floats = npt.NDArray[np.float64]
Document = dict[str, Any]

POINTS = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
LENS = (-0.2, 0.05, 1e-3, -2e-3)


def view(seed: int) -> Floats:
    """Return a world-to-camera matrix that sees POINTS."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = 0.1, -0.1, 3.0
    return matrix


def to_opengl(matrix: Floats) -> Floats:
    """Return the camera-to-world matrix, in OpenGL's axes, of a world-to-camera matrix."""
    return np.linalg.inv(matrix) @ np.diag([1.0, -1.0, -1.0, 1.0])


def bent(model: str, lens: Sequence[float], matrix: Floats | None = None) -> Floats:
    """Return where a lens puts POINTS (n, 2), by default seen from ``view(1)``, to the right and down."""
    matrix = view(1) if matrix is None else matrix
    seen = POINTS @ matrix[:3, :3].T + matrix[:3, 3]
    return np.array([through(model, lens, x / z, y / z) for x, y, z in seen])


def expected(
    matrix: Floats,
    focal_x: float,
    focal_y: float,
    center: tuple[float, float],
    lens: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> Floats:
    """Return where POINTS land."""
    return bent("OPENCV", lens, matrix) * [focal_x, focal_y] + center


def quaternion(rotation: Floats) -> Floats:
    """Return w, x, y, z of a rotation matrix."""
    return quaternion_from_matrix(np.pad(rotation, (0, 1)) + np.diag([0.0, 0, 0, 1]))


def write_json(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def sees(camera: Camera, pixels: Floats) -> None:
    np.testing.assert_allclose(camera.project(POINTS)[0], pixels, rtol=0, atol=1e-8)


def refusal(path: Path | str) -> str:
    with pytest.raises(CameraError) as caught:
        read_cameras(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


def transforms(**changes: Any) -> Document:
    fields = {
        "camera_model": "OPENCV",
        "fl_x": 500.0, "fl_y": 510, "cx": 310.0, "cy": 250.0, "w": 640, "h": 480.0,
        "k1": LENS[0], "k2": LENS[1], "p1": LENS[2], "p2": LENS[3],
        "aabb_scale": 16,
        "frames": [
            {"file_path": "./images/a.png", "transform_matrix": to_opengl(view(1)).tolist()},
            {"file_path": "images/b", "transform_matrix": to_opengl(view(2))[:3].tolist(), "fl_x": 700.0},
        ],
    }  # fmt: skip
    return {key: value for key, value in (fields | changes).items() if value is not None}


CAMERAS = [
    (1, "SIMPLE_PINHOLE", (500.0, 310.0, 250.0)),
    (2, "PINHOLE", (500.0, 510.0, 310.0, 250.0)),
    (3, "SIMPLE_RADIAL", (500.0, 310.0, 250.0, -0.1)),
    (4, "RADIAL", (500.0, 310.0, 250.0, -0.1, 0.02)),
    (7, "OPENCV", (500.0, 510.0, 310.0, 250.0, *LENS)),
    (8, "OPENCV_FISHEYE", (500.0, 510.0, 310.0, 250.0, 0.1, -0.05, 0.02, -0.01)),
    (9, "FULL_OPENCV", (500.0, 510.0, 310.0, 250.0, *LENS, 0.02, 0.1, 0.03, -0.01)),
    (10, "FOV", (500.0, 510.0, 310.0, 250.0, 0.9)),
    (11, "SIMPLE_RADIAL_FISHEYE", (500.0, 310.0, 250.0, 0.1)),
    (12, "RADIAL_FISHEYE", (500.0, 310.0, 250.0, 0.1, -0.03)),
    (13, "THIN_PRISM_FISHEYE", (500.0, 510.0, 310.0, 250.0, *LENS, 0.02, -0.01, 0.003, -0.002)),
]
NUMBERS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
}  # fmt: skip


def colmap_text(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list"]
    lines += [f"{key} {model} 640 480 {' '.join(map(repr, values))}" for key, model, values in CAMERAS]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = ["# Image list", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for key, _, _ in CAMERAS:
        numbers = [*(2.0 * quaternion(view(key)[:3, :3])), *view(key)[:3, 3]]
        lines += [f"{key} {' '.join(repr(float(n)) for n in numbers)} {key} dir/im {key}.jpg"]
        lines += ["1.5 2.5 -1 3.0 4.0 17" if key == 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines), encoding="utf-8")
    return folder


def colmap_binary(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    content = struct.pack("<Q", len(CAMERAS))
    for key, model, values in CAMERAS:
        content += struct.pack(f"<iiQQ{len(values)}d", key, NUMBERS[model], 640, 480, *values)
    (folder / "cameras.bin").write_bytes(content)
    content = struct.pack("<Q", len(CAMERAS))
    for key, _, _ in CAMERAS:
        numbers = [*(2.0 * quaternion(view(key)[:3, :3])), *view(key)[:3, 3]]
        content += struct.pack("<i7di", key, *numbers, key) + f"dir/im {key}.jpg\0".encode()
        points = [(1.5, 2.5, -1), (3.0, 4.0, 17)] if key == 2 else []
        content += struct.pack("<Q", len(points)) + b"".join(struct.pack("<ddq", *point) for point in points)
    (folder / "images.bin").write_bytes(content)
    return folder


def gltf(**changes: Any) -> Document:
    """Return two cameras that stand where view(1) and view(2) do, below scaled and turned nodes."""
    parent = np.eye(4)
    parent[:3, :3] = 2.0 * view(5)[:3, :3]
    parent[:3, 3] = 1.0, 2.0, 3.0
    w, x, y, z = quaternion(view(6)[:3, :3])
    middle = np.eye(4)
    middle[:3, :3] = 0.25 * view(6)[:3, :3]
    middle[:3, 3] = -1.0, 0.0, 0.5
    local = np.linalg.inv(parent @ middle) @ to_opengl(view(1))
    return {
        "asset": {"version": "2.0"},
        "scene": 1,
        "scenes": [{"nodes": [4]}, {"nodes": [0, 3]}],
        "nodes": [
            {"matrix": parent.T.ravel().tolist(), "children": [1]},
            {"rotation": [x, y, z, w], "scale": [0.25] * 3, "translation": [-1.0, 0.0, 0.5], "children": [2]},
            {"matrix": local.T.ravel().tolist(), "camera": 0, "name": "eye"},
            {"matrix": to_opengl(view(2)).T.ravel().tolist(), "camera": 1},
            {"camera": 0, "name": "of another scene"},
        ],
        "cameras": [
            {
                "type": "perspective",
                "name": "lens",
                "perspective": {"yfov": 0.7, "aspectRatio": 9.0, "znear": 0.1},
            },
            {"type": "orthographic", "orthographic": {"xmag": 2.0, "ymag": 1.5, "zfar": 9, "znear": 0.1}},
        ],
    } | changes


def glb(document: Document) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text), len(text), 0x4E4F534A) + text


def one_camera(**node: Any) -> Document:
    return gltf(nodes=[{"camera": 0, "name": "eye"} | node], scenes=[{"nodes": [0]}], scene=0)


def ours() -> dict[str, Camera]:
    return {
        "front": Camera.pinhole((640, 480), pose=view(1), convention="opencv", focal=501.3, distortion=LENS),
        "ü/side": Camera.pinhole(
            (64, 48), pose=to_opengl(view(2)), convention="opengl", K=[[50, 3, 30], [0, 40, 25], [0, 0, 1]]
        ),
        "top": Camera.orthographic((30, 40), pose=view(3), convention="opencv", pixels_per_unit=10 / 3),
        "fitted": Camera.fitted(POINTS, (1.0, 2.0, 3.0), size=(100, 50)),
    }


#: k1, k2, k3, p1, p2, b1, b2 of Metashape.
METASHAPE = {
    "f": 500.0, "cx": -9.5, "cy": 12.25, "b1": 1.5, "b2": -0.75, "k1": -0.2, "k2": 0.05, "k3": 0.01,
    "p1": 2e-3, "p2": -1e-3,
}  # fmt: skip


def metashape(
    numbers: Mapping[str, float] = METASHAPE,
    kind: str = "frame",
    reference: str = "LOCAL_CS[]",
    resolution: tuple[object, object] = (640, 480),
    **changes: Any,
) -> str:
    """Write a chunk whose component turns, moves and scales its cameras; return it and one's true pose."""
    turn, shift, scale = view(7)[:3, :3], np.array([0.5, -0.25, 2.0]), 1.75
    words = {"rotation": turn, "translation": shift, "scale": scale} | changes
    given = to_opengl(view(1)) @ np.diag([1.0, -1.0, -1.0, 1.0])  # from the camera's axes, y down
    own = given.copy()
    own[:3, :3], own[:3, 3] = turn.T @ given[:3, :3], turn.T @ (given[:3, 3] - shift) / scale

    def text(values: Any) -> str:
        return " ".join(map(repr, np.asarray(values).ravel().tolist()))

    calibration = "".join(f"<{name}>{value!r}</{name}>" for name, value in numbers.items())
    size = f'<resolution width="{resolution[0]}" height="{resolution[1]}"/>'
    placed = "".join(f"<{name}>{text(values)}</{name}>" for name, values in words.items())
    return f'''<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="3" label="lens" type="{kind}">{size}
<calibration type="{kind}" class="initial">{size}<f>77</f></calibration>
<calibration type="{kind}" class="adjusted">{size}{calibration}</calibration></sensor></sensors>
<components next_id="1"><component id="0" label="Component 1">
<transform>{placed}</transform></component></components>
<cameras next_id="3"><camera id="0" sensor_id="3" component_id="0" label="a.jpg">
<transform>{text(own)}</transform></camera>
<group id="0" label="g"><camera id="1" sensor_id="3" component_id="0" label="b">
<transform>{text(own)}</transform><orientation>1</orientation></camera></group>
<camera id="2" sensor_id="3" label="not aligned"/></cameras>
<reference>{reference}</reference></chunk></document>'''


def openmvs(
    version: int, size: tuple[int, int] = (640, 480), pose: tuple[int, int, int] = (0, 0, 0)
) -> bytes:
    """Write a scene of two images, of which the second has no pose: the camera is mounted on a platform."""

    def text(words: str) -> bytes:
        return struct.pack("<Q", len(words)) + words.encode()

    def placed(matrix: Floats) -> bytes:
        origin = -matrix[:3, :3].T @ matrix[:3, 3]
        return matrix[:3, :3].tobytes() + origin.tobytes()

    mount = view(5)
    scale = 1.0 if any(size) else 1 / 640
    K = np.array([[500.0 * scale, 0.0, 309.5 * scale], [0.0, 510.0 * scale, 249.5 * scale], [0.0, 0.0, 1.0]])
    camera = text("lens") + (text("RGB") if version > 3 else b"") + struct.pack("<II", *size)
    platform = text("rig") + struct.pack("<Q", 1) + camera + K.tobytes() + placed(mount)
    platform += struct.pack("<Q", 1) + placed(np.linalg.inv(mount) @ view(1))
    content = (
        b"MVSI" + struct.pack("<II", version, 0) + struct.pack("<Q", 1) + platform + struct.pack("<Q", 2)
    )
    for name, which in (("images/a.jpg", pose), ("images/b.jpg", (0, 0, 2**32 - 1))):
        content += text(name) + (text("") if version > 4 else b"") + struct.pack("<III", *which)
        content += struct.pack("<I", 9) if version > 2 else b""
        content += struct.pack("<3fQ2I4f", 1, 2, 3, 1, 0, 5, 1, 2, 3, 4) if version > 6 else b""
    return content + bytes(40)


MESHROOM_LENS = [-0.2, 0.05, 0.01, 2e-3, -1e-3]


def meshroom(
    version: tuple[int, ...] = (1, 2, 11),
    kind: str = "brown",
    numbers: Sequence[float] = MESHROOM_LENS,
    **changes: Any,
) -> str:
    """Write a view that is placed and one that is not; the focal lengths are 500 and 510 pixels."""
    matrix = view(1) @ np.diag([1.0, -1.0, -1.0, 1.0]) if version >= (1, 2, 3) else view(1)
    rotation, center = matrix[:3, :3], -matrix[:3, :3].T @ matrix[:3, 3]
    center_x, center_y = (309.5, 249.5) if version < (1, 2, 1) else (-10.5, 9.5)
    sensor = {"sensorWidth": "32", "focalLength": "25", "pixelRatio": repr(510 / 500)}
    if version >= (1, 2, 11):
        sensor["focalLength"] = "25.5"
    elif (1, 2, 2) <= version < (1, 2, 5):
        sensor["pixelRatio"] = repr(500 / 510)
    kinds = {"type": {"radialk1": "radial1", "radialk3": "radial3", "none": "pinhole"}.get(kind, kind)}
    if version >= (1, 2, 8):
        kinds = {"type": "pinhole", "distortionType": kind, "undistortionType": "none"}
    focal = {"pxFocalLength": "500" if version < (1, 2, 0) else ["500", "510"]}
    intrinsic = {
        "intrinsicId": "7", "width": "640", "height": "480", "serialNumber": "", "locked": "true",
        "principalPoint": [repr(center_x), repr(center_y)], "distortionParams": [*map(repr, numbers)],
        **(sensor if version >= (1, 2, 2) else focal), **kinds,
    }  # fmt: skip
    columns = [repr(value) for value in rotation.T.ravel().tolist()]
    pose = {"transform": {"rotation": columns, "center": [*map(repr, center.tolist())]}, "locked": "1"}
    placed = {"viewId": "3", "poseId": "3", "intrinsicId": "7", "path": "/far/a.jpg", "width": "640"}
    return json.dumps(
        {
            "version": [*map(str, version)],
            "views": [placed, placed | {"viewId": "4", "poseId": "4", "path": "/far/b.jpg"}],
            "intrinsics": [intrinsic | changes],
            "poses": [{"poseId": "3", "pose": pose}],
        }
    )


def bundler(focal: object = 500.0, count: int = 3) -> str:
    """Write a camera, one that is not placed, and the same once more; and a point."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0]) @ view(1)
    rows = [*matrix[:3, :3].tolist(), matrix[:3, 3].tolist()]
    placed = "\n".join(" ".join(map(repr, row)) for row in [[focal, -0.2, 0.05], *rows])
    lines = ["# Bundle file v0.3", f"{count} 1", placed, "0 0 0\n" * 5 + placed, "0 0 0", "1 2 3", "0"]
    return "\n".join(lines)


def own_file(**changes: Any) -> Document:
    """Return our own file with other fields of its first camera."""
    with TemporaryDirectory() as folder:
        write_cameras(Path(folder) / "a.json", ours())
        document = json.loads((Path(folder) / "a.json").read_text(encoding="utf-8"))
    document["cameras"][0] |= changes
    return document


def arrays(**changes: Any) -> bytes:
    """Return an .npz file of two cameras, with other arrays or without them."""
    given = {"viewmats": np.stack([view(1), view(2)]), "Ks": np.eye(3)} | changes
    file = BytesIO()
    np.savez(file, **{name: each for name, each in given.items() if each is not None})
    return file.getvalue()


def as_bytes(content: Document | str | bytes) -> bytes:
    content = json.dumps(content) if isinstance(content, dict) else content
    return content.encode() if isinstance(content, str) else content
