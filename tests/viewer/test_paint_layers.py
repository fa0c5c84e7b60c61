"""Layers and the eraser of pages that paint: commands do what the library does, and pages show it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octex
from octex.errors import ArgumentError
from octex.painting.picture import Blend
from octex.viewer.session import Session
from tests.make.same import assert_same
from tests.viewer.test_session import PAGE, SIZE, camera, canvas, disc, plain, stroke


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    found = Session(*canvas(), tmp_path / "out.octex")
    yield found
    found.close()


def painted(layers: octex.Layers, number: int, blend: Blend = "over") -> None:
    """Paint what `stroke` sends as a user of the library does."""
    image = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    image[..., :3] = 200, 10 * (number % 20), 30
    image[4:28, 10:40, 3] = disc(number)
    layers.paint(octex.Projection(image, camera(), opacity=0.8, blend=blend), max_angle=85)


def ones(points: Any) -> Any:
    return np.ones(len(points))


class Both:
    """A session and the same calls of the library."""

    def __init__(self, session: Session) -> None:
        self.session, self.layers, self.number = session, octex.Layers(*canvas()), 0

    def send(self, kind: str, **given: Any) -> None:
        self.number += 1
        make = stroke(self.number, **given) if kind == "stroke" else plain(kind, self.number, **given)
        self.session.take(make)
        self.session.wait()
        assert self.session.shown.told["fault"] == ""
        assert_same(self.session.shown.texture, self.layers.texture())
        told = [
            (each["number"], each["title"], each["opacity"]) for each in self.session.shown.told["layers"]
        ]
        assert told == [(each.number, each.name, each.opacity) for each in self.layers.layers]
        assert self.session.shown.told["done"] == len(self.layers.strokes)

    def do(self, random: np.random.Generator) -> None:
        """Do one thing at random."""
        layers, numbers = self.layers, [each.number for each in self.layers.layers]
        move = random.choice(["stroke", "fill", "add", "set", "move", "delete", "undo", "redo"],
                             p=[0.35, 0.1, 0.12, 0.15, 0.06, 0.04, 0.12, 0.06])  # fmt: skip
        number = int(random.choice(numbers)) if numbers else None
        if move in ("stroke", "fill"):
            target: dict[str, Any] = {} if number is None or random.random() < 0.2 else {"layer": number}
            if target and random.random() < 0.15:
                target["mask"] = True
            erases = bool(random.random() < 0.3)
            layers.choose(target.get("layer"), mask="mask" in target)
            blend: Blend = "erase" if erases else "over"
            if move == "stroke":
                painted(layers, self.number + 1, blend)
                self.send("stroke", erases=erases, **target)
            else:
                layers.fill(ones, (1.0, 0.0, 0.0), opacity=0.5, blend=blend)
                self.send("fill", color=[255, 0, 0], opacity=0.5, erases=erases, **target)
        elif move == "add" and len(numbers) < 4:
            layers.choose(number)
            layers.add_layer(blend="screen", opacity=0.7)
            self.send(
                "layer", action="add", blend="screen", opacity=0.7, **({"layer": number} if number else {})
            )
        elif move == "set" and number is not None:
            wanted, own = (
                ({"opacity": 0.3}, {"opacity": 0.3}),
                ({"isVisible": False}, {"is_visible": False}),
                ({"isVisible": True, "blend": "multiply"}, {"is_visible": True, "blend": "multiply"}),
                ({"title": "Dirt"}, {"name": "Dirt"}),
                ({"hasMask": True}, {"has_mask": True}),
            )[random.integers(5)]
            layers.change_layer(number, **own)  # type: ignore[arg-type]
            self.send("layer", action="set", layer=number, **wanted)
        elif move == "move" and number is not None:
            place = int(random.integers(len(numbers)))
            layers.move_layer(number, place)
            self.send("layer", action="move", layer=number, place=place)
        elif move == "delete" and number is not None:
            layers.delete_layer(number)
            self.send("layer", action="delete", layer=number)
        elif move in ("undo", "redo"):
            getattr(layers, move)()
            self.send(move)


@pytest.mark.parametrize("seed", range(4))
def test_random_commands_do_what_the_library_does_and_a_crash_loses_none(seed: int, tmp_path: Path) -> None:
    random, session = np.random.default_rng([3, seed]), Session(*canvas(), tmp_path / "out.octex")
    both = Both(session)
    for _ in range(25):
        both.do(random)
    session.close()
    again = Session(*canvas(), tmp_path / "out.octex", recover=True)
    assert again.repeated == both.number
    assert_same(again.shown.texture, both.layers.texture())
    assert again.shown.told["layers"] == session.shown.told["layers"]
    assert again.shown.told["steps"] == session.shown.told["steps"]
    again.close()


def test_what_is_wrong_with_a_layer_is_said_at_once_and_one_that_is_gone_is_told(session: Session) -> None:
    for given, message in (
        ({"action": "add", "title": ""}, "name must be a line of 1 to 40"),
        ({"action": "add", "opacity": 2}, "opacity"),
        ({"action": "add", "opacity": "much"}, "opacity"),
        ({"action": "add", "blend": "erase"}, "unknown blend"),
        ({"action": "set", "layer": 1, "isVisible": 1}, "is_visible"),
        ({"action": "set", "layer": 0}, "layer"),
        ({"action": "set", "layer": "1"}, "layer"),
        ({"action": "set"}, "name the layer to set"),
        ({"action": "move", "layer": 1}, "place"),
        ({"action": "merge", "layer": 1}, "unknown action 'merge'; there are: add, set, move, delete"),
        ({}, "unknown action"),
    ):
        with pytest.raises(ArgumentError, match=message):
            session.take(plain("layer", 1, **given))
    for given in ({"mask": True}, {"layer": 1, "mask": "yes"}, {"layer": -1}, {"erases": 3}):
        with pytest.raises(ArgumentError):
            session.take(stroke(1, **given))
    session.take(stroke(1, layer=5))
    session.wait()
    assert session.shown.told["fault"] == "there is no layer 5"
    assert session.shown.told["baked"] == {PAGE: 1}
    session.take(plain("layer", 2, action="move", layer=5, place=0))
    session.wait()
    assert (session.shown.told["fault"], session.shown.told["done"]) == ("there is no layer 5", 0)
    assert_same(session.shown.texture, canvas()[0])
