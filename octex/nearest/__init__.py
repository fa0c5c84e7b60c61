"""Nearest points of triangle meshes and point clouds, and the distance of two meshes.

boxes       a bounding box hierarchy
triangles   the nearest point of a mesh, and the smallest distance of two
points      the nearest points of a cloud
"""
