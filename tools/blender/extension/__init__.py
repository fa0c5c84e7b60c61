# SPDX-License-Identifier: GPL-3.0-or-later
"""Octree textures in Blender: make one of an object, paint it, project photographs, bake it."""

import bpy

from . import jobs, operators, panel, settings, watching


def register() -> None:
    for part in (settings, operators, panel):
        part.register()


def unregister() -> None:
    for part in (watching, panel, operators, jobs, settings):
        part.unregister()


if __name__ == "__main__" and bpy.app.background:
    register()
