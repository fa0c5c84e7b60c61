"""The channels that glTF materials state."""

import numpy as np
import pytest

from octex.channels import srgb_to_linear
from octex.errors import ImageError
from octex.source.images.decode import decode_image
from octex.source.load import load_surface
from octex.source.models import gltf as reader
from tests.make.agreement import assert_agrees
from tests.make.fixtures import (
    CLAMP,
    LINEAR,
    NEAREST,
    SQUARE_UV,
    Gltf,
    png,
    random_image,
    textured_square,
)


@pytest.mark.parametrize(("mode", "mag"), [("BLEND", LINEAR), ("MASK", NEAREST)])
def test_alpha_is_a_channel_where_a_material_uses_it(tmp_path, mode, mag):
    image = png(random_image(6, 6, 4))
    path = textured_square(tmp_path / "a.glb", image, mag=mag, factor=(1, 1, 1, 0.7), alphaMode=mode)
    surface = assert_agrees(path, 400)
    assert [channel.name for channel in surface.channels] == ["base_color", "alpha"]
    alpha = surface.evaluate(surface.scatter(100), "alpha")
    assert alpha.shape == (100, 1)
    assert mode == "BLEND" or set(np.unique(alpha)) == {0.0, 1.0}


# Read without interpolation, so that a point's texel is known.
IMAGE = random_image(4, 4, 4, seed=5)


def model(path, **material):
    """A square with one material; its texture 0 has IMAGE."""
    gltf = Gltf()
    gltf.texture(gltf.image(png(IMAGE)), wrap=(CLAMP, CLAMP), mag=NEAREST)
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(**material)))
    return gltf.save(path)


def names(surface):
    return [channel.name for channel in surface.channels]


def texels(samples, lanes):
    """The fractions of IMAGE at points of the square."""
    column = np.minimum(4 * samples.points[:, 0], 3).astype(int)
    row = np.minimum(4 * (1 - samples.points[:, 1]), 3).astype(int)
    return IMAGE[row, column][:, lanes] / 255


def assert_gives(surface, channel, expected, samples):
    np.testing.assert_allclose(surface.evaluate(samples, channel), expected, atol=2e-5)


MAP = {"index": 0}
OLDER, STRENGTH = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_emissive_strength"
SPECULAR, INDEX = "KHR_materials_specular", "KHR_materials_ior"


@pytest.mark.parametrize(
    ("material", "stated"),
    [
        ({}, []),
        ({"pbr": {"metallicFactor": 1.0}}, ["metallic"]),
        ({"pbr": {"roughnessFactor": 0.5}}, ["roughness"]),
        ({"pbr": {"metallicRoughnessTexture": MAP}}, ["metallic", "roughness"]),
        ({"occlusionTexture": MAP}, ["occlusion"]),
        ({"emissiveFactor": [0, 0, 0]}, ["emissive"]),
        ({"emissiveTexture": MAP}, ["emissive"]),
        ({"normalTexture": MAP}, ["normal"]),
        ({"extensions": {STRENGTH: {"emissiveStrength": 5}}}, []),
        ({"extensions": {OLDER: {}}}, ["metallic", "roughness"]),
        ({"extensions": {OLDER: {"specularFactor": [1, 1, 1]}}}, ["metallic", "roughness", "specular"]),
        ({"extensions": {OLDER: {"specularGlossinessTexture": MAP}}}, ["metallic", "roughness", "specular"]),
        ({"extensions": {SPECULAR: {"specularFactor": 1.0}}}, ["specular"]),
        ({"extensions": {INDEX: {"ior": 1.5}}}, ["specular"]),
        ({"extensions": {OLDER: {}, "KHR_materials_unlit": {}}, "normalTexture": MAP}, []),
        ({"extensions": {"KHR_materials_clearcoat": {"clearcoatNormalTexture": {"index": 9}}}}, []),
    ],
)
def test_a_channel_is_what_stands_in_the_file(tmp_path, material, stated):
    surface = load_surface(model(tmp_path / "a.glb", **material))
    assert names(surface) == ["base_color", *stated]


