"""Files that a painting page downloads: what the library's own calls write of the painted texture."""

import json
import socket
import threading
from urllib.parse import urlencode

import pytest

import octex
from octex.errors import OutputError
from octex.session.painting import Session
from octex.texture import OctreeTexture
from octex.viewer import Viewer, downloads, write_page
from tests.make.browser import opened
from tests.make.browser import served as serving
from tests.make.same import assert_same
from tests.make.strokes import canvas, plain, stroke


def told(served, **wanted):
    """Ask for a file; return what is told until its line ends."""
    status, body = served.ask(f"export?{urlencode(wanted)}")
    assert status == 200
    events = [block.split("\n") for block in body.decode().strip().split("\n\n")]
    return [(name.removeprefix("event: "), json.loads(data.removeprefix("data: "))) for name, data in events]


def exported(served, **wanted):
    """Export a file; return its name and its bytes."""
    *steps, (name, last) = told(served, **wanted)
    assert name == "done", last
    assert {each for each, _ in steps} == {"progress"}
    status, body = served.ask(f"export/{last['number']}")
    assert status == 200
    assert len(body) == last["bytes"]
    assert served.headers["Content-Disposition"] == f"attachment; filename*=UTF-8''{last['name']}"
    return last["name"], body


KINDS = [
    ({"kind": "octex"}, "out.octex", lambda t, s, p: t.save(p)),  # noqa: ARG005
    ({"kind": "octz"}, "out.octz", lambda t, s, p: t.save(p)),  # noqa: ARG005
    ({"kind": "html"}, "out.html", lambda t, s, p: write_page(t, p, s, title="ball.octex")),
    ({"kind": "glb", "uv": "atlas", "size": "512"}, "out.glb",
     lambda t, s, p: octex.write_model(octex.bake(t, s, uv="atlas", texture_size=512), p)),
    ({"kind": "vertices"}, "out-vertices.glb",
     lambda t, s, p: octex.write_model(octex.bake_vertices(t, s), p)),
    ({"kind": "ply", "divide": "yes"}, "out-vertices.ply",
     lambda t, s, p: octex.write_model(octex.bake_vertices(t, s, subdivide="auto"), p)),
]  # fmt: skip


@pytest.mark.parametrize(("wanted", "name", "write"), KINDS)
def test_a_file_is_what_the_library_writes_of_the_painted_texture(wanted, name, write, served, tmp_path):
    served.post(stroke(1))
    served.session.wait()
    (tmp_path / "there").mkdir()
    write(served.session.shown.texture, canvas()[1], tmp_path / "there" / name)
    assert exported(served, **wanted) == (name, (tmp_path / "there" / name).read_bytes())
    assert served.session.shown.status["isSaved"] is False  # an export is no save


def test_the_last_file_alone_is_kept_and_none_in_the_end(served, tmp_path):
    (_, first) = told(served, kind="octex")[-1]
    (_, second) = told(served, kind="octz")[-1]
    assert served.ask(f"export/{first['number']}")[0] == 404
    assert "no longer there" in served.lines[-1]
    assert served.ask(f"export/{second['number']}")[0] == 200
    assert len([*tmp_path.glob(".octex-*")]) == 1
    assert served.viewer.downloads is not None
    served.viewer.downloads.close()
    assert not [*tmp_path.glob(".octex-*")]
    for path in ("export/../../out.octex.strokes", "export/", "export/1/2"):
        assert served.ask(path)[0] == 404


def test_what_cannot_be_exported_is_said_in_one_line(served, tmp_path):
    for wanted, why in (
        ({}, "unknown kind"),
        ({"kind": "exe"}, "unknown kind"),
        ({"kind": "glb", "uv": "../.."}, "unknown uv"),
        ({"kind": "glb", "size": "1000000000"}, "unknown size"),
        ({"kind": "ply", "divide": "NaN"}, "unknown divide"),
        ({"kind": "octex", "path": "/etc/passwd"}, "unknown field of the download 'path'"),
        ({"kind": "glb", "uv": "keep"}, "has no texture coordinates"),
    ):
        *_, (name, last) = told(served, **wanted)
        assert name == "fault"
        assert why in last["why"]
        assert "\n" not in last["why"]
        assert not [*tmp_path.glob(".octex-*")]
    assert exported(served, kind="octex")[0] == "out.octex"


