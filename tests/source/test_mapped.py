"""Images laid on surfaces by position: against a slow reference, at seams, caps and poles."""

import json
import pickle
import re

import numpy as np
import PIL.Image
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octex import jit
from octex.channels import CHANNELS
from octex.errors import ArgumentError, ImageError
from octex.source.base import points_with_normals
from octex.source.corners import Corners, Frames
from octex.source.images.filters import FILTERS
from octex.source.images.pyramid import WRAPS
from octex.source.mapped import FRAMES, KINDS, MappedImage
from octex.source.surface import Surface
from tests.conftest import needs_jit
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, png, random_image
from tests.make.small_textures import unit
from tests.oracles import naive_mapped
from tests.source.test_surface import CUBE, CUBE_TRIANGLES

COUNT = 20 if jit.DISABLED else 400
CENTER, SIZE = np.array([0.2, -0.1, 0.3]), np.array([0.9, 1.3, 0.7])
AROUND = ("cylindrical", "spherical")


def light(height, width, seed=0):
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def waves(height, width):
    """A smooth image that repeats."""
    v, u = np.mgrid[:height, :width] / [[[height]], [[width]]] * 2 * np.pi
    lanes = [np.sin(u + 1), np.cos(v) * np.sin(2 * u), np.sin(u + v)]
    return (0.5 + 0.5 * np.stack(lanes, axis=-1)).astype(np.float32)


def cube(scale=1.0, **options):
    return Surface.from_arrays((CUBE - 0.5) * scale, CUBE_TRIANGLES, **options)


def laid(image, kind, filter="bilinear", channel="base_color", **options):
    if kind != "spherical":
        options = {"size": SIZE, **options}
    mapped = MappedImage(image, kind, **{"center": CENTER, **options})
    source, _ = mapped.on(cube(), CHANNELS[channel], filter)
    return source


