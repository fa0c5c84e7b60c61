import re
import runpy
import sys
from functools import cache
from importlib import import_module
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import trimesh

import octex
from tests.conftest import needs_jit
from tests.oracles.naive_gltf import Document

SAMPLES = Path(__file__).parents[2] / "samples"
DROID = SAMPLES / "droid.glb"
MAP_SIZES = {"skull": (1024, 512), "neck": (256, 1024), "body": (256, 1024), "thin": (128, 1024)}


class Glb(Document):
    """A .glb read as its specification says, by hand."""

    def attributes(self):
        primitives = self.json["meshes"][0]["primitives"]
        return [
            {name: self.array(n) for name, n in {**p["attributes"], "INDICES": p["indices"]}.items()}
            for p in primitives
        ]

    def maps(self):
        return {entry["name"]: self.image(n)[..., :3] for n, entry in enumerate(self.json["images"])}

    def triangles(self):
        return np.concatenate(
            [p["POSITION"][p["INDICES"].ravel().astype(int)].reshape(-1, 3, 3) for p in self.attributes()]
        )


@pytest.fixture(scope="module")
def droid():
    return Glb(DROID)


def test_the_droid_is_small_and_has_the_maps_of_the_papers_table(droid):
    assert DROID.stat().st_size < 1_000_000
    assert {name: image.shape[1::-1] for name, image in droid.maps().items()} == MAP_SIZES
    assert 3_000 < len(droid.triangles()) < 15_000


def test_the_droids_attributes_are_sound(droid):
    assert droid.json["buffers"] == [{"byteLength": len(droid.binary)}]
    assert not any(view["byteOffset"] % 4 for view in droid.json["bufferViews"])
    for attributes in droid.attributes():
        positions, normals = attributes["POSITION"], attributes["NORMAL"]
        indices = attributes["INDICES"].astype(int)
        assert len(positions) == len(normals) == indices.max() + 1
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
        a, b, c = positions[indices.reshape(-1, 3)].astype(np.float64).transpose(1, 0, 2)
        crosses = np.cross(b - a, c - a)
        facing = np.einsum("ni,nci->nc", crosses, normals[indices.reshape(-1, 3)])
        assert (facing > 0).mean() > 0.995  # slivers may lean away from what is around them


def test_the_droid_is_one_watertight_solid_without_anything_inside(droid):
    triangles = droid.triangles()
    _, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    corners = corners.reshape(-1, 3)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], -1).reshape(-1, 2)
    forward, count = np.unique(edges[edges[:, 0] < edges[:, 1]], axis=0, return_counts=True)
    backward, opposite = np.unique(edges[edges[:, 0] > edges[:, 1]][:, ::-1], axis=0, return_counts=True)
    assert np.array_equal(forward, backward)
    assert np.array_equal(count, opposite)
    piece, before = np.arange(corners.max() + 1), None
    while not np.array_equal(piece, before):
        before = piece.copy()
        for near, far in (forward.T, forward.T[::-1]):
            np.minimum.at(piece, far, piece[near])
        piece = piece[piece]
    assert not piece.any()
    assert np.linalg.det(triangles.astype(np.float64)).sum() / 6 > 0.004


@needs_jit
def test_make_droid_writes_the_droid(droid, tmp_path, monkeypatch, capsys):
    path = tmp_path / "droid.glb"
    monkeypatch.syspath_prepend(SAMPLES)
    monkeypatch.setattr(sys, "argv", ["make_droid.py", str(path)])
    runpy.run_path(str(SAMPLES / "make_droid.py"), run_name="__main__")
    shares = [int(line.split(",")[1].split("%")[0]) for line in capsys.readouterr().out.splitlines()[1:]]
    assert all(58 <= share <= 85 for share in shares)
    if path.read_bytes() == DROID.read_bytes():
        return
    # Another version of a library triangulates, rounds or compresses otherwise: the same to the eye, then.
    made = Glb(path)
    for corner in (np.min, np.max):
        np.testing.assert_allclose(
            corner(made.triangles(), (0, 1)), corner(droid.triangles(), (0, 1)), atol=1e-3
        )
    volumes = [np.linalg.det(each.triangles().astype(np.float64)).sum() for each in (made, droid)]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-3)
    if len(made.triangles()) == len(droid.triangles()):
        for name, image in made.maps().items():
            difference = np.subtract(image, droid.maps()[name], dtype=np.int16)
            assert np.abs(difference).mean() < 4


