"""glTF and GLB against an independent reader, and what is refused."""

from __future__ import annotations

import base64
import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octex.errors import ImageError, ModelError
from octex.source.load import load_surface
from octex.source.surface import Surface
from tests import naive_source
from tests.fixtures import (
    CLAMP,
    LINEAR,
    MIRROR,
    NEAREST,
    REPEAT,
    SQUARE,
    SQUARE_TRIANGLES,
    SQUARE_UV,
    Gltf,
    png,
    random_image,
    textured_square,
)


def assert_agrees(path: Path, samples: int = 150) -> Surface:
    """The surface has the values that the independent reader finds, triangle by triangle."""
    surface = load_surface(path)
    model = naive_source.load(path)
    assert len(surface.triangles) == len(model.triangles)
    for corners, triangle in zip(surface.vertices[surface.triangles], model.triangles, strict=True):
        np.testing.assert_allclose(sorted(corners.tolist()), sorted(triangle.corners), atol=1e-6)
    found = surface.scatter(samples)
    values = surface.evaluate_all(found.triangles, found.barycentric, np.zeros(samples, np.float32))
    expected = np.array(
        [model.evaluate(t, p) for t, p in zip(found.triangles.tolist(), found.points.tolist(), strict=True)]
    )
    np.testing.assert_allclose(values, expected[:, : values.shape[1]], atol=2e-4)
    return surface


@pytest.mark.parametrize("wrap_v", [REPEAT, MIRROR, CLAMP])
@pytest.mark.parametrize("wrap_u", [REPEAT, MIRROR, CLAMP])
@pytest.mark.parametrize("mag", [NEAREST, LINEAR])
def test_each_wrap_of_each_axis_agrees_with_the_specification(
    tmp_path: Path, wrap_u: int, wrap_v: int, mag: int
) -> None:
    image = png(random_image(5, 8))
    path = textured_square(tmp_path / "a.glb", image, wrap=(wrap_u, wrap_v), mag=mag, scale=5.0, shift=-2.3)
    assert_agrees(path)


def test_a_texture_without_a_sampler_repeats_and_is_linear(tmp_path: Path) -> None:
    assert_agrees(textured_square(tmp_path / "a.glb", png(random_image(4, 4)), scale=3.0, shift=-1.0))


def test_a_nearest_minification_alone_leaves_magnification_linear(tmp_path: Path) -> None:
    image = png(random_image(4, 4))
    assert_agrees(textured_square(tmp_path / "a.glb", image, wrap=(REPEAT, REPEAT), minify=NEAREST))


def test_the_upper_left_texel_lies_at_coordinates_0_0_which_is_the_upper_left_corner(tmp_path: Path) -> None:
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[0, 0] = 255
    surface = load_surface(textured_square(tmp_path / "a.glb", png(texels), wrap=(CLAMP, CLAMP), mag=NEAREST))
    samples = surface.scatter(200)
    is_white = surface.evaluate(samples)[:, 0] > 0.5
    np.testing.assert_array_equal(is_white, (samples.points[:, 0] < 0.5) & (samples.points[:, 1] > 0.5))


def test_texel_centres_lie_half_a_texel_from_the_edge(tmp_path: Path) -> None:
    ramp = np.array([[[0] * 3, [255] * 3]], np.uint8)
    surface = load_surface(textured_square(tmp_path / "a.glb", png(ramp), wrap=(CLAMP, CLAMP)))
    samples = surface.scatter(300)
    expected = np.clip(2 * samples.points[:, 0] - 0.5, 0, 1)
    np.testing.assert_allclose(surface.evaluate(samples)[:, 1], expected, atol=1e-5)


