"""Photographs that cannot be right are found: of another scene, turned, twice, damaged, beside the model."""

import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from octex.cameras.camera import Camera
from octex.cameras.files import write_cameras
from octex.channels import linear_to_srgb
from octex.painting.image import Projection
from octex.photos.misfits import LightSamples, better_placed, misfits
from octex.source.surface import Surface
from tests.make.command import OUT
from tests.make.fixtures import obj_lines
from tests.make.painted import ball, halved_quads

SIZE = 96


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """Compare small images at a third of the points."""
    monkeypatch.setattr("octex.photos.misfits._POINTS", 2500)


def relief():
    """Vertices and triangles of a hill that faces +z; no turn and no mirroring brings it onto itself."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-1, 1, 33)] * 2))
    z = 0.3 * np.exp(-3 * ((x - 0.3) ** 2 + (y - 0.1) ** 2))
    return np.column_stack([x, y, z]), halved_quads(33, 33)


def look(number):
    toward = 0.4 * np.cos(number), 0.4 * np.sin(number), 1.0
    return Camera.fitted(relief()[0], toward, size=(SIZE, SIZE))


def rays(camera):
    rows, columns = np.indices((camera.height, camera.width)) + 0.5
    return camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))


def waves(points, seed, pitch, count):
    random = np.random.default_rng(seed)
    lengths, phases = random.normal(0, pitch, (count, points.shape[1])), random.uniform(0, 6, count)
    return np.sin(points @ lengths.T + phases).mean(axis=1)


def coded(light, camera):
    """A grey image of 8-bit codes."""
    codes = linear_to_srgb(np.clip(light, 0, 1)) * 255
    return np.repeat(codes.reshape(camera.height, camera.width, 1), 3, axis=2).astype(np.uint8)


def image(camera, seed=0, gain=1.0, slope=0.0):
    """What a camera sees of waves over the plane z = 0, near enough to the relief's."""
    origins, directions = rays(camera)
    points = (origins - directions * (origins[:, 2:] / directions[:, 2:]))[:, :2]
    light = 0.5 + (0.8 - slope) * waves(points, seed, 4, 6) + slope * points[:, 1]
    return coded(light * gain, camera)


def ring(count=6):
    cameras = [look(number) for number in range(count)]
    return [Projection(image(each, gain=0.6 + 0.1 * n), each) for n, each in enumerate(cameras)]


def found(projections, surface=None):
    with ThreadPoolExecutor(2) as pool:
        return misfits(Surface.from_arrays(*relief()) if surface is None else surface, projections, pool)


def test_an_image_agrees_as_it_correlates_with_the_median_of_the_others():
    random = np.random.default_rng(0)
    for count, share in ((1, 0.8), (2, 0.8), (3, 0.5), (8, 0.3), (41, 0.8)):
        light = random.normal(size=1000) + random.normal(0, 0.5, (count, 1000))
        light = light.round(1).astype(np.float32)  # equal values too
        seen = random.random(light.shape) < share
        samples = LightSamples(*(np.empty(0),) * 3, light, seen)
        expected = []
        for number in range(count):
            others = np.where(seen, light, np.nan)
            others[number] = np.nan
            at = np.flatnonzero(seen[number] & (np.isfinite(others).sum(axis=0) >= 2))
            middle = [np.nanmedian(others[:, point]) for point in at]
            expected.append(np.corrcoef(light[number, at], middle)[0, 1] if at.size >= 200 else np.nan)
        np.testing.assert_allclose(samples.agreements(), expected, rtol=1e-12)
        other = random.normal(size=1000).astype(np.float32)  # the same image turned
        again = samples._replace(light=np.vstack([other, light[1:]]))
        np.testing.assert_array_equal(samples.agreement(0, other), again.agreements()[0])


def test_images_of_different_exposures_that_agree_are_all_painted():
    assert found(ring()) == ({}, None)


@pytest.mark.parametrize("slope", [0.0, 0.4])  # as light above as the others
def test_an_image_of_another_scene_is_found(slope):
    given = [replace(each, image=image(look(n), slope=slope)) for n, each in enumerate(ring())]
    given[2] = replace(given[2], image=image(look(2), seed=7, slope=slope))
    reasons, better = found(given)
    assert (list(reasons), better) == ([2], None)
    assert "it differs from all others there" in reasons[2]


