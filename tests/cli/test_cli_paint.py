"""Painting at the command line: images, their frames, masks and cameras, and what becomes of them."""

import hashlib
import inspect
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import octex
from octex import parallel
from octex.channels import decode
from octex.cli.options import COMMANDS, DEFAULT_CHANNEL
from octex.cli.parser import Parser
from octex.cli.values import BALANCES, BLENDS, HOLES, PICTURES, camera
from octex.errors import ExitCode
from octex.painting import image, paint
from octex.painting import surface as surfaces
from tests.conftest import needs_jit
from tests.make.command import OUT
from tests.make.same import assert_equal
from tests.make.scene import SIZE, assert_painted


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_textures_and_layers_whose_content_is_broken_are_refused(scene, tmp_path, cli):
    content = bytearray(scene.texture.read_bytes())
    flags = octex.open(scene.texture).tree.arrays.flags.tobytes()
    at = bytes(content).index(flags, 4096)
    content[at : at + len(flags)] = bytes(0xC0 for _ in flags)  # all split and kept, and facing nowhere
    broken, whole, out = (tmp_path / name for name in ("broken.octex", "box.octex", "out.octex"))
    broken.write_bytes(content)
    whole.write_bytes(scene.texture.read_bytes())
    shot = [broken, scene.model, *scene.shot[2:]]
    assert cli.refusal(*shot, OUT, out).startswith(f"{broken}: split table")
    for layer, said in ((broken, f"{broken}: split table"), (whole, f"{whole}: "), ("a.octex", "a.octex")):
        assert cli.refusal(scene.texture, scene.model, OUT, out, layer).startswith(said)
    assert not out.exists()


