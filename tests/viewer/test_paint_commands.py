"""Commands of pages do what the library does, bit for bit."""

import json
import os

import numpy as np
import pytest

import octex
from octex.channels import decode
from octex.nearest.triangles import Triangles
from octex.painting.region import alike
from octex.session.painting import Session, mirrored
from octex.source.corners import at_corners
from tests.make.painted import ball, plain, together
from tests.make.same import assert_same
from tests.make.strokes import PAGE, camera, image_sent, ones, stroke, take
from tests.make.strokes import plain as plain_command

BLENDS = ["over", "multiply", "screen", "add"]


def two_balls():
    """A ball before another one, as the camera of strokes sees them."""
    one, other = ball(8), ball(12)
    away = camera().world_to_camera[2, :3] * 3
    mesh = together((one.vertices, one.triangles), (0.8 * other.vertices + away, other.triangles))
    surface = plain(mesh)
    return octex.convert(surface, depth=5), surface


def library_calls(painter, surface, body):
    """Do what a command says with calls of the library; return what a painter returns of each."""
    line = json.loads(body.partition(b"\n")[0])
    blend, opacity, axis = line.get("blend", "over"), line.get("opacity", 1.0), line.get("mirror", "")
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    plane = (low + high) / 2 + line.get("offset", 0.0)
    points = [np.array(line["at"])] if "at" in line else []
    if axis and points:
        n = "xyz".index(axis)
        points.append(points[0] + 2 * (plane - points[0]) * np.eye(3)[n])
    found = Triangles.of(surface.rest, surface.triangles).nearest(np.array(points)) if points else None
    parts = [surface.parts == surface.parts[n] for n in found.triangles] if found else []
    if line["kind"] == "fill":
        color, regions = decode(np.array(line["color"], np.uint8), "srgb"), parts
        if "tolerance" in line:
            at = at_corners(surface.rest, surface.triangles[found.triangles], found.barycentric)
            texture, connected = painter.texture(), line.get("connected", True)
            regions = [alike(texture, each, line["tolerance"], connected=connected) for each in at]
        elif not parts:
            regions = [ones]
        elif len(parts) > 1 and (parts[0] == parts[1]).all():
            regions = parts[:1]
        elif len(parts) > 1 and parts[1][0]:
            regions = parts[::-1]
        return [painter.fill(each, color, opacity=opacity, blend=blend) for each in regions]
    image = image_sent(line["number"], line["color"])
    shown = [octex.Projection(image, camera(), opacity=opacity, blend=blend)]
    if axis:
        shown.append(mirrored(shown[0], "xyz".index(axis), plane["xyz".index(axis)]))
    options = {"back_faces": line.get("backFaces", False), "hidden": line.get("hidden", False)}
    where = parts or [None, None]
    return [
        painter.paint(each, region=own, max_angle=line["maxAngle"], **options)
        for each, own in zip(shown, where, strict=False)
    ]


FRONT, BACK = [0.3, 0.2, 1.0], (camera().world_to_camera[2, :3] * 3).tolist()


PLACES = [
    {"hidden": True},
    {"backFaces": True, "maxAngle": 40},
    {"hidden": True, "backFaces": True, "maxAngle": 90},
    {"at": FRONT},
    {"at": BACK, "hidden": True},
    {"mirror": "x", "at": FRONT},
    {"mirror": "z", "offset": 0.3},
    {"mirror": "y", "offset": -0.2, "at": BACK, "hidden": True, "blend": "multiply"},
]


@pytest.mark.parametrize("given", PLACES)
def test_what_is_hit_is_bit_for_bit_what_the_library_hits(given, tmp_path):
    texture, surface = two_balls()
    session, painter = Session(texture, surface, tmp_path / "out.octex"), octex.Painter(texture, surface)
    body = stroke(1, **given)
    take(session, body)
    library_calls(painter, surface, body)
    assert session.shown.status["error"] == ""
    assert_same(session.shown.texture, painter.texture())
    ways = np.array([FRONT, BACK]) / np.linalg.norm([FRONT, BACK], axis=1, keepdims=True)
    points = np.array([ways[0], BACK - 0.8 * ways[1]])  # where both face the camera
    if not given.get("mirror"):
        apart = np.abs(session.shown.texture.sample(points) - texture.sample(points)).max(axis=1) > 0.05
        hits = [given.get("at") != BACK, "hidden" in given and given.get("at") != FRONT]
        assert apart.tolist() == hits
    session.close()


def random_command(random, number):
    """A stroke or a fill with some options, or what undoes or redoes one."""
    kind = random.choice(["stroke", "stroke", "stroke", "fill", "undo", "redo"])
    if kind in ("undo", "redo"):
        return plain_command(kind, number)
    given = {"blend": random.choice(BLENDS), "opacity": float(random.uniform(0.2, 1))}
    if random.random() < 0.4:
        given |= {"mirror": random.choice(["x", "y", "z"]), "offset": float(random.uniform(-0.5, 0.5))}
    if random.random() < 0.5:
        given["at"] = [FRONT, BACK][random.integers(2)]
    if kind == "fill":
        if "at" in given and random.random() < 0.7:
            given |= {"tolerance": float(random.uniform(0, 60)), "connected": bool(random.random() < 0.5)}
        return plain_command("fill", number, color=random.integers(0, 256, 3).tolist(), **given)
    options = {"hidden": bool(random.random() < 0.4), "backFaces": bool(random.random() < 0.3)}
    return stroke(number, **given, **options, maxAngle=float(random.choice([60, 85, 90])))


# Seeds 11 and 12 have every blend mode in strokes and fills, and fills of one colour, mirrored or connected.
@pytest.mark.parametrize("seed", range(11, 11 + int(os.environ.get("OCTEX_TEST_SESSIONS", "2"))))
def test_random_commands_do_bit_for_bit_what_the_library_does_also_after_a_crash(seed, tmp_path):
    random, (texture, surface) = np.random.default_rng(seed), two_balls()
    session, painter = Session(texture, surface, tmp_path / "out.octex"), octex.Painter(texture, surface)
    done = []
    undone = []
    for number in range(1, 13):
        body = random_command(random, number)
        kind = json.loads(body.partition(b"\n")[0])["kind"]
        assert session.take(body) == number
        if kind in ("undo", "redo"):
            taken, put = (done, undone) if kind == "undo" else (undone, done)
            if taken:
                put.append(taken.pop())
                for _ in range(put[-1]):
                    getattr(painter, kind)()
        elif strokes := sum(map(bool, library_calls(painter, surface, body))):
            done.append(strokes)
            undone.clear()
        session.wait()
        assert session.shown.status["error"] == ""
        assert_same(session.shown.texture, painter.texture())
        assert (session.shown.status["done"], session.shown.status["finished"]) == (len(done), {PAGE: number})
    session.close()
    again = Session(texture, surface, tmp_path / "out.octex", recover=True)
    assert_same(again.shown.texture, painter.texture())
    again.close()
