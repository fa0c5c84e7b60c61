"""Files of cameras, each written here by hand from known poses."""

import json
import struct
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from trimesh.transformations import quaternion_from_matrix

from octex.cameras.camera import Camera
from octex.cameras.files import read_cameras, write_cameras
from octex.errors import CameraError, OutputError
from tests.oracles.naive_lens import through

POINTS = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
LENS = (-0.2, 0.05, 1e-3, -2e-3)


def view(seed):
    """Return a world-to-camera matrix that sees POINTS."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = 0.1, -0.1, 3.0
    return matrix


def to_opengl(matrix):
    """Return the camera-to-world matrix, in OpenGL's axes, of a world-to-camera matrix."""
    return np.linalg.inv(matrix) @ np.diag([1.0, -1.0, -1.0, 1.0])


def bent(model, lens, matrix=None):
    """Return where a lens puts POINTS (n, 2), by default seen from ``view(1)``, to the right and down."""
    matrix = view(1) if matrix is None else matrix
    seen = POINTS @ matrix[:3, :3].T + matrix[:3, 3]
    return np.array([through(model, lens, x / z, y / z) for x, y, z in seen])


def expected(matrix, focal_x, focal_y, center, lens=(0.0, 0.0, 0.0, 0.0)):
    """Return where POINTS land."""
    return bent("OPENCV", lens, matrix) * [focal_x, focal_y] + center


def quaternion(rotation):
    """Return w, x, y, z of a rotation matrix."""
    return quaternion_from_matrix(np.pad(rotation, (0, 1)) + np.diag([0.0, 0, 0, 1]))


def write_json(path, document):
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def bent_by_brown(k1, k2, k3, p1, p2):
    """Return where the lens of Brown's model puts POINTS."""
    return bent("FULL_OPENCV", (k1, k2, p1, p2, k3))


def sees(camera, pixels):
    np.testing.assert_allclose(camera.project(POINTS)[0], pixels, rtol=0, atol=1e-8)


def refusal(path):
    with pytest.raises(CameraError) as caught:
        read_cameras(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


# transforms.json


def transforms(**changes):
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


def test_transforms_share_intrinsics_and_frames_may_have_their_own(tmp_path):
    first, second = read_cameras(write_json(tmp_path / "transforms.json", transforms()))
    assert (first.name, second.name) == ("./images/a.png", "images/b")
    assert first.size == (640, 480)
    sees(first.camera(), expected(view(1), 500.0, 510.0, (310.0, 250.0), LENS))
    sees(second.camera((640, 480)), expected(view(2), 700.0, 510.0, (310.0, 250.0), LENS))


def test_transforms_find_their_pictures_with_and_without_an_ending(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images/b.jpg").touch()
    frames = read_cameras(write_json(tmp_path / "transforms.json", transforms()))
    assert frames[0].image == tmp_path / "images/a.png"
    assert frames[1].image == tmp_path / "images/b.jpg"


def test_a_picture_may_have_a_name_that_no_file_can_have(tmp_path):
    document = transforms()
    document["frames"][0]["file_path"] = "long" * 2000
    document["frames"][1]["file_path"] = "a\0\ud800"
    frames = read_cameras(write_json(tmp_path / "t.json", document))
    assert [frame.image.name for frame in frames] == ["long" * 2000, "a\0\ud800"]


def test_transforms_may_give_angles_and_leave_the_size_to_the_picture(tmp_path):
    gone = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"))
    document = transforms(**gone, camera_angle_x=0.8)
    del document["frames"][1]["fl_x"]
    document["frames"][1]["camera_angle_y"] = 0.5
    first, second = read_cameras(write_json(tmp_path / "t.json", document))
    assert first.size is None
    focal = 400 / np.tan(0.4)
    sees(first.camera((800, 600)), expected(view(1), focal, focal, (400, 300)))
    sees(second.camera((800, 600)), expected(view(2), focal, 300 / np.tan(0.25), (400, 300)))
    with pytest.raises(CameraError, match=r"frame '\./images/a\.png' of .*t\.json has no image size"):
        first.camera()


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (213, 160), (214, 160), (91, 69)])
def test_a_picture_may_be_made_smaller_or_larger(tmp_path, size):
    frame = read_cameras(write_json(tmp_path / "t.json", transforms()))[0]
    camera = frame.camera(size)
    assert (camera.width, camera.height) == size
    factors = np.array(size) / [640, 480]
    sees(camera, factors * expected(view(1), 500.0, 510.0, (310.0, 250.0), LENS))


