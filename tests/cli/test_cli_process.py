"""octex edit: textures from textures."""

import json

import numpy as np
import pytest

import octex
from tests.conftest import needs_jit
from tests.make.same import assert_same


@pytest.fixture(scope="module")
def other(made):
    path = made.with_name("other.octex")
    octex.map(octex.open(made), lambda values: 1 - values).save(path)
    return path


@needs_jit
def test_every_option_is_the_operation_of_that_name(made, other, tmp_path, cli):
    texture, second, out = octex.open(made), octex.open(other), tmp_path / "out.octex"
    low, high = texture.bounds
    middle = (low + high) / 2
    box = ",".join(repr(float(each)) for each in [*low, *middle])
    for words, wanted in (
        (f"--crop={box}", octex.crop(texture, low, middle)),
        ("--depth 3", octex.resize(texture, 3)),
        (f"--combine {other}", octex.combine(texture, second)),
        (f"--mix {other}=0.3", octex.mix(texture, second, 0.3)),
        ("--blur 0.2", octex.blur(texture, 0.2)),
        ("--levels 0.1,0.9,1.5", octex.levels(texture, "base_color", 0.1, 0.9, 1.5)),
        ("--levels 0.1,0.9", octex.levels(texture, "base_color", 0.1, 0.9)),
        ("--dtype base_color=uint16 --threads 1", octex.cast(texture, "uint16")),
    ):
        cli.result("edit", made, out, *words.split(), "--force")
        found = octex.open(out)
        found.validate()
        assert_same(found, wanted)


def test_options_work_in_one_order_however_they_are_given(made, other, tmp_path, cli):
    out = tmp_path / "all.octex"
    words = ["--dtype", "float16", "--levels", "0,0.9", "--blur", "0.1", "--mix", f"{other}=0.5"]
    cli.result("edit", made, out, *words, "--depth", 3)
    done = json.loads(octex.open(out).metadata["processed"])
    assert [each["operation"] for each in done] == ["resize", "mix", "blur", "levels", "cast"]
    cli.result("edit", made, out.with_suffix(".ply"), *words, "--depth", 3)
    cli.result(out, tmp_path / "same.ply")
    assert (tmp_path / "same.ply").read_bytes() == out.with_suffix(".ply").read_bytes()


def test_a_coarser_depth_leaves_larger_leaves_as_they_are(model, tmp_path, cli):
    adaptive, out = tmp_path / "adaptive.octex", tmp_path / "out.octex"
    texture = octex.convert(model, 4, detail=lambda points: np.where(points[:, 0] > 0, 4, 2))
    texture.save(adaptive)
    assert texture.tree.cells_by_depth()[2][0]
    for depth in (4, 3):
        cli.result("edit", adaptive, out, "--depth", depth, "--force")
        assert octex.open(out).tree.cells_by_depth() == texture.level(depth).tree.cells_by_depth()
