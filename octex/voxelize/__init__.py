"""A surface in cells: which it meets, what lies in each, and sums level by level. It knows no texture.

grid        which cells a triangle meets, exactly
clip        the fragment of a triangle in each of them
fragments   a surface cut into these, block of cells by block of cells
sums        what a source shows, summed over the fragments of each cell, and over the cells below others
"""
