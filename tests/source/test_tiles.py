"""UDIM: tiles are read as one image, in MTL files and in USD stages."""

import json

import numpy as np
import pytest

import octex
from octex.channels import srgb_to_linear
from octex.errors import ImageError
from octex.source.images.tiles import join_tiles, tile_files, tile_grid
from octex.source.mesh import SurfaceSamples
from tests.make.fixtures import png, random_image
from tests.make.refusal import refused

RED, GREEN, BLUE = [255, 0, 0], [0, 255, 0], [0, 0, 255]
#: Below tile 1012 lies a gap, which is black.
TILES = {1001: [[RED, BLUE], [GREEN, BLUE]], 1011: [[GREEN]], 1012: [[BLUE]]}
#: A square over two columns and two rows of tiles, v up.
CORNERS = [(0, 0), (2, 0), (2, 2), (0, 2)]
PLACES = {
    (0.5, 1.5): RED,
    (0.5, 0.5): GREEN,
    (1.5, 1.0): BLUE,
    (1, 3): GREEN,
    (3, 3): BLUE,
    (3, 1): [0, 0, 0],
}


def as_mtl(folder):
    positions = "".join(f"v {2 * x} {2 * y} 0\nvt {x} {y}\n" for x, y in CORNERS)
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{positions}usemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "a.mtl").write_text("newmtl a\nmap_Kd textures\\wood.<UDIM>.png\n")
    return folder / "a.obj"


def as_usd(folder):
    pytest.importorskip("pxr", reason="the extra octex[usd] is not installed")
    (folder / "a.usda").write_text(f"""#usda 1.0
(upAxis = "Y"
metersPerUnit = 1)
def Mesh "square" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    point3f[] points = {[(2 * x, 2 * y, 0) for x, y in CORNERS]}
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    float2[] primvars:st = {CORNERS} (interpolation = "vertex")
    rel material:binding = </wood>
}}
def Material "wood" {{
    token outputs:surface.connect = </wood/surface.outputs:surface>
    def Shader "surface" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </wood/image.outputs:rgb>
        token outputs:surface
    }}
    def Shader "image" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @textures/wood.<UDIM>.png@
        float3 outputs:rgb
    }}
}}
""")
    return folder / "a.usda"


@pytest.mark.parametrize("write", [as_mtl, as_usd])
def test_tiles_lie_where_their_numbers_say(write, tmp_path):
    path = write(tmp_path)
    with refused(ImageError, "wood.<UDIM>.png is missing; put it next to"):
        octex.load_surface(path)
    (tmp_path / "textures").mkdir()
    for number, texels in TILES.items():
        (tmp_path / f"textures/wood.{number}.png").write_bytes(png(np.array(texels, np.uint8)))
    surface = octex.load_surface(path)
    assert sum(name.endswith(".png") for name in json.loads(surface.provenance["files"])) == len(TILES)
    xy = np.array(list(PLACES), np.float64)
    places = np.column_stack([xy, np.zeros(len(xy))])
    upper = xy[:, 1] > xy[:, 0]
    weights = np.where(
        upper[:, None],
        np.column_stack([4 - xy[:, 1], xy[:, 0], xy[:, 1] - xy[:, 0]]),
        np.column_stack([4 - xy[:, 0], xy[:, 0] - xy[:, 1], xy[:, 1]]),
    )
    samples = SurfaceSamples(places, places, places, upper.astype(np.int32), weights / 4, places)
    np.testing.assert_allclose(
        surface.evaluate(samples), srgb_to_linear(np.array(list(PLACES.values())) / 255), atol=1e-4
    )


def test_only_files_with_a_tile_number_are_tiles(tmp_path):
    for name in (
        "a.1001.png",
        "a.1012.PNG",
        "a.0999.png",
        "a.1000.png",
        "a.10010.png",
        "b.1001.png",
        "a.1110.png",
    ):
        (tmp_path / name).write_bytes(b"")
    found = tile_files(tmp_path / "a.<UDIM>.png")
    assert {number: path.name for number, path in found.items()} == {1001: "a.1001.png", 1110: "a.1110.png"}
    assert tile_grid(found) == (10, 11)
    assert not tile_files(tmp_path / "none" / "a.<UDIM>.png")


def test_tiles_of_two_kinds_or_of_too_many_texels_are_refused():
    whole = random_image(2, 2, 4).astype(np.uint16)
    with refused(ImageError, "wood: some tiles have integers, others floats; save all in one format"):
        join_tiles({1001: whole, 1002: whole.astype(np.float32)}, "wood")
    with refused(ImageError, "wood: the image of all 2 tiles has 50000 × 6600 texels; octex reads up to"):
        join_tiles(
            {1001: np.zeros((1, 5000, 4), np.uint16), 1110: np.zeros((600, 1, 4), np.uint16)},
            "wood",
        )
