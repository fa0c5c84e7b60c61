"""From octree textures to images for other tools (Benson & Davis 2002, 6.3).

layout      where triangles lie in a map: at coordinates of their own, and the edges of charts
atlas       coordinates for any surface: charts, flattened and packed
sheets      which triangles share maps: those of a material, or all
texels      which point of the surface a texel shows
blocks      the field at texels, some of a triangle at a time
gutters     what stands around charts
fit         texels that read like the field between them
maps        the channels at these points, as images of a material
vertices    colours at vertices instead
bake        all of it: a texture and a surface in, a surface with images out
"""
