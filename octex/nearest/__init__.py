"""What is near: the nearest points of triangles and of clouds, and how near two meshes come.

boxes       a tree of boxes over triangles
triangles   the nearest point of them
points      the nearest points of a cloud
distances   how near two meshes come
"""
