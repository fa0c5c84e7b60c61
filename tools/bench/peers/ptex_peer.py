#!/usr/bin/env python
"""Judge octex's reading and writing of .ptx files by Ptex's own library.

usage: ptex_peer.py SOURCE [FILE.ptx|FOLDER...] [--build FOLDER] [--random N] [--seed N]

SOURCE is a checkout of github.com/wdas/ptex, or a bare clone of it; it is built with ptex_peer.cpp into
FOLDER by a C++ compiler, with zlib's headers. Each file is read by both, and so are N random contents,
written by both; of what octex writes the library must read the texels, neighbours and metadata that were
given, and its reductions may differ from octex's by rounding alone. Exit code 1 if anything differs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from octex.channels import ONE
from octex.errors import ModelError
from octex.formats.ptex.layout import (
    BORDER_MODES,
    DTYPES,
    EDGE_FILTERS,
    MESH_TYPES,
    TEXT,
    Faces,
)  # fmt: skip
from octex.formats.ptex.reader import PtexFile
from octex.formats.ptex.writer import PtexContents, halved, multiply, write_contents
from octex.parallel import workers

PROGRAM = Path(__file__).with_suffix(".cpp")
#: Those of the library; the other of its files are tests and tables.
SOURCES = (
    *("Cache", "Filters", "Half", "Reader", "SeparableFilter", "SeparableKernel"),
    *("TriangleFilter", "TriangleKernel", "Utils", "Writer"),
)


class Dump(NamedTuple):
    """What Ptex's library reads in a file."""

    contents: PtexContents
    is_constant: np.ndarray  # (faces,)
    least: np.ndarray  # (faces, channels)
    reductions: list[list[np.ndarray]]  # of each face, (v, u, channels) each


def build(source: Path, folder: Path) -> Path:
    """Compile the library and the program that speaks to it; return the program."""
    program = folder / "ptex_peer"
    if program.exists():
        return program
    folder.mkdir(parents=True, exist_ok=True)
    code = source / "src" / "ptex"
    if not code.is_dir():
        archive = subprocess.run(
            ["git", "-C", str(source), "archive", "HEAD", "src/ptex"], check=True, capture_output=True
        )
        subprocess.run(["tar", "x", "-C", str(folder)], input=archive.stdout, check=True)
        code = folder / "src" / "ptex"
    version = (code / "PtexVersion.h.in").read_text().replace("@PTEX_MAJOR_VERSION@", "2")
    (folder / "PtexVersion.h").write_text(version.replace("@PTEX_MINOR_VERSION@", "4"))
    files = [str(code / f"Ptex{name}.cpp") for name in SOURCES]
    subprocess.run(
        ["c++", "-O2", "-std=c++11", "-DPTEX_STATIC", f"-I{folder}", f"-I{code}", str(PROGRAM), *files, "-lz",
         "-lpthread", "-o", str(program)],
        check=True,
    )  # fmt: skip
    return program


def dumped(program: Path, path: Path) -> Dump:
    """Read a file by the library; raises ModelError if that refuses it."""
    done = subprocess.run([str(program), "dump", str(path)], capture_output=True)
    if done.returncode:
        raise ModelError(f"{path.name}: Ptex says {done.stderr.decode(errors='replace').strip()}")
    data, at = done.stdout, 0

    def taken(form: str, count: int) -> np.ndarray:
        nonlocal at
        found = np.frombuffer(data, form, count, at)
        at += found.nbytes
        return found

    mesh, kind, alpha, channels, count, u, v, edges = taken("<i4", 8).tolist()
    form = np.dtype(DTYPES[kind])
    info = taken("<i4", 11 * count).reshape(-1, 11)
    log2 = info[:, :2].astype(np.int8)
    faces = Faces(log2, info[:, 3:7], info[:, 7:].astype(np.uint8), info[:, 2] != 0)
    texels = taken(form.str, int(faces.counts.sum()) * channels).reshape(-1, channels)
    least, constant, reductions = [], [], []
    for face in range(count):
        least.append(taken(form.str, channels))
        constant.append(bool(taken("<i4", 1)[0]))
        sides = 1 << log2[face].astype(int)
        reductions.append([])
        while sides.min() > 1:
            sides //= 2
            reductions[-1].append(
                taken(form.str, int(sides.prod()) * channels).reshape(sides[1], sides[0], channels)
            )
    metadata: dict[str, str] = {}
    for _ in range(int(taken("<i4", 1)[0])):
        which, name, size = taken("<i4", 3).tolist()
        key, value = taken("S1", name).tobytes().decode(), taken("u1", size)
        if which == TEXT:
            metadata[key] = value.tobytes().rstrip(b"\0").decode(errors="replace")
    contents = PtexContents(
        MESH_TYPES[mesh], faces, texels, None if alpha < 0 else alpha, (BORDER_MODES[u], BORDER_MODES[v]),
        EDGE_FILTERS[edges], metadata,
    )  # fmt: skip
    return Dump(contents, np.array(constant), np.array(least), reductions)


