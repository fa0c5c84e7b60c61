"""What a model looks like: what cameras see of a mesh (and of cubes), and how that is lit.

Knows arrays of vertices and triangles; nothing of textures and model files.

zbuffer       the triangle that each pixel sees
visibility    which points a camera sees
cubes         cells drawn as cubes
shading       soft light on what is seen, and smooth normals
environment   light from all around
reflection    what materials reflect of that
"""
