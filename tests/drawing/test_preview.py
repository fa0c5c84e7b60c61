"""Previews, and layers that lie behind each other."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import octex
from octex.cameras.camera import Camera
from octex.channels import BASE_COLOR, CHANNELS, linear_to_srgb, srgb_to_linear
from octex.drawing import (
    Viewpoint,
    draw_preview,
    panels,
    rasters,
    render_leaves,
    render_surface,
    source_shader,
    texture_shader,
    viewpoint_among,
    write_preview,
)
from octex.drawing.hits import Hits
from octex.drawing.shaders import Appearance, ShownChannels
from octex.drawing.soft_light import background, light
from octex.errors import ArgumentError, OutputError
from octex.source.surface import Surface
from octex.texture import Channel, OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement

# A square that faces +z, its lower left corner in the origin.
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def _square(**source):
    return Surface.from_arrays(SQUARE, TWO, **source)


def _camera(pixels=8, unit=1.0):
    """Sees exactly the square (times unit) from +z."""
    pose = np.eye(4)
    pose[:3, 3] = unit / 2, unit / 2, 5.0
    return Camera.orthographic(
        (pixels, pixels), pose=pose, convention="opengl", pixels_per_unit=pixels / unit
    )


FRONT = float(light(_camera(), *np.array([[[0.5, 0.5, 0.0]], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]]]))[0])


@pytest.fixture(scope="module")
def quarters():
    """A square of four colours, and its texture."""
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    image = image.repeat(8, axis=0).repeat(8, axis=1)
    surface = _square(uv=SQUARE[:, :2], image=image, mag_filter="nearest", wrap="clamp")
    return surface, octex.convert(surface, depth=5)


def test_an_image_shows_colours_where_they_are():
    colors = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    surface = _square(colors=colors)
    image = render_surface(surface, _camera(), source_shader(surface)) / FRONT
    corners = image[[-1, -1, 0, 0], [0, -1, -1, 0]]
    assert np.allclose(corners, colors, atol=0.14)  # within a pixel of the corner


def test_a_texture_shows_the_same_as_its_source(quarters):
    surface, texture = quarters
    looks = source_shader(surface), texture_shader(texture)
    outer = np.ix_([0, 3], [0, 3])
    one, other = (render_surface(surface, _camera(4), look)[outer] for look in looks)
    assert np.allclose(one / FRONT, [[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], atol=0.01)
    assert np.allclose(one, other, atol=0.01)


def test_samples_are_averaged_in_linear_light():
    surface = _square()

    def stripes(hits):
        white = np.floor(hits.rest[:, :1] * 16 + 1e-9) % 2  # half a pixel each
        return Appearance(np.repeat(white, 3, axis=1))

    assert np.allclose(render_surface(surface, _camera(8), stripes, supersample=2), 0.5 * FRONT, atol=1e-6)


def test_the_background_shows_through_what_is_not_covered():
    surface = _square()
    camera = _camera(6)
    quarter = render_surface(surface, camera, lambda hits: _red(hits, 0.25))
    assert np.allclose(quarter, 0.25 * FRONT * np.array([1, 0, 0]) + 0.75 * background(6, 6), atol=1e-6)
    nothing = render_surface(surface, camera, lambda hits: _red(hits, 0.0))
    assert np.allclose(nothing, background(6, 6), atol=1e-6)


def _red(hits, coverage):
    n = len(hits.width)
    return Appearance(np.tile([1.0, 0.0, 0.0], (n, 1)), None, np.full(n, coverage))


def test_both_sides_of_a_surface_are_lit_alike():
    surface, turned = _square(), Surface.from_arrays(SQUARE, TWO[:, ::-1])
    look = source_shader(surface)
    assert np.array_equal(render_surface(surface, _camera(), look), render_surface(turned, _camera(), look))


def test_a_posed_model_is_coloured_at_its_rest_positions_with_widths_in_rest_units():
    posed = Surface.from_arrays(SQUARE * 10.0, TWO, rest=SQUARE + 3.0)
    seen = []

    def look(hits):
        seen.append(hits)
        return Appearance(np.zeros((len(hits.width), 3)))

    render_surface(posed, _camera(5, unit=10.0), look, supersample=2)
    hits = Hits(*map(np.concatenate, zip(*seen, strict=True)))
    assert len(hits.width) == 100
    assert np.allclose(hits.width, 0.1)
    steps = 3.05 + 0.1 * np.arange(10)
    assert np.allclose(np.unique(hits.rest[:, 0].round(5)), steps)
    assert np.allclose(hits.rest[:, 2], 3.0)
    assert np.allclose(np.einsum("nk,nkc->nc", hits.barycentric, posed.rest[TWO[hits.triangles]]), hits.rest)


def test_images_do_not_depend_on_the_size_of_the_blocks(monkeypatch):
    surface = _square(colors=np.eye(4)[:, :3])
    whole = render_surface(surface, _camera(), source_shader(surface))
    monkeypatch.setattr(rasters, "_BLOCK", 7)
    assert np.allclose(render_surface(surface, _camera(), source_shader(surface)), whole, atol=1e-7)


def test_a_texture_is_read_with_the_footprints_and_normals_of_the_samples():
    asked = []

    def sample(points, names, **footprint):
        asked.append((points, footprint))
        return {name: np.zeros((len(points), 3)) for name in names}

    texture = SimpleNamespace(channels={"base_color": SimpleNamespace(format=BASE_COLOR)}, sample=sample)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    stretched = np.array([[2.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
    posed = Surface.from_arrays(SQUARE @ turned.T + [1.0, 0.0, 0.0], TWO, rest=SQUARE @ stretched + 3.0)
    render_surface(posed, _camera(5), texture_shader(texture), supersample=2)
    points, footprint = asked[0]
    assert len(asked) == 1
    assert points.shape == (100, 3)
    # A step to the right in the image is one down at rest, and a step down one to the left.
    assert np.allclose(footprint["dPdx"], [0.0, -0.5 * 0.1, 0.0], atol=1e-9)
    assert np.allclose(footprint["dPdy"], [-2.0 * 0.1, 0.0, 0.0], atol=1e-9)
    assert np.allclose(footprint["normals"], [0.0, 0.0, 1.0])


def test_alpha_is_shown_from_both_sides():
    surface = _square(colors=np.tile([0.2, 0.4, 0.6, 0.5], (4, 1)))
    texture = octex.convert(surface, depth=3)
    expected = 0.5 * FRONT * np.array([0.2, 0.4, 0.6]) + 0.5 * background(4, 4)
    for look in (source_shader(surface), texture_shader(texture)):
        assert np.allclose(render_surface(surface, _camera(4), look), expected, atol=0.01)


def test_what_is_translucent_ends_where_cells_do():
    tree = Octree.from_leaves(np.arange(8), 3)
    half = np.full((tree.n_cells, 1), 128, np.uint8)
    channels = {
        form.name: Channel(
            form, np.repeat(half, form.components, 1), *[half[:0].repeat(form.components, 1)] * 2
        )
        for form in (BASE_COLOR, CHANNELS["alpha"])
    }
    texture = OctreeTexture(tree, channels, Placement((0.0, 0.0, 0.0), 1.0), np.array([[0.0] * 3, [1.0] * 3]))
    rest = np.array([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    none, up = np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1))
    hits = Hits(np.zeros(2, np.int32), none, rest, np.zeros(2, np.float32), none, none, up)
    coverage = texture_shader(texture)(hits).coverage
    np.testing.assert_allclose(coverage, [128 / 255, 0], atol=0.01)


FITTED = Camera.fitted(SQUARE, [0.0, 0.0, 1.0], size=(64, 64), margin=0.25)


@pytest.mark.parametrize("cubes", [False, True])
def test_leaves_show_the_colours_of_the_model(quarters, cubes):
    image = render_leaves(quarters[1], FITTED, cubes=cubes, supersample=2)
    at = np.ix_([20, 44], [20, 44])
    expected = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]])
    assert np.allclose(image[at] / FRONT, expected, atol=0.03)
    assert np.allclose(image[4, 4], background(64, 64)[4, 4])


def test_cubes_have_the_values_of_their_leaves_and_lie_in_the_image():
    coords = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [3, 1, 2]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8)
    texture = octex.convert(octex.Voxels(coords, {"base_color": colors}))
    image = octex.render(texture, cubes=True, size=(96, 96), supersample=1)
    saturated = image.max(axis=2) > image.min(axis=2) + 64
    hues = {tuple(pixel) for pixel in (image[saturated] > 64).tolist()}
    assert hues == {tuple((color > 64).tolist()) for color in colors}
    border = np.ones((96, 96), bool)
    border[1:-1, 1:-1] = False
    assert not (saturated & border).any()


def test_leaves_are_drawn_no_finer_than_asked_and_coarser_for_a_far_camera(quarters, monkeypatch):
    root = render_leaves(quarters[1], FITTED, level=0, cubes=True, supersample=1)
    assert np.allclose(root[32, 32] / FRONT, 0.5, atol=0.02)
    deep, finest = (render_leaves(quarters[1], FITTED, level=level, supersample=1) for level in (9, 5))
    assert np.array_equal(deep, finest)
    _, texture = quarters
    levels = []
    monkeypatch.setattr(type(texture), "level", lambda self, level: levels.append(level) or self)
    render_leaves(texture, Camera.fitted(SQUARE, [0.0, 0.0, 1.0], size=(10, 10)))
    assert levels == [3]  # cells of 1.25 pixels


def test_a_preview_shows_source_and_octree_side_by_side(quarters, tmp_path):
    surface, texture = quarters
    path = tmp_path / "preview.png"
    write_preview(path, texture, surface, size=(160, 110), supersample=1)
    image = np.asarray(Image.open(path)).astype(int)
    assert image.shape == (110, 160, 3)
    # Only in the cells along the edges of colours may the halves differ.
    difference = np.abs(image[:80, :80] - image[:80, 80:]).max(axis=2)
    assert np.mean(difference > 2) < 0.2
    colors = {tuple(color > 100) for color in image[:80, 80:].reshape(-1, 3)[::7]}
    assert {(True, False, False), (False, True, False), (False, False, True)} <= colors


def test_what_cannot_be_drawn_is_refused(quarters):
    surface, texture = quarters
    none = np.zeros((0, 3), np.uint8)
    channel = {"base_color": Channel(BASE_COLOR, np.zeros((1, 3), np.uint8), none, none)}
    empty = OctreeTexture(Octree.from_leaves([], 0), channel, Placement((0, 0, 0), 1), [[0] * 3, [1] * 3])
    too_small = "size must be larger: a panel of {} pixels has no room"
    for draw, message in (
        (lambda: draw_preview(texture, surface, (1, 90)), too_small.format("0 × 90")),
        (lambda: draw_preview(texture, surface, (90, 24)), too_small.format("45 × 24")),
        (lambda: draw_preview(None), "a surface, a texture or both"),
        (lambda: draw_preview(empty), "no leaves to draw"),
        (lambda: texture_shader(SimpleNamespace(channels={})), "there is no channel to draw"),
        (lambda: source_shader(surface, "height"), "unknown channel 'height'; there are: base_color"),
    ):
        with pytest.raises(ArgumentError, match=message):
            draw()


def test_a_preview_of_one_thing_shows_it_alone(quarters, tmp_path):
    surface, texture = quarters
    for name, things in (("surface", (None, surface)), ("texture", (texture,))):
        write_preview(tmp_path / f"{name}.png", *things, size=(100, 64), supersample=1)
        image = np.asarray(Image.open(tmp_path / f"{name}.png"))
        assert image.shape == (64, 100, 3)
        red = (image[..., 0] > 150) & (image[..., 1] < 80)
        assert red.any()


@pytest.fixture
def captions(monkeypatch):
    """The captions of panels that are drawn, which are left blank."""
    texts = []
    monkeypatch.setattr(panels, "captioned", lambda _, *text: texts.append(text) or np.zeros((1, 1, 3)))
    return texts


def test_captions_name_the_model_and_count_the_leaves(quarters, captions):
    surface, texture = quarters
    draw_preview(texture, surface, (60, 60), 1)
    draw_preview(texture, None, (60, 60), 1)
    octree = f"{texture.tree.n_leaves:,} leaves, {texture.nbytes / 1e3:.3g} kB"
    assert captions[0] == ("surface", "model, 2 triangles")
    assert captions[1] == captions[2] == ("octree, depth 5", octree)
    assert captions[3][0].startswith("level ")


def test_captions_are_dark_on_the_background(quarters):
    surface, _ = quarters
    image = draw_preview(None, surface, (200, 120), 1).astype(int)
    strip = image[-24:]
    ink, paper = srgb_to_linear(np.array([strip.min(), np.median(strip)]) / 255)
    assert (paper + 0.05) / (ink + 0.05) > 4.5  # as WCAG asks of text
    codes = np.rint(255 * linear_to_srgb(background(120, 200)))
    assert np.array_equal(image[-1, 0], codes[-1, 0])


def test_a_preview_that_cannot_be_written_leaves_what_stood_there(quarters, tmp_path):
    surface, _ = quarters
    with pytest.raises(OutputError, match=r"no such folder|cannot be written"):
        write_preview(tmp_path / "missing" / "preview.png", None, surface, size=(40, 40), supersample=1)
    (tmp_path / "preview.png").mkdir()
    with pytest.raises(OutputError, match=r"preview\.png"):
        write_preview(tmp_path / "preview.png", None, surface, size=(40, 40), supersample=1)
    assert [path.name for path in tmp_path.iterdir()] == ["preview.png"]


# --- what is shown


def _textured(values, **channels):
    """The square's cells of depth 2, with channels of one value each."""
    square, stored = octex.convert(_square(), 2), {}
    for name, own in channels.items():
        form = own or CHANNELS[name]
        array = np.tile(np.array(values[name], form.dtype), (square.tree.n_cells, 1))
        stored[name] = Channel(form, array, array[:0], array[:0])
    return OctreeTexture(square.tree, stored, square.placement, [[0, 0, 0], [1, 1, 0]])


