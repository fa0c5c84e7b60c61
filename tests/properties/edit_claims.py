"""What must hold of every texture, and what an edit must leave alone."""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import octex
from octex.channels import ALPHA, ONE, decode, encode
from octex.tree.areas import SKIRT
from octex.tree.layout import FACING_FLAGS, KEPT, SPLIT
from octex.tree.morton import decode_cells
from octex.tree.split import find_rows, rows_of
from tests.make.same import arrays_of, assert_equal
from tests.oracles.naive_processing import AREAS
from tests.oracles.naive_sheets import clipped

Array = npt.NDArray[Any]

#: Areas are coded in steps of 9 %, so that each is known to half of that.
AREA_PART = 0.046
#: Boxes times boxes that are compared at most.
MOST_PAIRS = 10_000_000
#: Codes of areas of which many together are less than a millionth of a cell's face.
HARDLY = 40
#: Images are made to agree twice: by the lightest and darkest that are compared, and by three stops.
LARGEST_GAIN = (8 * 0.97 / 0.004) ** 2
#: What is transparent weighs so much at least.
FAINT = 2.0**-40


class Cells(NamedTuple):
    """The cells of a tree, in the order of their numbers."""

    keys: Array  # (n,)   1, then the bits of the Morton code: ascending, and a parent's is that >> 3
    low: Array  # (n, 3)   corners at rest
    high: Array
    edges: Array  # (n,)
    is_leaf: Array  # (n,)


def cells_of(texture):
    keys, places, edges, leaves = [], [], [], []
    for level, (codes, is_node) in enumerate(texture.tree.walk()):
        edge = texture.placement.size / 2**level
        keys.append(codes | 1 << 3 * level)
        places.append(np.array(texture.placement.origin) + decode_cells(codes) * edge)
        edges.append(np.full(codes.size, edge))
        leaves.append(~is_node)
    low, width = np.concatenate(places), np.concatenate(edges)
    is_leaf = np.concatenate(leaves)
    if not texture.tree.n_leaves:
        is_leaf[:] = False
    return Cells(np.concatenate(keys), low, low + width[:, None], width, is_leaf)


def kept_edge(texture):
    """The edge of the largest node that keeps a coefficient; 0 if none does."""
    return float(cells_of(texture).edges[texture.tree.kept.cells].max(initial=0.0))


def digest(texture):
    """A number that changes with any of a texture's arrays."""
    found = 0
    for array in [*arrays_of(texture), texture.bounds]:
        found = zlib.crc32(np.ascontiguousarray(array).tobytes(), found)
    return found


def code_width(form, most=1.0):
    """How far, decoded, a value that is rounded may be from another that is."""
    if form.dtype.startswith("u"):
        slope = {"srgb": 2.3, "direction": 2.0}.get(form.space, 1.0)
        return slope / ONE[form.dtype]
    return most * {"float16": 2.0**-10, "float32": 2.0**-20}[form.dtype]


# --- every texture


def assert_sound(texture, folder, seed, count):
    """It is valid, lookups at ``count`` points stay among what is stored, and a file keeps all of it."""
    texture.validate()
    random = np.random.default_rng(seed)
    size = texture.placement.size
    unit = random.random((count, 3))
    unit[::4] = random.uniform(-0.2, 1.2, unit[::4].shape)
    leaves = texture.tree.leaf_cells()
    if leaves.size:  # half of them on leaves
        cells, half = cells_of(texture), count // 2
        near = random.choice(leaves, half)
        places = cells.low[near] + random.random((half, 3)) * cells.edges[near, None]
        unit[:half] = (places - texture.placement.origin) / size
    points = texture.placement.to_rest(unit)
    normals = random.normal(size=points.shape).astype(np.float32)
    names = list(texture.channels)
    answers = {}
    for width in (None, size / 2**texture.tree.max_depth, size / 9, size):
        for facing in (None, normals):
            found = texture.sample(points, names, width=width, normals=facing, normalize=False)
            for name, values in found.items():
                assert_among(texture, name, values, f"sample(width={width}, normals={facing is not None})")
            answers[width, facing is None] = found
    path = folder / "texture.octex"
    texture.save(path)
    opened = octex.open(path)
    assert_equal(texture, opened)
    for (width, is_plain), before in answers.items():
        facing = None if is_plain else normals
        after = opened.sample(points, names, width=width, normals=facing, normalize=False)
        for name in names:
            np.testing.assert_array_equal(before[name], after[name], f"{name} opened again")


