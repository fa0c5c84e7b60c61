"""Parts of a surface that intersect or nearly touch, against exact booleans and slow references."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import octex
from octex.errors import ArgumentError
from octex.nearest.triangles import gap, mesh_of
from octex.source.parts import Overlap, Unchecked, parts_of
from octex.source.surface import Surface
from octex.source.welding import first_equal
from tests.conftest import needs_jit
from tests.make.solids import colored, cube, inside_out, open_cube, sphere, torn
from tests.oracles.naive_parts import components, distance, solid


def test_cubes_that_touch_share_nothing_and_are_too_near_for_any_margin_also_vertex_on_vertex():
    surface = colored(cube([0, 0, 0]), cube([1, 0.25, 0.25]))
    assert surface.overlapping_parts().pairs == ()
    assert surface.overlapping_parts(1e-9).pairs == (Overlap(0, 1, 0.0, 0.0),)
    surface = colored(cube([0, 0, 0]), cube([0, 0, 1]))
    found = surface.overlapping_parts(0.1)
    assert (found.n_parts, found.unchecked) == (2, ())
    assert found.pairs == (Overlap(0, 1, 0.0, 0.0),)


def test_seams_do_not_cut_a_part_and_minus_zero_is_where_zero_is():
    points, triangles = torn(cube([0, 0, 0]))
    points[::2] *= np.where(points[::2] == 0, -1.0, 1.0)
    found = colored((points, triangles), torn(sphere([3, 0, 0], 1.0, 12))).overlapping_parts()
    assert (found.n_parts, found.unchecked) == (2, ())


def test_a_solid_inside_another_is_apart_from_it_by_the_distance_of_their_surfaces():
    surface = colored(cube([0, 0, 0]), cube([0.2, 0.3, 0.4], 0.25))
    (near,) = surface.overlapping_parts(0.3).pairs
    assert near == Overlap(0, 1, pytest.approx(0.25**3), pytest.approx(0.2))
    (far,) = surface.overlapping_parts(0.1).pairs
    assert far.gap == math.inf


def test_inverted_solids_are_turned_round():
    surface = colored(inside_out(cube([0, 0, 0])), cube([0.5, 0, 0]), inside_out(cube([0.75, 0, 0])))
    volumes = {(a, b): volume for a, b, volume, _ in surface.overlapping_parts().pairs}
    assert volumes == {(0, 1): pytest.approx(0.5), (0, 2): pytest.approx(0.25), (1, 2): pytest.approx(0.75)}


def test_what_is_no_solid_is_named_and_its_surface_compared():
    flat = cube([0.5, 0.2, 0.2])
    flat[0][:, 2] = 0.2
    mixed = cube([9, 9, 9])
    mixed[1][0] = mixed[1][0, ::-1]
    surface = colored(cube([0, 0, 0]), open_cube([2, 0, 0]), flat, mixed, open_cube([1.01, 3, 3]))
    found = surface.overlapping_parts()
    assert found.unchecked == (
        Unchecked(1, 10, "open"),
        Unchecked(2, 12, "without volume"),
        Unchecked(3, 12, "not manifold"),
        Unchecked(4, 10, "open"),
    )
    assert found.pairs == (Overlap(0, 2, None, 0.0),)


def test_parts_are_numbered_by_their_first_triangles_and_say_which_is_whose():
    points, triangles = colored(cube([0, 0, 0]), cube([5, 0, 0])).vertices, cube([0, 0, 0])[1]
    mixed = np.stack([triangles + 8, triangles], axis=1).reshape(-1, 3)
    found = Surface.from_arrays(points, mixed).overlapping_parts()
    assert found.parts.dtype == np.int32
    assert found.parts.tolist() == [0, 1] * 12


def test_what_was_found_reads_as_lines():
    surface = colored(cube([0, 0, 0]), cube([0.5, 0, 0]), cube([0.2, 0.2, 0.2], 0.1), open_cube([1.6, 0, 0]))
    assert str(surface.overlapping_parts(0.15)).splitlines() == [
        "4 parts, 3 pairs that intersect or come near",
        "parts 0 and 1: their surfaces cross or touch; they share a volume of 0.5",
        "parts 0 and 2: their surfaces are more than 0.15 apart; they share a volume of 0.001",
        "parts 1 and 3: their surfaces are 0.1 apart",
        "part 3 of 10 triangles is open: only its surface was checked, not what lies inside",
    ]
    touching = colored(cube([0, 0, 0]), cube([1, 0, 0]), cube([0.2, 0.2, 0.2], 0.1))
    assert (
        str(touching.overlapping_parts(0.1)).splitlines()[1].endswith("cross or touch; they share no volume")
    )
    assert "their surfaces do not cross" in str(touching.overlapping_parts())


def test_parts_are_those_at_rest_of_vertices_in_use_and_a_negative_margin_is_refused():
    surface = colored(cube([0, 0, 0]), cube([0.5, 0, 0]))
    apart = surface.rest + np.repeat([[0.0, 0, 0], [9.0, 0, 0]], 8, axis=0)
    assert surface.with_rest(apart).overlapping_parts(1.0).pairs == ()
    with pytest.raises(ArgumentError, match="margin must be from 0"):
        colored(cube([0, 0, 0])).overlapping_parts(-1.0)
    points, triangles = cube([0, 0, 0])
    surface = Surface.from_arrays(np.vstack([points, [[np.pi, 0, 0]]]), triangles)
    assert surface.overlapping_parts(1.0).n_parts == 1


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_parts_are_what_hangs_together(seed, count):
    random = np.random.default_rng(seed)
    points = random.integers(0, 5, (count + 3, 3)).astype(np.float64)
    triangles = random.integers(0, len(points), (count, 3)).astype(np.int32)
    found = parts_of(triangles, first_equal(points))
    for number, own in enumerate(np.unique(found)):
        members = set(np.flatnonzero(found == own).tolist())
        assert any(members <= whole for whole in components(points, triangles))
        assert min(members) == min(np.flatnonzero(found >= number))
    # Coarser than what shares vertices.
    for whole in components(np.arange(len(points))[:, None] * np.ones(3), triangles):
        assert len(set(found[list(whole)].tolist())) == 1


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 3.0]))
def test_triangles_are_as_far_apart_as_points_on_them(seed, lift):
    random = np.random.default_rng(seed)
    a, b = random.random((2, 3, 3))
    if seed % 5 == 0:
        b[2] = b[1]  # a segment
    if seed % 7 == 0:
        a[:] = a[0]  # a point
    b[:, seed % 3] += lift
    found = gap(mesh_of(a[None]), mesh_of(b[None]), 10.0)
    bound, slack = distance(a, b, 12)
    assert bound - slack <= found <= bound + 1e-12
    assert gap(mesh_of(b[None]), mesh_of(a[None]), 10.0) == pytest.approx(found, abs=1e-12)


def test_triangles_that_pierce_each_other_are_not_apart():
    flat = np.array([[[-1.0, -1, 0], [2, -1, 0], [-1, 2, 0]]])
    spike = np.array([[[0.0, 0, -1], [0.1, 0, 1], [0, 0.1, 1]]])
    assert gap(mesh_of(flat), mesh_of(spike), 1.0) == 0.0
    assert gap(mesh_of(spike), mesh_of(flat), 0.0) == 0.0
    spike[..., 2] += 1.25
    assert gap(mesh_of(flat), mesh_of(spike), 0.2) == math.inf
    assert gap(mesh_of(flat), mesh_of(spike), 0.3) == pytest.approx(0.25)


@needs_jit
@given(st.integers(0, 2**32 - 1))
def test_gaps_are_manifolds(seed):
    random = np.random.default_rng(seed)
    meshes = [sphere(random.random(3) * 2, 0.2 + 0.3 * random.random(), 16) for _ in range(6)]
    surface = colored(*meshes)
    found = {(a, b): (volume, gap) for a, b, volume, gap in surface.overlapping_parts(0.5).pairs}
    solids = [solid(*mesh) for mesh in meshes]
    for a in range(6):
        for b in range(a + 1, 6):
            volume = (solids[a] ^ solids[b]).volume()
            apart = solids[a].min_gap(solids[b], 0.5)
            if volume > 1e-9:
                assert found[a, b][0] == pytest.approx(volume, rel=1e-9)
            elif apart < 0.5 - 1e-9:
                assert found[a, b] == (0.0, pytest.approx(apart, abs=1e-9))
            else:
                assert (a, b) not in found


@needs_jit
def test_a_city_of_parts_is_compared_box_by_box():
    where = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    surface = colored(*[cube(1.25 * place) for place in where])
    found = surface.overlapping_parts(0.3)
    assert found.n_parts == 20 * 20
    assert len(found.pairs) == 2 * 20 * 19
    assert surface.overlapping_parts(0.2).pairs == ()


@needs_jit
@pytest.mark.parametrize(
    ("file", "solids", "volumes"),
    [
        ("manifold-models/openscad-nonmanifold-crash.obj", 2, 1),
        ("manifold-models/Cray_left.obj", 2, 1),
        ("manifold-models/hull-body.obj", 3, 0),
        ("manifold-models/mengerSponge3.glb", 1, 0),
        ("manifold-models/self_intersectA.obj", 1, 0),
    ],
)
def test_real_solids_share_what_a_boolean_of_them_says(models, file, solids, volumes):
    surface = octex.load_surface(models / file)
    found = surface.overlapping_parts()
    assert (found.n_parts, found.unchecked) == (solids, ())
    assert sum(pair.volume > 0 for pair in found.pairs if pair.volume is not None) == volumes
    welded = first_equal(surface.rest)[surface.triangles]
    for a, b, volume, _ in found.pairs:
        first, second = (solid(surface.rest, welded[found.parts == part]) for part in (a, b))
        assert volume == pytest.approx((first ^ second).volume(), rel=1e-9)


@needs_jit
def test_suzannes_eyes_cross_her_head(models):
    found = octex.load_surface(models / "Suzanne" / "Suzanne.gltf").overlapping_parts()
    assert found.n_parts == 3
    assert [each.why for each in found.unchecked] == ["open"] * 3
    assert found.pairs == (Overlap(0, 2, None, 0.0), Overlap(1, 2, None, 0.0))
