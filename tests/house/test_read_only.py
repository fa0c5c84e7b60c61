"""Nobody changes what textures, surfaces, clouds and cameras hold; kernels take read-only arrays as any."""

import sys

import numpy as np
import pytest

import octex
from octex.jit import kernel, unlocked
from octex.jit.decorators import Kernel, Part
from octex.source.surface import Surface
from octex.tree.layout import KeptTable, TreeArrays
from octex.tree.octree import Octree
from tests.conftest import needs_jit
from tests.make.small_surfaces import FACES, TETRAHEDRON, tetrahedron
from tests.make.small_textures import shell


def handed_out(folder):
    """Return the arrays that callers get, by name."""
    surface = tetrahedron(uv=TETRAHEDRON[:, :2])
    texture = octex.convert(surface, 2, fit=False)
    texture.save(folder / "a.octex")
    cloud = octex.PointCloud(TETRAHEDRON, np.full((4, 3), 0.5), TETRAHEDRON + 1)
    camera = octex.Camera.fitted(TETRAHEDRON, (0, 0, 1), size=(4, 4))
    found = {
        "vertices": surface.vertices,
        "triangles": surface.triangles,
        "rest": surface.rest,
        "other rest": surface.with_rest(TETRAHEDRON * 2).rest,
        "surface.bounds": surface.bounds,
        "points": cloud.points,
        "colors": cloud.colors,
        "normals": cloud.normals,
        "K": camera.K,
        "world_to_camera": camera.scaled(2).world_to_camera,
    }
    assert surface.uv is not None
    found |= {"uv": surface.uv.values, "uv rows": surface.uv.rows}
    for name, each in (("texture", texture), ("opened", octex.open(folder / "a.octex"))):
        for made in (each, each.level(1), octex.map(each, np.sqrt)):
            found |= {f"{name}.{n}": array for n, array in enumerate(made.channels["base_color"][1:])}
            found[f"{name}.bounds"] = made.bounds
    return found


def test_arrays_that_are_handed_out_cannot_be_written_to(tmp_path):
    for name, array in handed_out(tmp_path).items():
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
        assert not array.flags.writeable, name


def test_arrays_that_are_given_may_change_afterwards():
    vertices, faces, rest = TETRAHEDRON.copy(), FACES.copy(), TETRAHEDRON * 2.0
    bounds, colors = np.array([[0.0] * 3, [1.0] * 3]), np.full((4, 3), 0.5, np.float32)
    K, pose = np.eye(3), np.eye(4)
    surface = Surface.from_arrays(vertices, faces, rest=rest)
    cloud = octex.PointCloud(vertices, colors)
    camera = octex.Camera(4, 4, K, pose, "pinhole")
    whole = shell(1)
    texture = octex.OctreeTexture(whole.tree, whole.channels, whole.placement, bounds)
    for array in (vertices, faces, rest, bounds, colors, K, pose):
        array[...] = 3
    assert np.array_equal(surface.vertices, TETRAHEDRON)
    assert np.array_equal(surface.triangles, FACES)
    assert np.array_equal(surface.rest, TETRAHEDRON * 2.0)
    assert np.array_equal(cloud.points, TETRAHEDRON)
    assert np.array_equal(cloud.colors[:, :3], np.full((4, 3), 0.5))
    assert np.array_equal(texture.bounds, [[0.0] * 3, [1.0] * 3])
    assert np.array_equal(camera.K, np.eye(3))
    assert np.array_equal(camera.world_to_camera, np.eye(4))


def test_what_is_read_only_is_not_copied_once_more(tmp_path):
    surface = tetrahedron()
    assert surface.with_filter("trilinear").vertices is surface.vertices
    shell(2).save(tmp_path / "a.octex")
    texture = octex.open(tmp_path / "a.octex")
    mapped = np.frombuffer(texture.storage.mapping or b"", np.uint8)
    for each in (texture, texture.level(1), octex.cast(texture)):
        assert np.shares_memory(each.channels["base_color"].values, mapped)
        del each
    del mapped


@kernel
def _total(numbers, table, more):
    total = 0.0
    for n in range(numbers.size):
        total += numbers[n] + np.float64(table.cells[n])
    more[0] = total
    return total


def test_kernels_take_read_only_arrays_without_being_compiled_anew():
    arguments = np.arange(5.0), np.arange(5, dtype=np.uint32), np.zeros(1)
    for locked in ([], [0], [1], [0, 1], [0, 1]):
        numbers, cells, more = (array.copy() for array in arguments)
        for which in locked:
            (numbers, cells)[which].flags.writeable = False
        assert _total(numbers, KeptTable(cells), more) == more[0] == 20.0
    if isinstance(_total, Kernel):
        assert len(_total.compiled.signatures) == 1


def compiled():
    """Return what is compiled of octex: the kernels, and the types that they are compiled for."""
    return {
        f"{name}.{own}": str(each.compiled.signatures)
        for name, module in list(sys.modules.items())
        if name.startswith("octex.")
        for own, each in vars(module).items()
        if isinstance(each, Part)
    }


