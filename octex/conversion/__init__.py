"""From a surface to an octree texture.

convert     all of it; sets: textures of a model's parts; points, voxels: without a surface
apart       parts moved off each other
levels      the surface voxelized block by block: means of all cells, and the tree of these, as stored
gaps        cells that a source knows nothing of
samples     points of the surface in each cell, with what the source shows there
fit, solve  leaves whose field meets the samples; numbering: which these are; cubes: all are finest cells
sides       a value for each side of a leaf
detail      how deep to go where; prune: trees with nodes as leaves
adapt       leaves merged where the field stays near; differences: how near between samples, by evaluator;
            measure: in codes
large       arrays in files
"""
