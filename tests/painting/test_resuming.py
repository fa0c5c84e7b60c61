"""A folder of what was done: painting goes on from it, and gives what it gives without."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from unittest import mock

import numpy as np
import pytest

import octex
from octex import container
from octex.conversion.large import digest_of
from octex.errors import OutputError
from octex.painting import image, paint, project
from octex.photos import agreement, refine
from tests.conftest import needs_jit
from tests.make.photographs import projections, ring
from tests.properties.edit_claims import digest

WORK = {
    "decoded": (image, "_window_of"),
    "seen": (project, "visibility_of"),
    "compared": (agreement, "_differences"),
    "projected": (paint, "rasterize_surface"),
    "refined": (refine, "_refined"),
}


class Counted:
    """Counts what is done in a block."""

    def __enter__(self):
        self.counts = dict.fromkeys(WORK, 0)
        self._patches = []
        for name, (module, function) in WORK.items():
            self._patches.append(mock.patch.object(module, function, self._counting(module, function, name)))
            self._patches[-1].start()
        return self.counts

    def __exit__(self, *_):
        for patch in self._patches:
            patch.stop()

    def _counting(self, module, function, name):
        call = getattr(module, function)

        def counted(*given, **named):
            self.counts[name] += 1
            return call(*given, **named)

        return counted


def scene():
    surface, cameras, images = ring(5, 48)
    images[2][15:30, 20:35, :3] = 0.9, 0.02, 0.02
    return surface, projections(images, cameras), {"max_depth": 4, "balance": "full"}


def painted(surface, shown, options, resume=None, **how):
    """Paint; return the digest of the texture, and what was done for it."""
    with Counted() as counts:
        made = octex.paint(None, surface, shown, run=octex.Run(resume=resume, **how), **options)
    return digest(made), counts


def counted(**counts):
    return dict.fromkeys(WORK, 0) | counts


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_what_is_done_is_not_done_again(tmp_path):
    surface, shown, options = given = scene()
    expected, _ = painted(*given)
    folder = tmp_path / "kept"
    everything = counted(decoded=5, seen=5, compared=5, projected=1)
    assert painted(*given, folder) == (expected, everything)
    assert painted(*given, folder) == (expected, counted())
    with Counted() as counts:
        layer = octex.project(surface, shown, run=octex.Run(resume=folder), **options)
    assert not any(counts.values())
    assert digest(layer) == digest(octex.project(surface, shown, **options))
    for path in folder.glob("layer-*"):
        path.unlink()
    assert painted(*given, folder, memory="1kB", folder=tmp_path) == (expected, counted(projected=1))


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_only_what_has_changed_is_done_anew(tmp_path):
    surface, shown, options = scene()
    painted(surface, shown, options, tmp_path)

    def repainted(given, surface=surface, **changed):
        found, counts = painted(surface, given, {**options, **changed}, tmp_path)
        assert found == painted(surface, given, {**options, **changed})[0]
        return counts

    image = np.array(shown[1].image)
    image[0, 0] = 0.5
    other = [shown[0], dataclasses.replace(shown[1], image=image), *shown[2:]]
    assert repainted(other) == counted(decoded=1, compared=5, projected=1)
    for change in ({"opacity": 0.5}, {"mask": image}):
        assert repainted([*shown[:4], dataclasses.replace(shown[4], **change)])["decoded"] == 1
    moved = [dataclasses.replace(shown[0], camera=shown[1].camera), *shown[1:]]
    assert repainted(moved) == counted(compared=5, projected=1)
    changes = [
        {"max_depth": 3},
        {"max_angle": 50.0},
        {"pictures": "best"},
        {"balance": None},
        {"fit": False},
        {"back_faces": True},
        {"region": np.arange(len(surface.triangles)) % 2 == 0},
        {"reference": 2},
    ]
    for changed in changes:
        counts = repainted(shown, **changed)
        assert counts["decoded"] == counts["seen"] == 0
        assert counts["projected"] == 1
    assert repainted(shown, edge_feather=6.0)["seen"] == 5
    assert repainted(shown, channel="emissive")["decoded"] == 5
    larger = octex.Surface.from_arrays(surface.vertices * 1.01, surface.triangles)
    counts = repainted(shown, larger)
    assert (counts["decoded"], counts["seen"]) == (0, 5)


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_damaged_files_are_made_anew(tmp_path):
    given = scene()
    expected, _ = painted(*given, tmp_path)
    for kind, work in (("image", "decoded"), ("sight", "seen"), ("differences", "compared")):
        for damage in (cut_off, emptied, other_kind):
            for layer in tmp_path.glob("layer-*"):
                layer.unlink()
            damage(next(tmp_path.glob(f"{kind}-*")), tmp_path)
            assert painted(*given, tmp_path) == (expected, counted(**{work: 1}, projected=1))
    [layer] = tmp_path.glob("layer-*")
    cut_off(layer, tmp_path)
    assert painted(*given, tmp_path) == (expected, counted(projected=1))


def cut_off(path, _folder):
    path.write_bytes(path.read_bytes()[:-1])


def emptied(path, _folder):
    path.write_bytes(b"")


def other_kind(path, folder):
    kind = "sight" if path.name.startswith("image") else "image"
    path.write_bytes(next(folder.glob(f"{kind}-*")).read_bytes())


@needs_jit
def test_numbers_of_triangles_that_are_not_there_are_not_believed(tmp_path):
    surface, shown, options = scene()
    expected, _ = painted(surface, shown[:1], options, tmp_path)
    for name, number in (("rows", 1 << 20), ("rows", -2), ("triangles", len(surface.triangles))):
        for layer in tmp_path.glob("layer-*"):
            layer.unlink()
        [path] = tmp_path.glob("sight-*")
        tensors = {key: np.array(each) for key, each in container.read(path).tensors.items()}
        tensors[name][tensors[name].shape[0] // 2] = number
        container.write(path, tensors, {})
        assert painted(surface, shown[:1], options, tmp_path)[0] == expected


@needs_jit
@pytest.mark.usefixtures("few_points")
def test_refined_cameras_are_kept(tmp_path):
    surface, cameras, images = ring(4, 48)
    shown = projections(images, cameras)
    expected = octex.refine_cameras(surface, shown)
    for refined in (1, 0):
        with Counted() as counts:
            found = octex.refine_cameras(surface, shown, run=octex.Run(resume=tmp_path))
        assert counts["refined"] == refined
        for camera, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(camera.world_to_camera, other.world_to_camera)
            np.testing.assert_array_equal(camera.K, other.K)
    [path] = tmp_path.glob("cameras-*")
    cut_off(path, tmp_path)
    with Counted() as counts:
        octex.refine_cameras(surface, shown, run=octex.Run(resume=tmp_path))
    assert (counts["refined"], counts["decoded"]) == (1, 0)


def test_a_folder_that_cannot_be_is_named(tmp_path):
    surface, shown, _ = scene()
    file = tmp_path / "file"
    file.write_bytes(b"")
    for folder in (file, tmp_path / "a" / "b"):
        with pytest.raises(
            OutputError, match=rf"{folder.name}: cannot store intermediate results: .*choose a folder"
        ):
            octex.paint(None, surface, shown, run=octex.Run(resume=folder))


def test_digests_tell_what_is_like_from_what_is_other():
    a = np.arange(6, dtype=np.int32)
    others = [
        (a,), (a.astype(np.int64),), (a.reshape(2, 3),), (a + 1,), (a, None), ((a,), None), (a, (None,)),
        (1,), (1.0,), ("1",), (b"1",), (True,), ((1, 2), 3), (1, (2, 3)), (1, 2, 3), ((),), (), ((), ()),
    ]  # fmt: skip
    assert len({digest_of(*parts) for parts in others}) == len(others)
    assert digest_of(a[::2]) == digest_of(np.array([0, 2, 4], np.int32))
    assert digest_of(np.empty((0, 3))) != digest_of(np.empty((3, 0)))


@needs_jit
@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal")
def test_a_painting_that_was_killed_goes_on(tmp_path):
    surface, shown, options = scene()
    task = (
        "import octex, sys\n"
        "from tests.painting.test_resuming import scene\n"
        "surface, shown, options = scene()\n"
        "octex.paint(None, surface, shown, run=octex.Run(resume=sys.argv[1]), **options).save(sys.argv[2])\n"
    )
    folder, out = tmp_path / "kept", tmp_path / "out.octex"
    process = subprocess.Popen([sys.executable, "-c", task, str(folder), str(out)])
    while process.poll() is None and len(list(folder.glob("image-*"))) < 3:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not out.exists()
    kept = len(list(folder.glob("image-*")))
    assert kept >= 3
    found, counts = painted(surface, shown, options, folder)
    assert counts["decoded"] <= 5 - kept
    assert found == painted(surface, shown, options)[0]
    assert all(path.name[0] != "." for path in folder.iterdir())
