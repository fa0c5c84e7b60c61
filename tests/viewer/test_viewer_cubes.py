"""Cells as cubes: no more than a page can draw; and what the colours of cells mean."""

import numpy as np
import pytest

import octex
from octex.tree.morton import decode_cells
from octex.tree.octree import walk_leaves
from octex.viewer import write_page
from tests.make.browser import drawn, file_url, opened, sharp
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
