"""Painting of any channel, several at once: as the same calls of the library do, and added channels."""

import os

import numpy as np
import pytest

import octex
from octex.channels import ChannelFormat, decode, encode
from octex.editing.draft import Change, joined_change
from octex.session.painting import Session
from octex.viewer.changes import change_between, change_of
from tests.make.painted import ball
from tests.make.same import assert_same
from tests.make.small_textures import with_channel
from tests.make.strokes import SIZE, camera, disc, image_sent, ones, plain, stroke, take, without_color

#: What the values of a command are, beside its colour.
GIVEN = {"roughness": [0.25], "metallic": [1], "emissive": [10, 200, 30], "height": [1.75]}


def canvas():
    """A ball with material channels, and a height in floats."""
    surface = ball(12).with_sources({"roughness": 0.5, "metallic": 0.0, "emissive": (0.1, 0.0, 0.0)})
    form = ChannelFormat("height", 1, "data", "float16")
    return with_channel(octex.convert(surface, depth=5), form, 0), surface


def image(number, form, value, blend="over"):
    """The image of a stroke by its value, as a user of the library makes it."""
    if form.components == 3:
        image = image_sent(number, value)
    elif form.dtype == "uint8":
        image = image_sent(number, (*encode(np.array(value, np.float64), "uint8", "data"), 0, 0))
    else:
        image = np.zeros((SIZE[1], SIZE[0], 4), np.float32)
        image[..., 0] = np.float16(value[0])
        image[4:28, 10:40, 3] = disc(number) * (1 / 255)
    return octex.Projection(image, camera(), opacity=0.8, blend=blend)


def painted(painter, number, values, blend="over"):
    """Paint channels in the texture's order."""
    for name, channel in painter.texture().channels.items():
        if name in values:
            painter.paint(image(number, channel.format, values[name], blend), channel=name, max_angle=85)


def light_of(form, value):
    """Return a value as fills of the library take it."""
    if form.components == 3:
        return decode(np.array(value, np.uint8), "srgb")
    return decode(encode(np.array(value, np.float64), form.dtype, "data"), "data")


def color_of(number):
    return [200, 10 * (number % 20), 30]


@pytest.fixture
def session(tmp_path):
    found = Session(*canvas(), tmp_path / "out.octex")
    yield found
    found.close()


def test_mirrored_and_blended_strokes_paint_all_channels(session):
    texture, _ = canvas()
    take(session, stroke(1, values={"metallic": [1]}, mirror="x", blend="screen"))
    assert session.shown.status["done"] == 1
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for name in ("base_color", "metallic"):
        apart = session.shown.texture.sample(points, name) - texture.sample(points, name)
        is_painted = np.abs(apart).max(axis=1) > 0.05
        assert is_painted[points[:, 0] > 0.3].any()
        assert is_painted[points[:, 0] < -0.3].any()


def test_an_added_channel_is_a_step_and_can_be_painted(session, tmp_path):
    texture, surface = canvas()
    bodies = [
        plain("channel", 1, channel="occlusion", name="Add occlusion"),
        stroke(2, values={"occlusion": [0.5]}),
        *(plain(kind, number) for number, kind in enumerate(("undo", "undo", "redo", "redo"), 3)),
    ]
    seen = []
    for body in bodies:
        take(session, body)
        assert session.shown.status["error"] == ""
        seen.append(session.shown.texture)
    added = seen[0].channels["occlusion"]
    assert added.format == ChannelFormat("occlusion", 1, "data")
    assert all((part == 255).all() for part in added[1:])
    others = {name: seen[0].channels[name] for name in texture.channels}
    assert_same(texture.with_cells(seen[0].tree, others), texture)
    painter = octex.Painter(seen[0], surface)
    painted(painter, 2, {"occlusion": [0.5], "base_color": color_of(2)})
    for found, expected in zip(
        seen[1:], (painter.texture(), seen[0], texture, seen[0], seen[1]), strict=True
    ):
        assert_same(found, expected)
    assert session.shown.status["steps"] == ["Add occlusion", "Brush 2"]
    session.close()
    again = Session(*canvas(), tmp_path / "out.octex", recover=True)
    take(again, plain("save", 7))
    for found in (again.shown.texture, octex.open(tmp_path / "out.octex")):
        assert_same(found, seen[5])
    again.close()


