"""Archives read as octex/formats/FORMAT.md says, a symbol at a time, without octex."""

from __future__ import annotations

import json
import lzma
import zlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

STEPS = 1, 2, 3, 6, 10, 16, 24, 36, 52, 80
AREAS = [0] + [round(2 ** ((c - 207) / 8 + 30)) for c in range(1, 256)]
KNOWN = {f"tree/{name}" for name in ("groups", "level_cells", "level_nodes", "flags", "areas")}
KNOWN |= {"split/cells", "split/facings", "split/areas", "kept/cells"}
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

    def plain(self, count: int) -> int:
        found = 0
        for done in range(0, count, 12):
            bits = min(count - done, 12)
            part = self.low() >> 12 - bits
            self.take(part << 12 - bits, 1 << 12 - bits)
            found |= part << done
        return found

    def end(self) -> None:
        assert self.states == [1 << 16] * 4
        assert next(self.words, None) is None


def near(code: int) -> int:
    """Fold back."""
    return -(code + 1 >> 1) if code & 1 else code >> 1


def highest(area: int) -> int:
    """Return the highest code of an area that is not above."""
    return max(c for c in range(256) if AREAS[c] <= area)


def numbers_in(content: bytes) -> list[int]:
    """Return the numbers of models."""
    said, value, bits = [], 0, 0
    for byte in content:
        value |= (byte & 127) << bits
        bits += 7
        if byte < 128:
            said.append(value)
            value = bits = 0
    written, more, found = said[1 : 1 + said[0]], said[1 + said[0] :], list[int]()
    for number in written:
        found += [number] if number else [0] * (1 + more.pop(0))
    assert not more
    return found


