"""Odd values for every argument of every public function: a result, or an error of octex's own.

``check(seed)`` makes one call. Only what octex exports is called, and the public methods of its classes, on
inputs as small as may be.
"""

from __future__ import annotations

import inspect
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
import PIL.Image

import octex
from octex import jit
from octex.editing.draft import Change
from octex.errors import OctexError
from tests.make.fixtures import obj_lines
from tests.make.small_surfaces import FACES, TETRAHEDRON

#: How fine what is converted is.
DEPTH = {"depth": 2}


class Call(NamedTuple):
    """A function, and arguments that it takes."""

    function: Callable[..., Any]
    arguments: dict[str, Any]

    @property
    def name(self):
        return self.function.__qualname__

    @property
    def names(self):
        """Every argument of the function, also those that are not given."""
        kinds = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
        parameters = inspect.signature(self.function).parameters.values()
        names = [each.name for each in parameters if each.kind in kinds]
        for each in parameters:
            if each.kind is inspect.Parameter.VAR_KEYWORD:  # as a TypedDict names them
                (options,) = get_args(get_type_hints(self.function)[each.name])
                names += get_type_hints(options)
        return names


class World(NamedTuple):
    """The smallest of each kind."""

    surface: octex.Surface
    texture: octex.OctreeTexture
    layer: octex.OctreeTexture
    parts: octex.TextureSet
    cloud: octex.PointCloud
    camera: octex.Camera
    image: octex.Projection
    light: octex.Environment

    def content(self):
        """Return what no call may change."""
        texture, surface, camera = self.texture, self.surface, self.camera
        arrays = [*texture.tree.arrays, texture.bounds, *texture.channels["base_color"][1:]]
        arrays += [surface.vertices, surface.triangles, surface.rest, surface.bounds, self.cloud.points]
        return [array.tobytes() for array in [*arrays, camera.K, camera.world_to_camera]]


@cache
def holder():
    return tempfile.TemporaryDirectory(prefix="octex-border-")


@cache
def folder():
    """A folder of this process, with files of all kinds."""
    path = Path(holder().name)
    (path / "folder.octex").mkdir()
    (path / "empty.octex").touch()
    (path / "loop.octex").symlink_to(path / "loop.octex")
    if hasattr(os, "mkfifo"):
        for ending in ("octex", "glb", "xyz", "json", "png"):
            os.mkfifo(path / f"pipe.{ending}")
    w = world()
    w.texture.save(path / "texture.octex")
    w.parts.save(path / "set")
    octex.write_cameras(path / "cameras.json", {"one": w.camera})
    rows = np.hstack([w.cloud.points, w.cloud.colors[:, :3]])
    (path / "cloud.xyz").write_text("\n".join(" ".join(map(str, row)) for row in rows.tolist()))
    np.savez(path / "voxels.npz", coords=FACES, base_color=FACES / 9)
    PIL.Image.new("RGB", (4, 2), (90, 80, 70)).save(path / "light.png")
    (path / "model.obj").write_text(obj_lines(TETRAHEDRON, FACES))
    octex.write_ptex(w.texture, w.surface, path / "written.ptx")
    return path


@cache
def world():
    colors = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7], [0.5, 0.5, 0.1]])
    surface = octex.Surface.from_arrays(TETRAHEDRON, FACES, colors=colors, uv=TETRAHEDRON[:, :2])
    texture = octex.convert(surface, **DEPTH, fit=False)
    camera = octex.Camera.fitted(TETRAHEDRON, (0.4, 0.3, 1.0), size=(4, 4))
    image = octex.Projection(np.full((4, 4, 3), 200, np.uint8), camera)
    layer = octex.project(surface, image, like=texture, max_depth=2, fit=False)
    parts = octex.TextureSet({"a": texture, "b": texture})
    cloud = octex.PointCloud(TETRAHEDRON, colors, TETRAHEDRON + 1.0)
    return World(surface, texture, layer, parts, cloud, camera, image, octex.Environment.studio())


def ball(points):
    return np.linalg.norm(points - 0.5, axis=1) - 0.3


