"""Where values come from: models, their geometry, materials and images, as one surface with a source.

images/     image files decoded, their levels stored, footprints read by filters
models/     glTF, USD, OBJ, PLY, OFF, STL and 3MF files read
base        what a source is: combined and joined ones, those by position, what is laid on surfaces
materials   the source that model files have; evaluate: its kernels
mesh        triangles and their polygons, posed and at rest; points on them
corners     what is bound to the corners of triangles
tangents    frames of normals and tangents there; vectors: what kernels share
overrides   channels of one's own: functions, images, numbers; mapped: images laid on by position
transfer    another model's nearest surface; cloud: coloured points
voxels      values in cells of a grid, a texture by themselves
surface     triangles with a source
misplaced   surfaces that are not the texture's
implicit    where a function is zero, as triangles
subdivided  limit surfaces of cages; subdivision: their rules
parts       what hangs together, what intersects or nearly touches, and these moved apart at rest
welding     vertices at one place, and rows of numbers, each once
colors      colours as users and files give them, as linear light
motion      how a model moves over time
load        any model file as a surface
"""
