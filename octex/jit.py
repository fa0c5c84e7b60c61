"""How octex compiles: one decorator, and the bit instructions that numba lacks.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python; the intrinsics then have plain twins.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])

#: True when kernels run as plain Python.
DISABLED: bool = bool(numba.config.DISABLE_JIT)


def kernel(function: Function) -> Function:
    """Compile ``function`` on first call, cached on disk, releasing the GIL.

    Kernels take arrays, scalars and named tuples of them; they never raise and never allocate per element.
    """
    return _compiled(function)


def inlined(function: Function) -> Function:
    """Compile ``function`` into the kernels that call it.

    For the small steps of a hot loop, where a call costs as much as the work. They must not create arrays:
    without numba's runtime they count no references, which otherwise costs 100 to 200 ns a call with a tuple
    of arrays (coherent lookups: 24 million a second instead of 4).
    """
    return _compiled(function, forceinline=True, _nrt=False)


def summing_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let sums be reordered to run in vectors: their last bits may vary."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def fused_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function: Function, **options: Any) -> Function:
    compiler = partial(numba.njit, nogil=True, error_model="numpy", **options)
    try:
        compiled = compiler(cache=True)(function)
    except RuntimeError:  # no folder that numba could write its cache to: compile in every process
        return compiler(cache=False)(function)  # type: ignore[no-any-return]
    # What a kernel calls is compiled into it, but numba looks for changes in the kernel's own file only.
    with suppress(AttributeError):
        cache_file = compiled._cache._cache_file
        cache_file._source_stamp = (cache_file._source_stamp, _digest_of_sources())
        cache_file._load_index = partial(_load_index, cache_file._load_index)
    return compiled  # type: ignore[no-any-return]


def _load_index(load: Callable[[], dict[Any, Any]]) -> dict[Any, Any]:
    """List what is cached: nothing, if it was written by an octex whose types are no longer there."""
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


@cache
def _digest_of_sources() -> str:
    """Tell this state of octex from any other."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


if DISABLED:

    def popcount(bits: int | np.uint64) -> int:
        """Count the set bits of an unsigned 64-bit integer."""
        return int(bits).bit_count()

    def trailing_zeros(bits: int | np.uint64) -> int:
        """Index of the lowest set bit of a non-zero unsigned 64-bit integer."""
        bits = int(bits)
        return (bits & -bits).bit_length() - 1

    def prefetch(array: np.ndarray[Any, Any], row: int) -> None:
        """Ask for the memory of a row of an array ahead of its use."""

else:

    @intrinsic  # type: ignore[untyped-decorator]
    def popcount(_context: Any, _bits: Any) -> Any:
        """Count the set bits of an unsigned 64-bit integer: one instruction."""

        def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return builder.ctpop(arguments[0])

        return types.int64(types.uint64), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def trailing_zeros(_context: Any, _bits: Any) -> Any:
        """Index of the lowest set bit of a non-zero unsigned 64-bit integer: one instruction."""

        def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            zero_is_undefined = ir.Constant(ir.IntType(1), 0)
            return builder.cttz(arguments[0], zero_is_undefined)

        return types.int64(types.uint64), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def prefetch(_context: Any, array: Any, _row: Any) -> Any:
        """Ask for the memory of a row of an array ahead of its use; any number will do."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            data = context.make_array(signature.args[0])(context, builder, arguments[0])
            stride = builder.extract_value(data.strides, 0)
            address = builder.add(builder.ptrtoint(data.data, stride.type), builder.mul(arguments[1], stride))
            pointer = builder.inttoptr(address, ir.IntType(8).as_pointer())
            number = ir.IntType(32)
            to_read, keep, of_data = (ir.Constant(number, value) for value in (0, 3, 1))
            form = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
            function = builder.module.declare_intrinsic("llvm.prefetch", [pointer.type], form)
            builder.call(function, [pointer, to_read, keep, of_data])
            return context.get_dummy_value()

        return types.void(array, types.int64), codegen


@kernel
def low_bits(count: int) -> np.uint64:
    """Return a mask of the lowest ``count`` bits, 0 ≤ count ≤ 63."""
    return (np.uint64(1) << np.uint64(count)) - np.uint64(1)
