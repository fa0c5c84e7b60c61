#!/usr/bin/env python
"""Measure octex, some of it beside Open3D.

    python tools/bench                           octex's own figures
    python tools/bench torus transfer --peer-python PYTHON
    python tools/bench models lookups --models FOLDER
    python tools/bench --quick                   everything on tiny sizes: does it still run?

The peer is a Python that has Open3D. Figures without it, or without models, are left out, and said to be.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

from baking import atlas, baking
from conversion import cloud, filters, large, models, torus, transfer
from files import archive, mapped, paper
from filtered import far, footprints, stretched
from light import light
from lookups import lookups, mixed, sphere, today
from measuring import Setup, octex_worker
from painting import painting, processing, ring, whole
from painting_page import frames, session

BENCHMARKS = {
    each.__name__: each for each in (
        paper, archive, mapped, sphere, lookups, mixed, today, far, footprints, stretched, torus, models,
        large, filters, transfer, cloud, ring, whole, painting, processing, session, frames, baking, atlas,
        light,
    )
}  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    listing = "\n".join(
        f"  {name:9} {(each.__doc__ or '').splitlines()[0]}" for name, each in BENCHMARKS.items()
    )
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        epilog=f"benchmarks:\n{listing}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="BENCHMARK", help="all of them by default")
    parser.add_argument("--peer-python", metavar="PYTHON", help="one that has Open3D")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="of real models")
    parser.add_argument("--repeats", type=int, default=5, help="rounds, of which medians are taken (5)")
    parser.add_argument("--core", type=int, help="the processor for what runs on one thread (the last)")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where the files that are made stay")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, one round")
    options = parser.parse_args(arguments)
    unknown = set(options.names) - set(BENCHMARKS)
    if unknown:
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}")
    peer_python = options.peer_python and shutil.which(options.peer_python)
    if options.peer_python and not peer_python:
        parser.error(f"there is no program {options.peer_python}")

    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} processors, load {load:.1f}", end="")
    print(": wall times will be disturbed" if load > 0.5 and not options.quick else "")
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    room = nullcontext(options.keep) if options.keep else TemporaryDirectory(prefix="octex-bench-")
    with room as folder, octex_worker() if options.quick else nullcontext() as worker:
        setup = Setup(
            quick=options.quick,
            repeats=1 if options.quick else max(options.repeats, 1),
            core=max(os.sched_getaffinity(0)) if options.core is None else options.core,
            folder=Path(folder),
            peer_python=peer_python,
            folder_of_models=options.models,
            worker=worker,
        )
        for name in options.names or BENCHMARKS:
            BENCHMARKS[name](setup)
    return 0


if __name__ == "__main__":
    sys.exit(main())
