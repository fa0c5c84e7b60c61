# SPDX-License-Identifier: GPL-3.0-or-later
"""What is stored with an object: where its octree texture lies, and how it is made and baked."""

import bpy
from bpy.props import EnumProperty, IntProperty, PointerProperty, StringProperty


class Settings(bpy.types.PropertyGroup):
    """The octree texture of an object."""

    path: StringProperty(
        name="Texture",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        description="The .octex file; empty: next to the .blend file",
    )
    depth: IntProperty(
        name="Depth", default=9, min=1, max=14,
        description="Levels of the octree: the finest cells are 1/2^depth of the object's size",
    )  # fmt: skip
    cameras: StringProperty(
        name="Cameras",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        description="A COLMAP folder, or a file of cameras, in the scene's axes; its images lie next to it",
    )
    origin: EnumProperty(
        name="Colours",
        items=[
            ("MATERIAL", "Material", "Take the images, colours and values of the object's materials"),
            ("GREY", "Grey", "Begin with grey, to paint on"),
        ],
    )
    texture_size: IntProperty(
        name="Size",
        default=2048,
        min=64,
        max=16384,
        description="Width and height of baked images, in pixels",
    )
    layout: EnumProperty(
        name="UVs",
        items=[
            ("KEEP", "Own", "Bake at the UV map that is active for rendering"),
            ("ATLAS", "New", "Make a UV map without overlaps, and bake at it"),
        ],
    )


def register() -> None:
    bpy.utils.register_class(Settings)
    bpy.types.Object.octex = PointerProperty(type=Settings)


def unregister() -> None:
    del bpy.types.Object.octex
    bpy.utils.unregister_class(Settings)
