"""Differences at the command line."""

import json
from functools import partial

import numpy as np
import pytest
from PIL import Image

import octex
from octex.cli.inspect import number
from octex.drawing import draw_difference
from octex.drawing.compare import difference
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.command import colored_box
from tests.make.fixtures import ply, ply_square


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box, its textures of depths 4 and 3, and one of another half box with roughness."""
    folder = tmp_path_factory.mktemp("diff")
    model = colored_box(folder)
    for depth in (3, 4):
        octex.convert(model, depth).save(folder / f"{depth}.octex")
    surface = octex.load_surface(model)
    half = Surface(surface.vertices, surface.triangles[:6], surface.source, name="half")
    octex.convert(half.with_sources({"roughness": 0.5}), 4).save(folder / "half.octex")
    return folder


def test_two_textures_are_compared_in_a_table(folder, cli):
    first, second = folder / "4.octex", folder / "3.octex"
    lines = cli.result("diff", first, second).splitlines()
    a, b = octex.open(first), octex.open(second)
    found = difference(a, b)
    assert lines[0] == f"A  {first}: an octree texture of depth 4, {a.tree.n_leaves:,} leaves"
    assert lines[1] == f"B  {second}: an octree texture of depth 3, {b.tree.n_leaves:,} leaves"
    assert lines[2] == f"at the centres of {found.points:,} leaves, those of both, by area"
    header = "channel measure rms PSNR p99 maximum where A there B there"
    assert " ".join(lines[4].split()) == header
    row = found["base_color"]
    for text in ("base_color", "sRGB codes", f"{row.rms:.3f}"[:3], f"{row.psnr:.2f} dB"):
        assert text in lines[5]
    assert len(lines) == 6


def test_the_same_texture_twice_is_exact(folder, cli):
    same = folder / "4.octex", folder / "4.octex"
    assert " 0  exact " in cli.result("diff", *same)
    found = json.loads(cli.result("diff", *same, "--json"))["channels"]["base_color"]
    assert (found["psnr"], found["rms"]) == (None, 0)


def test_quiet_leaves_out_progress_but_not_the_numbers(folder, cli):
    arguments = "diff", folder / "4.octex", folder / "3.octex"
    loud = cli.result(*arguments)
    cli.run(*arguments, "--quiet")
    assert cli.said() == (loud, "")
    cli.run("overlaps", folder / "box.glb", "--quiet")
    text, errors = cli.said()
    assert (str(folder / "box.glb") in text, errors) == (True, "")


def test_a_texture_and_its_model_are_compared_at_points(folder, cli):
    model, texture = folder / "box.glb", folder / "4.octex"
    lines = cli.result("diff", texture, model, "--points", 5000).splitlines()
    assert lines[1] == f"B  {model}: a model of 12 triangles"
    cell = octex.open(texture).placement.size / 16
    assert lines[2] == f"at 5,000 points, uniform by area, both averaged over {cell:.4g}"
    found = difference(octex.open(texture), octex.load_surface(model), points=5000)
    report = json.loads(cli.result("diff", texture, model, "--points", 5000, "--json"))
    assert report["b"] == str(model)
    assert report["points"] == 5000
    assert report["width"] == cell
    assert report["channels"]["base_color"]["rms"] == found["base_color"].rms
    assert report["channels"]["base_color"]["where"] == list(found["base_color"].where)
    assert report["uncovered"] == {"a": None, "b": 0.0}


def test_what_cannot_be_compared_is_named(folder, cli):
    lines = cli.result("diff", folder / "half.octex", folder / "4.octex").splitlines()
    assert "only A has the channel roughness" in lines
    assert any(line.endswith("% of B's surface is not in A; it is left out") for line in lines)
    assert any(line.startswith("A has an area of ") for line in lines)
    report = json.loads(cli.result("diff", folder / "half.octex", folder / "4.octex", "--json"))
    assert report["unmatched"] == {"a": ["roughness"], "b": []}
    message = cli.refusal("diff", folder / "half.octex", folder / "4.octex", "--channels", "roughness")
    assert message == "unknown channel in both 'roughness'; there are: base_color"


def test_a_model_is_completed_as_for_a_conversion(folder, cli):
    arguments = ["--source", "roughness=0.5", "--channels", "roughness", "--points", "2000", "--json"]
    report = json.loads(cli.result("diff", folder / "half.octex", folder / "box.glb", *arguments))
    assert list(report["channels"]) == ["roughness"]
    assert report["channels"]["roughness"]["maximum"] < 1 / 255
    assert 0.2 < report["uncovered"]["b"] < 0.6


def test_directions_have_a_row_for_the_angle(tmp_path, cli):
    surface = Surface.from_arrays(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.3]]), np.array([[0, 1, 2]]), uv=np.eye(3)[:, :2]
    )
    image = np.full((4, 4, 3), 128, np.uint8)
    image[..., 2] = 255
    octex.convert(surface.with_sources({"normal": image}), 2).save(tmp_path / "a.octex")
    image[:2, :, 0] = 200
    octex.convert(surface.with_sources({"normal": image}), 2).save(tmp_path / "b.octex")
    lines = cli.result(
        "diff", tmp_path / "a.octex", tmp_path / "b.octex", "--channels", "normal"
    ).splitlines()
    assert lines[5].split()[:2] == ["normal", "components"]
    assert lines[6].split()[0] == "degrees"
    report = json.loads(cli.result("diff", tmp_path / "a.octex", tmp_path / "b.octex", "--json"))
    assert report["channels"]["normal"]["angle"]["measure"] == "degrees"
    assert "angle" not in report["channels"]["normal"]["angle"]


def test_a_picture_is_drawn_and_named(folder, tmp_path, cli, monkeypatch):
    small = partial(draw_difference, supersample=1)
    monkeypatch.setattr("octex.drawing.draw_difference", small)
    path = tmp_path / "diff.png"
    words = ["--as", "difference", "--size", "90,40"]
    again = ["draw", folder / "4.octex", folder / "3.octex", path, *words]
    assert cli.result(*again).startswith(f"{path}: 90×40 pixels, ")
    with Image.open(path) as picture:
        assert picture.size == (90, 40)
    assert cli.refusal(*again) == f"{path}: exists already; --force overwrites it"
    drawn = path.read_bytes()
    assert cli.result(*again, "--force", "--quiet") == ""
    assert path.read_bytes() == drawn
    assert cli.result(*again, "--force", "--quiet", "--direction", "-1,0.2,-1", "--zoom", "2") == ""
    assert path.read_bytes() != drawn
    assert cli.refusal(*again[:3], tmp_path / "a.gif", *words).endswith("octex writes .png here")


@needs_jit
def test_light_is_compared_and_drawn_times_alpha_also_if_colours_alone_are_asked_for(
    tmp_path, cli, monkeypatch
):
    texture, path = tmp_path / "clear.octex", tmp_path / "diff.png"
    codes = {"red": [255, 0, 0, 255], "green": [0, 255, 0, 255], "blue": [0, 0, 255, 255]}
    colors = {name: ("uchar", each) for name, each in codes.items()}
    model = ply(tmp_path / "clear.ply", ply_square(**colors, alpha=("uchar", [0, 255, 255, 0])))
    octex.convert(model, 4).save(texture)
    assert "alpha" in octex.open(texture).channels
    small = partial(draw_difference, supersample=1)
    monkeypatch.setattr("octex.drawing.draw_difference", small)
    few = ["diff", texture, model, "--points", 2000]
    drawn = ["draw", texture, model, path, "--as", "difference", "--size", "300,110", "--force", "--quiet"]
    drawn += ["--channel", "base_color"]
    whole = json.loads(cli.result(*few, "--json"))["channels"]
    shown = ["--channels", "base_color"]
    cli.result(*drawn)
    assert json.loads(cli.result(*few, *shown, "--json"))["channels"] == {"base_color": whole["base_color"]}
    left, right, _ = np.split(np.array(Image.open(path)).astype(int)[:75], 3, axis=1)
    assert np.abs(left - right).mean() < 2
    # an opaque model beside a texture with alpha
    few[2] = drawn[2] = ply(tmp_path / "opaque.ply", ply_square(**colors))
    cli.result(*drawn)
    assert list(json.loads(cli.result(*few, *shown, "--json"))["channels"]) == ["base_color"]
    left, right, _ = np.split(np.array(Image.open(path)).astype(int)[:75], 3, axis=1)
    assert np.abs(left - right).mean() < 12  # colours that the texture weighs by alpha


def test_progress_goes_to_stderr(folder, cli):
    said = cli.errors("diff", folder / "4.octex", folder / "3.octex")
    lines = [line for line in said.splitlines() if "compiling" not in line]
    assert [line.split(":")[1] for line in lines] == [" read", " compare"]


def test_missing_files_are_named(folder, cli):
    for name in ("missing.octex", "missing.glb"):
        assert name in cli.refusal("diff", folder / "4.octex", folder / name)


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (0.5, "0.5"), (1 / 3, "0.3333"), (12.345, "12.3"), (-0.25, "-0.25")]
)
def test_numbers_are_short(value, text):
    assert number(value) == text


def test_a_texture_that_is_broken_inside_is_refused(folder, tmp_path, cli):
    data = bytearray((folder / "4.octex").read_bytes())
    data[4096] ^= 0xFF  # the masks of the first nodes follow the header
    broken = tmp_path / "broken.octex"
    broken.write_bytes(data)
    assert "broken.octex: " in cli.refusal("diff", broken, folder / "4.octex", "--quiet")
