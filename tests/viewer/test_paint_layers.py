"""Layers and the eraser of pages that paint: commands do what the library does, and pages show it."""

from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.cli.main import main
from octex.errors import ArgumentError, ExitCode
from octex.session.painting import Session, Shown
from octex.viewer import Viewer
from tests.make.fixtures import obj_lines
from tests.make.same import assert_same
from tests.make.strokes import canvas, ones, painted, plain, stroke, take
from tests.make.studio import imaged
from tests.viewer.test_paint_brush import LINE, assert_same_inside, drawn_and_baked


class Both:
    """A session and the same calls of the library."""

    def __init__(self, session):
        self.session, self.layers, self.number = session, octex.Layers(*canvas()), 0

    def send(self, kind, **given):
        self.number += 1
        take(self.session, (stroke if kind == "stroke" else partial(plain, kind))(self.number, **given))
        told = self.session.shown.status
        assert told["error"] == ""
        assert_same(self.session.shown.texture, self.layers.texture())
        layers = [(each["number"], each["title"], each["opacity"]) for each in told["layers"]]
        assert layers == [(each.number, each.name, each.opacity) for each in self.layers.layers]
        assert told["done"] == len(self.layers.strokes)

    def do(self, random):
        """Do one thing at random."""
        layers, numbers = self.layers, [each.number for each in self.layers.layers]
        move = random.choice(MOVES, p=LIKELY)
        number = int(random.choice(numbers)) if numbers else None
        if move in ("stroke", "fill"):
            target = {} if number is None or random.random() < 0.2 else {"layer": number}
            if target and random.random() < 0.15:
                target["mask"] = True
            target["erases"] = bool(random.random() < 0.3)
            layers.choose(target.get("layer"), mask="mask" in target)
            blend = "erase" if target["erases"] else "over"
            if move == "stroke":
                painted(layers, self.number + 1, blend)
                self.send("stroke", **target)
            else:
                layers.fill(ones, (1.0, 0.0, 0.0), opacity=0.5, blend=blend)
                self.send("fill", color=[255, 0, 0], opacity=0.5, **target)
        elif move == "add" and len(numbers) < 4:
            given = {"blend": "screen", "opacity": 0.7}
            layers.choose(number)
            layers.add_layer(**given)
            self.send("layer", action="add", **given, **({"layer": number} if number else {}))
        elif move == "set" and number is not None:
            name, own, value = SETTINGS[random.integers(5)]
            layers.change_layer(number, **{own: value})
            self.send("layer", action="set", layer=number, **{name: value})
        elif move == "move" and number is not None:
            place = int(random.integers(len(numbers)))
            layers.move_layer(number, place)
            self.send("layer", action="move", layer=number, place=place)
        elif move in ("copy", "merge", "delete") and number is not None:
            with suppress(ArgumentError):  # not all can be merged
                getattr(layers, f"{move}_layer")(number)
                self.send("layer", action=move, layer=number)
        elif move in ("undo", "redo"):
            getattr(layers, move)()
            self.send(move)


MOVES = ["stroke", "fill", "add", "set", "move", "copy", "merge", "delete", "undo", "redo"]
LIKELY = [0.3, 0.1, 0.12, 0.12, 0.06, 0.04, 0.06, 0.04, 0.1, 0.06]
#: Settings of layers: of a page, of the library, and a value.
SETTINGS = [
    ("opacity", "opacity", 0.3),
    ("isVisible", "is_visible", False),
    ("blend", "blend", "multiply"),
    ("title", "name", "Dirt"),
    ("hasMask", "has_mask", True),
]


@pytest.mark.parametrize("seed", range(4))
def test_random_commands_do_what_the_library_does_and_a_crash_loses_none(seed, tmp_path):
    random, session = np.random.default_rng([3, seed]), Session(*canvas(), tmp_path / "out.octex")
    both = Both(session)
    for _ in range(25):
        both.do(random)
    session.close()
    again = Session(*canvas(), tmp_path / "out.octex", recover=True)
    assert again.repeated == both.number
    assert_same(again.shown.texture, both.layers.texture())
    assert again.shown.status["layers"] == session.shown.status["layers"]
    assert again.shown.status["steps"] == session.shown.status["steps"]
    again.close()


def test_a_stroke_in_the_top_layer_is_seen_at_once_as_it_is_baked_and_can_be_erased(studio, page):
    page.evaluate("document.getElementById('layers').open = true")
    page.click("#layer-add")
    studio.is_done(page)
    assert page.evaluate("viewer.painting.layers.active") == 1
    images = drawn_and_baked(studio, page, [({}, LINE)])
    assert_same_inside(images)
    page.keyboard.press("e")
    page.evaluate("viewer.painting.set({ size: 160, hardness: 1 })")
    studio.drag(page, *LINE)
    studio.is_done(page)
    assert np.abs(imaged(page) - images[0]).max() <= 1
    page.click("#layer-delete")
    studio.is_done(page)
    last = page.evaluate("[viewer.painting.layers.active, viewer.painting.status.steps.at(-1)]")
    assert last == [None, "Delete a layer"]


