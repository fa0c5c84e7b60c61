"""A texture, the steps that are taken with it, and what holds after each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from octex.errors import OctexError
from octex.texture import OctreeTexture
from tests.oracles.naive_edits import assert_averages
from tests.properties import edit_claims as claims
from tests.properties.edit_models import vars_of_scripts

#: Averages of more are not compared with those made the slow way.
MOST_AVERAGED = 3_000


#: Refusals of what cannot be done, and why; any other error of octex's is a fault.
ALLOWED = (
    "no leaf of the texture meets the box",  # a crop beside the surface
    "which uint8 cannot hold",  # floats above 1 or below 0, cast
    "which uint16 cannot hold",
    "its source has no value anywhere on it",  # a source with a limit, and nothing within it
    "cells apart into depth",  # too coarse to separate
    "belongs to another model",  # a cloud's root cell need not hold the surface
)


Claim = Callable[["Run", OctreeTexture, OctreeTexture], None]


class Step(NamedTuple):
    lines: tuple[str, ...]  # the last one makes ``texture``
    claim: Claim | None = None
    fits: bool = False  # leaves become coefficients: averages are not their means, and floats leave 0 … 1
    leaves_range: bool = False  # floats may leave 0 … 1
    has_gaps: bool = False  # alpha of nodes counts surface where nothing is stored
    is_exact: bool = False  # averages are known also where leaves are coefficients
    turns: bool = False  # residuals are not kept, but mapped or rounded
    layers: tuple[str, ...] = ()  # other textures, whose averages may differ from means too


class Run:
    """A texture and what has been done to it."""

    def __init__(self, dtypes, folder, points):
        self.names: dict[str, Any] = dict(vars_of_scripts())
        self.dtypes, self.folder, self.points = dtypes, folder, points
        self.steps: list[Step] = []
        self.is_fitted = self.is_free = False

    @property
    def texture(self):
        return self.names["texture"]

    @property
    def surface(self):
        return self.names["surface"]

    def take(self, step):
        """Do a step and look at what has become of the texture; say whether it could be done."""
        before = self.names.get("texture")
        was = None if before is None else claims.digest(before)
        self.steps.append(step)
        try:
            for line in step.lines:
                exec(line, self.names)
        except OctexError as error:
            if any(text in str(error) for text in ALLOWED):
                self.steps.pop()
                self.names["texture"] = before
                return False
            raise
        self.is_fitted |= step.fits
        self.is_free |= step.leaves_range
        after = self.texture
        count = len(self.steps)
        claims.assert_sound(after, self.folder, count, self.points)
        if not self.is_fitted:
            claims.assert_in_unit_range(after, None if not self.is_free else ["alpha"])
        if before is None and not self.is_fitted:
            names = [name for name in after.channels if name != "alpha" or not step.has_gaps]
            claims.assert_averaged(after, names, 2.0)
        if before is not None:
            if after.tree.n_cells < MOST_AVERAGED and (step.is_exact or not (self.is_fitted or step.turns)):
                layers = [eval(code, {**self.names, "texture": before}) for code in step.layers]
                assert_averages(before, after, layers)
            assert claims.digest(before) == was, "the texture that was given has changed"
            assert after.placement == before.placement, "the root cell has moved"
            if step.claim is not None:
                step.claim(self, before, after)
        return True

    def script(self):
        return [line for step in self.steps for line in step.lines]


def some(random, low, high):
    return round(float(random.uniform(low, high)), 3)


def one_of(random, values):
    return values[int(random.integers(len(values)))]


def call(function, *arguments, **options):
    """Write a call; strings stand for themselves, so that those that are meant as such come quoted."""
    given = [str(each) for each in arguments]
    given += [f"{name}={value}" for name, value in options.items() if value is not None]
    return f"{function}({', '.join(given)})"


def color_of(random, components):
    return tuple(float(each) for each in random.choice([0.0, 1.0, 0.2, 0.7], components))


def place_on(random, run):
    """Somewhere on the surface at rest."""
    rest = run.surface.placed_in(run.texture).scatter(1, int(random.integers(1 << 30))).rest[0]
    x, y, z = (round(float(each), 3) for each in rest)
    return x, y, z


def extent_of(run):
    return float(np.ptp(run.texture.bounds, axis=0).max()) or 1.0
