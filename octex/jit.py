"""How octex compiles: one decorator, and the bit instructions that numba lacks.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python; the intrinsics then have plain twins.
"""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from operator import attrgetter
from threading import Lock
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.npydecl import parse_dtype
from numba.extending import intrinsic
from numba.np.arrayobj import _empty_nd_impl, make_array, populate_array

from octex.jit_parts import USED, PartCompiler, PartContext, WholeCompiler

Function = TypeVar("Function", bound=Callable[..., Any])
Scalar = TypeVar("Scalar", bound=np.generic)

#: What is used of numba beyond what it documents, of its functions and of their caches on disk.
_USED = "_compile_for_args", "_insert", "add_overload", "get_call_template", "overloads", "typeof_pyval"
_USED_OF_CACHE = (
    *("_cache._cache_file.load", "_cache._cache_file.save", "_cache._cache_file._source_stamp"),
    *("_cache._impl.rebuild", "_cache.cache_path", "_cache.save_overload"),
)
#: New objects after which Python looks for garbage while kernels are compiled, which make hundreds of
#: thousands: by its own 700, that takes a tenth of the time.
MANY_OBJECTS = 100_000

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
    of arrays (coherent lookups: 24 million a second instead of 4). Only kernels can call them: without what
    Python calls, octex compiles in six sevenths of the time.
    """
    return _part(function, forceinline=True, _nrt=False)


def step(function: Function) -> Function:
    """Compile ``function`` for kernels to call, as ``inlined`` does, but not into each call."""
    return _part(function, _nrt=False)


def part(function: Function) -> Function:
    """Compile ``function`` for kernels to call. It may create arrays, as ``kernel`` lets it."""
    return _part(function)


def fused_part(function: Function) -> Function:
    """Compile like ``part``, but let a product and a sum be one instruction, rounded once."""
    return _part(function, fastmath={"contract"})


def _part(function: Function, **options: Any) -> Function:
    """Compile a function that only kernels can call."""
    compiled: Any = _compiled(function, PartCompiler, no_cpython_wrapper=True, **options)
    if not DISABLED:
        compiled.add_overload = partial(_add_overload, compiled)
        compiled._compile_for_args = partial(_refuse, compiled.__name__)
    return compiled  # type: ignore[no-any-return]


def _add_overload(compiled: Any, result: Any) -> None:
    """Note what was compiled for a kernel's call, out of Python's reach."""
    compiled.overloads[tuple(result.signature.args)] = result


def _refuse(name: str, *_arguments: Any, **_keywords: Any) -> None:
    raise TypeError(f"{name} can be called in kernels only")


def summing_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let sums be reordered to run in vectors: their last bits may vary."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def fused_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function: Function, by: type[Any] = WholeCompiler, **options: Any) -> Function:
    from octex.jit_cache import CodeFiles  # not above: nothing is compiled from it

    # Without the entry for C, which nobody calls, each version is a module less to compile.
    plain = partial(numba.njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)
    compiler = partial(plain, pipeline_class=by)
    used: tuple[str, ...] = (*_USED, *_USED_OF_CACHE)
    try:
        compiled: Any = compiler(cache=True)(function)
    except RuntimeError:  # no folder that numba could write its cache to: compile in every process
        compiled, used = compiler(cache=False)(function), _USED
    if DISABLED:
        return compiled  # type: ignore[no-any-return]
    missing = [name for name in used if not _has(compiled, name)]
    missing += [name for owner, names in USED for name in names if not hasattr(owner, name)]
    if missing:
        # Code that is kept on disk by numba's rules alone may be stale.
        warnings.warn(
            f"numba {numba.__version__} has no {' and no '.join(missing)} in its functions, which octex "
            f"uses: {function.__name__} is compiled in every process; install a numba that octex knows",
            RuntimeWarning,
            stacklevel=3,
        )
        return plain(cache=False)(function)  # type: ignore[no-any-return]
    compiled.get_call_template = partial(_call_template, compiled.get_call_template)
    compiled._compile_for_args = partial(_compile_for_args, compiled, compiled._compile_for_args, set())
    if used != _USED:
        kept = compiled._cache
        kept._cache_file = CodeFiles(kept.cache_path, function, kept._cache_file._source_stamp)
        kept.save_overload = partial(_keep, kept.save_overload)
        if by is PartCompiler:
            kept._impl.rebuild = partial(_rebuild_part, kept._impl.rebuild)
        compiled.compile = partial(_compile, compiled.compile, kept._cache_file)
    return compiled  # type: ignore[no-any-return]


def _compile(compile: Callable[..., Any], files: Any, signature: Any) -> Any:
    with files.turns():
        return compile(signature)


def _rebuild_part(rebuild: Callable[..., Any], context: Any, kept: Any) -> Any:
    return rebuild(PartContext(context), kept)


def _keep(save: Callable[..., None], signature: Any, result: Any) -> None:
    """Save what was compiled; what numba has lost of it is used, and compiled anew by the next process.

    llvmlite finds a module that it has compiled in a set, which another thread may change at that moment when
    it drops a module: the object code is then not handed on.
    """
    try:
        save(signature, result)
    except RuntimeError as error:
        if not str(error).startswith("no compiled object yet"):
            raise


def _has(compiled: Any, name: str) -> bool:
    try:
        attrgetter(name)(compiled)
    except AttributeError:
        return False
    return True


def _compile_for_args(
    compiled: Any, compile_for_args: Callable[..., Any], known: set[Any], *arguments: Any
) -> Any:
    """Return the code for arguments: for read-only arrays that for arrays that can be written to.

    Their types differ, and each kernel would be compiled once more. Kernels write to what they are given to
    write to, and to nothing else.
    """
    with _little_garbage_sought():
        if not any(map(_has_locked, arguments)):
            return compile_for_args(*arguments)
        given = tuple(map(compiled.typeof_pyval, arguments))
        code = compiled.compile(tuple(map(_unlocked, given)))
    with _LOCK:
        if given not in known:
            known.add(given)
            compiled._insert([each._code for each in given], code, False)
    return code


_LOCK = Lock()
_compiling = 0  # calls that wait for code
_usual: tuple[int, ...] = ()  # Python's thresholds while none does


@contextmanager
def _little_garbage_sought() -> Iterator[None]:
    global _compiling, _usual
    with _LOCK:
        if _compiling == 0:
            _usual = gc.get_threshold()
            gc.set_threshold(max(_usual[0], MANY_OBJECTS) if _usual[0] else 0, *_usual[1:])
        _compiling += 1
    try:
        yield
    finally:
        with _LOCK:
            _compiling -= 1
            if _compiling == 0:
                gc.set_threshold(*_usual)


def _has_locked(argument: Any) -> bool:
    if isinstance(argument, np.ndarray):
        return not argument.flags.writeable
    return isinstance(argument, tuple) and any(map(_has_locked, argument))


def _unlocked(given: Any) -> Any:
    """Return the type of the same arguments if all arrays could be written to."""
    if isinstance(given, types.Array):
        return given.copy(readonly=False)
    if isinstance(given, types.BaseTuple):
        return types.BaseTuple.from_types(
            tuple(map(_unlocked, given.types)), getattr(given, "instance_class", None)
        )
    return given


def _call_template(resolve: Callable[..., Any], arguments: Any, keywords: Any) -> Any:
    """Choose what a call in a kernel compiles: one version for all numbers, not one for each constant.

    What is inlined gets its constants all the same.
    """
    keywords = {name: types.unliteral(each) for name, each in dict(keywords).items()}
    return resolve(tuple(types.unliteral(each) for each in arguments), keywords)


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

    def weighted_rows(rows: Any, numbers: Any, weights: Any, first: int, end: int) -> Any:
        """Return Σ weights[i] · rows[numbers[i]] for i from ``first`` to ``end`` − 1: four float32.

        ``rows`` (n, 4) and ``weights`` are float32, ``numbers`` int32, all C-ordered.
        """
        total = np.zeros(4, np.float32)
        for i in range(first, end):
            total += weights[i] * rows[numbers[i]]
        return tuple(total)

    def spline_rows(rows: Any, first: int, of_x: Any, of_y: Any, of_z: Any) -> Any:
        """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + i + 3 j + 9 k], each 0 … 2: four float32.

        ``rows`` (n, 4) are float32, C-ordered; the weights are tuples of three float32.
        """
        block = rows[first : first + 27].reshape(3, 3, 3, 4)
        for weights in (of_z, of_y, of_x):
            block = weights[0] * block[0] + weights[1] * block[1] + weights[2] * block[2]
        return tuple(block)

    def spline_box(rows: Any, first: int, steps: Any, of_x: Any, of_y: Any, of_z: Any) -> Any:
        """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + (i, j, k) · steps], 0 … 2: four float32."""
        z, y, x = np.ogrid[:3, :3, :3]
        block = rows[first + x * steps[0] + y * steps[1] + z * steps[2]]
        for weights in (of_z, of_y, of_x):
            block = weights[0] * block[0] + weights[1] * block[1] + weights[2] * block[2]
        return tuple(block)

    def add_to_rows(rows: Any, numbers: Any, weights: Any, first: int, end: int, step: Any) -> None:
        """Add weights[i] · row[3] · step to row = rows[numbers[i]], for i from ``first`` to ``end`` − 1."""
        for i in range(first, end):
            row = rows[numbers[i]]
            row += weights[i] * row[3] * np.array(step, np.float32)

    def refine_rows(
        rows: Any, at: int, apart: int, step: int, to: int, to_apart: int, to_step: int, count: int
    ) -> None:
        """Write ¾ a + ¼ b and, ``to_apart`` behind it, ¼ a + ¾ b for ``count`` pairs, from ``to`` on.

        The first a begins at ``at``, each b ``apart`` behind its a; steps lead to the next pair. All count
        the numbers in ``rows``, float32 and C-ordered.
        """
        near, far = np.float32(0.75), np.float32(0.25)
        for n in range(count):
            a, b = (rows[first + n * step : first + n * step + 4].copy() for first in (at, at + apart))
            first = to + n * to_step
            rows[first : first + 4] = near * a + far * b
            rows[first + to_apart : first + to_apart + 4] = far * a + near * b

    def weighted_cube(rows: Any, at: int, step: int, along_x: Any, along_y: Any, along_z: Any) -> Any:
        """Return Σ x[i] · y[j] · z[k] · (the four of ``rows`` at 4 · (at + i + step · (j + step · k))).

        Weights are three float32 along each axis; ``rows`` is float32 and C-ordered.
        """
        total = np.zeros(4, np.float32)
        for k in range(3):
            for j in range(3):
                both, first = along_y[j] * along_z[k], 4 * (at + step * (j + step * k))
                for i in range(3):
                    total += both * along_x[i] * rows[first + 4 * i : first + 4 * i + 4]
        return tuple(total)

    def squares_to_boxes(
        bounds: Any, node: int, x: Any, y: Any, z: Any, limit: Any, squares: Any
    ) -> np.uint64:
        """Fill in how far (8,) the eight boxes of a node are from a point, squared; say which are in a limit.

        ``bounds`` (nodes, 6, 8) has their low x, y, z and high x, y, z; the result has a bit for each box
        that is ``limit`` far or less. All are float32, C-ordered.
        """
        point = np.array([x, y, z], np.float32)[:, None]
        apart = np.maximum(np.maximum(bounds[node, :3] - point, point - bounds[node, 3:]), np.float32(0))
        squares[:] = (apart * apart).sum(axis=0)
        return np.uint64(sum(1 << child for child in range(8) if squares[child] <= limit))

    def nearest_box(bounds: Any, nodes: Any, count: int, x: Any, y: Any, z: Any) -> int:
        """Return which box of the first ``count`` of some nodes is nearest to a point: 8 · node + child.

        As for ``squares_to_boxes``; ``nodes`` are int64. Of equally near boxes any; −1 for no node.
        """
        squares = np.empty((count, 8), np.float32)
        for row in range(count):
            squares_to_boxes(bounds, nodes[row], x, y, z, np.float32(0), squares[row])
        place = int(squares.argmin()) if count else -1
        return int(nodes[place >> 3]) * 8 + (place & 7) if count else -1

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
            return builder.load(_pointer(context, builder, signature.args[0], arguments[0], index))

        return (code if code == types.float32 else table.dtype)(table, code), codegen

    # Rows of four as vectors, which the compiler does not make by itself: a sweep of the fit takes 55 to
    # 65 ns a leaf so, where scalars take 86 to 91.

    _FOUR = ir.VectorType(ir.FloatType(), 4)
    _NOTHING = ir.Constant(_FOUR, ir.Undefined)

    def _lane(k: int) -> Any:
        return ir.Constant(ir.IntType(32), k)

    def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
        return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])

    def _fill(builder: Any, value: Any) -> Any:
        """Put a number into all four lanes."""
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4)
        return builder.shuffle_vector(builder.insert_element(_NOTHING, value, _lane(0)), _NOTHING, zeros)

    def _load_four(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
        place = _pointer(context, builder, array_type, array, index)
        four = builder.load(builder.bitcast(place, _FOUR.as_pointer()))
        four.align = 4
        return four

    _FUSED = ("contract",)

    @intrinsic  # type: ignore[untyped-decorator]
    def refine_rows(
        _context: Any,
        rows: Any,
        _at: Any,
        _apart: Any,
        _step: Any,
        _to: Any,
        _to_apart: Any,
        _to_step: Any,
        _count: Any,
    ) -> Any:
        """Write ¾ a + ¼ b and, ``to_apart`` behind it, ¼ a + ¾ b for ``count`` pairs, from ``to`` on.

        A fifth of the time of scalars.
        """

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows, at, apart, step, to, to_apart, to_step, count = arguments
            array = signature.args[0], rows
            near, far = (ir.Constant(_FOUR, [part] * 4) for part in (0.75, 0.25))
            first, one = ir.Constant(count.type, 0), ir.Constant(count.type, 1)
            with cgutils.for_range_slice(builder, first, count, one) as (n, _):
                source = builder.add(at, builder.mul(n, step))
                target = builder.add(to, builder.mul(n, to_step))
                a = _load_four(context, builder, *array, source)
                b = _load_four(context, builder, *array, builder.add(source, apart))
                for p, q, place in ((near, far, target), (far, near, builder.add(target, to_apart))):
                    products = builder.fmul(p, a, flags=_FUSED), builder.fmul(q, b, flags=_FUSED)
                    pointer = _pointer(context, builder, *array, place)
                    mean = builder.fadd(*products, flags=_FUSED)
                    builder.store(mean, builder.bitcast(pointer, _FOUR.as_pointer())).align = 4
            return context.get_dummy_value()

        return types.void(rows, *[types.int64] * 7), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def weighted_cube(
        _context: Any, rows: Any, _at: Any, _step: Any, _along_x: Any, _along_y: Any, _along_z: Any
    ) -> Any:
        """Return Σ x[i] · y[j] · z[k] · (the four of ``rows`` at 4 · (at + i + step · (j + step · k)))."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows, at, step = arguments[:3]
            of_x, of_y, of_z = ([builder.extract_value(each, k) for k in range(3)] for each in arguments[3:])
            of_x = [_fill(builder, weight) for weight in of_x]

            def summed(weights: Any, fours: Any) -> Any:
                total = None
                for weight, four in zip(weights, fours, strict=True):
                    product = builder.fmul(weight, four, flags=_FUSED)
                    total = product if total is None else builder.fadd(total, product, flags=_FUSED)
                return total

            def run(j: int, k: int) -> Any:
                number = at.type
                line = builder.add(builder.mul(ir.Constant(number, k), step), ir.Constant(number, j))
                first = builder.add(at, builder.mul(line, step))
                places = [
                    builder.shl(builder.add(first, ir.Constant(number, i)), ir.Constant(number, 2))
                    for i in range(3)
                ]
                fours = [_load_four(context, builder, signature.args[0], rows, place) for place in places]
                return summed(of_x, fours)

            both = [_fill(builder, builder.fmul(y, z)) for z in of_z for y in of_y]
            result = summed(both, [run(j, k) for k in range(3) for j in range(3)])
            lanes = [builder.extract_element(result, _lane(k)) for k in range(4)]
            return context.make_tuple(builder, signature.return_type, lanes)

        three, four = types.UniTuple(types.float32, 3), types.UniTuple(types.float32, 4)
        return four(rows, types.int64, types.int64, three, three, three), codegen

    _EIGHT = ir.VectorType(ir.FloatType(), 8)

    def _splat(builder: Any, value: Any) -> Any:
        """Put a number into all eight lanes."""
        nothing = ir.Constant(ir.VectorType(value.type, 8), ir.Undefined)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), 8), [0] * 8)
        return builder.shuffle_vector(builder.insert_element(nothing, value, _lane(0)), nothing, zeros)

    def _box_squares(context: Any, builder: Any, array_type: Any, bounds: Any, node: Any, point: Any) -> Any:
        """Return how far, squared, a node's eight boxes are from a point; its coordinates are splat."""

        def larger(one: Any, other: Any) -> Any:
            return builder.select(builder.fcmp_ordered(">", one, other), one, other)

        start = builder.mul(node, ir.Constant(node.type, 48))
        total = None
        for axis, coordinate in enumerate(point):
            ends = []
            for row in (axis, axis + 3):
                index = builder.add(start, ir.Constant(node.type, 8 * row))
                pointer = _pointer(context, builder, array_type, bounds, index)
                end = builder.load(builder.bitcast(pointer, _EIGHT.as_pointer()))
                end.align = 4
                ends.append(end)
            apart = larger(builder.fsub(ends[0], coordinate), builder.fsub(coordinate, ends[1]))
            apart = larger(apart, ir.Constant(_EIGHT, [0.0] * 8))
            square = builder.fmul(apart, apart)
            total = square if total is None else builder.fadd(total, square)
        return total

    @intrinsic  # type: ignore[untyped-decorator]
    def squares_to_boxes(
        _context: Any, bounds: Any, _node: Any, _x: Any, _y: Any, _z: Any, _limit: Any, squares: Any
    ) -> Any:
        """Fill in how far (8,) the eight boxes of a node are from a point, squared; say which are in a limit.

        ``bounds`` (nodes, 6, 8) has their low x, y, z and high x, y, z; the result has a bit for each box
        that is ``limit`` far or less. All are float32, C-ordered. A third of the time of scalars.
        """

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            bounds, node, x, y, z, limit, squares = arguments
            point = [_splat(builder, coordinate) for coordinate in (x, y, z)]
            total = _box_squares(context, builder, signature.args[0], bounds, node, point)
            pointer = _pointer(context, builder, signature.args[6], squares, ir.Constant(node.type, 0))
            builder.store(total, builder.bitcast(pointer, _EIGHT.as_pointer())).align = 4
            inside = builder.fcmp_ordered("<=", total, _splat(builder, limit))
            return builder.zext(builder.bitcast(inside, ir.IntType(8)), ir.IntType(64))

        number = types.float32
        return types.uint64(bounds, types.int64, number, number, number, number, squares), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def nearest_box(_context: Any, bounds: Any, nodes: Any, _count: Any, _x: Any, _y: Any, _z: Any) -> Any:
        """Return which box of the first ``count`` of some nodes is nearest to a point: 8 · node + child.

        As for ``squares_to_boxes``; ``nodes`` are int64. Of equally near boxes any; −1 for no node.
        """

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            bounds, nodes, count, x, y, z = arguments
            point = [_splat(builder, coordinate) for coordinate in (x, y, z)]
            numbers = ir.VectorType(count.type, 8)
            lanes = ir.Constant(numbers, list(range(8)))
            least = cgutils.alloca_once_value(builder, ir.Constant(_EIGHT, [float("inf")] * 8))
            places = cgutils.alloca_once_value(builder, ir.Constant(numbers, [-1] * 8))
            first, step = ir.Constant(count.type, 0), ir.Constant(count.type, 1)
            with cgutils.for_range_slice(builder, first, count, step) as (row, _):
                node = builder.load(_pointer(context, builder, signature.args[1], nodes, row))
                squares = _box_squares(context, builder, signature.args[0], bounds, node, point)
                place = builder.add(builder.shl(_splat(builder, node), ir.Constant(numbers, [3] * 8)), lanes)
                is_less = builder.fcmp_ordered("<", squares, builder.load(least))
                builder.store(builder.select(is_less, squares, builder.load(least)), least)
                builder.store(builder.select(is_less, place, builder.load(places)), places)
            best, chosen = None, None
            for lane in range(8):
                square = builder.extract_element(builder.load(least), _lane(lane))
                place = builder.extract_element(builder.load(places), _lane(lane))
                if best is None:
                    best, chosen = square, place
                    continue
                is_less = builder.fcmp_ordered("<", square, best)
                best = builder.select(is_less, square, best)
                chosen = builder.select(is_less, place, chosen)
            return chosen

        number = types.float32
        return types.int64(bounds, nodes, types.int64, number, number, number), codegen

    @contextmanager
    def _each_row(context: Any, builder: Any, signature: Any, arguments: Any) -> Iterator[Any]:
        """Loop over the rows that are named: yield the place and the content of each, and its weight."""
        rows, numbers, weights, first, end = arguments[:5]
        with cgutils.for_range_slice(builder, first, end, ir.Constant(first.type, 1)) as (index, _):
            number = builder.load(_pointer(context, builder, signature.args[1], numbers, index))
            start = builder.shl(builder.sext(number, index.type), ir.Constant(index.type, 2))
            row = _pointer(context, builder, signature.args[0], rows, start)
            place = builder.bitcast(row, _FOUR.as_pointer())
            content = builder.load(place)
            content.align = 4
            yield place, content, builder.load(_pointer(context, builder, signature.args[2], weights, index))

    @intrinsic  # type: ignore[untyped-decorator]
    def weighted_rows(_context: Any, rows: Any, numbers: Any, weights: Any, _first: Any, _end: Any) -> Any:
        """Return Σ weights[i] · rows[numbers[i]] for i from ``first`` to ``end`` − 1: four float32."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            total = cgutils.alloca_once_value(builder, ir.Constant(_FOUR, [0.0] * 4))
            with _each_row(context, builder, signature, arguments) as (_, content, weight):
                product = builder.fmul(_fill(builder, weight), content)
                builder.store(builder.fadd(builder.load(total), product), total)
            result = builder.load(total)
            lanes = [builder.extract_element(result, _lane(k)) for k in range(4)]
            return context.make_tuple(builder, signature.return_type, lanes)

        four = types.UniTuple(types.float32, 4)
        return four(rows, numbers, weights, types.int64, types.int64), codegen

    def _spline(
        context: Any, builder: Any, signature: Any, rows: Any, first: Any, steps: Any, weights: Any
    ) -> Any:
        """Sum 27 rows, ``steps`` apart along each axis, under weights."""
        sums = []
        for number in range(27):
            index = first
            for axis, step in enumerate(steps):
                for _ in range(number // 3**axis % 3):
                    index = builder.add(index, step)
            index = builder.shl(index, ir.Constant(index.type, 2))
            row = _pointer(context, builder, signature.args[0], rows, index)
            content = builder.load(builder.bitcast(row, _FOUR.as_pointer()))
            content.align = 4
            sums.append(content)
        for along in weights:
            three = [_fill(builder, builder.extract_value(along, k)) for k in range(3)]
            parts = [builder.fmul(three[n % 3], content) for n, content in enumerate(sums)]
            sums = [
                builder.fadd(builder.fadd(parts[n], parts[n + 1]), parts[n + 2])
                for n in range(0, len(parts), 3)
            ]
        lanes = [builder.extract_element(sums[0], _lane(k)) for k in range(4)]
        return context.make_tuple(builder, signature.return_type, lanes)

    @intrinsic  # type: ignore[untyped-decorator]
    def spline_box(
        _context: Any, rows: Any, _first: Any, _steps: Any, of_x: Any, of_y: Any, of_z: Any
    ) -> Any:
        """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + (i, j, k) · steps], 0 … 2: four float32."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            apart = [builder.extract_value(arguments[2], axis) for axis in range(3)]
            return _spline(context, builder, signature, arguments[0], arguments[1], apart, arguments[3:])

        four = types.UniTuple(types.float32, 4)
        return four(rows, types.int64, types.UniTuple(types.int64, 3), of_x, of_y, of_z), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def spline_rows(_context: Any, rows: Any, _first: Any, of_x: Any, of_y: Any, of_z: Any) -> Any:
        """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + i + 3 j + 9 k], each 0 … 2: four float32.

        Sums along one axis after the other: 39 products of vectors, few of which wait for others.
        """

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            steps = [ir.Constant(arguments[1].type, 3**axis) for axis in range(3)]
            return _spline(context, builder, signature, arguments[0], arguments[1], steps, arguments[2:])

        four = types.UniTuple(types.float32, 4)
        return four(rows, types.int64, of_x, of_y, of_z), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def add_to_rows(
        _context: Any, rows: Any, numbers: Any, weights: Any, _first: Any, _end: Any, _step: Any
    ) -> Any:
        """Add weights[i] · row[3] · step to row = rows[numbers[i]], for i from ``first`` to ``end`` − 1."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            step = _NOTHING
            for k in range(4):
                step = builder.insert_element(step, builder.extract_value(arguments[5], k), _lane(k))
            with _each_row(context, builder, signature, arguments) as (place, content, weight):
                factor = builder.fmul(weight, builder.extract_element(content, _lane(3)))
                change = builder.fmul(_fill(builder, factor), step)
                builder.store(builder.fadd(content, change), place).align = 4
            return context.get_dummy_value()

        four = types.UniTuple(types.float32, 4)
        return types.void(rows, numbers, weights, types.int64, types.int64, four), codegen


@kernel
def low_bits(count: int) -> np.uint64:
    """Return a mask of the lowest ``count`` bits, 0 ≤ count ≤ 63."""
    return (np.uint64(1) << np.uint64(count)) - np.uint64(1)
