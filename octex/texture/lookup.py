"""How points are looked up: what users ask for, checked; in blocks, on any threads; and where answers go."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple, Protocol, TypedDict

import numpy as np
import numpy.typing as npt

from octex.arrays import Array, Float32s
from octex.checks import as_array, as_choice, as_number, as_point_rows
from octex.errors import ArgumentError
from octex.field.field import NotFiniteError
from octex.field.footprints import ROUND, Footprints, long_footprints
from octex.field.lookups import Query
from octex.field.splines import FILTERS
from octex.parallel import ordered_map, workers
from octex.tree.order import order_in_space, put_rows
from octex.tree.placement import Placement
from octex.tree.search import Positions

#: Difference of a front and a back, of 1, that footprints without normals may mix.
BLEED_THRESHOLD = 1 / 32

#: How much longer than wide a footprint may be, if nobody says.
ANISOTROPY = 16.0

#: Most that a footprint may be longer than wide.
MOST_ANISOTROPY = 256.0

_MOST_BLUR = float(np.finfo(np.float64).max)

#: What is given of points: arrays of a row each by name, "points" (n, 3) among them.
Given = Mapping[str, Array]
#: Looks up the points of a block, writes to arrays of as many rows, and returns the first row of points that
#: is not finite or −1, or raises NotFiniteError.
LookUp = Callable[[Given, list[Array]], int]

#: Points looked up at once: what is kept of them stays in the processor's cache, and a thread that takes them
#: is busy for a millisecond or more, beside which handing them over (50 µs) is little.
BLOCK = 1 << 16
#: Most points sorted at once: what is given of them and their answers are copied meanwhile.
_SORTED = 1 << 19
#: Points that are looked up as they come, where more are sorted since lookups read much.
LEAST_SORTED = 1 << 12
_NO_NUMBERS = np.empty(0, np.int32)


class FootprintOptions(TypedDict, total=False):
    """What lookups average over: see `OctreeTexture.sample`."""

    width: npt.ArrayLike | None
    normals: npt.ArrayLike | None
    dPdx: npt.ArrayLike | None
    dPdy: npt.ArrayLike | None
    anisotropy: float
    blur: float
    sharpness: float
    bleed_threshold: float


class LookupOptions(FootprintOptions, total=False):
    """How points are looked at: see `OctreeTexture.sample`."""

    normalize: bool
    threads: int | None
    executor: Executor | None


class SurfacePoints(Protocol):
    """Points of a surface, as ``Surface.scatter`` returns them; or a record of hits of one's own."""

    @property
    def rest(self) -> npt.ArrayLike:
        """Rest positions (n, 3). Beside them are normals there: ``rest_normals``, else ``normals``."""


def placed(
    points: npt.ArrayLike | SurfacePoints, normals: npt.ArrayLike | None = None
) -> tuple[Array, npt.ArrayLike | None]:
    """Return rest positions (n, 3), and normals: those that are given, else those that points come with.

    Raises ArgumentError for what are no positions.
    """
    if not hasattr(points, "rest"):
        return as_point_rows(points), normals
    if normals is None:
        normals = getattr(points, "rest_normals", getattr(points, "normals", None))
    return as_point_rows(points.rest, "points' rest"), normals


class Lens(NamedTuple):
    """What is the same for all points of a lookup; see `OctreeTexture.sample`."""

    filter: str
    anisotropy: float = ANISOTROPY
    blur: float = 0.0
    sharpness: float = 0.0
    bleed_threshold: float = BLEED_THRESHOLD

    def has_footprints(self, given: Given) -> bool:
        """Say whether points are looked up with footprints."""
        return "width" in given or "dPdx" in given or self.blur > 0

    def query(self, given: Given) -> Query:
        """Return what is asked of a block of points, whose arrays are as kernels take them."""
        footprints: Footprints | None = None
        if "dPdx" in given:
            derivatives = given["dPdx"], given["dPdy"]
            footprints = long_footprints(*derivatives, self.blur, self.anisotropy, self.sharpness)
        elif "width" in given:
            widths = given["width"].astype(np.float64) + self.blur
            footprints = ROUND._replace(widths=widths, sharpness=self.sharpness)
        elif self.blur > 0:
            widths = np.full(len(given["points"]), float(self.blur))
            footprints = ROUND._replace(widths=widths, sharpness=self.sharpness)
        normals = given.get("normals")
        if normals is not None:
            most = np.finfo(np.float32).max
            normals = np.clip(normals, -most, most).astype(np.float32, copy=False)
        return Query(self.filter, footprints, normals)


