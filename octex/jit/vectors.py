"""Vectors of numbers in registers, and sums with them: the compiler makes none by itself.

A vector is read from an array, or filled with one number; vectors are added, multiplied, divided and compared
like numbers. A sweep of the fit takes 55 to 65 ns a leaf with them, 86 to 91 with scalars. Without numba a
vector is a short numpy array.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import lower_builtin, models, register_model, type_callable

from octex.jit.decorators import fused_inlined, inlined
from octex.jit.instructions import instruction, pointer_to


class Vector(types.Type):  # type: ignore[misc]
    """Numba's type of a vector of numbers or of truth values."""

    def __init__(self, element: Any, count: int) -> None:
        self.element, self.count = element, count
        super().__init__(f"vector({element}, {count})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Vector) -> None:
        element = manager.lookup(kind.element).get_value_type()
        super().__init__(manager, kind, ir.VectorType(element, kind.count))


def _typed_as(result: Callable[[Vector], Any], _context: Any) -> Callable[[Any, Any], Any]:
    def typed(one: Any, other: Any) -> Any:
        return result(one) if isinstance(one, Vector) and one == other else None

    return typed


def _write_operation(
    of_floats: str, of_integers: str, sign: str, _c: Any, builder: Any, signature: Any, values: Any
) -> Any:
    element = signature.args[0].element
    name = of_floats if isinstance(element, types.Float) else of_integers
    if sign and name == of_integers:
        name += "_signed" if element.signed else "_unsigned"
    return getattr(builder, name)(*filter(None, [sign]), *values)


for _symbol, _names in {
    operator.add: ("fadd", "add", ""),
    operator.sub: ("fsub", "sub", ""),
    operator.mul: ("fmul", "mul", ""),
    operator.truediv: ("fdiv", "", ""),
    operator.rshift: ("", "lshr", ""),
    operator.lt: ("fcmp_ordered", "icmp", "<"),
    operator.le: ("fcmp_ordered", "icmp", "<="),
    operator.gt: ("fcmp_ordered", "icmp", ">"),
}.items():
    _result = (lambda kind: Vector(types.boolean, kind.count)) if _names[2] else (lambda kind: kind)
    type_callable(_symbol)(partial(_typed_as, _result))
    lower_builtin(_symbol, Vector, Vector)(partial(_write_operation, *_names))


def _vector_place(context: Any, builder: Any, array: Any, kind: Vector, values: Any) -> tuple[Any, int]:
    """Return a pointer to a vector in an array, and its alignment."""
    pointer = pointer_to(context, builder, array, *values)
    of_vector = context.get_value_type(kind).as_pointer()
    return builder.bitcast(pointer, of_vector), array.dtype.bitwidth // 8


def _reader(count: int) -> Any:
    def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointer, align = _vector_place(context, builder, signature.args[0], signature.return_type, values)
        return builder.load(pointer, align=align)

    @instruction(lambda array, _: Vector(array.dtype, count)(array, types.int64), write)
    def read(array: Any, at: Any) -> Any:
        """Return the vector of the numbers of a C-ordered array from ``at`` on."""
        return array.reshape(-1)[at : at + count].copy()

    return read


def _filler(element: Any, count: int) -> Any:
    def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        nothing = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
        first = builder.insert_element(nothing, values[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, nothing, lanes)

    @instruction(lambda _: Vector(element, count)(element), write)
    def fill(number: Any) -> Any:
        """Return a vector that has the same number everywhere."""
        return np.full(count, number, element.name)

    return fill


four_at, eight_at, sixteen_at = _reader(4), _reader(8), _reader(16)
four, eight, sixteen = _filler(types.float32, 4), _filler(types.float32, 8), _filler(types.int16, 16)


def _write_store(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array, at, vector = values
    pointer, align = _vector_place(context, builder, signature.args[0], signature.args[2], (array, at))
    builder.store(vector, pointer, align=align)
    return context.get_dummy_value()


@instruction(lambda array, _, vector: types.void(array, types.int64, vector), _write_store)
def put(array: Any, at: Any, vector: Any) -> None:
    """Write a vector's numbers to a C-ordered array, from ``at`` on."""
    array.reshape(-1)[at : at + len(vector)] = vector


def _write_lanes(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    lanes = range(signature.return_type.count)
    numbers = [builder.extract_element(values[0], ir.Constant(ir.IntType(32), lane)) for lane in lanes]
    return context.make_tuple(builder, signature.return_type, numbers)


@instruction(lambda vector: types.UniTuple(vector.element, vector.count)(vector), _write_lanes)
def lanes(vector: Any) -> Any:
    """Return a vector's numbers as a tuple."""
    return tuple(vector)


def _write_vector(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vector = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
    for lane in range(signature.return_type.count):
        number = builder.extract_value(values[0], lane)
        vector = builder.insert_element(vector, number, ir.Constant(ir.IntType(32), lane))
    return vector


@instruction(lambda numbers: Vector(numbers.dtype, numbers.count)(numbers), _write_vector)
def vector_of(numbers: Any) -> Any:
    """Return a tuple's numbers as a vector."""
    return np.array(numbers)


@instruction(lambda mask, one, other: one(mask, one, other), lambda _c, to, _s, values: to.select(*values))
def chosen(mask: Any, one: Any, other: Any) -> Any:
    """Return the vector of one's numbers where ``mask`` is true, else of the other's."""
    return np.where(mask, one, other)


def _write_bits(_context: Any, builder: Any, signature: Any, values: Any) -> Any:
    bits = builder.bitcast(values[0], ir.IntType(signature.args[0].count))
    return builder.zext(bits, ir.IntType(64))


@instruction(lambda mask: types.uint64(mask), _write_bits)
def mask_bits(mask: Any) -> Any:
    """Return a bit for each truth value."""
    return np.uint64(sum(1 << int(lane) for lane in np.flatnonzero(mask)))


@inlined
def weighted_rows(rows: Any, numbers: Any, weights: Any, first: int, end: int) -> Any:
    """Return Σ weights[i] · rows[numbers[i]] for i from ``first`` to ``end`` − 1: four float32.

    ``rows`` (n, 4) and ``weights`` are float32, ``numbers`` int32, all C-ordered.
    """
    total = four(0.0)
    for i in range(first, end):
        at = np.uint64(i)
        total = total + four(weights[at]) * four_at(rows, np.int64(numbers[at]) << 2)
    return lanes(total)


@inlined
def add_to_rows(rows: Any, numbers: Any, weights: Any, first: int, end: int, step: Any) -> None:
    """Add weights[i] · row[3] · step to row = rows[numbers[i]], for i from ``first`` to ``end`` − 1."""
    change = vector_of(step)
    for i in range(first, end):
        at = np.uint64(i)
        begin = np.int64(numbers[at]) << 2
        row = four_at(rows, begin)
        put(rows, begin, row + four(weights[at] * lanes(row)[3]) * change)


@fused_inlined
def spline_box(rows: Any, first: int, steps: Any, of_x: Any, of_y: Any, of_z: Any) -> Any:
    """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + (i, j, k) · steps], 0 … 2: four float32.

    ``rows`` (n, 4) are float32, C-ordered; the weights are tuples of three float32.
    """
    total = four(0.0)
    for k in range(3):
        for j in range(3):
            line, at = four(0.0), first + steps[1] * j + steps[2] * k
            for i in range(3):
                line = line + four(of_x[i]) * four_at(rows, 4 * (at + steps[0] * i))
            total = total + four(of_y[j] * of_z[k]) * line
    return lanes(total)


@fused_inlined
def spline_at_eight(rows: Any, first: int, of_x: Any, of_y: Any, of_z: Any) -> Any:
    """Return Σ of_z[k] · of_y[j] · of_x[i] · rows[first + i + 3 · j + 9 · k] at eight points: four vectors.

    ``rows`` (n, 4) are float32; the weights are tuples of three vectors.
    """
    a = b = c = d = eight(0.0)
    for k in range(3):
        p = q = r = s = eight(0.0)
        for j in range(3):
            for i in range(3):
                at, weight = np.uint64(first + i + 3 * j + 9 * k), of_x[i] * of_y[j]
                p, q = p + weight * eight(rows[at, 0]), q + weight * eight(rows[at, 1])
                r, s = r + weight * eight(rows[at, 2]), s + weight * eight(rows[at, 3])
        a, b, c, d = a + of_z[k] * p, b + of_z[k] * q, c + of_z[k] * r, d + of_z[k] * s
    return a, b, c, d


@fused_inlined
def refine_rows(rows: Any, at: int, apart: int, to: int, to_apart: int, to_step: int, count: int) -> None:
    """Write ¾ a + ¼ b and, ``to_apart`` behind it, ¼ a + ¾ b for ``count`` pairs, from ``to`` on.

    The first a begins at ``at``, the next ones follow, each b lies ``apart`` behind its a; ``to_step`` leads
    to the next result. All count the numbers in ``rows``, float32 and C-ordered. A fifth of the time of
    scalars.
    """
    three_quarters, quarter = four(0.75), four(0.25)
    for n in range(count):
        source, target = at + 4 * n, to + n * to_step
        a, b = four_at(rows, source), four_at(rows, source + apart)
        put(rows, target, three_quarters * a + quarter * b)
        put(rows, target + to_apart, quarter * a + three_quarters * b)


@inlined
def _larger(one: Any, other: Any) -> Any:
    return chosen(one > other, one, other)


@inlined
def squares_to_boxes(bounds: Any, node: int, x: Any, y: Any, z: Any, limit: Any, squares: Any) -> np.uint64:
    """Write the squared distances (8,) of a node's boxes to a point; return the boxes within a limit as bits.

    ``bounds`` (nodes, 6, 8) has their low x, y, z and high x, y, z. All are float32, C-ordered. A third of
    the time of scalars.
    """
    at, none, u, v, w = 48 * node, eight(0.0), eight(x), eight(y), eight(z)
    i = _larger(_larger(eight_at(bounds, at) - u, u - eight_at(bounds, at + 24)), none)
    j = _larger(_larger(eight_at(bounds, at + 8) - v, v - eight_at(bounds, at + 32)), none)
    k = _larger(_larger(eight_at(bounds, at + 16) - w, w - eight_at(bounds, at + 40)), none)
    distances = i * i + j * j + k * k
    put(squares, 0, distances)
    return mask_bits(distances <= eight(limit))  # type: ignore[no-any-return]
