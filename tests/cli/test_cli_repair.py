"""--repair at the command line: what is left out is counted in one line."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh

import octex
from octex.errors import ModelError
from tests.make.fixtures import obj_lines


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
