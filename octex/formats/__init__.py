"""Files of other tools.

models      writes surfaces with images or vertex colours, by the endings of their files
gltf, obj, usd, threemf, ply   one format each; ply also writes a texture as points
npz         a texture as arrays
web         a texture for pages and three.js; streams: integers as deflated bytes
osl         a texture as an image, with a shader that looks it up
ptex        texels for the polygons of a mesh, read and written
images      images of materials as files
"""
