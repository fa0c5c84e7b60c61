"""What a model looks like: cameras, what they see of a mesh (and of cubes), and how that is lit.

Knows arrays of vertices and triangles; nothing of textures and model files.
"""