def assert_among(texture, name, values, what):
    """Answers of weights that are not negative lie among what is stored."""
    channel = texture.channels[name]
    assert np.isfinite(values).all(), f"{what} of {name} is not finite"
    stored = np.concatenate([decode(array, channel.format.space) for array in channel[1:]])
    low, high = stored.min(axis=0), stored.max(axis=0)
    slack = 1e-4 * np.maximum(np.abs(low), np.abs(high)).max() + 1e-6
    beyond = (values < low - slack) | (values > high + slack)
    assert not beyond.any(), (
        f"{what} of {name} is {values[beyond.any(axis=1)][0].tolist()}, stored is from {low.tolist()} to "
        f"{high.tolist()}"
    )


def assert_in_unit_range(texture, names=None):
    """What was made of values in 0 … 1 stays there, light above 0; ``names`` None: all channels."""
    for name, channel in texture.channels.items():
        if names is not None and name not in names:
            continue
        least = -1.0 if channel.format.space == "direction" else 0.0
        for array in channel[1:]:
            if array.dtype.kind == "f" and array.size:
                found = float(array.min()), float(array.max())
                assert found[0] >= least - 1e-6, f"{name} goes down to {found[0]}"
                if channel.format.space not in ("srgb", "linear"):  # light may be above 1
                    assert found[1] <= 1.001, f"{name} goes up to {found[1]}"


def assert_averaged(texture, names, codes):
    """Nodes are means of their children by area and alpha, but for so many codes and what rounding hides.
    Nodes that keep a coefficient are left out: what is refined from that has another mean. So are those of
    cells beside the surface, of the least area there is.
    """
    cells = cells_of(texture)
    if not texture.tree.n_leaves:
        return
    flags, areas = texture.tree.arrays.flags, AREAS[texture.tree.arrays.areas]
    parents = np.searchsorted(cells.keys, cells.keys[1:] >> 3)
    alpha = texture.channels.get(ALPHA.name)
    for name in names:
        channel = texture.channels[name]
        form = channel.format
        values = decode(channel.values, form.space).astype(np.float64)
        weights, doubt = areas.copy(), areas * AREA_PART
        if alpha is not None and name != ALPHA.name:
            opacity = decode(alpha.values, "data")[:, 0].astype(np.float64)
            weights = areas * np.maximum(opacity, FAINT)
            doubt = weights * AREA_PART + areas * code_width(alpha.format)
        total = np.bincount(parents, weights[1:], len(values))
        means, spread = np.zeros((2, *values.shape))
        for k in range(form.components):
            means[:, k] = np.bincount(parents, weights[1:] * values[1:, k], len(values))
            means[:, k] /= np.maximum(total, 1e-300)
            apart = np.abs(values[1:, k] - means[parents, k])
            spread[:, k] = np.bincount(parents, doubt[1:] * apart, len(values)) / np.maximum(total, 1e-300)
        chosen = ~cells.is_leaf & (flags & KEPT == 0) & (texture.tree.arrays.areas > 1)
        if form.dtype.startswith("u"):
            low, high = (
                encode(means[chosen] + sign * spread[chosen], form.dtype, form.space).astype(float)
                for sign in (-1, 1)
            )
            found, slack = channel.values[chosen].astype(float), codes
            slack *= 1 if form.dtype == "uint8" else 8
        else:
            low, high = means[chosen] - spread[chosen], means[chosen] + spread[chosen]
            found = values[chosen]
            slack = codes * code_width(form, float(np.abs(values).max()) + 1e-6)
        beyond = np.maximum(low - found, found - high).max(axis=1)
        if beyond.size and beyond.max() > slack:
            row = int(beyond.argmax())
            cell = np.flatnonzero(chosen)[row]
            raise AssertionError(
                f"averages of {name}: cell {cell} (key {cells.keys[cell]:#o}) is {found[row].tolist()}, its "
                f"children's mean is from {low[row].tolist()} to {high[row].tolist()}"
            )


