"""Conversions and octex edit at the command line."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh

import octex
from octex.cli.common import bytes_text
from octex.cli.options import COMMANDS
from octex.cli.parser import Parser
from octex.cli.values import AXES, PROJECTIONS
from octex.errors import ModelError
from octex.source.mapped import FRAMES, KINDS, MappedImage
from tests.conftest import needs_jit
from tests.make.command import run
from tests.make.fixtures import obj_lines, png, random_image, textured_square
from tests.make.same import assert_same
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


def test_a_model_becomes_an_octree_texture_and_stages_are_told_on_stderr(model, made, tmp_path, cli):
    out = tmp_path / "box.octex"
    assert cli.run(model, out, "--depth", 4) == 0
    summary, said = cli.said()
    assert out.read_bytes() == made.read_bytes()
    cells = rf"{octex.open(out).tree.n_leaves:,} leaves, depth 4 \(cells of [\d.]+\)"
    size = bytes_text(out.stat().st_size)
    assert re.fullmatch(rf"{re.escape(str(out))}: {cells}, {re.escape(size)}, [\d.]+ s\n", summary)
    lines = [line for line in said.splitlines() if "compiling" not in line]
    assert all(re.fullmatch(r"octree-convert: \w+: done in \d+\.\d s", line) for line in lines)
    assert [lines[0].split()[1], lines[-1].split()[1]] == ["read:", "write:"]


def test_a_machine_reads_one_json_object_and_quiet_is_silent(model, tmp_path, cli):
    out = tmp_path / "box.octex"
    made = cli.facts(model, out, "--depth", "3", "--quiet")
    texture = octex.open(out)
    assert made.pop("seconds") > 0
    assert made == {
        "output": str(out),
        "leaves": texture.tree.n_leaves,
        "nodes": texture.tree.n_nodes,
        "depth": 3,
        "cell": texture.placement.size / 8,
        "bytes": out.stat().st_size,
    }
    assert cli.run(model, out, "--depth", "3", "--quiet", "--force") == 0
    assert cli.said() == ("", "")


def test_a_rest_mesh_places_the_texture(model, tmp_path, cli):
    posed, out = tmp_path / "posed.glb", tmp_path / "box.octex"
    trimesh.load(model, force="mesh").apply_scale(3).export(posed)
    cli.result(posed, out, "--rest", model, "--depth", 3)
    np.testing.assert_allclose(octex.open(out).bounds, octex.load_surface(model).bounds)


def test_points_are_the_same_from_the_model_and_from_its_texture(model, made, tmp_path, cli):
    out = cli.result(model, tmp_path / "a.ply", "--depth", 4)
    cli.result(made, tmp_path / "b.PLY")
    assert f"{octex.open(made).tree.n_leaves:,} leaves" in out
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.PLY").read_bytes()


def test_a_texture_can_be_made_coarser_but_not_finer(made, tmp_path, cli):
    out = tmp_path / "coarse.octex"
    for depth in (0, 2):
        cli.result("edit", made, out, "--depth", depth, "--force")
        texture = octex.open(out)
        texture.validate()
        assert texture.tree.max_depth == depth
        np.testing.assert_array_equal(texture.rows(), octex.open(made).level(depth).rows())
    cli.result("edit", made, tmp_path / "coarse.ply", "--depth", 2)
    options = f"--cell=0.1 --rest={made.with_suffix('.glb')} --source=alpha=1 --filter=trilinear --depth=2"
    for option in f"{options} --max-error=2 --detail=stretch --no-fit".split():
        assert cli.refusal(made, tmp_path / "x.octex", option) == (
            f"{made}: {option.split('=')[0]} needs the model, but this is a texture made from it; "
            "see octex edit"
        )


# --- channels


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A textured square with metallic and roughness."""
    path = tmp_path_factory.mktemp("square") / "square.glb"
    return textured_square(path, png(random_image(8, 8)), pbr={"metallicFactor": 0.4, "roughnessFactor": 0.6})


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("", {}),
        ("--threads 1", {}),
        ("--threads 3", {}),
        ("--memory 9kB", {}),
        ("--cell 0.25", {"depth": None, "cell": 0.25}),
        ("--channels roughness,base_color", {"channels": ["roughness", "base_color"]}),
        ("--dtype uint16", {"dtype": "uint16"}),
        ("--dtype roughness=float16", {"dtype": {"roughness": "float16"}}),
        ("--max-error 2", {"max_error": 2}),
        ("--no-fit", {"fit": False}),
        ("--filter nearest", {"filter": "nearest"}),
        ("--detail stretch --rest {square}", {"detail": "stretch"}),
    ],
)
def test_the_texture_is_what_the_library_makes(words, options, square, tmp_path, cli):
    wanted = {"depth": 4, "rest": square if "--rest" in words else None, **options}
    depth = [] if wanted["depth"] is None else ["--depth", wanted["depth"]]
    cli.result(square, tmp_path / "a.octex", *depth, *words.format(square=square).split())
    octex.convert(square, **wanted).save(tmp_path / "b.octex")
    assert (tmp_path / "a.octex").read_bytes() == (tmp_path / "b.octex").read_bytes()