def test_painting_goes_on_while_a_file_is_made_and_only_one_is_made_at_a_time(served, monkeypatch, tmp_path):
    begun, held = threading.Event(), threading.Event()
    save = OctreeTexture.save

    def slow(texture, path):
        begun.set()
        assert held.wait(20)
        save(texture, path)

    monkeypatch.setattr(OctreeTexture, "save", slow)
    found = []
    thread = threading.Thread(target=lambda: found.append(exported(served, kind="octex")))
    thread.start()
    assert begun.wait(20)
    served.post(stroke(1))
    served.session.wait()
    assert served.session.shown.status["done"] == 1
    assert told(served, kind="octz")[-1] == (
        "fault",
        {"why": "another export is under way; wait until it is done"},
    )
    held.set()
    thread.join(20)
    (tmp_path / "then.octex").write_bytes(found[0][1])
    assert_same(octex.open(tmp_path / "then.octex"), canvas()[0])  # as it was when the export began


def test_a_page_that_goes_away_stops_the_work_and_leaves_nothing(served, monkeypatch, tmp_path):
    begun, ended = threading.Event(), threading.Event()

    def endless(*_, progress, **__):
        monkeypatch.setattr(downloads, "_BEAT", 0.0)
        try:
            while True:
                progress("bake", 1, 2)
                begun.set()
        finally:
            ended.set()

    monkeypatch.setattr(downloads, "bake", endless)
    with socket.create_connection(("127.0.0.1", served.viewer.port)) as page:
        page.sendall(
            f"GET /{served.viewer.token}/export?kind=glb HTTP/1.1\r\n"
            f"Host: 127.0.0.1:{served.viewer.port}\r\n\r\n".encode()
        )
        assert begun.wait(20)
    assert ended.wait(20)
    for _ in range(100):
        *_, (name, _) = told(served, kind="octex")
        if name == "done":
            break
    assert name == "done"
    assert len([*tmp_path.glob(".octex-*")]) == 1


def test_a_full_disk_is_said_and_the_session_goes_on(served, monkeypatch, tmp_path):
    def full(_texture, path):
        raise OutputError(f"{path.name}: cannot be written: No space left on device; make room")

    with monkeypatch.context() as patched:
        patched.setattr(OctreeTexture, "save", full)
        *_, (name, last) = told(served, kind="octex")
    assert (name, "No space left" in last["why"]) == ("fault", True)
    assert not [*tmp_path.glob(".octex-*")]
    assert served.post(plain("fill", 1, color=[1, 2, 3]))[0] == 200


def test_the_page_downloads_a_file_with_a_proper_name_and_says_what_is_wrong(browser, tmp_path):
    texture, surface = canvas()
    session = Session(texture, surface, tmp_path / "Kugel ä.octex")
    viewer = Viewer(lambda: texture, tmp_path / "ball.octex", surface, session=session)
    with serving(viewer):
        page = opened(browser, viewer.url, (800, 400), is_drawn=False)
        page.wait_for_function("viewer.painting")
        page.click("#export summary")
        page.evaluate(
            "viewer.painting.commands.send({ kind: 'fill', color: [9, 9, 9], opacity: 1, mirror: '' })"
        )
        page.select_option("#export-kind", "octz")
        assert page.locator("#export-images").is_hidden()
        with page.expect_download() as waited:
            page.click("#export-begin")
        download = waited.value
        assert download.suggested_filename == "Kugel ä.octz"
        download.save_as(tmp_path / "saved.octz")
        assert_same(octex.open(tmp_path / "saved.octz"), session.shown.texture)
        assert session.shown.status["done"] == 1
        with page.expect_download() as waited:
            page.keyboard.press("Control+Shift+S")
        assert waited.value.suggested_filename == "Kugel ä.octex"
        page.select_option("#export-kind", "glb")
        page.select_option("#export-uv", "keep")
        page.click("#export-begin")
        page.wait_for_function(
            "document.getElementById('export-note').textContent.startsWith('Not exported: ')"
        )
        assert "texture coordinates" in page.locator("#export-note").inner_text()
        assert page.complaints == []
        page.close()
    session.close()
