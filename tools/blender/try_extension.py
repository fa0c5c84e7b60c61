#!/usr/bin/env python
"""Use the extension as a user of Blender does, without a window; print what came of it as JSON.

usage: tools/blender/try_extension.py FOLDER, by a Python that has bpy and octex
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy  # type: ignore[import-not-found]
import extension
import numpy as np
from bpy_extras.object_utils import world_to_camera_view  # type: ignore[import-not-found]
from extension import objects, operators, watching
from mathutils import Vector  # type: ignore[import-not-found]

import octex
from octex.channels import linear_to_srgb, srgb_to_linear

SIZE = 256


def main() -> int:
    folder = Path(sys.argv[1])
    extension.register()
    package = installed()
    told: dict[str, Any] = {"refused": refused(folder)}
    told["grey"] = grey()
    told["material"] = material(folder)
    told["atlas"] = atlas()
    told["photograph"] = photograph(folder)
    told["painted"] = painted()
    told["exact"] = exact("painted", folder)
    plate()
    told["exact plate"] = exact("plate", folder)
    channels()
    told["exact channels"] = exact("channels", folder)
    told |= {"stuck": stuck(), "packages": package.exists()}
    extension.unregister()
    print(json.dumps(told))
    return 0


def installed() -> Path:
    """Return a file of a package that another extension has installed."""
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    path = Path(bpy.utils.user_resource("EXTENSIONS"), ".local", "lib", version, "site-packages", "other.py")
    path.parent.mkdir(parents=True)
    path.touch()
    return path


def ball(name: str = "ball") -> bpy.types.Object:
    """Add a ball of triangles, turned, mirrored and moved, and make it the active object."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24)
    made = bpy.context.active_object
    made.name = name
    mesh = made.data
    mesh.calc_loop_triangles()
    triangles, loops = np.empty((2, 3 * len(mesh.loop_triangles)), np.int32)  # Blender's own are in any order
    mesh.loop_triangles.foreach_get("vertices", triangles)
    mesh.loop_triangles.foreach_get("loops", loops)
    uv = np.empty((len(mesh.loops), 2), np.float32)
    mesh.uv_layers[0].uv.foreach_get("vector", uv.reshape(-1))
    made.data = bpy.data.meshes.new(name)
    made.data.from_pydata([each.co for each in mesh.vertices], [], triangles.reshape(-1, 3).tolist())
    made.data.uv_layers.new().uv.foreach_set("vector", uv[loops].reshape(-1))
    made.location, made.rotation_euler, made.scale = (3, -2, 1), (0.3, 0.2, 1.0), (-1.5, 1.5, 1.5)
    made.octex.depth = 7
    return made


def gradient(name: str, floats: bool = False) -> bpy.types.Image:
    """Return an image whose red grows to the right and whose green grows upwards, in sRGB."""
    image = bpy.data.images.new(name, SIZE, SIZE, float_buffer=floats)
    image.colorspace_settings.name = "sRGB"
    across = (np.arange(SIZE) + 0.5) / SIZE
    pixels = np.ones((SIZE, SIZE, 4), np.float32)
    pixels[..., 0], pixels[..., 1], pixels[..., 2] = across, across[:, None], 0.25
    if floats:
        pixels = srgb_to_linear(pixels).astype(np.float32)
    image.pixels.foreach_set(pixels.reshape(-1))
    return image


def own_material(chosen: bpy.types.Object, image: bpy.types.Image) -> bpy.types.ShaderNode:
    """Give an object a material of an image, and return the image's node."""
    own = bpy.data.materials.new("own")
    if own.node_tree is None:  # as before Blender 5
        own.use_nodes = True
    node = own.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    own.node_tree.links.new(
        node.outputs["Color"], own.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
    )
    chosen.data.materials.append(own)
    return node


def colors(chosen: bpy.types.Object) -> np.ndarray:
    """Return the colour attribute (corners, 4) as Blender's image pixels have it: codes / 255."""
    found = np.empty(4 * len(chosen.data.loops), np.float32)
    chosen.data.color_attributes[objects.NAME].data.foreach_get("color_srgb", found)
    return found.reshape(-1, 4)


def worst(difference: np.ndarray) -> float:
    return float(np.abs(difference).max() * 255)


def save(image: bpy.types.Image, path: Path) -> bpy.types.Image:
    """Save an image as PNG, and return it."""
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    return image


