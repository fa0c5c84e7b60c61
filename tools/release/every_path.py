"""Tiny models taken along every path of octex: they call all kernels (`tools/release/signatures.py`)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image

import octex
from octex.channels import BASE_COLOR
from octex.drawing import Environment, write_preview
from octex.editing.draft import Change, OpenTiles, cut_out, put_back
from octex.files import scratch_folder
from octex.formats.ply import write_points
from octex.source.mesh import Mesh
from octex.source.models.vxz import unpack_vxz
from octex.texture import FILTERS
from octex.tree.areas import area_codes
from octex.tree.morton import encode_cells
from octex.tree.search import Positions, order_in_space, put_rows
from octex.viewer.export import write_page

# A needle: few cells, but at a depth at which cells come in several blocks.
_OBJ = """mtllib needle.mtl
usemtl needle
v 0 0 0
v 1 0 0
v 1 0.01 0
v 0 0.01 0
v 0.2 0.002 0.01
vt 0 0
vt 3 0
vt 3 1
vt 0 1
f 4/4 3/3 2/2 1/1
f 1/1 2/2 5/3
f 2/2 3/3 5/4
f 3/3 4/4 5/1
f 4/4 1/1 5/2
"""
_MTL = "newmtl needle\nmap_Kd needle.png\nnorm needle.png\n"
_PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 0.01 0
3 0 1 2
"""
_QUAD = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
f 1 2 3 4
f 2 5 3
"""


def main(_arguments: list[str]) -> int:
    """Read, convert, save, open, sample, validate, draw and paint tiny models."""
    with scratch_folder() as folder:
        surfaces = _surfaces(folder)
        light = Environment.of(np.full((4, 8, 3), 128, np.uint8))
        for surface in surfaces:
            _convert_and_look(surface, folder)
            texture = octex.convert(surface, 3)
            write_preview(folder / "model.png", texture, surface, size=(64, 64))
            bump = ("base_color", 0.01)
            write_preview(folder / "lit.png", texture, surface, size=(64, 64), light=light, bump=bump)
        light.irradiance([[0.0, 0.0, 1.0]])
        write_page(octex.convert(surfaces[0], 3), folder / "page.octw", surfaces[0])
        _map(surfaces[0])
        _take(surfaces[0], folder)
        _separate(surfaces[0])
        _paint(surfaces[0], folder)
        _bake(surfaces, folder)
        _ptex(folder)
    return 0


def _surfaces(folder: Path) -> list[octex.Surface]:
    """One textured from a file and deformed, one without colours, one with all that arrays can give."""
    (folder / "needle.obj").write_text(_OBJ)
    (folder / "needle.mtl").write_text(_MTL)
    (folder / "needle.ply").write_text(_PLY)
    # Of several values: constants are baked as factors.
    PIL.Image.fromarray(np.arange(0, 48000, 3000).reshape(4, 4).astype(np.uint16)).save(folder / "needle.png")
    textured = octex.load_surface(folder / "needle.obj")
    deformed = textured.with_rest(2.0 * textured.vertices)
    translucent = octex.Surface.from_arrays(
        textured.vertices,
        textured.triangles,
        colors=np.full((len(textured.vertices), 4), 0.5),
        uv=textured.vertices[:, :2],
        image=np.arange(64, dtype=np.uint8).reshape(4, 4, 4) * 4,
        rest=textured.vertices[:, ::-1],
    )
    return [deformed, octex.load_surface(folder / "needle.ply"), translucent]


def _convert_and_look(surface: octex.Surface, folder: Path) -> None:
    samples = surface.scatter(100)
    for channel in surface.channels:
        surface.evaluate(samples, channel.name, width=0.1)
        surface.with_filter("bilinear").evaluate(samples, channel.name, width=0.1)
    octex.convert(surface, 6).save(folder / "needle.octex")
    texture = octex.open(folder / "needle.octex")
    texture.validate()
    texture.save(folder / "needle.octz")
    octex.open(folder / "needle.octz")
    for points in (samples.rest, samples.rest.astype(np.float32)):
        texture.contains(points)
        for filter in FILTERS:
            texture.sample(points, list(texture.channels), filter)
            texture.level(2).sample(points, filter=filter)
            texture.sample(points, filter=filter, width=0.1)
            texture.sample(points + 0.1, filter=filter)
        texture.sample(points, list(texture.channels), gradient=True)
        right, down = points * 0.1, points[:, ::-1] * 0.2
        texture.sample(points, dPdx=right, dPdy=down)
        texture.sample(points, list(texture.channels), dPdx=right, dPdy=down, normals=points)
        texture.sample(points, list(texture.channels), width=0.1, gradient=True)
    for dtype in ("uint16", "float16", "float32"):
        coarse = octex.convert(surface, 2, dtype=dtype)
        for filter in ("nearest", "quadratic"):
            coarse.sample(samples.rest, list(texture.channels), filter)
    octex.convert(surface, 4, max_error=2, detail="stretch")
    mixed = octex.convert(surface, 4, detail=lambda rest: np.where(rest[:, 0] > rest[0, 0], 4.0, 2.0))
    points = surface.scatter(100).rest
    mixed.sample(points, list(mixed.channels))
    # As for more points than are warmed up with.
    numbers = order_in_space(Positions.of(points), *mixed.placement)
    put_rows(np.empty((numbers.size, 3), np.float32), numbers, np.empty((100, 3), np.float32))
    encode_cells([(1, 2, 3)])
    texture.tree.level_codes(6)
    area_codes(np.ones(1))
    write_points(texture, folder / "points.ply")
    write_preview(folder / "texture.png", texture, size=(64, 64))


def _map(surface: octex.Surface) -> None:
    """Lay images on a surface by position."""
    image = octex.MappedImage(np.full((4, 4), 128, np.uint8), "box")
    mapped = surface.with_sources({"base_color": image, "normal": image})
    samples = mapped.scatter(10)
    for channel in ("base_color", "normal"):
        mapped.evaluate(samples, channel, 0.1)
    mapped.source.texel_edges(samples.triangles)


def _take(surface: octex.Surface, folder: Path) -> None:
    """Take values from another model and from points, convert points alone, and read voxels."""
    samples = surface.scatter(10)
    cloud = octex.PointCloud(samples.rest, np.full((10, 3), 128, np.uint8), samples.normals)
    bare = octex.Surface.from_arrays(surface.vertices, surface.triangles)
    for sources in (octex.Transfer(surface, max_angle=90.0).sources, cloud.sources):
        bare.with_sources(sources).evaluate(samples)
    octex.convert(cloud)
    voxel = {"ptr": [0, 4], "svo": [0, 1], "attr": [1, 3], "idx": [0, 0, 0]}
    for name in ("none", "parent", "neighbor"):
        header = {"filter": name, "compression": "none", "chunk_size": 2, "attr": [["base_color", 3]]}
        words = json.dumps({**header, "attr_interleave": "all", "chunks": [voxel]}).encode()
        unpack_vxz(b"VXZ\0" + (8 + len(words)).to_bytes(4, "big") + words + b"\x01abc", "warm-up")
    quad = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]])
    grid = {"dual_vertices": np.full((4, 3), 0.5), "intersected": quad == 0}
    np.savez(folder / "quad.npz", coords=quad, x=np.ones(4), **grid)
    octex.load_surface(folder / "quad.npz")


def _separate(surface: octex.Surface) -> None:
    """Move two parts apart, and repair them."""
    twice = np.concatenate([surface.triangles, surface.triangles + len(surface.rest)])
    parts = octex.Surface.from_arrays(np.concatenate([surface.rest, surface.rest + 0.001]), twice)
    octex.separate(parts)
    octex.repair(octex.Surface.from_arrays(parts.rest, parts.triangles[1:]), cell=0.1)


def _paint(surface: octex.Surface, folder: Path) -> None:
    """Paint onto nothing, and onto a texture that is coarser than the images."""
    from octex.painting.image import mips_of
    from octex.photos.agreement import fill_unknown, find_modes, off_modes
    from octex.photos.patches import put_mask

    camera = octex.Camera.fitted(surface.vertices, (0.4, 0.3, 1.0), size=(16, 4))
    camera.differentials(surface.vertices, surface.vertices)
    image = np.full((4, 16, 4), 128, np.uint8)
    image[0, 0] = 0
    image[1, ::2, :3] = 20  # images of one colour are not sharpened
    projection = octex.Projection(image, camera)
    octex.convert(surface, 2).save(folder / "coarse.octex")
    for texture in (None, octex.open(folder / "coarse.octex")):
        octex.paint(texture, surface, projection)
    octex.paint(texture, surface, projection, hidden=True)
    octex.refine_cameras(surface, [projection] * 2)
    octex.paint(None, surface, [projection] * 3, balance="full")
    octex.paint(None, surface, [projection] * 3, pictures="best")
    find_modes(np.zeros((3, 1, 3), np.float32), np.zeros((3, 1), np.float32), 0, np.zeros((1, 3), np.float32))
    off_modes(*np.zeros((2, 1, 1, 3), np.float32))
    fill_unknown(np.full((1, 1), np.nan, np.float32), np.zeros((1, 1, 4), np.float32))
    mips = mips_of(projection, BASE_COLOR)
    put_mask(mips, np.zeros((1, 4), np.float32))
    lens = replace(camera, distortion=(0.01, 0.0, 0.0, 0.0))
    octex.paint(None, surface, [replace(projection, camera=lens)] * 3)
    _process(octex.open(folder / "coarse.octex"), surface)
    octex.fill(texture, surface, octex.Sphere((0.0, 0.0, 0.0), 0.1), (1.0, 0.0, 0.0))


def _bake(surfaces: list[octex.Surface], folder: Path) -> None:
    """Bake to images in atlases, of what folds and overlaps too, and write them."""
    from octex.baking.charts import laid_flat
    from octex.baking.texels import barycentric_at

    steps = np.arange(60)
    ring = np.stack([np.cos(steps / 3.0), np.sin(steps / 3.0), steps / 30.0], axis=1)  # above itself
    rough = np.concatenate(
        [np.argwhere(np.ones((100, 100))), 4.0 * np.random.default_rng(0).random((10_000, 1))], axis=1
    )
    for points, width in ((np.concatenate([ring, ring * (2.0, 2.0, 1.0)]), 60), (rough, 100)):
        starts = np.arange(len(points) - width).reshape(-1, width)[:, :-1].reshape(-1)
        quads = np.stack([starts, starts + width, starts + width + 1, starts + 1], axis=1)
        laid_flat(Mesh(points, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)))
    surface, translucent = surfaces[0], surfaces[2]
    texture = octex.convert(surface, 3)
    octex.bake(
        octex.convert(translucent, 3), translucent, uv="atlas", texture_size=64, padding=2, supersample=2
    )
    barycentric_at(np.zeros((1, 3, 2)), np.zeros(1, np.int32), np.zeros((1, 2)))
    baked = octex.bake(texture, surface, uv="atlas", texture_size=64, padding=2)
    octex.write_model(baked, folder / "baked.glb", octree=texture)
    octex.open(folder / "baked.glb")
    octex.bake_vertices(texture, surface, subdivide="auto")
    octex.displace(texture, surface, "base_color", 0.01)


def _ptex(folder: Path) -> None:
    """Write texels for polygons, and convert them; paint on a piece that is laid flat."""
    (folder / "quad.obj").write_text(_QUAD)
    surface = octex.load_surface(folder / "quad.obj")
    texture = octex.convert(surface, 3)
    for mesh in (surface, octex.Surface.from_arrays(surface.vertices, surface.triangles)):
        octex.write_ptex(texture, mesh, folder / "faces.ptx")
        octex.convert(mesh.with_sources(octex.Ptex(folder / "faces.ptx").sources), 3)
    octex.write_osl(texture, folder / "walk.osl")
    patch = octex.unwrap(surface, (0.5, 0.5, 0), 0.4, size=8)
    octex.paint(texture, surface, octex.Projection(np.zeros((8, 8, 3), np.uint8), patch))


def _process(texture: octex.OctreeTexture, surface: octex.Surface) -> None:
    """Change values of every type, and put together textures of two depths."""
    for dtype in ("uint8", "uint16", "float32"):
        cast = octex.cast(texture, {"base_color": dtype})
        octex.map(octex.levels(cast, gamma=(1.0, 1.1, 1.2)), lambda values: values)
        octex.levels(cast, gamma=1.5)
    octex.blur(octex.crop(texture, surface.bounds[0], surface.bounds[1]), 0.1)
    finer = octex.resize(texture, 3)
    finer.sample(surface.rest, filter="nearest")
    codes, _ = list(finer.tree.walk())[2]
    tiles = OpenTiles(2, codes[:1])
    draft = cut_out(finer, tiles)
    put_back(finer, tiles, draft)
    Change(tiles, draft, octex.levels(draft, gamma=2.0)).put_into(finer)
    octex.mix(finer, texture, 0.3)