def test_a_painted_channel_steers_and_is_stored_if_it_is_named(square, tmp_path, cli):
    image = np.full((32, 32, 1), 255, np.uint8)
    image[:, 16:] = 64
    (tmp_path / "mask.png").write_bytes(png(image))
    words = ["--detail", "detail", "--source", f"detail={tmp_path / 'mask.png'}", "--depth", 5]
    cli.result(square, tmp_path / "a.octex", *words, "--channels", "base_color")
    found = octex.open(tmp_path / "a.octex")
    assert list(found.channels) == ["base_color"]
    leaves = [each for each, _ in found.tree.cells_by_depth()]
    assert min(leaves[3], leaves[5]) > 0
    cli.result(square, tmp_path / "b.octex", *words)
    both = octex.open(tmp_path / "b.octex")
    assert set(both.channels) == {"base_color", "metallic", "roughness", "detail"}
    assert both.tree.n_leaves == found.tree.n_leaves


def test_channels_can_come_from_elsewhere(square, tmp_path, cli):
    image, out = tmp_path / "rough.png", tmp_path / "out.octex"
    image.write_bytes(png(np.full((2, 2, 1), 51, np.uint8)))
    sources = f"roughness={image}", "base_color=1,0.5,0", "metallic=0.2", f"height={image}"
    cli.result(square, out, "--depth", 3, *(f"--source={each}" for each in sources))
    texture = octex.open(out)
    values = texture.sample([[0.4, 0.6, 0.0]], ["base_color", "roughness", "metallic", "height"])
    assert values["roughness"][0] == values["height"][0] == pytest.approx(0.2)
    assert values["metallic"][0] == pytest.approx(0.2)
    assert values["base_color"][0] == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    assert "rough.png" in texture.metadata["source_roughness"]
    # Of the model, only its shape.
    cli.result(square, out, "--depth", 3, "--channels", "alpha", "--source", "alpha=0.5", "--force")
    assert list(octex.open(out).channels) == ["alpha"]
    for name, said in (("missing.png", "missing.png"), ("rough.png", "--preview is also an input")):
        words = ["--source", f"alpha={tmp_path / name}", "--preview", image, "--force"]
        assert said in cli.refusal(square, tmp_path / "x.octex", *words)


def test_a_texture_can_be_reduced_to_some_channels(square, tmp_path, cli):
    paths = [tmp_path / name for name in ("whole.octex", "part.octex")]
    cli.result(square, paths[0], "--depth", 3)
    cli.result("edit", *paths, "--channels", "roughness,base_color")
    whole, part = map(octex.open, paths)
    part.validate()
    assert list(part.channels) == ["roughness", "base_color"]
    cast = {"operation": "cast", "channels": {"roughness": "uint8", "base_color": "uint8"}}
    assert part.metadata == {**whole.metadata, "processed": json.dumps([cast])}
    np.testing.assert_array_equal(part.rows("roughness"), whole.rows("roughness"))