def uv_of(chosen: bpy.types.Object, layer: int | str = 0) -> np.ndarray:
    """Return the texture coordinates of corners (n, 2)."""
    uv = np.empty(2 * len(chosen.data.loops), np.float32)
    chosen.data.uv_layers[layer].uv.foreach_get("vector", uv)
    return uv.reshape(-1, 2)


def at_uv(chosen: bpy.types.Object) -> float:
    """Return how far the colours are from a gradient at the first UVs, away from poles and seam."""
    bpy.ops.octex.colors()
    uv = uv_of(chosen)
    inside = (np.abs(uv - 0.5) < 0.4).all(axis=1)  # at the poles and the seam, texels meet others
    return worst(colors(chosen)[inside, :2] - uv[inside])


def image_of(chosen: bpy.types.Object) -> tuple[bpy.types.Image, np.ndarray]:
    """Return the first image that an object shows, and its pixels (height, width, 4)."""
    nodes = chosen.material_slots[0].material.node_tree.nodes
    image = next(each for each in nodes if each.type == "TEX_IMAGE").image
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return image, pixels.reshape(image.size[1], image.size[0], 4)


def camera_at(place: tuple[float, float, float], chosen: bpy.types.Object) -> bpy.types.Object:
    """Return a new camera of the scene that looks at an object."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location = place
    camera.rotation_euler = (camera.location - chosen.location).to_track_quat("Z", "Y").to_euler()
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    bpy.context.view_layer.update()
    return camera


def seen_at(chosen: bpy.types.Object, camera: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return where a camera's image has the corners (n, 2), and which of them it sees well."""
    places, seen = [], []
    for loop in chosen.data.loops:
        place = chosen.matrix_world @ chosen.data.vertices[loop.vertex_index].co
        outward = (place - chosen.location).normalized()
        places.append(world_to_camera_view(bpy.context.scene, camera, Vector(place))[:2])
        seen.append(outward.dot((camera.location - place).normalized()) > 0.6)
    return np.array(places), np.array(seen)


def refusal(command: str) -> str:
    """Return why a command refuses the active object."""
    try:
        getattr(bpy.ops.octex, command)()
    except RuntimeError as error:
        return str(error).removeprefix("Error: ").strip()
    return "it did not refuse"


def refused(folder: Path) -> list[str]:
    """Return what is said of objects that cannot be used."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    ball()
    said = [refusal("make")]
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    said += map(refusal, ("colors", "photographs", "images"))
    empty = bpy.data.objects.new("empty", bpy.data.meshes.new("empty"))
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.view_layer.objects.active = empty
    said.append(refusal("make"))
    bpy.context.view_layer.objects.active = bpy.data.objects["ball"]
    bpy.ops.object.mode_set(mode="EDIT")
    said.append(refusal("make"))
    bpy.ops.object.mode_set(mode="OBJECT")
    (folder / "ball.octex").write_bytes(b"no texture")
    return [*said, refusal("colors")]


def grey() -> float:
    """Make a grey texture, and return how far the colours are from grey."""
    chosen = bpy.data.objects["ball"]
    chosen.octex.origin = "GREY"
    bpy.ops.octex.make()
    bpy.ops.octex.colors()
    return worst(colors(chosen)[:, :3] - 0.5)


def material(folder: Path) -> dict[str, Any]:
    """Make a texture of a material's image, and return how far the colours are from it at the UVs."""
    chosen = ball("painted")
    own_material(chosen, save(gradient("gradient"), folder / "gradient.png"))
    chosen.octex.depth = 8
    bpy.ops.octex.make()
    found = at_uv(chosen)
    names = {"kept": chosen.data.materials[0].name, "shown": chosen.material_slots[0].material.name}
    return names | {"worst": found, "scenes": len(bpy.data.scenes)}


def atlas() -> dict[str, Any]:
    """Bake images at new UVs, and return how far they are from the colours at corners."""
    chosen = bpy.data.objects["painted"]
    chosen.octex.layout, chosen.octex.texture_size = "ATLAS", 512
    bpy.ops.octex.images()
    image, pixels = image_of(chosen)
    size = len(pixels)
    places = np.clip((uv_of(chosen, objects.UV_MAP) * size).astype(int), 0, size - 1)
    off = np.abs(pixels[places[:, 1], places[:, 0], :2] - colors(chosen)[:, :2]).max(axis=1) * 255
    return {"size": size, "median": float(np.median(off)), "space": image.colorspace_settings.name}


