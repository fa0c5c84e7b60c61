"""Layers: the composite is what compositing all anew gives, bit for bit, and what painters expect of it."""

import os
import pickle
from contextlib import suppress

import numpy as np
import pytest

import octex
from octex.channels import decode, encode
from octex.errors import ArgumentError
from octex.painting.layers import Layers
from octex.painting.stack import LAYER_BLENDS, as_file, composite_name, shown_names, with_composite
from octex.texture import Channel, OctreeTexture
from tests.editing.test_draft import case
from tests.make.same import assert_same
from tests.painting.test_painter import brush, shots
from tests.properties import edit_models


def anew(layers):
    """The composite of the whole stack, made from the bottom without what was composited before."""
    texture = layers._texture
    names = {name: own for name, own in texture.channels.items() if composite_name("") not in name}
    made = with_composite(texture.with_cells(texture.tree, names), layers.layers)
    return octex.painting.stack.shown(made, shown_names(made))


def naive_leaves(layers):
    """The composite of base colour in each leaf by the textbook's formulas, in float64."""
    texture = layers._texture
    stored = {
        name: decode(own.values, own.format.space).astype(np.float64)
        for name, own in texture.channels.items()
    }
    color, alpha = stored["base_color"], stored.get("alpha", np.ones((1, 1)))
    for layer in layers.layers:
        if not layer.is_visible or layer.paints("base_color") not in stored:
            continue
        paint = stored[layer.paints("base_color")]
        part = layer.opacity * stored[f"alpha\0in {layer.number} base_color"]
        if layer.has_mask:
            part = part * (1 - stored.get(layer.mask, np.zeros((1, 1))))
        if layer.blend == "over":
            united = part + alpha * (1 - part)
            share = np.divide(part, united, out=np.zeros_like(united * part), where=united > 0)
            color, alpha = color * (1 - share) + paint * share, united
        elif layer.blend == "add":
            most = 1.0 if texture.channels["base_color"].values.dtype.kind == "u" else np.inf
            color = np.minimum(color + part * paint, most)
        else:
            both = color * paint if layer.blend == "multiply" else 1 - (1 - color) * (1 - paint)
            color = color * (1 - part) + both * part
    return {"base_color": color, "alpha": alpha}


def assert_is_composite(layers):
    """The texture is the composite, in leaves by the textbook and everywhere as it is made anew."""
    found = layers.texture()
    found.tree.validate()
    assert_same(found, anew(layers))
    is_leaf = np.concatenate([~is_node for _, is_node in found.tree.walk()])
    for name, values in naive_leaves(layers).items():
        if name in found.channels:
            own = found.channels[name]
            codes = encode(
                np.broadcast_to(values, own.values.shape)[is_leaf], own.format.dtype, own.format.space
            )
            apart = np.abs(codes.astype(np.float64) - own.values[is_leaf])
            assert apart.max() <= (1 if own.format.dtype.startswith("u") else 1e-3)


def a_step(layers, surface, random, depth):
    """Do something at random."""
    numbers = [layer.number for layer in layers.layers]
    move = random.choice(["add", "paint", "fill", "change", "move", "copy", "merge", "delete", "undo",
                          "redo"],
                         p=[0.12, 0.23, 0.13, 0.12, 0.05, 0.05, 0.07, 0.04, 0.13, 0.06])  # fmt: skip
    if move in ("paint", "fill"):
        chosen = None if not numbers or random.random() < 0.2 else int(random.choice(numbers))
        layers.choose(chosen, mask=chosen is not None and bool(random.random() < 0.15))
        if move == "paint":
            layers.paint(shots(surface, random), max_depth=int(random.integers(depth - 1, depth + 2)))
        else:
            middle = surface.rest[surface.triangles[random.integers(len(surface.triangles))]].mean(axis=0)
            sphere = octex.Sphere(tuple(middle.tolist()), 0.2 * float(np.ptp(surface.rest, axis=0).max()))
            layers.fill(sphere, random.random(3), opacity=float(random.choice([0.6, 1.0])))
    elif move == "add" and len(numbers) < 4:
        layers.add_layer(opacity=float(random.choice([0.5, 1.0])), blend=random.choice(LAYER_BLENDS))
    elif move == "change" and numbers:
        changes = [
            {"opacity": float(random.choice([0.0, 0.3, 1.0]))},
            {"blend": random.choice(LAYER_BLENDS)},
            {"is_visible": bool(random.integers(2))},
            {"has_mask": bool(random.integers(2))},
            {"name": "another"},
        ]
        layers.change_layer(int(random.choice(numbers)), **changes[random.integers(5)])
    elif move == "move" and numbers:
        layers.move_layer(int(random.choice(numbers)), int(random.integers(len(numbers))))
    elif move in ("copy", "merge", "delete") and numbers:
        with suppress(ArgumentError):  # not all can be merged
            getattr(layers, f"{move}_layer")(int(random.choice(numbers)))
    elif move in ("undo", "redo"):
        getattr(layers, move)()


