"""OctreeTexture: a tree, channels of values and a placement."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, Unpack, overload

import numpy as np
import numpy.typing as npt

from octex import container
from octex.arrays import Bools, Float32s, Float64s, Int64s
from octex.channels import decode
from octex.checks import as_choice, as_depth, as_flag, as_path, as_reals, as_row_numbers, as_whole, locked
from octex.errors import ArgumentError, InputError, TextureFileError
from octex.field.blend import joined
from octex.field.field import Field
from octex.field.taps import TapList
from octex.parallel import DEFAULT, Run, as_run, built_once
from octex.texture.channel import Channel, as_channels
from octex.texture.file import ARCHIVE_ENDING, ENDING, Storage, are_texts, contents_of, info_of, take_parts
from octex.texture.lookup import (
    ANISOTROPY,
    BLEED_THRESHOLD,
    LEAST_SORTED,
    Answers,
    FootprintOptions,
    Inputs,
    LookUp,
    LookupOptions,
    Lookups,
    Names,
    Request,
    SurfacePoints,
    checked_request,
    each_block,
    in_blocks,
    in_space,
    points_with_normals,
)
from octex.texture.spans import Spans, add_reads, cells_of, lookup_reads, nodes_read
from octex.tree.octree import Octree
from octex.tree.placement import Placement

#: Default of ``sample`` for blur and for sharpness.
_NONE = 0.0
#: Leaves from which on each read waits for memory or the disk: points are then sorted, 1.7 times as fast for
#: 234 M leaves. For 15 M it makes no difference.
_MANY_LEAVES = 1 << 26


class OctreeTexture:
    """An octree texture: values in the cells that a surface passes through, sampled by rest position.

    tree        the octree
    channels    the stored values by name, as read-only arrays
    placement   where the root cell lies
    bounds      of the surface, at rest
    metadata    provenance: free text by name, stored in the file

    A texture is immutable, and can be pickled and copied, also one that is mapped from a file. Arrays that
    you pass in are not copied. Raises ArgumentError if tree, channels, placement and bounds do not fit
    together.
    """

    def __init__(
        self,
        tree: Octree,
        channels: Mapping[str, Channel],
        placement: Placement,
        bounds: npt.ArrayLike,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.placement = Placement.checked(placement)
        most = float(np.finfo(np.float64).max)
        self.bounds: Float64s = locked(as_reals(bounds, "bounds, two finite corners,", (2, 3), most=most))
        self.metadata = MappingProxyType(as_metadata(metadata))
        self._set_parts(tree, as_channels(channels, tree), Storage())

    def _set_parts(self, tree: Octree, channels: Mapping[str, Channel], storage: Storage) -> None:
        self.tree, self.storage = tree, storage
        self.channels = MappingProxyType(dict(channels))

    def with_cells(
        self, tree: Octree, channels: Mapping[str, Channel], metadata: Mapping[str, str] | None = None
    ) -> OctreeTexture:
        """Return a texture of another tree and its channels, with this one's placement and bounds.

        ``metadata`` is its provenance, by default this one's. Raises ArgumentError if tree and channels do
        not fit together.
        """
        texture = self._with_parts(tree, as_channels(channels, tree), Storage())
        if metadata is not None:
            texture.metadata = MappingProxyType(as_metadata(metadata))
        return texture

    def _with_parts(self, tree: Octree, channels: Mapping[str, Channel], storage: Storage) -> OctreeTexture:
        """Return a texture like ``with_cells``, of parts that fit together."""
        texture = object.__new__(OctreeTexture)
        texture.placement, texture.bounds, texture.metadata = self.placement, self.bounds, self.metadata
        texture._set_parts(tree, channels, storage)
        return texture

    def __repr__(self) -> str:
        return f"<OctreeTexture of {', '.join(self.channels) or 'no channels'}; {self.tree!r}>"

    def __reduce__(self) -> tuple[Any, ...]:
        whole = self.storage.load_all(self)
        parts = whole.tree, dict(whole.channels), self.placement, self.bounds, dict(self.metadata)
        return OctreeTexture, parts, (whole.storage.path, None, whole.storage.tensors, whole.storage.metadata)

    def __setstate__(self, storage: tuple[Any, ...]) -> None:
        self.storage = Storage(*storage)

    @built_once
    def _lookups(self) -> Lookups:
        return Lookups(self.tree, self.channels, self.placement)

    @property
    def _field(self) -> Field:
        field: Field = self._lookups.field
        return field

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays: structure, flags, areas, values, and those of split cells and kept nodes."""
        loaded = self.storage.loaded(self)
        return loaded.tree.nbytes + sum(channel.nbytes for channel in loaded.channels.values())

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
        channel: Names = "base_color",
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
        run: Run | None = None,
    ) -> Any:
        """Sample channels at rest positions (n, 3), or at points that ``Surface.scatter`` returns.

        filter           "quadratic": a spline over 3×3×3 cells, smooth across changes of depth (paper 3.4);
                         "quartic": over 5×5×5; "linear": the paper's rule, which jumps where the depth
                         changes; "nearest": the leaf at the point, else the nearest of 27 cells
        width            side of the square to average over, in the model's units: one number, or (n,)
        dPdx, dPdy       instead of a width, (n, 3): derivatives of rest positions by an image's x and y
        anisotropy       largest ratio of a footprint's length to its width, up to 256; narrower ones are
                         widened
        blur             widens both sides of a footprint by this
        sharpness        0 … 1: sharpens footprints; results may leave the range of the stored values
        normals          shading normals (n, 3) in rest space: surface that faces away has no weight. Points
                         of ``Surface.scatter`` have their own
        bleed_threshold  for footprints without normals (paper 3.5.2): where the opposite sides of a coarse
                         cell differ by this much, use finer cells
        normalize        return unit vectors for directions; False: stored means, shorter where directions
                         vary
        gradient         also return derivatives by rest position (n, components, 3); not for "nearest"
        out              write into these C-ordered float32 arrays: one, a dict, or a pair of either
        run              how to work (octex.Run)

        Returns float32 (n, components), or a dict for a list of channels: linear light for colours, −1 … 1
        for directions, 0 … 1 for other integers. Values blend in linear light, weighted by ``alpha``. Every
        point has a value: off the surface that of a coarser level, outside the root cell that of the nearest
        point inside.

        In adaptive textures, a result may depend on the call's other points, by 10⁻⁶ of the values around.

        Raises ArgumentError for values that are not finite, with the first row (``out`` is then partly
        written), for unknown channels and filters, and for an ``out`` that does not fit.
        """
        if (
            (width is normals is dPdx is dPdy is out is None and threads is None and run is None)
            and (gradient is False and normalize is True and blur is sharpness is _NONE)
            and (anisotropy is ANISOTROPY and bleed_threshold is BLEED_THRESHOLD)
        ):
            answer = self._lookups.sample_few(points, channel, filter) if self.storage.is_local else None
            if answer is not None:
                return answer
        gradient, normalize = as_flag(gradient, "gradient"), as_flag(normalize, "normalize")
        request = checked_request(
            points, channel, filter, gradient, width, normals, dPdx, dPdy,
            anisotropy=anisotropy, blur=blur, sharpness=sharpness, bleed_threshold=bleed_threshold,
        )  # fmt: skip
        inputs, prepared = request.inputs, self
        answers = Answers(self._lookups.components, channel, inputs, gradient, out)
        if self.storage.path:  # not memory
            prepared = self.storage.prepare(self, len(inputs["points"]), lambda: request)
        lookups = prepared._lookups
        look_up: LookUp = partial(lookups.look_up, answers.channels, request.settings, normalize)
        how = DEFAULT if threads is None and run is None else as_run(run, threads)
        task = inputs, answers.arrays, look_up, how
        is_crowded = inputs.keys() <= {"points", "normals"} and lookups.field.tiles is None
        if len(answers.channels) > 2 or filter == "quartic":  # most of the time is waiting for memory
            in_space(*task, self.placement, LEAST_SORTED)
        elif lookups.field.n_leaves >= _MANY_LEAVES or is_crowded:
            in_space(*task, self.placement)
        else:
            in_blocks(*task)
        return answers.returned

    def taps(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: str = "base_color",
        filter: str = "quadratic",
        *,
        threads: int | None = None,
        run: Run | None = None,
        **options: Unpack[FootprintOptions],
    ) -> TapList:
        """List the taps of ``sample`` at rest positions (n, 3): the stored values that it reads, and weights.

        Returns a sparse matrix: ``starts`` (n + 1,) int64, ``rows`` (taps,) int64, each once per point, and
        ``weights`` (taps,) float32, which sum to 1 per point. Weights times ``rows(channel)`` is what
        ``sample`` returns with ``normalize=False``. With scipy:

            taps = texture.taps(points)
            values = texture.rows("base_color")
            blend = scipy.sparse.csr_array((taps.weights, taps.rows, taps.starts), (n, len(values)))
            colors = blend @ values  # (n, 3); solving this for values fits a texture to colours

        Taps of channels differ where alpha weights them, and for footprints without normals where front and
        back differ. "nearest" has one tap per point, except in footprints. All other arguments are those of
        ``sample``.

        Raises ArgumentError as ``sample`` does.
        """
        request = checked_request(points, channel, filter, **options)
        as_choice(channel, self.channels, "channel")
        prepared = self.storage.prepare(self, len(request.inputs["points"]), lambda: request)
        list_taps = partial(prepared._lookups.list_taps, channel, request.settings)
        blocks = each_block(request.inputs, [], list_taps, as_run(run, threads))
        taps = joined([TapList(*arrays) for _, arrays in blocks])
        return taps._replace(rows=taps.rows.astype(np.int64))

    def rows(self, channel: str = "base_color", numbers: npt.ArrayLike | None = None) -> Float32s:
        """Return a channel's stored values (rows, components), float32, in the units of ``sample``.

        The rows are: cells, in the order of their numbers; kept nodes; facings of split cells. ``numbers``
        (n,) selects rows. Raises ArgumentError for an unknown channel and for rows out of range.
        """
        chosen = self.channels[as_choice(channel, self.channels, "channel")]
        parts = chosen.values, chosen.kept_values, chosen.split_values
        if numbers is not None:
            return decode(chosen.rows(as_row_numbers(numbers, sum(map(len, parts)))), chosen.format.space)
        return decode(np.concatenate(parts), chosen.format.space)

    def blocks(
        self,
        points: npt.ArrayLike | SurfacePoints,
        channel: Names = "base_color",
        filter: str = "quadratic",
        *,
        block_size: int = 1 << 16,
        **options: Unpack[FootprintOptions],
    ) -> Int64s:
        """List the bytes of the texture's file that ``sample`` will read for these points.

        Returns begins and ends of runs of blocks (n, 2), int64, ascending and disjoint. A block has
        ``block_size`` bytes, counted from the file's start; the last may be shorter. A file with only these
        bytes, and zeros elsewhere, opens and gives the same results. To find out, octex reads the tree's
        structure down to the level that is asked for, at most a fifth of the file, and, for footprints
        without normals, the values of split cells. All other arguments are those of ``sample``.

        Raises ArgumentError as ``sample`` does, and for a texture without a file.
        """
        block_size = as_whole(block_size, "block_size", 1, 1 << 40)
        mapping = self.storage.loaded(self).storage.mapping
        if mapping is None:
            raise ArgumentError("the texture has no file: save it and open that")
        request = checked_request(points, channel, filter, **options)
        prepared = self.storage.prepare(self, 0, lambda: request)
        spans, reads = Spans(mapping, block_size), lookup_reads(prepared, request)
        for nodes in nodes_read(prepared.tree, cells_of(reads.values()), filter):
            spans.nodes(prepared.tree.arrays.groups, nodes)
        add_reads(prepared, reads, request, spans)
        return spans.ranges()

    def contains(
        self, points: npt.ArrayLike | SurfacePoints, *, threads: int | None = None, run: Run | None = None
    ) -> Bools:
        """Return for each rest position (n, 3) whether a leaf holds it.

        ``run`` says how to work (octex.Run). Raises ArgumentError for positions that are not finite (n, 3).
        """
        inputs: Inputs = {"points": points_with_normals(points)[0]}
        inside = np.empty(len(inputs["points"]), np.bool_)
        prepared = self.storage.prepare(self, len(inside), lambda: Request(inputs))
        in_blocks(inputs, [inside], prepared._lookups.contain, as_run(run, threads))
        return inside

    def level(self, level: int) -> OctreeTexture:
        """Return the texture of levels 0 … ``level``: its leaves hold the averages stored there.

        Its arrays are views; nothing deeper is read. Raises ArgumentError for a level outside of 0 … 21.
        """
        if as_depth(level, "level") >= self.tree.max_depth:
            return self
        loaded = self.storage.load_levels(self, level)
        field = loaded._field.level(level)
        channels = {name: channel.of(field.tree) for name, channel in loaded.channels.items()}
        texture = OctreeTexture(field.tree, channels, self.placement, self.bounds, self.metadata)
        texture._lookups.field = field
        return texture

    def save(self, path: str | os.PathLike[str], *, max_error: int = 0) -> None:
        """Write an ``.octex`` file, or a compressed ``.octz``; the same texture gives the same bytes.

        An ``.octex`` file is memory-mapped when opened. An ``.octz`` has a third of the bytes or less;
        opening it decodes the same bits. ``max_error``, 0 … 255, lets each stored integer of an ``.octz``
        change by this much.

        The file is replaced completely or not at all. Raises ArgumentError for another ending, and for a
        ``max_error`` without ``.octz``; TextureFileError for a damaged tree; OutputError if the file cannot
        be written.
        """
        path = as_path(path)
        max_error = as_whole(max_error, "max_error", 0, 255)
        ending = path.suffix.lower()
        if ending not in (ENDING, ARCHIVE_ENDING):
            raise ArgumentError(f"{path}: a texture is saved as NAME{ENDING} or NAME{ARCHIVE_ENDING}")
        if max_error and ending == ENDING:
            raise ArgumentError(f"{path}: max_error is for archives, NAME{ARCHIVE_ENDING}")
        tensors, metadata = contents_of(self.storage.load_all(self))
        if ending == ENDING:
            container.write(path, tensors, metadata)
        else:
            from octex.archive.write import write

            write(path, tensors, metadata, max_error)

    def validate(self) -> None:
        """Check that the tree is sound and all values are finite.

        Raises TextureFileError that names the fault.
        """
        whole, path = self.storage.load_all(self), self.storage.path
        try:
            whole.tree.validate()
            for name, channel in whole.channels.items():
                if not channel.is_finite():
                    raise TextureFileError(f"channel {name!r} has values that are not finite")
        except TextureFileError as error:
            raise TextureFileError(f"{path}: {error}" if path else str(error)) from None

    def info(self) -> dict[str, Any]:
        """Describe the texture as numbers and strings for JSON; lengths are in the model's units.

        ``bytes`` lists the sizes of the file's parts; ``archive`` those of the ``.octz`` that it came from.
        """
        return info_of(self.storage.loaded(self))


def as_metadata(metadata: Mapping[str, str] | None) -> dict[str, str]:
    """Return provenance, or raise ArgumentError for anything but strings by name."""
    if metadata is not None and not are_texts(metadata):
        raise ArgumentError("metadata must map strings to strings")
    return dict(metadata or {})


def as_texture(texture: OctreeTexture, name: str = "texture") -> OctreeTexture:
    """Return a texture, or raise ArgumentError for anything else."""
    if not isinstance(texture, OctreeTexture):
        raise ArgumentError(f"{name} must be an octex.OctreeTexture, not {texture!r}")
    return texture


def texture_of(storage: Storage) -> OctreeTexture:
    """Return the texture of a storage, which retains unknown entries."""
    try:
        texture = OctreeTexture(*take_parts(storage.tensors, storage.metadata))
    except InputError as error:
        raise TextureFileError(f"{storage.path}: {error}") from error
    texture.storage = storage
    return texture