def test_what_is_emitted_is_added_to_what_is_lit():
    values = {"base_color": [0.25, 0.5, 0.0], "emissive": [0.0, 0.25, 3.0]}
    floats = {name: CHANNELS[name]._replace(space="linear", dtype="float32") for name in values}
    texture, surface = _textured(values, **floats), _square().with_sources(values)
    expected = np.array([0.25, 0.5, 0.0]) * FRONT + [0.0, 0.25, 1.0]  # emission ends at white
    for look in (texture_shader(texture), source_shader(surface)):
        assert np.allclose(render_surface(_square(), _camera(4), look), expected, atol=1e-3)
    assert np.allclose(render_leaves(texture, _camera(4)), expected, atol=0.05)


NORMAL = np.array([100, 150, 200]) / 255 * 2 - 1


@pytest.mark.parametrize(
    ("stored", "shown", "image"),
    [
        (["roughness"], "roughness", srgb_to_linear([100 / 255] * 3)),
        (["normal"], "normal", srgb_to_linear((NORMAL / np.linalg.norm(NORMAL) + 1) / 2)),
        (["emissive"], "emissive", srgb_to_linear(np.array([100, 150, 200]) / 255)),
        (["roughness", "specular"], "specular", srgb_to_linear(np.array([100, 150, 200]) / 255)),
        (["normal", "metallic"], "metallic", srgb_to_linear([100 / 255] * 3)),
        (["alpha"], "alpha", srgb_to_linear([100 / 255] * 3)),
    ],
)
def test_without_base_colour_another_channel_is_shown_as_it_is(stored, shown, image, captions):
    codes = {name: [100, 150, 200][: CHANNELS[name].components] for name in stored}
    texture = _textured(codes, **dict.fromkeys(stored))
    assert np.allclose(render_surface(_square(), _camera(4), texture_shader(texture)), image, atol=0.01)
    assert np.allclose(render_leaves(texture, _camera(4)), image, atol=0.01)
    draw_preview(texture, None, (40, 40), 1)
    assert captions[0][1].startswith(f"{shown}: ")


