"""Files that are not our own: what other tools read.

models      surfaces with images or vertex colours, by the endings of their files
gltf, obj, usd, threemf  each of them; ply: also a texture as points
npz         a texture as arrays
ptex        texels for the polygons of a mesh, both ways
images      images of materials, and what is bound to vertices, as files have them
units       units of length that files state
origins     where positions in float32 are written from
"""
