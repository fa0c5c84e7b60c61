"""glTF models posed by their animations, skins and morph targets."""

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.drawing.hits import rest_normals, visible_hits
from octex.errors import ArgumentError, ModelError, ModelWarning
from octex.source.load import load_motion
from octex.view.shading import face_normals
from octex.view.zbuffer import z_buffer
from tests.conftest import needs_jit
from tests.make.fixtures import MISSING, SQUARE, Gltf, put, rows
from tests.make.refusal import refused
from tests.oracles.naive_poses import posed

WEIGHTS = np.float32([[1, 0, 0, 0], [0.25, 0.75, 0, 0], [0.5, 0.25, 0.25, 0], [0, 0, 1, 0]])
JOINTS = np.uint8([[0, 0, 0, 0], [0, 1, 0, 0], [2, 1, 0, 0], [0, 0, 1, 0]])
TIMES = np.float32([0.25, 0.5, 1.5, 2.0])


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def moving(path, mode, seed=0):
    """A skinned, morphed square below a node that an animation moves, beside one without a skin."""
    random = np.random.default_rng(seed)
    gltf = Gltf()
    offsets = [{"POSITION": gltf.accessor(random.normal(size=(4, 3)).astype(np.float32))} for _ in range(2)]
    targets = {"targets": offsets}
    attributes = {"JOINTS_0": gltf.accessor(JOINTS), "WEIGHTS_0": gltf.accessor(WEIGHTS)}
    moved = gltf.show(gltf.primitive(**attributes) | targets, translation=[5, 5, 5])
    rigid = gltf.show(gltf.primitive() | targets, scale=[1, 2, 1], weights=[0.5, 0.25])
    gltf.json["meshes"][0]["weights"] = [0.5, -1.0]
    last = gltf.add("nodes", translation=[0, 1, 0])
    middle = gltf.add("nodes", children=[last, rigid], rotation=[0, 0.6, 0, 0.8])
    first = gltf.add("nodes", children=[middle], matrix=[*np.eye(4)[[1, 0, 2, 3]].ravel().tolist()])
    gltf.json["scenes"][0]["nodes"] = [moved, first]
    inverses = random.normal(size=(3, 16)).astype(np.float32)
    inverses[:, 3:12:4], inverses[:, 15] = 0, 1
    number = gltf.accessor(inverses.reshape(-1, 4))
    gltf.json["accessors"][number] |= {"type": "MAT4", "count": 3}
    gltf.json["nodes"][moved]["skin"] = gltf.add(
        "skins", joints=[first, middle, last], inverseBindMatrices=number
    )
    width = {"rotation": 4, "weights": 1}.get(path, 3)
    keys = len(TIMES) * (3 if mode == "CUBICSPLINE" else 1) * (2 if path == "weights" else 1)
    values = random.normal(size=(keys, width)).astype(np.float32)
    if path == "rotation" and mode != "CUBICSPLINE":
        values = unit(values)
    sampler = {"input": gltf.accessor(TIMES), "output": gltf.accessor(values), "interpolation": mode}
    target = {"node": moved if path == "weights" else middle, "path": path}
    gltf.add("animations", name="A", channels=[{"sampler": 0, "target": target}], samplers=[sampler])
    return gltf


@pytest.mark.parametrize("mode", ["STEP", "LINEAR", "CUBICSPLINE"])
@pytest.mark.parametrize("path", ["translation", "rotation", "scale", "weights"])
def test_vertices_are_where_the_specification_puts_them(tmp_path, path, mode):
    file = moving(path, mode).save(tmp_path / "a.glb")
    rest = octex.load_surface(file)
    for time in (0.0, 0.3, 0.5, 1.2, 1.9, 2.0):
        surface = octex.load_surface(file, pose=f"A@{time}")
        np.testing.assert_allclose(surface.vertices, posed(file, 0, np.float32(time)), atol=1e-5)
        np.testing.assert_array_equal(surface.rest, rest.vertices)
        np.testing.assert_array_equal(surface.triangles, rest.triangles)
        assert surface.provenance["pose"] == f"A@{time}"


def test_weights_of_another_sum_are_normalized_with_a_warning(tmp_path):
    gltf = moving("rotation", "LINEAR")
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["WEIGHTS_0"] = gltf.accessor(WEIGHTS * np.float32([[2], [0.18], [0], [1]]))
    file = gltf.save(tmp_path / "a.glb")
    octex.load_surface(file)  # as it rests they do not matter
    words = r"primitives\[0\]: the weights of 3 of 4 vertices do not sum to 1; octex normalizes them"
    with pytest.warns(ModelWarning, match=words):
        surface = octex.load_surface(file, pose="A@1.2")
    np.testing.assert_allclose(surface.vertices, posed(file, 0, np.float32(1.2)), atol=1e-5)
    with pytest.warns(ModelWarning, match=words):
        motion = load_motion(file)
    np.testing.assert_allclose(np.add.reduceat(motion.bones.shares, motion.bones.first[:-1]), 1, atol=1e-12)