# --- what is outside an edit


class Boxes(NamedTuple):
    """Where something was painted: boxes, each in cells of its own edge."""

    low: Array  # (n, 3)
    high: Array
    edges: Array  # (n,)
    slack: float = 0.0  # cells by which paint may reach beyond them

    def gaps(self, low, high):
        """How many cells of paint boxes (n,) are from the nearest of these along an axis."""
        found = np.full(len(low), np.inf)
        if not len(self.edges):
            return found
        block = 1 + 400_000 // len(self.edges)
        for begin in range(0, len(low), block):
            here = slice(begin, begin + block)
            apart = np.full((len(low[here]), len(self.edges)), -np.inf)
            for axis in range(3):
                np.maximum(apart, self.low[:, axis] - high[here, axis, None], out=apart)
                np.maximum(apart, low[here, axis, None] - self.high[:, axis], out=apart)
            found[here] = (apart / self.edges).min(axis=1)
        return found - self.slack

    def depths(self, points):
        """How far points (n, 3) are inside the only box: half the edge of the largest cube around each."""
        return np.minimum(points - self.low[0], self.high[0] - points).min(axis=1)

    def __add__(self, other):
        assert isinstance(other, Boxes)
        arrays = (np.concatenate(pair) for pair in zip(self[:3], other[:3], strict=True))
        return Boxes(*arrays, max(self.slack, other.slack))


class Ball(NamedTuple):
    """What is in a ball, in cells of some edge that meet it."""

    center: tuple[float, float, float]
    radius: float
    edge: float

    def gaps(self, low, high):
        nearest = np.clip(self.center, low, high)
        apart = np.linalg.norm(nearest - self.center, axis=1) - self.radius
        return apart / (np.sqrt(3.0) * self.edge) - 1.0

    def depths(self, points):
        """How far points (n, 3) are inside: half the edge of the largest cube around each."""
        away = np.abs(points - self.center)
        total, left = away.sum(axis=1), self.radius**2 - (away**2).sum(axis=1)
        return (np.sqrt(np.maximum(total**2 + 3 * left, 0.0)) - total) / 3


def painted_boxes(layer):
    """The leaves of a layer that have paint."""
    cells = cells_of(layer)
    has = cells.is_leaf & (decode(layer.channels[ALPHA.name].values, "data")[:, 0] > 0)
    return Boxes(cells.low[has], cells.high[has], cells.edges[has])


def _stored(texture, cells):
    """Everything that is stored of cells, as ascending keys and rows."""
    tree = texture.tree
    has_children = np.where(cells.is_leaf, 1, 0).astype(np.uint8)
    found = {"cells": (cells.keys, np.stack([tree.arrays.flags, tree.arrays.areas, has_children], axis=1))}
    rows = rows_of(tree.split)
    row_keys = cells.keys[rows.cells] << 6 | rows.bits
    found["split areas"] = row_keys, tree.split.areas[:, None]
    kept = cells.keys[tree.kept.cells]
    for name, channel in texture.channels.items():
        found[f"values of {name}"] = cells.keys, channel.values
        found[f"rows of {name}"] = row_keys, channel.split_values
        found[f"kept values of {name}"] = kept, channel.kept_values
    return found


