"""O-Voxel's dual grids and TRELLIS.2's arrays as surfaces, against shapes whose surface is known."""

from collections import Counter

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError, ModelError
from tests.make.refusal import refused
from tests.make.vxz import dual_grid, vxz

SIDE = 16
RADIUS = 0.36


def ball(points):
    return np.linalg.norm(points - 0.5, axis=1) - RADIUS


COORDS, DUAL, CROSSED = dual_grid(ball, SIDE)
CENTRES = (COORDS + 0.5) / SIDE - 0.5
COLORS = np.rint(255 * (0.5 + CENTRES)).astype(np.uint8)
ROUGHNESS = np.rint(255 * (0.5 + CENTRES[:, 2:])).astype(np.uint8)
BITS = CROSSED @ [[1], [2], [4]]
PACKED = {"dual_vertices": (DUAL * 255).astype(np.uint8), "intersected": BITS.astype(np.uint8)}
FLAT = {"coords": COORDS, "base_color": COLORS, "dual_vertices": DUAL, "intersected": CROSSED}


def test_a_vxz_is_a_closed_surface_with_its_values(tmp_path):
    path = tmp_path / "ball.vxz"
    path.write_bytes(vxz(COORDS, {"base_color": COLORS, "roughness": ROUGHNESS, **PACKED}, filtered="parent"))
    surface = octex.load_surface(path)
    rows = surface.triangles
    both = Counter(zip(rows.ravel().tolist(), np.roll(rows, -1, axis=1).ravel().tolist(), strict=True))
    assert set(both.values()) == {1}
    assert all((b, a) in both for a, b in both)  # closed, and all of it winds one way
    corners = surface.vertices[surface.triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    np.testing.assert_allclose(volume, 4 / 3 * np.pi * RADIUS**3, rtol=0.05)  # and encloses what it should
    samples = surface.scatter(2000)
    assert np.abs(np.linalg.norm(samples.points, axis=1) - RADIUS).max() < 0.5 / SIDE
    expected = np.clip(0.5 + samples.points, 0, 1)
    found = surface.evaluate(samples, "roughness")[:, 0]
    np.testing.assert_allclose(found, expected[:, 2], atol=1 / SIDE)
    assert {form.name for form in surface.channels} == {"base_color", "roughness"}
    assert [form.name for form in octex.load_surface(path, channels=["roughness"]).channels] == ["roughness"]
    with pytest.raises(ModelError, match=r"ball.vxz has no channel metallic; it has base_color, roughness"):
        octex.load_surface(path, channels=["metallic"])


def test_each_crossed_edge_is_a_quad_cut_from_its_first_corner(tmp_path):
    rows = {tuple(each): row for row, each in enumerate(COORDS.tolist())}
    expected = set()
    for (x, y, z), flags in zip(COORDS.tolist(), CROSSED, strict=True):
        around = (
            [(x, y, z), (x, y, z + 1), (x, y + 1, z + 1), (x, y + 1, z)],
            [(x, y, z), (x + 1, y, z), (x + 1, y, z + 1), (x, y, z + 1)],
            [(x, y, z), (x, y + 1, z), (x + 1, y + 1, z), (x + 1, y, z)],
        )
        for axis in np.flatnonzero(flags):
            a, b, c, d = (rows[place] for place in around[axis])
            expected |= {tuple(sorted((a, b, c))), tuple(sorted((a, c, d)))}
    np.savez(tmp_path / "a.npz", **FLAT)
    surface = octex.load_surface(tmp_path / "a.npz")
    assert {tuple(sorted(each)) for each in surface.triangles.tolist()} == expected
    np.testing.assert_allclose(surface.vertices, (COORDS + DUAL) / SIDE - 0.5, atol=1e-12)


@pytest.mark.parametrize("diagonal", [(0, 2), (1, 3)])
def test_weights_say_where_a_quad_is_cut(tmp_path, diagonal):
    weights = np.full((4, 1), 0.5)
    weights[list(diagonal)] = 1.0
    quad = {
        "coords": np.array([[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]]),
        "base_color": COLORS[:4],
        "dual_vertices": np.full((4, 3), 0.5),
        "intersected": np.array([[1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]),
    }
    np.savez(tmp_path / "a.npz", **quad, split_weight=weights)
    two = octex.load_surface(tmp_path / "a.npz").triangles
    assert set(two[0]) & set(two[1]) == set(diagonal)


@pytest.mark.parametrize(("side", "scale"), [(16, 1.0), (24, 32 / 24), (12, 16 / 12)])
def test_the_grid_is_as_wide_as_its_coords_say(tmp_path, side, scale):
    coords = np.array([[0, 0, 0], [side - 1, 1, 2]])
    (tmp_path / "a.vxz").write_bytes(vxz(coords, {"roughness": np.full((2, 1), 9, np.uint8)}))
    voxels = octex.Voxels.load(tmp_path / "a.vxz")
    assert voxels.size == pytest.approx(scale)
    assert voxels.origin == (-0.5,) * 3
    assert voxels.size / 2.0 ** int(voxels.depths[0]) == pytest.approx(1 / side)


def test_the_surface_lies_in_its_voxels(tmp_path):
    path = tmp_path / "ball.vxz"
    path.write_bytes(vxz(COORDS, {"base_color": COLORS, "roughness": ROUGHNESS, **PACKED}))
    texture, surface = octex.convert(path), octex.load_surface(path)
    samples = surface.scatter(5000)
    assert texture.contains(samples.rest).all()  # every point lies in one of the voxels around its edge
    np.testing.assert_allclose(
        texture.sample(samples.rest, "roughness"), 0.5 + samples.rest[:, 2:], atol=1 / SIDE
    )


def test_trellis_arrays_with_a_mesh_beside(tmp_path):
    np.savez(tmp_path / "grid.npz", **FLAT)
    mesh = octex.load_surface(tmp_path / "grid.npz")
    ones = np.ones((len(COORDS), 1))
    attributes = np.concatenate([COLORS / 255, 0 * ones, ROUGHNESS / 255, ones], axis=1, dtype=np.float32)
    attributes[0] += 0.004  # a decoder's values may lie a little outside
    given = {"coords": COORDS.astype(np.int32), "attrs": attributes}
    given |= {"origin": np.full(3, -0.5), "voxel_size": np.array(1 / SIDE)}
    np.savez(tmp_path / "asset.npz", **given, vertices=mesh.vertices.astype(np.float32), faces=mesh.triangles)
    texture = octex.convert(tmp_path / "asset.npz")
    assert set(texture.channels) == {"base_color", "metallic", "roughness", "alpha"}
    assert texture.placement == ((-0.5,) * 3, 1.0)
    plain = octex.convert(octex.Voxels(COORDS, {"base_color": COLORS}, origin=(-0.5,) * 3, size=1.0))
    shades = [each.sample(CENTRES[1:], "base_color", "nearest") for each in (texture, plain)]
    np.testing.assert_allclose(*shades, atol=1e-3)  # floats are sRGB there
    surface = octex.load_surface(tmp_path / "asset.npz")
    np.testing.assert_array_equal(surface.triangles, mesh.triangles)
    samples = surface.scatter(1000)
    np.testing.assert_allclose(
        surface.evaluate(samples, "roughness"), 0.5 + samples.rest[:, 2:], atol=1.5 / SIDE
    )
    np.savez(tmp_path / "apart.npz", **given, vertices=mesh.vertices + 3.0, faces=mesh.triangles)
    with pytest.raises(ModelError, match=r"apart.npz: mesh and voxels do not lie on each other: 0 % of the"):
        octex.load_surface(tmp_path / "apart.npz")
    with pytest.raises(ArgumentError, match="has no point in the texture"):
        octex.bake(texture, octex.Surface.from_arrays(mesh.vertices + 3.0, mesh.triangles))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dual_vertices": None}, "has no mesh: octex needs the arrays dual_vertices and intersected"),
        ({"dual_vertices": DUAL[:5]}, r"dual_vertices must be bytes or floats of shape \(\d+, 3\)"),
        ({"dual_vertices": DUAL + 2}, "dual_vertices must lie within their voxels"),
        ({"dual_vertices": DUAL * np.nan}, "dual_vertices must lie within their voxels"),
        ({"intersected": CROSSED[:, :2]}, "intersected must be whole numbers of shape"),
        ({"intersected": CROSSED * 0.5}, "intersected must be whole numbers of shape"),
        ({"intersected": CROSSED & False}, "has no surface: no edge that is crossed"),
        ({"split_weight": np.ones(3)}, "split_weight must be numbers of shape"),
        ({"coords": COORDS[np.r_[0, 0, 2 : len(COORDS)]]}, "voxels overlap"),
        ({"coords": COORDS * 10**9}, "coords from .* do not fit a grid"),
        ({"attrs": np.ones((len(COORDS), 5))}, r"attrs must have shape \(\d+, 6\): base_color, metallic"),
        ({"attrs": np.full((len(COORDS), 6), np.nan)}, "attrs are not all finite"),
        ({"attrs": np.ones((len(COORDS), 6), object)}, "not an .npz file of arrays .*type object"),
        ({"coords": None}, "has no array 'coords'"),
        ({"faces": [[0, 1, 9]], "vertices": DUAL[:3]}, "a triangle uses vertex 9, but there are 3"),
        ({"faces": [[0, 1, 2]], "vertices": DUAL[:3] * np.inf}, "vertices are not all finite"),
    ],
)
def test_arrays_that_make_no_surface_are_refused(tmp_path, changes, message):
    arrays = {name: each for name, each in {**FLAT, **changes}.items() if each is not None}
    np.savez(tmp_path / "bad.npz", **arrays, allow_pickle=True)
    with refused(ModelError, message, "bad.npz"):
        octex.load_surface(tmp_path / "bad.npz")
