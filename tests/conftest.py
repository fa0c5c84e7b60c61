"""What all tests share."""

import os
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

# The other processors have tests to run, and threads that wait for work in BLAS spin. Read with numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

import octex
from octex import ahead, jit
from octex.parallel import cpu_count
from tests.make.command import Cli, colored_box

# No deadlines: a first call compiles. Derandomized: a red test stays red.
settings.register_profile("octex", deadline=None, derandomize=True, max_examples=10 if jit.DISABLED else 50)
settings.load_profile("octex")

#: For tests beside a slow reference, which find planted faults in a few examples.
few = settings(max_examples=10 if jit.DISABLED else 20)
#: For tests whose inputs are too large to run as plain Python.
needs_jit = pytest.mark.skipif(jit.DISABLED, reason="too slow without compilation")


def pytest_xdist_auto_num_workers(config):
    """Share the whole suite among the processors; run some files in this process.

    One process more than processors, since some wait for a browser: no processor is idle then.
    """
    return cpu_count() + 1 if _runs_all(config) else 0


def _runs_all(config):
    return config.args_source is pytest.Config.ArgsSource.TESTPATHS


@cache
def _claims(config):
    """Return a folder for as long as pytest runs."""
    folder = TemporaryDirectory()
    config.add_cleanup(folder.cleanup)
    return folder.name


def pytest_configure_node(node):
    """Let processes share what the whole suite compiles: two that need a kernel at once compile it twice."""
    chosen = node.config.option.keyword or node.config.option.markexpr
    if _runs_all(node.config) and not chosen and not jit.DISABLED:
        node.workerinput["claims"] = _claims(node.config)


def pytest_sessionstart(session):
    """Compile kernels, but in the first process: it collects, and writes Python's bytecode for the others."""
    given = getattr(session.config, "workerinput", {})
    if given.get("workerid") != "gw0":
        _compile_share(given)


def pytest_collection_finish(session):
    """Compile kernels in the first process too."""
    _compile_share(getattr(session.config, "workerinput", {}))


def _compile_share(given):
    """Compile the kernels of those modules that no other process has claimed."""
    if "claims" not in given:
        return
    listed = {}
    for line in ahead.lines(*ahead.SECTIONS):
        listed.setdefault(line.partition(":")[0], []).append(line)
    for module, lines in sorted(listed.items(), key=lambda item: -len("".join(item[1]))):
        with suppress(FileExistsError):
            (Path(given["claims"]) / module).mkdir()  # by one process alone
            for line in lines:
                ahead._compile(line)


def pytest_collection_modifyitems(items):
    """Begin with the rooms whose files take longest: at the end, one process would run them alone."""
    items.sort(key=lambda item: item.path.parent.name not in ("house", "viewer"))


@pytest.fixture(scope="session", autouse=True)
def no_helpers():
    """Let no command start helpers that compile ahead: the other processors have tests to run."""
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(ahead, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def no_home(tmp_path_factory):
    """Let commands keep what is the user's in a folder of the tests."""
    with pytest.MonkeyPatch.context() as changed:
        changed.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def cli(capsys):
    """Runs commands."""
    return Cli(capsys)


@pytest.fixture
def small_previews(monkeypatch):
    """Let commands draw small previews and compare few points: theirs have 13 million samples, a million."""
    monkeypatch.setattr(octex, "write_preview", partial(octex.write_preview, size=(320, 176)))
    monkeypatch.setattr(octex, "difference", partial(octex.difference, points=20_000))


def fewer_points(monkeypatch, part):
    """Compare photographs at a part of the points."""
    from octex.photos import balance, refine, sharpness

    for module, names in (
        (refine, ("_POINTS", "_COARSE", "_TELLING", "_MOST")),
        (balance, ("_POINTS",)),
        (sharpness, ("_POINTS",)),
    ):
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name) // part)


@pytest.fixture
def few_points(monkeypatch):
    """Compare photographs at a tenth of the points: enough for small images."""
    fewer_points(monkeypatch, 10)


@pytest.fixture(scope="session")
def models():
    """The folder of real models, named by OCTEX_TEST_MODELS."""
    folder = os.environ.get("OCTEX_TEST_MODELS")
    if not folder:
        pytest.skip("set OCTEX_TEST_MODELS to a folder of real models")
    return Path(folder)


@pytest.fixture(scope="session")
def model(tmp_path_factory):
    """A box whose corners have colours."""
    return colored_box(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="session")
def made(model):
    """The box as an octree texture of depth 4."""
    path = model.with_name("box.octex")
    octex.convert(model, 4).save(path)
    return path
