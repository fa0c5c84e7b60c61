"""Ptex: textures without coordinates, texels for each face of a mesh (Burley and Lacewell, EGSR 2008).

layout      what a file has, drawn
reader      reading, lazily; reduction: halving texels
writer      writing
patches     a mesh's polygons as Ptex has them: faces, neighbours, and where their points are
pyramid     texels of faces and their means, with rims; triangles: what lies between triangular texels
field       what lies between texels, by position on the mesh
source      a file's texels as the source of a surface
export      a texture's values as texels of faces
"""
