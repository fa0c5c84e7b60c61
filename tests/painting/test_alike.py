"""Fills of what has one colour, beside a walk from leaf to leaf."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.errors import ArgumentError
from octex.painting.alike import alike
from octex.texture import OctreeTexture
from octex.tree.morton import decode_cells
from tests.conftest import needs_jit
from tests.make.painted import ball

_FACES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def striped(depth: int = 5, **options: Any) -> OctreeTexture:
    """A ball with rings of two colours, which go over into each other."""
    surface = ball(16).with_sources({"base_color": lambda p: 0.5 + 0.4 * np.sin(6 * p[:, 1:2] + [[0, 1, 2]])})
    return octex.convert(surface, depth=depth, **options)


def leaves_of(texture: OctreeTexture) -> list[tuple[int, tuple[int, ...]]]:
    return [
        (level, tuple(place))
        for level, (codes, is_node) in enumerate(texture.tree.walk())
        for place in decode_cells(codes[~is_node]).tolist()
    ]


def naive(texture: OctreeTexture, point: Any, tolerance: float, connected: bool) -> set[Any]:
    """The leaves of the colour at a point, each level and place: one after another."""
    every = set(leaves_of(texture))

    def leaf_at(place: Any) -> Any:
        for level in range(texture.tree.max_depth + 1):
            cell = level, tuple(int(x) for x in np.floor(np.asarray(place) * 2**level))
            if cell in every:
                return cell
        return None

    def color_at(rest: Any) -> Any:
        return 255 * linear_to_srgb(np.clip(texture.sample([rest])[0], 0, 1))

    first, wanted = leaf_at(texture.placement.to_texture_space([point])[0]), color_at(point)
    if first is None:
        return set()
    middles = {
        (level, place): color_at(texture.placement.to_rest([(np.array(place) + 0.5) / 2**level])[0])
        for level, place in every
    }
    same = {leaf for leaf, color in middles.items() if np.abs(color - wanted).max() <= tolerance} | {first}
    if not connected:
        return same
    found, waiting = {first}, [first]
    beside: dict[Any, set[Any]] = {leaf: set() for leaf in same}
    for level, place in same:
        for step in _FACES:
            other = leaf_at((np.array(place) + step + 0.5) / 2**level)
            if other in same and other[0] <= level:
                beside[level, place].add(other)
                beside[other].add((level, place))
    while waiting:
        new = beside[waiting.pop()] - found
        found |= new
        waiting += new
    return found


@needs_jit
@pytest.mark.parametrize("connected", [True, False])
@pytest.mark.parametrize("options", [{}, {"max_error": 6.0}])
def test_leaves_of_one_colour_are_those_that_a_walk_finds(connected: bool, options: dict[str, Any]) -> None:
    texture = striped(**options)
    every = leaves_of(texture)
    assert bool(options) == (len({level for level, _ in every}) > 1)
    middles = np.array([(np.array(place) + 0.5) / 2**level for level, place in every])
    sizes = []
    for seed, tolerance in ((0, 10.0), (1, 25.0), (2, 60.0), (3, 0.0)):
        point = ball(16).scatter(1, seed).points[0]
        covers = alike(texture, point, tolerance, connected=connected)
        is_chosen = np.asarray(covers(texture.placement.to_rest(middles)))
        expected = naive(texture, point, tolerance, connected)
        assert {leaf for leaf, own in zip(every, is_chosen, strict=True) if own} == expected
        sizes.append(len(expected))
    assert sizes[0] < sizes[2] < len(every)
    assert sizes[3] >= 1


@needs_jit
def test_a_fill_of_one_colour_changes_the_leaves_of_it_alone() -> None:
    texture, surface = striped(), ball(16)
    point = surface.scatter(1, 5).points[0]
    made = octex.fill(texture, surface, alike(texture, point, 20.0), (1.0, 0.0, 0.0))
    samples = surface.scatter(5000, 0).points
    own = np.asarray(alike(texture, point, 20.0)(samples))
    assert 0.02 < own.mean() < 0.6
    before, after = (each.sample(samples, filter="nearest") for each in (texture, made))
    assert np.abs(after[own] - [1, 0, 0]).max() < 0.01
    assert (np.abs(after[~own] - before[~own]).max(axis=1) < 0.01).mean() > 0.999


def test_a_point_beside_the_surface_has_an_empty_region_and_bad_numbers_are_refused() -> None:
    texture = striped(4)
    points = ball(16).scatter(100, 0).points
    for far in ([0.0, 0.0, 0.0], [50.0, 0.0, 0.0]):
        assert not np.asarray(alike(texture, np.array(far), 255.0)(points)).any()
    for point, tolerance in (([np.nan] * 3, 1.0), ([0.0, 1.0], 1.0), ([0.0] * 3, 256.0), ([0.0] * 3, -1.0)):
        with pytest.raises(ArgumentError):
            alike(texture, np.array(point), tolerance)