def test_the_list_of_layers_hides_names_moves_and_sets_them(studio, page):

    def done():
        studio.is_done(page)
        return studio.session.shown.status["layers"]

    page.evaluate("document.getElementById('layers').open = true")
    for _ in range(2):
        page.click("#layer-add")
        done()
    page.fill("#layer-title", "Rust")
    page.keyboard.press("Enter")
    assert done()[1]["title"] == "Rust"
    page.select_option("#layer-blend", "multiply")
    assert done()[1]["blend"] == "multiply"
    page.evaluate("""() => {
      const slider = document.getElementById("layer-opacity");
      slider.value = 0.4;
      slider.dispatchEvent(new Event("input"));
      slider.dispatchEvent(new Event("change"));
    }""")
    assert done()[1]["opacity"] == 0.4
    assert page.inner_text("#stack li:first-child").split("\n")[0].startswith("Rust")
    page.click("#layer-down")
    assert done()[0]["title"] == "Rust"
    page.click("#stack li:nth-child(2) .eye")
    assert [each["isVisible"] for each in done()] == [False, True]
    studio.drag(page, (-20, 0), (20, 0))
    assert "hidden" in page.inner_text("#paint-note")
    page.check("#layer-mask")
    assert done()[0]["hasMask"]
    page.check("#layer-masked")
    assert page.evaluate("viewer.painting.layers.target.mask")
    page.keyboard.press("Control+z")
    assert not done()[0]["hasMask"]
    assert page.evaluate("viewer.painting.layers.target.mask") is False


def test_layers_are_saved_beside_the_output_and_a_session_goes_on_with_them(tmp_path):
    session = Session(*canvas(), tmp_path / "out.octz")
    session.take(plain("layer", 1, action="add", blend="multiply", title="Dirt"))
    take(session, stroke(2, layer=1), plain("save", 3))
    assert session.shown.status["isSaved"]
    assert session.close() == ""
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out.layers.octex", "out.octz"]
    assert_same(octex.open(tmp_path / "out.octz"), session.shown.texture)
    _, surface = canvas()
    again = Session(octex.open(tmp_path / "out.layers.octex"), surface, tmp_path / "more.octex")
    assert again.shown.status["layers"] == session.shown.status["layers"]
    assert_same(again.shown.texture, session.shown.texture)
    take(again, plain("layer", 1, action="set", layer=1, isVisible=False))
    hits = surface.scatter(500, 0)
    assert np.abs(again.shown.texture.sample(hits) - canvas()[0].sample(hits)).max() < 2 / 255
    take(again, plain("save", 2), plain("layer", 3, action="delete", layer=1), plain("save", 4))
    assert again.close() == ""
    assert sorted(each.name for each in tmp_path.iterdir()) == ["more.octex", "out.layers.octex", "out.octz"]


def test_of_a_file_with_layers_that_a_command_edits_nothing_is_lost(tmp_path, monkeypatch, capfd):
    texture, surface = canvas()
    layers = octex.Layers(texture, surface)
    layers.add_layer("Dirt")
    layers.fill(ones, "#102030")
    path, edited, model = (str(tmp_path / name) for name in ("stack.octex", "edited.octex", "ball.obj"))
    layers.save(path)
    Path(model).write_text(obj_lines(surface.vertices, surface.triangles))
    assert main(["edit", path, edited, "--levels", "0.1,0.8,1"]) == ExitCode.DONE
    assert "not its layers" in capfd.readouterr().err
    words = ["view", edited, model, "--paint", str(tmp_path / "out.octex"), "--no-browser"]
    assert main(words) == ExitCode.REFUSED
    assert "edited.octex: the texture was edited after its layers were saved" in capfd.readouterr().err
    found = list[Shown]()

    def run(viewer):
        viewer._server.server_close()
        assert viewer.session is not None
        found.append(viewer.session.shown)

    monkeypatch.setattr(Viewer, "run", run)
    for choice in ("shown", "layers"):
        assert main([*words, "--keep", choice]) == ExitCode.DONE
    for name, own in found[0].texture.channels.items():
        assert np.array_equal(own.values, octex.open(edited).channels[name].values)
    assert found[0].status["layers"] == []
    assert [each["title"] for each in found[1].status["layers"]] == ["Dirt"]
    assert np.array_equal(
        found[1].texture.channels["base_color"].values, layers.texture().channels["base_color"].values
    )
