"""Lookups: checks arguments; runs blocks on threads; writes the results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple, Protocol, TypedDict

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s, Floats, Uint8s
from octex.checks import as_array, as_choice, as_number, as_point_rows
from octex.errors import ArgumentError
from octex.field.field import Field, NotFiniteError
from octex.field.footprints import ROUND, Footprints, long_footprints
from octex.field.lookups import ChannelRows, Listing, Lookup, Query, Reads
from octex.field.splines import FILTERS
from octex.parallel import Run, ordered_map, workers
from octex.texture.channel import NO_GRADIENTS, Channel, make_unit, mixed_cells, stored
from octex.tree.octree import Octree
from octex.tree.placement import Placement
from octex.tree.search import Positions, in_leaves, order_in_space, put_rows

#: Difference of a front and a back, of 1, that footprints without normals may mix.
BLEED_THRESHOLD = 1 / 32

#: Default of the largest ratio of a footprint's length to its width.
ANISOTROPY = 16.0

#: One channel by name, or several.
Names = str | list[str] | tuple[str, ...]
#: Arrays with a row for each point by name, "points" (n, 3) among them.
Inputs = Mapping[str, Array]
#: Looks up the points of a block and writes to arrays of as many rows. Raises NotFiniteError.
LookUp = Callable[[Inputs, list[Array]], None]

#: Points looked up at once: they fit the processor's cache, and take a thread a millisecond or more, compared
#: with 50 µs to hand them over.
BLOCK = 1 << 16
#: Most points sorted at once: their inputs and answers are copied.
_SORTED = 1 << 19
#: Most points that are not sorted for lookups that read much.
LEAST_SORTED = 1 << 12
#: Most points of the short path, and their types.
_FEW = 64
_TAKEN = {np.dtype(np.float32), np.dtype(np.float64)}


class FootprintOptions(TypedDict, total=False):
    """Options of footprints: see `OctreeTexture.sample`."""

    width: npt.ArrayLike | None
    normals: npt.ArrayLike | None
    dPdx: npt.ArrayLike | None
    dPdy: npt.ArrayLike | None
    anisotropy: float
    blur: float
    sharpness: float
    bleed_threshold: float


class LookupOptions(FootprintOptions, total=False):
    """Options of lookups: see `OctreeTexture.sample`."""

    normalize: bool
    threads: int | None
    run: Run | None


class SurfacePoints(Protocol):
    """Points of a surface, as ``Surface.scatter`` returns them; or your renderer's record of hits."""

    @property
    def rest(self) -> npt.ArrayLike:
        """Rest positions (n, 3). Normals come with them as ``rest_normals``, else ``normals``."""


def points_with_normals(
    points: npt.ArrayLike | SurfacePoints, normals: npt.ArrayLike | None = None
) -> tuple[Array, npt.ArrayLike | None]:
    """Return rest positions (n, 3), and normals: the argument, else those of the points.

    Raises ArgumentError for anything but positions.
    """
    if not hasattr(points, "rest"):
        return as_point_rows(points), normals
    if normals is None:
        normals = getattr(points, "rest_normals", getattr(points, "normals", None))
    return as_point_rows(points.rest, "points' rest"), normals


class Settings(NamedTuple):
    """Options shared by all points of a lookup; see `OctreeTexture.sample`."""

    filter: str
    anisotropy: float = ANISOTROPY
    blur: float = 0.0
    sharpness: float = 0.0
    bleed_threshold: float = BLEED_THRESHOLD

    def query(self, inputs: Inputs) -> Query:
        """Return the query of a block of points, with arrays as kernels take them."""
        footprints: Footprints | None = None
        if "dPdx" in inputs:
            shape = map(float, (self.blur, self.anisotropy, self.sharpness))
            footprints = long_footprints(inputs["dPdx"], inputs["dPdy"], *shape)
        elif "width" in inputs or self.blur > 0:
            widths = np.full(len(inputs["points"]), float(self.blur))
            if "width" in inputs:
                widths += inputs["width"]
            footprints = ROUND._replace(widths=widths, sharpness=self.sharpness)
        normals = inputs.get("normals")
        if normals is not None:
            most = np.finfo(np.float32).max
            normals = np.clip(normals, -most, most).astype(np.float32, copy=False)
        return Query(self.filter, footprints, normals)