def test_factor_vertex_colour_and_texture_multiply(tmp_path: Path) -> None:
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(3, 3)))), factor=(0.5, 0.25, 1.0, 1.0))
    colors = np.array([[255, 0, 128], [1, 255, 3], [7, 99, 255], [255, 255, 255]], np.uint8)
    gltf.show(gltf.primitive(uv=SQUARE_UV, colors=colors, material=material))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    "colors",
    [
        np.array([[0, 0.5, 1], [1, 0.25, 0], [0.1, 0.2, 0.3], [1, 1, 1]], np.float32),
        np.array(
            [[0, 65535, 1000, 65535], [1, 2, 3, 65535], [65535, 5, 6, 65535], [9, 9, 9, 65535]], np.uint16
        ),
    ],
)
def test_vertex_colours_are_linear_light(tmp_path: Path, colors: np.ndarray) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(colors=colors))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_coordinates_may_be_normalized_integers(tmp_path: Path) -> None:
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4))), wrap=(CLAMP, CLAMP)))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 65535).astype(np.uint16), material=material))
    gltf.show(gltf.primitive(uv=(SQUARE_UV * 255).astype(np.uint8), material=material), translation=[2, 0, 0])
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_opaque_materials_ignore_alpha(tmp_path: Path) -> None:
    image = png(random_image(4, 4, 4))
    surface = assert_agrees(textured_square(tmp_path / "a.glb", image, factor=(1, 1, 1, 0.2)))
    assert [channel.name for channel in surface.channels] == ["base_color"]


@pytest.mark.parametrize(
    "options", [{"alphaMode": "BLEND"}, {"alphaMode": "MASK"}, {"alphaMode": "MASK", "alphaCutoff": 0.2}]
)
@pytest.mark.parametrize("mag", [NEAREST, LINEAR])
def test_alpha_is_a_channel_where_a_material_uses_it(
    tmp_path: Path, options: dict[str, Any], mag: int
) -> None:
    image = png(random_image(6, 6, 4))
    surface = assert_agrees(
        textured_square(tmp_path / "a.glb", image, mag=mag, factor=(1, 1, 1, 0.7), **options), 400
    )
    assert [channel.name for channel in surface.channels] == ["base_color", "alpha"]
    samples = surface.scatter(100)
    alpha = surface.evaluate(samples, "alpha")
    assert alpha.shape == (100, 1)
    assert options["alphaMode"] == "BLEND" or set(np.unique(alpha)) == {0.0, 1.0}


@pytest.mark.parametrize(("mode", "alpha"), [("BLEND", 0.3), ("MASK", 0.0)])
def test_alpha_of_materials_without_texture_counts_too(tmp_path: Path, mode: str, alpha: float) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(material=gltf.material(factor=(1, 0, 0, 0.3), alphaMode=mode)))
    gltf.show(gltf.primitive(), translation=[0, 0, 1])
    surface = assert_agrees(gltf.save(tmp_path / "a.glb"))
    samples = surface.scatter(50)
    expected = np.where(samples.points[:, 2] < 0.5, np.float32(alpha), 1)
    np.testing.assert_allclose(surface.evaluate(samples, "alpha")[:, 0], expected)


def test_an_opaque_image_takes_part_in_masking_by_the_factor(tmp_path: Path) -> None:
    path = textured_square(
        tmp_path / "a.glb", png(random_image(4, 4)), factor=(1, 1, 1, 0.4), alphaMode="MASK"
    )
    assert (
        assert_agrees(path).evaluate_all(np.zeros(1), np.full((1, 3), 1 / 3), np.ones(1))[:, 3] == 0
    ).all()


def test_a_material_that_no_triangle_uses_adds_no_channel(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.material(alphaMode="BLEND")
    gltf.show(gltf.primitive(material=gltf.material()))
    assert len(load_surface(gltf.save(tmp_path / "a.glb")).channels) == 1


def test_several_materials_images_and_primitives_keep_their_own(tmp_path: Path) -> None:
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


def test_transforms_apply_down_the_tree_and_meshes_may_be_shown_often(tmp_path: Path) -> None:
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))
    mesh = gltf.add("meshes", primitives=[gltf.primitive(uv=SQUARE_UV, material=material)])
    half = 0.5**0.5
    leaf = gltf.add("nodes", mesh=mesh, rotation=[0, half, 0, half], translation=[1, 2, 3])
    camera = gltf.add("nodes", camera=0, children=[leaf], scale=[2, 3, 4])
    matrix = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
    root = gltf.add("nodes", children=[camera, gltf.add("nodes", mesh=mesh)], matrix=matrix)
    gltf.json["scenes"][0]["nodes"] += [root, gltf.add("nodes", mesh=mesh, scale=[1, 1, 0.5])]
    surface = assert_agrees(gltf.save(tmp_path / "a.gltf"))
    assert len(surface.triangles) == 6


def test_a_mirroring_transform_keeps_normals_outward(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(), scale=[-1, 1, 1])
    assert_agrees(gltf.save(tmp_path / "a.glb"))
    normals = load_surface(tmp_path / "a.glb").scatter(10).normals
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 10)


