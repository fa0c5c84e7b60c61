"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

import octex
from octex import jit
from tests.command import colored_box

# No deadlines: a first call compiles. Derandomized: a red test stays red.
settings.register_profile("octex", deadline=None, derandomize=True, max_examples=10 if jit.DISABLED else 50)
settings.load_profile("octex")

#: For tests whose inputs are too large to run as plain Python.
needs_jit = pytest.mark.skipif(jit.DISABLED, reason="too slow without compilation")


@pytest.fixture(scope="session")
def models() -> Path:
    """The folder of real models, named by OCTEX_TEST_MODELS."""
    folder = os.environ.get("OCTEX_TEST_MODELS")
    if not folder:
        pytest.skip("set OCTEX_TEST_MODELS to a folder of real models")
    return Path(folder)


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box whose corners have colours."""
    return colored_box(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="session")
def made(model: Path) -> Path:
    """The box as an octree texture of depth 4."""
    path = model.with_name("box.octex")
    octex.convert(model, 4).save(path)
    return path
