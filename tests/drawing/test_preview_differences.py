"""Images of differences."""

import math

import numpy as np
import pytest
from PIL import ImageDraw

import octex
from octex.drawing import differences, draw_difference
from octex.drawing.compare import PEAKS, Difference, difference
from octex.drawing.differences import _ALONE, _SCALE, _scale_codes, _scale_top
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.morton import decode_cells
from octex.tree.octree import walk_leaves
from tests.conftest import needs_jit

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
SIZE = (300, 110)


@pytest.fixture(scope="module")
def surface():
    grey = Surface.from_arrays(SQUARE, TWO, colors=np.full((4, 3), 0.25))
    return grey.with_sources({"roughness": 0.5})


@pytest.fixture(scope="module")
def texture(surface):
    return octex.convert(surface, 4)


def spotted(texture, x=0.75, y=0.75):
    """The same texture with a white spot."""
    (leaves,) = walk_leaves(texture.tree.arrays)
    edge = 2.0**-texture.tree.max_depth
    centres = texture.placement.to_rest((decode_cells(leaves.codes) + 0.5) * edge)
    near = np.abs(centres[:, :2] - [x, y]).max(axis=1) < 0.1
    stored = texture.channels["base_color"]
    values = stored.values.copy()
    values[leaves.cells[near]] = 255
    changed = {**texture.channels, "base_color": stored._replace(values=values)}
    return OctreeTexture(texture.tree, changed, texture.placement, texture.bounds)


def drawn(a, b, **options):
    found = difference(a, b, points=1000, **options)
    image = draw_difference(a, b, found, size=SIZE, supersample=1).astype(np.int64)
    assert image.shape == (SIZE[1] * len(found), SIZE[0], 3)
    return np.split(image[: SIZE[1]], 3, axis=1), found


def is_bright(image):
    """Where the model, above the caption, is of the scale's upper half."""
    return (image[:75, :, 0] > 180) & (image[:75, :, 2] < 120)


@pytest.mark.parametrize("kind", ["textures", "model"])
def test_the_difference_is_bright_where_something_differs_and_dark_elsewhere(kind, surface, texture):
    a = surface if kind == "model" else texture
    (first, second, apart), _ = drawn(a, spotted(texture), channels=["base_color"])
    rows, columns = np.nonzero(is_bright(apart))
    assert len(rows) > 20
    # The spot is where the second image is bright and the first is not; the backdrop is the same in both.
    spot = np.abs(second - first).max(axis=2)[:75] > 40
    assert np.abs(np.argwhere(spot).mean(axis=0) - [rows.mean(), columns.mean()]).max() < 3
    dark = (apart[:75] < 30).all(axis=2)
    assert dark.sum() > 4 * len(rows)


@pytest.mark.parametrize("kind", ["textures", "model"])
def test_a_ring_marks_the_maximum_if_it_is_in_sight(kind, surface, texture, monkeypatch):
    said, rings, captioned = [], [], differences.captioned
    monkeypatch.setattr(differences, "captioned", lambda *panel: said.append(panel[2]) or captioned(*panel))
    circle = ImageDraw.ImageDraw.circle

    def drawn_circle(image, middle, *given, **options):
        rings.append(middle)
        circle(image, middle, *given, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "circle", drawn_circle)
    one, other = surface if kind == "model" else texture, spotted(texture)
    (_, _, apart), found = drawn(one, other, channels=["base_color"])
    assert said[2].endswith("/255, in the ring")
    bright = np.argwhere(is_bright(apart))
    assert (bright.min(axis=0) - 2 <= rings[0][::-1]).all()
    assert (bright.max(axis=0) + 2 >= rings[0][::-1]).all()
    # Elsewhere than anything that is seen, there is no ring.
    found["base_color"] = found["base_color"]._replace(where=(0.75, 0.75, -9.0))
    said.clear()
    rings.clear()
    draw_difference(one, other, found, size=SIZE, supersample=1)
    assert said[2].endswith("out of sight")
    assert not rings


def test_what_only_one_has_is_blue_and_the_legend_says_so(surface):
    half = Surface(SQUARE, TWO[:1], surface.source)
    texture = octex.convert(half, 4)
    for a in (surface, octex.convert(surface, 4)):
        (_, _, apart), found = drawn(a, texture, channels=["roughness"])
        assert found.uncovered[0] == pytest.approx(0.4, abs=0.1)
        blue = np.abs(apart - _ALONE).max(axis=2) < 12
        assert blue[:75].sum() > 500
        assert blue[90:].sum() >= 9  # the legend
    (_, _, apart), _ = drawn(surface, octex.convert(surface, 4), channels=["roughness"])
    assert not (np.abs(apart - _ALONE).max(axis=2) < 12).any()