@pytest.mark.parametrize("size", [(320, 320), (240, 320), (642, 480), (640, 479 - 2), (320, 238)])
def test_a_picture_of_another_shape_is_refused(tmp_path, size):
    frame = read_cameras(write_json(tmp_path / "t.json", transforms()))[0]
    with pytest.raises(CameraError, match=r"is for 640×480 pixels, the picture has \d+×\d+, another shape; "):
        frame.camera(size)
    with pytest.raises(CameraError, match=r"has 240×320, another shape; turn it by 90 degrees"):
        frame.camera((240, 320))


def test_transforms_may_be_of_fisheye_lenses(tmp_path):
    numbers = {"k1": 0.1, "k2": -0.03, "k3": 0.01, "k4": -0.004, "p1": 0.0, "p2": 0.0}
    for number, fields in enumerate(({"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True})):
        path = write_json(tmp_path / f"{number}.json", transforms(**fields, **numbers))
        pixels = bent("OPENCV_FISHEYE", [0.1, -0.03, 0.01, -0.004]) * [500, 510] + [310, 250]
        sees(read_cameras(path)[0].camera(), pixels)


# Arrays


def write_arrays(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_arrays_of_gsplat_are_world_to_camera_and_what_numbers_say(tmp_path):
    matrices, K = np.stack([view(1), view(2)]), np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
    pixels = [expected(each, 500.0, 510.0, (310.0, 250.0)) for each in matrices]
    given = {
        "a": {"viewmats": matrices, "Ks": np.stack([K, K])},
        "b": {"viewmats": matrices[None], "Ks": K[None], "width": 640, "height": 480},
        "c": {"w2c": matrices[:, :3], "K": K},
        "d": {
            "camtoworlds": np.stack([to_opengl(each) for each in matrices]),
            "convention": "opengl",
            "K": K,
        },
        "e": {"c2w": np.linalg.inv(matrices), "convention": "opencv", "Ks": K},
    }
    for name, arrays in given.items():
        frames = read_cameras(write_arrays(tmp_path / f"{name}.npz", **arrays))
        assert [frame.name for frame in frames] == ["0", "1"]
        assert not frames[0].is_named
        for frame, there in zip(frames, pixels, strict=True):
            sees(frame.camera(frame.size or (640, 480)), there)


def test_arrays_may_have_names_and_lenses(tmp_path):
    K = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
    path = write_arrays(
        tmp_path / "a.npz", viewmats=view(1)[None], Ks=K, names=["a.png"], distortion=LENS,
        width=[640], height=480,
    )  # fmt: skip
    frame = read_cameras(path)[0]
    assert (frame.name, frame.size, frame.is_named) == ("a.png", (640, 480), True)
    sees(frame.camera(), expected(view(1), 500.0, 510.0, (310.0, 250.0), LENS))


# COLMAP

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


def colmap_text(folder):
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


def colmap_binary(folder):
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


def colmap_pixels(model, values, matrix):
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        values = values[0], *values
    focal_x, focal_y, x, y, *lens = values
    return bent(model, lens, matrix) * [focal_x, focal_y] + [x, y]


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
def test_colmap_cameras_see_what_their_numbers_say(tmp_path, write):
    frames = read_cameras(write(tmp_path))
    assert [frame.name for frame in frames] == [f"dir/im {key}.jpg" for key, _, _ in CAMERAS]
    for frame, (key, model, values) in zip(frames, CAMERAS, strict=True):
        assert frame.size == (640, 480)
        assert frame.image is None
        sees(frame.camera(), colmap_pixels(model, values, view(key)))


def test_both_forms_of_a_colmap_model_give_the_same_cameras(tmp_path):
    frames = read_cameras(colmap_text(tmp_path / "text")), read_cameras(colmap_binary(tmp_path / "binary"))
    for text, binary in zip(*frames, strict=True):
        assert text.name == binary.name
        assert text.size == binary.size
        assert np.array_equal(text.camera().K, binary.camera().K)
        assert np.array_equal(text.camera().world_to_camera, binary.camera().world_to_camera)
        assert text.camera().distortion == binary.camera().distortion


def test_a_colmap_model_is_found_below_its_folder_and_by_each_of_its_files(tmp_path):
    colmap_binary(tmp_path / "a/sparse/0")
    colmap_text(tmp_path / "b/sparse")
    for path in ("a", "a/sparse", *(f"a/sparse/0/{name}.bin" for name in ("images", "cameras", "points3D"))):
        assert len(read_cameras(tmp_path / path)) == len(CAMERAS)
    for path in ("b", "b/sparse/cameras.txt"):
        assert len(read_cameras(tmp_path / path)) == len(CAMERAS)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "."])
def test_the_pictures_of_a_colmap_workspace_are_in_images(model, tmp_path):
    colmap_binary(tmp_path / model)
    assert {frame.image for frame in read_cameras(tmp_path / model)} == {None}
    (tmp_path / "images").mkdir()
    for frame in read_cameras(tmp_path / model):
        assert frame.image.resolve() == (tmp_path / "images" / frame.name).resolve()


def test_a_folder_without_a_model_is_refused(tmp_path):
    assert "has no COLMAP model; choose a folder with" in refusal(tmp_path)
    colmap_text(tmp_path)
    (tmp_path / "cameras.txt").unlink()
    assert "has no COLMAP model" in refusal(tmp_path)
    assert "cameras.txt: cannot be read: No such file" in refusal(tmp_path / "images.txt")


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        ("cameras.txt", "PINHOLE", "DIVISION", "line 2: model 'SIMPLE_DIVISION' is not known; undistort"),
        ("cameras.txt", "2 PINHOLE 640", "2 PINHOLE 0", "line 3: width must be a whole number from 1"),
        ("cameras.txt", "2 PINHOLE 640", "2 PINHOLE x", "line 3: width must be a number, not 'x'"),
        ("cameras.txt", "2 PINHOLE", "2", "line 3: model '640' is not known"),
        ("cameras.txt", "310.0 250.0\n", "310.0\n", "SIMPLE_PINHOLE must have 3 parameters, not 2"),
        ("cameras.txt", "500.0", "nan", "line 2: parameters must be a finite number, not nan"),
        ("cameras.txt", "500.0", "-1", "line 2: focal lengths must be above zero"),
        ("cameras.txt", "500.0", "f", "line 2: parameters must be a number, not 'f'"),
        ("images.txt", " dir/im 1.jpg", "", "line 3: must have the columns IMAGE_ID QW"),
        ("images.txt", " 3.0 1 dir", " 3.0 99 dir", "frame 'dir/im 1.jpg': camera 99 is not in cameras"),
        ("images.txt", " 3.0 1 dir", " 3.0 x dir", "CAMERA_ID must be a whole number, not 'x'"),
        ("images.txt", " 3.0 1 dir", " inf 1 dir", "must be a finite number, not inf"),
        ("images.txt", "\n\n", "\n", "each image must have two lines"),
    ],
)
def test_a_broken_text_model_is_refused_by_line(tmp_path, file, old, new, complaint):
    path = colmap_text(tmp_path) / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace("im ", "im") if new == "\n" else text, encoding="utf-8")
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    message = refusal(tmp_path)
    assert message.startswith(f"{path}: ")
    assert complaint in message