def test_each_channel_is_lanes_of_its_texture_times_factors(tmp_path):
    pbr = {"metallicRoughnessTexture": MAP, "metallicFactor": 0.5, "roughnessFactor": 0.25}
    light = {"emissiveTexture": MAP, "emissiveFactor": [1, 0.5, 0.25]}
    strength = {STRENGTH: {"emissiveStrength": 20}}
    occlusion = MAP | {"strength": 0.25}
    path = model(tmp_path / "a.glb", pbr=pbr, occlusionTexture=occlusion, extensions=strength, **light)
    surface = load_surface(path)
    samples = surface.scatter(50)
    assert_gives(surface, "metallic", 0.5 * texels(samples, (2,)), samples)
    assert_gives(surface, "roughness", 0.25 * texels(samples, (1,)), samples)
    assert_gives(surface, "occlusion", 1 + 0.25 * (texels(samples, (0,)) - 1), samples)
    emitted = srgb_to_linear(texels(samples, (0, 1, 2))) * [20, 10, 5]
    np.testing.assert_allclose(surface.evaluate(samples, "emissive"), emitted, atol=1e-3)
    form = next(channel for channel in surface.channels if channel.name == "emissive")
    assert (form.space, form.dtype) == ("linear", "float16")
    dark = load_surface(model(tmp_path / "b.glb", emissiveTexture=MAP))
    assert_gives(dark, "emissive", 0 * emitted, samples)


@pytest.mark.parametrize(
    ("layer", "index", "along"),
    [
        ({}, {}, [0.04, 0.04, 0.04]),
        ({"specularFactor": 0.5, "specularColorFactor": [1, 2, 100]}, {}, [0.02, 0.04, 1]),
        ({"specularColorFactor": [0, 0.5, 1]}, {"ior": 2.0}, [0, 1 / 18, 1 / 9]),
        ({}, {"ior": 0.0}, [1, 1, 1]),
    ],
)
def test_specular_is_what_is_reflected_along_the_normal(tmp_path, layer, index, along):
    surface = load_surface(model(tmp_path / "a.glb", extensions={SPECULAR: layer, INDEX: index}))
    samples = surface.scatter(50)
    assert_gives(surface, "specular", np.tile(along, (50, 1)), samples)
    textured = {**layer, "specularColorTexture": MAP}
    surface = load_surface(model(tmp_path / "b.glb", extensions={SPECULAR: textured, INDEX: index}))
    assert_gives(surface, "specular", srgb_to_linear(texels(samples, (0, 1, 2))) * along, samples)


def test_older_specular_glossiness_materials_are_smooth_and_no_metals_by_default(tmp_path):
    surface = load_surface(model(tmp_path / "a.glb", extensions={OLDER: {}}, pbr={"metallicFactor": 1.0}))
    samples = surface.scatter(50)
    for name in ("roughness", "metallic"):
        assert_gives(surface, name, np.zeros((50, 1)), samples)


def test_only_images_that_a_wanted_channel_needs_are_read(tmp_path):
    gltf = Gltf()
    gltf.add("images", uri="not there.png")
    there = gltf.texture(gltf.image(png(IMAGE)))
    gone = gltf.add("textures", source=0)
    pbr = {"baseColorTexture": {"index": there}, "metallicRoughnessTexture": {"index": gone}}
    material = gltf.material(pbr=pbr, alphaMode="BLEND", emissiveTexture={"index": gone, "texCoord": 7})
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=material))
    path = gltf.save(tmp_path / "a.glb")
    with pytest.raises(ImageError, match=r"a\.glb: images\[0\] cannot be read: not there\.png"):
        load_surface(path)
    for wanted in (["base_color"], ["alpha"], ["base_color", "alpha"]):
        assert names(load_surface(path, channels=wanted)) == wanted
    with pytest.raises(ImageError, match="not there"):
        load_surface(path, channels=["roughness"])


