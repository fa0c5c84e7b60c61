"""Commands that pages post, and octex view --paint."""

import json
import socket

import pytest

import octex
from octex.cli.main import main
from octex.errors import ExitCode
from octex.session import painting as sessions
from octex.viewer import Viewer, answers
from tests.make.fixtures import obj_lines
from tests.make.painted import ball
from tests.make.strokes import OCTETS, PAGE, canvas, plain, stroke
from tests.viewer.test_session_refusals import BAD


def test_a_command_is_posted_and_the_change_is_there_for_pages(served):
    before = served.viewer.version()[0]
    status, body = served.post(stroke(1), Origin=f"http://127.0.0.1:{served.viewer.port}")
    assert (status, json.loads(body)) == (200, {"number": 1})
    served.session.wait()
    assert served.viewer.version()[0] != before
    change = served.viewer.of_version(before)[1]
    assert change.header["session"]["steps"] == ["Brush 1"]
    assert change.header["session"]["finished"] == {PAGE: 1}
    assert served.viewer.packed().header["session"]["done"] == 1
    assert served.lines == []


@pytest.mark.parametrize(
    ("asked", "status", "line"),
    [
        ({"token": "a" * 22}, 403, "the token is missing or wrong"),
        ({"token": ""}, 403, "the token is missing or wrong"),
        ({"Host": "rebound.example"}, 403, "the host is 'rebound.example'"),
        ({"Origin": "https://evil.example"}, 403, "the origin is 'https://evil.example'"),
        ({"Origin": "null"}, 403, "the origin is 'null'"),
        ({"Sec_Fetch_Site": "cross-site"}, 403, "another site asks"),
        ({"Transfer_Encoding": "chunked"}, 413, "it has a body"),
        ({"path": "data/header"}, 404, "commands are sent to session"),
        ({"Content_Type": "text/plain"}, 415, "a command is application/octet-stream"),
        ({"Content_Length": "-5"}, 411, "its length is missing"),
        ({"Content_Length": "1e9"}, 411, "its length is missing"),
        ({"Content_Length": str(10**9)}, 413, "1,000,000,000 bytes; at most 33,554,432"),
    ],
)
def test_commands_from_elsewhere_are_refused_in_one_line(served, asked, status, line):
    assert served.post(stroke(1), **asked)[0] == status
    assert len(served.lines) == 1
    assert served.lines[0].startswith("refused: POST /")
    assert served.lines[0].endswith(line)
    assert served.post(stroke(1))[0] == 200


def test_bad_commands_are_refused_and_the_server_goes_on(served):
    for body, _ in BAD:
        assert served.post(body)[0] == 400
    assert served.post(stroke(7))[0] == 409
    assert served.post(stroke(1))[0] == 200


def test_half_a_command_changes_nothing(served, monkeypatch):
    monkeypatch.setattr(answers.Handler, "timeout", 0.5)
    body, address = stroke(1), ("127.0.0.1", served.viewer.port)
    head = (
        f"POST /{served.viewer.token}/session HTTP/1.1\r\nHost: 127.0.0.1:{served.viewer.port}\r\n"
        f"Content-Type: {OCTETS}\r\nContent-Length: {len(body)}\r\n\r\n"
    ).encode()
    with socket.create_connection(address, timeout=5) as ends, socket.create_connection(address) as waits:
        ends.sendall(head + body[:50])
        ends.shutdown(socket.SHUT_WR)
        assert b" 400 " in ends.recv(4096)
        waits.sendall(head + body[:50])
        assert waits.recv(4096) == b""
    assert len(served.lines) == 2
    assert f"50 bytes of {len(body):,} arrived" in served.lines[0]
    assert "timed out" in served.lines[1]
    assert served.post(body)[0] == 200


def test_a_flood_of_strokes_is_held_up_and_loses_none(served, monkeypatch):
    monkeypatch.setattr(sessions, "_MOST_WAITING", 3)
    statuses = []
    for number in range(1, 41):
        while (status := served.post(stroke(number))[0]) == 429:
            statuses.append(status)
            served.session.wait()
        assert status == 200
    assert 429 in statuses
    served.session.wait()
    assert served.session.shown.status["done"] == 40


def test_a_port_that_is_taken_leaves_no_journal(served, tmp_path):
    canvas()[0].save(tmp_path / "a.octex")
    octex.write_model(canvas()[1], tmp_path / "a.ply")
    words = [str(tmp_path / "a.octex"), str(tmp_path / "a.ply"), "--paint", str(tmp_path / "b.octex")]
    assert main(["view", *words, "--port", str(served.viewer.port)]) == ExitCode.REFUSED
    assert not [*tmp_path.glob("b.*")]


def test_the_command_says_what_is_not_saved_and_recovers_it(tmp_path, monkeypatch, capfd):
    (tmp_path / "ball.obj").write_text(obj_lines(ball(12).vertices, ball(12).triangles))
    words = ["view", str(tmp_path / "ball.obj"), "--depth", "4", "--paint", str(tmp_path / "out.octex")]

    def paints(*bodies):
        def run(viewer):
            viewer._server.server_close()
            assert viewer.session is not None
            for body in bodies:
                viewer.session.take(body)
            viewer.session.wait()

        monkeypatch.setattr(Viewer, "run", run)

    paints(stroke(1))
    assert main([*words, "--no-browser"]) == ExitCode.DONE
    assert "1 painted step are not saved" not in (out := capfd.readouterr().out)
    assert "1 painted step is not saved: the same command with --recover" in out
    assert main([*words, "--no-browser"]) == ExitCode.REFUSED
    assert "out.octex.strokes has 1 command that was not saved; --recover" in capfd.readouterr().err
    paints(plain("save", 2))
    assert main([*words, "--no-browser", "--recover"]) == ExitCode.DONE
    captured = capfd.readouterr()
    assert "1 command is painted again" in captured.err
    assert captured.out.count("\n") == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == ["ball.obj", "out.octex"]
