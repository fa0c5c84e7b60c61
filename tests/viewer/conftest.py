"""What tests of the viewer share: a browser and a painted model, each started once a process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.make.browser import driven, started
from tests.make.studio import Studio


@pytest.fixture(scope="package")
def driver() -> Iterator[Any]:
    with driven() as found:
        yield found


@pytest.fixture(scope="package")
def browser(driver: Any) -> Iterator[Any]:
    with started(driver) as found:
        yield found


@pytest.fixture(scope="package")
def studio(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A grey ball that is painted."""
    with Studio(browser, tmp_path_factory.mktemp("studio")).shared() as found:
        yield found


@pytest.fixture
def page(studio: Studio) -> Iterator[Any]:
    """A page whose brush and view are as at the beginning, on a model without paint."""
    with studio.restored() as found:
        yield found