class Request(NamedTuple):
    """A lookup's inputs, channels and settings."""

    inputs: Inputs
    channel: Names | None = None  # None: whether leaves hold them
    settings: Settings = Settings("nearest")

    @property
    def has_footprints(self) -> bool:
        """Whether points are looked up with footprints."""
        return "width" in self.inputs or "dPdx" in self.inputs or self.settings.blur > 0


def checked_request(
    points: npt.ArrayLike | SurfacePoints,
    channel: Names,
    filter: str,
    gradient: bool = False,
    /,
    width: npt.ArrayLike | None = None,
    normals: npt.ArrayLike | None = None,
    dPdx: npt.ArrayLike | None = None,
    dPdy: npt.ArrayLike | None = None,
    **options: Any,
) -> Request:
    """Return a lookup's arguments, checked but for the channel; see `OctreeTexture.sample`."""
    positions, normals = points_with_normals(points, normals)
    settings, inputs = Settings(filter, **options), {"points": positions}
    as_choice(settings.filter, FILTERS, "filter")
    if gradient and settings.filter == "nearest":
        raise ArgumentError(f"nearest has no gradient; {', '.join(FILTERS[1:])} have one")
    as_number(settings.anisotropy, "anisotropy", 1.0, 256.0)
    as_number(settings.blur, "blur", 0.0, float(np.finfo(np.float64).max))
    as_number(settings.sharpness, "sharpness", 0.0, 1.0)
    as_number(settings.bleed_threshold, "bleed_threshold", 0.0, np.inf)
    n = len(positions)
    optional = {"normals": normals, "width": width, "dPdx": dPdx, "dPdy": dPdy}
    for name, array in optional.items():
        if array is None:
            continue
        if name == "width":
            widths = as_array(array)
            if widths.dtype.kind not in "fiu" or widths.shape not in ((), (n,)):
                shape = f"{widths.dtype} {widths.shape}"
                raise ArgumentError(f"width must be a real number or (n,) of them, not {shape}")
            inputs[name] = np.broadcast_to(widths, (n,))
        else:
            inputs[name] = as_point_rows(array, name)
            if len(inputs[name]) != n:
                raise ArgumentError(f"{name} must have a row for each of {n} points, not {len(inputs[name])}")
    if ("dPdx" in inputs) != ("dPdy" in inputs):
        raise ArgumentError("dPdx and dPdy are given together or not at all")
    if "width" in inputs and "dPdx" in inputs:
        raise ArgumentError("a footprint has a width, or dPdx and dPdy, not both")
    request = Request(inputs, channel, settings)
    if settings.sharpness > 0 and not request.has_footprints:
        raise ArgumentError("sharpness is for footprints: give a width, or dPdx and dPdy, or blur")
    if settings.anisotropy != ANISOTROPY and "dPdx" not in inputs:
        raise ArgumentError("anisotropy is for footprints longer than wide: give dPdx and dPdy")
    if settings.bleed_threshold != BLEED_THRESHOLD and ("normals" in inputs or not request.has_footprints):
        raise ArgumentError(
            "bleed_threshold is for footprints without normals: leave it out, or give a width, or dPdx "
            "and dPdy, or blur, and no normals"
        )
    return request


#: An input's name, and its first unusable row.
_Fault = tuple[str, int]


class _InputBlock(NamedTuple):
    """The inputs of a block of points, and rows for its results, which other processes allocate."""

    inputs: Inputs
    answers: list[Array]

    @classmethod
    def empty(cls, inputs: Inputs, answers: list[tuple[tuple[int, ...], np.dtype[Any]]]) -> _InputBlock:
        """Return a block with room for results of these shapes and types."""
        return cls(inputs, [np.empty(*each) for each in answers])

    def __reduce__(self) -> tuple[Any, ...]:
        return _InputBlock.empty, (self.inputs, [(each.shape, each.dtype) for each in self.answers])