@cache
def calls():
    """Return every function that octex exports, and the public methods of its classes."""
    w, at = world(), folder()
    box, sphere = octex.Box((0.1, 0.1, 0.1), (0.5, 0.5, 0.5), 0.1), octex.Sphere((0.3, 0.3, 0.2), 0.4, 0.1)
    rows = np.array([[0.3, 0.3, 0.2], [0.5, 0.4, 0.1], [9.0, 0.2, 0.3]])
    points, pixels = {"points": rows}, rows[:, :2]
    pose = {"size": (4, 4), "pose": np.eye(4), "convention": "opencv"}
    camera = {"width": 4, "height": 4, "K": np.eye(3), "world_to_camera": np.eye(4), "projection": "pinhole"}
    tree = {"tree": w.texture.tree, "channels": w.texture.channels, "placement": w.texture.placement}
    painted = {"texture": w.texture, "surface": w.surface}
    images = {"surface": w.surface, "projections": w.image, "max_depth": 2, "fit": False}
    painter, layers = octex.Painter(w.texture, w.surface), octex.Layers(w.texture, w.surface)
    number = layers.add_layer("paint").number
    same = Change(None, w.texture, w.texture)
    one, two = {"texture": w.texture}, {"first": w.texture, "second": w.texture}
    listed = [
        (octex.Box, {"low": (0.1, 0.1, 0.1), "high": (0.5, 0.5, 0.5)}),
        (box.covers, points),
        (octex.Camera, camera),
        (octex.Camera.pinhole, {**pose, "focal": 3.0}),
        (octex.Camera.orthographic, {**pose, "pixels_per_unit": 3.0}),
        (octex.Camera.fitted, {**points, "direction": (0, 0, 1), "size": (4, 4)}),
        (w.camera.distort, {"points": pixels}),
        (w.camera.project, points),
        (w.camera.rays, {"pixels": pixels}),
        (w.camera.differentials, {**points, "normals": rows}),
        (w.camera.pixel_width, {"depth": rows}),
        (w.camera.scaled, {"factor": 2}),
        (w.camera.resized, {"size": (5, 3)}),
        (w.camera.zoomed, {"times": 2.0}),
        (octex.Environment.of, {"image": at / "light.png"}),
        (octex.Environment.of, {"image": rows[None] / 10}),
        (w.light.seen_by, {"camera": w.camera}),
        (w.light.radiance, {"directions": rows, "roughness": 0.5}),
        (w.light.irradiance, {"normals": rows}),
        (octex.MappedImage, {"image": w.image.image, "kind": "box"}),
        (octex.OctreeTexture, {**tree, "bounds": w.texture.bounds}),
        (w.texture.with_cells, {"tree": w.texture.tree, "channels": w.texture.channels}),
        (w.texture.sample, points),
        (w.texture.sample, {**points, "width": 0.3, "normals": rows}),
        (w.texture.sample, {**points, "dPdx": rows / 9, "dPdy": rows / 99, "gradient": True}),
        (w.texture.contains, points),
        (w.texture.taps, {**points, "width": 0.3}),
        (w.texture.rows, {"numbers": [0, 1]}),
        (octex.open(at / "texture.octex").blocks, points),
        (w.texture.level, {"level": 1}),
        (w.texture.save, {"path": at / "saved.octex"}),
        (w.texture.save, {"path": at / "saved.octz", "max_error": 1}),
        (octex.PointCloud, {**points, "colors": rows / 10}),
        (octex.PointCloud.load, {"path": at / "cloud.xyz"}),
        (octex.Patch, {**vars(octex.unwrap(w.surface, rows[0], 0.3, size=4))}),
        (octex.Ptex, {"path": at / "written.ptx"}),
        (octex.Projection, {"image": w.image.image, "camera": w.camera}),
        (octex.Sphere, {"center": (0.1, 0.1, 0.1), "radius": 0.5}),
        (sphere.covers, points),
        (octex.Surface, {"vertices": TETRAHEDRON, "triangles": FACES, "source": w.surface.source}),
        (octex.Surface.from_arrays, {"vertices": rows, "triangles": np.array([[0, 1, 2]])}),
        (octex.Surface.from_function, {"f": ball, "bounds": [[0.0] * 3, [1.0] * 3], "edge_length": 0.5}),
        (octex.Surface.joined, {"surfaces": [w.surface, w.surface]}),
        (w.surface.with_pose, {"vertices": w.surface.vertices}),
        (w.surface.with_rest, {"rest": w.surface.vertices}),
        (w.surface.with_channels, {"channels": ["base_color"]}),
        (w.surface.with_filter, {"filter": "trilinear"}),
        (w.surface.with_sources, {"sources": {"roughness": 0.5}}),
        (w.surface.completed, {"sources": {"roughness": 0.5}, "channels": ["base_color"]}),
        (w.surface.part, {"triangles": [0, 1]}),
        (w.surface.overlapping_parts, {"margin": 0.1}),
        (w.surface.separated, {"margin": 0.1}),
        (w.surface.scatter, {"n": 3}),
        (w.surface.evaluate, {"samples": w.surface.scatter(3)}),
        (octex.Voxels, {"coords": FACES, "channels": {"base_color": FACES / 9}, "depth": 2, "size": 2.0}),
        (octex.Voxels.load, {"path": at / "voxels.npz"}),
        (octex.TextureSet, {"textures": {"a": w.texture}}),
        (octex.TextureSet.open, {"folder": at / "set"}),
        (w.parts.sample, {**points, "parts": [0, 1, 0]}),
        (w.parts.contains, {**points, "parts": "a"}),
        (w.parts.save, {"folder": at / "saved"}),
        (octex.Transfer, {"model": w.surface}),
        (octex.bake, {**painted, "texture_size": 64, "padding": 1}),
        (octex.finish, {"model": painted["surface"], "texture": painted["texture"], "texture_size": 64}),
        (octex.simplify, {"surface": painted["surface"], "triangles": 20}),
        (octex.bake_vertices, {**painted, "most_triangles": 99}),
        (octex.Painter, painted),
        (painter.paint, {"projections": w.image, "max_depth": 2, "fit": False}),
        (painter.fill, {"region": sphere, "color": (1, 0, 0)}),
        (painter.put, {"change": same}),
        (painter.store, {"folder": at}),
        (octex.Layers, painted),
        (layers.add_layer, {"name": "more", "opacity": 0.5}),
        (layers.change_layer, {"number": number, "blend": "multiply", "is_visible": False}),
        (layers.choose, {"layer": number}),
        (layers.copy_layer, {"number": number}),
        (layers.covered, {"erases": True}),
        (layers.delete_layer, {"number": number}),
        (layers.layer, {"number": number}),
        (layers.merge_layer, {"number": layers.add_layer("above").number}),
        (layers.move_layer, {"number": number, "place": 0}),
        (layers.put, {"change": same}),
        (octex.Layers(**painted).replace, one),
        (layers.save, {"path": at / "layers.octex"}),
        (octex.Run, {"memory": 9, "folder": at}),
        (octex.blur, {**one, "width": 0.1}),
        (octex.combine, two),
        (octex.convert, {"model": w.surface, **DEPTH, "fit": False}),
        (octex.convert, {"model": w.surface, **DEPTH, "path": at / "made.octex", "run": octex.Run(memory=9)}),
        (octex.convert, {"model": w.cloud, **DEPTH}),
        (octex.convert, {"model": octex.Voxels.load(at / "voxels.npz")}),
        (octex.convert_set, {"parts": {"a": w.surface}, **DEPTH, "fit": False}),
        (octex.crop, {**one, "low": (0, 0, 0), "high": (1, 1, 1)}),
        (octex.curves, {**one, "channel": "base_color", "points": [[0, 0], [1, 0.5]]}),
        (octex.difference, {"a": w.texture, "b": w.surface, "points": 9}),
        (octex.displace, {**painted, "channel": "base_color", "scale": 0.1, "most_triangles": 999}),
        (octex.fill, {**painted, "region": sphere, "color": (1, 0, 0)}),
        (octex.load_surface, {"path": at / "model.obj"}),
        (octex.map, {**one, "f": np.sqrt}),
        (octex.merge, {**painted, "layer": w.layer}),
        (octex.mix, two),
        (octex.open, {"path": at / "texture.octex"}),
        (octex.paint, {"texture": w.texture, **images}),
        (octex.project, images),
        (octex.refine_cameras, {"surface": w.surface, "projections": [w.image, w.image], "reference": 0}),
        (octex.read_cameras, {"path": at / "cameras.json"}),
        (octex.render, {**painted, "size": (4, 4), "supersample": 1}),
        (octex.render, {**one, "camera": w.camera, "supersample": 1}),
        (octex.resize, {**one, "depth": 1}),
        (octex.separate, {"surface": w.surface, **DEPTH}),
        (octex.repair, {"surface": w.surface}),
        (octex.subdivide, {"mesh": w.surface, "levels": 1}),
        (octex.unwrap, {"surface": w.surface, "center": rows[0], "radius": 0.3, "size": 4}),
        (octex.write_ptex, {**painted, "path": at / "written.ptx"}),
        (octex.write_osl, {**one, "path": at / "written.osl"}),
        (octex.write_model, {"surface": w.surface, "path": at / "written.obj", "unit": "foot"}),
        (octex.write_model, {"surface": w.surface, "path": at / "written.glb", "octree": w.texture}),
        (octex.write_preview, {**painted, "path": at / "a.png", "size": (64, 64), "supersample": 1}),
        (octex.write_cameras, {"path": at / "written.json", "cameras": {"one": w.camera}}),
    ]
    alone = [
        *(box.bounds, box.checked, sphere.bounds, sphere.checked, octex.Environment.studio),
        *(w.texture.validate, w.texture.info, w.parts.validate, w.parts.info, w.surface.areas),
        *(painter.undo, painter.redo, painter.texture, layers.undo, layers.redo, layers.texture),
    ]
    of_textures = w.surface.placed_in, w.surface.placed_on, w.surface.rest_positions, octex.cast, octex.levels
    listed += [(function, {}) for function in alone] + [(function, one) for function in of_textures]
    return [Call(function, arguments) for function, arguments in listed]