def _below_leaves(cells, others):
    """Say which cells lie inside leaves of another tree."""
    found = np.zeros(cells.keys.size, np.bool_)
    leaves, above = others.keys[others.is_leaf], cells.keys >> 3
    while (above > 0).any():
        found |= np.isin(above, leaves)
        above = above >> 3
    return found


def idle_skirts(before, after, other):
    """Return the insides of the skirts that went where another texture was laid over.

    A skirt that the other lacks may go if the largest cell around it that the other lacks, no larger than the
    other's largest leaf or kept node, touches a leaf of the other: a node there changes what the field
    spreads to, as far as it touches.
    """
    cells, others = cells_of(before), cells_of(other)
    leaves = Boxes(*(each[others.is_leaf] for each in others[1:4]))
    largest = max(leaves.edges.max(initial=0.0), kept_edge(other))
    is_gone = cells.is_leaf & (before.tree.arrays.areas == SKIRT) & ~np.isin(cells.keys, cells_of(after).keys)
    tops = gone = np.flatnonzero(is_gone & ~np.isin(cells.keys, others.keys) & ~_below_leaves(cells, others))
    parents = np.searchsorted(cells.keys, cells.keys >> 3)
    while (rises := ~np.isin(cells.keys[parents[tops]], others.keys) & (cells.edges[tops] < largest)).any():
        tops = np.where(rises, parents[tops], tops)
    apart = leaves.gaps(cells.low[tops], cells.high[tops]) > 1e-6
    assert not apart.any(), f"the skirt {cells.keys[gone[apart]][0]:#o} far from the other texture is gone"
    inset = 0.02 * cells.edges[gone, None]
    return Boxes(cells.low[gone] + inset, cells.high[gone] - inset, cells.edges[gone])


def adds_leaves(before, after):
    """Whether there are leaves where nothing was."""
    cells, known = cells_of(after), cells_of(before)
    is_new = cells.is_leaf & ~np.isin(cells.keys, known.keys) & (after.tree.arrays.areas > 1)
    return bool((is_new & ~_below_leaves(cells, known)).any())