def test_an_added_channel_has_its_neutral_value(tmp_path):
    surface, number = ball(8), 0
    session = Session(octex.convert(surface, depth=3), surface, tmp_path / "out.octex")
    neutral = {"metallic": 0.0, "roughness": 1.0, "occlusion": 1.0, "emissive": 0.0, "height": 0.5}
    for name, value in neutral.items():
        take(session, *(plain("channel", number + n, channel=name) for n in (1, 2)))
        number += 2
        found = session.shown.texture.sample([[0.0, 0.0, 1.0]], name)
        np.testing.assert_allclose(found, value, atol=0.5 / 255)
        assert f"has the channel '{name}' already" in session.shown.status["error"]
    session.close()


def test_pages_are_sent_a_stroke_of_several_channels_by_its_tiles():
    surface = ball(48).with_sources({"roughness": 0.5, "metallic": 0.0})
    painter = octex.Painter(octex.convert(surface, depth=8), surface)
    before = painter.texture()
    values = {"base_color": color_of(1), "roughness": [0.1], "metallic": [1.0]}
    painted(painter, 1, values)
    painter.fill(octex.Sphere((1.0, 0.0, 0.0), 0.05), (0.1, 0.2, 0.3))
    changes = [change for each in painter.strokes for change in each]
    after = painter.texture()
    for some in (changes, changes[:3]):
        if some is not changes:
            painter.undo()
        after = painter.texture()
        joined = joined_change(some, before, after)
        assert joined.tiles is not None
        assert change_of(joined, before, after) == change_between(before, after)
        back = joined.inverted()
        assert change_of(back, after, before) == change_between(after, before)
        assert_same(joined.put_into(before), after)
        assert_same(back.put_into(after), before)
    grown = before.with_cells(before.tree, before.channels)
    assert joined_change([changes[0], Change(None, before, grown)], before, grown).tiles is None


@pytest.mark.parametrize("seed", range(int(os.environ.get("OCTEX_TEST_SESSIONS", "2"))))
def test_random_commands_do_what_calls_of_the_library_do_and_are_recovered(seed, tmp_path):
    random = np.random.default_rng(seed)
    texture, surface = canvas()
    history, done = [texture], 0
    session = Session(texture, surface, tmp_path / "out.octex")
    for number in range(1, 15):
        kind = random.choice(["stroke", "stroke", "fill", "channel", "undo", "redo"])
        now = history[done]
        values = {name: value for name, value in GIVEN.items() if random.random() < 0.4}
        has_color = not values or random.random() < 0.5
        blend = str(random.choice(["over", "multiply"]))
        if kind == "undo":
            body, done = plain("undo", number), max(done - 1, 0)
        elif kind == "redo":
            body, done = plain("redo", number), min(done + 1, len(history) - 1)
        elif kind == "channel":
            name = "specular" if "occlusion" in now.channels else "occlusion"
            body = plain("channel", number, channel=name)
            if name not in now.channels:
                form = ChannelFormat(name, *((3, "srgb") if name == "specular" else (1, "data")))
                history[done + 1 :], done = (
                    [with_channel(now, form, 56 if name == "specular" else 255)],
                    done + 1,
                )
        else:
            painter = octex.Painter(now, surface)
            lit = values | ({"base_color": color_of(number)} if has_color else {})
            if kind == "stroke":
                body = stroke(number, values=values, blend=blend)
                painted(painter, number, lit, blend)
            else:
                body = plain("fill", number, values=values, color=color_of(number), opacity=0.3, blend=blend)
                for name, channel in now.channels.items():
                    if name in lit:
                        light = light_of(channel.format, lit[name])
                        painter.fill(ones, light, channel=name, opacity=0.3, blend=blend)
            body = body if has_color else without_color(body)
            history[done + 1 :], done = [painter.texture()], done + 1
        take(session, body)
        assert_same(session.shown.texture, history[done])
        assert session.shown.status["done"] == done
    session.close()
    again = Session(*canvas(), tmp_path / "out.octex", recover=True)
    assert_same(again.shown.texture, history[done])
    assert again.shown.status["done"] == done
    again.close()
