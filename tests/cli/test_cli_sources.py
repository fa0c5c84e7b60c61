"""Values from other models and from points, at the command line."""

import json
import sys

import numpy as np
import pytest

import octex
from tests.conftest import needs_jit
from tests.make.fixtures import ply, ply_square


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
    out = tmp_path / "out.octex"
    said = cli.result(folder / "wide.ply", out, "--depth", 5, "--transfer", folder / "red.ply")
    assert np.allclose(colors(out), [1, 0, 0]) and "empty" not in said
    limited = ["--depth", 5, "--transfer", folder / "red.ply", "--within", 0.2, "--force"]
    said = cli.result(folder / "wide.ply", out, *limited)
    assert "stay empty" in said
    made = json.loads(cli.result(folder / "wide.ply", out, *limited, "--json", "--quiet"))
    assert made["empty"] > 0
    assert octex.open(out).contains([[0.5, 0.5, 0.0], [1.9, 0.5, 0.0]]).tolist() == [True, False]


@needs_jit
def test_points_colour_a_model(folder, tmp_path, cli):
    out = tmp_path / "out.octex"
    for options in (
        [],
        ["--within", "mean:0.1"],
        ["--within", "0.1,90"],
        ["--within", "mean:0.1,90"],
        ["--within", "any,90"],
    ):
        given = ["--depth", 5, "--transfer", folder / "green.npz", "--force", *options]
        cli.result(folder / "wide.ply", out, *given)
        assert np.allclose(colors(out), [0, 1, 0], atol=1e-3)


@needs_jit
def test_points_alone_become_a_texture(folder, tmp_path, cli):
    out = tmp_path / "out.octex"
    cli.result(folder / "green.npz", out, "--preview", tmp_path / "out.png")
    assert np.allclose(colors(out), [0, 1, 0], atol=1e-3) and (tmp_path / "out.png").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["wide.ply", "--within", "mean:1"], "--within needs --transfer"),
        (["wide.ply", "--within", "1"], "--within needs --transfer"),
        (["wide.ply", "--within", "1,181"], "--within: 181 is not from 0 to 180"),
        (
            ["wide.ply", "--transfer", "green.npz", "--within", "mean:0"],
            "0 is not a finite number above zero",
        ),
        (["green.npz", "--max-error", "2"], "--max-error needs a surface"),
        (["green.npz", "--transfer", "red.ply"], "--transfer needs a surface"),
        (["wide.ply", "--transfer", "none.ply"], "none.ply cannot be read"),
        (["wide.ply", "--transfer", "red.obj", "--within", "mean:1"], "not a point cloud that octex reads"),
    ],
)
def test_options_that_do_not_go_together_are_refused(folder, tmp_path, cli, arguments, complaint):
    given = [folder / word if "." in word else word for word in arguments]
    said = cli.refusal(given[0], tmp_path / "out.octex", *given[1:])
    assert complaint in said
    assert not (tmp_path / "out.octex").exists()


def test_what_values_are_taken_from_is_not_overwritten(folder, tmp_path, cli):
    (tmp_path / "red.ply").write_bytes((folder / "red.ply").read_bytes())
    said = cli.refusal(
        folder / "wide.ply", tmp_path / "red.ply", "--transfer", tmp_path / "red.ply", "--force"
    )
    assert "red.ply" in said
    assert (tmp_path / "red.ply").read_bytes() == (folder / "red.ply").read_bytes()


_FUNCTIONS = """
import numpy as np

def red(points):
    return np.tile([1.0, 0.0, 0.0], (len(points), 1))

def ball(points):
    return np.linalg.norm(points, axis=1) - 1.0

three = 3
"""


def test_functions_in_files_are_channels_and_surfaces(folder, tmp_path, cli):
    (tmp_path / "shapes.py").write_text(_FUNCTIONS)
    out = tmp_path / "out.octex"
    red = f"base_color={tmp_path / 'shapes.py'}:red"
    cli.result(folder / "wide.ply", out, "--depth", 4, "--source", red)
    assert np.allclose(colors(out), [1, 0, 0])
    ball = f"{tmp_path / 'shapes.py'}:ball"
    where = ["--grid=-1.1,-1.1,-1.1,1.1,1.1,1.1,0.2"]
    cli.result(ball, out, "--depth", 4, "--source", red, *where, "--force")
    texture = octex.open(out)
    assert texture.contains([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]).tolist() == [True, False]
    cli.result(folder / "red.ply", out, "--depth", 5, "--also", ball, *where, "--force")
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


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["shapes.py:ball"], "give --grid"),
        (["wide.ply", "--grid", "0,0,0,1,1,1,1"], "--grid applies to implicit surfaces only"),
        (["wide.ply", "--source", "base_color=shapes.py:blue"], "has no function blue; it has red, ball"),
        (["wide.ply", "--source", "base_color=shapes.py:three"], "has no function three"),
        (["wide.ply", "--source", "base_color=none.py:red"], "none.py cannot be read"),
        (["wide.ply", "--source", "base_color=broken.py:red"], "broken.py raised SyntaxError"),
        (["wide.ply", "--also", "red.ply", "--rest", "wide.ply"], "--rest applies to one model"),
        (["wide.ply", "--also", "none.ply"], "none.ply cannot be read"),
    ],
)
def test_functions_and_models_that_cannot_be_used_are_refused(
    folder, tmp_path, cli, monkeypatch, arguments, complaint
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shapes.py").write_text(_FUNCTIONS)
    (tmp_path / "broken.py").write_text("def red(:\n")
    given = [folder / word if word.endswith(".ply") else word for word in arguments]
    assert complaint in cli.refusal(given[0], tmp_path / "out.octex", *given[1:])
