"""Where values come from: models, their geometry, materials and images, as one surface with a source.

images/     image files decoded, their levels stored, footprints read by filters
models/     glTF, USD, OBJ, PLY, OFF, STL and 3MF files read
base        the classes of sources: combined, joined, by position; and objects to lay on surfaces
materials   the source that model files have; evaluate: its kernels
mesh        triangles and their polygons, posed and at rest; points on them
corners     attributes of the corners of triangles: colours, coordinates, polygons, creases
tangents    frames of normals and tangents there; vectors: arithmetic for kernels
overrides   replacements of channels: functions, images, numbers; mapped: images projected by position
transfer    another model's nearest surface; cloud: coloured points
voxels      values in cells of a grid, a texture by themselves
surface     triangles with a source
misplaced   surfaces that are not the texture's
implicit    where a function is zero, as triangles
subdivided  limit surfaces of cages; subdivision: their rules
parts       connected parts; which of them intersect or nearly touch, and these moved apart at rest
welding     vertices at one place, and rows of numbers, each once
colors      colours as users and files give them, as linear light
motion      how a model moves over time
load        any model file as a surface
"""
