"""Benchmarks of baking: what a bilinear sampler reads from the maps beside the field, and the time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from inputs import painted_torus
from measuring import DROID, Report, Setup, Spent, in_turns, open3d, pinned, timed

import octex
from octex.baking.gutters import find_nearest
from octex.baking.layout import Layout, charts_of, neighbors
from octex.baking.texels import draw_texels
from octex.channels import CHANNELS, linear_to_srgb, srgb_to_linear
from octex.formats.models import materials_of

Floats = npt.NDArray[np.float64]

#: Models of a folder whose maps are baked, by their files' names.
MODELS = "Avocado.gltf", "BoomBoxWithAxes.gltf", "Suzanne.gltf", "spot.obj"
#: Points so near to a chart's border, in texels, are told apart.
NEAR = 2
MIPS = 4
#: Degrees between the triangles beside a border up to which it is no crease.
SMOOTH = 20.0


def baking(setup: Setup, report: Report) -> None:
    """Read maps that were baked, beside the field, and beside the borders of charts."""
    report.title("baking: base colour of maps beside the field that they were baked from, dB")
    rows = []
    for path in _models(setup):
        surface = octex.load_surface(path, normals=True)
        names = [each.name for each in surface.channels if each.name in ("base_color", "normal")]
        texture = octex.convert(surface.with_channels(names), 6 if setup.quick else 10)
        rows += _table(report, path.stem, surface, texture, 128 if setup.quick else largest_map(surface))
    report.note(
        "99th percentiles of the difference, codes, by mip level: within 2 texels of borders / of those that "
        "are no creases / elsewhere where detail is as beside the former, as beside the latter / elsewhere"
    )
    report.table(["model", "uv", "size", "dB", *(f"mip {level}" for level in range(MIPS)), "normals"], rows)
    _speed(setup, report)


def _models(setup: Setup) -> Iterator[Path]:
    yield DROID
    for name in MODELS if setup.models is not None else ():
        assert setup.models is not None
        yield from list(setup.models.rglob(name))[:1]


def largest_map(surface: octex.Surface) -> int:
    """Return the longest side of the images that a model's colours come from."""
    inputs = (each.inputs.get("base_color") for each in materials_of(surface).materials)
    textures = (each.texture for each in inputs if each is not None)
    return max((max(each.texels.shape[:2]) for each in textures if each is not None), default=1024)


def _table(
    report: Report, name: str, surface: octex.Surface, texture: octex.OctreeTexture, size: int
) -> Iterator[list[str]]:
    made = []
    size_of_atlas = size
    try:
        kept = octex.bake(texture, surface, uv="keep", texture_size=size)
    except octex.OctexError as error:
        report.note(str(error))
    else:
        made.append(("keep", kept, size, 42.0))
        size_of_atlas = 8 * round(float(np.sqrt(sum(each**2 for each in _sizes(kept)))) / 8)
    size_of_atlas = max(size_of_atlas, 256 if report.quick else 1024)
    atlas = octex.bake(texture, surface, uv="atlas", texture_size=size_of_atlas)
    made.append(("atlas", atlas, size_of_atlas, 38.0))
    for uv, baked, side, least in made:
        found = compared(texture, baked, side, 5000 if report.quick else 200_000)
        normals = "" if found.degrees is None else f"{found.degrees:.2f}°"
        rows = zip(found.beside, found.smooth, found.alike, found.smooth_alike, found.inside, strict=True)
        percentiles = [" / ".join(f"{each:.2f}" for each in row) for row in rows]
        yield [name, uv, str(side), f"{found.decibels:.1f}", *percentiles, normals]
        report.at_least(f"baking: {name}, {uv}", found.decibels, least, "dB")
        compared_with = [
            ("borders above elsewhere", found.beside, found.inside),
            ("borders above elsewhere, alike", found.beside, found.alike),
            ("smooth borders above elsewhere, alike", found.smooth, found.smooth_alike),
        ]
        for what, borders, others in compared_with:
            worst = max(b - a for a, b in zip(others, borders, strict=True))
            report.at_most(f"baking: {name}, {uv}, {what}", worst, 1.0, "codes")
        if found.degrees is not None:
            report.at_most(f"baking: {name}, {uv}, normals", found.degrees, 1.0, "degrees")


