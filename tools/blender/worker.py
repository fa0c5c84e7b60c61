"""What the tools of this folder have Blender do, run by a Python that has bpy.

usage: worker.py TASK JOB       bake, photograph or pose; JOB is JSON, and so is the last line of the answer
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import bpy  # type: ignore[import-not-found]
import mathutils  # type: ignore[import-not-found]
import numpy as np
from extension import exact
from mathutils import Vector  # type: ignore[import-not-found]

#: Millimetres, as of a camera for films of 36 mm.
LENS, FILM = 45.0, 36.0
#: Frames a second, to which the importer scales keys.
FPS = 1000


def opened(job: dict, **options: str) -> bpy.types.Scene:
    """Return a scene with the model of a job and nothing else, to be drawn with Cycles as it is."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = FPS
    bpy.ops.import_scene.gltf(filepath=job["model"], **options)
    scene.render.engine = "CYCLES"
    scene.render.resolution_percentage = 100
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    return scene


def new_camera(scene: bpy.types.Scene, lens: float, clip: tuple[float, float]) -> bpy.types.Object:
    """Return a camera that the scene is drawn from."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", FILM, lens
    data.clip_start, data.clip_end = clip
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)
    return scene.camera


# Bake.


def bake(job: dict) -> dict:
    """Draw a model unlit, bake it, and draw it by an OSL node; return how long each takes."""
    scene = opened(job)
    for material in bpy.data.materials:
        glow(material)
    spent = drawn(scene, job["baked"])
    told = baked(scene, job["texture_size"])
    for each in scene.objects:
        if each.type == "MESH":
            exact.show(bpy.context, each, Path(job["shader"]), [("base_color", 3, "base_color")])
            glow(each.material_slots[0].material)
    return told | {"baked": spent, "exact": drawn(scene, job["exact"])}


def drawn(scene: bpy.types.Scene, views: list[dict]) -> list[float]:
    """Draw the scene from cameras; return seconds of the processor that each takes."""
    spent = []
    for each in views:
        began = time.process_time()
        draw(scene, each)
        spent.append(time.process_time() - began)
    return spent


def glow(material: bpy.types.Material) -> None:
    """Have a material send out its base colour, and nothing else."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    emission = nodes.new("ShaderNodeEmission")
    color = shader.inputs["Base Color"]
    if color.is_linked:
        links.new(color.links[0].from_socket, emission.inputs["Color"])
    else:
        emission.inputs["Color"].default_value = color.default_value
    links.new(emission.outputs["Emission"], output.inputs["Surface"])


def draw(scene: bpy.types.Scene, job: dict) -> None:
    """Draw the scene from a camera; rays go through the middles of a pixel's parts."""
    camera = new_camera(scene, FILM * job["focal"], (1e-3, 1e6))
    camera.matrix_world = mathutils.Matrix(job["pose"])
    settings = scene.render
    settings.resolution_x, settings.resolution_y = job["pixels"]
    settings.film_transparent = True
    settings.dither_intensity = 0.0
    settings.filepath = job["picture"]
    settings.image_settings.file_format = "PNG"
    settings.image_settings.color_mode, settings.image_settings.color_depth = "RGBA", "8"
    scene.cycles.samples = job["samples"] ** 2
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 0.01 if job["samples"] == 1 else 1.0
    bpy.ops.render.render(write_still=True)


def baked(scene: bpy.types.Scene, size: int) -> dict:
    """Bake what the meshes send out, a map a material, at their coordinates; return how long that takes."""
    for material in bpy.data.materials:
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = bpy.data.images.new(material.name, size, size)
        material.node_tree.nodes.active = node
    meshes = [each for each in scene.objects if each.type == "MESH"]
    for each in meshes:
        each.select_set(True)
    bpy.context.view_layer.objects.active = meshes[0]
    scene.cycles.samples = 1
    began = time.process_time(), time.perf_counter()
    bpy.ops.object.bake(type="EMIT", margin=8, use_clear=True)
    return {
        "cpu": time.process_time() - began[0],
        "wall": time.perf_counter() - began[1],
        "texels": size * size * len(bpy.data.materials),
        "version": bpy.app.version_string,
    }


# Photographs.


