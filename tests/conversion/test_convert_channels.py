"""Conversion of many channels, of any type."""

import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

import octex
from octex.channels import ALPHA, BASE_COLOR, METALLIC, NORMAL, ONE, ROUGHNESS, decode
from octex.errors import ArgumentError, ModelError
from octex.source.surface import Surface
from octex.voxelize import fragments
from tests.conftest import needs_jit
from tests.make.fixtures import obj_lines
from tests.make.small_surfaces import (
    FACES,
    LIGHT,
    TETRAHEDRON,
    WHOLE,
    WHOLE_VALUES,
    FaceSource,
    tetrahedron,
    whole,
)

convert_means = partial(octex.convert, fit=False)


@pytest.mark.parametrize(
    ("dtype", "precision"),
    [
        ({}, 0.005),
        ("float16", 5e-4),
        ("float32", 1e-6),
        ({"base_color": "uint16", "normal": "uint16"}, 0.005),
    ],
)
def test_all_channels_come_back_from_a_file_in_every_type(dtype, precision, tmp_path):
    surface = whole()
    convert_means(surface, depth=5, dtype=dtype).save(tmp_path / "a.octex")
    texture = octex.open(tmp_path / "a.octex")
    texture.validate()
    assert list(texture.channels) == [channel.name for channel in WHOLE]
    samples = surface.scatter(400)
    found = texture.sample(samples.rest, list(texture.channels), normalize=False)
    # Away from edges a cell sees one face alone.
    inner = samples.barycentric.min(axis=1) > 0.15
    assert inner.any()
    first = 0
    for channel in WHOLE:
        columns = slice(first, first + channel.components)
        first = columns.stop
        expected = np.array(WHOLE_VALUES, np.float32)[samples.triangles, columns]
        stored = texture.channels[channel.name].format
        wanted = dtype if isinstance(dtype, str) else dtype.get(channel.name, channel.dtype)
        assert stored.dtype == wanted
        if channel.space == "srgb":
            assert stored.space == ("linear" if wanted.startswith("float") else "srgb")
        scale = np.maximum(expected, 1)
        assert (np.abs(found[channel.name] - expected) / scale)[inner].max() < precision, channel.name


def test_channels_converted_together_are_as_converted_alone():
    together = octex.convert(whole(), depth=4)
    for channel in WHOLE:
        alone = octex.convert(whole(), depth=4, channels=[channel.name])
        assert list(alone.channels) == [channel.name]
        values = alone.channels[channel.name].values
        assert np.array_equal(together.channels[channel.name].values, values)
    coarse = together.level(2)
    coarse.validate()
    assert coarse.sample(TETRAHEDRON, ["normal", "emissive"])["normal"].shape == (4, 3)


@needs_jit
@pytest.mark.parametrize("options", [{}, {"max_error": 2}])
def test_the_same_bytes_of_all_channels_come_from_any_number_of_threads(options, tmp_path, monkeypatch):
    monkeypatch.setattr("octex.conversion.fit.BRICK_SAMPLES", 500)
    with ThreadPoolExecutor(1) as alone:
        octex.convert(whole(), 6, run=octex.Run(executor=alone), **options).save(tmp_path / "alone.octex")
    monkeypatch.setattr(fragments, "TASK_FRAGMENTS", 2_000)
    with ThreadPoolExecutor(3) as pool:
        octex.convert(whole(), 6, run=octex.Run(executor=pool), **options).save(tmp_path / "many.octex")
    assert (tmp_path / "alone.octex").read_bytes() == (tmp_path / "many.octex").read_bytes()


SHEET = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
BOTH_SIDES = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]], np.int32)


def sheet(form, front, back):
    """A sheet that shows one value from the front and another from the back."""
    source = FaceSource((form,), [front, front, back, back])
    return octex.convert(Surface(SHEET, BOTH_SIDES, source), depth=3)


