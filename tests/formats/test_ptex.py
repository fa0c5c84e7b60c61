"""Ptex: files against a simple reader, meshes against their polygons, textures there and back."""

import importlib.util
import struct
import sys
import zlib
from contextlib import nullcontext as nothing
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import decode, linear_to_srgb
from octex.errors import ArgumentError, ModelError
from octex.formats.ptex.export import _at
from octex.formats.ptex.patches import faces_of, neighbors_of, patches_of, place
from octex.formats.ptex.reader import PtexFile
from octex.formats.ptex.writer import PtexContents, write_contents
from octex.parallel import Run, workers
from tests.make.small_surfaces import OCTAHEDRON, OCTAHEDRON_FACES
from tests.oracles import naive_ptex

TOOLS = Path(__file__).parents[2] / "tools"
# A cage of quads, a pentagon and a triangle: a house without a floor, whose walls share edges with the roof.
HOUSE = """v 0 0 0
v 2 0 0
v 2 0 1
v 0 0 1
v 0 1 0
v 2 1 0
v 2 1 1
v 0 1 1
v 0 1.5 0.5
v 2 1.5 0.5
f 1 5 6 2
f 3 7 8 4
f 5 9 10 6
f 7 10 9 8
f 4 8 9 5 1
f 2 6 10 7 3
"""


def tool(name):
    """A program of tools/, as a module."""
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def house(tmp_path):
    (tmp_path / "house.obj").write_text(HOUSE)
    return tmp_path / "house.obj"


def waves(points):
    """Return a smooth colour by position."""
    x, y, z = points.T
    return np.stack([np.sin(3 * x + y), np.cos(2 * y - 2 * z), np.sin(2 * z + 2 * x)], axis=1) * 0.35 + 0.5


@pytest.mark.parametrize("seed", range(6))
def test_what_is_written_is_read_by_a_simple_reader_and_by_octex(seed, tmp_path):
    contents = tool("bench/peers/ptex_peer").random_contents(seed)
    path = tmp_path / "made.ptx"
    with workers(Run(threads=1)) as executor:
        write_contents(contents, path, executor)
    records, texels, metadata = naive_ptex.read(path)
    ends = np.cumsum(contents.faces.counts)
    with PtexFile(path) as file:
        assert (file.mesh_type, file.alpha_channel) == (contents.mesh_type, contents.alpha_channel)
        assert (file.border_modes, file.edge_filter) == (contents.border_modes, contents.edge_filter)
        sides = 4 if file.mesh_type == "quad" else 3
        assert np.array_equal(file.faces.neighbors[:, :sides], contents.faces.neighbors[:, :sides])
        assert np.array_equal(file.faces.edges[:, :sides], contents.faces.edges[:, :sides])
        for face, (end, count) in enumerate(zip(ends, contents.faces.counts, strict=True)):
            wanted = contents.texels[end - count : end]
            assert np.array_equal(texels[0][face].reshape(count, -1), wanted)
            assert np.array_equal(file.texels(face).reshape(count, -1), wanted)
            assert tuple(records[face][4:8]) == tuple(file.faces.neighbors[face])
        assert file.metadata.keys() == metadata.keys() == contents.metadata.keys()
        for name, value in contents.metadata.items():
            assert file.metadata[name] == value
            assert metadata[name] == value.encode() + b"\0"


def written(path, mesh_type, log2, texels, **options):
    """Write a file of three faces that have no neighbours."""
    peer = tool("bench/peers/ptex_peer")
    alone = np.full((3, 4), -1, np.int32)
    faces = peer.Faces(np.full((3, 2), log2, np.int8), alone, np.zeros((3, 4), np.uint8), np.zeros(3, bool))
    with workers(Run(threads=1)) as executor:
        write_contents(PtexContents(mesh_type, faces, texels, **options), path, executor)
    return path


