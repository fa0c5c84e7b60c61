"""Ptex: textures without coordinates, with texels for each face of a mesh (Burley & Lacewell, EGSR 2008).

layout      the file format, drawn
reader      reads files lazily
writer      writes files
patches     a mesh's polygons as Ptex faces, their neighbours, and points on them
pyramid     texels of faces and their means, with rims
triangles   interpolation between triangular texels
field       interpolation by position on the mesh
source      a file's texels as the source of a surface
export      a texture's values as texels of faces
"""
