"""A benchmark of archives: bytes a leaf beside what else packs the same, and how fast they are."""

from __future__ import annotations

import io
import lzma
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from measuring import DROID, Report, Setup, timed
from PIL import Image

import octex
from octex.archive.read import read
from octex.parallel import at_most
from octex.source.load import MODEL_ENDINGS
from octex.texture import OctreeTexture

#: Models, by parts of their names, that archives are measured with.
MODELS = ("Avocado", "BoomBox", "Suzanne", "spot")


def archive(setup: Setup, report: Report) -> None:
    """Bytes a leaf of archives beside .octex, zstd, xz and the source's images as PNG; speeds of a core."""
    report.title("archive: bytes a leaf, all channels")
    heads = ("model", "depth", "leaves", ".octex", "zstd -19", "xz", ".octz", "of xz", "bits of structure")
    heads = (*heads, "error 1", "error 3", "PNG", "write", "read MB/s")
    rows = []
    for path in _models(setup.models):
        for depth in (5,) if setup.quick else (8, 9):
            texture = octex.convert(octex.load_surface(path), depth)
            rows.append([path.stem, depth, *_measured(texture, path, setup, report)])
    report.table(heads, rows)
    report.note("error N: streams of whole numbers that may move by N codes, of those that may not")
    if setup.models is None:
        report.note("models other than the droid: left out without --models")


def _models(folder: Path | None) -> Iterator[Path]:
    if DROID.is_file():
        yield DROID
    for path in sorted(folder.rglob("*")) if folder else []:
        if path.suffix.lower() in MODEL_ENDINGS and path.stem.startswith(MODELS):
            yield path


def _measured(texture: OctreeTexture, path: Path, setup: Setup, report: Report) -> list[str]:
    plain, packed = setup.folder / "a.octex", setup.folder / "a.octz"
    texture.save(plain)
    opened, leaves = octex.open(plain), texture.tree.n_leaves
    raw = plain.stat().st_size
    with at_most(1):
        opened.save(packed)
        written = min(timed(lambda: opened.save(packed))[0].cpu for _ in range(setup.repeats))
        decoded = min(timed(lambda: read(packed))[0].cpu for _ in range(setup.repeats))
    size, streams = packed.stat().st_size, _streams(packed)
    moved = []
    for error in (1, 3):
        opened.save(packed, max_error=error)
        moved.append(sum(_streams(packed)[2:]) / max(sum(streams[2:]), 1))
    content = plain.read_bytes()
    xz = len(lzma.compress(content, preset=9 | lzma.PRESET_EXTREME))
    png = _png_bytes(texture, path)
    report.at_most(f"{path.stem}, depth {texture.tree.max_depth}: .octz of xz", size / xz, 0.7)
    report.at_most(f"{path.stem}: structure and flags", 8 * streams[0] / leaves, 1.2, "bits a leaf")
    report.at_most(f"{path.stem}: --max-error 1", moved[0], 0.65)
    report.at_most(f"{path.stem}: --max-error 3", moved[1], 0.4)
    sizes = (raw, _zstd_bytes(plain), xz, size)
    return [
        f"{leaves:,}",
        *("–" if number is None else f"{number / leaves:.2f}" for number in sizes),
        f"{size / xz:.1%}",
        f"{8 * streams[0] / leaves:.2f}",
        *(f"{part:.1%}" for part in moved),
        f"{png / leaves:.2f}",
        f"{raw / written / 1e6:.1f}",
        f"{raw / decoded / 1e6:.1f}",
    ]


def _streams(path: Path) -> list[int]:
    """Return the bytes of an archive's streams: structure, areas, and those of each channel."""
    sizes = octex.open(path).info()["archive"]
    return [size for name, size in sizes.items() if name not in ("directory", "other")]


def _zstd_bytes(path: Path) -> int | None:
    program = shutil.which("zstd")
    if program is None:
        return None
    return len(subprocess.run([program, "-19", "-c", str(path)], capture_output=True, check=True).stdout)


def _png_bytes(texture: OctreeTexture, path: Path) -> int:
    """Return the bytes of the model's images as PNG, of as many texels as the texture has leaves."""
    total = 0
    for image in sorted(path.parent.glob("*.png")):
        with Image.open(image) as opened:
            scale = np.sqrt(texture.tree.n_leaves / (opened.width * opened.height))
            resized = opened.resize([max(round(side * scale), 1) for side in opened.size])
        file = io.BytesIO()
        resized.save(file, "PNG", optimize=True)
        total += file.tell()
    return total
