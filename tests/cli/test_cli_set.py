"""Parts with textures of their own at the command line."""

import json
import re

import numpy as np
import pytest

import octex
from octex.errors import ExitCode
from octex.formats.ply import write_points
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
    folder = tmp_path / "out"
    options = ("--parts", "--cell", 0.25, "--channels", "base_color", "--dtype", "uint16", "--no-fit")
    text = cli.result(model, folder, *options, "--threads", 1)
    assert re.fullmatch(rf"{re.escape(str(folder))}: 2 parts, [\d,]+ leaves, [\d.]+ kB, [\d.]+ s\n", text)
    found = octex.TextureSet.open(folder)
    wanted = octex.convert_set(model, cell=0.25, channels=["base_color"], dtype="uint16", fit=False)
    assert found.info() == wanted.info()
    told = json.loads(cli.result(model, folder, *options, "--force", "--json"))
    assert told.pop("seconds") >= 0
    assert told == {
        "output": str(folder),
        "parts": 2,
        "leaves": sum(texture.tree.n_leaves for texture in wanted.values()),
        "bytes": wanted.info()["bytes"],
    }
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
    octex.TextureSet.open(made).save(tmp_path / "copy")
    path = tmp_path / "copy" / "part-1.octex"
    damaged = bytearray(path.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    path.write_bytes(damaged)
    assert cli.run("validate", tmp_path / "copy") == ExitCode.INVALID
    assert cli.said()[0].startswith("part 'part-1': ")
    path.unlink()
    assert cli.run("validate", tmp_path / "copy", "--json") == ExitCode.INVALID
    assert "the file of part 'part-1' is missing" in json.loads(cli.said()[0])["broken"]
    assert "set.json: No such file" in cli.refusal("validate", tmp_path)
    assert "is not the folder of a texture set" in cli.refusal("info", tmp_path)


def test_what_cannot_be_written_is_refused_before_any_work(model, made, tmp_path, cli, monkeypatch):
    monkeypatch.setattr(octex, "load_surface", None)
    (tmp_path / "file").write_text("mine")
    before = sorted(made.iterdir())
    cases = [
        (made, "holds a texture set already; --force replaces it"),
        (tmp_path / "file", "is a file; --parts writes a folder, give OUTPUT another name"),
        *(
            (tmp_path / f"a.{ending}", "--parts writes a folder; give OUTPUT no ending")
            for ending in ("octex", "octz", "ply", "npz")
        ),
        (tmp_path / "no" / "folder", "there is no folder"),
    ]
    for folder, message in cases:
        assert message in cli.refusal(model, folder, "--parts")
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "cannot be written" in cli.refusal(model, tmp_path / "new", "--parts")
    assert sorted(made.iterdir()) == before


def test_options_that_do_not_go_with_parts_are_refused(model, made, tmp_path, cli):
    out = tmp_path / "out"
    for words in (("--separate", "3"), ("--preview", "a.png"), ("--memory", "1GB")):
        message = cli.refusal(model, out, "--parts", *words)
        assert f"{words[0]} cannot be used with --parts" in message
    texture = made / "part-0.octex"
    assert "--parts needs the model, but this is a texture" in cli.refusal(texture, out, "--parts")
    write_points(octex.open(texture), tmp_path / "dots.ply")
    assert "--parts needs a surface" in cli.refusal(tmp_path / "dots.ply", out, "--parts")
    assert "--depth: 22 is not from 0 to 21" in cli.refusal(model, out, "--parts", "--depth", 22)
    message = cli.refusal(model, out, "--parts", "--crop", "0,0,0,1,1,1")
    assert message.startswith("--crop is an option of octex edit, not of octree-convert")
    assert not out.exists()


def test_lookups_by_part_do_not_bleed(model, made):
    surface = octex.load_surface(model)
    samples = surface.scatter(500)
    found = octex.TextureSet.open(made).sample(samples.rest, surface.parts[samples.triangles])
    assert np.abs(found - surface.evaluate(samples)).max() < 0.02
