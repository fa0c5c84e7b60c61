"""What a session of painting refuses at once, and what it tells of commands that fail."""

import gc
import json

import pytest

import octex
from octex.channels import NORMAL
from octex.errors import ArgumentError
from octex.session.painting import Session
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.small_textures import with_channel
from tests.make.strokes import PAGE, camera, camera_sent, deflated, plain, stroke, take

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