def test_two_images_of_other_scenes_are_found():
    given = ring()
    for number, seed in ((2, 7), (5, 8)):
        given[number] = replace(given[number], image=image(look(number), seed))
    assert sorted(found(given)[0]) == [2, 5]


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_a_turned_image_is_found_and_the_turn_back_is_told(turn):
    given = ring()
    # Clockwise turns bring it back, as viewers of images count them.
    given[1] = replace(given[1], image=np.ascontiguousarray(np.rot90(image(look(1)), turn // 90)))
    reasons, _ = found(given)
    assert list(reasons) == [1]
    assert f"only when turned by {turn} degrees clockwise" in reasons[1]


def test_an_image_that_is_given_twice_and_one_beside_the_model_are_found():
    given = ring()
    away = Camera.fitted(np.add(relief()[0], [0, 0, 99]), (0, 0, -1), size=(SIZE, SIZE))
    reasons, _ = found([*given, given[3], replace(given[0], camera=away)])
    assert reasons == {6: "the same image and camera as the image", 7: "its camera sees nothing of the model"}


@pytest.mark.parametrize("wrong", [1, 4])
def test_of_an_image_with_two_cameras_the_one_that_agrees_less_is_found(wrong):
    given = ring()
    beside = look(3)
    view = beside.world_to_camera.copy()
    view[0, 3] += 0.05  # near enough to agree in part
    given[wrong] = replace(given[3], camera=replace(beside, world_to_camera=view))
    reasons, better = found(given)
    assert reasons == {wrong: "the same image as the image, whose camera it fits better"}
    assert better is None


def test_an_image_in_anothers_place_is_told_to_be_that_one_again():
    given = ring()
    view = look(1).world_to_camera.copy()
    view[:2, 3] += 0.6  # shows other waves
    given[1] = replace(given[4], camera=replace(look(1), world_to_camera=view))
    assert found(given)[0] == {1: "the same image as the image, whose camera it fits better"}


def test_a_mesh_on_which_no_images_agree_is_told():
    vertices, triangles = relief()
    reasons, better = found(ring(), Surface.from_arrays(np.add(vertices, [0, 0, 1.5]), triangles))
    assert reasons == {}
    assert better is not None
    assert better.startswith("images show different things at the same points of it; give the mesh")


def test_images_of_one_colour_tell_nothing():
    given = [replace(each, image=np.full((SIZE, SIZE, 3), 40 * n, np.uint8)) for n, each in enumerate(ring())]
    assert found(given) == ({}, None)


def test_the_factor_and_the_turn_of_a_mesh_are_told():
    vertices, triangles = relief()
    lying = 0.001 * vertices[:, [0, 2, 1]] * [1, 1, -1]  # y is up, and it is in metres
    reasons, better = found(ring(), Surface.from_arrays(lying, triangles))
    assert reasons == {}
    turned = "images agree if the mesh is scaled by 1000 and turned so that (x, y, z) becomes (x, -z, y)"
    assert better == f"{turned}; change that, and paint again"
    steep = [
        Camera.fitted(vertices, (0.1 * np.cos(n), 0.1 * np.sin(n), 1.0), size=(SIZE, SIZE)) for n in range(6)
    ]
    lying = vertices[:, [0, 2, 1]] * [1, 0.1, -1]  # nearly flat, and so steep that images share nothing
    given = [Projection(image(each), each) for each in steep]
    reasons, better = found(given, Surface.from_arrays(lying, triangles))
    assert reasons == {}
    assert better is not None  # what is flat may also be turned about its normal
    assert re.match(r"images agree if the mesh is turned so that \(x, y, z\) becomes \([^)]*, y\);", better)
    far = Surface.from_arrays(np.add(vertices, [0, 0, 1e6]), triangles)
    assert found(ring(), far) == ({}, None)


def test_no_change_is_told_with_which_the_images_differ():
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])  # each camera looks the other way, and shows its own scene
    cameras = [replace(each.camera, world_to_camera=behind @ each.camera.world_to_camera) for each in ring()]
    scenes = [image(each.camera, seed) for seed, each in enumerate(ring())]
    assert found([Projection(*each) for each in zip(scenes, cameras, strict=True)]) == ({}, None)


AXES = np.array([1.0, 0.85, 0.7])


def egg_seen(camera):
    """What a camera sees of waves on an ellipsoid with these half axes; grey beside it."""
    origins, directions = (each / AXES for each in rays(camera))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = (origins * directions).sum(axis=1)
    root = along**2 - (origins**2).sum(axis=1) + 1.0
    points = origins - directions * (along + np.sqrt(np.maximum(root, 0.0)))[:, None]
    return coded(np.where(root > 0.0, 0.5 + 0.8 * waves(points, 3, 6, 8), 0.4), camera)


def egg_ring():
    """Ten images all around an ellipsoid, of which none shows more than the half."""
    angles = np.arange(10) * 2 * np.pi / 10
    heights = 0.4 * (-1.0) ** np.arange(10)
    toward = np.column_stack([np.cos(angles), heights, np.sin(angles)])
    cameras = [Camera.fitted(AXES * ball().vertices, each, size=(SIZE, SIZE)) for each in toward]
    return [Projection(egg_seen(each), each) for each in cameras]


@pytest.mark.parametrize("change", ["factor", "turn", "reversed"])
def test_what_is_wrong_is_told_although_every_turn_of_an_egg_fills_the_images_alike(change):
    vertices, triangles = AXES * ball().vertices, ball().triangles
    given = egg_ring()
    if change == "factor":
        vertices, told = 1000.0 * vertices, "the mesh is scaled by 0.001"
    elif change == "turn":
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
        told = "the mesh is turned so that (x, y, z) becomes (x, z, -y)"
    else:
        signs = np.diag([1.0, -1.0, -1.0, 1.0])
        cameras = [
            replace(each.camera, world_to_camera=signs @ each.camera.world_to_camera) for each in given
        ]
        given = [replace(each, camera=camera) for each, camera in zip(given, cameras, strict=True)]
        told = "the cameras' y and z axes are reversed (OpenCV or OpenGL)"
    reasons, better = found(given, Surface.from_arrays(vertices, triangles))
    assert reasons == {}
    assert better == f"images agree if {told}; change that, and paint again"


@pytest.mark.parametrize(("scale", "aside", "step"), [(217.0, 0.0, 1), (1.0, 1.4, 3)])
def test_a_mesh_around_the_cameras_or_beside_what_images_of_separate_sides_show_is_told(scale, aside, step):
    vertices = scale * AXES * ball().vertices + [0, aside, 0]
    reasons, better = found(egg_ring()[::step], Surface.from_arrays(vertices, ball().triangles))
    assert reasons == {}
    assert better is not None
    assert better.startswith("they see little of it, and share nothing")


def test_a_change_with_which_images_hardly_agree_is_not_told(monkeypatch):
    monkeypatch.setattr(LightSamples, "agreements", lambda _: np.full(6, 0.5))
    with ThreadPoolExecutor(2) as pool:
        assert better_placed(Surface.from_arrays(*relief()), ring(), 0.0, pool) is None


def test_the_command_paints_the_others_and_names_what_it_leaves_out(tmp_path, cli):
    vertices, triangles = relief()
    (tmp_path / "hill.obj").write_text(obj_lines(vertices, triangles))
    names = [f"{number}.png" for number in range(7)]
    for number, name in enumerate(names):
        seed = 9 if number == 3 else 0
        PIL.Image.fromarray(image(look(number), seed)).save(tmp_path / name)
    write_cameras(tmp_path / "cameras.json", {name: look(number) for number, name in enumerate(names)})
    whole = (tmp_path / "4.png").read_bytes()
    (tmp_path / "4.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "5.png").write_bytes(b"nothing")
    images = [str(tmp_path / name) for name in names]
    words = ["--camera", str(tmp_path / "cameras.json"), OUT, str(tmp_path / "out.octex"), "--json"]
    assert cli.run(tmp_path / "hill.obj", *images, *words, "--max-depth", "6") == 0
    told, said = cli.said()
    made = json.loads(told)
    assert made["painted"] == ["0.png", "1.png", "2.png", "6.png"]
    assert sorted(made["skipped"]) == ["3.png", "4.png", "5.png"]
    for name, reason in (("3", "it differs from all others"), ("4", "4.png"), ("5", "5.png")):
        assert f"{images[int(name)]} is left out: " in said
        assert reason in said