def panels(path, columns, rows=1):
    """Return the parts of an image, row by row, 0 … 1."""
    image = np.asarray(PIL.Image.open(path).convert("RGB")) / 255
    height, width = image.shape[0] // rows, image.shape[1] // columns
    return [
        image[row * height : (row + 1) * height, column * width : (column + 1) * width]
        for row in range(rows)
        for column in range(columns)
    ]


def rms(one, two):
    return float(np.sqrt(((one - two) ** 2).mean()))


def reddish(image):
    """Return the part of an image that is red."""
    return float((image[..., 0] > image[..., 1:].max(axis=2) + 0.25).mean())


def all_differ(images):
    return all(rms(one, two) > 0.004 for one, two in combinations(images, 2))


def numbers(pattern, text):
    return [float(found.replace(",", "")) for found in re.findall(pattern, text)]


def looks_up_the_source(_folder, said):
    first, *averages = numbers(r"PSNR ([\d.]+) dB", said)
    assert "every point lies in a leaf: True" in said
    assert averages == sorted(averages)
    assert first > averages[-1] > 10.0


def sees_the_model(folder, said):
    model, texture = panels(folder / "droid.png", 2)
    assert 0.0 < rms(model, texture) < 0.08
    leaves = octex.open(folder / "droid.octex").tree.n_leaves
    assert f"{leaves:,} leaves" in said


def has_a_point_a_leaf(folder, said):
    (count,) = numbers(r"([\d,]+) points in", said)
    cloud = trimesh.load(folder / "droid.ply")
    assert len(cloud.vertices) == count > 100
    assert cloud.visual.vertex_colors[:, :3].std() > 10


def is_coarser_at_each_depth(folder, _said):
    model, *textures = panels(folder / "head.png", 2, 2)
    errors = [rms(model, each) for each in textures]
    assert 0.0 < errors[0] < errors[1] < errors[2] < 0.2


def has_shorter_means(folder, said):
    assert "normals are unit vectors: True" in said
    lengths = numbers(r"means are ([\d.]+) long", said)
    assert lengths == sorted(lengths, reverse=True)
    assert len(lengths) == 5
    assert octex.open(folder / "torus.octex").channels.keys() == {"base_color", "roughness", "normal"}


def is_smoother_far_away(folder, _said):
    alone, averaged = panels(folder / "ray_cast.png", 2)
    steps = [np.abs(np.diff(each, axis=0)).mean() for each in (alone, averaged)]
    assert steps[1] < steps[0]


def is_nearest_by_facings(folder, said):
    errors = np.array(re.findall(r"RMS: ([\d.]+)% ([\d.]+)% ([\d.]+)%", said), float)
    assert len(errors) == 4
    assert (errors[:, 2] < errors[:, :2].min(axis=1) / 2).all()
    images = panels(folder / "thin.png", 4, 4)
    assert all(rms(images[4 * n + 2], images[4 * n + 3]) < 0.02 for n in range(4))


def is_painted(folder, _said):
    before, drawn, after = panels(folder / "paint.png", 3)
    assert rms(before, drawn) > 0.1
    assert 0.02 < rms(before, after) < 0.2


