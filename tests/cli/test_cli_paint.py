"""Painting at the command line."""

import hashlib
import inspect
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
from octex.cli.main import main as octex_main
from octex.cli.options import COMMANDS, DEFAULT_CHANNEL
from octex.cli.parser import Parser
from octex.cli.values import BALANCES, BLENDS, HOLES, PICTURES, camera
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import OUT, VIEW, Painting, colored_box, painting
from tests.make.same import assert_equal, assert_same

SIZE = 40
SQUARE = (16, 16, 23, 23)  # in the picture's middle, on the box: left, top, right, bottom, all inside
ROOT = Path(octex.__file__).parent.parent


@pytest.fixture
def cli(capsys):
    """Runs octex paint, or octex draw for a view to paint on."""
    return Painting(capsys)


class Scene:
    """A box with its texture, a camera before it and pictures for that."""

    def __init__(self, folder):
        self.model = colored_box(folder)
        self.surface = octex.load_surface(self.model)
        self.texture = folder / "box.octex"
        octex.convert(self.model, 4).save(self.texture)
        self.camera = octex.Camera.fitted(self.surface.vertices, (0.4, 0.3, 1), size=(SIZE, SIZE))
        self.cameras = folder / "cameras.json"
        octex.write_cameras(self.cameras, {"square.png": self.camera, "blue.png": self.camera})
        self.square = folder / "square.png"
        paint = np.zeros((SIZE, SIZE, 4), np.uint8)
        paint[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1] = [255, 0, 0, 255]
        Image.fromarray(paint).save(self.square)
        self.blue = folder / "blue.png"
        Image.fromarray(np.full((SIZE, SIZE, 3), [0, 0, 255], np.uint8)).save(self.blue)

    @property
    def shot(self):
        """Arguments to paint the square."""
        return [self.texture, self.model, self.square, "--camera", f"{self.cameras}#square.png"]

    def places(self, beside):
        """Return rest positions that the camera sees, and whether they are so many pixels in the square."""
        samples = self.surface.scatter(4000)
        toward = self.camera.position - samples.points
        seen = np.einsum("nk,nk->n", toward, samples.normals) > 0.5 * np.linalg.norm(toward, axis=1)
        pixels, _ = self.camera.project(samples.points[seen])
        low, high = np.array(SQUARE[:2]) + beside, np.array(SQUARE[2:]) + 1 - beside
        return samples.rest[seen], ((pixels >= low) & (pixels <= high)).all(axis=1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(tmp_path_factory.mktemp("scene"))


# --- painting


def assert_painted(one, other):
    """Two textures are the same, and lie in the same place; a command's metadata say more."""
    assert_same(one, other)
    assert one.placement == other.placement
    np.testing.assert_array_equal(one.bounds, other.bounds)


def test_textures_and_layers_whose_content_is_broken_are_refused(scene, tmp_path, cli):
    content = bytearray(scene.texture.read_bytes())
    flags = octex.open(scene.texture).tree.arrays.flags.tobytes()
    at = bytes(content).index(flags, 4096)
    content[at : at + len(flags)] = bytes(0xC0 for _ in flags)  # all split and kept, and facing nowhere
    broken, out = tmp_path / "broken.octex", tmp_path / "out.octex"
    broken.write_bytes(content)
    shot = [broken, scene.model, *scene.shot[2:]]
    assert cli.refusal(*shot, OUT, out).startswith(f"{broken}: split table")
    layer = [scene.texture, scene.model, broken]
    assert cli.refusal(*layer, OUT, out).startswith(f"{broken}: split table")
    assert not out.exists()


@needs_jit
def test_paint_is_where_the_camera_sees_it_and_nowhere_else(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    text = cli.result(*scene.shot, OUT, out)
    assert text.startswith(f"{out}: 1 picture painted, {octex.open(out).tree.n_leaves:,} leaves, depth ")
    before, after = octex.open(scene.texture), octex.open(out)
    after.validate()
    points, inside = scene.places(1.5)
    assert inside.sum() > 10
    np.testing.assert_allclose(after.sample(points[inside]), [[1.0, 0.0, 0.0]] * inside.sum(), atol=0.02)
    points, near = scene.places(-8.0)  # cells beside the paint are as wide as some pixels
    np.testing.assert_allclose(after.sample(points[~near]), before.sample(points[~near]), atol=1e-5)


@needs_jit
def test_a_picture_that_was_drawn_is_edited_and_painted_back(scene, tmp_path, cli):
    view, file, out = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "out.octex"
    options = ["--camera", f"{scene.cameras}#square.png", "--threads", 1]
    text = cli.result(scene.texture, scene.model, VIEW, view, "--camera-out", file, *options)
    assert text.splitlines()[0].startswith(f"{view}: {SIZE}×{SIZE} pixels, ")
    assert text.splitlines()[1] == f"{file}: its camera"
    picture = np.array(Image.open(view))
    assert picture.shape == (SIZE, SIZE, 4)
    assert set(np.unique(picture[:, :, 3])) == {0, 255}
    back = [scene.texture, scene.model, view, "--camera", file]
    cli.result(*back, OUT, out, "--since", "nothing")
    before, points = octex.open(scene.texture), scene.places(0.0)[0]
    np.testing.assert_allclose(octex.open(out).sample(points), before.sample(points), atol=0.15)
    assert np.abs(octex.open(out).sample(points) - before.sample(points)).mean() < 0.01
    picture[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1, :3] = [255, 0, 0]
    Image.fromarray(picture).save(view)
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
    picture = np.array(Image.open(view)).astype(int)
    left, top, right, bottom = SQUARE
    assert not picture[top + 2 : bottom - 1, left + 2 : right - 1].any()
    cli.result(scene.texture, scene.model, *look[2:], "--force")
    whole = np.array(Image.open(view)).astype(int)
    beside = np.ones((SIZE, SIZE), bool)
    beside[top - 2 : bottom + 3, left - 2 : right + 3] = False
    assert np.abs(picture - whole)[beside].max() <= 1
    part = (picture[..., 3] > 100) & (picture[..., 3] < 255)
    assert part.any()
    assert np.abs(picture - whole)[part, :3].mean() < 6  # black, were they multiplied by alpha
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


@needs_jit
def test_a_layer_kept_and_merged_later_is_the_same_paint(scene, tmp_path, cli):
    layer = tmp_path / "layer.octex"
    text = cli.result(
        *scene.shot, OUT, tmp_path / "a.octex", "--layer-out", layer, "--opacity", 0.5, "--quiet"
    )
    assert text == ""
    merge = [scene.texture, scene.model, layer, "--opacity", 0.5]
    text = cli.result(*merge, OUT, tmp_path / "b.octex")
    assert ": 1 layer painted, " in text
    assert_painted(octex.open(tmp_path / "a.octex"), octex.open(tmp_path / "b.octex"))
    picture = octex.Projection(scene.square, scene.camera, opacity=0.5)
    texture = octex.open(scene.texture)
    assert_painted(octex.paint(texture, scene.surface, picture), octex.open(tmp_path / "a.octex"))
    cli.result(*merge, layer, "--blend", "multiply", OUT, tmp_path / "c.octex")
    for _ in range(2):
        texture = octex.merge(texture, octex.open(layer), scene.surface, opacity=0.5, blend="multiply")
    assert_painted(texture, octex.open(tmp_path / "c.octex"))
    told = json.loads(octex.open(tmp_path / "c.octex").metadata["paint"])
    digest = hashlib.sha256(layer.read_bytes()).hexdigest()
    entry = {"image": "layer.octex", "sha256": digest, "blend": "multiply", "opacity": 0.5}
    assert told == [{**entry, "channel": "base_color"}] * 2


@needs_jit
def test_an_archive_is_painted_on_and_with_force_the_texture_itself_is_replaced(scene, tmp_path, cli):
    texture, out = tmp_path / "box.octex", tmp_path / "out.octex"
    texture.write_bytes(scene.texture.read_bytes())
    arguments = [texture, scene.model, *scene.shot[2:]]
    cli.result(*arguments, OUT, out)
    opened = octex.open(texture)
    opened.save(texture.with_suffix(".octz"))
    archived = [texture.with_suffix(".octz"), scene.model, *scene.shot[2:]]
    cli.result(*archived, OUT, tmp_path / "archived.octex")
    assert (tmp_path / "archived.octex").read_bytes() == out.read_bytes()
    cli.result(*arguments, OUT, texture, "--force")
    assert texture.read_bytes() == out.read_bytes()
    assert_equal(opened, octex.open(scene.texture))  # what is mapped is the old file


def test_without_force_and_as_a_layer_the_texture_is_not_replaced(scene, tmp_path, cli):
    before = scene.texture.read_bytes()
    message = cli.refusal(*scene.shot, OUT, scene.texture)
    assert message == f"{scene.texture}: exists already; --force overwrites it"
    out = tmp_path / "out.octex"
    message = cli.refusal(*scene.shot, OUT, out, "--layer-out", scene.texture, "--force")
    assert message == f"{scene.texture}: --layer-out is also an input; give it another name"
    assert scene.texture.read_bytes() == before


@needs_jit
def test_erasing_takes_alpha_away(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    cli.result(*scene.shot, OUT, out, "--blend", "erase", "--opacity", 0.5, "--quiet")
    before, after = octex.open(scene.texture), octex.open(out)
    after.validate()
    assert list(before.channels) == ["base_color"]
    assert list(after.channels) == ["base_color", "alpha"]
    points, inside = scene.places(1.5)
    np.testing.assert_allclose(after.sample(points[inside], "alpha"), 0.5, atol=0.02)
    points, near = scene.places(-8.0)
    np.testing.assert_allclose(after.sample(points[~near], "alpha"), 1.0, atol=1e-6)
    away = scene.surface.scatter(1000)
    hidden = away.rest[away.normals[:, 2] < -0.5]
    np.testing.assert_allclose(after.sample(hidden, "alpha"), 1.0, atol=1e-6)
    np.testing.assert_allclose(after.sample(hidden), before.sample(hidden), atol=1e-5)
    told = json.loads(after.metadata["paint"])
    assert [(entry["blend"], entry["opacity"]) for entry in told] == [("erase", 0.5)]


@needs_jit
def test_a_machine_reads_one_object_and_the_texture_knows_what_was_painted(scene, tmp_path, cli):
    first, second = tmp_path / "first.octex", tmp_path / "second.octex"
    cli.result(*scene.shot, OUT, first, "--quiet")
    arguments = [first, scene.model, scene.square, scene.blue, "--camera", scene.cameras]
    code = cli.run(*arguments, OUT, second, "--opacity", 0.5, "--json", "--quiet")
    assert code == ExitCode.DONE
    told, said = cli.said()
    assert said == ""
    made, texture = json.loads(told), octex.open(second)
    assert made.pop("seconds") > 0
    assert made == {
        "output": str(second),
        "leaves": texture.tree.n_leaves,
        "nodes": texture.tree.n_nodes,
        "depth": texture.tree.max_depth,
        "cell": texture.placement.size / 2**texture.tree.max_depth,
        "painted": ["square.png", "blue.png"],
        "skipped": [],
        "bytes": second.stat().st_size,
    }
    told = [(path, 1.0) for path in [scene.square]] + [(path, 0.5) for path in [scene.square, scene.blue]]
    assert json.loads(texture.metadata["paint"]) == [
        {
            "image": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "blend": "over",
            "opacity": strength,
            "channel": "base_color",
        }
        for path, strength in told
    ]
    assert texture.metadata["convert"] == octex.open(scene.texture).metadata["convert"]


@needs_jit
def test_nothing_painted_writes_nothing_and_has_an_exit_code_of_its_own(scene, tmp_path, cli):
    away = replace(
        scene.camera, world_to_camera=np.diag([1.0, -1.0, -1.0, 1.0]) @ scene.camera.world_to_camera
    )
    octex.write_cameras(tmp_path / "away.json", {"square.png": away})
    black, clear = tmp_path / "black.png", tmp_path / "clear.png"
    Image.new("L", (SIZE, SIZE), 0).save(black)
    Image.new("RGBA", (SIZE, SIZE), (255, 0, 0, 0)).save(clear)
    files = sorted(tmp_path.iterdir())
    looks_away = [*scene.shot[:3], "--camera", tmp_path / "away.json"]
    for texture in ([scene.texture], []):
        for arguments in (
            looks_away,
            [*scene.shot, "--mask", black],
            [*scene.shot[:2], clear, *scene.shot[3:]],
            [*scene.shot, "--opacity", 0],
        ):
            given = [*texture, scene.model, *arguments[2:], OUT, tmp_path / "out.octex", "--quiet"]
            assert cli.run(*given) == ExitCode.NOTHING_PAINTED == 3
            told, said = cli.said()
            assert (told, said.count("\n")) == ("", 1)
            assert said.startswith(
                f"octex paint: nothing was painted, and {tmp_path / 'out.octex'} is not written: "
            )
    given = [*looks_away, OUT, tmp_path / "o.octex", "--layer-out", tmp_path / "l.octex"]
    assert cli.run(*given) == 3
    assert sorted(tmp_path.iterdir()) == files


# --- new textures


@needs_jit
def test_a_texture_that_is_not_there_is_begun(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    assert "there is no texture yet: painting begins a new one" in cli.errors(*scene.shot[1:], OUT, out)
    made = octex.open(out)
    made.validate()
    picture = octex.Projection(scene.square, scene.camera)
    assert_painted(made, octex.paint(None, scene.surface, picture))
    points, inside = scene.places(1.5)
    np.testing.assert_allclose(made.sample(points[inside]), [[1.0, 0.0, 0.0]] * inside.sum(), atol=0.02)
    assert made.metadata["source"] == "box.glb"
    assert set(made.metadata) == {"source", "sha256", "octex", "paint"}


@needs_jit
@pytest.mark.parametrize("depth", [[], ["--max-depth", 3]])
def test_a_new_texture_may_have_a_background(depth, scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    arguments = [*scene.shot[1:], OUT, out, *depth]
    cli.result(*arguments, "--holes", "#204060", "--quiet")
    made = octex.open(out)
    made.validate()
    assert not depth or made.tree.max_depth == 3
    away = scene.surface.scatter(2000)
    away_points = away.rest[away.normals[:, 2] < -0.5]
    from octex.channels import decode

    color = decode(np.array([0x20, 0x40, 0x60], np.uint8), "srgb")
    np.testing.assert_allclose(made.sample(away_points), np.tile(color, (len(away_points), 1)), atol=1e-3)
    rough = [*arguments, "--channel", "roughness", "--force"]
    cli.result(*rough, "--holes", "51", "--quiet")
    assert octex.open(out).sample(away_points, "roughness") == pytest.approx(0.2, abs=1e-3)


def test_a_background_is_one_of_the_channels_values(scene, tmp_path, cli):
    new = [*scene.shot[1:], OUT, tmp_path / "out.octex"]
    given = [*new, "--holes", "1,2,3", "--channel"]
    assert "give a grey" in cli.refusal(*given, "roughness")
    assert "normal holds directions" in cli.refusal(*given, "normal")


# --- pictures and frames


@needs_jit
def test_pictures_are_matched_to_frames_by_their_file_names(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    arguments = [scene.texture, scene.model, "--camera", scene.cameras, OUT, out, "--force"]
    made = json.loads(cli.result(*arguments, scene.blue, scene.square, "--json", "--quiet"))
    assert made["painted"] == ["blue.png", "square.png"]


@needs_jit
def test_pictures_without_a_frame_are_skipped_and_refused_if_none_has_one(scene, tmp_path, cli):
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
    assert f"skipped 1 of 3 pictures, which have no camera in {scene.cameras}: 'other.png'\n" in said
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
    assert message.startswith(f"{alone}: none of the 2 pictures that it names exists: 'square.png'")
    unnamed = tmp_path / "cameras.npz"
    np.savez(unnamed, viewmats=np.eye(4)[None], Ks=np.eye(3)[None])
    message = cli.refusal(scene.texture, scene.model, "--camera", unnamed, OUT, out)
    assert message == f"{unnamed}: does not name the pictures of its cameras; give IMAGEs"


def test_pictures_that_lie_beside_their_cameras_need_not_be_named(scene, tmp_path, cli):
    arguments = [scene.texture, scene.model, "--camera", scene.cameras, OUT, tmp_path / "out.octex"]
    made = json.loads(cli.result(*arguments, "--json", "--quiet"))
    assert made["painted"] == ["square.png", "blue.png"]


@needs_jit
def test_a_files_own_pictures_are_painted_and_missing_ones_skipped(scene, tmp_path, cli):
    file, names = transforms(scene, tmp_path)
    (tmp_path / "images").mkdir()
    (tmp_path / names[0]).write_bytes(scene.blue.read_bytes())
    arguments = [scene.texture, scene.model, "--camera", file, OUT, tmp_path / "out.octex"]
    assert cli.run(*arguments, "--json") == ExitCode.DONE
    told, said = cli.said()
    listing = ", ".join(map(repr, names[1:6]))
    assert f"octex paint: skipped 7 of 8 pictures: {listing} and 2 more\n" in said
    made = json.loads(told)
    assert (made["painted"], made["skipped"]) == (["blue.png"], names[1:])


def test_a_file_none_of_whose_pictures_is_there_is_refused(scene, tmp_path, cli):
    file, names = transforms(scene, tmp_path)
    arguments = [scene.texture, scene.model, "--camera", file, OUT, tmp_path / "out.octex"]
    listing = ", ".join(map(repr, names[:5]))
    assert cli.refusal(*arguments) == (
        f"{file}: none of the 8 pictures that it names exists: {listing} and 3 more; give IMAGEs"
    )


def transforms(scene, folder):
    """Write a transforms.json that names eight pictures; return it and their names."""
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


def test_pictures_that_cannot_be_used_are_refused_by_file_and_frame(scene, tmp_path, cli):
    out, camera = tmp_path / "out.octex", ["--camera", f"{scene.cameras}#square.png"]
    small, words, missing = tmp_path / "small.png", tmp_path / "words.png", tmp_path / "missing.png"
    Image.new("RGB", (8, 5)).save(small)
    words.write_text("words")
    paint = [scene.texture, scene.model]
    frame = f"frame 'square.png' of {scene.cameras}"
    assert cli.refusal(*paint, small, *camera, OUT, out) == (
        f"{small}: {frame} is for {SIZE}×{SIZE} pixels, the picture has 8×5, another shape; give the "
        "picture that the camera was made for"
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
    out = tmp_path / "out.octex"
    black, white = tmp_path / "black.png", tmp_path / "white.png"
    Image.new("L", (SIZE, SIZE), 0).save(black)
    Image.new("L", (SIZE, SIZE), 255).save(white)
    both = [scene.texture, scene.model, scene.square, scene.blue, "--camera", scene.cameras, OUT, out]
    cli.result(*both, "--mask", white, "--mask", black, "--quiet")
    picture = octex.Projection(scene.square, scene.camera, white)
    assert_painted(
        octex.open(out),
        octex.paint(
            octex.open(scene.texture),
            scene.surface,
            [picture, octex.Projection(scene.blue, scene.camera, black)],
        ),
    )
    assert cli.run(*both, "--mask", black, "--force") == ExitCode.NOTHING_PAINTED


def test_masks_of_another_number_than_the_pictures_are_refused(scene, tmp_path, cli):
    both = [scene.texture, scene.model, scene.square, scene.blue, "--camera", scene.cameras]
    message = cli.refusal(*both, OUT, tmp_path / "out.octex", *["--mask", scene.square] * 3)
    assert message == "--mask gives 3 for 2 IMAGEs; give one for all, or one an IMAGE"


@needs_jit
def test_the_options_of_painting_reach_the_library(scene, tmp_path, monkeypatch, cli):
    seen = {}
    project = octex.project

    def projected(*arguments, **options):
        seen.update(options)
        return project(*arguments, **options)

    monkeypatch.setattr(octex, "project", projected)
    more = "--max-depth 3 --max-angle 60,both --edge-feather 1.5 --balance gain --pictures average"
    more += f" --no-fit --threads 2 --memory 1kB --resume {tmp_path / 'kept'}"
    cli.result(*scene.shot, OUT, tmp_path / "out.octex", *more.split(), "--channel", "base_color")
    run = seen.pop("run")
    assert (run.memory, run.folder, run.resume) == (1000, tmp_path, tmp_path / "kept")
    assert run.executor is not None
    assert run.progress is not None
    assert seen.pop("like") is not None
    assert seen == {
        "channel": "base_color", "max_depth": 3, "max_angle": 60.0, "edge_feather": 1.5,
        "pictures": "average", "balance": "gain", "reference": None, "back_faces": True, "hidden": False,
        "fit": False,
    }  # fmt: skip
    cli.result(*scene.shot, OUT, tmp_path / "hidden.octex", "--max-angle", "hidden")
    assert (seen["max_angle"], seen["back_faces"], seen["hidden"]) == (None, False, True)


@needs_jit
def test_a_preview_is_drawn_of_what_was_painted(scene, tmp_path, monkeypatch, cli):
    drawn = []
    views = []

    def write_preview(_path, texture, surface, **view):
        names = None if surface is None else [form.name for form in surface.channels]
        drawn.append((names, list(texture.channels)))
        views.append(view)

    monkeypatch.setattr("octex.write_preview", write_preview)
    preview = tmp_path / "preview.png"
    text = cli.result(*scene.shot, OUT, tmp_path / "a.octex", "--preview", preview)
    assert text.splitlines()[1] == f"{preview}: a picture of it"
    new = [*scene.shot[1:], "--preview", preview]
    cli.result(*new, OUT, tmp_path / "b.octex", "--channel", "occlusion")
    assert drawn == [(["base_color"], ["base_color"]), (None, ["occlusion"])]
    rows = -scene.camera.world_to_camera[:3, :3]
    np.testing.assert_allclose([views[0]["direction"], views[0]["up"]], [rows[2], rows[1]], atol=1e-9)


# --- pictures to paint on


def test_the_view_is_of_the_channel_alone(scene, tmp_path, cli):
    bright, view, file = tmp_path / "bright.octex", tmp_path / "view.png", tmp_path / "camera.json"
    sources = {"base_color": (0.2, 0.4, 0.6), "emissive": 1.0, "alpha": 0.5, "roughness": 0.2}
    octex.convert(scene.model, 3, sources=sources).save(bright)
    arguments = [bright, scene.model, VIEW, view, "--camera-out", file, "--force"]
    made = json.loads(cli.result(*arguments, "--size", "30,20", "--json", "--quiet"))
    assert made.pop("seconds") > 0
    size = view.stat().st_size
    assert made == {"output": str(view), "size": [30, 20], "bytes": size, "camera": str(file)}
    picture = np.array(Image.open(view))
    assert picture.shape == (20, 30, 4)
    seen = picture[picture[:, :, 3] == 128]  # of the texture; colours are not multiplied by it
    assert 40 < len(seen) < 600
    assert np.abs(seen[:, :3].astype(int) - [124, 170, 203]).max() <= 1
    assert set(np.unique(picture[:, :, 3])) == {0, 128}
    assert not picture[picture[:, :, 3] == 0].any()
    frame = octex.read_cameras(file)[0]
    assert (frame.name, frame.size) == ("view.png", (30, 20))
    expected = octex.Camera.fitted(scene.surface.vertices, (0.4, 0.3, 1), size=(30, 20))
    np.testing.assert_array_equal(frame.camera().matrix, expected.matrix)
    cli.result(*arguments, "--size", "30,20", "--channel", "roughness", "--quiet")
    picture = np.array(Image.open(view))
    assert set(picture[picture[:, :, 3] == 128][:, :3].ravel().tolist()) == {51}
    assert "'normal'" in cli.refusal(*arguments, "--channel", "normal")


def test_without_a_texture_the_view_shows_the_form_in_grey(scene, tmp_path, cli):
    view = tmp_path / "view.png"
    given = [scene.model, VIEW, view, "--camera", f"{scene.cameras}#blue.png"]
    assert "without a texture the model is drawn grey" in cli.errors(*given)
    picture = np.array(Image.open(view)).reshape(-1, 4)
    seen = picture[picture[:, 3] == 255]
    assert (seen[:, :1] == seen[:, :3]).all()
    assert len(np.unique(seen[:, 0])) >= 3
    assert seen[:, 0].min() > 100


def test_a_view_has_no_lens_distortion(scene, tmp_path, cli):
    bent = replace(scene.camera, distortion=(-0.1, 0.01, 0.0, 0.0))
    octex.write_cameras(tmp_path / "bent.json", {"bent": bent})
    given = [scene.texture, scene.model, "--camera", tmp_path / "bent.json", VIEW, tmp_path / "a.png"]
    given += ["--camera-out", tmp_path / "straight.json"]
    assert "octex draw: the camera has lens distortion; the picture is drawn without it" in cli.errors(*given)
    frame = octex.read_cameras(tmp_path / "straight.json")[0]
    assert frame.name == "a.png"
    assert frame.camera().distortion == (0.0, 0.0, 0.0, 0.0)
    cli.result(scene.texture, scene.model, "--camera", scene.cameras, VIEW, tmp_path / "square.png")
    assert np.array_equal(Image.open(tmp_path / "a.png"), Image.open(tmp_path / "square.png"))


def test_a_view_needs_a_camera_that_can_be_found_again(scene, tmp_path, cli):
    view = [scene.texture, scene.model, VIEW, tmp_path / "view.png"]
    assert cli.refusal(*view) == (
        "--as paint without --camera needs --camera-out: only with its camera can you paint it back"
    )
    assert cli.refusal(*view, "--camera", scene.cameras) == (
        f"{scene.cameras}: there is no frame 'view.png'; there are: 'square.png', 'blue.png'"
    )
    message = cli.refusal(*view, "--camera", f"{scene.cameras}#blue.png", "--size", "7,9")
    assert message == (
        f"--size has another aspect ratio than frame 'blue.png' of {scene.cameras}, 40,40; leave --size out"
    )
    message = cli.refusal(*view, "--camera-out", tmp_path / "camera.txt")
    assert message.endswith("--camera-out has the ending '.txt'; octex writes .json here")
    assert list(tmp_path.iterdir()) == []


# --- an empty layer


@needs_jit
def test_an_empty_layer_beside_a_view_is_painted_back_as_it_is(scene, tmp_path, cli):
    view, layer, file = tmp_path / "view.png", tmp_path / "layer.png", tmp_path / "camera.json"
    look = [scene.texture, scene.model, VIEW, view, "--camera", f"{scene.cameras}#square.png"]
    said = cli.result(*look, "--empty-layer", layer, "--camera-out", file)
    assert said.splitlines()[1:] == [f"{layer}: an empty layer of its size", f"{file}: its camera"]
    picture = np.array(Image.open(layer))
    assert picture.shape == (SIZE, SIZE, 4)
    assert not picture.any()
    back = [scene.texture, scene.model, layer, "--camera", file, "--quiet", OUT]
    assert cli.run(*back, tmp_path / "none.octex") == ExitCode.NOTHING_PAINTED
    cli.said()
    # In the view's own colours: as a layer that is paint, and it is multiplied with what is there.
    place = np.s_[SQUARE[1] : SQUARE[3] + 1, SQUARE[0] : SQUARE[2] + 1]
    picture[place] = np.array(Image.open(view))[place]
    Image.fromarray(picture).save(layer)
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


# --- from where


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--camera c.json --direction 0,0,1", "--direction cannot be used with --camera; give one of them"),
        ("--camera c.json --up 0,0,1", "--up cannot be used with --camera; give one of them"),
        ("--camera-out c.json --direction 0,0,0", "--direction: must not be 0,0,0"),
        ("--camera-out c.json --exposure 1", "--exposure needs --light"),
        ("--camera-out c.json --bump alpha=1", "--bump needs --light"),
        (
            "--camera-out c.json --empty-layer v.png --force",
            "--empty-layer has the name of OUTPUT, v.png, but cameras are found by file name; "
            "give it another",
        ),
    ],
)
def test_where_a_picture_is_drawn_from_is_said_once(options, message, tmp_path, scene, cli):
    (tmp_path / "layer").mkdir()
    words = options.replace("c.json", str(tmp_path / "c.json")).replace("v.png", f"{tmp_path}/layer/v.png")
    view = [scene.texture, scene.model, VIEW, tmp_path / "v.png"]
    assert cli.refusal(*view, *words.split()).startswith(message)


def test_a_frame_that_is_not_there_is_refused_before_anything_is_read(tmp_path, cli, monkeypatch):
    document = {"asset": {"version": "2.0"}, "nodes": [{"camera": 0, "name": "front"}]}
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7}}]
    model = tmp_path / "scene.gltf"
    model.write_text(json.dumps(document))
    picture = tmp_path / "a.png"
    for name in ("load_surface", "open", "convert"):
        monkeypatch.setattr(octex, name, lambda *_, **__: pytest.fail("it was begun"))
    message = f"{model}: there is no frame 'back'; there are: 'front'"
    look = ["--camera", f"{model}#back"]
    assert cli.refusal(model, VIEW, picture, *look, "--camera-out", tmp_path / "c.json") == message
    assert octex_main(["draw", str(model), str(picture), *look]) == ExitCode.REFUSED
    assert cli.said()[1].endswith(f": error: {message}\n")


# --- only what was drawn


@needs_jit
def test_of_a_view_only_what_was_drawn_on_it_is_painted(scene, tmp_path, cli):
    view, file = tmp_path / "view.png", tmp_path / "camera.json"
    look = [scene.texture, scene.model, VIEW, view, "--camera-out", file, "--size", "64,64", "--quiet"]
    cli.result(*look)
    shot = [scene.texture, scene.model, view, "--camera", file, "--quiet", OUT]
    said = cli.errors(*shot, tmp_path / "none.octex", code=ExitCode.NOTHING_PAINTED)
    assert said.endswith(", or nothing was drawn on the view (--since nothing paints all of it)\n")
    before = tmp_path / "before.png"
    before.write_bytes(view.read_bytes())
    picture = np.array(Image.open(view))
    picture[28:36, 28:36, :3] = [255, 0, 0]
    Image.fromarray(picture).save(view)
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
def test_all_of_a_view_is_painted_on_request_and_on_a_new_texture(scene, tmp_path, cli):
    view, file = tmp_path / "view.png", tmp_path / "camera.json"
    cli.result(scene.texture, scene.model, VIEW, view, "--camera-out", file, "--size", "48,48")
    out = tmp_path / "whole.octex"
    cli.result(scene.texture, scene.model, view, "--camera", file, OUT, out, "--since", "nothing")
    assert octex.open(out).tree.n_leaves > octex.open(scene.texture).tree.n_leaves
    new = tmp_path / "new.octex"
    said = cli.result(scene.model, view, "--camera", file, OUT, new)
    assert said.startswith(f"{new}: 1 picture painted, ")


@needs_jit
def test_a_view_saved_as_jpeg_is_painted_with_a_word(scene, tmp_path, cli):
    view, file, lossy = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "view.jpg"
    cli.result(scene.texture, scene.model, VIEW, view, "--camera-out", file, "--size", "48,48")
    with Image.open(view) as picture:
        picture.convert("RGB").save(lossy, quality=70)
    shot = [scene.texture, scene.model, f"{lossy}={view.name}", "--camera", file]
    said = cli.errors(*shot, OUT, tmp_path / "out.octex")
    assert f"{lossy} is a JPEG: what compression changed is painted, too" in said


@needs_jit
def test_the_preview_of_a_disc_looks_at_the_disc(scene, tmp_path, cli):
    low, high = scene.surface.bounds
    at = (low + high) / 2
    at[1] = low[1]  # the bottom, which usual views do not show
    green, preview = tmp_path / "green.png", tmp_path / "preview.png"
    Image.new("RGB", (16, 16), (0, 255, 0)).save(green)
    disc = ",".join(f"{each:g}" for each in [*at, 0.3 * (high - low).min()])
    settings = ["--unwrap", disc, "--since", "nothing", "--preview", preview]
    cli.result(scene.texture, scene.model, green, *settings, OUT, tmp_path / "out.octex")
    with Image.open(preview) as picture:
        codes = np.asarray(picture.convert("RGB")).astype(int)
    assert (codes[..., 1] - codes[..., ::2].max(axis=2) > 100).mean() > 0.005


@needs_jit
def test_pictures_and_views_may_be_smaller_or_larger_than_their_cameras(scene, tmp_path, cli):
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
    with Image.open(view) as picture:
        picture.resize((2 * SIZE, 2 * SIZE)).save(view)
    back = [scene.texture, scene.model, view, "--camera", file, OUT, out]
    assert cli.refusal(*back).endswith(
        "so octex cannot tell which pixels you changed; scale the picture, or give --since nothing"
    )
    cli.result(*back, "--since", "nothing")


def test_a_view_in_a_camera_file_that_is_no_picture_is_refused(scene, tmp_path, cli):
    file = tmp_path / "camera.json"
    octex.write_cameras(file, {"blue.png": scene.camera}, {"blue.png": b"no picture"})
    shot = [scene.texture, scene.model, scene.blue, "--camera", file, OUT, tmp_path / "out.octex"]
    assert cli.refusal(*shot).startswith(f"the view in {file}")
    text = file.read_text()
    file.write_text(re.sub('"view": "', '"view": "é', text))
    assert "view is not an image in base64" in cli.refusal(*shot)
    with pytest.raises(octex.errors.ArgumentError, match="view 'other' must be the bytes of a PNG file"):
        octex.write_cameras(file, {"blue.png": scene.camera}, {"other": b""})


@needs_jit
def test_a_picture_may_name_its_frame(scene, tmp_path, cli):
    out, other = tmp_path / "out.octex", tmp_path / "other.octex"
    picture = tmp_path / "my=picture.png"
    picture.write_bytes(scene.square.read_bytes())
    shot = [scene.texture, scene.model, "--camera", scene.cameras, "--quiet", OUT]
    cli.result(*shot, out, f"{picture}=square.png")
    cli.result(*shot, other, scene.square)
    assert np.array_equal(octex.open(out).tree.arrays.flags, octex.open(other).tree.arrays.flags)
    refused = cli.refusal(*shot, tmp_path / "no.octex", f"{picture}=x.png")
    assert refused.startswith(f"{scene.cameras}: there is no frame 'x.png'; there are: ")


@needs_jit
def test_paint_that_more_than_doubles_a_texture_is_announced(scene, tmp_path, cli):
    arguments = [scene.texture, scene.model, scene.blue, "--camera", scene.cameras]
    assert cli.run(*arguments, OUT, tmp_path / "a.octex", "--max-depth", 7) == 0
    leaves = octex.open(scene.texture).tree.n_leaves
    assert f"leaves, the texture {leaves:,}; --max-depth 4 paints with" in cli.said()[1]
    assert "--max-depth" not in cli.errors(*arguments, OUT, tmp_path / "b.octex", "--max-depth", 4)


# --- usage


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "MODEL OUTPUT are missing; see octex paint --help"),
        ("m.glb", "OUTPUT is missing; see octex paint --help"),
        ("t.octex m.glb", "OUTPUT is missing; see octex paint --help"),
        ("t.octex m.glb o.octex", "--camera is missing; see octex paint --help"),
        ("t.octex m.glb o.octex a.png l.octex", "l.octex: is a layer; merge layers and paint pictures one"),
        *[
            (f"t.octex m.glb o.octex l.octex {words}", f"{words.split()[0]} cannot be used with layers")
            for words in (
                *("--balance full", "--camera c", "--mask m.png", "--channel alpha", "--layer-out x.octex"),
                "--max-depth 3",
            )
        ],
        *[
            (f"t.octex m.glb o.octex {words}", f"{words.split()[0]} is an option of octex draw, not of octex")
            for words in ("--size 3,3", "--camera-out c.json", "--zoom 2", "--empty-layer l.png")
        ],
        ("m.glb o.octex a.png --camera c --blend erase", "there is no TEXTURE; there is nothing to erase"),
        ("t.octex m.glb o.octex --blend burn", "--blend: 'burn' is not one of over, multiply, "),
        ("t.octex m.glb o.octex --opacity 2", "--opacity: 2 is not from 0 to 1; see octex paint --help"),
        ("t.octex m.glb o.octex --opacity x", "--opacity: 'x' is not a number; see octex paint --help"),
        ("t.octex m.glb o.octex --opacity nan", "--opacity: nan is not from 0 to 1"),
        ("t.octex m.glb o.octex --max-angle 181", "--max-angle: 181 is not from 0 to 180"),
        ("t.octex m.glb o.octex --max-angle=", "--max-angle: '' is not a number"),
        ("t.octex m.glb o.octex --edge-feather 1e7", "--edge-feather: 1e7 is not from 0 to 1000000"),
        ("m.glb o.octex --holes red", "--holes: 'red' is not R,G,B from 0 to 255, nor #rrggbb, nor leave or"),
        ("m.glb o.octex --holes 1,2", "--holes: '1,2' is not R,G,B from 0 to 255, nor"),
        ("m.glb o.octex --holes 1,2,256", "--holes: 1,2,256 is not from 0 to 255"),
        ("t.octex m.glb o.octex --camera c#", "--camera: 'c#' names no camera; write FILE#NAME, or FILE"),
        ("m.glb o.octex a.png --camera c --reference a.png", "--reference needs --balance"),
        ("m.glb o.octex a.png --camera c --mask 1,2,3 --mask #ffffff", "--mask gives several backdrop"),
        ("m.glb o.octex a.png --camera c --mask {stem}.png --mask a.png", "--mask gives a pattern and more"),
        ("t.octex m.glb o.octex --camera c --max-depth 22", "--max-depth: 22 is not from 0 to 21"),
        ("t.octex m.glb o.ply --camera c", "o.ply: OUTPUT has the ending '.ply'; octex writes .octex here"),
    ],
)
def test_bad_usage_is_refused_by_name(arguments, message, tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)
    assert cli.refusal(*arguments.split()).startswith(message)


