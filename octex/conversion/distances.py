"""How far trees' fields are from the full tree's at samples, found by lookups like those of a texture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from octex.arrays import Bools, Float32s, Int64s
from octex.channels import ALPHA, ChannelFormat
from octex.conversion import large
from octex.conversion.measure import ErrorColumns, encoded
from octex.conversion.samples import Samples, sample_points
from octex.field.field import Field
from octex.field.lookups import Query, look_up
from octex.jit import inlined, kernel
from octex.texture.blend import stored
from octex.texture.channel import Channel
from octex.tree.octree import Octree
from octex.tree.placement import Placement

_UNIT = Placement((0.0, 0.0, 0.0), 1.0)


class Looked(NamedTuple):
    """A tree and its channels as lookups without normals read them."""

    field: Field
    channels: list[Channel]

    @classmethod
    def of(cls, tree: Octree, channels: Mapping[str, Channel], forms: Sequence[ChannelFormat]) -> Looked:
        """Make a tree, and its channels of some formats, ready to be looked up by threads."""
        field = Field(tree)
        field.prepare()
        return cls(field, [channels[form.name].of(tree) for form in forms])

    def codes(self, samples: Samples, rows: Int64s, columns: ErrorColumns) -> Float32s:
        """Return what the field is in codes (n, see `encoded`) at samples (n,), fastest if they ascend."""
        read = [stored(channel) for channel in self.channels]
        answers = [np.empty((rows.size, channel.format.components), np.float32) for channel in self.channels]
        alpha = next((each for each in read if each.is_alpha), None)
        points = sample_points(samples, rows, _UNIT)
        look_up(self.field, _UNIT, points, Query("quadratic"), read, alpha, answers, [])
        return encoded(np.concatenate(answers, axis=1), columns)


def coverage_of(codes: Float32s, forms: Sequence[ChannelFormat]) -> Float32s:
    """Return by how much differences from codes (n, columns) count, (n,): by alpha; or (0,) without one."""
    first = 0
    for form in forms:
        if form.name == ALPHA.name and form.components == 1:
            found: Float32s = large.empty(len(codes), np.float32)
            np.multiply(codes[:, first], np.float32(1 / 255), out=found)
            return found
        first += form.components
    return codes[:0, 0].copy()


@inlined
def _are_near(
    found: Float32s,
    row: int,
    wanted: Float32s,
    sample: int,
    coverage: Float32s,
    alpha: int,
    most: np.float32,
) -> bool:
    """Say whether no code of a row is more than ``most`` from that of a sample, as far as that is covered."""
    covered = coverage[sample] if coverage.size > 0 else np.float32(1)
    near = True
    for column in range(wanted.shape[1]):
        apart = abs(found[row, column] - wanted[sample, column])
        # what is not a number is far from anything
        near &= (apart if column == alpha else covered * apart) <= most
    return near


@kernel
def far_samples(
    found: Float32s, wanted: Float32s, rows: Int64s, coverage: Float32s, alpha: int, most: float
) -> Bools:
    """Say which codes (n, columns) are more than ``most`` from those of samples ``rows`` (n,)."""
    far = np.empty(rows.size, np.bool_)
    for n in range(rows.size):
        far[n] = not _are_near(found, n, wanted, rows[n], coverage, alpha, np.float32(most))
    return far


@kernel
def near_alone(
    own: Float32s,
    wanted: Float32s,
    firsts: Int64s,
    coverage: Float32s,
    alpha: int,
    most: float,
    chosen: Bools,
) -> Bools:
    """Say which ``chosen`` of some cells (n,) have codes (n, columns) near those of all samples in them.

    The samples in a cell are those from its first of ``firsts`` (n + 1,) to the next one's.
    """
    near = chosen.copy()
    for n in range(chosen.size):
        sample = firsts[n]
        while near[n] and sample < firsts[n + 1]:
            near[n] = _are_near(own, n, wanted, sample, coverage, alpha, np.float32(most))
            sample += 1
    return near
