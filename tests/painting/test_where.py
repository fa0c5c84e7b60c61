"""Where images are painted: on what is hidden, and on some triangles only."""

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.tree.layout import SPLIT
from tests.conftest import needs_jit
from tests.make.painted import above, ball, centres, codes, image_of, one_color, plain, square, together
from tests.make.same import assert_same
from tests.make.small_surfaces import sheet

RED = (0.8, 0.1, 0.1)


def sheets():
    """Two squares, of which the upper one hides the middle of the other."""
    surface = plain(together(square(0.3, 0.5), square(-0.3, 1.0)))
    return octex.convert(surface, depth=5), surface


def disc(size=64, radius=20.0):
    y, x = np.mgrid[:size, :size] + 0.5
    image = np.zeros((size, size, 4), np.float32)
    image[..., :3] = RED
    image[..., 3] = np.hypot(x - size / 2, y - size / 2) < radius
    return image


def painted_points(texture, height, side):
    """Which points of a square are painted, and how many pixels they are inside of the disc; not its rim."""
    line = np.linspace(-0.45 * side, 0.45 * side, 31)
    x, y = np.meshgrid(line, line)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    inside = 20.0 - 128 * np.hypot(x, y).ravel() / (2.0 - height)
    is_red = np.abs(texture.sample(points) - RED).max(axis=1) < 0.05
    return is_red[np.abs(inside) > 4], inside[np.abs(inside) > 4]


@needs_jit
@pytest.mark.parametrize("in_session", [False, True])
def test_what_is_hidden_is_painted_if_asked_for_as_if_it_were_alone(in_session):
    texture, surface = sheets()
    shown = octex.Projection(disc(), above(2.0))
    if in_session:
        painter = octex.Painter(texture, surface)
        painter.paint(shown)
        painter.undo()
        painter.paint(shown, hidden=True)
        made = painter.texture()
        assert_same(made, octex.paint(texture, surface, shown, hidden=True))
    else:
        made = octex.paint(texture, surface, shown, hidden=True)
    for height, side in ((0.3, 0.5), (-0.3, 1.0)):
        is_painted, inside = painted_points(made, height, side)
        assert is_painted.mean() > 0.4
        assert (is_painted == (inside > 0)).all()
    is_painted, _ = painted_points(octex.paint(texture, surface, shown), -0.3, 1.0)
    assert not is_painted.any()


@needs_jit
@pytest.mark.parametrize("hidden", [False, True])
def test_only_triangles_of_a_region_are_painted_and_others_still_hide(hidden):
    texture, surface = sheets()
    shown = octex.Projection(disc(), above(2.0))
    for part, height, side in ((0, 0.3, 0.5), (1, -0.3, 1.0)):
        region = surface.parts == part
        made = octex.paint(texture, surface, shown, region=region, hidden=hidden)
        assert_same(made, octex.paint(texture, surface, shown, region=np.flatnonzero(region), hidden=hidden))
        is_painted, inside = painted_points(made, height, side)
        assert (is_painted == ((inside > 0) & (hidden or part == 0))).all()
        others, _ = painted_points(made, *((-0.3, 1.0) if part == 0 else (0.3, 0.5)))
        assert not others.any()
    everything = octex.paint(texture, surface, shown, region=np.ones(len(surface.triangles), bool))
    assert_same(everything, octex.paint(texture, surface, shown))
    assert octex.paint(texture, surface, shown, region=np.empty(0, int)) is texture


@pytest.mark.parametrize(
    "region", [[True], [-1], [10**6], [0.5], "all", [[0], [1, 2]], np.zeros((2, 2), int)]
)
def test_a_region_of_other_things_than_triangles_is_refused(region):
    texture, surface = sheets()
    with pytest.raises(ArgumentError, match="region must be triangles of the surface: numbers from 0 to 63"):
        octex.paint(texture, surface, octex.Projection(disc(), above(2.0)), region=region)


@pytest.mark.parametrize("more", [{"balance": "gain"}, {"pictures": "best"}, {"pictures": "robust"}])
def test_hidden_surface_is_not_painted_with_images_that_are_compared(more):
    texture, surface = sheets()
    shown = [octex.Projection(disc(), above(2.0))] * 3
    with pytest.raises(ArgumentError, match="hidden cannot be used with balance, or with images that"):
        octex.paint(texture, surface, shown, hidden=True, **more)
    with pytest.raises(ArgumentError, match="hidden"):
        octex.paint(texture, surface, shown, hidden=2)


@needs_jit
def test_several_images_of_hidden_surface_are_averaged():
    texture, surface = sheets()
    shown = [octex.Projection(disc(), above(2.0))] * 3
    one = octex.paint(texture, surface, shown, hidden=True, pictures="average")
    assert_same(octex.paint(texture, surface, shown, hidden=True), one)