class Compared(NamedTuple):
    """How maps differ from the field."""

    decibels: float  # at mip 0
    inside: list[float]  # 99th percentiles by mip level, codes, away from borders of charts
    beside: list[float]  # and beside them
    alike: list[float]  # away from borders, each point weighing so that detail is as common as beside them
    smooth: list[float]  # beside borders across which the surface goes on without a crease
    smooth_alike: list[float]  # away from borders, where detail is as common as beside those
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
    found, (near, smooth) = np.empty((MIPS, count, 3)), np.zeros((2, count), np.bool_)
    is_mapped = flat[points.triangles] > 1e-9  # the others have no texels
    for number, material in enumerate(source.materials):
        own = owners == number
        given = material.inputs["base_color"]
        if given.texture is None:
            found[:, own], is_mapped[own] = given.factor, False
            continue
        level = srgb_to_linear(given.texture.texels[..., :3] / 65535.0) * given.factor
        around = _near_borders(baked, corners, source.triangle_materials == number, size)
        near[own], smooth[own] = around[:, *np.floor(places[own]).astype(int).T[::-1] % size]
        for mip in range(MIPS):
            if mip:
                level = level.reshape(level.shape[0] // 2, 2, level.shape[1] // 2, 2, 3).mean(axis=(1, 3))
            found[mip, own] = _bilinear(level, places[own] / 2**mip)
    inside, beside, alike, decibels = [], [], [], 0.0
    beside_smooth, smooth_alike = [], []
    field = _seen(texture, points, None)
    for mip in range(MIPS):
        coarser = _seen(texture, points, edges * 2 ** (mip + 1))
        own = linear_to_srgb(found[mip])
        difference = np.abs(own - field).max(axis=1) * 255
        if mip == 0:
            decibels = float(-10 * np.log10(np.mean((own - field) ** 2)))
        detail = np.abs(field - coarser).max(axis=1)[is_mapped] * 255
        difference, is_near, is_smooth = difference[is_mapped], near[is_mapped], smooth[is_mapped]
        inside.append(float(np.percentile(difference[~is_near], 99)))
        beside.append(_percentile(difference[is_near]))
        alike.append(_alike(difference, detail, is_near, is_near))
        beside_smooth.append(_percentile(difference[is_smooth]))
        smooth_alike.append(_alike(difference, detail, is_smooth, is_near))
        field = coarser
    degrees = None
    if "normal" in texture.channels:
        cosines = np.einsum("nx,nx->n", baked.evaluate(points, "normal"), texture.sample(points, "normal"))
        degrees = float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())
    return Compared(decibels, inside, beside, alike, beside_smooth, smooth_alike, degrees)


def _seen(texture: octex.OctreeTexture, points: octex.SurfaceSamples, width: Floats | None) -> Floats:
    """Return the field's sRGB values at points, over widths."""
    return linear_to_srgb(np.clip(texture.sample(points, "base_color", width=width), 0, 1))


def _percentile(difference: Floats) -> float:
    return float(np.percentile(difference, 99)) if difference.size else 0.0


def _alike(
    difference: Floats, detail: Floats, some: npt.NDArray[np.bool_], near: npt.NDArray[np.bool_]
) -> float:
    """Return the 99th percentile away from borders if detail, in codes, were as common there as at some."""
    bins = np.digitize(detail, 0.25 * 2.0 ** np.arange(10))
    there, here = (np.bincount(bins[each], minlength=11) for each in (some, ~near))
    weights = (there / np.maximum(here, 1))[bins[~near]]
    order = np.argsort(difference[~near])
    total = np.cumsum(weights[order])
    return float(difference[~near][order][np.searchsorted(total, 0.99 * total[-1])]) if some.any() else 0.0


def _sizes(baked: octex.Surface) -> list[int]:
    """Return the sides of the maps of a surface's colours."""
    inputs = [each.inputs["base_color"].texture for each in materials_of(baked).materials]
    return [len(each.texels) for each in {id(t.texels): t for t in inputs if t is not None}.values()]


