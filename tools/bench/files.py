"""Benchmarks of files: their size, and what lookups read of them and keep in memory."""

from __future__ import annotations

import io
import lzma
import shutil
import subprocess
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from inputs import sphere_texture
from measuring import Setup, colors_of, line, table, task, timed, title
from PIL import Image

import octex
from octex.archive.read import read
from octex.formats.models import materials_of
from octex.parallel import at_most


def paper(setup: Setup) -> None:
    """Bytes of the sample's octree textures beside those of its images (paper, figure 6)."""
    _, path, deepest = next(setup.models())
    surface = colors_of(path)
    images = [each.inputs["base_color"].texture for each in materials_of(surface).materials]
    shapes = {id(each.texels): each.texels.shape for each in images if each is not None}
    maps = sum(3 * height * width for height, width, *_ in shapes.values())
    title(f"paper: the droid, bytes beside its {len(shapes)} images, {maps:,} uncompressed")
    rows = []
    for depth in (deepest - 2, deepest - 1, deepest):
        texture = octex.convert(surface, depth)
        both, leaves, size = _both(texture), texture.tree.n_leaves, texture.info()["bytes"]
        bytes_ = size["structure"], both, size["flags"], size["areas"], size["total"]
        parts = (f"{each / leaves:.2f}" for each in bytes_)
        rows.append([depth, f"{leaves:,}", f"{both:,}", f"{both / maps:.3f}", f"{size['total']:,}", *parts])
    heads = [
        "depth",
        "leaves",
        "structure + colour",
        "of the images",
        "file",
        "a leaf: structure",
        "+ colour",
    ]
    table([*heads, "flags", "areas", "file"], rows)
    # A depth more makes cells somewhat smaller than half, as the margin's cells shrink too.
    longest = float(np.ptp(surface.bounds, axis=0).max()) / (2 ** (deepest - 2) - 3)
    sizes = [_both(octex.convert(surface, cell=longest / 2**step)) for step in range(3)]
    line("growth, cells halved", ", ".join(f"{after / before:.3f} ×" for before, after in pairwise(sizes)))


def _both(texture: octex.OctreeTexture) -> int:
    """Return the bytes of structure and colour, averages included."""
    colour = sum(channel.values.nbytes for channel in texture.channels.values())
    return int(texture.info()["bytes"]["structure"]) + colour


def archive(setup: Setup) -> None:
    """Bytes a leaf of archives beside .octex, zstd, xz and the model's images as PNG; speeds of a core."""
    title("archive: bytes a leaf, all channels")
    rows = []
    for name, path, depth in setup.models():
        texture = octex.convert(octex.load_surface(path), min(depth, 9))
        plain, packed = setup.folder / "a.octex", setup.folder / "a.octz"
        texture.save(plain)
        opened, leaves, raw = octex.open(plain), texture.tree.n_leaves, plain.stat().st_size
        with at_most(1):
            opened.save(packed)
            works = partial(opened.save, packed), partial(read, packed)
            write, decode = (min(timed(work)[0].cpu for _ in range(setup.repeats)) for work in works)
        size, streams = packed.stat().st_size, _streams(packed)
        moved = []
        for error in (1, 3):
            opened.save(packed, max_error=error)
            moved.append(f"{sum(_streams(packed)[2:]) / max(sum(streams[2:]), 1):.1%}")
        xz = len(lzma.compress(plain.read_bytes(), preset=9 | lzma.PRESET_EXTREME))
        sizes = raw, _zstd_bytes(plain), xz, size, _png_bytes(leaves, path)
        each = ("–" if number is None else f"{number / leaves:.2f}" for number in sizes)
        speeds = (f"{raw / spent / 1e6:.1f}" for spent in (write, decode))
        rows.append([name, f"{leaves:,}", *each, f"{8 * streams[0] / leaves:.2f}", *moved, *speeds])
    heads = ["model", "leaves", ".octex", "zstd -19", "xz", ".octz", "PNG", "bits of structure"]
    # Streams of whole numbers that may move by N codes, of those that may not.
    table([*heads, "error 1", "error 3", "write MB/s", "read MB/s"], rows)


def _streams(path: Path) -> list[int]:
    """Return the bytes of an archive's streams: structure, areas, and those of each channel."""
    sizes = octex.open(path).info()["archive"]
    return [size for name, size in sizes.items() if name not in ("directory", "other")]


def _zstd_bytes(path: Path) -> int | None:
    if shutil.which("zstd") is None:
        return None
    return len(subprocess.run(["zstd", "-19", "-c", path], capture_output=True, check=True).stdout)


def _png_bytes(leaves: int, path: Path) -> int:
    """Return the bytes of the images beside a model as PNG, of as many texels as a texture has leaves."""
    total = 0
    for image in sorted(path.parent.glob("*.png")):
        with Image.open(image) as opened:
            scale = np.sqrt(leaves / (opened.width * opened.height))
            resized = opened.resize([max(round(side * scale), 1) for side in opened.size])
        file = io.BytesIO()
        resized.save(file, "PNG", optimize=True)
        total += file.tell()
    return total


def mapped(setup: Setup) -> None:
    """Memory that lookups in a file take, and what images read of a file that is not in the cache."""
    depth, count, sizes = (6, 2000, (20, 64)) if setup.quick else (10, 2_000_000, (20, 256, 1024))
    path = setup.folder / "sphere.octex"
    texture = sphere_texture(depth)
    leaves = texture.tree.n_leaves
    texture.save(path)
    title(f"mapped: sphere, {1 << depth} cells along an edge")
    line("all arrays, bytes a cell", f"{texture.nbytes / leaves:.2f}")
    with task(setup, "resident", pin=False, path=str(path), count=count) as work:
        line(f"after {count:,} random quadratic lookups", f"{work()['grown'] / leaves:.2f}")
    sphere_texture(depth + 1).save(path)
    for n in sizes:
        with task(setup, "image", pin=False, path=str(path), pixels=n) as work:
            found = work()
        read_ = f"{found['touched'] / 1e6:.2f} MB of {path.stat().st_size / 1e6:.1f} in {found['wall']:.3f} s"
        line(f"read by an image of {n}²", read_)
    path.unlink()