def test_a_binary_model_that_lies_about_its_length_is_refused(tmp_path):
    colmap_binary(tmp_path)
    whole = (tmp_path / "images.bin").read_bytes()
    last = len(CAMERAS)
    for count in (last + 1, 2**64 - 1):
        (tmp_path / "images.bin").write_bytes(struct.pack("<Q", count) + whole[8:])
        assert f"images.bin: image {last + 1} of {count}: the file ends here" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole[:-8] + struct.pack("<Q", 2**63))
    assert f"image {last} of {last}: the file ends here" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole[:80])
    assert f"image 1 of {last}: the file ends in a name" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    assert "has no cameras" in refusal(tmp_path)
    (tmp_path / "images.bin").write_bytes(whole.replace(b"dir", b"\xff\xfe\xfd"))
    assert "images.bin: is not UTF-8 text" in refusal(tmp_path)


@pytest.mark.parametrize(("number", "name"), [(11, "'number 11'"), (99, "'number 99'"), (-1, "'number -1'")])
def test_a_binary_model_of_an_unknown_kind_is_refused_by_name(tmp_path, number, name):
    colmap_binary(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, number, 640, 480))
    assert f"cameras.bin: camera 1 of 1: model {name} is not known" in refusal(tmp_path)


def test_a_quaternion_of_nothing_is_refused(tmp_path):
    colmap_binary(tmp_path)
    content = struct.pack("<Qi7di", 1, 1, *np.zeros(7), 1) + b"a\0" + struct.pack("<Q", 0)
    (tmp_path / "images.bin").write_bytes(content)
    assert "images.bin: frame 'a': quaternion must not be zero" in refusal(tmp_path)


