"""Archives read as octex/formats/FORMAT.md says, a symbol at a time, without octex."""

from __future__ import annotations

import json
import lzma
import zlib
from itertools import pairwise
from typing import Any

import numpy as np

STEPS = 1, 2, 3, 6, 10, 16, 24, 36, 52, 80
AREAS = [0] + [round(2 ** ((c - 207) / 8 + 30)) for c in range(1, 256)]
KNOWN = {f"tree/{name}" for name in ("groups", "level_cells", "level_nodes", "flags", "areas")}
KNOWN |= {"split/cells", "split/facings", "split/areas", "kept/cells"}
RATES = [rate for rate, count in enumerate([1, 2, 4, 12, 40, 100, 90], 1) for _ in range(count)]
TOKENS = *((n, 0) for n in range(8)), (8, 2), (12, 2), (16, 3), (24, 3), (32, 4), (48, 4), (64, 6), (128, 7)


class Model:
    """What is known of contexts: what their symbols begin at less their number, and the odds of bits."""

    def __init__(self) -> None:
        self.numbers: dict[int, list[int]] = {}
        self.seen: dict[int, int] = {}
        self.odds: dict[int, int] = {}

    def copy(self) -> Model:
        found = Model()
        found.numbers = {context: list(numbers) for context, numbers in self.numbers.items()}
        found.seen, found.odds = dict(self.seen), dict(self.odds)
        return found


class Stream:
    """Words, read as symbols."""

    def __init__(self, content: bytes, model: Model) -> None:
        words = np.frombuffer(content, "<u4").tolist()
        self.states = [words[0] | words[1] << 32, words[2] | words[3] << 32]
        self.words = iter(words[4:])
        self.count = 0
        self.model = model

    def low(self) -> int:
        return self.states[self.count % 2] & 32767

    def take(self, start: int, size: int, bits: int = 0) -> int:
        x = self.states[self.count % 2]
        x = size * (x >> 15) + (x & 32767) - start
        plain, x = x & (1 << bits) - 1, x >> bits
        self.states[self.count % 2] = x << 32 | next(self.words) if x < 1 << 31 else x
        self.count += 1
        return plain

    def symbol(self, context: int) -> int:
        return self.token(context, [0] * 16)[0]

    def token(self, context: int, bits: list[int]) -> tuple[int, int]:
        """Return a symbol, and the plain bits that follow it, so many of each symbol."""
        model = self.model
        numbers = model.numbers.setdefault(context, [2047 * i for i in range(16)])
        starts = [number + i for i, number in enumerate(numbers)] + [32768]
        symbol = sum(start <= self.low() for start in starts) - 1
        plain = self.take(starts[symbol], starts[symbol + 1] - starts[symbol], bits[symbol])
        seen = model.seen.get(context, 0)
        rate, model.seen[context] = RATES[seen], min(seen + 1, len(RATES) - 1)
        for i in range(16):
            numbers[i] += (32752 >> rate if i > symbol else 0) - (numbers[i] >> rate)
        return symbol, plain

    def bit(self, context: int) -> int:
        odds = self.model.odds.get(context, 32768)
        zeros = min(max(odds >> 1, 16), 32752)
        bit = int(self.low() >= zeros)
        self.take(zeros if bit else 0, 32768 - zeros if bit else zeros)
        self.model.odds[context] = odds - (odds >> 5) if bit else odds + (65536 - odds >> 5)
        return bit

    def plain(self, count: int) -> int:
        return self.take(0, 1 << 15, count)

    def long(self, count: int) -> int:
        return sum(self.plain(min(count - done, 15)) << done for done in range(0, count, 15))

    def number(self, context: int, unit: int, size: int) -> tuple[int, int]:
        """Return a number, and what contexts take it for."""
        bits = [bits for _, bits in TOKENS]
        if size > 1:
            bits[15] = 5
        token, plain = self.token(context, bits)
        least, _ = TOKENS[token]
        if size == 1:
            return least + plain, least
        high = least + plain
        if token == 15:
            high = (1 << 7 + plain) + self.long(7 + plain)
        number = high << unit | self.long(unit)
        return number, number

    def end(self) -> None:
        assert self.states == [1 << 31] * 2
        assert next(self.words, None) is None


def near(code: int) -> int:
    """Fold back."""
    return -(code + 1 >> 1) if code & 1 else code >> 1


def highest(area: int) -> int:
    """Return the highest code of an area that is not above."""
    return max(c for c in range(256) if AREAS[c] <= area)


