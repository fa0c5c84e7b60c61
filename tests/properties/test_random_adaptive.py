"""Adaptive trees of random surfaces and sources are as near as they promise."""

import pytest

from tests.conftest import needs_jit
from tests.properties.random_adaptive import check


@needs_jit
@pytest.mark.parametrize("seed", [3, 5, 11, 20, 24, 25, 28, 43, 45, 53, 54, 55, 90156, 90261])
def test_adaptive_textures_are_as_near_as_they_promise(seed):
    check(seed)