# glTF


def gltf(**changes):
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


def glb(document):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize("ending", [".gltf", ".glb"])
def test_cameras_of_nested_gltf_nodes_stand_where_the_scene_puts_them(tmp_path, ending):
    path = tmp_path / f"scene{ending}"
    path.write_bytes(glb(gltf()) if ending == ".glb" else json.dumps(gltf()).encode())
    first, second = read_cameras(path)
    assert (first.name, second.name) == ("eye", "camera_1")
    assert first.size is None
    focal = 240 / np.tan(0.35)
    sees(first.camera((640, 480)), expected(view(1), focal, focal, (320, 240)))
    camera = second.camera((640, 480))
    assert camera.projection == "orthographic"
    turned = POINTS @ view(2)[:3, :3].T + view(2)[:3, 3]
    sees(camera, 160.0 * turned[:, :2] + [320, 240])


def test_a_gltf_file_without_scenes_shows_all_its_nodes(tmp_path):
    document = gltf()
    del document["scenes"], document["scene"]
    frames = read_cameras(write_json(tmp_path / "a.gltf", document))
    assert [frame.name for frame in frames] == ["eye", "camera_1", "of another scene"]
    sees(frames[0].camera((64, 48)), expected(view(1), *[24 / np.tan(0.35)] * 2, (32, 24)))


def test_gltf_cameras_of_one_name_are_numbered(tmp_path):
    nodes = [{"camera": 0}, {"camera": 0, "name": "lens_2"}, {"camera": 0}, {"camera": 0}]
    document = gltf(nodes=nodes, scenes=[{"nodes": [0, 1, 2, 3]}], scene=0)
    names = [frame.name for frame in read_cameras(write_json(tmp_path / "a.gltf", document))]
    assert names == ["lens", "lens_2", "lens_3", "lens_4"]


def test_an_orthographic_camera_is_for_pictures_of_its_shape(tmp_path):
    frame = read_cameras(write_json(tmp_path / "a.gltf", gltf()))[1]
    frame.camera((403, 300))
    with pytest.raises(
        CameraError, match=r"'camera_1' of .*xmag 2 and ymag 1\.5 do not have the aspect ratio of"
    ):
        frame.camera((410, 300))


def one_camera(**node):
    return gltf(nodes=[{"camera": 0, "name": "eye"} | node], scenes=[{"nodes": [0]}], scene=0)


def test_a_broken_glb_is_refused(tmp_path):
    whole = glb(gltf())
    path = tmp_path / "a.glb"
    for content, complaint in [
        (whole[:10], "is truncated: a GLB header has 20 bytes, the file 10"),
        (whole[:100], "is truncated: it should have"),
        (whole[:4] + struct.pack("<I", 1) + whole[8:], "is GLB version 1"),
        (whole[:16] + b"BIN\0" + whole[20:], "its first chunk is not JSON"),
    ]:
        path.write_bytes(content)
        assert complaint in refusal(path)


# Our own