class Archive:
    """What an archive holds: level by level its cells, each with its flags, area, values …."""

    def __init__(self, content: bytes) -> None:
        assert content[8:12] == bytes([1, 0, 0, 0])
        begin = int.from_bytes(content[16:24], "little")
        lengths = np.frombuffer(content, "<u4", 4, begin).tolist()
        parts = lzma.decompress(content[begin + 16 :])
        ends = [sum(lengths[:n]) for n in range(5)]
        assert len(parts) == ends[4]
        header, root, models, records = (parts[a:b] for a, b in pairwise(ends))
        self.tensors = json.loads(header)
        self.metadata = self.tensors.pop("__metadata__")
        self.channels = []
        for name in json.loads(self.metadata["channels"]):
            entry = self.tensors[f"channels/{name}"]
            dtype = {"U8": "u1", "U16": "u2", "F16": "f2", "F32": "f4"}[entry["dtype"]]
            self.channels.append({"dtype": dtype, "components": entry["shape"][1]})
        numbers = iter(numbers_in(models))
        contexts = [1 << 15, 13, 2160, 6066] + [44 * each["components"] + 2 for each in self.channels]
        self.pools = [self.pool(numbers, each) for each in contexts]
        self.weights = [
            [near(next(numbers)) for _ in range(2 * 5 * 10 * each["components"])] for each in self.channels
        ]
        assert next(numbers, None) is None
        self.records = iter(np.frombuffer(records, "<u4").tolist())
        self.content, self.at = content, 32
        self.begin(root)
        self.read()
        assert self.at == begin
        assert next(self.records, None) is None

    def begin(self, root: bytes) -> None:
        """Take what the directory says of the levels and of the root."""
        at = 0

        def take(count: int) -> bytes:
            nonlocal at
            at += count
            return root[at - count : at]

        size = self.tensors["tree/level_cells"]["shape"][0]
        self.level_cells, self.level_nodes = (np.frombuffer(take(8 * size), "<i8").tolist() for _ in range(2))
        for each in self.channels:
            each["max_error"], each["unit"] = np.frombuffer(take(8), "<u4").tolist()
        flags, area = take(2)
        rows = (flags & 63).bit_count() if flags & 128 else 0
        self.flags, self.areas, self.split_areas = [flags], [area], list(take(rows))
        self.values: list[list[list[int]]] = []
        self.split_values: list[list[list[int]]] = []
        self.kept_values: list[list[list[int]]] = []
        for each in self.channels:
            size = np.dtype(each["dtype"]).itemsize * each["components"]
            for found, count in (
                (self.values, 1),
                (self.split_values, rows),
                (self.kept_values, flags >> 6 & 1),
            ):
                found.append([self.keys(each, take(size)) for _ in range(count)])
        assert at == len(root)

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
        self.masks: list[tuple[int, int]] = []  # of nodes: occupied octants, those of leaves
        # Of nodes of a level: place, cell; of all: the first child cell.
        nodes: dict[tuple[int, ...], tuple[int, int]] = {(0, 0, 0): (0, 0)} if self.level_nodes[1] else {}
        cells: dict[tuple[int, ...], int] = {(0, 0, 0): 0}
        self.firsts: list[int] = []
        for level in range(len(self.level_cells) - 2):
            below: dict[tuple[int, ...], int] = {}
            nodes_below: dict[tuple[int, ...], tuple[int, int]] = {}
            order = list(nodes.items())
            first = self.level_nodes[level]
            while order:
                size = 16384 - first % 16384
                self.block(level, order[:size], nodes, cells, below, nodes_below)
                order, first = order[size:], first + size
            nodes, cells = nodes_below, below
        self.others = {}
        known = KNOWN | {
            f"{table}channels/{name}"
            for table in ("", "split/", "kept/")
            for name in json.loads(self.metadata["channels"])
        }
        for name, each in self.tensors.items():
            if name not in known:
                left, parts = each["data_offsets"][1] - each["data_offsets"][0], b""
                while len(parts) < left:
                    parts += lzma.decompress(self.next_bytes())
                self.others[name] = parts

    def keys(self, channel: dict[str, Any], content: bytes) -> list[int]:
        """Return numbers in the order of values, component by component."""
        bits = 8 * np.dtype(channel["dtype"]).itemsize
        found = np.frombuffer(content, f"<u{bits // 8}").tolist()
        if channel["dtype"].startswith("f"):
            sign = 1 << bits - 1
            found = [v ^ (2 * sign - 1) if v & sign else v ^ sign for v in found]
        return found

    def block(
        self, level: int, order: list[Any], nodes: Any, cells: Any, below: Any, nodes_below: Any
    ) -> None:
        counts = [next(self.records) for _ in range(5)]
        begin = len(self.flags)
        own = {place: n for n, (place, _) in enumerate(order)}  # nodes of the block
        masks: list[int] = []
        firsts: list[int] = []
        children: list[tuple[int, int]] = []  # node of the block, octant
        has_nodes: list[int] = []
        may_be_nodes = level + 3 < len(self.level_cells)
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
            alike = len(shown) == 1 and stream.symbol(pools[1], 12)
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
        split = [cell for cell in range(begin, len(self.flags)) if self.flags[cell] & 128]
        kept = [cell for cell in range(begin, len(self.flags)) if self.flags[cell] & 64]
        rows = [cell for cell in split for _ in range((self.flags[cell] & 63).bit_count())]
        child_nodes = sum((there & ~leaves).bit_count() for there, leaves in self.masks[-len(order) :])
        assert counts == [child_nodes, len(children), len(split), len(rows), len(kept)]
        stream = Stream(self.next_bytes())
        before = -1
        for cell, (n, octant) in enumerate(children, begin):
            place, (_, parent) = order[n]
            if n != before:
                whole, left = min(self.areas[parent] + 16, 255), masks[n].bit_count() + 1
                rest = AREAS[whole]
            before, left = n, left - 1
            shown = [k for k in range(6) if self.flags[cell] >> k & 1]
            own_axis = shown[0] >> 1 if len(shown) == 1 else 0
            pairs, sizes = [0, 0, 0], [0, 0, 0]
            for axis in range(3):
                across, outside = octant ^ 1 << axis, moved(place, 2 * axis + (octant >> axis & 1))
                beyond = masks[own[outside]] >> across & 1 if outside in own else int(outside in cells)
                pairs[axis] = 2 * (masks[n] >> across & 1) + beyond
                around = [moved(place, k) for k in range(6)]
                beside = self.beside(n, octant, axis, around, own, masks, firsts)
                sizes[axis] = 0 if beside is None else self.areas[beside]
            pair, along = pairs.pop(own_axis), sizes.pop(own_axis)
            guess, m = whole, 20
            if len(shown) == 1:
                m = 5 * pair + sum(each.bit_count() for each in pairs)
                if pair == 0 and max(sizes) > 0:
                    guess = max(sizes)
                elif pair in (1, 2) and along > 0:
                    column = AREAS[self.areas[parent]]
                    for side in (moved(place, 2 * own_axis), moved(place, 2 * own_axis + 1)):
                        column += AREAS[self.areas[cells[side]]] if side in cells else 0
                    guess = highest(max(column - AREAS[along], column >> 6))
            q = [1 + (whole - c >= 8) + (whole - c >= 16) if c else 0 for c in (max(sizes), along)]
            context = (m * 3 + min(left, 3) - 1) * 16 + q[0] * 4 + q[1]
            rest, area = self.area(stream, whole, rest, left, context, guess)
            self.areas.append(area)
        for n, cell in enumerate(rows):
            if n == 0 or rows[n - 1] != cell:
                left, rest = rows.count(cell), AREAS[self.areas[cell]]
            whole, context = self.areas[cell], 1008 + min(left, 3) - 1
            rest, area = self.area(stream, whole, rest, left, context, whole)
            self.split_areas.append(area)
            left -= 1
        stream.end()
        for number in range(len(self.channels)):
            stream = self.channel(number, order, children, has_nodes, cells, own, masks, firsts)
            self.split_values[number] += self.rows(stream, number, rows, 2)
            self.kept_values[number] += self.rows(stream, number, kept, 3)
            stream.end()

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
        self, stream: Stream, whole: int, rest: int, left: int, context: int, guess: int
    ) -> tuple[int, int]:
        rest = max(rest, AREAS[whole] >> 8)
        code = highest(rest)
        d = max(whole - code, 0)
        p = 5 - sum(d >= step for step in (4, 9, 17, 25, 36))
        guess = code if left == 1 else guess
        area = guess + stream.symbol(self.pools[3], context * 6 + p) & 255
        return rest - AREAS[area], area

    def channel(
        self, number: int, order: Any, children: Any, has_nodes: Any, cells: Any, own: Any, masks: Any,
        firsts: Any,
    ) -> Stream:  # fmt: skip
        channel, pool, values = self.channels[number], self.pools[4 + number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        order_of = [1, 0, 2, 3][:components] if components > 2 else range(components)

        def context_of(kind: int, j: int, noise: int) -> int:
            return (kind * components + j) * 11 + sum(step <= min(noise, 255) for step in STEPS)

        stream = Stream(self.next_bytes())
        for begin in range(0, len(order), 32):
            nodes = []
            for n, (place, (_, cell)) in enumerate(order[begin : begin + 32], begin):
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
                for n, octant, kind, most in listed:
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
                        off[j] = errors[n, octant, j]
                        found[c] = self.corrected(channel, guess, off[j])
                        sums[j] += found[c] - value[j]
                    values.append(found)
        return stream

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

    def rows(self, stream: Stream, number: int, owners: list[int], kind: int) -> list[list[int]]:
        channel, pool, values = self.channels[number], self.pools[4 + number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        most = (1 << 8 * np.dtype(channel["dtype"]).itemsize) - 1
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
        return found


def moved(place: tuple[int, ...], k: int) -> tuple[int, ...]:
    """Return the place across face k."""
    return tuple(i + (2 * (k & 1) - 1) * (axis == k >> 1) for axis, i in enumerate(place))
