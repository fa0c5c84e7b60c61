"""Materials of any channels, against reads written out in the open."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from octex.channels import CHANNELS, srgb_to_linear
from octex.errors import ArgumentError, ModelError
from octex.source.corners import Corners, Frames
from octex.source.images.filters import FILTERS
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT, WRAPS
from octex.source.materials import Input, Material, MaterialSource, Texture
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, random_image
from tests.make.small_textures import unit
from tests.oracles import naive_filters

TRIANGLES = SQUARE_TRIANGLES.astype(np.int32)
UV = Corners(SQUARE_UV, TRIANGLES)
COUNT = 30
WHITE = (1.0, 1.0, 1.0)


def source(*materials, **options):
    """The unit square; with two materials, one for each triangle."""
    numbers = np.array([0, len(materials) - 1], np.int32)
    options = {"coordinates": [UV], **options}
    return MaterialSource(materials, numbers, SQUARE.astype(float), TRIANGLES, **options)


def points(seed=0):
    random = np.random.default_rng(seed)
    return random.integers(0, 2, COUNT).astype(np.int32), random.dirichlet([1, 1, 1], COUNT)


def values(given, channel=None, width=0.0, seed=0):
    """Values of a channel, or of all, at points."""
    found = given.evaluate(*points(seed), np.full(COUNT, width, np.float32)).astype(float)
    ends = np.cumsum([0, *(form.components for form in given.channels)]).tolist()
    if channel is None:
        assert found.shape == (COUNT, ends[-1])
        return found
    at = [form.name for form in given.channels].index(channel)
    return found[:, ends[at] : ends[at + 1]]


def at_points(corners):
    """What is bound to corners, at points."""
    triangles, barycentric = points()
    return np.einsum("nc,nck->nk", barycentric, corners.values[corners.rows[triangles]].astype(float))


def texture(texels, wrap=REPEAT, **options):
    return Texture(texels, wrap, wrap, **options)


def reads(given, space):
    """The four lanes of an image at points, decoded; written out."""
    texels = given.texels.astype(float)
    if given.texels.dtype == np.uint16:
        texels /= 65535
        if space == "srgb":
            texels[..., :3] = srgb_to_linear(texels[..., :3])
    wraps = (WRAPS[given.wrap_u], WRAPS[given.wrap_v])
    return naive_filters.dense_reads(texels, wraps, at_points(UV), given.nearest)


def image(height, width, seed=0):
    return random_image(height, width, 4, "uint16", seed)


def names(given):
    return [form.name for form in given.channels]


def test_a_channel_is_an_offset_and_factors_times_lanes_of_texels():
    color, maps, light = texture(image(5, 4)), texture(image(3, 6, 1), CLAMP), texture(image(5, 4, 2), MIRROR)
    material = Material(
        {
            "normal": Input(WHITE),
            "roughness": Input((-0.6,), maps, (3,), (1.0,)),
            "metallic": Input((0.7,), maps, (2,)),
            "occlusion": Input((0.4,), maps, (0,), (0.6,)),
            "base_color": Input((0.5, 0.25, 1.0), color),
            "emissive": Input((0.1, 0.2, 0.3), light, (2, 0, 1), (0.0, 0.5, 0.0)),
            "specular": Input((0.04, 0.05, 0.06)),
        }
    )
    given = source(material)
    assert [form.name for form in given.channels] == [
        "base_color", "metallic", "roughness", "occlusion", "emissive", "specular"
    ]  # fmt: skip
    assert given.channels == tuple(CHANNELS[name] for name in names(given))
    data = reads(maps, "data")
    expected = {
        "base_color": reads(color, "srgb")[:, :3] * [0.5, 0.25, 1.0],
        "metallic": 0.7 * data[:, 2:3],
        "roughness": 1.0 - 0.6 * data[:, 3:4],
        "occlusion": 0.6 + 0.4 * data[:, :1],
        "emissive": reads(light, "srgb")[:, [2, 0, 1]] * [0.1, 0.2, 0.3] + [0, 0.5, 0],
        "specular": np.tile([0.04, 0.05, 0.06], (COUNT, 1)),
    }
    for name, wanted in expected.items():
        np.testing.assert_allclose(values(given, name), wanted, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(values(given), np.hstack(list(expected.values())), atol=1e-5)


def test_a_material_without_a_channel_gives_its_default():
    stated = {name: Input((0.25,) * form.components) for name, form in CHANNELS.items()}
    given = source(Material(), Material(stated, "blend"), frames=frames())
    assert names(given) == list(CHANNELS)
    first = points()[0] == 0
    defaults = {name: 1.0 for name in CHANNELS if name != "normal"} | {"emissive": 0.0, "specular": 0.04}
    for name, default in defaults.items():
        np.testing.assert_array_equal(values(given, name)[first], np.float32(default))
        np.testing.assert_array_equal(values(given, name)[~first], 0.25)
    assert names(source(Material())) == ["base_color"]


def test_channels_of_materials_that_no_triangle_uses_are_not_there():
    unused = Material({"metallic": Input((0.5,))}, "blend")
    given = MaterialSource([unused, Material()], np.ones(2, np.int32), SQUARE.astype(float), TRIANGLES)
    assert names(given) == ["base_color"]


def test_alpha_counts_as_its_mode_says():
    texels = texture(image(5, 5), nearest=True)
    alpha = reads(texels, "data")[:, 3]
    inputs = {"base_color": Input(WHITE, texels), "alpha": Input((0.5,), texels, (3,))}
    assert "alpha" not in names(source(Material(inputs, "opaque")))
    np.testing.assert_allclose(values(source(Material(inputs, "blend")), "alpha")[:, 0], alpha / 2, atol=1e-5)
    masked = values(source(Material(inputs, "mask", 0.2)), "alpha")[:, 0]
    np.testing.assert_array_equal(masked, alpha / 2 >= 0.2)
    masked = values(source(Material(inputs, "mask", 0.2)), "alpha", 100.0)
    np.testing.assert_allclose(masked, (texels.texels[..., 3] >= 0.4 * 65535).mean(), atol=1e-3)
    nothing = {**inputs, "alpha": Input((0.0,), texels, (3,))}
    assert not values(source(Material(nothing, "mask", 0.2)), "alpha").any()
    both = values(source(Material(inputs, "opaque"), Material(inputs, "blend")), "alpha")[:, 0]
    np.testing.assert_allclose(both, np.where(points()[0] == 0, 1, alpha / 2), atol=1e-5)


def test_alpha_without_an_image_is_its_factor():
    inputs = {"alpha": Input((0.4,))}
    colors = Corners(np.float32([[1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]]), TRIANGLES)
    x = at_points(colors)[:, 3]
    np.testing.assert_allclose(
        values(source(Material(inputs, "blend"), colors=colors), "alpha")[:, 0], 0.4 * x
    )
    masked = values(source(Material(inputs, "mask", 0.1), colors=colors), "alpha")[:, 0]
    np.testing.assert_array_equal(masked, 0.4 * x >= 0.1)
    assert (values(source(Material({}, "mask")), "alpha") == 1).all()


def test_alpha_of_an_image_of_its_own_weighs_no_colour():
    color, cover = texture(image(4, 4)), texture(image(3, 3, 1))
    inputs = {"base_color": Input(WHITE, color), "alpha": Input((1.0,), cover, (0,))}
    given = source(Material(inputs, "blend"))
    np.testing.assert_allclose(values(given, "base_color"), reads(color, "srgb")[:, :3], atol=1e-5)
    np.testing.assert_allclose(values(given, "alpha"), reads(cover, "data")[:, :1], atol=1e-5)
    masked = values(source(Material(inputs, "mask", 0.3)), "alpha")
    np.testing.assert_array_equal(masked, reads(cover, "data")[:, :1] >= 0.3)


def test_light_above_1_is_kept_as_light():
    def formats(material, **options):
        return {form.name: (form.space, form.dtype) for form in source(material, **options).channels}

    usual, bright = ("srgb", "uint8"), ("linear", "float16")
    lamp = Material({"emissive": Input((0.5, 5.0, 0.0)), "metallic": Input((1.0,))})
    assert formats(lamp) == {"base_color": usual, "metallic": ("data", "uint8"), "emissive": bright}
    np.testing.assert_allclose(values(source(lamp), "emissive"), [[0.5, 5, 0]] * COUNT)
    texels = (4 * np.random.default_rng(0).random((4, 4, 4))).astype(np.float32)
    texels[..., 3] = 1.0
    sky = Material({"base_color": Input(WHITE, texture(texels))})
    assert formats(sky) == {"base_color": bright}
    np.testing.assert_allclose(values(source(sky)), reads(texture(texels), "srgb")[:, :3], rtol=1e-5)
    dim = Material({"base_color": Input(WHITE, texture(texels / 4))})
    assert formats(dim) == {"base_color": usual}
    colors = Corners(np.full((4, 4), 2.0, np.float32), TRIANGLES)
    assert formats(Material(), colors=colors) == {"base_color": bright}
    assert formats(Material({"emissive": Input(WHITE, None, (0, 1, 2), WHITE)}))["emissive"] == bright
    assert formats(Material({"emissive": Input(WHITE, texture(image(2, 2)))}))["emissive"] == usual


def everything(**options):
    texels, maps = texture(image(8, 8)), texture(image(4, 6, 1), CLAMP)
    inputs = {
        "base_color": Input(WHITE, texels),
        "alpha": Input((1.0,), texels, (3,)),
        "roughness": Input((1.0,), maps, (1,)),
        "emissive": Input((3.0, 3.0, 3.0), maps),
        "normal": Input((0.5, 0.5, 1.0), maps),
    }
    return source(Material(inputs, "blend"), **{"frames": frames(), **options})


def frames(turn=None):
    """Shading normals about z and tangents about x, different at each vertex, turned by a rotation."""
    random = np.random.default_rng(6)
    turn = np.eye(3) if turn is None else turn
    normals = unit(random.normal((0, 0, 1), 0.3, (4, 3))) @ turn.T
    along = unit(random.normal((1, 0, 0), 0.3, (4, 3))) @ turn.T
    along = unit(along - (along * normals).sum(axis=1, keepdims=True) * normals)
    tangents = np.column_stack([along, np.ones(4)]).astype(np.float32)
    return Frames(Corners(normals.astype(np.float32), TRIANGLES), Corners(tangents, TRIANGLES))


def axes(given):
    """Tangent, bitangent and normal (n, 3, 3) at points, by rows."""
    normal = unit(at_points(given.normals))
    along = at_points(given.tangents)[:, :3]
    tangent = unit(along - (along * normal).sum(axis=1, keepdims=True) * normal)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)


@pytest.mark.parametrize("width", [0.0, 0.3])
def test_channels_chosen_are_the_same_columns_of_fewer(width):
    whole = everything()
    assert names(whole) == ["base_color", "alpha", "roughness", "emissive", "normal"]
    for chosen in (["alpha"], ["normal", "roughness"], ["emissive", "base_color"], names(whole)):
        asked, only = everything(channels=chosen), whole.only(chosen)
        assert names(asked) == names(only) == [name for name in CHANNELS if name in chosen]
        assert only.channels == asked.channels
        for name in chosen:
            expected = values(whole, name, width)
            np.testing.assert_allclose(values(asked, name, width), expected, atol=1e-6)
            np.testing.assert_allclose(values(only, name, width), expected, atol=1e-6)
    assert whole.only(names(whole)) is whole
    assert names(everything(frames=None)) == names(whole)[:-1]


def test_channels_that_the_materials_lack_are_refused_with_those_they_have():
    message = "^box has no channel occlusion, metal; it has base_color, alpha, roughness, emissive, normal$"
    with pytest.raises(ModelError, match=message):
        everything(channels=["alpha", "occlusion", "metal"], name="box")


@pytest.mark.parametrize("filter", FILTERS)
def test_another_filter_is_as_if_it_had_been_asked_for(filter):
    given = everything()
    values(given)
    np.testing.assert_array_equal(
        values(given.with_filter(filter), width=0.3), values(everything(filter=filter), width=0.3)
    )
    with pytest.raises(ArgumentError, match="unknown filter 'sharp'; there are: nearest, bilinear"):
        given.with_filter("sharp")
    with pytest.raises(ArgumentError, match="unknown filter 'sharp'"):
        everything(filter="sharp")


def test_a_source_is_pickled_before_and_after_its_first_use():
    given = everything()
    fresh = pickle.loads(pickle.dumps(given))
    expected = values(given, width=0.2)
    used = pickle.loads(pickle.dumps(given))
    for each in (fresh, used):
        assert each.channels == given.channels
        np.testing.assert_array_equal(values(each, width=0.2), expected)


def test_the_first_use_may_come_from_many_threads_at_once():
    expected = values(everything(), width=0.2)
    for _ in range(3):
        given, start = everything(), Barrier(6)

        def use(_, given=given, start=start):
            start.wait()
            return values(given, width=0.2)

        with ThreadPoolExecutor(6) as pool:
            for found in pool.map(use, range(6)):
                np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colors": Corners(np.full((4, 4), np.nan, np.float32), TRIANGLES)}, "colours are not all finite"),
        ({"coordinates": [Corners(np.full((4, 2), np.inf, np.float32), TRIANGLES)]}, "texture coordinates"),
        ({"coordinates": []}, "an image reads set 0 of texture coordinates, which is missing"),
        ({"inputs": {"metallic": Input((np.nan,))}}, "colours are not all finite"),
        ({"inputs": {"metallic": Input((1.0,), None, (0,), (np.inf,))}}, "colours are not all finite"),
    ],
)
def test_what_is_not_there_or_not_finite_is_refused(options, message):
    inputs = options.pop("inputs", {"base_color": Input(WHITE, texture(image(2, 2)))})
    with pytest.raises(ModelError, match=f"box: {message}"):
        source(Material(inputs), name="box", **options)


def test_coordinates_that_no_texture_reads_may_be_anything():
    broken = Corners(np.full((4, 2), np.nan, np.float32), TRIANGLES)
    given = source(Material({"base_color": Input(WHITE, texture(image(2, 2)))}), coordinates=[UV, broken])
    assert np.isfinite(values(given)).all()


def normal_map(directions):
    """A normal map of floats, (direction + 1) / 2."""
    texels = np.ones((*np.shape(directions)[:-1], 4), np.float32)
    texels[..., :3] = (np.asarray(directions, float) + 1) / 2
    return texture(texels)


def normals(given, placed, factor=WHITE, **options):
    return source(
        Material({"normal": Input(tuple(factor), given)}), frames=placed, channels=["normal"], **options
    )


@pytest.mark.parametrize("width", [0.0, 0.2])
def test_a_flat_normal_map_and_none_give_the_shading_normal(width):
    placed = frames()
    expected = axes(placed)[:, 2]
    for given in (normal_map([[[0.0, 0, 1]]]), None):
        np.testing.assert_allclose(values(normals(given, placed), width=width), expected, atol=1e-4)
    mixed = source(Material(), Material({"normal": Input(WHITE, normal_map([[[1.0, 0, 0]]]))}), frames=placed)
    first = points()[0] == 0
    np.testing.assert_allclose(values(mixed, "normal", width)[first], expected[first], atol=1e-4)
    np.testing.assert_allclose(values(mixed, "normal", width)[~first], axes(placed)[~first, 0], atol=1e-4)


def test_a_texel_that_points_nowhere_points_straight_up():
    found = values(normals(normal_map([[[0.0, 0, 0]]]), frames()))
    np.testing.assert_allclose(found, axes(frames())[:, 2], atol=1e-4)


@pytest.mark.parametrize("filter", ["bilinear", "trilinear", "ewa"])
def test_normals_come_back_through_their_frame_and_their_means_are_shorter(filter):
    random = np.random.default_rng(8)
    directions = unit(random.normal((0, 0, 1), 0.5, (6, 6, 3)))
    placed, texels = frames(), normal_map(directions)
    for width in (0.0, 0.25):
        found = values(normals(texels, placed, filter=filter), width=width)
        tangent = np.einsum("nkx,nx->nk", axes(placed), found)
        both = [naive_filters.Axis(6, "repeat")] * 2
        jacobian = np.diag([6 * width, -6 * width])
        shares = [naive_filters.weights(filter, *both, uv, jacobian) for uv in at_points(UV)]
        mean = np.array([naive_filters.filtered(directions, share) for share in shares])
        np.testing.assert_allclose(tangent, unit(mean) if width == 0 else mean, atol=1e-3)
        lengths = np.linalg.norm(found, axis=1)
        if width == 0:
            np.testing.assert_allclose(lengths, 1, atol=1e-5)
        else:
            assert (lengths < 0.999).all()


def test_normals_follow_the_rest_mesh():
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    given = everything()
    rest = SQUARE.astype(float)
    for width in (0.0, 0.3):
        expected = values(given, "normal", width) @ turn.T
        turned = given.with_rest(rest @ turn.T + 5)
        np.testing.assert_allclose(values(turned, "normal", width), expected, atol=1e-5)
        np.testing.assert_allclose(
            values(turned, "roughness", width), values(given, "roughness", width), atol=1e-5
        )
        larger = given.with_rest(rest @ turn.T * 7)
        np.testing.assert_allclose(values(larger, "normal", 7 * width), expected, atol=1e-5)
        back = turned.with_rest(rest)
        np.testing.assert_allclose(values(back, "normal", width), values(given, "normal", width), atol=1e-5)
    again = everything(frames=frames(turn)).with_rest(rest)
    np.testing.assert_allclose(values(again, "normal"), values(given, "normal") @ turn.T, atol=1e-5)


def test_averages_of_a_mask_take_the_vertex_alpha_under_its_own_material():
    texels = image(16, 16)
    each = texture(texels)
    inputs = {"base_color": Input(WHITE, each), "alpha": Input((1.0,), each, (3,))}
    mask, blend = Material(inputs, "mask", 0.25), Material(inputs, "blend")
    rows = np.arange(6, dtype=np.int32).reshape(2, 3)
    colors = np.ones((6, 4), np.float32)
    colors[:3, 3], colors[3:, 3] = 0.5, 0.1
    given = source(mask, blend, colors=Corners(colors, rows))
    triangles, _ = points()
    found = values(given, "alpha", width=1000.0)[:, 0]
    share = (texels[..., 3] >= 0.5 * 65535).mean()
    np.testing.assert_allclose(found[triangles == 0], share, atol=1e-3)
    np.testing.assert_allclose(found[triangles == 1], 0.1 * texels[..., 3].mean() / 65535, atol=1e-3)
