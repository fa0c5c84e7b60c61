"""What a session of painting refuses, what it tells of commands that fail, and commands that pages post."""

import gc
import json
import socket

import pytest

import octex
from octex.channels import NORMAL
from octex.cli.main import main
from octex.errors import ArgumentError, ExitCode
from octex.session import painting as sessions
from octex.session.painting import Session
from octex.viewer import Viewer, answers
from tests.make.fixtures import obj_lines
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.small_textures import with_channel
from tests.make.strokes import OCTETS, PAGE, camera, camera_sent, canvas, deflated, plain, stroke, take

NAN = float("nan")


def fill(**given):
    return plain("fill", 1, **{"color": [1, 2, 3]} | given)


def sent(**given):
    return stroke(1, **given)


def layer(**given):
    return plain("layer", 1, **given)


SPOT = {"center": [0.4, 0.2, 0.9], "radius": 0.6, "up": [0.0, 1.0, 0.1]}
#: What is no patch, and what is said of it.
PATCHES = [
    ([1], "patch must be an object"),
    ({}, "center"),
    (SPOT | {"center": [1, 2]}, "center"),
    (SPOT | {"center": [1, 2, NAN]}, "center"),
    (SPOT | {"radius": 0}, "radius"),
    (SPOT | {"radius": NAN}, "radius"),
    (SPOT | {"radius": 1e300}, "radius"),
    (SPOT | {"up": "y"}, "up"),
]
#: What is no moment of an animation.
MOMENTS = [([0, 1], "moved"), ({}, "animation"), ({"animation": 0}, "time")]
MOMENTS += [({"animation": number, "time": 0.0}, "animation") for number in (0.5, -1, "A", 1e9)]
MOMENTS += [({"animation": 0, "time": time}, "time") for time in (NAN, -1.0, 1e300)]
#: Values of channels that are no numbers.
VALUES = [([0.5], "must be an object"), ("roughness", "must be an object")]
VALUES += [({str(n): [0] for n in range(17)}, "at most 16 channels")]
WRONG = 0.5, [NAN], [1e300], ["0.5"], [[0.5]], None
VALUES += [({"roughness": each}, "roughness must be finite numbers") for each in WRONG]
BLENDS = "unknown blend .*; there are: over, multiply, screen, add"
#: Bodies that are no commands, and what is said of them.
BAD = [
    (b"", "the command's line must be a JSON object"),
    (b"\xff\xfe{}\n", "must be a JSON object"),
    (b"[" * 100_000, "must be a JSON object"),
    (b"[]\n", "must be a JSON object"),
    (plain("undo", 1, page="../../etc"), "page must be"),
    (plain("undo", 0), "number"),
    (plain("undo", 10**30), "number"),
    (plain("undo", "1"), "number"),
    (plain("erase all", 1), "kind must be one of"),
    (plain("undo", 1) + b"more", "has no content"),
    (plain("fill", 1, color=[1, 2]), "color"),
    (plain("fill", 1, color=[1, 2, 3], opacity=2), "opacity"),
    (stroke(1, name="x" * 50), "name must be"),
    (stroke(1, name="a\x1b[2J"), "name must be"),
    (stroke(1, color=[NAN, 0, 0]), "color"),
    (stroke(1, color=[-1, 0, 0]), "color"),
    (stroke(1, color="red"), "color"),
    (stroke(1, opacity=NAN), "opacity"),
    (stroke(1, maxAngle=NAN), "max_angle"),
    (stroke(1, backFaces="yes"), "back_faces"),
    (stroke(1, camera=None), "camera"),
    (stroke(1, camera={"width": 10**9, "height": 10**9}), "width"),
    (stroke(1, camera=camera_sent(camera()) | {"K": [[NAN] * 3] * 3}), "K"),
    (stroke(1, camera=camera_sent(camera()) | {"pose": [[NAN] * 4] * 4}), "pose"),
    (stroke(1, box=[0, 0, 1e9, 1e9]), "box must be a part"),
    (stroke(1, box=[0, 0, 48.5, 32]), "box must be a part"),
    (stroke(1, box=[10, 4, 10, 28]), "box must be a part"),
    (stroke(1, box=[NAN, 4, 10, 28]), "box"),
    (stroke(1, content=b"not deflated"), "not deflated coverage of 720 pixels"),
    (stroke(1, content=deflated(bytes(719))), "not deflated coverage of 720 pixels"),
    (stroke(1, content=deflated(bytes(10**8))), "not deflated coverage of 720 pixels"),
    (stroke(1)[:-5], "not deflated coverage of 720 pixels"),
    (stroke(1, mirror="w"), "mirror must be x, y, z"),
    (stroke(1, hidden="yes"), "hidden must be True or False"),
    (stroke(1, at=[1, 2]), "at"),
    (stroke(1, at=[NAN, 0, 0]), "at"),
    (stroke(1, mirror="x", offset=NAN), "offset"),
    (stroke(1, mirror="x", offset=1e13), "offset"),
    (fill(tolerance=20), "tolerance needs at"),
    (fill(at=[0, 0, 1], tolerance=-1), "tolerance"),
    (fill(at=[0, 0, 1], tolerance=256), "tolerance"),
    (fill(at=[0, 0, 1], tolerance=9, connected=1), "connected"),
    *((make(blend=each), BLENDS) for each in ("darken", "erase", 3, None, []) for make in (sent, fill)),
    *((make(values=values), why) for values, why in VALUES for make in (sent, fill)),
    *((stroke(1, moved=moved), why) for moved, why in MOMENTS),
    *((stroke(1, patch=patch), why) for patch, why in PATCHES),
    (plain("channel", 1), "channel must be a name"),
    (plain("channel", 1, channel=3), "channel must be a name"),
    (plain("save", 1, replace="yes"), "replace must be True or False"),
    (layer(action="add", title=""), "name must be a line of 1 to 40"),
    (layer(action="add", opacity=2), "opacity"),
    (layer(action="add", opacity="much"), "opacity"),
    (layer(action="add", blend="erase"), "unknown blend"),
    (layer(action="set", layer=1, isVisible=1), "is_visible"),
    (layer(action="set", layer=0), "layer"),
    (layer(action="set", layer="1"), "layer"),
    (layer(action="set"), "name the layer to set"),
    (layer(action="move", layer=1), "place"),
    (layer(action="split", layer=1), "unknown action 'split'; there are: add, set, move, copy"),
    (layer(), "unknown action"),
    (stroke(1, mask=True), "name a layer"),
    (stroke(1, layer=1, mask="yes"), "mask"),
    (stroke(1, layer=-1), "layer"),
    (stroke(1, erases=3), "erases"),
]


