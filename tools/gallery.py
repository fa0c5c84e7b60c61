#!/usr/bin/env python
"""Convert one channel of every model under a folder, and draw all on one sheet: source beside octree.

usage: tools/gallery.py FOLDER SHEET.png [--channel base_color] [--depth 9] [--columns 2]

Prints a table of the models (leaves, and PSNR against the source averaged over a cell), then the models whose
channel is 0 or 1 all over, then those that are refused, each with the reason.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import octex
from octex.channels import CHANNELS
from octex.drawing import draw_preview
from octex.files import replacing

ENDINGS = {".glb", ".gltf", ".obj", ".ply", ".off", ".stl"}
SAMPLES = 100_000
TILE = (800, 460)


def is_plain(surface: octex.Surface, channel: str) -> bool:
    """Say whether a channel is 0 all over, or 1."""
    values = surface.evaluate(surface.scatter(1000), channel)
    return bool((values > 0.999).all() or (abs(values) < 0.001).all())


def sheet(tiles: list[np.ndarray], columns: int) -> np.ndarray:
    """Lay tiles out in rows; what is left of the last row is white."""
    missing = -len(tiles) % columns
    tiles = tiles + [np.full_like(tiles[0], 255)] * missing
    rows = [np.hstack(tiles[first : first + columns]) for first in range(0, len(tiles), columns)]
    return np.vstack(rows)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("sheet", type=Path)
    parser.add_argument("--channel", choices=CHANNELS, default="base_color")
    parser.add_argument("--depth", type=int, default=9)
    parser.add_argument("--columns", type=int, default=2)
    options = parser.parse_args(arguments)

    tiles: list[np.ndarray] = []
    plain: list[str] = []
    refused: list[str] = []
    for path in sorted(p for p in options.folder.rglob("*") if p.suffix.lower() in ENDINGS):
        name = path.relative_to(options.folder).as_posix()
        try:
            surface = octex.load_surface(path, channels=[options.channel])
            if is_plain(surface, options.channel):
                plain.append(name)
                continue
            texture = octex.convert(surface, depth=options.depth)
        except octex.OctexError as error:
            refused.append(f"{name}: {error}")
            continue
        quality = octex.difference(texture, surface, points=SAMPLES)[options.channel].psnr
        leaves = f"{texture.tree.n_leaves:,} leaves"
        print(f"{name:60} {leaves:>20} {quality:7.2f} dB", flush=True)
        note = "exact" if quality == np.inf else f"{quality:.1f} dB"
        tiles.append(draw_preview(texture, surface, TILE, supersample=2, note=note))
    for title, names in ((f"with a plain {options.channel}", plain), ("refused", refused)):
        print(f"\n{len(names)} {title}")
        for name in names:
            print(f"  {name}")
    if not tiles:
        print(f"no {options.channel} to draw under {options.folder}", file=sys.stderr)
        return 1
    with replacing(options.sheet) as file:
        Image.fromarray(sheet(tiles, options.columns)).save(file, "PNG")
    print(f"\n{len(tiles)} models on {options.sheet}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