@pytest.mark.parametrize("dtype", ONE)
@pytest.mark.parametrize(
    ("form", "value", "least"),
    # Of the mean, half the difference; 1/255 of the range of sRGB codes, of numbers, of −1 … 1.
    [(BASE_COLOR, 0.2158605, 0.00713), (METALLIC, 0.5, 2 / 255), (NORMAL, 0.0, 4 / 255)],
    ids=["light", "data", "direction"],
)
def test_sides_are_kept_where_they_differ_by_more_than_a_code_in_every_type(form, value, least, dtype):
    space = "linear" if form.space == "srgb" and dtype.startswith("float") else form.space
    form = form._replace(dtype=dtype, space=space)
    for difference, splits in ((0.8 * least, False), (2.5 * least, True)):
        sides = [[value + sign * difference / 2] * form.components for sign in (1, -1)]
        texture = sheet(form, *sides)
        assert (texture.tree.split.cells.size > 0) == splits
        if splits:
            kept = decode(texture.channels[form.name].split_values, form.space)
            assert np.allclose(kept[0::2], sides[0], atol=0.005)
            assert np.allclose(kept[1::2], sides[1], atol=0.005)


def test_sides_of_bright_light_are_compared_by_ratio():
    # Above 1 a code is 0.9 % of the value; from the mean, half the difference counts.
    assert sheet(LIGHT, [100.0] * 3, [101.0] * 3).tree.split.cells.size == 0
    assert sheet(LIGHT, [100.0] * 3, [103.0] * 3).tree.split.cells.size > 0


def test_directions_are_averaged_as_vectors_and_keep_the_length_of_the_mean():
    # A roof of two faces as large, whose normals stand at right angles: their mean has length √½.
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    source = FaceSource((NORMAL,), [[0.6, 0.0, 0.8], [-0.8, 0.0, 0.6]])
    texture = convert_means(Surface(vertices, triangles, source), depth=0, dtype="float32")
    mean = texture.sample([[0.5, 0.5, 0]], "normal", normalize=False)[0]
    assert np.allclose(mean, [-0.1, 0.0, 0.7], atol=1e-6)
    unit = texture.sample([[0.5, 0.5, 0]], "normal")[0]
    assert np.allclose(unit, np.array([-0.1, 0.0, 0.7]) / np.sqrt(0.5), atol=1e-6)


