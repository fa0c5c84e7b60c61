"""Surfaces from arrays: samples, values, errors."""

import numpy as np
import PIL.Image
import pytest

from octex.channels import srgb_to_linear
from octex.errors import ArgumentError, ImageError, ModelError
from octex.source.corners import Corners, Frames
from octex.source.surface import Surface
from tests.make.fixtures import SQUARE, SQUARE_TRIANGLES, SQUARE_UV, random_image

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
CUBE_TRIANGLES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
     [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def square(**options):
    return Surface.from_arrays(SQUARE, SQUARE_TRIANGLES, **options)


def test_samples_lie_on_their_triangles_and_are_the_same_for_a_seed():
    surface = Surface.from_arrays(CUBE, CUBE_TRIANGLES)
    samples = surface.scatter(500)
    corners = surface.vertices[surface.triangles[samples.triangles]]
    np.testing.assert_allclose(samples.barycentric.sum(axis=1), 1)
    assert (samples.barycentric >= 0).all()
    np.testing.assert_allclose((samples.barycentric[:, :, None] * corners).sum(axis=1), samples.points)
    np.testing.assert_allclose(np.linalg.norm(samples.normals, axis=1), 1)
    outward = samples.points + 1e-3 * samples.normals
    assert ((outward < 0) | (outward > 1)).any(axis=1).all()
    assert samples.triangles.dtype == np.int32
    np.testing.assert_array_equal(samples.rest, samples.points)
    np.testing.assert_array_equal(surface.scatter(500).points, samples.points)
    assert (surface.scatter(500, seed=4).points != samples.points).any()
    assert surface.evaluate(surface.scatter(0)).shape == surface.scatter(0).points.shape == (0, 3)


def test_shading_normals_are_given_by_vertex_or_by_corner():
    by_vertex = CUBE - 0.5
    by_corner = 3.0 * by_vertex[CUBE_TRIANGLES]
    barycentric = np.full((len(CUBE_TRIANGLES), 3), 1 / 3)
    for normals in (by_vertex, by_corner):
        frames = Surface.from_arrays(CUBE, CUBE_TRIANGLES, normals=normals).frames
        found = frames.normals.at(np.arange(len(CUBE_TRIANGLES)), barycentric)
        np.testing.assert_allclose(found, by_vertex[CUBE_TRIANGLES].mean(axis=1) / 0.75**0.5, atol=1e-6)
        tangents = frames.tangents.values[frames.tangents.rows, :3]
        np.testing.assert_allclose((tangents * by_corner).sum(axis=2), 0, atol=1e-6)
    with pytest.raises(ArgumentError, match="normals must not have length 0"):
        Surface.from_arrays(CUBE, CUBE_TRIANGLES, normals=np.zeros((8, 3)))


def test_samples_are_uniform_by_posed_area():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 3, 5]], float)
    rest = vertices * [1, 1, 0] + [0, 0, 7]
    surface = Surface.from_arrays(vertices, [[0, 1, 2], [3, 4, 5]], rest=rest)
    np.testing.assert_allclose(surface.areas(), [0.5, 4.5])
    samples = surface.scatter(20_000)
    assert abs((samples.triangles == 1).mean() - 0.9) < 0.01
    small = samples.points[samples.triangles == 0]
    np.testing.assert_allclose(small.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.02)
    np.testing.assert_allclose(samples.rest[:, 2], 7)


def test_triangles_without_area_get_no_samples():
    surface = Surface.from_arrays(SQUARE, [[0, 0, 1], [0, 1, 2], [2, 2, 2]])
    assert set(surface.scatter(100).triangles) == {1}
    with pytest.raises(ModelError, match="dot: all triangles are degenerate"):
        Surface.from_arrays(SQUARE, [[0, 0, 1]], name="dot").scatter(1)


def test_bounds_are_those_of_the_rest_positions_in_use():
    vertices = np.append(SQUARE, [[100, 100, 100]], axis=0)
    surface = Surface.from_arrays(vertices, SQUARE_TRIANGLES, rest=vertices * 2 + 1)
    np.testing.assert_allclose(surface.bounds, [[1, 1, 1], [3, 3, 1]])