@pytest.mark.parametrize("mesh_type", ["quad", "triangle"])
def test_reductions_and_averages_are_means_of_texels_to_rounding(mesh_type, tmp_path):
    texels = np.random.default_rng(0).integers(0, 256, (3 * 1024, 3)).astype(np.uint8)
    path = written(tmp_path / "made.ptx", mesh_type, 5, texels)
    _, levels, _ = naive_ptex.read(path)
    with PtexFile(path) as file:
        assert file.n_levels == len(levels) == 4
        for face in range(3):
            whole = file.texels(face).astype(float)
            mean = whole.mean(axis=(0, 1))
            assert abs(file.constants[face] - mean).max() <= 0.5 + 1e-9
            for level in range(1, 4):
                part = levels[level][face].astype(float)
                assert part.shape == (32 >> level, 32 >> level, 3)
                assert abs(part.mean(axis=(0, 1)) - mean).max() < 0.7
            if mesh_type == "quad":
                wanted = whole.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3))
                assert abs(levels[2][face] - wanted).max() <= 0.5 + 1e-9


def test_damaged_files_are_refused_or_read(tmp_path):
    import random

    fuzz = tool("fuzz/random_ptex")
    path = tmp_path / "damaged.ptx"
    with workers(Run(threads=1)) as executor:
        write_contents(tool("bench/peers/ptex_peer").random_contents(3), path, executor)
    good, results = path.read_bytes(), set()
    for seed in range(150):
        draw = random.Random(seed)
        path.write_bytes(fuzz.damaged(good, draw))
        results.add(fuzz.attempt(path, draw))
    assert results == {"read", "refused"}


def test_edits_that_were_appended_count(tmp_path):
    texels = np.arange(12, dtype=np.uint8)[:, None]
    path = written(tmp_path / "made.ptx", "quad", 1, texels, metadata={"by": "me"})
    record = struct.pack("<bbBB4i", 1, 0, 0, 0, -1, -1, -1, -1)
    block = zlib.compress(bytes([70, 80]))
    face = struct.pack("<I", 1) + record + struct.pack("<I", len(block) | 1 << 30) + bytes([75]) + block
    flat = struct.pack("<I", 2) + record[:3] + b"\x01" + record[4:] + struct.pack("<I", 0) + bytes([9])
    entry = b"\x03by\0\0" + struct.pack("<I", 4) + b"you\0"
    zipped = zlib.compress(entry)
    note = struct.pack("<II", len(zipped), len(entry)) + zipped
    edits = b"".join(
        struct.pack("<BI", kind, len(each)) + each for kind, each in ((0, face), (0, flat), (1, note))
    )
    data = bytearray(path.read_bytes() + edits)
    data[64 + 24 : 64 + 32] = struct.pack("<Q", len(edits))
    path.write_bytes(data)
    with PtexFile(path) as file:
        assert file.texels(0).ravel().tolist() == [0, 1, 2, 3]
        assert file.texels(1).tolist() == [[[70], [80]]]
        assert file.texels(2).tolist() == [[[9], [9]]]
        assert file.constants[1:].tolist() == [[75], [9]]
        assert file.metadata == {"by": "you"}
    for end in (1, 30, 60):
        path.write_bytes(data[:-end])
        with pytest.raises(ModelError, match="ends early"):
            PtexFile(path)


@pytest.mark.parametrize("broken", ["nothing", "folder", "text"])
def test_what_is_no_ptex_file_is_named(broken, tmp_path):
    path = tmp_path / "broken.ptx"
    if broken == "folder":
        path.mkdir()
    elif broken == "text":
        path.write_text("no texels" * 50)
    with pytest.raises(ModelError, match=r"broken\.ptx"):
        PtexFile(path)


def test_neighbours_share_an_edge_and_polygons_are_a_face_for_each_corner(house):
    surface = octex.load_surface(house)
    patches = patches_of(surface)
    neighbors, edges = neighbors_of(surface, patches)
    assert patches.n_faces == 4 + 5 + 5
    assert np.array_equal(patches.owners, [0, 1, 2, 3, *[4] * 5, *[5] * 5])
    # Points on an edge of a face are those on the neighbour's, from its other end.
    for face in range(patches.n_faces):
        for edge in range(4):
            other = neighbors[face, edge]
            if other < 0:
                continue
            whole = [np.bincount(patches.owners)[patches.owners[each]] == 1 for each in (face, other)]
            mine = points_on_edge(surface, patches, face, edge)
            its = points_on_edge(surface, patches, other, edges[face, edge])
            if whole[0] == whole[1]:
                assert neighbors[other, edges[face, edge]] == face
                assert np.allclose(mine, its[::-1], atol=1e-12)
            elif whole[0]:  # beside two subfaces, the first is named
                assert np.allclose(mine[0], its[-1], atol=1e-12)
                assert np.allclose(mine.mean(axis=0), its[0], atol=1e-12)
            else:
                assert np.allclose(mine[0], its[-1]) or np.allclose(mine[-1], its[0])


