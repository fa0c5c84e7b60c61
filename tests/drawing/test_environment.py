import numpy as np
import pytest

import octex
from octex.cameras.camera import Camera
from octex.channels import encode
from octex.drawing import draw_preview, render_leaves, render_surface, source_shader, texture_shader
from octex.drawing.environment import Environment
from octex.drawing.rasters import lit
from octex.drawing.reflection import reflectances, reflected, tone_mapped
from octex.drawing.shaders import Appearance
from octex.errors import ArgumentError, ImageError
from tests.oracles import naive_light

WHITE = Environment.of(np.ones((8, 16, 3)))
BACK = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]])
AHEAD = Camera.orthographic((4, 4), pose=BACK, convention="opengl", pixels_per_unit=2.0)


def _smooth(directions):
    """Light that varies smoothly, of another colour on each side."""
    x, y, z = directions.T
    return np.stack([1.2 + x + 0.1 * y * z, 0.8 + 0.6 * y + 0.2 * x * x, 1.0 - 0.7 * z * y], axis=1)


def _image(height=64, radiance=_smooth):
    return radiance(naive_light.texel_directions(height, 2 * height)[0]).reshape(height, 2 * height, 3)


def _tilted(cosine):
    """A normal at some cosine to the way to the camera, +z."""
    return np.array([np.sqrt(1 - cosine**2), 0.0, cosine])


def _reflected(environment, normals, **material):
    normals = np.atleast_2d(np.asarray(normals, float))
    count = len(normals)
    given = {
        name: np.broadcast_to(value, (count, 3) if name in ("base_color", "specular") else count)
        for name, value in material.items()
    }
    given["reflected"] = given.pop("base_color")
    return reflected(environment, AHEAD, np.zeros((count, 3)), normals, normals, Appearance(**given))


GRAZING, ROUGHNESSES = (each.ravel() for each in np.meshgrid([1.0, 0.7, 0.3, 0.05], np.linspace(0, 1, 9)))


