"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4).

paint       images to a texture; painter: a session of strokes, with undo
region      spheres, boxes, functions, triangles and leaves of one colour, filled with one value
steps       the seven steps of the paper: a layer is rasterized, and merged into a texture
image       images with cameras, decoded to mips; sharpened: as values at points
surface     the painted surface, a call's job on it, its options, and a grid that finds triangles near paint
unwrap      a disc of the surface laid flat, for a camera
project     images as a source of paint, and the surface that cameras see; reading: its kernels
layer       any source of paint, its depth, and paint on cells of a level
boundary    cells around paint, on the surface and off it
blend       rows of channels are blended once, and the nodes above are averaged, with mixed residuals
merge       a layer is merged into a texture, in one draft or in pieces
first       a new texture: filled where no image sees, by multigrid on a graph of sheets; then merged
layers      strokes into layers above a texture; stack: the layers, their composite and file;
            composites: the composites that strokes lead to, and the eraser on the bottom
"""
