"""From a surface to an octree texture.

convert     the whole way; parts moved apart
sets        a texture for each part of a model
points      points and voxels, without a surface
levels      voxelizes the surface block by block: the means of all cells, and their tree
samples     points of the surface in each cell, with the source's values
fit         leaf values that fit the field to the samples: lookups finds the taps, solve the values
detail      local depth, from a function or channel
adapt       merges leaves where the field stays near: prune makes the trees, differences compares them,
            evaluator evaluates the field, measure says how far values are apart
large       arrays in files, and finished stages, stored in a folder for the next call
"""
