"""Coloured points: on a surface, and by themselves."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import octex
from octex.channels import encode
from octex.errors import ArgumentError, ModelError
from octex.source.cloud import is_cloud
from octex.tree.morton import encode_cells
from octex.tree.placement import Placement
from tests.make.fixtures import ply
from tests.make.painted import ball, plain, square
from tests.make.refusal import refused

_BARE = b"""ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 1 2
"""

_LISTED = b"""ply
format ascii 1.0
element vertex 3
property %s x
property float y
property float z
property %s red
property uchar green
property uchar blue
end_header
1 1 1 1 1 1 1
1 1 1 1 1 1 1
1 1 1 1 1 1 1
"""


def colored(points):
    return np.asarray((points + 1.2) / 2.5, np.float32)


def scanned(count=4000, **options):
    """Points of the unit ball that say where they are."""
    samples = ball(40).scatter(count)
    points = samples.rest / np.linalg.norm(samples.rest, axis=1)[:, None]
    return octex.PointCloud(points, colored(points), points * 3.0, **options)


def test_on_a_mesh_each_place_takes_the_points_around_it():
    surface = ball(30)
    for options in ({}, {"radius": 0.1}, {"distance": 1.0}):
        made = surface.with_sources(scanned(**options).sources)
        samples = made.scatter(400)
        assert np.abs(made.evaluate(samples) - colored(samples.rest)).max() < 0.06


def test_wide_places_average_all_the_points_in_them():
    random = np.random.default_rng(0)
    points = np.column_stack([random.random((5000, 2)) - 0.5, np.zeros(5000)])
    cloud = octex.PointCloud(points, random.integers(0, 2, 5000)[:, None].repeat(3, 1).astype(np.float32))
    surface = plain(square()).with_sources(cloud.sources)
    samples = surface.scatter(100)
    assert set(np.unique(surface.evaluate(samples))) == {0.0, 1.0}
    inner = np.abs(samples.rest[:, :2]).max(axis=1) < 0.3
    assert np.abs(surface.evaluate(samples, width=0.3)[inner] - 0.5).max() < 0.1


def test_beyond_a_radius_or_a_distance_the_surface_stays_empty():
    surface = plain(square())
    points = np.array([[-0.4, -0.4, 0.0], [-0.4, -0.3, 0.0], [-0.3, -0.4, 0.0]])
    for options in ({"radius": 0.2}, {"distance": 0.2}):
        cloud = octex.PointCloud(points, np.full((3, 3), 128, np.uint8), **options)
        texture = octex.convert(surface, 5, sources=cloud.sources)
        samples = surface.scatter(1000)
        apart = np.linalg.norm(samples.rest[:, None] - points, axis=2).min(axis=1)
        assert texture.contains(samples.rest[apart < 0.15]).all()
        assert not texture.contains(samples.rest[apart > 0.3]).any()


def test_points_that_face_another_way_do_not_count_but_those_without_a_normal_do():
    surface = plain(square())
    points = np.repeat(surface.vertices, 2, axis=0) + np.tile([[0, 0, 0.0], [0, 0, 0.01]], (25, 1))
    normals = np.tile([[0.0, 0, -1], [0, 0, 1]], (25, 1))
    colors = np.tile([[1.0, 0, 0], [0, 1, 0]], (25, 1))
    made = surface.with_sources(octex.PointCloud(points, colors, normals).sources)
    assert np.allclose(made.evaluate(made.scatter(50)), [0, 1, 0])
    blind = surface.with_sources(octex.PointCloud(points, colors, normals, max_angle=180.0).sources)
    assert not np.allclose(blind.evaluate(made.scatter(50)), [0, 1, 0])
    none = surface.with_sources(octex.PointCloud(points, colors, 0 * normals, max_angle=30.0).sources)
    np.testing.assert_array_equal(none.evaluate(made.scatter(50)), blind.evaluate(made.scatter(50)))


def test_translucent_points_weigh_by_alpha():
    surface = plain(square())
    points = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    colors = np.array([[1.0, 0, 0, 1.0], [0, 1.0, 0, 0.0], [0, 0, 1.0, 0.0]])
    made = surface.with_sources(octex.PointCloud(points, colors, radius=10.0).sources)
    samples = made.scatter(20)
    assert np.allclose(made.evaluate(samples), [1, 0, 0], atol=1e-5)
    assert np.allclose(made.evaluate(samples, "alpha"), 1 / 3, atol=0.01)


def test_alone_the_cells_are_those_of_the_points_and_hold_their_means():
    cloud = scanned(500)
    texture = octex.convert(cloud, 3)
    texture.validate()
    cells = np.floor(texture.placement.to_texture_space(cloud.points) * 8).astype(int)
    codes = encode_cells(cells)
    assert np.array_equal(np.unique(codes), texture.tree.level_codes(3))
    for cell in np.unique(codes)[::7]:
        mean = cloud.colors[codes == cell, :3].astype(float).mean(axis=0)
        stored = texture.channels["base_color"].values[-texture.tree.n_leaves :]
        row = np.searchsorted(np.unique(codes), cell)
        assert np.abs(encode(mean, "uint8", "srgb").astype(int) - stored[row].astype(int)).max() <= 1


def test_alone_points_tell_the_sides_of_a_thin_sheet_apart_by_their_normals():
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)), -1).reshape(-1, 2)
    points = np.concatenate([np.column_stack([grid, np.full(1600, z)]) for z in (0.0, 0.001)])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], 1600, axis=0)
    colors = np.repeat([[1.0, 0, 0], [0, 1, 0]], 1600, axis=0)
    texture = octex.convert(octex.PointCloud(points, colors, normals), 5)
    texture.validate()
    assert texture.tree.split.cells.size
    for row in (0, -1):
        seen = texture.sample(points[800:810], normals=np.tile(normals[row], (10, 1)))
        assert np.allclose(seen, colors[row], atol=0.02)


def test_without_normals_cells_face_no_way_and_are_seen_from_everywhere():
    cloud = scanned(3000)
    texture = octex.convert(octex.PointCloud(cloud.points, cloud.colors))
    texture.validate()
    points = cloud.points[:100]
    assert texture.contains(points).all()
    plain_looks = texture.sample(points)
    assert np.abs(plain_looks - colored(points)).max() < 0.1
    assert np.allclose(texture.sample(points, normals=points), plain_looks, atol=1e-6)
    assert texture.tree.max_depth == 4  # cells of about twice 0.05


def test_alone_types_cells_and_channels_are_as_asked_for():
    cloud = scanned(100)
    made = octex.convert(cloud, cell=0.1, dtype="float32")
    assert made.channels["base_color"].format.dtype == "float32"
    assert made.placement.size / 2**made.tree.max_depth == pytest.approx(0.1)
    translucent = octex.PointCloud(cloud.points, np.full((100, 4), 0.5))
    assert list(octex.convert(translucent, 3).channels) == ["base_color", "alpha"]
    assert list(octex.convert(translucent, 3, channels="alpha").channels) == ["alpha"]
    with pytest.raises(ArgumentError, match="channel"):
        octex.convert(cloud, 3, channels=["roughness"])
    refused = {"rest": "a.ply", "sources": {}, "max_error": 2, "detail": "stretch", "separate": True}
    refused |= {"filter": "ewa", "fit": False}
    for name, given in refused.items():
        with pytest.raises(ArgumentError, match=f"{name} needs a surface"):
            octex.convert(cloud, 3, **{name: given})
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(ArgumentError, match=r"executor needs a surface, .* leave it out"):
            octex.convert(cloud, 3, run=octex.Run(executor=pool))
        with pytest.raises(ArgumentError, match="executor needs a surface"):
            octex.convert_set({"a": cloud}, 3, run=octex.Run(executor=pool))
        parts = {"a": cloud, "b": plain(square())}
        assert len(octex.convert_set(parts, 3, run=octex.Run(executor=pool), fit=False, filter="ewa")) == 2
    octex.convert(cloud, 3, filter=None, fit=True, run=None, separate=False)


def test_points_in_one_place_make_one_cell():
    texture = octex.convert(octex.PointCloud(np.ones((3, 3)), np.ones((3, 3))))
    assert texture.tree.n_leaves == 1


def test_files_of_every_kind_hold_the_same_points(tmp_path):
    random = np.random.default_rng(0)
    points, normals = random.random((20, 3)), random.normal(size=(20, 3))
    codes = random.integers(0, 256, (20, 3), np.uint8)
    np.savez(tmp_path / "a.npz", points=points, colors=codes, normals=normals)
    np.savez(tmp_path / "b.npz", xyz=points, rgb=codes)
    rows = np.hstack([points, normals, codes])
    (tmp_path / "a.xyz").write_text(
        "# x y z …\n" + "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    )
    (tmp_path / "b.xyz").write_text(
        "\n".join(",".join(map(repr, row)) for row in np.hstack([points, codes / 255.0]).tolist())
    )
    vertex = {name: ("double", points[:, i]) for i, name in enumerate("xyz")}
    vertex |= {f"n{name}": ("double", normals[:, i]) for i, name in enumerate("xyz")}
    vertex |= {name: ("uchar", codes[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    ply(tmp_path / "a.ply", {"vertex": vertex})
    for name in ("a.npz", "b.npz", "a.xyz", "b.xyz", "a.ply"):
        assert is_cloud(tmp_path / name)
        cloud = octex.PointCloud.load(tmp_path / name)
        assert len(cloud) == 20 and name in repr(cloud)
        np.testing.assert_allclose(cloud.points, points, atol=1e-12)
        np.testing.assert_allclose(
            cloud.colors[:, :3], octex.PointCloud(points, codes).colors[:, :3], atol=1e-6
        )
        assert (cloud.normals is None) == name.startswith("b")
    assert octex.convert(tmp_path / "a.xyz", 2).tree.n_leaves


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.xyz", b"1 2 3\n4 5 6\n", "no colours"),
        ("a.xyz", b"1 2 3 4 5 6\n1 2\n", "not all 6 numbers"),
        ("a.xyz", b"1 2 3 4 5 red\n", "not all 6 numbers"),
        ("a.xyz", b"", "a.xyz has no points"),
        ("a.xyz", b"1 2 3 4 5 6\n1 2 3 4 5 6\n", "a cloud needs at least three"),
        ("a.npz", b"PK\x03\x04 nonsense", "damaged|not an .npz"),
        ("a.npz", b"nonsense", "is not an .npz file of arrays"),
        ("a.obj", b"", "not a point cloud that octex reads"),
        ("a.ply", _BARE, "without colours"),
        ("a.ply", _BARE.replace(b"vertex 1", b"vertex 0").replace(b"0 1 2\n", b""), "has no points; export"),
        ("a.ply", _LISTED % (b"list int float x", b"uchar red"), "no vertices with x, y and z"),
        ("a.ply", _LISTED % (b"float x", b"list int uchar red"), "without colours"),
    ],
)
def test_what_is_no_cloud_is_refused_in_a_line(name, content, complaint, tmp_path):
    (tmp_path / name).write_bytes(content)
    with refused(ModelError, complaint, name):
        octex.PointCloud.load(tmp_path / name)


def test_arrays_that_are_not_there_are_named(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.zeros((3, 3)))
    with pytest.raises(ModelError, match="no array 'colors'"):
        octex.PointCloud.load(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", points=np.zeros((3, 3)), colors=np.zeros((2, 3)))
    with pytest.raises(ModelError, match=r"b\.npz: colors must have shape"):
        octex.PointCloud.load(tmp_path / "b.npz")
    with pytest.raises(ModelError, match="cannot be read"):
        octex.PointCloud.load(tmp_path / "none.npz")
    assert not is_cloud(tmp_path / "none.ply")


@pytest.mark.parametrize("element", [b"element face 1", b" element  tristrips  1"])
def test_files_with_faces_or_strips_are_no_clouds(element, tmp_path):
    strip = element + b"\nproperty list int int vertex_indices\ncomment end_header follows\nend_header"
    content = _BARE.replace(b"vertex 1", b"vertex 3").replace(b"end_header", strip)
    (tmp_path / "a.ply").write_bytes(content + b"3 1 2\n3 1 3\n3 0 1 2\n")
    assert octex.convert(tmp_path / "a.ply", depth=2).tree.n_leaves


@pytest.mark.parametrize(
    ("arguments", "options", "complaint"),
    [
        ((np.zeros((3, 2)), np.zeros((3, 3))), {}, "points must be numbers of shape"),
        (("red", np.zeros((3, 3))), {}, "must be numbers"),
        ((np.full((3, 3), np.nan), np.zeros((3, 3))), {}, "number 0 is not"),
        ((np.zeros((3, 3)), np.full((3, 3), np.inf)), {}, "colour 0 is not finite"),
        ((np.zeros((3, 3)), np.full((3, 3), 255.0)), {}, "colour 0 is not from 0 to 1"),
        ((np.zeros((3, 3)), np.full((3, 3), -0.1)), {}, "colour 0 is not from 0 to 1"),
        ((np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((2, 3))), {}, "2 normals for 3"),
        ((np.zeros((3, 3)), np.zeros((3, 3))), {"radius": 1.0, "distance": 1.0}, "not both"),
        ((np.zeros((3, 3)), np.zeros((3, 3))), {"radius": -1.0}, "radius"),
    ],
)
def test_arrays_and_numbers_that_do_not_fit_are_refused(arguments, options, complaint):
    with pytest.raises((ArgumentError, ModelError), match=complaint):
        octex.PointCloud(*arguments, **options)


def test_points_for_another_channel_and_radii_that_hold_far_too_many_are_refused():
    with pytest.raises(ArgumentError, match="not roughness"):
        ball().with_sources({"roughness": scanned(10)})
    points = np.random.default_rng(0).random((40_000, 3)) * [1, 1, 0]
    cloud = octex.PointCloud(points, points, radius=10.0)
    with pytest.raises(ArgumentError, match="holds about 40,000 points"):
        plain(square()).with_sources(cloud.sources)


def test_cells_of_the_deepest_level_half_a_root_apart_stay_apart():
    half = Placement.around([[0.0] * 3, [1.0] * 3], 21).size / 2
    points = [[0.0, 0.0, 0.0], [0.3, 0.3, 0.3], [0.3, 0.3 + half, 0.3], [1.0, 1.0, 1.0]]
    colors = np.linspace(0.1, 0.9, 12).reshape(4, 3)
    texture = octex.convert(octex.PointCloud(points, colors, np.tile([0.0, 0.0, 1.0], (4, 1))), depth=21)
    texture.validate()
    assert texture.tree.n_leaves == 4
    np.testing.assert_allclose(texture.sample(points, filter="nearest"), colors, atol=0.01)


def test_points_are_in_the_cells_that_lookups_find_also_next_to_their_borders():
    corners = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    placement = Placement.around(corners, 6)
    places = np.array([[20, 30, 24], [30, 20, 33], [24, 33, 40]]) / 64
    points = np.concatenate(
        [corners, placement.to_rest(places - 2.0**-33), placement.to_rest(places + 2.0**-33)]
    )
    colors = np.linspace(0.1, 0.9, 24).reshape(8, 3)
    colors[5:] = colors[2:5]
    texture = octex.convert(octex.PointCloud(points, colors), 6)
    assert texture.tree.n_leaves == 5
    assert texture.contains(points).all()
    np.testing.assert_allclose(texture.sample(points, filter="nearest"), colors, atol=0.01)
