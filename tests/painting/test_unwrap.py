"""Discs of surfaces, laid flat: against exact exponential maps, and painted on."""

import numpy as np
import pytest
from PIL import Image

import octex
from octex.channels import linear_to_srgb
from octex.errors import ArgumentError, ModelError
from octex.nearest.triangles import Triangles
from octex.view.zbuffer import z_buffer
from tests.make.command import OUT, VIEW
from tests.make.fixtures import obj_lines
from tests.make.solids import colored, cube, sphere
from tests.oracles.naive_geodesics import straight

CENTER = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])


def ball(segments=96):
    return colored(sphere((0, 0, 0), 1.0, segments))


def tube(around=96, along=49):
    """A cylinder of radius 1 around y, 4 long, without ends."""
    angle, y = np.meshgrid(np.arange(around) / around * 2 * np.pi, np.linspace(-2, 2, along), indexing="ij")
    vertices = np.stack([np.sin(angle), y, np.cos(angle)], axis=-1).reshape(-1, 3)
    i, j = (each.ravel() for each in np.meshgrid(np.arange(around), np.arange(along - 1), indexing="ij"))
    a, b = i * along + j, (i + 1) % around * along + j
    return octex.Surface.from_arrays(
        vertices, np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    )


def on_ball(points, center):
    """Return the sphere's exact map around a point, with y up in the image."""
    right = np.cross((0, 1, 0), center)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(center, right)])
    units = points / np.linalg.norm(points, axis=1, keepdims=True)
    flat = units @ axes.T
    lengths = np.linalg.norm(flat, axis=1, keepdims=True)
    return flat / np.where(lengths > 0, lengths, 1) * np.arccos(np.clip(units @ center, -1, 1))[:, None]


def on_tube(points, center):
    """Return the cylinder's exact map around a point."""
    turn = np.arctan2(points[:, 0], points[:, 2]) - np.arctan2(center[0], center[2])
    return np.stack([(turn + np.pi) % (2 * np.pi) - np.pi, points[:, 1] - center[1]], axis=1)


@pytest.mark.parametrize("radius", [0.4, 1.2])
def test_on_a_coarse_sphere_the_disc_misses_the_spheres_map_by_what_straight_lines_on_its_triangles_do(
    radius,
):
    patch = octex.unwrap(ball(48), CENTER, radius)
    vertices, names = np.unique(ball(48).vertices.round(9), axis=0, return_inverse=True)
    triangles = names.ravel()[ball(48).triangles]
    triangles = triangles[[len(set(each)) == 3 for each in triangles.tolist()]]
    start = int(Triangles.of(vertices, triangles).nearest(patch.center[None]).triangles[0])
    a, b, c = vertices[triangles[start]]
    normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    middle, missed, own = patch.center / np.linalg.norm(patch.center), 0.0, 0.0
    right = np.cross((0, 1, 0), middle)
    right -= normal * (normal @ right)  # the direction of the sphere's map, in the triangle's plane
    right /= np.linalg.norm(right)
    lengths = np.linspace(0.05, 1, 20) * radius
    mesh = Triangles.of(patch.surface.rest, patch.surface.triangles)
    for turn in np.linspace(0.01, 2 * np.pi, 36):
        along = np.cos(turn) * right + np.sin(turn) * np.cross(normal, right)
        points = straight(vertices, triangles, start, patch.center, along, lengths)
        exact = on_ball(points, middle)
        lines = lengths[:, None] * np.array([np.cos(turn), np.sin(turn)])
        own = max(own, np.linalg.norm(lines - exact, axis=1).max() / radius)
        at = mesh.nearest(points)
        flat = np.einsum(
            "nk,nkc->nc", at.barycentric, patch.surface.vertices[patch.surface.triangles[at.triangles]]
        )
        known = np.isin(at.triangles, patch.triangles)
        missed = max(missed, np.linalg.norm(flat[known, :2] - exact[known], axis=1).max() / radius)
    # The mesh is no sphere: a hundredth is not to be had of straight lines either.
    assert own > 0.01
    assert missed < 1.05 * own


