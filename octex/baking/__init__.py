"""From octree textures to images for other tools (Benson & Davis 2002, 6.3).

layout        where triangles lie in a map, at their own coordinates; the edges of charts
atlas         coordinates for any surface: charts, flattened and packed
coordinates   whether a model's own coordinates can show a texture
sheets        which triangles share maps: those of a material, or all
texels        the point of the surface that each texel shows
blocks        the field at texels, some of a triangle at a time
flat          triangles without area in the map
gutters       the texels around charts
fit           texels that read like the field between them
directions    normals, tangents and directions relative to them
maps          channels at texels, as images of a material
bake          all of it: a texture and a surface in, a surface with images out

tessellation  triangles divided so that neighbours meet at the same vertices
vertices      colours at vertices instead
displaced     surfaces moved along their normals
"""
