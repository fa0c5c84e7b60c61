"""Instructions that numba lacks, and arrays that it would compile anew for each type in each process."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.npydecl import parse_dtype
from numba.extending import intrinsic
from numba.np.arrayobj import _empty_nd_impl, make_array, populate_array

from octex.jit.decorators import DISABLED, kernel

Scalar = TypeVar("Scalar", bound=np.generic)


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

    def new_array(shape: Any, dtype: type[Scalar] | np.dtype[Scalar]) -> np.ndarray[Any, np.dtype[Scalar]]:
        """Return an array that is not filled in."""
        return np.empty(shape, dtype)

    def new_zeros(shape: Any, dtype: type[Scalar] | np.dtype[Scalar]) -> np.ndarray[Any, np.dtype[Scalar]]:
        """Return an array of zeros."""
        return np.zeros(shape, dtype)

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

    # numba compiles its own ``empty`` and ``zeros`` anew for each type, in each process.

    def _allocated(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        shape, kind = arguments[0], signature.args[0]
        sizes, kinds = [shape], [kind]
        if isinstance(kind, types.BaseTuple):
            sizes, kinds = cgutils.unpack_tuple(builder, shape), list(kind)
        pairs = zip(sizes, kinds, strict=True)
        sizes = [context.cast(builder, size, own, types.intp) for size, own in pairs]
        return _empty_nd_impl(context, builder, signature.return_type, sizes)

    def _array_type(shape: Any, dtype: Any) -> Any:
        dimensions = len(shape) if isinstance(shape, types.BaseTuple) else 1
        return types.Array(parse_dtype(dtype), dimensions, "C")(shape, dtype)

    @intrinsic  # type: ignore[untyped-decorator]
    def new_array(_context: Any, shape: Any, dtype: Any) -> Any:
        """Return an array that is not filled in."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return _allocated(context, builder, signature, arguments)._getvalue()

        return _array_type(shape, dtype), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def new_zeros(_context: Any, shape: Any, dtype: Any) -> Any:
        """Return an array of zeros."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array = _allocated(context, builder, signature, arguments)
            count = builder.mul(array.nitems, array.itemsize)
            cgutils.memset(builder, array.data, count, 0)
            return array._getvalue()

        return _array_type(shape, dtype), codegen

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
