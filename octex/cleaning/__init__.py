"""Repairs scanned and generated meshes; colours, images and materials stay.

repair   removes triangles without area, duplicates and inner faces, closes cracks, and counts all of these
cracks   closes gaps, narrower than a cell, between facing borders
inner    finds the triangles that are visible from outside
"""