@needs_jit
def test_nothing_of_octex_is_compiled_for_read_only_arrays(tmp_path):
    before = compiled()  # others' kernels, which call those of octex, may be given such arrays
    handed_out(tmp_path)
    texture, points = shell(3), np.random.default_rng(0).random((50, 3))
    points.flags.writeable = False
    for options in ({}, {"width": 0.2}, {"filter": "nearest"}, {"filter": "linear", "normals": points}):
        texture.sample(points, **options)
    octex.mix(texture, octex.blur(texture, 0.1), 0.4)
    surface = tetrahedron()
    image = octex.Projection(
        np.full((4, 4, 3), 200, np.uint8), octex.Camera.fitted(surface.rest, (0, 0, 1), size=(4, 4))
    )
    octex.paint(None, surface, image, max_depth=3)
    after = compiled()
    assert len(after) > 50
    changed = [name for name, signatures in after.items() if before.get(name) != signatures]
    locked = {name for name in changed if "readonly" in after[name]}
    assert {name for name in locked if "readonly" not in before.get(name, "")} == set()


def mapped(folder, *arrays):
    """Yield the same arrays in files that are mapped to be read: writing to their memory ends the process."""
    for array in map(np.asarray, arrays):
        path = folder / f"{len(list(folder.iterdir()))}.npy"
        np.save(path, array)
        yield np.load(path, mmap_mode="r")


@needs_jit
def test_a_view_for_kernels_is_of_the_same_memory_and_lives_by_itself(tmp_path):
    (numbers,) = mapped(tmp_path, np.arange(12.0).reshape(3, 4))
    for array in (numbers, numbers[::-1, 1:], numbers.T, numbers[:0]):
        found = unlocked((1, KeptTable(array)))[1].cells
        assert type(found) is np.ndarray
        assert found.flags.writeable
        assert np.array_equal(found, array)
        assert found.strides == array.strides
        assert found.size == 0 or np.shares_memory(found, array)
    own = np.arange(3)
    assert unlocked(own) is own
    assert unlocked(given := (own, KeptTable(own.astype(np.uint32)), "text")) is given
    expected = numbers.T.tolist()
    found = unlocked(numbers.T)
    del array, numbers
    assert found.tolist() == expected


@needs_jit
def test_kernels_write_to_nothing_that_users_have_mapped_to_be_read(tmp_path):
    texture, random = shell(3), np.random.default_rng(0)
    channel = texture.channels["base_color"]
    channel = channel._replace(**dict(zip(channel._fields[1:], mapped(tmp_path, *channel[1:]), strict=True)))
    table = dict(zip(texture.tree.arrays._fields, mapped(tmp_path, *texture.tree.arrays), strict=True))
    tree = Octree(TreeArrays(**table), texture.tree.split, texture.tree.kept)
    texture = octex.OctreeTexture(tree, {"base_color": channel}, texture.placement, texture.bounds)
    directions = random.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for kind in (np.float32, np.float64):
        points, normals, widths, slopes = mapped(
            tmp_path,
            *((0.5 + 0.45 * directions).astype(kind), directions.astype(kind)),
            *(np.full(50, 0.1, kind), np.full((50, 3), 0.05, kind)),
        )
        texture.contains(points)
        texture.taps(points, width=widths)
        for filter in ("nearest", "linear", "quadratic", "quartic"):
            for asked in ({}, {"normals": normals}, {"gradient": filter != "nearest"}):
                texture.sample(points, filter=filter, **asked)
        for asked in (
            {"width": widths},
            {"width": widths, "normals": normals},
            {"dPdx": slopes, "dPdy": slopes},
        ):
            texture.sample(points, **asked)
    vertices, faces, rest, colors = mapped(
        tmp_path, TETRAHEDRON, FACES, TETRAHEDRON * 2.0, random.random((4, 3))
    )
    surface = Surface.from_arrays(vertices, faces, rest=rest, colors=colors)
    octex.convert(surface, 4).save(tmp_path / "a.octex")
    octex.convert(octex.PointCloud(vertices, colors, vertices), 3)
    coords, values = mapped(tmp_path, np.arange(12).reshape(4, 3) % 8, np.full((4, 3), 99, np.uint8))
    octex.convert(octex.Voxels(coords, {"base_color": values}, depth=3))
    image, mask = mapped(tmp_path, np.full((8, 8, 3), 200, np.uint8), np.full((8, 8), 255, np.uint8))
    projection = octex.Projection(image, octex.Camera.fitted(surface.rest, (0, 0, 1), size=(8, 8)), mask)
    octex.paint(octex.open(tmp_path / "a.octex"), surface, projection, max_angle=90)
    octex.project(surface, projection, max_depth=3)
    octex.mix(texture, octex.blur(texture, 0.1), 0.4).save(tmp_path / "b.octex")
    octex.crop(texture, (0.0,) * 3, (0.5,) * 3)
    octex.resize(texture, 2)