def photograph(folder: Path) -> dict[str, Any]:
    """Project a camera's background image, and return how far colours are from it where it sees the ball."""
    chosen = bpy.data.objects["ball"]
    image = save(gradient("photograph"), folder / "photograph.png")
    image.pack()
    (folder / "photograph.png").unlink()
    camera = camera_at((9, -8, 4), chosen)
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = 40.0, 0.05, -0.02
    camera.data.background_images.new().image = image
    bpy.context.view_layer.objects.active = chosen
    bpy.ops.octex.photographs()
    bpy.ops.octex.colors()
    places, is_seen = seen_at(chosen, camera)
    return {"corners": int(is_seen.sum()), "worst": worst(colors(chosen)[is_seen, :2] - places[is_seen])}


def painted() -> dict[str, Any]:
    """Open the painting page, save a grey texture as it does, and return what the object then shows."""
    chosen = bpy.data.objects["ball"]
    chosen.data.color_attributes.remove(chosen.data.color_attributes[objects.NAME])
    chosen.data.materials.clear()  # it shows no bake
    os.environ["BROWSER"] = "true"
    bpy.context.view_layer.objects.active = chosen
    bpy.ops.octex.paint()
    while watching._painted[chosen.session_uid].process is None:
        watching.look()
        time.sleep(0.05)
    output = watching._painted[chosen.session_uid].output
    chosen.octex.origin, chosen.name = "GREY", "renamed"
    bpy.ops.octex.make()
    objects.texture_path(chosen).rename(output)
    began = time.monotonic()
    while not objects.shows_colors(chosen) and time.monotonic() - began < 60:
        watching.look()
        time.sleep(0.05)
    is_open = watching._painted[chosen.session_uid].process.poll() is None
    next_name = watching._next(output.with_name("other-8.octex")).name
    told = {"path": chosen.octex.path, "is_open": is_open, "next": next_name}
    return told | {"worst": worst(colors(chosen)[:, :3] - 0.5)}


class Stubborn(operators.Working):
    """An operator whose job is done, and which cannot take over what it has made."""

    job = SimpleNamespace(poll=dict, close=lambda: None, warnings=[], stage="", share=0.0)

    def report(self, *_: object) -> None:
        """Say nothing."""

    def finish(self, _context: bpy.types.Context, _answer: dict[str, Any]) -> str:
        """Fail."""
        raise OSError


def stuck() -> dict[str, bool]:
    """Return whether painting is offered while an operator runs, and what is after it has failed."""
    manager = bpy.context.window_manager
    operators.Working.running = own = Stubborn()
    own._timer = manager.event_timer_add(1, window=manager.windows[0])
    told = {"at work": operators.OCTEX_OT_paint.poll(bpy.context)}
    with suppress(OSError):
        own.modal(bpy.context, SimpleNamespace(type="TIMER"))
    return told | {"after": operators.OCTEX_OT_paint.poll(bpy.context)}


