"""Parts with textures of their own at the command line."""

import json
import re
import shutil

import numpy as np
import pytest

import octex
from octex.errors import ExitCode
from tests.make.command import run
from tests.make.fixtures import obj_lines
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


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
