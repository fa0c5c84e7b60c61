"""Images, samplers, texture coordinates and vertex colours of glTF against an independent reader."""

import base64

import numpy as np
import pytest

from octex.source.load import load_surface
from tests.make.agreement import assert_agrees
from tests.make.fixtures import (
    CLAMP,
    MIRROR,
    NEAREST,
    REPEAT,
    SQUARE,
    SQUARE_UV,
    Gltf,
    png,
    random_image,
    saved,
    textured_square,
)


@pytest.mark.parametrize("sampler", [{}, {"wrap": (REPEAT, REPEAT), "minify": NEAREST}])
def test_a_texture_repeats_and_is_linear_without_a_sampler_that_says_otherwise(tmp_path, sampler):
    image = png(random_image(4, 4))
    assert_agrees(textured_square(tmp_path / "a.glb", image, scale=3.0, shift=-1.0, **sampler))


def test_the_upper_left_texel_lies_at_coordinates_0_0_which_is_the_upper_left_corner(tmp_path):
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[0, 0] = 255
    surface = load_surface(textured_square(tmp_path / "a.glb", png(texels), wrap=(CLAMP, CLAMP), mag=NEAREST))
    samples = surface.scatter(200)
    is_white = surface.evaluate(samples)[:, 0] > 0.5
    np.testing.assert_array_equal(is_white, (samples.points[:, 0] < 0.5) & (samples.points[:, 1] > 0.5))


def test_vertex_colours_are_linear_light(tmp_path):
    gltf = Gltf()
    colors = np.array([[0, 0.5, 1], [1, 0.25, 0], [0.1, 0.2, 0.3], [1, 1, 1]], np.float32)
    gltf.show(gltf.primitive(colors=colors))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_coordinates_may_be_normalized_integers(tmp_path):
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4))), wrap=(CLAMP, CLAMP)))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 65535).astype(np.uint16), material=material))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 255).astype(np.uint8), material=material), translation=[2, 0, 0])
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_several_materials_images_and_primitives_keep_their_own(tmp_path):
    gltf = Gltf()
    images = [gltf.image(png(random_image(3 + i, 4, seed=i))) for i in range(2)]
    materials = [
        gltf.material(gltf.texture(images[0], wrap=(CLAMP, MIRROR)), factor=(1, 0.5, 1, 1)),
        gltf.material(gltf.texture(images[1], mag=NEAREST)),
        gltf.material(gltf.texture(images[0], wrap=(REPEAT, REPEAT))),
        gltf.material(factor=(0.1, 0.2, 0.3, 1)),
        None,
    ]
    shapes = [
        gltf.primitive(SQUARE + np.float32([0, 0, i]), uv=SQUARE_UV * 2 - np.float32(0.5), material=material)
        for i, material in enumerate(materials)
    ]
    gltf.show(*shapes[:2])
    gltf.show(*shapes[2:])
    assert_agrees(gltf.save(tmp_path / "a.glb"), 300)


def test_a_quarter_turn_of_the_transform_is_the_example_of_the_extension(tmp_path):
    # The lower left quadrant of the image, turned clockwise.
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[1, 0] = 255
    change = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    gltf = Gltf()
    info = {
        "index": gltf.texture(gltf.image(png(texels)), mag=NEAREST),
        "extensions": {"KHR_texture_transform": change},
    }
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(info)))
    gltf.json["extensionsRequired"] = ["KHR_texture_transform"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert (surface.evaluate(surface.scatter(50)) == 1).all()


def test_webp_images_are_read(tmp_path):
    gltf = Gltf()
    image = gltf.image(saved(random_image(4, 4), "WEBP", lossless=True), "image/webp")
    texture = gltf.add("textures", extensions={"EXT_texture_webp": {"source": image}})
    gltf.json["extensionsRequired"] = ["EXT_texture_webp"]
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(texture)))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_buffers_and_images_may_lie_in_files_with_blanks_and_in_other_folders(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "a ü.png").write_bytes(png(random_image(4, 4)))
    assert_agrees(textured_square(tmp_path / "model" / "a.gltf", "../maps/a%20%C3%BC.png", external=True))


def test_a_name_with_a_percent_sign_is_found_as_it_stands(tmp_path):
    data = png(random_image(4, 4))
    (tmp_path / "50%25.png").write_bytes(data)
    paths = [textured_square(tmp_path / f"{n}.gltf", each) for n, each in enumerate(("50%25.png", data))]
    surfaces = [load_surface(path) for path in paths]
    samples = surfaces[0].scatter(100)
    values = [surface.evaluate(samples) for surface in surfaces]
    assert values[0].std() > 0.05
    np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("style", ["base64", "base64 with line ends and no padding", "percent"])
def test_images_may_be_data_uris(tmp_path, style):
    data = png(random_image(4, 4))
    text = base64.b64encode(data).decode()
    uri = {
        "base64": f"data:image/png;base64,{text}",
        "percent": "data:image/png," + "".join(f"%{byte:02x}" for byte in data),
    }.get(style, f"data:image/png;base64,{text[:8]}\n{text[8:].rstrip('=')}")
    surface = load_surface(textured_square(tmp_path / "a.gltf", uri))
    assert surface.evaluate(surface.scatter(100)).std() > 0.05
