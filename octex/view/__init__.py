"""Visibility of meshes and cubes from a camera, and normals for shading.

It knows arrays of vertices and triangles, but neither textures nor model files.

zbuffer       the triangle that each pixel sees
visibility    which points a camera sees
cubes         a z-buffer of cubes, for drawing cells
shading       face normals and smooth corner normals
"""
