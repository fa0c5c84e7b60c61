"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4).

paint       pictures to a texture; options: what people may ask; painter: a session of strokes
region      spheres, boxes, functions and triangles filled with one value
steps       the seven steps of the paper: a layer rasterized, and merged into a texture
picture     images with cameras, decoded to mips; sharpened: as values at points
surface     what is painted, and which of its triangles are near paint
unwrap      a disc of the surface laid flat, for a camera; conformal: so that angles change least
sight       what cameras see of the surface
project     pictures as a source of paint; reading: what one of them paints at points; layer: any such source
boundary    cells around paint, on the surface and off it; cells: paint as it lies on them
blend       each cell blended once, and averages above
merge       a layer merged into a texture, in drafts; first: made the leaves of a new texture
holes       what no picture saw, filled: multigrid on the graph of sheets, the surface in cells
layers      strokes into layers above a texture; stack: the layers and their composite; stack_file: saved;
            beneath: what a page shows of a stroke below others; restore: an eraser on the bottom
history     strokes that can be undone; alike: the leaves of one colour
resume      finished stages, stored in a folder for the next call
"""
