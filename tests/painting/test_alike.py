"""Fills of what has one colour, beside a walk from leaf to leaf."""

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.errors import ArgumentError
from octex.painting.region import alike
from octex.tree.morton import decode_cells
from tests.conftest import needs_jit
from tests.make.painted import ball

_FACES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def striped(depth=5, **options):
    """A ball with rings of two colours, which go over into each other."""
    surface = ball(16).with_sources({"base_color": lambda p: 0.5 + 0.4 * np.sin(6 * p[:, 1:2] + [[0, 1, 2]])})
    return octex.convert(surface, depth=depth, **options)


def leaves_of(texture):
    return [
        (level, tuple(place))
        for level, (codes, is_node) in enumerate(texture.tree.walk())
        for place in decode_cells(codes[~is_node]).tolist()
    ]


class Walked:
    """A texture whose leaves and their colours are looked up one after another."""

    def __init__(self, **options):
        self.texture = striped(**options)
        self.leaves = leaves_of(self.texture)
        self.every = set(self.leaves)
        middles = [(np.array(place) + 0.5) / 2**level for level, place in self.leaves]
        self.middles = self.texture.placement.to_rest(np.array(middles))
        self.colors = {leaf: self.color_at(own) for leaf, own in zip(self.leaves, self.middles, strict=True)}

    def color_at(self, rest):
        return 255 * linear_to_srgb(np.clip(self.texture.sample([rest])[0], 0, 1))

    def leaf_at(self, place):
        for level in range(self.texture.tree.max_depth + 1):
            cell = level, tuple(int(x) for x in np.floor(np.asarray(place) * 2**level))
            if cell in self.every:
                return cell
        return None

    def alike(self, point, tolerance, connected):
        """The leaves of the colour at a point, each level and place: one after another."""
        first = self.leaf_at(self.texture.placement.to_texture_space([point])[0])
        if first is None:
            return set()
        wanted = self.color_at(point)
        same = {leaf for leaf, color in self.colors.items() if np.abs(color - wanted).max() <= tolerance}
        same |= {first}
        if not connected:
            return same
        found, waiting = {first}, [first]
        beside = {leaf: set() for leaf in same}
        for level, place in same:
            for step in _FACES:
                other = self.leaf_at((np.array(place) + step + 0.5) / 2**level)
                if other in same and other[0] <= level:
                    beside[level, place].add(other)
                    beside[other].add((level, place))
        while waiting:
            new = beside[waiting.pop()] - found
            found |= new
            waiting += new
        return found


@needs_jit
@pytest.mark.parametrize("options", [{}, {"max_error": 6.0}])
def test_leaves_of_one_colour_are_those_that_a_walk_finds(options):
    walked = Walked(**options)
    assert bool(options) == (len({level for level, _ in walked.leaves}) > 1)
    for connected in (True, False):
        sizes = []
        for seed, tolerance in ((0, 10.0), (1, 25.0), (2, 60.0), (3, 0.0)):
            point = ball(16).scatter(1, seed).points[0]
            covers = alike(walked.texture, point, tolerance, connected=connected)
            chosen = np.flatnonzero(np.asarray(covers(walked.middles)))
            expected = walked.alike(point, tolerance, connected)
            assert {walked.leaves[n] for n in chosen} == expected
            sizes.append(len(expected))
        assert sizes[0] < sizes[2] < len(walked.leaves)
        assert sizes[3] >= 1


@needs_jit
def test_a_fill_of_one_colour_changes_the_leaves_of_it_alone():
    texture, surface = striped(), ball(16)
    point = surface.scatter(1, 5).points[0]
    made = octex.fill(texture, surface, alike(texture, point, 20.0), (1.0, 0.0, 0.0))
    samples = surface.scatter(5000, 0).points
    own = np.asarray(alike(texture, point, 20.0)(samples))
    assert 0.02 < own.mean() < 0.6
    before, after = (each.sample(samples, filter="nearest") for each in (texture, made))
    assert np.abs(after[own] - [1, 0, 0]).max() < 0.01
    assert (np.abs(after[~own] - before[~own]).max(axis=1) < 0.01).mean() > 0.999


def test_a_point_beside_the_surface_has_an_empty_region_and_bad_numbers_are_refused():
    texture = striped(4)
    points = ball(16).scatter(100, 0).points
    for far in ([0.0, 0.0, 0.0], [50.0, 0.0, 0.0]):
        assert not np.asarray(alike(texture, np.array(far), 255.0)(points)).any()
    for point, tolerance in (([np.nan] * 3, 1.0), ([0.0, 1.0], 1.0), ([0.0] * 3, 256.0), ([0.0] * 3, -1.0)):
        with pytest.raises(ArgumentError):
            alike(texture, np.array(point), tolerance)
