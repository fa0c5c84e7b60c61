"""Random steps that change values and cells."""

import numpy as np

from octex.tree.layout import KEPT
from tests.properties import edit_claims as claims
from tests.properties.edit_paints import draw_fill, draw_paint
from tests.properties.edit_run import Step, call, extent_of, one_of, place_on


def draw_map(random, run):
    name = one_of(random, [each for each in run.texture.channels if each != "normal"])
    scale, shift = one_of(random, ((0.5, 0.25), (-1.0, 1.0), (1.0, 0.0), (0.25, 0.0)))
    line = call("texture = octex.map", "texture", f"lambda values: {scale} * values + {shift}", repr(name))

    def claim(run, before, after):
        same_tree(run, before, after)
        if name == "alpha" or "alpha" in before.channels:
            return
        points = run.surface.placed_in(before).scatter(100, 1).rest
        points = points[before.contains(points)]
        if not len(points):
            return
        was, found = (each.sample(points, name) for each in (before, after))
        form = after.channels[name].format
        stored = claims.decode(before.channels[name].values, form.space)
        if stored.min() * scale + shift < 0 or stored.max() * scale + shift > 1:
            return
        slack = 1.5 * claims.code_width(form, float(np.abs(was).max())) + 1e-5
        assert np.abs(scale * was + shift - found).max() <= slack, "the field is not mapped as its values are"

    return Step((line,), claim, turns=scale < 0)


def same_tree(_run, before, after):
    for one, other in zip(
        [*before.tree.arrays, *before.tree.split, *before.tree.kept],
        [*after.tree.arrays, *after.tree.split, *after.tree.kept],
        strict=True,
    ):
        np.testing.assert_array_equal(one, other, "the tree has changed")


def draw_levels(random, run):
    names = [each for each in run.texture.channels if each != "normal"]
    options = {
        "black": one_of(random, (0.0, 0.2)),
        "white": one_of(random, (1.0, 0.7)),
        "gamma": one_of(random, (1.0, 2.2, 0.5)),
    }
    chosen = names if random.random() < 0.3 else [one_of(random, names)]
    line = call("texture = octex.levels", "texture", chosen, **options)
    return Step((line,), same_tree, turns=True, leaves_range=True)


def other_texture(random, run):
    """Lines that make another texture of the same root cell."""
    how = random.random()
    if how < 0.3:
        return (call("other = octex.map", "texture", "lambda values: 1 - values"),)
    if how < 0.5:
        depth = run.texture.tree.max_depth
        return (call("other = octex.resize", "texture", int(np.clip(depth + random.integers(-2, 2), 1, 5))),)
    if how < 0.7:
        low, high = box_of(random, run)
        return (call("other = octex.crop", "texture", low, high),)
    step = draw_fill(random, run) if random.random() < 0.5 else draw_paint(random, run)
    return (*step.lines[:-1], step.lines[-1].replace("texture = ", "other = ", 1))


def box_of(random, run):
    center = np.array(place_on(random, run))
    radius = extent_of(run) * one_of(random, (0.1, 0.3, 0.6))
    return (center - radius).round(3).tolist(), (center + radius).round(3).tolist()


def draw_mix(random, run):
    lines = other_texture(random, run)
    how = random.random()
    amount = str(one_of(random, (0.0, 1.0, 0.3, 0.5, 0.8)))
    claim = None
    if how < 0.3:
        axis = int(random.integers(3))
        amount = call("beyond", axis, round(place_on(random, run)[axis], 3), one_of(random, (0.0, 0.2)))
    elif how < 0.4 and "roughness" in run.texture.channels:
        amount = "octex.cast(texture, channels=['roughness'])"
    if amount in ("0.0", "1.0"):

        def claim(run, before, after):
            pair = before, run.names["other"]
            claims.assert_prevails(after, *(pair if amount == "0.0" else pair[::-1]), run.surface)

    line = call("texture = octex.mix", "texture", "other", amount)
    return Step((*lines, line), claim, fits=fits_of(lines), leaves_range=True, layers=("other",))


def fits_of(lines):
    return any("octex.paint" in line and "fit=False" not in line for line in lines)