def test_a_channel_of_one_or_four_numbers_is_shown_too():
    for components, expected in ((1, [0.5, 0.5, 0.5]), (2, [0.5, 0.5, 0.5]), (4, [0.5, 0.25, 0.0])):
        form = CHANNELS["emissive"]._replace(components=components, space="linear", dtype="float32")
        texture = _textured({"emissive": [0.5, 0.25, 0.0, 1.0][:components]}, emissive=form)
        assert np.allclose(render_surface(_square(), _camera(2), texture_shader(texture)), expected)


def test_a_model_and_a_texture_of_fewer_channels_show_the_same_one(captions):
    surface = _square().with_sources({"roughness": 0.5})
    assert {form.name for form in surface.channels} == {"base_color", "roughness"}
    draw_preview(octex.convert(surface.with_channels(["roughness"]), 2), surface, (40, 40), 1)
    assert [text.split(":")[0] for _, text in captions] == ["roughness", "roughness"]


def test_only_what_is_drawn_is_evaluated():
    surface = _square().with_sources({"roughness": 0.5, "emissive": 0.5})
    asked = []
    surface.with_channels = lambda names: asked.append(names) or Surface.with_channels(surface, names)
    source_shader(surface)
    source_shader(surface, "roughness")
    assert asked == [["base_color", "emissive"], ["roughness"]]


