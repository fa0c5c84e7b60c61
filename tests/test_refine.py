"""Cameras that are a little off find back to where their pictures agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import PIL.Image
import pytest

import octex
from octex.channels import encode
from octex.cli.paint import main
from octex.painting.refine import _moved
from tests.conftest import needs_jit
from tests.painted import above, picture_of
from tests.test_agreement import ring

Array = npt.NDArray[Any]
pytestmark = needs_jit


def off(camera: octex.Camera, number: int, points: Array) -> octex.Camera:
    return _moved(camera, np.random.default_rng(number).normal(0, 0.7, 7), points)


def shift(camera: octex.Camera, truth: octex.Camera, points: Array) -> float:
    apart = camera.project(points)[0] - truth.project(points)[0]
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def test_cameras_find_back_whatever_the_order_and_the_exposures() -> None:
    surface, cameras, _ = ring(6, 128)
    images = [picture_of(surface, camera) for camera in cameras]
    points = surface.scatter(500).points
    moved = [off(camera, n, points) if n else camera for n, camera in enumerate(cameras)]
    light = np.random.default_rng(9).uniform(0.8, 1.2, 6)
    light[0] = 1
    shots = [
        octex.Projection(image * np.array([gain, gain, gain, 1], np.float32), camera)
        for image, camera, gain in zip(images, moved, light, strict=True)
    ]
    found = octex.refine_cameras(surface, shots, reference=0)
    before = [shift(*each, points) for each in zip(moved, cameras, strict=True)]
    after = [shift(*each, points) for each in zip(found, cameras, strict=True)]
    assert np.array_equal(found[0].world_to_camera, cameras[0].world_to_camera)
    assert np.mean(before[1:]) > 1
    assert max(after) < 0.25
    order = [3, 1, 0, 5, 4, 2]
    again = octex.refine_cameras(surface, [shots[n] for n in order], reference=2)
    for n, camera in zip(order, again, strict=True):
        assert np.array_equal(camera.world_to_camera, found[n].world_to_camera)
        assert np.array_equal(camera.K, found[n].K)


def test_one_picture_has_nothing_to_agree_with() -> None:
    surface, cameras, images = ring(1, 16)
    assert octex.refine_cameras(surface, octex.Projection(images[0], cameras[0])) == cameras


@pytest.mark.parametrize("is_parallel", [False, True])
def test_a_number_of_a_camera_is_about_a_pixel(is_parallel: bool) -> None:
    camera = above(3.0, 64)
    if is_parallel:
        camera = octex.Camera(64, 64, np.diag([50.0, 50, 1]), camera.world_to_camera, "orthographic")
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    for number in range(7):
        moved = _moved(camera, np.eye(7)[number], points)
        if number not in (2, 5):  # about the axis of the view and along it, where less changes
            assert 0.2 < shift(moved, camera, points) < 3
    assert np.array_equal(_moved(camera, np.zeros(7), points).K, camera.K)


def test_refined_cameras_are_kept_in_a_file(tmp_path: Path) -> None:
    surface, cameras, images = ring(4, 64)
    (tmp_path / "ball.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in surface.vertices.tolist())
        + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in surface.triangles.tolist()),
        encoding="utf-8",
    )
    points = surface.scatter(300).points
    names = [f"{n}.png" for n in range(4)]
    for name, image in zip(names, images, strict=True):
        PIL.Image.fromarray(encode(image, "uint8", "srgb")).save(tmp_path / name)
    moved = {
        name: off(camera, n, points) for n, (name, camera) in enumerate(zip(names, cameras, strict=True))
    }
    octex.write_cameras(tmp_path / "cameras.json", moved)
    words = [
        "--camera",
        tmp_path / "cameras.json",
        "--out",
        tmp_path / "out.octex",
        "--max-depth",
        4,
        "--quiet",
    ]
    words += ["--refine-cameras", "--save-cameras", tmp_path / "refined.json"]
    files = [tmp_path / "ball.obj", *(tmp_path / name for name in names)]
    assert main([str(word) for word in [*files, *words]]) == 0
    frames = octex.read_cameras(tmp_path / "refined.json")
    assert [frame.name for frame in frames] == names
    assert not all(
        np.array_equal(frame.camera().world_to_camera, moved[frame.name].world_to_camera) for frame in frames
    )


def test_what_makes_no_sense_without_refining_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words, complaint in (
        ("--save-cameras c.json", "--save-cameras has no meaning without --refine-cameras"),
        ("--reference a.png", "--reference has no meaning without --balance or --refine-cameras"),
    ):
        assert main(f"m.obj a.png --camera c.json --out o.octex {words}".split()) != 0
        assert complaint in capsys.readouterr().err