class Archive:
    """What an archive holds: level by level its cells, each with its flags, area, values …."""

    def __init__(self, content: bytes) -> None:
        assert content[8:12] == bytes([1, 0, 0, 0])
        begin = int.from_bytes(content[16:24], "little")
        lengths = np.frombuffer(content, "<u4", 3, begin).tolist()
        parts = lzma.decompress(content[begin + 12 :])
        ends = [sum(lengths[:n]) for n in range(4)]
        assert len(parts) == ends[3]
        header, root, records = (parts[a:b] for a, b in pairwise(ends))
        self.tensors = json.loads(header)
        self.metadata = self.tensors.pop("__metadata__")
        self.channels = []
        for name in json.loads(self.metadata["channels"]):
            entry = self.tensors[f"channels/{name}"]
            dtype = {"U8": "u1", "U16": "u2", "F16": "f2", "F32": "f4"}[entry["dtype"]]
            self.channels.append({"dtype": dtype, "components": entry["shape"][1]})
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
            each["weights"] = np.frombuffer(take(400 * each["components"]), "<i4").tolist()
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

    def stream(self, kind: object) -> Stream:
        model = self.models.get(kind, Model())
        if self.is_only:
            self.models[kind] = model
        return Stream(self.next_bytes(), model if self.is_only else model.copy())

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
        self.models: dict[object, Model] = {}
        for level in range(len(self.level_cells) - 2):
            below: dict[tuple[int, ...], int] = {}
            nodes_below: dict[tuple[int, ...], tuple[int, int]] = {}
            order = list(nodes.items())
            first = self.level_nodes[level]
            while order:
                size = 16384 - first % 16384
                self.is_only = len(order[:size]) == len(nodes)
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
        stream, was_leaf, number = self.stream("structure"), 0, len(nodes_below)
        for n, (place, (_, cell)) in enumerate(order):
            around = [moved(place, k) for k in range(6)]
            faces = sum((each in cells) << k for k, each in enumerate(around))
            x, y, z = (masks[own[around[k]]] if around[k] in own else 0 for k in (0, 2, 4))
            low = (x >> 1 & 1 | x >> 2 & 2) << 6 | (y >> 2 & 3) << 4 | z >> 4
            there = stream.symbol(low + 256 * (faces >> 1 & 1 | faces >> 2 & 2))
            high = (x >> 5 & 1 | x >> 6 & 2) << 6 | (y >> 6 & 3) << 4 | there
            high += 256 * (faces >> 1 & 1 | faces >> 2 & 2 | faces >> 3 & 4)
            there |= stream.symbol(1024 + high) << 4
            leaves = 0 if may_be_nodes else there
            if may_be_nodes:
                count = min(sum(each in cells and each not in nodes for each in around), 3)
                for octant in range(8):
                    if there >> octant & 1:
                        was_leaf = stream.bit(4 * was_leaf + count)
                        leaves |= was_leaf << octant
            masks.append(there)
            firsts.append(len(self.flags))
            has_nodes.append(int(leaves != there))
            self.masks.append((there, leaves))
            parent = self.flags[cell]
            shown = [k for k in range(6) if parent >> k & 1]

            union = t = 0
            alike = stream.bit(8 + 2 * min(len(shown), 3) + (parent >> 7))
            for octant in range(8):
                if not there >> octant & 1:
                    continue
                some = 0
                for axis in range(3):
                    beside = self.beside(n, octant, axis, around, own, masks, firsts)
                    some |= self.flags[beside] if beside is not None else 0
                flags = parent & 63 if alike else 0
                for k in () if alike else shown:
                    place_of = 0 if flags else 1 + (k == shown[-1])
                    known = 2 * (some >> k & 1) + (union >> k & 1)
                    flags |= stream.bit(16 + (known * 3 + place_of) * 4 + min(len(shown), 4) - 1) << k
                if not alike:
                    some = min(flags.bit_count(), 2) * 2 + (parent >> 7)
                    flags |= stream.bit(64 + some * 3 + t) << 7
                    if not leaves >> octant & 1:
                        flags |= stream.bit(82 + (parent >> 6 & 1)) << 6
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
        stream = self.stream("areas")
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
        off, plain = stream.token(context * 6 + p, [6, 5, 4, 3, 2, 1, 0, 0, 0, 0, 0, 1, 2, 3, 4, 7])
        off -= 8
        far = abs(off)
        if far > 2:
            far = 2 ** (far - 2) + 1 + plain
        area = guess + (far if off > 0 else -far) & 255
        return rest - AREAS[area], area

    def channel(
        self, number: int, order: Any, children: Any, has_nodes: Any, cells: Any, own: Any, masks: Any,
        firsts: Any,
    ) -> Stream:  # fmt: skip
        channel, values = self.channels[number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        size = np.dtype(channel["dtype"]).itemsize
        order_of = [1, 0, 2, 3][:components] if components > 2 else list(range(components))
        weights, was_flat, t = list(channel["weights"]), 0, 0
        stream = self.stream(number)

        def term(number: int) -> int:
            return number if size == 1 else min(max(number >> unit, -4096), 4096)

        for n, (place, (_, cell)) in enumerate(order):
            around = [moved(place, k) for k in range(6)]
            value = [values[cell][c] for c in order_of]
            differ = [
                [values[cells[each]][c] - values[cell][c] if each in cells else 0 for each in around]
                for c in order_of
            ]
            octants = [octant for m, octant in children if m == n]
            kind, flat = has_nodes[n], 0
            if not any(map(any, differ)):
                flat = was_flat = stream.bit(2 * kind + was_flat)
            most = [min(sum(map(abs, each)) >> unit + 1, 255) for each in differ]
            differ = [[term(each) for each in sides] for sides in differ]
            sums = [0] * components
            for i, octant in enumerate(octants):
                t += 1
                if flat:
                    values.append(values[cell])
                    continue
                found, off, noise = [0] * components, [0] * components, 0
                besides = [self.beside(n, octant, axis, around, own, masks, firsts) for axis in range(3)]
                for j, c in enumerate(order_of):
                    step = sum(step <= most[j] for step in (1, 4, 16, 48))
                    at = 10 * ((kind * components + j) * 5 + step)
                    terms = [sum(differ[j][2 * axis + (octant >> axis & 1)] for axis in range(3))]
                    terms += [sum(differ[j])]
                    terms += [term(sum(values[b][c] - value[j] for b in besides if b is not None))]
                    terms += [term(sums[j]) * (65536 // (len(octants) - i)) >> 16]
                    for k in range(min(j, 3)):
                        terms += [term(off[k]), term(found[order_of[k]] - value[k])]
                    total = sum(weights[at + k] * each for k, each in enumerate(terms))
                    guess = value[j] + ((total + 2**19 >> 20) << unit)
                    varies = sum(step <= min(most[j] + noise, 255) for step in STEPS)
                    context = (kind * components + j) * 11 + varies
                    found[c], off[j], about = self.corrected(stream, channel, guess, context)
                    sums[j] += found[c] - value[j]
                    noise += 2 * abs(about) >> unit
                    if t % 4 == 1:
                        sign = (off[j] > 0) - (off[j] < 0)
                        for k, each in enumerate(terms):
                            weights[at + k] += sign * each << (9, 8, 7, 5, 3)[step]
                values.append(found)
        return stream

    def corrected(self, stream: Stream, channel: Any, guess: int, context: int) -> tuple[int, int, int]:
        """Return the number that was guessed, what the guess is off by, and what contexts take that for."""
        size, step = np.dtype(channel["dtype"]).itemsize, 2 * channel["max_error"] + 1
        most, error = (1 << 8 * size) - 1, channel["max_error"]
        off, about = (near(each) * step for each in stream.number(context, channel["unit"] + 4, size))
        number = min(max(guess, 0), most) + off
        steps = (most + 2 * error) // step + 1
        number += steps * step * ((number < -error) - (number > most + error))
        return min(max(number, 0), most), off, about

    def rows(self, stream: Stream, number: int, owners: list[int], kind: int) -> list[list[int]]:
        channel, values = self.channels[number], self.values[number]
        components, unit = channel["components"], channel["unit"]
        found: list[list[int]] = []
        before, last = [0] * components, -1
        for cell in owners:
            if cell != last:
                before = [0] * components
            row, shift, noise, last = [0] * components, 0, 0, cell
            for j, c in enumerate([1, 0, 2, 3][:components] if components > 2 else range(components)):
                own = values[cell][c]
                guess = own + (shift if components > 2 else 0)
                varies = min((abs(before[j]) >> unit) + noise, 255)
                context = (kind * components + j) * 11 + sum(step <= varies for step in STEPS)
                row[c], _, about = self.corrected(stream, channel, guess, context)
                before[j] = shift = row[c] - own
                noise += 2 * abs(about) >> unit
            found.append(row)
        return found


def moved(place: tuple[int, ...], k: int) -> tuple[int, ...]:
    """Return the place across face k."""
    return tuple(i + (2 * (k & 1) - 1) * (axis == k >> 1) for axis, i in enumerate(place))