def ours():
    return {
        "front": Camera.pinhole((640, 480), pose=view(1), convention="opencv", focal=501.3, distortion=LENS),
        "ü/side": Camera.pinhole(
            (64, 48), pose=to_opengl(view(2)), convention="opengl", K=[[50, 3, 30], [0, 40, 25], [0, 0, 1]]
        ),
        "top": Camera.orthographic((30, 40), pose=view(3), convention="opencv", pixels_per_unit=10 / 3),
        "fitted": Camera.fitted(POINTS, (1.0, 2.0, 3.0), size=(100, 50)),
    }


def test_written_cameras_come_back_to_the_same_bits(tmp_path):
    path = tmp_path / "cameras.json"
    write_cameras(path, ours())
    frames = read_cameras(path)
    assert [frame.name for frame in frames] == list(ours())
    for frame, camera in zip(frames, ours().values(), strict=True):
        back = frame.camera()
        assert (back.width, back.height) == (camera.width, camera.height) == frame.size
        assert back.projection == camera.projection
        assert back.distortion == camera.distortion
        assert back.K.tobytes() == camera.K.tobytes()
        assert back.world_to_camera.tobytes() == camera.world_to_camera.tobytes()


def test_our_file_may_have_opengl_poses_and_no_distortion(tmp_path):
    write_cameras(tmp_path / "cameras.json", ours())
    document = json.loads((tmp_path / "cameras.json").read_text(encoding="utf-8"))
    record = document["cameras"][0]
    del record["distortion"]
    record |= {"convention": "opengl", "pose": to_opengl(view(1)).tolist()}
    frame = read_cameras(write_json(tmp_path / "b.json", document))[0]
    sees(frame.camera(), expected(view(1), 501.3, 501.3, (320, 240)))


@pytest.mark.parametrize(
    ("version", "complaint"),
    [(2, "octex_cameras is 2, from a newer octex"), ("1", "octex_cameras must be the number 1, not '1'")],
)
def test_our_file_of_another_version_is_refused(tmp_path, version, complaint):
    assert complaint in refusal(write_json(tmp_path / "b.json", {"octex_cameras": version, "cameras": []}))


def test_cameras_that_cannot_be_written_leave_what_was_there(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="is not a file that can be replaced"):
        write_cameras(tmp_path / "folder", ours())
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        write_cameras(tmp_path / "missing/cameras.json", ours())
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_full_disk_leaves_the_cameras_that_were_there(tmp_path, monkeypatch):
    path = tmp_path / "cameras.json"
    path.write_text("old", encoding="utf-8")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match=r"cameras\.json: cannot be written: No space left on device; "):
        write_cameras(path, ours())
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


# Metashape

#: k1, k2, k3, p1, p2, b1, b2 of Metashape.
METASHAPE = {
    "f": 500.0, "cx": -9.5, "cy": 12.25, "b1": 1.5, "b2": -0.75, "k1": -0.2, "k2": 0.05, "k3": 0.01,
    "p1": 2e-3, "p2": -1e-3,
}  # fmt: skip


def metashape(numbers=METASHAPE, kind="frame", reference="LOCAL_CS[]", resolution=(640, 480), **changes):
    """Write a chunk whose component turns, moves and scales its cameras; return it and one's true pose."""
    turn, shift, scale = view(7)[:3, :3], np.array([0.5, -0.25, 2.0]), 1.75
    words = {"rotation": turn, "translation": shift, "scale": scale} | changes
    given = to_opengl(view(1)) @ np.diag([1.0, -1.0, -1.0, 1.0])  # from the camera's axes, y down
    own = given.copy()
    own[:3, :3], own[:3, 3] = turn.T @ given[:3, :3], turn.T @ (given[:3, 3] - shift) / scale

    def text(values):
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


def test_metashape_cameras_see_what_its_manual_says(tmp_path):
    path = tmp_path / "cameras.xml"
    path.write_text(metashape(), encoding="utf-8-sig")
    frames = read_cameras(path)
    assert [(frame.name, frame.size, frame.image) for frame in frames] == [
        ("a.jpg", (640, 480), None),
        ("b", (640, 480), None),
    ]
    f, cx, cy, b1, b2, k1, k2, k3, p1, p2 = METASHAPE.values()
    right, down = bent_by_brown(k1, k2, k3, p2, p1).T
    pixels = np.stack([320 + cx + right * f + right * b1 + down * b2, 240 + cy + down * f], axis=1)
    for frame in frames:
        sees(frame.camera(), pixels)


