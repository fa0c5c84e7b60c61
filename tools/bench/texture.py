"""Benchmark of textures: their size beside the maps that they replace."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from measuring import DROID, Report, Setup
from PIL import Image, ImageDraw

import octex
from octex.gltf import Document

#: A map's charts are counted on this many points along a texel's edge.
FINE = 4


def paper(setup: Setup, report: Report) -> None:
    """Bytes of the sample's octree textures beside those of its maps (paper, figure 6)."""
    report.title("paper: the droid part, bytes beside the maps that it was textured with")
    if not DROID.is_file():
        report.note(f"left out: there is no samples/{DROID.name}; samples/make_droid.py makes it")
        return
    maps = 0
    for name, image, coverage in _maps(DROID):
        width, height = image.size
        maps += 3 * width * height
        report.line(
            f"map {name}",
            f"{width} × {height}, {3 * width * height:,} bytes, {coverage:.0%} covered by charts",
        )
    report.line("maps, uncompressed", f"{maps:,} bytes")
    surface = octex.load_surface(DROID, channels=["base_color"])
    depths = (4, 5, 6) if setup.quick else (8, 9, 10)
    rows, parts, sizes = [], [], []
    for depth in depths:
        texture = octex.convert(surface, depth)
        size, leaves = texture.info()["bytes"], texture.tree.n_leaves
        both = _both(texture)
        colour = both - size["structure"]
        split = size["split"] + sum(channel.split_values.nbytes for channel in texture.channels.values())
        sizes.append(both)
        rows.append(
            [
                depth, f"{leaves:,}", f"{both:,}", f"{both / maps:.3f}", f"{size['total']:,}",
                f"{size['total'] / maps:.3f}",
            ]
        )  # fmt: skip
        each = [
            size["structure"], colour, both, size["flags"], size["areas"], split, size["header"],
            size["total"],
        ]  # fmt: skip
        parts.append([depth, *(f"{bytes_ / leaves:.3f}" for bytes_ in each)])
    report.table(["depth", "leaves", "structure + colour", "of the maps", "whole file", "of the maps"], rows)
    report.note("bytes a leaf")
    report.table(["depth", "structure", "colour", "both", "flags", "areas", "split", "header", "file"], parts)
    report.at_most("paper: structure + colour beside the maps", sizes[-1] / maps, 0.82, "×")
    # A depth more makes cells somewhat smaller than half, as the margin's cells shrink too.
    longest = float(np.ptp(surface.bounds, axis=0).max())
    halved = [longest / ((2 ** depths[0] - 3) << step) for step in range(len(depths))]
    growth = [
        after / before for before, after in pairwise(_both(octex.convert(surface, cell=c)) for c in halved)
    ]
    report.line("growth, a depth more", ", ".join(f"{b / a:.3f} ×" for a, b in pairwise(sizes)))
    report.line("growth, cells halved", ", ".join(f"{each:.3f} ×" for each in growth))
    report.at_most("paper: growth a level (cells halved), most", max(growth), 4.05, "×")
    report.at_most("paper: structure + colour a leaf, deepest", float(parts[-1][3]), 5.1, "bytes")
    report.at_most("paper: whole file a leaf, deepest", float(parts[-1][-1]), 7.8, "bytes")


def _both(texture: octex.OctreeTexture) -> int:
    """Return the bytes of structure and colour, averages included."""
    colour = sum(channel.values.nbytes for channel in texture.channels.values())
    return int(texture.info()["bytes"]["structure"]) + colour


def _maps(path: Path) -> Iterator[tuple[str, Image.Image, float]]:
    """Yield the base colour maps of a model, and the part of each that its charts cover."""
    document = Document(path)
    charts: dict[int, list[np.ndarray]] = {}
    for mesh in document.json["meshes"]:
        for primitive in mesh["primitives"]:
            material = document.item("materials", primitive["material"])
            texture = material["pbrMetallicRoughness"].get("baseColorTexture")
            if texture is None:
                continue
            source = document.item("textures", texture["index"])["source"]
            uv = document.accessor(primitive["attributes"]["TEXCOORD_0"], (2,))
            rows = document.accessor(primitive["indices"], (1,))[:, 0].reshape(-1, 3)
            charts.setdefault(source, []).append(uv[rows])
    for source, triangles in sorted(charts.items()):
        entry = document.item("images", source)
        image = Image.open(io.BytesIO(document.view(entry["bufferView"])[0]))
        fine = (image.width * FINE, image.height * FINE)
        mask = Image.new("1", fine)
        pen = ImageDraw.Draw(mask)
        for corners in np.concatenate(triangles) * fine - 0.5:
            pen.polygon([tuple(corner) for corner in corners.tolist()], fill=1)
        yield entry.get("name", str(source)), image, float(np.asarray(mask).mean())