def test_the_model_is_left_of_the_texture_whichever_is_given_first(surface, texture):
    other = spotted(texture)
    (left, right, _), _ = drawn(surface, other, channels=["base_color"])
    found = difference(other, surface, points=1000, channels=["base_color"])
    names = "texture", "model"
    turned = draw_difference(other, surface, found, names, size=SIZE, supersample=1)
    first, second, _ = np.split(turned.astype(np.int64)[:75], 3, axis=1)
    assert np.abs(first - left[:75]).max() <= 2
    assert np.abs(second - right[:75]).max() <= 2
    assert np.abs(first - second).max() > 40


def test_of_two_textures_the_finer_leaves_show_the_difference(surface):
    fine, coarse = spotted(octex.convert(surface, 5)), octex.convert(surface, 4)
    for a, b in ((fine, coarse), (coarse, fine)):
        (_, _, apart), _ = drawn(a, b, channels=["base_color"])
        assert is_bright(apart).sum() > 20


@needs_jit
@pytest.mark.parametrize("kind", ["textures", "model"])
def test_both_sides_are_drawn_with_alpha_and_what_is_emitted_or_neither_is(kind, surface, texture):
    changed = surface.with_sources({"alpha": lambda points: points[:, 0], "emissive": (0.0, 0.5, 0.0)})
    clear = octex.convert(changed, 4)
    without, with_both = (surface, changed) if kind == "model" else (texture, clear)
    (plain, beside, _), found = drawn(without, clear, channels=["base_color"])
    assert found["base_color"].maximum < 1
    assert np.abs(plain - beside)[:75].max() <= 2
    (first, second, _), _ = drawn(with_both, clear, channels=["base_color"])
    assert np.abs(first - second)[:75].max() <= 8
    assert np.abs(first - plain)[:75].max() > 50
    _, found = drawn(surface, texture)
    assert list(found) == ["base_color", "roughness"]  # a row each


def test_directions_are_drawn_by_their_angle():
    flat = np.full((4, 4, 3), 128, np.uint8)
    tilted = flat.copy()
    flat[..., 2] = 255
    tilted[..., 0], tilted[..., 2] = 218, 218
    mapped = Surface.from_arrays(SQUARE, TWO, uv=SQUARE[:, :2])
    a, b = (octex.convert(mapped.with_sources({"normal": image}), 3) for image in (flat, tilted))
    (first, second, apart), found = drawn(a, b, channels=["normal"])
    assert found["normal"].angle is not None
    assert found["normal"].angle.rms == pytest.approx(45, abs=2)
    assert _scale_top(found["normal"].angle) == 50.0
    middle = apart[30:60, 45:55].reshape(-1, 3)
    assert np.abs(middle - _scale_codes(np.array(0.9))).max() < 25
    assert np.abs(first[40, 50] - [128, 128, 255]).max() < 6
    assert np.abs(second[40, 50] - [218, 128, 218]).max() < 12


def test_a_preview_of_no_difference_is_dark(texture):
    (_, _, apart), found = drawn(texture, texture, channels=["roughness"])
    assert found["roughness"].maximum == 0.0
    assert (np.abs(apart - 255).max(axis=2) > 0).all()  # no ring
    assert (np.abs(apart[30:60, 45:55] - _SCALE[0]).max() < 3).all()


@pytest.mark.parametrize(
    ("p99", "maximum", "top"),
    [
        (0.0, 0.0, 255.0), (0.7, 1.0, 1.0), (1.0, 1.0, 1.0), (1.1, 3.0, 2.0), (0.0, 30.0, 5.0),
        (49.0, 60.0, 50.0), (51.0, 60.0, 100.0), (0.003, 0.004, 0.005), (3.0, math.inf, 255.0),
    ],
)  # fmt: skip
def test_the_scale_ends_at_a_round_number(p99, maximum, top):
    shown = Difference("sRGB, 1/255", 0.0, 0.0, p99, maximum, (0.0, 0.0, 0.0), (), ())
    assert PEAKS[shown.measure] == 255
    assert _scale_top(shown) == pytest.approx(top)


def test_the_scale_is_ordered_by_lightness():
    codes = _scale_codes(np.linspace(0.0, 1.0, 100))
    lightness = codes @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 0).all()
    assert _scale_codes(np.array([7.0])).tolist() == [_SCALE[-1].tolist()]
