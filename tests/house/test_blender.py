"""Blender's extension, used without a window; OCTEX_TEST_BLENDER names a Python with bpy and octex."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

TOOLS = Path(__file__).parents[2] / "tools" / "blender"
PYTHON = os.environ.get("OCTEX_TEST_BLENDER", "")
pytestmark = pytest.mark.skipif(not PYTHON, reason="OCTEX_TEST_BLENDER names no Python with bpy and octex")


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("blender")
    call = [PYTHON, str(TOOLS / "try_extension.py"), str(folder)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return told


def test_objects_that_cannot_be_used_are_refused_in_words(used: dict[str, Any]) -> None:
    expected = (
        "Save the .blend file first", "make the texture first", "No camera has a background image",
        "make the texture first", "empty has no faces", "Leave Edit Mode of ball first",
        "is not an octree texture file",
    )  # fmt: skip
    assert len(used["refused"]) == len(expected)
    for said, part in zip(used["refused"], expected, strict=True):
        assert part in said


def test_grey_and_the_colours_of_a_material_come_back_to_the_corners(used: dict[str, Any]) -> None:
    assert used["grey"] <= 0.51  # Blender's bytes hold no half
    assert used["material"]["worst"] <= 2
    assert (used["material"]["kept"], used["material"]["shown"]) == ("own", "painted octree")
    assert used["material"]["scenes"] == 1  # what was exported is gone


def test_images_at_new_uvs_show_the_same_colours(used: dict[str, Any]) -> None:
    assert (used["atlas"]["size"], used["atlas"]["space"]) == (512, "sRGB")
    assert used["atlas"]["median"] <= 2


@pytest.mark.parametrize("name", ["exact", "exact plate"])
def test_cycles_looks_the_octree_up_as_octex_does(used: dict[str, Any], name: str) -> None:
    assert used[name]["pixels"] > 2000
    for filter in ("nearest", "linear", "quadratic"):
        assert used[name][filter] <= 1
    assert used["exact plate"]["split"] > 100  # another colour on each side


def test_a_photograph_lands_where_the_camera_sees_it(used: dict[str, Any]) -> None:
    assert used["photograph"]["corners"] > 500
    assert used["photograph"]["worst"] <= 2


def test_what_the_page_saves_is_shown(used: dict[str, Any]) -> None:
    assert used["painted"]["is_open"]
    assert used["painted"]["path"] == "//ball-2.octex"
    assert used["painted"]["worst"] <= 0.51