@pytest.mark.parametrize("seed", range(int(os.environ.get("OCTEX_TEST_LAYERS", "12"))))
def test_the_composite_is_what_all_layers_give_anew_forth_and_back(seed):
    random, surface, texture, depth = case(seed)
    layers = octex.Layers(texture, surface)
    held = []
    for _ in range(14):
        if layers.texture().tree.n_cells > 60_000:
            layers.undo()
        before = layers.texture()
        layers.changes = ()
        a_step(layers, surface, random, depth)
        assert_is_composite(layers)
        after = before
        for change in layers.changes:
            after = change.applied(after)
        assert_same(after, layers.texture())
        if random.random() < 0.5:
            held.append((layers.texture(), pickle.loads(pickle.dumps(layers.texture()))))
    for found, copy in held:
        assert_same(found, copy)
    last, stack, count = layers.texture(), layers.layers, len(layers.strokes)
    while layers.undo():
        pass
    assert_same(layers.texture(), texture)
    assert layers.layers == ()
    for _ in range(count):
        assert layers.redo()
    assert_same(layers.texture(), last)
    assert layers.layers == stack


def start(depth=5):
    surface = edit_models.waved("sphere", 0, ["base_color"], 0)
    texture = octex.convert(surface, depth)
    return surface, texture, Layers(texture, surface)


def everywhere(points):
    return np.ones(len(points))


def test_paint_that_changes_no_coverage_is_stored_with_it():
    """Its colours change and its coverage, 0 in all cells that are changed, does not."""
    surface = edit_models.waved("flat", 5, ["base_color", "alpha"], 34)
    layers = octex.Layers(octex.convert(surface, 3, dtype="uint16"), surface)
    layers.add_layer(blend="multiply", opacity=0.6)
    layers.fill(
        octex.Sphere((0.282, -0.449, 0.0), 0.4, soft=0.1), (0.7, 1.0, 0.2), blend="replace", max_depth=2
    )
    before = layers.texture()
    layers.add_layer()
    assert_same(layers.texture(), before)


def test_without_layers_it_is_a_painter():
    surface, texture, layers = start()
    painter = octex.Painter(texture, surface)
    for each in (layers, painter):
        each.paint(brush(surface, 200), max_depth=7)
        each.fill(octex.Sphere((0.0, 0.0, 1.0), 0.4), (0.1, 0.2, 0.3), opacity=0.5)
    assert_same(layers.texture(), painter.texture())


@pytest.mark.parametrize("changed", [{"opacity": 0.0}, {"is_visible": False}])
def test_a_layer_that_is_not_seen_changes_nothing(changed):
    surface, texture, layers = start()
    number = layers.add_layer().number
    assert_same(layers.texture(), texture)
    assert layers.changes == ()
    layers.paint(brush(surface, 200), max_depth=5)
    assert bool(layers.changes)
    layers.change_layer(number, **changed)
    assert_same(layers.texture(), texture)
    layers.fill(everywhere, "#ff0000")
    assert_same(layers.texture(), texture)


