"""How large baked maps are, and how their images are stored."""

from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import octex
from octex.baking import atlas
from octex.baking.coordinates import leaf_of
from octex.baking.layout import unit_area
from octex.baking.sheets import coordinates_of, sheets_of
from octex.baking.texels import draw_texels
from octex.channels import encode
from octex.cli.common import bytes_text
from octex.errors import ModelError
from octex.source.materials import Input, Material, MaterialSource, Texture
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.baking.test_bake import cube_with_charts, on_disk, psnr, scattered_triangles, two_squares
from tests.make.painted import square, waves
from tests.make.small_surfaces import whole
from tests.oracles.naive_gltf import Document

DROID = Path(octex.__file__).parents[1] / "samples" / "droid.glb"


@pytest.fixture(scope="module")
def droid():
    surface = octex.load_surface(DROID)
    return octex.convert(surface, 8, channels=["base_color"]), surface


@pytest.fixture(scope="module")
def fine_droid(droid):
    """The droid at a depth of which less than a hundredth of the texels overlap."""
    return octex.convert(droid[1], 9, channels=["base_color"])


def sizes_of(baked):
    """Return the sizes of the base colours' maps."""
    textures = [each.inputs["base_color"].texture for each in baked.source.materials]
    return [each.texels.shape[0] for each in textures if each is not None]


@pytest.mark.parametrize("uv", ["atlas", "xatlas"])
def test_all_charts_of_the_droid_have_room_in_small_maps(droid, uv):
    if uv == "xatlas":
        pytest.importorskip("xatlas", reason="the extra octex[atlas] is not installed")
    texture, surface = droid
    baked = octex.bake(texture, surface, uv=uv, texture_size=64)
    assert sizes_of(baked) == [64]
    points = baked.scatter(20_000, seed=1)
    assert psnr(baked.evaluate(points), texture.sample(points, "base_color")) > 19.0


@pytest.mark.parametrize("size", [64, None])
def test_whether_coordinates_are_kept_does_not_depend_on_the_size(droid, fine_droid, size):
    _, surface = droid
    with ThreadPoolExecutor(1) as pool:
        sheets = sheets_of(
            fine_droid, surface.placed_on(fine_droid), ["base_color"], "auto", size, None, pool
        )
    kept = coordinates_of(sheets, len(surface.triangles))
    (own,) = surface.source.coordinates
    is_same = np.isclose(kept.values[kept.rows], own.values[own.rows], atol=1e-6).all(axis=(1, 2))
    has_coordinates = (own.values[own.rows] != 0.0).any(axis=(1, 2))  # parts without get an atlas
    assert (is_same == has_coordinates).mean() > 0.99


@pytest.mark.parametrize(("uv", "most"), [("keep", 4.0), ("atlas", 2.5)])
def test_maps_of_the_default_size_are_as_sharp_as_the_texture(droid, uv, most):
    texture, surface = droid
    baked = octex.bake(texture, surface, uv=uv)
    points = baked.scatter(20_000, seed=1)
    missed = encode(baked.evaluate(points), "uint8", "srgb").astype(np.float64)
    missed -= encode(texture.sample(points, "base_color"), "uint8", "srgb")
    assert np.sqrt((missed**2).mean()) < most  # 9.3 and 5.8 where texels have the area of a leaf
    assert sizes_of(baked)[0] <= 1024


def test_maps_of_smooth_colours_are_no_finer_than_the_leaves():
    surface = two_squares()
    slow = octex.convert(surface.with_sources({"base_color": lambda points: 0.5 + 0.1 * np.sin(points)}), 7)
    sharp = octex.convert(
        surface.with_sources({"base_color": lambda points: np.repeat(points[:, :1] * 20 % 1 > 0.5, 3, 1)}), 7
    )
    leaves_a_side = 64  # the root cell is about 2 wide
    assert sizes_of(octex.bake(slow, surface))[0] == leaves_a_side
    assert sizes_of(octex.bake(sharp, surface))[0] == 4 * leaves_a_side


@pytest.mark.parametrize(("count", "padding"), [(6, 4), (100, 2), (300, 1), (1200, 0)])
def test_an_atlas_with_more_charts_has_less_padding(count, padding):
    layout = atlas.atlas_layout(scattered_triangles(count), [256], None, 1e-4)
    assert layout.padding == padding
    assert unit_area(layout) >= 0.25
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, 256, 0, 256)
    shown = drawn.triangles >= 0
    # Nothing of another chart lies within twice the padding of a texel.
    for move in range(1, 2 * padding - 1):
        for axis in (0, 1):
            one, two = (np.moveaxis(each, axis, 0) for each in (shown, drawn.triangles))
            both = one[move:] & one[:-move]
            assert (two[move:] == two[:-move])[both].all()


