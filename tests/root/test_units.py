"""What octex makes does not depend on the units of a model: powers of two change no bit."""

from dataclasses import replace

import numpy as np
import pytest

import octex
from octex.cameras.camera import Camera
from tests.conftest import needs_jit
from tests.make.painted import ball, image_of
from tests.make.same import arrays_of

pytestmark = needs_jit

#: Of a ball of radius 1: of a tenth of a millimetre in metres, and of a mountain in millimetres.
UNITS = 2.0**-13, 2.0**22


def shots(surface, count, aside=0.0):
    """Images from around a surface, whose cameras are said to be ``aside``, in the model's units."""
    found = []
    for angle in np.arange(count) * 2 * np.pi / max(count, 5):
        camera = Camera.fitted(surface.vertices, (np.cos(angle), 0.3, np.sin(angle)), size=(40, 40))
        moved = camera.world_to_camera.copy()
        moved[0, 3] += aside * np.cos(3 * angle)
        image = image_of(surface, camera)
        found.append(octex.Projection(image, replace(camera, world_to_camera=moved)))
    return found


def painted(surface, count=5, **options):
    return octex.paint(None, surface, shots(surface, count), max_depth=4, **options)


WORKS = {
    "convert": lambda surface, _: octex.convert(surface, 4),
    "cell": lambda surface, unit: octex.convert(surface, cell=0.1 * unit),
    "max_error": lambda surface, _: octex.convert(surface, 4, max_error=2),
    "transfer": lambda surface, unit: octex.convert(
        ball(9, 1.01 * unit).with_sources({"base_color": octex.Transfer(surface, distance=0.05 * unit)}), 4
    ),
    "average": lambda surface, _: painted(surface, pictures="average"),
    "robust": lambda surface, _: painted(surface, pictures="robust"),
    "best": lambda surface, _: painted(surface, pictures="best"),
    "balance": lambda surface, _: painted(surface, balance="full"),
    "holes": lambda surface, _: painted(surface, 2),
    "fill": lambda surface, unit: octex.fill(
        octex.convert(surface, 4), surface, octex.Sphere((0.0, unit, 0.0), 0.6 * unit), (1, 0, 0)
    ),
    "blur": lambda surface, unit: octex.blur(octex.convert(surface, 4), 0.1 * unit),
}


@pytest.mark.parametrize("work", WORKS)
def test_textures_are_the_same_in_all_units(work):
    expected, *found = (WORKS[work](ball(12, unit), unit) for unit in (1.0, *UNITS))
    for unit, texture in zip(UNITS, found, strict=True):
        assert texture.placement.size == expected.placement.size * unit
        assert texture.placement.origin == tuple(at * unit for at in expected.placement.origin)
        for own, other in zip(arrays_of(texture), arrays_of(expected), strict=True):
            assert np.array_equal(own, other * unit if own is texture.bounds else other)


@pytest.mark.usefixtures("few_points")
def test_cameras_are_refined_alike_in_all_units():
    found = []
    for unit in (1.0, *UNITS):
        refined = octex.refine_cameras(
            ball(12, unit), shots(ball(12, unit), 5, aside=0.02 * unit), reference=0
        )
        matrices = np.stack([each.world_to_camera for each in refined])
        matrices[:, :3, 3] /= unit
        found.append(matrices)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-6)
