"""Files of cameras, from known poses, and frames by their names."""

import json
from pathlib import Path

import numpy as np
import pytest

from octex.cameras.files import find_frame, read_cameras, write_cameras
from octex.errors import CameraError, OutputError
from tests.make.camera_files import (
    LENS,
    MESHROOM_LENS,
    METASHAPE,
    POINTS,
    as_bytes,
    bent,
    bundler,
    expected,
    glb,
    gltf,
    meshroom,
    metashape,
    openmvs,
    ours,
    refusal,
    sees,
    to_opengl,
    transforms,
    view,
    write_json,
)
from tests.make.painted import above


def bent_by_brown(k1, k2, k3, p1, p2):
    """Return where the lens of Brown's model puts POINTS."""
    return bent("FULL_OPENCV", (k1, k2, p1, p2, k3))


def written(path, content):
    """Return the frames of a new file."""
    path.write_bytes(as_bytes(content))
    return read_cameras(path)


# transforms.json


def test_transforms_share_intrinsics_and_frames_may_have_their_own(tmp_path):
    first, second = read_cameras(write_json(tmp_path / "transforms.json", transforms()))
    assert (first.name, second.name) == ("./images/a.png", "images/b")
    assert first.size == (640, 480)
    sees(first.camera(), expected(view(1), 500.0, 510.0, (310.0, 250.0), LENS))
    sees(second.camera((640, 480)), expected(view(2), 700.0, 510.0, (310.0, 250.0), LENS))


def test_transforms_find_their_images_with_and_without_an_ending(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images/b.jpg").touch()
    frames = read_cameras(write_json(tmp_path / "transforms.json", transforms()))
    assert frames[0].image == tmp_path / "images/a.png"
    assert frames[1].image == tmp_path / "images/b.jpg"


def test_an_image_may_have_a_name_that_no_file_can_have(tmp_path):
    document = transforms()
    document["frames"][0]["file_path"] = "long" * 2000
    document["frames"][1]["file_path"] = "a\0\ud800"
    frames = read_cameras(write_json(tmp_path / "t.json", document))
    assert [frame.image.name for frame in frames] == ["long" * 2000, "a\0\ud800"]


def test_transforms_may_give_angles_and_leave_the_size_to_the_image(tmp_path):
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
def test_an_image_may_be_made_smaller_or_larger(tmp_path, size):
    frame = read_cameras(write_json(tmp_path / "t.json", transforms()))[0]
    camera = frame.camera(size)
    assert (camera.width, camera.height) == size
    factors = np.array(size) / [640, 480]
    sees(camera, factors * expected(view(1), 500.0, 510.0, (310.0, 250.0), LENS))


@pytest.mark.parametrize("size", [(320, 320), (240, 320), (642, 480), (640, 479 - 2), (320, 238)])
def test_an_image_of_another_shape_is_refused(tmp_path, size):
    frame = read_cameras(write_json(tmp_path / "t.json", transforms()))[0]
    with pytest.raises(CameraError, match=r"is for 640×480 pixels, the image has \d+×\d+, another shape; "):
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


# glTF


@pytest.mark.parametrize("ending", [".gltf", ".glb"])
def test_cameras_of_nested_gltf_nodes_stand_where_the_scene_puts_them(tmp_path, ending):
    first, second = written(tmp_path / f"scene{ending}", glb(gltf()) if ending == ".glb" else gltf())
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


def test_an_orthographic_camera_is_for_images_of_its_shape(tmp_path):
    frame = read_cameras(write_json(tmp_path / "a.gltf", gltf()))[1]
    frame.camera((403, 300))
    with pytest.raises(CameraError, match=r"'camera_1' of .*xmag 2 and ymag 1\.5 do not have the aspect"):
        frame.camera((410, 300))


# Our own


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


# Metashape


def test_metashape_cameras_see_what_its_manual_says_also_through_fisheyes(tmp_path):
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
    for word in ("false", "0"):
        path.write_text(metashape().replace('label="b"', f'label="b" enabled="{word}"'), encoding="utf-8")
        assert [frame.name for frame in read_cameras(path)] == ["a.jpg"]
    numbers = {name: METASHAPE[name] for name in ("f", "k1", "k2", "k3", "p1", "p2")} | {"k4": -0.02}
    frames = written(tmp_path / "cameras.xml", metashape(numbers, "fisheye"))
    lens = -0.2, 0.05, -1e-3, 2e-3, 0.01, -0.02, 0.0, 0.0
    sees(frames[0].camera(), bent("THIN_PRISM_FISHEYE", lens) * 500 + [320, 240])


# OpenMVS


@pytest.mark.parametrize("version", range(1, 8))
def test_openmvs_cameras_see_what_their_numbers_say(tmp_path, version):
    for size in ((640, 480), (0, 0)):
        (frame,) = written(tmp_path / "scene.mvs", openmvs(version, size))
        assert (frame.name, frame.image) == ("images/a.jpg", tmp_path / "images/a.jpg")
        assert frame.size == (size if any(size) else None)
        # Whole numbers are the middles of OpenMVS's pixels.
        sees(frame.camera((640, 480)), expected(view(1), 500.0, 510.0, (310.0, 250.0)))


# Meshroom


@pytest.mark.parametrize("version", [(1, 2, 11), (1, 2, 8), (1, 2, 5), (1, 2, 4), (1, 2, 2), (1, 2, 1)])
def test_meshroom_cameras_see_what_their_numbers_say(tmp_path, version):
    (frame,) = written(tmp_path / "cameras.sfm", meshroom(version))
    assert (frame.name, frame.image, frame.size) == ("/far/a.jpg", tmp_path / "a.jpg", (640, 480))
    sees(frame.camera(), bent_by_brown(*MESHROOM_LENS) * [500, 510] + [310, 250])


@pytest.mark.parametrize("version", [(1, 2, 11), (1, 2, 7), (1, 0, 0)])
@pytest.mark.parametrize(
    ("kind", "numbers"), [("none", []), ("radialk1", [-0.2]), ("radialk3", [-0.2, 0.05, 0.0])]
)
def test_meshroom_cameras_may_have_simpler_lenses(tmp_path, version, kind, numbers):
    (frame,) = written(tmp_path / "cameras.sfm", meshroom(version, kind, numbers))
    lens = (*numbers[:2], *[0.0] * (2 - len(numbers[:2])), 0.0, 0.0)
    down = 500.0 if version < (1, 2) else 510.0
    sees(frame.camera(), expected(view(1), 500.0, down, (310.0, 250.0), lens))


def test_meshroom_cameras_may_be_fisheyes_and_views_of_a_rig_have_poses_of_their_own(tmp_path):
    assert written(tmp_path / "cameras.sfm", meshroom().replace('"path"', '"rigId": "1", "path"'))
    lens = [-0.2, 0.05, 0.01, -0.02]
    (frame,) = written(tmp_path / "cameras.sfm", meshroom(kind="fisheye", numbers=lens))
    sees(frame.camera(), bent("OPENCV_FISHEYE", lens) * [500, 510] + [310, 250])


# Bundler


def test_bundler_cameras_see_what_its_manual_says_and_a_list_of_too_many_images_is_refused(tmp_path):
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
    (tmp_path / "list.rd.txt").write_text("C:\\scan\\a.jpg\nb.jpg\nc.jpg\n")  # of undistorted images
    assert [frame.image for frame in read_cameras(path)] == [tmp_path / "a.jpg", tmp_path / "c.jpg"]
    (tmp_path / "bundle.out").write_text(bundler())
    (tmp_path / "bundle.list.txt").write_text("a.jpg\nb.jpg\n")
    assert "its list names 2 images for 3 cameras" in refusal(tmp_path / "bundle.out")


def test_bundler_leaves_the_list_next_to_its_folder(tmp_path):
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "bundle.out").write_text(bundler())
    (tmp_path / "list.txt").write_text("./a.jpg\n./b.jpg\n./c.jpg\n")
    frames = read_cameras(tmp_path / "bundle" / "bundle.out")
    assert [frame.image for frame in frames] == [tmp_path / "a.jpg", tmp_path / "c.jpg"]


