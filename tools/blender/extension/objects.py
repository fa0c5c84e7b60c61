# SPDX-License-Identifier: GPL-3.0-or-later
"""What octex needs of objects, and what comes back to them.

octex works on the object's own mesh at rest: without modifiers, at the first shape key, in the object's axes.
Its rest positions have glTF's axes (y up), as in the model that the painting page shows.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

#: Attributes of a deformed mesh: where it rests, and its normals there.
REST, NORMAL = "octex rest", "octex normal"
#: Names of the colour attribute and of the UV map, which differ, and the mark of the extension's materials.
NAME, UV_MAP, MARK = "octex", "octex UV", "octex"
#: The property of baked materials that names the image of base colour.
BAKED = "octex baked"
#: The property of cameras that names the view which they drew, before it was painted on.
VIEW = "octex view"
#: Modifiers that move vertices but make none.
_DEFORMING = {
    "ARMATURE", "CAST", "CLOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM", "LATTICE", "MESH_DEFORM",
    "SHRINKWRAP",
    "SIMPLE_DEFORM", "SMOOTH", "CORRECTIVE_SMOOTH", "LAPLACIANSMOOTH", "SURFACE_DEFORM", "WARP", "WAVE",
    "COLLISION", "SOFT_BODY", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "NORMAL_EDIT", "WEIGHTED_NORMAL",
    "DATA_TRANSFER", "UV_PROJECT", "UV_WARP", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX",
    "VERTEX_WEIGHT_PROXIMITY",
}  # fmt: skip


class ObjectError(Exception):
    """An object, or what belongs to it, cannot be used; says what to do."""


def mesh_object(context: bpy.types.Context) -> bpy.types.Object:
    """Return the active object, a mesh with faces; raises ObjectError."""
    chosen = context.active_object
    if chosen is None or chosen.type != "MESH":
        raise ObjectError("Select a mesh object first")
    if chosen.mode == "EDIT":
        raise ObjectError(f"Leave Edit Mode of {chosen.name} first")
    if not len(chosen.data.polygons):
        raise ObjectError(f"{chosen.name} has no faces; octree textures colour surfaces")
    return chosen


def found(name: str, uid: int) -> bpy.types.Object | None:
    """Return an object by its session_uid: it may be renamed; or by its name: the file may be read again."""
    same = (each for each in bpy.data.objects if each.session_uid == uid)
    return next(same, None) or bpy.data.objects.get(name)


def check_editable(chosen: bpy.types.Object) -> None:
    """Raise ObjectError for an object or a mesh that another file owns: it can show no bake."""
    for each in (chosen, chosen.data):
        if each.library is not None:
            raise ObjectError(
                f"{each.name} is linked from {Path(each.library.filepath).name}: make it local first "
                "(Object, Relations, Make Local, Selected Objects and Data)"
            )


def making_modifiers(chosen: bpy.types.Object) -> list[str]:
    """Return the names of the modifiers that make geometry, which octex does not see."""
    return [each.name for each in chosen.modifiers if each.type not in _DEFORMING and each.show_viewport]


def texture_path(chosen: bpy.types.Object, exists: bool = True) -> Path:
    """Return the absolute path of an object's texture; raises ObjectError if it is to exist and does not."""
    path = chosen.octex.path or f"//{bpy.path.clean_name(chosen.name)}.octex"
    if path.startswith("//") and not bpy.data.filepath:
        raise ObjectError("Save the .blend file first, or choose a file for the texture")
    found = Path(bpy.path.abspath(path, library=chosen.library))
    if exists and not found.exists():
        raise ObjectError(f"{found} does not exist; make the texture first")
    return found


# To octex


def rotated(positions: np.ndarray) -> np.ndarray:
    """Return positions or directions (n, 3) in glTF's axes."""
    return positions[:, [0, 2, 1]] * (1.0, 1.0, -1.0)


def _read(
    items: bpy.types.bpy_prop_collection, name: str, width: int, dtype: type = np.float32
) -> np.ndarray:
    values = np.empty(len(items) * width, dtype)
    items.foreach_get(name, values)
    return values.reshape(-1, width) if width > 1 else values


