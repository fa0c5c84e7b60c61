# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials for Cycles whose OSL node looks the octree up at each point: nothing is baked."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from . import objects

#: Sockets of the shader: its inputs; and its outputs, a colour, a number or a direction.
_INPUTS = {"Position": "Vector", "Normal": "Vector", "Filter": "Int", "ZUp": "Int", "File": "String"}
_SOCKETS = {3: "NodeSocketColor", 1: "NodeSocketFloat", 0: "NodeSocketVector"}


def check_osl(context: bpy.types.Context) -> None:
    """Raise ObjectError where Cycles or its OSL is missing."""
    try:
        import _cycles
    except ImportError:
        _cycles = None
    if _cycles is None or not hasattr(context.scene, "cycles"):
        raise objects.ObjectError("Enable the add-on Cycles Render Engine first")
    if not _cycles.with_osl:
        raise objects.ObjectError("This Blender was built without OSL: bake to images, or use another")


def show(
    context: bpy.types.Context,
    chosen: bpy.types.Object,
    shader: Path,
    outputs: Sequence[tuple[str, int, str]],
    rest: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Show an object by a shader file with outputs: names, 3, 1 or 0 for a direction, and their channels.

    A deformed object needs its rest: positions of vertices and normals of corners (n, 3). Raises ObjectError
    if the shader does not compile.
    """
    code = compiled(shader)
    if rest is not None:
        objects.set_vectors(chosen, objects.NORMAL, "CORNER", rest[1])
        objects.set_vectors(chosen, objects.REST, "POINT", rest[0])
    context.scene.cycles.shading_system = True
    material, principled = objects.emptied(f"{chosen.name} octree exact")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    node = nodes.new("ShaderNodeScript")
    node.mode, node.location = "INTERNAL", (-350, 0)
    node.bytecode, node.bytecode_hash = code, hashlib.md5(code.encode(), usedforsecurity=False).hexdigest()
    for name, kind in _INPUTS.items():
        if name not in node.inputs:
            node.inputs.new(f"NodeSocket{kind}", name)
    node.inputs["Filter"].default_value, node.inputs["ZUp"].default_value = 2, 1
    node.inputs["File"].default_value = str(shader.with_name(f"{shader.name}.tif"))
    if rest is not None:
        for name, socket in ((objects.REST, "Position"), (objects.NORMAL, "Normal")):
            stored = nodes.new("ShaderNodeAttribute")
            stored.attribute_name = name
            stored.location = (-600, 0 if socket == "Position" else -200)
            links.new(stored.outputs["Vector"], node.inputs[socket])
    else:
        place = nodes.new("ShaderNodeTexCoord")
        place.location = (-600, 0)
        links.new(place.outputs["Object"], node.inputs["Position"])
        links.new(_outward(material.node_tree), node.inputs["Normal"])
    for name, components, channel in outputs:
        output = node.outputs.get(name) or node.outputs.new(_SOCKETS[components], name)
        if channel in objects.SOCKETS:
            links.new(output, principled.inputs[objects.SOCKETS[channel]])
    if any(channel == "emissive" for _, _, channel in outputs):
        principled.inputs["Emission Strength"].default_value = 1.0
    objects.put(chosen, lambda _: material)


def _outward(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Return the normal of a face's front in the object's axes: Blender 5.3's shaders do not have it."""
    kinds = ("NewGeometry", "Math", "VectorMath", "VectorTransform")
    geometry, sign, front, turned = (tree.nodes.new(f"ShaderNode{kind}") for kind in kinds)
    for place, node in enumerate((geometry, sign, front, turned)):
        node.location = (200 * place - 1200, -200)
    sign.operation, front.operation = "MULTIPLY_ADD", "SCALE"
    sign.inputs[1].default_value, sign.inputs[2].default_value = -2.0, 1.0
    turned.vector_type, turned.convert_from, turned.convert_to = "NORMAL", "WORLD", "OBJECT"
    tree.links.new(geometry.outputs["Backfacing"], sign.inputs[0])
    tree.links.new(geometry.outputs["Normal"], front.inputs["Vector"])
    tree.links.new(sign.outputs[0], front.inputs["Scale"])
    tree.links.new(front.outputs["Vector"], turned.inputs["Vector"])
    return turned.outputs["Vector"]


def compiled(shader: Path) -> str:
    """Return the code of a shader file; raises ObjectError."""
    import _cycles

    code = shader.with_suffix(".oso")
    try:
        if not _cycles.osl_compile(str(shader), str(code)):
            raise objects.ObjectError(f"{shader} does not compile: see Blender's console")
        return code.read_text(encoding="utf-8")
    finally:
        code.unlink(missing_ok=True)
