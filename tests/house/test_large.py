"""Conversions whose arrays lie in files, and whose tasks others do: the same bytes come out."""

import errno
import multiprocessing
import os
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.conversion import fit, large
from octex.errors import ArgumentError, InputError, OutputError
from octex.parallel import sharing
from octex.source import materials
from octex.source.images.pyramid import store
from octex.voxelize import fragments
from tests.conftest import needs_jit
from tests.make.small_surfaces import bent, sheet, tetrahedron, turned


def torus(**options):
    """Return a bumpy torus with a colour a vertex."""
    around, along = np.meshgrid(*[np.arange(48) * (np.pi / 24)] * 2)
    radius = 0.4 + 0.05 * np.sin(5 * around) * np.sin(4 * along)
    ring = 1 + radius * np.cos(along)
    points = np.stack([ring * np.cos(around), ring * np.sin(around), radius * np.sin(along)], axis=-1)
    a = np.arange(48 * 48).reshape(48, 48)
    b, c, d = np.roll(a, -1, 0), np.roll(a, -1, (0, 1)), np.roll(a, -1, 1)
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    colors = 0.5 + 0.5 * np.sin(9 * points.reshape(-1, 3))
    return octex.Surface.from_arrays(points.reshape(-1, 3), triangles, colors=colors, name="torus", **options)


SURFACES = {
    "torus": torus(), "tetrahedron": tetrahedron(), "sheet": sheet(turned(3), 0.02), "bent": bent(0.03),
}  # fmt: skip


def converted(surface, folder, **options):
    """Return the bytes of a texture made in memory, and of one made in files."""
    depth, fit = options.pop("depth", 6), options.pop("fit", True)
    octex.convert(surface, depth, fit=fit).save(folder / "memory.octex")
    made = octex.convert(surface, depth, fit=fit, path=folder / "files.octex", **options)
    made.validate()
    del made
    assert sorted(each.name for each in folder.iterdir()) == ["files.octex", "memory.octex"]
    return (folder / "memory.octex").read_bytes(), (folder / "files.octex").read_bytes()


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("fit", [True, False])
def test_a_texture_made_in_files_has_the_same_bytes(name, fit, tmp_path):
    for depth in (0, 2, 6):
        in_memory, in_files = converted(
            SURFACES[name], tmp_path, fit=fit, depth=depth, run=octex.Run(memory=1)
        )
        assert in_memory == in_files


def depths(points):
    return np.where(points[:, 0] > 0, 5, 3)


@pytest.mark.parametrize("options", [{"max_error": 16}, {"max_error": 8, "fit": False}, {"detail": depths}])
def test_an_adaptive_texture_made_in_files_has_the_same_bytes(options, tmp_path):
    paths = tmp_path / "memory.octex", tmp_path / "files.octex"
    in_memory = octex.convert(torus(), 5, **options)
    assert in_memory.tree.n_leaves < octex.convert(torus(), 5, fit=False).tree.n_leaves
    in_memory.save(paths[0])
    octex.convert(torus(), 5, path=paths[1], run=octex.Run(memory=1), **options).validate()
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def test_what_fits_into_memory_is_made_there(tmp_path, monkeypatch):
    monkeypatch.setattr(large, "scratch", None)
    in_memory, in_files = converted(tetrahedron(), tmp_path, run=octex.Run(memory="1GB"))
    assert in_memory == in_files


@pytest.mark.parametrize(("needed", "is_mapped"), [(160, False), (170, True)])
def test_memory_is_what_a_conversion_takes_at_its_peak(needed, is_mapped, scratched, tmp_path, monkeypatch):
    # A conversion takes up to six times the least that it could.
    monkeypatch.setattr("octex.conversion.convert.memory_needed", lambda *_, **__: needed)
    octex.convert(tetrahedron(), 3, run=octex.Run(memory=1000), path=tmp_path / "a.octex")
    assert bool(scratched) is is_mapped


