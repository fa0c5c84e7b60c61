"""OctreeTexture: a tree, channels of values and a placement; what everything else meets."""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, Unpack, overload

import numpy as np
import numpy.typing as npt

from octex import container
from octex.archive.layout import is_archive
from octex.arrays import Array, Bools, Float32s, Float64s, Int64s, Uint8s
from octex.channels import decode
from octex.checks import (
    as_choice,
    as_depth,
    as_entries,
    as_flag,
    as_path,
    as_reals,
    as_row_numbers,
    as_whole,
    locked,
)
from octex.errors import ArgumentError, InputError, TextureFileError
from octex.field.field import Field
from octex.field.listing import Reads, TapList, joined, joined_reads, list_blends, reads_of
from octex.field.lookups import ChannelRows, PlainLookup, Query, look_up, plain_lookup
from octex.field.splines import FILTERS
from octex.files import is_address
from octex.texture.blend import NO_GRADIENTS, make_unit, mixed_cells, stored
from octex.texture.channel import Channel
from octex.texture.file import ARCHIVE_ENDING, ENDING, File, Parts, described, taken, written
from octex.texture.lookup import (
    ANISOTROPY,
    BLEED_THRESHOLD,
    LEAST_SORTED,
    Answers,
    Given,
    Lens,
    LookUp,
    LookupOptions,
    SurfacePoints,
    check_apart,
    each_block,
    in_blocks,
    in_space,
    placed,
)
from octex.texture.spans import Rows, Spans, add_reads, cells_of, nodes_read
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, in_leaves

#: What ``sample`` takes for no blur, and for no sharpness, if nobody says.
_NONE = 0.0
#: Points that `OctreeTexture.sample` looks up the short way, and their types.
_FEW = 64
_TAKEN = {np.dtype(np.float32), np.dtype(np.float64)}
#: Leaves of which each read waits for memory, and for the disk if they do not fit there: points are looked up
#: in the order of space, 1.7 times as fast for 234 M of them. For 15 M it makes no difference.
_MANY_LEAVES = 1 << 26


