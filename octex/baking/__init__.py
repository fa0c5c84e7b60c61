"""Bakes octree textures to images, vertex colours and displaced surfaces (Benson & Davis 2002, 6.3).

layout        where triangles lie in a map; the edges of charts
unfold        flattens charts: mends folds and overlaps
charts        divides a surface into charts
atlas         packs charts into a map
coordinates   whether a model's texture coordinates can show a texture
sheets        which triangles share maps: those of a material, or all
texels        the point of the surface that each texel shows
blocks        the field at the texels of a triangle, many at a time
gutters       the texels around charts
directions    tangent space
maps          channels at texels, as images of a material
bake          all of these: a texture and a surface in, a surface with images out

tessellation  divides triangles so that neighbours share the new vertices
vertices      vertex colours
displaced     moves a surface along its normals
simplify      meshes of fewer triangles
finish        a light mesh with images from any mesh
"""
