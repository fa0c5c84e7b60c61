"""What a model looks like: cameras, what they see of a mesh (and of cubes), and how that is lit.

Knows arrays of vertices and triangles; nothing of textures and model files.

camera        pictures' sizes, lenses and poses
camera_files  cameras read and written: records, and a reader a format
differentials how what a pixel sees moves to the next
zbuffer       the triangle that each pixel sees
visibility    which points a camera sees
cubes         cells drawn as cubes
shading       soft light on what is seen, and smooth normals
environment   light from all around
reflection    what materials reflect of that
"""
