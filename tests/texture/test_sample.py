"""What lookups give, beside the slow reference of the field: channels, alpha, directions, gradients."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex.channels import ALPHA, decode
from octex.texture import FILTERS, Channel, OctreeTexture
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from tests.make.small_textures import UNIT_BOUNDS, eight_colors
from tests.make.strategies import textures
from tests.oracles import naive

SMOOTH = [name for name in FILTERS if name != "nearest"]


def weights_at(texture, filter, point):
    """Weights of all rows, cells' and kept nodes', at a rest position, and their derivatives: (4, rows)."""
    field = naive.field_of(texture.tree, filter)
    (place,) = texture.placement.to_texture_space(point[None]).tolist()
    slopes = [field.derivatives(place, axis, 1)[1] / texture.placement.size for axis in np.eye(3).tolist()]
    return np.array([field.at(place), *slopes])


def decoded(channel):
    both = np.concatenate([channel.values, channel.kept_values])
    return decode(both, channel.format.space).astype(np.float64)


def expected(channel, alpha, weights):
    """Value (components,), gradient (components, 3), and how much of the weight is covered."""
    covered = 1.0
    if alpha is not None and channel is not alpha:
        under_alpha = weights * decoded(alpha)[:, 0]
        if under_alpha[0].sum() > 0:
            weights, covered = under_alpha, float(under_alpha[0].sum())
    (total, *slopes), sums = weights @ decoded(channel), weights.sum(axis=1)
    value = total / sums[0]
    gradient = [(slope - value * change) / sums[0] for slope, change in zip(slopes, sums[1:], strict=True)]
    return value, np.array(gradient).T, covered


@given(textures(deepest=5), st.sampled_from(SMOOTH), st.integers(0, 2**32 - 1))
def test_every_filter_blends_as_the_reference_does(texture, filter, seed):
    random = np.random.default_rng(seed)
    codes = texture.tree.level_codes(texture.tree.max_depth)
    place = np.array(naive.unmorton(int(random.choice(codes))))
    near = (place + random.random((3, 3)) * 3 - 1) / 2**texture.tree.max_depth
    points = texture.placement.to_rest(np.concatenate([near, random.random((1, 3))]))
    names = list(texture.channels)
    values, gradients = texture.sample(points, names, filter, normalize=False, gradient=True)
    units, unit_gradients = texture.sample(points, names, filter, gradient=True)
    steepest = 2.0**texture.tree.max_depth / texture.placement.size
    places = (points - texture.placement.origin) / texture.placement.size
    is_inside = (places > 0) & (places < 1)  # elsewhere points are clamped
    for n, point in enumerate(points):
        weights = weights_at(texture, filter, point)
        for name, channel in texture.channels.items():
            value, gradient, covered = expected(channel, texture.channels.get("alpha"), weights)
            assert np.allclose(values[name][n], value, rtol=0, atol=1e-5)
            gradient[:, ~is_inside[n]] = 0.0
            tolerance = 1e-5 * steepest / covered
            assert np.allclose(gradients[name][n], gradient, rtol=1e-4, atol=tolerance)
            length = np.linalg.norm(value)
            if channel.format.space == "direction" and length > 1e-3:
                value /= length
                gradient = (gradient - np.outer(value, value @ gradient)) / length
                assert np.allclose(units[name][n], value, rtol=0, atol=1e-5 / length)
                assert np.allclose(unit_gradients[name][n], gradient, rtol=1e-3, atol=tolerance / length**2)
            elif channel.format.space != "direction":
                assert np.array_equal(units[name][n], values[name][n])


@pytest.mark.parametrize("filter", FILTERS)
@given(textures(deepest=8), st.integers(0, 255))
def test_a_constant_comes_back_exactly(filter, texture, code):
    if not texture.tree.n_leaves:
        return
    form = ALPHA._replace(name="height")
    rows = texture.tree.n_cells, texture.tree.split.areas.size, texture.tree.kept.cells.size
    height = Channel(form, *(np.full((count, 1), code, np.uint8) for count in rows))
    alpha = {name: channel for name, channel in texture.channels.items() if name == "alpha"}
    flat = OctreeTexture(texture.tree, {"height": height, **alpha}, texture.placement, texture.bounds)
    points = texture.placement.to_rest(np.random.default_rng(code).random((20, 3)) * 1.2 - 0.1)
    assert (flat.sample(points, "height", filter) == np.float32(code / 255)).all()
    if filter != "nearest":
        _, gradient = flat.sample(points, "height", filter, gradient=True)
        assert (gradient == 0).all()


@pytest.mark.parametrize("filter", FILTERS)
def test_an_empty_texture_has_the_roots_value_everywhere(filter):
    tree = Octree.from_leaves([], 0)
    channels = {
        name: channel._replace(values=channel.values[:1]) for name, channel in eight_colors().channels.items()
    }
    texture = OctreeTexture(tree, channels, Placement((0.0, 0.0, 0.0), 1.0), UNIT_BOUNDS)
    values = texture.sample([[0.5, 0.5, 0.5], [-3.0, 0.1, 9.0]], filter=filter)
    assert values == pytest.approx(naive.srgb_to_linear(100 / 255))


def test_alpha_of_several_components_is_a_channel_like_others():
    color = eight_colors().channels["base_color"]
    alpha = color._replace(format=color.format._replace(name="alpha"))
    texture = eight_colors(channels={"base_color": color, "alpha": alpha})
    points = np.random.default_rng(0).random((9, 3))
    assert np.array_equal(
        texture.sample(points, filter="linear"), eight_colors().sample(points, filter="linear")
    )


def test_a_direction_that_cancels_out_has_no_gradient():
    color = eight_colors().channels["base_color"]
    form = color.format._replace(name="normal", space="direction", dtype="float32")
    zeros = np.zeros((9, 3), np.float32)
    texture = eight_colors(channels={"normal": Channel(form, zeros, zeros[:0], zeros[:0])})
    values, gradients = texture.sample([[0.3, 0.4, 0.5]], "normal", "quadratic", gradient=True)
    assert not values.any() and not gradients.any()
