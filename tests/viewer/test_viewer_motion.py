"""Animations in the browser: what pixels see of a model that moves, and animations that are broken."""

import numpy as np
import pytest

import octex
from octex.drawing.hits import rest_normals, visible_hits
from octex.errors import ArgumentError, ModelError
from octex.files import size_of
from octex.source.load import load_motion
from octex.viewer import write_page
from octex.viewer.pack import pack
from tests.make.browser import Probe, camera_of, lit_normals, sharp
from tests.make.fixtures import Gltf
from tests.source.test_poses import NO_SUCH_JOINT, WAVY, broken, moving

SIZE = 120, 90


def naive(motion, animation, frame):
    """Where the vertices are at a frame, one by one."""
    found = motion.positions.copy()
    for v in range(len(found)):
        for n in range(motion.targets.first[v], motion.targets.first[v + 1]):
            weight = animation.weights[frame, motion.targets.numbers[n]]
            found[v] += weight * motion.targets.shares[n]
        moved = np.zeros(3)
        for n in range(motion.bones.first[v], motion.bones.first[v + 1]):
            bone = animation.bones[frame, motion.bones.numbers[n]]
            moved += motion.bones.shares[n] * (bone[:, :3] @ found[v] + bone[:, 3])
        found[v] = moved
    return found


@pytest.mark.parametrize("path", ["rotation", "translation", "scale", "weights"])
def test_frames_are_where_poses_are(tmp_path, path):
    file = moving(path, "CUBICSPLINE").save(tmp_path / "a.glb")
    motion = load_motion(file, 7.0)
    assert motion is not None
    (animation,) = motion.animations
    assert motion.faults == []
    assert animation.length == 2.0
    assert len(animation.bones) == 17  # 14 steps, up to a multiple of 4, and one
    for frame in range(0, 17, 3):
        surface = octex.load_surface(file, pose=f"A@{np.float32(frame / 8)}")
        np.testing.assert_allclose(naive(motion, animation, frame), surface.vertices, atol=1e-5)


@pytest.mark.parametrize("path", ["rotation", "translation", "scale", "weights"])
def test_between_frames_vertices_move_straight_on(tmp_path, path):
    motion = load_motion(moving(path, "LINEAR").save(tmp_path / "a.glb"), 7.0)
    assert motion is not None
    (animation,) = motion.animations
    frames = [naive(motion, animation, frame) for frame in (0, 3, 4, 16)]
    for time, expected in (
        *((-1.0, frames[0]), (0.0, frames[0]), (3 / 8, frames[1]), (4 / 8, frames[2])),
        *((2.0, frames[3]), (9.0, frames[3])),
    ):
        np.testing.assert_allclose(motion.positions_at(0, time), expected, rtol=0, atol=1e-12)
    between = animation._replace(
        bones=(animation.bones[3:4] + animation.bones[4:5]) / 2,
        weights=(animation.weights[3:4] + animation.weights[4:5]) / 2,
    )
    np.testing.assert_allclose(motion.positions_at(0, 3.5 / 8), naive(motion, between, 0), rtol=0, atol=1e-12)


def test_a_broken_animation_is_said_and_the_others_are_kept(tmp_path):
    gltf = broken(WAVY)
    sound = moving("rotation", "LINEAR").json["animations"][0]
    gltf.add("animations", **{**sound, "name": "B"})
    file = gltf.save(tmp_path / "a.glb")
    motion = load_motion(file)
    assert motion is not None
    assert [each.name for each in motion.animations] == ["B"]
    assert motion.faults == [
        "animation A: a.glb: animations[0].samplers[0] interpolates by 'WAVY', which is not one of glTF's; "
        "export it again"
    ]
    surface = octex.load_surface(file)
    notes = pack(octex.convert(surface, depth=2), surface, motion=motion).header["notes"]
    assert motion.faults[0] in notes