@pytest.fixture
def scratched(monkeypatch):
    """The folders beside which conversions made some for files of arrays."""
    made, scratch = [], large.scratch
    monkeypatch.setattr(large, "scratch", lambda parent: made.append(parent) or scratch(parent))
    return made


def test_files_of_a_conversion_lie_in_the_folder_of_the_run(scratched, tmp_path):
    (tmp_path / "other").mkdir()
    for folder, expected in ((None, tmp_path), (tmp_path / "other", tmp_path / "other")):
        octex.convert(tetrahedron(), 3, run=octex.Run(memory=1, folder=folder), path=tmp_path / "a.octex")
        assert scratched.pop() == expected


OPEN_FILES = Path("/proc/self/fd")


def open_files_in(folder):
    """Count the files of a folder that this process has open, with or without a name."""
    return sum(str(folder) in str(each.readlink()) for each in OPEN_FILES.iterdir() if each.is_symlink())


@pytest.mark.skipif(not OPEN_FILES.is_dir(), reason="Linux lists what is open")
def test_files_of_arrays_go_when_nobody_has_the_array(tmp_path):
    with large.scratch(tmp_path) as folder:
        array = large.zeros((1000, 1000), np.uint8)
        array[:] = 7
        kept = large.moved({"rows": array[10:20]})["rows"]
        joined = large.joined([array, kept])
        assert not list(folder.iterdir())
        assert open_files_in(folder) == 4  # the folder is locked
        assert (joined == 7).all()
        del array, joined
        assert open_files_in(folder) == 2
        assert (kept == 7).all()


@needs_jit
def test_large_arrays_of_a_conversion_take_no_memory(tmp_path, monkeypatch):
    made, joined = [], large.joined
    monkeypatch.setattr(large, "joined", lambda arrays: made.append(joined(arrays)) or made[-1])
    octex.convert(torus(), 6, run=octex.Run(memory=1), path=tmp_path / "a.octex")
    filled = [array for array in made if array.size]
    owners = {type(array.base.base if array.ndim > 1 else array.base).__name__ for array in filled}
    assert len(made) > 9
    assert owners <= {"mmap", "memoryview", "ndarray"}
    assert not any(array.flags.owndata for array in filled)


def test_processes_pass_files_and_the_same_bytes_come_out(processes, tmp_path):
    in_memory, in_files = converted(torus(), tmp_path, run=octex.Run(executor=processes))
    assert in_memory == in_files
    with ThreadPoolExecutor(2) as threads:
        assert converted(torus(), tmp_path, run=octex.Run(executor=threads))[1] == in_memory


def wave(points):
    """Return the alpha of positions."""
    return 0.5 + 0.4 * np.sin(9 * points[:, :1])


@pytest.mark.parametrize("sources", [{}, {"alpha": wave}])
def test_a_texture_with_gaps_made_in_files_has_the_same_bytes(sources, processes, tmp_path):
    taller = torus().with_rest(torus().rest * [1, 1, 1.2])
    surface = taller.with_sources({**octex.Transfer(torus(), distance=0.04).sources, **sources})
    for run in (octex.Run(memory=1), octex.Run(executor=processes)):
        in_memory, in_files = converted(surface, tmp_path, run=run)
        assert in_memory == in_files
    texture = octex.open(tmp_path / "files.octex")
    assert 0 < texture.tree.n_leaves < 0.9 * octex.convert(taller, 6, fit=False).tree.n_leaves
    assert "alpha" in texture.channels


@pytest.mark.parametrize("name", ["sheet", "bent"])
def test_sides_are_told_apart_in_parallel_as_in_one_thread(name, tmp_path, monkeypatch):
    octex.convert(SURFACES[name], 6, threads=1).save(tmp_path / "one.octex")
    assert octex.open(tmp_path / "one.octex").tree.split.cells.size
    for name_of_size in ("_RUN", "_BLOCK"):
        monkeypatch.setattr(fit, name_of_size, 50)
    octex.convert(SURFACES[name], 6, threads=3).save(tmp_path / "three.octex")
    assert (tmp_path / "one.octex").read_bytes() == (tmp_path / "three.octex").read_bytes()


