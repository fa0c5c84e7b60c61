"""Random textures looked up at random, every way, beside the slow references: `check` takes a seed."""

import numpy as np

from octex.channels import ALPHA, COLOR_SPACES, ONE, ChannelFormat, decode
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.strategies import random_channel, with_random_data
from tests.oracles import naive
from tests.oracles.naive_views import Views

DTYPES = tuple(sorted(ONE))
#: Covers below this are rounding, or nearly: on which side of a support's rim a point lies is then left open.
_LEAST_COVER = 1e-5
#: Derivatives are differences over 2⁻⁷ of a finest cell to both sides, or else over 2⁻¹⁰.
_STEPS = 7, 10


def random_texture(random, dtypes=DTYPES):
    """A small texture: even or adaptive, with or without alpha, split cells, kept nodes and leaves."""
    deepest = int(random.choice([0, 1, 2, 3, 4, 5, 6, 21], p=[0.02, 0.08, 0.2, 0.2, 0.2, 0.2, 0.05, 0.05]))
    tree = _random_tree(random, deepest)
    tree = with_random_data(tree, int(random.integers(2**32)), float(random.choice([0.0, 0.0, 0.4])))
    channels = {}
    for number in range(int(random.integers(1, 4))):
        dtype = str(random.choice(dtypes))
        form = ChannelFormat(
            f"channel {number}", int(random.integers(1, 5)), str(random.choice(COLOR_SPACES)), dtype
        )
        if number == 0 and random.random() < 0.4:
            form = ALPHA._replace(dtype=dtype)
        channels[form.name] = random_channel(form, tree, random)
        if form.name == ALPHA.name:
            values = [array * (random.random(array.shape) < 0.7) for array in channels[form.name][1:]]
            channels[form.name] = Channel(form, *values)
    size = float(10.0 ** random.choice([0, 0, 0, -12, 12])) * float(random.random() + 0.1)
    x, y, z = (size * random.normal(size=3)).tolist()
    placement = Placement((x, y, z), size)
    return OctreeTexture(tree, channels, placement, placement.to_rest(np.array([[0.0] * 3, [1.0] * 3])))


def _random_tree(random, deepest):
    """Leaves crowded around a place, of one depth or of several."""
    is_even = random.random() < 0.5
    centre = random.integers(0, 2**21, 3)
    taken = []  # first and last code of the deepest level there is, and the depth
    for _ in range(int(random.integers(0, 30))):
        depth = deepest if is_even else int(random.integers(max(deepest - 3, 0), deepest + 1))
        place = np.clip((centre >> (21 - depth)) + random.integers(-2, 3, 3), 0, 2**depth - 1)
        first = naive.morton(place.tolist()) << 3 * (21 - depth)
        last = first + (1 << 3 * (21 - depth)) - 1
        if all(last < low or first > high for low, high, _ in taken):
            taken.append((first, last, depth))
    taken.sort()
    codes = [first >> 3 * (21 - depth) for first, _, depth in taken]
    return Octree.from_leaves(np.array(codes, np.int64), np.array([each[2] for each in taken], np.uint8))


def random_points(texture, random, count):
    """Rest positions (2 · count, 3) in and around cells: at random, and then on cells' corners or nearly so.

    Also which of them are at random.
    """
    tree = texture.tree
    levels = random.integers(0, tree.max_depth + 1, 2 * count)
    codes = [int(random.choice(tree.level_codes(int(level)))) for level in levels]
    places = np.array([naive.unmorton(code) for code in codes], np.float64)
    steps = random.random((2 * count, 3)) * 5 - 2
    steps[count:] = np.round(2 * steps[count:]) / 2
    points = (places + steps) / 2.0 ** levels[:, None]
    points[count:] += random.choice([0.0, 0.0, 1e-16, 1e-12, 1e-9, 1e-7], (count, 3))
    points[0] = random.random(3) * 3 - 1
    points = points * texture.placement.size + np.array(texture.placement.origin)
    return points, np.arange(2 * count) < count


def check(seed):
    """Look up a random texture: finite, in the range of what is stored, and as the references have it."""
    random = np.random.default_rng(seed)
    texture = random_texture(random)
    points, at_random = random_points(texture, random, 4)
    if random.random() < 0.3:
        points = points.astype(np.float32)
        at_random[:] &= texture.tree.max_depth < 8  # else rounding moves them by cells
    for filter in FILTERS:
        views = random_views(random, len(points), texture.placement.size)
        about = f"seed {seed}: {texture!r}, {filter}, {views}"
        _check_answers(texture, points, filter, views, about)
        _check_references(texture, points, at_random, filter, views, about)
        gradient = filter != "nearest" and random.random() < 0.5
        if gradient:
            _check_gradients(texture, points, at_random, filter, views, about)