def test_the_channel_most_like_a_colour_is_chosen():
    order = ["base_color", "emissive", "alpha", "normal"]
    for first in range(4):
        formats = [CHANNELS[name] for name in reversed(order[first:])]
        assert ShownChannels.of(formats).channel.name == order[first]


def test_a_preview_is_drawn_from_where_it_is_asked_for(quarters):
    surface = quarters[0]

    def drawn(**view):
        image = draw_preview(None, surface, (90, 60), 1, view=Viewpoint(**view)).astype(int)
        seen = np.ptp(image, axis=2) > 60  # what has colours
        return image, seen

    usual, large = drawn(direction=(0, 0, 1)), drawn(direction=(0, 0, 1), zoom=0.5)
    assert 3 < usual[1].sum() / large[1].sum() < 5
    turned = drawn(direction=(0, 0, 1), up=(0, -1, 0))[0]
    for row, column in ((10, 37), (10, 53), (26, 37), (26, 53)):  # about the middle, (18, 45)
        assert np.abs(turned[36 - row, 90 - column] - usual[0][row, column]).max() < 30
    assert np.abs(turned[10, 37] - usual[0][10, 37]).max() > 100


def test_images_are_seen_from_where_their_cameras_stand():
    points, up = np.random.default_rng(0).random((20, 3)), (0.0, 0.0, 1.0)
    ways = np.array([[1.0, -0.4, 0.2], [1.0, 0.0, 0.2], [1.0, 0.4, 0.2]])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)

    def seen(ways):
        return [Camera.fitted(points, way, size=(40, 30), up=up) for way in ways]

    for some, direction in ((ways, ways.mean(axis=0)), (ways[:1], ways[0]), ([ways[2], *-ways[2:]], ways[2])):
        made = viewpoint_among(seen(some)).camera(
            points, lambda: (np.eye(3), np.ones(3)), lambda _: points, (40, 30), 0
        )
        (expected,) = seen([direction])
        np.testing.assert_allclose(made.world_to_camera, expected.world_to_camera, atol=1e-9)


