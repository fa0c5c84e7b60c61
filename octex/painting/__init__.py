"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4).

paint       all of it; painter: a session of strokes; region: spheres, boxes and functions filled
pictures    images with cameras, checked and decoded; sharpened: as values at points
resuming    what is done, kept in a folder for the next call
balance     gains and vignetting of pictures that overlap; sharpness: blurred ones weighed
agreement   masks of what only one of them saw; overexposed: of what is cut off; patches: what they look at
best        one picture for each patch: labels of sheets, and what levels their borders
refine      cameras that are a little off; moved: what pictures show as these move; consensus: what they say
            of the same points together
unwrap      a disc of the surface laid flat, for a camera; conformal: so that angles change least
shots       pictures before what their cameras see; projected: what they paint at points of the surface
holes       what no picture saw, filled: multigrid on the graph of sheets, the surface in cells
layer       these rasterized into a paint octree; near: the triangles around it
merge       a layer blended into a texture, once for each cell
raising     the texture brought to where paint is finer; cells, kept: paint beside coarser cells and on nodes
averages    nodes above what was painted
"""
