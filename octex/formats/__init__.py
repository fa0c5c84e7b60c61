"""Files of other tools.

models      surfaces with images or vertex colours, by the endings of their files; what writers share
gltf, obj, usd, threemf  each of them, and ply: also a texture as points
npz         a texture as arrays
web         a texture as pages and three.js show it; streams: whole numbers as bytes, deflated
osl         a texture as an image, and a shader that looks it up
ptex        texels for the polygons of a mesh, read and written
images      images of materials as files
"""
