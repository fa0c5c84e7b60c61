"""Paint: images projected through cameras onto a surface, and merged into a texture (paper 4)."""
