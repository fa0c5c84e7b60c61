"""What tests of the viewer share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.make.browser import started


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with started() as found:
        yield found