def test_a_preview_is_drawn_of_models_and_of_textures(square, made, tmp_path, cli, monkeypatch):
    drawn, path = [], tmp_path / "a.png"

    def write_preview(path, texture, surface):
        shown = surface and [form.name for form in surface.channels]
        drawn.append((path.name, texture.tree.max_depth, shown))

    monkeypatch.setattr("octex.write_preview", write_preview)
    words = ["--channels", "roughness,alpha", "--source", "alpha=0.5", "--rest", square, "--depth", 2]
    out = cli.result(square, tmp_path / "a.octex", *words, "--preview", path)
    assert out.splitlines()[1] == f"{path}: an image of it"
    assert cli.facts(made, tmp_path / "b.ply", "--preview", path)["preview"] == str(path)
    assert drawn == [("a.png", 2, ["alpha", "roughness"]), ("a.png", 4, None)]


def test_the_help_names_the_librarys_default_depth():
    from octex.conversion.convert import DEFAULT_DEPTH

    assert f"(default {DEFAULT_DEPTH})" in " ".join(
        Parser("octex convert", COMMANDS["convert"], COMMANDS).help().split()
    )


@pytest.fixture(scope="module")
def other(made):
    path = made.with_name("other.octex")
    octex.map(octex.open(made), lambda values: 1 - values).save(path)
    return path


@needs_jit
def test_every_option_is_the_operation_of_that_name(made, other, tmp_path, cli):
    texture, second, out = octex.open(made), octex.open(other), tmp_path / "out.octex"
    low, high = texture.bounds
    middle = (low + high) / 2
    box = ",".join(repr(float(each)) for each in [*low, *middle])
    for words, wanted in (
        (f"--crop={box}", octex.crop(texture, low, middle)),
        ("--depth 3", octex.resize(texture, 3)),
        (f"--combine {other}", octex.combine(texture, second)),
        (f"--mix {other}=0.3", octex.mix(texture, second, 0.3)),
        ("--blur 0.2", octex.blur(texture, 0.2)),
        ("--levels 0.1,0.9,1.5", octex.levels(texture, "base_color", 0.1, 0.9, 1.5)),
        ("--levels 0.1,0.9", octex.levels(texture, "base_color", 0.1, 0.9)),
        ("--dtype base_color=uint16 --threads 1", octex.cast(texture, "uint16")),
    ):
        cli.result("edit", made, out, *words.split(), "--force")
        found = octex.open(out)
        found.validate()
        assert_same(found, wanted)


def test_options_work_in_one_order_however_they_are_given(made, other, tmp_path, cli):
    out = tmp_path / "all.octex"
    words = ["--dtype", "float16", "--levels", "0,0.9", "--blur", "0.1", "--mix", f"{other}=0.5"]
    cli.result("edit", made, out, *words, "--depth", 3)
    done = json.loads(octex.open(out).metadata["processed"])
    assert [each["operation"] for each in done] == ["resize", "mix", "blur", "levels", "cast"]
    cli.result("edit", made, out.with_suffix(".ply"), *words, "--depth", 3)
    cli.result(out, tmp_path / "same.ply")
    assert (tmp_path / "same.ply").read_bytes() == out.with_suffix(".ply").read_bytes()


def test_a_coarser_depth_leaves_larger_leaves_as_they_are(model, tmp_path, cli):
    adaptive, out = tmp_path / "adaptive.octex", tmp_path / "out.octex"
    texture = octex.convert(model, 4, detail=lambda points: np.where(points[:, 0] > 0, 4, 2))
    texture.save(adaptive)
    assert texture.tree.cells_by_depth()[2][0]
    for depth in (4, 3):
        cli.result("edit", adaptive, out, "--depth", depth, "--force")
        assert octex.open(out).tree.cells_by_depth() == texture.level(depth).tree.cells_by_depth()