@needs_jit
def test_paint_is_where_the_camera_sees_it_and_nowhere_else(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    text = cli.result(*scene.shot, OUT, out)
    assert text.startswith(f"{out}: 1 image painted, {octex.open(out).tree.n_leaves:,} leaves, depth ")
    before, after = octex.open(scene.texture), octex.open(out)
    after.validate()
    points, inside = scene.places(1.5)
    assert inside.sum() > 10
    np.testing.assert_allclose(after.sample(points[inside]), [[1.0, 0.0, 0.0]] * inside.sum(), atol=0.02)
    points, near = scene.places(-8.0)  # cells beside the paint are as wide as some pixels
    np.testing.assert_allclose(after.sample(points[~near]), before.sample(points[~near]), atol=1e-5)


@needs_jit
def test_a_layer_kept_and_merged_later_is_the_same_paint(scene, tmp_path, cli):
    layer, *outs = (tmp_path / f"{name}.octex" for name in ("layer", "a", "b", "c"))
    kept = *scene.shot, OUT, outs[0], "--layer-out", layer, "--opacity", 0.5, "--quiet"
    assert cli.result(*kept) == ""
    merge = [scene.texture, scene.model, layer, "--opacity", 0.5]
    assert ": 1 layer painted, " in cli.result(*merge, OUT, outs[1])
    cli.result(*merge, layer, "--blend", "multiply", OUT, outs[2])
    found = [octex.open(out) for out in outs]
    texture = octex.open(scene.texture)
    image = octex.Projection(scene.square, scene.camera, opacity=0.5)
    painted = octex.paint(texture, scene.surface, image)
    for _ in range(2):
        texture = octex.merge(texture, octex.open(layer), scene.surface, opacity=0.5, blend="multiply")
    for one, other in zip(found, (painted, painted, texture), strict=True):
        assert_painted(one, other)
    told = json.loads(found[2].metadata["paint"])
    entry = {"image": "layer.octex", "sha256": digest(layer), "blend": "multiply", "opacity": 0.5}
    assert told == [{**entry, "channel": "base_color"}] * 2


@needs_jit
def test_an_archive_is_painted_on_and_with_force_the_texture_itself_is_replaced(scene, tmp_path, cli):
    texture, out = tmp_path / "box.octex", tmp_path / "out.octex"
    texture.write_bytes(scene.texture.read_bytes())
    opened = octex.open(texture)
    opened.save(texture.with_suffix(".octz"))
    archived = texture.with_suffix(".octz"), tmp_path / "archived.octex"
    for path, output in ((texture, out), archived, (texture, texture)):
        cli.result(path, scene.model, *scene.shot[2:], OUT, output, "--force")
        assert output.read_bytes() == out.read_bytes()
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
def test_erasing_takes_alpha_away_as_the_library_does(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    cli.result(*scene.shot, OUT, out, "--blend", "erase", "--opacity", 0.5, "--quiet")
    before, after = octex.open(scene.texture), octex.open(out)
    erased = octex.Projection(scene.square, scene.camera, opacity=0.5, blend="erase")
    assert_painted(after, octex.paint(before, scene.surface, erased))
    points, inside = scene.places(1.5)
    np.testing.assert_allclose(after.sample(points[inside], "alpha"), 0.5, atol=0.02)
    (told,) = json.loads(after.metadata["paint"])
    assert (told["blend"], told["opacity"]) == ("erase", 0.5)


@needs_jit
def test_a_machine_reads_one_object_and_the_texture_knows_what_was_painted(scene, tmp_path, cli):
    first, second = tmp_path / "first.octex", tmp_path / "second.octex"
    cli.result(*scene.shot, OUT, first, "--quiet")
    arguments = [first, scene.model, scene.square, scene.blue, "--camera", scene.cameras]
    made = cli.facts(*arguments, OUT, second, "--opacity", 0.5, "--quiet")
    texture = octex.open(second)
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
    usual = {"blend": "over", "channel": "base_color"}
    assert json.loads(texture.metadata["paint"]) == [
        {"image": path.name, "sha256": digest(path), "opacity": part, **usual}
        for path, part in ((scene.square, 1.0), (scene.square, 0.5), (scene.blue, 0.5))
    ]
    assert texture.metadata["convert"] == octex.open(scene.texture).metadata["convert"]


@needs_jit
def test_nothing_painted_writes_nothing_and_has_an_exit_code_of_its_own(scene, tmp_path, cli):
    turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ scene.camera.world_to_camera
    octex.write_cameras(tmp_path / "away.json", {"square.png": replace(scene.camera, world_to_camera=turned)})
    black, clear, out = (tmp_path / name for name in ("black.png", "clear.png", "out.octex"))
    Image.new("L", (SIZE, SIZE), 0).save(black)
    Image.new("RGBA", (SIZE, SIZE), (255, 0, 0, 0)).save(clear)
    files = sorted(tmp_path.iterdir())
    for words in (
        [*scene.shot[2:3], "--camera", tmp_path / "away.json", "--layer-out", tmp_path / "l.octex"],
        [*scene.shot[2:], "--mask", black],
        [clear, *scene.shot[3:]],
        [*scene.shot[2:], "--opacity", 0],
    ):
        for given in (scene.shot[:2], scene.shot[1:2]):
            assert cli.run(*given, *words, OUT, out, "--quiet") == ExitCode.NOTHING_PAINTED == 3
            told, said = cli.said()
            assert (told, said.count("\n")) == ("", 1)
            assert said.startswith(f"octex paint: nothing was painted, and {out} is not written: ")
    assert sorted(tmp_path.iterdir()) == files


@needs_jit
def test_a_texture_that_is_not_there_is_begun(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    assert "there is no texture yet: painting begins a new one" in cli.errors(*scene.shot[1:], OUT, out)
    made = octex.open(out)
    assert_painted(made, octex.paint(None, scene.surface, octex.Projection(scene.square, scene.camera)))
    assert made.metadata["source"] == "box.glb"
    assert set(made.metadata) == {"source", "sha256", "octex", "paint"}


@needs_jit
def test_a_new_texture_may_have_a_background(scene, tmp_path, cli):
    out, square = tmp_path / "out.octex", octex.Projection(scene.square, scene.camera)
    arguments = [*scene.shot[1:], OUT, out, "--force", "--quiet"]
    color = decode(np.array([0x20, 0x40, 0x60], np.uint8), "srgb")
    for words, channel, holes in (
        (["--holes", "#204060"], "base_color", color),
        (["--holes", "#204060", "--max-depth", 3], "base_color", color),
        (["--holes", "51"], "roughness", 0.2),
    ):
        cli.result(*arguments, *words, "--channel", channel)
        options = {"channel": channel, "holes": holes, "max_depth": 3 if "--max-depth" in words else None}
        assert_painted(octex.open(out), octex.paint(None, scene.surface, square, **options))
    for channel in "roughness", "normal":
        message = cli.refusal(*arguments, "--holes", "1,2,3", "--channel", channel)
        assert message.startswith(f"{channel!r} holds no colours, so '#010203' has no meaning")


@needs_jit
def test_the_options_of_painting_reach_the_library(scene, tmp_path, monkeypatch, cli):
    seen, painted_by = {}, paint.painted_by

    def painted(*arguments, **options):
        seen.update(asdict(arguments[3]), run=arguments[4])
        return painted_by(*arguments, **options)

    monkeypatch.setattr(paint, "painted_by", painted)
    more = "--max-depth 3 --max-angle 60,both --edge-feather 1.5 --balance gain --pictures average"
    more += f" --no-fit --threads 2 --memory 1kB --resume {tmp_path / 'kept'}"
    cli.result(*scene.shot, OUT, tmp_path / "out.octex", *more.split(), "--channel", "base_color")
    run = seen.pop("run")
    assert (run.memory, run.folder, run.resume) == (1000, tmp_path, tmp_path / "kept")
    assert None not in (run.executor, run.progress, run.folder)
    assert seen == {
        "channel": "base_color", "max_depth": 3, "max_angle": 60.0, "edge_feather": 1.5,
        "pictures": "average", "balance": "gain", "reference": None, "back_faces": True, "hidden": False,
        "fit": False, "region": None,
    }  # fmt: skip
    monkeypatch.setattr(parallel, "memory_size", lambda: 2000)  # by default, half of that
    cli.result(*scene.shot, OUT, tmp_path / "usual.octex")
    assert (seen["run"].memory, seen["run"].folder) == (1000, tmp_path)
    cli.result(*scene.shot, OUT, tmp_path / "hidden.octex", "--max-angle", "hidden")
    assert (seen["max_angle"], seen["back_faces"], seen["hidden"]) == (None, False, True)


@needs_jit
def test_a_preview_is_drawn_of_what_was_painted(scene, tmp_path, monkeypatch, cli):
    drawn, views, preview = [], [], tmp_path / "preview.png"

    def write_preview(_path, texture, surface, **view):
        drawn.append((surface and [form.name for form in surface.channels], list(texture.channels)))
        views.append(view)

    monkeypatch.setattr("octex.write_preview", write_preview)
    text = cli.result(*scene.shot, OUT, tmp_path / "a.octex", "--preview", preview)
    assert text.splitlines()[1] == f"{preview}: an image of it"
    new = *scene.shot[1:], "--preview", preview, "--channel", "occlusion"
    cli.result(*new, OUT, tmp_path / "b.octex")
    assert drawn == [(["base_color"], ["base_color"]), (None, ["occlusion"])]
    rows = -scene.camera.world_to_camera[:3, :3]
    np.testing.assert_allclose([views[0]["direction"], views[0]["up"]], [rows[2], rows[1]], atol=1e-9)


@needs_jit
@pytest.mark.usefixtures("small_previews")
def test_the_preview_of_a_disc_looks_at_the_disc(scene, tmp_path, cli):
    low, high = scene.surface.bounds
    at = (low + high) / 2
    at[1] = low[1]  # the bottom, which usual views do not show
    green, preview = tmp_path / "green.png", tmp_path / "preview.png"
    Image.new("RGB", (16, 16), (0, 255, 0)).save(green)
    disc = ",".join(f"{each:g}" for each in [*at, 0.3 * (high - low).min()])
    settings = ["--unwrap", disc, "--since", "nothing", "--preview", preview]
    cli.result(scene.texture, scene.model, green, *settings, OUT, tmp_path / "out.octex")
    with Image.open(preview) as image:
        codes = np.asarray(image.convert("RGB")).astype(int)
    assert (codes[..., 1] - codes[..., ::2].max(axis=2) > 100).mean() > 0.005


@needs_jit
def test_paint_that_more_than_doubles_a_texture_is_announced(scene, tmp_path, cli):
    arguments = [scene.texture, scene.model, scene.blue, "--camera", scene.cameras]
    assert cli.run(*arguments, OUT, tmp_path / "a.octex", "--max-depth", 7) == 0
    leaves = octex.open(scene.texture).tree.n_leaves
    assert f"leaves, the texture {leaves:,}; --max-depth 4 paints with" in cli.said()[1]
    assert "--max-depth" not in cli.errors(*arguments, OUT, tmp_path / "b.octex", "--max-depth", 4)


@needs_jit
def test_holes_are_filled_or_left_and_coverage_is_kept_as_the_library_does(scene, tmp_path, cli):
    square, out = octex.Projection(scene.square, scene.camera), tmp_path / "out.octex"
    for words, given in (
        (["--coverage"], {"coverage": True}),
        (["--holes", "leave"], {"holes": "leave"}),
    ):
        cli.result(*scene.shot[1:], OUT, out, *words, "--force")
        assert_painted(octex.open(out), octex.paint(None, scene.surface, square, **given))
    for holes in ("smooth", "0"):
        message = cli.refusal(*scene.shot, OUT, tmp_path / "b.octex", "--holes", holes)
        assert message == f"{scene.texture} has colours; --holes is for a new texture: leave it out"


def test_the_help_names_the_librarys_defaults():
    own = surfaces.PICTURES, surfaces.BALANCES, paint.FILLS, image.BLENDS
    assert own == (PICTURES, BALANCES, HOLES, BLENDS)
    text = " ".join(Parser("octex paint", COMMANDS["paint"], COMMANDS).help().split())
    defaults = {name: each.default for name, each in inspect.signature(paint.project).parameters.items()}
    assert defaults["channel"] == DEFAULT_CHANNEL
    angles = f"(default {surfaces.TAKEN_ANGLE:g}; {surfaces.DRAWN_ANGLE:g} for views)"
    assert f"skip surface tilted more {angles}" in text
    assert f"edges in depth (default {defaults['edge_feather']:g})" in text
    assert inspect.signature(paint.paint).parameters["max_depth"].default is None


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