def test_instances_of_the_extension_are_placed(tmp_path: Path) -> None:
    gltf = Gltf()
    node = gltf.show(gltf.primitive(), translation=[0, 0, 10])
    places = np.array([[1, 0, 0], [5, 0, 0]], np.float32)
    sizes = np.array([[1, 1, 1], [2, 2, 2]], np.float32)
    gltf.json["nodes"][node]["extensions"] = {
        "EXT_mesh_gpu_instancing": {
            "attributes": {"TRANSLATION": gltf.accessor(places), "SCALE": gltf.accessor(sizes)}
        }
    }
    gltf.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert len(surface.triangles) == 4
    np.testing.assert_allclose(surface.bounds, [[1, 0, 10], [7, 2, 10]])


@pytest.mark.parametrize("mode", [4, 5, 6])
@pytest.mark.parametrize("indexed", [True, False])
def test_lists_strips_and_fans_become_triangles(tmp_path: Path, mode: int, indexed: bool) -> None:
    ring = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0]], np.float32)
    zigzag = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], np.float32)
    positions = ring if mode == 6 else zigzag
    gltf = Gltf()
    indices = np.arange(len(positions), dtype=np.uint32) if indexed else None
    colors = np.linspace(0, 1, 3 * len(positions), dtype=np.float32).reshape(-1, 3)
    gltf.show(gltf.primitive(positions, indices, colors=colors, mode=mode))
    surface = assert_agrees(gltf.save(tmp_path / "a.glb"))
    if mode != 4:
        np.testing.assert_allclose(surface.scatter(20).normals, [[0, 0, 1]] * 20)


def test_points_and_lines_beside_triangles_are_left_out(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(mode=0), gltf.primitive(mode=1), gltf.primitive())
    assert len(load_surface(gltf.save(tmp_path / "a.glb")).triangles) == 2


def test_sparse_accessors_are_filled_in(tmp_path: Path) -> None:
    gltf = Gltf()
    entry = gltf.primitive()
    gltf.json["accessors"][entry["attributes"]["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": gltf.view(np.array([2], np.uint8).tobytes()), "componentType": 5121},
        "values": {"bufferView": gltf.view(np.array([4, 4, 0], np.float32).tobytes())},
    }
    gltf.show(entry)
    assert assert_agrees(gltf.save(tmp_path / "a.glb")).bounds[1, 0] == 4


def test_sparse_accessors_may_stand_on_zeros(tmp_path: Path) -> None:
    gltf = Gltf()
    entry = gltf.primitive()
    accessor = gltf.json["accessors"][entry["attributes"]["POSITION"]]
    del accessor["bufferView"]
    accessor["sparse"] = {
        "count": 3,
        "indices": {"bufferView": gltf.view(np.array([1, 2, 3], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": gltf.view(SQUARE[1:].tobytes())},
    }
    gltf.show(entry)
    assert assert_agrees(gltf.save(tmp_path / "a.glb")).bounds[1, 0] == 1


def test_interleaved_attributes_are_read_by_their_stride(tmp_path: Path) -> None:
    gltf = Gltf()
    material = gltf.material(gltf.texture(gltf.image(png(random_image(4, 4)))))
    view = gltf.view(np.hstack([SQUARE, SQUARE_UV]).astype(np.float32).tobytes(), stride=20)
    shared = {"bufferView": view, "componentType": 5126, "count": 4}
    attributes = {
        "POSITION": gltf.add("accessors", type="VEC3", byteOffset=0, **shared),
        "TEXCOORD_0": gltf.add("accessors", type="VEC2", byteOffset=12, **shared),
    }
    indices = gltf.accessor(SQUARE_TRIANGLES.reshape(-1))
    gltf.show({"attributes": attributes, "indices": indices, "material": material})
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_quantized_positions_are_read_as_the_numbers_they_are(tmp_path: Path) -> None:
    gltf = Gltf()
    entry = gltf.primitive((SQUARE * 7).astype(np.int8))
    gltf.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    gltf.show(entry, scale=[0.5, 0.5, 0.5])
    np.testing.assert_allclose(assert_agrees(gltf.save(tmp_path / "a.glb")).bounds[1], [3.5, 3.5, 0])


@pytest.mark.parametrize("through", ["texCoord", "extension"])
def test_another_set_of_coordinates_is_used_when_the_material_names_it(tmp_path: Path, through: str) -> None:
    gltf = Gltf()
    info: dict[str, Any] = {"index": gltf.texture(gltf.image(png(random_image(4, 4))))}
    if through == "texCoord":
        info["texCoord"] = 1
    else:
        info["extensions"] = {"KHR_texture_transform": {"texCoord": 1}}
    second = gltf.accessor((SQUARE_UV[::-1] * 3).astype(np.float32))
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(info), TEXCOORD_1=second))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_texture_transforms_scale_then_rotate_then_move(tmp_path: Path) -> None:
    change = {"offset": [0.3, -0.2], "rotation": 0.7, "scale": [2.0, 0.5]}
    gltf = Gltf()
    texture = gltf.texture(gltf.image(png(random_image(4, 6))), wrap=(REPEAT, CLAMP))
    info = {"index": texture, "extensions": {"KHR_texture_transform": change}}
    gltf.json["extensionsRequired"] = ["KHR_texture_transform"]
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(info)))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_a_quarter_turn_of_the_transform_is_the_example_of_the_extension(tmp_path: Path) -> None:
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
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert (surface.evaluate(surface.scatter(50)) == 1).all()