def draw_combine(random, run):
    lines = other_texture(random, run)
    over = random.random() < 0.5
    line = call("texture = octex.combine", "texture", "other", over=over or None)

    def claim(run, before, after):
        other = claims.cells_of(run.names["other"])
        leaves = other.is_leaf
        where = claims.Boxes(other.low[leaves], other.high[leaves], other.edges[leaves])
        if not before.tree.n_leaves:
            return
        where += claims.idle_skirts(before, after, run.names["other"])
        claims.assert_far_cells_stay(before, after, where, 0.01)
        if not over:
            claims.assert_prevails(after, run.names["other"], before, run.surface)

    return Step((*lines, line), claim, fits=fits_of(lines), leaves_range=True, layers=("other",))


def draw_blur(random, run):
    width = round(run.texture.placement.size / 2 ** one_of(random, (0.5, 1.5, 2.5, 4, 6, 9)), 4)
    name = one_of(random, [None, None, *run.texture.channels])
    chosen = [] if name is None else [repr(name)]
    line = call("texture = octex.blur", "texture", width, *chosen)
    return Step((line,), same_tree, turns=True)


def draw_crop(random, run):
    low, high = box_of(random, run)
    line = call("texture = octex.crop", "texture", low, high)

    def claim(run, before, after):
        cells, left = claims.cells_of(before), claims.cells_of(after)
        gone = cells.is_leaf & ~np.isin(cells.keys, left.keys)
        leaves = np.isin(cells.keys, left.keys) & cells.is_leaf
        rows = np.searchsorted(left.keys, cells.keys[leaves])
        for name, channel in before.channels.items():
            own = after.channels[name].values[rows]
            np.testing.assert_array_equal(channel.values[leaves], own, f"leaves of {name} after a crop")
        inside = (cells.low[leaves] <= high).all(axis=1) & (cells.high[leaves] > low).all(axis=1)
        assert inside.all(), "leaves outside the box are left"
        lost = (cells.low[gone] < np.array(high) - 1e-9).all(axis=1)
        lost &= (cells.high[gone] > np.array(low) + 1e-9).all(axis=1)
        assert not lost.any(), "leaves in the box are gone"
        # Where a node is gone the field spreads anew; one that keeps a coefficient faces other ways.
        gone |= ~np.isin(cells.keys, left.keys)
        lost = gone
        while lost.any():
            lost = np.isin(cells.keys, cells.keys[lost] >> 3)
            gone |= lost & (before.tree.arrays.flags & KEPT != 0)
        where = claims.Boxes(cells.low[gone], cells.high[gone], cells.edges[gone])
        claims.assert_far_cells_stay(before, after, where, 0.01)
        claims.assert_far_field_stays(before, after, run.surface, where, 1.01, len(run.steps))

    return Step((line,), claim, is_exact=True)


def draw_resize(random, run):
    depth = int(np.clip(run.texture.tree.max_depth + random.integers(-2, 2), 0, 5))
    line = call("texture = octex.resize", "texture", depth)

    def claim(run, before, after):
        if depth < before.tree.max_depth:
            before = before.level(depth)
        points = run.surface.placed_in(before).scatter(200, len(run.steps)).rest
        claims.assert_same_field(before, after, points[before.contains(points)], None)

    return Step((line,), claim)


def draw_cast(random, run):
    dtype = one_of(random, run.dtypes)
    names = list(run.texture.channels)
    kept = names if random.random() < 0.7 else ["base_color", *(["alpha"] if "alpha" in names else [])]
    options = {"dtype": repr(dtype), "channels": None if kept == names else str(kept)}
    line = call("texture = octex.cast", "texture", **options)

    def claim(run, before, after):
        same_tree(run, before, after)
        points = run.surface.placed_in(before).scatter(100, 1).rest
        claims.assert_same_field(before, after, points, None)

    return Step((line,), claim, turns=True)


def draw_level(random, run):
    level = int(np.clip(run.texture.tree.max_depth - random.integers(0, 3), 0, 21))
    line = f"texture = texture.level({level})"

    def claim(run, before, after):  # noqa: ARG001
        count = after.tree.n_cells
        for name, channel in before.channels.items():
            np.testing.assert_array_equal(channel.values[:count], after.channels[name].values, "a level")

    return Step((line,), claim)


def draw_reopened(random, run):  # noqa: ARG001
    return Step(("texture = reopened(texture)",), is_exact=True)


def draw_curves(random, run):
    name = one_of(random, [each for each in run.texture.channels if each != "normal"])
    points = one_of(random, ([(0, 0.2), (0.5, 0.9), (1, 1)], [(0, 1), (1, 0)], [(0.3, 0), (0.6, 1)]))
    line = call("texture = octex.curves", "texture", repr(name), points)
    return Step((line,), same_tree, turns=True)
