"""Sources of values in general: one of one's own, and several together."""

import hashlib
import json
import re

import numpy as np
import PIL.Image
import pytest

from octex.channels import CHANNELS, srgb_to_linear
from octex.errors import ArgumentError, ImageError, ModelError
from octex.source.base import Combined, Source, in_order
from octex.source.corners import Corners, Frames
from octex.source.images.filters import FILTERS
from octex.source.surface import Surface, SurfaceSamples
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, png, random_image

UV_UP = SQUARE_UV * [1, -1] + [0, 1]


class Ramp(Source):
    """Everything it is asked for, told apart: the channel's number and the triangle's, and the width."""

    def __init__(self, *names, scale=1.0, filter="ewa"):
        self.names, self.scale, self.filter = names, scale, filter
        self.calls = 0

    @property
    def channels(self):
        return tuple(CHANNELS[name] for name in self.names)

    def evaluate(self, triangles, barycentric, widths):
        self.calls += 1
        value = triangles + widths * self.scale + barycentric[:, 0]
        columns = [
            np.full((len(value), form.components), list(CHANNELS).index(form.name)) + value[:, None]
            for form in self.channels
        ]
        return np.hstack(columns).astype(np.float32)

    def with_rest(self, rest):
        return Ramp(*self.names, scale=1 / float(np.ptp(rest)), filter=self.filter)

    def with_filter(self, name):
        return Ramp(*self.names, scale=self.scale, filter=name)


def values(source, width=0.5):
    barycentric = np.array([[0.25, 0.25, 0.5]] * 2)
    return source.evaluate(np.array([0, 1], np.int32), barycentric, np.full(2, width, np.float32))


def square(**options):
    return Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, **{"uv": UV_UP, "name": "quad", **options})


def one(surface, channel, width=None):
    return surface.evaluate(surface.scatter(20), channel, width)


def test_a_source_needs_channels_and_values_alone():
    class Plain(Source):
        channels = (CHANNELS["metallic"], CHANNELS["emissive"])

        def evaluate(self, triangles, barycentric, widths):  # noqa: ARG002
            return np.tile(np.float32([1, 2, 3, 4]), (len(triangles), 1))

    plain = Plain()
    assert plain.with_rest(SQUARE.astype(float)) is plain
    assert plain.with_filter("trilinear") is plain
    np.testing.assert_array_equal(values(plain.only(["emissive"])), [[2, 3, 4]] * 2)
    np.testing.assert_array_equal(values(plain.only(["emissive", "metallic"])), [[1, 2, 3, 4]] * 2)
    surface = Surface(SQUARE.astype(float), SQUARE_TRIANGLES.astype(np.int32), plain)
    np.testing.assert_array_equal(one(surface, "emissive"), [[2, 3, 4]] * 20)
    np.testing.assert_array_equal(one(surface.with_channels(["metallic"]), "metallic"), [[1]] * 20)


def test_channels_are_in_the_order_of_textures_and_others_last():
    assert in_order(["glow", "normal", "alpha", "glow", "base_color"]) == [
        "base_color", "alpha", "normal", "glow",
    ]  # fmt: skip


def test_each_channel_comes_from_the_source_named_for_it():
    first, second = Ramp("metallic", "base_color"), Ramp("roughness", "metallic", "emissive", scale=10.0)
    both = Combined({"metallic": second, "base_color": first, "emissive": second})
    assert [form.name for form in both.channels] == ["base_color", "metallic", "emissive"]
    expected = np.hstack([values(first)[:, 1:], values(second)[:, 1:]])
    calls = first.calls, second.calls
    np.testing.assert_array_equal(values(both), expected)
    assert (first.calls, second.calls) == (calls[0] + 1, calls[1] + 1)
    only = both.only(["base_color"])
    assert [form.name for form in only.channels] == ["base_color"]
    np.testing.assert_array_equal(values(only), expected[:, :3])
    assert second.calls == calls[1] + 1


def test_other_rest_positions_and_filters_reach_every_source():
    first, second = Ramp("metallic"), Ramp("roughness", "emissive")
    both = Combined({"metallic": first, "roughness": second, "emissive": second})
    larger = both.with_rest(SQUARE.astype(float) * 4)
    np.testing.assert_array_equal(values(larger, 2.0), values(both, 0.5))
    changed = both.with_filter("trilinear")
    sources = changed._inputs
    assert {(each.filter, *each.names) for each in sources if isinstance(each, Ramp)} == {
        ("trilinear", "metallic"), ("trilinear", "roughness", "emissive")
    }  # fmt: skip
    assert len(sources) == 2
    assert first.filter == second.filter == "ewa"


