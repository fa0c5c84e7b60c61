"""Meshes that nobody modelled, made clean: they keep their colours, images and materials.

repair   the whole: triangles without area, duplicates, cracks, inner faces, and how many of each
cracks   borders that face each other across less than a cell, drawn together
inner    which triangles nothing outside can see
"""
