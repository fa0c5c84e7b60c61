"""Octex's own side of the benchmarks that need a process to themselves; started by the benchmarks.

usage: worker.py       does a task for each line that it reads, of JSON: its name and its arguments
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from inputs import NoChannels, painted_torus, scattered_on_sphere, torus
from measuring import memory, timed
from painted_sphere import view

import octex
from octex.conversion.levels import assemble, cell_levels
from octex.parallel import silent
from octex.tree.octree import Octree
from octex.tree.placement import Placement

UNIT_CUBE = Placement((0.0, 0.0, 0.0), 1.0)

Answer = dict[str, Any]


@contextmanager
def small_texture() -> Iterator[octex.OctreeTexture]:
    """Open a small file: the code that a task needs is loaded and compiled before."""
    with TemporaryDirectory() as folder:
        octex.convert(painted_torus(20, 10, 16), 5).save(Path(folder, "small.octex"))
        yield octex.open(Path(folder, "small.octex"))


def tree(around: int, across: int, depth: int) -> Callable[[], Answer]:
    """From triangles to the finished tree with areas and flags, on one thread."""
    vertices, triangles, _ = torus(around, across)

    def build() -> Octree:
        surface = octex.Surface(vertices.astype(np.float64), triangles, NoChannels(), name="torus")
        with ThreadPoolExecutor(1) as pool:
            filled = cell_levels(surface, None, (), UNIT_CUBE, depth, pool, silent, has_samples=False)
        return assemble(filled).tree

    def task() -> Answer:
        spent, built = timed(build)
        return {**spent._asdict(), "leaves": built.n_leaves, "bytes": built.nbytes, "peak": memory("VmHWM")}

    return task


def large(around: int, across: int, size: int, depth: int, path: str) -> Callable[[], Answer]:
    """Convert a large model and save it."""
    octex.convert(painted_torus(20, 10, 16), 5)  # what it compiles is none of the model's

    def task() -> Answer:
        surface = painted_torus(around, across, size)
        converted, texture = timed(lambda: octex.convert(surface, depth))
        saved, _ = timed(lambda: texture.save(path))
        return {
            "convert": converted._asdict(),
            "save": saved._asdict(),
            "leaves": texture.tree.n_leaves,
            "bytes": texture.info()["bytes"]["total"],
            "peak": memory("VmHWM"),
        }

    return task


def look(path: str, level: int) -> Callable[[], Answer]:
    """Open a file that is not in the system's cache, and read 20 × 20 points of a coarse level."""
    with small_texture() as small:
        small.level(3).sample(np.full((400, 3), 0.5))

    def task() -> Answer:
        drop_from_cache(path)
        left = cached_bytes(path)
        before = memory("VmRSS")
        begin = time.perf_counter()
        texture = octex.open(path)
        cold = time.perf_counter() - begin
        opened = memory("VmRSS")
        low, high = texture.bounds
        x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0, 1, 20)]))
        points = low + np.stack([x, y, np.full(400, 0.5)], axis=1) * (high - low)
        looked, _ = timed(lambda: texture.level(level).sample(points))
        touched = cached_bytes(path) - left
        warm = []
        for _ in range(20):
            begin = time.perf_counter()
            octex.open(path)
            warm.append(time.perf_counter() - begin)
        return {
            "cold": cold, "warm": float(np.median(warm)), "opened": opened - before, "look": looked.wall,
            "touched": touched, "left": left,
        }  # fmt: skip

    return task


def picture(path: str, pixels: int) -> Callable[[], Answer]:
    """Open a file that is not in the system's cache, and look at all of the sphere in pixels²."""
    seen = view(pixels)
    with small_texture() as small:
        small.sample(seen.points[:100], dPdx=seen.dPdx[:100], dPdy=seen.dPdy[:100])

    def task() -> Answer:
        drop_from_cache(path)
        left = cached_bytes(path)
        texture = octex.open(path)
        spent, _ = timed(lambda: texture.sample(seen.points, dPdx=seen.dPdx, dPdy=seen.dPdy))
        return {"touched": cached_bytes(path) - left, "wall": spent.wall}

    return task


def resident(path: str, count: int) -> Callable[[], Answer]:
    """Open a file and look up random points of the sphere in it; say how much memory that takes."""
    points = scattered_on_sphere(count)
    out = np.ones((count, 3), np.float32)  # written to, so that it is there
    with small_texture() as small:
        small.sample(points[:1000], out=out[:1000])

    def task() -> Answer:
        before = memory("VmRSS")
        texture = octex.open(path)
        texture.sample(points, out=out)
        grown = memory("VmRSS") - before
        tiles = texture._field.tiles
        assert tiles is not None
        return {"grown": grown, "tiles": tiles.top.nbytes + tiles.masks.nbytes + tiles.firsts.nbytes}

    return task


def drop_from_cache(path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(descriptor)


def cached_bytes(path: str) -> int:
    """Bytes of a file that the system holds in memory."""
    library = ctypes.CDLL(None, use_errno=True)
    with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY) as mapping:
        pages = np.zeros(-(-len(mapping) // mmap.PAGESIZE), np.uint8)
        view = ctypes.c_char.from_buffer(mapping)
        failed = library.mincore(
            ctypes.c_void_p(ctypes.addressof(view)),
            ctypes.c_size_t(len(mapping)),
            ctypes.c_void_p(pages.ctypes.data),
        )
        del view
    if failed:
        raise OSError(ctypes.get_errno(), "mincore")
    return int((pages & 1).sum()) * mmap.PAGESIZE


TASKS: dict[str, Callable[..., Callable[[], Answer]]] = {
    "tree": tree, "large": large, "look": look, "resident": resident, "picture": picture,
}  # fmt: skip


def main() -> None:
    tasks: dict[str, Callable[[], Answer]] = {}
    for line in sys.stdin:
        if line not in tasks:
            name, arguments = json.loads(line)
            tasks[line] = TASKS[name](**arguments)
        print(json.dumps(tasks[line]()), flush=True)


if __name__ == "__main__":
    main()
