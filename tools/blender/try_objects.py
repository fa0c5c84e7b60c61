#!/usr/bin/env python
"""Use the extension on objects, images and cameras of many kinds; print what came of it as JSON.

usage: tools/blender/try_objects.py FOLDER, by a Python that has bpy and octex
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy  # type: ignore[import-not-found]
import extension
import numpy as np
from extension import handover, objects, watching
from extension.jobs import Job
from mathutils import Matrix  # type: ignore[import-not-found]
from PIL import Image
from try_extension import (
    SIZE,
    at_uv,
    ball,
    camera_at,
    colors,
    gradient,
    image_of,
    own_material,
    refusal,
    save,
    seen_at,
    uv_of,
    worst,
)

RED = (1.0, 0.0, 0.0)


def main() -> int:
    folder = Path(sys.argv[1])
    extension.register()
    told: dict[str, Any] = {}
    for task in (images, reads, strokes, view, colmap, plain, shape_keys, modifiers, linked, another):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        own = folder / task.__name__
        own.mkdir()
        bpy.ops.wm.save_as_mainfile(filepath=str(own / "scene.blend"))
        told[task.__name__] = task(own)
    extension.unregister()
    print(json.dumps(told))
    return 0


def middle(difference: np.ndarray) -> float:
    """Return the median of the largest differences (n, k) of rows."""
    return float(np.median(np.abs(difference).max(axis=1)) * 255)


def images(folder: Path) -> dict[str, Any]:
    """Make textures of images that are packed, unsaved, missing and of UDIM tiles."""
    chosen = ball()
    image = gradient("gradient")
    node = own_material(chosen, image)
    chosen.octex.depth = 8
    bpy.ops.octex.make()
    told: dict[str, Any] = {"unsaved": at_uv(chosen)}
    image.pack()
    bpy.ops.octex.make()
    told["packed"] = at_uv(chosen)
    save(image, folder / "gradient.png")
    node.image = bpy.data.images.load(str(folder / "gradient.png"))
    objects.check_images(chosen)
    told["was read"] = node.image.has_data
    bpy.ops.octex.make()
    told["file"] = at_uv(chosen)
    (folder / "gradient.png").rename(folder / "elsewhere.png")
    node.image.reload()
    told["missing"] = refusal("make")
    (folder / "gradient.png").write_bytes(b"no image")
    told["damaged"] = refusal("make")
    node.image = bpy.data.images.new("tiles", SIZE, SIZE, tiled=True)
    told["tiles"] = refusal("make")
    own = node.id_data
    group = own.nodes.new("ShaderNodeGroup")
    group.node_tree = bpy.data.node_groups.new("group", "ShaderNodeTree")
    group.node_tree.nodes.new("ShaderNodeTexImage").image = node.image
    chosen.octex.origin, chosen.octex.texture_size = "GREY", 64
    bpy.ops.octex.make()
    told["baked over tiles"] = refusal("images")
    told["painted over tiles"] = page_failure(chosen)
    node.image = None
    chosen.octex.origin = "MATERIAL"
    told["tiles in a group"] = refusal("make")
    return told


def reads(_folder: Path) -> dict[str, Any]:
    """Project photographs that are in no file, and change one before the window has read it."""
    chosen = ball()
    camera = camera_at((9, -8, 4), chosen)
    background = camera.data.background_images.new()
    told: dict[str, Any] = {}
    for kind in ("unsaved", "floats", "packed"):
        background.image = image = gradient(kind, kind == "floats")
        if kind == "packed":
            image.pack()
        bpy.ops.octex.photographs()
        bpy.ops.octex.colors()
        places, is_seen = seen_at(chosen, camera)
        told[kind] = worst(colors(chosen)[is_seen, :2] - places[is_seen])
        objects.texture_path(chosen).unlink()
    own = background.image = gradient("resized")
    _, waiting = handover.photographs(bpy.context, True)
    job = Job().reading(waiting)
    own.scale(SIZE // 2, SIZE)
    job.start()
    try:
        job.wait()
    except objects.ObjectError as error:
        told["resized"] = str(error)
    job.close()
    deadline = time.monotonic() + 10
    while job.folder.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return told | {"is there": job.folder.exists()}


def page_failure(chosen: bpy.types.Object) -> str:
    """Open the painting page of an object; return why it ends, or nothing if it serves."""
    os.environ["BROWSER"] = "true"
    bpy.ops.octex.paint()
    while (page := watching._painted.get(chosen.session_uid)) is not None and page.process is None:
        watching.look()
        time.sleep(0.05)
    if page is not None:
        with suppress(subprocess.TimeoutExpired):
            page.process.wait(10)
    watching.look()
    watching.unregister()
    return watching.failures.get(chosen.session_uid, "")


def strokes(_folder: Path) -> dict[str, Any]:
    """Paint on baked images, and take that over."""
    told = {}
    for layout in ("KEEP", "ATLAS"):
        chosen = ball(f"ball {layout}")
        own_material(chosen, gradient("gradient"))
        chosen.octex.layout, chosen.octex.texture_size, chosen.octex.depth = layout, 512, 7
        bpy.ops.octex.make()
        told["not baked"] = refusal("strokes")
        bpy.ops.octex.images()
        told["not painted"] = refusal("strokes")
        texture = objects.texture_path(chosen)
        texture.rename(texture.with_suffix(".old"))
        chosen.octex.origin = "GREY"
        bpy.ops.octex.make()
        told[f"not painted {layout}, but another texture"] = refusal("strokes")
        texture.with_suffix(".old").replace(texture)
        content = texture.read_bytes()
        bpy.ops.octex.colors()
        before = colors(chosen)
        bpy.ops.octex.images()
        image, pixels = image_of(chosen)
        pixels[200:300, 100:220, :3] = RED
        image.pixels.foreach_set(pixels.reshape(-1))
        uv = uv_of(chosen, objects.UV_MAP if layout == "ATLAS" else 0)
        refused = refusal("images")
        bpy.ops.octex.strokes()
        is_kept = texture.with_suffix(".octex1").read_bytes() == content
        bpy.ops.octex.colors()
        u, v = 512 * uv.T
        inside = (u > 120) & (u < 200) & (v > 220) & (v < 280)
        beside = (u < 80) | (u > 240) | (v < 180) | (v > 320)
        told[layout] = {
            "corners": int(inside.sum()),
            "is_kept": is_kept,
            "red": middle(colors(chosen)[inside, :3] - RED),  # next to charts' edges there is old paint
            "moved": middle((colors(chosen) - before)[beside]),
            "baked over": refused,
            "baked after": refusal("images"),
        }
    return told


def view(_folder: Path) -> dict[str, Any]:
    """Draw a view, paint on it, and project that."""
    chosen = ball()
    chosen.octex.origin = "GREY"
    bpy.ops.octex.make()
    told: dict[str, Any] = {"no camera": refusal("view")}
    seen_in = SimpleNamespace(view_perspective="PERSP", view_matrix=Matrix())
    window = SimpleNamespace(region_data=seen_in, space_data=SimpleNamespace(lens=50))
    told["scenes"] = len(objects.view_camera(window).users_scene)
    camera = camera_at((9, -8, 4), chosen)
    bpy.ops.octex.view()
    path = Path(bpy.path.abspath(camera.data.background_images[0].image.filepath))
    told["name"] = path.name
    image = np.array(Image.open(path))
    told["drawn"] = float(np.abs(image[..., :3][image[..., 3] == 255].astype(float) - 127.5).max())
    told["not painted"] = refusal("photographs")
    rows, columns = slice(SIZE // 2 - 20, SIZE // 2 + 20), slice(SIZE // 2, SIZE // 2 + 40)
    image[rows, columns] = (255, 0, 0, 255)
    Image.fromarray(image).save(path)
    bpy.ops.octex.photographs()
    bpy.ops.octex.colors()
    found = colors(chosen)[:, :3]
    places, seen = seen_at(chosen, camera)
    x, y = (places * SIZE - SIZE / 2).T
    inside = seen & (x > 6) & (x < 34) & (np.abs(y) < 14)
    beside = (x < -6) | (x > 46) | (np.abs(y) > 26)
    told |= {"corners": int(inside.sum()), "red": worst(found[inside] - RED)}
    told["grey"] = worst(found[beside] - 0.5)
    return told


def colmap(folder: Path) -> dict[str, Any]:
    """Project the photograph of a COLMAP folder."""
    chosen = ball()
    camera = camera_at((9, -8, 4), chosen)
    focal = camera.data.lens / camera.data.sensor_width * SIZE
    seen = Matrix.Diagonal((1, -1, -1, 1)) @ camera.matrix_world.inverted()
    turn = " ".join(map(repr, seen.to_quaternion()))
    move = " ".join(map(repr, seen.to_translation()))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} {focal} {focal} {SIZE / 2} {SIZE / 2}\n")
    (sparse / "images.txt").write_text(f"1 {turn} {move} 1 one.png\n\n2 {turn} {move} 1 two.png\n\n")
    (sparse / "points3D.txt").write_text("")
    chosen.octex.cameras = "//sparse/0"
    told: dict[str, Any] = {"missing": refusal("photographs")}
    (folder / "images").mkdir()
    save(gradient("one"), folder / "images" / "one.png")
    bpy.ops.octex.photographs()
    bpy.ops.octex.colors()
    places, is_seen = seen_at(chosen, camera)
    told["worst"] = worst(colors(chosen)[is_seen, :2] - places[is_seen])
    return told


def plain(_folder: Path) -> dict[str, Any]:
    """Make a texture of an object without a material."""
    chosen = ball()
    bpy.ops.octex.make()
    bpy.ops.octex.colors()
    found = colors(chosen)[:, :3]
    told = {"spread": worst(found - found[0]), "slots": len(chosen.material_slots)}
    other = ball("other")
    own = bpy.data.materials.new("other octree")  # the user's, though the extension's would have this name
    own.node_tree.nodes.clear() if own.node_tree is not None else None
    other.data.materials.append(own)
    bpy.ops.octex.make()
    bpy.ops.octex.colors()
    return told | {"own": len(own.node_tree.nodes) if own.node_tree is not None else 0}


def shape_keys(_folder: Path) -> dict[str, Any]:
    """Show the colours of an object whose shape key is on: it rests at the first one."""
    chosen = ball()
    own_material(chosen, gradient("gradient"))
    chosen.octex.depth = 8
    chosen.shape_key_add(name="rest")
    key = chosen.shape_key_add(name="far")
    for point in key.data:
        point.co = point.co * 3
    key.value = 1.0
    bpy.ops.octex.make()
    return {"worst": at_uv(chosen)}


def modifiers(_folder: Path) -> dict[str, Any]:
    """Return why photographs of what a modifier makes are refused."""
    chosen = ball()
    chosen.modifiers.new("finer", "SUBSURF")
    camera_at((9, -8, 4), chosen).data.background_images.new().image = gradient("gradient")
    return {"photographs": refusal("photographs")}


def linked(folder: Path) -> dict[str, Any]:
    """Return why an object of another file, which has a texture, shows none."""
    ball()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    with bpy.data.libraries.load(str(folder / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["ball"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    bpy.context.view_layer.objects.active = wanted.objects[0]
    bpy.ops.octex.make()
    return {command: refusal(command) for command in ("colors", "images", "exact")}


def another(_folder: Path) -> dict[str, Any]:
    """Return why the texture of an object is not used on another one."""
    small = ball()
    small.octex.origin = "GREY"
    bpy.ops.octex.make()
    bpy.ops.mesh.primitive_cube_add(size=20)
    cube = bpy.context.active_object
    cube.octex.path = "//ball.octex"
    camera_at((30, -20, 10), cube).data.background_images.new().image = gradient("gradient")
    told = {command: refusal(command) for command in ("colors", "images", "exact", "photographs", "view")}
    return told | {"paint": page_failure(cube)}


if __name__ == "__main__":
    sys.exit(main())
