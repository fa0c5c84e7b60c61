"""Rows of four numbers and boxes eight at a time as vectors, which the compiler does not make by itself.

A sweep of the fit takes 55 to 65 ns a leaf so, where scalars take 86 to 91.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from octex.jit.decorators import DISABLED
from octex.jit.instructions import pointer_to

if DISABLED:

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

    def count_begun(numbers: Any, at: int, low: int) -> int:
        """Return of how many i < 16 numbers[at + i] + i is ``low`` or less; all are uint16 below 2¹⁵."""
        return int(np.count_nonzero(numbers[at : at + 16] + np.arange(16, dtype=np.uint16) <= low))

    def move_begins(numbers: Any, at: int, last: int, rate: int) -> None:
        """Move numbers[at + i] by 2^−``rate`` to 0 for i to ``last``, and to 2¹⁵ − 16 for others below 16."""
        row = numbers[at : at + 16]
        row[:] = row - (row >> rate) + np.where(np.arange(16) > last, 2**15 - 16 >> rate, 0)

else:
    _FOUR = ir.VectorType(ir.FloatType(), 4)
    _NOTHING = ir.Constant(_FOUR, ir.Undefined)

    def _lane(k: int) -> Any:
        return ir.Constant(ir.IntType(32), k)

    def _fill(builder: Any, value: Any) -> Any:
        """Put a number into all four lanes."""
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4)
        return builder.shuffle_vector(builder.insert_element(_NOTHING, value, _lane(0)), _NOTHING, zeros)

    def _load_four(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
        place = pointer_to(context, builder, array_type, array, index)
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
                    pointer = pointer_to(context, builder, *array, place)
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
                pointer = pointer_to(context, builder, array_type, bounds, index)
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
            pointer = pointer_to(context, builder, signature.args[6], squares, ir.Constant(node.type, 0))
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
                node = builder.load(pointer_to(context, builder, signature.args[1], nodes, row))
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
            number = builder.load(pointer_to(context, builder, signature.args[1], numbers, index))
            start = builder.shl(builder.sext(number, index.type), ir.Constant(index.type, 2))
            row = pointer_to(context, builder, signature.args[0], rows, start)
            place = builder.bitcast(row, _FOUR.as_pointer())
            content = builder.load(place)
            content.align = 4
            yield (
                place,
                content,
                builder.load(pointer_to(context, builder, signature.args[2], weights, index)),
            )

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
            row = pointer_to(context, builder, signature.args[0], rows, index)
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

    _SIXTEEN = ir.VectorType(ir.IntType(16), 16)
    _PLACES = ir.Constant(_SIXTEEN, list(range(16)))

    def _sixteen(builder: Any, value: Any) -> Any:
        """Put a number into all sixteen lanes."""
        nothing, value = ir.Constant(_SIXTEEN, ir.Undefined), builder.trunc(value, ir.IntType(16))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), 16), [0] * 16)
        return builder.shuffle_vector(builder.insert_element(nothing, value, _lane(0)), nothing, zeros)

    def _at_sixteen(context: Any, builder: Any, array_type: Any, array: Any, at: Any) -> Any:
        return builder.bitcast(pointer_to(context, builder, array_type, array, at), _SIXTEEN.as_pointer())

    @intrinsic  # type: ignore[untyped-decorator]
    def count_begun(_context: Any, numbers: Any, _at: Any, _low: Any) -> Any:
        """Return of how many i < 16 numbers[at + i] + i is ``low`` or less; all are uint16 below 2¹⁵."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            row = builder.load(_at_sixteen(context, builder, signature.args[0], *arguments[:2]), align=2)
            begun = builder.icmp_signed("<=", builder.add(row, _PLACES), _sixteen(builder, arguments[2]))
            return builder.zext(builder.ctpop(builder.bitcast(begun, ir.IntType(16))), ir.IntType(64))

        return types.int64(numbers, types.int64, types.int64), codegen

    @intrinsic  # type: ignore[untyped-decorator]
    def move_begins(_context: Any, numbers: Any, _at: Any, _last: Any, _rate: Any) -> Any:
        """Move numbers[at + i] by 2^−``rate`` to 0 for i to ``last``, and to 2¹⁵ − 16 for others below 16."""

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            numbers, at, last, rate = arguments
            pointer = _at_sixteen(context, builder, signature.args[0], numbers, at)
            row, rate = builder.load(pointer, align=2), _sixteen(builder, rate)
            is_after = builder.icmp_signed(">", _PLACES, _sixteen(builder, last))
            most, none = (ir.Constant(_SIXTEEN, [value] * 16) for value in (2**15 - 16, 0))
            more = builder.select(is_after, builder.lshr(most, rate), none)
            builder.store(builder.add(builder.sub(row, builder.lshr(row, rate)), more), pointer, align=2)
            return context.get_dummy_value()

        return types.void(numbers, types.int64, types.int64, types.int64), codegen