class OctreeTexture:
    """Values stored in the octree cells that a surface passes through, looked up by rest position.

    Immutable: what ``channels`` and ``bounds`` hand out is read-only. The arrays given of a tree and of
    channels are not copied. ``metadata`` is provenance: free text by name, kept in the file. It can be
    pickled and copied, whole: also what is in a file.

    Raises ArgumentError if tree, channels, placement and bounds do not fit together.
    """

    __slots__ = (
        "_components",
        "_field",
        "_file",
        "_known_mixed",
        "_known_plain",
        "_known_stored",
        "bounds",
        "channels",
        "metadata",
        "placement",
        "tree",
    )

    def __init__(
        self,
        tree: Octree,
        channels: Mapping[str, Channel],
        placement: Placement,
        bounds: npt.ArrayLike,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.placement = Placement.checked(placement)
        self.bounds = _as_bounds(bounds)
        self.metadata = MappingProxyType(as_metadata(metadata))
        self._hold(tree, channels)

    def _hold(self, tree: Octree, channels: Mapping[str, Channel]) -> None:
        if not isinstance(tree, Octree):
            raise ArgumentError(f"tree must be an Octree, not {tree!r}")
        self.tree = tree
        self._field = Field(tree)
        self._known_mixed: dict[tuple[str, int], tuple[float, Uint8s]] = {}
        self._known_plain: dict[tuple[str, str], PlainLookup | None] = {}
        self._known_stored: dict[str, ChannelRows] = {}
        self._file: File | None = None
        given = as_entries(channels, "channels")
        for name, channel in given.items():
            if not isinstance(channel, Channel):
                raise ArgumentError(f"channel {name!r} must be a Channel, not {channel!r}")
            channel.check(name, tree)
        self.channels = MappingProxyType({name: channel.locked() for name, channel in given.items()})
        self._components = {name: channel.format.components for name, channel in given.items()}

    def with_cells(self, tree: Octree, channels: Mapping[str, Channel]) -> OctreeTexture:
        """Return a texture of another tree and its channels; placement, bounds and provenance are this one's.

        Raises ArgumentError if tree and channels do not fit together.
        """
        made = object.__new__(OctreeTexture)
        made.placement, made.bounds, made.metadata = self.placement, self.bounds, self.metadata
        made._hold(tree, channels)
        return made

    def __repr__(self) -> str:
        return f"<OctreeTexture of {', '.join(self.channels) or 'no channels'}; {self.tree!r}>"

    def __reduce__(self) -> tuple[Any, ...]:
        others = (self._file.path, self._file.tensors, self._file.metadata) if self._file else None
        parts = self.tree, dict(self.channels), self.placement, self.bounds, dict(self.metadata)
        return _received, (parts, others)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays: structure, flags, areas, values, the split table and the kept nodes."""
        return self.tree.nbytes + sum(channel.nbytes for channel in self.channels.values())

    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        gradient: Literal[False] = False,
        out: Float32s | None = None,
        **options: Unpack[LookupOptions],
    ) -> Float32s: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: list[str] | tuple[str, ...],
        filter: str = "quadratic",
        *,
        gradient: Literal[False] = False,
        out: Mapping[str, Float32s] | None = None,
        **options: Unpack[LookupOptions],
    ) -> dict[str, Float32s]: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        gradient: Literal[True],
        out: tuple[Float32s, Float32s] | None = None,
        **options: Unpack[LookupOptions],
    ) -> tuple[Float32s, Float32s]: ...
    @overload
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: list[str] | tuple[str, ...],
        filter: str = "quadratic",
        *,
        gradient: Literal[True],
        out: tuple[Mapping[str, Float32s], Mapping[str, Float32s]] | None = None,
        **options: Unpack[LookupOptions],
    ) -> tuple[dict[str, Float32s], dict[str, Float32s]]: ...
    def sample(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str | list[str] | tuple[str, ...] = "base_color",
        filter: str = "quadratic",
        *,
        width: npt.ArrayLike | None = None,
        normals: npt.ArrayLike | None = None,
        dPdx: npt.ArrayLike | None = None,
        dPdy: npt.ArrayLike | None = None,
        anisotropy: float = ANISOTROPY,
        blur: float = _NONE,
        sharpness: float = _NONE,
        bleed_threshold: float = BLEED_THRESHOLD,
        normalize: bool = True,
        gradient: bool = False,
        out: Any = None,
        threads: int | None = None,
        executor: Executor | None = None,
    ) -> Any:
        """Look up the field at rest positions (n, 3), float32 or float64, or at points of a surface.

        These are what ``Surface.scatter`` returns, or a record of hits: anything with ``rest`` (n, 3), and
        normals at rest, ``rest_normals`` or ``normals`` (n, 3), which count as given if none are.

        Returns float32 (n, components): linear light for colours, −1 … 1 for directions, 0 … 1 for other
        integers. A list of channel names gives a dict. Every point has a value: off the surface, where none
        of the cells that a filter reads is stored, that of coarser averages; outside the root cell, that of
        the nearest point inside.

        width     side of the square to average over, in the model's units: one for all, or (n,). Averages of
                  the source are read at the two levels whose cells suit it, and blended; they weigh by the
                  root of the area in their cells. None: the leaves.
        dPdx, dPdy  instead of a width: how rest positions change from one pixel to the next, (n, 3) each. The
                  footprint is then the pixel's parallelogram: several looks along its longer axis, and, but
                  for ``nearest`` and ``linear``, two across.
        anisotropy  how much longer than wide such a footprint may be, up to 256; a narrower one is widened
                  (for dPdx and dPdy alone)
        blur      width that is added to both sides of a footprint, in the model's units
        sharpness  0 … 1: from the mean over the footprint to a kernel of variance zero, whose results may
                  leave the range of the stored values. Leaves are not sharpened.
        normals   shading normals (n, 3) of any length, in rest space. What faces away from them weighs
                  nothing, and cells where a front and a back meet answer with what faces the normal; where
                  nothing faces it (double-sided materials), everything counts.
        bleed_threshold  for footprints without normals (paper 3.5.2): a coarse cell whose means over opposite
                  facings differ by this or more, in any component as it is answered, is left to the next
                  finer level.

        filter    what lies between the stored values. ``quadratic``: a spline over 3×3×3 cells, with
                  continuous slopes across every change of depth (the neighbourhood of paper 3.4, after
                  Kobbelt et al. 1997). ``quartic``: likewise over 5×5×5 cells, continuous to the third
                  derivative. ``linear``: the paper's own rule, which jumps where the depth changes.
                  ``nearest``: what is stored of the leaf that holds the point; else of the nearest cell among
                  the 27 around it at the deepest level that has one there.
        normalize directions come back as unit vectors; without, as the means that are stored, whose length,
                  1 where all directions agree, tells how far they spread. A mean of zero stays zeros in
                  floats; integers have no code for zero, so it has no direction worth the name there.
        gradient  return a pair: the values, and their derivatives by rest position, float32
                  (n, components, 3), per unit of the model's length. ``nearest`` has none.
        out       where to write and what to return: a C-ordered float32 array of the answer's shape, a dict
                  of them for a list of channels, with ``gradient`` a pair of either; else new arrays

        Who works in parallel: ``threads``, so many, by default all processors for large batches and the
        calling thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor.
        The result is the same. To other processes the texture travels with each block of points.

        Blending is done in linear light. Where the texture has a channel ``alpha``, all others weigh by it.

        Where leaves have several depths, points that lie close together are answered together: what else is
        asked for may change an answer by rounding, up to 10⁻⁶ of the largest value around; threads do not.

        Memory does not grow with the points but for the answers. Raises ArgumentError for positions that are
        not finite (n, 3), naming the first row (``out`` is then written in part), likewise for normals,
        widths and derivatives, for unknown channels and filters, listing those there are, for gradients of
        ``nearest``, and for an ``out`` that does not fit.
        """
        if (
            (width is normals is dPdx is dPdy is out is None and threads is None and executor is None)
            and (gradient is False and normalize is True and blur is sharpness is _NONE)
            and (anisotropy is ANISOTROPY and bleed_threshold is BLEED_THRESHOLD)
        ):
            answer = self._plain(points, channel, filter)
            if answer is not None:
                return answer
        lens = Lens(filter, anisotropy, blur, sharpness, bleed_threshold)
        gradient, normalize = as_flag(gradient, "gradient"), as_flag(normalize, "normalize")
        footprint = {"width": width, "dPdx": dPdx, "dPdy": dPdy}
        given = lens.given(points, normals=normals, gradient=gradient, **footprint)
        answers = Answers(self._components, channel, len(given["points"]), gradient, out)
        if out is not None:
            check_apart(given.values(), answers.arrays)
        if self._file is not None:
            self._read_for(len(given["points"]))
        look_up_block: LookUp = partial(self._sampled, answers.channels, lens, normalize)
        task = given, answers.arrays, look_up_block, threads, executor
        is_crowded = given.keys() <= {"points", "normals"} and self._field.tiles is None
        if is_crowded:
            self._field.prepare(FILTERS.index(filter))
        if len(answers.channels) > 2 or filter == "quartic":  # most of the time is waiting for memory
            in_space(*task, self.placement, LEAST_SORTED)
        elif self._field.n_leaves >= _MANY_LEAVES or is_crowded:
            in_space(*task, self.placement)
        else:
            in_blocks(*task)
        return answers.returned

    def _plain(self, points: Any, channel: Any, filter: Any) -> Float32s | None:
        """Look up few points of the leaves the short way; None where that is not for them.

        A call with one point takes a third of the time so.
        """
        if type(points) is not np.ndarray or points.ndim != 2 or not 0 < len(points) <= _FEW:
            return None
        flags = points.flags
        is_taken = points.dtype in _TAKEN and flags.c_contiguous and flags.aligned
        if not (is_taken and points.shape[1] == 3 and type(channel) is type(filter) is str):
            return None
        key = channel, filter
        if key not in self._known_plain:
            if channel not in self.channels or filter not in FILTERS:
                return None
            (read,), alpha = self._read(channel)
            is_direction = self.channels[channel].format.space == "direction"  # made unit vectors
            plain = None if is_direction else plain_lookup(self._field, self.placement, filter, read, alpha)
            self._known_plain[key] = plain
        known = self._known_plain[key]
        if known is None:
            return None
        self._read_for(len(points))
        return known.at(points)

    def _ready_for(
        self,
        count: int,
        channel: str | list[str] | tuple[str, ...] | None,  # noqa: ARG002
        lens: Lens | None,  # noqa: ARG002
        given: Callable[[], Given],  # noqa: ARG002
    ) -> OctreeTexture:
        """Return the texture that answers so many lookups, and has at hand what these read.

        Without a channel they are those of ``contains``. ``given`` returns what is given of the points.
        """
        self._read_for(count)
        return self

    def _sampled(
        self, names: list[str], lens: Lens, normalize: bool, given: Given, answers: list[Array]
    ) -> int:
        """Look up a block: what `lookup.in_blocks` takes.

        Its values are written to ``answers``, and then, if they are wanted, as many gradients.
        """
        if not names:
            return -1
        channels = list(map(self.channels.__getitem__, names))
        values, gradients = answers[: len(channels)], answers[len(channels) :]
        read, alpha = self._read(*names)
        task = self._field, self.placement, given["points"]
        fault = -1
        query = self._query(lens, given, names[0])
        if len(channels) == 1 or query.mixed is None:
            fault = look_up(*task, query, read, alpha, values, gradients)
        else:  # each channel mixes facings in cells of its own
            for n, name in enumerate(names):
                query, one = self._query(lens, given, name), slice(n, n + 1)
                fault = look_up(*task, query, read[one], alpha, values[one], gradients[one])
        if fault < 0 and normalize:
            for number, channel in enumerate(channels):
                if channel.format.space == "direction":
                    make_unit(values[number], gradients[number] if gradients else NO_GRADIENTS)
        return fault

    def _query(self, lens: Lens, given: Given, name: str) -> Query:
        """Return what is asked of a block of points of a channel."""
        query = lens.query(given)
        if query.footprints is not None and query.normals is None and self.tree.split.cells.size:
            query = query._replace(mixed=partial(self._mixed, self.channels[name], lens.bleed_threshold))
        return query

    def _read(self, *names: str) -> tuple[list[ChannelRows], ChannelRows | None]:
        """Return channels as lookups read them, and that which others weigh by, if there is one."""
        found: list[ChannelRows] = []
        for name in (*names, "alpha") if "alpha" in self.channels else names:
            if name not in self._known_stored:
                self._known_stored[name] = stored(self.channels[name])
            found.append(self._known_stored[name])
        alpha = found.pop() if len(found) > len(names) else None
        return found, alpha if alpha and alpha.is_alpha else None

    def _mixed(self, channel: Channel, threshold: float, level: int) -> Uint8s:
        key = channel.format.name, level
        known = self._known_mixed.get(key)
        if known is None or known[0] != threshold:
            known = threshold, mixed_cells(channel, self._field.level(level).tree, threshold)
            self._known_mixed[key] = known
        return known[1]

    def taps(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        width: npt.ArrayLike | None = None,
        normals: npt.ArrayLike | None = None,
        dPdx: npt.ArrayLike | None = None,
        dPdy: npt.ArrayLike | None = None,
        anisotropy: float = ANISOTROPY,
        blur: float = 0.0,
        sharpness: float = 0.0,
        bleed_threshold: float = BLEED_THRESHOLD,
        threads: int | None = None,
        executor: Executor | None = None,
    ) -> TapList:
        """List what ``sample`` blends at rest positions (n, 3): which rows of ``rows(channel)``, how much.

        Returns, in compressed sparse rows, ``starts`` (n + 1,) int64, ``rows`` (taps,) int64, none twice for
        a point, and ``weights`` (taps,) float32, 1 in sum for each point. Their blend is what ``sample``
        returns with ``normalize=False``; values are linear in it, which is what fits and optimizers need.
        With scipy:

            taps = texture.taps(points)
            values = texture.rows("base_color")
            blend = scipy.sparse.csr_array((taps.weights, taps.rows, taps.starts), (n, len(values)))
            colors = blend @ values  # (n, 3); values that suit given colors solve blend @ values = colors

        ``torch.nn.functional.embedding_bag`` does the same with rows, values, ``starts[:-1]`` and weights.
        Channels differ where alpha weighs them, and in footprints without normals where their fronts and
        backs differ; else their taps are alike.

        Who works in parallel: ``threads``, so many, by default all processors for large batches and the
        calling thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor.
        The result is the same.

        All other arguments, and what is raised, are as for ``sample``; ``nearest`` has one tap a point but in
        footprints.
        """
        lens = Lens(filter, anisotropy, blur, sharpness, bleed_threshold)
        given = lens.given(points, normals=normals, width=width, dPdx=dPdx, dPdy=dPdy)
        as_choice(channel, self.channels, "channel")
        self._read_for(len(given["points"]))
        blocks = each_block(given, [], partial(self._listed, channel, lens), threads, executor)
        return joined([TapList(*found) for _, found in blocks])

    def _listed(self, name: str, lens: Lens, given: Given, answers: list[Array]) -> int:
        """Add the taps of a block to ``answers``: what `lookup.each_block` takes."""
        query = self._query(lens, given, name)
        (read,), alpha = self._read(name)
        answers += list_blends(self._field, self.placement, given["points"], query, read, alpha)
        return -1

    def rows(self, channel: str = "base_color", numbers: npt.ArrayLike | None = None) -> Float32s:
        """Return a channel's stored values (rows, components), float32, as ``sample`` returns values.

        First those of cells, in the order of their numbers (``tree.arrays`` says how cells are numbered),
        nodes with their averages; then those of the kept nodes; then those of the split cells' facings.
        ``numbers`` (n,): these rows alone. Raises ArgumentError for an unknown channel and for rows that are
        not there.
        """
        known = self.channels[as_choice(channel, self.channels, "channel")]
        parts = [known.values, known.kept_values, known.split_values]
        count = sum(map(len, parts))
        if numbers is not None:
            wanted = as_row_numbers(numbers, count)
            begin, taken = 0, np.empty((wanted.size, known.format.components), known.values.dtype)
            for part in parts:
                here = (wanted >= begin) & (wanted < begin + len(part))
                taken[here] = part[wanted[here] - begin]
                begin += len(part)
            parts = [taken]
        return decode(np.concatenate(parts), known.format.space)

    def blocks(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str | list[str] | tuple[str, ...] = "base_color",
        filter: str = "quadratic",
        *,
        width: npt.ArrayLike | None = None,
        normals: npt.ArrayLike | None = None,
        dPdx: npt.ArrayLike | None = None,
        dPdy: npt.ArrayLike | None = None,
        anisotropy: float = ANISOTROPY,
        blur: float = 0.0,
        sharpness: float = 0.0,
        bleed_threshold: float = BLEED_THRESHOLD,
        block_size: int = 1 << 16,
    ) -> Int64s:
        """List the bytes of its file that ``sample`` needs for these points, before it reads them.

        Returns where runs of blocks begin and end (n, 2), int64, ascending, apart from each other; a block is
        ``block_size`` bytes, counted from the file's first, and the last may be shorter. A file with these
        bytes alone, zeros elsewhere, opens and answers likewise. Only what says which cells there are is read
        to find out, down to the level that is asked for, which is a fifth of a file or less, and of the
        values, for footprints without normals, those of split cells. Of trees whose leaves have one depth,
        only what lies around the points is listed. Arguments are as for ``sample``.

        Raises ArgumentError as that does, and for a texture that has no file.
        """
        block_size = as_whole(block_size, "block_size", 1, 1 << 40)
        mapping = self._file.mapping if self._file else None
        if mapping is None:
            raise ArgumentError("the texture has no file: save it and open that")
        lens = Lens(filter, anisotropy, blur, sharpness, bleed_threshold)
        given = lens.given(points, normals=normals, width=width, dPdx=dPdx, dPdy=dPdy)
        spans, reads = Spans(mapping, block_size), self._reads(channel, lens, given)
        for nodes in nodes_read(self.tree, cells_of(reads.values()), filter):
            spans.nodes(self.tree.arrays.groups, nodes)
        self._add_reads(spans, reads, lens, given)
        return spans.ranges()

    def _reads(
        self,
        channel: str | list[str] | tuple[str, ...],
        lens: Lens,
        given: Given,
        *,
        cells_alone: bool = False,
    ) -> dict[str, dict[int, Reads]]:
        """Return what lookups read of each channel, by level.

        With ``cells_alone`` only where points are looked at, as far as what is stored does not matter.
        """
        names = list(channel) if isinstance(channel, (list, tuple)) else [channel]
        for name in names:
            as_choice(name, self.channels, "channel")
        found: dict[str, dict[int, Reads]] = {}
        for name in names:
            parts: dict[int, list[Reads]] = {}
            look_up = partial(self._read_of, name, lens, cells_alone)
            for _, (levels, *arrays) in each_block(given, [], look_up, 1, None):
                for level, rows, cells in zip(levels.tolist(), arrays[::2], arrays[1::2], strict=True):
                    parts.setdefault(level, []).append(Reads(rows, cells))
            found[name] = joined_reads(parts)
        return found

    def _read_of(self, name: str, lens: Lens, cells_alone: bool, given: Given, answers: list[Array]) -> int:
        """Add the levels that a block looks at, and what it reads of each, to ``answers``."""
        query = self._query(lens, given, name)
        task = self._field, self.placement, given["points"], query, self._read(name)[0][0]
        found = reads_of(*task, cells_alone=cells_alone)
        answers += [np.array(list(found), np.int64), *(array for read in found.values() for array in read)]
        return -1

    def _add_reads(
        self, spans: Rows, reads: Mapping[str, Mapping[int, Reads]], lens: Lens, given: Given
    ) -> None:
        """Add the bytes of the file that lookups read, but for what says which cells there are."""
        alpha = [] if self._read()[1] is None else [self.channels["alpha"]]
        for name, levels in reads.items():
            rows = {level: read.rows for level, read in levels.items()}
            task = spans, self.tree, [self.channels[name], *alpha], rows
            by_facing = "normals" in given
            add_reads(*task, by_facing=by_facing, is_ruled=not by_facing and lens.has_footprints(given))

    def contains(
        self,
        points: npt.ArrayLike | SurfacePoints,
        *,
        threads: int | None = None,
        executor: Executor | None = None,
    ) -> Bools:
        """Say of each rest position (n, 3) whether a leaf holds it.

        Who works in parallel: ``threads``, so many, by default all processors for large batches and the
        calling thread alone for small ones; or the workers of ``executor``, any concurrent.futures.Executor.
        The result is the same.

        Raises ArgumentError for positions that are not finite (n, 3).
        """
        points, _ = placed(points)
        inside = np.empty(len(points), np.bool_)
        self._read_for(len(points))
        in_blocks({"points": points}, [inside], self._holds, threads, executor)
        return inside

    def _holds(self, given: Given, answers: list[Array]) -> int:
        """Say of a block of points whether leaves hold them: what `lookup.in_blocks` takes."""
        return in_leaves(self.tree.arrays, Positions.of(given["points"]), *self.placement, answers[0])

    def _read_for(self, count: int) -> None:
        """Prepare for so many lookups."""
        # About a page a point: most of the file will be read.
        mapping = self._file.mapping if self._file else None
        if mapping and count * mmap.PAGESIZE > len(mapping):
            self._read_ahead()

    def level(self, level: int) -> OctreeTexture:
        """Return the texture of levels 0 … ``level``, whose leaves include the averages stored there.

        Its arrays are views; nothing deeper is read. Raises ArgumentError for a level that is not 0 … 21.
        """
        if as_depth(level, "level") >= self.tree.max_depth:
            return self
        field = self._field.level(level)
        channels = {name: channel.of(field.tree) for name, channel in self.channels.items()}
        texture = OctreeTexture(field.tree, channels, self.placement, self.bounds, self.metadata)
        texture._field = field
        return texture

    def save(self, path: str | os.PathLike[str], *, max_error: int = 0) -> None:
        """Write an ``.octex`` file, or an archive of it, ``.octz``; the same texture gives the same bytes.

        An ``.octex`` file is looked up where it lies. An archive has a third of its bytes or less, and is
        decoded when it is opened; what comes back is the same, bit for bit. With ``max_error``,
        0 … 255, the whole numbers of an archive's values may move by so many of their codes, averages too,
        each by itself; floats do not move.

        Raises ArgumentError for another ending, and for a ``max_error`` without an archive; TextureFileError
        for a tree that is not sound, of which no archive can be made; OutputError if the file cannot be
        written: what stood at ``path`` then still stands.
        """
        path = as_path(path)
        max_error = as_whole(max_error, "max_error", 0, 255)
        ending = path.suffix.lower()
        if ending not in (ENDING, ARCHIVE_ENDING):
            raise ArgumentError(f"{path}: a texture is saved as NAME{ENDING} or NAME{ARCHIVE_ENDING}")
        if max_error and ending == ENDING:
            raise ArgumentError(f"{path}: max_error is for archives, NAME{ARCHIVE_ENDING}")
        self._read_ahead()
        tensors, metadata = written(self._parts(), self._file)
        if ending == ENDING:
            container.write(path, tensors, metadata)
        else:
            from octex.archive.write import write

            write(path, tensors, metadata, max_error)

    def validate(self) -> None:
        """Prove that the tree is sound and the values are finite.

        Raises TextureFileError that names what is broken.
        """
        self._read_ahead()
        try:
            self.tree.validate()
            for name, channel in self.channels.items():
                if not channel.is_finite():
                    raise TextureFileError(f"channel {name!r} has values that are not finite")
        except TextureFileError as error:
            raise TextureFileError(f"{self._file.path}: {error}" if self._file else str(error)) from None

    def info(self) -> dict[str, Any]:
        """Describe the texture as numbers and strings, ready for JSON. Lengths are in the model's units.

        Reads no cell. ``bytes`` says where the bytes of its render file go; ``archive``, if it came from one,
        where those of that go.
        """
        return described(self._parts(), self._file)

    def _read_ahead(self) -> None:
        if self._file and self._file.mapping:
            container.read_ahead(self._file.mapping)

    def _parts(self) -> Parts:
        return Parts(self.tree, self.channels, self.placement, self.bounds, self.metadata)


def _as_bounds(bounds: npt.ArrayLike) -> Float64s:
    """Return the lowest and highest corner (2, 3), read-only, or raise ArgumentError."""
    most = float(np.finfo(np.float64).max)
    corners = as_reals(bounds, "bounds, two finite corners,", (2, 3), most=most)
    return locked(corners)


def as_metadata(metadata: Mapping[str, str] | None) -> dict[str, str]:
    """Return provenance, or raise ArgumentError for what is no text by name."""
    found: dict[str, str] = {}
    if metadata is not None:
        is_mapping = isinstance(metadata, Mapping)
        if not is_mapping or not all(isinstance(text, str) for pair in metadata.items() for text in pair):
            raise ArgumentError("metadata must map strings to strings")
        found = dict(metadata)
    return found


def as_texture(texture: OctreeTexture, name: str = "texture") -> OctreeTexture:
    """Return a texture, or raise ArgumentError for anything else."""
    if not isinstance(texture, OctreeTexture):
        raise ArgumentError(f"{name} must be an octex.OctreeTexture, not {texture!r}")
    return texture


def _received(
    parts: tuple[Any, ...], others: tuple[str, dict[str, Array], dict[str, str]] | None
) -> OctreeTexture:
    """Make the texture that was pickled, or copied, anew."""
    texture = OctreeTexture(*parts)
    if others is not None:
        path, tensors, metadata = others
        texture._file = File(path, None, tensors, metadata)
    return texture


def open_texture(
    path: str | os.PathLike[str], *, cache: str | os.PathLike[str] | None = None
) -> OctreeTexture:
    """Open an ``.octex`` file, or an archive, ``.octz``, whatever their names.

    The former is mapped: only its header is read, the rest when it is looked at. The latter is decoded whole:
    into memory, or from 256 MB on into a temporary file, whose pages need not stay in memory. If another
    program cuts a mapped file off, the system ends the process that reads it (SIGBUS): files should be
    replaced by new ones of the same name, as ``save`` does, and those that others write copied first.

    An address, ``https://…`` or any that fsspec knows (``pip install 'octex[remote]'``; what else it needs,
    like s3fs for ``s3://…``, is your own to install), is opened by parts: ``sample``, ``taps`` and
    ``contains`` fetch the blocks of the file that they read, by range requests, ``level`` the coarse levels,
    all else what it asks for whole. Of an archive come the structure of the levels looked at, and blocks of
    what they hold, which are decoded into memory. What is fetched stays in a temporary file, or in the folder
    ``cache``, where the next process finds them as long as the file has not changed.

    Raises TextureFileError for a file that is missing, damaged, of another type or of a newer version, and,
    also later, for an address that cannot be read any more, or whose file has changed; OutputError if there
    is no place for what is fetched; ArgumentError for a ``cache`` without an address.
    """
    if is_address(path):
        from octex.texture.remote import open_remote

        return open_remote(str(path), None if cache is None else as_path(cache, "cache"))
    if cache is not None:
        raise ArgumentError("cache is for addresses, like https://…; files here need none")
    path = as_path(path)
    if os.path.isdir(path):  # noqa: PTH112  # a name too long is none, and no error
        raise TextureFileError(f"{path}: is a folder; octex.TextureSet.open opens a texture set")
    mapping: mmap.mmap | None = None
    sizes: dict[str, int] | None = None
    if is_archive(path):
        from octex.archive.read import read

        archived = read(path)
        tensors, metadata, sizes = dict(archived.tensors), dict(archived.metadata), archived.sizes
    else:
        contents = container.read(path)
        mapping, tensors, metadata = contents.mapping, dict(contents.tensors), dict(contents.metadata)
    try:
        texture = OctreeTexture(*taken(tensors, metadata))
    except InputError as error:
        raise TextureFileError(f"{path}: {error}") from error
    texture._file = File(str(path), mapping, tensors, metadata, sizes)
    return texture