def test_metashape_cameras_may_be_fisheyes(tmp_path):
    path = tmp_path / "cameras.xml"
    numbers = {name: METASHAPE[name] for name in ("f", "k1", "k2", "k3", "p1", "p2")} | {"k4": -0.02}
    path.write_text(metashape(numbers, "fisheye"), encoding="utf-8")
    lens = -0.2, 0.05, -1e-3, 2e-3, 0.01, -0.02, 0.0, 0.0
    pixels = bent("THIN_PRISM_FISHEYE", lens) * 500 + [320, 240]
    sees(read_cameras(path)[0].camera(), pixels)


# OpenMVS


def openmvs(version, size=(640, 480), pose=(0, 0, 0)):
    """Write a scene of two pictures, of which the second has no pose: the camera is mounted on a platform."""

    def text(words):
        return struct.pack("<Q", len(words)) + words.encode()

    def placed(matrix):
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


@pytest.mark.parametrize("version", range(1, 8))
def test_openmvs_cameras_see_what_their_numbers_say(tmp_path, version):
    path = tmp_path / "scene.mvs"
    for size in ((640, 480), (0, 0)):
        path.write_bytes(openmvs(version, size))
        (frame,) = read_cameras(path)
        assert (frame.name, frame.image) == ("images/a.jpg", tmp_path / "images/a.jpg")
        assert frame.size == (size if any(size) else None)
        # Whole numbers are the middles of OpenMVS's pixels.
        sees(frame.camera((640, 480)), expected(view(1), 500.0, 510.0, (310.0, 250.0)))


# Meshroom

MESHROOM_LENS = [-0.2, 0.05, 0.01, 2e-3, -1e-3]


def meshroom(version=(1, 2, 11), kind="brown", numbers=MESHROOM_LENS, mesh=True, **changes):
    """Write a view that is placed and one that is not; the focal lengths are 500 and 510 pixels."""
    matrix = view(1) @ np.diag([1.0, -1.0, -1.0, 1.0]) if mesh and version >= (1, 2, 3) else view(1)
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


@pytest.mark.parametrize("version", [(1, 2, 11), (1, 2, 8), (1, 2, 5), (1, 2, 4), (1, 2, 2), (1, 2, 1)])
def test_meshroom_cameras_see_what_their_numbers_say(tmp_path, version):
    path = tmp_path / "cameras.sfm"
    path.write_text(meshroom(version))
    (frame,) = read_cameras(path)
    assert (frame.name, frame.image, frame.size) == ("/far/a.jpg", tmp_path / "a.jpg", (640, 480))
    sees(frame.camera(), bent_by_brown(*MESHROOM_LENS) * [500, 510] + [310, 250])


@pytest.mark.parametrize("version", [(1, 2, 11), (1, 2, 7), (1, 0, 0)])
@pytest.mark.parametrize(
    ("kind", "numbers"), [("none", []), ("radialk1", [-0.2]), ("radialk3", [-0.2, 0.05, 0.0])]
)
def test_meshroom_cameras_may_have_simpler_lenses(tmp_path, version, kind, numbers):
    path = tmp_path / "cameras.sfm"
    path.write_text(meshroom(version, kind, numbers))
    lens = (*numbers[:2], *[0.0] * (2 - len(numbers[:2])), 0.0, 0.0)
    down = 500.0 if version < (1, 2) else 510.0
    sees(read_cameras(path)[0].camera(), expected(view(1), 500.0, down, (310.0, 250.0), lens))


def test_meshroom_views_of_a_rig_may_have_poses_of_their_own(tmp_path):
    path = tmp_path / "cameras.sfm"
    path.write_text(meshroom().replace('"path"', '"rigId": "1", "path"'))
    assert len(read_cameras(path)) == 1


def test_meshroom_cameras_may_be_fisheyes(tmp_path):
    path, lens = tmp_path / "cameras.sfm", [-0.2, 0.05, 0.01, -0.02]
    path.write_text(meshroom(kind="fisheye", numbers=lens))
    sees(read_cameras(path)[0].camera(), bent("OPENCV_FISHEYE", lens) * [500, 510] + [310, 250])


