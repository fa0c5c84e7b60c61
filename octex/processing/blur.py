"""Blur over the surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import numpy as np

from octex.arrays import Bools, Float32s, Float64s, Int64s, Uint8s
from octex.channels import ALPHA, LEAST_COVERAGE, decode, encode
from octex.checks import as_number
from octex.editing.averages import average_plain
from octex.editing.nodes import node_cells
from octex.processing.edit import noted, with_values
from octex.processing.mapping import centres_of, levels_of, names_of
from octex.texture import Channel, OctreeTexture
from octex.tree.areas import AREAS
from octex.tree.layout import FACING_FLAGS
from octex.tree.octree import Octree
from octex.tree.split import Rows, rows_of


def blur(
    texture: OctreeTexture,
    width: float,
    channel: str | Sequence[str] | None = None,
    *,
    threads: int | None = None,
    executor: Executor | None = None,
) -> OctreeTexture:
    """Return a texture that is blurred over its surface.

    width     of the blur, in the model's units
    channel   one name, several, or None for all. Unless alpha is blurred too, it stays and weighs the others
    threads, executor   who works in parallel: a number of threads, or a concurrent.futures.Executor

    Each leaf becomes ``texture.sample(centre, width=width, normals=facing)``: the average over a square
    around its centre, of surface that faces the same way. So nothing bleeds through a thin sheet. Split
    leaves are blurred for each facing. Leaves wider than ``width`` are blurred in part, so that a width of 0
    changes nothing. Averages are recomputed.

    Raises ArgumentError for unknown channels, and for a width that is negative or not finite.
    """
    names = names_of(texture, channel)
    width = as_number(width, "width", 0.0, np.finfo(np.float64).max)
    if width == 0:
        return texture
    tree = texture.tree
    arrays = {name: [array.copy() for array in texture.channels[name][1:]] for name in names}
    made = {name: Channel(texture.channels[name].format, *own) for name, own in arrays.items()}
    is_leaf = np.ones(tree.n_cells, np.bool_)
    is_leaf[node_cells(tree)] = False
    rows = rows_of(tree.split)
    rows = rows.of(is_leaf[rows.cells])
    is_plain = is_leaf.copy()
    is_plain[rows.cells] = False
    plain, kept = np.flatnonzero(is_plain), tree.kept.cells.astype(np.int64)
    look = _Look(texture, names, width, threads, executor)
    faces = tree.arrays.flags & np.uint8(FACING_FLAGS)
    for part, numbers, chosen, facings in (
        (0, plain, plain, faces[plain]),
        (1, *rows),
        (2, np.arange(kept.size), kept, faces[kept]),
    ):
        for name, values in look.at(chosen, facings).items():
            blurred, plain_field = values
            form, own = made[name].format, arrays[name][part]
            old = decode(own[numbers], form.space)
            result = blurred + look.left[chosen, None] * (old - plain_field)
            own[numbers] = encode(result, form.dtype, form.space)
    _average_facings(texture, made, rows, look.left)
    left = look.left[:, None].astype(np.float64)
    change = dict.fromkeys(names, lambda cells, values, means: left[cells] * (values - means))
    metadata = noted(texture.metadata, "blur", channels=names, width=width)
    return with_values(texture, made, change, metadata)


class _Look:
    """Lookups at the centres of cells."""

    def __init__(
        self,
        texture: OctreeTexture,
        names: list[str],
        width: float,
        threads: int | None,
        executor: Executor | None,
    ) -> None:
        self._texture, self._names, self._width = texture, names, width
        self._threads, self._executor = threads, executor
        self._codes = np.concatenate([codes for codes, _ in texture.tree.walk()])
        first = texture.tree.arrays.level_cells
        edges = texture.placement.size * np.ldexp(1.0, -np.arange(first.size - 1))
        # What is left of what cells (cells,) differ from the field by; in nodes, of their leaves.
        self.left = np.repeat(np.maximum(1 - width / edges, 0), np.diff(first)).astype(np.float32)
        average_plain(texture.tree, self.left)

    def at(self, cells: Int64s, facings: Uint8s) -> dict[str, tuple[Float32s, Float32s]]:
        """Return what is blurred, and the field as it is, in cells (n,) whose surface faces some ways."""
        centres = centres_of(self._texture, self._codes[cells], levels_of(self._texture.tree, cells))
        axes = np.stack([(facings >> bit & 1).astype(np.int8) for bit in range(6)], axis=1)
        normals = (axes[:, 0::2] - axes[:, 1::2]).astype(np.float32)
        has_normal = (axes[:, 0::2] & axes[:, 1::2] == 0).all(axis=1) & (facings > 0)
        found = {}
        for name in self._names:
            components = self._texture.channels[name].format.components
            found[name] = (
                np.empty((cells.size, components), np.float32),
                np.zeros((cells.size, components), np.float32),
            )
        for chosen, seen in ((has_normal, normals), (~has_normal, None)):
            chosen_normals = None if seen is None else seen[chosen]
            self._look(centres[chosen], chosen, chosen_normals, self._width, 0, found)
            keeps = chosen & (self.left[cells] > 0)
            if keeps.any():
                kept_normals = None if seen is None else seen[keeps]
                self._look(centres[keeps], keeps, kept_normals, None, 1, found)
        return found

    def _look(
        self,
        centres: Float64s,
        chosen: Bools,
        normals: Float32s | None,
        width: float | None,
        part: int,
        found: dict[str, tuple[Float32s, Float32s]],
    ) -> None:
        values = self._texture.sample(
            centres,
            self._names,
            width=width,
            normals=normals,
            normalize=False,
            threads=self._threads,
            executor=self._executor,
        )
        for name, own in values.items():
            found[name][part][chosen] = own


def _average_facings(texture: OctreeTexture, made: Mapping[str, Channel], rows: Rows, left: Float32s) -> None:
    """Make split leaves the means of their rows, in place, and keep what is left of their residuals."""
    if not rows.rows.size:
        return
    tree = texture.tree
    starts = np.flatnonzero(np.diff(rows.cells, prepend=-1))
    split = rows.cells[starts]
    after = {**texture.channels, **made}
    for name, channel in made.items():
        form, before = channel.format, texture.channels[name]
        was, now = (
            _means(own[name], None if name == ALPHA.name else own.get(ALPHA.name), tree, rows.rows, starts)
            for own in (texture.channels, after)
        )
        differed = decode(before.values[split], form.space) - was
        channel.values[split] = encode(now + left[split, None] * differed, form.dtype, form.space)


def _means(channel: Channel, alpha: Channel | None, tree: Octree, rows: Int64s, starts: Int64s) -> Float64s:
    """Return the means of runs of rows, by their areas."""
    shares = AREAS[tree.split.areas[rows]]
    if alpha is not None:
        shares = shares * np.maximum(decode(alpha.split_values[rows, 0], "data"), LEAST_COVERAGE)
    values = decode(channel.split_values[rows], channel.format.space) * shares[:, None]
    return np.asarray(np.add.reduceat(values, starts) / np.add.reduceat(shares, starts)[:, None])
