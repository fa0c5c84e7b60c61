"""Images that are laid on a model by position at the command line."""

import octex
from octex.cli.values import AXES, PROJECTIONS
from octex.source.mapped import FRAMES, KINDS, MappedImage
from tests.conftest import needs_jit
from tests.make.command import run
from tests.make.fixtures import obj_lines, png, random_image
from tests.source.test_surface import CUBE, CUBE_TRIANGLES


@needs_jit
def test_images_are_projected_at_the_command_line(tmp_path):
    model, image, out = (tmp_path / name for name in ("cube.obj", "wood.png", "cube.octex"))
    model.write_text(obj_lines(CUBE, CUBE_TRIANGLES))
    image.write_bytes(png(random_image(8, 8)))
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
