"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4).

paint       all of it; painter: a session of strokes; region: spheres, boxes and functions filled
picture     images with cameras, checked and decoded; sharpened: as values at points
surface     what is painted, with what stays the same between strokes; triangle_grid: its triangles near paint
unwrap      a disc of the surface laid flat, for a camera; conformal: so that angles change least
sight       what cameras see of the surface; project: what pictures paint at its points
holes       what no picture saw, filled: multigrid on the graph of sheets, the surface in cells
layer       these rasterized into a paint octree
merge       a layer blended into a texture, once for each cell; tiles: a large layer part by part
raising     the texture brought to where paint is finer; cells, kept: paint beside coarser cells and on nodes
blend       each cell blended once; averages: nodes above what was painted
resume      finished stages, stored in a folder for the next call
"""
