"""Parts moved apart at rest: no cell is shared, colours stay, and files remember it."""

import json
from functools import cache

import numpy as np
import PIL.Image
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import octex
from octex.channels import CHANNELS, linear_to_srgb
from octex.conversion.convert import separate
from octex.drawing import draw_difference, draw_preview
from octex.drawing.compare import difference
from octex.errors import ArgumentError
from octex.source.base import SpatialSource
from octex.source.parts import _packed
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from octex.tree.morton import decode_cells
from tests.conftest import needs_jit
from tests.make.command import OUT, VIEW
from tests.make.fixtures import obj_lines
from tests.make.solids import colored, cube, open_cube, sphere


def pair():
    return colored(cube([0, 0, 0]), cube([0.6, 0.3, 0.2], 0.5))


#: Two spheres that intersect.
SPHERES = sphere([0, 0, 0], 1.0), sphere([1.5, 0.1, 0], 0.8)


@cache
def spheres(depth):
    """The spheres, and a texture for which they were moved apart."""
    surface = colored(*SPHERES)
    return surface, octex.convert(surface, depth, separate=3)


def cells_of(surface, texture, parts, **options):
    """The finest cells (n, 3) of each part, by a conversion of it alone into the texture's root cell."""
    depth = texture.tree.max_depth
    found = []
    for part in range(parts.max() + 1):
        alone = Surface(surface.vertices, surface.triangles[parts == part], surface.source, rest=surface.rest)
        alone.source = octex.Surface.from_arrays(alone.vertices, alone.triangles).source
        alone.bounds = texture.bounds
        converted = octex.convert(alone, fit=False, **(options or {"depth": depth}))
        assert converted.placement == texture.placement
        found.append(decode_cells(converted.tree.level_codes(depth)).astype(np.int64))
    return found


def are_apart(a, b, cells):
    """Whether no two cells are less than so many apart along every axis."""
    taken = np.zeros(np.maximum(a.max(axis=0), b.max(axis=0)) + 2 * cells, bool)
    taken[tuple((b + cells).T)] = True
    near = np.array(list(np.ndindex(*[2 * cells - 1] * 3))) + 1
    return not any(taken[tuple((a + step).T)].any() for step in near)


def worst(surface, texture):
    """The root mean square of differences at points of a surface, in sRGB codes."""
    samples = surface.placed_in(texture).scatter(20_000)
    found, wanted = texture.sample(samples.rest), surface.evaluate(samples)
    return float(255 * np.sqrt(((linear_to_srgb(found) - linear_to_srgb(wanted)) ** 2).mean()))


def test_the_smaller_of_two_parts_is_moved_beside_the_larger():
    surface = pair()
    apart = surface.separated(0.125)
    moved = apart.rest - surface.rest
    assert not moved[:8].any()
    assert np.ptp(moved[8:], axis=0).max() < 1e-12
    assert apart.overlapping_parts(0.124).pairs == ()
    assert np.ptp(apart.bounds, axis=0).max() == pytest.approx(1.625)
    assert np.array_equal(apart.vertices, surface.vertices)
    assert json.loads(apart.provenance["separation"])["moved"].keys() == {"1"}


def test_parts_that_are_apart_stay_where_they_are():
    surface = colored(cube([0, 0, 0]), cube([0.6, 0.3, 0.2], 0.5), cube([3, 0, 0]), cube([6, 0, 0]))
    moved = surface.separated(0.1).rest - surface.rest
    assert not moved[:8].any()
    assert not moved[16:].any()
    single = colored(cube([0, 0, 0]), cube([3, 0, 0]))
    assert single.separated(0.1) is single


def test_what_lies_deep_inside_another_stays():
    surface = colored(cube([0, 0, 0]), cube([0.4, 0.4, 0.4], 0.2))
    assert surface.separated(0.3) is surface
    assert surface.separated(0.5) is not surface


def test_open_parts_are_moved_too():
    surface = colored(cube([0, 0, 0]), open_cube([0.5, 0.2, 0.1], 0.4))
    assert surface.separated(0.1).overlapping_parts(0.0999).pairs == ()