def test_an_animation_without_a_name_is_called_by_its_number(tmp_path):
    gltf = moving("scale", "LINEAR")
    del gltf.json["animations"][0]["name"]
    file = gltf.save(tmp_path / "a.glb")
    found = octex.load_surface(file, pose="0@1").vertices
    np.testing.assert_allclose(found, posed(file, 0, 1.0), atol=1e-5)


def test_posed_normals_turn_with_the_joints(tmp_path):
    gltf = Gltf()
    up = np.tile(np.float32([0, 0, 1]), (4, 1))
    alone = np.zeros((4, 4), np.float32)
    alone[:, 0] = 1
    given = {"NORMAL": up, "JOINTS_0": np.zeros((4, 4), np.uint8), "WEIGHTS_0": alone}
    node = gltf.show(gltf.primitive(**{name: gltf.accessor(rows) for name, rows in given.items()}))
    joint = gltf.add("nodes")
    gltf.json["scenes"][0]["nodes"].append(joint)
    gltf.json["nodes"][node]["skin"] = gltf.add("skins", joints=[joint])
    turns = unit(np.float32([[0, 0, 0, 1], [0.5, 0, 0, 0.5]]))  # 90° about x
    sampler = {"input": gltf.accessor(np.float32([0, 1])), "output": gltf.accessor(turns)}
    channel = {"sampler": 0, "target": {"node": joint, "path": "rotation"}}
    gltf.add("animations", name="turn", channels=[channel], samplers=[sampler])
    surface = octex.load_surface(gltf.save(tmp_path / "a.glb"), normals=True, pose="turn@0.5")
    frames = surface.posed_frames()
    normals = frames.normals.values[frames.normals.rows]
    np.testing.assert_allclose(normals, np.broadcast_to([0, -(0.5**0.5), 0.5**0.5], (2, 3, 3)), atol=1e-6)
    np.testing.assert_allclose(surface.scatter(9).normals, normals[0, :1].repeat(9, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ("B@1", r"has no animation 'B'; it has A \(0 to 2\.0 s\)"),
        ("1@1", r"has no animation '1'"),
        ("A", r"cannot be posed as 'A': give NAME@SECONDS; it has A \(0 to 2\.0 s\)"),
        ("A@2.5", r"animation 'A' has no time '2\.5': seconds from 0 to 2\.0; it has A"),
        ("A@-1", "has no time '-1'"),
        ("A@nan", "has no time 'nan'"),
        ("A@soon", "has no time 'soon'"),
        (3, "pose must be text"),
    ],
)
def test_a_pose_that_the_model_lacks_is_refused(tmp_path, pose, message):
    file = moving("scale", "STEP").save(tmp_path / "a.glb")
    with pytest.raises(ArgumentError, match=message):
        octex.load_surface(file, pose=pose)


def test_what_has_no_animation_is_not_posed(tmp_path):
    gltf = Gltf()
    gltf.show(gltf.primitive())
    with pytest.raises(ArgumentError, match=r"a\.glb has no animations; leave the pose 'A@0' out"):
        octex.load_surface(gltf.save(tmp_path / "a.glb"), pose="A@0")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ArgumentError, match="only glTF models can"):
        octex.load_surface(tmp_path / "a.obj", pose="A@0")


PRIMITIVE, SAMPLER = "meshes.0.primitives.0", "animations.0.samplers.0"
WEIGHTS_0, JOINTS_0 = f"{PRIMITIVE}.attributes.WEIGHTS_0", f"{PRIMITIVE}.attributes.JOINTS_0"
CHANNEL = "animations.0.channels.0"
MATRICES = moving("rotation", "LINEAR").json["skins"][0]["inverseBindMatrices"]
NOT_WEIGHTS = "which must be finite and not below 0"
#: Two changes that the page's tests make, too.
WAVY = {f"{SAMPLER}.interpolation": "WAVY"}
NO_SUCH_JOINT = {JOINTS_0: rows(*JOINTS + 1, dtype="uint8")}