def test_a_plain_surface_is_white_and_introduces_itself():
    assert (square().evaluate(square().scatter(10)) == 1).all()
    assert [channel.name for channel in square().channels] == ["base_color"]
    assert repr(square(name="corner")) == "<Surface 'corner' of 2 triangles with base_color>"


def test_colours_of_vertices_are_interpolated_in_linear_light_and_those_of_faces_constant():
    codes = np.array([[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 0, 128]], np.uint8)
    surface = square(colors=codes, factor=(1, 1, 0.5))
    samples = surface.scatter(50)
    linear = srgb_to_linear(codes / 255) * [1, 1, 0.5]
    expected = (samples.barycentric[:, :, None] * linear[SQUARE_TRIANGLES[samples.triangles]]).sum(axis=1)
    np.testing.assert_allclose(surface.evaluate(samples), expected, atol=1e-6)
    deep = square(colors=codes.astype(np.uint16) * 257, factor=(1, 1, 0.5))
    np.testing.assert_allclose(deep.evaluate(samples), expected, atol=1e-6)
    light = square(colors=srgb_to_linear(codes / 255), factor=(1, 1, 0.5))
    np.testing.assert_allclose(light.evaluate(samples), expected, atol=1e-6)
    colors = np.array([[1.0, 0, 0], [0, 0.5, 1]])
    surface = square(face_colors=colors)
    samples = surface.scatter(50)
    np.testing.assert_allclose(surface.evaluate(samples), colors[samples.triangles])


def test_alpha_below_1_makes_a_channel():
    colors = np.array([[1, 1, 1, 0.0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]])
    surface = square(colors=colors)
    assert [channel.name for channel in surface.channels] == ["base_color", "alpha"]
    samples = surface.scatter(50)
    np.testing.assert_allclose(surface.evaluate(samples, "alpha")[:, 0], samples.points[:, 0], atol=1e-6)
    assert len(square(factor=(1, 1, 1, 0.5)).channels) == 2
    assert len(square(uv=SQUARE_UV, image=random_image(2, 2, 4)).channels) == 2
    assert len(square(colors=colors, alpha="opaque").channels) == 1
    masked = square(colors=colors, alpha="mask", cutoff=0.25)
    np.testing.assert_array_equal(masked.evaluate(samples, "alpha")[:, 0], samples.points[:, 0] >= 0.25)


def test_coordinates_have_v_up_and_may_be_given_by_corner():
    image = np.array([[[255] * 3, [255] * 3], [[0] * 3, [0] * 3]], np.uint8)
    by_vertex = SQUARE[:, :2]
    for uv in (by_vertex, by_vertex[SQUARE_TRIANGLES]):
        for either in (image, PIL.Image.fromarray(image)):
            surface = square(uv=uv, image=either, mag_filter="nearest", wrap=("repeat", "clamp"))
            samples = surface.scatter(100)
            np.testing.assert_array_equal(surface.evaluate(samples)[:, 0] == 1, samples.points[:, 1] > 0.5)


def test_coordinates_are_kept_with_v_down_without_an_image_too():
    surface = square(uv=SQUARE_UV)
    np.testing.assert_allclose(surface.uv.values, SQUARE_UV * [1, -1] + [0, 1])
    np.testing.assert_array_equal(surface.uv.rows, SQUARE_TRIANGLES)
    surface.provenance["source"] = "quad.glb"
    for other in (surface.with_rest(SQUARE * 2), surface.with_filter("trilinear"), surface.with_sources({})):
        assert other.uv is surface.uv
        assert other.provenance["source"] == "quad.glb"
        other.provenance["rest"] = "another.glb"  # each keeps its own
    assert surface.provenance == {"source": "quad.glb"}
    assert square().uv is None