def test_values_of_ones_own_are_numbers_or_one_for_each_component():
    surface = square(image=random_image(4, 4)).with_sources(
        {"emissive": [0.5, 2.0, 0.0], "metallic": 1, "alpha": 0.25, "specular": (0.04,)}
    )
    formats = {form.name: (form.space, form.dtype) for form in surface.channels}
    assert list(formats) == ["base_color", "alpha", "metallic", "emissive", "specular"]
    assert formats["emissive"] == ("linear", "float16")
    assert formats["alpha"] == ("data", "uint8")
    np.testing.assert_allclose(one(surface, "emissive"), [[0.5, 2.0, 0.0]] * 20)
    np.testing.assert_allclose(one(surface, "metallic"), [[1.0]] * 20)
    np.testing.assert_allclose(one(surface, "alpha"), [[0.25]] * 20)
    np.testing.assert_allclose(one(surface, "specular"), [[0.04] * 3] * 20)
    np.testing.assert_array_equal(
        one(surface, "base_color"), one(square(image=random_image(4, 4)), "base_color")
    )
    assert json.loads(surface.provenance["source_emissive"]) == [0.5, 2.0, 0.0]


@pytest.mark.parametrize("width", [None, 0.3])
def test_images_of_ones_own_are_read_at_the_surfaces_coordinates(width, tmp_path):
    codes = random_image(6, 5)
    (tmp_path / "skin.png").write_bytes(png(codes))
    expected = one(square(image=codes), "base_color", width)
    bare = square()
    for given in (codes, PIL.Image.fromarray(codes), tmp_path / "skin.png", str(tmp_path / "skin.png")):
        painted = bare.with_sources({"base_color": given})
        np.testing.assert_allclose(one(painted, "base_color", width), expected, atol=1e-6)
    digest = hashlib.sha256(png(codes)).hexdigest()
    assert painted.provenance == {"source_base_color": json.dumps({"skin.png": digest})}
    assert bare.provenance == {}
    assert [form.name for form in bare.channels] == ["base_color"]


def test_an_image_of_data_is_read_from_red_and_not_as_light():
    codes = random_image(4, 4)
    made = square().with_sources({"roughness": codes, "alpha": codes[..., :1]})
    red = square(image=np.repeat(codes[..., :1], 3, axis=2), mag_filter="nearest")
    samples = red.scatter(20)
    texels = (samples.rest[:, :2] * [4, -4] + [0, 4]).astype(int)
    samples = samples._replace(  # at the texels' middles
        barycentric=np.stack(
            [1 - (x := (texels[:, 0] + 0.5) / 4), x - (y := 1 - (texels[:, 1] + 0.5) / 4), y], 1
        ),
        triangles=np.zeros(20, np.int32),
    )
    expected = codes[texels[:, 1], texels[:, 0], :1] / 255
    for channel in ("roughness", "alpha"):
        np.testing.assert_allclose(made.evaluate(samples, channel), expected, atol=1e-5)
    np.testing.assert_allclose(red.evaluate(samples)[:, :1], srgb_to_linear(expected), atol=1e-5)


def test_vertex_colours_do_not_multiply_what_is_given():
    dark = square(colors=np.zeros((4, 3)))
    np.testing.assert_allclose(one(dark.with_sources({"base_color": 0.5}), "base_color"), [[0.5] * 3] * 20)


@pytest.mark.parametrize("filter", FILTERS)
def test_images_of_ones_own_are_read_by_the_filter_asked_for(filter):
    codes = random_image(8, 8)
    expected = one(square(image=codes, filter=filter), "base_color", 0.3)
    made = square().with_sources({"base_color": codes}, filter)
    np.testing.assert_allclose(one(made, "base_color", 0.3), expected, atol=1e-6)
    later = square().with_sources({"base_color": codes}).with_filter(filter)
    np.testing.assert_allclose(one(later, "base_color", 0.3), expected, atol=1e-6)


