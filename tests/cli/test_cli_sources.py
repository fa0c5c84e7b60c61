"""Values from other models and from points, at the command line."""

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
