"""Blender's extension, used without a window; OCTEX_TEST_BLENDER names a Python with bpy and octex."""

import json
import os
import subprocess
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools" / "blender"
PYTHON = os.environ.get("OCTEX_TEST_BLENDER", "")
pytestmark = pytest.mark.skipif(not PYTHON, reason="OCTEX_TEST_BLENDER names no Python with bpy and octex")


def told_by(tool, folder):
    call = [PYTHON, str(TOOLS / tool), str(folder)]
    own = os.environ | {"BLENDER_USER_RESOURCES": str(folder / "resources")}
    done = subprocess.run(call, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def used(tmp_path_factory):
    return told_by("try_extension.py", tmp_path_factory.mktemp("blender"))


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    return told_by("try_objects.py", tmp_path_factory.mktemp("objects"))


def test_objects_that_cannot_be_used_are_refused_in_words(used):
    expected = (
        "Save the .blend file first", "make the texture first", "No camera has a background image",
        "make the texture first", "empty has no faces", "Leave Edit Mode of ball first",
        "is not an octree texture file",
    )  # fmt: skip
    assert len(used["refused"]) == len(expected)
    for said, part in zip(used["refused"], expected, strict=True):
        assert part in said


def test_grey_and_the_colours_of_a_material_come_back_to_the_corners(used):
    assert used["grey"] <= 0.51  # Blender's bytes hold no half
    assert used["material"]["worst"] <= 2
    assert (used["material"]["kept"], used["material"]["shown"]) == ("own", "painted octree")
    assert used["material"]["scenes"] == 1  # what was exported is gone


def test_images_at_new_uvs_show_the_same_colours(used):
    assert (used["atlas"]["size"], used["atlas"]["space"]) == (512, "sRGB")
    assert used["atlas"]["median"] <= 2


@pytest.mark.parametrize("name", ["exact", "exact plate", "exact channels"])
def test_cycles_looks_the_octree_up_as_octex_does(used, name):
    assert used[name]["pixels"] > 2000
    for filter in ("nearest", "linear", "quadratic"):
        assert used[name][filter] <= 1
    assert used["exact plate"]["split"] > 100  # another colour on each side
    for channel in ("alpha", "roughness", "metallic", "normal"):
        assert used["exact channels"][channel] <= 1


def test_a_photograph_lands_where_the_camera_sees_it(used):
    assert used["photograph"]["corners"] > 500
    assert used["photograph"]["worst"] <= 2


def test_what_the_page_saves_is_shown_though_the_object_is_renamed(used):
    assert used["painted"]["is_open"]
    assert used["painted"]["path"] == "//ball-2.octex"
    assert used["painted"]["worst"] <= 0.51
    assert used["painted"]["next"] == "other-8-2.octex"  # the object is called other-8


def test_no_operator_is_offered_during_another_but_after_one_that_has_failed(used):
    assert used["stuck"] == {"at work": False, "after": True}


def test_the_packages_of_other_extensions_stay_installed(used):
    assert used["packages"]


def test_images_that_are_unsaved_or_packed_are_read_and_others_refused(kinds):
    images = kinds["images"]
    assert max(images[kind] for kind in ("unsaved", "packed", "file")) <= 2
    assert not images["was read"]  # that takes long, and the window would wait
    assert "is missing: find or remove it first" in images["missing"]
    assert "cannot be read: replace or remove it first" in images["damaged"]
    for kind in ("tiles", "tiles in a group"):
        assert "has UDIM tiles: bake it to one image first" in images[kind]
    assert images["baked over tiles"] == "it did not refuse"  # neither reads the material's images
    assert images["painted over tiles"] == ""


@pytest.mark.parametrize("layout", ["KEEP", "ATLAS"])
def test_strokes_on_baked_images_are_taken_over(kinds, layout):
    assert "bake to images first" in kinds["strokes"]["not baked"]
    assert "nothing was painted" in kinds["strokes"]["not painted"]
    assert "nothing was painted" in kinds["strokes"][f"not painted {layout}, but another texture"]
    assert kinds["strokes"][layout]["corners"] > 50 and kinds["strokes"][layout]["is_kept"]
    assert kinds["strokes"][layout]["red"] <= 2
    assert kinds["strokes"][layout]["moved"] <= 1
    assert "was painted on: take that over first" in kinds["strokes"][layout]["baked over"]
    assert kinds["strokes"][layout]["baked after"] == "it did not refuse"


def test_what_is_painted_on_a_drawn_view_is_projected(kinds):
    view = kinds["view"]
    assert "The scene has no camera" in view["no camera"]
    assert view["scenes"] == 0  # a job that is cancelled leaves no camera
    assert view["name"] == "ball-camera.png"
    assert view["drawn"] <= 0.5
    assert "no view was painted on" in view["not painted"]
    assert view["corners"] > 50
    assert view["red"] <= 10  # at the border some grey is averaged in
    assert view["grey"] <= 2


def test_photographs_of_a_colmap_folder_land_where_its_cameras_see_them(kinds):
    assert "none of its 2 images is there" in kinds["colmap"]["missing"]
    assert kinds["colmap"]["worst"] <= 2


def test_photographs_in_no_file_land_as_those_in_files_do(kinds):
    reads = kinds["reads"]
    assert max(reads[kind] for kind in ("unsaved", "floats", "packed")) <= 2
    assert "resized was changed meanwhile" in reads["resized"]
    assert not reads["is there"]  # the folder of a job that is closed


def test_objects_without_material_and_with_shape_keys_are_coloured(kinds):
    assert kinds["plain"] == {"spread": 0.0, "slots": 1, "own": 0}
    assert kinds["shape_keys"]["worst"] <= 2


def test_what_cannot_take_a_texture_says_what_to_do(kinds):
    assert "apply finer first" in kinds["modifiers"]["photographs"]
    for said in kinds["linked"].values():
        assert "ball is linked from library.blend: make it local first" in said
    assert len(kinds["linked"]) == 3


def test_the_texture_of_another_object_is_refused(kinds):
    assert len(kinds["another"]) == 6
    for said in kinds["another"].values():
        assert "no point in the texture" in said or "belongs to another model" in said
        assert "model.glb" not in said