def asked(
    points: npt.ArrayLike | SurfacePoints,
    filter: str,
    gradient: bool = False,
    /,
    width: npt.ArrayLike | None = None,
    normals: npt.ArrayLike | None = None,
    dPdx: npt.ArrayLike | None = None,
    dPdy: npt.ArrayLike | None = None,
    **options: Any,
) -> tuple[Lens, dict[str, Array]]:
    """Return what is asked of points, and what is given of each; see `OctreeTexture.sample`.

    Raises ArgumentError for what does not fit.
    """
    places, normals = placed(points, normals)
    lens, given = Lens(filter, **options), {"points": places}
    as_choice(lens.filter, FILTERS, "filter")
    if gradient and lens.filter == "nearest":
        raise ArgumentError(f"nearest has no gradient; {', '.join(FILTERS[1:])} have one")
    as_number(lens.anisotropy, "anisotropy", 1.0, MOST_ANISOTROPY)
    as_number(lens.blur, "blur", 0.0, _MOST_BLUR)
    as_number(lens.sharpness, "sharpness", 0.0, 1.0)
    as_number(lens.bleed_threshold, "bleed_threshold", 0.0, np.inf)
    n = len(places)
    shape = {"normals": normals, "width": width, "dPdx": dPdx, "dPdy": dPdy}
    for name, array in shape.items():
        if array is None:
            continue
        if name == "width":
            widths = as_array(array)
            if widths.dtype.kind not in "fiu" or widths.shape not in ((), (n,)):
                found = f"{widths.dtype} {widths.shape}"
                raise ArgumentError(f"width must be a real number or (n,) of them, not {found}")
            given[name] = np.broadcast_to(widths, (n,))
        else:
            given[name] = as_point_rows(array, name)
            if len(given[name]) != n:
                raise ArgumentError(f"{name} must have a row for each of {n} points, not {len(given[name])}")
    if ("dPdx" in given) != ("dPdy" in given):
        raise ArgumentError("dPdx and dPdy are given together or not at all")
    if "width" in given and "dPdx" in given:
        raise ArgumentError("a footprint has a width, or dPdx and dPdy, not both")
    if lens.sharpness > 0 and not lens.has_footprints(given):
        raise ArgumentError("sharpness is for footprints: give a width, or dPdx and dPdy, or blur")
    if lens.anisotropy != ANISOTROPY and "dPdx" not in given:
        raise ArgumentError("anisotropy is for footprints longer than wide: give dPdx and dPdy")
    if lens.bleed_threshold != BLEED_THRESHOLD and ("normals" in given or not lens.has_footprints(given)):
        raise ArgumentError(
            "bleed_threshold is for footprints without normals: leave it out, or give a width, or dPdx "
            "and dPdy, or blur, and no normals"
        )
    return lens, given


class _Fault(NamedTuple):
    name: str
    row: int


class _Block(NamedTuple):
    """What is given of some points, and the rows of their answers, which do not travel to other processes."""

    given: Given
    answers: list[Array]

    @classmethod
    def at(cls, begin: int, given: Given, answers: list[Array]) -> _Block:
        """Return the block whose first row is ``begin``."""
        rows = slice(begin, begin + BLOCK)
        return cls({name: array[rows] for name, array in given.items()}, [each[rows] for each in answers])

    @classmethod
    def empty(cls, given: Given, answers: list[tuple[tuple[int, ...], np.dtype[Any]]]) -> _Block:
        """Return a block with room for answers of some shapes and types."""
        return cls(given, [np.empty(*each) for each in answers])

    def __reduce__(self) -> tuple[Any, ...]:
        return _Block.empty, (self.given, [(each.shape, each.dtype) for each in self.answers])


def in_blocks(
    given: Given, answers: list[Array], look_up: LookUp, threads: int | None, executor: Executor | None
) -> None:
    """Look up points by what is given of them, of any real type, and write to ``answers``, arrays of n rows.

    Only a block is copied, and only if it is not as kernels take it. Raises ArgumentError naming the first
    row that is not finite, or a width that is below zero; the answers are then written in part.
    """
    if threads is None and executor is None and 0 < len(given["points"]) <= BLOCK:  # nothing to hand over
        fault, _ = _checked_block(look_up, _Block(given, answers))
        if fault is not None:
            _refuse(fault, 0, given)
        return
    for begin, found in each_block(given, answers, look_up, threads, executor):
        for answer, rows in zip(answers, found, strict=True):
            here = answer[begin : begin + BLOCK]
            if not np.may_share_memory(here, rows):  # the executor works in other processes
                here[:] = rows


def each_block(
    given: Given, answers: list[Array], look_up: LookUp, threads: int | None, executor: Executor | None
) -> Iterator[tuple[int, list[Array]]]:
    """Look up points like ``in_blocks``; yield where each block begins, and its rows of the answers.

    These are followed by what ``look_up`` adds to the list of answers that it is given.
    """
    begins = range(0, len(given["points"]), BLOCK)
    blocks = [_Block.at(begin, given, answers) for begin in begins]
    with workers(threads, executor, len(blocks)) as pool:
        results = ordered_map(pool, partial(_checked_block, look_up), blocks)
        for begin, (fault, found) in zip(begins, results, strict=True):
            if fault is not None:
                _refuse(fault, begin, given)
            yield begin, found


