"""octex.render: images of a texture, a model or both, from a camera or a direction."""

import numpy as np
import pytest
from PIL import Image

import octex
from octex.channels import encode
from octex.drawing import render_leaves, render_surface, source_shader, texture_shader
from octex.errors import ArgumentError, OutputError
from tests.conftest import needs_jit
from tests.make.painted import ball

pytestmark = needs_jit
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
BENT = octex.Camera.pinhole(
    size=(4, 4), pose=np.eye(4), convention="opencv", focal=3.0, distortion=[0.1, 0.0]
)
COLORS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])


@pytest.fixture(scope="module")
def surface():
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    made = octex.Surface.from_arrays(CORNERS, triangles, colors=COLORS, name="square")
    return made.with_sources({"roughness": 0.3})


@pytest.fixture(scope="module")
def texture(surface):
    return octex.convert(surface, 5)


@pytest.fixture(scope="module")
def camera():
    return octex.Camera.fitted(CORNERS, (0.2, 0.1, 1.0), size=(48, 36))


def codes(light):
    return encode(light, "uint8", "srgb")


def test_an_image_is_what_its_shader_shows_as_srgb_codes(surface, texture, camera):
    found = octex.render(texture, surface, camera)
    assert (found.dtype, found.shape) == (np.uint8, (36, 48, 3))
    np.testing.assert_array_equal(found, codes(render_surface(surface, camera, texture_shader(texture))))
    np.testing.assert_array_equal(
        octex.render(None, surface, camera, channel="roughness"),
        codes(render_surface(surface, camera, source_shader(surface, "roughness"))),
    )
    coarse = texture_shader(texture.level(2))
    np.testing.assert_array_equal(
        octex.render(texture, surface, camera, level=2), codes(render_surface(surface, camera, coarse))
    )
    studio, bump = octex.Environment.studio(), ("roughness", 0.1)
    look = texture_shader(texture, materials=True, bump=bump)
    np.testing.assert_array_equal(
        octex.render(texture, surface, camera, light=studio, bump=bump),
        codes(render_surface(surface, camera, look, light=studio)),
    )


def test_leaves_are_drawn_without_a_model_and_cubes_also_with_one(surface, texture, camera):
    np.testing.assert_array_equal(
        octex.render(texture, camera=camera, supersample=1),
        codes(render_leaves(texture, camera, supersample=1)),
    )
    cubes = codes(render_leaves(texture, camera, level=3, cubes=True))
    for model in (None, surface):
        np.testing.assert_array_equal(octex.render(texture, model, camera, level=3, cubes=True), cubes)


def test_without_a_camera_the_whole_model_is_seen_and_a_file_is_written(surface, texture, tmp_path):
    path, way = tmp_path / "a.png", (0.2, 0.1, 1.0)
    found = octex.render(texture, surface, path=path, size=(48, 36), direction=way, zoom=1.5)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), found)
    camera = octex.Camera.fitted(CORNERS, way, size=(48, 36)).zoomed(1.5)
    np.testing.assert_array_equal(found, octex.render(texture, surface, camera))
    for given in ((None, surface), (texture, None)):
        usual = octex.render(*given, size=(48, 36))
        assert usual.shape == (36, 48, 3)
        assert np.ptp(usual.astype(int), axis=2).max() > 100
    with pytest.raises(OutputError, match="nowhere"):
        octex.render(texture, surface, path=tmp_path / "nowhere" / "a.png", size=(8, 8))