def test_where_a_disc_meets_itself_behind_a_limb_what_folds_hides_nothing():
    patch = octex.unwrap(tube(), (0.0, 0.0, 1.0), 3.6, size=256)
    assert "fold over" in repr(patch)
    seen = z_buffer(patch.surface.vertices, patch.surface.triangles, patch.camera)
    y, x = (np.mgrid[:256, :256] + 0.5) / 256 * 7.2 - 3.6
    clear = (np.abs(x) < 3.0) & (np.abs(y) < 1.9) & (np.hypot(x, y) < 3.5)
    assert (seen.triangle[clear] >= 0).all()
    assert not np.isin(seen.triangle[clear], patch.folded).any()
    corners = patch.surface.rest[patch.surface.triangles[seen.triangle[clear]]]
    points = np.einsum("nk,nkc->nc", seen.barycentric[clear], corners)
    exact = on_tube(points, patch.center)
    assert np.abs(exact - np.stack([x[clear], -y[clear]], axis=1)).max() < 0.036


def stretches(patch):
    """Return the greater and the lesser stretch (k,) of a disc's triangles."""
    corners = patch.surface.triangles[patch.triangles]
    at, flat = patch.surface.rest[corners], patch.coordinates[corners]
    ways = np.linalg.qr(np.moveaxis(np.diff(at, axis=1), 1, 2))[1]
    lengths = np.linalg.svd(np.moveaxis(np.diff(flat, axis=1), 1, 2) @ np.linalg.inv(ways), compute_uv=False)
    return lengths[:, 0], lengths[:, 1]


def horned(segments=64):
    """A ball with a horn along x, three of its radii long."""
    whole = colored(sphere((0, 0, 0), 1.0, segments))
    points = whole.vertices
    along = np.arccos(np.clip(points[:, 0], -1, 1))
    return octex.Surface.from_arrays(
        points * (1 + 3 * np.exp(-((along / 0.35) ** 2)))[:, None], whole.triangles
    )


def test_a_conformal_disc_of_what_can_be_laid_flat_is_its_exponential_map():
    patch = octex.unwrap(tube(), (0.3, 0.1, 1.0), 0.8, method="conformal")
    known = np.isfinite(patch.coordinates[:, 0])
    exact = on_tube(patch.surface.rest[known], patch.center)
    assert np.linalg.norm(patch.coordinates[known] - exact, axis=1).max() < 0.008


