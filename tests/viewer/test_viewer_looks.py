"""Cells as cubes, studio light and translucent layers in the page."""

import numpy as np
import pytest

import octex
from octex.channels import encode, linear_to_srgb, srgb_to_linear
from octex.drawing import render_surface, texture_shader
from octex.drawing.environment import Environment
from octex.source.surface import Surface
from octex.tree.morton import decode_cells
from octex.tree.octree import walk_leaves
from octex.viewer import write_page
from tests.make.browser import Probe, camera_of, drawn, file_url, opened, sharp
from tests.make.painted import ball

#: Returns the numbers of a level's cubes, and how many cubes there are to be.
_CUBES = """(level) => {
  const { octree } = viewer.parts[0];
  return [Array.from(octree.cubes(level)), octree.cubeCount(level)];
}"""


@pytest.fixture(scope="module")
def painted(browser, tmp_path_factory):
    """A ball, a part of it finer, and its page."""
    surface = ball(16).with_sources({"base_color": lambda p: np.full_like(p, 0.5)})
    low, _ = surface.bounds
    texture = octex.fill(
        octex.convert(surface, depth=6), surface, octex.Sphere(low + 0.5, 0.6), (1, 0, 0), max_depth=7
    )
    path = tmp_path_factory.mktemp("page") / "ball.html"
    write_page(texture, path, surface, title="ball.octex")
    page = opened(browser, file_url(path), (760, 400))
    yield texture, page
    assert page.complaints == []
    page.close()


def test_cubes_are_the_leaves(painted):
    texture, page = painted
    for level in (0, 3, 6, 7):
        cubes, count = page.evaluate(_CUBES, level)
        found = np.array(cubes).reshape(-1, 5)
        expected = [
            np.column_stack([decode_cells(codes), depths, cells])
            for cells, codes, depths in walk_leaves(texture.level(level).tree.arrays)
        ]
        np.testing.assert_array_equal(np.unique(found, axis=0), np.unique(np.concatenate(expected), axis=0))
        assert count == len(found)


def test_where_cubes_are_too_many_a_coarser_level_is_drawn_and_named(painted):
    texture, page = painted
    page.check("#cubes")
    assert page.locator("#cubes-note").inner_text() == ""
    fewer = "(most) => { viewer.gpu.maxCubes = most; viewer.showLegend(); viewer.invalidate(); }"
    most = page.evaluate("viewer.gpu.maxCubes")
    page.evaluate(fewer, texture.tree.n_leaves - 1)
    note = "Level 6 is drawn: level 7 has too many cubes."
    assert page.locator("#cubes-note").text_content() == note
    middle = "viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2)"
    sharp(page)
    assert page.evaluate("viewer.parts[0].cubes.level") == 6
    assert page.evaluate(middle)["level"] <= 6
    page.uncheck("#cubes")
    assert page.locator("#cubes-note").text_content() == ""
    page.evaluate(fewer, most)


def test_the_legend_names_the_colours_that_are_drawn(painted):
    texture, page = painted
    swatches = "[...document.querySelectorAll('#legend .swatch')].map((each) => each.style.background)"
    assert not page.locator("#legend").is_visible()
    page.select_option("#mode", "depth")
    leaves = [leaves for leaves, _ in texture.tree.cells_by_depth()]
    edge = texture.placement.size
    expected = [
        f"level {level}: {count:,} cells, {edge / 2**level:#.3g} wide"
        for level, count in enumerate(leaves)
        if count
    ]
    assert page.locator("#legend").inner_text().split("\n") == expected
    page.locator("#level").fill("6")
    assert "level 7" not in page.locator("#legend").inner_text()
    for shown in ("depth", "facing"):
        page.select_option("#mode", shown)
        page.check("#cubes")
        page.evaluate("viewer.gpu.draw(viewer.display, viewer.camera, 64, 48)")
        sharp(page)
        colors = [[int(n) for n in text[4:-1].split(",")] for text in page.evaluate(swatches)]
        ways = np.array(colors, float)
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        image = drawn(page, (160, 120)).reshape(-1, 3).astype(float)
        seen = image[np.abs(image - image[0]).max(axis=1) > 2]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)  # faces are shaded
        apart = np.linalg.norm(seen[:, None] - ways, axis=2).min(axis=1)
        assert np.median(apart) < 0.02
        page.uncheck("#cubes")
    assert page.locator("#legend li").count() == 8
    page.select_option("#mode", "unlit")
    assert not page.locator("#legend").is_visible()


