"""From a surface to an octree texture: the cells that it meets, and what it shows in each of them.

convert     all of it; sets: textures of a model's parts; points, voxels: without a surface
apart       parts moved off each other
numbering   which blocks of cells triangles reach
cells       which cells they meet, exactly; pieces, clip: what of them lies in each cell
accumulate  sums over the pieces: means, areas, facings
levels      these steps, block by block, and the tree made of what they give
gaps        cells that a source knows nothing of
facings     cells whose sides show different values
samples     points of the surface in each cell
fit, solve  leaves whose field meets the samples; cubes: where all are finest cells; sides: for each facing
adapt       leaves merged where the field stays near: detail, measure, prune, distances, patches, nearness,
            coefficients
formats     how channels are stored
"""
