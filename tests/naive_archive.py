"""Archives read as octex/formats/FORMAT.md says, a symbol at a time, without octex."""

from __future__ import annotations

import json
import lzma
import zlib
from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any

import numpy as np

STEPS = 1, 2, 3, 6, 10, 16, 24, 36, 52, 80
AREAS = [0] + [round(2 ** ((c - 207) / 8 + 30)) for c in range(1, 256)]
SHAPES = [triple for triple in product(range(4), repeat=3) if sum(triple) == 3]
Pool = tuple[list[int], list[list[int]]]


class Stream:
    """Words, read as symbols."""

    def __init__(self, content: bytes) -> None:
        words = np.frombuffer(content, "<u2").tolist()
        self.states = [words[2 * n] | words[2 * n + 1] << 16 for n in range(4)] if words else [1 << 16] * 4
        self.words = iter(words[8:])
        self.count = 0

    def low(self) -> int:
        return self.states[self.count % 4] & 4095

    def take(self, start: int, size: int) -> None:
        x = self.states[self.count % 4]
        x = size * (x >> 12) + (x & 4095) - start
        self.states[self.count % 4] = x << 16 | next(self.words) if x < 1 << 16 else x
        self.count += 1

    def symbol(self, pool: Pool, context: int) -> int:
        start = 0
        for symbol, size in enumerate(pool[1][pool[0][context]]):
            if self.low() < start + size:
                self.take(start, size)
                return symbol
            start += size
        raise AssertionError

    def bit(self, chances: dict[Any, int], key: Any) -> int:
        chance = chances.get(key, 2048)
        bit = int(self.low() < chance)
        self.take(*((0, chance) if bit else (chance, 4096 - chance)))
        chances[key] = chance + ((4095 - chance) >> 4) if bit else max(chance - (chance >> 4), 1)
        return bit

    def plain(self, count: int) -> int:
        found = 0
        for done in range(0, count, 12):
            bits = min(count - done, 12)
            part = self.low() >> 12 - bits
            self.take(part << 12 - bits, 1 << 12 - bits)
            found |= part << done
        return found

    def number(self, chances: dict[Any, int], kind: int) -> int:
        n = 0
        while self.bit(chances, (kind, n, 0)):
            n += 1
        high = self.bit(chances, (kind, n, 1)) if n else 0
        return ((2 | high) << n - 1 | self.plain(n - 1)) - 1 if n else 0

    def numbers(self, count: int) -> Iterator[int]:
        chances: dict[Any, int] = {}
        kind = 0
        while count > 0:
            yield (number := self.number(chances, kind))
            kind = min((number + 1).bit_length() - 1, 3)
            more = self.number(chances, 4) if number == 0 else 0
            yield from [0] * more
            count -= 1 + more

    def end(self) -> None:
        assert self.states == [1 << 16] * 4
        assert next(self.words, None) is None


def near(code: int) -> int:
    """Fold back."""
    return -(code + 1 >> 1) if code & 1 else code >> 1


