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
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from inputs import UNIT_CUBE, painted_torus, scattered_on_sphere, torus, view
from measuring import Answer, memory, timed

import octex
from octex.conversion.levels import assemble, cell_levels
from octex.parallel import silent
from octex.tree.octree import Octree


@cache
def compile_lookups() -> None:
    """Have all loaded and compiled that tasks need."""
    with TemporaryDirectory() as folder:
        octex.convert(painted_torus(20, 10, 16), 5).save(Path(folder, "small.octex"))
        small = octex.open(Path(folder, "small.octex"))
    points = np.full((400, 3), 0.5, np.float32)
    small.level(3).sample(points.astype(np.float64))
    small.sample(points, out=np.empty((400, 3), np.float32))
    small.sample(points.astype(np.float64), dPdx=points.astype(np.float64), dPdy=points.astype(np.float64))


def tree(around: int, across: int, depth: int) -> Answer:
    """From triangles to the finished tree with areas and flags, on one thread."""
    vertices, triangles, _ = torus(around, across)

    def build() -> Octree:
        surface = octex.Surface.from_arrays(vertices, triangles)
        with ThreadPoolExecutor(1) as pool:
            filled = cell_levels(surface, None, (), UNIT_CUBE, depth, pool, silent, has_samples=False)
        return assemble(filled).tree

    spent, built = timed(build)
    return {"spent": spent._asdict(), "leaves": built.n_leaves, "peak": memory("VmHWM")}


def large(around: int, across: int, size: int, depth: int, path: str) -> Answer:
    """Convert a large model and save it."""
    surface = painted_torus(around, across, size)
    converted, texture = timed(lambda: octex.convert(surface, depth))
    saved, _ = timed(lambda: texture.save(path))
    answer = {"convert": converted._asdict(), "save": saved._asdict(), "leaves": texture.tree.n_leaves}
    return answer | {"bytes": texture.info()["bytes"]["total"], "peak": memory("VmHWM")}


def look(path: str, level: int) -> Answer:
    """Open a file that is not in the system's cache, and read 20 × 20 points of a coarse level."""
    drop_from_cache(path)
    left, before, begin = cached_bytes(path), memory("VmRSS"), time.perf_counter()
    texture = octex.open(path)
    cold, opened = time.perf_counter() - begin, memory("VmRSS") - before
    low, high = texture.bounds
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0, 1, 20)]))
    points = low + np.stack([x, y, np.full(400, 0.5)], axis=1) * (high - low)
    looked, _ = timed(lambda: texture.level(level).sample(points))
    touched = cached_bytes(path) - left
    warm = float(np.median([timed(lambda: octex.open(path))[0].wall for _ in range(20)]))
    return {"cold": cold, "warm": warm, "opened": opened, "look": looked.wall, "touched": touched}


def image(path: str, pixels: int) -> Answer:
    """Open a file that is not in the system's cache, and look at all of the sphere in pixels²."""
    seen = view(pixels)
    drop_from_cache(path)
    left = cached_bytes(path)
    texture = octex.open(path)
    spent, _ = timed(lambda: texture.sample(seen.points, dPdx=seen.dPdx, dPdy=seen.dPdy))
    return {"touched": cached_bytes(path) - left, "wall": spent.wall}


def resident(path: str, count: int) -> Answer:
    """Open a file and look up random points of the sphere in it; say how much memory that takes."""
    points = scattered_on_sphere(count)
    out = np.ones((count, 3), np.float32)  # written to, so that it is there
    before = memory("VmRSS")
    texture = octex.open(path)
    texture.sample(points, out=out)
    return {"grown": memory("VmRSS") - before}


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
        first = ctypes.c_char.from_buffer(mapping)
        length, to = ctypes.c_size_t(len(mapping)), ctypes.c_void_p(pages.ctypes.data)
        failed = library.mincore(ctypes.c_void_p(ctypes.addressof(first)), length, to)
        del first
    if failed:
        raise OSError(ctypes.get_errno(), "mincore")
    return int((pages & 1).sum()) * mmap.PAGESIZE


TASKS: dict[str, Callable[..., Answer]] = {
    each.__name__: each for each in (tree, large, look, image, resident)
}


def main() -> None:
    for line in sys.stdin:
        name, arguments = json.loads(line)
        if name != "tree":
            compile_lookups()
        print(json.dumps(TASKS[name](**arguments)), flush=True)


if __name__ == "__main__":
    main()