def test_the_upper_of_two_layers_hides_the_other_unless_its_paint_is_masked_or_erased():
    _, _, layers = start()
    numbers = []
    for color in ("#ff0000", "#00ff00"):
        numbers.append(layers.add_layer().number)
        layers.fill(everywhere, color)
    shown = []

    def show():
        shown.append(layers.texture().channels["base_color"].values[0].tolist())

    show()
    layers.move_layer(numbers[1], 0)
    show()
    layers.change_layer(numbers[0], has_mask=True)
    layers.choose(numbers[0], mask=True)
    layers.fill(everywhere, "#ffffff", blend="erase")
    show()
    layers.choose(numbers[0])
    layers.change_layer(numbers[0], has_mask=False)
    layers.fill(everywhere, "#000000", blend="erase")
    show()
    red, green = [255, 0, 0], [0, 255, 0]
    assert shown == [green, red, green, green]


def test_bad_layers_are_refused_and_nothing_changes():
    surface, texture, layers = start()
    number = layers.add_layer("a").number
    for change, message in (
        (lambda: layers.change_layer(number, name=""), "name must be a line of 1 to 40 characters"),
        (lambda: layers.change_layer(number, name="x" * 41), "name must be a line"),
        (lambda: layers.change_layer(number, opacity=1.5), "opacity"),
        (lambda: layers.change_layer(number, opacity=float("nan")), "opacity"),
        (lambda: layers.change_layer(number, blend="erase"), "unknown blend"),
        (lambda: layers.change_layer(number, is_visible="no"), "is_visible"),
        (lambda: layers.delete_layer(7), "7"),
        (lambda: layers.move_layer(number, 1), "place"),
        (lambda: layers.choose(9), "9"),
        (lambda: layers.choose(None, mask=True), "mask"),
        (lambda: layers.merge_layer(number), "no layer below"),
        (lambda: octex.Layers(texture, surface, keep="all"), "keep"),
    ):
        with pytest.raises(ArgumentError, match=message):
            change()
    assert [layer.name for layer in layers.layers] == ["a"]
    assert_same(layers.texture(), texture)
    for change in ({"blend": "multiply"}, {"is_visible": False}):
        above = layers.add_layer("Shade").number
        layers.change_layer(above, **change)
        with pytest.raises(ArgumentError, match="'Shade' is hidden or not normal"):
            layers.merge_layer(above)


@pytest.mark.parametrize("names", [["base_color"], ["base_color", "alpha"], ["base_color", "roughness"]])
def test_the_eraser_on_the_texture_brings_back_what_was_opened(names):
    surface = edit_models.waved("sphere", 0, names, 0)
    texture = octex.convert(surface, 5)
    layers = Layers(texture, surface)
    layers.fill(everywhere, "#ff0000")
    layers.paint(brush(surface, 200, 30), max_depth=7)
    layers.add_layer()
    layers.paint(brush(surface, 90, 12), max_depth=6)
    layers.choose(None)
    layers.fill(everywhere, "#000000", blend="erase")
    layers.change_layer(1, is_visible=False)
    found = layers.texture()
    found.tree.validate()
    hits = surface.scatter(3000, 1)
    for name in names:
        for width, most in ((0.0, 2 / 255), (0.3, 1e-5)):
            one, other = (each.sample(hits.rest, name, width=width) for each in (found, texture))
            assert np.abs(one - other).max() <= most
    for (codes, is_node), level in zip(texture.tree.walk(), range(6), strict=True):
        first, begin = (int(each.tree.arrays.level_cells[level]) for each in (found, texture))
        same = np.flatnonzero(np.isin(found.tree.level_codes(level), codes))
        at = np.searchsorted(codes, found.tree.level_codes(level)[same])
        is_leaf = ~is_node[at]
        for name in names:
            one, other = found.channels[name].values[first + same], texture.channels[name].values[begin + at]
            now_leaf = ~np.isin(first + same, octex.tree.children.node_cells(found.tree.arrays))
            assert np.array_equal(one[is_leaf & now_leaf], other[is_leaf & now_leaf])
    layers.undo()
    layers.undo()
    assert layers.texture().channels["base_color"].values[0, 0] > texture.channels["base_color"].values[0, 0]


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_a_stack_that_is_saved_is_opened_as_it_was(seed, tmp_path):
    random, surface, texture, depth = case(seed)
    layers = octex.Layers(texture, surface)
    for _ in range(12):
        a_step(layers, surface, random, depth)
    layers.add_layer("top", opacity=0.5, blend="screen")
    layers.fill(everywhere, "#102030")
    layers.save(tmp_path / "stack.octex")
    opened = octex.open(tmp_path / "stack.octex")
    for name, own in layers.texture().channels.items():
        assert np.array_equal(opened.channels[name].values, own.values)
    again = octex.Layers(opened, surface)
    assert again.layers == layers.layers
    assert_same(again.texture(), layers.texture())
    for each in (layers, again):
        each.choose(each.layers[-1].number)
        each.fill(octex.Sphere((0.0, 0.0, 1.0), 0.5), "#ff0000")
        number = each.add_layer().number
        assert number not in {layer.number for layer in each.layers[:-1]}
        each.change_layer(each.layers[0].number, is_visible=False)
    assert_same(again.texture(), layers.texture())
    while again.undo():
        pass
    assert_same(again.texture(), octex.Layers(opened, surface).texture())


