"""Conversions at the command line."""

import json
import os
import re

import numpy as np
import pytest

import octex
from octex.cli.common import bytes_text
from octex.cli.options import COMMANDS
from octex.cli.parser import Parser
from tests.make.fixtures import png, random_image, textured_square


def test_a_model_becomes_an_octree_texture(model, made, tmp_path, cli):
    out = tmp_path / "box.octex"
    summary = cli.result(model, out, "--depth", 4)
    assert out.read_bytes() == made.read_bytes()
    texture = octex.open(out)
    cells = rf"{texture.tree.n_leaves:,} leaves, depth 4 \(cells of [\d.]+\)"
    size = bytes_text(out.stat().st_size)
    assert re.fullmatch(rf"{re.escape(str(out))}: {cells}, {re.escape(size)}, [\d.]+ s\n", summary)


def test_stages_are_told_on_stderr(model, tmp_path, cli):
    said = cli.errors(model, tmp_path / "box.octex", "--depth", 3)
    lines = [line for line in said.splitlines() if "compiling" not in line]
    assert lines
    assert all(re.fullmatch(r"octree-convert: \w+: done in \d+\.\d s", line) for line in lines)
    assert [lines[0].split()[1], lines[-1].split()[1]] == ["read:", "write:"]


def test_a_machine_reads_one_json_object_and_quiet_is_silent(model, tmp_path, cli):
    out = tmp_path / "box.octex"
    assert cli.run(model, out, "--depth", "3", "--json", "--quiet") == 0
    told, said = cli.said()
    assert said == ""
    made = json.loads(told)
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


def test_only_a_texture_is_made_in_files(model, tmp_path, cli):
    refused = cli.refusal(model, tmp_path / "b.ply", "--memory", "9kB")
    assert refused.endswith("b.ply: a texture is converted to NAME.octex")


def test_a_rest_mesh_places_the_texture(model, tmp_path, cli):
    import trimesh

    posed = trimesh.load(model, force="mesh")
    posed.apply_scale(3)
    posed.export(tmp_path / "posed.glb")
    out = tmp_path / "box.octex"
    cli.result(tmp_path / "posed.glb", out, "--rest", model, "--depth", 3)
    np.testing.assert_allclose(octex.open(out).bounds, octex.load_surface(model).bounds)
    trimesh.creation.icosahedron().export(tmp_path / "other.glb")
    assert "other.glb" in cli.refusal(model, tmp_path / "x.octex", "--rest", tmp_path / "other.glb")
    assert not (tmp_path / "x.octex").exists()


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
        level = octex.open(made).level(depth)
        np.testing.assert_array_equal(
            texture.channels["base_color"].values, level.channels["base_color"].values
        )
    cli.result("edit", made, tmp_path / "coarse.ply", "--depth", 2)
    assert cli.refusal("edit", made, tmp_path / "x.octex", "--depth", 5) == (
        f"{made}: has depth 4; --depth 5 needs the model"
    )
    assert cli.refusal(made, tmp_path / "x.octex") == (
        f"{made}: is an octree texture already; octex edit makes it coarser or smaller"
    )
    for option in (
        ["--cell", "0.1"],
        ["--rest", str(made.with_suffix(".glb"))],
        ["--source", "alpha=1"],
        ["--filter", "trilinear"],
        ["--depth", "2"],
        ["--max-error", "2"],
        ["--detail", "stretch"],
        ["--no-fit"],
    ):
        assert cli.refusal(made, tmp_path / "x.octex", *option) == (
            f"{made}: {option[0]} needs the model, but this is a texture made from it; see octex edit"
        )
    assert not (tmp_path / "x.octex").exists()


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


@pytest.fixture(scope="module")
def mask(square):
    """White on the left, a quarter on the right."""
    image = np.full((32, 32, 1), 255, np.uint8)
    image[:, 16:] = 64
    square.with_name("mask.png").write_bytes(png(image))
    return square.with_name("mask.png")


