"""Kill processes while they save a texture, and see that the file is the old one or the new one.

Two processes save two textures over one file, .octex and .octz in turn, without end; after a random time both
are killed (SIGKILL). Then the file must be one of the two, whole, and the next save must leave nothing else.
"""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from octex.channels import BASE_COLOR
from octex.texture import Channel, OctreeTexture
from octex.tree.morton import encode_cells
from octex.tree.octree import Octree
from octex.tree.placement import Placement


def check(seed: int) -> None:
    """Kill some saves."""
    with tempfile.TemporaryDirectory() as folder:
        made = textures()
        made[0].save(Path(folder) / "compile.octz")
        faults = killed(made, Path(folder), 10, random.Random(seed))
    assert not faults, "\n".join(faults)


def textures() -> list[OctreeTexture]:
    """Make two textures, a flat sheet of cells each, whose files differ in every array."""
    made = []
    for depth in (6, 7):
        x, y = np.divmod(np.arange(4**depth), 1 << depth)
        tree = Octree.from_leaves(np.sort(encode_cells(np.stack([x, y, np.zeros_like(x)], axis=1))), depth)
        values = np.random.default_rng(depth).integers(0, 256, (tree.n_cells, 3), dtype=np.uint8)
        channel = Channel(BASE_COLOR, values, values[:0], values[:0])
        placement = Placement((0.0, 0.0, 0.0), 1.0)
        made.append(OctreeTexture(tree, {"base_color": channel}, placement, [[0] * 3, [1] * 3]))
    return made


def killed(made: list[OctreeTexture], folder: Path, count: int, chance: random.Random) -> list[str]:
    """Kill so many saves of two textures; return what was wrong."""
    faults = []
    wholes: dict[str, set[bytes]] = {}
    for number in range(count):
        path = folder / f"a{('.octex', '.octz')[number % 2]}"
        if path.name not in wholes:
            wholes[path.name] = set()
            for texture in made:
                texture.save(path)
                wholes[path.name].add(path.read_bytes())
        writers = [_writer(texture, path) for texture in made]
        time.sleep(chance.uniform(0.0, 0.06))
        for writer in writers:
            os.kill(writer, signal.SIGKILL)
            os.waitpid(writer, 0)
        if path.read_bytes() not in wholes[path.name]:
            faults.append(f"{number}: the file is neither the old one nor the new one")
        made[number % 2].save(path)
        left = [each.name for each in folder.iterdir() if each.name.startswith(".")]
        if left:
            faults.append(f"{number}: the next save left {left}")
            for name in left:
                (folder / name).unlink()
    return faults


def _writer(texture: OctreeTexture, path: Path) -> int:
    """Start a process that saves a texture over and over; return its number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads idle
        child = os.fork()
    if child == 0:
        while True:
            texture.save(path)
    return child