def photograph(job: dict) -> None:
    """Photograph a model in sunlight, from all sides; write its mesh and the cameras beside the pictures."""
    folder, width = Path(job["folder"]), job["width"]
    scene = opened(job)
    meshes = [each for each in scene.objects if each.type == "MESH"]
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
    scene.cycles.samples = job["rays"]
    scene.render.resolution_x, scene.render.resolution_y = width, width * 3 // 4
    scene.render.image_settings.file_format, scene.render.image_settings.quality = "JPEG", 94
    camera = new_camera(scene, LENS, (1e-3 * radius, 1e3 * radius))
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


# Poses.


def pose(job: dict) -> dict:
    """Return where the vertices of a posed model are, by animation and time."""
    scene = opened(job, import_shading="NORMALS")
    found = {}
    for number, name in enumerate(job["animations"]):
        choose(job["names"][number])
        slerp(job["times"][number])
        found[name] = [vertices(scene, time).tolist() for time in job["times"][number]]
    return found


def owners() -> list[bpy.types.ID]:
    keys = [mesh.shape_keys for mesh in bpy.data.meshes if mesh.shape_keys is not None]
    return [each for each in [*bpy.data.objects, *keys] if each.animation_data is not None]


def choose(name: str) -> None:
    """Play the animation of this name alone, as it is: strips of tracks are rounded to frames."""
    played = 0
    for owner in owners():
        data = owner.animation_data
        strips = [strip for track in data.nla_tracks if track.name == name for strip in track.strips]
        for track in data.nla_tracks:
            track.mute = True
        data.action = strips[0].action if strips else None
        if strips:
            data.action_slot = strips[0].action_slot
            played += 1
    if not played:
        sys.exit(f"Blender has no animation {name!r}")


def slerp(times: list[float]) -> None:
    """Put keys of quaternions at these times: Blender blends their components, glTF asks for slerp."""
    for owner in owners():
        turns: dict[str, dict] = {}
        for curve in curves_of(owner.animation_data):
            if curve.data_path.endswith("rotation_quaternion"):
                turns.setdefault(curve.data_path, {})[curve.array_index] = curve
        for four in turns.values():
            insert(four, times, mathutils.Quaternion)


def insert(four: dict, times: list[float], quaternion: type) -> None:
    points = [four[axis].keyframe_points for axis in range(4)]
    keys = np.array([[point.co[0] for point in points[0]]] + [[p.co[1] for p in each] for each in points])
    if points[0][0].interpolation != "LINEAR":
        return
    added = []
    for second in times:
        frame = second * FPS
        after = int(np.searchsorted(keys[0], frame))
        if 0 < after < keys.shape[1] and keys[0, after] != frame and keys[0, after - 1] != frame:
            a, b = quaternion(keys[1:, after - 1]), quaternion(keys[1:, after])
            t = (frame - keys[0, after - 1]) / (keys[0, after] - keys[0, after - 1])
            added.append((frame, a.slerp(b, t)))
    for frame, value in added:
        for axis in range(4):
            four[axis].keyframe_points.insert(frame, value[axis]).interpolation = "LINEAR"


def curves_of(data: bpy.types.AnimData) -> list:
    layers = [] if data.action is None else data.action.layers
    bags = [strip.channelbag(data.action_slot) for layer in layers for strip in layer.strips]
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


def vertices(scene: bpy.types.Scene, time: float) -> np.ndarray:
    """Return where all vertices are (n, 3), in glTF's axes."""
    frame = time * FPS
    scene.frame_set(int(frame), subframe=frame - int(frame))
    graph = bpy.context.evaluated_depsgraph_get()
    every = []
    for each in scene.objects:
        if each.type != "MESH" or each.name.startswith("Icosphere"):
            continue
        evaluated = each.evaluated_get(graph)
        mesh = evaluated.to_mesh()
        local = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", local)
        matrix = np.array(evaluated.matrix_world)
        every.append(local.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3])
        evaluated.to_mesh_clear()
    x, y, z = np.concatenate(every).T
    return np.stack([x, z, -y], axis=1)


print(
    json.dumps({"bake": bake, "photograph": photograph, "pose": pose}[sys.argv[1]](json.loads(sys.argv[2])))
)