def test_a_long_model_is_put_beside_its_long_side():
    tall = cube([0, 0, 0])
    tall[0][:, 2] *= 4
    surface = colored(tall, cube([0.5, 0, 0]))
    assert np.ptp(surface.separated(0.1).bounds, axis=0).max() == pytest.approx(4)


def test_many_parts_are_moved_in_their_classes(monkeypatch):
    monkeypatch.setattr("octex.source.parts._SINGLY", 3)
    surface = colored(*[cube([0.75 * n, 0, 0]) for n in range(8)])
    apart = surface.separated(0.1)
    assert apart.overlapping_parts(0.0999).pairs == ()
    moved = (apart.rest - surface.rest).reshape(8, 8, 3)[:, 0]
    assert len(np.unique(moved[np.abs(moved).max(axis=1) > 0].round(9), axis=0)) == 1
    assert np.ptp(apart.bounds, axis=0).max() == pytest.approx(0.75 * 6 + 1)


def test_sources_give_what_they_gave():
    class Places(SpatialSource):
        def at(self, points, normals, widths):  # noqa: ARG002
            return np.clip(points, 0, 1).astype(np.float32)

    form = CHANNELS["base_color"]
    surface = pair()
    surface.source = Places([form], surface.rest, surface.triangles)
    samples = surface.scatter(50)
    assert np.array_equal(surface.separated(0.1).evaluate(samples), surface.evaluate(samples))


def test_margins_and_overlaps_that_do_not_fit_are_refused():
    surface, other = pair(), colored(cube([0, 0, 0]))
    for each, options, message in (
        (surface, (0.0,), "margin must be finite and above zero"),
        (surface, (0.1, surface.overlapping_parts(0.05)), r"overlaps were computed with a margin of 0\.05"),
        (surface, (0.1, other.overlapping_parts(0.1)), "or for another surface"),
        (surface.separated(0.1), (0.2,), "parts is separated already"),
    ):
        with pytest.raises(ArgumentError, match=message):
            each.separated(*options)


def test_a_group_finds_the_place_where_the_whole_grows_least():
    low = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    high = np.array([[4.0, 4, 1], [1, 1, 1], [2, 2, 2]])
    offsets = _packed(low, high, (low[0], high[0]), [np.array([1]), np.array([2])], 0.5)
    assert np.ptp([(low + offsets).min(0), (high + offsets).max(0)], axis=0).tolist() == [4, 4, 3.5]


@pytest.mark.parametrize("options", [{"depth": 5}, {"cell": 0.05}])
def test_no_cell_and_no_neighbourhood_is_shared(options):
    surface = pair()
    texture = octex.convert(surface, **options, separate=3, fit=False)
    placed = surface.placed_in(texture)
    first, second = cells_of(placed, texture, surface.overlapping_parts().parts, **options)
    assert are_apart(first, second, 3)
    assert len(first) + len(second) == texture.tree.n_leaves


@needs_jit
@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.integers(5, 6))
def test_cubes_anywhere_are_separated(seed, count, depth):
    random = np.random.default_rng(seed)
    meshes = [cube(random.random(3) * 2, 0.1 + 0.5 * random.random()) for _ in range(count)]
    surface = colored(*meshes)
    made = separate(surface, 3, depth=depth)
    texture = octex.convert(made.surface, depth, fit=False)
    cells = cells_of(made.surface, texture, made.found.parts)
    for a in range(len(cells)):
        for b in range(a + 1, len(cells)):
            assert are_apart(cells[a], cells[b], 3)
    assert np.array_equal(surface.rest_positions(texture), made.surface.rest)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cells": 0.5}, "cells must be from 1"),
        ({"cells": "x"}, "cells must be a number"),
        ({"depth": 3, "cell": 0.1}, "give depth or cell, not both"),
        ({"cell": -1}, "cell must be finite and above zero"),
        ({"depth": 99}, "depth must be a whole number"),
        ({"depth": 3}, "20 parts do not fit 3 cells apart into depth 3; use a larger depth"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message):
    with pytest.raises(ArgumentError, match=message):
        separate(colored(*[cube([0.01 * n, 0, 0]) for n in range(20)]), **options)


