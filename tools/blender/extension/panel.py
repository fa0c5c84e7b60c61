# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in the sidebar of the 3D view."""

import textwrap

import bpy

from .operators import Working
from .watching import failures


class OCTEX_PT_main(bpy.types.Panel):
    """Octree texture of the active object."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "Octree"
    bl_label = "Octree Texture"

    def draw(self, context: bpy.types.Context) -> None:
        layout, chosen = self.layout, context.active_object
        layout.use_property_split = True
        layout.use_property_decorate = False
        if chosen is None or chosen.type != "MESH":
            layout.label(text="Select a mesh object", icon="INFO")
            return
        running = Working.running
        if running is not None:
            layout.progress(factor=running.job.share, text=running.job.stage or "Starting")
            layout.label(text="Esc cancels")
        settings = chosen.octex
        layout.prop(settings, "path")
        box = layout.box()
        box.prop(settings, "origin", expand=True)
        box.prop(settings, "depth")
        box.operator("octex.make", icon="SHADING_TEXTURE")
        layout.operator("octex.paint", icon="BRUSH_DATA")
        for line in textwrap.wrap(failures.get(chosen.session_uid, ""), 40):
            layout.label(text=line, icon="ERROR")
        layout.operator("octex.view", icon="VIEW_CAMERA")
        layout.operator("octex.strokes", icon="TPAINT_HLT")
        box = layout.box()
        box.prop(settings, "cameras")
        box.operator("octex.photographs", icon="CAMERA_DATA")
        box = layout.box()
        box.operator("octex.colors", icon="GROUP_VCOL")
        box.prop(settings, "layout", expand=True)
        box.prop(settings, "texture_size")
        box.operator("octex.images", icon="IMAGE_DATA")
        layout.operator("octex.exact", icon="NODE_MATERIAL")


register, unregister = bpy.utils.register_classes_factory([OCTEX_PT_main])