def broken(changes):
    """A model with something wrong."""
    gltf = moving("weights" if "nodes.0.weights" in changes else "rotation", "LINEAR")
    put(gltf.json, changes, gltf)
    return gltf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({WEIGHTS_0: rows(*[[2, -1, 0, 0]] * 4)}, rf"\[2\.0, -1\.0, 0\.0, 0\.0\], {NOT_WEIGHTS}"),
        ({WEIGHTS_0: rows(*[[np.inf, 1, 0, 0]] * 4)}, NOT_WEIGHTS),
        ({WEIGHTS_0: rows(*[[np.nan, 1, 0, 0]] * 4)}, NOT_WEIGHTS),
        ({WEIGHTS_0: MISSING}, "has JOINTS_0 without weights"),
        ({JOINTS_0: MISSING}, "has a skin but no JOINTS_0"),
        (NO_SUCH_JOINT, "vertex 2 is moved by joint 3, but its skin has 3"),
        ({f"accessors.{MATRICES}.count": 2}, "has 2 inverse bind matrices for 3 joints"),
        ({"skins.0.joints.1": lambda gltf: gltf.add("nodes")}, r"joint nodes\[5\], which the scene does not"),
        ({"skins.0.joints": []}, "has no joints"),
        ({"skins": []}, r"refers to skins\[0\]"),
        (
            {"nodes.0.weights": [0, 0, 0], f"{CHANNEL}.target.path": "unknown"},
            r"has 2 morph targets, and nodes\[0\] weights of 3",
        ),
        ({f"{PRIMITIVE}.targets.0.POSITION": rows(*SQUARE[:2])}, r"targets\[0\] moves 2 of 4 vertices"),
        (WAVY, "interpolates by 'WAVY'"),
        ({f"{SAMPLER}.input": rows(*TIMES[::-1])}, "times that do not ascend from 0 on"),
        ({f"{SAMPLER}.input": rows()}, "times that do not ascend"),
        ({f"{SAMPLER}.output": rows(*unit(np.ones((3, 4))))}, "has 3 values for 4 times"),
        ({f"{SAMPLER}.output": rows(*np.ones((4, 3)))}, "has type VEC3"),
        ({f"{SAMPLER}.output": rows(*np.full((4, 4), np.inf))}, "has values that are not finite"),
        ({f"{CHANNEL}.sampler": 1}, r"refers to samplers\[1\]"),
        ({f"{CHANNEL}.target.node": lambda gltf: gltf.json["skins"][0]["joints"][0]}, "which has a matrix"),
        (
            {"animations.0.channels": lambda gltf: 2 * gltf.json["animations"][0]["channels"]},
            "its rotation twice",
        ),
        ({f"{CHANNEL}.target.node": 99}, r"refers to nodes\[99\]"),
    ],
)
def test_a_broken_animation_is_refused_in_one_line(tmp_path, changes, message):
    file = broken(changes).save(tmp_path / "a.glb")
    octex.load_surface(file)  # as it rests it is read
    with refused(ModelError, message):
        octex.load_surface(file, pose="A@0")


def test_broken_files_of_others_are_refused_or_posed(models):
    count = 0
    for path in sorted((models / "fragile" / "gltf-validator").rglob("*.gltf")):
        try:
            octex.load_surface(path, pose="0@0")
        except octex.OctexError as error:
            assert "\n" not in str(error)
        count += 1
    assert count > 100


@needs_jit
def test_paint_put_on_the_running_fox_lies_there_when_it_looks_around(models):
    path = models / "animated" / "Fox.glb"
    running, looking = (octex.load_surface(path, pose=pose) for pose in ("Run@0.5", "Survey@1.2"))
    size = (256, 256)
    camera = octex.Camera.fitted(running.vertices, (1, 0.3, 0.2), size=size)
    down, across = np.mgrid[:256, :256] / 255.0
    image = np.stack([across, down, 0.5 + 0 * down, 1 + 0 * down], axis=-1)
    codes = np.rint(255 * image).astype(np.uint8)
    texture = octex.convert(octex.load_surface(path, channels=["base_color"]), 8)
    painted = octex.paint(texture, running, octex.Projection(codes, camera))
    seen = z_buffer(running.vertices, running.triangles, camera).triangle
    other = octex.Camera.fitted(looking.vertices, (1, 0.5, 0.5), size=size)
    off = []
    for _, hits in visible_hits(looking, other, rest_normals(looking)):
        x, y = camera.project(running.points_at(hits.triangles, hits.barycentric))[0].T
        column, row = np.clip(np.stack([x, y]).astype(int), 2, 253)
        # Well inside of triangles that the first camera sees, and faces.
        inside = np.all([seen[row + i, column + j] == hits.triangles for i in (-2, 2) for j in (-2, 2)], 0)
        faces, _ = face_normals(running.vertices, running.triangles)
        inside &= faces[hits.triangles] @ [0.93, 0.28, 0.19] > 0.6
        found = painted.sample(hits.rest[inside])
        wanted = (np.stack([x, y], axis=1)[inside] - 0.5) / 255
        off.append(255 * (linear_to_srgb(found[:, :2]) - wanted))
    errors = np.concatenate(off)
    assert len(errors) > 1000
    assert np.sqrt((errors**2).mean()) < 2


@needs_jit
def test_bake_tells_of_animations_that_it_does_not_write(tmp_path, cli):
    animated = moving("rotation", "LINEAR").save(tmp_path / "a.glb")
    for name, model in (("moving", animated), ("still", tmp_path / "moving.glb")):
        cli.result(model, tmp_path / "a.octex", "--depth", 4, "--force", "--quiet")
        told = cli.result("bake", tmp_path / "a.octex", model, tmp_path / f"{name}.glb")
        assert ("its animations are not written" in told) == (name == "moving")


def test_the_fox_runs_as_a_naive_reader_has_it(models):
    path = models / "animated" / "Fox.glb"
    surface = octex.load_surface(path, pose="Run@0.5")
    size = np.ptp(surface.vertices, axis=0).max()
    np.testing.assert_allclose(surface.vertices, posed(path, 2, 0.5), atol=1e-6 * size)