def test_older_specular_glossiness_materials_give_their_diffuse_colour(tmp_path: Path) -> None:
    gltf = Gltf()
    texture = gltf.texture(gltf.image(png(random_image(4, 4))))
    older = {"diffuseFactor": [0.5, 1, 1, 1], "diffuseTexture": {"index": texture}}
    material = gltf.add("materials", extensions={"KHR_materials_pbrSpecularGlossiness": older})
    gltf.json["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness"]
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=material))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_webp_images_are_read(tmp_path: Path) -> None:
    import io

    import PIL.Image

    stream = io.BytesIO()
    PIL.Image.fromarray(random_image(4, 4)).save(stream, "WEBP", lossless=True)
    gltf = Gltf()
    image = gltf.image(stream.getvalue(), "image/webp")
    texture = gltf.add("textures", extensions={"EXT_texture_webp": {"source": image}})
    gltf.json["extensionsRequired"] = ["EXT_texture_webp"]
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(texture)))
    assert_agrees(gltf.save(tmp_path / "a.glb"))


def test_buffers_and_images_may_lie_in_files_with_blanks_and_in_other_folders(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "a ü.png").write_bytes(png(random_image(4, 4)))
    gltf = Gltf()
    image = gltf.add("images", uri="../maps/a%20%C3%BC.png")
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(gltf.texture(image))))
    assert_agrees(gltf.save(tmp_path / "model" / "a.gltf", external=True))


def test_a_name_with_a_percent_sign_is_found_as_it_stands(tmp_path: Path) -> None:
    (tmp_path / "50%25.png").write_bytes(png(random_image(4, 4)))
    gltf = Gltf()
    image = gltf.add("images", uri="50%25.png")
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(gltf.texture(image))))
    load_surface(gltf.save(tmp_path / "a.gltf"))


@pytest.mark.parametrize("style", ["base64", "base64 with line ends and no padding", "percent"])
def test_images_may_be_data_uris(tmp_path: Path, style: str) -> None:
    data = png(random_image(4, 4))
    text = base64.b64encode(data).decode()
    uri = "data:image/png;base64," + text
    if style == "percent":
        uri = "data:image/png," + "".join(f"%{byte:02x}" for byte in data)
    elif style != "base64":
        uri = "data:image/png;base64," + text[:8] + "\n" + text[8:].rstrip("=")
    gltf = Gltf()
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(gltf.texture(gltf.add("images", uri=uri)))))
    surface = load_surface(gltf.save(tmp_path / "a.gltf"))
    assert surface.evaluate(surface.scatter(100)).std() > 0.05


def test_without_scenes_the_roots_of_the_nodes_are_shown(tmp_path: Path) -> None:
    gltf = Gltf()
    node = gltf.show(gltf.primitive())
    gltf.add("nodes", children=[node], scale=[3, 3, 3])
    del gltf.json["scenes"], gltf.json["scene"]
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    assert len(surface.triangles) == 2
    assert surface.bounds[1, 0] == 3