def _near_borders(
    baked: octex.Surface, corners: Floats, own: npt.NDArray[np.bool_], size: int
) -> npt.NDArray[np.bool_]:
    """Say which texels (2, size, size) of a material's maps have one of another chart, or of none, near them.

    The second are those of them where the surface goes on without a crease across the nearest border.
    """
    assert baked.uv is not None
    wrapped = corners - np.floor(corners.mean(axis=1, keepdims=True) / size) * size
    charts, edges = charts_of(baked, corners)
    layout = Layout(
        baked.uv, wrapped[own], np.flatnonzero(own).astype(np.int32), charts[own], edges[own], size, size
    )  # fmt: skip
    drawn = draw_texels(layout.corners, layout.charts, layout.edges, size, 0, size)
    shown = np.where(drawn.areas > 0.999, layout.charts[drawn.triangles], -1)
    near = shown < 0
    for down in range(-NEAR, NEAR + 1):
        for right in range(-NEAR, NEAR + 1):
            near |= np.roll(shown, (down, right), (0, 1)) != shown
    of, sides = np.nonzero(layout.edges)
    nearest, border = np.full((size, size), np.inf, np.float32), np.full((size, size), -1, np.int32)
    find_nearest(layout.corners, of, sides, np.zeros_like(near), 2.0 + NEAR, nearest, border)
    others, _ = neighbors(baked)
    ends = baked.rest[baked.triangles]
    normals = np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    beyond = others[layout.faces[of], sides]
    cosines = np.einsum("nx,nx->n", normals[layout.faces[of]], normals[beyond])
    is_smooth = (beyond >= 0) & (cosines > np.cos(np.radians(SMOOTH)))
    return np.stack([near, near & (border >= 0) & is_smooth[border]])


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


def _speed(setup: Setup, report: Report) -> None:
    """Bake five channels of a mesh with an atlas, without unwrapping it."""
    around, size = (40, 256) if setup.quick else (316, 4096)
    surface = painted_torus(around, around // 2, size // 4)
    rates = {"roughness": 90.0, "metallic": 50.0, "occlusion": 70.0, "emissive": 80.0}
    sources = {name: _waves(rate, CHANNELS[name].components) for name, rate in rates.items()}
    texture = octex.convert(surface.with_sources(sources), 6 if setup.quick else 10)
    octex.bake(texture, surface, uv="keep", texture_size=64)
    spent, _ = timed(lambda: octex.bake(texture, surface, uv="keep", texture_size=size))
    report.line(f"{size}², five channels, {len(surface.triangles):,} triangles", spent)
    report.at_most("baking: five channels of 4096²", spent.wall, 6.0, "s")
    _beside_open3d(setup, report, texture, surface, size)


def _waves(rate: float, components: int) -> Callable[[Floats], Floats]:
    return lambda points: 0.5 + 0.4 * np.sin(rate * points[:, :components])


def _beside_open3d(
    setup: Setup, report: Report, texture: octex.OctreeTexture, surface: octex.Surface, size: int
) -> None:
    """Bake one channel on one core, and colours of vertices by Open3D."""
    assert surface.uv is not None
    path = setup.folder / "bake.npz"
    uv = np.empty((len(surface.vertices), 2), np.float32)
    uv[surface.triangles] = surface.uv.values[surface.uv.rows]
    np.savez(path, vertices=surface.vertices.astype(np.float32), triangles=surface.triangles, uv=uv)

    def own() -> Spent:
        options = {"uv": "keep", "texture_size": size, "channels": ["base_color"], "threads": 1}
        return timed(lambda: octex.bake(texture, surface, **options))[0]

    with open3d(setup, report, "bake", path, size, core=setup.core) as peer, pinned({setup.core}):
        if not peer:
            return
        own()
        found = in_turns({"octex": own, **peer}, setup.repeats)
    for name, each in found.items():
        report.line(f"{name}, {size}², three components, one core", str(each))
    report.at_least("baking: of Open3D's rate", found["Open3D"].cpu / found["octex"].cpu, 2)
