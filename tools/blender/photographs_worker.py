"""What photographs.py has Blender do, run by a Python that has bpy: photograph a model in sunlight."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import bpy  # type: ignore[import-not-found]
from mathutils import Vector  # type: ignore[import-not-found]

#: Millimetres, as of a camera for films of 36 mm.
LENS, FILM = 45.0, 36.0


def main() -> None:
    job = json.loads(sys.argv[1])
    folder, width = Path(job["folder"]), job["width"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["model"])
    meshes = [each for each in bpy.context.scene.objects if each.type == "MESH"]
    for each in meshes:
        each.select_set(True)
    bpy.ops.wm.ply_export(
        filepath=str(folder / "scan.ply"), export_selected_objects=True, export_uv=False,
        export_normals=False, export_colors="NONE", export_triangulated_mesh=True,
    )  # fmt: skip
    points = [each.matrix_world @ vertex.co for each in meshes for vertex in each.data.vertices]
    low, high = (Vector(choose(each) for each in zip(*points, strict=True)) for choose in (min, max))
    middle, radius = (low + high) / 2, (high - low).length / 2
    light(middle.xy.to_3d() + Vector((0, 0, low.z)), radius)
    scene = set_up(width, job["rays"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.data.sensor_width = LENS, FILM
    camera.data.clip_start, camera.data.clip_end = 1e-3 * radius, 1e3 * radius
    scene.collection.objects.link(camera)
    scene.camera = camera
    height = scene.render.resolution_y
    away = 1.02 * radius / math.sin(math.atan(FILM * height / width / 2 / LENS))
    frames = []
    for number in range(job["count"]):
        turn, up = 2 * math.pi * number / job["count"], (0.15, 0.55)[number % 2] + 0.1 * math.sin(3 * number)
        way = Vector((math.cos(turn) * math.cos(up), math.sin(turn) * math.cos(up), math.sin(up)))
        camera.location = middle + away * way
        camera.rotation_euler = (-way).to_track_quat("-Z", "Y").to_euler()
        bpy.context.view_layer.update()
        name = f"photograph{number:02d}.jpg"
        scene.render.filepath = str(folder / name)
        bpy.ops.render.render(write_still=True)
        frames.append({"file_path": name, "transform_matrix": [list(row) for row in camera.matrix_world]})
    focal = LENS / FILM * width
    lens = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def light(below: Vector, radius: float) -> None:
    """Lay a checkered ground under the model, with a sun and a sky above."""
    bpy.ops.mesh.primitive_plane_add(size=40 * radius, location=below)
    ground = bpy.data.materials.new("ground")
    ground.use_nodes = True
    nodes = ground.node_tree.nodes
    checker = nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 60.0
    checker.inputs["Color1"].default_value = 0.45, 0.42, 0.38, 1.0
    checker.inputs["Color2"].default_value = 0.25, 0.30, 0.20, 1.0
    ground.node_tree.links.new(checker.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    bpy.context.object.data.materials.append(ground)
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    sky = world.node_tree.nodes["Background"].inputs
    sky["Color"].default_value, sky["Strength"].default_value = (0.55, 0.7, 1.0, 1.0), 0.6
    bpy.context.scene.world = world
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 2.2, 0.03, (0.6, 0.3, 0.8)
    bpy.context.scene.collection.objects.link(sun)


def set_up(width: int, rays: int) -> bpy.types.Scene:
    """Have the scene drawn with Cycles, as JPEG files."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = rays
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.render.resolution_x, scene.render.resolution_y = width, width * 3 // 4
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format, scene.render.image_settings.quality = "JPEG", 94
    scene.view_settings.view_transform = "Standard"
    return scene


main()