@needs_jit
def test_colours_do_not_run_together():
    surface, texture = spheres(6)
    assert worst(surface, octex.convert(surface, 6)) > 4
    assert worst(surface, texture) < 0.5


@needs_jit
def test_suzannes_eyes_share_no_cell_with_her_head(models):
    surface = octex.load_surface(models / "Suzanne" / "Suzanne.gltf", channels=["base_color"])
    texture = octex.convert(surface, 8, separate=3)
    cells = cells_of(surface.placed_in(texture), texture, surface.overlapping_parts().parts)
    assert sum(map(len, cells)) == texture.tree.n_leaves
    assert all(are_apart(cells[eye], cells[2], 3) for eye in (0, 1))
    assert worst(surface, texture) <= 1.0


def test_the_file_remembers_it(tmp_path):
    surface = pair()
    octex.convert(surface, 4, separate=3).save(tmp_path / "pair.octex")
    texture = octex.open(tmp_path / "pair.octex")
    samples = surface.scatter(100)
    rest = surface.rest_positions(texture)
    corners = rest[surface.triangles[samples.triangles]]
    points = np.einsum("nc,ncx->nx", samples.barycentric, corners)
    assert texture.contains(points).all()
    assert not texture.contains(samples.rest).all()
    plain = octex.convert(surface, 4)
    assert surface.rest_positions(plain) is surface.rest
    assert surface.placed_in(plain) is surface
    assert json.loads(texture.metadata["convert"])["separate"] == 3.0


def test_a_separated_surface_is_where_its_texture_is():
    apart = pair().separated(0.5)
    texture = octex.convert(apart, 4)
    assert apart.placed_in(texture) is apart
    assert np.array_equal(pair().rest_positions(texture), apart.rest)
    with pytest.raises(ArgumentError, match="parts is separated otherwise than the texture"):
        apart.placed_in(octex.convert(pair(), 4))
    with pytest.raises(ArgumentError, match="texture's 2 parts were moved apart, and they are not the 1 of"):
        colored(cube([0, 0, 0])).rest_positions(texture)
    with pytest.raises(ArgumentError, match="otherwise than the texture"):
        pair().separated(0.3).placed_in(texture)
    moved = apart.with_rest(apart.vertices)
    assert np.array_equal(moved.rest_positions(texture), apart.rest)


@needs_jit
def test_cells_are_a_number_or_three():
    plain, three, also = (octex.convert(pair(), 5, separate=cells) for cells in (False, True, 3))
    assert "separation" not in plain.metadata
    assert three.metadata == also.metadata
    with pytest.raises(ArgumentError, match="separate must be from 1"):
        octex.convert(pair(), 5, separate=0)


def test_functions_of_detail_get_positions_as_they_were():
    seen = []

    def detail(points):
        seen.append(points)
        return np.full(len(points), 4)

    surface = pair()
    assert octex.convert(surface, 5, detail=detail, separate=3).tree.max_depth == 4
    points = np.concatenate(seen)
    assert (points >= surface.bounds[0] - 1e-9).all()
    assert (points <= surface.bounds[1] + 1e-9).all()


@needs_jit
def test_the_paint_command_finds_the_parts(tmp_path, cli):
    model = written(tmp_path, *SPHERES)
    octex.convert(model, 5, separate=3).save(tmp_path / "a.octex")
    seen, eye = tmp_path / "a.png", tmp_path / "a.json"
    both = [tmp_path / "a.octex", model]
    cli.result(*both, VIEW, seen, "--camera-out", eye)
    pixels = np.array(PIL.Image.open(seen))
    pixels[..., :3] = 255 - pixels[..., :3]
    PIL.Image.fromarray(pixels).save(seen)
    words = [seen, "--camera", eye, OUT, tmp_path / "b.octex", "--max-depth", "6"]
    cli.result(*both, *words)
    surface = octex.load_surface(model)
    before, after = octex.open(tmp_path / "a.octex"), octex.open(tmp_path / "b.octex")
    rest = surface.rest_positions(after)
    facing = surface.vertices @ [0.35, 0.26, 0.9]
    front = [int(np.argmax(facing[:1000])), int(np.argmax(facing[-1000:])) + len(rest) - 1000]
    codes = [255 * linear_to_srgb(texture.sample(rest[front])) for texture in (before, after)]
    np.testing.assert_allclose(codes[0] + codes[1], 255, atol=12)