def test_a_conformal_disc_of_a_sphere_keeps_angles_and_area():
    patch = octex.unwrap(ball(), CENTER, 1.2, method="conformal")
    most, least = stretches(patch)
    assert patch.faults == []
    assert (most / least).max() < 1.1  # the exponential map: 1.29
    corners = patch.surface.rest[patch.surface.triangles[patch.triangles]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (areas * most * least).sum() == pytest.approx(areas.sum())
    half = patch.width / 2 * float(patch.camera.pixel_width(np.ones(1))[0])
    assert np.nanmax(abs(patch.coordinates)) == pytest.approx(half)


def test_a_horn_folds_less_in_a_conformal_disc_and_keeps_its_angles():
    surface = horned()
    folds, opens = (
        octex.unwrap(surface, (0.6, 0.6, 0.6), 2.5, method=each) for each in ("exponential", "conformal")
    )
    assert np.array_equal(folds.triangles, opens.triangles)
    assert folds.folded.size > 3 * opens.folded.size
    medians = [np.median(most / least) for most, least in map(stretches, (folds, opens))]
    assert medians[0] > 1.4
    assert medians[1] < 1.15


@pytest.mark.parametrize(
    ("make", "exact", "center", "radius"),
    [
        *((ball, on_ball, CENTER, radius) for radius in (0.3, 1.2)),
        *((tube, on_tube, (0.3, 0.1, 1.0), radius) for radius in (0.4, 1.5)),
    ],
)
def test_a_disc_is_the_exponential_map_to_a_hundredth_of_the_radius(make, exact, center, radius):
    patch = octex.unwrap(make(), center, radius)
    inside = np.linalg.norm(patch.coordinates, axis=1) <= radius
    middle = patch.center / np.linalg.norm(patch.center) if make is ball else patch.center
    apart = patch.coordinates[inside] - exact(patch.surface.rest[inside], middle)
    assert np.linalg.norm(apart, axis=1).max() <= 0.01 * radius
    assert patch.faults == []


def test_a_disc_over_the_edge_of_a_cube_goes_on_straight():
    patch = octex.unwrap(colored(cube((0, 0, 0))), (1.0, 0.5, 0.9), 0.3)
    points = patch.surface.rest[patch.surface.triangles[patch.triangles]].reshape(-1, 3)
    flat = patch.coordinates[patch.surface.triangles[patch.triangles]].reshape(-1, 2)
    front = points[:, 2] == 1.0
    across = np.where(front, 0.1 + 1.0 - points[:, 0], 0.9 - points[:, 2])
    on_two = front | (points[:, 0] == 1.0)
    known = on_two & (np.linalg.norm(flat, axis=1) < 2)
    sign = np.where(front, -1.0, 1.0)
    assert np.allclose(flat[known, 0], (across * sign)[known], atol=1e-9)
    assert np.allclose(flat[known, 1], points[known, 1] - 0.5, atol=1e-9)


def test_borders_and_folds_are_said():
    patch = octex.unwrap(tube(), (0.0, 1.5, 1.0), 1.0)
    assert patch.meets_border
    assert patch.faults == ["the surface ends within it"]
    around = octex.unwrap(colored(cube((0, 0, 0))), (1.0, 0.5, 0.5), 2.0)
    assert around.folded.size
    assert "fold over" in repr(around)


def test_vertices_at_one_place_are_one():
    whole = tube()
    torn = octex.Surface.from_arrays(
        whole.vertices[whole.triangles].reshape(-1, 3), np.arange(3 * len(whole.triangles)).reshape(-1, 3)
    )
    one, other = (octex.unwrap(each, (0.3, 0.1, 1.0), 0.5) for each in (whole, torn))
    assert np.array_equal(one.triangles, other.triangles)
    corners = [each.coordinates[each.surface.triangles[each.triangles]] for each in (one, other)]
    assert np.allclose(*corners, atol=1e-12)
    assert not other.meets_border


def test_what_cannot_be_unwrapped_is_refused():
    for center, radius, options, error, message in (
        ((5, 0, 0), 1.0, {}, ModelError, "farther than the radius"),
        ((1, 0, 0), 0.0, {}, ArgumentError, "radius"),
        ((1, 0, 0), 1.0, {"method": "flat"}, ArgumentError, "'flat'; there are: exponential, conformal"),
        ((1, np.nan, 0), 1.0, {}, ArgumentError, "center"),
    ):
        with pytest.raises(error, match=message):
            octex.unwrap(ball(12), center, radius, **options)
    patch = octex.unwrap(ball(12), (1, 0, 0), 0.5, size=4)
    image = octex.Projection(np.zeros((4, 4, 3), np.uint8), patch)
    with pytest.raises(ArgumentError, match="is not of"):
        octex.project(ball(24), image)
    other = octex.Projection(np.zeros((4, 4, 3), np.uint8), octex.unwrap(ball(12), (1, 0, 0), 0.5, size=4))
    with pytest.raises(ArgumentError, match="in a call of their own"):
        octex.project(ball(12), [image, other])


def waves(x, y):
    """Return sRGB colours of a flat image."""
    return np.stack([np.sin(6 * x), np.cos(5 * y + 2 * x), np.sin(7 * (x + y))], axis=-1) * 0.35 + 0.5


@pytest.mark.parametrize(
    ("make", "exact", "center", "depth"),
    [(ball, on_ball, CENTER, 6), (tube, on_tube, (0.3, 0.1, 1.0), 7)],  # cells of one size
)
def test_what_is_painted_on_a_disc_lies_there(make, exact, center, depth):
    surface, radius, size = make(), 0.7, 256
    patch = octex.unwrap(surface, center, radius, size=size)
    at = ((np.arange(size) + 0.5) / size * 2 - 1) * radius
    image = np.rint(waves(at[None, :] + 0 * at[:, None], -at[:, None] + 0 * at) * 255).astype(np.uint8)
    texture = octex.convert(surface, depth, sources={"base_color": 0.25})
    painted = octex.paint(texture, surface, octex.Projection(image, patch))
    points = surface.scatter(100_000)
    middle = patch.center / np.linalg.norm(patch.center) if make is ball else patch.center
    flat = exact(points.rest, middle)
    reach = np.linalg.norm(flat, axis=1)
    inside = reach < 0.95 * radius
    found = linear_to_srgb(painted.sample(points.rest[inside]))
    error = 255 * (found - waves(*flat[inside].T))
    assert np.sqrt((error**2).mean()) <= 2.0
    beside = reach > 1.6 * radius
    assert np.array_equal(painted.sample(points.rest[beside]), texture.sample(points.rest[beside]))


@pytest.mark.parametrize("center", [(0.5, 0.5, 1.0), (0.45, 0.5, 1.0), (0.7, 0.55, 1.0), (0.5, 0.4, 1.0)])
@pytest.mark.parametrize(("scale", "size"), [(1.0, 32), (0.05, 16)])
def test_a_disc_inside_the_side_of_a_box_is_the_whole_disc(center, scale, size):
    box = colored(cube((0, 0, 0)))
    patch = octex.unwrap(box, center, 0.3 * scale, size=size)
    assert patch.faults == []
    seen = z_buffer(patch.surface.vertices, patch.surface.triangles, patch.camera)
    places = patch.surface.points_at(seen.triangle.ravel(), seen.barycentric.reshape(-1, 3))
    rest = octex.Surface.from_arrays(patch.surface.rest, patch.surface.triangles)
    rest = rest.points_at(seen.triangle.ravel(), seen.barycentric.reshape(-1, 3))
    assert (seen.triangle >= 0).all()
    np.testing.assert_allclose(rest[:, :2] - patch.center[:2], places[:, :2], atol=1e-6)
    texture = octex.convert(box, 4, sources={"base_color": 0.25})
    paint = octex.project(box, octex.Projection(np.full((size, size, 3), 255, np.uint8), patch), like=texture)
    cell, pixel = paint.placement.size / 2**paint.tree.max_depth, 0.6 * scale / size
    assert 0.5 * pixel <= cell <= 1.05 * pixel
    assert paint.tree.n_leaves * cell**2 == pytest.approx((0.6 * scale) ** 2, rel=0.15)


def test_the_command_draws_a_disc_flat_and_paints_it_back(tmp_path, cli):
    surface = tube(48, 25)
    model, before, after = tmp_path / "tube.obj", tmp_path / "tube.octex", tmp_path / "painted.octex"
    model.write_text(obj_lines(surface.vertices, surface.triangles))
    octex.convert(octex.load_surface(model), 5, sources={"base_color": 0.25}).save(before)
    view, disc = tmp_path / "view.png", "--unwrap=0,0,1,0.5"
    cli.result(before, model, disc, VIEW, view, "--size", "64,64")
    image = np.array(Image.open(view))
    assert image.shape == (64, 64, 4)
    assert (image[32, 32] == [137, 137, 137, 255]).all()
    image[24:40, 32:] = [255, 0, 0, 255]
    Image.fromarray(image).save(view)
    cli.result(before, model, view, disc, OUT, after)
    painted = octex.open(after)
    angle = 0.25
    seen = painted.sample(
        [[np.sin(angle), 0, np.cos(angle)], [-np.sin(angle), 0, np.cos(angle)], [0, 0.4, 1]]
    )
    assert np.allclose(seen[0], [1, 0, 0], atol=0.03)
    assert np.allclose(seen[1:], 0.25, atol=0.03)
    # Of what can be laid flat a conformal disc is the same; its image is as wide as its triangles.
    flat = tmp_path / "flat.png"
    conformal = f"{disc}:conformal"
    cli.result(before, model, conformal, VIEW, flat, "--size", "64,64")
    Image.fromarray(np.full((64, 64, 3), 255, np.uint8)).save(flat)
    words = [before, model, flat, conformal, "--since", "nothing", "--force", OUT, after]
    cli.result(*words)
    white = octex.open(after).sample([[np.sin(a), 0.2, np.cos(a)] for a in (-0.3, 0.0, 0.3)])
    assert np.allclose(white, 1.0, atol=0.03)
    for words, message in (
        ([f"{disc}:folded", VIEW, flat], "'folded' is neither conformal nor up=X,Y,Z"),
        ([disc, VIEW, tmp_path / "b.png", "--size", "64,32"], "square"),
    ):
        assert message in cli.errors(before, model, *words, code=2)