def written(program: Path, contents: PtexContents, path: Path) -> None:
    """Write a file by the library."""
    faces, texels = contents.faces, contents.texels
    head = np.array(
        [
            MESH_TYPES.index(contents.mesh_type), DTYPES.index(texels.dtype.name),
            -1 if contents.alpha_channel is None else contents.alpha_channel, texels.shape[1],
            len(faces.log2), *map(BORDER_MODES.index, contents.border_modes),
            EDGE_FILTERS.index(contents.edge_filter),
        ],
        "<i4",
    )  # fmt: skip
    info = np.column_stack([faces.log2, faces.subfaces, faces.neighbors, faces.edges]).astype("<i4")
    parts = [head.tobytes(), info.tobytes(), texels.tobytes(), len(contents.metadata).to_bytes(4, "little")]
    for key, value in contents.metadata.items():
        data = value.encode() + b"\0"
        parts += [np.array([TEXT, len(key.encode()), len(data)], "<i4").tobytes(), key.encode(), data]
    done = subprocess.run([str(program), "write", str(path)], input=b"".join(parts), capture_output=True)
    if done.returncode:
        raise ModelError(f"{path.name}: Ptex says {done.stderr.decode(errors='replace').strip()}")


def differences(dump: Dump, path: Path, wanted: PtexContents | None = None) -> Iterator[str]:
    """Say how what octex reads in a file differs from what the library reads, and from what was written."""
    with PtexFile(path) as file:
        own = {"mesh_type": file.mesh_type, "alpha_channel": file.alpha_channel,
               "border_modes": file.border_modes, "edge_filter": file.edge_filter}  # fmt: skip
        for name, value in own.items():
            if value != getattr(dump.contents, name):
                yield f"{name}: {value}, not {getattr(dump.contents, name)}"
        sides = 4 if file.mesh_type == "quad" else 3
        for name, mine, its in zip(Faces._fields, file.faces, dump.contents.faces, strict=True):
            if name in ("neighbors", "edges"):
                mine, its = mine[:, :sides], its[:, :sides]
            if not np.array_equal(mine, its):
                yield f"faces' {name} differ"
        if not np.array_equal(file.is_constant, dump.is_constant):
            yield "other faces are constant"
        if file.metadata != dump.contents.metadata:
            yield f"metadata: {file.metadata}, not {dump.contents.metadata}"
        ends = np.cumsum(dump.contents.faces.counts)
        limit = 1.0 if file.dtype.kind == "u" else 2e-3
        for face, (end, count) in enumerate(zip(ends, dump.contents.faces.counts, strict=True)):
            texels = np.ascontiguousarray(file.texels(face)).reshape(count, -1)
            if texels.tobytes() != np.ascontiguousarray(dump.contents.texels[end - count : end]).tobytes():
                yield f"texels of face {face} differ"
                break
            if not file.is_constant[face]:
                mine = file.texels(face)[None].astype(float)
                if file.alpha_channel is not None:
                    multiply(mine, file.alpha_channel, ONE[file.dtype.name])
                for level, its in enumerate(dump.reductions[face], 1):
                    mine = halved(mine, file.mesh_type == "triangle")
                    stored = level < file.n_levels and min(file.faces.log2[face]) > level + 1
                    if file.alpha_channel is not None and not stored:
                        continue  # which the library does not multiply by alpha, as it does what it stores
                    apart = np.abs(mine[0] - its.astype(float)).max()
                    scale = max(np.abs(its.astype(float)).max(), 1.0) if file.dtype.kind == "f" else level
                    if apart > limit * scale:
                        yield f"level {level} of face {face} differs by {apart}"
    if wanted is not None:
        if dump.contents.texels.tobytes() != wanted.texels.tobytes():
            yield "the library reads other texels than were written"
        if dump.contents.metadata != wanted.metadata:
            yield f"the library reads other metadata: {dump.contents.metadata}"