def test_a_posed_surface_is_moved_at_rest():
    surface = pair()
    posed = Surface(surface.vertices * 2 + 5, surface.triangles, surface.source, rest=surface.rest)
    texture = octex.convert(surface, 4, separate=3)
    placed = posed.placed_in(texture)
    assert np.array_equal(placed.rest, surface.rest_positions(texture))
    assert np.array_equal(placed.vertices, posed.vertices)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"parts": 2, "digest": "", "moved": 1}',
        '{"parts": 2, "digest": "", "moved": {"2": [0, 0, 0]}}',
        '{"parts": 2, "digest": "", "moved": {"0": [0, 0]}}',
        '{"parts": 2, "digest": "", "moved": {"0": [0, 0, NaN]}}',
    ],
)
def test_metadata_that_cannot_be_read_are_refused(text):
    texture = octex.convert(pair(), 3)
    broken = OctreeTexture(
        texture.tree, texture.channels, texture.placement, texture.bounds, {"separation": text}
    )
    with pytest.raises(ArgumentError, match="separated parts cannot be read"):
        pair().rest_positions(broken)


@needs_jit
def test_images_are_drawn_where_the_texture_is():
    surface, texture = spheres(6)
    drawn = draw_preview(texture, surface, (200, 100), 1).astype(int)
    assert np.abs(drawn[:70, :100] - drawn[:70, 100:]).max() < 12
    found = difference(surface, texture, points=10_000)
    assert found["base_color"].rms < 0.5
    assert found.uncovered == (0.0, None)
    assert difference(texture, surface, points=10_000)["base_color"].rms < 0.5
    again = draw_difference(texture, surface, found, size=(300, 100), supersample=1)
    assert np.abs(again[:60, :100].astype(int) - again[:60, 100:200]).max() < 12


def test_textures_with_other_places_for_parts_are_not_compared():
    surface = pair()
    with pytest.raises(ArgumentError, match="compare each with its model"):
        difference(octex.convert(surface, 4, separate=3), octex.convert(surface, 4))
    same = octex.convert(surface, 4, separate=3)
    assert difference(same, octex.convert(surface, 4, separate=3))["base_color"].rms == 0


@needs_jit
def test_paint_lands_where_the_texture_is():
    surface, texture = spheres(5)
    placed = surface.placed_in(texture)
    camera = octex.Camera.fitted(surface.vertices, (0.0, 0.0, 1.0), size=(64, 64))
    image = octex.Projection(np.full((64, 64, 3), 255, np.uint8), camera)
    facing = np.array([[0.0, 0.3, 0.95], [1.6, 0.3, 0.77]])
    near = [int(np.argmin(np.linalg.norm(surface.vertices - point, axis=1))) for point in facing]
    painted = octex.paint(texture, surface, image)
    assert painted.sample(placed.rest[near]).min() > 0.9
    assert texture.sample(placed.rest[near]).min() < 0.9
    assert painted.metadata["separation"] == texture.metadata["separation"]
    layer = octex.project(surface, image, like=texture)
    merged = octex.merge(texture, layer, surface)
    assert np.array_equal(merged.sample(placed.rest), painted.sample(placed.rest))
    begun = octex.paint(None, placed, image)
    assert np.array_equal(surface.rest_positions(begun), placed.rest)
    filled = octex.fill(texture, surface, octex.Sphere((1.6, 0.3, 0.77), 0.2), (1.0, 1.0, 1.0))
    assert filled.sample(placed.rest[near[1:]]).min() > 0.9
    assert np.array_equal(filled.sample(placed.rest[near[:1]]), texture.sample(placed.rest[near[:1]]))


def written(folder, *meshes):
    surface = colored(*meshes)
    path = folder / "parts.obj"
    path.write_text(obj_lines(np.hstack([surface.vertices, surface.vertices % 1]), surface.triangles))
    return path


