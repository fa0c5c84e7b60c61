"""Files of cameras that cannot be used, and damaged ones."""

import json
import struct

import numpy as np
import pytest

from octex.cameras.files import read_cameras
from octex.errors import CameraError
from tests.cameras.test_camera_sfm import openmvg, opensfm
from tests.make.camera_files import (
    arrays,
    as_bytes,
    bundler,
    colmap_binary,
    colmap_text,
    glb,
    gltf,
    meshroom,
    metashape,
    one_camera,
    openmvs,
    own_file,
    refusal,
    transforms,
)

RIG = '"rigId": "1", "isPoseIndependant"'


def posed(matrix):
    return {"frames": [{"file_path": "x", "transform_matrix": np.asarray(matrix, object).tolist()}]}


def lens(kind, **numbers):
    return {"cameras": [{"type": kind, kind: numbers}]}


#: By the file's name: its content, and a part of what is said of it.
REFUSED = {
    "transforms.json": [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not known"),
        ({"camera_model": 3}, "camera_model must be a text, not 3"),
        ({"is_equirectangular": True}, "is_equirectangular is set"),
        ({"k4": 0.1}, "k4 must be zero"),
        ({"k1": "a"}, "k1 must be a finite number, not 'a'"),
        ({"fl_y": 0}, "fl_y must be above zero, not 0"),
        ({"fl_y": True}, "fl_y must be a finite number, not True"),
        ({"cx": float("nan")}, "cx must be a finite number, not nan"),
        ({"w": 1.5}, "w must be a whole number from 1 to 1000000"),
        ({"w": None}, "w is missing; it must be a number"),
        ({"fl_x": None}, "fl_x is missing, and so is camera_angle_x"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x must be above zero and below 3.14159, not 4"),
        ({"frames": []}, "has no cameras"),
        ({"frames": {}}, "frames must be a list of objects"),
        ({"frames": [1]}, "frames must be a list of objects, not of 1"),
        ({"frames": [{}]}, "frame 0: file_path is missing"),
        ({"frames": [{"file_path": "x"}]}, "frame 'x': transform_matrix is missing"),
        (posed([[1, 2], [3]]), "must be a matrix of 4×4 or 3×4 numbers"),
        (posed(np.zeros((4, 4))), "transform_matrix: a camera's pose must have the last row"),
        (posed(np.diag([1, 1, 0, 1])), "transform_matrix: a camera's pose must not scale"),
    ],
    "a.npz": [
        ({"viewmats": None}, "must have one of viewmats, w2c"),
        ({"width": 640}, "camera 0: height is missing; it must be a number"),
        ({"Ks": None}, "must have one of Ks, K, intrinsics; has viewmats"),
        ({"viewmats": np.ones((2, 5, 4))}, "viewmats must have shape (n, 4, 4), not (2, 5, 4)"),
        ({"viewmats": np.ones((2, 4, 4))}, "camera 0: viewmats: a camera's pose must have the last row"),
        ({"viewmats": np.full((1, 4, 4), np.nan)}, "viewmats must be finite numbers"),
        ({"Ks": np.zeros((3, 3))}, "camera 0: Ks: K's focal lengths must be above zero"),
        ({"Ks": np.ones((3, 3, 3))}, "Ks has 3 rows for 2 cameras"),
        ({"camtoworlds": np.ones((2, 4, 4))}, "must have one of"),
        ({"viewmats": None, "poses": np.ones((2, 4, 4))}, "convention is missing; it must be a text"),
        ({"viewmats": None, "poses": np.zeros((2, 3, 4)), "convention": "opencv"}, "3×3 must be a rotation"),
        ({"width": 1.5, "height": 3}, "camera 0: width must be a whole number from 1 to 1000000, not 1.5"),
        ({"distortion": [1.0]}, "distortion must be"),
        ({"distortion_model": "x"}, "distortion_model must be one of opencv, fisheye, fov"),
        ({"names": np.array([None])}, "cannot be read as an .npz file"),
    ],
    "a.gltf": [
        (one_camera(scale=[1, 1, -1]), "frame 'eye': a camera's pose must not mirror"),
        (one_camera(scale=[1, 0, 1]), "'eye': its node, with the nodes above it, must not scale to nothing"),
        (one_camera(matrix=[1, 0.5, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "must not scale or shear"),
        (one_camera(matrix=[1, 2]), "nodes[0]: matrix must be 16 numbers, not [1, 2]"),
        (one_camera(rotation=[0, 0, 0, 0]), "nodes[0]: rotation must not be zero"),
        (one_camera(rotation=None), "nodes[0]: rotation must be 4 numbers, not None"),
        (one_camera(translation=[0, 10**400, 0]), "nodes[0]: translation must be 3 numbers"),
        (one_camera(children=1), "nodes[0]: children must be a list of indices"),
        (one_camera(camera=2), "refers to cameras[2], which it does not have"),
        (one_camera(children=[0]), "nodes[0] is reached twice"),
        (one_camera(children=[-1]), "refers to nodes[-1], which it does not have"),
        (gltf(scene=7), "refers to scenes[7], which it does not have"),
        (gltf(nodes={}), "nodes must be a list, not {}"),
        (gltf(scenes=[{}], scene=0), "has no cameras"),
        (one_camera() | {"cameras": [{"type": "fisheye"}]}, "type must be one of perspective, orthographic"),
        (one_camera() | {"cameras": [{"type": "perspective"}]}, "'eye': perspective is missing"),
        (one_camera() | lens("perspective", yfov=0), "'eye': perspective: yfov must be above zero"),
        (one_camera() | lens("orthographic", xmag=-1, ymag=1), "'eye': orthographic: xmag must be above"),
    ],
    "a.glb": [
        (glb(gltf())[:10], "is truncated: a GLB header has 20 bytes, the file 10"),
        (glb(gltf())[:100], "is truncated: it should have"),
        (glb(gltf())[:4] + struct.pack("<I", 1) + glb(gltf())[8:], "is GLB version 1"),
        (glb(gltf())[:16] + b"BIN\0" + glb(gltf())[20:], "its first chunk is not JSON"),
    ],
    "ours.json": [
        ({"name": 3}, "camera 0: name must be a text, not 3"),
        ({"width": 0}, "frame 'front': width must be a whole number"),
        ({"projection": "fisheye"}, "projection must be one of pinhole, orthographic, not 'fisheye'"),
        ({"convention": "blender"}, "convention must be one of opencv, opengl, not 'blender'"),
        ({"projection": "orthographic"}, "distortion must be zeros for an orthographic camera"),
        ({"distortion": [1]}, "distortion must be 2 or 4 or 5 or 8 numbers, not 1"),
        ({"K": np.ones((3, 3)).tolist()}, "frame 'front': K: K must be upper triangular"),
        ({"pose": np.eye(3).tolist()}, "frame 'front': pose must be a matrix of 4×4 numbers"),
        ({"pose": np.zeros((4, 4)).tolist()}, "frame 'front': pose: a camera's pose"),
    ],
    "cameras.xml": [
        ("<document>", "is not XML"),
        ("<!DOCTYPE a><document/>", "has a document type"),
        ("<plist/>", "is not a camera file; export the cameras from Metashape as Agisoft XML"),
        ("<document><chunk/></document>", "has no cameras"),
        (metashape(kind="spherical"), "type 'spherical' is not known; octex knows frame and fisheye"),
        (metashape({"f": 0.0}), "frame 'a.jpg': sensor 'lens': f must be above zero, not 0"),
        (metashape({"f": 500.0, "k4": 0.1}), "k4 must be zero"),
        (metashape({"f": float("nan")}), "f must be a finite number, not nan"),
        (metashape(resolution=("", 480)), "width must be a number, not ''"),
        (metashape(reference="GEOGCS[]"), "the chunk has geographic coordinates"),
        (metashape(scale=(1, 2)), "the component's transform: scale must be 1 numbers, not 2"),
        (metashape(rotation=np.ones((3, 3))), "frame 'a.jpg': transform: "),
        (metashape().replace('sensor_id="3"', 'sensor_id="4"'), "sensor_id '4' names no sensor of the file"),
    ],
    "scene.mvs": [
        (b"MVSI" + struct.pack("<II", 8, 0), "is an OpenMVS scene of version 8; octex reads versions 1 to 7"),
        (openmvs(3)[:60], "the file ends here"),
        (b"MVSI" + struct.pack("<IIQ", 3, 0, 2**60), "the number of platforms, 1152921504606846976, is more"),
        (openmvs(3, pose=(1, 0, 0)), "frame 'images/a.jpg': platform 1 is not in the file"),
        (openmvs(3, pose=(0, 0, 1)), "camera 0 or pose 1 is not in the file"),
        (openmvs(3, size=(640, 0)), "camera 0: height must be a whole number"),
    ],
    "cameras.sfm": [
        (meshroom(kind="fisheye1"), "view '/far/a.jpg': intrinsics: type 'fisheye1' is not known"),
        (meshroom(type="equidistant"), "type 'equidistant, brown, none' is not known"),
        (meshroom(undistortionType="3deradial4"), "type 'pinhole, brown, 3deradial4' is not known"),
        (meshroom(focalLength="0"), "intrinsics: the focal length must be above zero, not 0"),
        (meshroom(sensorWidth="0"), "sensorWidth and pixelRatio must be above zero"),
        (meshroom(width="a"), "width must be a number, not 'a'"),
        (meshroom(distortionParams=["1"]), "distortionParams must be 5 numbers, not 1"),
        (meshroom().replace('"poses"', '"pose"'), "has views without poses; give the .sfm file that Struc"),
        (meshroom().replace('"version": [', '"version": ["0", '), "version must be 3 numbers, not 4"),
        (meshroom().replace('"center"', '"centre"'), "pose: center is missing"),
        *(
            (meshroom().replace('"path"', f'{RIG}: {no}, "path"'), "view '/far/a.jpg': belongs to a rig")
            for no in ("false", '"false"')
        ),
        (meshroom().replace('"poseId": "3"', '"poseId": "5"', 1), "has no cameras"),
    ],
    "bundle.out": [
        ("# Bundle file v0.3", "the number of cameras must be a finite number, not None"),
        (bundler(count=9), "the number of cameras, 9, is more than the file has room for"),
        (bundler()[:-60], "the number of cameras, 3, is more than the file has room for"),
        (bundler(-1.0), "camera 0: f must be above zero, not -1"),
        (bundler("x"), "camera 0: f must be a number, not"),
    ],
    "cameras.json": [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"\xff\xfe", "is not UTF-8 text"),
        (b"[]", "its JSON must be an object"),
        (b"{}", "is not a camera file; give"),
        (b"NVM_V3\n\n2\n", "is not a camera file; give"),
        (b"[" * 200_000, "is not JSON (a number or nesting too long)"),
        (b'{"frames": ' + b"9" * 10_000 + b"}", "is not JSON (a number or nesting too long)"),
        (b'{"frames": 1e999}', "frames must be a list of objects, not inf"),
    ],
}


#: What a table holds where that is no file's content.
CONTENT = {"transforms.json": transforms, "a.npz": arrays, "ours.json": own_file}


@pytest.mark.parametrize(
    ("name", "content", "complaint"), [(name, *row) for name, rows in REFUSED.items() for row in rows]
)
def test_what_cannot_be_used_is_refused_by_file_and_field(tmp_path, name, content, complaint):
    path = tmp_path / name
    path.write_bytes(as_bytes(CONTENT[name](**content) if name in CONTENT else content))
    message = refusal(path)
    assert message.startswith(f"{path}: ")
    assert complaint in message


#: Files of every kind, by their names, and folders of COLMAP.
KINDS = {
    "a.json": own_file, "transforms.json": transforms, "a.gltf": gltf, "a.glb": lambda: glb(gltf()),
    "a.xml": metashape, "a.mvs": lambda: openmvs(7), "a.sfm": meshroom, "a.out": bundler,
    "reconstruction.json": lambda: json.dumps(opensfm(focal=0.8, k1=0.1)),
    "sfm_data.json": lambda: json.dumps(openmvg(disto_k1=[0.1])),
    "text": colmap_text, "binary": colmap_binary,
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_of_each_kind_is_read_or_refused(tmp_path, kind):
    path, make = tmp_path / kind, KINDS[kind]
    if "." in kind:
        path.write_bytes(as_bytes(make()))
    else:
        make(path)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    wholes = [file.read_bytes() for file in files]
    random = np.random.default_rng(0)
    refused = 0
    for turn in range(120):
        which = turn % len(files)
        content = bytearray(wholes[which])
        for _ in range(random.integers(1, 4)):
            at = random.integers(len(content))
            match random.integers(4):
                case 0:
                    content[at] = random.integers(256)
                case 1:
                    content[at] = random.choice(list(b'09-e.,"[]{}: \n'))
                case 2:
                    del content[at : at + random.integers(1, 9)]
                case 3:
                    content[at:at] = content[random.integers(len(content)) :][: random.integers(1, 30)]
        files[which].write_bytes(content)
        try:
            for frame in read_cameras(path):
                frame.camera(frame.size or (64, 48))
        except CameraError:
            refused += 1
        files[which].write_bytes(wholes[which])
    assert 30 < refused < 120
    assert read_cameras(path)
