"""The quadratic field at samples, and the source there.

Samples lie in Morton order, so that what lies around a cell is gathered once for all samples in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octex.channels import ALPHA, decode
from octex.conversion.samples import PLACE_STEPS, Samples, sample_points
from octex.field.coefficients import add_up, new_windows
from octex.field.field import Field
from octex.field.lookups import Query, Stored, look_up
from octex.field.windows import new_walk
from octex.jit import kernel
from octex.parallel import ordered_map
from octex.texture.blend import stored
from octex.texture.channel import Channel
from octex.tree.layout import TreeArrays
from octex.tree.morton import decode as decode_cell
from octex.tree.octree import Octree
from octex.tree.placement import Placement

Floats = npt.NDArray[np.float32]
Int64s = npt.NDArray[np.int64]

_NO_KEPT = np.empty(0, np.uint32)
_UNIT = Placement((0.0, 0.0, 0.0), 1.0)
#: Finest cells whose samples are looked up at once.
_BLOCK = 1 << 15


class Coefficients(NamedTuple):
    """A tree without kept coefficients, and its cells' values as lookups add them up."""

    arrays: TreeArrays
    rows: Floats  # (cells · vectors, 4)   a cell's components, times its alpha, then a one
    components: int
    alpha: int  # the component that is the alpha, or −1

    @classmethod
    def of(cls, tree: Octree, channels: Mapping[str, Channel], samples: Samples) -> Coefficients:
        """Decode the channels that the samples have."""
        components = sum(form.components for form in samples.channels)
        rows = np.zeros((tree.n_cells, -(-(components + 1) // 4) * 4), np.float32)
        alpha = -1
        end = 0
        for form in samples.channels:
            start, end = end, end + form.components
            rows[:, start:end] = decode(channels[form.name].values[: tree.n_cells], form.space)
            alpha = start if form.name == "alpha" else alpha
        if alpha >= 0:
            others = np.arange(components) != alpha
            rows[:, :components][:, others] *= rows[:, alpha, None]
        rows[:, components] = 1.0
        return cls(tree.arrays, rows.reshape(-1, 4), components, alpha)

    def values_at(self, samples: Samples, cells: Int64s) -> Floats:
        """Return the field (n, components) at all samples of finest cells, which ascend.

        Every one of the cells must lie in a leaf of the tree. What nothing covers is black.
        """
        counts = samples.firsts[cells + 1] - samples.firsts[cells]
        found = np.empty((int(counts.sum()), self.components), np.float32)
        arrays = samples.codes, samples.firsts, samples.places
        _values_at(self, _NO_KEPT, *arrays, samples.depth, cells, found)
        return found


class FacingField(NamedTuple):
    """A tree and its channels, looked up with the normals of samples."""

    field: Field
    channels: list[Stored]
    alpha: Stored | None

    @classmethod
    def of(cls, tree: Octree, channels: Mapping[str, Channel], samples: Samples) -> FacingField:
        """Take the channels that the samples have."""
        field = Field(tree)
        field.tiles, field.facings  # noqa: B018 (built before threads share them)
        alpha = channels.get(ALPHA.name)
        read = [stored(channels[form.name]) for form in samples.channels]
        return cls(field, read, stored(alpha) if alpha else None)

    def values_at(self, samples: Samples, cells: Int64s) -> Floats:
        """Return the field (n, components) at all samples of finest cells, which ascend."""
        rows = samples.rows(cells)
        query = Query("quadratic", normals=samples.normals[rows].astype(np.float32))
        answers = [np.empty((rows.size, each.codes.components), np.float32) for each in self.channels]
        points = sample_points(samples, rows, _UNIT)
        look_up(self.field, _UNIT, points, query, self.channels, self.alpha, answers, ())
        return np.hstack(answers)


class Reference(NamedTuple):
    """The field of a full tree, looked up without normals and with them."""

    samples: Samples  # whose values are the field's
    field: Coefficients
    facing: FacingField

    @classmethod
    def of(
        cls, tree: Octree, channels: Mapping[str, Channel], samples: Samples, executor: Executor | None
    ) -> Reference:
        """Look the field up without normals, rounded as samples are."""
        field = Coefficients.of(tree, channels, samples)
        values = np.empty_like(samples.values)
        most = np.finfo(values.dtype).max
        blocks = [
            np.arange(begin, min(begin + _BLOCK, samples.codes.size))
            for begin in range(0, samples.codes.size, _BLOCK)
        ]
        work = partial(field.values_at, samples)
        done = map(work, blocks) if executor is None else ordered_map(executor, work, blocks)
        for block, found in zip(blocks, done, strict=True):
            here = slice(samples.firsts[block[0]], samples.firsts[block[-1] + 1])
            values[here] = np.clip(found, -most, most)
        return cls(samples._replace(values=values), field, FacingField.of(tree, channels, samples))


def values_of(coefficients: Coefficients, samples: Samples, cells: Int64s, nodes: Int64s) -> Floats:
    """Return at the same samples the values of the cells of the last level that hold them.

    ``nodes`` are the first finest cells in these, all that have any.
    """
    arrays, rows, components, alpha = coefficients
    owners = np.searchsorted(nodes, cells, side="right") - 1 + arrays.level_cells[-2]
    values = rows.reshape(len(arrays.flags), -1)[owners, :components]
    if alpha >= 0:
        others = np.arange(components) != alpha
        coverage = values[:, alpha, None]
        values[:, others] /= np.where(coverage > 0, coverage, 1)
    return np.repeat(values, samples.firsts[cells + 1] - samples.firsts[cells], axis=0)


def source_at(samples: Samples, cells: Int64s) -> npt.NDArray[np.floating]:
    """Return the source (n, components) at the same samples."""
    values = samples.values
    bits: npt.NDArray[Any] = values.view(np.uint16 if values.dtype == np.float16 else np.uint32)
    counts = samples.firsts[cells + 1] - samples.firsts[cells]
    found = np.empty((int(counts.sum()), values.shape[1]), bits.dtype)
    _copy_rows(bits, samples.firsts, cells, found)
    return found.view(values.dtype)


@kernel
def _copy_rows(
    bits: npt.NDArray[np.uint16 | np.uint32],
    firsts: Int64s,
    cells: Int64s,
    found: npt.NDArray[np.uint16 | np.uint32],
) -> None:
    n = 0
    for cell in cells:
        for sample in range(firsts[cell], firsts[cell + 1]):
            for component in range(bits.shape[1]):
                found[n, component] = bits[sample, component]
            n += 1


@kernel
def _values_at(
    coefficients: Coefficients,
    kept: npt.NDArray[np.uint32],
    codes: Int64s,
    firsts: Int64s,
    places: npt.NDArray[np.uint16],
    depth: int,
    cells: Int64s,
    found: Floats,
) -> None:
    arrays, rows, components, alpha = coefficients
    vectors = (components + 4) // 4
    walk, windows = new_walk(), new_windows(vectors)
    totals = np.empty(4 * vectors, np.float32)
    step = 1.0 / PLACE_STEPS
    scale = 1.0 / (1 << depth)
    n = 0
    for cell in cells:
        i, j, k = decode_cell(codes[cell])
        for sample in range(firsts[cell], firsts[cell + 1]):
            x = (i + (places[sample, 0] + 0.5) * step) * scale
            y = (j + (places[sample, 1] + 0.5) * step) * scale
            z = (k + (places[sample, 2] + 0.5) * step) * scale
            add_up(arrays, kept, rows, vectors, x, y, z, walk, windows, totals)
            for component in range(components):
                divisor = totals[components if alpha < 0 or component == alpha else alpha]
                found[n, component] = totals[component] / divisor if divisor > 0 else np.float32(0)
            n += 1
