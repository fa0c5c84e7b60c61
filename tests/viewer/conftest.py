"""What tests of the viewer share: a browser and a painted model, each started once a process."""

import pytest

from octex.session.painting import Session
from tests.make.browser import driven, started
from tests.make.studio import Studio
from tests.viewer.test_session import canvas


@pytest.fixture(scope="package")
def driver():
    with driven() as found:
        yield found


@pytest.fixture(scope="package")
def browser(driver):
    with started(driver) as found:
        yield found


@pytest.fixture(scope="package")
def studio(browser, tmp_path_factory):
    """A grey ball that is painted."""
    with Studio(browser, tmp_path_factory.mktemp("studio")).shared() as found:
        yield found


@pytest.fixture
def page(studio):
    """A page whose brush and view are as at the beginning, on a model without paint."""
    with studio.restored() as found:
        yield found


@pytest.fixture
def session(tmp_path):
    """Painting of a plain ball, without a page."""
    found = Session(*canvas(), tmp_path / "out.octex")
    yield found
    found.close()