def test_what_is_no_command_is_refused(session):
    gc.collect()  # what earlier tests left open must not be closed, with a warning, deep in a recursion
    for body, why in BAD:
        with pytest.raises(ArgumentError, match=why):
            session.take(body)
    for asked, why in (
        *((json.dumps({"patch": patch}), why) for patch, why in PATCHES),
        *((text, "patch") for text in ("", "{", "[]", "{}", "[" * 100_000)),
    ):
        with pytest.raises(ArgumentError, match=why):
            session.patch(asked)
    assert session.take(stroke(1)) == 1


#: Fields of strokes and fills that nothing is painted of, and what is told.
FAILING = [
    ({"values": {"roughness": [1.01]}}, "values of 'roughness' must be from 0 to 1"),
    ({"values": {"roughness": [-0.01]}}, "values of 'roughness' must be from 0 to 1"),
    ({"values": {"roughness": [0.5, 0.5]}}, "values of 'roughness' must be 1, not 2"),
    ({"values": {"roughness": []}}, "values of 'roughness' must be 1, not 0"),
    ({"values": {"base_color": [1, 2, 3]}}, "color is the value of 'base_color'"),
    ({"values": {"emissive": [0, 0, 256]}}, "values of 'emissive' must be codes of 0 to 255"),
    ({"values": {"emissive": [0.5]}}, "values of 'emissive' must be 3, not 1"),
    ({"values": {"occlusion": [0.5]}}, "unknown channel of the texture 'occlusion'"),
    ({"values": {"alpha": [0.5]}}, "alpha is painted with blend"),
    ({"values": {"normal": [0, 0, 1]}}, "'normal' holds directions, which values do not paint"),
    ({"layer": 5}, "there is no layer 5"),
]
#: Other commands that fail.
OTHERS = [
    *(("channel", {"channel": name}, "unknown channel to add") for name in ("normal", "colour", "../x")),
    ("channel", {"channel": "base_color"}, "unknown channel to add"),
    ("layer", {"action": "move", "layer": 5, "place": 0}, "there is no layer 5"),
]


def test_what_cannot_be_done_changes_nothing_and_is_told(tmp_path):
    surface = ball(12).with_sources({"roughness": 0.5, "emissive": (0.0, 0.0, 0.0), "alpha": 1.0})
    texture = octex.convert(surface, depth=4)
    texture = with_channel(texture, NORMAL, 0)
    session = Session(texture, surface, tmp_path / "out.octex")
    failing = [("stroke", fields, why) for fields, why in FAILING]
    failing += [("fill", {"color": [1, 2, 3], **fields}, why) for fields, why in FAILING]
    for number, (kind, fields, why) in enumerate([*failing, *OTHERS], 1):
        take(session, stroke(number, **fields) if kind == "stroke" else plain(kind, number, **fields))
        assert why in session.shown.status["error"]
        assert session.shown.status["finished"] == {PAGE: number}
    assert session.shown.status["steps"] == []
    assert_same(session.shown.texture, texture)
    session.close()


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