def _sheets(alphas, colors, order):
    """Squares behind each other toward −z, in some order, each of a colour and an alpha."""
    vertices = np.vstack([SQUARE - [0.0, 0.0, 0.1 * n] for n in order])
    triangles = np.vstack([TWO + 4 * n for n in range(len(order))])
    rgba = np.column_stack([colors, alphas])[order]
    return Surface.from_arrays(vertices, triangles, colors=rgba.repeat(4, axis=0), alpha="blend")


def _over(alphas, colors, behind):
    """Composite, the nearest first."""
    for alpha, color in zip(alphas[::-1], colors[::-1], strict=True):
        behind = alpha * np.asarray(color) * FRONT + (1 - alpha) * behind
    return behind


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 1, 0, 2]])
def test_layers_are_drawn_over_what_is_behind_them_in_whatever_order_they_are_stored(order):
    alphas, colors = np.array([0.5, 0.0, 0.25, 0.6]), np.array([[1, 0, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1.0]])
    surface = _sheets(alphas, colors, order)
    truth = _over(alphas, colors, background(4, 4))
    assert np.allclose(render_surface(surface, _camera(4), source_shader(surface), 2), truth, atol=1e-5)
    texture = octex.convert(surface, 7)
    found = render_surface(surface, _camera(4), texture_shader(texture), 2)
    assert np.allclose(found[1:-1, 1:-1], truth[1:-1, 1:-1], atol=0.02)