def test_a_normal_map_of_ones_own_stands_on_flat_triangles_or_on_normals_that_were_kept():
    tilted = np.full((2, 2, 3), [255, 128, 128], np.uint8)
    flat = one(square().with_sources({"normal": tilted}), "normal")
    np.testing.assert_allclose(flat, [[1, 0, 0]] * 20, atol=0.01)
    triangles = SQUARE_TRIANGLES.astype(np.int32)
    up = Corners(np.tile(np.float32([0, 1, 0]), (4, 1)), triangles)
    along = Corners(np.tile(np.float32([1, 0, 0, 1]), (4, 1)), triangles)
    plain = square()
    kept = Surface(plain.vertices, plain.triangles, plain.source, uv=plain.uv, frames=Frames(up, along))
    straight = np.full((2, 2, 3), [128, 128, 255], np.uint8)
    np.testing.assert_allclose(
        one(kept.with_sources({"normal": straight}), "normal"), [[0, 1, 0]] * 20, atol=0.01
    )
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = kept.with_rest(SQUARE @ turn.T).with_sources({"normal": straight})
    np.testing.assert_allclose(one(turned, "normal"), [turn @ [0, 1, 0]] * 20, atol=0.01)


def test_a_source_of_ones_own_gives_the_channels_it_is_named_for():
    ramp = Ramp("metallic", "emissive")
    surface = square().with_sources({"emissive": ramp})
    assert [form.name for form in surface.channels] == ["base_color", "emissive"]
    samples = surface.scatter(5)
    expected = 5 + samples.triangles + samples.barycentric[:, 0]
    np.testing.assert_allclose(surface.evaluate(samples, "emissive")[:, 0], expected, rtol=1e-6)
    again = surface.with_sources({"metallic": ramp, "emissive": 0.0})
    np.testing.assert_allclose(again.evaluate(samples, "metallic")[:, 0], expected - 3, rtol=1e-6)
    assert not again.evaluate(samples, "emissive").any()


@pytest.mark.parametrize(
    ("channel", "given", "error", "message"),
    [
        ("glow", 1.0, ArgumentError, "unknown channel 'glow'; there are: base_color, alpha"),
        (
            "base_color",
            (1.0, 0.5),
            ArgumentError,
            "base_color must be 3 numbers in 0 … 1, or an image, not (1.0, 0.5)",
        ),
        ("base_color", ["a", "b", "c"], ArgumentError, "base_color must be 3 numbers in 0 … 1, or an image"),
        (
            "normal",
            (0.0, 0.0, 1.0),
            ArgumentError,
            "normal must be an image or a Source, not (0.0, 0.0, 1.0)",
        ),
        ("normal", 1.0, ArgumentError, "normal must be an image or a Source, not 1.0"),
        ("metallic", np.nan, ArgumentError, "metallic must be a number in 0 … 1, or an image, not nan"),
        ("roughness", 5, ArgumentError, "roughness must be a number in 0 … 1, or an image, not 5"),
        ("base_color", (300, 20, 20), ArgumentError, "base_color must be 3 numbers in 0 … 1, or an image"),
        ("emissive", -1.0, ArgumentError, "emissive must be 3 numbers from 0 on, or an image, not -1.0"),
        ("base_color", -1.0, ArgumentError, "base_color must be 3 numbers in 0 … 1, or an image, not -1.0"),
        ("metallic", None, ImageError, "an image must have shape"),
        ("metallic", np.zeros((2, 2), int), ImageError, "an image must be uint8 or uint16"),
        ("metallic", "no such.png", ImageError, "no such.png cannot be read: No such file"),
        (
            "roughness",
            Ramp("metallic"),
            ArgumentError,
            "unknown channel of the given source 'roughness'; there are: metallic",
        ),
    ],
)
def test_what_cannot_be_a_source_is_refused(channel, given, error, message):
    with pytest.raises(error, match=re.escape(message)):
        square().with_sources({channel: given})


def test_images_need_coordinates_and_filters_names():
    message = "quad has no texture coordinates for an image of metallic; give a MappedImage (--project box)"
    with pytest.raises(ModelError, match=re.escape(message)):
        square(uv=None).with_sources({"metallic": random_image(2, 2)})
    np.testing.assert_allclose(one(square(uv=None).with_sources({"metallic": 0.5}), "metallic"), 0.5)
    with pytest.raises(ArgumentError, match="unknown filter 'sharp'"):
        square().with_sources({"metallic": 0.5}, "sharp")


def test_sources_follow_other_rest_positions_with_the_surface():
    made = square(image=random_image(4, 4)).with_sources({"roughness": random_image(8, 8), "metallic": 0.5})
    larger = made.with_rest(SQUARE * 10.0)
    assert isinstance(larger.scatter(1), SurfaceSamples)
    for channel in ("base_color", "roughness", "metallic"):
        np.testing.assert_allclose(one(larger, channel, 3.0), one(made, channel, 0.3), atol=1e-6)
