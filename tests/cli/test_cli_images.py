"""Images to paint with at the command line, their frames, masks and cameras."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.cli.values import camera
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import OUT
from tests.make.scene import SIZE, assert_painted


@needs_jit
def test_images_are_matched_to_frames_by_their_file_names(scene, tmp_path, cli):
    arguments = [*scene.shot[:2], "--camera", scene.cameras, OUT, tmp_path / "out.octex", "--force"]
    assert cli.facts(*arguments, scene.blue, scene.square)["painted"] == ["blue.png", "square.png"]
    assert cli.facts(*arguments)["painted"] == ["square.png", "blue.png"]  # they lie beside their cameras


@needs_jit
def test_images_without_a_frame_are_skipped_and_refused_if_none_has_one(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    arguments = [scene.texture, scene.model, "--camera", scene.cameras, OUT, out]
    (tmp_path / "other.png").write_bytes(scene.blue.read_bytes())
    black, white = tmp_path / "black.png", tmp_path / "white.png"
    Image.fromarray(np.zeros((SIZE, SIZE), np.uint8)).save(black)
    Image.fromarray(np.full((SIZE, SIZE), 255, np.uint8)).save(white)
    masked = [word for mask in (black, white, black) for word in ("--mask", mask)]
    shown = [tmp_path / "other.png", scene.blue, scene.square]
    assert cli.run(*arguments, *shown, *masked, "--json") == ExitCode.DONE  # the white mask is blue's
    told, said = cli.said()
    assert f"skipped 1 of 3 images, which have no camera in {scene.cameras}: 'other.png'\n" in said
    made = json.loads(told)
    assert (made["painted"], made["skipped"]) == (["blue.png", "square.png"], ["other.png"])
    out.unlink()
    assert cli.refusal(*arguments, tmp_path / "other.png") == (
        f"{scene.cameras}: there is no frame {(tmp_path / 'other.png').as_posix()!r}; "
        "there are: 'square.png', 'blue.png'; IMAGE=NAME says which camera an IMAGE has"
    )
    message = cli.refusal(*scene.shot, scene.blue, OUT, out)
    assert message.startswith("--camera names one frame, 'square.png', for 2 IMAGEs; leave the name out")
    alone = tmp_path / "alone" / "cameras.json"
    alone.parent.mkdir()
    alone.write_bytes(scene.cameras.read_bytes())
    message = cli.refusal(scene.texture, scene.model, "--camera", alone, OUT, out)
    assert message.startswith(f"{alone}: none of the 2 images that it names exists: 'square.png'")
    unnamed = tmp_path / "cameras.npz"
    np.savez(unnamed, viewmats=np.eye(4)[None], Ks=np.eye(3)[None])
    message = cli.refusal(scene.texture, scene.model, "--camera", unnamed, OUT, out)
    assert message == f"{unnamed}: does not name the images of its cameras; give IMAGEs"


@needs_jit
def test_a_files_own_images_are_painted_and_missing_ones_skipped(scene, tmp_path, cli):
    file, names = transforms(scene, tmp_path)
    arguments = [scene.texture, scene.model, "--camera", file, OUT, tmp_path / "out.octex"]
    listing = ", ".join(map(repr, names[:5]))
    assert cli.refusal(*arguments) == (
        f"{file}: none of the 8 images that it names exists: {listing} and 3 more; give IMAGEs"
    )
    (tmp_path / "images").mkdir()
    (tmp_path / names[0]).write_bytes(scene.blue.read_bytes())
    assert cli.run(*arguments, "--json") == ExitCode.DONE
    told, said = cli.said()
    listing = ", ".join(map(repr, names[1:6]))
    assert f"octex paint: skipped 7 of 8 images: {listing} and 2 more\n" in said
    made = json.loads(told)
    assert (made["painted"], made["skipped"]) == (["blue.png"], names[1:])


def transforms(scene, folder):
    """Write a transforms.json that names eight images; return it and their names."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    pose = (np.linalg.inv(scene.camera.world_to_camera) @ flip).tolist()
    names = ["images/blue.png", *(f"images/{number}.png" for number in range(7))]
    document = {
        "fl_x": float(scene.camera.K[0, 0]),
        "frames": [{"file_path": name, "transform_matrix": pose} for name in names],
    }
    file = folder / "transforms.json"
    file.write_text(json.dumps(document))
    return file, names