def test_the_command_says_which_parts_overlap(tmp_path, cli):
    model = written(
        tmp_path, cube([0, 0, 0]), cube([0.5, 0, 0]), cube([0.25, 0.25, 0.25], 0.125), open_cube([4, 0, 0])
    )
    assert cli.result("overlaps", model, "--quiet") == cli.result("overlaps", model)
    assert cli.result("overlaps", model).splitlines() == [
        f"{model}: 4 parts, 2 pairs that intersect or come near",
        "parts 0 and 1: their surfaces cross or touch; they share a volume of 0.5",
        "parts 0 and 2: their surfaces do not cross; they share a volume of 0.001953",
        "part 3 of 10 triangles is open: only its surface was checked, not what lies inside",
    ]
    found = json.loads(cli.result("overlaps", model, "--margin", 0.2, "--json"))
    assert (found["parts"], found["margin"], found["model"]) == (4, 0.2, str(model))
    assert found["pairs"] == [
        {"a": 0, "b": 1, "volume": pytest.approx(0.5), "gap": 0.0},
        {"a": 0, "b": 2, "volume": pytest.approx(0.125**3), "gap": None},
        {"a": 1, "b": 2, "volume": 0.0, "gap": 0.125},
    ]
    assert found["unchecked"] == [{"part": 3, "triangles": 10, "why": "open"}]


@needs_jit
def test_the_command_separates(tmp_path, cli):
    model = written(tmp_path, cube([0, 0, 0]), cube([0.5, 0, 0], 0.5), open_cube([4, 0, 0]))
    out = tmp_path / "parts.octex"
    lines = cli.result(model, out, "--depth", 6, "--quiet", "--json", "--separate", 4)
    made = json.loads(lines)["separated"]
    assert (made["parts"], list(made["moved"]), len(made["unchecked"])) == (3, ["1"], 1)
    texture = octex.open(out)
    surface = octex.load_surface(model)
    cells = cells_of(surface.placed_in(texture), texture, surface.overlapping_parts().parts)
    assert are_apart(cells[0], cells[1], 4)
    text = cli.result(model, out, "--depth", 6, "--force", "--preview", tmp_path / "a.png", "--separate", 3)
    assert "1 of 3 parts moved apart; Surface.rest_positions says where to\n  part 1 by " in text
    assert "1 of them are not closed solids: only their surfaces were checked" in text
    lines = cli.result("diff", out, model, "--json", "--points", 1000)
    assert json.loads(lines)["channels"]["base_color"]["rms"] < 2
    box = written(tmp_path, cube([0, 0, 0]))
    text = cli.result(box, out, "--depth", 3, "--force", "--separate", 3)
    assert text.endswith("nothing to move apart, even where it intersects itself\n")
    boxes = written(tmp_path, cube([0, 0, 0]), cube([9, 0, 0]))
    text = cli.result(boxes, out, "--depth", 5, "--force", "--separate", 3)
    assert text.endswith("2 parts, none too close to another: none moved\n")


@needs_jit
def test_many_moved_parts_are_not_all_listed(tmp_path, cli):
    model = written(tmp_path, cube([0, 0, 0], 2.0), *[cube([0.15 * n, 0, 0], 0.1) for n in range(13)])
    text = cli.result(model, tmp_path / "a.octex", "--depth", 6, "--no-fit", "--separate", 3)
    assert "\n  and 3 more; --json lists them\n" in text


def test_bad_words_are_refused(tmp_path, cli):
    model, made = written(tmp_path, cube([0, 0, 0])), tmp_path / "b.octex"
    octex.convert(pair(), 3).save(made)
    for words, message in (
        (("--separate=far", model, "a.octex"), "'far' is not a number"),
        ((model, "a.octex", "--separate", 0.5), "0.5 is not a number of cells from 1 to a million"),
        ((model, "a.octex", "--margin", 1), "--margin is an option of octex overlaps, not of octree-convert"),
        (
            ("overlaps", model, "--separate"),
            "--separate is an option of octex convert, not of octex overlaps",
        ),
        ((made, tmp_path / "c.octex", "--separate", 3), "--separate needs the model"),
    ):
        assert message in cli.refusal(*words)