BOX = octex.Surface.from_arrays(np.eye(3), [[0, 1, 2]])


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"size": (1 << 15, 1 << 15)}, "has at most 268,435,456 pixels"),
        ({"light": "studio"}, "light must be an octex.Environment"),
        ({"bump": "base_color"}, r"bump must be \(channel, height\)"),
        ({"camera": 3}, "camera must be an octex.Camera"),
        ({"camera": BENT}, "give camera.undistorted"),
        ({"level": -1}, "level must be a whole number from 0"),
        ({"supersample": 0}, "supersample must be a whole number from 1"),
        ({"zoom": 0}, "zoom"),
        ({"channel": "height"}, "unknown channel 'height'"),
        ({"cubes": True, "bump": ("base_color", 0.1)}, "leave bump or cubes out"),
        ({"texture": None}, "a texture, a surface or both"),
        ({"texture": None, "surface": BOX, "level": 1}, "level and cubes are for a texture"),
        ({"texture": None, "surface": BOX, "cubes": True}, "level and cubes are for a texture"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(texture, options, word):
    with pytest.raises(ArgumentError, match=word):
        octex.render(**{"texture": texture, "size": (8, 8), **options})


def test_the_command_draws_every_kind(texture, camera, tmp_path, cli):
    stored, model, eye = tmp_path / "a.octex", tmp_path / "a.obj", tmp_path / "eye.json"
    texture.save(stored)
    rows = [f"v {x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(CORNERS, COLORS, strict=True)]
    model.write_text("\n".join([*rows, "f 1 2 3", "f 1 3 4"]))
    octex.write_cameras(eye, {"front": camera})
    loaded = octex.load_surface(model)

    def drawn(*words):
        path = tmp_path / "drawn.png"
        at = next((n for n, word in enumerate(words) if str(word).startswith("--")), len(words))
        cli.result("draw", *words[:at], path, *words[at:], "--force", "--quiet")
        return np.asarray(Image.open(path))

    front = ["--camera", f"{eye}#front"]
    view = drawn(stored, model, "--as", "view", *front)
    np.testing.assert_array_equal(view, octex.render(texture, loaded, camera))
    np.testing.assert_array_equal(
        drawn(stored, "--as", "cells", "--level", 3, *front),
        octex.render(texture, None, camera, level=3, cubes=True),
    )
    # Panels of a camera whose images have a size are as large as they fit.
    assert drawn(stored, model, "--size", "96,60", *front).shape == (60, 96, 3)
    assert drawn(model, "--size", "48,60", *front).shape == (60, 48, 3)
    both = drawn(stored, model, "--as", "difference", "--size", "150,60", "--channel", "base_color")
    assert both.shape == (60, 150, 3)
    two = drawn(stored, stored, "--as", "difference", "--size", "150,60")
    assert two.shape == (120, 150, 3)  # also roughness


def test_a_surface_is_lit_by_its_own_normals():
    coarse, fine = ball(4), ball(128)
    camera = octex.Camera.fitted(fine.vertices, (0.3, 0.2, 1.0), size=(64, 64))
    light = octex.Environment.studio()
    normals = coarse.vertices / np.linalg.norm(coarse.vertices, axis=1, keepdims=True)
    posed = coarse.vertices[:, [1, 2, 0]]  # turned by a third
    both = octex.Surface.from_arrays(coarse.vertices, coarse.triangles, normals=normals)
    wanted = octex.render(None, octex.Surface.from_arrays(fine.vertices, fine.triangles), camera, light=light)
    inside = np.linalg.norm(np.mgrid[:64, :64] - 31.5, axis=0) < 24

    def off(surface):
        image = octex.render(None, surface, camera, light=light)
        return np.abs(image[inside].astype(int) - wanted[inside]).mean()

    flat = octex.Surface.from_arrays(coarse.vertices, coarse.triangles)
    assert max(off(both), off(both.with_pose(posed))) < 0.4 * off(flat)


def test_leaves_are_the_finest_where_the_middle_of_the_surface_is_behind_the_camera(texture):
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # looks along −z
    pose[:3, 3] = *texture.bounds.mean(axis=0)[:2], -1.0
    beyond = octex.Camera.pinhole((8, 6), pose=pose, convention="opencv", focal=8.0)
    np.testing.assert_array_equal(
        octex.render(texture, None, beyond), octex.render(texture, None, beyond, level=texture.tree.max_depth)
    )
