"""Images that are laid on a model by position at the command line."""

import pytest

import octex
from octex.cli.values import AXES, PROJECTIONS
from octex.source.mapped import FRAMES, KINDS, MappedImage
from tests.conftest import needs_jit
from tests.make.command import run
from tests.make.fixtures import obj_lines, png, random_image
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


@pytest.fixture
def model(tmp_path):
    (tmp_path / "cube.obj").write_text(obj_lines(CUBE, CUBE_TRIANGLES))
    (tmp_path / "wood.png").write_bytes(png(random_image(8, 8)))
    return tmp_path / "cube.obj"


@needs_jit
def test_images_are_projected_at_the_command_line(model):
    image, out = model.with_name("wood.png"), model.with_name("cube.octex")
    words = [model, out, "--depth", "4", "--quiet", "--source", f"base_color={image}"]
    words += ["--project", "box:axis=-y:center=-1,0,0.5:size=0.5"]
    assert run(*words, "--source", "roughness=0.5") == 0
    mapped = MappedImage(image, "box", axis="-y", center=(-1, 0, 0.5), size=0.5)
    expected = octex.convert(octex.load_surface(model, sources={"base_color": mapped, "roughness": 0.5}), 4)
    expected.save(model.with_name("expected.octex"))
    assert out.read_bytes() == model.with_name("expected.octex").read_bytes()


def test_the_help_lists_the_mappings_of_the_library():
    assert PROJECTIONS == KINDS
    assert tuple(FRAMES) == AXES


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--project box", "--project needs an image to project: --source base_color=FILE"),
        ("--project box --source alpha=1", "--project needs an image to project: --source base_color=FILE"),
        (
            "--source alpha=a.png --project spherical:size=2",
            "--project: a spherical projection has no size: one copy of the image goes around; see",
        ),
        ("--project cone", "--project: 'cone' is not one of planar, box, cylindrical, spherical; see"),
        (
            "--project box:size",
            "--project: 'size' is not one of axis=A, center=X,Y,Z, size=SIZE, such as box:size=0.5",
        ),
        (
            "--project box:axis=w",
            "--project: axis: 'w' is not one of x, -x, y, -y, z, -z; see octree-convert --help",
        ),
        ("--project box:center=1,2", "--project: center: '1,2' is not X,Y,Z, such as 0,0.5,1; see"),
        ("--project box:center=a,b,c", "--project: center: 'a,b,c' must be numbers separated by commas; see"),
        ("--project box:center=1,nan,2", "--project: center: 1,nan,2 has numbers that are not finite; see"),
        (
            "--project box:size=0",
            "--project: size: '0' is not a size above zero, nor three like 1,1,0.5; see",
        ),
    ],
)
def test_projections_that_make_no_sense_are_refused_in_one_line(words, message, cli):
    assert cli.refusal("a.glb", "b.octex", *words.split()).startswith(message)


def test_a_texture_needs_its_model_for_a_projection(cli):
    words = "a.octex b.octex --source alpha=a.png --project box"
    assert "needs the model, but this is a texture made from it" in cli.refusal(*words.split())