def test_images_that_cannot_be_used_are_refused_by_file_and_frame(scene, tmp_path, cli):
    out, camera = tmp_path / "out.octex", ["--camera", f"{scene.cameras}#square.png"]
    small, words, missing = tmp_path / "small.png", tmp_path / "words.png", tmp_path / "missing.png"
    Image.new("RGB", (8, 5)).save(small)
    words.write_text("words")
    paint = [scene.texture, scene.model]
    frame = f"frame 'square.png' of {scene.cameras}"
    assert cli.refusal(*paint, small, *camera, OUT, out) == (
        f"{small}: {frame} is for {SIZE}×{SIZE} pixels, the image has 8×5, another shape; give the "
        "image that the camera was made for"
    )
    message = cli.refusal(*paint, words, *camera, OUT, out)
    assert message.startswith("words.png cannot be read as an image (")
    assert message.endswith(f"(for {frame})")
    message = cli.refusal(*paint, missing, *camera, OUT, out)
    assert message == f"{missing} cannot be read: No such file or directory (for {frame})"
    message = cli.refusal(*scene.shot, "--mask", small, OUT, out)
    assert message.startswith(f"{small} has 8×5 pixels, its camera {SIZE}×{SIZE}")
    message = cli.refusal(*scene.shot[:4], f"{scene.cameras}#nobody", OUT, out)
    assert message == f"{scene.cameras}: there is no frame 'nobody'; there are: 'square.png', 'blue.png'"
    message = cli.refusal(*scene.shot[:4], tmp_path / "none.json", OUT, out)
    assert message.startswith(f"{tmp_path / 'none.json'}: cannot be read")
    assert not out.exists()


@needs_jit
def test_masks_are_one_for_all_or_one_each(scene, tmp_path, cli):
    out, black, white = (tmp_path / name for name in ("out.octex", "black.png", "white.png"))
    for path, code in ((black, 0), (white, 255)):
        Image.new("L", (SIZE, SIZE), code).save(path)
    both = [*scene.shot[:2], scene.square, scene.blue, "--camera", scene.cameras, OUT, out, "--force"]
    cli.result(*both, "--mask", white, "--mask", black, "--quiet")
    masked = ((scene.square, white), (scene.blue, black))
    images = [octex.Projection(image, scene.camera, mask) for image, mask in masked]
    assert_painted(octex.open(out), octex.paint(octex.open(scene.texture), scene.surface, images))
    assert cli.run(*both, "--mask", black) == ExitCode.NOTHING_PAINTED
    cli.said()
    message = cli.refusal(*both, *["--mask", white] * 3)
    assert message == "--mask gives 3 for 2 IMAGEs; give one for all, or one an IMAGE"


@needs_jit
def test_an_image_may_name_its_frame(scene, tmp_path, cli):
    out, other = tmp_path / "out.octex", tmp_path / "other.octex"
    image = tmp_path / "my=image.png"
    image.write_bytes(scene.square.read_bytes())
    shot = [scene.texture, scene.model, "--camera", scene.cameras, "--quiet", OUT]
    cli.result(*shot, out, f"{image}=square.png")
    cli.result(*shot, other, scene.square)
    assert np.array_equal(octex.open(out).tree.arrays.flags, octex.open(other).tree.arrays.flags)
    refused = cli.refusal(*shot, tmp_path / "no.octex", f"{image}=x.png")
    assert refused.startswith(f"{scene.cameras}: there is no frame 'x.png'; there are: ")


def test_the_name_of_a_camera_comes_after_the_file(tmp_path):
    (tmp_path / "a#b.json").touch()
    plain = f"{tmp_path}/a#b.json"
    assert camera(plain) == (Path(plain), None)
    assert camera(f"{plain}#c#d") == (Path(plain), "c#d")
    assert camera("missing.json#a#b") == (Path("missing.json"), "a#b")
    assert camera("#a") == (Path("#a"), None)