@needs_jit
def test_holes_are_filled_or_left_and_coverage_is_kept_as_the_library_does(scene, tmp_path, cli):
    new = [*scene.shot[1:], OUT, tmp_path / "out.octex"]
    picture = octex.Projection(scene.square, scene.camera)
    for words, options in (
        (["--coverage"], {"coverage": True}),
        (["--holes", "leave", "--force"], {"holes": "leave"}),
    ):
        cli.result(*new, *words)
        made = octex.open(tmp_path / "out.octex")
        assert_painted(made, octex.paint(None, scene.surface, picture, **options))
    for holes in ("smooth", "0"):
        message = cli.refusal(*scene.shot, OUT, tmp_path / "b.octex", "--holes", holes)
        assert message == f"{scene.texture} has colours; --holes is for a new texture"


def test_a_layer_that_is_none_is_refused_by_name(scene, tmp_path, cli):
    arguments = [scene.texture, scene.model, OUT, tmp_path / "out.octex"]
    (tmp_path / "box.octex").write_bytes(scene.texture.read_bytes())
    assert cli.refusal(*arguments, tmp_path / "box.octex").startswith(f"{tmp_path / 'box.octex'}: ")
    assert "missing.octex" in cli.refusal(*arguments, tmp_path / "missing.octex")