LIT = 160, 120
_APART = np.arange(3.0)  # of the components of colours


def shiny(p):
    """What a ball is made of: from mirror to matte, half of it metal."""
    turn = np.arctan2(p[:, 2], p[:, 0])[:, None]
    return {
        "base_color": 0.5 + 0.45 * np.sin(2 * turn + _APART),
        "metallic": 0.5 + 0.5 * np.tanh(8 * p[:, 1:2]),
        "roughness": 0.5 + 0.5 * np.sin(turn),
        "occlusion": 0.7 + 0.3 * np.cos(turn),
        "emissive": 0.1 + 0.1 * np.sin(3 * turn + 2 * _APART),
        "specular": 0.05 + 0.04 * np.cos(turn + _APART),
    }


def made(names):
    return ball(32).with_sources({name: lambda p, name=name: shiny(p)[name] for name in names})


@pytest.mark.parametrize("names", [["base_color"], list(shiny(np.ones((1, 3))))])
def test_studio_light_is_the_same_in_the_page_and_in_previews(names, opens, tmp_path):
    surface = made(names)
    texture = octex.convert(surface, depth=6)
    write_page(texture, tmp_path / "page.html", surface)
    page = opens(tmp_path / "page.html", (912, 480))  # the image is 4:3
    seen = Probe(page, texture, LIT).seen.reshape(LIT[1], LIT[0])[::-1]
    found = drawn(page, LIT).astype(int)
    look = texture_shader(texture, materials=True)
    light = render_surface(surface, camera_of(page, LIT), look, 1, Environment.studio())
    away = np.abs(found - encode(light, "uint8", "srgb")).max(axis=2)[seen]
    assert away.size > 3000
    assert np.quantile(away, 0.97) <= 2


PANE = 64, 48
RED, GREEN, BLUE = np.eye(3)
GROUND = srgb_to_linear(np.array([0.925, 0.93, 0.94]))


def panes(alphas):
    """Squares one behind another: at each z a colour and its alpha."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([square + np.array([0, 0, z]) for z in alphas])
    triangles = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * n for n in range(len(alphas))])
    places, kinds = np.array(list(alphas)), list(alphas.values())

    def nearest(p):
        return np.abs(p[:, 2:] - places).argmin(axis=1)

    colors, covers = np.array([kind[0] for kind in kinds]), np.array([kind[1] for kind in kinds])
    return Surface.from_arrays(vertices, triangles).with_sources(
        {"base_color": lambda p: colors[nearest(p)], "alpha": lambda p: covers[nearest(p)][:, None]}
    )


def middle(opens, surface, path):
    """Return the colour in the middle of the image, without light, and what a pick finds there."""
    write_page(octex.convert(surface, depth=5), path, surface)
    page = opens(path, (912, 480), is_drawn=False)
    page.evaluate("viewer.camera.reset(0, 0)")
    color = drawn(page, PANE, mode="unlit")[PANE[1] // 2, PANE[0] // 2]
    found = page.evaluate("viewer.pick(viewer.canvas.clientWidth / 2, viewer.canvas.clientHeight / 2)")
    return color, found


def over(color, alpha, behind):
    return alpha * np.asarray(color) + (1 - alpha) * np.asarray(behind)


@pytest.mark.parametrize(
    ("layers", "expected", "picked"),
    [
        ({-1.0: (BLUE, 1.0), 1.0: (RED, 0.4)}, over(RED, 0.4, BLUE), 1.0),  # glass over what is opaque
        ({-1.0: (BLUE, 1.0), 0.0: (GREEN, 0.5), 1.0: (RED, 0.4)}, over(RED, 0.4, BLUE), 1.0),  # the nearest
        ({-1.0: (BLUE, 1.0), 0.0: (GREEN, 0.5), 1.0: (RED, 0.0)}, over(GREEN, 0.5, BLUE), 0.0),  # cut out
        ({-1.0: (BLUE, 0.5), 1.0: (RED, 1.0)}, RED, 1.0),  # what is hidden adds nothing
        ({0.0: (GREEN, 0.5)}, over(GREEN, 0.5, GROUND), 0.0),  # alone, over the ground in linear light
    ],
)
def test_the_nearest_translucent_layer_lies_over_what_is_opaque(layers, expected, picked, opens, tmp_path):
    color, found = middle(opens, panes(layers), tmp_path / "panes.html")
    assert np.abs(color - 255 * linear_to_srgb(expected)).max() <= 2
    assert found["rest"][2] == pytest.approx(picked, abs=1e-3)
