"""The viewer's server: who is answered and who is refused, with a line for each refusal."""

import hmac
import json
import os
import signal
import socket
import threading
import time
import webbrowser
import zlib

import pytest

import octex
from octex.cli.main import main
from octex.errors import ExitCode, OutputError
from octex.viewer import Viewer, answers, server
from octex.viewer.key import user_key
from tests.make.fixtures import obj_lines
from tests.make.painted import balls
from tests.make.small_textures import eight_colors
from tests.viewer.conftest import Served


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A viewer of a small texture."""
    monkeypatch.setattr(server, "_FIRST", 4000)  # the first page is waited for 400 s, others 0.1 s
    path = tmp_path / "eight.octex"
    eight_colors().save(path)
    found = Served(lambda log: Viewer(lambda: octex.open(path), path, None, log=log))
    found.path = path
    yield found
    if found.thread.is_alive():
        events(found).close()  # a page that comes and goes: then it stops
    found.thread.join(10)
    assert not found.thread.is_alive()


def test_the_page_and_its_data_are_answered_to_who_has_the_token(served):
    for path in ("", "style.css", "viewer.js", "shaders/walk.glsl"):
        status, body = served.ask(path)
        assert status == 200
        assert body
        policy = served.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'")
        assert "http" not in policy
    header = json.loads(served.ask("data/header")[1])
    (part,) = header["parts"]
    assert (part["depth"], part["levelCells"]) == (1, [0, 1, 9])
    status, chunk = served.ask(
        f"data/{header['version']}/0-levels-0", Origin=f"http://127.0.0.1:{served.viewer.port}"
    )
    assert status == 200
    assert len(zlib.decompress(chunk, -15)) == part["levelNodes"][-1] * 2 + 1 + 9 + 27
    assert served.ask("data/header", Host=f"localhost:{served.viewer.port}")[0] == 200
    assert served.lines == []


@pytest.mark.parametrize(
    ("asked", "headers", "status", "line"),
    [
        ({"token": ""}, {}, 403, "the token is missing or wrong"),
        ({"token": "a" * 22}, {}, 403, "the token is missing or wrong"),
        ({"token": "", "path": "data/header"}, {}, 403, "the token is missing or wrong"),
        ({}, {"Host": "rebound.example"}, 403, "the host is 'rebound.example'"),
        ({}, {"Host": "127.0.0.1:1"}, 403, "the host is '127.0.0.1:1'"),
        ({}, {"Origin": "https://evil.example"}, 403, "the origin is 'https://evil.example'"),
        ({}, {"Origin": "null"}, 403, "the origin is 'null'"),
        ({}, {"Sec_Fetch_Site": "cross-site"}, 403, "another site asks"),
        ({}, {"Content_Length": "5"}, 413, "it has a body"),
        ({}, {"Transfer_Encoding": "chunked"}, 413, "it has a body"),
        ({"path": "../server.py"}, {}, 404, "there is no such file"),
        ({"path": "..%2f..%2fetc/passwd"}, {}, 404, "there is no such file"),
        ({"path": "/etc/passwd"}, {}, 404, "there is no such file"),
        ({"path": "data/../header"}, {}, 404, "there is no such data"),
        ({"path": "data/levels-9"}, {}, 404, "there is no such data"),
        ({"path": "data/../0/change"}, {}, 404, "there is no such data"),
    ],
)
def test_what_comes_from_elsewhere_is_refused_in_one_line(served, asked, headers, status, line):
    assert served.ask(**asked, **headers)[0] == status
    assert len(served.lines) == 1
    assert served.lines[0].startswith("refused: GET /")
    assert served.lines[0].endswith(line)
    assert served.ask("data/header")[0] == 200


def test_refusals_that_are_alike_are_logged_once_and_no_more_than_some(served, monkeypatch):
    monkeypatch.setattr(server, "_MOST_REFUSALS", 3)
    for _ in range(5):
        assert served.ask("events", token="a" * 22)[0] == 403
    assert len(served.lines) == 1
    for number in range(5):
        assert served.ask(f"events/{number}", token="a" * 22)[0] == 403
    assert len(served.lines) == 3


def test_other_methods_are_refused(served):
    for number, method in enumerate(["POST", "PUT", "DELETE", "OPTIONS", "HEAD"], 1):
        assert served.ask(method=method)[0] == 501
        assert len(served.lines) == number


def test_what_is_no_request_or_half_of_one_changes_nothing(served):
    for content in (b"GET", b"\x16\x03\x01\x02\x00", b"GET /\x1b[2J HTTP/1.1\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", served.viewer.port), timeout=60) as line:
            line.sendall(content)
            line.shutdown(socket.SHUT_WR)
            while line.recv(4096):
                pass
        assert all(line.isprintable() for line in served.lines)
        assert served.ask("data/header")[0] == 200


def test_half_a_request_is_given_up_and_an_idle_line_is_no_fault(served, monkeypatch):
    monkeypatch.setattr(answers.Handler, "timeout", 0.2)
    address = "127.0.0.1", served.viewer.port
    with socket.create_connection(address, timeout=5) as idle, socket.create_connection(address) as half:
        half.sendall(b"GET / HTTP/1.1\r\nHost: ")
        assert half.recv(10) == idle.recv(10) == b""
    assert len(served.lines) == 1
    assert "timed out" in served.lines[0]


def events(served):
    line = socket.create_connection(("127.0.0.1", served.viewer.port), timeout=5)
    host = f"127.0.0.1:{served.viewer.port}"
    line.sendall(f"GET /{served.viewer.token}/events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    return line


def until(line, text):
    found = ""
    while text not in found:
        found += line.recv(4096).decode()
    return found


def test_a_page_is_told_of_a_changed_file_and_of_a_broken_one(served):
    with events(served) as line:
        first = until(line, "event: version\ndata: ")
        eight_colors(metadata={"source": "another"}).save(served.path)
        assert first not in until(line, "event: version\ndata: ")
        served.path.write_bytes(b"broken")
        assert "eight.octex" in until(line, "event: changing\ndata: ")
        assert served.ask("data/header")[0] == 503
        eight_colors().save(served.path)
        until(line, "event: version\ndata: ")
        assert served.ask("data/header")[0] == 200


def test_the_server_stops_when_the_last_page_is_gone(served):
    with events(served) as line:
        until(line, "event: version")
        time.sleep(0.4)  # four times as long as it waits for pages
        assert served.thread.is_alive()
    served.thread.join(5)
    assert not served.thread.is_alive()


def test_a_port_that_is_taken_is_said(served):
    with pytest.raises(OutputError, match=f"port {served.viewer.port} of 127.0.0.1: .*; choose another"):
        Viewer(eight_colors, served.path, None, port=served.viewer.port)


def test_with_a_key_the_address_of_a_path_is_the_same_each_time(tmp_path):
    def made(name, key, port=0):
        eight_colors().save(tmp_path / name)
        return Viewer(eight_colors, tmp_path / name, None, port=port, key=key)

    def closed(viewer):
        viewer._server.server_close()
        return viewer.url

    first = closed(made("a.octex", b"key"))
    viewer = made("a.octex", b"key")
    assert viewer.url == first
    second = made("a.octex", b"key")  # at the same time
    assert (second.token, second.port != viewer.port) == (viewer.token, True)
    tokens = [viewer.token]
    for name, key in (("b.octex", b"key"), ("a.octex", b"other"), ("a.octex", b""), ("a.octex", b"")):
        each = made(name, key)
        tokens.append(each.token)
        closed(each)
    assert len(set(tokens)) == len(tokens)
    assert {len(token) for token in tokens} == {22}
    assert viewer.packed().header["version"] != second.packed().header["version"]
    assert [closed(viewer), closed(second)][0] == first


def test_a_proof_of_the_token_is_given_without_it_to_the_own_page_alone(served):
    status, body = served.ask("proof?abc", token="")
    assert (status, body.decode()) == (200, hmac.digest(served.viewer.token.encode(), b"abc", "sha256").hex())
    assert served.ask("proof?abc", token="", Origin="https://evil.example")[0] == 403
    assert served.ask("proof?abc", token="", Host="rebound.example")[0] == 403
    assert served.ask("proof", token="")[0] == 403


def test_the_key_is_made_once_and_is_for_its_user_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    key, path = user_key(), tmp_path / "state" / "octex" / "viewer.key"
    assert len(key) == 32
    assert user_key() == key == path.read_bytes()
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    if os.name == "posix":
        assert path.stat().st_mode & 0o777 == 0o600
        path.chmod(0o644)  # others may have read it
        assert user_key() != key
        assert path.stat().st_mode & 0o777 == 0o600
    path.write_bytes(b"short")
    assert len(user_key()) == 32
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    assert user_key() == b""


def test_ctrl_c_ends_the_command(tmp_path, monkeypatch, capfd):
    def interrupt_soon(_url):
        threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()

    monkeypatch.setattr(webbrowser, "open", interrupt_soon)
    eight_colors().save(tmp_path / "eight.octex")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored
    try:
        assert main(["view", str(tmp_path / "eight.octex")]) == ExitCode.DONE
    finally:
        signal.signal(signal.SIGINT, before)
    assert capfd.readouterr().out.startswith("http://127.0.0.1:")


def test_of_a_folder_all_parts_are_shown_or_one(tmp_path, monkeypatch):
    def view(*words):
        found = []

        def kept(viewer):
            viewer._server.server_close()
            found.append(viewer.packed().header["parts"])

        monkeypatch.setattr(Viewer, "run", kept)
        assert main(["view", str(tmp_path / "set"), "--no-browser", "--quiet", *words]) == ExitCode.DONE
        return found[0]

    two = balls([5, 5, 5], 4, 2)
    (tmp_path / "two.obj").write_text(obj_lines(two.vertices, two.triangles))
    two = octex.load_surface(tmp_path / "two.obj")
    textures = octex.convert_set(two, depth=3)
    textures.save(tmp_path / "set")
    names = list(textures)
    for words in ([], [str(tmp_path / "two.obj")]):
        assert [(part["name"], part["leaves"]) for part in view(*words)] == [
            (name, textures[name].tree.n_leaves) for name in names
        ]
    for number, name in enumerate(names):
        (header,) = view(str(tmp_path / "two.obj"), "--part", name)
        assert header["leaves"] == textures[name].tree.n_leaves
        assert header["mesh"]["triangles"] == (two.parts == number).sum()
    assert main(["view", str(tmp_path / "set"), "--part", "none"]) == ExitCode.REFUSED
