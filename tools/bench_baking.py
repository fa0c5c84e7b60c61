"""Benchmarks of baking: what a bilinear sampler reads from the maps beside the field, and the time."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from bench_inputs import coloured_models, painted_torus
from bench_texture import DROID
from bench_tools import Report, Setup

import octex
from octex.baking.layout import Layout, charts_of
from octex.baking.texels import draw_texels
from octex.channels import linear_to_srgb, srgb_to_linear
from octex.formats.images import materials_of

Floats = npt.NDArray[np.float64]

POINTS = 200_000
#: Points so near to a chart's border, in texels, are told apart.
NEAR = 2


def baking(setup: Setup, report: Report) -> None:
    """Read maps that were baked, beside the field, and beside the borders of charts."""
    report.title("baking: base colour of maps beside the field that they were baked from, dB")
    paths = [DROID, *([] if setup.models is None else coloured_models(setup.models))]
    depth, size = (6, 128) if setup.quick else (10, 2048)
    rows = []
    for path in paths:
        surface = octex.load_surface(path, channels=["base_color"])
        texture = octex.convert(surface, depth)
        for uv in ("keep", "atlas"):
            try:
                baked = octex.bake(texture, surface, uv=uv, texture_size=size, channels=["base_color"])
            except octex.OctexError as error:
                report.note(f"{path.stem}, {uv}: left out: {error}")
                continue
            inside, beside, decibels = _differences(texture, baked, size)
            rows.append(
                [
                    path.stem,
                    uv,
                    f"{decibels:.1f}",
                    *(f"{b:.2f} / {a:.2f}" for a, b in zip(inside, beside, strict=True)),
                ]
            )
            report.at_least(f"baking: {path.stem}, {uv}", decibels, 42.0 if uv == "keep" else 38.0, "dB")
            worst = max(b - a for a, b in zip(inside, beside, strict=True))
            report.at_most(f"baking: {path.stem}, {uv}, beside borders above inside", worst, 1.0, "codes")
    report.note(
        "99th percentiles of the difference, codes: within 2 texels of borders / elsewhere, by mip level"
    )
    report.table(["model", "uv", "dB", *(f"mip {level}" for level in range(4))], rows)
    _speed(setup, report)


def _speed(setup: Setup, report: Report) -> None:
    """Bake five channels of a mesh with an atlas, without unwrapping it."""
    around, size = (40, 256) if setup.quick else (316, 4096)
    surface = painted_torus(around, around // 2, size // 4)
    sources = {"roughness": 0.5, "metallic": 0.2, "occlusion": 0.9, "emissive": (0.1, 0.2, 0.3)}
    texture = octex.convert(surface.with_sources(sources), 6 if setup.quick else 10)
    octex.bake(texture, surface, uv="keep", texture_size=64)
    began = time.perf_counter(), time.process_time()
    octex.bake(texture, surface, uv="keep", texture_size=size)
    wall, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
    report.line(
        f"{size}², five channels, {len(surface.triangles):,} triangles", f"{wall:.2f} s (CPU {cpu:.2f} s)"
    )
    report.at_most("baking: five channels of 4096²", wall, 6.0, "s")


def _differences(
    texture: octex.OctreeTexture, baked: octex.Surface, size: int
) -> tuple[list[float], list[float], float]:
    """Return 99th percentiles inside and beside borders by mip level, in codes, and decibels at level 0."""
    assert baked.uv is not None
    texels = materials_of(baked).materials[0].inputs["base_color"].texture
    assert texels is not None
    level = srgb_to_linear(texels.texels[..., :3] / 65535.0)
    points = baked.scatter(POINTS)
    places = baked.uv.at(points.triangles, points.barycentric) * size
    corners = baked.uv.values[baked.uv.rows].astype(np.float64) * size
    near = _near_borders(baked, corners, size)[tuple(np.floor(places).astype(int).T[::-1] % size)]
    flat = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])) / 2
    edges = np.sqrt(baked.areas() / np.maximum(flat, 1e-12))[points.triangles]
    inside, beside, decibels = [], [], 0.0
    for mip in range(4):
        found = linear_to_srgb(_bilinear(level, places / 2**mip))
        width = None if mip == 0 else edges * 2**mip
        field = linear_to_srgb(np.clip(texture.sample(points, "base_color", width=width), 0, 1))
        difference = np.abs(found - field).max(axis=1) * 255
        if mip == 0:
            decibels = float(-10 * np.log10(np.mean((found - field) ** 2)))
        inside.append(float(np.percentile(difference[~near], 99)))
        beside.append(float(np.percentile(difference[near], 99)))
        level = level.reshape(level.shape[0] // 2, 2, level.shape[1] // 2, 2, 3).mean(axis=(1, 3))
    return inside, beside, decibels


def _near_borders(baked: octex.Surface, corners: Floats, size: int) -> npt.NDArray[np.bool_]:
    """Say which texels (size, size) have one of another chart, or of none, near them."""
    wrapped = corners - np.floor(corners.mean(axis=1, keepdims=True) / size) * size
    layout = Layout(
        baked.uv, wrapped, np.arange(len(corners), dtype=np.int32), charts_of(baked, corners), size, size
    )
    drawn = draw_texels(layout.corners, layout.charts, size, 0, size)
    charts = np.where(drawn.areas > 0.999, layout.charts[drawn.triangles], -1)
    near = charts < 0
    for down in range(-NEAR, NEAR + 1):
        for right in range(-NEAR, NEAR + 1):
            near |= np.roll(charts, (down, right), (0, 1)) != charts
    return near


def _bilinear(level: Floats, places: Floats) -> Floats:
    """Read a map (h, w, 3) between its texels at places (n, 2), which repeat, as renderers do."""
    height, width, _ = level.shape
    low = np.floor(places - 0.5).astype(np.int64)
    part = places - 0.5 - low
    found = np.zeros((len(places), level.shape[2]))
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
            found += weight[:, None] * level[(low[:, 1] + down) % height, (low[:, 0] + right) % width]
    return found