@needs_jit
def test_images_are_projected_at_the_command_line(tmp_path):
    model, image, out = (tmp_path / name for name in ("cube.obj", "wood.png", "cube.octex"))
    model.write_text(obj_lines(CUBE, CUBE_TRIANGLES))
    image.write_bytes(png(random_image(8, 8)))
    words = [model, out, "--depth", "4", "--quiet", "--source", f"base_color={image}"]
    words += ["--project", "box:axis=-y:center=-1,0,0.5:size=0.5"]
    assert run(*words, "--source", "roughness=0.5") == 0
    mapped = MappedImage(image, "box", axis="-y", center=(-1, 0, 0.5), size=0.5)
    expected = octex.convert(octex.load_surface(model, sources={"base_color": mapped, "roughness": 0.5}), 4)
    expected.save(model.with_name("expected.octex"))
    assert out.read_bytes() == model.with_name("expected.octex").read_bytes()


def test_the_help_lists_the_mappings_of_the_library():
    assert PROJECTIONS == KINDS
    assert tuple(FRAMES) == AXES


@pytest.fixture
def messy(tmp_path):
    """A box around another, a copy of a triangle, a sliver, and a triangle to nowhere."""
    outer, inner = trimesh.creation.box(), trimesh.creation.box((0.5, 0.5, 0.5))
    points = [*outer.vertices.tolist(), *inner.vertices.tolist(), ["nan", 0, 0]]
    whole = [*outer.faces.tolist(), *(inner.faces + 8).tolist()]
    faces = [*whole, whole[3], [0, 1, 1], [0, 1, 16]]
    path = tmp_path / "messy.obj"
    path.write_text(obj_lines(points, faces))
    return path


COUNTS = {"not_finite": 1, "degenerate": 1, "duplicate": 1, "inner": 12, "moved": 0}


def test_convert_and_bake_tell_what_they_left_out(messy, tmp_path, cli):
    made, baked, words = tmp_path / "a.octex", tmp_path / "a.glb", ["--depth", 3, "--repair"]
    assert "repair the model" in cli.refusal(messy, made, "--quiet")
    assert cli.facts(messy, made, *words, "--quiet")["repair"] == COUNTS
    texture = octex.open(made)
    box = octex.Surface.from_arrays(trimesh.creation.box().vertices, trimesh.creation.box().faces)
    assert texture.tree.n_leaves == octex.convert(box, 3).tree.n_leaves
    assert json.loads(texture.metadata["repair"]) == COUNTS
    told = cli.result("bake", made, messy, baked, "--repair", "--texture-size", 64)
    left_out = "repair: left out triangles: 1 not finite, 1 without area, 1 duplicate, 12 inner"
    assert left_out in told.splitlines()
    assert len(octex.load_surface(baked).triangles) == 12
    assert "12 inner" in cli.result(messy, tmp_path / "parts", *words, "--parts")


@pytest.mark.parametrize("ending", ["obj", "ply", "off", "stl", "glb"])
def test_triangles_that_are_not_finite_are_left_out_of_every_format(tmp_path, ending):
    mesh = trimesh.creation.box()
    points = np.concatenate([mesh.vertices, [[-77.25, 0, 0]]])
    faces = np.concatenate([mesh.faces, [[0, 1, 8]], [[2, 8, 3]]])
    path = tmp_path / f"a.{ending}"
    trimesh.Trimesh(points, faces, process=False).export(path)
    data = path.read_bytes().replace(struct.pack("<f", -77.25), struct.pack("<f", np.inf))
    path.write_bytes(re.sub(rb"-77\.250*\b", b"inf", data) if ending in ("obj", "off") else data)
    with pytest.raises(ModelError, match="finite"):
        octex.load_surface(path)
    surface = octex.load_surface(path, finite=True)
    assert surface.provenance["not_finite"] == "2"
    assert len(surface.triangles) == 12
    np.testing.assert_allclose(surface.bounds, [[-0.5] * 3, [0.5] * 3])
    assert octex.repair(surface)[1] == (2, 0, 0, 0, 0)
