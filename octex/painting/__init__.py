"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4).

paint       all of it; painter: a session of strokes; region: spheres, boxes and functions filled
pictures    images with cameras, checked and decoded; balance: their gains and vignetting
agreement   masks of what only one picture saw; refine: cameras that are a little off
consensus   by which numbers pictures agree best: least squares of balance and refine
projected   what pictures paint at points of the surface
layer       these rasterized into a paint octree; near: the triangles around it; centres: of pixels, to fit to
merge       a layer blended into a texture, once for each cell
raising     the texture brought to where paint is finer; cells, kept: paint beside coarser cells and on nodes
averages    nodes above what was painted
"""
