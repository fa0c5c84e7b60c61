"""Painting at the command line."""

import hashlib
import inspect
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

import octex
from octex.cli.options import COMMANDS, DEFAULT_CHANNEL
from octex.cli.parser import Parser
from octex.cli.values import BALANCES, BLENDS, HOLES, PICTURES
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import OUT, Painting
from tests.make.same import assert_equal
from tests.make.scene import SIZE, assert_painted


@pytest.fixture
def cli(capsys):
    """Runs octex paint, or octex draw for a view to paint on."""
    return Painting(capsys)


# --- painting


def test_textures_and_layers_whose_content_is_broken_are_refused(scene, tmp_path, cli):
    content = bytearray(scene.texture.read_bytes())
    flags = octex.open(scene.texture).tree.arrays.flags.tobytes()
    at = bytes(content).index(flags, 4096)
    content[at : at + len(flags)] = bytes(0xC0 for _ in flags)  # all split and kept, and facing nowhere
    broken, out = tmp_path / "broken.octex", tmp_path / "out.octex"
    broken.write_bytes(content)
    shot = [broken, scene.model, *scene.shot[2:]]
    assert cli.refusal(*shot, OUT, out).startswith(f"{broken}: split table")
    whole = tmp_path / "box.octex"
    whole.write_bytes(scene.texture.read_bytes())
    given = [scene.texture, scene.model, OUT, out]
    for layer, said in (
        (broken, f"{broken}: split table"),
        (whole, f"{whole}: "),
        ("none.octex", "none.octex"),
    ):
        assert cli.refusal(*given, layer).startswith(said)
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
    given = [*arguments, "--force", "--holes", "1,2,3", "--channel"]
    for channel in "roughness", "normal":
        assert f"{channel!r} holds no colours, so '#010203' has no meaning" in cli.refusal(*given, channel)


@needs_jit
def test_the_options_of_painting_reach_the_library(scene, tmp_path, monkeypatch, cli):
    from octex.painting import paint as module

    seen, paint = {}, module.painted_layers

    def painted(*arguments, **options):
        seen.update(asdict(arguments[3]), run=arguments[4])
        return paint(*arguments, **options)

    monkeypatch.setattr(module, "painted_layers", painted)
    more = "--max-depth 3 --max-angle 60,both --edge-feather 1.5 --balance gain --pictures average"
    more += f" --no-fit --threads 2 --memory 1kB --resume {tmp_path / 'kept'}"
    cli.result(*scene.shot, OUT, tmp_path / "out.octex", *more.split(), "--channel", "base_color")
    run = seen.pop("run")
    assert (run.memory, run.folder, run.resume) == (1000, tmp_path, tmp_path / "kept")
    assert run.executor is not None
    assert run.progress is not None
    assert seen == {
        "channel": "base_color", "max_depth": 3, "max_angle": 60.0, "edge_feather": 1.5,
        "pictures": "average", "balance": "gain", "reference": None, "back_faces": True, "hidden": False,
        "fit": False, "region": None,
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


def test_the_help_names_the_librarys_defaults():
    from octex.painting import options, paint, picture

    assert picture.BLENDS == BLENDS
    assert options.PICTURES == PICTURES
    assert options.BALANCES == BALANCES
    assert options.FILLS == HOLES
    text = " ".join(Parser("octex paint", COMMANDS["paint"], COMMANDS).help().split())
    defaults = {name: each.default for name, each in inspect.signature(paint.project).parameters.items()}
    assert defaults["channel"] == DEFAULT_CHANNEL
    assert (
        f"skip surface tilted more (default {options.TAKEN_ANGLE:g}; {options.DRAWN_ANGLE:g} for views)"
        in text
    )
    assert f"edges in depth (default {defaults['edge_feather']:g})" in text
    assert inspect.signature(paint.paint).parameters["max_depth"].default is None
