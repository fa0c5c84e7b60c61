"""Cuts a surface into the cells of an octree: exact tests, fragments, and sums by level. It knows no texture.

grid        the cells that a triangle meets, exactly
clip        the fragment of a triangle in each cell
fragments   cuts a whole surface into fragments, block of cells by block of cells
sums        sums of source values over the fragments of each cell, and over the cells below a node
"""
