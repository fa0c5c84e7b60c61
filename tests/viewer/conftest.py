"""What tests of the viewer share: a browser and a painted model, each started once a process."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path

import pytest

from octex import jit
from octex.session.painting import Session
from octex.viewer import Viewer, server
from tests.make.browser import driven, file_url, opened, started
from tests.make.browser import served as served_pages
from tests.make.strokes import OCTETS, canvas
from tests.make.studio import Studio


@pytest.fixture(scope="package")
def driver():
    if jit.DISABLED:
        pytest.skip("too slow without compilation")
    with driven() as found:
        yield found


@pytest.fixture(scope="package")
def browser(driver):
    with started(driver) as found:
        yield found


@pytest.fixture
def opens(browser):
    """Opens pages of viewers, files and addresses; at the end they must have complained of nothing.

    What cannot be loaded is no complaint of those with ``is_lost``, whose servers go away.
    """
    told = []
    with ExitStack() as stack:

        def page_of(shown, *given, is_lost=False, **options):
            if isinstance(shown, Viewer):
                shown = stack.enter_context(served_pages(shown)).url
            page = opened(browser, file_url(shown) if isinstance(shown, Path) else shown, *given, **options)
            stack.callback(page.close)
            told.append((page.complaints, ("Failed to load resource",) if is_lost else ()))
            return page

        yield page_of
        assert [line for lines, known in told for line in lines if not line.startswith(known)] == []


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


class Served:
    """A viewer that runs, and what it is asked."""

    def __init__(self, made):
        self.lines: list[str] = []
        self.viewer = made(self.lines.append)
        self.session = self.viewer.session
        self.thread = threading.Thread(target=self.viewer.run, kwargs={"alone": 0.1})
        self.thread.start()

    def ask(self, path="", method="GET", token=None, body=None, **headers):
        connection = HTTPConnection("127.0.0.1", self.viewer.port, timeout=60)
        named = {name.replace("_", "-"): text for name, text in headers.items()}
        token = self.viewer.token if token is None else token
        connection.request(method, f"/{token}/{path}" if token else f"/{path}", body, headers=named)
        answer = connection.getresponse()
        self.headers = answer.headers
        found = answer.status, answer.read()
        connection.close()
        return found

    def post(self, body, path="session", **given):
        return self.ask(path, "POST", body=body, **{"Content_Type": OCTETS, **given})


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A viewer that paints."""
    monkeypatch.setattr(server, "_FIRST", 4000)
    texture, surface = canvas()
    session = Session(texture, surface, tmp_path / "out.octex")
    path = tmp_path / "ball.octex"
    found = Served(lambda log: Viewer(lambda: texture, path, surface, session=session, log=log))
    yield found
    monkeypatch.setattr(server, "_FIRST", 0)
    found.thread.join(20)
    assert not found.thread.is_alive()
    session.close()
