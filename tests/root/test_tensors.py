"""Tensors of other libraries are taken where arrays are, and one on a GPU is refused in one line."""

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from tests.make.refusal import refused
from tests.make.solids import cube, torn

CORNERS, FACES = torn(cube((0, 0, 0)))


class ByDlpack:
    """A tensor that is read by ``__dlpack__`` alone."""

    def __init__(self, array):
        self._array = np.ascontiguousarray(array)

    def __dlpack__(self, **options):
        return self._array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


class ByArray:
    """A tensor that is read by ``__array__`` alone."""

    def __init__(self, array):
        self._array = np.asarray(array)

    def __array__(self, dtype=None, copy=None):
        return np.array(self._array, dtype)


class OnGpu(ByDlpack):
    """A tensor as torch has it on a GPU, which has both."""

    def __dlpack_device__(self):
        return 2, 0

    def __array__(self, dtype=None, copy=None):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() ...\nfirst.")


class OnGpuByDlpack(ByDlpack):
    """A tensor on a GPU that has ``__dlpack__`` alone."""

    def __dlpack_device__(self):
        return 2, 0

    def __dlpack__(self, **options):
        raise BufferError("cannot be exported to the CPU")


@pytest.mark.parametrize("tensor", [np.asarray, ByDlpack, ByArray])
def test_tensors_give_what_arrays_give(tensor):
    codes = np.random.default_rng(0).integers(0, 256, (len(CORNERS), 3), np.uint8)
    plain = octex.Surface.from_arrays(CORNERS, FACES, colors=codes)
    surface = octex.Surface.from_arrays(tensor(CORNERS), tensor(FACES), colors=tensor(codes))
    texture, expected = octex.convert(surface, 3), octex.convert(plain, 3)
    points = CORNERS[:9] * 0.9
    np.testing.assert_array_equal(texture.sample(tensor(points)), expected.sample(points))
    widths = np.full(9, 0.1, np.float32)
    np.testing.assert_array_equal(
        texture.sample(tensor(points), width=tensor(widths)), expected.sample(points, width=widths)
    )
    np.testing.assert_array_equal(texture.contains(tensor(points)), expected.contains(points))
    np.testing.assert_array_equal(
        surface.with_rest(tensor(CORNERS * 2)).part(tensor(np.arange(4))).rest,
        plain.with_rest(CORNERS * 2).part(np.arange(4)).rest,
    )
    coords = np.argwhere(np.ones((2, 2, 2)))
    voxels = octex.Voxels(tensor(coords), {"base_color": tensor(codes[:8])}, origin=tensor(np.zeros(3)))
    np.testing.assert_array_equal(voxels.values["base_color"].rows, codes[:8])
    cloud = octex.PointCloud(tensor(CORNERS), tensor(codes))
    np.testing.assert_array_equal(cloud.points, CORNERS)
    shaded = surface.with_sources({"base_color": lambda rest: tensor(np.clip(rest, 0, 1))})
    samples = shaded.scatter(9)
    np.testing.assert_allclose(shaded.evaluate(samples), np.clip(samples.rest, 0, 1), atol=1e-6)
    image = np.random.default_rng(1).integers(0, 256, (4, 4, 3), np.uint8)
    uv = CORNERS[:, :2]
    mapped = octex.Surface.from_arrays(CORNERS, FACES, uv=tensor(uv), image=tensor(image))
    reference = octex.Surface.from_arrays(CORNERS, FACES, uv=uv, image=image)
    np.testing.assert_array_equal(mapped.evaluate(samples), reference.evaluate(samples))
    camera, other = (
        octex.Camera.fitted(kind(CORNERS), (0, 0, 1), size=(8, 8)) for kind in (tensor, np.asarray)
    )
    np.testing.assert_array_equal(camera.matrix, other.matrix)


@pytest.mark.parametrize("tensor", [OnGpu, OnGpuByDlpack])
def test_a_tensor_on_a_gpu_is_refused_in_one_line(tensor):
    surface = octex.Surface.from_arrays(CORNERS, FACES)
    texture = octex.convert(surface, 2)
    calls = (
        lambda: octex.Surface.from_arrays(tensor(CORNERS), FACES),
        lambda: octex.Surface.from_arrays(CORNERS, tensor(FACES)),
        lambda: octex.Voxels(tensor(np.zeros((1, 3), int)), {"x": [1.0]}),
        lambda: octex.PointCloud(tensor(CORNERS), CORNERS),
        lambda: texture.sample(tensor(CORNERS)),
        lambda: texture.contains(tensor(CORNERS)),
        lambda: surface.with_rest(tensor(CORNERS)),
    )
    for call in calls:
        with refused(ArgumentError, r"main memory, .* like tensor\.detach\(\)\.cpu\(\)"):
            call()