def test_the_name_of_a_camera_comes_after_the_file(tmp_path):
    (tmp_path / "a#b.json").touch()
    plain = f"{tmp_path}/a#b.json"
    assert camera(plain) == (Path(plain), None)
    assert camera(f"{plain}#c#d") == (Path(plain), "c#d")
    assert camera("missing.json#a#b") == (Path("missing.json"), "a#b")
    assert camera("#a") == (Path("#a"), None)


def test_the_help_names_the_librarys_defaults():
    from octex.painting import options, paint, picture

    assert picture.BLENDS == BLENDS
    assert options.PICTURES == PICTURES
    assert options.BALANCES == BALANCES
    assert options.HOLES == HOLES
    text = " ".join(Parser("octex paint", COMMANDS["paint"], COMMANDS).help().split())
    defaults = {name: each.default for name, each in inspect.signature(paint.project).parameters.items()}
    assert defaults["channel"] == DEFAULT_CHANNEL
    assert (
        f"skip surface tilted more (default {options.TAKEN_ANGLE:g}; {options.DRAWN_ANGLE:g} for views)"
        in text
    )
    assert f"edges in depth (default {defaults['edge_feather']:g})" in text
    assert inspect.signature(paint.paint).parameters["max_depth"].default is None


# --- as a process


@needs_jit
def test_a_model_is_drawn_edited_and_painted_from_a_checkout(tmp_path, cli):
    droid, texture = ROOT / "samples" / "droid.glb", tmp_path / "droid.octex"
    octex.convert(droid, 7, channels=["base_color"]).save(texture)

    view, file, out = tmp_path / "view.png", tmp_path / "camera.json", tmp_path / "out.octex"
    cli.result(texture, droid, VIEW, view, "--camera-out", file, "--size", "256,256")
    picture = np.array(Image.open(view))
    row, column = 118, 128  # on the head
    picture[row - 9 : row + 10, column - 9 : column + 10, :3] = [255, 0, 0]
    Image.fromarray(picture).save(view)
    _, *words = painting(texture, droid, view, "--camera", file, OUT, out)
    call = [sys.executable, "tools/paint_projection.py", *words]
    said = subprocess.run(call, stdout=subprocess.PIPE, text=True, timeout=600, cwd=ROOT, check=True).stdout
    assert said.startswith(f"{out}: 1 picture painted, ")
    after = [out, droid, VIEW, tmp_path / "after.png", "--camera", f"{file}#view.png"]
    cli.result(*after)
    after = np.array(Image.open(tmp_path / "after.png"))
    assert np.array_equal(after[:, :, 3], picture[:, :, 3])
    seen = picture[:, :, 3] > 0
    moved = np.abs(after[:, :, :3].astype(int) - picture[:, :, :3]).max(axis=2)
    assert np.median(moved[seen]) <= 6
    patch = after[row - 5 : row + 6, column - 5 : column + 6]
    red, green, blue, _ = np.median(patch.reshape(-1, 4), axis=0)
    assert red > 240
    assert max(green, blue) < 20