def test_what_the_file_says_of_its_origin_is_kept(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.json["asset"] |= {"copyright": "2002 Somebody", "generator": "by hand"}
    gltf.show(gltf.primitive())
    provenance = load_surface(gltf.save(tmp_path / "a.glb")).provenance
    assert provenance["source"] == "a.glb"
    assert len(provenance["sha256"]) == 64
    assert (provenance["copyright"], provenance["generator"]) == ("2002 Somebody", "by hand")


def test_chunks_of_unknown_kinds_are_passed_over(tmp_path: Path) -> None:
    path = textured_square(tmp_path / "a.glb", png(random_image(4, 4)))
    data = path.read_bytes()
    at = 20 + struct.unpack_from("<I", data, 12)[0]
    data = data[:at] + struct.pack("<I4s", 4, b"ACME") + b"more" + data[at:]
    path.write_bytes(data[:8] + struct.pack("<I", len(data)) + data[12:])
    assert len(load_surface(path).triangles) == 2


def test_primitives_without_triangles_are_passed_over(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.show(gltf.primitive(triangles=np.empty((0, 3), np.uint16)), gltf.primitive())
    assert len(load_surface(gltf.save(tmp_path / "a.glb")).triangles) == 2


def test_a_rest_mesh_lends_its_positions_and_needs_no_images(tmp_path: Path) -> None:
    posed = textured_square(tmp_path / "posed.glb", png(random_image(4, 4)))
    gltf = Gltf()
    image = gltf.add("images", uri="not there.png")
    gltf.show(gltf.primitive(SQUARE * 3, uv=SQUARE_UV, material=gltf.material(gltf.texture(image))))
    rest = gltf.save(tmp_path / "rest.gltf")
    surface = load_surface(posed, rest=rest)
    np.testing.assert_allclose(surface.rest, surface.vertices * 3)
    assert surface.provenance["rest"] == "rest.gltf"
    assert surface.provenance["rest_sha256"] == hashlib.sha256(rest.read_bytes()).hexdigest()
    np.testing.assert_allclose(surface.bounds[1], [3, 3, 0])
    samples = surface.scatter(20)
    np.testing.assert_allclose(samples.rest, samples.points * 3)
    np.testing.assert_array_equal(surface.evaluate(samples), load_surface(posed).evaluate(samples))


def test_a_rest_mesh_of_another_topology_is_refused(tmp_path: Path) -> None:
    posed = textured_square(tmp_path / "posed.glb", png(random_image(4, 4)))
    for number, triangles in enumerate((SQUARE_TRIANGLES[:1], SQUARE_TRIANGLES[::-1])):
        gltf = Gltf()
        gltf.show(gltf.primitive(triangles=triangles))
        rest = gltf.save(tmp_path / f"rest{number}.glb")
        with pytest.raises(
            ModelError, match=r"rest.\.glb is no rest mesh of posed\.glb: the topology differs"
        ):
            load_surface(posed, rest=rest)
    with pytest.raises(ModelError, match="3 rest positions for 4 vertices"):
        load_surface(posed, rest=np.zeros((3, 3)))


def broken(change: str, tmp_path: Path) -> Path:
    """A model with one thing wrong."""
    gltf = Gltf()
    texture = gltf.texture(gltf.image(png(random_image(4, 4))))
    material = gltf.material(texture)
    entry = gltf.primitive(uv=SQUARE_UV, material=material)
    node = gltf.show(entry)
    attributes = entry["attributes"]
    accessors, views = gltf.json["accessors"], gltf.json["bufferViews"]
    position = accessors[attributes["POSITION"]]
    path = tmp_path / "bad.glb"
    if change == "vertex out of range":
        entry["indices"] = gltf.accessor(np.array([0, 1, 9], np.uint8))
    elif change == "negative index":
        entry["indices"] = gltf.accessor(np.array([0, 1, -1], np.int8))
    elif change == "not finite":
        attributes["POSITION"] = gltf.accessor(np.where(SQUARE == 1, np.float32(np.nan), SQUARE))
    elif change == "colours not finite":
        attributes["COLOR_0"] = gltf.accessor(np.full((4, 3), np.nan, np.float32))
    elif change == "factor not finite":
        gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1e999, 1, 1, 1]
    elif change == "beyond all bounds":
        gltf.json["nodes"][node]["scale"] = [1e200, 1, 1]
    elif change == "infinite transform":
        gltf.json["nodes"][node]["scale"] = [1e999, 1, 1]
    elif change == "no coordinates":
        del attributes["TEXCOORD_0"]
    elif change == "coordinates not finite":
        attributes["TEXCOORD_0"] = gltf.accessor(np.full((4, 2), np.inf, np.float32))
    elif change == "few coordinates":
        attributes["TEXCOORD_0"] = gltf.accessor(SQUARE_UV[:2])
    elif change == "node cycle":
        gltf.json["nodes"][node]["children"] = [node]
    elif change == "no such mesh":
        gltf.json["nodes"][node]["mesh"] = 7
    elif change == "points only":
        entry["mode"] = 0
    elif change == "nothing shown":
        gltf.json["scenes"] = [{}]
    elif change == "view outside buffer":
        views[0]["byteLength"] = 10**6
    elif change == "accessor outside view":
        position["count"] = 1000
    elif change == "zeros without end":
        del position["bufferView"]
        position["count"] = 10**12
    elif change == "sparse index":
        where = {"bufferView": gltf.view(b"\x63"), "componentType": 5121}
        values = {"bufferView": gltf.view(bytes(12))}
        position["sparse"] = {"count": 1, "indices": where, "values": values}
    elif change == "wrong type":
        position["type"] = "VEC2"
    elif change == "unknown component":
        position["componentType"] = 1
    elif change == "alpha mode":
        gltf.json["materials"][0]["alphaMode"] = "GLASS"
    elif change == "wrap":
        gltf.json["textures"][0]["sampler"] = gltf.add("samplers", wrapS=1)
    elif change == "texture without image":
        del gltf.json["textures"][0]["source"]
    elif change == "ktx2":
        gltf.json["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
        gltf.json["extensionsRequired"] = ["KHR_texture_basisu"]
    elif change == "draco":
        del position["bufferView"]
        entry["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
        gltf.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    elif change == "meshopt":
        views[position["bufferView"]] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {}}}
        path = tmp_path / "bad.gltf"
        gltf.save(path)
        header = json.loads(path.read_text())
        header["buffers"].append({"byteLength": 999})
        path.write_text(json.dumps(header))
        return path
    elif change == "unknown extension":
        gltf.json["extensionsRequired"] = ["ACME_magic"]
    elif change == "image missing":
        gltf.json["images"][0] = {"uri": "wood.png"}
    elif change == "image nowhere":
        gltf.json["images"][0] = {}
    elif change == "image broken":
        gltf.json["images"][0] = {"bufferView": 1}
    elif change == "image on the web":
        gltf.json["images"][0] = {"uri": "https://example.org/wood.png"}
    elif change == "image uri without data":
        gltf.json["images"][0] = {"uri": "data:image/png;base64"}
    elif change == "image not base64":
        gltf.json["images"][0] = {"uri": "data:image/png;base64,!!!"}
    elif change == "no buffer":
        path = tmp_path / "bad.gltf"
        gltf.save(path)
        header = json.loads(path.read_text())
        header["buffers"] = [{"byteLength": 4}]
        path.write_text(json.dumps(header))
        return path
    elif change == "buffer missing":
        path = tmp_path / "bad.gltf"
        gltf.save(path, external=True)
        (tmp_path / "a buffer.bin").unlink()
        return path
    elif change == "buffer truncated":
        path = tmp_path / "bad.gltf"
        gltf.save(path, external=True)
        (tmp_path / "a buffer.bin").write_bytes(b"12")
        return path
    elif change == "glTF 1":
        gltf.json["asset"]["version"] = "1.0"
    elif change == "no asset":
        del gltf.json["asset"]
    elif change == "types":
        gltf.json["nodes"] = "three"
    else:
        data = bytearray(gltf.save(path).read_bytes())
        if change == "truncated":
            data = data[:-20]
        elif change == "header only":
            data = data[:15]
        elif change == "GLB 1":
            struct.pack_into("<I", data, 4, 1)
        elif change == "first chunk":
            data[16:20] = b"BIN\0"
        elif change == "binary chunk":
            at = 20 + struct.unpack_from("<I", data, 12)[0]
            struct.pack_into("<I", data, at, 10**6)
        elif change == "empty":
            data = bytearray()
        elif change == "another type":
            data = bytearray(png(random_image(2, 2)))
        elif change == "not JSON":
            data = bytearray(b'{"asset": NaN}')
        path.write_bytes(data)
        return path
    return gltf.save(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("vertex out of range", "uses vertex 9, but there are 4"),
        ("negative index", "uses vertex -1, but there are 4"),
        ("not finite", "vertices that are not finite"),
        ("colours not finite", "colours are not all finite"),
        ("factor not finite", "Infinity is not JSON|colours are not all finite"),
        ("beyond all bounds", "not all finite"),
        ("infinite transform", "Infinity is not JSON|not all finite"),
        ("no coordinates", "no TEXCOORD_0"),
        ("coordinates not finite", "texture coordinates are not all finite"),
        ("few coordinates", "has 2 rows for 4 vertices"),
        ("node cycle", "reached twice"),
        ("no such mesh", r"meshes\[7\]"),
        ("points only", "no triangles"),
        ("nothing shown", "no triangles"),
        ("view outside buffer", "outside its buffer"),
        ("accessor outside view", "outside its buffer view"),
        ("zeros without end", "elements without data"),
        ("sparse index", "sparse indices outside"),
        ("wrong type", "type VEC2"),
        ("unknown component", "malformed .1 is missing or unknown"),
        ("alpha mode", "unknown alphaMode GLASS"),
        ("wrap", "unknown wrapS 1"),
        ("texture without image", r"textures\[0\] names no image"),
        ("ktx2", "KTX2 textures .KHR_texture_basisu.*gltf-transform"),
        ("draco", "Draco.*KHR_draco_mesh_compression.*gltf-transform copy bad.glb"),
        ("meshopt", "meshopt.*EXT_meshopt_compression.*gltfpack -i bad.gltf"),
        ("unknown extension", "requires the glTF extension ACME_magic"),
        ("no buffer", r"buffers\[0\] has no data"),
        ("buffer missing", "a%20buffer.bin: No such file"),
        ("buffer truncated", r"buffers\[0\] is truncated"),
        ("glTF 1", "is glTF 1.0"),
        ("no asset", "has no asset"),
        ("types", "malformed .a value has the wrong type"),
        ("truncated", "truncated"),
        ("header only", "truncated"),
        ("GLB 1", "GLB version 1"),
        ("first chunk", "first chunk is not JSON"),
        ("binary chunk", "binary chunk ends early"),
        ("empty", "is empty"),
        ("another type", "neither GLB nor JSON"),
        ("not JSON", "NaN is not JSON"),
    ],
)
def test_a_bad_model_is_refused_in_one_line_that_names_it(tmp_path: Path, change: str, message: str) -> None:
    path = broken(change, tmp_path)
    with pytest.raises(ModelError, match=message) as caught:
        load_surface(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("image missing", "wood.png: No such file"),
        ("image nowhere", "neither a uri nor a bufferView"),
        ("image broken", "not an image"),
        ("image on the web", "download it first"),
        ("image uri without data", "data: URI without data"),
        ("image not base64", "not valid base64"),
    ],
)
def test_a_bad_image_is_named(tmp_path: Path, change: str, message: str) -> None:
    with pytest.raises(ImageError, match=message) as caught:
        load_surface(broken(change, tmp_path))
    assert "bad.glb" in str(caught.value)
    assert "images[0]" in str(caught.value)