def in_space(
    given: Given,
    answers: list[Array],
    look_up: LookUp,
    threads: int | None,
    executor: Executor | None,
    placement: Placement,
    least: int = 0,
) -> None:
    """Look points up as ``in_blocks`` does, where they do not come in an order like that of space in this.

    That is for lookups that read much, or in which points that lie close together share most of the work.
    Points that are no more than ``least``, by default than a block, are looked up as they come.
    """
    try:
        for begin in range(0, len(given["points"]), _SORTED):
            rows = slice(begin, begin + _SORTED)
            here = {name: array[rows] for name, array in given.items()}
            there = [answer[rows] for answer in answers]
            numbers = _NO_NUMBERS
            if len(here["points"]) > (least or BLOCK):
                here["points"] = _as_kernels_take_it(here["points"])
                numbers = order_in_space(Positions.of(here["points"]), *placement)
            if not numbers.size:
                in_blocks(here, there, look_up, threads, executor)
                continue
            sorted_here = {name: np.take(array, numbers, axis=0) for name, array in here.items()}
            found = [np.empty(answer.shape, answer.dtype) for answer in there]
            in_blocks(sorted_here, found, look_up, threads, executor)
            for answer, each in zip(there, found, strict=True):
                put_rows(each.reshape(len(each), -1), numbers, answer.reshape(len(answer), -1))
    except ArgumentError:
        in_blocks(given, answers, look_up, threads, executor)  # which names the first row
        raise


def _refuse(fault: _Fault, begin: int, given: Given) -> None:
    """Raise ArgumentError for a fault in the block that begins at a row."""
    name, row = fault.name, begin + fault.row
    kind = "finite and not below zero" if name == "width" else "finite"
    raise ArgumentError(f"{name} must be {kind}, but {name}[{row}] is {given[name][row].tolist()}")


def _checked_block(look_up: LookUp, block: _Block) -> tuple[_Fault | None, list[Array]]:
    given, answers = block
    taken: dict[str, Array] = {}
    for name, array in given.items():
        taken[name] = array = _as_kernels_take_it(array)
        if name == "points":  # looked at as they are placed
            continue
        sound = np.isfinite(array)
        if name == "width":
            sound = sound & (array >= 0)
        if not sound.all():
            return _Fault(name, int(np.argmin(sound)) // (array.size // len(array))), answers
    try:
        row = look_up(taken, answers)
    except NotFiniteError as error:
        row = error.row
    return (_Fault("points", row) if row >= 0 else None), answers


def _as_kernels_take_it(array: Array) -> Array:
    if array.dtype in (np.float32, np.float64) and array.flags.c_contiguous and array.flags.aligned:
        return array
    return np.require(array, np.float32 if array.dtype == np.float32 else np.float64, ["C", "A"])


class Answers:
    """Where the values of channels go, and their gradients if they are wanted.

    ``components`` are those of the channels that there are, by name; ``channel``, ``gradient`` and ``out``
    are what users ask for: see `OctreeTexture.sample`. Raises ArgumentError for what does not fit.
    """

    def __init__(
        self,
        components: Mapping[str, int],
        channel: str | list[str] | tuple[str, ...],
        count: int,
        gradient: bool,
        out: Any,
    ) -> None:
        is_single = isinstance(channel, str)
        shapes: dict[str, tuple[int, ...]] = {}
        slopes: dict[str, tuple[int, ...]] = {}
        for name in channel if isinstance(channel, (list, tuple)) else (channel,):
            as_choice(name, components, "channel")
            shapes[name] = count, components[name]
            slopes[name] = *shapes[name], 3
        #: The channels, each once.
        self.channels = list(shapes)
        out_gradients = None
        if gradient and out is not None:
            if not isinstance(out, (tuple, list)) or len(out) != 2:
                raise ArgumentError("out must be a pair, for values and for gradients")
            out, out_gradients = out
        values = answers_for(shapes, out, is_single)
        gradients = answers_for(slopes, out_gradients, is_single, "the gradients' out") if gradient else {}
        #: The values of each channel, then the gradients of each.
        self.arrays: list[Array] = [*values.values(), *gradients.values()]
        #: What `OctreeTexture.sample` returns.
        self.returned: Any = (values, gradients) if gradient else values
        if is_single:
            self.returned = tuple(self.arrays) if gradient else self.arrays[0]


def answers_for(
    shapes: Mapping[str, tuple[int, ...]], out: Any, single: bool, name: str = "out"
) -> dict[str, Float32s]:
    """Return arrays to write to by channel: new ones, or for ``out`` what the caller gave, if it fits.

    ``out`` is one array if ``single``, else a dict of them. Raises ArgumentError.
    """
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
            found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else repr(type(array))
            raise ArgumentError(
                f"{name} for {channel!r} must be a float32 array of shape {shape}, not {found}"
            )
        if not array.flags.carray:
            raise ArgumentError(f"{name} for {channel!r} must be C-ordered, aligned and writable")
    return {channel: out[channel] for channel in shapes}


def check_apart(given: Iterable[Array], answers: Sequence[Array]) -> None:
    """Raise ArgumentError if an answer shares memory with another or with what is given."""
    known = list(given)
    for answer in answers:
        if any(np.may_share_memory(answer, other) for other in known):
            raise ArgumentError("the arrays in out must not share memory with each other or with the points")
        known.append(answer)
