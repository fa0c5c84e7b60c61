from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.conftest import needs_jit


@pytest.fixture(scope="module")
def gallery():
    path = Path(__file__).parents[2] / "tools" / "gallery.py"
    specification = importlib.util.spec_from_file_location("gallery", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    module.TILE = (160, 90)
    return module


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "inner").mkdir()
    for name, colors in (("red.glb", [[255, 0, 0, 255]] * 8), ("inner/many.glb", np.eye(8, 4) * 255)):
        box = trimesh.creation.box()
        box.visual.vertex_colors = np.array(colors, np.uint8) | [0, 0, 0, 255]
        box.export(tmp_path / name)
    (tmp_path / "broken.glb").write_bytes(b"no model")
    (tmp_path / "notes.txt").write_text("no model either")
    return tmp_path


@needs_jit
def test_a_gallery_shows_all_coloured_models_and_lists_what_is_refused(gallery, folder, capsys):
    sheet = folder / "sheet.png"
    assert gallery.main([str(folder), str(sheet), "--depth", "4"]) == 0
    said = capsys.readouterr().out
    assert np.asarray(Image.open(sheet)).shape == (90, 320, 3)
    assert (
        said.index("inner/many.glb")
        < said.index("red.glb")
        < said.index("1 refused")
        < said.index("broken.glb")
    )
    assert "2 models on" in said
    assert "notes.txt" not in said


@needs_jit
def test_an_odd_number_of_models_leaves_a_white_tile(gallery, folder):
    (folder / "red.glb").unlink()
    sheet = folder / "sheet.png"
    assert gallery.main([str(folder), str(sheet), "--depth", "3"]) == 0
    assert (np.asarray(Image.open(sheet))[:, 160:] == 255).all()


def test_a_folder_without_coloured_models_makes_no_sheet(gallery, tmp_path, capsys):
    (tmp_path / "white.glb").write_bytes(trimesh.creation.box().export(file_type="glb"))
    assert gallery.main([str(tmp_path), str(tmp_path / "sheet.png")]) == 1
    assert not (tmp_path / "sheet.png").exists()
    assert "white.glb" in capsys.readouterr().out


@needs_jit
def test_a_gallery_of_another_channel_lists_models_that_lack_it(gallery, folder, capsys):
    material = trimesh.visual.material.PBRMaterial(roughnessFactor=0.5)
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], material=material)
    box.export(folder / "rough.glb")
    sheet = folder / "sheet.png"
    assert gallery.main([str(folder), str(sheet), "--depth", "3", "--channel", "roughness"]) == 0
    said = capsys.readouterr().out
    assert "1 models on" in said
    assert said.index("rough.glb") < said.index("refused") < said.index("broken.glb")