def test_an_image_is_decoded_once_however_often_it_is_used(tmp_path, monkeypatch):
    decoded = []

    def counted(data, name):
        decoded.append(name)
        return decode_image(data, name)

    monkeypatch.setattr(reader, "decode_image", counted)
    (tmp_path / "a.png").write_bytes(png(IMAGE))
    gltf = Gltf()
    image = gltf.image(png(IMAGE))
    uses = [gltf.texture(image), gltf.texture(image, wrap=(CLAMP, CLAMP))]
    uses += [gltf.texture(gltf.add("images", uri="a.png")) for _ in range(2)]
    pbr = {"baseColorTexture": {"index": uses[0]}, "metallicRoughnessTexture": {"index": uses[1]}}
    material = gltf.material(pbr=pbr, occlusionTexture={"index": uses[2]}, emissiveTexture={"index": uses[3]})
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=material))
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(uses[0])), translation=[2, 0, 0])
    load_surface(gltf.save(tmp_path / "a.glb"))
    assert sorted(decoded) == ["a.glb: images[0]", "a.glb: images[1] (a.png)"]


def test_each_texture_of_a_material_has_its_own_coordinates(tmp_path):
    gltf = Gltf()
    gltf.texture(gltf.image(png(IMAGE)), wrap=(CLAMP, CLAMP), mag=NEAREST)
    other = MAP | {"texCoord": 1}
    both = gltf.material(pbr={"baseColorTexture": MAP, "metallicRoughnessTexture": other})
    second = gltf.accessor(np.ascontiguousarray(SQUARE_UV[:, ::-1]))
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=both, TEXCOORD_1=second))
    # One with fewer sets, of another number; its points must not read the other's.
    single = gltf.material(pbr={"metallicRoughnessTexture": MAP | {"texCoord": 2}})
    third = gltf.accessor(np.float32([1, 1]) - SQUARE_UV)
    gltf.show(gltf.primitive(material=single, TEXCOORD_2=third), translation=[0, 0, 1])
    surface = load_surface(gltf.save(tmp_path / "a.glb"))
    samples = surface.scatter(100)
    lower = samples.points[:, 2] < 0.5
    x, y = samples.points[:, 0], samples.points[:, 1]

    def at(u, v, lane):
        column, row = (np.minimum(4 * t, 3).astype(int) for t in (u, v))
        return (IMAGE[row, column, lane] / 255)[:, None]

    color = srgb_to_linear(at(x, 1 - y, 0))
    np.testing.assert_allclose(surface.evaluate(samples)[lower, :1], color[lower], atol=2e-5)
    expected = np.where(lower[:, None], at(1 - y, x, 1), at(1 - x, y, 1))
    np.testing.assert_allclose(surface.evaluate(samples, "roughness"), expected, atol=2e-5)


def test_the_surface_keeps_the_first_coordinates_as_they_stand_in_the_file_if_all_have_them(tmp_path):
    gltf = Gltf()
    gltf.texture(gltf.image(png(IMAGE)))
    turned = MAP | {"extensions": {"KHR_texture_transform": {"rotation": 1.0}}}
    gltf.show(gltf.primitive(uv=SQUARE_UV, material=gltf.material(turned)))
    uv = load_surface(gltf.save(tmp_path / "a.glb")).uv
    np.testing.assert_array_equal(uv.values[uv.rows], SQUARE_UV[[[0, 1, 2], [0, 2, 3]]])
    second = {"TEXCOORD_1": gltf.accessor(SQUARE_UV)}
    gltf.show(gltf.primitive(material=gltf.material(MAP | {"texCoord": 1}), **second))
    assert load_surface(gltf.save(tmp_path / "a.glb")).uv is None


def test_extensions_of_materials_that_are_required_and_change_no_channel_are_passed_over(tmp_path):
    gltf = Gltf()
    sheen = {"KHR_materials_sheen": {"sheenColorTexture": {"index": 3}}}
    gltf.json["extensionsRequired"] = ["KHR_materials_sheen"]
    gltf.show(gltf.primitive(material=gltf.material(extensions=sheen)))
    assert names(load_surface(gltf.save(tmp_path / "a.glb"))) == ["base_color"]