def test_some_channels_alone_are_those_values():
    surface = square(uv=SQUARE_UV, image=random_image(4, 4, 4))
    samples = surface.scatter(30)
    for name in ("base_color", "alpha"):
        alone = surface.with_channels([name])
        assert [channel.name for channel in alone.channels] == [name]
        assert alone.provenance is not surface.provenance
        for width in np.float32([0.0, 0.3]):
            values = surface.evaluate_all(samples.triangles, samples.barycentric, np.full(30, width))
            expected = surface.evaluate(samples, name, width)
            np.testing.assert_array_equal(expected, values[:, :3] if name == "base_color" else values[:, 3:])
            np.testing.assert_allclose(alone.evaluate(samples, name, width), expected, atol=1e-6)
    both = surface.with_channels(["alpha", "base_color"])
    assert both.channels == surface.channels
    with pytest.raises(ArgumentError, match="unknown channel 'metallic'; there are: base_color, alpha"):
        surface.with_channels(["alpha", "metallic"])
    with pytest.raises(ArgumentError, match="channels must name at least one channel"):
        surface.with_channels([])


def test_shading_normals_follow_the_rest_mesh_and_a_pose_which_moves_no_rest_or_values():
    triangles, plain = SQUARE_TRIANGLES.astype(np.int32), square(uv=SQUARE_UV, image=random_image(4, 4))
    normals = Corners(np.tile(np.float32([0, 0.6, 0.8]), (4, 1)), triangles)
    tangents = Corners(np.tile(np.float32([1, 0, 0, 1]), (4, 1)), triangles)
    surface = Surface(plain.vertices, triangles, plain.source, frames=Frames(normals, tangents))
    assert surface.with_filter("trilinear").frames is surface.frames
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = surface.with_rest(SQUARE @ turn.T).frames
    np.testing.assert_allclose(turned.normals.values, [turn @ [0, 0.6, 0.8]] * 6, atol=1e-6)
    np.testing.assert_allclose(turned.tangents.values[:, :3], [turn @ [1, 0, 0]] * 6, atol=1e-6)
    posed = surface.with_pose(SQUARE @ turn.T).with_pose(SQUARE @ turn)
    np.testing.assert_array_equal(posed.vertices, SQUARE @ turn)
    assert posed.rest is surface.rest is surface.vertices
    frames = posed.posed_frames()
    np.testing.assert_allclose(frames.normals.values, [turn.T @ [0, 0.6, 0.8]] * 6, atol=1e-6)
    samples, posed_samples = surface.scatter(30), posed.scatter(30)
    np.testing.assert_array_equal(posed_samples.rest, samples.rest)
    np.testing.assert_array_equal(posed.evaluate(posed_samples), surface.evaluate(samples))
    with pytest.raises(ModelError, match="surface: 3 posed positions for 4 vertices; give one each"):
        surface.with_pose(SQUARE[:3])


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (SQUARE, np.empty((0, 3), int), "no triangles"),
        (SQUARE, [[0, 1, 4]], "uses vertex 4, but there are 4"),
        (SQUARE, [[0, 1, -1]], "uses vertex -1"),
        (SQUARE, [[0, 1]], "triangles must be whole numbers"),
        (SQUARE, [[0.0, 1.0, 2.0]], "triangles must be whole numbers"),
        (SQUARE[:, :2], SQUARE_TRIANGLES, r"vertices must have shape \(n, 3\)"),
        (np.full((4, 3), np.nan), SQUARE_TRIANGLES, "vertices are not all finite.*number 0 is nan, nan, nan"),
        (np.float64(SQUARE) * 1e80, SQUARE_TRIANGLES, "not all finite"),
    ],
)
def test_broken_geometry_is_refused(vertices, triangles, message):
    with pytest.raises(ModelError, match=message):
        Surface.from_arrays(np.asarray(vertices, float), triangles, name="thing")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"colors": np.zeros((3, 3))}, ArgumentError, r"colors must have shape \(4, 3\)"),
        ({"colors": np.zeros((4, 3), int)}, ArgumentError, "uint8 or uint16"),
        ({"face_colors": np.zeros((4, 3))}, ArgumentError, r"face_colors must have shape \(2, 3\)"),
        ({"colors": np.zeros((4, 3)), "face_colors": np.zeros((2, 3))}, ArgumentError, "not both"),
        ({"colors": np.full((4, 3), np.nan)}, ModelError, "colour 0 is not finite"),
        ({"colors": np.full((4, 3), 255.0)}, ModelError, "colour 0 is not from 0 to 1, as linear light is"),
        ({"factor": (np.inf, 1, 1)}, ArgumentError, "factor must be finite numbers"),
        ({"image": random_image(2, 2)}, ArgumentError, "needs uv"),
        ({"image": random_image(2, 2), "uv": np.zeros((3, 2))}, ArgumentError, "uv must be numbers of shape"),
        ({"image": random_image(2, 2), "uv": np.full((4, 2), np.nan)}, ModelError, "coordinates"),
        ({"image": random_image(2, 2), "uv": SQUARE_UV, "wrap": "fold"}, ArgumentError, "unknown wrap"),
        ({"image": random_image(2, 2), "uv": SQUARE_UV, "filter": "sharp"}, ArgumentError, "unknown filter"),
        ({"image": np.zeros((2, 2), bool), "uv": SQUARE_UV}, ImageError, "uint8 or uint16"),
        ({"image": random_image(2, 2), "uv": SQUARE_UV, "wrap": ("clamp",)}, ArgumentError, "wrap must be"),
        ({"rest": np.zeros((3, 3))}, ModelError, "3 rest positions for 4 vertices"),
        ({"rest": [[0, 0, 0], [1]]}, ModelError, r"rest positions must be numbers of shape \(n, 3\)"),
        ({"rest": np.full((4, 3), np.nan)}, ModelError, "rest positions are not all finite"),
        ({"alpha": "glass"}, ArgumentError, "unknown alpha"),
        ({"factor": (1, 1)}, ArgumentError, "factor must be finite numbers of shape"),
    ],
)
def test_what_does_not_fit_the_surface_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        square(**options)


