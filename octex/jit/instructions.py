"""Instructions that numba lacks: counting bits, asking for memory ahead, arrays as bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from octex.jit.decorators import DISABLED, kernel


def pointer_to(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Return a pointer to an element of a C-ordered array, by its number in memory."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


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

    def bytes_of(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return the bytes of a C-ordered array, in rows as long as its last axis."""
        return array.view(np.uint8)

    def decoded(table: Any, code: Any) -> Any:
        """Return what ``table`` has for an unsigned code; a float32 number as it is."""
        return code if isinstance(code, np.floating) else table[code]

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

    @intrinsic  # type: ignore[untyped-decorator]
    def bytes_of(_context: Any, array: Any) -> Any:
        """Return the bytes of a C-ordered array, in rows as long as its last axis."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            given = make_array(signature.args[0])(context, builder, arguments[0])
            seen = make_array(signature.return_type)(context, builder)
            size, one = given.itemsize, context.get_constant(types.intp, 1)
            *rows, last = cgutils.unpack_tuple(builder, given.shape)
            data = builder.bitcast(given.data, ir.IntType(8).as_pointer())
            shape = [*rows, builder.mul(last, size)]
            strides = [*cgutils.unpack_tuple(builder, given.strides)[:-1], one]
            populate_array(seen, data, shape, strides, one, given.meminfo, given.parent)
            return impl_ret_borrowed(context, builder, signature.return_type, seen._getvalue())

        return types.Array(types.uint8, array.ndim, array.layout)(array), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def decoded(_context: Any, table: Any, code: Any) -> Any:
        """Return what ``table`` has for an unsigned code; a float32 number as it is."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            if signature.args[1] == types.float32:
                return arguments[1]
            index = builder.zext(arguments[1], ir.IntType(64))
            return builder.load(pointer_to(context, builder, signature.args[0], arguments[0], index))

        return (code if code == types.float32 else table.dtype)(table, code), codegen


@kernel
def low_bits(count: int) -> np.uint64:
    """Return a mask of the lowest ``count`` bits, 0 ≤ count ≤ 63."""
    return (np.uint64(1) << np.uint64(count)) - np.uint64(1)
