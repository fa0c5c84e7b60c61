"""Benchmarks of baking: what a bilinear sampler reads from the maps beside the field, and the time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from inputs import painted_torus
from measuring import Setup, in_turns, line, note, open3d, pinned, table, timed, title

import octex
from octex.baking.layout import Layout, charts_of
from octex.baking.texels import draw_texels
from octex.channels import CHANNELS, linear_to_srgb, srgb_to_linear
from octex.formats.models import materials_of

Floats = npt.NDArray[np.float64]

#: Points so near to a chart's border, in texels, are told apart.
NEAR = 2
MIPS = 4


def baking(setup: Setup) -> None:
    """Read maps that were baked, beside the field: whole, and beside the borders of charts."""
    title("baking: base colour of maps beside the field that they were baked from")
    count, least = (5000, 256) if setup.quick else (200_000, 1024)
    rows = []
    for name, path, depth in setup.models():
        surface = octex.load_surface(path, normals=True)
        names = [each.name for each in surface.channels if each.name in ("base_color", "normal")]
        texture = octex.convert(surface.with_channels(names), depth)
        size = 128 if setup.quick else max([len(each) for each in _maps(surface)], default=1024)
        try:
            kept = octex.bake(texture, surface, uv="keep", texture_size=size)
        except octex.OctexError as error:
            note(f"{name}: {error}")
            made = {}
        else:
            made = {"keep": (kept, size)}
            size = 8 * round(np.sqrt(sum(len(each) ** 2 for each in _maps(kept))) / 8)
        size = max(size, least)
        made["atlas"] = octex.bake(texture, surface, uv="atlas", texture_size=size), size
        for uv, (baked, side) in made.items():
            found = compared(texture, baked, side, count)
            borders = (f"{a:.2f} / {b:.2f}" for a, b in zip(found.beside, found.inside, strict=True))
            degrees = "" if found.degrees is None else f"{found.degrees:.2f}°"
            rows.append([name, uv, side, f"{found.decibels:.1f}", *borders, degrees])
    note(
        f"99th percentiles of the difference in 1/255: within {NEAR} texels of borders of charts / elsewhere"
    )
    table(["model", "uv", "size", "dB", *(f"mip {level}" for level in range(MIPS)), "normals"], rows)


def _maps(surface: octex.Surface) -> list[npt.NDArray[np.generic]]:
    """Return the texels that a model's colours come from, each once."""
    textures = [each.inputs["base_color"].texture for each in materials_of(surface).materials]
    return list({id(each.texels): each.texels for each in textures if each is not None}.values())


class Compared(NamedTuple):
    """How maps differ from the field."""

    decibels: float  # at mip 0
    inside: list[float]  # 99th percentiles by mip level, codes, away from borders of charts
    beside: list[float]  # and beside them
    degrees: float | None  # mean angle between normals


def compared(texture: octex.OctreeTexture, baked: octex.Surface, size: int, count: int) -> Compared:
    """Read the maps of a baked surface at random points, as a renderer would, beside the field there."""
    assert baked.uv is not None
    points = baked.scatter(count)
    source = materials_of(baked)
    owners = source.triangle_materials[points.triangles]
    places = baked.uv.at(points.triangles, points.barycentric) * size
    corners = baked.uv.values[baked.uv.rows].astype(np.float64) * size
    flat = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2
    edges = np.sqrt(baked.areas() / np.maximum(flat, 1e-12))[points.triangles]
    found, near = np.empty((MIPS, count, 3)), np.zeros(count, np.bool_)
    is_mapped = flat[points.triangles] > 1e-9  # the others have no texels
    for number, material in enumerate(source.materials):
        own = owners == number
        given = material.inputs["base_color"]
        if given.texture is None:
            found[:, own], is_mapped[own] = given.factor, False
            continue
        level = srgb_to_linear(given.texture.texels[..., :3] / 65535.0) * given.factor
        borders = _near_borders(baked, corners, source.triangle_materials == number, size)
        near[own] = borders[*np.floor(places[own]).astype(int).T[::-1] % size]
        for mip in range(MIPS):
            if mip:
                level = level.reshape(level.shape[0] // 2, 2, level.shape[1] // 2, 2, 3).mean(axis=(1, 3))
            found[mip, own] = _bilinear(level, places[own] / 2**mip)
    inside, beside, errors = [], [], []
    for mip in range(MIPS):
        field = texture.sample(points, "base_color", width=edges * 2**mip if mip else None)
        errors.append(linear_to_srgb(found[mip]) - linear_to_srgb(np.clip(field, 0, 1)))
        worst = np.abs(errors[-1]).max(axis=1) * 255
        for listed, some in ((inside, is_mapped & ~near), (beside, is_mapped & near)):
            listed.append(float(np.percentile(worst[some], 99)) if some.any() else 0.0)
    degrees = None
    if "normal" in texture.channels:
        cosines = np.einsum("nx,nx->n", baked.evaluate(points, "normal"), texture.sample(points, "normal"))
        degrees = float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())
    return Compared(float(-10 * np.log10(np.mean(errors[0] ** 2))), inside, beside, degrees)


def _near_borders(
    baked: octex.Surface, corners: Floats, own: npt.NDArray[np.bool_], size: int
) -> npt.NDArray[np.bool_]:
    """Say which texels (size, size) of a material's maps have one of another chart, or of none, near them."""
    assert baked.uv is not None
    wrapped = corners - np.floor(corners.mean(axis=1, keepdims=True) / size) * size
    charts, edges = charts_of(baked, corners)
    faces = np.flatnonzero(own).astype(np.int32)
    layout = Layout(baked.uv, wrapped[own], faces, charts[own], edges[own], size, size)
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, size, 0, size)
    shown = np.where(drawn.areas > 0.999, layout.charts[drawn.triangles], -1)
    near = shown < 0
    for down in range(-NEAR, NEAR + 1):
        for right in range(-NEAR, NEAR + 1):
            near |= np.roll(shown, (down, right), (0, 1)) != shown
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


def atlas(setup: Setup) -> None:
    """Bake five channels of a mesh at its coordinates; and one, on one core, beside Open3D."""
    around, size = (40, 256) if setup.quick else (316, 4096)
    surface = painted_torus(around, around // 2, size // 4)
    waves = {"roughness": 90.0, "metallic": 50.0, "occlusion": 70.0, "emissive": 80.0}

    def source(name: str) -> Callable[[Floats], Floats]:
        return lambda points: 0.5 + 0.4 * np.sin(waves[name] * points[:, : CHANNELS[name].components])

    sources = {name: source(name) for name in waves}
    texture = octex.convert(surface.with_sources(sources), 6 if setup.quick else 10)
    title(f"atlas: {size}² texels, {len(surface.triangles):,} triangles")
    octex.bake(texture, surface, uv="keep", texture_size=64)
    spent, _ = timed(lambda: octex.bake(texture, surface, uv="keep", texture_size=size))
    line("five channels, all cores", spent)
    assert surface.uv is not None
    uv = np.empty((len(surface.vertices), 2), np.float32)
    uv[surface.triangles] = surface.uv.values[surface.uv.rows]
    arrays = {"vertices": surface.vertices.astype(np.float32), "triangles": surface.triangles, "uv": uv}
    options = {"uv": "keep", "texture_size": size, "channels": ["base_color"], "threads": 1}
    own = {"octex": lambda: timed(lambda: octex.bake(texture, surface, **options))[0]}
    with open3d(setup, "bake", size, core=setup.core, **arrays) as peer, pinned(setup.core):
        for name, each in in_turns(own | peer, setup.repeats).items():
            line(f"{name}, three components, one core", each)
