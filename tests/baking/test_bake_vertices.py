"""Colours baked to vertices, and triangles divided for them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import octex
from octex.channels import encode
from octex.errors import ArgumentError
from octex.source.surface import Surface
from octex.source.tangents import corner_frames
from tests.baking.test_bake import cube_with_charts, painted_sphere, psnr, turned_ball
from tests.conftest import needs_jit
from tests.make.painted import waves
from tests.make.small_surfaces import whole

DROID = Path(__file__).parents[2] / "samples" / "droid.glb"


def test_vertex_colours_follow_the_field_and_neighbours_divide_alike():
    texture, surface = painted_sphere()
    coarse = octex.bake_vertices(texture, surface)
    assert len(coarse.triangles) == len(surface.triangles)
    fine = octex.bake_vertices(texture, surface, subdivide="auto", max_error=2.0)
    near = texture.sample(fine.vertices, "base_color", normals=fine.vertices)
    np.testing.assert_allclose(fine.source.colors.values[:, :3], near, atol=0.02)
    for seed, made, least in ((3, coarse, 20.0), (4, fine, 43.0)):
        some = made.scatter(20_000, seed=seed)
        assert psnr(made.evaluate(some), texture.sample(some, "base_color")) > least
    # Each edge has two triangles, as before, and the sphere is where it was.
    ends = np.stack([fine.triangles, np.roll(fine.triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()
    assert fine.areas().sum() == pytest.approx(surface.areas().sum(), rel=1e-9)


@pytest.mark.parametrize("subdivide", ["auto", 0.07])
def test_where_vertices_are_apart_at_one_place_edges_are_divided_alike(subdivide):
    surface = cube_with_charts()  # no two of its triangles share a vertex
    flat = corner_frames(surface.rest, surface.triangles, None, None, None)
    surface = Surface(surface.vertices, surface.triangles, surface.source, frames=flat)
    texture = octex.convert(surface.with_sources({"base_color": waves}), 5)
    made = octex.bake_vertices(texture, surface, subdivide=subdivide, max_error=2.0)
    _, places = np.unique(made.vertices, axis=0, return_inverse=True)
    triangles = places[made.triangles]
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert len(triangles) > 100
    assert (counts == 2).all()
    # And the cube's edges stay sharp.
    sides = made.vertices[made.triangles]
    crosses = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    crosses /= np.linalg.norm(crosses, axis=1, keepdims=True)
    found = made.frames.normals.values[made.frames.normals.rows]
    np.testing.assert_allclose(found, np.broadcast_to(crosses[:, None], found.shape), atol=1e-6)


@needs_jit
def test_no_triangle_gets_ever_thinner_where_edges_are_halved_by_their_colours():
    surface = octex.load_surface(DROID)
    made = octex.bake_vertices(octex.convert(surface, 8), surface, subdivide="auto", max_error=40.0)
    _, places = np.unique(made.vertices.astype(np.float32), axis=0, return_inverse=True)
    triangles = places.reshape(-1)[made.triangles]
    assert (triangles != np.roll(triangles, 1, axis=1)).all()
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, counts = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()
    assert len(made.triangles) < 150_000


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_divided_triangles_are_shaded_as_the_whole_was(ending, tmp_path):
    surface = turned_ball(8)
    made = octex.bake_vertices(octex.convert(surface, 3), surface, subdivide=0.2)
    assert len(made.triangles) > 4 * len(surface.triangles)
    octex.write_model(made, tmp_path / f"ball{ending}")
    if ending == ".ply":
        mesh = trimesh.load(tmp_path / "ball.ply", process=False)
        assert "vertex_normals" in mesh._cache  # those of the file
        found, places = mesh.vertex_normals[mesh.faces], mesh.vertices[mesh.faces]
    else:
        read = octex.load_surface(tmp_path / f"ball{ending}", normals=True)
        found, places = read.frames.normals.values[read.frames.normals.rows], read.vertices[read.triangles]
    # On a sphere what lies between the corners' normals points as positions do.
    expected = places / np.linalg.norm(places, axis=2, keepdims=True)
    assert np.einsum("tcx,tcx->tc", found, expected).min() > np.cos(np.radians(2.0))


def test_edges_are_halved_until_none_is_longer():
    surface = whole()
    texture = octex.convert(surface, 5)
    made = octex.bake_vertices(texture, surface, subdivide=0.1)
    sides = made.vertices[np.roll(made.triangles, -1, axis=1)] - made.vertices[made.triangles]
    assert np.linalg.norm(sides, axis=2).max() <= 0.1
    assert made.areas().sum() == pytest.approx(surface.areas().sum(), rel=1e-9)
    shorter = octex.bake_vertices(texture, surface, subdivide=0.008)  # a quarter of the finest cells
    sides = shorter.vertices[np.roll(shorter.triangles, -1, axis=1)] - shorter.vertices[shorter.triangles]
    assert np.linalg.norm(sides, axis=2).max() <= 0.008
    with pytest.raises(ArgumentError, match=r"0\.1 make more than 200 triangles; edges of up to"):
        octex.bake_vertices(texture, surface, subdivide=0.1, most_triangles=200)
    same = octex.bake_vertices(texture, surface, subdivide=9.0, most_triangles=1)  # nothing to halve
    assert len(same.triangles) == len(surface.triangles)
    for most in (20, 200):
        few = octex.bake_vertices(texture, surface, subdivide="auto", max_error=0.0, most_triangles=most)
        assert most / 6 < len(few.triangles) <= most


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_vertex_colours_are_written_and_read_back(ending, tmp_path):
    texture, surface = painted_sphere()
    made = octex.bake_vertices(texture, surface)
    octex.write_model(made, tmp_path / f"ball{ending}")
    read = octex.load_surface(tmp_path / f"ball{ending}")
    assert read.triangles.shape == made.triangles.shape
    points = made.scatter(2000)
    np.testing.assert_allclose(read.evaluate(points), made.evaluate(points), atol=0.01)
    if ending == ".ply":
        cloud = trimesh.load(tmp_path / "ball.ply", process=False)
        np.testing.assert_array_equal(cloud.faces, made.triangles)
        codes = encode(made.source.colors.values[:, :3], "uint8", "srgb")
        np.testing.assert_array_equal(cloud.visual.vertex_colors[:, :3], codes)
