"""Points looked up in blocks: on any threads, and answers where the caller wants them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from octex.errors import ArgumentError
from octex.parallel import ordered_map

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
#: Looks up the points of a block, writes to arrays of as many rows, and returns the first row that is not
#: finite or −1.
LookUp = Callable[[Array, list[Array]], int]

#: Points looked up at once: what is kept of them stays in the processor's cache, and a thread that takes them
#: is busy for a millisecond or more, beside which handing them over (50 µs) is little.
BLOCK = 1 << 16


class _Blocks(Sequence[tuple[Array, list[Array]]]):
    """Points and the rows of their answers, block by block."""

    def __init__(self, points: Array, answers: list[Array]) -> None:
        self._points, self._answers = points, answers

    def __len__(self) -> int:
        return -(-len(self._points) // BLOCK)

    def __getitem__(self, number: Any) -> Any:
        rows = slice(number * BLOCK, (number + 1) * BLOCK)
        return self._points[rows], [answer[rows] for answer in self._answers]

    def __iter__(self) -> Iterator[tuple[Array, list[Array]]]:
        return (self[number] for number in range(len(self)))


def in_blocks(points: Array, answers: list[Array], look_up: LookUp, executor: Executor | None) -> None:
    """Look up points (n, 3) of any real type, and write to ``answers``, arrays of n rows.

    Only a block is copied, and only if the points are not as kernels take them. Raises ArgumentError naming
    the first row that is not finite; the answers are then written in part.
    """
    blocks = _Blocks(points, answers)
    work = partial(_look_up_block, look_up)
    done = map(work, blocks) if executor is None else ordered_map(executor, work, blocks)
    for number, (fault, found) in enumerate(done):
        if fault >= 0:
            row = number * BLOCK + fault
            raise ArgumentError(f"points must be finite, but points[{row}] is {points[row].tolist()}")
        for answer, rows in zip(blocks[number][1], found, strict=True):
            if not np.may_share_memory(answer, rows):  # the executor works in other processes
                answer[:] = rows


def _look_up_block(look_up: LookUp, block: tuple[Array, list[Array]]) -> tuple[int, list[Array]]:
    points, answers = block
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return look_up(np.require(points, dtype, ["C", "A", "W"]), answers), answers


def answers_for(
    shapes: Mapping[str, tuple[int, ...]], out: Any, single: bool, name: str = "out"
) -> dict[str, Floats]:
    """Return arrays to write to by channel: new ones, or for ``out`` what the caller gave, if it fits.

    ``out`` is one array if ``single``, else a dict of them. Raises ArgumentError.
    """
    if out is None:
        return {channel: np.empty(shape, np.float32) for channel, shape in shapes.items()}
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


def pair_of(out: Any) -> tuple[Any, Any]:
    """Return the two parts of ``out`` for values and gradients, or Nones. Raises ArgumentError."""
    if out is None:
        return None, None
    if not isinstance(out, (tuple, list)) or len(out) != 2:
        raise ArgumentError("out must be a pair, for values and for gradients")
    return out[0], out[1]


def check_apart(arrays: Sequence[Array]) -> None:
    """Raise ArgumentError if any of the points and the answers share memory."""
    for number, array in enumerate(arrays):
        if any(np.may_share_memory(array, other) for other in arrays[:number]):
            raise ArgumentError("the arrays in out must not share memory with each other or with the points")