@pytest.mark.parametrize("specular", [0.0, 0.04, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
def test_white_in_white_light_stays_white_whatever_the_roughness(metallic, specular):
    normals = np.array([_tilted(c) for c in GRAZING])
    material = {"metallic": metallic, "roughness": ROUGHNESSES, "specular": specular}
    assert np.allclose(_reflected(WHITE, normals, base_color=1.0, **material), 1.0, atol=1e-4)


def test_what_reflects_nothing_along_the_normal_is_matte_and_occlusion_darkens():
    normals = np.array([_tilted(c) for c in GRAZING])
    black = _reflected(WHITE, normals, base_color=0.0, roughness=ROUGHNESSES, specular=0.0)
    assert np.allclose(black, 0.0, atol=1e-6)
    lit = _reflected(WHITE, [[0.0, 0.0, 1.0]] * 2, base_color=0.5, occlusion=[1.0, 0.25])
    assert np.allclose(lit[1], lit[0] / 4)


def test_what_a_lobe_reflects_in_all_is_its_integral():
    table, up = reflectances(), np.array([0.0, 0.0, 1.0])
    everywhere = naive_light.directions(200_000)
    for row, column in [(31, 31), (31, 12), (16, 20), (8, 28), (3, 16)]:
        v = _tilted((row + 0.5) / 32)
        values = [
            4
            * np.pi
            * (naive_light.reflectance(up, v, everywhere, [f0] * 3, 1.0, (column + 0.5) / 32)[:, 0]).mean()
            for f0 in (0.0, 1.0)
        ]
        assert np.allclose([table[row, column, 1], table[row, column].sum()], values, atol=0.005)


def test_averages_for_each_roughness_are_those_of_the_lobe():
    image = np.random.default_rng(0).random((32, 64, 3)) ** 4 * 5
    environment = Environment.of(image)
    texels, solid = naive_light.texel_directions(32, 64)
    looks = naive_light.directions(40)
    cosines = np.clip(looks @ texels.T, -1, 1)
    for roughness in (0.25, 0.5, 0.75, 1.0):
        weights = naive_light.lobe(np.sqrt((1 + cosines) / 2), roughness) * np.maximum(cosines, 0) * solid
        truth = weights @ image.reshape(-1, 3) / weights.sum(axis=1, keepdims=True)
        apart = np.abs(environment.radiance(looks, roughness) - truth)
        assert apart.max() < (0.4 if roughness == 0.25 else 0.06)  # the finest lobes are as narrow as texels
        assert apart.mean() < (0.05 if roughness == 0.25 else 0.015)
    matte = np.maximum(cosines, 0) * solid @ image.reshape(-1, 3) / np.pi
    assert np.abs(environment.irradiance(looks) - matte).max() < 0.05


@pytest.mark.parametrize(
    ("metallic", "roughness", "specular"),
    [(0.0, 1.0, 0.04), (1.0, 0.4, 0.04), (1.0, 0.7, 0.04), (0.0, 0.5, (0.02, 0.2, 0.6))],
)
def test_reflected_light_is_the_integral_over_the_hemisphere(metallic, roughness, specular):
    environment = Environment.of(_image())
    base, v = np.array([0.9, 0.5, 0.2]), np.array([0.0, 0.0, 1.0])
    for cosine, apart in ((1.0, 0.03), (0.9, 0.1), (0.7, 0.2)):
        normal = _tilted(cosine)
        given = normal, v, _smooth, base, metallic, roughness, np.array(specular)
        truth = naive_light.reflected(*given) + naive_light.reflected_again(*given)
        material = {"metallic": metallic, "roughness": roughness, "specular": specular}
        found = _reflected(environment, normal, base_color=base, **material)[0]
        assert np.abs(found - truth).max() < apart  # the split sum takes lobes as seen along the normal


def test_a_mirror_shows_the_environment():
    image = _image(128)
    environment = Environment.of(image)
    normals = np.array([_tilted(c) for c in (1.0, 0.95, 0.8, 0.6)])
    normals[1] = normals[1][[1, 0, 2]]  # upward
    mirrored = 2 * normals[:, 2:] * normals - np.array([0.0, 0.0, 1.0])
    lit = _reflected(environment, normals, base_color=1.0, metallic=1.0, roughness=0.0)
    assert np.allclose(lit, _smooth(mirrored), atol=0.02)


def test_an_image_has_its_middle_in_front_and_its_right_side_at_minus_x():
    image = np.zeros((8, 16, 3))
    image[:, 7:9] = [1, 0, 0]  # the middle
    image[:, 11:13] = [0, 1, 0]  # halfway to the right
    image[0] = [0, 0, 1]
    environment = Environment.of(image)
    looks = environment.radiance([[0, 0, 1], [-1, 0, 0], [0, 1, 0], [1, 0, 0]], 0.0)
    assert np.allclose(looks, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])
    turned = Environment.of(image, up=(0, 0, 1))
    assert np.allclose(turned.radiance([[0, 0, 1], [0, -1, 0]], 0.0), [[0, 0, 1], [1, 0, 0]])
    upside_down = Environment.of(image, up=(0, -2, 0))
    assert np.allclose(upside_down.radiance([[0, -1, 0]], 0.0), [[0, 0, 1]])


def test_a_stop_doubles_the_light_and_what_is_below_zero_is_black():
    twice = Environment.of(np.full((8, 16), 0.25), exposure=2.0)
    assert np.allclose(twice.irradiance([[0, 1, 0]]), 1.0)
    assert np.allclose(Environment.of(np.full((8, 16), -0.5)).irradiance([[0, 1, 0]]), 0.0)


def test_bytes_are_decoded_and_images_of_any_size_resampled():
    codes = np.full((5, 11, 3), 188, np.uint8)
    assert np.allclose(Environment.of(codes).radiance([[1, 2, 3]], 0.3), 0.503, atol=1e-3)
    stripes = np.zeros((30, 60, 3))
    stripes[:15] = 1.0
    assert np.allclose(
        Environment.of(stripes).irradiance([[0, 1, 0], [0, -1, 0], [1, 0, 0]])[:, 0], [1, 0, 0.5], atol=0.02
    )


def test_the_studio_turns_with_the_camera():
    studio = Environment.studio()
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    turned = Camera.orthographic((4, 4), pose=pose, convention="opengl", pixels_per_unit=2.0)
    normals = naive_light.directions(20)
    material = Appearance(np.full((20, 3), 0.5), metallic=np.full(20, 0.5), roughness=np.full(20, 0.3))
    here = reflected(studio, AHEAD, np.zeros((20, 3)), normals, normals, material)
    there = reflected(
        studio, turned, np.zeros((20, 3)), normals @ pose[:3, :3].T, normals @ pose[:3, :3].T, material
    )
    assert np.allclose(here, there, atol=1e-5)


#: Colour, metallic and roughness of balls; their mean sRGB codes within 0.89 of the radius, seen from eight
#: sides in three.js 0.170: RoomEnvironment, NeutralToneMapping, exposure 1; and how grey their darkest
#: twentieth, quarter and half are.
_ROOM = [
    ((0.0, 0.0, 0.0), 0, 0.5, (25, 25, 25), (7, 10, 15)),
    ((0.02, 0.02, 0.02), 0, 0.3, (45, 45, 45), (21, 29, 31)),
    ((0.18, 0.18, 0.18), 0, 0.6, (126, 126, 126), (92, 98, 121)),
    ((0.8, 0.8, 0.8), 0, 0.6, (228, 228, 228), (192, 206, 237)),
    ((0.7, 0.05, 0.05), 0, 0.4, (220, 70, 70), (91, 94, 112)),
    ((1.0, 0.78, 0.34), 1, 0.2, (207, 180, 114), (106, 148, 176)),
    ((0.9, 0.9, 0.9), 1, 0.05, (182, 182, 182), (99, 152, 202)),
    ((0.9, 0.9, 0.9), 1, 0.35, (212, 212, 212), (167, 198, 205)),
    ((0.3, 0.3, 0.3), 1, 0.4, (126, 126, 126), (78, 100, 107)),
]


@pytest.mark.parametrize(("color", "metallic", "roughness", "codes", "greys"), _ROOM)
def test_materials_are_as_bright_and_as_dark_in_the_studio_as_in_the_room_of_three_js(
    color, metallic, roughness, codes, greys
):
    x, y = np.meshgrid(*[np.linspace(-0.89, 0.89, 41)] * 2)
    inside = x**2 + y**2 < 0.89**2
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[inside]
    seen = Appearance(
        np.tile(np.array(color), (len(normals), 1)),
        metallic=np.full(len(normals), float(metallic)),
        roughness=np.full(len(normals), roughness),
    )
    light = lit(seen, Environment.studio(), AHEAD, np.zeros_like(normals), normals, normals).reflected
    found = encode(light, "uint8", "srgb").astype(float)
    assert np.abs(found.mean(axis=0) - codes).max() < 12
    darkest = np.quantile(found.mean(axis=1), [0.05, 0.25, 0.5])
    assert (np.abs(darkest - greys) < 7 + 0.1 * np.array(greys)).all()


def test_tone_mapping_keeps_colours_below_white_and_compresses_light_beyond():
    light = [[0.0] * 3, [0.04] * 3, [0.5, 0.3, 0.2], [0.8, 0.1, 0.1], [50.0, 10.0, 10.0]]
    mapped = tone_mapped(np.array(light))
    assert np.allclose(mapped[:4], [[0, 0, 0], [0.01, 0.01, 0.01], [0.46, 0.26, 0.16], [0.76, 0.06, 0.06]])
    assert 0.99 < mapped[4, 0] < 1.0
    assert mapped[4, 1] > 0.8  # it fades to white
    ramp = tone_mapped(np.linspace(0, 20, 2000)[:, None] * [1.0, 0.5, 0.2])
    assert (np.diff(ramp[:, 0]) > 0).all()
    assert np.allclose(tone_mapped(np.full((1, 3), 1e30, np.float32)), 1.0)
    # What glows in the studio is compressed with what it reflects.
    shines = Appearance(np.full((1, 3), 0.5), emitted=np.full((1, 3), 3.0))
    normal = np.array([[0.0, 0.0, 1.0]])
    found = lit(shines, Environment.studio(), AHEAD, np.zeros((1, 3)), normal, normal)
    assert found.emitted is None
    assert 0.9 < found.reflected.max() < 1.0


def test_both_sides_reflect_alike_and_normals_that_lean_away_stay_finite():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    environment, zeros = Environment.of(_image(16)), np.zeros((50, 3))
    material = Appearance(np.full((50, 3), 0.5))
    assert np.array_equal(
        reflected(environment, AHEAD, zeros, normals, normals, material),
        reflected(environment, AHEAD, zeros, -normals, -normals, material),
    )
    away = reflected(environment, AHEAD, zeros, np.tile([0.0, 0.0, 1.0], (50, 1)), normals, material)
    assert np.isfinite(away).all()
    assert away.min() >= 0.0


def test_what_is_no_image_of_all_directions_is_refused(tmp_path):
    for wrong in ({"exposure": np.nan}, {"exposure": 65.0}, {"up": (0, 0, 0)}, {"up": (0, 1)}):
        with pytest.raises(ArgumentError, match=next(iter(wrong))):
            Environment.of(np.ones((8, 16)), **wrong)
    with pytest.raises(ImageError, match="its 4 × 24 texels are taller than wide"):
        Environment.of(np.ones((24, 4, 3), np.float32))
    (tmp_path / "light.hdr").write_bytes(b"nothing")
    for path in (tmp_path / "light.hdr", tmp_path / "missing.hdr"):
        with pytest.raises(ImageError, match=path.name):
            Environment.of(path)


# --- in images

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def _plain(**sources):
    return octex.Surface.from_arrays(SQUARE, TWO, uv=SQUARE[:, :2] / 2 + 0.5).with_sources(sources)


def test_metal_roughness_and_normal_maps_are_reflected_by_source_and_texture_alike():
    environment = Environment.of(_image())
    slanted = np.array([0.3, 0.2, 0.9])
    slanted /= np.linalg.norm(slanted)
    surface = _plain(
        base_color=(0.9, 0.5, 0.2),
        metallic=1.0,
        roughness=0.5,
        normal=lambda rest: np.tile(slanted, (len(rest), 1)),
    )
    texture = octex.convert(surface, 3, dtype="float32")
    truth = _reflected(environment, slanted, base_color=[0.9, 0.5, 0.2], metallic=1.0, roughness=0.5)
    camera = AHEAD
    for look in (source_shader(surface, materials=True), texture_shader(texture, materials=True)):
        assert np.allclose(render_surface(surface, camera, look, 1, environment), truth, atol=2e-3)
    assert np.allclose(
        render_leaves(texture, camera, supersample=1, light=environment)[1:3, 1:3], truth, atol=2e-3
    )
    # Posed, the same normals point elsewhere.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    posed = octex.Surface(SQUARE @ turn.T, TWO, surface.source, rest=SQUARE)
    truth = _reflected(environment, turn @ slanted, base_color=[0.9, 0.5, 0.2], metallic=1.0, roughness=0.5)
    assert np.allclose(
        render_surface(posed, camera, texture_shader(texture, materials=True), 1, environment),
        truth,
        atol=2e-3,
    )


def test_a_bump_bends_normals_as_a_surface_that_is_displaced():
    slope = np.array([0.4, -0.2])
    environment = Environment.of(_image())

    def height(rest):
        return 0.5 + 0.3 * (rest[:, :2] @ slope)

    surface = _plain(base_color=(0.5, 0.5, 0.5), roughness=height)
    texture = octex.convert(surface, 4, dtype="float32")
    normal = np.array([-0.6 * slope[0], -0.6 * slope[1], 1.0])
    normal /= np.linalg.norm(normal)
    bump = ("roughness", 2.0)
    camera = Camera.orthographic((8, 8), pose=BACK, convention="opengl", pixels_per_unit=8.0)
    for look in (source_shader(surface, bump=bump), texture_shader(texture, bump=bump)):
        truth = _reflected(environment, normal, base_color=0.5)
        assert np.allclose(render_surface(surface, camera, look, 1, environment), truth, atol=5e-3)
    assert np.allclose(
        render_leaves(texture, camera, supersample=1, light=environment, bump=bump)[2:6, 2:6].mean(
            axis=(0, 1)
        ),
        _reflected(environment, normal, base_color=0.5, roughness=0.5),
        atol=0.02,
    )
    with pytest.raises(ArgumentError, match="unknown channel to bend normals by 'height'"):
        texture_shader(texture, bump=("height", 1.0))
    with pytest.raises(ArgumentError, match="normal holds directions"):
        source_shader(
            _plain(normal=lambda rest: np.tile([0.0, 0.0, 1.0], (len(rest), 1))), bump=("normal", 1.0)
        )


def test_a_preview_in_light_differs_from_the_soft_one():
    surface = _plain(base_color=(0.9, 0.5, 0.2), metallic=1.0, roughness=0.2)
    texture, studio = octex.convert(surface, 3), Environment.studio()
    soft, alone = (draw_preview(texture, each, (64, 48), 1) for each in (surface, None))
    assert np.array_equal(soft, draw_preview(texture, surface, (64, 48), 1, light=None))
    lit = draw_preview(texture, surface, (64, 48), 1, light=studio, bump=("roughness", 0.1))
    assert not np.array_equal(soft, lit)
    assert not np.array_equal(alone, draw_preview(texture, None, (64, 48), 1, light=studio))


# --- from the shell


def test_previews_and_views_are_lit_from_the_shell(tmp_path, cli):
    model, texture = tmp_path / "model.obj", tmp_path / "a.octex"
    model.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    octex.convert(model, 3).save(texture)
    paint = f"--as paint --camera-out {tmp_path / 'c.json'} --size 32,32"
    studio, images = "--size 96,48 --light studio", set()
    for words in (
        *("--size 96,48", studio, f"{studio} --exposure -2"),
        *(paint, f"{paint} --light soft", f"{paint} --light studio"),
    ):
        cli.result("draw", texture, model, tmp_path / "a.png", "--force", "--quiet", *words.split())
        images.add((tmp_path / "a.png").read_bytes())
    assert len(images) == 6
