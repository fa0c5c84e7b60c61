"""Painting at the command line."""

import hashlib
import inspect
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

import octex
from octex import parallel
from octex.channels import decode
from octex.cli.options import COMMANDS, DEFAULT_CHANNEL
from octex.cli.parser import Parser
from octex.cli.values import BALANCES, BLENDS, HOLES, PICTURES
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
def test_erasing_takes_alpha_away(scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    cli.result(*scene.shot, OUT, out, "--blend", "erase", "--opacity", 0.5, "--quiet")
    before, after = octex.open(scene.texture), octex.open(out)
    after.validate()
    assert (list(before.channels), list(after.channels)) == (["base_color"], ["base_color", "alpha"])
    points, inside = scene.places(1.5)
    np.testing.assert_allclose(after.sample(points[inside], "alpha"), 0.5, atol=0.02)
    points, near = scene.places(-8.0)
    away = scene.surface.scatter(1000)
    hidden = away.rest[away.normals[:, 2] < -0.5]
    for unpainted in (points[~near], hidden):
        np.testing.assert_allclose(after.sample(unpainted, "alpha"), 1.0, atol=1e-6)
    np.testing.assert_allclose(after.sample(hidden), before.sample(hidden), atol=1e-5)
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
    made.validate()
    image = octex.Projection(scene.square, scene.camera)
    assert_painted(made, octex.paint(None, scene.surface, image))
    points, inside = scene.places(1.5)
    np.testing.assert_allclose(made.sample(points[inside]), [[1.0, 0.0, 0.0]] * inside.sum(), atol=0.02)
    assert made.metadata["source"] == "box.glb"
    assert set(made.metadata) == {"source", "sha256", "octex", "paint"}


@needs_jit
@pytest.mark.parametrize("depth", [[], ["--max-depth", 3]])
def test_a_new_texture_may_have_a_background(depth, scene, tmp_path, cli):
    out = tmp_path / "out.octex"
    arguments = [*scene.shot[1:], OUT, out, *depth, "--force", "--quiet"]
    cli.result(*arguments, "--holes", "#204060")
    made = octex.open(out)
    made.validate()
    assert not depth or made.tree.max_depth == 3
    away = scene.surface.scatter(2000)
    hidden = away.rest[away.normals[:, 2] < -0.5]
    color = decode(np.array([0x20, 0x40, 0x60], np.uint8), "srgb")
    np.testing.assert_allclose(made.sample(hidden), np.tile(color, (len(hidden), 1)), atol=1e-3)
    cli.result(*arguments, "--channel", "roughness", "--holes", "51")
    assert octex.open(out).sample(hidden, "roughness") == pytest.approx(0.2, abs=1e-3)
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