def translucent():
    """One cell sees a triangle that covers fully and, as large, one of coverage ¼."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    channels = (BASE_COLOR, ALPHA, ROUGHNESS, NORMAL)
    return Surface(
        vertices, triangles, FaceSource(channels, [[1, 0, 0, 1, 0, 1, 0, 0], [0, 1, 0, 0.25, 1, 0, 0, 1]])
    )


def test_alpha_weighs_all_channels_where_it_is_among_them():
    texture = convert_means(translucent(), depth=0, dtype="float32")
    found = texture.sample([[0.5, 0.5, 0]], list(texture.channels), normalize=False)
    assert np.allclose(found["base_color"], [[0.8, 0.2, 0]])
    assert np.allclose(found["alpha"], 0.625)
    assert np.allclose(found["roughness"], 0.2)
    assert np.allclose(found["normal"], [[0.8, 0, 0.2]])
    texture = convert_means(translucent(), depth=0, dtype="float32", channels=["roughness", "base_color"])
    found = texture.sample([[0.5, 0.5, 0]], list(texture.channels))
    assert np.allclose(found["base_color"], [[0.5, 0.5, 0]])
    assert np.allclose(found["roughness"], 0.5)


def test_a_texture_holds_nothing_that_is_not_finite():
    source = FaceSource((LIGHT,), [[np.inf, 1e9, -np.inf]] * 4)
    octex.convert(Surface(TETRAHEDRON, FACES, source), depth=3).validate()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"channels": ["normal", "clearcoat"]},
            "unknown channel 'clearcoat'; there are: base_color, metallic",
        ),
        ({"channels": []}, "channels must name at least one channel"),
        ({"dtype": "int8"}, "unknown dtype 'int8'; there are: uint8, uint16, float16, float32"),
        ({"dtype": {"alpha": "uint8"}}, "unknown channel of dtype 'alpha'; there are: base_color, metallic"),
        (
            {"dtype": "uint16"},
            "surface: channel 'emissive' has values above 1, which uint16 cannot hold; give it",
        ),
        ({"filter": "sharp"}, "unknown filter 'sharp'; there are: nearest, bilinear"),
        ({"sources": {"paint": 0.5}}, "unknown channel 'paint'; there are: base_color, "),
    ],
)
def test_names_that_are_not_there_and_types_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ArgumentError, match=message):
        octex.convert(whole(), depth=3, **options)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("fit", [False, True])
def test_integers_hold_light_that_is_nowhere_above_1_whatever_its_source_could_give(dtype, fit):
    def glow(points):
        return np.clip(2 * points, 0, 1)

    texture = octex.convert(tetrahedron(), 5, sources={"emissive": glow}, dtype={"emissive": dtype}, fit=fit)
    form = texture.channels["emissive"].format
    assert (form.dtype, form.space) == (dtype, "srgb")
    points = tetrahedron().scatter(500, seed=1)
    assert np.abs(texture.sample(points.rest, "emissive") - glow(points.rest)).max() < 0.1
    bright = {"emissive": lambda points: 2 * points}
    with pytest.raises(
        ArgumentError, match=f"surface: channel 'emissive' has values above 1, which {dtype} "
    ):
        octex.convert(tetrahedron(), 5, sources=bright, dtype={"emissive": dtype}, fit=fit)


def test_sources_of_ones_own_replace_channels_and_add_to_them():
    texture = octex.convert(whole(), depth=3, sources={"base_color": (0.25, 0.5, 1.0), "occlusion": 0.4})
    assert list(texture.channels) == [
        "base_color", "metallic", "roughness", "occlusion", "emissive", "normal",
    ]  # fmt: skip
    found = texture.sample(TETRAHEDRON, ["base_color", "occlusion"])
    assert np.allclose(found["base_color"], [[0.25, 0.5, 1.0]], atol=0.005)
    assert np.allclose(found["occlusion"], 0.4, atol=0.002)


def test_a_file_is_asked_only_for_the_channels_that_do_not_come_from_elsewhere(tmp_path):
    (tmp_path / "a.obj").write_text(obj_lines(TETRAHEDRON, FACES))
    sources = {"roughness": 0.3, "metallic": 1.0}
    texture = octex.convert(tmp_path / "a.obj", 3, channels="roughness", sources=sources)
    assert list(texture.channels) == ["roughness"]
    assert [name for name in texture.metadata if "source_" in name] == ["source_roughness"]
    with pytest.raises(ModelError, match=r"a\.obj has no channel emissive; it has base_color"):
        octex.convert(tmp_path / "a.obj", 3, channels=["emissive", "roughness"], sources=sources)


@needs_jit
def test_the_filter_is_the_one_that_is_asked_for():
    checkers = np.indices((64, 64)).sum(axis=0).astype(np.uint8) % 2 * 255
    surface = Surface.from_arrays(SHEET, BOTH_SIDES[:2], uv=SHEET[:, :2], image=checkers)
    points = [[0.25, 0.6, 0], [0.6, 0.25, 0], [0.75, 0.3, 0], [0.3, 0.8, 0]]
    nearest, ewa = (
        convert_means(surface, 4, filter=name).sample(points, filter="nearest")[:, 0]
        for name in ("nearest", "ewa")
    )
    assert set(nearest.tolist()) <= {0.0, 1.0}
    assert np.abs(ewa - 0.5).max() < 0.1


def test_the_file_says_what_was_asked_for():
    options = {"channels": ["base_color", "emissive"], "dtype": {"base_color": "uint16"}, "filter": "ewa"}
    texture = octex.convert(whole(), depth=3, sources={"base_color": 0.5}, rest=TETRAHEDRON + 1, **options)
    counts = {"triangles": 4, "degenerate": 0}
    stored = {"base_color": "uint16", "emissive": "float16"}
    assert json.loads(texture.metadata["convert"]) == {"depth": 3, "fit": True, "channels": stored, **counts}
    assert texture.metadata["filter"] == "ewa"
    assert json.loads(texture.metadata["source_base_color"]) == [0.5, 0.5, 0.5]
    assert texture.metadata["octex"] == octex.__version__
    asked = json.loads(convert_means(tetrahedron(), cell=0.1).metadata["convert"])
    assert asked == {"cell": 0.1, "fit": False, "channels": {"base_color": "uint8"}, **counts}