def places(count, seed=0):
    """Points about the centre, some on the axes and on the seam, and normals, some along the axes."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points[::9, 0] = 0.0
    points[::10, 1] = 0.0
    points[::11, 2] = 0.0
    points[0] = 0.0
    normals = unit(random.normal(size=(count, 3)))
    normals[::7] = np.eye(3)[random.integers(0, 3, len(normals[::7]))] * random.choice([-1, 1])
    return CENTER + points, normals


def zeros(points):
    return np.zeros(len(points), np.float32)


@pytest.mark.parametrize("axis", FRAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_points_are_read_as_the_slow_reference_reads_them(kind, axis):
    image = light(7, 12)
    points, normals = places(COUNT)
    for wraps in (("repeat", "clamp"), ("mirror", "repeat"), ("clamp", "mirror")):
        found = laid(image, kind, axis=axis, wrap=wraps).at(points, normals, zeros(points))
        expected = naive_mapped.read(image, kind, axis, CENTER, SIZE, wraps, points, normals)
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_flat_texels_are_those_of_the_slow_reference(kind):
    image = light(5, 8)
    random = np.random.default_rng(1)
    points, normals = random.normal(size=(5 * COUNT, 3)), unit(random.normal(size=(5 * COUNT, 3)))
    expected = naive_mapped.read(image, kind, "y", CENTER, SIZE, ("mirror",) * 2, points, normals, flat=True)
    for options in ({"filter": "nearest"}, {"filter": "ewa", "mag_filter": "nearest"}):
        found = laid(image, kind, axis="y", wrap="mirror", **options).at(points, normals, zeros(points))
        np.testing.assert_allclose(found, expected, atol=2e-5)


@needs_jit
@pytest.mark.parametrize(("kind", "filter"), [("box", "trilinear"), *((kind, "ewa") for kind in KINDS)])
def test_footprints_are_the_means_of_many_points(kind, filter):
    # Round the axis they end at a third of what the surface is away: farther in they are no ellipses.
    image = waves(64, 128)
    random = np.random.default_rng(2)
    points, normals = unit(random.normal(size=(60, 3))), unit(random.normal(size=(60, 3)))
    points[:20, 0] = random.normal(size=20) * 1e-3  # about the seam
    if kind in AROUND:
        normals = points.copy()
    normals[40:50] = [0, 0, 1]
    widths = random.uniform(0.01, 0.2, 60)
    radii = np.hypot(points[:, 0], points[:, 1])
    if kind in AROUND:
        widths = np.minimum(widths, radii / 3)
    found = laid(image, kind, filter, center=(0, 0, 0)).at(points, normals, widths.astype(np.float32))
    expected = naive_mapped.means(
        image, kind, "z", np.zeros(3), SIZE, ("repeat",) * 2, points, normals, widths.tolist()
    )
    # The squares of mip levels are as wide as footprints are long.
    limit = 0.03 if filter == "trilinear" else 0.012
    assert np.sqrt(np.mean((found - expected) ** 2)) < limit
    assert np.abs(found - expected).max() < 5 * limit


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("kind", AROUND)
def test_nothing_jumps_at_the_seam(kind, filter):
    image = waves(16, 32)
    if filter == "nearest":
        image[:, -1] = image[:, 0]
    random = np.random.default_rng(3)
    angles, heights = np.pi / 2 + 1e-9 * np.array([[-1.0], [1.0]]), random.uniform(-0.9, 0.9, 20)
    x, y = np.cos(angles) + 0 * heights, np.sin(angles) + 0 * heights
    sides = [np.stack([x[i], y[i], heights], axis=1) for i in (0, 1)]
    assert sides[0][0, 0] > 0 > sides[1][0, 0]
    normals = unit(sides[0] * [1, 1, 0])
    source = laid(image, kind, filter, center=(0, 0, 0))
    for width in (0.0, 0.03, 0.3, 2.0):
        widths = np.full(20, width, np.float32)
        left, right = (source.at(points, normals, widths) for points in sides)
        np.testing.assert_allclose(left, right, atol=2e-6)


@pytest.mark.parametrize("filter", ["bilinear", "ewa"])
def test_a_pole_shows_nothing_of_the_other_and_all_longitudes(filter):
    image = np.zeros((32, 64, 3), np.float32)
    image[:16, ::2, 0] = 1.0  # stripes in the north, red on black
    image[16:, :, 1] = 1.0  # the south is green
    source = laid(image, "spherical", filter, center=(0, 0, 0))
    around = np.exp(1j * np.linspace(0, 6, 13)) * 1e-4
    points = np.stack([around.real, around.imag, np.ones(13)], axis=1)
    for width in (0.05, 0.2, 0.5):
        widths = np.full(13, width, np.float32)
        north = source.at(points, points, widths)
        assert (north[:, 1] < 1e-6).all()
        if filter != "bilinear":
            np.testing.assert_allclose(north[:, 0], 0.5, atol=0.02)
        np.testing.assert_allclose(source.at(-points, -points, widths), [[0, 1, 0]] * 13, atol=1e-6)


def test_a_footprint_covers_the_image_once_at_most():
    # Also in the middle of a sphere, where all of it is as near.
    image = waves(16, 32)
    for kind in AROUND:
        source = laid(image, kind, "ewa", center=(0, 0, 0))
        points = np.array([[0.0, 0, 0], [1e-200, 0, 0], [0, -1e-9, 0]])
        found = source.at(points, np.tile([0.0, -1, 0], (3, 1)), np.full(3, 0.1, np.float32))
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found, found[[0]].repeat(3, axis=0), atol=0.02)


QUARTERS = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], np.float32)  # from the top left


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axis", FRAMES)
def test_from_outside_the_image_is_upright_and_not_mirrored(axis, kind):
    size = {} if kind == "spherical" else {"size": 2}
    source = laid(QUARTERS, kind, "nearest", axis=axis, center=(0, 0, 0), **size)
    up, front = naive_mapped.AXES[axis], naive_mapped.FRONTS[axis]
    sides = {"box": naive_mapped.sides_of(axis), "planar": [(up, naive_mapped.TOPS[axis])]}
    reach = 0.1 if kind in AROUND else 0.5
    for outward, top in sides.get(kind, [(front, up)]):
        right = np.cross(top, outward)
        points = np.array([outward + reach * (a * right + b * top) for b in (1, -1) for a in (-1, 1)])
        for normal in (outward, -outward, top) if kind == "planar" else (outward,):
            found = source.at(points, np.tile(normal, (4, 1)), zeros(points))
            np.testing.assert_array_equal(found, QUARTERS.reshape(4, 3))


def test_where_normals_are_as_near_to_two_sides_rounding_does_not_decide():
    normals = unit(np.array([[1.0, 0, 1], [1, 1, 1], [1, -1, 0]]).repeat(50, axis=0))
    normals += np.random.default_rng(0).normal(size=(150, 3)) * 1e-8
    points = np.tile([0.3, 0.17, 0.39], (150, 1))
    for kind in KINDS:
        found = laid(light(8, 8), kind, axis="z").at(points, normals, zeros(points)).reshape(3, 50, 3)
        np.testing.assert_allclose(found, found[:, :1].repeat(50, axis=1), atol=1e-5)


def test_a_cap_shows_the_circle_inscribed_in_the_image():
    image = waves(64, 64)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], axis=1)
    up = np.array([0.0, 0, 1])
    points = np.concatenate([rim + up, rim - up, [up, -up]])
    triangles = [[48, i, (i + 1) % 24] for i in range(24)]
    triangles += [[49, 24 + (i + 1) % 24, 24 + i] for i in range(24)]
    surface = Surface.from_arrays(points, triangles)
    laid_on = surface.with_sources({"base_color": MappedImage(image, "cylindrical")}, "bilinear")
    samples = laid_on.scatter(300)
    found = laid_on.evaluate(samples)
    u, v = (samples.rest[:, 0] + 1) / 2, (1 - samples.rest[:, 1]) / 2
    v = np.where(samples.rest[:, 2] > 0, v, 1 - v)
    expected = naive_mapped.dense_reads(image.astype(float), ("repeat",) * 2, np.stack([u, v], axis=1))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("slope", [44.9, 45.1])
def test_a_cap_begins_where_a_face_is_nearer_to_the_axis_than_to_the_side(slope):
    normal = np.array([[0, -np.cos(np.radians(slope)), np.sin(np.radians(slope))]])
    point = np.array([[0.3, -0.4, 0.2]])
    image = waves(32, 32)
    found = laid(image, "cylindrical").at(point, normal, zeros(point))
    other = "box" if slope > 45 else "cylindrical"
    side = [[0.0, 0, 1]] if slope > 45 else [[0.0, -1, 0]]
    np.testing.assert_allclose(found, laid(image, other).at(point, np.array(side), zeros(point)), atol=1e-6)


@given(st.sampled_from(KINDS), st.sampled_from(FILTERS), st.sampled_from(WRAPS), st.integers(0, 2**31))
def test_however_far_or_wide_values_are_of_the_image(kind, filter, wrap, seed):
    image = np.full((3, 5, 3), 0.25, np.float32)
    random = np.random.default_rng(seed)
    points = random.normal(size=(6, 3)) * 10.0 ** random.uniform(-30, 29, (6, 1))
    widths = (10.0 ** random.uniform(-30, 29, 6)).astype(np.float32)
    source = laid(image, kind, filter, wrap=wrap, **({} if kind == "spherical" else {"size": 1e-6}))
    normals = unit(random.normal(size=(6, 3)))
    normals[0] = 0.0  # of a triangle without area
    np.testing.assert_allclose(source.at(points, normals, widths), 0.25, rtol=1e-3)


def test_an_image_spans_the_bounds_at_rest_unless_told_otherwise():
    image = waves(16, 16)
    rest = np.array([[1.0, 1, 2], [5, 1, 2], [5, 3, 3], [1, 3, 3]])
    surface = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, rest=rest)
    middle, bounds = [3, 2, 2.5], [4, 2, 1]
    samples = surface.scatter(50)
    for kind in KINDS:
        usual = surface.with_sources({"base_color": MappedImage(image, kind)})
        size = None if kind == "spherical" else 4 if kind == "box" else bounds
        same = surface.with_sources({"base_color": MappedImage(image, kind, center=middle, size=size)})
        np.testing.assert_allclose(usual.evaluate(samples, width=0.3), same.evaluate(samples, width=0.3))
        said = json.loads(usual.provenance["source_base_color"])
        assert said["mapping"] == kind
        assert (said["center"], said["size"]) == (middle, [4.0] * 3 if size == 4 else size)
        assert usual.provenance == same.provenance
    half = MappedImage(image, "planar", size=(2, 1, 7), center=middle)
    found = surface.with_sources({"base_color": half}).evaluate(samples)
    uv = (samples.rest[:, :2] - [3, 2]) / [2, -1] + 0.5
    np.testing.assert_allclose(
        found, naive_mapped.dense_reads(image.astype(float), ("repeat",) * 2, uv), atol=1e-5
    )


def test_a_flat_surface_has_an_image_from_its_side_too():
    surface = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES)
    for axis in FRAMES:
        made = surface.with_sources({"base_color": MappedImage(waves(8, 8), "planar", axis=axis)})
        assert np.isfinite(made.evaluate(made.scatter(20), width=0.2)).all()
    point = Surface.from_arrays(np.zeros((3, 3)), [[0, 1, 2]])
    made = point.with_sources({"base_color": MappedImage(waves(8, 8), "box")})
    assert np.isfinite(made.evaluate_all(np.zeros(1), np.eye(3)[:1], np.ones(1))).all()


@pytest.mark.parametrize("filter", FILTERS)
def test_a_plane_is_what_texture_coordinates_of_the_positions_are(filter):
    codes = random_image(16, 8, 3)
    vertices = SQUARE * [1, 1, 0] + np.array([[0, 0, 0], [0, 0, 1], [0, 0, 1.5], [0, 0, 0.5]])
    surface = Surface.from_arrays(vertices, SQUARE_TRIANGLES, uv=SQUARE[:, :2])
    samples = surface.scatter(100)
    for channel in ("base_color", "roughness", "alpha", "emissive", "normal"):
        by_coordinates = surface.with_sources({channel: codes}, filter)
        by_position = surface.with_sources({channel: MappedImage(codes, "planar")}, filter)
        for width in (0.0, 0.05, 0.4):
            expected = by_coordinates.evaluate(samples, channel, width)
            np.testing.assert_allclose(by_position.evaluate(samples, channel, width), expected, atol=2e-4)
    mapped = {"base_color": MappedImage(codes, "planar")}
    again, at_once = surface.with_sources(mapped).with_filter(filter), surface.with_sources(mapped, filter)
    np.testing.assert_array_equal(again.evaluate(samples, width=0.3), at_once.evaluate(samples, width=0.3))


@pytest.mark.parametrize("kind", KINDS)
def test_directions_of_normal_maps_follow_the_image(kind):
    # What leans to the image's right or top points where u grows or v falls along the surface.
    random = np.random.default_rng(5)
    points, normals = random.normal(size=(40, 3)), unit(random.normal(size=(40, 3)))
    straight, right, top = (
        laid(np.full((2, 2, 3), code, np.float32), kind, channel="normal", center=(0, 0, 0)).at(
            points, normals, zeros(points)
        )
        for code in ([0.5, 0.5, 1], [1, 0.5, 0.5], [0.5, 1, 0.5])
    )
    np.testing.assert_allclose(straight, normals, atol=0.01)
    for lean in (right, top):
        np.testing.assert_allclose(np.linalg.norm(lean, axis=1), 1, atol=1e-5)
        np.testing.assert_allclose((lean * normals).sum(axis=1), 0, atol=0.01)
    np.testing.assert_allclose((right * top).sum(axis=1), 0, atol=0.01)

    def seen(at):
        found = [
            naive_mapped.coordinates(kind, "z", np.zeros(3), SIZE, p, n)[:2]
            for p, n in zip(at, normals, strict=True)
        ]
        return np.array(found)

    step = 1e-5
    along = right - normals * (right * normals).sum(axis=1, keepdims=True)
    change = (seen(points + step * along) - seen(points)) / step
    assert (change[:, 0] > 0).all()
    assert (np.abs(change[:, 1]) < 0.02 * np.abs(change[:, 0]) + 0.02).all()
    change = (seen(points + step * top) - seen(points)) / step
    assert (change[:, 1] < 0).all()


def test_normal_maps_seen_edge_on_have_a_frame_all_the_same():
    normals = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    points = np.full((7, 3), 0.3)
    for kind in KINDS:
        source = laid(np.full((2, 2, 3), [255, 128, 128], np.uint8), kind, channel="normal")
        found = source.at(points, normals, zeros(points))
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
        np.testing.assert_allclose((found * normals).sum(axis=1), 0, atol=0.01)


def test_normal_maps_stand_on_shading_normals_where_the_surface_has_them():
    plain = cube()
    triangles = np.asarray(plain.triangles)
    smooth = Corners(unit(plain.vertices).astype(np.float32), triangles)
    tangents = Corners(np.tile(np.float32([1, 0, 0, 1]), (8, 1)), triangles)
    surface = Surface(plain.vertices, triangles, plain.source, frames=Frames(smooth, tangents))
    straight = MappedImage(np.full((2, 2, 3), [128, 128, 255], np.uint8), "box")
    made = surface.with_sources({"normal": straight})
    samples = made.scatter(30)
    np.testing.assert_allclose(made.evaluate(samples, "normal"), unit(samples.rest), atol=0.01)
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = made.with_rest(made.rest @ turn.T)
    np.testing.assert_allclose(turned.evaluate(samples, "normal"), unit(samples.rest @ turn.T), atol=0.01)


def test_averages_of_directions_are_shorter_than_1():
    codes = np.zeros((8, 8, 3), np.uint8) + np.uint8(128)
    codes[::2, :, 0], codes[1::2, :, 0] = 255, 0
    source = laid(codes, "planar", "ewa", "normal")
    points, normals = np.zeros((1, 3)), np.array([[0.0, 0, 1]])
    assert np.linalg.norm(source.at(points, normals, np.ones(1, np.float32))) < 0.1


def test_floats_above_1_are_stored_as_light_and_data_is_not_decoded():
    surface = cube()
    made = surface.with_sources({"emissive": MappedImage(light(4, 4) * 8, "box")})
    form = made.channels[-1]
    assert (form.name, form.space, form.dtype) == ("emissive", "linear", "float16")
    samples = surface.scatter(20)
    assert made.evaluate(samples, "emissive").max() > 1
    made = surface.with_sources({"roughness": MappedImage(np.full((2, 2), 128, np.uint8), "box")})
    np.testing.assert_allclose(made.evaluate(samples, "roughness"), 128 / 255, atol=1e-6)


def test_files_images_and_arrays_are_one(tmp_path):
    codes = random_image(4, 4)
    (tmp_path / "wood.png").write_bytes(png(codes))
    samples = cube().scatter(20)
    first, *others = (
        cube().with_sources({"base_color": MappedImage(given, "box")})
        for given in (codes, PIL.Image.fromarray(codes), tmp_path / "wood.png", str(tmp_path / "wood.png"))
    )
    for other in others:
        np.testing.assert_array_equal(first.evaluate(samples), other.evaluate(samples))
    assert "wood.png" in json.loads(other.provenance["source_base_color"])


def test_other_rest_positions_are_read_where_they_are():
    source = laid(light(8, 8), "box", "ewa")
    moved = source.with_rest((CUBE - 0.5) * 3 + 1)
    triangles, barycentric = np.arange(12, dtype=np.int32), np.full((12, 3), 1 / 3)
    widths = np.full(12, 0.1, np.float32)
    points = ((CUBE - 0.5) * 3 + 1)[CUBE_TRIANGLES].mean(axis=1)
    _, normals = points_with_normals(source._rest, source._triangles, triangles, barycentric)
    np.testing.assert_allclose(
        moved.evaluate(triangles, barycentric, widths), source.at(points, normals, widths), atol=1e-6
    )
    again = pickle.loads(pickle.dumps(moved))
    np.testing.assert_array_equal(
        again.evaluate(triangles, barycentric, widths), moved.evaluate(triangles, barycentric, widths)
    )


def test_texels_have_the_edges_they_have_on_the_surface():
    triangles = np.arange(12, dtype=np.int32)
    surface = cube(2.0)
    for kind in ("planar", "box"):
        source, _ = MappedImage(light(8, 16), kind, size=(2, 2, 1)).on(surface, CHANNELS["base_color"], "ewa")
        edges = source.texel_edges(triangles)
        middles = np.full((12, 3), 1 / 3)
        _, normals = points_with_normals(surface.rest, surface.triangles, triangles, middles)
        np.testing.assert_allclose(edges[abs(normals[:, 2]) > 0.5], 1 / 8)
        sides = edges[abs(normals[:, 2]) < 0.5]
        assert set(np.round(sides, 4)) == ({0.125, 0.25} if kind == "planar" else {0.125})
    source, _ = MappedImage(light(8, 16), "spherical").on(surface, CHANNELS["base_color"], "ewa")
    at = surface.vertices[surface.triangles].mean(axis=1)
    rounds = 2 * np.pi * np.hypot(at[:, 0], at[:, 1]) / 16
    assert (source.texel_edges(triangles) <= rounds * 1.1).all()
    flat = Surface.from_arrays(SQUARE, SQUARE_TRIANGLES)
    one, _ = MappedImage(light(1, 1), "planar", axis="x").on(flat, CHANNELS["base_color"], "ewa")
    assert np.isfinite(one.texel_edges(np.zeros(1, np.int32))).all()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("conical", {}, "unknown kind of mapping 'conical'; there are: planar, box, cylindrical, spherical"),
        ("box", {"axis": "w"}, "unknown axis 'w'; there are: x, -x, y, -y, z, -z"),
        ("box", {"center": (1, 2)}, "center must be numbers of shape (3,), not (1, 2)"),
        ("box", {"center": 1}, "center must be numbers of shape (3,), not 1"),
        ("box", {"center": (0, np.nan, 0)}, "center must be from -1e+30 to 1e+30, not nan"),
        ("box", {"size": 0}, "size must be from 1e-30 to 1e+30, not 0"),
        ("box", {"size": (1, -1, 1)}, "size must be from 1e-30 to 1e+30, not -1"),
        ("box", {"size": (1, 1)}, "size must be numbers of shape (3,) or (), not (1, 1)"),
        ("box", {"size": "big"}, "size must be numbers of shape (3,) or (), not 'big'"),
        ("spherical", {"size": 1}, "a spherical projection has no size: it goes once around"),
        ("box", {"wrap": "tile"}, "unknown wrap 'tile'; there are: repeat, mirror, clamp"),
        ("box", {"wrap": ("clamp",)}, "wrap must be one name, or one for u and one for v, not ('clamp',)"),
        ("box", {"mag_filter": "cubic"}, "unknown mag_filter 'cubic'; there are: linear, nearest"),
    ],
)
def test_what_is_no_mapping_is_refused(kind, options, message):
    with pytest.raises(ArgumentError, match=re.escape(message)):
        MappedImage(random_image(2, 2), kind, **options)


def test_what_is_no_image_is_refused_when_it_is_laid():
    for image, message in (("no such.png", "no such.png cannot be read: No such"), (3, "must have shape")):
        with pytest.raises(ImageError, match=message):
            cube().with_sources({"base_color": MappedImage(image, "box")})
    with pytest.raises(ArgumentError, match="unknown filter 'sharp'"):
        laid(random_image(2, 2), "box").with_filter("sharp")
