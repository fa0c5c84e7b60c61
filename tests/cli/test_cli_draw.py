"""Views to paint on at the command line, and what is painted of them."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import octex
from octex.cli.main import main
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import OUT, VIEW, painting
from tests.make.scene import SIZE, SQUARE

ROOT = Path(octex.__file__).parent.parent


@needs_jit
def test_an_image_that_was_drawn_is_edited_and_painted_back(scene, tmp_path, cli):
    view, file, out = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "out.octex"
    options = ["--camera", f"{scene.cameras}#square.png", "--threads", 1]
    text = cli.result(scene.texture, scene.model, VIEW, view, "--camera-out", file, *options)
    assert text.splitlines()[0].startswith(f"{view}: {SIZE}×{SIZE} pixels, ")
    assert text.splitlines()[1] == f"{file}: its camera"
    image = np.array(Image.open(view))
    assert image.shape == (SIZE, SIZE, 4)
    assert set(np.unique(image[:, :, 3])) == {0, 255}
    back = [scene.texture, scene.model, view, "--camera", file]
    cli.result(*back, OUT, out, "--since", "nothing")
    before, points = octex.open(scene.texture), scene.places(0.0)[0]
    np.testing.assert_allclose(octex.open(out).sample(points), before.sample(points), atol=0.15)
    assert np.abs(octex.open(out).sample(points) - before.sample(points)).mean() < 0.01
    image[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1, :3] = [255, 0, 0]
    Image.fromarray(image).save(view)
    cli.result(*back, OUT, out, "--force", "--since", "nothing")
    points, inside = scene.places(1.5)
    red = octex.open(out).sample(points)
    np.testing.assert_allclose(red[inside], [[1.0, 0.0, 0.0]] * inside.sum(), atol=0.02)
    points, near = scene.places(-3.0)
    assert np.abs(octex.open(out).sample(points) - before.sample(points))[~near].mean() < 0.01


@needs_jit
def test_what_is_erased_is_transparent_in_the_view_and_stays_erased_when_it_is_painted_back(
    scene, tmp_path, cli
):
    erased, view, out = tmp_path / "erased.octex", tmp_path / "square.png", tmp_path / "out.octex"
    cli.result(*scene.shot, "--blend", "erase", "--max-depth", "12", OUT, erased)
    before = octex.open(erased)
    look = [erased, scene.model, VIEW, view, "--camera", scene.cameras]
    cli.result(*look)
    image = np.array(Image.open(view)).astype(int)
    left, top, right, bottom = SQUARE
    assert not image[top + 2 : bottom - 1, left + 2 : right - 1].any()
    cli.result(scene.texture, scene.model, *look[2:], "--force")
    whole = np.array(Image.open(view)).astype(int)
    beside = np.ones((SIZE, SIZE), bool)
    beside[top - 2 : bottom + 3, left - 2 : right + 3] = False
    assert np.abs(image - whole)[beside].max() <= 1
    part = (image[..., 3] > 100) & (image[..., 3] < 255)
    assert part.any()
    assert np.abs(image - whole)[part, :3].mean() < 6  # black, were they multiplied by alpha
    cli.result(*look, "--force")
    points, inside = scene.places(1.5)
    assert (before.sample(points, "alpha")[inside] == 0).all()
    back = [erased, scene.model, view, "--camera", scene.cameras, "--max-depth", "12", OUT, out, "--force"]
    for blend in ("over", "replace"):
        cli.result(*back, "--blend", blend)
        after = octex.open(out)
        assert (after.sample(points, "alpha")[inside] < 0.01).all()
        if blend == "replace":
            np.testing.assert_allclose(
                after.sample(points, "alpha"), before.sample(points, "alpha"), atol=0.005
            )


def test_the_view_is_of_the_channel_alone(scene, tmp_path, cli):
    bright, view, file = tmp_path / "bright.octex", tmp_path / "view.png", tmp_path / "camera.json"
    sources = {"base_color": (0.2, 0.4, 0.6), "emissive": 1.0, "alpha": 0.5, "roughness": 0.2}
    octex.convert(scene.model, 3, sources=sources).save(bright)
    arguments = [bright, scene.model, VIEW, view, "--camera-out", file, "--size", "30,20", "--quiet"]
    made = cli.facts(*arguments)
    assert made.pop("seconds") > 0
    size = view.stat().st_size
    assert made == {"output": str(view), "size": [30, 20], "bytes": size, "camera": str(file)}
    image = np.array(Image.open(view))
    assert image.shape == (20, 30, 4)
    seen = image[image[:, :, 3] == 128]  # of the texture; colours are not multiplied by it
    assert 40 < len(seen) < 600
    assert np.abs(seen[:, :3].astype(int) - [124, 170, 203]).max() <= 1
    assert set(np.unique(image[:, :, 3])) == {0, 128}
    assert not image[image[:, :, 3] == 0].any()
    frame = octex.read_cameras(file)[0]
    assert (frame.name, frame.size) == ("view.png", (30, 20))
    expected = octex.Camera.fitted(scene.surface.vertices, (0.4, 0.3, 1), size=(30, 20))
    np.testing.assert_array_equal(frame.camera().matrix, expected.matrix)
    cli.result(*arguments, "--force", "--channel", "roughness")
    image = np.array(Image.open(view))
    assert set(image[image[:, :, 3] == 128][:, :3].ravel().tolist()) == {51}
    assert "'normal'" in cli.refusal(*arguments, "--force", "--channel", "normal")


def test_without_a_texture_the_view_shows_the_form_in_grey(scene, tmp_path, cli):
    view = tmp_path / "view.png"
    given = [scene.model, VIEW, view, "--camera", f"{scene.cameras}#blue.png"]
    assert "without a texture the model is drawn grey" in cli.errors(*given)
    image = np.array(Image.open(view)).reshape(-1, 4)
    seen = image[image[:, 3] == 255]
    assert (seen[:, :1] == seen[:, :3]).all()
    assert len(np.unique(seen[:, 0])) >= 3
    assert seen[:, 0].min() > 100


def test_a_view_has_no_lens_distortion(scene, tmp_path, cli):
    bent = replace(scene.camera, distortion=(-0.1, 0.01, 0.0, 0.0))
    octex.write_cameras(tmp_path / "bent.json", {"bent": bent})
    given = [scene.texture, scene.model, "--camera", tmp_path / "bent.json", VIEW, tmp_path / "a.png"]
    said = cli.errors(*given, "--camera-out", tmp_path / "straight.json")
    assert "octex draw: the camera has lens distortion; the image is drawn without it" in said
    frame = octex.read_cameras(tmp_path / "straight.json")[0]
    assert (frame.name, frame.camera().distortion) == ("a.png", (0.0, 0.0, 0.0, 0.0))
    cli.result(scene.texture, scene.model, "--camera", scene.cameras, VIEW, tmp_path / "square.png")
    assert np.array_equal(Image.open(tmp_path / "a.png"), Image.open(tmp_path / "square.png"))


def test_a_view_needs_a_camera_that_can_be_found_again(scene, tmp_path, cli):
    view = [scene.texture, scene.model, VIEW, tmp_path / "view.png"]
    assert cli.refusal(*view, "--camera", scene.cameras) == (
        f"{scene.cameras}: there is no frame 'view.png'; there are: 'square.png', 'blue.png'; "
        f"choose one with --camera {scene.cameras}#NAME"
    )
    message = cli.refusal(*view, "--camera", f"{scene.cameras}#blue.png", "--size", "7,9")
    assert message == (
        f"--size has another aspect ratio than frame 'blue.png' of {scene.cameras}, 40,40; leave --size out"
    )
    assert list(tmp_path.iterdir()) == []


@needs_jit
def test_an_empty_layer_beside_a_view_is_painted_back_as_it_is(scene, tmp_path, cli):
    view, layer, file = tmp_path / "view.png", tmp_path / "layer.png", tmp_path / "camera.json"
    look = [scene.texture, scene.model, VIEW, view, "--camera", f"{scene.cameras}#square.png"]
    said = cli.result(*look, "--empty-layer", layer, "--camera-out", file)
    assert said.splitlines()[1:] == [f"{layer}: an empty layer of its size", f"{file}: its camera"]
    image = np.array(Image.open(layer))
    assert image.shape == (SIZE, SIZE, 4)
    assert not image.any()
    back = [scene.texture, scene.model, layer, "--camera", file, "--quiet", OUT]
    assert cli.run(*back, tmp_path / "none.octex") == ExitCode.NOTHING_PAINTED
    cli.said()
    # In the view's own colours: as a layer that is paint, and it is multiplied with what is there.
    place = np.s_[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1]
    image[place] = np.array(Image.open(view))[place]
    Image.fromarray(image).save(layer)
    same = tmp_path / "same.png"
    same.write_bytes(layer.read_bytes())
    outs = [tmp_path / "as_layer.octex", tmp_path / "by_hand.octex"]
    cli.result(*back, outs[0], "--blend", "multiply")
    by_hand = [same, "--camera", f"{scene.cameras}#square.png", "--blend", "multiply", "--quiet"]
    cli.result(scene.texture, scene.model, *by_hand, OUT, outs[1])
    painted, expected = (octex.open(out) for out in outs)
    np.testing.assert_array_equal(
        painted.channels["base_color"].values, expected.channels["base_color"].values
    )
    points, inside = scene.places(1.5)
    before = octex.open(scene.texture).sample(points[inside])
    np.testing.assert_allclose(painted.sample(points[inside]), before**2, atol=0.05)


@needs_jit
def test_a_view_is_from_the_side_and_as_near_as_wanted(scene, tmp_path, cli):
    file = tmp_path / "camera.json"
    look = [scene.texture, scene.model, VIEW, tmp_path / "view.png", "--camera-out", file, "--force"]
    cli.result(*look, "--size", "32,24", "--direction=-1,0.5,0", "--up", "0,0,1", "--zoom", 2)
    made = octex.read_cameras(file)[0].camera()
    whole = octex.Camera.fitted(scene.surface.vertices, (-1, 0.5, 0), size=(32, 24), up=(0, 0, 1))
    np.testing.assert_array_equal(made.world_to_camera, whole.world_to_camera)
    points = scene.surface.vertices
    middle = np.array([16.0, 12.0])
    expected = middle + 2 * (whole.project(points)[0] - middle)
    np.testing.assert_allclose(made.project(points)[0], expected, atol=1e-9)
    cli.result(*look, "--camera", f"{scene.cameras}#blue.png")
    np.testing.assert_array_equal(octex.read_cameras(file)[0].camera().K, scene.camera.K)
    flat = np.array(Image.open(tmp_path / "view.png"))
    cli.result(*look, "--camera", f"{scene.cameras}#blue.png", "--light", "soft")
    shaded = np.array(Image.open(tmp_path / "view.png"))
    assert (shaded[..., 3] == flat[..., 3]).all()
    assert (shaded <= flat).all()
    assert shaded.mean() < flat.mean()


def test_a_frame_that_is_not_there_is_refused_before_anything_is_read(tmp_path, cli, monkeypatch):
    document = {"asset": {"version": "2.0"}, "nodes": [{"camera": 0, "name": "front"}]}
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7}}]
    model, image = tmp_path / "scene.gltf", tmp_path / "a.png"
    model.write_text(json.dumps(document))
    for name in ("load_surface", "open", "convert"):
        monkeypatch.setattr(octex, name, lambda *_, **__: pytest.fail("it was begun"))
    for more in (["--as", "paint", "--camera-out", str(tmp_path / "c.json")], []):
        assert main(["draw", str(model), str(image), "--camera", f"{model}#back", *more]) == 2
        assert cli.said()[1].endswith(f": error: {model}: there is no frame 'back'; there are: 'front'\n")


@needs_jit
def test_of_a_view_only_what_was_drawn_on_it_is_painted(scene, tmp_path, cli):
    view, file = tmp_path / "view.png", tmp_path / "camera.json"
    look = [scene.texture, scene.model, VIEW, view, "--camera-out", file, "--size", "64,64", "--quiet"]
    cli.result(*look)
    shot = [scene.texture, scene.model, view, "--camera", file, "--quiet", OUT]
    said = cli.errors(*shot, tmp_path / "none.octex", code=ExitCode.NOTHING_PAINTED)
    assert " is not written: nothing was drawn on the view (--since nothing paints all of it), or " in said
    before = tmp_path / "before.png"
    before.write_bytes(view.read_bytes())
    image = np.array(Image.open(view))
    image[28:36, 28:36, :3] = [255, 0, 0]
    Image.fromarray(image).save(view)
    texture = octex.open(scene.texture)
    outs = {name: tmp_path / f"{name}.octex" for name in ("drawn", "by_hand", "whole")}
    cli.result(*shot, outs["drawn"])
    file.write_text(re.sub(r', "view": "[^"]*"', "", file.read_text()))  # as an older octex wrote it
    cli.result(*shot, outs["by_hand"], "--since", before)
    cli.result(*shot, outs["whole"])
    assert outs["by_hand"].read_bytes() == outs["drawn"].read_bytes()
    drawn, whole = octex.open(outs["drawn"]), octex.open(outs["whole"])
    assert texture.tree.n_leaves < drawn.tree.n_leaves < whole.tree.n_leaves / 4
    points = scene.surface.scatter(2000, seed=1)
    camera = octex.read_cameras(file)[0].camera()
    pixels, _ = camera.project(points.points)
    distance = np.abs(pixels - 32).max(axis=1)
    far = distance > 9
    np.testing.assert_allclose(drawn.sample(points.rest[far]), texture.sample(points.rest[far]), atol=1e-3)
    seen = np.einsum("nk,nk->n", camera.position - points.points, points.normals) > 1.0
    red = drawn.sample(points.rest[(distance < 2) & seen])
    assert len(red)
    np.testing.assert_allclose(red, np.broadcast_to([1.0, 0.0, 0.0], red.shape), atol=0.02)


@needs_jit
def test_all_of_a_view_is_painted_on_request_on_a_new_texture_and_if_compression_changed_it(
    scene, tmp_path, cli
):
    view, file, lossy = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "view.jpg"
    cli.result(scene.texture, scene.model, VIEW, view, "--camera-out", file, "--size", "48,48")
    out, given = tmp_path / "out.octex", [view, "--camera", file, "--force", OUT]
    cli.result(scene.texture, scene.model, *given, out, "--since", "nothing")
    assert octex.open(out).tree.n_leaves > octex.open(scene.texture).tree.n_leaves
    assert cli.result(scene.model, *given, out).startswith(f"{out}: 1 image painted, ")
    with Image.open(view) as image:
        image.convert("RGB").save(lossy, quality=70)
    said = cli.errors(scene.texture, scene.model, f"{lossy}={view.name}", *given[1:], out)
    assert f"{lossy} is a JPEG: what compression changed is painted, too" in said


@needs_jit
def test_images_and_views_may_be_smaller_or_larger_than_their_cameras(scene, tmp_path, cli):
    view, file, out = tmp_path / "square.png", tmp_path / "camera.json", tmp_path / "out.octex"
    drawn = [scene.texture, scene.model, "--camera", scene.cameras, "--size", f"{3 * SIZE},{3 * SIZE}"]
    cli.result(*drawn, VIEW, view, "--camera-out", file)
    assert octex.read_cameras(file)[0].size == (3 * SIZE, 3 * SIZE)
    outs = []
    for cameras in (scene.cameras, file):  # that of a third of the size, and the view's own
        outs.append(tmp_path / f"{cameras.stem}.octex")
        cli.result(scene.model, view, "--camera", cameras, OUT, outs[-1])
    points = scene.places(0.0)[0]
    a, b = (octex.open(out).sample(points) for out in outs)
    np.testing.assert_allclose(a, b, atol=1e-6)
    with Image.open(view) as image:
        image.resize((2 * SIZE, 2 * SIZE)).save(view)
    back = [scene.texture, scene.model, view, "--camera", file, OUT, out]
    assert cli.refusal(*back).endswith(
        "so octex cannot tell which pixels you changed; scale the image, or give --since nothing"
    )
    cli.result(*back, "--since", "nothing")


def test_a_view_in_a_camera_file_that_is_no_image_is_refused(scene, tmp_path, cli):
    file = tmp_path / "camera.json"
    octex.write_cameras(file, {"blue.png": scene.camera}, {"blue.png": b"no image"})
    shot = [scene.texture, scene.model, scene.blue, "--camera", file, OUT, tmp_path / "out.octex"]
    assert cli.refusal(*shot).startswith(f"the view in {file}")
    text = file.read_text()
    file.write_text(re.sub('"view": "', '"view": "é', text))
    assert "view is not an image in base64" in cli.refusal(*shot)
    with pytest.raises(octex.errors.ArgumentError, match="view 'other' must be the bytes of a PNG file"):
        octex.write_cameras(file, {"blue.png": scene.camera}, {"other": b""})


@needs_jit
def test_a_model_is_drawn_edited_and_painted_from_a_checkout(tmp_path, cli):
    droid, texture = ROOT / "samples" / "droid.glb", tmp_path / "droid.octex"
    view, file, out = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "out.octex"
    octex.convert(droid, 6, channels=["base_color"]).save(texture)
    cli.result(texture, droid, VIEW, view, "--camera-out", file, "--size", "128,128")
    image = np.array(Image.open(view))
    row, column = 59, 64  # on the head
    image[row - 4 : row + 5, column - 4 : column + 5, :3] = [255, 0, 0]
    Image.fromarray(image).save(view)
    _, *words = painting(texture, droid, view, "--camera", file, OUT, out)
    call = [sys.executable, "tools/paint_projection.py", *words]
    said = subprocess.run(call, stdout=subprocess.PIPE, text=True, timeout=600, cwd=ROOT, check=True).stdout
    assert said.startswith(f"{out}: 1 image painted, ")
    cli.result(out, droid, VIEW, tmp_path / "after.png", "--camera", f"{file}#view.png")
    after = np.array(Image.open(tmp_path / "after.png"))
    assert np.array_equal(after[:, :, 3], image[:, :, 3])
    moved = np.abs(after[:, :, :3].astype(int) - image[:, :, :3]).max(axis=2)
    assert np.median(moved[image[:, :, 3] > 0]) <= 6
    patch = after[row - 2 : row + 3, column - 2 : column + 3]
    red, green, blue, _ = np.median(patch.reshape(-1, 4), axis=0)
    assert red > 240
    assert max(green, blue) < 20
