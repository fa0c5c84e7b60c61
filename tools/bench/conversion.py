"""Benchmarks of conversion: cells of a mesh, coloured cells, and a model of very many leaves."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from statistics import median

from inputs import painted_torus, write_mesh
from inputs import torus as torus_mesh
from measuring import Report, Setup, Spent, in_turns, megabytes, millions, open3d, pinned, task, timed

import octex


def torus(setup: Setup, report: Report) -> None:
    """Cut a torus of a million triangles into cells, beside Open3D, on one thread."""
    around, across, depth = (40, 20, 6) if setup.quick else (1000, 500, 10)
    report.title(f"torus: {2 * around * across:,} triangles, {1 << depth} cells along an edge, one thread")
    mesh = setup.folder / "torus.bin"
    write_mesh(mesh, *torus_mesh(around, across)[:2])
    size = {"around": around, "across": across, "depth": depth}
    own = "octex, tree with flags and areas"
    if not setup.quick:  # so that its memory is not that of compiling
        with task(setup, "tree", pin=False, around=20, across=10, depth=6) as work:
            work.run()
    with (
        task(setup, "tree", **size) as tree,
        open3d(setup, report, "cells", mesh, 1 << depth, core=setup.core) as peer,
    ):
        spent = in_turns({own: tree.spent, **peer}, setup.repeats)
        built = tree.run()
    for name, each in spent.items():
        report.line(name, f"{each}   {millions(built['leaves'] / each.cpu)} cells/s")
    report.line("cells", f"{built['leaves']:,}")
    if not setup.quick:
        report.at_least("torus: cells (those that the surface meets)", built["leaves"], 3.35e6, "cells")
    if peer:
        report.at_least("torus: tree, faster than Open3D", spent["Open3D"].cpu / spent[own].cpu, 6)
    report.at_most("torus: peak memory of the process", built["peak"] / 2**20, 500, "MB")


def boombox(setup: Setup, report: Report) -> None:
    """Convert a surface in memory into a texture: coloured cells a second, on one thread and on two."""
    path = setup.models / "BoomBoxWithAxes" / "BoomBoxWithAxes.gltf" if setup.models else None
    if path and path.is_file():
        surface, depth = octex.load_surface(path, channels=["base_color"]), 6 if setup.quick else 10
    else:
        report.note("boombox: left out without --models; a painted torus in its place")
        surface, depth = (
            (painted_torus(40, 20, 256), 6) if setup.quick else (painted_torus(120, 70, 2048), 10)
        )
    report.title(f"boombox: {surface.name}, {len(surface.triangles):,} triangles, depth {depth}")
    cores = sorted(os.sched_getaffinity(0))
    pair = {setup.core, *[core for core in cores if core != setup.core][:1]}

    def convert(threads: int) -> octex.OctreeTexture:
        with ThreadPoolExecutor(threads) as pool:
            return octex.convert(surface, depth, fit=False, run=octex.Run(executor=pool))

    def on(used: set[int], threads: int) -> Spent:
        with pinned(used):
            return timed(lambda: convert(threads))[0]

    texture = convert(1)
    one, two = "one thread", "two threads"
    spent = in_turns({one: lambda: on({setup.core}, 1), two: lambda: on(pair, 2)}, setup.repeats)
    leaves, cells = texture.tree.n_leaves, texture.tree.n_cells
    for name, each in spent.items():
        rate = leaves / (each.cpu if name == one else each.wall)
        report.line(name, f"{each}   {millions(rate)} leaves/s")
    report.line("cells", f"{leaves:,} leaves, {cells:,} with the nodes' averages")
    report.at_least("boombox: a core", leaves / spent[one].cpu / 1e6, 4, "M leaves/s")
    if len(pair) == 2:
        report.at_least(
            "boombox: two threads beside one, by the wall", spent[one].wall / spent[two].wall, 1.7
        )
    else:
        report.note("left out: two threads (one processor)")


def large(setup: Setup, report: Report) -> None:
    """Memory that a model of fifty million leaves takes, and what opening it and a coarse look cost."""
    around, across, size, depth = (40, 20, 256, 6) if setup.quick else (1000, 500, 4096, 12)
    report.title(f"large: painted torus, {2 * around * across:,} triangles, {size}² texels, depth {depth}")
    path = setup.folder / "large.octex"
    arguments = {"around": around, "across": across, "size": size, "depth": depth, "path": str(path)}
    with task(setup, "large", pin=False, **arguments) as work:
        made = work.run()
    convert, save = Spent(**made["convert"]), Spent(**made["save"])
    report.line("leaves, bytes of the file", f"{made['leaves']:,}, {megabytes(made['bytes'])}")
    report.line(
        "convert, all processors",
        f"{convert}   {millions(made['leaves'] / convert.wall)} leaves/s by the wall",
    )
    report.line("save", save)
    level = 3 if setup.quick else 5
    with task(setup, "look", path=str(path), level=level) as work:
        looks = [work.run() for _ in range(setup.repeats)]
    look = {name: median(look[name] for look in looks) for name in looks[0]}
    report.line("open: nothing cached, cached", f"{look['cold'] * 1e3:.2f} ms, {look['warm'] * 1e3:.2f} ms")
    report.line(f"20 × 20 points at level {level}, nothing cached", f"{look['look'] * 1e3:.2f} ms")
    if look["left"]:
        report.note(f"{megabytes(look['left'])} of the file could not be dropped from the system's cache")
    report.at_least("large: leaves", made["leaves"] / 1e6, 50, "M")
    report.at_most("large: peak memory of the conversion", made["peak"] / 2**30, 6, "GB")
    report.at_most("large: opening (nothing cached)", look["cold"] * 1e3, 5, "ms")
    report.at_most("large: new memory after opening (first time)", looks[0]["opened"] / 2**20, 5, "MB")
    report.at_most("large: read from the file by a coarse look", look["touched"] / 2**20, 0.5, "MB")
    path.unlink()


assert sys.platform == "linux", "the benchmarks measure memory and processors as Linux counts them"