def test_compressed_content_with_a_plain_copy_beside_it_is_read(tmp_path: Path) -> None:
    gltf = Gltf()
    texture = gltf.add(
        "textures",
        source=gltf.image(png(random_image(4, 4))),
        extensions={"KHR_texture_basisu": {"source": 9}},
    )
    entry = gltf.primitive(uv=SQUARE_UV, material=gltf.material(texture))
    entry["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
    for view in gltf.json["bufferViews"]:
        view["extensions"] = {"EXT_meshopt_compression": {}}
    gltf.show(entry)
    assert_agrees(gltf.save(tmp_path / "a.gltf"))


def test_real_models_agree(models: Path) -> None:
    for name in (
        "BoxTextured/BoxTextured.gltf",
        "BoxVertexColors/BoxVertexColors.gltf",
        "Cube/Cube.gltf",
        "TwoSidedPlane/TwoSidedPlane.gltf",
        "TextureCoordinateTest/TextureCoordinateTest.gltf",
        "TextureSettingsTest/TextureSettingsTest.gltf",
        "assimp-glTF2/textureTransform/TextureTransformTest.gltf",
        "assimp-glTF2/BoxTexcoords-glTF/boxTexcoords.gltf",
        "assimp-glTF2/BoxTextured-glTF-pbrSpecularGlossiness/BoxTextured.gltf",
    ):
        assert_agrees(models / name, 300)
