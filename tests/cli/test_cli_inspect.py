"""A look at textures and their differences at the command line."""

import json
import re
from functools import partial

import numpy as np
import pytest
from PIL import Image

import octex
from octex.cli.inspect import number
from octex.drawing import draw_difference
from octex.drawing.compare import difference
from octex.errors import ExitCode
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.command import colored_box
from tests.make.fixtures import ply, ply_square


def test_info_is_text_for_people_and_json_for_machines(made, cli):
    texture = octex.open(made)
    assert json.loads(cli.result("info", made, "--json")) == texture.info()
    text = cli.result("info", made)
    assert re.search(r"^depth +4, finest cells of edge [\d.]+$", text, re.MULTILINE)
    assert re.search(rf"^ +all +{texture.tree.n_leaves:,} +{texture.tree.n_nodes:,}$", text, re.MULTILINE)
    assert re.search(r"^channels +base_color  3 x uint8    srgb$", text, re.MULTILINE)
    assert re.search(rf"^total +{made.stat().st_size:,} ", text, re.MULTILINE)
    assert re.search(r"^source +box\.glb$", text, re.MULTILINE)


def test_validate_proves_a_texture_or_names_what_is_broken(made, tmp_path, cli):
    assert cli.result("validate", made) == "valid\n"
    assert cli.result("validate", made, "--quiet") == ""
    assert cli.facts("validate", made) == {"file": str(made), "valid": True, "broken": None}
    damaged = bytearray(made.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    for name, content in (("damaged.octex", damaged), ("short.octex", made.read_bytes()[:5000])):
        (tmp_path / name).write_bytes(content)
        for words in ([], ["--json"], ["--quiet"]):
            assert cli.run("validate", tmp_path / name, *words) == ExitCode.INVALID
            told, said = cli.said()
            assert (told.count("\n"), said) == (words != ["--quiet"], "")
            if words == ["--json"]:
                assert not json.loads(told)["valid"]
                told = json.loads(told)["broken"]
            assert words == ["--quiet"] or name in told


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
    for text in ("base_color", "sRGB, 1/255", f"{row.rms:.3f}"[:3], f"{row.psnr:.2f} dB"):
        assert text in lines[5]
    assert len(lines) == 6


def test_the_same_texture_twice_is_exact(folder, cli):
    same = "diff", folder / "4.octex", folder / "4.octex"
    assert " 0  exact " in cli.result(*same)
    found = cli.facts(*same)["channels"]["base_color"]
    assert (found["psnr"], found["rms"]) == (None, 0)


def test_quiet_leaves_out_progress_but_not_the_numbers(folder, cli):
    arguments = "diff", folder / "4.octex", folder / "3.octex"
    assert cli.run(*arguments) == 0
    loud, said = cli.said()
    stages = [line.split(":")[1] for line in said.splitlines() if "compiling" not in line]
    assert stages == [" read", " compare"]
    cli.run(*arguments, "--quiet")
    assert cli.said() == (loud, "")
    cli.run("overlaps", folder / "box.glb", "--quiet")
    text, errors = cli.said()
    assert (str(folder / "box.glb") in text, errors) == (True, "")


def test_a_texture_and_its_model_are_compared_at_points(folder, cli):
    model, texture = folder / "box.glb", folder / "4.octex"
    given = "diff", texture, model, "--points", 5000
    lines = cli.result(*given).splitlines()
    assert lines[1] == f"B  {model}: a model of 12 triangles"
    cell = octex.open(texture).placement.size / 16
    assert lines[2] == f"at 5,000 points, uniform by area, both averaged over {cell:.4g}"
    found = difference(octex.open(texture), octex.load_surface(model), points=5000)["base_color"]
    report = cli.facts(*given)
    assert (report["b"], report["points"], report["width"]) == (str(model), 5000, cell)
    told = report["channels"]["base_color"]
    assert (told["rms"], told["where"]) == (found.rms, list(found.where))
    assert report["uncovered"] == {"a": None, "b": 0.0}


def test_what_cannot_be_compared_is_named(folder, cli):
    given = "diff", folder / "half.octex", folder / "4.octex"
    lines = cli.result(*given).splitlines()
    assert "only A has the channel roughness" in lines
    assert any(line.endswith("% of B's surface is not in A; it is left out") for line in lines)
    assert any(line.startswith("A has an area of ") for line in lines)
    assert cli.facts(*given)["unmatched"] == {"a": ["roughness"], "b": []}
    message = cli.refusal(*given, "--channels", "roughness")
    assert message == "unknown channel in both 'roughness'; there are: base_color"


def test_a_model_is_completed_as_for_a_conversion(folder, cli):
    words = ["--source", "roughness=0.5", "--channels", "roughness", "--points", "2000"]
    report = cli.facts("diff", folder / "half.octex", folder / "box.glb", *words)
    assert list(report["channels"]) == ["roughness"]
    assert report["channels"]["roughness"]["maximum"] < 1 / 255
    assert 0.2 < report["uncovered"]["b"] < 0.6


def test_directions_have_a_row_for_the_angle(tmp_path, cli):
    corners, uv = [[0, 0, 0], [1, 0, 0], [1, 1, 0.3]], np.eye(3)[:, :2]
    surface = Surface.from_arrays(corners, [[0, 1, 2]], uv=uv)
    image = np.full((4, 4, 3), [128, 128, 255], np.uint8)
    given = ["diff"]
    for name, red in (("a", 128), ("b", 200)):
        image[:2, :, 0] = red
        given.append(tmp_path / f"{name}.octex")
        octex.convert(surface.with_sources({"normal": image}), 2).save(given[-1])
    lines = cli.result(*given, "--channels", "normal").splitlines()
    assert lines[5].split()[:2] == ["normal", "components"]
    assert lines[6].split()[0] == "degrees"
    angle = cli.facts(*given)["channels"]["normal"]["angle"]
    assert angle["measure"] == "degrees"
    assert "angle" not in angle


@pytest.fixture
def one_sample(monkeypatch):
    """Draw differences with one sample a pixel."""
    monkeypatch.setattr("octex.drawing.draw_difference", partial(draw_difference, supersample=1))


@pytest.mark.usefixtures("one_sample")
def test_an_image_is_drawn_and_named(folder, tmp_path, cli):
    path = tmp_path / "diff.png"
    again = ["draw", folder / "4.octex", folder / "3.octex", path, "--as", "difference", "--size", "90,40"]
    assert cli.result(*again).startswith(f"{path}: 90×40 pixels, ")
    drawn = path.read_bytes()
    with Image.open(path) as image:
        assert image.size == (90, 40)
    for words, same in (([], True), (["--direction", "-1,0.2,-1", "--zoom", "2"], False)):
        assert cli.result(*again, "--force", "--quiet", *words) == ""
        assert (path.read_bytes() == drawn) == same


@needs_jit
@pytest.mark.usefixtures("one_sample")
def test_light_is_compared_and_drawn_times_alpha_also_if_colours_alone_are_asked_for(tmp_path, cli):
    texture, path = tmp_path / "clear.octex", tmp_path / "diff.png"
    codes = {"red": [255, 0, 0, 255], "green": [0, 255, 0, 255], "blue": [0, 0, 255, 255]}
    colors = {name: ("uchar", each) for name, each in codes.items()}
    clear = ply(tmp_path / "clear.ply", ply_square(**colors, alpha=("uchar", [0, 255, 255, 0])))
    opaque = ply(tmp_path / "opaque.ply", ply_square(**colors))
    octex.convert(clear, 4).save(texture)
    assert "alpha" in octex.open(texture).channels
    whole = cli.facts("diff", texture, clear, "--points", 2000)["channels"]
    draw = ["--as", "difference", "--size", "300,110", "--force", "--quiet", "--channel", "base_color"]
    for model, most in ((clear, 2), (opaque, 12)):  # colours that the texture weighs by alpha
        cli.result("draw", texture, model, path, *draw)
        found = cli.facts("diff", texture, model, "--points", 2000, "--channels", "base_color")["channels"]
        assert list(found) == ["base_color"]
        assert model == opaque or found["base_color"] == whole["base_color"]
        left, right, _ = np.split(np.array(Image.open(path)).astype(int)[:75], 3, axis=1)
        assert np.abs(left - right).mean() < most


def test_numbers_are_short():
    assert [*map(number, (0.0, 0.5, 1 / 3, 12.345, -0.25))] == ["0", "0.5", "0.3333", "12.3", "-0.25"]
