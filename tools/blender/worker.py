"""What bake.py and suns.py have Blender do, run by a Python that has bpy.

usage: worker.py TASK JOB       JOB is JSON, and so is the last line of the answer
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import bpy  # type: ignore[import-not-found]
import mathutils  # type: ignore[import-not-found]
from extension import exact

#: The width of a camera's film, in millimetres.
FILM = 36.0
#: The irradiance of a sun.
SUN = 3.0
#: Sharper edges, in degrees, show where a mesh has no normals.
CREASE = 40.0


def opened(path: str) -> bpy.types.Scene:
    """Return a scene with a model, .glb or .ply, and nothing else, to be drawn with Cycles as it is."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    if path.endswith(".ply"):
        bpy.ops.wm.ply_import(filepath=path, forward_axis="NEGATIVE_Z", up_axis="Y")
        show_colors(bpy.context.object.data)
        if not bpy.context.object.data.has_custom_normals:  # octex's, of what has none
            bpy.context.object.data.shade_smooth()
            bpy.context.object.data.set_sharp_from_angle(angle=math.radians(CREASE))
    else:
        bpy.ops.import_scene.gltf(filepath=path)
    scene.render.engine = "CYCLES"
    scene.render.resolution_percentage = 100
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    return scene


def show_colors(mesh: bpy.types.Mesh) -> None:
    """Give a mesh with colours at its vertices a rough material of these."""
    material = bpy.data.materials.new("paint")
    nodes = material.node_tree.nodes
    colors, shader = nodes.new("ShaderNodeVertexColor"), nodes["Principled BSDF"]
    colors.layer_name = mesh.color_attributes[0].name = "paint"  # Cycles draws one named "color" black
    shader.inputs["Roughness"].default_value = 1.0
    material.node_tree.links.new(colors.outputs["Color"], shader.inputs["Base Color"])
    mesh.materials.append(material)


def suns(job: dict) -> dict:
    """Draw models from one camera, each under one sun after the other; return seconds that each takes."""
    spent = {}
    for name, path in job["models"].items():
        scene = opened(path)
        lamp = bpy.data.lights.new("sun", "SUN")  # as wide as the sun from the earth
        lamp.energy = SUN
        sun = bpy.data.objects.new("sun", lamp)
        scene.collection.objects.link(sun)
        scene.world = bpy.data.worlds.new("sky")
        scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*[job["sky"]] * 3, 1.0)
        sun.rotation_mode = "QUATERNION"
        scene.render.use_persistent_data = True
        spent[name] = []
        for number, direction in enumerate(job["suns"]):
            sun.rotation_quaternion = mathutils.Vector(direction).to_track_quat("Z", "Y")
            spent[name] += drawn(scene, [job["view"] | {"image": f"{job['folder']}/{name}-{number}.png"}])
    return spent


def bake(job: dict) -> dict:
    """Draw a model unlit, bake it, and draw it by an OSL node; return how long each takes."""
    scene = opened(job["model"])
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
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", FILM, FILM * job["focal"]
    data.clip_start, data.clip_end = 1e-3, 1e6
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)
    scene.camera.matrix_world = mathutils.Matrix(job["pose"])
    settings = scene.render
    settings.resolution_x, settings.resolution_y = job["pixels"]
    settings.film_transparent = True
    settings.dither_intensity = 0.0
    settings.filepath = job["image"]
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


print(json.dumps({"bake": bake, "suns": suns}[sys.argv[1]](json.loads(sys.argv[2]))))