# Bundler


def bundler(focal=500.0, count=3):
    """Write a camera, one that is not placed, and the same once more; and a point."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0]) @ view(1)
    rows = [*matrix[:3, :3].tolist(), matrix[:3, 3].tolist()]
    placed = "\n".join(" ".join(map(repr, row)) for row in [[focal, -0.2, 0.05], *rows])
    lines = ["# Bundle file v0.3", f"{count} 1", placed, "0 0 0\n" * 5 + placed, "0 0 0", "1 2 3", "0"]
    return "\n".join(lines)


def test_bundler_cameras_see_what_its_manual_says(tmp_path):
    path = tmp_path / "bundle.rd.out"
    path.write_text(bundler())
    assert [(frame.name, frame.is_named) for frame in read_cameras(path)] == [("0", False), ("2", False)]
    (tmp_path / "list.txt").write_text("photos/a b.jpg 0 512.5\n./b.jpg\nc.jpg\n")
    frames = read_cameras(path)
    assert [frame.name for frame in frames] == ["photos/a b.jpg", "c.jpg"]
    assert frames[0].image == tmp_path / "photos" / "a b.jpg"
    pixels = bent("RADIAL", (-0.2, 0.05)) * 500 + [320, 240]
    for frame in frames:
        sees(frame.camera((640, 480)), pixels)


def test_a_list_of_more_pictures_than_bundler_has_cameras_is_refused(tmp_path):
    (tmp_path / "bundle.out").write_text(bundler())
    (tmp_path / "bundle.list.txt").write_text("a.jpg\nb.jpg\n")
    assert "its list names 2 pictures for 3 cameras" in refusal(tmp_path / "bundle.out")


# Any file


def test_an_absolute_path_of_a_picture_is_a_name_beside_the_file(tmp_path):
    matrix = to_opengl(view(1)).tolist()
    names = [str(tmp_path / "far" / "a.png"), "C:\\pictures\\b.png"]
    frames = [{"file_path": name, "transform_matrix": matrix} for name in names]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 700.0, "frames": frames}))
    assert [frame.image for frame in read_cameras(path)] == [tmp_path / "a.png", tmp_path / "b.png"]
    assert [frame.name for frame in read_cameras(path)] == names


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="this system has no devices among its files")
def test_a_device_is_not_read():
    assert "/dev/null: cannot be read: it is a pipe or a device, not a file" in refusal("/dev/null")


def test_a_file_that_cannot_be_is_refused(tmp_path):
    assert "cannot be read: No such file" in refusal(tmp_path / "missing.json")
    assert "cannot be read" in refusal(tmp_path / ("long" * 1000))
    assert "is not a valid file name" in refusal("a\0b")


# What cannot be used


def own_file(**changes):
    """Return our own file with other fields of its first camera."""
    with TemporaryDirectory() as folder:
        write_cameras(Path(folder) / "a.json", ours())
        document = json.loads((Path(folder) / "a.json").read_text(encoding="utf-8"))
    document["cameras"][0] |= changes
    return document


def arrays(**changes):
    """Return an .npz file of two cameras, with other arrays or without them."""
    given = {"viewmats": np.stack([view(1), view(2)]), "Ks": np.eye(3)} | changes
    file = BytesIO()
    np.savez(file, **{name: each for name, each in given.items() if each is not None})
    return file.getvalue()


def as_bytes(content):
    content = json.dumps(content) if isinstance(content, dict) else content
    return content.encode() if isinstance(content, str) else content


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
        ({"cx": 1e300}, "cx must be a finite number"),
        ({"w": 1.5}, "w must be a whole number from 1 to 1000000"),
        ({"w": None}, "w is missing; it must be a number"),
        ({"fl_x": None}, "fl_x is missing, and so is camera_angle_x"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x must be above zero and below 3.14159, not 4"),
        ({"frames": []}, "has no cameras"),
        ({"frames": {}}, "frames must be a list of objects"),
        ({"frames": [1]}, "frames must be a list of objects, not of 1"),
        ({"frames": [{}]}, "frame 0: file_path is missing"),
        ({"frames": [{"file_path": "x"}]}, "frame 'x': transform_matrix is missing"),
        (
            {"frames": [{"file_path": "x", "transform_matrix": [[1, 2], [3]]}]},
            "must be a matrix of 4×4 or 3×4 numbers",
        ),
        ({"frames": [{"file_path": "x", "transform_matrix": [*np.eye(4).tolist()[:2], 0, 1]}]}, "4×4 or 3×4"),
        (
            {"frames": [{"file_path": "x", "transform_matrix": np.zeros((4, 4)).tolist()}]},
            "transform_matrix: a camera's pose must have the last row",
        ),
        (
            {"frames": [{"file_path": "x", "transform_matrix": np.diag([1, 1, 0, 1]).tolist()}]},
            "transform_matrix: a camera's pose must not scale",
        ),
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
        (
            {"viewmats": None, "poses": np.zeros((2, 3, 4)), "convention": "opencv"},
            "poses: its upper left 3×3 must be a rotation",
        ),
        ({"width": 1.5, "height": 3}, "camera 0: width must be a whole number from 1 to 1000000, not 1.5"),
        ({"distortion": [1.0]}, "distortion must be"),
        ({"distortion_model": "x"}, "distortion_model must be one of opencv, fisheye, fov"),
        ({"names": np.array([None])}, "cannot be read as an .npz file"),
    ],
    "a.gltf": [
        (one_camera(scale=[1, 1, -1]), "frame 'eye': a camera's pose must not mirror"),
        (
            one_camera(scale=[1, 0, 1]),
            "frame 'eye': its node, with the nodes above it, must not scale to nothing",
        ),
        (one_camera(matrix=[1, 0.5, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "must not scale or shear"),
        (one_camera(matrix=[1, 2]), "nodes[0]: matrix must be 16 numbers, not [1, 2]"),
        (one_camera(rotation=[0, 0, 0, 0]), "nodes[0]: rotation must not be zero"),
        (one_camera(rotation=None), "nodes[0]: rotation must be 4 numbers, not None"),
        (one_camera(translation=[0, 10**400, 0]), "nodes[0]: translation must be 3 numbers"),
        (one_camera(children=1), "nodes[0]: children must be a list of indices"),
        (one_camera(rotation="x"), "nodes[0]: rotation must be 4 numbers, not 'x'"),
        (one_camera(camera=2), "refers to cameras[2], which it does not have"),
        (one_camera(children=[0]), "nodes[0] is reached twice"),
        (one_camera(children=[-1]), "refers to nodes[-1], which it does not have"),
        (gltf(scene=7), "refers to scenes[7], which it does not have"),
        (gltf(nodes={}), "nodes must be a list, not {}"),
        (gltf(scenes=[{}], scene=0), "has no cameras"),
        (one_camera() | {"cameras": [{"type": "fisheye"}]}, "type must be one of perspective, orthographic"),
        (one_camera() | {"cameras": [{"type": "perspective"}]}, "'eye': perspective is missing"),
        (
            one_camera() | {"cameras": [{"type": "perspective", "perspective": {"yfov": 0}}]},
            "'eye': perspective: yfov must be above zero",
        ),
        (
            one_camera() | {"cameras": [{"type": "orthographic", "orthographic": {"xmag": -1, "ymag": 1}}]},
            "'eye': orthographic: xmag must be above zero",
        ),
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
        (meshroom().replace('"poses"', '"pose"'), "is not a camera file"),
        (meshroom().replace('"version": [', '"version": ["0", '), "version must be 3 numbers, not 4"),
        (meshroom().replace('"center"', '"centre"'), "pose: center is missing"),
        (
            meshroom().replace('"path"', '"rigId": "1", "isPoseIndependant": "false", "path"'),
            "view '/far/a.jpg': belongs to a rig",
        ),
        (
            meshroom().replace('"path"', '"rigId": "1", "isPoseIndependant": false, "path"'),
            "view '/far/a.jpg': belongs to a rig",
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
    for turn in range(300):
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
    assert refused > 30
    assert read_cameras(path)