def test_what_is_opaque_ends_the_layers_and_each_look_has_its_own():
    surface = _sheets(np.array([0.5, 1.0, 1.0]), np.eye(3), [2, 0, 1])
    seen = []

    def red(hits):
        seen.append(len(hits.width))
        return Appearance(np.tile([1.0, 0.0, 0.0], (len(hits.width), 1)))

    both = rasters.film_surface(surface, _camera(4), [source_shader(surface), red], 1)
    assert seen == [16, 16]  # behind the first layer, nothing behind the second
    truth = _over(np.array([0.5, 1.0]), np.eye(3)[:2], 0.0)
    assert np.allclose(both[0].image(), truth, atol=1e-6)
    assert np.allclose(both[1].image(), FRONT * np.array([1.0, 0, 0]), atol=1e-6)


@pytest.mark.parametrize("cutoff", [0.25, 0.5, 0.75])
def test_masks_are_cut_out_at_their_cutoff_and_show_what_is_behind(cutoff):
    ramp = np.zeros((64, 64, 4), np.uint8)
    ramp[..., 0] = 255
    ramp[..., 3] = np.rint(np.linspace(0, 255, 64))[:, None]
    card = {"uv": SQUARE[:, :2], "image": ramp, "wrap": "clamp"}
    masked = _square(**card, alpha="mask", cutoff=cutoff)
    wall = Surface.from_arrays(SQUARE - [0, 0, 0.5], TWO, factor=(0.0, 0.0, 1.0))
    both = Surface.joined([masked, wall])
    texture = octex.convert(both, 6)
    for look in (source_shader(both), texture_shader(texture)):
        image = render_surface(both, _camera(32), look, 2) / FRONT
        rows = np.arange(32)
        is_card = (rows + 0.5) / 32 > cutoff
        clear = np.abs((rows + 0.5) / 32 - cutoff) > 0.06
        clear[:2] = clear[-2:] = False
        assert np.allclose(image[is_card & clear][:, 4:-4], [1, 0, 0], atol=0.02)
        assert np.allclose(image[~is_card & clear][:, 4:-4], [0, 0, 1], atol=0.02)


def test_leaves_that_cover_nothing_hide_nothing():
    both = _sheets(np.array([0.0, 1.0]), np.array([[1, 1, 1], [0.2, 0.4, 0.6]]), [0, 1])
    camera = Camera.fitted(SQUARE, [0.0, 0.0, 1.0], size=(64, 64), margin=0.25)
    image = render_leaves(octex.convert(both, 6), camera, supersample=1)
    assert np.allclose(image[24:40, 24:40] / FRONT, [0.2, 0.4, 0.6], atol=0.03)