def points_on_edge(surface, patches, face, edge):
    """Return both ends of an edge of a face, as it goes around."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    uv = corners[[edge, (edge + 1) % 4]]
    triangles, barycentric = place(patches, np.full(2, face, np.int32), uv)
    return surface.rest_at(triangles, barycentric)


def test_edges_of_three_faces_or_gone_along_twice_the_same_way_are_borders():
    vertices = [(0, 0, 0), (0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0.5, 1, 1)]
    three = octex.Surface.from_arrays(vertices, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert (neighbors_of(three, patches_of(three))[0] == -1).all()
    same = octex.Surface.from_arrays(vertices, [[0, 1, 2], [0, 1, 3]])
    assert (neighbors_of(same, patches_of(same))[0] == -1).all()
    sound = octex.Surface.from_arrays(vertices, [[0, 1, 2], [1, 0, 3]])
    neighbors, edges = neighbors_of(sound, patches_of(sound))
    assert neighbors[:, 0].tolist() == [1, 0]
    assert edges[:, 0].tolist() == [0, 0]


@pytest.mark.parametrize("triangles", [False, True])
def test_at_the_centres_of_texels_a_surface_has_their_values(triangles, house, tmp_path):
    surface = octex.load_surface(house)
    if triangles:
        surface = octex.Surface.from_arrays(surface.vertices, surface.triangles)
    texture = octex.convert(surface, 5, sources={"base_color": waves})
    octex.write_ptex(texture, surface, tmp_path / "made.ptx")
    painted = surface.with_sources(octex.Ptex(tmp_path / "made.ptx").sources)
    patches = patches_of(surface)
    with PtexFile(tmp_path / "made.ptx") as file:
        assert file.mesh_type == ("triangle" if triangles else "quad")
        for face in range(file.n_faces):
            count = int(file.faces.counts[face])
            log2 = np.repeat(file.faces.log2[face][None], count, axis=0)
            middle = np.full((1, 2), 1 / 3 if triangles else 1 / 2)
            uv = _at(patches, log2, np.arange(count), middle)[:, 0]
            at = place(patches, np.full(count, face, np.int32), uv)
            found = painted.evaluate_all(*at, np.zeros(count, np.float32))
            wanted = decode(file.texels(face).reshape(count, 3), "srgb")
            assert abs(found - wanted).max() < 1e-4


def octaves(points):
    """Return a colour by position that varies over lengths down to six cells of depth 5."""
    return np.asarray(sum((waves(points * 2**k) - 0.5) * 0.6**k for k in range(3)) * 0.6 + 0.5)


@pytest.mark.parametrize("triangles", [False, True])
def test_there_and_back_a_texture_stays_within_40_decibels(triangles, house, tmp_path):
    surface = octex.load_surface(house)
    if triangles:
        surface = octex.Surface.from_arrays(surface.vertices, surface.triangles)
    texture = octex.convert(surface, 5, sources={"base_color": octaves})
    octex.write_ptex(texture, surface, tmp_path / "made.ptx", texels=texture.tree.n_leaves)
    with PtexFile(tmp_path / "made.ptx") as file:
        assert texture.tree.n_leaves / 4 < file.faces.counts.sum() <= texture.tree.n_leaves
    back = octex.convert(surface.with_sources(octex.Ptex(tmp_path / "made.ptx").sources), 5)
    points = surface.scatter(20_000)
    error = linear_to_srgb(texture.sample(points)) - linear_to_srgb(back.sample(points))
    assert -10 * np.log10((error**2).mean()) >= 40


@pytest.mark.parametrize("sizes", [(3, 3), (1, 4), (0, 2)])
def test_across_edges_of_triangles_values_go_on_whatever_the_faces_resolutions(sizes, tmp_path):
    surface = octex.Surface.from_arrays(OCTAHEDRON, OCTAHEDRON_FACES)  # closed: each vertex has four faces
    patches = patches_of(surface)
    log2 = np.array([[sizes[n % 2]] * 2 for n in range(8)], np.int8)  # neighbours differ
    faces = faces_of(surface, patches, log2)
    texels = np.random.default_rng(0).random((int(faces.counts.sum()), 3), np.float32)
    path = tmp_path / "made.ptx"
    with workers(Run(threads=1)) as executor:
        write_contents(PtexContents("triangle", faces, texels), path, executor)
    painted = surface.with_sources(octex.Ptex(path).sources)
    along = np.linspace(0.0, 1.0, 97)
    here = np.stack([1 - along, along, np.zeros(97)], axis=1)
    for face in range(8):
        for edge in range(3):
            other, there = faces.neighbors[face, edge], faces.edges[face, edge]
            sides = [
                painted.evaluate_all(
                    np.full(97, each, np.int32), np.roll(shares, turn, axis=1), np.zeros(97, np.float32)
                )
                for each, turn, shares in ((face, edge, here), (other, there, here[::-1]))
            ]
            assert np.ptp(sides[0]) > 0.01
            np.testing.assert_allclose(*sides, atol=1e-6)
            # Along the edge they are linear between the corners of the coarser face's texels.
            knots = 2 ** int(min(log2[face, 0], log2[other, 0]))
            bends = abs(np.diff(sides[0], 2, axis=0)).max(axis=1)
            inner = np.abs(along[1:-1] * knots - np.rint(along[1:-1] * knots)) > knots / 96
            assert (bends[inner] < 1e-6).all()


def test_a_corner_of_texels_on_an_edge_of_triangles_is_the_mean_of_six(tmp_path):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    surface = octex.Surface.from_arrays(corners, [[0, 1, 2], [3, 2, 1]])
    faces = faces_of(surface, patches_of(surface), np.ones((2, 2), np.int8))
    texels = np.arange(8, dtype=np.float32)[:, None] / 8
    path = tmp_path / "made.ptx"
    with workers(Run(threads=1)) as executor:
        write_contents(PtexContents("triangle", faces, texels), path, executor)
    painted = surface.with_sources(octex.Ptex(path).sources)

    def at(u, v):
        where = np.zeros(1, np.int32), np.array([[1 - u - v, u, v]]), np.zeros(1, np.float32)
        return float(painted.evaluate_all(*where)[0, 0])

    # Of a face: 0 at corner 0, 1 at corner 1, 2 at corner 2, 3 the one on its tip in the middle.
    assert at(0.5, 0.5) == pytest.approx((1 + 2 + 3 + 5 + 6 + 7) / 6 / 8)
    assert at(1.0, 0.0) == pytest.approx((1 + 6) / 2 / 8)
    assert at(0.5, 0.0) == pytest.approx((0 + 1 + 3) / 3 / 8)
    assert at(0.0, 0.0) == 0


def test_faces_get_texels_as_wide_as_the_cells_and_more_along_their_longer_side(house, tmp_path):
    surface = octex.load_surface(house)
    texture = octex.convert(surface, 5, sources={"base_color": waves})
    octex.write_ptex(texture, surface, tmp_path / "made.ptx")
    cell = texture.placement.size / 32
    with PtexFile(tmp_path / "made.ptx") as file:
        edges = np.array([1.0, 2.0]) / np.exp2(file.faces.log2[0])  # of the first wall
        assert (edges <= cell * 2**0.5 + 1e-9).all()
        assert (edges >= cell / 2**0.5 - 1e-9).all()


def test_on_the_limit_surface_faces_that_spread_out_get_more_texels(tmp_path):
    # A box with a narrow band around its middle, which spreads out on the limit surface; creased nowhere.
    levels = (-1.0, -0.02, 0.02, 1.0)
    lines = [f"v {x} {y} {z}" for y in levels for x, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    lines += [
        f"f {a + 4 * k} {a + 4 * k + 4} {b + 4 * k + 4} {b + 4 * k}"
        for k in range(3)
        for a, b in ((1, 2), (2, 3), (3, 4), (4, 1))
    ]
    (tmp_path / "box.obj").write_text("\n".join([*lines, "f 1 2 3 4", "f 13 16 15 14"]))
    surface = octex.load_surface(tmp_path / "box.obj")
    texture = octex.convert(surface, 6)
    sides = []
    for limit in (False, True):
        octex.write_ptex(texture, surface, tmp_path / "box.ptx", limit=limit)
        with PtexFile(tmp_path / "box.ptx") as file:
            sides.append(file.faces.log2[4:8].tolist())
    # u runs up the band, v along it.
    assert all(after[0] > before[0] for before, after in zip(*sides, strict=True))
    assert all(after[1] <= before[1] for before, after in zip(*sides, strict=True))


def test_a_mesh_that_does_not_fit_is_refused(house, tmp_path):
    surface = octex.load_surface(house)
    texture = octex.convert(surface, 3)
    octex.write_ptex(texture, surface, tmp_path / "made.ptx")
    ptex = octex.Ptex(tmp_path / "made.ptx")
    lines = HOUSE.splitlines(keepends=True)
    (tmp_path / "fewer.obj").write_text("".join(lines[:-1]))
    with pytest.raises(ModelError, match=r"fewer.obj has 9 faces, and made.ptx has 14"):
        octex.load_surface(tmp_path / "fewer.obj", sources=ptex.sources)
    (tmp_path / "turned.obj").write_text("".join(lines[:10] + lines[:9:-1]))
    with pytest.raises(ModelError, match="in another order"):
        octex.load_surface(tmp_path / "turned.obj", sources=ptex.sources)
    one = octex.Surface.from_arrays(surface.vertices, surface.triangles)
    octex.write_ptex(texture, one, tmp_path / "triangles.ptx")
    with pytest.raises(ModelError, match="for a mesh of triangles"):
        octex.load_surface(house, sources=octex.Ptex(tmp_path / "triangles.ptx").sources)


def test_what_cannot_be_written_is_refused(house, tmp_path):
    surface = octex.load_surface(house)
    texture = octex.convert(surface, 3)
    for change, said in (
        ({"channels": ["roughness"]}, "roughness"),
        ({"channels": []}, "name at least one"),
        ({"dtype": "int8"}, "dtype"),
        ({"texels": 3}, "at least 14"),
        ({"path": tmp_path / "made.png"}, r"\.ptx"),
    ):
        with pytest.raises(ArgumentError, match=said):
            octex.write_ptex(texture, surface, **{"path": tmp_path / "made.ptx", **change})


def test_the_command_goes_both_ways(house, tmp_path, cli):
    texture = octex.convert(octex.load_surface(house), 4, sources={"base_color": waves})
    texture.save(tmp_path / "house.octex")
    made, back = tmp_path / "house.ptx", tmp_path / "back.octex"
    assert "texels on 14 faces" in cli.result("bake", tmp_path / "house.octex", house, made)
    cli.result(house, back, "--transfer", made, "--depth", "4")
    points = octex.load_surface(house).scatter(2000)
    assert abs(octex.open(back).sample(points) - texture.sample(points)).max() < 0.1
    one = tmp_path / "one.octex"
    cli.result(house, one, "--source", f"base_color={made}", "--depth", "4")
    np.testing.assert_array_equal(octex.open(one).sample(points), octex.open(back).sample(points))
    assert f"convert its mesh with --transfer {made}" in cli.refusal(made, tmp_path / "other.octex")


def test_real_files_fit_their_meshes_and_have_the_neighbours_of_these(models):
    folder = models / "ptex-disney"
    for mesh, ptex in (
        ("cube/cube.obj", "cube/text/cube.ptx"),
        ("flatsphere/ptex_test_object_orig.obj", "flatsphere/cellnoise.ptx"),
    ):
        with PtexFile(folder / ptex) as file, pytest.warns() if "orig" in mesh else nothing():
            surface = octex.load_surface(folder / mesh)
            patches = patches_of(surface, file.mesh_type)
            neighbors, edges = neighbors_of(surface, patches)
            assert np.array_equal(neighbors, file.faces.neighbors)
            assert np.array_equal(edges, file.faces.edges)


def test_malformed_files_are_refused(models):
    files = sorted((models / "ptex-oiio" / "src").glob("*.ptx"))
    refused = 0
    for path in files:
        if path.name == "triangle.ptx":
            with PtexFile(path) as file:
                assert (file.mesh_type, file.n_faces, file.dtype) == ("triangle", 9, np.float32)
                assert np.isfinite(file.texels(8)).all()
            continue
        with pytest.raises(ModelError, match=path.name):
            PtexFile(path)
        refused += 1
    assert refused == 6