@cache
def odd_values():
    """Return what no argument expects, and some that a few do."""
    at = folder()
    numbers = [-1, 0, 1, 2, 0.5, np.inf, -np.inf, np.nan, 1e-312, 1e300, 2**70, -(2**70), 10**400, True, 1j]
    scalars = [np.int64(3), np.bool_(False), np.float32(0.5), np.complex128(1j), np.datetime64("2000-01-01")]
    texts = [
        "", "x", "base_color", "nearest", "uint8", "\ud800", "x" * 5000, "a\0b.octex", b"a\0b", b"x", b"",
    ]  # fmt: skip
    things = [None, object(), (lambda *_: None), range(3), {1}, set(), frozenset("x"), iter([])]
    named = [{}, {"x": 1}, {1: 2}, {"base_color": None}, {"base_color": "x"}]
    rows = [[], (), [None], ["x"], [[]], [[1, 2], [3]]]
    shapes = [np.zeros(shape) for shape in [3, (2, 3), (0, 3), (3, 2), (2, 3, 4), (4, 4), ()]]
    values = [np.full((4, 3), value) for value in (np.nan, 1e308, 1e-312, 1j, True, "x")]
    types = [
        *(np.zeros((4, 4, 3), dtype) for dtype in ("u1", ">f4", "M8[s]")),
        *(np.zeros(2, [("x", "f4")]), np.arange(3), np.array([2**64 - 1], np.uint64)),
        *(np.array([None, "x"], object), np.array([[1, 2, 3]], object), np.array("x")),
    ]
    files = ["folder", "empty", "loop", "none", "no/a", "texture"]
    paths = [at, os.devnull, at / "model.obj", at / "cloud.xyz"]
    paths += [at / f"{name}.octex" for name in files] + [os.fsencode(at / "texture.octex")]
    paths += sorted(at.glob("pipe.*"))
    return [*numbers, *scalars, *texts, *things, *named, *rows, *shapes, *values, *types, *paths, *world()]


