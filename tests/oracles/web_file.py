"""Web files read as octex/formats/FORMAT.md says, a cell at a time, without octex."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any


class WebFile:
    """A part of a web file: masks of nodes, and of each cell its parent, flags and values."""

    def __init__(self, path: Path, part: int = 0) -> None:
        whole = path.read_bytes()
        magic, version, length = struct.unpack("<8sII", whole[:16])
        assert (magic, version) == (b"octexweb", 1)
        header = json.loads(whole[16 : 16 + length])
        self.header = header["parts"][part]
        first = 16 + length
        self.masks: list[tuple[int, int]] = []
        self.parents = [-1]
        self.areas: dict[int, int] = {}  # of cells that are nodes
        self.flags: list[int] = []
        self.values: dict[str, list[list[int]]] = {each["name"]: [] for each in self.header["channels"]}
        self._nodes = [0] if self.header["levelNodes"][-1] else []  # the cells of the nodes that are known
        for number, chunk in enumerate(self.header["chunks"]):
            begin, size = header["streams"][f"{part}-levels-{number}"]
            data = zlib.decompress(whole[first + begin : first + begin + size], -15)
            if chunk["levels"] is not None:
                at = 0
                for level in range(*chunk["levels"]):
                    at = self._level(level, data, at)
                assert at == len(data)

    def _level(self, level: int, data: bytes, at: int) -> int:
        cells, nodes = self.header["levelCells"], self.header["levelNodes"]
        own = range(cells[level], cells[level + 1])
        if level:
            count = nodes[level] - nodes[level - 1]
            for n in range(count):
                masks = data[at + n], data[at + count + n]
                self.masks.append(masks)
                for octant in range(8):
                    if (masks[0] | masks[1]) >> octant & 1:
                        if masks[0] >> octant & 1:
                            self._nodes.append(len(self.parents))
                        self.parents.append(self._nodes[nodes[level - 1] + n])
            at += 2 * count
        for cell in self._nodes[nodes[level] :]:
            self.areas[cell] = (data[at] + self.areas.get(self.parents[cell], 0)) % 256
            at += 1
        for cell in own:
            self.flags.append(data[at] ^ (self.flags[self.parents[cell]] if level else 0))
            at += 1
        for channel in self.header["channels"]:
            width, found = channel["components"], self.values[channel["name"]]
            for n, cell in enumerate(own):
                parts = [data[at + k * len(own) + n] for k in range(width)]
                above = list(found[self.parents[cell]]) if level else [0] * width
                if width == 3:
                    above = [above[0] - above[1], above[1], above[2] - above[1]]
                parts = [(a + b) % 256 for a, b in zip(parts, above, strict=True)]
                if width == 3:
                    parts = [(parts[0] + parts[1]) % 256, parts[1], (parts[2] + parts[1]) % 256]
                found.append(parts)
            at += width * len(own)
        return at

    def leaves(self) -> list[Any]:
        """Return the cells that are no nodes."""
        nodes = set(self._nodes)
        return [cell for cell in range(len(self.parents)) if cell not in nodes]