def test_a_painted_channel_steers_and_is_stored_if_it_is_named(square, mask, tmp_path, cli):
    words = ["--detail", "detail", "--source", f"detail={mask}", "--depth", 5]
    cli.result(square, tmp_path / "a.octex", *words, "--channels", "base_color")
    found = octex.open(tmp_path / "a.octex")
    assert list(found.channels) == ["base_color"]
    (fine, _), (coarse, _) = found.tree.cells_by_depth()[5], found.tree.cells_by_depth()[3]
    assert fine > 0
    assert coarse > 0
    cli.result(square, tmp_path / "b.octex", *words)
    both = octex.open(tmp_path / "b.octex")
    assert set(both.channels) == {"base_color", "metallic", "roughness", "detail"}
    assert both.tree.n_leaves == found.tree.n_leaves


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--detail wear", "unknown detail 'wear'; there are: base_color, metallic, roughness, stretch"),
        (
            "--detail base_color",
            "--detail must be a channel with one component in 0 … 1, and 'base_color' is not",
        ),
        *[
            (
                f"--channels base_color --detail stretch --source {name}=1",
                f"--source gives {name}, but --channels leaves it out",
            )
            for name in ("alpha", "stretch")
        ],
    ],
)
def test_what_cannot_steer_is_refused(words, message, square, tmp_path, cli):
    assert cli.refusal(square, tmp_path / "x.octex", "--depth", 3, *words.split()) == message


def test_a_channel_that_the_model_lacks_is_refused_with_those_it_has(square, made, tmp_path, cli):
    out = tmp_path / "out.octex"
    for arguments in (["--channels", "normal"], ["--dtype", "normal=uint16"]):
        message = cli.refusal(square, out, "--depth", 3, *arguments)
        assert "normal" in message
        assert "base_color" in message
    message = cli.refusal("edit", made, out, "--channels", "normal")
    assert message == f"unknown channel of {made}: 'normal'; there are: base_color"
    assert not out.exists()


def test_channels_can_come_from_elsewhere(square, tmp_path, cli):
    image = tmp_path / "rough.png"
    image.write_bytes(png(np.full((2, 2, 1), 51, np.uint8)))
    out = tmp_path / "out.octex"
    arguments = [
        "--source", f"roughness={image}", "--source", "base_color=1,0.5,0", "--source", "metallic=0.2",
        "--source", f"height={image}",
    ]  # fmt: skip
    cli.result(square, out, "--depth", 3, *arguments)
    texture = octex.open(out)
    values = texture.sample([[0.4, 0.6, 0.0]], ["base_color", "roughness", "metallic", "height"])
    assert values["roughness"][0] == values["height"][0] == pytest.approx(0.2)
    assert values["metallic"][0] == pytest.approx(0.2)
    assert values["base_color"][0] == pytest.approx([1.0, 0.5, 0.0], abs=0.01)
    assert "rough.png" in texture.metadata["source_roughness"]
    # Of the model, only its shape.
    cli.result(square, out, "--depth", 3, "--channels", "alpha", "--source", "alpha=0.5", "--force")
    assert list(octex.open(out).channels) == ["alpha"]
    assert "missing.png" in cli.refusal(
        square, tmp_path / "x.octex", "--source", f"alpha={tmp_path / 'missing.png'}"
    )
    assert "--preview is also an input" in cli.refusal(
        square, tmp_path / "x.octex", "--preview", image, "--source", f"alpha={image}", "--force"
    )


def test_a_texture_can_be_reduced_to_some_channels(square, tmp_path, cli):
    whole, part = tmp_path / "whole.octex", tmp_path / "part.octex"
    cli.result(square, whole, "--depth", 3)
    cli.result("edit", whole, part, "--channels", "roughness,base_color")
    texture = octex.open(part)
    texture.validate()
    assert list(texture.channels) == ["roughness", "base_color"]
    cast = {"operation": "cast", "channels": {"roughness": "uint8", "base_color": "uint8"}}
    assert texture.metadata == {**octex.open(whole).metadata, "processed": json.dumps([cast])}
    np.testing.assert_array_equal(
        texture.channels["roughness"].values, octex.open(whole).channels["roughness"].values
    )


