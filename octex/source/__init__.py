"""Where values come from: models, their geometry, materials and images, as one surface with a source.

images/     image files decoded, their levels stored, footprints read by filters
models/     glTF, USD, OBJ, PLY, OFF, STL and 3MF files read
base        what a source is; sources joined
materials   the source that model files have
evaluate    its kernels
mesh        triangles and their polygons, posed and at rest; points on them
corners     what is bound to the corners of triangles
tangents    frames of normals and tangents there
given       channels of one's own: images (mapped), functions (function), numbers
transfer    another model's nearest surface; cloud: coloured points
voxels      values in cells of a grid, a texture by themselves; vxz: O-Voxel's files
surface     triangles with a source
implicit    where a function is zero, as triangles
parts       what hangs together, and what intersects or nearly touches
welding     vertices at one place; distinct: rows of numbers, each once
separation  such parts, moved apart at rest
motion      how a model moves over time
load        any model file as a surface
alone       settings of the whole process, changed for a moment
"""