BROKEN = ['{"number": 1}', '{"number": 0, "name": "a"}', '{"number": 1, "name": "a", "blend": "erase"}', "3"]
LISTS = [
    "",
    "{",
    "3",
    "[]",
    "{}",
    *(f'{{"composite": "", "channels": [], "layers": [{each}]}}' for each in BROKEN),
]


@pytest.mark.parametrize("text", LISTS)
def test_a_list_of_layers_that_cannot_be_read_is_refused(text):
    surface, texture, _ = start()
    metadata = {"layers": text}
    broken = OctreeTexture(texture.tree, texture.channels, texture.placement, texture.bounds, metadata)
    with pytest.raises(ArgumentError, match="metadata 'layers' is no list of layers"):
        octex.Layers(broken, surface)


def test_a_stack_whose_channels_another_program_has_changed_is_refused(tmp_path):
    surface, texture, _ = start()
    layers = octex.Layers(texture, surface)
    layers.add_layer("paint")
    layers.fill(everywhere, "#102030")
    layers.save(tmp_path / "stack.octex")
    saved = octex.open(tmp_path / "stack.octex")
    own = [name for name in saved.channels if " in layer 1 " in name]
    assert len(own) == 2
    for name, channel in (("alpha", None), *((each, saved.channels["base_color"]) for each in own)):
        channels = {each: one for each, one in saved.channels.items() if channel or name not in each}
        if channel is not None:
            form = channel.format._replace(name=name, components=2)
            channels[name] = Channel(form, *(each[:, :2].copy() for each in channel[1:]))
        broken = OctreeTexture(saved.tree, channels, saved.placement, saved.bounds, saved.metadata)
        with pytest.raises(ArgumentError, match=r"layer 'paint' paints .* in another way than the texture"):
            octex.Layers(broken, surface)


def grey(surface):
    return octex.convert(surface, 4, sources={"base_color": (0.5, 0.5, 0.5)})


#: Calls that change what a texture shows.
EDITS = {
    "blur": lambda texture, _: octex.blur(texture, 0.1),
    "levels": lambda texture, _: octex.levels(texture, "base_color", 0.1, 0.8),
    "curves": lambda texture, _: octex.curves(texture, "base_color", [(0, 0.2), (1, 1)]),
    "mix": lambda texture, surface: octex.mix(texture, grey(surface), 0.5),
    "combine": lambda texture, surface: octex.combine(
        texture, octex.crop(grey(surface), (-1, 0, -1), (1, 1, 1))
    ),
    "paint": lambda texture, surface: octex.paint(texture, surface, brush(surface, 200, 30)),
    "fill": lambda texture, surface: octex.fill(texture, surface, everywhere, (0.2, 0.4, 0.6)),
    "merge": lambda texture, surface: octex.merge(
        texture, octex.project(surface, brush(surface, 200, 30), like=texture), surface
    ),
}