@needs_jit
@pytest.mark.parametrize(
    ("toward", "hidden"),
    [
        ((0.0, 0.0, -1.0), False),
        ((0.8, -0.1, -0.5), False),
        ((1.9, -0.1, -0.5), False),
        ((0.8, -0.1, -0.5), True),
    ],
)
def test_an_image_of_the_inside_of_one_large_triangle_is_painted_in_its_detail(toward, hidden):
    wall = plain(square(0.0, 10.0))
    texture = octex.convert(wall, depth=4)
    position, size = np.array([3.0, -2.0, 0.5]), 96
    back = -np.array(toward) / np.linalg.norm(toward)
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(back, right), back, position])
    K = np.array([[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]])
    camera = octex.Camera.pinhole((size, size), K=K, pose=pose, convention="opengl")

    def waves(pixels):
        x, y = pixels[..., 0], pixels[..., 1]
        return 0.5 + 0.4 * np.stack([np.sin(x / 8), np.cos(y / 6), np.sin((x + y) / 11)], axis=-1)

    pixels = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), axis=-1)
    shown = octex.Projection(waves(pixels).astype(np.float32), camera)
    painted = octex.paint(texture, wall, shown, max_angle=89, hidden=hidden)
    points = np.column_stack([*np.random.default_rng(0).uniform(-5, 5, (2, 200_000)), np.zeros(200_000)])
    seen, depth = camera.project(points)
    inside = (depth > 0) & (depth < 1.5) & (seen > 4).all(axis=1) & (seen < size - 4).all(axis=1)
    assert inside.sum() > 100
    error = painted.sample(points[inside]) - waves(seen[inside])
    assert np.sqrt((error**2).mean()) < 0.01


def test_each_side_of_something_thin_is_painted_for_itself():
    surface = sheet(np.eye(3), 0.004)
    texture = octex.convert(surface, 5)
    size = float(np.ptp(surface.bounds, axis=0).max())
    camera = above(3.0, 96, 96 * 3 / size * 0.9)
    blue = octex.paint(texture, surface, octex.Projection(one_color(camera, (0, 0, 1)), camera))
    blue.validate()
    points = surface.scatter(3000)
    inner = np.abs(points.rest[:, :2]).max(axis=1) < 0.4 * size
    front = inner & (points.normals[:, 2] > 0.9)
    back = inner & (points.normals[:, 2] < -0.9)
    seen = blue.sample(points.rest, normals=points.normals)
    before = texture.sample(points.rest, normals=points.normals)
    np.testing.assert_allclose(seen[front], np.tile([0, 0, 1.0], (front.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(seen[back], before[back], atol=0.01)
    assert (blue.tree.arrays.flags & SPLIT != 0).any()


def assert_painted_back(surface, direction, most):
    """An image that is painted from its own camera is what that sees, up to a root mean square in codes."""
    camera = octex.Camera.fitted(surface.vertices, direction, size=(128, 128))
    image = image_of(surface, camera)
    texture = octex.paint(None, surface, octex.Projection(image, camera), max_angle=90)
    texture.validate()
    pixels, rest, normals = centres(surface, camera)
    error = codes(texture.sample(rest, normals=normals)) - codes(image.reshape(-1, 4)[pixels, :3])
    assert np.sqrt((error**2).mean()) < most
    return texture


def test_an_image_painted_back_from_its_own_camera_is_what_is_seen():
    assert set(assert_painted_back(ball(), (0.3, 0.4, 1), 1.0).channels) == {"base_color"}


def waved_at_rest(posed, rest):
    colors = 0.5 + 0.4 * np.sin(3 * rest.vertices)
    return octex.Surface.from_arrays(posed, rest.triangles, colors=colors, rest=rest.vertices)


def test_paint_on_a_posed_model_lands_at_rest():
    rest = ball(16)
    surface = waved_at_rest(rest.vertices * [1.0, 1.6, 0.7] + [3.0, -1.0, 2.0], rest)
    texture = assert_painted_back(surface, (0.2, 0.3, 1), 1.5)
    assert texture.bounds.tolist() == rest.bounds.tolist()


def test_a_subdivided_cage_is_painted_at_its_hull(models):
    folder = models / "opensubdiv-cages"
    hull = octex.load_surface(folder / "catmark_cube_creases0_level4.obj")
    loaded = octex.load_surface(folder / "catmark_cube_level4.obj", rest=hull.vertices)
    assert np.abs(loaded.rest - loaded.vertices).max() > 0.01
    assert_painted_back(waved_at_rest(loaded.vertices, hull), (0.5, 0.4, 1), 2.0)


def test_a_small_stroke_inside_a_large_triangle_is_painted():
    surface = plain(square(0.0, 2.0))
    texture = octex.convert(surface, depth=5)
    camera = octex.Camera.fitted(
        [[0.4, 0.1, 0.0], [0.6, 0.3, 0.0]], (0.0, 0.0, 1.0), size=(640, 640), margin=0.0
    )
    image = np.zeros((640, 640, 4), np.uint8)
    image[318:322, 318:322] = (200, 30, 30, 255)
    made = octex.paint(texture, surface, octex.Projection(image, camera))
    assert np.abs(made.sample([[0.5, 0.2, 0.0]]) - texture.sample([[0.5, 0.2, 0.0]])).max() > 0.3


def test_a_stroke_that_meets_only_surface_that_faces_away_is_no_change():
    x, z = np.cos(1.55), np.sin(1.55)  # a wall that is seen from behind, and whose corners' normals lean
    corners = [[-3, -1, 0], [-3, 1, 0], [0, -1, 0], [0, 1, 0], [x, -1, z], [x, 1, z]]
    surface = octex.Surface.from_arrays(corners, [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]])
    near = 0.15 * np.array([x, 0, z]) + 0.05 * np.concatenate([np.eye(3), -np.eye(3)])
    camera = octex.Camera.fitted(near, (1.0, 0.0, 0.3), size=(64, 64), margin=0.0)
    seen = octex.Projection(disc(radius=8.0), camera)
    painter = octex.Painter(octex.convert(surface, depth=5), surface)
    assert painter.paint(seen, max_angle=85) == ()
    assert painter.paint(seen, max_angle=85, back_faces=True) != ()