def test_lookups_of_what_is_not_there_are_refused():
    surface = square()
    samples = surface.scatter(3)
    with pytest.raises(ArgumentError, match="unknown channel 'metal'; there are: base_color"):
        surface.evaluate(samples, "metal")
    for width in (-1.0, np.nan, np.inf):
        with pytest.raises(ArgumentError, match="width must be from 0 on"):
            surface.evaluate(samples, width=width)
    for number in (-1, 2):
        other = samples._replace(triangles=np.full(3, number))
        with pytest.raises(ArgumentError, match="triangles that surface does not have"):
            surface.evaluate(other)
    with pytest.raises(ArgumentError, match="must be a whole number from 0 to 4294967296, not -1"):
        surface.scatter(-1)
    for far in (np.nan, np.inf, 1e300):
        with pytest.raises(ArgumentError, match="barycentric coordinates that are not below 1e"):
            surface.evaluate(samples._replace(barycentric=np.full((3, 3), far)))
    with pytest.raises(ModelError, match="3 rest positions for 4 vertices"):
        surface.with_rest(np.zeros((3, 3)))


@pytest.mark.parametrize("size", [1e-10, 1e29])
def test_surfaces_may_be_tiny_and_huge(size):
    image = random_image(8, 8)
    usual = square(image=image, uv=SQUARE_UV)
    scaled = Surface.from_arrays(SQUARE * size, SQUARE_TRIANGLES, image=image, uv=SQUARE_UV)
    samples = usual.scatter(20)
    for width in (0.0, 0.2):
        expected = usual.evaluate(samples, width=width)
        np.testing.assert_allclose(scaled.evaluate(samples, width=width * size), expected, atol=1e-6)
    with pytest.raises(ModelError, match=r"not all finite \(and below 1e\+30\)"):
        Surface.from_arrays(SQUARE * 1e31, SQUARE_TRIANGLES)


def test_points_of_a_posed_surface_come_with_the_normals_of_its_rest_triangles():
    standing = np.array(SQUARE) @ [[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]
    flat = square().scatter(20)
    np.testing.assert_array_equal(flat.rest_normals, flat.normals)
    posed = square().with_rest(standing).scatter(20)
    np.testing.assert_array_equal(posed.normals, flat.normals)
    a, b, c = standing[square().triangles[0]]
    expected = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    np.testing.assert_allclose(posed.rest_normals, np.tile(expected, (20, 1)), atol=1e-12)
    without_area = square().with_rest(np.zeros((4, 3))).scatter(5)
    assert not without_area.rest_normals.any()
