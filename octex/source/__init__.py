"""Where values come from: models, their geometry, materials and images, as one surface with a source.

images/     image files decoded, their levels stored, footprints read by filters
models/     glTF, OBJ, PLY, OFF and STL files read
base        what a source is; sources joined
materials   the source that model files have
evaluate    its kernels
corners     what is bound to the corners of triangles
tangents    frames of normals and tangents there
given       channels of one's own
surface     triangles with a source
implicit    where a function is zero, as triangles
parts       what hangs together, and what intersects or nearly touches
gaps        how near two meshes come to each other
separation  such parts, moved apart at rest
load        any model file as a surface
alone       settings of the whole process, changed for a moment
"""