def test_of_a_broken_skin_and_without_animations_there_is_no_motion_but_a_still_page(tmp_path, cli):
    with pytest.raises(ModelError, match="is moved by joint 3"):
        load_motion(broken(NO_SUCH_JOINT).save(tmp_path / "a.glb"))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_motion(tmp_path / "a.obj") is None
    file = broken(NO_SUCH_JOINT).save(tmp_path / "a.glb")
    octex.convert(octex.load_surface(file), depth=2).save(tmp_path / "a.octex")
    told = cli.result("view", tmp_path / "a.octex", file, tmp_path / "a.html")
    assert "no animations: a.glb: meshes[0].primitives[0]: vertex 2 is moved by joint 3" in told
    assert 'id="data-0-motion"' not in (tmp_path / "a.html").read_text("utf-8")


def test_motion_has_fewer_frames_where_there_is_little_room(tmp_path):
    file = moving("rotation", "LINEAR").save(tmp_path / "a.glb")
    surface, motion = octex.load_surface(file), load_motion(file)
    texture = octex.convert(surface, depth=2)
    whole = pack(texture, surface, motion=motion)
    size = len(whole.streams["motion"])
    assert whole.header["motion"]["animations"][0]["frames"] == 61
    half = pack(texture, surface, motion=motion, room=size - 1)
    assert half.header["motion"]["animations"][0]["frames"] == 31
    assert half.header["notes"] == ["animations: every second frame"]
    none = pack(texture, surface, motion=motion, room=9)
    assert "motion" not in none.header
    assert none.header["notes"][0].startswith("no animations: they take")
    page = tmp_path / "a.html"
    with pytest.raises(ArgumentError, match="even without any level; allow ") as caught:
        write_page(texture, page, surface, motion=motion, max_size=1000)
    least = size_of(str(caught.value).split("allow ")[1].replace(" ", ""))
    notes = write_page(texture, page, surface, motion=motion, max_size=least)
    assert page.stat().st_size <= least
    assert any(note.startswith("no animations: they take") for note in notes)


@pytest.mark.parametrize("path", ["rotation", "weights"])
def test_pixels_see_the_posed_model_and_the_colours_of_where_it_rests(path, opens, tmp_path):
    file = moving(path, "LINEAR", 3).save(tmp_path / "a.glb")
    waves = lambda p: 0.5 + 0.5 * np.sin(9 * p)  # noqa: E731
    surface = octex.load_surface(file, sources={"base_color": waves})
    texture = octex.convert(surface, depth=5)
    write_page(texture, tmp_path / "page.html", surface, motion=load_motion(file, 50.0))
    page = opens(tmp_path / "page.html", (900, 480), is_drawn=False)
    still = Probe(page, texture, SIZE).points
    page.select_option("#animation", "0")
    for time in (0.6, 1.4):
        posed = octex.load_surface(file, pose=f"A@{time}")
        page.evaluate(
            "([at, size]) => Object.assign(viewer.camera, { target: at, distance: 2.5 * size })",
            [posed.vertices.mean(axis=0).tolist(), float(np.ptp(posed.vertices, axis=0).max())],
        )
        probe = Probe(page, texture, SIZE, moment={"animation": 0, "time": time})
        assert len(probe.points) != len(still) or not np.allclose(probe.points, still)
        compare_seen(posed, camera_of(page, SIZE), probe)
        page.evaluate("viewer.camera.orbit(0.5, 0.1)")
    values = Probe(page, texture, SIZE, moment={"animation": 0, "time": 1.4})
    base = next(each for each in pack(texture, surface).header["channels"] if each["name"] == "base_color")
    expected = texture.sample(values.points, filter="quadratic")
    assert 255 * np.abs(values.plane(base["at"][0])[:, :3] - expected).max() <= 1.0


def compare_seen(posed, camera, probe):
    """Compare with what rays of the posed model's pixels hit, but at outlines."""
    expected = np.full((SIZE[0] * SIZE[1], 3), np.nan)
    for seen, hits in visible_hits(posed, camera, rest_normals(posed)):
        expected[seen] = hits.rest
    upright = probe.seen.reshape(SIZE[1], SIZE[0])[::-1]
    found = np.full((SIZE[1], SIZE[0], 3), np.nan)
    found[probe.seen.reshape(SIZE[1], SIZE[0])] = probe.points
    found = found[::-1].reshape(-1, 3)
    both = np.isfinite(expected[:, 0]) & np.isfinite(found[:, 0])
    assert both.sum() > 200, (np.isfinite(expected[:, 0]).sum(), upright.sum())
    assert (np.isfinite(expected[:, 0]) != upright.ravel()).mean() < 0.01
    off = np.abs(found - expected)[both].max(axis=1) / np.ptp(posed.rest)
    assert np.quantile(off, 0.97) < 3e-3  # a pixel is wider than 0.01