def mesh_arrays(chosen: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return an object's mesh as arrays: rest, triangles, corners (m, 3), and normals at these."""
    mesh = chosen.data
    mesh.calc_loop_triangles()
    at_rest = mesh.shape_keys.reference_key.data if mesh.shape_keys else mesh.vertices
    corners = _read(mesh.loop_triangles, "loops", 3, np.int32)
    return {
        "rest": rotated(_read(at_rest, "co", 3).astype(np.float64)),
        "triangles": _read(mesh.loop_triangles, "vertices", 3, np.int32),
        "corners": corners,
        "normals": rotated(_read(mesh.corner_normals, "vector", 3).astype(np.float64))[corners],
    }


def posed_positions(context: bpy.types.Context, chosen: bpy.types.Object) -> np.ndarray:
    """Return where the vertices lie (n, 3) in the object's own axes, deformed as it is seen."""
    mesh = chosen.evaluated_get(context.evaluated_depsgraph_get()).data
    if len(mesh.vertices) != len(chosen.data.vertices):
        names = ", ".join(making_modifiers(chosen)) or "a modifier"
        raise ObjectError(f"{chosen.name}: apply {names} first: photographs show what it makes")
    return _read(mesh.vertices, "co", 3)


def write_model(context: bpy.types.Context, chosen: bpy.types.Object, path: Path, form: str) -> None:
    """Write an object as .glb, at rest, in its own axes, in one of the forms of models: see `handover`."""
    shown, images = form == "shown", "NONE" if form == "without images" else "AUTO"
    with _alone(chosen, shown) as scene, context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        bpy.ops.export_scene.gltf(
            filepath=str(path), export_format="GLB", use_active_scene=True, export_apply=False,
            export_animations=False, export_skins=False, export_morph=False, export_yup=True,
            export_tangents=False, export_materials="EXPORT", export_image_format=images,
        )  # fmt: skip


@contextmanager
def _alone(chosen: bpy.types.Object, shown: bool) -> Iterator[bpy.types.Scene]:
    """Lend a scene with a copy of an object, bare of transforms and modifiers."""
    scene = bpy.data.scenes.new("octex")
    try:
        with bare_copy(chosen) as copy:
            copy.matrix_world = Matrix()
            for slot in copy.material_slots:
                if not shown and slot.material is not None and MARK in slot.material:
                    slot.link = "DATA"  # what the texture is made of, not how it is shown
            scene.collection.objects.link(copy)
            yield scene
    finally:
        bpy.data.scenes.remove(scene)


@contextmanager
def bare_copy(chosen: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """Lend a copy of an object that nothing moves or deforms."""
    copy = chosen.copy()
    try:
        copy.animation_data_clear()
        copy.parent = None
        copy.constraints.clear()
        copy.modifiers.clear()
        yield copy
    finally:
        bpy.data.objects.remove(copy)


def image_nodes(
    chosen: bpy.types.Object, shown: bool = False
) -> Iterator[tuple[bpy.types.Material, bpy.types.ShaderNode]]:
    """Yield the nodes with images of an object's materials, as `write_model` writes them."""
    for material in _materials(chosen, shown):
        for node in _nodes(material.node_tree):
            if node.type == "TEX_IMAGE" and node.image is not None:
                yield material, node


def _nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Yield the nodes of a tree and of its groups."""
    for node in tree.nodes:
        yield node
        if node.type == "GROUP" and node.node_tree is not None:
            yield from _nodes(node.node_tree)


def _materials(chosen: bpy.types.Object, shown: bool) -> Iterator[bpy.types.Material]:
    """Yield an object's materials that have nodes: its mesh's, or those that it shows."""
    for slot, own in zip(chosen.material_slots, chosen.data.materials, strict=True):
        material = slot.material
        if not shown and material is not None and MARK in material:
            material = own  # what the texture is made of, not how it is shown
        if material is not None and material.node_tree is not None:
            yield material


def check_images(chosen: bpy.types.Object, shown: bool = False) -> list[str]:
    """Return what octex will not see of an object's materials, as `write_model` writes them.

    Raises ObjectError for images with tiles, and for those without data.
    """
    for _, node in image_nodes(chosen, shown):
        if node.image.source == "TILED":
            raise ObjectError(f"{node.image.name} has UDIM tiles: bake it to one image first")
        if is_missing(node.image):
            raise ObjectError(f"{node.image.name} is missing: find or remove it first")
    complaints = []
    for material in _materials(chosen, shown):
        for node in material.node_tree.nodes:
            if node.type == "BSDF_PRINCIPLED" and node.inputs["Base Color"].is_linked:
                source = node.inputs["Base Color"].links[0].from_node
                if source.type.startswith("TEX_") and source.type != "TEX_IMAGE":
                    name = source.bl_label
                    complaints.append(
                        f"{material.name}: bake its {name} to an image first; octex cannot read it"
                    )
    return complaints


def is_missing(image: bpy.types.Image) -> bool:
    """Return whether an image has neither data nor a file; its size would have Blender read the file."""
    if image.has_data or image.packed_file is not None or image.source == "GENERATED":
        return False
    return not Path(bpy.path.abspath(image.filepath, library=image.library)).is_file()


def lens_and_pose(camera: bpy.types.Object) -> dict:
    """Return how a camera sees an image of any size; raises ObjectError."""
    data = camera.data
    if data.type != "PERSP":
        raise ObjectError(f"{camera.name} is no perspective camera")
    location, rotation, _ = camera.matrix_world.decompose()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(rotation.to_matrix()), location
    return {
        "lens": data.lens / (data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width),
        "fit": data.sensor_fit,
        "shift": [data.shift_x, data.shift_y],
        "pose": pose.tolist(),
    }


def view_camera(context: bpy.types.Context) -> bpy.types.Object:
    """Return the scene's camera, or one of no scene that sees what the 3D view does."""
    seen = getattr(context, "region_data", None)
    if seen is None or seen.view_perspective == "CAMERA":
        if context.scene.camera is None:
            raise ObjectError("The scene has no camera; add one, or press the button in a 3D view")
        return context.scene.camera
    if seen.view_perspective == "ORTHO":
        raise ObjectError("Switch the 3D view to perspective first (numpad 5)")
    # a view shows 72 mm where a camera has 36
    return new_camera(seen.view_matrix.inverted(), context.space_data.lens / 2)


def new_camera(pose: Matrix, lens: float) -> bpy.types.Object:
    """Return a camera that no scene has yet."""
    camera = bpy.data.objects.new("octex view", bpy.data.cameras.new("octex view"))
    camera.matrix_world, camera.data.lens = pose, lens
    return camera


def set_view(camera: bpy.types.Object, path: Path) -> None:
    """Give a camera the image that was drawn from it, to paint on, and keep the unedited one next to it."""
    before = path.with_name(f"{path.stem}-before.png")
    before.write_bytes(path.read_bytes())
    image = loaded(path)
    backgrounds = camera.data.background_images
    background = next((each for each in backgrounds if each.image in (None, image)), None)
    (background or backgrounds.new()).image = image
    camera.data.show_background_images = True
    camera[VIEW] = str(before)


# From octex


def loaded(path: Path) -> bpy.types.Image:
    """Return the image of a file; Blender reads its pixels when it shows them."""
    image = bpy.data.images.load(str(path), check_existing=True)
    if image.has_data:
        image.reload()
    return image


def set_colors(chosen: bpy.types.Object, colors: np.ndarray) -> None:
    """Store colours (corners, 4), linear light, as the colour attribute that is shown and drawn."""
    _check_same(chosen, len(chosen.data.loops), len(colors))
    attributes = chosen.data.color_attributes
    attribute = _attribute(attributes, NAME, "FLOAT_COLOR", "CORNER")  # bytes take 40 times as long
    attribute.data.foreach_set("color", np.ascontiguousarray(colors, np.float32).reshape(-1))
    attributes.active_color = attribute
    attributes.render_color_index = attributes.active_color_index
    chosen.data.update()


def _check_same(chosen: bpy.types.Object, count: int, before: int) -> None:
    """Raise ObjectError if a mesh has not as many vertices or corners as when a job began."""
    if chosen.mode == "EDIT" or count != before:
        raise ObjectError(f"{chosen.name} was edited meanwhile; bake it again in Object Mode")


def set_uv(chosen: bpy.types.Object, values: np.ndarray) -> None:
    """Store texture coordinates of corners (corners, 2) as a UV map; raises ObjectError."""
    _check_same(chosen, len(chosen.data.loops), len(values))
    layers = chosen.data.uv_layers
    layer = layers.get(UV_MAP) or layers.new(name=UV_MAP)
    if layer is None:
        raise ObjectError(f"{chosen.name} has no room for another UV map; remove one")
    layer.uv.foreach_set("vector", np.ascontiguousarray(values, np.float32).reshape(-1))
    chosen.data.update()


def set_vectors(chosen: bpy.types.Object, name: str, domain: str, values: np.ndarray) -> None:
    """Store vectors (n, 3) of vertices or corners as an attribute; raises ObjectError."""
    stored = _attribute(chosen.data.attributes, name, "FLOAT_VECTOR", domain)
    _check_same(chosen, len(stored.data), len(values))
    stored.data.foreach_set("vector", values.reshape(-1))


def _attribute(
    attributes: bpy.types.bpy_prop_collection, name: str, kind: str, domain: str
) -> bpy.types.Attribute:
    """Return an attribute of this kind, in the place of another one of its name."""
    stored = attributes.get(name)
    if stored is not None and (stored.domain, stored.data_type) != (domain, kind):
        attributes.remove(stored)
        stored = None
    return stored or attributes.new(name, kind, domain)


def show(chosen: bpy.types.Object, baked: Sequence[dict[str, Any]] = ()) -> None:
    """Show an object by baked materials (name, maps, values), or by its colour attribute without any."""

    def shown(own: bpy.types.Material | None) -> bpy.types.Material:
        same = [each for each in baked if own is not None and each["name"] == own.name] or baked[:1]
        return _material(chosen, same[0]) if same else _colored(chosen)

    put(chosen, shown)


def shows_colors(chosen: bpy.types.Object) -> bool:
    """Return whether an object shows its colour attribute."""
    shown = [each.material and each.material.name for each in chosen.material_slots]
    return bool(shown) and all(each == f"{chosen.name} octree" for each in shown)


def put(chosen: bpy.types.Object, shown: Callable[[bpy.types.Material | None], bpy.types.Material]) -> None:
    """Have an object's slots show other materials in the place of its mesh's, which stay."""
    if not chosen.material_slots:
        chosen.data.materials.append(None)
    for slot, own in zip(chosen.material_slots, chosen.data.materials, strict=True):
        slot.link = "OBJECT"
        slot.material = shown(own)


def _colored(chosen: bpy.types.Object) -> bpy.types.Material:
    """Return a material that shows the colour attribute."""
    material, shader = emptied(f"{chosen.name} octree")
    node = material.node_tree.nodes.new("ShaderNodeVertexColor")
    node.layer_name, node.location = NAME, (-300, 0)
    for output, socket in (("Color", "Base Color"), ("Alpha", "Alpha")):
        material.node_tree.links.new(node.outputs[output], shader.inputs[socket])
    return material


def _material(chosen: bpy.types.Object, baked: dict[str, Any]) -> bpy.types.Material:
    """Return a material of images and values of channels; without a name, at the new UV map."""
    material, shader = emptied(" ".join([chosen.name, baked["name"], "octree"]))
    nodes, links = material.node_tree.nodes, material.node_tree.links
    for channel, value in baked["values"].items():
        socket = shader.inputs[SOCKETS[channel]]
        socket.default_value = (*value, 1.0) if len(value) == 3 else value[0]
    coordinates = None
    if not baked["name"]:
        coordinates = nodes.new("ShaderNodeUVMap")
        coordinates.uv_map, coordinates.location = UV_MAP, (-850, 0)
    for place, (channel, image) in enumerate(baked["maps"].items()):
        height = 300 - 280 * place
        node = nodes.new("ShaderNodeTexImage")
        node.image, node.location = image, (-600, height)
        if coordinates is not None:
            links.new(coordinates.outputs["UV"], node.inputs["Vector"])
        output = node.outputs["Color"]
        if channel == "normal":
            turn = nodes.new("ShaderNodeNormalMap")
            turn.location = (-300, height)
            links.new(output, turn.inputs["Color"])
            output = turn.outputs["Normal"]
        links.new(output, shader.inputs[SOCKETS[channel]])
    image = baked["maps"].get("base_color")
    material[BAKED] = "" if image is None else bpy.path.abspath(image.filepath)
    if "emissive" in baked["maps"] or "emissive" in baked["values"]:
        shader.inputs["Emission Strength"].default_value = 1.0
    return material


def emptied(name: str) -> tuple[bpy.types.Material, bpy.types.ShaderNode]:
    """Return one of the extension's materials, with a Principled shader alone."""
    found = bpy.data.materials.get((name, None))  # not one of a library
    material = found if found is not None and MARK in found else bpy.data.materials.new(name)
    material[MARK] = True
    if material.node_tree is None:  # as before Blender 5
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output, shader = (tree.nodes.new(f"ShaderNode{each}") for each in ("OutputMaterial", "BsdfPrincipled"))
    output.location = (300, 0)
    tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return material, shader


#: The shader's inputs of channels.
SOCKETS = {
    "base_color": "Base Color", "roughness": "Roughness", "metallic": "Metallic", "alpha": "Alpha",
    "emissive": "Emission Color", "normal": "Normal",
}  # fmt: skip
