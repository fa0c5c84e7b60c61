# SPDX-License-Identifier: GPL-3.0-or-later
"""Octree textures in Blender: make one of an object, paint it, project photographs, bake it."""

import bpy

from . import operators, panel, settings, watching

_PARTS = (settings, operators, panel, watching)


def register() -> None:
    for part in _PARTS:
        part.register()


def unregister() -> None:
    for part in reversed(_PARTS):
        part.unregister()


if __name__ == "__main__" and bpy.app.background:
    register()