def random_contents(seed: int) -> PtexContents:
    """Draw what a file may hold."""
    draw = np.random.default_rng(seed)
    triangles = bool(draw.integers(2))
    count, channels = int(draw.integers(1, 40)), int(draw.integers(1, 6))
    dtype = np.dtype(DTYPES[draw.integers(4)])
    most = 9 if draw.random() < 0.2 else 6
    log2 = draw.integers(0, most, (count, 2)).astype(np.int8)
    if triangles:
        log2[:, 1] = log2[:, 0]
    neighbors = np.full((count, 4), -1, np.int32)
    edges = np.zeros((count, 4), np.uint8)
    sides = 3 if triangles else 4
    free = draw.permutation(count * sides)
    for a, b in free[: len(free) // 2 * 2].reshape(-1, 2)[:count]:
        neighbors[a // sides, a % sides], edges[a // sides, a % sides] = b // sides, b % sides
        neighbors[b // sides, b % sides], edges[b // sides, b % sides] = a // sides, a % sides
    faces = Faces(log2, neighbors, edges, np.zeros(count, np.bool_))
    parts = []
    for size in faces.counts.tolist():
        kind = draw.integers(3)
        values = draw.random((1 if kind == 0 else size, channels))
        if kind == 1:
            values = np.cumsum((values - 0.5) * 0.05, axis=0) % 1
        parts.append(np.broadcast_to(values, (size, channels)))
    values = np.concatenate(parts)
    scale = {"uint8": 255, "uint16": 65535}.get(dtype.name, 1)
    texels = (values * scale).astype(dtype)
    alpha = int(draw.integers(channels)) if draw.random() < 0.3 else None
    metadata = {f"entry {n}": "grün " * int(draw.integers(1, 150)) for n in range(draw.integers(8))}
    modes = BORDER_MODES[draw.integers(3)], BORDER_MODES[draw.integers(3)]
    return PtexContents(
        MESH_TYPES[not triangles], faces, texels, alpha, modes, EDGE_FILTERS[draw.integers(2)], metadata
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--build", type=Path, default=Path("build") / "ptex_peer")
    parser.add_argument("--random", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    program = build(options.source, options.build.resolve())
    failed = 0

    def judge(name: str, path: Path, wanted: PtexContents | None = None) -> None:
        nonlocal failed
        found = list(differences(dumped(program, path), path, wanted))
        failed += bool(found)
        for each in found[:5]:
            print(f"{name}: {each}")

    files = [f for each in options.files for f in (sorted(each.rglob("*.ptx")) if each.is_dir() else [each])]
    for path in files:
        try:
            with PtexFile(path) as file:
                print(f"{path.name}: {file}")
        except ModelError as error:
            print(f"{path.name}: refused ({error})")
            continue
        judge(path.name, path)
    with TemporaryDirectory() as folder, workers() as executor:
        own, its = Path(folder) / "own.ptx", Path(folder) / "its.ptx"
        for seed in range(options.seed, options.seed + options.random):
            contents = random_contents(seed)
            write_contents(contents, own, executor)
            judge(f"written by octex, seed {seed}", own, contents)
            written(program, contents, its)
            judge(f"written by Ptex, seed {seed}", its, contents)
        print(f"{options.random} random contents written by both")
    print("differences" if failed else "no difference")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