def test_maps_are_as_fine_as_the_leaves_on_their_triangles():
    surface = two_squares()
    texture = octex.convert(surface.with_sources({"base_color": waves}), 7)
    fine = octex.fill(texture, surface, octex.Box((-1, -1, -1), (0.9, 2, 2)), (1.0, 0.0, 0.0), max_depth=9)
    assert fine.tree.max_depth == 9
    size = sizes_of(octex.bake(texture, surface))[0]
    assert sizes_of(octex.bake(fine, surface)) == [4 * size, size]
    spot = octex.fill(texture, surface, octex.Sphere((0.5, 0.5, 0.0), 0.02), (1.0, 0.0, 0.0), max_depth=9)
    assert spot.tree.max_depth == 9
    assert sizes_of(octex.bake(spot, surface)) == [size, size]


def test_where_a_texture_is_not_its_finest_cells_count():
    surface = two_squares()
    texture = octex.convert(surface.with_sources({"base_color": waves}), 5)
    away = Surface.from_arrays(surface.rest + 9.0, surface.triangles)
    assert leaf_of(texture, surface) == leaf_of(texture, away) == texture.placement.size / 32


def inputs_of(baked):
    return dict(baked.source.materials[0].inputs)


VARIED = {
    "base_color": waves,
    "alpha": lambda points: 0.2 + 0.6 * waves(points)[:, :1],
    "occlusion": lambda points: waves(points)[:, :1],
    "roughness": lambda points: waves(points)[:, 1:2],
    "metallic": lambda points: waves(points)[:, 2:],
    "emissive": waves,
    "specular": waves,
}
PLAIN = {
    "base_color": (0.2, 0.5, 0.8), "alpha": 0.6, "occlusion": 1.0, "roughness": 0.6, "metallic": 0.2,
    "emissive": (0.0, 0.2, 2.0), "specular": (0.02, 0.03, 0.04),
}  # fmt: skip


@pytest.mark.parametrize(
    ("plain", "bits"),
    [*((plain, 8) for plain in (*PLAIN, "all")), ("metallic", 16), ("alpha", 32), ("all", 16), ("all", 32)],
)
def test_channels_that_do_not_vary_are_numbers(plain, bits, tmp_path):
    names = list(PLAIN) if plain == "all" else [plain]
    surface = cube_with_charts().with_sources({**VARIED, **{name: PLAIN[name] for name in names}})
    texture = octex.convert(surface, 4)
    baked = octex.bake(texture, surface, texture_size=64, bits=bits)
    inputs = inputs_of(baked)
    assert {name for name in PLAIN if inputs[name].texture is None} == set(names)
    for name in names:
        assert inputs[name].factor == pytest.approx(np.atleast_1d(PLAIN[name]), abs=3e-3)
    paths = [tmp_path / "a.obj"] if "emissive" not in names else []
    if bits != 32:
        paths.append(tmp_path / "a.glb")
    points = baked.scatter(500)
    for path in paths:
        octex.write_model(baked, path, images="exr" if bits == 32 else "png")
        read = octex.load_surface(path)
        for name in PLAIN:
            if name in [form.name for form in read.channels]:
                np.testing.assert_allclose(
                    read.evaluate(points, name), baked.evaluate(points, name), atol=1e-2, err_msg=name
                )


def test_a_number_between_two_codes_needs_no_image_but_occlusion_that_is_not_1_does():
    surface = cube_with_charts().with_sources({**VARIED, "roughness": 0.7})
    texture = octex.convert(surface, 4)
    assert np.ptp(texture.channels["roughness"].values) == 1  # cells are rounded either way
    given = inputs_of(octex.bake(texture, surface, texture_size=64))["roughness"]
    assert given.texture is None
    assert given.factor == pytest.approx((0.7,), abs=3e-3)
    surface = cube_with_charts().with_sources({"base_color": waves, "occlusion": 0.5})
    given = inputs_of(octex.bake(octex.convert(surface, 4), surface, texture_size=64))["occlusion"]
    assert abs(given.texture.texels[..., 0] / 65535 - 0.5).max() < 0.01


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_normals_of_the_surface_need_no_image(tilt):
    image = np.tile(np.array([tilt, 0.0, 1.0]) / np.hypot(tilt, 1.0), (4, 4, 1))
    codes = np.rint((image + 1) * 32767.5).astype(np.uint16)
    points, triangles = square(side=1.0, steps=2)
    plain = Surface.from_arrays(points, triangles, uv=0.1 + 0.8 * (points[:, :2] + 0.5))
    texels = np.concatenate([codes, np.full((4, 4, 1), 65535, np.uint16)], axis=2)
    frames = corner_frames(plain.rest, plain.triangles, None, None, plain.uv)
    source = MaterialSource(
        [Material({"normal": Input((1.0,) * 3, Texture(texels))})],
        np.zeros(len(plain.triangles), np.int32), plain.rest, plain.triangles, coordinates=[plain.uv],
        frames=frames,
    )  # fmt: skip
    surface = Surface(plain.vertices, plain.triangles, source, uv=plain.uv, frames=frames)
    baked = octex.bake(octex.convert(surface, 5), surface, texture_size=64)
    assert (inputs_of(baked)["normal"].texture is None) == (tilt == 0.0)
    seen = baked.scatter(500)
    expected = surface.evaluate(seen, "normal")
    np.testing.assert_allclose(baked.evaluate(seen, "normal"), expected, atol=0.02)


