"""Instructions that numba lacks, each with a plain function of the same result."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from octex.jit.decorators import DISABLED, Function


def instruction(kind: Callable[..., Any], write: Callable[..., Any]) -> Callable[[Function], Function]:
    """Replace a plain function in kernels by the instructions that ``write`` generates.

    ``kind`` returns numba's signature for the arguments' types. ``write`` takes numba's context, a builder,
    the signature and the arguments; it returns the result.
    """

    def replaced(function: Function) -> Function:
        if DISABLED:
            return function

        def typed(_context: Any, *arguments: Any) -> Any:
            return kind(*arguments), write

        functools.update_wrapper(typed, function)
        plain = inspect.signature(function)
        context = inspect.Parameter("_context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        typed.__signature__ = plain.replace(parameters=[context, *plain.parameters.values()])  # type: ignore[attr-defined]
        return intrinsic(typed)  # type: ignore[no-any-return]

    return replaced


def pointer_to(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Return a pointer to an element of a C-ordered array, by its number in memory."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


@instruction(lambda _: types.int64(types.uint64), lambda _c, builder, _s, values: builder.ctpop(*values))
def popcount(bits: int | np.uint64) -> int:
    """Count the set bits of an unsigned 64-bit integer: one instruction."""
    return int(bits).bit_count()


_ALSO_ZERO = ir.Constant(ir.IntType(1), 0)


@instruction(
    lambda _: types.int64(types.uint64), lambda _c, builder, _s, values: builder.cttz(*values, _ALSO_ZERO)
)
def trailing_zeros(bits: int | np.uint64) -> int:
    """Index of the lowest set bit of a non-zero unsigned 64-bit integer: one instruction."""
    bits = int(bits)
    return (bits & -bits).bit_length() - 1


def _write_prefetch(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0])
    stride = builder.extract_value(data.strides, 0)
    address = builder.add(builder.ptrtoint(data.data, stride.type), builder.mul(values[1], stride))
    pointer = builder.inttoptr(address, ir.IntType(8).as_pointer())
    number = ir.IntType(32)
    to_read, keep, of_data = (ir.Constant(number, value) for value in (0, 3, 1))
    form = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
    function = builder.module.declare_intrinsic("llvm.prefetch", [pointer.type], form)
    builder.call(function, [pointer, to_read, keep, of_data])
    return context.get_dummy_value()


@instruction(lambda array, _: types.void(array, types.int64), _write_prefetch)
def prefetch(array: np.ndarray[Any, Any], row: int) -> None:
    """Prefetch the memory of a row of an array; any number is valid."""


def _write_decoded(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    if signature.args[1] == types.float32:
        return values[1]
    index = builder.zext(values[1], ir.IntType(64))
    return builder.load(pointer_to(context, builder, signature.args[0], values[0], index))


@instruction(
    lambda table, code: (code if code == types.float32 else table.dtype)(table, code), _write_decoded
)
def decoded(table: Any, code: Any) -> Any:
    """Return the entry of ``table`` for an unsigned code; a float32 number unchanged."""
    return code if isinstance(code, np.floating) else table[code]