class Archive:
    """What an archive holds: level by level its cells, each with its flags, area, values …."""

    def __init__(self, content: bytes) -> None:
        self.version = content[8]
        begin = int.from_bytes(content[16:24], "little")
        lengths = np.frombuffer(content, "<u4", 3, begin).tolist()
        at = begin + 12
        self.head = json.loads(zlib.decompress(content[at : at + lengths[0]]))
        at += lengths[0]
        count = int.from_bytes(content[at : at + 4], "little")
        stream = Stream(content[at + 4 : at + lengths[1]])
        numbers = stream.numbers(count)
        channels = self.head["channels"]
        contexts = [1 << 15, 12 + (self.version > 1), 2160, 2436] + [
            44 * each["components"] + 2 for each in channels
        ]
        self.pools = [self.pool(numbers, each) for each in contexts]
        self.weights = [
            [near(next(numbers)) for _ in range(2 * 5 * 10 * each["components"])] for each in channels
        ]
        assert next(numbers, None) is None
        stream.end()
        self.records = iter(np.frombuffer(content, "<u4", lengths[2] // 4, at + lengths[1]).tolist())
        self.content, self.at = content, 32
        self.read()
        assert self.at == begin

    def pool(self, numbers: Iterator[int], contexts: int) -> Pool:
        count = next(numbers)
        chosen = [next(numbers) for _ in range(contexts)]
        return chosen, [[next(numbers) for _ in range(256)] for _ in range(count)]

    def next_bytes(self) -> bytes:
        length, checksum = next(self.records), next(self.records)
        found = self.content[self.at : self.at + length]
        assert zlib.crc32(found) == checksum
        self.at += length
        return found

    def read(self) -> None:
        head = self.head
        self.flags, self.areas = [head["root"][0]], [head["root"][1]]
        self.values = [[self.keys(each, bytes.fromhex(each["root"]))] for each in head["channels"]]
        self.masks: list[tuple[int, int]] = []  # of nodes: occupied octants, those of leaves
        # Of nodes of a level: place, cell; of all: the first child cell.
        nodes = {(0, 0, 0): (0, 0)} if head["level_nodes"][1] else {}
        cells = {(0, 0, 0): 0}
        self.firsts: list[int] = []
        most = 4096 if self.version == 1 else 16384
        for level in range(len(head["level_cells"]) - 2):
            below: dict[tuple[int, ...], int] = {}
            nodes_below: dict[tuple[int, ...], tuple[int, int]] = {}
            order = list(nodes.items())
            first = head["level_nodes"][level]
            while order:
                size = most - first % most
                self.block(level, order[:size], nodes, cells, below, nodes_below)
                order, first = order[size:], first + size
            nodes, cells = nodes_below, below
        split = [cell for cell, flags in enumerate(self.flags) if flags & 128]
        kept = [cell for cell, flags in enumerate(self.flags) if flags & 64]
        self.split_areas: list[int] = []
        self.split_values: list[list[list[int]]] = [[] for _ in head["channels"]]
        self.kept_values: list[list[list[int]]] = [[] for _ in head["channels"]]
        for some in self.runs(split, most):
            stream = Stream(self.next_bytes())
            for cell in some:
                rows = (self.flags[cell] & 63).bit_count()
                rest = AREAS[self.areas[cell]]
                for left in range(rows, 0, -1):
                    context = 2400 + min(left, 3) - 1
                    rest, area = self.area(stream, self.areas[cell], rest, left, context, 3)
                    self.split_areas.append(area)
            stream.end()
            owners = [cell for cell in some for _ in range((self.flags[cell] & 63).bit_count())]
            for number in range(len(head["channels"])):
                self.split_values[number] += self.rows(number, owners, 2)
        for some in self.runs(kept, most):
            for number in range(len(head["channels"])):
                self.kept_values[number] += self.rows(number, some, 3)
        counts = [head["split_cells"], head["kept_nodes"]]
        for cells, count in zip((split, kept), counts, strict=True):
            ends = head["level_cells"]
            by_level = [sum(a <= cell < b for cell in cells) for a, b in pairwise(ends)]
            assert count == (len(cells) if self.version < 3 else by_level)
        self.others = []
        for each in head["others"]:
            dtype = np.dtype(each["dtype"])
            left, parts = int(np.prod(each["shape"])) * dtype.itemsize, b""
            while len(parts) < left:
                parts += lzma.decompress(self.next_bytes())
            self.others.append(np.frombuffer(parts, dtype).reshape(each["shape"]))

    def runs(self, cells: list[int], most: int) -> Iterator[list[int]]:
        """Yield so many cells at most at a time, from version 3 on of one level."""
        ends = self.head["level_cells"]
        levels = list(pairwise(ends)) if self.version > 2 else [(0, ends[-1])]
        for first, end in levels:
            own = [cell for cell in cells if first <= cell < end]
            for begin in range(0, len(own), most):
                yield own[begin : begin + most]

    def keys(self, channel: dict[str, Any], content: bytes) -> list[int]:
        """Return numbers in the order of values, component by component."""
        bits = 8 * np.dtype(channel["dtype"]).itemsize
        found = np.frombuffer(content, f"<u{bits // 8}").tolist()
        if channel["dtype"].startswith("float"):
            sign = 1 << bits - 1
            found = [v ^ (2 * sign - 1) if v & sign else v ^ sign for v in found]
        return found

    def block(
        self, level: int, order: list[Any], nodes: Any, cells: Any, below: Any, nodes_below: Any
    ) -> None:
        child_nodes, child_cells = next(self.records), next(self.records)
        own = {place: n for n, (place, _) in enumerate(order)}  # nodes of the block
        masks: list[int] = []
        firsts: list[int] = []
        children: list[tuple[int, int]] = []  # node of the block, octant
        has_nodes: list[int] = []
        head = self.head
        may_be_nodes = level + 3 < len(head["level_cells"])
        stream, kinds, number = Stream(self.next_bytes()), 0, len(nodes_below)
        pools = self.pools
        for n, (place, (_, cell)) in enumerate(order):
            around = [moved(place, k) for k in range(6)]
            faces = sum((each in cells) << k for k, each in enumerate(around))
            x, y, z = (masks[own[around[k]]] if around[k] in own else 0 for k in (0, 2, 4))
            low = ((faces * 4 + (x >> 1 & 1 | x >> 2 & 2)) * 4 + (y >> 2 & 3)) * 16 + (z >> 4)
            there = stream.symbol(pools[0], low)
            high = ((faces * 4 + (x >> 5 & 1 | x >> 6 & 2)) * 4 + (y >> 6 & 3)) * 16 + there
            there |= stream.symbol(pools[0], 2**14 + high) << 4
            leaves = there
            if may_be_nodes:
                count = sum(each in cells and each not in nodes for each in around)
                leaves = stream.symbol(pools[1], 4 * kinds + min(count, 3)) & there
                kinds = 0 if leaves == 0 else 2 if leaves == there else 1
            masks.append(there)
            firsts.append(len(self.flags))
            has_nodes.append(int(leaves != there))
            self.masks.append((there, leaves))
            parent = self.flags[cell]
            shown = [k for k in range(6) if parent >> k & 1]

            def packed(mask: int, shown: list[int] = shown) -> int:
                return sum((mask >> k & 1) << i for i, k in enumerate(shown))

            union = t = 0
            alike = self.version > 1 and len(shown) == 1 and stream.symbol(pools[1], 12)
            for octant in range(8):
                if not there >> octant & 1:
                    continue
                u = 1 + (packed(union) & 7) if len(self.flags) > firsts[n] else 0
                some = 0
                for axis in range(3):
                    beside = self.beside(n, octant, axis, around, own, masks, firsts)
                    some |= self.flags[beside] if beside is not None else 0
                v = packed(some) & 7 if len(shown) > 1 else 0
                context = ((min(len(shown), 4) * 9 + u) * 8 + v) * 6 + 2 * t + (parent >> 7)
                symbol = 1 if alike else stream.symbol(pools[2], context)
                flags = sum(1 << k for i, k in enumerate(shown) if symbol >> i & 1) | symbol & 192
                union |= flags & 63
                t = 1 + (flags >> 7)
                at = tuple(2 * i + (octant >> axis & 1) for axis, i in enumerate(place))
                below[at] = len(self.flags)
                if not leaves >> octant & 1:
                    nodes_below[at] = number, len(self.flags)
                    number += 1
                children.append((n, octant))
                self.flags.append(flags)
        stream.end()
        assert (child_nodes, child_cells) == (
            sum((there & ~leaves).bit_count() for there, leaves in self.masks[-len(order) :]),
            len(children),
        )
        stream = Stream(self.next_bytes())
        before = -1
        for n, octant in children:
            place, (_, cell) = order[n]
            if n != before:
                whole, left = min(self.areas[cell] + 16, 255), masks[n].bit_count() + 1
                rest = AREAS[whole]
            before, left = n, left - 1
            counts = [0, 0, 0]
            for axis in range(3):
                across, outside = octant ^ 1 << axis, moved(place, 2 * axis + (octant >> axis & 1))
                beyond = masks[own[outside]] >> across & 1 if outside in own else int(outside in cells)
                counts[(masks[n] >> across & 1) + beyond] += 1
            around = [moved(place, k) for k in range(6)]
            beside = [self.beside(n, octant, axis, around, own, masks, firsts) for axis in range(3)]
            largest = max((self.areas[each] for each in beside if each is not None), default=0)
            size = 1 + sum(step <= whole - largest for step in (6, 12, 20)) if largest else 0
            context = SHAPES.index(tuple(counts)) + 10 * (min(left, 4) - 1) + 40 * size  # type: ignore[arg-type]
            rest, area = self.area(stream, whole, rest, left, context, 200)
            self.areas.append(area)
        stream.end()
        for number in range(len(head["channels"])):
            self.channel(number, order, children, has_nodes, cells, own, masks, firsts)

    def beside(
        self, n: int, octant: int, axis: int, around: Any, own: Any, masks: list[int], firsts: list[int]
    ) -> int | None:
        """Return the cell across a lower face, if it is of the block."""
        across, at = octant ^ 1 << axis, n
        if not octant >> axis & 1:
            at = own.get(around[2 * axis])
        if at is None or not masks[at] >> across & 1:
            return None
        return firsts[at] + (masks[at] & (1 << across) - 1).bit_count()

    def area(
        self, stream: Stream, whole: int, rest: int, left: int, context: int, span: int
    ) -> tuple[int, int]:
        rest = max(rest, AREAS[whole] >> 8)
        code = max(c for c in range(256) if AREAS[c] <= rest)
        d = max(whole - code, 0)
        p = 11 - sum(d >= step for step in (4, 6, 9, 12, 17, 20, 25, 33, 36, 41, 49))
        area = (code if left == 1 else whole) + stream.symbol(self.pools[3], context + span * p) & 255
        return rest - AREAS[area], area

    def channel(
        self, number: int, order: Any, children: Any, has_nodes: Any, cells: Any, own: Any, masks: Any,
        firsts: Any,
    ) -> None:  # fmt: skip
        channel, pool, values = self.head["channels"][number], self.pools[4 + number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        order_of = [1, 0, 2, 3][:components] if components > 2 else range(components)

        def context_of(kind: int, j: int, noise: int) -> int:
            return (kind * components + j) * 11 + sum(step <= min(noise, 255) for step in STEPS)

        stream = Stream(self.next_bytes())
        run = 32 if self.version > 1 else 1
        for begin in range(0, len(order), run):
            nodes = []
            for n, (place, (_, cell)) in enumerate(order[begin : begin + run], begin):
                around = [moved(place, k) for k in range(6)]
                value = [values[cell][c] for c in order_of]
                differ = [
                    [values[cells[each]][c] - values[cell][c] if each in cells else 0 for each in around]
                    for c in order_of
                ]
                octants = [octant for m, octant in children if m == n]
                kind = has_nodes[n]
                flat = not any(map(any, differ)) and stream.symbol(pool, 44 * components + kind)
                most = [min(sum(map(abs, each)) >> unit + 1, 255) for each in differ]
                nodes.append((n, around, cell, value, differ, octants, kind, flat, most))
            errors: dict[tuple[int, int, int], int] = {}
            listed = [
                (n, octant, kind, most)
                for n, *_, octants, kind, flat, most in nodes
                if not flat
                for octant in octants
            ]
            for j in range(components):
                for n, octant, kind, most in listed if self.version > 1 else []:
                    noise = most[j] + sum(2 * abs(errors[n, octant, i]) >> unit for i in range(j))
                    errors[n, octant, j] = self.error(stream, channel, pool, context_of(kind, j, noise))
            for n, around, cell, value, differ, octants, kind, flat, most in nodes:
                sums = [0] * components
                for i, octant in enumerate(octants):
                    if flat:
                        values.append(values[cell])
                        continue
                    found, off = [0] * components, [0] * components
                    beside = [self.beside(n, octant, axis, around, own, masks, firsts) for axis in range(3)]
                    for j, c in enumerate(order_of):
                        at = (kind * components + j) * 5 + sum(step <= most[j] for step in (1, 4, 16, 48))
                        w = self.weights[number][10 * at : 10 * at + 10]
                        on_side = sum(differ[j][2 * axis + (octant >> axis & 1)] for axis in range(3))
                        total = w[0] * on_side + w[1] * (sum(differ[j]) - on_side)
                        total += w[2] * sum(values[b][c] - value[j] for b in beside if b is not None)
                        total += w[3] * (sums[j] * (65536 // (len(octants) - i)) >> 16)
                        for k in range(min(j, 3)):
                            total += w[4 + k] * off[k] + w[7 + k] * (found[order_of[k]] - value[k])
                        guess = value[j] + (total + 2048 >> 12)
                        if self.version == 1:
                            noise = most[j] + sum(2 * abs(each) >> unit for each in off[:j])
                            context = context_of(kind, j, noise)
                            errors[n, octant, j] = self.error(stream, channel, pool, context)
                        off[j] = errors[n, octant, j]
                        found[c] = self.corrected(channel, guess, off[j])
                        sums[j] += found[c] - value[j]
                    values.append(found)
        stream.end()

    def error(self, stream: Stream, channel: Any, pool: Pool, context: int) -> int:
        symbol = stream.symbol(pool, context)
        if np.dtype(channel["dtype"]).itemsize > 1 and symbol >= 16:
            length = (symbol - 16) // 4 + 5
            symbol = (4 | symbol & 3) << length - 3 | stream.plain(length - 3)
        return near(symbol) * (2 * channel["max_error"] + 1)

    def corrected(self, channel: Any, guess: int, off: int) -> int:
        most, error = (1 << 8 * np.dtype(channel["dtype"]).itemsize) - 1, channel["max_error"]
        if not error:
            return guess + off & most
        number, step = min(max(guess, 0), most) + off, 2 * error + 1
        steps = (most + 2 * error) // step + 1
        number += steps * step * ((number < -error) - (number > most + error))
        return min(max(number, 0), most)

    def rows(self, number: int, owners: list[int], kind: int) -> list[list[int]]:
        channel, pool, values = self.head["channels"][number], self.pools[4 + number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        most = (1 << 8 * np.dtype(channel["dtype"]).itemsize) - 1
        stream = Stream(self.next_bytes())
        found: list[list[int]] = []
        before, last = [0] * components, -1
        for cell in owners:
            if cell != last:
                before = [0] * components
            row, shift, noise, last = [0] * components, 0, 0, cell
            for j, c in enumerate([1, 0, 2, 3][:components] if components > 2 else range(components)):
                own = values[cell][c]
                guess = min(max(own + (shift if components > 2 else 0), 0), most)
                varies = min((abs(before[j]) >> unit) + noise, 255)
                context = (kind * components + j) * 11 + sum(step <= varies for step in STEPS)
                off = self.error(stream, channel, pool, context)
                row[c] = self.corrected(channel, guess, off)
                before[j] = shift = row[c] - own
                noise += 2 * abs(off) >> unit
            found.append(row)
        stream.end()
        return found


def moved(place: tuple[int, ...], k: int) -> tuple[int, ...]:
    """Return the place across face k."""
    return tuple(i + (2 * (k & 1) - 1) * (axis == k >> 1) for axis, i in enumerate(place))
