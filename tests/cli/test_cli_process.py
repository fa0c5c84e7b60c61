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
    texture, second = octex.open(made), octex.open(other)
    low, high = texture.bounds
    middle = (low + high) / 2
    box = ",".join(repr(float(each)) for each in [*low, *middle])
    for number, (words, wanted) in enumerate(
        [
            (["--crop=" + box], octex.crop(texture, low, middle)),
            (["--depth", "3"], octex.resize(texture, 3)),
            (["--combine", other], octex.combine(texture, second)),
            (["--mix", f"{other}=0.3"], octex.mix(texture, second, 0.3)),
            (["--blur", "0.2"], octex.blur(texture, 0.2)),
            (["--levels", "0.1,0.9,1.5"], octex.levels(texture, "base_color", 0.1, 0.9, 1.5)),
            (["--levels", "0.1,0.9"], octex.levels(texture, "base_color", 0.1, 0.9)),
            (["--dtype", "base_color=uint16", "--threads", "1"], octex.cast(texture, "uint16")),
        ]
    ):
        out = tmp_path / f"{number}.octex"
        cli.result("edit", made, out, *words)
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
    octex.convert(model, 4, detail=lambda points: np.where(points[:, 0] > points[:, 0].mean(), 4, 2)).save(
        adaptive
    )
    texture = octex.open(adaptive)
    assert texture.tree.cells_by_depth()[2][0]
    for depth in (4, 3):
        cli.result("edit", adaptive, out, "--depth", depth, "--force")
        assert octex.open(out).tree.cells_by_depth() == texture.level(depth).tree.cells_by_depth()


@pytest.mark.parametrize(
    "words", ["--crop 0,0,0,1,1,1", "--combine b.octex", "--mix b.octex=0.3", "--blur 1", "--levels 0,1"]
)
def test_models_are_converted_first(words, model, tmp_path, cli):
    option = words.split()[0]
    assert cli.refusal(model, tmp_path / "x.octex", *words.split()) == (
        f"{option} is an option of octex edit, not of octree-convert; see octree-convert --help"
    )
    assert cli.refusal("edit", model, tmp_path / "x.octex", *words.split()) == (
        f"{model}: is a model without EXT_octree_texture; octex convert makes a texture of it"
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--crop 0,0,0,1,1", "--crop: '0,0,0,1,1' is not x0,y0,z0,x1,y1,z1, such as 0,0,0,1,2,1"),
        ("--crop 0,0,0,1,1,nan", "--crop: 0,0,0,1,1,nan has numbers that are not finite"),
        ("--levels 0.5", "--levels: '0.5' is not BLACK,WHITE[,GAMMA], such as 0.1,0.9,1.2"),
        ("--levels 0.5,0.4", "--levels: '0.5,0.4' is not BLACK,WHITE[,GAMMA]"),
        ("--levels a,b", "--levels: 'a,b' must be numbers separated by commas"),
        ("--mix b.octex", "--mix: 'b.octex' is not FILE=AMOUNT, such as other.octex=0.3"),
        ("--mix b.octex=2", "--mix: 2 is not from 0 to 1"),
        ("--loss 1", "--loss is for NAME.octz"),
        ("--loss 0.5", "--loss: '0.5' is not a whole number"),
        ("--blur 0", "--blur: 0 is not a finite number above zero"),
        ("--combine none.octex", "none.octex"),
        ("--channels paint", "unknown channel of "),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(words, message, made, tmp_path, cli):
    assert message in cli.refusal("edit", made, tmp_path / "x.octex", *words.split())
    assert not (tmp_path / "x.octex").exists()


def test_what_is_read_is_not_overwritten(made, other, cli):
    before = other.read_bytes()
    for words in (["--combine", other], ["--mix", f"{other}=0.5"]):
        assert "OUTPUT is also an input" in cli.refusal("edit", made, other, *words, "--force")
    assert other.read_bytes() == before
    np.testing.assert_array_equal(octex.open(other).tree.arrays.groups, octex.open(made).tree.arrays.groups)