# Any file


def test_an_absolute_path_of_an_image_is_a_name_beside_the_file(tmp_path):
    matrix = to_opengl(view(1)).tolist()
    names = [str(tmp_path / "far" / "a.png"), "C:\\images\\b.png"]
    frames = [{"file_path": name, "transform_matrix": matrix} for name in names]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 700.0, "frames": frames}))
    assert [frame.image for frame in read_cameras(path)] == [tmp_path / "a.png", tmp_path / "b.png"]
    assert [frame.name for frame in read_cameras(path)] == names


def test_a_file_that_cannot_be_is_refused(tmp_path):
    assert "cannot be read: No such file" in refusal(tmp_path / "missing.json")
    assert "cannot be read" in refusal(tmp_path / ("long" * 1000))
    assert "is not a valid file name" in refusal("a\0b")


FILE = Path("f.json")


def named(folder, *names):
    write_cameras(folder / "cameras.json", dict.fromkeys(names, above()))
    return read_cameras(folder / "cameras.json")


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("a/x.png", "a/x.png"), ("y.png", "y.png"), ("elsewhere/x.png", "a/x.png"), ("z.jpg", "b\\z.jpg"),
        ("x.exr", "a/x.png"), ("w.png", "w"),
    ],
)  # fmt: skip
def test_a_frame_is_found_by_its_name_then_its_file_name_then_its_stem(asked, found, tmp_path):
    assert (
        find_frame(named(tmp_path, "a/x.png", "b/y.png", "b\\z.jpg", "y.png", "w"), asked, FILE).name == found
    )


@pytest.mark.parametrize(
    ("names", "asked", "message"),
    [
        (
            ["a/x.png", "b/x.png"],
            "x.png",
            r"f\.json: frame 'x\.png' may be 2 frames: 'a/x\.png', 'b/x\.png'; give the whole name",
        ),
        (["a/x.png", "b/x.png", *"cdefghijklm"], "q", r"no frame 'q'; there are: 'a/x\.png', .* and 3 more"),
        ([], "q", "there are: none"),
    ],
)
def test_a_frame_that_is_not_there_or_not_one_is_refused_with_a_listing(names, asked, message, tmp_path):
    frames = named(tmp_path, *names) if names else []
    with pytest.raises(CameraError, match=message):
        find_frame(frames, asked, FILE)