def plate() -> None:
    """Add a bent plate thinner than cells, another colour on each side, and a texture of it."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=12, y_subdivisions=12, size=2)
    made = bpy.context.active_object
    made.name, made.octex.depth, made.octex.origin = "plate", 6, "MATERIAL"
    for name, color in (("over", (0.8, 0.1, 0.1, 1)), ("under", (0.1, 0.2, 0.9, 1))):
        own = bpy.data.materials.new(name)
        if own.node_tree is None:
            own.use_nodes = True
        own.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color
        made.data.materials.append(own)
    thick = made.modifiers.new("thick", "SOLIDIFY")
    thick.thickness, thick.material_offset, thick.material_offset_rim = 0.004, 1, 1
    bpy.ops.object.modifier_apply(modifier=thick.name)
    bend = made.modifiers.new("bend", "SIMPLE_DEFORM")
    bend.deform_method, bend.angle = "BEND", 1.2
    bpy.ops.octex.make()


def channels() -> None:
    """Add a ball with a texture of several channels, partly transparent."""
    made = ball("channels")
    mesh = objects.mesh_arrays(made)
    surface = octex.Surface.from_arrays(mesh["rest"], mesh["triangles"], normals=mesh["normals"])
    sources = {
        "base_color": lambda points: 0.5 + 0.5 * np.sin(9 * points),
        "alpha": lambda points: np.clip(0.5 + 2 * points[:, 1], 0, 1),
        "roughness": lambda points: 0.5 + 0.5 * points[:, 0],
        "metallic": 0.25,
        "normal": lambda points: 0.7 * points + (0, 0.2, 0),
    }
    octex.convert(surface.with_sources(sources), 6).save(objects.texture_path(made, exists=False))


def exact(name: str, folder: Path) -> dict[str, Any]:
    """Have Cycles draw an object by the OSL node; return how far each filter is from octex's own lookups."""
    chosen, scene = bpy.data.objects[name], bpy.context.scene
    bpy.context.view_layer.objects.active = chosen
    scene.render.engine = "CYCLES"
    bpy.ops.octex.exact()
    material = chosen.material_slots[0].material
    nodes, links = material.node_tree.nodes, material.node_tree.links
    node = next(each for each in nodes if each.type == "SCRIPT")
    shader = nodes.new("ShaderNodeEmission")
    links.new(shader.outputs[0], next(each for each in nodes if each.type == "OUTPUT_MATERIAL").inputs[0])
    draw = Drawing(chosen, shader.inputs["Color"], folder)
    place = node.inputs["Position"].links[0].from_socket
    rest = draw(place)
    if node.inputs["Normal"].is_linked:
        normals = draw(node.inputs["Normal"].links[0].from_socket)
    else:
        turned = nodes.new("ShaderNodeVectorTransform")
        turned.vector_type, turned.convert_from, turned.convert_to = "NORMAL", "WORLD", "OBJECT"
        links.new(nodes.new("ShaderNodeNewGeometry").outputs["Normal"], turned.inputs[0])
        normals = draw(turned.outputs[0])
    inside = rest[:, 3] == 1
    rest, normals = (objects.rotated(each[inside, :3].astype(np.float64)) for each in (rest, normals))
    texture = octex.open(objects.texture_path(chosen))
    told: dict[str, Any] = {"pixels": int(inside.sum()), "split": int(texture.tree.split.cells.size)}
    for number, filter in enumerate(("nearest", "linear", "quadratic")):
        node.inputs["Filter"].default_value = number
        shown = linear_to_srgb(draw(node.outputs["base_color"])[inside, :3])
        off = np.abs(shown - linear_to_srgb(texture.sample(rest, filter=filter, normals=normals)))
        told[filter] = float(np.quantile(off.max(axis=1) * 255, 0.999))
    for channel in {"alpha", "roughness", "metallic"} & set(texture.channels):
        shown = draw(node.outputs[channel])[inside, 0]
        told[channel] = worst(shown - texture.sample(rest, channel, normals=normals)[:, 0])
    if "normal" in texture.channels:
        matrix = np.linalg.inv(np.array(chosen.matrix_world)[:3, :3])
        expected = texture.sample(rest, "normal", normals=normals)[:, [0, 2, 1]] * (1, -1, 1) @ matrix
        told["normal"] = worst(draw(node.outputs["normal_"])[inside, :3] - normalized(expected))
    draw.close()
    return told


def normalized(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


class Drawing:
    """Draws an object from one side, a ray a pixel, as what a socket holds."""

    def __init__(self, chosen: bpy.types.Object, shown: bpy.types.NodeSocket, folder: Path) -> None:
        self._links, self._shown, self._path = shown.id_data.links, shown, folder / "drawn.exr"
        self._scene = scene = bpy.data.scenes.new("drawing")
        scene.collection.objects.link(chosen)
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(camera)
        camera.location = chosen.location + Vector((1, -3, 2)) * 2
        camera.rotation_euler = (camera.location - chosen.location).to_track_quat("Z", "Y").to_euler()
        scene.camera, scene.render.engine, scene.render.film_transparent = camera, "CYCLES", True
        scene.render.resolution_x = scene.render.resolution_y = SIZE
        scene.cycles.shading_system, scene.cycles.samples, scene.cycles.device = True, 1, "CPU"
        scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
        scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
        scene.render.filepath = str(self._path)
        settings = scene.render.image_settings
        settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGBA"

    def __call__(self, socket: bpy.types.NodeSocket) -> np.ndarray:
        """Return pixels (n, 4)."""
        self._links.new(socket, self._shown)
        bpy.ops.render.render(write_still=True, scene=self._scene.name)
        image = bpy.data.images.load(str(self._path))
        pixels = np.empty(4 * SIZE * SIZE, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
        return pixels.reshape(-1, 4)

    def close(self) -> None:
        """Remove the scene and its camera."""
        bpy.data.objects.remove(self._scene.camera)
        bpy.data.scenes.remove(self._scene)


if __name__ == "__main__":
    sys.exit(main())