def in_blocks(inputs: Inputs, answers: list[Array], look_up: LookUp, run: Run) -> None:
    """Look up points, of any real type, and write to ``answers``, arrays of n rows.

    A block is copied only if kernels cannot take it as it is. Raises ArgumentError naming the first row that
    is not finite, or a negative width; the answers are then partly written.
    """
    if run.threads is None and run.executor is None and 0 < len(inputs["points"]) <= BLOCK:  # in one piece
        fault, _ = _checked_block(look_up, _InputBlock(inputs, answers))
        if fault is not None:
            _refuse(fault, 0, inputs)
        return
    for begin, block_answers in each_block(inputs, answers, look_up, run):
        for answer, rows in zip(answers, block_answers, strict=True):
            target = answer[begin : begin + BLOCK]
            if not np.may_share_memory(target, rows):  # the executor works in other processes
                target[:] = rows


def each_block(
    inputs: Inputs, answers: list[Array], look_up: LookUp, run: Run
) -> Iterator[tuple[int, list[Array]]]:
    """Look up points like ``in_blocks``; yield each block's begin, and its rows of the answers.

    After these rows come the arrays that ``look_up`` appends.
    """
    begins, blocks = range(0, len(inputs["points"]), BLOCK), []
    for begin in begins:
        rows = slice(begin, begin + BLOCK)
        block_inputs = {name: array[rows] for name, array in inputs.items()}
        blocks.append(_InputBlock(block_inputs, [answer[rows] for answer in answers]))
    with workers(run, len(blocks)) as pool:
        results = ordered_map(pool, partial(_checked_block, look_up), blocks)
        for begin, (fault, block_answers) in zip(begins, results, strict=True):
            if fault is not None:
                _refuse(fault, begin, inputs)
            yield begin, block_answers


def in_space(
    inputs: Inputs, answers: list[Array], look_up: LookUp, run: Run, placement: Placement, least: int = 0
) -> None:
    """Look points up like ``in_blocks``, sorted in Morton order unless they already nearly are.

    This is for lookups that read much, or where close points share most of the work. At most ``least``
    points, by default a block, are looked up unsorted.
    """
    try:
        for begin in range(0, len(inputs["points"]), _SORTED):
            rows = slice(begin, begin + _SORTED)
            part_inputs = {name: array[rows] for name, array in inputs.items()}
            part_answers = [answer[rows] for answer in answers]
            numbers = None
            if len(part_inputs["points"]) > (least or BLOCK):
                part_inputs["points"] = _as_kernels_take_it(part_inputs["points"])
                numbers = order_in_space(Positions.of(part_inputs["points"]), *placement)
            if numbers is None or not numbers.size:
                in_blocks(part_inputs, part_answers, look_up, run)
                continue
            sorted_inputs = {name: np.take(array, numbers, axis=0) for name, array in part_inputs.items()}
            sorted_answers = [np.empty(answer.shape, answer.dtype) for answer in part_answers]
            in_blocks(sorted_inputs, sorted_answers, look_up, run)
            for answer, sorted_answer in zip(part_answers, sorted_answers, strict=True):
                values, target = (array.reshape(len(array), -1) for array in (sorted_answer, answer))
                put_rows(values, numbers, target)
    except ArgumentError:
        in_blocks(inputs, answers, look_up, run)  # which names the first row
        raise


def _refuse(fault: _Fault, begin: int, inputs: Inputs) -> None:
    """Raise ArgumentError for a fault in the block that begins at a row."""
    name, row = fault[0], begin + fault[1]
    kind = "finite and not below zero" if name == "width" else "finite"
    raise ArgumentError(f"{name} must be {kind}, but {name}[{row}] is {inputs[name][row].tolist()}")


