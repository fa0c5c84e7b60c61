"""Values from other models, points and functions, and parts with own textures, at the command line."""

import json
import re
import shutil
import sys

import numpy as np
import pytest

import octex
from octex.errors import ExitCode
from tests.conftest import needs_jit
from tests.make.command import run
from tests.make.fixtures import obj_lines, ply, ply_square
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A red square, the same without colours and twice as wide, and green points on it."""
    folder = tmp_path_factory.mktemp("sources")
    red = {name: ("uchar", [255 * (name == "red")] * 4) for name in ("red", "green", "blue")}
    ply(folder / "red.ply", ply_square(**red))
    wide = ply_square()
    wide["vertex"]["x"] = ("float", [2.0 * x for x in wide["vertex"]["x"][1]])
    ply(folder / "wide.ply", wide)
    points = np.random.default_rng(0).random((2000, 3)) * [1.0, 1.0, 0.0]
    np.savez(folder / "green.npz", points=points, colors=np.tile(np.uint8([0, 255, 0]), (2000, 1)))
    return folder


def colors(path):
    texture = octex.open(path)
    texture.validate()
    return texture.sample([[0.5, 0.5, 0.0]])[0]


@needs_jit
def test_another_models_colours_are_transferred(folder, tmp_path, cli):
    given = folder / "wide.ply", tmp_path / "out.octex", "--depth", 5, "--transfer", folder / "red.ply"
    said = cli.result(*given)
    assert np.allclose(colors(given[1]), [1, 0, 0]) and "empty" not in said
    limited = *given, "--within", 0.2, "--force"
    assert "stay empty" in cli.result(*limited)
    assert cli.facts(*limited, "--quiet")["empty"] > 0
    assert octex.open(given[1]).contains([[0.5, 0.5, 0.0], [1.9, 0.5, 0.0]]).tolist() == [True, False]


@needs_jit
def test_points_colour_a_model(folder, tmp_path, cli):
    given = folder / "wide.ply", tmp_path / "out.octex", "--depth", 5, "--transfer", folder / "green.npz"
    for within in ("", "mean:0.1", "0.1,90", "mean:0.1,90", "any,90"):
        cli.result(*given, "--force", *(["--within", within] if within else []))
        assert np.allclose(colors(given[1]), [0, 1, 0], atol=1e-3)


@needs_jit
@pytest.mark.usefixtures("small_previews")
def test_points_alone_become_a_texture(folder, tmp_path, cli):
    out = tmp_path / "out.octex"
    cli.result(folder / "green.npz", out, "--preview", tmp_path / "out.png")
    assert np.allclose(colors(out), [0, 1, 0], atol=1e-3) and (tmp_path / "out.png").exists()


_FUNCTIONS = """
import numpy as np

def red(points):
    return np.tile([1.0, 0.0, 0.0], (len(points), 1))

def ball(points):
    return np.linalg.norm(points, axis=1) - 1.0
"""


def test_functions_in_files_are_channels_and_surfaces(folder, tmp_path, cli):
    (tmp_path / "shapes.py").write_text(_FUNCTIONS)
    ball, out = f"{tmp_path / 'shapes.py'}:ball", tmp_path / "out.octex"
    red = ["--source", f"base_color={tmp_path / 'shapes.py'}:red", "--depth", 4, "--force"]
    where = "--grid=-1.1,-1.1,-1.1,1.1,1.1,1.1,0.2"
    cli.result(folder / "wide.ply", out, *red)
    assert np.allclose(colors(out), [1, 0, 0])
    cli.result(ball, out, *red, where)
    assert octex.open(out).contains([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]).tolist() == [True, False]
    cli.result(folder / "red.ply", out, "--depth", 5, "--also", ball, where, "--force")
    assert octex.open(out).contains([[0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]).all()


_DATACLASS = """
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from paints import GREEN

@dataclass
class Rings:
    color: tuple[float, ...] = GREEN

def rings(points):
    from paints_of_calls import BLUE

    return np.tile(np.add(Rings().color, BLUE), (len(points), 1))