def test_what_writes_to_arrays_of_this_process_is_done_in_it(processes, tmp_path):
    with ThreadPoolExecutor(2) as threads, large.scratch(tmp_path) as folder:
        tasks = large.Tasks(threads, folder, is_here=True)
        for given in (threads, tasks):
            with sharing(given) as found:
                assert found is threads
        for given in (processes, large.Tasks(processes, folder, is_here=False)):
            with sharing(given) as found:
                assert found.submit(os.getpid).result() == os.getpid()


class Sending(Executor):
    """Does each task at once, as another process would: from what was written to files."""

    def submit(self, function, /, *given, **named):
        large._read.cache_clear()
        done = Future()
        done.set_result(function(*given, **named))
        return done


@needs_jit
def test_images_are_made_ready_once_for_all_processes(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(fragments, "_LEAST_FRAGMENTS", 1)  # many tasks
    monkeypatch.setattr(materials, "store", lambda *given: made.append(given) or store(*given))
    model = Path(__file__).parents[2] / "samples" / "droid.glb"
    octex.convert(model, 7, path=tmp_path / "a.octex", run=octex.Run(executor=Sending()))
    assert len(made) == 1


class Fragile:
    """Colours, by a source that ends the process that asks first, but for this one."""

    def __init__(self, flag):
        self.flag, self.process = flag, os.getpid()

    def __call__(self, points):
        if os.getpid() != self.process and not self.flag.exists():
            self.flag.touch()
            os._exit(9)
        return 0.5 + 0.5 * np.sin(points)


def test_a_worker_that_ends_half_way_is_done_without(tmp_path):
    (tmp_path / "made").mkdir()
    surface = torus().with_sources({"base_color": Fragile(tmp_path / "flag")})
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        in_memory, in_files = converted(surface, tmp_path / "made", run=octex.Run(executor=pool))
    assert (tmp_path / "flag").exists()
    assert in_memory == in_files


class Failing:
    """A source that fails in other processes."""

    def __init__(self):
        self.process = os.getpid()

    def __call__(self, points):
        if os.getpid() != self.process:
            raise InputError("it is not there")
        return points * 0


def test_what_a_task_raises_comes_back(processes, tmp_path):
    given = {"depth": 5, "path": tmp_path / "a.octex", "run": octex.Run(executor=processes)}
    with pytest.raises(InputError, match="it is not there"):
        octex.convert(torus().with_sources({"base_color": Failing()}), **given)
    assert not list(tmp_path.iterdir())
    here = torus().with_sources({"base_color": lambda points: points})
    with pytest.raises(ArgumentError, match=r"cannot be sent to workers: .*define its functions in a module"):
        octex.convert(here, **given)


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(large, "empty", full)
    with pytest.raises(OutputError, match="has no room for temporary files: No space left on device"):
        octex.convert(tetrahedron(), 3, run=octex.Run(memory=1), path=tmp_path / "a.octex")
    assert not list(tmp_path.iterdir())


def test_a_dask_cluster_makes_the_same_bytes(tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra octex[cluster]")
    (tmp_path / "made").mkdir()
    surface = torus().with_sources({"base_color": Fragile(tmp_path / "flag")})
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        in_memory, in_files = converted(
            surface, tmp_path / "made", run=octex.Run(executor=client.get_executor())
        )
    assert in_memory == in_files


def test_what_cannot_be_made_in_files_is_refused(tmp_path):
    with ProcessPoolExecutor(1) as pool:
        for options, message in (
            ({"path": tmp_path / "a.ply"}, r"is converted to NAME\.octex"),
            ({"path": tmp_path / "b" / "a.octex"}, "there is no folder"),
            (
                {"max_error": 2, "run": octex.Run(executor=pool), "path": tmp_path / "a.octex"},
                "max_error and detail run on one machine only",
            ),
        ):
            with pytest.raises((ArgumentError, OutputError), match=message):
                octex.convert(tetrahedron(), 3, **options)
    assert not list(tmp_path.iterdir())