@pytest.fixture(scope="module")
def baked_whole():
    surface = whole()
    channels = ["base_color", "roughness", "normal"]
    return octex.bake(octex.convert(surface, 4), surface, texture_size=64, channels=channels)


KINDS = {"png": ["png"] * 3, "webp": ["webp"] * 3, "jpeg": ["jpeg", "png", "png"], "jpeg-all": ["jpeg"] * 3}


@pytest.mark.parametrize(
    ("ending", "images"),
    [*product((".glb", ".gltf"), KINDS), *product((".obj", ".usdc"), ("jpeg", "jpeg-all"))],
)
def test_jpeg_is_for_colours_unless_all_is_asked_for(baked_whole, images, ending, tmp_path):
    if ending == ".usdc":
        pytest.importorskip("pxr", reason="the extra octex[usd] is not installed")
    baked, kinds = baked_whole, KINDS[images]
    written = octex.write_model(baked, tmp_path / f"a{ending}", images=images)
    assert sorted(written.files) == sorted(tmp_path.iterdir())
    if ending != ".glb":
        made = [path for path in written.files if path.suffix[1:] in {*kinds, "png"}]
        assert [path.suffix[1:] for path in made] == kinds
        assert written.image_bytes == sum(path.stat().st_size for path in made)
        for path in made:
            with PIL.Image.open(path) as image:
                assert image.format == path.suffix[1:].upper()
    else:
        document = Document(written.files[0]).json
        assert [each["mimeType"] for each in document["images"]] == [f"image/{each}" for each in kinds]
        views = [document["bufferViews"][each["bufferView"]]["byteLength"] for each in document["images"]]
        assert written.image_bytes == sum(views)
        required = ["EXT_texture_webp"] if images == "webp" else None
        assert document.get("extensionsRequired") == required
    points = baked.scatter(500)
    read = octex.load_surface(tmp_path / f"a{ending}")
    assert psnr(read.evaluate(points), baked.evaluate(points)) > (28.0 if "jpeg" in images else 60.0)
    near = 0.3 if images == "jpeg-all" else 3e-3
    np.testing.assert_allclose(
        read.evaluate(points, "roughness"), baked.evaluate(points, "roughness"), atol=near
    )


def test_large_images_are_told_and_smaller_formats_offered(tmp_path, cli, monkeypatch):
    given = on_disk(tmp_path)

    def told(output, *options):
        return cli.result(*given, tmp_path / output, "--texture-size", 256, *options)

    assert "--image-format" not in told("small.glb")
    monkeypatch.setattr("octex.cli.bake._LARGE", 1000)
    made = told("large.gltf")
    sizes = [path.stat().st_size for path in sorted(tmp_path.glob("large*"))]
    assert len(sizes) == 3
    assert bytes_text(sum(sizes)) in made
    size = bytes_text((tmp_path / "large-0.png").stat().st_size)
    assert f"its images take {size}: --image-format webp is smaller and lossless, jpeg" in made
    assert "--image-format" not in told("webp.glb", "--image-format", "webp")
    assert (tmp_path / "webp.glb").stat().st_size < sum(sizes)


def test_a_material_whose_image_gltf_would_multiply_by_its_number_is_refused(tmp_path):
    plain = cube_with_charts()
    texture = Texture(np.full((4, 4, 4), 30000, np.uint16))
    owners = np.zeros(len(plain.triangles), np.int32)
    for inputs, words in (
        ({"alpha": Input((1.0,), texture, (3,))}, "base_color and alpha in one image"),
        ({"metallic": Input((1.0,), texture, (2,)), "roughness": Input((0.5,))}, "metallic and roughness in"),
    ):
        source = MaterialSource(
            [Material(inputs, "blend")], owners, plain.rest, plain.triangles, coordinates=[plain.uv]
        )
        surface = Surface(plain.vertices, plain.triangles, source, uv=plain.uv)
        with pytest.raises(ModelError, match=words):
            octex.write_model(surface, tmp_path / "a.glb")