def assert_far_cells_stay(before, after, region, reach, surface=None):
    """Cells farther than ``reach`` cells of paint from a region are stored as they were, bit by bit.

    Cells that the ``surface`` does not meet, or hardly, are refined beyond themselves: to half a cell, then a
    quarter, and so on, less than a cell in all. So much farther paint that they are refined to reaches them,
    and in other cells the rows of facings that the surface hardly has there.
    """
    placed = None if surface is None else surface.placed_in(before)
    both = [(texture, cells_of(texture)) for texture in (before, after)]
    far, refined = ([np.zeros(cells.keys.size, np.bool_) for _, cells in both] for _ in range(2))
    pairs = len(getattr(region, "edges", ())) * max(own.size for own in far)
    for own, own_refined, (texture, cells) in zip(far, refined, both, strict=True):
        # Of very many cells some.
        some = cells.keys * 2654435761 % 1000003 % (1 + pairs // MOST_PAIRS) == 0
        low, high, edge = cells.low[some], cells.high[some], cells.edges[some, None]
        is_far = region.gaps(low, high) > reach
        is_refined = region.gaps(low - edge / 2, high + edge / 2) <= reach
        is_refined |= region.gaps(low - edge, high + edge) <= reach - 2  # with the cell of paint inside
        is_off = is_far & is_refined
        is_off &= (texture.tree.arrays.areas[some] < HARDLY) | _is_off(placed, low, high, is_off)
        own[some], own_refined[some] = is_far & ~is_off, is_refined
    far[1] &= ~_below_leaves(both[1][1], both[0][1])  # near paint a leaf is divided as a whole
    stored = [_stored(texture, cells) for texture, cells in both]
    for what, (keys, rows) in stored[0].items():
        is_row = what.startswith(("rows", "split"))
        kept = []
        for n, (own_keys, own_rows) in enumerate(((keys, rows), stored[1][what])):
            all_keys = both[n][1].keys
            at = np.searchsorted(all_keys, own_keys >> 6 if is_row else own_keys)
            chosen = far[n][at]
            if is_row:
                chosen &= ~refined[n][at] | (stored[n]["split areas"][1][:, 0] >= HARDLY)
            kept.append((own_keys[chosen], own_rows[chosen]))
        (one_keys, one), (other_keys, other) = kept
        gone = np.setxor1d(one_keys, other_keys)
        assert not gone.size, f"{what}: {gone[0]:#o} far from the edit is in one only"
        differs = np.flatnonzero((one != other).any(axis=1))
        assert not differs.size, (
            f"{what}: {one_keys[differs[0]]:#o} far from the edit was {one[differs[0]].tolist()}, is "
            f"{other[differs[0]].tolist()} ({differs.size} of {len(one)} such)"
        )
    added = set(after.channels) - set(before.channels)
    assert added <= {ALPHA.name}, f"new channels {sorted(added)}"
    for name in added:
        values = decode(after.channels[name].values, "data")[far[1]]
        assert (values == 1).all(), "alpha that was not there is not 1 far from the edit"


def _is_off(surface, low, high, chosen):
    """Say which of the chosen boxes (n,) a surface does not meet; its upper faces are no part of a box."""
    found = np.zeros(len(low), np.bool_)
    if surface is None:
        return found
    corners = surface.rest[surface.triangles]
    least, most = corners.min(axis=1), corners.max(axis=1)
    for n in np.flatnonzero(chosen):
        end = high[n] - 1e-6 * (high[n] - low[n])
        near = corners[((least <= end) & (most >= low[n])).all(axis=1)]
        found[n] = not any(len(clipped(triangle, low[n], end)) for triangle in near)
    return found


def assert_far_field_stays(before, after, surface, region, reach, seed):
    """On the surface, farther than ``reach`` cells of paint from a region, lookups answer as before.

    Farther than a cell, too, from nodes where nothing was: no field spreads into what of these is empty.
    With normals, farther than a cell too from leaves that were divided, as smaller ones face fewer ways, and
    from nodes that keep a coefficient and face other ways now, or show facings something else: they show the
    coefficient until they are split, then rows, the means of what is below.
    """
    samples = surface.placed_in(before).scatter(300, seed)
    points, normals = samples.rest, samples.normals
    cells, known = cells_of(before), cells_of(after)
    far = before.contains(points) & after.contains(points) & (region.gaps(points, points) > reach)
    is_node = ~known.is_leaf & ~np.isin(known.keys, cells.keys) & ~_below_leaves(known, cells)
    added = Boxes(known.low[is_node], known.high[is_node], known.edges[is_node])
    far &= added.gaps(points, points) > 1.0
    assert_same_field(before, after, points[far], None)
    at = np.minimum(np.searchsorted(known.keys, cells.keys), known.keys.size - 1)
    was_divided = cells.is_leaf & ~((known.keys[at] == cells.keys) & known.is_leaf[at])
    flags, now = before.tree.arrays.flags, after.tree.arrays.flags[at]
    was_divided |= (flags & KEPT != 0) & ((flags ^ now) & (FACING_FLAGS | SPLIT) != 0)
    was_divided[_with_other_rows(before, after, at)] = True
    divided = Boxes(cells.low[was_divided], cells.high[was_divided], cells.edges[was_divided])
    far &= divided.gaps(points, points) > 1.0
    assert_same_field(before, after, points[far], normals[far])


def assert_other_channels_stay(before, after, surface, painted, seed):
    """Paint on one channel leaves lookups of others as they were; of textures without alpha.

    Left out is what is near surface that was added where nothing was: it weighs more than what the field
    spreads to there.
    """
    names = [name for name in before.channels if name != painted]
    if not names or ALPHA.name in after.channels:
        return
    points = surface.placed_in(before).scatter(300, seed).rest
    cells, known = cells_of(before), cells_of(after)
    is_new = ~np.isin(known.keys, cells.keys) & ~_below_leaves(known, cells) & (after.tree.arrays.areas > 1)
    added = Boxes(known.low[is_new], known.high[is_new], known.edges[is_new])
    points = points[before.contains(points) & after.contains(points) & (added.gaps(points, points) > 1.0)]
    assert_same_field(*(octex.cast(texture, channels=names) for texture in (before, after)), points, None)


def _with_other_rows(before, after, at):
    """Nodes that keep a coefficient and have other rows after; ``at`` are the cells' numbers then."""
    rows = rows_of(before.tree.split, before.tree.kept.cells.astype(np.int64))
    there, found = find_rows(after.tree.split, at[rows.cells], rows.bits)
    differs = ~there
    for name, channel in before.channels.items():
        own = decode(channel.split_values[rows.rows[there]], channel.format.space)
        other = after.channels[name]
        differs[there] |= (own != decode(other.split_values[found], other.format.space)).any(axis=1)
    return rows.cells[differs]


def largest(texture, name):
    """The largest that a channel stores, decoded: what floats round by grows with it."""
    channel = texture.channels[name]
    return max(float(np.abs(decode(array, channel.format.space)).max(initial=1e-3)) for array in channel[1:])


def assert_same_field(before, after, points, normals, codes=1.0):
    """Lookups agree, but for so many codes of rounding."""
    if not len(points):
        return
    names = [name for name in before.channels if name in after.channels]
    one, other = (
        texture.sample(points, names, normals=normals, normalize=False) for texture in (before, after)
    )
    for name in names:
        # What hardly covers anything says hardly what colour it has.
        a, b = (
            found[name] * (found[ALPHA.name] if ALPHA.name in names and name != ALPHA.name else 1.0)
            for found in (one, other)
        )
        forms = [texture.channels[name].format for texture in (before, after)]
        most = max(largest(texture, name) for texture in (before, after))
        slack = codes * max(code_width(form, most) for form in forms) + 1e-5 * most
        if ALPHA.name in names and name != ALPHA.name:
            alphas = (texture.channels[ALPHA.name].format for texture in (before, after))
            slack += codes * most * max(map(code_width, alphas))
        apart = np.abs(a - b).max(axis=1)
        worst = int(apart.argmax())
        assert apart[worst] <= slack, (
            f"{name} with{'out' if normals is None else ''} normals at {points[worst].tolist()} was "
            f"{one[name][worst].tolist()}, is {other[name][worst].tolist()}"
        )


def assert_one_color(texture, surface, name, color, seed, *, averages=True):
    """Lookups on the surface answer one colour; of ``averages`` too, as widths and normals have them."""
    samples = surface.placed_in(texture).scatter(200, seed)
    turned = np.random.default_rng(seed).normal(size=samples.normals.shape).astype(np.float32)
    slack = 1.5 * code_width(texture.channels[name].format) + 1e-5
    widths = texture.placement.size / 2**texture.tree.max_depth, texture.placement.size / 9
    for width in (None, *widths) if averages else (None,):
        for normals in (None, samples.normals, turned) if averages else (None,):
            found = texture.sample(samples.rest, name, width=width, normals=normals, normalize=False)
            apart = np.abs(found - color).max(axis=1)
            worst = int(apart.argmax())
            facing = "no normal" if normals is None else f"normal {normals[worst].tolist()}"
            assert apart[worst] <= slack, (
                f"painted over, {name} at {samples.rest[worst].tolist()} with width {width} and {facing} is "
                f"{found[worst].tolist()}, not {color}"
            )


def assert_prevails(made, one, hidden, surface):
    """Lookups answer as one of two textures, unless the other has surface that it lacks."""
    if not one.tree.n_leaves or adds_leaves(one, hidden):
        return
    samples = surface.placed_in(one).scatter(200, 1)
    assert_same_field(one, made, samples.rest, None)
    assert_same_field(one, made, samples.rest, samples.normals)