"""


def test_functions_in_files_may_have_dataclasses_and_import_files_beside(folder, tmp_path, cli, monkeypatch):
    monkeypatch.setattr(sys, "path", sys.path.copy())
    (tmp_path / "wood.py").write_text(_DATACLASS)
    (tmp_path / "paints.py").write_text("GREEN = (0.0, 1.0, 0.0)")
    (tmp_path / "paints_of_calls.py").write_text("BLUE = (0.0, 0.0, 1.0)")
    out = tmp_path / "out.octex"
    rings = f"base_color={tmp_path / 'wood.py'}:rings"
    cli.result(folder / "wide.ply", out, "--depth", 4, "--source", rings)
    assert np.allclose(colors(out), [0, 1, 1])


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Two boxes, one in the other's corner, in two colours."""
    path = tmp_path_factory.mktemp("model") / "pair.obj"
    corners = [
        (low + side * CUBE, color) for low, side, color in ((0.0, 1.0, [1, 0, 0]), (0.6, 0.7, [0, 0, 1]))
    ]
    vertices = [np.hstack([points, np.tile(color, (8, 1))]) for points, color in corners]
    path.write_text(obj_lines(np.concatenate(vertices), np.concatenate([CUBE_TRIANGLES, CUBE_TRIANGLES + 8])))
    return path


@pytest.fixture(scope="module")
def made(model):
    folder = model.with_name("made")
    assert run(model, folder, "--parts", "--depth", "3", "--quiet") == ExitCode.DONE
    return folder


def test_parts_become_a_folder_of_textures(model, tmp_path, cli):
    folder, options = tmp_path / "out", ("--cell", 0.25, "--channels", "base_color", "--dtype", "uint16")
    given = model, folder, "--parts", "--no-fit", *options
    text = cli.result(*given, "--threads", 1)
    assert re.fullmatch(rf"{re.escape(str(folder))}: 2 parts, [\d,]+ leaves, [\d.]+ kB, [\d.]+ s\n", text)
    wanted = octex.convert_set(model, cell=0.25, channels=["base_color"], dtype="uint16", fit=False)
    assert octex.TextureSet.open(folder).info() == wanted.info()
    told = cli.facts(*given, "--force")
    assert told.pop("seconds") >= 0
    leaves = sum(texture.tree.n_leaves for texture in wanted.values())
    size = wanted.info()["bytes"]
    assert told == {"output": str(folder), "parts": 2, "leaves": leaves, "bytes": size}
    assert len(list(folder.iterdir())) == 3


def test_info_lists_parts_cells_and_bytes(made, cli):
    found = octex.TextureSet.open(made)
    assert json.loads(cli.result("info", made, "--json")) == found.info()
    lines = cli.result("info", made).splitlines()
    assert lines[0].split() == ["part", "depth", "finest", "cell", "leaves", "nodes", "bytes"]
    for line, (name, part) in zip(lines[1:3], found.info()["parts"].items(), strict=True):
        words = line.replace(",", "").split()
        assert words[:2] == [name, "3"]
        assert float(words[2]) == pytest.approx(part["finest_cell"], rel=1e-5)
        assert [int(word) for word in words[3:]] == [part["leaves"], part["nodes"], part["bytes"]["total"]]
    assert lines[3].split()[0] == "all"
    assert int(lines[3].replace(",", "").split()[-1]) == found.info()["bytes"]
    assert len(lines) == 4


def test_validate_proves_all_parts_or_names_what_is_broken(made, tmp_path, cli):
    assert cli.result("validate", made) == "valid\n"
    shutil.copytree(made, tmp_path / "copy")
    path = tmp_path / "copy" / "part-1.octex"
    damaged = bytearray(path.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    path.write_bytes(damaged)
    assert cli.run("validate", tmp_path / "copy") == ExitCode.INVALID
    assert cli.said()[0].startswith("part 'part-1': ")
    path.unlink()
    assert cli.run("validate", tmp_path / "copy", "--json") == ExitCode.INVALID
    assert "the file of part 'part-1' is missing" in json.loads(cli.said()[0])["broken"]


def test_what_cannot_be_written_is_refused_before_any_work(model, tmp_path, cli, monkeypatch):
    monkeypatch.setattr(octex, "load_surface", None)
    for ending in ("octex", "octz", "ply", "npz"):
        said = cli.refusal(model, tmp_path / f"a.{ending}", "--parts")
        assert said.endswith("--parts writes a folder; give OUTPUT no ending")
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "cannot be written" in cli.refusal(model, tmp_path / "new", "--parts")


def test_lookups_by_part_do_not_bleed(model, made):
    surface = octex.load_surface(model)
    samples = surface.scatter(500)
    found = octex.TextureSet.open(made).sample(samples.rest, surface.parts[samples.triangles])
    assert np.abs(found - surface.evaluate(samples)).max() < 0.02