@pytest.mark.parametrize("pose", [None, "A@2"])
def test_targets_turn_normals_before_bones_do(pose, opens, tmp_path):
    gltf = Gltf()
    up, added = np.float32([0, 0, 1]), np.float32([[0.5, -0.2, 0.1], [-0.3, 1.5, 0.2]])
    rows = [{"NORMAL": gltf.accessor(np.tile(each, (4, 1)))} for each in added]
    plain = gltf.primitive(NORMAL=gltf.accessor(np.tile(up, (4, 1))))
    node = gltf.show(plain | {"targets": rows}, scale=[1, 2, 0.5], rotation=[0, 0.6, 0, 0.8])
    gltf.json["meshes"][0]["weights"] = [0.0, 0.0]
    times, weights = np.float32([0, 2]), np.float32([[0, 0, 1, 0.4]]).reshape(-1, 1)
    turns = np.float32([[0, 0.6, 0, 0.8], [0, 0.6, 0, 0.8]])
    channels = [
        {"sampler": n, "target": {"node": node, "path": p}} for n, p in enumerate(("weights", "rotation"))
    ]
    samplers = [{"input": gltf.accessor(times), "output": gltf.accessor(rows)} for rows in (weights, turns)]
    gltf.add("animations", name="A", channels=channels, samplers=samplers)
    file = gltf.save(tmp_path / "a.glb")
    surface = octex.load_surface(file, normals=True, pose=pose)
    motion = load_motion(file)
    write_page(octex.convert(surface, depth=3), tmp_path / "page.html", surface, motion=motion)
    page = opens(tmp_path / "page.html", (900, 480), is_drawn=False)
    turn = np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])  # of the quaternion above
    view = camera_of(page, SIZE).world_to_camera[:3, :3] * [[1], [-1], [-1]]
    for time, share in ((0.0, 0.0), (1.0, 0.5), (2.0, 1.0)):
        morphed = up + share * np.array([1.0, 0.4]) @ added
        expected = view @ turn @ (morphed / [1, 2, 0.5])
        expected /= np.linalg.norm(expected)
        seen = Probe(page, octex.convert(surface, depth=3), SIZE, moment={"animation": 0, "time": time}).seen
        assert seen.sum() > 200
        found = lit_normals(page, SIZE, moment={"animation": 0, "time": time})[seen]
        away = np.minimum(np.abs(found - expected).max(axis=1), np.abs(found + expected).max(axis=1))
        assert away.max() < 2e-3  # normals come in 2⁻¹⁰


def test_animations_are_chosen_played_and_sought(opens, tmp_path):
    file = moving("rotation", "LINEAR").save(tmp_path / "a.glb")
    surface = octex.load_surface(file)
    write_page(octex.convert(surface, depth=3), tmp_path / "page.html", surface, motion=load_motion(file))
    page = opens(tmp_path / "page.html", (900, 700))
    assert page.locator("#animation option").all_text_contents() == ["rest pose", "A"]
    assert page.is_disabled("#time")
    page.locator("canvas").focus()
    page.keyboard.press("Space")
    page.wait_for_function("viewer.player.time > 0.3")
    assert page.locator("#play").inner_text() == "Pause"
    page.keyboard.press("Space")
    time = page.evaluate("viewer.player.time")
    sharp(page)
    assert page.evaluate("viewer.player.time") == time
    page.locator("#time").fill("1.5")
    assert page.evaluate("viewer.display.moment") == {"animation": 0, "time": 1.5}
    page.select_option("#animation", "-1")
    assert page.evaluate("viewer.display.moment") is None