def random_views(random, n, size):
    """How points are looked at: plain, with widths or derivatives, with normals."""
    views = {}
    kind = int(random.integers(4))
    if kind == 1:
        views["width"] = float(size * 2.0 ** random.uniform(-8, 2))
    elif kind == 2:
        views["width"] = size * np.where(random.random(n) < 0.2, 0.0, 2.0 ** random.uniform(-8, 2, n))
    elif kind == 3:
        right, down = size * 2.0 ** random.uniform(-8, 1, (2, n, 1)) * random.normal(size=(2, n, 3))
        views |= {"dPdx": right, "dPdy": down}
    if random.random() < 0.5:
        normals = random.normal(size=(n, 3))
        normals[: n // 4] = np.eye(3)[random.integers(0, 3, n // 4)]
        views["normals"] = normals
    return views


def _stored(texture, name):
    """All decoded values of a channel (rows, components)."""
    channel = texture.channels[name]
    parts = channel.values, channel.kept_values, channel.split_values
    return np.concatenate([decode(part, channel.format.space) for part in parts]).astype(np.float64)


def _check_answers(texture, points, filter, views, about):
    """Answers are finite, among what is stored, and alike however many channels and points are asked for."""
    names = list(texture.channels)
    together = texture.sample(points, names, filter, normalize=False, **views)
    for name in names:
        alone = texture.sample(points, name, filter, normalize=False, **views)
        low, high = _stored(texture, name).min(axis=0), _stored(texture, name).max(axis=0)
        slack = 2e-6 * np.maximum(np.abs(low), np.abs(high)) + 1e-9
        for found in (alone, together[name]):
            assert np.isfinite(found).all(), (
                f"{about}: {name} is not finite at {points[~np.isfinite(found).all(1)]}"
            )
            assert (found >= low - slack).all() and (found <= high + slack).all(), (
                f"{about}: {name} out of range"
            )


def _check_references(texture, points, at_random, filter, views, about):
    """Values are those of the slow reference, but where a point lies on the rim of a support."""
    if "dPdx" in views:
        return  # whose references are tests of their own
    found = texture.sample(points, list(texture.channels), filter, normalize=False, **views)
    alpha = texture.channels.get(ALPHA.name)
    covers = Views(texture, ALPHA.name, filter) if alpha is not None and filter else None
    is_one_cell = filter == "nearest" and not views
    threshold = 1 / 32
    if covers is not None:
        threshold = np.inf  # by channel; under alpha the reference knows one
    widths = np.broadcast_to(views["width"], len(points)) if "width" in views else [None] * len(points)
    if covers is not None and "width" in views and "normals" not in views:
        found = texture.sample(
            points, list(texture.channels), filter, normalize=False, bleed_threshold=np.inf, **views
        )
    more = (
        {"bleed_threshold": np.inf}
        if threshold == np.inf and "width" in views and "normals" not in views
        else {}
    )
    for name in texture.channels:
        alone = texture.sample(points, name, filter, normalize=False, **views, **more)
        slow = Views(texture, name, filter)
        for n in np.flatnonzero(at_random):
            point = points[n].astype(np.float64)
            if _on_a_rim(slow, point):
                continue
            width = None if widths[n] is None else max(float(widths[n]), 1e-9 * texture.placement.size)
            normal = None
            if "normals" in views:
                normal = views["normals"][n] / np.linalg.norm(views["normals"][n])
            expected = slow.value(point, width, normal, threshold)
            if covers is not None and name != ALPHA.name and not is_one_cell:
                below = covers.value(point, width, normal, threshold)
                if below > 0 and below < 1e-3:
                    continue
                if below > 0:
                    plain = slow.values
                    slow.values = plain * covers.values
                    expected = slow.value(point, width, normal, threshold) / below
                    slow.values = plain
            for answer in (found[name], alone):
                np.testing.assert_allclose(
                    answer[n], expected, rtol=2e-3, atol=1e-3, err_msg=f"{about}: {name} at {points[n]}"
                )


def _on_a_rim(slow, point):
    covers = [slow.taps(point, level)[1] for level in range(slow.tree.max_depth + 1)]
    return any(0 < cover < _LEAST_COVER for cover in covers)


def _check_gradients(texture, points, at_random, filter, views, about):
    """Gradients are the derivatives of what lookups return; values beside them are those without."""
    exact = points.astype(np.float64)
    for name, channel in texture.channels.items():
        stored = _stored(texture, name)
        largest = 1.0 if channel.format.space == "direction" else float(np.abs(stored).max(initial=0.0))
        values, gradients = texture.sample(points, name, filter, gradient=True, **views)
        assert np.isfinite(values).all() and np.isfinite(gradients).all(), f"{about}: gradients of {name}"
        plain = texture.sample(points, name, filter, **views)
        np.testing.assert_allclose(
            values[at_random],
            plain[at_random],
            rtol=1e-4,
            atol=1e-4,
            err_msg=f"{about}: {name} beside gradients",
        )
        middle = texture.sample(exact, name, filter, **views).astype(np.float64)
        for axis in range(3):
            wrong = np.ones(middle.shape, np.bool_)
            for finer in _STEPS:  # near a rim the field may bend within the first
                step = 2.0 ** -(texture.tree.max_depth + finer) * texture.placement.size * np.eye(3)[axis]
                ahead, behind = (
                    texture.sample(exact + sign * step, name, filter, **views).astype(np.float64)
                    for sign in (1, -1)
                )
                # All by a step, so that rounding of values counts alike whatever the step is.
                slopes = 0.5 * (ahead - behind)
                bends = np.abs(ahead - 2 * middle + behind)
                found = gradients[:, :, axis] * step[axis]
                allowed = bends + 1e-2 * np.abs(slopes) + 2e-3 * 2.0**-finer * largest
                wrong &= np.abs(found - slopes) > allowed
                if not wrong[at_random].any():
                    break
            wrong = wrong[at_random]
            assert not wrong.any(), (
                f"{about}: the derivative of {name} along axis {axis} is {slopes[at_random][wrong]}, "
                f"not {found[at_random][wrong]}, at {points[at_random][wrong.any(axis=1)]}"
            )