def test_the_preview_shows_what_was_converted(square, tmp_path, cli, monkeypatch):
    shown = []
    monkeypatch.setattr(
        "octex.write_preview",
        lambda _path, _texture, surface: shown.append([form.name for form in surface.channels]),
    )
    arguments = ["--channels", "roughness,alpha", "--source", "alpha=0.5", "--rest", square]
    cli.result(square, tmp_path / "a.octex", "--depth", 2, *arguments, "--preview", tmp_path / "a.png")
    assert shown == [["alpha", "roughness"]]


# --- previews


def test_a_preview_is_drawn_of_models_and_of_textures(model, made, tmp_path, cli, monkeypatch):
    drawn = []

    def write_preview(path, texture, surface):
        drawn.append((path.name, surface is not None))
        assert texture.tree.max_depth == (3 if surface is not None else 4)

    monkeypatch.setattr("octex.write_preview", write_preview)
    out = cli.result(model, tmp_path / "a.octex", "--depth", 3, "--preview", tmp_path / "a.png")
    assert out.splitlines()[1] == f"{tmp_path / 'a.png'}: a picture of it"
    out = cli.result(made, tmp_path / "b.ply", "--preview", tmp_path / "b.png", "--json")
    assert json.loads(out)["preview"] == str(tmp_path / "b.png")
    assert drawn == [("a.png", True), ("b.png", False)]
    assert "writes .png here" in cli.refusal(model, tmp_path / "c.octex", "--preview", tmp_path / "c.gif")
    (tmp_path / "a.png").touch()
    assert "--force" in cli.refusal(model, tmp_path / "c.octex", "--preview", tmp_path / "a.png")


def test_the_help_names_the_librarys_default_depth():
    from octex.conversion.convert import DEFAULT_DEPTH

    assert f"(default {DEFAULT_DEPTH})" in " ".join(
        Parser("octex convert", COMMANDS["convert"], COMMANDS).help().split()
    )


# --- bad input: one line, nothing written


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.glb", None),
        ("empty.glb", b""),
        ("broken.gltf", b"{"),
        ("words.txt", b"words"),
        ("folder.glb", None),
        ("missing.octex", None),
        ("empty.octex", b""),
        ("words.octex", b"words and words and words"),
    ],
)
def test_bad_input_is_refused_by_name_and_nothing_is_written(name, content, tmp_path, cli):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.glb").mkdir()
    before = sorted(tmp_path.iterdir())
    assert name in cli.refused(tmp_path / name, tmp_path / "out.ply")
    assert sorted(tmp_path.iterdir()) == before


def test_a_depth_out_of_range_is_refused_before_any_work(tmp_path, cli):
    for depth in (-1, 22):
        expected = f"--depth: {depth} is not from 0 to 21; see octree-convert --help"
        assert cli.refusal(tmp_path / "missing.glb", tmp_path / "out.octex", "--depth", depth) == expected


def test_nothing_is_overwritten_without_force(model, tmp_path, cli):
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")
    assert cli.refusal(model, out, "--depth", 3) == f"{out}: exists already; --force overwrites it"
    assert out.read_bytes() == b"old"
    cli.result(model, out, "--depth", 3, "--force")
    octex.open(out).validate()


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "octree-convert: interrupted"),
        (MemoryError(), 2, "octree-convert: error: out of memory; a smaller depth needs less"),
        (RuntimeError("odd"), 70, "octree-convert: this is a defect of octex: RuntimeError: odd; run with"),
    ],
)
def test_whatever_happens_while_writing_the_old_file_stays(
    error, code, line, model, tmp_path, cli, monkeypatch
):
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")

    def fail(_descriptor):
        raise error

    monkeypatch.setattr(os, "fsync", fail)
    said = cli.errors(model, out, "--depth", 3, "--force", code=code)
    assert said.splitlines()[-1].startswith(line)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]