def _checked_block(look_up: LookUp, block: _InputBlock) -> tuple[_Fault | None, list[Array]]:
    inputs, answers = block
    block_inputs: dict[str, Array] = {}
    for name, array in inputs.items():
        block_inputs[name] = array = _as_kernels_take_it(array)
        if name == "points":  # checked as they are placed
            continue
        is_valid = np.isfinite(array)
        if name == "width":
            is_valid = is_valid & (array >= 0)
        if not is_valid.all():
            return (name, int(np.argmin(is_valid)) // (array.size // len(array))), answers
    try:
        look_up(block_inputs, answers)
    except NotFiniteError as error:
        return ("points", error.row), answers
    return None, answers


def _as_kernels_take_it(array: Array) -> Array:
    if array.dtype in (np.float32, np.float64) and array.flags.c_contiguous and array.flags.aligned:
        return array
    return np.require(array, np.float32 if array.dtype == np.float32 else np.float64, ["C", "A"])


class Answers:
    """Arrays for the values of channels, and for their gradients if wanted.

    ``components`` are those of all channels by name; for ``channel``, ``gradient`` and ``out`` see
    `OctreeTexture.sample`. Raises ArgumentError for arguments that do not fit.
    """

    def __init__(
        self, components: Mapping[str, int], channel: Names, inputs: Inputs, gradient: bool, out: Any
    ) -> None:
        is_single = isinstance(channel, str)
        shapes: dict[str, tuple[int, ...]] = {}
        slopes: dict[str, tuple[int, ...]] = {}
        for name in channel if isinstance(channel, (list, tuple)) else (channel,):
            as_choice(name, components, "channel")
            shapes[name] = len(inputs["points"]), components[name]
            slopes[name] = *shapes[name], 3
        #: The channels, each once.
        self.channels = list(shapes)
        is_given, out_gradients = out is not None, None
        if gradient and out is not None:
            if not isinstance(out, (tuple, list)) or len(out) != 2:
                raise ArgumentError("out must be a pair, for values and for gradients")
            out, out_gradients = out
        values = _answers_for(shapes, out, is_single)
        gradients = _answers_for(slopes, out_gradients, is_single, "the gradients' out") if gradient else {}
        #: The values of each channel, then the gradients of each.
        self.arrays: list[Array] = [*values.values(), *gradients.values()]
        arrays = list(inputs.values())
        for answer in self.arrays if is_given else ():
            if any(np.may_share_memory(answer, other) for other in arrays):
                raise ArgumentError(
                    "the arrays in out must not share memory with each other or with the points"
                )
            arrays.append(answer)
        #: What `OctreeTexture.sample` returns.
        self.returned: Any = (values, gradients) if gradient else values
        if is_single:
            self.returned = tuple(self.arrays) if gradient else self.arrays[0]


def _answers_for(
    shapes: Mapping[str, tuple[int, ...]], out: Any, single: bool, name: str = "out"
) -> dict[str, Float32s]:
    """Return arrays by channel: new ones, or the checked ``out``, one array if ``single``, else a dict."""
    if out is None:
        new: dict[str, Float32s] = {}
        for channel, shape in shapes.items():
            new[channel] = np.empty(shape, np.float32)
        return new
    if single:
        out = dict.fromkeys(shapes, out)
    elif not isinstance(out, Mapping) or set(out) != set(shapes):
        raise ArgumentError(f"{name} must be a dict of arrays for: {', '.join(shapes)}")
    for channel, shape in shapes.items():
        array = out[channel]
        if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.shape != shape:
            kind = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else repr(type(array))
            raise ArgumentError(
                f"{name} for {channel!r} must be a float32 array of shape {shape}, not {kind}"
            )
        if not array.flags.carray:
            raise ArgumentError(f"{name} for {channel!r} must be C-ordered, aligned and writable")
    return {channel: out[channel] for channel in shapes}


class Lookups:
    """Lookups of a texture: its channels in readable form, and indices built for them."""

    def __init__(self, tree: Octree, channels: Mapping[str, Channel], placement: Placement) -> None:
        self.field = Field(tree)
        self.components = {name: channel.format.components for name, channel in channels.items()}
        self._tree, self._channels, self._placement = tree, channels, placement
        self._mixed: dict[tuple[str, int], tuple[float, Uint8s]] = {}
        self._few: dict[tuple[str, str], Callable[[Floats], Float32s | None] | None] = {}
        self._stored: dict[str, ChannelRows] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Lookups, (self._tree, dict(self._channels), self._placement)

    def sample_few(self, points: Any, channel: Any, filter: Any) -> Float32s | dict[str, Float32s] | None:
        """Look up at most 64 points of leaves by a short path; None where it does not apply.

        A call with one point takes a third of the time this way.
        """
        if type(points) is not np.ndarray or points.ndim != 2 or not 0 < len(points) <= _FEW:
            return None
        flags = points.flags
        is_taken = points.dtype in _TAKEN and flags.c_contiguous and flags.aligned
        if not (is_taken and points.shape[1] == 3 and type(filter) is str):
            return None
        is_list = type(channel) in (list, tuple)
        values: dict[str, Float32s] = {}
        for name in channel if is_list else (channel,):
            if type(name) is not str:
                return None
            key = name, filter
            if key not in self._few:
                if name not in self._channels or filter not in FILTERS:
                    return None
                few = None
                if self._channels[name].format.space != "direction":  # those are made unit vectors
                    (read,), alpha = self.rows_of(name)
                    few = Lookup(self.field, self._placement, Query(filter), [read], alpha).prepare_few()
                self._few[key] = few
            look_up = self._few[key]
            value = None if look_up is None else look_up(points)
            if value is None:
                return None
            values[name] = value
        return (values or None) if is_list else values[channel]

    def look_up(
        self, names: list[str], settings: Settings, normalize: bool, inputs: Inputs, answers: list[Array]
    ) -> None:
        """Look up a block, as a LookUp: write its values to ``answers``, and as many gradients if wanted."""
        if not names:
            return
        values, gradients = answers[: len(names)], answers[len(names) :]
        read, alpha = self.rows_of(*names)
        groups = [(names[0], slice(None))]
        if self.query(settings, inputs, names[0]).mixed is not None:  # mixed cells differ by channel
            numbers = range(len(names) + 1)
            groups = list(zip(names, map(slice, numbers, numbers[1:]), strict=False))
        for name, group in groups:
            task = self.query(settings, inputs, name), read[group], alpha, values[group], gradients[group]
            Lookup(self.field, self._placement, *task).look_up(inputs["points"])
        for number, name in enumerate(names if normalize else ()):
            if self._channels[name].format.space == "direction":
                make_unit(values[number], gradients[number] if gradients else NO_GRADIENTS)

    def list_taps(self, name: str, settings: Settings, inputs: Inputs, answers: list[Array]) -> None:
        """Add the taps of a block to ``answers``, as a LookUp."""
        query, (read, alpha) = self.query(settings, inputs, name), self.rows_of(name)
        answers += Listing(self.field, self._placement, query, read, alpha).blends(inputs["points"])

    def list_reads(
        self, name: str, settings: Settings, reads: list[dict[int, Reads]], inputs: Inputs, _: list[Array]
    ) -> None:
        """Add the reads of a block, by level, to ``reads``, as a LookUp."""
        query, read = self.query(settings, inputs, name), self.rows_of(name)[0]
        reads.append(Listing(self.field, self._placement, query, read, None).reads(inputs["points"]))

    def contain(self, inputs: Inputs, answers: list[Array]) -> None:
        """Write whether leaves hold a block of points, as a LookUp."""
        fault = in_leaves(self._tree.arrays, Positions.of(inputs["points"]), *self._placement, answers[0])
        if fault >= 0:
            raise NotFiniteError(fault)

    def query(self, settings: Settings, inputs: Inputs, name: str) -> Query:
        """Return the query of a block of points for a channel."""
        query = settings.query(inputs)
        if query.footprints is not None and query.normals is None and self._tree.split.cells.size:
            query = query._replace(mixed=partial(self._mixed_cells, name, settings.bleed_threshold))
        return query

    def rows_of(self, *names: str) -> tuple[list[ChannelRows], ChannelRows | None]:
        """Return channels in readable form, and the alpha that weights them, if any."""
        rows: list[ChannelRows] = []
        for name in (*names, "alpha") if "alpha" in self._channels else names:
            if name not in self._stored:
                self._stored[name] = stored(self._channels[name])
            rows.append(self._stored[name])
        alpha = rows.pop() if len(rows) > len(names) else None
        return rows, alpha if alpha and alpha.is_alpha else None

    def _mixed_cells(self, name: str, threshold: float, level: int) -> Uint8s:
        cached = self._mixed.get((name, level))
        if cached is None or cached[0] != threshold:
            cached = threshold, mixed_cells(self._channels[name], self.field.level(level).tree, threshold)
            self._mixed[name, level] = cached
        return cached[1]