def is_painted_by_photographs(folder, _said):
    image = np.asarray(PIL.Image.open(folder / "photos.png").convert("RGB")) / 255
    painted, truth = np.hsplit(image[image.shape[0] // 2 :], 2)
    assert 0.0 < rms(painted, truth) < 0.15
    assert truth.std() > 0.05


def shows_both_sides_of_walls(folder, _said):
    """Blue and orange walls in the middle below the sky's light, which is grey and brighter above."""
    image = panels(folder / "path_trace.png", 1)[0]
    red, blue = image[..., 0], image[..., 2]
    assert (blue > red + 0.1).mean() > 0.03
    assert (red > blue + 0.1).mean() > 0.03
    sky = image[:, :4]
    np.testing.assert_allclose(sky[..., 0], sky[..., 2], atol=0.01)
    assert sky[0].mean() > sky[-1].mean() + 0.1


def is_baked(folder, said):
    texture, read, atlas = panels(folder / "baked.png", 3)
    assert rms(texture, read) < 0.02
    assert atlas.std() > 0.05
    (size,) = numbers(r"([\d.]+) MB", said)
    assert size == pytest.approx((folder / "baked.glb").stat().st_size / 1e6, abs=0.06)
    files = [octex.load_surface(folder / f"baked{ending}") for ending in (".glb", ".gltf")]
    points = files[0].scatter(200)
    np.testing.assert_array_equal(*(each.evaluate(points) for each in files))


def is_painted_robustly(folder, _said):
    *photos, averaged, painted, truth = panels(folder / "photographs.png", 3, 2)
    assert all_differ(photos)
    assert 0.0 < rms(painted, truth) < 0.8 * rms(averaged, truth)
    baked, model = octex.load_surface(folder / "photographs.glb"), octex.load_surface(DROID)
    assert len(baked.triangles) == len(model.triangles)
    assert baked.evaluate(baked.scatter(500)).std() > 0.02


def explains_concepts(folder, _said):
    coarse, middle, fine, smooth = panels(folder / "cells.png", 4)
    assert rms(fine, smooth) < rms(middle, smooth) < rms(coarse, smooth)
    nearest, averaged, fitted, model = panels(folder / "field.png", 4)
    assert rms(fitted, model) < min(rms(nearest, model), rms(averaged, model))
    unaveraged, square, long = (each[: len(each) // 3] for each in panels(folder / "footprints.png", 3))
    assert square.std() < long.std() < unaveraged.std()
    assert all_differ(panels(folder / "kept.png", 3))


def is_better_after_the_remedies(folder, _said):
    faults, remedies = np.split(np.array(panels(folder / "failures.png", 4, 2)), 2)
    truth = remedies[2]  # exact cameras and mesh
    assert all(rms(remedies[n], truth) < 0.7 * rms(faults[n], truth) for n in range(3))
    wrong, right = (
        (np.ptp(each, -1) > 0.06) & (each[..., 2] > 0.36) & (each.argmax(-1) == 2)
        for each in (faults[3], remedies[3])
    )
    assert right.mean() < 0.5 * wrong.mean()  # where it is as blue as the sky


def is_fetched_in_parts(folder, said):
    rows = [numbers(r"[\d,]+", line.split(":")[1]) for line in said.splitlines()]
    size = (folder / "droid.octex").stat().st_size
    came = [row[0] for row in rows]
    assert [row[1] for row in rows] == [size] * 3
    assert 0 < came[0] <= came[1] <= came[2] <= 2 * size


def is_displaced(folder, said):
    assert all_differ(panels(folder / "displacement.png", 2))
    (count,) = numbers(r"displaced to ([\d,]+) triangles", said)
    assert count >= 8 * 4**5


def is_on_the_surface(folder, said):
    assert all_differ(panels(folder / "implicit.png", 2))
    assert numbers(r"off by ([\d.e+-]+)", said)[0] < 1e-3


def is_painted_flat(folder, _said):
    flat, drawn, after = panels(folder / "unwrap.png", 3)
    assert reddish(drawn) > reddish(flat) + 0.05
    assert reddish(after) > 0.02


def is_painted_in_all_poses(folder, _said):
    images = panels(folder / "poses.png", 3)
    assert all_differ(images)
    assert min(map(reddish, images)) > 0.005


def shows_different_panels(name, columns, rows=1):
    """Return a check that an image's parts differ from each other."""

    def check(folder, _):
        assert all_differ(panels(folder / name, columns, rows))

    return check


def says(words):
    """Return a check of what a script measures and says."""

    def check(_, said):
        assert words in said

    return check


@pytest.fixture(scope="module")
def walls():
    """Polygonize the walls that two scripts show once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SAMPLES)
        made = import_module("make_walls")
        patch.setattr(made, "surface", cache(made.surface))
        yield


CARRIED = [f"octree{ending}" for ending in ("-0.png", ".bin", ".glb", ".gltf", ".octw", ".png")]


@needs_jit
@pytest.mark.usefixtures("few_points", "small_previews", "walls")
@pytest.mark.parametrize(
    ("script", "written", "check"),
    [
        ("01_convert.py", ["droid.octex", "droid.png"], sees_the_model),
        ("02_sample.py", [], looks_up_the_source),
        ("03_inspect.py", ["droid.octex"], says("[ True  True False]")),
        ("04_points.py", ["droid.ply"], has_a_point_a_leaf),
        ("05_own_mesh.py", ["knot.png"], shows_different_panels("knot.png", 2)),
        ("06_image.py", ["head.png"], is_coarser_at_each_depth),
        ("07_channels.py", ["torus.octex"], has_shorter_means),
        ("08_smooth.py", ["smooth.png"], shows_different_panels("smooth.png", 2)),
        ("09_ray_cast.py", ["ray_cast.png"], is_smoother_far_away),
        ("10_thin.py", ["thin.png"], is_nearest_by_facings),
        ("11_paint.py", ["paint.png"], is_painted),
        ("12_photos.py", ["photos.png"], is_painted_by_photographs),
        ("13_no_uvs.py", ["no_uvs.png"], shows_different_panels("no_uvs.png", 4)),
        ("14_wood.py", ["wood.png"], shows_different_panels("wood.png", 2)),
        ("15_parts.py", ["parts.png"], shows_different_panels("parts.png", 3)),
        ("16_implicit.py", ["implicit.png"], is_on_the_surface),
        ("17_processing.py", ["processing.png"], shows_different_panels("processing.png", 5)),
        ("18_elsewhere.py", ["elsewhere.png"], shows_different_panels("elsewhere.png", 3)),
        ("19_path_trace.py", ["path_trace.png"], shows_both_sides_of_walls),
        ("20_bake.py", ["baked-0.png", "baked.bin", "baked.glb", "baked.gltf", "baked.png"], is_baked),
        ("21_poses.py", ["poses.png", "reed.gltf"], is_painted_in_all_poses),
        ("22_subdivision.py", ["cage.obj", "subdivision.png"], shows_different_panels("subdivision.png", 3)),
        ("23_displacement.py", ["displacement.png"], is_displaced),
        ("24_ptex.py", ["house.obj", "house.ptx", "ptex.png"], says("14 faces of six polygons")),
        ("25_unwrap.py", ["unwrap.png"], is_painted_flat),
        ("26_photographs.py", ["photographs.glb", "photographs.png"], is_painted_robustly),
        ("27_remote.py", ["droid.octex"], is_fetched_in_parts),
        ("28_light.py", ["light.png"], shows_different_panels("light.png", 1, 3)),
        ("29_gltf.py", CARRIED, shows_different_panels("octree.png", 2)),
        ("30_three.py", ["droid.octw", "index.html", "walls.octw", "wood.octw"], says("wood.octw")),
        ("draw_concepts.py", ["cells.png", "field.png", "footprints.png", "kept.png"], explains_concepts),
        ("draw_failures.py", ["failures.png"], is_better_after_the_remedies),
    ],
)
def test_the_scripts_run_from_anywhere(script, written, check, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SAMPLES)
    # Three images of less than 320² do not outvote a passer-by.
    slow = {
        is_painted_robustly: ("7", "160"),
        shows_both_sides_of_walls: ("5", "48"),
        explains_concepts: ("8", "96"),
        is_better_after_the_remedies: ("6", "96"),
    }
    depth, width = slow.get(check, ("5", "96"))
    monkeypatch.setenv("OCTEX_SAMPLE_DEPTH", depth)
    monkeypatch.setenv("OCTEX_SAMPLE_WIDTH", width)
    monkeypatch.setattr(sys, "argv", [script])
    monkeypatch.delattr(octex, "kernels", raising=False)  # which a script has to import itself
    monkeypatch.delitem(sys.modules, "octex.kernels", raising=False)
    runpy.run_path(str(SAMPLES / script), run_name="__main__")
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == written
    check(tmp_path / "out", capsys.readouterr().out)
    for path in (tmp_path / "out").glob("*.octex"):
        octex.open(path).validate()
    for path in (tmp_path / "out").glob("*.png"):
        assert panels(path, 1)[0].std() > 0.03


def test_every_numbered_script_is_tested_short_and_says_what_it_shows():
    scripts = sorted(SAMPLES.glob("[0-9]*.py"))
    assert [path.name[:2] for path in scripts] == [f"{i:02}" for i in range(1, len(scripts) + 1)]
    assert len(scripts) == 30
    for path in scripts:
        text = path.read_text(encoding="utf-8")
        assert text.startswith('"""')
        assert len(text.splitlines()) <= 50