@pytest.mark.parametrize(("name", "ending"), [*((name, "octex") for name in EDITS), ("levels", "octz")])
def test_neither_an_edit_of_what_is_shown_nor_the_layers_are_lost(name, ending, tmp_path):
    surface, _, layers = start(4)
    layers.add_layer("paint", opacity=0.7)
    layers.fill(octex.Sphere((0.0, 0.0, 1.0), 0.8), "#102030")
    layers.save(tmp_path / f"stack.{ending}")
    saved = octex.open(tmp_path / f"stack.{ending}")
    assert_same(octex.Layers(saved, surface).texture(), layers.texture())
    path = tmp_path / f"edited.{ending}"
    made = EDITS[name](saved, surface)
    made.save(path)
    edited = octex.open(path)
    with pytest.raises(ArgumentError, match="edited after its layers were saved"):
        octex.Layers(edited, surface)
    flat = octex.Layers(edited, surface, keep="shown")
    assert flat.layers == ()
    for each, own in flat.texture().channels.items():
        for one, other in zip(own[1:], made.channels[each][1:], strict=True):
            assert np.array_equal(one, other)
    again = octex.Layers(edited, surface, keep="layers")  # with the paint that they still have
    assert again.layers == layers.layers
    for choice in (flat, again):  # what is chosen is no longer asked for
        choice.save(tmp_path / "chosen.octex")
        assert_same(octex.Layers(octex.open(tmp_path / "chosen.octex"), surface).texture(), choice.texture())


def test_a_stack_that_is_cropped_as_a_whole_keeps_its_layers():
    surface, _, layers = start()
    layers.add_layer("paint")
    layers.fill(octex.Sphere((0.0, 0.0, 1.0), 0.8), "#102030")
    cropped = octex.crop(as_file(layers._texture, layers.layers), (-2, -2, 0), (2, 2, 2))
    again = octex.Layers(cropped, surface)
    assert again.layers == layers.layers


@pytest.mark.parametrize("seed", range(4))
def test_a_copy_hidden_changes_nothing_and_merged_layers_look_as_both_did(seed):
    surface, _, layers = start()
    random = np.random.default_rng(seed)
    for number in range(3):
        layers.add_layer(opacity=float(random.choice([1.0, 0.4])))
        layers.fill(octex.Sphere(tuple(random.normal(size=3)), 0.9, soft=0.3), random.random(3))
        layers.paint(shots(surface, random), max_depth=6 + number % 2)
    layers.choose(2, mask=True)
    layers.fill(octex.Sphere((0.0, 0.0, 1.0), 0.5), "#000000", blend="erase")
    layers.change_layer(2, has_mask=True)
    before, stack, count = layers.texture(), layers.layers, layers.count
    copied = layers.copy_layer(2)
    assert [each.number for each in layers.layers] == [1, 2, copied.number, 3]
    layers.change_layer(2, is_visible=False)
    assert_same(layers.texture(), before)
    layers.fill(everywhere, "#ff0000")
    layers.paint(brush(surface, 200, 30), max_depth=8)  # its cells are new arrays
    layers.undo()
    layers.undo()
    layers.undo()
    layers.undo()
    layers.redo()
    assert layers.chosen is not None
    layers.change_layer(2, is_visible=False)
    assert_same(layers.texture(), before)
    layers.delete_layer(copied.number)
    layers.change_layer(2, is_visible=True)
    assert_same(layers.texture(), before)
    one = layers.merge_layer(2)
    assert [each.number for each in layers.layers] == [one.number, 3]
    assert layers.chosen == one.number
    assert_is_composite(layers)
    after, hits = layers.texture(), surface.scatter(2000, seed)
    for width in (0.0, 0.3):
        found, expected = (each.sample(hits.rest, width=width) for each in (after, before))
        assert np.abs(found - expected).max() <= 4 / 255
    while layers.count > count:
        layers.undo()
    assert layers.layers == stack
    assert_same(layers.texture(), before)
    while layers.redo():
        pass
    assert_same(layers.texture(), after)