def variations(given):
    """Return what is nearly what an argument takes."""
    if isinstance(given, np.ndarray) and given.size:
        spoiled = [given.astype(np.float64) for _ in range(6)]
        for array, value in zip(spoiled, (np.nan, np.inf, -np.inf, 1e308, 1e-312, -1), strict=True):
            array.reshape(-1)[0] = value
        locked = given.copy()
        locked.flags.writeable = False
        with np.errstate(invalid="ignore"):  # not a number, as a whole one
            types = [given.astype(dtype) for dtype in ("f2", "f4", ">f8", "i8", "u1", "c16", "O", "U8", "g")]
        parts = [given[:0], given[:-1], given[::-1], given.T, given[None], np.asfortranarray(given)]
        return [*spoiled, locked, *types, *parts, given.tolist()]
    if isinstance(given, (tuple, list)) and given:
        changed = [list(given), tuple(given), given[:-1], [*given, given[0]], [None, *given[1:]]]
        if all(isinstance(each, (int, float)) for each in given):
            changed += variations(np.array(given))
        return changed
    if isinstance(given, dict):
        return [dict.fromkeys(given, each) for each in (None, "x", 1, np.nan, np.array(2.0), [])]
    if isinstance(given, Path):
        return [str(given), os.fsencode(given), given.parent, f"{given}\0"]
    return []


def check(seed):
    """Make a call of odd arguments; raises AssertionError for what is neither a result nor a refusal."""
    random = np.random.default_rng(seed)
    call = calls()[random.integers(len(calls()))]
    changed = {}
    for _ in range(min(random.choice([1, 1, 2]), len(call.names))):
        name = call.names[random.integers(len(call.names))]
        near = variations(call.arguments.get(name))
        among = near if near and random.random() < 0.4 else odd_values()
        changed[name] = among[random.integers(len(among))]
    attempt(call, changed)


def attempt(call, changed):
    """Call with some of the arguments changed; raises AssertionError as ``check`` does."""
    if jit.DISABLED and changed.get("depth", 0) is None:  # ten levels take minutes
        return
    before = world().content()
    odd = ", ".join(f"{name}={' '.join(repr(value).split())[:200]}" for name, value in changed.items())
    told = f"{call.name}({odd})"
    try:
        with warnings.catch_warnings(), chdir(folder()):  # where names of files without a folder lead
            warnings.simplefilter("error")
            found = call.function(**{**call.arguments, **changed})
            if isinstance(found, Iterator):
                list(found)
    except OctexError as error:
        assert str(error), f"{told}: refused without a word"
    except Exception as error:
        raise AssertionError(f"{told}: {type(error).__name__}: {error}") from error
    assert world().content() == before, f"{told}: changed what it was given"
